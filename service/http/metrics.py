"""What the server tells Prometheus; one process, one registry, no name for a caller or a body."""

import asyncio
from collections import deque
from time import perf_counter

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)

from service.catalog import Catalog
from service.engine.engine import Turn
from service.http.visits import Visit
from service.worker import Outcome

_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
_ROWS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_LAG_EVERY_S = 0.1
_LAGS_KEPT = 100  # ten seconds


class Metrics:
    """Counts what happens; it observes workers, from any thread."""

    def __init__(self) -> None:
        registry = CollectorRegistry()
        ProcessCollector(registry=registry)

        def seconds(name: str, text: str, *labels: str) -> Histogram:
            return Histogram(f"motion_{name}_seconds", text, labels, buckets=_SECONDS,
                             registry=registry)  # fmt: skip

        def gauge(name: str, text: str, *labels: str) -> Gauge:
            return Gauge(f"motion_{name}", text, labels, registry=registry)

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(f"motion_{name}", text, labels, registry=registry)

        self._registry = registry
        self._requests = counter("requests", "requests answered", "endpoint", "outcome")
        self._rejected = counter("rejected", "requests not taken on, by problem", "reason")
        self._cancelled = counter("cancelled", "predictions given up by clients", "model", "stage")
        self._steps = counter("steps", "denoising steps of requests", "model", "kind")
        self._duration = seconds("request_duration", "from arrival to the last byte", "endpoint")
        self._queue = seconds("queue_wait", "from arrival to the first step", "model")
        self._dispatch = seconds("batch_dispatch", "choosing the rows of a step", "model")
        self._unwanted = counter("rows_unwanted", "rows whose client left meanwhile", "model")
        self._step = seconds("step_duration", "one step of the engine", "model")
        self._encode = seconds("encode", "writing an answer", "format")
        self._preview = seconds("first_preview", "from arrival to the first preview", "model")
        self._slack = seconds("deadline_slack", "left of the deadline at the answer", "model")
        self._rows = Histogram("motion_batch_rows", "rows of a step", ["model"], buckets=_ROWS,
                               registry=registry)  # fmt: skip
        self._in_flight = gauge("rows_in_flight", "rows of the latest step", "model")
        self._queue_requests = gauge("queue_requests", "requests under way and waiting", "model")
        self._queue_rows = gauge("queue_rows", "rows under way and waiting", "model")
        self._heartbeat = gauge(
            "engine_heartbeat_age_seconds", "since the last step; 0 when idle", "model"
        )
        self._lag = gauge("event_loop_lag_seconds", "worst delay of the last ten seconds")
        self._ready = gauge("ready", "1 where predictions are answered")
        self._draining = gauge("draining", "1 once told to end")
        self._golden = gauge(
            "golden_check", "1 where the golden request has one answer, alone and among others",
            "name",
        )  # fmt: skip
        self._info = gauge("model_info", "a bundle that is ready", "name", "version", "digest")
        self._beats: dict[str, float] = {}

    def stepped(self, *, model: str, turn: Turn, seconds: float) -> None:
        """A step of the engine has run."""
        self._rows.labels(model).observe(turn.num_rows)
        self._unwanted.labels(model).inc(turn.num_unwanted)
        self._dispatch.labels(model).observe(turn.dispatch_s)
        self._in_flight.labels(model).set(turn.num_rows)
        self._step.labels(model).observe(seconds)
        self._beats[model] = perf_counter()

    def ended(  # noqa: PLR0913 - all that a request has been
        self,
        *,
        model: str,
        outcome: Outcome,
        stopped_by: str | None,
        steps_run: int,
        steps_of: int,
        rows: int,
        queue_s: float,
        engine_s: float,
    ) -> None:
        """A request has left the worker."""
        del stopped_by, rows  # told by the request's own line of the log
        if outcome == "refused":
            return
        self._queue.labels(model).observe(queue_s)
        if outcome == "cancelled":
            self._cancelled.labels(model, "running" if engine_s > 0 else "queued").inc()
        for kind, count in {
            "planned": steps_of, "done": steps_run, "skipped": steps_of - steps_run
        }.items():  # fmt: skip
            self._steps.labels(model, kind).inc(count)

    def visited(self, visit: Visit, seconds: float) -> None:
        """A request has been answered, or given up."""
        self._requests.labels(visit.route, visit.outcome).inc()
        self._duration.labels(visit.route).observe(seconds)
        if "problem" in visit.facts and visit.outcome in ("rejected", "deadline"):
            self._rejected.labels(visit.facts["problem"]).inc()

    def answered(
        self, *, model: str, media_type: str, encode_s: float, slack_s: float | None
    ) -> None:
        """An answer was written."""
        self._encode.labels(media_type).observe(encode_s)
        if slack_s is not None:
            self._slack.labels(model).observe(max(0.0, slack_s))

    def previewed(self, *, model: str, seconds: float) -> None:
        """The first preview of a stream was written."""
        self._preview.labels(model).observe(seconds)

    def text(self, catalog: Catalog, *, draining: bool) -> bytes:
        """Everything in Prometheus' format, with the state of now."""
        self._ready.set(catalog.state == "ready" and not draining)
        self._draining.set(draining)
        for entry in catalog.entries.values():
            if entry.state != "loading":
                self._golden.labels(entry.name).set(entry.golden_digest is not None)
            if entry.worker is None or entry.manifest is None:
                continue
            load = entry.worker.load()
            self._queue_requests.labels(entry.name).set(load.requests)
            self._queue_rows.labels(entry.name).set(load.rows)
            now = perf_counter()
            age = now - self._beats.get(entry.name, now) if load.requests else 0.0
            self._heartbeat.labels(entry.name).set(age)
            if not load.requests:
                self._in_flight.labels(entry.name).set(0)
            self._info.labels(entry.name, entry.manifest.version, entry.manifest.digest).set(1)
        return generate_latest(self._registry)

    async def watch_event_loop(self) -> None:
        """Measure, until cancelled, how late the event loop wakes those who sleep."""
        loop = asyncio.get_running_loop()
        lags: deque[float] = deque(maxlen=_LAGS_KEPT)
        while True:
            due = loop.time() + _LAG_EVERY_S
            await asyncio.sleep(_LAG_EVERY_S)
            lags.append(max(0.0, loop.time() - due))
            self._lag.set(max(lags))
