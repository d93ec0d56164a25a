"""A request under way: what its rows have come to, and the result that they make."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np
from jaxtyping import Float

from service.engine.trajectory import (
    Preview,
    Request,
    Result,
    Samples,
    Segment,
    Shown,
    StoppedBy,
    Trajectory,
)

_BY_WEIGHT: tuple[StoppedBy, ...] = ("deadline", "tolerance", "num_steps", "end")


@dataclass(kw_only=True, slots=True, eq=False)
class Job:
    """A request under way, its samples that are whole, and its previews that lack some rows."""

    request_id: int
    request: Request
    steps_of: int
    num_rows: int
    deadline_s: float
    added_s: float
    started_s: float | None = None
    samples: list[Samples] = field(default_factory=list)
    num_whole: int = 0
    previews: dict[int, list[Shown]] = field(default_factory=dict)
    num_told: int = 0

    @property
    def finished(self) -> bool:
        """Whether every sample is whole."""
        return self.num_whole == self.num_rows

    def put(self, samples: Samples) -> None:
        """Keep samples that are whole."""
        self.samples.append(samples)
        self.num_whole += len(samples.sample_indices)

    def show(self, rows: Trajectory) -> None:
        """Keep what the rows show, for the previews of their steps."""
        for shown in rows.shown:
            self.previews.setdefault(shown.steps_run, []).append(shown)

    def ready(self) -> list[tuple[int, int, list[Shown]]]:
        """Steps that every row has behind it, or needs no more, and the futures of all then.

        Before each, its place in all that is told of the request.

        The row that ends last may be one of few steps, for which previews of the others have
        waited; the last step's is the result.
        """
        found: list[tuple[int, int, list[Shown]]] = []
        last = max(samples.steps_run for samples in self.samples) if self.finished else inf
        for step in sorted(step for step in self.previews if step < last):
            whole = [
                Shown(
                    sample_indices=samples.sample_indices,
                    futures=samples.futures,
                    steps_run=samples.steps_run,
                    segments=samples.segments,
                )
                for samples in self.samples
                if samples.steps_run <= step
            ]
            shown = [*self.previews[step], *whole]
            # A sample that was cut was shown at its last step, and is whole too.
            if len({int(i) for some in shown for i in some.sample_indices}) < self.num_rows:
                break
            found.append((self.order(), step, shown))
            del self.previews[step]
        return found

    def order(self) -> int:
        """The place of what is told next; what comes first has the lowest."""
        self.num_told += 1
        return self.num_told - 1

    def queued_s(self, now_s: float) -> float:
        """Seconds before its first turn, so far."""
        return (now_s if self.started_s is None else self.started_s) - self.added_s

    def preview(self, order: int, steps_run: int, shown: Sequence[Shown]) -> Preview:
        """The futures of all samples after so many steps."""
        num_frames = self._num_frames(shown)
        return Preview(
            request_id=self.request_id,
            futures=self._assembled(
                shown, num_frames=min(num_frames, self.request.horizon or num_frames)
            ),
            steps_run=steps_run,
            steps_of=self.steps_of,
            segments=self._segments(shown),
            order=order,
        )

    def result(self) -> Result:
        """What the samples make, which are all whole; nothing is told after it."""
        reasons: set[StoppedBy] = {part.stopped_by for part in self.samples}
        return Result(
            request_id=self.request_id,
            futures=self._assembled(self.samples, num_frames=self._num_frames(self.samples)),
            steps_run=max(part.steps_run for part in self.samples),
            steps_of=self.steps_of,
            stopped_by=next(reason for reason in _BY_WEIGHT if reason in reasons),
            segments=self._segments(self.samples),
            queued_s=self.queued_s(self.added_s),
            order=self.order(),
        )

    def _num_frames(self, parts: Sequence[Shown | Samples]) -> int:
        """The longest future of actions; else the shortest, which all samples have reached."""
        lengths: list[int] = [part.futures.shape[1] for part in parts]
        return max(lengths) if self.request.actions else min(lengths)

    def _segments(self, parts: Sequence[Shown | Samples]) -> tuple[tuple[Segment, ...], ...]:
        """Those of all samples, in order; of actions alone."""
        found = {
            int(i): some
            for part in parts
            for i, some in zip(part.sample_indices, part.segments, strict=False)
        }
        return tuple(found[i] for i in range(self.num_rows) if i in found) * self._copies

    @property
    def _copies(self) -> int:
        """How many samples each row stands for: all, where they are alike."""
        return self.request.num_samples // self.num_rows

    def _assembled(
        self, parts: Sequence[Shown | Samples], *, num_frames: int
    ) -> Float[np.ndarray, "N H J 3"]:
        """The futures of all samples; those that are shorter repeat their last frame."""
        futures = np.empty((self.num_rows, num_frames, *parts[0].futures.shape[2:]), np.float32)
        for part in parts:
            made = part.futures[:, :num_frames]
            futures[part.sample_indices, : made.shape[1]] = made
            futures[part.sample_indices, made.shape[1] :] = made[:, -1:]
        return futures if self._copies == 1 else np.repeat(futures, self._copies, axis=0)
