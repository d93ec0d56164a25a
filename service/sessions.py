"""What a live stream has seen of a person, which outlives the connection that it came by."""

from asyncio import Event
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import monotonic
from uuid import uuid4

import numpy as np
from jaxtyping import Float

from models.motion.axes import Axes
from service.errors import FieldError

GAP_S = 0.5  # without a frame, after which what was seen before tells nothing of now
KEPT_S = 30.0  # after the connection was lost
FRAMES_PER_PERIOD = 5  # kept at most; more say nothing new
NEAR_S = 1e-6  # of a moment: a frame is taken as it is

Frame = tuple[float, Float[np.ndarray, "J 3"]]


class History:
    """The latest frames of a person at their own times, of which the older are forgotten."""

    def __init__(self, *, fps: float, num_frames: int, frames: Iterable[Frame] = ()) -> None:
        self._fps = fps
        self._num_frames = num_frames
        self._times: list[float] = []
        self._poses: list[Float[np.ndarray, "J 3"]] = []
        for t, pose in frames:
            self.add(t, pose)

    @property
    def frames(self) -> list[Frame]:
        """The frames, the latest last."""
        return list(zip(self._times, self._poses, strict=True))

    @property
    def newest_s(self) -> float | None:
        """The time of the latest frame."""
        return self._times[-1] if self._times else None

    @property
    def have_s(self) -> float:
        """Seconds from the first frame to the latest."""
        return self._times[-1] - self._times[0] if self._times else 0.0

    @property
    def need_s(self) -> float:
        """Seconds that have to be seen."""
        return (self._num_frames - 1) / self._fps

    @property
    def suffices(self) -> bool:
        """Whether so much has been seen."""
        return self._num_moments >= self._num_frames

    @property
    def _num_moments(self) -> int:
        """How many moments, a period between them, lie within what has been seen."""
        if not self._times:
            return 0
        return min(self._num_frames, int((self.have_s + NEAR_S) * self._fps)) + 1

    def add(self, t: float, pose: Float[np.ndarray, "J 3"]) -> None:
        """Take a frame; one that is far from the last in time begins a new history.

        Raises:
            FieldError: it is not later than the last one.
        """
        last = self.newest_s
        if last is not None and abs(t - last) > GAP_S:
            self._times.clear()
            self._poses.clear()
        elif last is not None and t <= last:
            raise FieldError(
                pointer="/t", found=f"{t:g} s", expected=f"must be after the last, at {last:g} s"
            )
        if len(self._times) > 1 and t - self._times[-2] < 1.0 / (FRAMES_PER_PERIOD * self._fps):
            self._times.pop()
            self._poses.pop()
        self._times.append(t)
        self._poses.append(pose)
        # One frame is kept from before all that is looked at, as one more than needed helps.
        oldest = t - (self._num_frames + 1) / self._fps
        while len(self._times) > 1 and self._times[1] <= oldest:
            del self._times[0], self._poses[0]

    def poses(self) -> Float[np.ndarray, "T J 3"]:
        """Evenly at the rate until the latest frame, one more than needed where it is there.

        Between two frames on the line between them; a joint that is NaN in either is NaN.
        """
        times, poses = np.array(self._times), np.stack(self._poses)
        if len(times) == 1:
            return poses
        moments = times[-1] - np.arange(self._num_moments - 1, -1, -1) / self._fps
        after = np.clip(np.searchsorted(times, moments - NEAR_S), 1, len(times) - 1)
        share = ((moments - times[after - 1]) / np.diff(times)[after - 1])[:, None, None]
        between: Float[np.ndarray, "T J 3"] = poses[after - 1] + share * (
            poses[after] - poses[after - 1]
        )
        for exact in (after - 1, after):
            near = np.abs(times[exact] - moments) <= NEAR_S
            between[near] = poses[exact[near]]
        return between


@dataclass(frozen=True, kw_only=True, slots=True)
class Watch:
    """How a person is watched: which joints, in which axes, in how many frames at which rate."""

    joints: tuple[str, ...]
    axes: Axes
    fps: float
    num_frames: int


@dataclass(kw_only=True, slots=True, eq=False)
class Session:
    """What has been seen, and how far it has been answered.

    ``taken`` tells the connection that has it that another one does; None where none has it.
    """

    id: str
    watch: Watch
    history: History
    answered_s: float | None = None
    num_answers: int = 0
    taken: Event | None = None
    left_s: float = 0.0

    @property
    def is_unanswered(self) -> bool:
        """Whether there is a frame that no answer has used."""
        return self.history.newest_s not in (None, self.answered_s)


class Sessions:
    """The sessions of connections that are open, and for a while of as many that were lost."""

    def __init__(
        self, *, most: int, kept_s: float = KEPT_S, clock: Callable[[], float] = monotonic
    ) -> None:
        self._most = most
        self._kept_s = kept_s
        self._clock = clock
        self._sessions: dict[str, Session] = {}

    def open(self, session_id: str | None, *, watch: Watch, taken: Event) -> Session:
        """The session of this id, taken from whoever has it, or a new one if it is not known.

        Its frames stay if the joints and axes are the same, and will be answered once more.
        """
        self._forget()
        old = self._sessions.pop(session_id or "", None)
        if old is not None and old.taken not in (None, taken):
            old.taken.set()
        same = old is not None and (old.watch.joints, old.watch.axes) == (watch.joints, watch.axes)
        session = Session(
            id=old.id if old else str(uuid4()),
            watch=watch,
            history=History(
                fps=watch.fps,
                num_frames=watch.num_frames,
                frames=old.history.frames if old and same else (),
            ),
            num_answers=old.num_answers if old else 0,
            taken=taken,
        )
        self._sessions[session.id] = session
        return session

    def leave(self, session: Session) -> None:
        """Its connection is closed; of too many that were left the first ones are forgotten."""
        session.taken, session.left_s = None, self._clock()
        self._sessions[session.id] = self._sessions.pop(session.id)
        self._forget()

    def _forget(self) -> None:
        left = [session for session in self._sessions.values() if session.taken is None]
        since_s = self._clock() - self._kept_s
        for i, session in enumerate(left):
            if i < len(left) - self._most or session.left_s < since_s:
                del self._sessions[session.id]
