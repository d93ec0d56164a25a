"""OpenTelemetry spans of each request and its stages, where an endpoint for them is configured.

FastAPI makes the span of the request and exports it; here is what goes on inside.
"""

from collections.abc import Mapping
from importlib.util import find_spec
from time import time_ns

from fastapi.telemetry import TelemetryConfig
from opentelemetry import trace

from service.errors import ServiceError
from service.http.guard import OPEN_PATHS

_EXPORTER = "opentelemetry.exporter.otlp.proto.http"


def telemetry_config(endpoint: str | None) -> TelemetryConfig:
    """What FastAPI is told: to trace predictions, if anywhere, and to log or count nothing itself.

    Raises:
        ServiceError: spans are to be sent to an endpoint, but not the packages for it are there.
    """
    if endpoint and not _installed(_EXPORTER):
        raise ServiceError(
            f"OTEL_EXPORTER_OTLP_ENDPOINT: found {endpoint!r}, but no package that sends spans; "
            "pip install 'posefutures[telemetry]', or leave it unset."
        )
    return {
        "tracing": bool(endpoint),
        "auto_configure": bool(endpoint),
        "metrics": False,
        "logs": False,  # they would hold parts of a body that is refused
        "operation_spans": False,
        "exclude": lambda scope: scope["path"] in (*OPEN_PATHS, "/metrics"),
    }


def record_stages(stages_s: Mapping[str, float]) -> None:
    """Add a span for each stage, which came one after the other until now, to the request's."""
    tracer = trace.get_tracer(__name__)
    start_ns = time_ns() - round(1e9 * sum(stages_s.values()))
    for name, seconds in stages_s.items():
        span = tracer.start_span(name, start_time=start_ns)
        start_ns += round(1e9 * seconds)
        span.end(end_time=start_ns)


def _installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of a parent
        return False
