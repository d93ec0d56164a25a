"""Requests of the server to itself, so that a caller's first one finds nothing that is cold.

The first request costs some 30 ms of its thread more than the others: modules that are imported,
validators and routes that are built, where they are first used.
"""

import asyncio
from typing import Any

import orjson
from starlette.types import ASGIApp, Message

from service.catalog import Catalog
from service.example import EXAMPLE
from service.http.visits import OWN, Visit
from service.media import JSON


async def warm_up(app: ASGIApp, catalog: Catalog) -> None:
    """Answer a small request of each kind that some bundle is for."""
    if (default := catalog.default(with_actions=False)) and default.state == "ready":
        await _answered(app, "/predict", EXAMPLE | {"num_samples": 1, "num_steps": 1})
    if (default := catalog.default(with_actions=True)) and default.state == "ready":
        label = next(iter(catalog.performers()[default.name].labels))
        await _answered(app, "/predict_actions", EXAMPLE | {"num_samples": 1, "actions": [label]})


async def _answered(app: ASGIApp, path: str, body: dict[str, Any]) -> None:
    """Let an application answer a POST of its own server, whatever the answer."""
    content = orjson.dumps(body)
    sent = iter([{"type": "http.request", "body": content, "more_body": False}])

    async def receive() -> Message:
        for message in sent:
            return message
        await asyncio.Event().wait()  # for a client that never leaves
        raise AssertionError

    async def send(message: Message) -> None:
        del message

    headers = {"content-type": JSON, "content-length": str(len(content))}
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "POST",
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "root_path": "",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
        "client": None,
        "server": None,
        "state": {OWN: True, "visit": Visit(request_id=OWN, method="POST")},
    }
    await app(scope, receive, send)
