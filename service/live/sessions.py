"""What a live stream has seen of a person, which outlives the connection that it came by."""

from asyncio import Event
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import monotonic
from typing import Any
from uuid import uuid4

import numpy as np
from jaxtyping import Float

from models.motion.axes import Axes
from models.motion.gaps import num_even
from service.errors import FieldError

GAP_S = 0.5  # without a frame, after which what was seen before tells nothing of now
KEPT_S = 30.0  # after the connection was lost
FRAMES_PER_PERIOD = 5  # kept at most; more say nothing new


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Frame:
    """A pose, when it was seen, and what each of its joints is worth, if that was told."""

    t: float
    pose: Float[np.ndarray, "J 3"]
    confidence: Float[np.ndarray, "J"] | None = None


class History:
    """The latest frames of a person as they came, of which the older are forgotten."""

    def __init__(self, *, fps: float, num_frames: int, frames: Iterable[Frame] = ()) -> None:
        self._fps = fps
        self._num_frames = num_frames
        self.frames: list[Frame] = []
        for frame in frames:
            self.add(frame)

    @property
    def newest_s(self) -> float | None:
        """The time of the latest frame."""
        return self.frames[-1].t if self.frames else None

    @property
    def have_s(self) -> float:
        """Seconds from the first frame to the latest."""
        return self.frames[-1].t - self.frames[0].t if self.frames else 0.0

    @property
    def need_s(self) -> float:
        """Seconds that have to be seen."""
        return (self._num_frames - 1) / self._fps

    @property
    def suffices(self) -> bool:
        """Whether so much has been seen."""
        return num_even(self.have_s, self._fps) >= self._num_frames

    def add(self, frame: Frame) -> None:
        """Take a frame; one that is far from the last in time begins a new history.

        Raises:
            FieldError: it is not later than the last one.
        """
        t, last = frame.t, self.newest_s
        if last is not None and abs(t - last) > GAP_S:
            self.frames.clear()
        elif last is not None and t <= last:
            raise FieldError(
                pointer="/t", found=f"{t:g} s", expected=f"must be after the last, at {last:g} s"
            )
        if len(self.frames) > 1 and t - self.frames[-2].t < 1.0 / (FRAMES_PER_PERIOD * self._fps):
            self.frames.pop()
        self.frames.append(frame)
        # One frame is kept from before all that is looked at, as one more than needed helps.
        oldest = t - (self._num_frames + 1) / self._fps
        while len(self.frames) > 1 and self.frames[1].t <= oldest:
            del self.frames[0]

    def observed(self) -> dict[str, Any]:
        """The frames as the fields of a request; one that told no confidence is sure."""
        told = [frame.confidence for frame in self.frames]
        sure = np.ones(len(self.frames[-1].pose))
        return {
            "poses": np.stack([frame.pose for frame in self.frames]),
            "timestamps": [frame.t for frame in self.frames],
            "confidence": None
            if all(worth is None for worth in told)
            else np.stack([sure if worth is None else worth for worth in told]),
        }


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
