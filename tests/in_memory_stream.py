"""A WebSocket to the application in memory, whose client reads only when a test does."""

import asyncio
from collections.abc import Sequence
from typing import Any

import numpy as np
import orjson
from fastapi import FastAPI

from service.media import MSGPACK, decoded, encoded

PATIENCE_S = 60.0


def nulled(pose: np.ndarray) -> list[Any]:
    """A pose as JSON has it."""
    return [None if np.isnan(joint).any() else joint.tolist() for joint in pose]


class Stream:
    """An async context manager; ``said()`` is the next message of the server."""

    def __init__(
        self,
        app: FastAPI,
        *,
        path: str = "/stream",
        key: str | None = None,
        protocols: Sequence[str] = (),
    ) -> None:
        headers = [] if key is None else [(b"authorization", f"Bearer {key}".encode())]
        self._scope = {
            "type": "websocket", "path": path, "raw_path": path.encode(), "headers": headers,
            "query_string": b"", "scheme": "ws", "client": ("test", 1), "server": ("service", 80),
            "subprotocols": list(protocols), "extensions": {"websocket.http.response": {}},
            "state": {},
        }  # fmt: skip
        self._app = app
        self._to_app: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._from_app: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._may_send = asyncio.Event()
        self._may_send.set()

    async def __aenter__(self) -> "Stream":
        self._to_app.put_nowait({"type": "websocket.connect"})
        self._running = asyncio.ensure_future(self._app(self._scope, self._to_app.get, self._send))
        self.opening = await self._event()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.leave()
        self.read_on()
        await asyncio.wait_for(self._running, PATIENCE_S)

    def leave(self) -> None:
        """Drop the connection."""
        self._to_app.put_nowait({"type": "websocket.disconnect", "code": 1006})

    def stop_reading(self) -> None:
        """Let the next message of the server, and all that follow, wait."""
        self._may_send.clear()

    def read_on(self) -> None:
        self._may_send.set()

    def say(self, **content: Any) -> None:
        self.say_text(orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY).decode())

    def say_text(self, text: str) -> None:
        self._to_app.put_nowait({"type": "websocket.receive", "text": text})

    def say_packed(self, **content: Any) -> None:
        message = {"type": "websocket.receive", "text": None, "bytes": encoded(content, MSGPACK)}
        self._to_app.put_nowait(message)

    def start(self, *, rate_hz: float = 60.0, session: str | None = None, **options: Any) -> None:
        self.say(type="start", session=session, rate_hz=rate_hz, options=options)

    def push(self, poses: np.ndarray, times: np.ndarray) -> None:
        for pose, t in zip(poses, times, strict=True):
            self.say(type="frame", t=float(t), pose=nulled(pose))

    async def all_taken(self) -> None:
        """Once the server has read all that was said."""
        async with asyncio.timeout(PATIENCE_S):
            while not self._to_app.empty():
                await asyncio.sleep(0)

    async def said(self) -> dict[str, Any]:
        event = await self._event()
        if event["type"] == "websocket.close":
            return {"type": "close", "code": event["code"]}
        if event.get("text") is not None:
            content: dict[str, Any] = orjson.loads(event["text"])
            return content
        return decoded(event["bytes"], MSGPACK, limit=2**24)

    async def said_of(self, kind: str) -> dict[str, Any]:
        """The next message of a type; it must come before any error or close that is not asked."""
        while (message := await self.said())["type"] != kind:
            assert message["type"] in ("ready", "waiting", "futures"), message
        return message

    async def _send(self, message: Any) -> None:
        await self._may_send.wait()
        self._from_app.put_nowait(dict(message))

    async def _event(self) -> dict[str, Any]:
        return await asyncio.wait_for(self._from_app.get(), PATIENCE_S)
