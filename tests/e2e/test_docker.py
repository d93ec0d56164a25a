"""The image: built and brought up by compose, asked for futures, taken down."""

import json
import shutil
import socket
import subprocess
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tiny_bundles import walking

ROOT = Path(__file__).parents[2]
SERVICE = "posefutures"
NUM_FRAMES, NUM_SAMPLES, NUM_JOINTS = 30, 3, 21

PROBE = """
import importlib.util, json, os
status = dict(line.split(":\\t", 1) for line in open("/proc/self/status") if ":\\t" in line)
print(json.dumps({
    "uid": os.getuid(),
    "gid": os.getgid(),
    "root_is_read_only": bool(os.statvfs("/").f_flag & os.ST_RDONLY),
    "capabilities": int(status["CapEff"], 16),
    "no_new_privileges": int(status["NoNewPrivs"]),
    "torch": importlib.util.find_spec("torch") is not None,
}))
"""

pytestmark = pytest.mark.slow


@dataclass(frozen=True, kw_only=True, slots=True)
class Stack:
    """A compose project of its own: other projects of this engine stay as they are."""

    project: str
    url: str

    def compose(self, *arguments: str, timeout_s: float = 60.0) -> str:
        """What a compose command printed; its failure comes with the container's log."""
        done = self._run(*arguments, timeout_s=timeout_s)
        if done.returncode:
            command = f"docker compose {' '.join(arguments)}"
            said = f"{done.stdout}{done.stderr}"[-6000:]
            pytest.fail(f"{command}: exit status {done.returncode}\n{said}\n{self.logs()}")
        return done.stdout

    def logs(self) -> str:
        done = self._run("logs", "--no-color", "--tail", "80")
        return f"--- the container's log\n{done.stdout}{done.stderr}"

    def _run(self, *arguments: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
        options = ("-f", "compose.yaml", "-p", self.project)
        return _docker("compose", *options, *arguments, timeout_s=timeout_s)

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            return httpx.request(method, f"{self.url}{path}", timeout=60.0, **options)
        except httpx.TransportError as error:
            pytest.fail(f"{method} {path}: {error!r}\n{self.logs()}")


@pytest.fixture(scope="module")
def stack() -> Iterator[Stack]:
    """The service of compose.yaml, healthy, on a free port."""
    reason = _why_no_engine()
    if reason is not None:
        pytest.skip(reason)
    port = _free_port()
    stack = Stack(
        project=f"posefutures-test-{uuid.uuid4().hex[:8]}", url=f"http://127.0.0.1:{port}"
    )
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("PORT", str(port))
        try:
            stack.compose("build", timeout_s=900.0)
            stack.compose("up", "--detach", "--wait", "--wait-timeout", "120", timeout_s=180.0)
            yield stack
        finally:
            stack.compose("down", "--volumes", "--rmi", "local", "--timeout", "15")


def test_the_image_is_ready_and_gives_futures(stack: Stack) -> None:
    ready = stack.ask("GET", "/readyz")
    assert ready.status_code == 200, f"{ready.text}\n{stack.logs()}"

    fields = {"skeleton": "body21", "fps": 30, "num_samples": NUM_SAMPLES, "seed": 1}
    response = stack.ask("POST", "/predict", json={"poses": walking(NUM_FRAMES).tolist(), **fields})

    assert response.status_code == 200, f"{response.text[:2000]}\n{stack.logs()}"
    answer = response.json()
    futures = np.array(answer["futures"])
    assert futures.shape == (NUM_SAMPLES, answer["num_frames"], NUM_JOINTS, 3)
    assert np.isfinite(futures).all()


def test_the_container_may_do_nothing_but_serve(stack: Stack) -> None:
    seen = json.loads(stack.compose("exec", "-T", SERVICE, "python", "-c", PROBE))

    assert seen["uid"] != 0
    assert seen["gid"] != 0
    assert seen["root_is_read_only"]
    assert seen["capabilities"] == 0
    assert seen["no_new_privileges"] == 1
    assert not seen["torch"]


def _why_no_engine() -> str | None:
    if shutil.which("docker") is None:
        return "docker is not installed"
    if _docker("info").returncode:
        return "no Docker engine answers"
    if _docker("compose", "version").returncode:
        return "docker has no compose plugin"
    return None


def _docker(*arguments: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["docker", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
    return port
