"""Reads a body itself, so that its size, its media type and its syntax each get their own error."""

from asyncio import to_thread
from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute

from service.errors import BodyTooLargeError
from service.media import JSON, decoded, sent

BIG_BODY_BYTES = 2**16  # some milliseconds of parsing, which the event loop has not got


class BodyRoute(APIRoute):
    """A route whose body is an object of at most ``app.state.settings.max_body_bytes``."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of FastAPI, given a request whose body was read and checked here."""
        handle = super().get_route_handler()
        if self.body_field is None:
            return handle

        async def checked(request: Request) -> Response:
            media_type = sent(request.headers.get("content-type", ""))
            limit: int = request.app.state.settings.max_body_bytes
            body = await read_body(request, limit=limit)
            if len(body) > BIG_BODY_BYTES:
                content = await to_thread(decoded, body, media_type, limit=limit)
            else:
                content = decoded(body, media_type, limit=limit)
            return await handle(_Parsed(request, body, content))

        return checked


class _Parsed(Request):
    """The same request, whose body has been read; to FastAPI it came as JSON."""

    def __init__(self, request: Request, body: bytes, content: dict[str, Any]) -> None:
        headers = [header for header in request.scope["headers"] if header[0] != b"content-type"]
        scope = {**request.scope, "headers": [*headers, (b"content-type", JSON.encode())]}
        super().__init__(scope, request.receive)
        self._bytes = body
        self._content = content

    async def body(self) -> bytes:
        return self._bytes

    async def json(self) -> dict[str, Any]:
        return self._content


async def read_body(request: Request, *, limit: int) -> bytes:
    """The bytes of a body.

    Raises:
        BodyTooLargeError: there are more than ``limit``.
    """
    declared = request.headers.get("content-length", "")
    size = int(declared) if declared.isdecimal() else 0
    chunks = []
    if size <= limit:
        size = 0
        async for chunk in request.stream():
            size += len(chunk)
            if size > limit:
                break
            chunks.append(chunk)
    if size > limit:
        raise BodyTooLargeError(
            f"the body: found {size} bytes or more; at most {limit} are read.",
            found=f"{size} bytes or more",
            expected=f"at most {limit} bytes",
        )
    return b"".join(chunks)
