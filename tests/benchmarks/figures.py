"""The figures of one round: what is measured, and how it is computed from replies."""

import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
from benchmarks.load import Group, Reply, closed, leave, opened, request, spent
from benchmarks.server import Server
from tiny_bundles import walking

from service.media import JSON, MSGPACK, encoded

NUM_SAMPLES = 50
NUM_STEPS = 10
CLIENTS = 8
OVERLOAD = 10
LEAVERS = 5
LEAVING_SAMPLES = 200
ROWS = "motion_batch_rows_sum"
UNWANTED = "motion_rows_unwanted_total"
DEADLINES = 20

Figures = dict[str, float]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Bench:
    """What a round works with: two servers, and processes that put load on one and probe it."""

    paper: Callable[[], object]
    latency: Server
    throughput: Server
    loader: Executor
    prober: Executor
    singles: int
    seconds: float


def figures_of_a_round(bench: Bench) -> Figures:
    """Every figure, each from what this round alone has measured."""
    single = _single(bench)
    crowd = _crowd(bench, single)
    mixed = _mixed(bench, single)
    late = _deadlines(bench, mixed)
    over = _overloaded(bench, crowd)
    return single | crowd | mixed | late | over | _after_leaving(bench)


def _single(bench: Bench) -> Figures:
    """One request at a time, and the paper's sizes in turn with them; milliseconds."""
    with httpx.Client() as http:

        def asked(server: Server, media_type: str = MSGPACK, **options: Any) -> Callable[[], float]:
            body, headers = _body(media_type, **options), _headers(media_type)

            def ask() -> float:
                reply = http.post(f"{server.url}/predict", content=body, headers=headers)
                reply.raise_for_status()
                return _stages_ms(reply.headers["server-timing"])["engine"]

            return ask

        sides: dict[str, Callable[[], object]] = {
            "paper": bench.paper,
            "binary": asked(bench.latency),
            "json": asked(bench.latency, JSON),
            "one_step": asked(bench.latency, num_steps=1),
            "shared": asked(bench.throughput),
            "shared_one_step": asked(bench.throughput, num_steps=1),
        }
        found: dict[str, list[float]] = {}
        for _ in range(bench.singles):
            for name, run in sides.items():
                time.sleep(0.02)  # thread pools spin after a call and would slow the next side
                started_s = time.perf_counter()
                engine_ms = run()
                found.setdefault(name, []).append(1e3 * (time.perf_counter() - started_s))
                if isinstance(engine_ms, float):
                    found.setdefault(f"{name}_engine", []).append(engine_ms)
    ms = {f"{name}_ms": float(np.median(values)) for name, values in found.items()}
    step_ms = (ms["shared_engine_ms"] - ms["shared_one_step_engine_ms"]) / (NUM_STEPS - 1)
    return ms | {
        "step_ms": step_ms,
        "compute": ms["paper_ms"] / ms["binary_engine_ms"],
        "over_binary": ms["paper_ms"] / ms["binary_ms"],
        "over_json": ms["paper_ms"] / ms["json_ms"],
        "shared_over_binary": ms["paper_ms"] / ms["shared_ms"],
        "one_step": ms["one_step_engine_ms"] / ms["binary_engine_ms"],
    }


def _crowd(bench: Bench, single: Figures) -> Figures:
    """Eight clients of equal requests, who each ask again as soon as they are answered."""
    probing = bench.prober.submit(closed, bench.throughput.port, [_livez()], bench.seconds)
    groups = [Group(clients=CLIENTS, requests=[_ten()])]
    [replies], cost = _loaded(bench, closed, groups, bench.seconds)
    [probes] = probing.result()
    seconds = _seconds(_good(replies))
    per_s = _per_s(replies, bench.seconds)
    return {
        "per_s": per_s,
        "throughput": per_s * single["paper_ms"] / 1e3,
        "spread": float(np.quantile(seconds, 0.99) / np.median(seconds)),
        "crowd_p50_ms": 1e3 * float(np.median(seconds)),
        "crowd_server_ms": 1e3 * cost.server_s / len(replies),
        "crowd_load_ms": 1e3 * cost.load_s / len(replies),
        "livez_p99_ms": 1e3 * float(np.quantile(_seconds(_good(probes)), 0.99)),
    }


def _mixed(bench: Bench, single: Figures) -> Figures:
    """One client of one-step requests among eight of ten-step ones."""
    groups = [
        Group(clients=CLIENTS, requests=[_ten()]),
        Group(clients=1, requests=[_asking(_body(num_steps=1))]),
    ]
    (tens, ones), _ = _loaded(bench, closed, groups, bench.seconds)
    waits = [_stages_ms(reply.headers["server-timing"])["queue"] for reply in _good(ones)]
    seconds = _seconds(_good(ones))
    return {
        "wait_steps": float(np.quantile(waits, 0.99)) / single["step_ms"],
        "later_steps": (1e3 * float(np.median(seconds)) - single["shared_one_step_ms"])
        / single["step_ms"],
        "one_step_p99_s": float(np.quantile(seconds, 0.99)),
        "ten_steps_p50_s": float(np.median(_seconds(_good(tens)))),
    }


def _deadlines(bench: Bench, mixed: Figures) -> Figures:
    """The same crowd, and a client with deadlines that one step fits into, and not always ten."""
    least, most = mixed["one_step_p99_s"], mixed["ten_steps_p50_s"]
    deadlines = np.linspace(least, max(most, 1.5 * least), DEADLINES)
    asked = [_asking(_body(), x_request_timeout_seconds=f"{s:.6f}") for s in deadlines]
    groups = [Group(clients=CLIENTS, requests=[_ten()]), Group(clients=1, requests=asked)]
    (others, replies), cost = _loaded(bench, closed, groups, bench.seconds)
    met = [reply.status == 200 and reply.seconds <= deadlines[reply.which] for reply in replies]
    return {
        "in_time": float(np.mean(met)),
        "timed": len(met),
        "in_time_late_ms": 1e3 * cost.waited_s / (len(others) + len(replies)),
    }


def _overloaded(bench: Bench, crowd: Figures) -> Figures:
    """Requests at ten times the rate of the eight clients, whatever the answers."""
    probing = bench.prober.submit(closed, bench.throughput.port, [_livez()], bench.seconds)
    per_s = OVERLOAD * crowd["per_s"]
    replies, cost = _loaded(bench, opened, _ten(), per_s=per_s, seconds=bench.seconds)
    [probes] = probing.result()
    refused = [reply for reply in replies if reply.status != 200]
    polite = [reply.status == 429 and "retry-after" in reply.headers for reply in refused]
    return {
        "offered": len(replies) / bench.seconds / crowd["per_s"],
        "goodput": _per_s(replies, bench.seconds) / crowd["per_s"],
        "polite": float(np.mean(polite)) if polite else 1.0,
        "overload_server_s": cost.server_s / cost.wall_s,
        "overload_load_s": cost.load_s / cost.wall_s,
        "overloaded_livez_p99_ms": 1e3 * float(np.quantile(_seconds(_good(probes)), 0.99)),
    }


def _after_leaving(bench: Bench) -> Figures:
    """Steps of a large request that ran in vain after its client had left; the most of a few.

    Those that ran when the server learnt of it, by its own count, and all since the client last
    looked at its metrics before it left.
    """
    server = bench.throughput
    asked = _asking(_body(num_samples=LEAVING_SAMPLES))
    vain, since = 0.0, 0.0
    for _ in range(LEAVERS):
        before = server.metric(UNWANTED)
        left = bench.loader.submit(
            leave, server.port, asked, metric=ROWS, after=2 * LEAVING_SAMPLES
        ).result()
        since = max(since, (_rows_when_idle(server) - left) / LEAVING_SAMPLES)
        vain = max(vain, (server.metric(UNWANTED) - before) / LEAVING_SAMPLES)
    return {"steps_after_leaving": vain, "steps_since_look": since}


@dataclass(frozen=True, kw_only=True, slots=True)
class _Cost:
    """CPU seconds of both sides, and how long the load itself waited for a core."""

    server_s: float
    load_s: float
    waited_s: float
    wall_s: float


def _loaded(bench: Bench, work: Callable[..., Any], *asked: Any, **how: Any) -> tuple[Any, _Cost]:
    """What a load on the server gives, and what it costs."""
    server = bench.throughput

    def passed() -> tuple[float, ...]:
        return server.cpu_s(), *bench.loader.submit(spent).result(), time.perf_counter()

    before = passed()
    found = bench.loader.submit(work, server.port, *asked, **how).result()
    server_s, load_s, waited_s, wall_s = (b - a for a, b in zip(before, passed(), strict=True))
    return found, _Cost(server_s=server_s, load_s=load_s, waited_s=waited_s, wall_s=wall_s)


def _rows_when_idle(server: Server) -> float:
    """Rows that ran until now, once none has for a while."""
    rows, found = -1.0, server.metric(ROWS)
    while found > rows:
        time.sleep(0.2)
        rows, found = found, server.metric(ROWS)
    return rows


def _body(media_type: str = MSGPACK, **options: Any) -> bytes:
    fields = {"poses": walking().astype(np.float32), "num_samples": NUM_SAMPLES, "seed": 1}
    return encoded(fields | options, media_type)


def _headers(media_type: str) -> dict[str, str]:
    return {"content-type": media_type, "accept": media_type}


def _asking(body: bytes, *, accept: str = MSGPACK, **headers: str) -> bytes:
    return request("POST", "/predict", body, content_type=MSGPACK, accept=accept, **headers)


def _ten() -> bytes:
    return _asking(_body())


def _livez() -> Group:
    return Group(clients=1, requests=[request("GET", "/livez")], pause_s=0.02)


def _good(replies: Sequence[Reply]) -> list[Reply]:
    good = [reply for reply in replies if reply.status == 200]
    if not good:
        raise SystemExit(f"found no good answer among {len(replies)}; see the server's log")
    return good


def _seconds(replies: Sequence[Reply]) -> list[float]:
    return [reply.seconds for reply in replies]


def _per_s(replies: Sequence[Reply], seconds: float) -> float:
    """Good answers a second, one at least, without the first fifth, in which the load builds up."""
    started_s = min(reply.sent_s for reply in replies)
    ends = [reply.sent_s + reply.seconds - started_s for reply in _good(replies)]
    return max(1, sum(0.2 * seconds <= end <= seconds for end in ends)) / (0.8 * seconds)


def _stages_ms(header: str) -> dict[str, float]:
    return {name: float(ms) for name, ms in re.findall(r"(\w+);dur=([\d.]+)", header)}
