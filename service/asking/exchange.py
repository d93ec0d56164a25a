"""How a call of a client is answered: sent again where that helps, read, or raised as an error.

ClientError                 the service did not answer with a prediction
├── ProblemError            it said why: type, pointer, found, expected
│   ├── BadRequestError     the request is at fault (4xx)
│   ├── BusyError           the server could not take it, however often it was asked (429, 503)
│   └── ServerFailedError   the server is at fault (5xx)
├── ConnectionFailedError   there was no answer
└── CutStreamError          a stream broke off before its end
"""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterator
from itertools import count
from math import inf
from secrets import SystemRandom
from time import monotonic, sleep
from typing import Any, Protocol, TypeVar, cast
from urllib.parse import quote

import httpx
import orjson

from service.asking.messages import Call
from service.media import MSGPACK, NDJSON, decoded, encoded

BACK_OFF_S = 0.1  # at most, before the second try; doubled for each that follows

_T = TypeVar("_T")
_PreviewT = TypeVar("_PreviewT")


class ClientError(Exception):
    """The service did not answer with a prediction."""


class ConnectionFailedError(ClientError):
    """There was no answer."""


class CutStreamError(ClientError):
    """A stream broke off before its end."""


class ProblemError(ClientError):
    """The service said what is wrong; ``problem`` is its problem+json."""

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        super().__init__(problem.get("detail") or f"HTTP {status}")
        self.status = status
        self.problem = problem

    @property
    def slug(self) -> str:
        """The stable name of the problem, such as ``unknown-skeleton``."""
        return str(self.problem.get("type", "")).rsplit("/", 1)[-1]


class BadRequestError(ProblemError):
    """The request is at fault."""


class ServerFailedError(ProblemError):
    """The server is at fault."""


class BusyError(ProblemError):
    """The server cannot take the request now; ``retry_after_s`` is when it says it can."""

    def __init__(self, status: int, problem: dict[str, Any], *, retry_after_s: float) -> None:
        super().__init__(status, problem)
        self.retry_after_s = retry_after_s


class _Wire(Protocol):
    """What the one exchange needs of httpx, whose two clients differ in `await` alone."""

    @property
    def http(self) -> httpx.Client | httpx.AsyncClient: ...
    async def send(self, request: httpx.Request, *, stream: bool) -> httpx.Response: ...
    def lines(self, response: httpx.Response) -> AsyncIterator[str]: ...
    async def sleep(self, seconds: float) -> None: ...
    async def end(self, response: httpx.Response) -> None: ...
    async def close(self) -> None: ...


class _AsyncWire:
    def __init__(self, http: httpx.AsyncClient) -> None:
        self.http = http

    async def send(self, request: httpx.Request, *, stream: bool) -> httpx.Response:
        response = await self.http.send(request, stream=stream)
        if not response.is_success:
            await response.aread()
        return response

    async def lines(self, response: httpx.Response) -> AsyncIterator[str]:
        async for line in response.aiter_lines():
            yield line

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def end(self, response: httpx.Response) -> None:
        await response.aclose()

    async def close(self) -> None:
        await self.http.aclose()


class _BlockingWire:
    """The same, whose coroutines end without ever waiting for an event loop."""

    def __init__(self, http: httpx.Client) -> None:
        self.http = http

    async def send(self, request: httpx.Request, *, stream: bool) -> httpx.Response:
        response = self.http.send(request, stream=stream)
        if not response.is_success:
            response.read()
        return response

    async def lines(self, response: httpx.Response) -> AsyncIterator[str]:
        for line in response.iter_lines():
            yield line

    async def sleep(self, seconds: float) -> None:
        sleep(seconds)

    async def end(self, response: httpx.Response) -> None:
        response.close()

    async def close(self) -> None:
        self.http.close()


class Exchange:
    """Sends calls until they are answered, refused, or not worth another try."""

    def __init__(
        self, http: httpx.Client | httpx.AsyncClient, *, timeout_s: float, attempts: int
    ) -> None:
        self._wire: _Wire
        self._wire = _BlockingWire(http) if isinstance(http, httpx.Client) else _AsyncWire(http)
        self._timeout_s = timeout_s
        self._attempts = attempts

    async def answer(self, call: Call[_T]) -> _T:
        """What the call gives."""
        response = await self._sent(call, accept=MSGPACK, stream=False)
        media_type = response.headers["content-type"].partition(";")[0]
        return call.read(decoded(response.content, media_type, limit=len(response.content)))

    async def events(
        self, call: Call[_T], preview: Callable[[dict[str, Any]], _PreviewT]
    ) -> AsyncGenerator[_PreviewT | _T, None]:
        """Previews, and then what the call gives; once it has begun, it is not sent again."""
        response = await self._sent(call, accept=NDJSON, stream=True)
        told: dict[str, Any] = {}
        try:
            async for line in self._wire.lines(response):
                event = orjson.loads(line)
                name, content = event["event"], event.get("data")
                told[name] = content
                if name == "preview":
                    yield preview(content)
                elif name == "error":
                    raise problem_error(content["status"], content)
                elif name == "end":
                    yield call.read(told["final"])
                    return
        except (httpx.TransportError, orjson.JSONDecodeError) as error:
            raise _cut() from error
        finally:
            await self._wire.end(response)
        raise _cut()

    async def cancelled(self, request_id: str) -> bool:
        """Whether a request was under way, and is no more."""
        path = f"/requests/{quote(request_id, safe='')}"
        try:
            await self._sent(
                Call(method="DELETE", path=path, read=bool), accept="*/*", stream=False
            )
        except BadRequestError as error:
            if error.slug != "unknown-request":
                raise
            return False
        return True

    async def close(self) -> None:
        """Close the connections."""
        await self._wire.close()

    async def _sent(self, call: Call[_T], *, accept: str, stream: bool) -> httpx.Response:
        started_s = monotonic()
        until_s = started_s + min(self._timeout_s, call.deadline_s)
        for attempt in count(1):
            request = self._request(call, accept=accept, spent_s=monotonic() - started_s)
            try:
                response = await self._wire.send(request, stream=stream)
            except httpx.TransportError as error:
                failure: ClientError = self._silence(error)
            else:
                if response.is_success:
                    return response
                failure = _failure(response)
            wait_s = _wait_s(failure, attempt)
            if attempt >= self._attempts or monotonic() + wait_s >= until_s:
                break
            await self._wire.sleep(wait_s)
        raise failure

    def _request(self, call: Call[_T], *, accept: str, spent_s: float) -> httpx.Request:
        """The next try, which has the time that is left."""
        headers = {"accept": accept}
        if call.request_id is not None:
            headers["x-request-id"] = call.request_id
        body = call.body_after(spent_s)
        if body is not None:
            headers["content-type"] = MSGPACK
        return self._wire.http.build_request(
            call.method,
            call.path,
            content=None if body is None else encoded(body, MSGPACK),
            headers=headers,
            timeout=max(self._timeout_s - spent_s, 0.001),
        )

    def _silence(self, error: httpx.TransportError) -> ConnectionFailedError:
        failure = ConnectionFailedError(
            f"{self._wire.http.base_url}: found no server that answers ({error}); "
            "start one with `posefutures serve`."
        )
        failure.__cause__ = error
        return failure


def _wait_s(failure: ClientError, attempt: int) -> float:
    """Seconds until a call is worth another try, a little at random, so that not all come at once.

    Infinite for a call that failed for good.
    """
    match failure:
        case BusyError():
            told_s = failure.retry_after_s
        case ConnectionFailedError():
            told_s = 0.0
        case _:
            return inf
    return told_s + SystemRandom().uniform(0.0, BACK_OFF_S * 2 ** (attempt - 1))


def _failure(response: httpx.Response) -> ProblemError:
    status, retry_after = response.status_code, response.headers.get("retry-after", "")
    told = response.headers.get("content-type") == "application/problem+json"
    problem = orjson.loads(response.content) if told else {}
    return problem_error(status, problem, retry_after_s=_seconds(retry_after))


def problem_error(
    status: int, problem: dict[str, Any], *, retry_after_s: float = 0.0
) -> ProblemError:
    """The error that a problem is to the client."""
    if status in (429, 503):
        return BusyError(status, problem, retry_after_s=retry_after_s)
    return (ServerFailedError if status >= 500 else BadRequestError)(status, problem)


def _seconds(retry_after: str) -> float:
    """0 where it is not given, or is a date."""
    return float(retry_after) if retry_after.replace(".", "", 1).isdecimal() else 0.0


def _cut() -> CutStreamError:
    return CutStreamError("the stream: found no end; what came is not the prediction, ask again.")


def key(api_key: str | None) -> dict[str, str]:
    """The header that tells the server who asks."""
    return {} if api_key is None else {"authorization": f"Bearer {api_key}"}


def now(awaitable: Awaitable[_T]) -> _T:
    """What an awaitable gives that never waits, as those over `_BlockingWire` are."""
    try:
        next(awaitable.__await__())
    except StopIteration as done:
        return cast(_T, done.value)
    raise AssertionError("it waited")


def each_now(events: AsyncGenerator[_T, None]) -> Iterator[_T]:
    """Each event of a generator that never waits; the generator is closed with this one."""
    try:
        while True:
            yield now(anext(events))
    except StopAsyncIteration:
        return
    finally:
        now(events.aclose())
