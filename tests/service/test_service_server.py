import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import pytest
from in_memory import JSON, dumped
from live import until
from tiny_bundles import walking

WALK = walking()
LONG = dumped({"poses": WALK, "num_samples": 1, "horizon_s": 8000.0})  # 40,000 steps
LONGISH = dumped({"poses": WALK, "num_samples": 1, "horizon_s": 200.0})
SMALL = dumped({"poses": WALK, "num_samples": 1})


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def answered(url: str, path: str) -> int:
    try:
        return httpx.get(f"{url}{path}").status_code
    except httpx.TransportError:
        return 0


@contextmanager
def serving(bundles: Path, **settings: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """The command ``posefutures serve`` in a process of its own, ready."""
    port = free_port()
    settings |= {"BUNDLES": str(bundles), "WORKERS": "1", "MAX_HORIZON_S": "10000"}
    environment = os.environ | {f"POSEFUTURES_{k}": v for k, v in settings.items()}  # noqa: TID251
    command = [
        sys.executable,
        "-c",
        "from service.cli import app; app()",
        "serve",
        "--port",
        str(port),
    ]
    process = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )
    try:
        url = f"http://127.0.0.1:{port}"
        until(lambda: answered(url, "/readyz") == 200)
        yield process, url
    finally:
        process.kill()
        process.communicate()


def in_flight(url: str) -> bool:
    return 'motion_queue_requests{model="diffusion"} 1.0' in httpx.get(f"{url}/metrics").text


@contextmanager
def asking(url: str, body: bytes, **headers: str) -> Iterator[list[httpx.Response]]:
    """A request under way, and the list that its response will be in."""
    responses: list[httpx.Response] = []

    def ask() -> None:
        responses.append(
            httpx.post(f"{url}/predict", content=body, headers=JSON | headers, timeout=120)
        )

    thread = Thread(target=ask)
    thread.start()
    until(lambda: in_flight(url))
    yield responses
    thread.join()


def test_idle_server_ends_with_status_0(bundles: Path):
    for sig in (signal.SIGTERM, signal.SIGINT):
        with serving(bundles) as (process, url):
            assert httpx.post(f"{url}/predict", content=SMALL, headers=JSON).status_code == 200
            process.send_signal(sig)
            _, log = process.communicate(timeout=60)
            assert process.returncode == 0, log
            lines: list[dict[str, Any]] = [json.loads(line) for line in log.splitlines()]
            (told,) = (line for line in lines if line.get("route") == "/predict")
            assert (told["status"], told["outcome"]) == (200, "ok")


@pytest.mark.parametrize("accept", ["application/json", "text/event-stream"])
def test_busy_server_hands_over_what_it_has(bundles: Path, accept: str):
    with serving(bundles, DRAIN_S="5") as (process, url):
        with asking(url, LONG, accept=accept) as responses:
            process.terminate()
            until(lambda: answered(url, "/readyz") == 503)
            assert httpx.get(f"{url}/readyz").json()["status"] == "draining"
            assert answered(url, "/livez") == 200
            refused = httpx.post(f"{url}/predict", content=SMALL, headers=JSON)
            assert (refused.status_code, refused.json()["type"]) == (503, "/problems/unavailable")
            assert refused.headers["retry-after"]
        process.communicate(timeout=60)
        assert process.returncode == 0
        (response,) = responses
        assert response.status_code == 200
        if accept == "application/json":
            assert response.json()["steps"]["stopped_by"] == "deadline"
        else:
            assert response.text.endswith("event: end\ndata: {}\n\n")


def test_work_that_fits_into_the_time_is_finished(bundles: Path):
    with serving(bundles, DRAIN_S="60") as (process, url):
        with asking(url, LONGISH) as responses:
            process.terminate()
        process.communicate(timeout=60)
        assert process.returncode == 0
        assert responses[0].json()["steps"]["stopped_by"] == "end"


def test_second_signal_ends_at_once(bundles: Path):
    with serving(bundles, DRAIN_S="600") as (process, url):
        address = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        with socket.create_connection(address) as connection:
            head = "POST /predict HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n"
            connection.sendall(f"{head}content-length: {len(LONG)}\r\n\r\n".encode() + LONG)
            until(lambda: in_flight(url))
            process.terminate()
            until(lambda: answered(url, "/readyz") == 503)
            process.terminate()
            process.communicate(timeout=60)
            assert process.returncode is not None
