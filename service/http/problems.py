"""Errors as problem+json (RFC 9457), wherever in the application they come from."""

from collections.abc import Sequence
from itertools import groupby
from math import ceil
from operator import attrgetter
from typing import Any

import orjson
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from service.errors import FieldError, MethodError, NotFoundError, ServiceError
from service.http.visits import CLIENT_GONE, ID_HEADER
from service.poses.arrays import shown
from service.schemas import Problem

MEDIA_TYPE = "application/problem+json"


def declared(*errors: type[ServiceError]) -> dict[int | str, dict[str, Any]]:
    """The errors of a route for the OpenAPI document."""
    status = attrgetter("status")
    return {
        code: {
            "model": Problem,
            "description": "; ".join(error.title for error in alike),
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for code, alike in groupby(sorted(errors, key=status), status)
    }


def add_problem_responses(app: FastAPI) -> None:
    """Let every error leave the application as a problem."""
    app.add_exception_handler(ServiceError, _on_service_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(ClientDisconnect, _on_disconnect)
    app.add_exception_handler(Exception, _on_exception)


def problem(error: ServiceError, *, status: int | None = None) -> Response:
    """The response that tells a caller of an error."""
    code = status or error.status
    headers = {}
    if error.retry_after_s is not None:
        headers["Retry-After"] = str(max(1, ceil(error.retry_after_s)))
    if code == 401:
        headers["WWW-Authenticate"] = "Bearer"
    return Response(
        orjson.dumps(content_of(error, status=code)),
        status_code=code,
        media_type=MEDIA_TYPE,
        headers=headers,
    )


def content_of(error: ServiceError, *, status: int) -> dict[str, Any]:
    """The problem that an error is."""
    content = {
        "type": f"/problems/{error.slug}",
        "title": error.title,
        "status": status,
        "detail": error.detail,
        "pointer": error.pointer or None,
        "found": error.found or None,
        "expected": error.expected or None,
        "retry_after_s": error.retry_after_s,
    }
    return {key: value for key, value in content.items() if value is not None}


async def _on_service_error(request: Request, error: Exception) -> Response:
    if not isinstance(error, ServiceError):
        raise error
    request.state.visit.failed(error)
    return problem(error)


async def _on_validation_error(_: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise error
    return problem(field_error(error.errors(), error.body))


async def _on_http_exception(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    if error.status_code == 404:
        return problem(
            NotFoundError(f"{request.url.path}: found nothing here; GET /docs lists every path.")
        )
    if error.status_code == 405:
        allowed = (error.headers or {}).get("Allow", "another method")
        response = problem(
            MethodError(f"{request.url.path}: found {request.method}; it takes {allowed}.")
        )
        response.headers["Allow"] = allowed
        return response
    return problem(ServiceError(str(error.detail)), status=error.status_code)


async def _on_disconnect(_: Request, __: Exception) -> Response:
    return Response(status_code=CLIENT_GONE)


async def _on_exception(request: Request, _: Exception) -> Response:
    response = problem(ServiceError("the server: an unforeseen error; its log says which."))
    response.headers[ID_HEADER] = request.state.visit.request_id  # beyond all middleware
    return response


def field_error(errors: Sequence[Any], body: object) -> FieldError:
    """What pydantic says of the fields of a request, or of its body alone."""
    # The deepest of several complaints is about the variant that the caller meant.
    error = max(errors, key=lambda e: len(e["loc"]))
    if error["loc"][0] in ("header", "path", "query"):
        body = {error["loc"][0]: {error["loc"][1]: error["input"]}}
    parts, at_fault = _path(error["loc"], body)
    pointer = "".join(f"/{str(part).replace('~', '~0').replace('/', '~1')}" for part in parts)
    message = str(error["msg"])
    expected = message[:1].lower() + message[1:]
    if error["type"] == "missing":
        return FieldError(pointer=pointer, found="nothing", expected="this field is required")
    if error["type"] == "extra_forbidden":
        return FieldError(
            pointer=pointer, found="a field that is not known", expected="GET /docs lists them"
        )
    return FieldError(pointer=pointer, found=shown(at_fault), expected=expected)


def _path(loc: tuple[int | str, ...], body: object) -> tuple[list[int | str], object]:
    """The part of an error's location that exists in the body; tags of unions do not."""
    parts: list[int | str] = []
    loc = loc[1:] if loc[:1] == ("body",) else loc
    for i, part in enumerate(loc):
        last = i == len(loc) - 1
        if isinstance(body, dict) and (part in body or last):
            parts.append(part)
            body = body.get(part)
        elif isinstance(body, list) and isinstance(part, int) and part < len(body):
            parts.append(part)
            body = body[part]
    return parts, body
