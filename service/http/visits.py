"""Each request of a client: its id, when it came, and what the log and the metrics say of it."""

import logging
import re
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any
from uuid import uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import ServiceError

ID_HEADER = "X-Request-Id"
OWN = "own"
"""The key of a request's state by which it is the server's own: nobody counts or refuses it."""
SWITCHED = 101
CLIENT_GONE = 499  # no client sees it: nobody is there any more

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)

_WELL_FORMED = re.compile(r"[A-Za-z0-9._:-]{1,64}")
_STARTS = ("http.response.start", "websocket.http.response.start", "websocket.accept")
_OUTCOMES = {401: "rejected", 409: "cancelled", 429: "rejected", 499: "cancelled",
             503: "rejected", 504: "deadline"}  # fmt: skip

_log = logging.getLogger(__name__)


@dataclass(kw_only=True, slots=True, eq=False)
class Visit:
    """A request under way; ``facts`` of it, never its poses, end up in the log."""

    request_id: str
    method: str
    arrived_s: float = field(default_factory=perf_counter)
    status: int | None = None
    route: str = "unknown"
    facts: dict[str, Any] = field(default_factory=dict)

    def failed(self, error: ServiceError) -> None:
        """Keep why it was not answered; of a stream, the status is then that of its error."""
        self.status = error.status
        self.facts["problem"] = error.slug

    @property
    def outcome(self) -> str:
        """What became of it, in one of few words."""
        if self.status is None:  # cut off before an answer began
            return "cancelled"
        if self.status < 400:
            return "partial" if self.facts.get("stopped_by") == "deadline" else "ok"
        return _OUTCOMES.get(self.status, "invalid" if self.status < 500 else "error")


class Visits:
    """Middleware that gives each request its id, and tells of it when it has been answered."""

    def __init__(self, app: ASGIApp, *, ended: Callable[[Visit, float], None]) -> None:
        self._app = app
        self._ended = ended

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as the application does, with the header X-Request-Id."""
        if scope["type"] not in ("http", "websocket") or OWN in scope.get("state", {}):
            await self._app(scope, receive, send)
            return
        asked = Headers(scope=scope).get(ID_HEADER, "")
        visit = Visit(
            request_id=asked if _WELL_FORMED.fullmatch(asked) else str(uuid4()),
            method=scope.get("method", "WEBSOCKET"),
        )
        scope.setdefault("state", {})["visit"] = visit
        token = request_id.set(visit.request_id)

        async def sent(message: Message) -> None:
            if message["type"] in _STARTS:
                visit.status = message.get("status", SWITCHED)
                MutableHeaders(scope=message)[ID_HEADER] = visit.request_id
            await send(message)

        try:
            await self._app(scope, receive, sent)
        except Exception:
            visit.status = 500
            raise
        finally:
            visit.route = getattr(scope.get("route"), "path", visit.route)
            self._tell(visit)
            request_id.reset(token)

    def _tell(self, visit: Visit) -> None:
        seconds = perf_counter() - visit.arrived_s
        self._ended(visit, seconds)
        facts = {
            "method": visit.method,
            "route": visit.route,
            "status": visit.status,
            "outcome": visit.outcome,
            "duration_ms": round(1000.0 * seconds, 3),
            **visit.facts,
        }
        _log.info("request", extra={"facts": facts})
