"""A real server in a process of its own."""

import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import httpx

ROOT = Path(__file__).parents[2]
START_S = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Server:
    """Where it listens, which process it is, and how long it took to be ready."""

    port: int
    pid: int
    start_s: float

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def peak_memory_mb(self) -> float:
        """The most memory that the process ever held."""
        status = Path(f"/proc/{self.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", status)
        assert found, status
        return int(found[1]) / 1000

    def cpu_s(self) -> float:
        """The CPU seconds of the process so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def metric(self, name: str) -> float:
        """A metric of the server, summed over its labels."""
        text = httpx.get(f"{self.url}/metrics").text
        return sum(map(float, re.findall(rf"^{name}(?:{{.*}})? (\S+)$", text, re.MULTILINE)))


@contextmanager
def serving(**settings: str) -> Iterator[Server]:
    """A server that is ready, with settings such as ``profile="latency"``."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    values = [f"POSEFUTURES_{name.upper()}={value}" for name, value in settings.items()]
    posefutures = str(Path(sys.executable).with_name("posefutures"))
    # The PYTHONPATH of the benchmark holds tests/, whose folders are not the server's rooms.
    command = ["env", "-u", "PYTHONPATH", *values, posefutures, "serve", "--port", str(port)]
    started_s = time.perf_counter()
    with TemporaryFile() as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
        try:
            _wait_until_ready(port, process)
            yield Server(port=port, pid=process.pid, start_s=time.perf_counter() - started_s)
        except BaseException:
            log.seek(0)
            sys.stderr.writelines(log.read().decode().splitlines(keepends=True)[-20:])
            raise
        finally:
            process.terminate()
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_until_ready(port: int, process: subprocess.Popen[bytes]) -> None:
    until_s = time.perf_counter() + START_S
    while time.perf_counter() < until_s:
        if process.poll() is not None:
            raise SystemExit(f"the server ended with {process.returncode} before it was ready")
        try:
            if httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.02)
    raise SystemExit(f"the server was not ready within {START_S:.0f} s")
