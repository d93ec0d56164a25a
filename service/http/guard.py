"""Who may ask, how often, and how many at a time, before anything is read of a request."""

import math
import time
from base64 import urlsafe_b64decode
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from hashlib import sha256
from hmac import compare_digest

from limits import parse
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import MovingWindowRateLimiter
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import OverloadedError, RateLimitedError, ServiceError, UnauthorisedError
from service.http import page
from service.http.problems import problem
from service.http.visits import OWN

STREAM_PROTOCOL = "posefutures"
KEY_PROTOCOL = f"{STREAM_PROTOCOL}.bearer."
"""Of a WebSocket, before a key in base64url: browsers set none of its headers but the protocols."""

OPEN_PATHS = ("/livez", "/readyz", page.PATH)
RETRY_FRESH_S = 0.1
"""For how long an estimate of when to come again is told, which engines that work can spare."""


class Guard:
    """Middleware that refuses strangers, where there are keys, and what is too much.

    A rate, such as ``60/minute``, is that of a key, else of an address; it counts what computes, as
    does ``max_requests``, the most that may be under way. To refuse must cost next to nothing: at
    ten times the load that a server can bear it is most of what it does. What computes within a
    WebSocket asks ``state.admitted``.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        api_keys: Sequence[str],
        rate_limit: str | None,
        max_requests: int,
        seconds_until_free: Callable[[], float],
    ) -> None:
        self._app = app
        self._max_requests = max_requests
        self._num_requests = 0
        self._seconds_until_free = seconds_until_free
        self._retry_after_s, self._estimated_s = 0.0, -math.inf
        self._keys = [_digest(key) for key in api_keys]
        self._rate = parse(rate_limit) if rate_limit else None
        self._limiter = MovingWindowRateLimiter(MemoryStorage())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 401 or 429."""
        app, computes = self._app, scope.get("method") == "POST"
        if scope["type"] in ("http", "websocket") and not _is_open(scope):
            try:
                caller = self._caller(scope)
                if computes:
                    self._check_room()
                    await self._count(caller)
                elif scope["type"] == "websocket":
                    scope["state"]["admitted"] = partial(self._admitted, caller)
            except ServiceError as error:
                app, computes = problem(error), False
                scope["state"]["visit"].failed(error)
        self._num_requests += computes
        try:
            await app(scope, receive, send)
        finally:
            self._num_requests -= computes

    @asynccontextmanager
    async def _admitted(self, caller: str) -> AsyncIterator[None]:
        """One thing that a connection lets compute, which counts as a request does."""
        self._check_room()
        await self._count(caller)
        self._num_requests += 1
        try:
            yield
        finally:
            self._num_requests -= 1

    def _caller(self, scope: Scope) -> str:
        key = _key(scope)
        found = b"" if key is None else _digest(key)
        # Every key is compared, so that the time taken tells nothing.
        known = sum(compare_digest(found, digest) for digest in self._keys)
        if self._keys and not known:
            raise UnauthorisedError(
                f"authorization: found {'an unknown key' if found else 'no key'}; it must be "
                "Bearer and an API key of this server.",
                found="an unknown key" if found else "no key",
                expected="Bearer and an API key of this server",
            )
        return found.hex() if known else str((scope.get("client") or ("unknown",))[0])

    def _check_room(self) -> None:
        if self._num_requests >= self._max_requests:
            if time.monotonic() > self._estimated_s + RETRY_FRESH_S:
                self._retry_after_s = self._seconds_until_free()
                self._estimated_s = time.monotonic()
            raise OverloadedError(
                f"the server: found {self._num_requests} requests under way; it takes at most "
                f"{self._max_requests}.",
                retry_after_s=self._retry_after_s,
            )

    async def _count(self, caller: str) -> None:
        if self._rate is not None and not await self._limiter.hit(self._rate, caller):
            window = await self._limiter.get_window_stats(self._rate, caller)
            raise RateLimitedError(
                f"the caller: found more requests than its rate; at most {self._rate} are "
                "answered.",
                retry_after_s=max(0.0, window.reset_time - time.time()),
            )


def _key(scope: Scope) -> str | None:
    """The key that a header holds, or one of the protocols that a WebSocket offers."""
    header = Headers(scope=scope).get("authorization")
    if header is not None:
        scheme, _, key = header.partition(" ")
        return key.strip() if scheme.lower() == "bearer" else None
    for protocol in scope.get("subprotocols", ()):
        if protocol.startswith(KEY_PROTOCOL):
            return _decoded(protocol.removeprefix(KEY_PROTOCOL))
    return None


def _decoded(text: str) -> str:
    """What a key is from its base64url, which has no padding; nobody's key where it is none."""
    try:
        return urlsafe_b64decode(text + "=" * (-len(text) % 4)).decode()
    except ValueError:
        return ""


def _is_open(scope: Scope) -> bool:
    path = scope["path"]
    return path in OPEN_PATHS or path.startswith(f"{page.FILES_PATH}/") or OWN in scope["state"]


def _digest(key: str) -> bytes:
    return sha256(key.encode()).digest()
