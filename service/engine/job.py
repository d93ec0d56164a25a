"""A request under way: what its rows have come to, and the result that they make."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Shaped

from service.engine.trajectory import Preview, Request, Result, Samples, StoppedBy, Trajectory

_BY_WEIGHT: tuple[StoppedBy, ...] = ("deadline", "tolerance", "num_steps", "end")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Shown:
    """Futures of some samples as they stand after a step."""

    sample_indices: Shaped[np.ndarray, "n"]
    futures: Float[np.ndarray, "n H J 3"]


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

    @property
    def finished(self) -> bool:
        """Whether every sample is whole."""
        return self.num_whole == self.num_rows

    def put(self, samples: Samples) -> None:
        """Keep samples that are whole."""
        self.samples.append(samples)
        self.num_whole += len(samples.sample_indices)

    def show(self, rows: Trajectory) -> None:
        """Keep what the rows show, for the preview of their step."""
        if rows.shown is not None:
            shown = Shown(sample_indices=rows.sample_indices, futures=rows.shown)
            self.previews.setdefault(rows.steps_behind, []).append(shown)

    def ready(self) -> list[tuple[int, list[Shown]]]:
        """Steps that every row has behind it, or needs no more, and the futures of all then."""
        found: list[tuple[int, list[Shown]]] = []
        for step in sorted(self.previews):
            whole = [
                Shown(sample_indices=samples.sample_indices, futures=samples.futures)
                for samples in self.samples
                if samples.steps_run <= step
            ]
            shown = [*self.previews[step], *whole]
            if sum(len(some.sample_indices) for some in shown) < self.num_rows:
                break
            found.append((step, shown))
            del self.previews[step]
        return found

    def queued_s(self, now_s: float) -> float:
        """Seconds before its first turn, so far."""
        return (now_s if self.started_s is None else self.started_s) - self.added_s

    def preview(self, steps_run: int, shown: Sequence[Shown]) -> Preview:
        """The futures of all samples after so many steps."""
        shortest = min(some.futures.shape[1] for some in shown)
        return Preview(
            request_id=self.request_id,
            futures=self._assembled(
                shown, num_frames=min(shortest, self.request.horizon or shortest)
            ),
            steps_run=steps_run,
            steps_of=self.steps_of,
        )

    def result(self) -> Result:
        """What the samples make, which are all whole."""
        segments = {
            int(i): some
            for part in self.samples
            for i, some in zip(part.sample_indices, part.segments, strict=False)
        }
        lengths = [part.futures.shape[1] for part in self.samples]
        num_frames = max(lengths) if segments else min(lengths)
        reasons: set[StoppedBy] = {part.stopped_by for part in self.samples}
        in_order = tuple(segments[i] for i in range(self.num_rows) if i in segments)
        return Result(
            request_id=self.request_id,
            futures=self._assembled(self.samples, num_frames=num_frames),
            steps_run=max(part.steps_run for part in self.samples),
            steps_of=self.steps_of,
            stopped_by=next(reason for reason in _BY_WEIGHT if reason in reasons),
            segments=in_order * self._copies,
            queued_s=self.queued_s(self.added_s),
        )

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
