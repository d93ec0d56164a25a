"""What a client asks and what it is told: the fields of a request, and of its answer, as arrays."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from secrets import SystemRandom
from typing import Any, Generic, Literal, TypedDict, TypeVar

import numpy as np
from jaxtyping import Float

from service.answers.modes import Mode
from service.answers.occupancy import Occupancy
from service.answers.quantiles import Regions
from service.schemas import MAX_SEED

_T = TypeVar("_T")
_T_co = TypeVar("_T_co", covariant=True)


class Options(TypedDict, total=False):
    """What any request may say beside its poses, as ``GET /docs`` explains it.

    ``request_id`` is no field: it names the request, so that it can be cancelled.
    """

    skeleton: str | Mapping[str, Any] | None
    axes: Mapping[str, str]
    fps: float | None
    timestamps: Sequence[float] | None
    confidence: Float[np.ndarray, "T J"] | None
    num_samples: int
    seed: int | None
    model: str | None
    bone_lengths: Literal["observed", "free"]
    deadline_ms: float | None
    occupancy: Mapping[str, Any] | None
    request_id: str


class PredictOptions(Options, total=False):
    """The options of ``POST /predict``; ``returned`` is its field ``return``."""

    num_steps: int | None
    tolerance_m: float | None
    horizon_s: float | None
    returned: Sequence[Literal["futures", "modes", "quantiles", "occupancy"]]
    num_modes: int
    quantile_levels: Sequence[float]


class ActionsOptions(Options, total=False):
    """The options of ``POST /predict_actions``."""

    stop_threshold: float | None
    max_seconds_per_action: float | None
    returned: Sequence[Literal["futures", "occupancy"]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Steps:
    """Denoising steps that ran, at most, of those there are, and what stopped them."""

    run: int
    of: int
    stopped_by: str


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Preview:
    """The futures as they are after some of the steps."""

    futures: Float[np.ndarray, "N H J 3"]
    run: int
    of: int


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionSegment:
    """The frames ``start`` to before ``end`` of a future, in which one action is performed.

    ``stopped`` is false where the action was cut off, or in a preview has not ended yet.
    """

    action: str
    start: int
    end: int
    stopped: bool


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ActionsPreview:
    """The futures of actions as far as they are after ``run`` chunks of frames, ``of`` at most."""

    futures: tuple[Float[np.ndarray, "_ J 3"], ...]
    segments: tuple[tuple[ActionSegment, ...], ...]
    run: int
    of: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Answer:
    """What every answer says beside its futures; ``timing_ms`` of each stage is the server's.

    ``joint_sources`` says of each joint whether it was observed, derived or imputed;
    ``occupancy`` is that of each region, where it was asked for, in the caller's units.
    """

    id: str
    joints: tuple[str, ...]
    joint_sources: tuple[str, ...]
    fps: float
    seed: int
    model: str
    warnings: tuple[str, ...]
    occupancy: tuple[Occupancy, ...]
    timing_ms: Mapping[str, float]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Prediction(Answer):
    """Futures in the caller's world, skeleton, axes, units and rate.

    There are none where only ``modes`` or ``quantiles`` were to be returned; the radius of the
    latter is in the caller's units too.
    """

    futures: Float[np.ndarray, "N H J 3"]
    modes: tuple[Mode, ...]
    quantiles: Regions | None
    steps: Steps


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LivePrediction:
    """Futures of a stream, from its frame of second ``t`` on."""

    t: float
    prediction: Prediction


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ActionsPrediction(Answer):
    """Futures as ``Prediction`` has them, each as long as its actions took."""

    futures: tuple[Float[np.ndarray, "_ J 3"], ...]
    segments: tuple[tuple[ActionSegment, ...], ...]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Call(Generic[_T_co]):
    """What is asked, and how its answer is read."""

    method: str
    path: str
    body: dict[str, Any] | None = None
    request_id: str | None = None
    read: Callable[[dict[str, Any]], _T_co]

    @property
    def deadline_s(self) -> float:
        """Seconds from the first try in which an answer is of use."""
        return float((self.body or {}).get("deadline_ms") or inf) / 1e3

    def body_after(self, spent_s: float) -> dict[str, Any] | None:
        """The body of a try so long after the first, with the time that is left."""
        if self.body is None or self.deadline_s == inf:
            return self.body
        return {**self.body, "deadline_ms": 1e3 * (self.deadline_s - spent_s)}


def predict(poses: Float[np.ndarray, "T J 3"], options: PredictOptions) -> Call[Prediction]:
    """Asks for futures of the poses."""
    return _posted("/predict", {"poses": poses, **options}, _prediction)


def predict_actions(
    poses: Float[np.ndarray, "T J 3"], actions: Sequence[str], options: ActionsOptions
) -> Call[ActionsPrediction]:
    """Asks for futures in which actions are performed."""
    body = {"poses": poses, "actions": list(actions), **options}
    return _posted("/predict_actions", body, _actions_prediction)


def _posted(path: str, fields: dict[str, Any], read: Callable[[dict[str, Any]], _T]) -> Call[_T]:
    body = _body(fields)
    request_id = body.pop("request_id", None)
    return Call(method="POST", path=path, body=body, request_id=request_id, read=read)


def _body(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields with a seed that is drawn here: however often they are sent, the answer is one."""
    body = {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in fields.items()
    }
    if "returned" in body:
        body["return"] = body.pop("returned")
    if body.get("seed") is None:
        body["seed"] = SystemRandom().randrange(MAX_SEED + 1)
    return body


def live_start(options: PredictOptions, *, rate_hz: float) -> dict[str, Any]:
    """What a stream begins with."""
    return {"type": "start", "session": None, "rate_hz": rate_hz, "options": _body(options)}


def live_prediction(content: dict[str, Any]) -> LivePrediction:
    """What a stream says of its latest frames."""
    return LivePrediction(t=content["t"], prediction=_prediction(content["answer"]))


def got(path: str) -> Call[dict[str, Any]]:
    """Asks for what a path says, whatever it is."""
    return Call(method="GET", path=path, read=dict)


def _prediction(content: dict[str, Any]) -> Prediction:
    none = np.empty((0, content["num_frames"], len(content["joints"]), 3))
    quantiles = content.get("quantiles")
    return Prediction(
        futures=np.array(content.get("futures", none)),
        modes=tuple(
            Mode(**mode | {"members": tuple(mode["members"])}) for mode in content.get("modes", ())
        ),
        quantiles=quantiles and _regions(**quantiles),
        steps=Steps(**content["steps"]),
        **_said(content),
    )


def _regions(levels: Sequence[float], centre: Any, radius: Any, *, calibrated: bool) -> Regions:
    return Regions(
        levels=tuple(levels),
        centre=np.array(centre),
        radius=np.array(radius),
        calibrated=calibrated,
    )


def _occupancy(
    probability: Any, num_lasting: Any, first_entry: dict[str, Any], min_distance: dict[str, Any]
) -> Occupancy:
    times = [inf if time_s is None else time_s for time_s in first_entry["time_s"]]
    return Occupancy(
        probability=np.array(probability),
        num_lasting=np.array(num_lasting),
        never=first_entry["never"],
        levels=tuple(first_entry["levels"]),
        first_entry_s=np.array(times),
        min_distance=np.array(min_distance["distance"]),
    )


def _actions_prediction(content: dict[str, Any]) -> ActionsPrediction:
    return ActionsPrediction(**_performed(content.get("futures", ())), **_said(content))


def _performed(futures: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "futures": tuple(np.array(future["poses"]) for future in futures),
        "segments": tuple(
            tuple(ActionSegment(**segment) for segment in future["segments"]) for future in futures
        ),
    }


def _said(content: dict[str, Any]) -> dict[str, Any]:
    return {
        "id": content["id"],
        "joints": tuple(content["joints"]),
        "joint_sources": tuple(content["joint_sources"]),
        "fps": content["fps"],
        "seed": content["seed"],
        "model": content["model"]["name"],
        "warnings": tuple(content["warnings"]),
        "occupancy": tuple(_occupancy(**region) for region in content.get("occupancy", ())),
        "timing_ms": content["timing_ms"],
    }


def preview(content: dict[str, Any]) -> Preview:
    """What a stream says after a step."""
    return Preview(futures=np.array(content["futures"]), **content["steps"])


def actions_preview(content: dict[str, Any]) -> ActionsPreview:
    """What a stream of actions says after a chunk of frames."""
    return ActionsPreview(**_performed(content["futures"]), **content["steps"])
