"""Progress by performing: chunk after chunk of an action until it ends, then the next action."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Float, Shaped

from models.bundle import ActionsSpec
from service.engine.context import Context, Tensors, unencoded
from service.engine.costs import Costs
from service.engine.runner import Runner
from service.engine.sampling import noise
from service.engine.stopping import rest_frame
from service.engine.trajectory import Request, Samples, Segment, StoppedBy

NEXT = "next_"
EARLIEST_END = "earliest_end"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Performance:
    """One sample of one request: the frames so far, and what the present action goes on from.

    ``frames`` are those of the observation and all that was made since; ``segments`` tell the
    actions that have ended. Before the first turn there is no ``noise``.
    """

    request_id: int
    request: Request
    sample_index: int
    turns_left: int
    frames: Float[np.ndarray, "F J 3"]
    context: Context
    noise: Float[np.ndarray, "..."] | None = None
    segments: tuple[Segment, ...] = ()
    is_cut: bool = False

    def __len__(self) -> int:
        """Each stands by itself."""
        return 1

    @property
    def sample_indices(self) -> Shaped[np.ndarray, "1"]:
        """The one sample that this is."""
        return np.array([self.sample_index])

    @property
    def steps_behind(self) -> int:
        """1 once there are frames to show."""
        return int(len(self.frames) > len(self.request.observation))

    @property
    def shown(self) -> None:
        """Nothing: a performance is one step."""

    @property
    def start(self) -> int:
        """The frame of the future at which the present action starts."""
        return self.segments[-1].end if self.segments else 0

    def cut(self) -> "Performance":
        """The same sample, which ends in its next turn with the frames that it has."""
        return replace(self, is_cut=True)

    def split(self, count: int) -> tuple["Performance", "Performance"]:
        """Nothing: a single sample has no parts."""
        raise ValueError(f"count: found {count}; a single sample cannot be split.")


class Performer:
    """The progress of a bundle that performs actions; every turn makes one chunk of frames."""

    def __init__(self, runner: Runner, costs: Costs, spec: ActionsSpec) -> None:
        self._runner = runner
        self._costs = costs
        self._manifest = runner.manifest
        self._spec = spec
        self._encoder_draws = runner.takes("encoder", "noise")
        self._draws = self._encoder_draws or runner.takes("decoder", "noise")

    def start(self, request_id: int, request: Request) -> list[Performance]:
        """Every sample before its first action, its context shared as far as noise permits."""
        observation, action = request.observation, request.actions[0]
        shared = self._context(observation, action)
        return [
            Performance(
                request_id=request_id,
                request=request,
                sample_index=sample_index,
                turns_left=self._turns(request, num_actions=len(request.actions)),
                frames=observation,
                context=self._context(observation, action) if self._encoder_draws else shared,
            )
            for sample_index in range(request.num_samples if self._draws else 1)
        ]

    def advance(self, rows: Sequence[Performance]) -> list[Performance | Samples]:
        """Make the next chunk of each row; where an action ends, turn to the next one."""
        ended = [self._ended(row) for row in rows if row.is_cut]
        going = [row for row in rows if not row.is_cut]
        begun = [row for row in going if row.noise is not None]
        running = [*begun, *self._drawn([row for row in going if row.noise is None])]
        if not running:
            return [*ended]
        waiting = unencoded(row.context for row in running)
        if waiting:
            with self._costs.timed("encode", len(waiting)):
                self._runner.encode(waiting)
        drawn = np.stack([row.noise for row in running if row.noise is not None])
        with self._costs.timed("step", len(running)):
            parts = [(row.context, 1) for row in running]
            outputs = self._runner.run("decoder", {"noise": drawn}, parts)
        state = {
            name.removeprefix(NEXT): values
            for name, values in outputs.items()
            if name.startswith(NEXT)
        }
        continued = [
            self._continued(
                row,
                outputs["future"][i],
                {name: values[i : i + 1] for name, values in state.items()},
                earliest_end=int(outputs[EARLIEST_END][i, 0]) if EARLIEST_END in outputs else 0,
            )
            for i, row in enumerate(running)
        ]
        return [*ended, *continued]

    def _continued(
        self,
        row: Performance,
        chunk: Float[np.ndarray, "C J 3"],
        state: Tensors,
        *,
        earliest_end: int,
    ) -> Performance | Samples:
        request, spec = row.request, self._spec
        frames = np.concatenate([row.frames, chunk])
        before = self._manifest.num_observed + row.start
        longest = request.max_frames or self._manifest.horizon
        action = request.actions[len(row.segments)]
        shortest = max(spec.min_frames, earliest_end)
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
            return replace(row, turns_left=row.turns_left - 1, frames=frames, context=context)
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

    def _turned(self, row: Performance) -> Performance | Samples:
        """A row whose action has just ended, before its next one; its sample after the last."""
        actions = row.request.actions[len(row.segments) :]
        if not actions:
            return self._whole(row, "end")
        seen = row.frames[-self._manifest.num_observed :]
        return replace(
            row,
            turns_left=self._turns(row.request, num_actions=len(actions)),
            noise=None,
            context=self._context(seen, actions[0]),
        )

    def _ended(self, row: Performance) -> Samples:
        """The sample of a row that was cut: its action stops with the frames so far."""
        num_frames = len(row.frames) - self._manifest.num_observed
        if num_frames > row.start:
            action = row.request.actions[len(row.segments)]
            last = Segment(action=action, start=row.start, end=num_frames, stopped=False)
            row = replace(row, segments=(*row.segments, last))
        return self._whole(row, "deadline")

    def _whole(self, row: Performance, stopped_by: StoppedBy) -> Samples:
        return Samples(
            request_id=row.request_id,
            sample_indices=row.sample_indices,
            futures=row.frames[None, self._manifest.num_observed :],
            steps_run=1,
            stopped_by=stopped_by,
            segments=(row.segments,),
        )

    def _turns(self, request: Request, *, num_actions: int) -> int:
        """The chunks of so many actions at their longest."""
        longest = request.max_frames or self._manifest.horizon
        return num_actions * -(-longest // self._spec.chunk_frames)

    def _drawn(self, rows: Sequence[Performance]) -> list[Performance]:
        """The rows with noise for their present actions."""
        drawn: list[Performance] = []
        for _, group in groupby(rows, lambda row: (row.request_id, len(row.segments))):
            alike = list(group)
            draws = noise(
                self._manifest.x_t_shape,
                seed=alike[0].request.seed,
                sample_indices=[row.sample_index for row in alike],
                draw=len(alike[0].segments),
            )
            drawn += [self._with_noise(row, own) for row, own in zip(alike, draws, strict=True)]
        return drawn

    def _with_noise(self, row: Performance, own: Float[np.ndarray, "..."]) -> Performance:
        context = row.context
        if self._encoder_draws:
            context = Context(tensors=context.tensors | {"noise": own[None]})
        return replace(row, noise=own, context=context)

    def _context(self, observation: Float[np.ndarray, "T J 3"], action: int) -> Context:
        return Context(tensors={"observation": observation[None], "action": np.array([action])})
