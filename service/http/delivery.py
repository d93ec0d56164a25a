"""Bytes on their way to a client, who may leave at any time: whole answers, and streams of events.

A stream is ``accepted``, ``preview`` after ``preview``, ``final`` and ``end``. Where it breaks off
there is an ``error`` in the place of the rest; without ``end`` it is not complete.
"""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine
from contextlib import aclosing, suppress
from typing import Any, TypeVar

import orjson
from fastapi.sse import KEEPALIVE_COMMENT
from starlette.requests import ClientDisconnect, Request
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from service.errors import ServiceError
from service.http.problems import content_of
from service.media import EVENT_STREAM

KEEP_ALIVE_S = 15.0

_T = TypeVar("_T")


async def unless_gone(request: Request, work: Coroutine[None, None, _T]) -> _T:
    """What the work gives; it is cancelled when the client closes the connection.

    Raises:
        ClientDisconnect: the client has left.
    """
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(_left(request))
    try:
        await asyncio.wait({working, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        return working.result()
    finally:
        leaving.cancel()
        await _cancelled(working)


async def _left(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def event(name: str, data: bytes, media_type: str) -> bytes:
    """An event of a stream, whose data is JSON without line breaks."""
    if media_type == EVENT_STREAM:
        return b"event: " + name.encode() + b"\ndata: " + data + b"\n\n"
    return b'{"event":"' + name.encode() + b'","data":' + data + b"}\n"


class Stream(StreamingResponse):
    """A stream of events, with signs of life between them.

    ``failed`` is told of an error in it, and however it ends, ``ended`` is called.
    """

    def __init__(
        self,
        events: AsyncGenerator[bytes, None],
        *,
        accepted: bytes,
        media_type: str,
        failed: Callable[[ServiceError], None],
        ended: Callable[[], None],
    ) -> None:
        self._parts = _parts(events, accepted=accepted, media_type=media_type, failed=failed)
        super().__init__(self._parts, media_type=media_type, headers={"Cache-Control": "no-store"})
        self._events = events
        self._ended = ended

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the events; when the client leaves, or a send fails, what is under way ends."""
        try:
            async with aclosing(self._events), aclosing(self._parts):
                await super().__call__(scope, receive, send)
        finally:
            self._ended()


async def _parts(
    events: AsyncGenerator[bytes, None],
    *,
    accepted: bytes,
    media_type: str,
    failed: Callable[[ServiceError], None],
) -> AsyncGenerator[bytes, None]:
    yield event("accepted", accepted, media_type)
    waiting = asyncio.ensure_future(_next(events))
    try:
        while True:
            await asyncio.wait({waiting}, timeout=KEEP_ALIVE_S)
            if waiting.done():
                yield waiting.result()
                waiting = asyncio.ensure_future(_next(events))
            elif media_type == EVENT_STREAM:
                yield KEEPALIVE_COMMENT
    except StopAsyncIteration:
        return
    except ServiceError as error:
        failed(error)
        yield event("error", orjson.dumps(content_of(error, status=error.status)), media_type)
    finally:
        await _cancelled(waiting)


async def _cancelled(work: "asyncio.Future[Any]") -> None:
    if work.cancel():
        with suppress(asyncio.CancelledError):
            await work


async def _next(events: AsyncIterator[bytes]) -> bytes:
    return await anext(events)
