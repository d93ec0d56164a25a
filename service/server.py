"""The process that serves: uvicorn, which drains before it ends when it is told to end."""

import asyncio
import gc
import socket
import sys
from types import FrameType

import uvicorn
from fastapi import FastAPI

from service.app import create_app, drain
from service.http.logs import log_as_json
from service.settings import Settings

GRACE_S = 5  # for answers that are written but not yet read
SWITCH_S = 0.001  # after which a thread that writes an answer lets the event loop go on


def serve(settings: Settings, *, host: str, port: int) -> None:
    """Answer until told to end by SIGTERM or SIGINT, and log as JSON.

    Raises:
        ServiceError: it is configured for something that is not installed.
    """
    log_as_json()
    sys.setswitchinterval(SWITCH_S)
    _Server(create_app(settings, once_ready=_spare_collector), host=host, port=port).run()


def _spare_collector() -> None:
    """Let the garbage collector pass over all that there is now, which lasts until the end.

    To walk over it takes a tenth of a second, in which every thread waits.
    """
    gc.collect()
    gc.freeze()


class _Server(uvicorn.Server):
    """Stays reachable while it drains, so that /readyz tells; then ends with status 0."""

    def __init__(self, app: FastAPI, *, host: str, port: int) -> None:
        config = uvicorn.Config(
            app,
            host=host,
            port=port,
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=GRACE_S,
            ws_per_message_deflate=False,  # an answer has a megabyte, ten times a second
        )
        super().__init__(config)
        self._app = app
        self._loop: asyncio.AbstractEventLoop | None = None
        self._draining: asyncio.Task[None] | None = None

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer until told to end."""
        self._loop = asyncio.get_running_loop()
        await super().serve(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:  # noqa: ARG002 - uvicorn's
        """Drain at the first signal, end at once at the second."""
        if self._loop is None or self._draining is not None:
            self.should_exit = self.force_exit = True
        else:
            self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        self._draining = asyncio.ensure_future(drain(self._app))
        self._draining.add_done_callback(self._end)

    def _end(self, _: "asyncio.Task[None]") -> None:
        self.should_exit = True
