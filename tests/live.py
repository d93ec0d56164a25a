"""The application behind a real socket: uvicorn in a thread, on a port that is free."""

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import uvicorn

from service.app import create_app
from service.settings import Settings

PATIENCE_S = 60.0


class Live:
    """Runs until its ``with`` ends; ``sock()`` is a new connection to it."""

    def __init__(
        self, bundles: Path, *, listener: socket.socket | None = None, **settings: Any
    ) -> None:
        self.app = create_app(Settings(bundles=bundles, threads=1, **settings))
        config = uvicorn.Config(self.app, port=0, log_config=None, timeout_graceful_shutdown=1)
        self._server = uvicorn.Server(config)
        sockets = None if listener is None else [listener]
        self._thread = threading.Thread(target=self._server.run, args=(sockets,))

    def __enter__(self) -> "Live":
        self._thread.start()
        until(lambda: self._server.started and self.app.state.catalog.state == "ready")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._server.should_exit = True
        self._thread.join()

    @property
    def port(self) -> int:
        port: int = self._server.servers[0].sockets[0].getsockname()[1]
        return port

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def under_way(self) -> int:
        """How many requests the workers hold."""
        entries = self.app.state.catalog.entries.values()
        return sum(entry.worker.load().requests for entry in entries if entry.worker)

    def sock(self, body: bytes, *, path: str = "/predict", accept: str = "*/*") -> socket.socket:
        """A connection on which a request has been sent, and nothing read."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        head = (
            f"POST {path} HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n"
            f"accept: {accept}\r\ncontent-length: {len(body)}\r\nx-request-id: mine\r\n\r\n"
        )
        connection.sendall(head.encode() + body)
        return connection


def until(condition: Callable[[], bool], *, patience_s: float = PATIENCE_S) -> None:
    """Wait for something that must become true."""
    give_up = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < give_up, "it never became true"
        time.sleep(0.002)
