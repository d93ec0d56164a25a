"""What goes into the engine and comes out of it, and what is on its way between the two."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Shaped

from service.engine.context import Context
from service.engine.rows import Rows, SelfT
from service.errors import ServiceError

StoppedBy = Literal["end", "num_steps", "deadline", "tolerance"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Request:
    """An observation in the bundle's skeleton, rate and metres, and how to continue it.

    ``num_steps`` of the bundle's K denoising steps are run, those of its plan; None runs as many as
    its manifest says. ``actions`` are
    indices of the manifest's labels, performed one after the other; a bundle that performs actions
    needs one at least. ``stop_threshold_m`` and ``max_frames`` (of one action) are the manifest's
    by default. At ``deadline_s``, on the engine's clock (``time.perf_counter``), the answer is what
    is ready then. A sample stops as soon as a step moved no joint of its future by ``tolerance_m``.
    Frames of the ``horizon`` beyond the bundle's come from legs that re-enter the last ones; a
    bundle that performs actions takes neither. ``previews`` asks for a Preview after each step but
    the last, which the Result follows; a step of one that performs is a chunk of frames.
    """

    observation: Float[np.ndarray, "T J 3"]
    num_samples: int = 1
    num_steps: int | None = None
    seed: int = 0
    actions: tuple[int, ...] = ()
    stop_threshold_m: float | None = None
    max_frames: int | None = None
    deadline_s: float | None = None
    tolerance_m: float | None = None
    horizon: int | None = None
    previews: bool = False


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
    frame, and the end of a sample's last segment is its length. Otherwise H is the horizon that was
    asked for, or less where the deadline came before the last leg. ``steps_run`` are the most that
    one row ran, of ``steps_of``, over all legs or actions; ``queued_s`` passed before the first.
    ``order`` is the place of a result, a preview or a failure in all that is told of its request.
    """

    request_id: int
    futures: Float[np.ndarray, "N H J 3"]
    steps_run: int
    steps_of: int
    stopped_by: StoppedBy = "end"
    segments: tuple[tuple[Segment, ...], ...] = ()
    queued_s: float = 0.0
    order: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Preview:
    """The futures of a request as they stand after a step: those that fewer steps would give.

    Of actions it is the frames so far, with their segments as a Result has them. The last one that
    has not ended is not ``stopped``, and may yet end some frames before those of its last chunk.
    """

    request_id: int
    futures: Float[np.ndarray, "N H J 3"]
    steps_run: int
    steps_of: int
    segments: tuple[tuple[Segment, ...], ...] = ()
    order: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Failure:
    """A request that could not be computed, and why."""

    request_id: int
    error: ServiceError
    queued_s: float = 0.0
    order: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Samples:
    """Futures of a request that are whole, after so many steps of each."""

    request_id: int
    sample_indices: Shaped[np.ndarray, "n"]
    futures: Float[np.ndarray, "n H J 3"]
    steps_run: int
    stopped_by: StoppedBy
    segments: tuple[tuple[Segment, ...], ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Shown:
    """Futures of some samples as they stand after so many steps of each."""

    sample_indices: Shaped[np.ndarray, "n"]
    futures: Float[np.ndarray, "n H J 3"]
    steps_run: int
    segments: tuple[tuple[Segment, ...], ...] = ()


@runtime_checkable
class Trajectory(Rows, Protocol):
    """Samples of one request on their way; how they advance is their own affair."""

    @property
    def steps_behind(self) -> int:
        """How many steps they have run; after one there are futures to show."""

    @property
    def context(self) -> Context:
        """What the graphs know of them."""

    @property
    def sample_indices(self) -> Shaped[np.ndarray, "n"]:
        """Which of the request's samples they are."""

    @property
    def shown(self) -> list[Shown]:
        """Their futures as they stand, where the request asks for previews."""

    def cut(self: SelfT) -> SelfT:
        """The same samples, which end in their next turn with what they have."""


TrajectoryT = TypeVar("TrajectoryT", bound=Trajectory)


class Progress(Protocol[TrajectoryT]):
    """A way of a request's samples to their futures."""

    def steps_of(self, request: Request) -> int:
        """The steps of a request, were it to run them all."""

    def start(self, request_id: int, request: Request) -> list[TrajectoryT]:
        """All samples of a request, or a single one where they are all alike; no graph runs."""

    def advance(self, rows: Sequence[TrajectoryT]) -> list[TrajectoryT | Samples]:
        """The same samples one turn later; those that have arrived, or were cut, are whole.

        Raises:
            EngineError: a graph could not run, or gave NaN; the rows may be advanced again.
        """
