"""What goes into the engine and comes out of it, and what is on its way between the two."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Request:
    """An observation in the bundle's skeleton, rate and metres, and how to continue it.

    ``num_steps`` of the bundle's K denoising steps are run; None runs them all. ``actions`` are
    indices of the manifest's labels, performed one after the other; a bundle that performs actions
    needs one at least. ``stop_threshold_m`` and ``max_frames`` (of one action) are the manifest's
    by default.
    """

    observation: Float[np.ndarray, "T J 3"]
    num_samples: int = 1
    num_steps: int | None = None
    seed: int = 0
    actions: tuple[int, ...] = ()
    stop_threshold_m: float | None = None
    max_frames: int | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Segment:
    """The frames ``start`` to before ``end`` of a future, in which one action is performed.

    ``stopped`` is false where the action was cut off at its longest.
    """

    action: int
    start: int
    end: int
    stopped: bool


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Result:
    """N futures of a request, in metres in the world of its observation.

    Futures of actions differ in length: H is that of the longest, the others repeat their last
    frame, and the end of a sample's last segment is its length.
    """

    request_id: int
    futures: Float[np.ndarray, "N H J 3"]
    steps_run: int
    steps_of: int
    segments: tuple[tuple[Segment, ...], ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Failure:
    """A request that could not be computed, and why."""

    request_id: int
    error: Exception


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Sample:
    """One future of a request, whole."""

    request_id: int
    sample_index: int
    future: Float[np.ndarray, "H J 3"]
    segments: tuple[Segment, ...] = ()


@runtime_checkable
class Trajectory(Protocol):
    """The state of one sample on its way, a row of a batch; how it advances is its own affair."""

    @property
    def request_id(self) -> int:
        """The request that it belongs to."""


TrajectoryT = TypeVar("TrajectoryT", bound=Trajectory)


class Progress(Protocol[TrajectoryT]):
    """A way of a request's samples to their futures."""

    def start(self, request_id: int, request: Request) -> list[TrajectoryT]:
        """The trajectories of a request, by sample; a single one where every sample is alike."""

    def advance(self, rows: Sequence[TrajectoryT]) -> list[TrajectoryT | Sample]:
        """The same rows one turn later; those that have arrived are samples.

        Raises:
            EngineError: a graph could not run, or gave NaN; the rows may be advanced again.
        """
