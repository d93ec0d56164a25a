import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from in_memory import JSON, Service, dumped
from prometheus_client.parser import text_string_to_metric_families
from tiny_bundles import walking

from service.errors import ServiceError
from service.http import telemetry
from service.http.logs import JsonFormatter

POSES = walking() + 0.123456


def posted(service: Service, **fields: Any) -> None:
    body = dumped({"poses": POSES, "num_samples": 2, "seed": 7, **fields})
    headers = JSON | {"x-request-id": "mine"}
    service.request("POST", "/predict", content=body, headers=headers)


def samples(service: Service) -> dict[tuple[str, ...], float]:
    response = service.get("/metrics")
    assert response.headers["content-type"].startswith("text/plain; version=")
    return {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


@pytest.fixture
def fresh(bundles: Path) -> Iterator[Service]:
    with Service.of(bundles) as service:
        service.wait_until_loaded()
        yield service


def test_metrics_count_what_happened(fresh: Service):
    own = samples(fresh)  # of the request that warmed the server up, only what the engine did
    posted(fresh)
    posted(fresh, num_steps=4)
    posted(fresh, num_samples=0)
    posted(fresh, deadline_ms=1e-6)
    found = samples(fresh)

    def steps(kind: str) -> float:
        return found[name := ("motion_steps_total", "diffusion", kind)] - own[name]

    for outcome, count in {"ok": 2.0, "invalid": 1.0, "deadline": 1.0}.items():
        assert found["motion_requests_total", "/predict", outcome] == count
    assert found["motion_request_duration_seconds_count", "/predict"] == 4.0
    assert steps("planned") == 20.0
    assert steps("done") == 14.0
    assert steps("skipped") == 6.0
    assert found["motion_queue_wait_seconds_count", "diffusion"] == 3.0
    assert found["motion_step_duration_seconds_count", "diffusion"] >= 10.0
    assert found["motion_batch_rows_count", "diffusion"] >= 10.0
    assert found["motion_batch_dispatch_seconds_count", "diffusion"] >= 10.0
    assert found["motion_rows_unwanted_total", "diffusion"] == 0.0
    assert found["motion_golden_check", "diffusion"] == 1.0
    assert found["motion_encode_seconds_count", "application/json"] == 3.0
    assert found["motion_queue_requests", "diffusion"] == 0.0
    assert found["motion_queue_rows", "diffusion"] == 0.0
    assert found["motion_engine_heartbeat_age_seconds", "diffusion"] == 0.0
    assert (found["motion_ready",], found["motion_draining",]) == (1.0, 0.0)
    assert found["motion_event_loop_lag_seconds",] >= 0.0
    assert found["process_resident_memory_bytes",] > 0.0
    assert sum(name[0] == "motion_model_info" for name in found) == 2


def test_server_that_is_ready_has_answered_a_request_of_its_own_which_nobody_counts(
    bundles: Path, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.INFO)
    with Service.of(bundles, api_keys="secret", rate_limit="1/minute") as service:
        service.wait_until_loaded()
        headers = JSON | {"authorization": "Bearer secret"}
        told = service.request("GET", "/metrics", headers=headers).text
        body = dumped({"poses": POSES, "num_samples": 1})
        answers = [
            service.request("POST", "/predict", content=body, headers=headers) for _ in range(2)
        ]
    assert 'motion_queue_wait_seconds_count{model="diffusion"} 1.0' in told
    assert "motion_requests_total{" not in told
    assert [answer.status_code for answer in answers] == [200, 429]
    assert not [line for line in lines(caplog) if line.get("request_id") == "own"]


def test_paths_that_are_not_there_share_one_label(fresh: Service):
    for path in ("/a", "/b"):
        fresh.get(path)
    assert samples(fresh)["motion_requests_total", "invalid", "unknown"] == 2.0


def lines(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    formatter = JsonFormatter()
    return [json.loads(formatter.format(record)) for record in caplog.records]


def test_log_has_a_line_of_json_for_each_request_and_no_poses(
    fresh: Service, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.DEBUG)
    posted(fresh, num_steps=4)
    posted(fresh, poses=[[[0.123456] * 3] * 21] * 15)
    good, bad = (line for line in lines(caplog) if line["logger"] == "service.http.visits")
    assert {"time", "duration_ms", "queue_ms", "engine_ms", "answer_ms", "digest"} <= set(good)
    expected = {
        "level": "info", "message": "request", "method": "POST", "route": "/predict",
        "status": 200, "outcome": "ok", "model": "diffusion", "seed": 7, "rows": 2,
        "steps_run": 4, "steps_of": 10, "stopped_by": "num_steps",
    }  # fmt: skip
    assert {key: good[key] for key in expected} == expected
    assert (bad["status"], bad["outcome"]) == (422, "invalid")
    assert "123456" not in caplog.text + json.dumps(lines(caplog))


def test_line_of_the_log_tells_its_request_and_its_exception():
    record = logging.LogRecord("here", logging.ERROR, "", 0, "broke %s", ("down",), None)
    assert json.loads(JsonFormatter().format(record))["message"] == "broke down"
    try:
        raise ZeroDivisionError
    except ZeroDivisionError:
        record.exc_info = sys.exc_info()
    assert "ZeroDivisionError" in json.loads(JsonFormatter().format(record))["exception"]


def test_without_an_endpoint_nothing_is_traced():
    config = telemetry.telemetry_config(None)
    assert not config["tracing"]
    assert not config["auto_configure"]


def test_endpoint_without_the_packages_is_a_clear_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(telemetry, "_EXPORTER", "no.such.package")
    with pytest.raises(ServiceError, match=r"pip install 'posefutures\[telemetry\]'"):
        telemetry.telemetry_config("http://127.0.0.1:4318")


def test_spans_of_a_request_and_its_stages_are_sent(bundles: Path):
    """In a process of its own, for OpenTelemetry keeps global state."""
    received: list[bytes] = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            received.append(self.rfile.read(int(self.headers["content-length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    collector = HTTPServer(("127.0.0.1", 0), Collector)
    Thread(target=collector.serve_forever, daemon=True).start()
    code = f"""
import logging
import httpx
from live import Live
from in_memory import JSON, dumped
from tiny_bundles import walking
with Live({str(bundles)!r}) as live:
    body = dumped({{"poses": walking(), "num_samples": 2}})
    trace = {{"traceparent": "00-" + "ab" * 16 + "-" + "cd" * 8 + "-01"}}
    assert httpx.post(f"{{live.url}}/predict", content=body, headers=JSON | trace).is_success
"""
    endpoint = f"http://127.0.0.1:{collector.server_port}"
    path = os.pathsep.join(str(Path(__file__).parents[i]) for i in (1, 2))
    environment = os.environ | {"PYTHONPATH": path}  # noqa: TID251 - of a child
    environment["OTEL_EXPORTER_OTLP_ENDPOINT"] = endpoint
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=120)
    collector.shutdown()
    collector.server_close()
    sent = b"".join(received)
    for name in (b"POST /predict", b"queue", b"engine", b"answer", b"\xab" * 16, b"\xcd" * 8):
        assert name in sent
