"""Clients of the service, for people who hold arrays: `Client` blocks, `AsyncClient` is awaited.

The errors that they raise are a tree, drawn in `service.asking.exchange`.
"""

from collections.abc import AsyncGenerator, Iterator, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Unpack

import httpx
import numpy as np
from jaxtyping import Float

from service.asking import messages
from service.asking.exchange import Exchange, each_now, key, now
from service.asking.live import AsyncLive, Live
from service.asking.messages import (
    ActionsOptions,
    ActionsPrediction,
    ActionsPreview,
    Prediction,
    PredictOptions,
    Preview,
)

URL = "http://127.0.0.1:8000"


class AsyncClient:
    """Asks one server; an async context manager that closes its connections.

    A request that the server is too busy for, or whose connection is lost, is sent again with the
    same seed, so that its answer is the same: at most ``attempts`` times, when the server says,
    and not after ``timeout_s`` or after its own deadline.
    """

    def __init__(
        self,
        base_url: str = URL,
        *,
        timeout_s: float = 60.0,
        attempts: int = 5,
        api_key: str | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._live = partial(AsyncLive, base_url, api_key=api_key)
        http = httpx.AsyncClient(base_url=base_url, headers=key(api_key), transport=transport)
        self._exchange = Exchange(http, timeout_s=timeout_s, attempts=attempts)

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections."""
        await self._exchange.close()

    async def predict(
        self, poses: Float[np.ndarray, "T J 3"], **options: Unpack[PredictOptions]
    ) -> Prediction:
        """Futures of the poses; a joint that is NaN was not seen.

        Raises:
            ClientError: one of its subclasses says why there is no prediction.
        """
        return await self._exchange.answer(messages.predict(poses, options))

    async def predict_actions(
        self,
        poses: Float[np.ndarray, "T J 3"],
        actions: Sequence[str],
        **options: Unpack[ActionsOptions],
    ) -> ActionsPrediction:
        """Futures of the poses, in which the person performs the actions one after the other.

        Raises:
            ClientError: one of its subclasses says why there is no prediction.
        """
        return await self._exchange.answer(messages.predict_actions(poses, actions, options))

    def stream(
        self, poses: Float[np.ndarray, "T J 3"], **options: Unpack[PredictOptions]
    ) -> AsyncGenerator[Preview | Prediction, None]:
        """Previews as the steps run, and then what ``predict`` gives; closing it frees the rows.

        Raises:
            CutStreamError: the stream broke off; what came before is not the prediction.
            ClientError: one of its subclasses says why there is no prediction.
        """
        return self._exchange.events(messages.predict(poses, options), messages.preview)

    def stream_actions(
        self,
        poses: Float[np.ndarray, "T J 3"],
        actions: Sequence[str],
        **options: Unpack[ActionsOptions],
    ) -> AsyncGenerator[ActionsPreview | ActionsPrediction, None]:
        """Previews as the frames are made, and then what ``predict_actions`` gives.

        Raises:
            ClientError: as ``stream``.
        """
        call = messages.predict_actions(poses, actions, options)
        return self._exchange.events(call, messages.actions_preview)

    def live(self, *, rate_hz: float = 10.0, **options: Unpack[PredictOptions]) -> AsyncLive:
        """Futures of poses as they come; an async context manager, which is iterated."""
        return self._live(rate_hz=rate_hz, options=options)

    async def cancel(self, request_id: str) -> bool:
        """Free the rows of a request; false where nothing of this ``request_id`` is under way."""
        return await self._exchange.cancelled(request_id)

    async def models(self) -> dict[str, Any]:
        """What ``GET /models`` says."""
        return await self._exchange.answer(messages.got("/models"))

    async def actions(self) -> dict[str, Any]:
        """What ``GET /actions`` says."""
        return await self._exchange.answer(messages.got("/actions"))


class Client:
    """`AsyncClient` for code that waits; a context manager that closes its connections."""

    def __init__(
        self,
        base_url: str = URL,
        *,
        timeout_s: float = 60.0,
        attempts: int = 5,
        api_key: str | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._live = partial(Live, base_url, api_key=api_key)
        http = httpx.Client(base_url=base_url, headers=key(api_key), transport=transport)
        self._exchange = Exchange(http, timeout_s=timeout_s, attempts=attempts)

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        now(self._exchange.close())

    def predict(
        self, poses: Float[np.ndarray, "T J 3"], **options: Unpack[PredictOptions]
    ) -> Prediction:
        """`AsyncClient.predict`."""
        return now(self._exchange.answer(messages.predict(poses, options)))

    def predict_actions(
        self,
        poses: Float[np.ndarray, "T J 3"],
        actions: Sequence[str],
        **options: Unpack[ActionsOptions],
    ) -> ActionsPrediction:
        """`AsyncClient.predict_actions`."""
        return now(self._exchange.answer(messages.predict_actions(poses, actions, options)))

    def stream(
        self, poses: Float[np.ndarray, "T J 3"], **options: Unpack[PredictOptions]
    ) -> Iterator[Preview | Prediction]:
        """`AsyncClient.stream`."""
        return each_now(self._exchange.events(messages.predict(poses, options), messages.preview))

    def stream_actions(
        self,
        poses: Float[np.ndarray, "T J 3"],
        actions: Sequence[str],
        **options: Unpack[ActionsOptions],
    ) -> Iterator[ActionsPreview | ActionsPrediction]:
        """`AsyncClient.stream_actions`."""
        call = messages.predict_actions(poses, actions, options)
        return each_now(self._exchange.events(call, messages.actions_preview))

    def live(self, *, rate_hz: float = 10.0, **options: Unpack[PredictOptions]) -> Live:
        """Futures of poses as they come; a context manager, which is iterated."""
        return self._live(rate_hz=rate_hz, options=options)

    def cancel(self, request_id: str) -> bool:
        """`AsyncClient.cancel`."""
        return now(self._exchange.cancelled(request_id))

    def models(self) -> dict[str, Any]:
        """What ``GET /models`` says."""
        return now(self._exchange.answer(messages.got("/models")))

    def actions(self) -> dict[str, Any]:
        """What ``GET /actions`` says."""
        return now(self._exchange.answer(messages.got("/actions")))
