"""Progress by performing: chunk after chunk of an action until it ends, then the next action."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from models.bundle import ActionsSpec
from service.engine.context import Context, Tensors
from service.engine.runner import Runner
from service.engine.sampling import noise
from service.engine.stopping import rest_frame
from service.engine.trajectory import Request, Sample, Segment

NEXT = "next_"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Performance:
    """One sample of one request: the frames so far, and what the present action goes on from.

    ``frames`` are those of the observation and all that was made since; ``segments`` tell the
    actions that have ended.
    """

    request_id: int
    sample_index: int
    request: Request
    frames: Float[np.ndarray, "F J 3"]
    noise: Float[np.ndarray, "..."]
    context: Context
    segments: tuple[Segment, ...] = ()

    @property
    def start(self) -> int:
        """The frame of the future at which the present action starts."""
        return self.segments[-1].end if self.segments else 0


class Performer:
    """The progress of a bundle that performs actions; every turn makes one chunk of frames."""

    def __init__(self, runner: Runner, spec: ActionsSpec) -> None:
        self._runner = runner
        self._manifest = runner.manifest
        self._spec = spec
        self._encoder_draws = runner.takes("encoder", "noise")
        self._draws = self._encoder_draws or runner.takes("decoder", "noise")

    def start(self, request_id: int, request: Request) -> list[Performance]:
        """Every sample before its first action, its context shared as far as noise permits."""
        num_rows = request.num_samples if self._draws else 1
        drawn = self._drawn(request, range(num_rows), action_index=0)
        shared = self._context(request.observation, request.actions[0], drawn[0])
        return [
            Performance(
                request_id=request_id,
                sample_index=sample_index,
                request=request,
                frames=request.observation,
                noise=own,
                context=self._context(request.observation, request.actions[0], own)
                if self._encoder_draws
                else shared,
            )
            for sample_index, own in enumerate(drawn)
        ]

    def advance(self, rows: Sequence[Performance]) -> list[Performance | Sample]:
        """Make the next chunk of each row; where an action ends, turn to the next one."""
        contexts = [row.context for row in rows]
        self._runner.encode(contexts)
        drawn = np.stack([row.noise for row in rows])
        outputs = self._runner.run("decoder", {"noise": drawn}, contexts)
        state = {
            name.removeprefix(NEXT): values
            for name, values in outputs.items()
            if name.startswith(NEXT)
        }
        return [
            self._continued(
                row,
                outputs["future"][i],
                {name: values[i : i + 1] for name, values in state.items()},
            )
            for i, row in enumerate(rows)
        ]

    def _continued(
        self, row: Performance, chunk: Float[np.ndarray, "C J 3"], state: Tensors
    ) -> Performance | Sample:
        request, spec = row.request, self._spec
        frames = np.concatenate([row.frames, chunk])
        before = self._manifest.num_observed + row.start
        longest = request.max_frames or self._manifest.horizon
        action = request.actions[len(row.segments)]
        shortest = spec.shortest.get(spec.labels[action], spec.min_frames)
        made = frames[before : before + longest]
        rest = rest_frame(
            made,
            # Windows that ended before this chunk were judged with the chunk before.
            start=max(shortest, len(row.frames) - before - spec.stop_window + 2) - 1,
            window=spec.stop_window,
            threshold_m=request.stop_threshold_m or spec.stop_threshold_m,
        )
        if rest is None and len(made) < longest:
            context = Context(tensors=row.context.tensors | state, encoded=True)
            return replace(row, frames=frames, context=context)
        segment = Segment(
            action=action,
            start=row.start,
            end=row.start + (len(made) if rest is None else rest + 1),
            stopped=rest is not None,
        )
        return self._turned(
            replace(
                row,
                frames=frames[: self._manifest.num_observed + segment.end],
                segments=(*row.segments, segment),
            )
        )

    def _turned(self, row: Performance) -> Performance | Sample:
        """A row whose action has just ended, before its next one; its sample after the last."""
        num_observed, action_index = self._manifest.num_observed, len(row.segments)
        if action_index == len(row.request.actions):
            return Sample(
                request_id=row.request_id,
                sample_index=row.sample_index,
                future=row.frames[num_observed:],
                segments=row.segments,
            )
        (own,) = self._drawn(row.request, (row.sample_index,), action_index=action_index)
        seen, action = row.frames[-num_observed:], row.request.actions[action_index]
        return replace(row, noise=own, context=self._context(seen, action, own))

    def _drawn(
        self, request: Request, sample_indices: Sequence[int], *, action_index: int
    ) -> Float[np.ndarray, "S ..."]:
        return noise(
            self._manifest.x_t_shape,
            seed=request.seed,
            sample_indices=sample_indices,
            draw=action_index,
        )

    def _context(
        self,
        observation: Float[np.ndarray, "T J 3"],
        action: int,
        own: Float[np.ndarray, "..."],
    ) -> Context:
        tensors: Tensors = {"observation": observation[None], "action": np.array([action])}
        if self._encoder_draws:
            tensors["noise"] = own[None]
        return Context(tensors=tensors)
