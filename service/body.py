"""Reads a JSON body itself, so that its size, its type and its syntax each get their own error."""

import json
from collections.abc import Callable, Coroutine
from typing import Any

import orjson
from fastapi import Request, Response
from fastapi.routing import APIRoute

from service.errors import BodyTooLargeError, MalformedBodyError, MediaTypeError


class JsonRoute(APIRoute):
    """A route whose body is a JSON object of at most ``app.state.max_body_bytes``."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of FastAPI, given a request whose body was read and checked here."""
        handle = super().get_route_handler()
        if self.body_field is None:
            return handle

        async def checked(request: Request) -> Response:
            _check_media_type(request.headers.get("content-type", ""))
            body = await _read(request, limit=request.app.state.max_body_bytes)
            return await handle(_Parsed(request, body, parsed(body)))

        return checked


class _Parsed(Request):
    """The same request, whose body has been read."""

    def __init__(self, request: Request, body: bytes, content: dict[str, Any]) -> None:
        super().__init__(request.scope, request.receive)
        self._bytes = body
        self._content = content

    async def body(self) -> bytes:
        return self._bytes

    async def json(self) -> dict[str, Any]:
        return self._content


def parsed(body: bytes) -> dict[str, Any]:
    """The JSON object in a body; NaN and Infinity, which JSON lacks, are kept to be named later.

    Raises:
        MalformedBodyError: the body is not a JSON object.
    """
    try:
        content = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        content = _with_nan(body, error)
    if not isinstance(content, dict):
        raise MalformedBodyError(
            f"the body: found a JSON {_KINDS[type(content)]}; it must be a JSON object.",
            found=_KINDS[type(content)],
            expected="a JSON object",
        )
    return content


_KINDS = {list: "array", str: "string", int: "number", float: "number", bool: "boolean"} | {
    type(None): "null"
}


def _with_nan(body: bytes, error: orjson.JSONDecodeError) -> Any:
    try:
        return json.loads(body)
    except (ValueError, RecursionError):
        raise MalformedBodyError(
            f"the body: found no JSON: {error}; it must be a JSON object.",
            found=str(error),
            expected="a JSON object",
        ) from error


def _check_media_type(content_type: str) -> None:
    media_type = content_type.split(";")[0].strip().lower()
    if media_type != "application/json":
        raise MediaTypeError(
            f"content-type: found {media_type[:60] or 'none'}; it must be application/json.",
            found=media_type[:60] or "none",
            expected="application/json",
        )


async def _read(request: Request, *, limit: int) -> bytes:
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
