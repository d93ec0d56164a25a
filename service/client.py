"""A client of the service, for people who hold arrays.

ClientError                 the service did not answer with a prediction
├── ProblemError            it said why: type, pointer, found, expected
│   ├── BadRequestError     the request is at fault (4xx)
│   └── ServerFailedError   the server is at fault (5xx)
└── ConnectionFailedError   there was no answer
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import httpx
import numpy as np
import orjson
from jaxtyping import Float


class ClientError(Exception):
    """The service did not answer with a prediction."""


class ConnectionFailedError(ClientError):
    """There was no answer."""


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


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Prediction:
    """Futures in the caller's world, skeleton, axes, units and rate."""

    futures: Float[np.ndarray, "N H J 3"]
    joints: tuple[str, ...]
    fps: float
    seed: int
    model: str
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionSegment:
    """The frames ``start`` to before ``end`` of a future, in which one action is performed.

    ``stopped`` is false where the action was cut off.
    """

    action: str
    start: int
    end: int
    stopped: bool


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ActionsPrediction:
    """Futures as ``Prediction`` has them, each as long as its actions took."""

    futures: tuple[Float[np.ndarray, "_ J 3"], ...]
    segments: tuple[tuple[ActionSegment, ...], ...]
    joints: tuple[str, ...]
    fps: float
    seed: int
    model: str
    warnings: tuple[str, ...]


class Client:
    """Asks one server; a context manager that closes its connections."""

    def __init__(
        self,
        base_url: str = "http://127.0.0.1:8000",
        *,
        timeout_s: float = 60.0,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._http = httpx.Client(base_url=base_url, timeout=timeout_s, transport=transport)

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
        self._http.close()

    def predict(self, poses: Float[np.ndarray, "T J 3"], **options: Any) -> Prediction:
        """Futures of the poses; a joint that is NaN was not seen.

        Options are the other fields of ``POST /predict``: skeleton, axes, fps, num_samples,
        num_steps, seed, model, bone_lengths.

        Raises:
            BadRequestError: the request is at fault.
            ServerFailedError: the server is at fault.
            ConnectionFailedError: there was no answer.
        """
        content = self._send("POST", "/predict", {"poses": _frames(poses), **options})
        return Prediction(
            futures=np.array(content["futures"], dtype=np.float64), **_envelope(content)
        )

    def predict_actions(
        self, poses: Float[np.ndarray, "T J 3"], actions: Sequence[str], **options: Any
    ) -> ActionsPrediction:
        """Futures of the poses, in which the person performs the actions one after the other.

        Options are the other fields of ``POST /predict_actions``: skeleton, axes, fps, num_samples,
        seed, model, bone_lengths, stop_threshold, max_seconds_per_action.

        Raises:
            BadRequestError: the request is at fault.
            ServerFailedError: the server is at fault.
            ConnectionFailedError: there was no answer.
        """
        body = {"poses": _frames(poses), "actions": list(actions), **options}
        content = self._send("POST", "/predict_actions", body)
        futures = content["futures"]
        return ActionsPrediction(
            futures=tuple(np.array(future["poses"], dtype=np.float64) for future in futures),
            segments=tuple(
                tuple(ActionSegment(**segment) for segment in future["segments"])
                for future in futures
            ),
            **_envelope(content),
        )

    def models(self) -> dict[str, Any]:
        """What ``GET /models`` says."""
        return self._send("GET", "/models")

    def actions(self) -> dict[str, Any]:
        """What ``GET /actions`` says."""
        return self._send("GET", "/actions")

    def _send(
        self, method: str, path: str, content: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        body = None if content is None else orjson.dumps(content)
        headers = {"content-type": "application/json"} if body else {}
        try:
            response = self._http.request(method, path, content=body, headers=headers)
        except httpx.TransportError as error:
            raise ConnectionFailedError(
                f"{self._http.base_url}: found no server that answers ({error}); "
                "start one with `posefutures serve`."
            ) from error
        if response.is_error:
            kind = ServerFailedError if response.status_code >= 500 else BadRequestError
            raise kind(response.status_code, _problem(response))
        answer: dict[str, Any] = orjson.loads(response.content)
        return answer


def _frames(poses: Float[np.ndarray, "T J 3"]) -> list[list[list[float] | None]]:
    return [
        [None if np.isnan(joint).any() else joint.tolist() for joint in frame] for frame in poses
    ]


def _envelope(content: dict[str, Any]) -> dict[str, Any]:
    return {
        "joints": tuple(content["joints"]),
        "fps": content["fps"],
        "seed": content["seed"],
        "model": content["model"]["name"],
        "warnings": tuple(content["warnings"]),
    }


def _problem(response: httpx.Response) -> dict[str, Any]:
    if response.headers.get("content-type") != "application/problem+json":
        return {}  # something between us and the service answered
    problem: dict[str, Any] = orjson.loads(response.content)
    return problem
