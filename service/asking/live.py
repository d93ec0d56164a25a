"""Live futures for people who hold a stream of poses: push what is seen, take what may come.

One task keeps the connection. Of frames that could not be sent the latest are kept, and of answers
that nobody took the newest, so that neither side ever waits for the other. A lost connection is
opened again with the same session, whose frames the server still has for a while.
"""

import asyncio
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import partial
from secrets import SystemRandom
from time import monotonic
from types import TracebackType
from typing import Any

import numpy as np
import orjson
from anyio.from_thread import start_blocking_portal
from jaxtyping import Float
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from service.asking import messages
from service.asking.exchange import (
    BACK_OFF_S,
    BusyError,
    ClientError,
    ConnectionFailedError,
    ProblemError,
    key,
    problem_error,
)
from service.asking.messages import LivePrediction, PredictOptions
from service.media import MSGPACK, decoded, encoded

KEPT_FRAMES = 256
CLOSING_S = 1.0
LONGEST_S = 5.0  # between two tries
TAKEN = 4409  # why the server closes a connection: another one has its session


class AsyncLive:
    """A stream of poses and of their futures; an async context manager that closes it."""

    def __init__(
        self,
        base_url: str,
        *,
        rate_hz: float,
        options: PredictOptions,
        api_key: str | None = None,
    ) -> None:
        self._url = f"ws{base_url.rstrip('/').removeprefix('http')}/stream"
        self._headers = key(api_key)
        self._start = messages.live_start(options, rate_hz=rate_hz)
        self._frames: deque[dict[str, Any]] = deque(maxlen=KEPT_FRAMES)
        self._pushed = asyncio.Event()
        self._prediction: LivePrediction | None = None
        self._problem: ProblemError | None = None
        self._need_s: float | None = None
        self._news = asyncio.Event()

    async def __aenter__(self) -> "AsyncLive":
        self._running = asyncio.ensure_future(self._run())
        self._running.add_done_callback(lambda _: self._news.set())
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)

    def push(
        self,
        pose: Float[np.ndarray, "J 3"],
        t: float | None = None,
        *,
        confidence: Float[np.ndarray, "J"] | None = None,
    ) -> None:
        """Tell of a pose, and the second when it was seen; now by default.

        A joint of NaN was not seen; ``confidence`` is what each joint is worth, from 0 to 1.
        """
        seen_s = monotonic() if t is None else float(t)
        frame = {"type": "frame", "t": seen_s, "pose": np.asarray(pose)}
        if confidence is not None:
            frame["confidence"] = np.asarray(confidence)
        self._frames.append(frame)
        self._pushed.set()

    def latest(self) -> LivePrediction | None:
        """The newest prediction if it was not given yet, at once.

        Raises:
            ProblemError: the options or a frame were refused; ask again for what comes next.
            ClientError: the connection cannot be opened, or another one took the session.
        """
        if self._problem is not None:
            problem, self._problem = self._problem, None
            raise problem
        prediction, self._prediction = self._prediction, None
        if prediction is None and self._running.done():
            self._running.result()  # it ends with an error alone
        return prediction

    async def ready(self) -> float:
        """Seconds that have to be seen before the first answer, once the server has said so.

        Raises:
            ClientError: as ``latest``.
        """
        while self._need_s is None:
            await self._told()
        return self._need_s

    def __aiter__(self) -> "AsyncLive":
        return self

    async def __anext__(self) -> LivePrediction:
        """The newest prediction that was not given yet, as soon as there is one.

        Raises:
            ClientError: as ``latest``.
        """
        while (prediction := self.latest()) is None:
            await self._told()
        return prediction

    async def _told(self) -> None:
        if self._running.done():
            self._running.result()
        await self._news.wait()
        self._news.clear()

    async def _run(self) -> None:
        failures = 0
        while True:
            try:
                async with connect(
                    self._url,
                    additional_headers=self._headers,
                    compression=None,
                    max_size=None,
                    close_timeout=CLOSING_S,
                ) as socket:
                    failures = 0
                    with suppress(ConnectionClosed):
                        await self._talk(socket)
            except (OSError, WebSocketException) as error:
                self._give_up(error)
                failures += 1
            else:
                if socket.close_code == TAKEN:
                    raise ClientError("the stream: another connection resumed its session.")
            most_s = min(LONGEST_S, BACK_OFF_S * 2**failures)
            await asyncio.sleep(SystemRandom().uniform(0.0, most_s))

    def _give_up(self, error: Exception) -> None:
        """Raise what is not worth another try; once a stream has begun, silence is."""
        begun = self._start["session"] is not None
        if isinstance(error, InvalidStatus):
            status, content = error.response.status_code, error.response.body
            if not begun or status not in (429, 503):
                raise problem_error(status, orjson.loads(content or b"{}")) from error
        elif not begun:
            raise ConnectionFailedError(
                f"{self._url}: found no server that answers ({error}); start one with "
                "`posefutures serve`."
            ) from error

    async def _talk(self, socket: ClientConnection) -> None:
        await self._begin(socket)
        telling = asyncio.ensure_future(self._tell(socket))
        try:
            while True:
                self._hear(await _received(socket))
        finally:
            telling.cancel()
            await asyncio.gather(telling, return_exceptions=True)

    async def _begin(self, socket: ClientConnection) -> None:
        """Say what is wanted, until a server that is busy is ready."""
        await socket.send(encoded(self._start, MSGPACK))
        while (message := await _received(socket))["type"] == "error":
            error = _error(message)
            if not isinstance(error, BusyError):
                raise error
            await asyncio.sleep(error.problem.get("retry_after_s", 1.0))
            await socket.send(encoded(self._start, MSGPACK))
        self._start["session"] = message["session"]
        self._need_s = (message["num_observed"] - 1) / message["fps"]
        self._news.set()

    async def _tell(self, socket: ClientConnection) -> None:
        while True:
            while self._frames:
                await socket.send(encoded(self._frames.popleft(), MSGPACK))
            self._pushed.clear()
            await self._pushed.wait()

    def _hear(self, message: dict[str, Any]) -> None:
        if message["type"] == "futures":
            self._prediction = messages.live_prediction(message)
        elif message["type"] == "error":
            error = _error(message)
            if not isinstance(error, BusyError):  # the server tries again by itself
                self._problem = error
        self._news.set()


class Live:
    """`AsyncLive` for code that waits; a context manager that closes it."""

    def __init__(
        self,
        base_url: str,
        *,
        rate_hz: float,
        options: PredictOptions,
        api_key: str | None = None,
    ) -> None:
        self._live = AsyncLive(base_url, rate_hz=rate_hz, options=options, api_key=api_key)
        self._stack = ExitStack()

    def __enter__(self) -> "Live":
        with ExitStack() as stack:
            self._portal = stack.enter_context(start_blocking_portal(name="live-futures"))
            stack.enter_context(self._portal.wrap_async_context_manager(self._live))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.close()

    def push(
        self,
        pose: Float[np.ndarray, "J 3"],
        t: float | None = None,
        *,
        confidence: Float[np.ndarray, "J"] | None = None,
    ) -> None:
        """`AsyncLive.push`."""
        self._portal.call(partial(self._live.push, pose, t, confidence=confidence))

    def latest(self) -> LivePrediction | None:
        """`AsyncLive.latest`."""
        return self._portal.call(self._live.latest)

    def __iter__(self) -> Iterator[LivePrediction]:
        return self

    def __next__(self) -> LivePrediction:
        """`AsyncLive.__anext__`."""
        return self._portal.call(self._live.__anext__)


async def _received(socket: ClientConnection) -> dict[str, Any]:
    message = await socket.recv(decode=False)
    return decoded(message, MSGPACK, limit=len(message))


def _error(message: dict[str, Any]) -> ProblemError:
    return problem_error(message["problem"]["status"], message["problem"])
