"""Progress by performing: chunk after chunk of an action until it ends, then the next action."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Float, Int64

from models.bundle import ActionsSpec
from service.engine.context import Context, Tensors, gathered, joined, unencoded
from service.engine.costs import Costs
from service.engine.runner import Runner
from service.engine.sampling import noise
from service.engine.stopping import rest_frames
from service.engine.trajectory import Request, Samples, Segment, Shown, StoppedBy

NEXT = "next_"
EARLIEST_END = "earliest_end"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Performance:
    """Samples of one request at the same chunk of the same action.

    ``past`` has the frames of each before this action, those of the observation included, and
    ``segments`` the actions that made them; ``chunks`` are those of this action so far. Before its
    first there is no ``noise``. ``steps_run`` are the chunks of each sample, of all its actions.
    """

    request_id: int
    request: Request
    sample_indices: Int64[np.ndarray, "n"]
    turns_left: int
    context: Context
    past: tuple[Float[np.ndarray, "_ J 3"], ...]
    segments: tuple[tuple[Segment, ...], ...]
    steps_run: Int64[np.ndarray, "n"]
    chunks: tuple[Float[np.ndarray, "n _ J 3"], ...] = ()
    noise: Float[np.ndarray, "n ..."] | None = None
    is_cut: bool = False

    def __len__(self) -> int:
        """How many samples these are."""
        return len(self.sample_indices)

    @property
    def actions_ended(self) -> int:
        """How many of the request's actions are behind these samples."""
        return len(self.segments[0])

    @property
    def num_made(self) -> int:
        """The frames of this action so far."""
        return sum(chunk.shape[1] for chunk in self.chunks)

    @property
    def steps_behind(self) -> int:
        """The chunks that every sample has."""
        return int(self.steps_run.min())

    @property
    def shown(self) -> list[Shown]:
        """The frames of each sample so far, where the request asks for previews."""
        if not self.request.previews:
            return []
        found = [self.so_far(row) for row in range(len(self))]
        return [
            Shown(
                sample_indices=self.sample_indices[row : row + 1],
                futures=frames[None, len(self.request.observation) :],
                steps_run=int(self.steps_run[row]),
                segments=(segments,),
            )
            for row, (frames, segments) in enumerate(found)
        ]

    def cut(self) -> "Performance":
        """The same samples, which end in their next turn with the frames that they have."""
        return replace(self, is_cut=True)

    def split(self, count: int) -> tuple["Performance", "Performance"]:
        """The first ``count`` samples, and the others."""
        rows = np.arange(len(self))
        return self.part(rows[:count]), self.part(rows[count:])

    def part(self, rows: Int64[np.ndarray, "m"]) -> "Performance":
        """Some of the samples."""
        if len(rows) == len(self):
            return self
        return replace(
            self,
            sample_indices=self.sample_indices[rows],
            context=self.context.part(rows),
            past=tuple(self.past[row] for row in rows),
            segments=tuple(self.segments[row] for row in rows),
            steps_run=self.steps_run[rows],
            chunks=tuple(chunk[rows] for chunk in self.chunks),
            noise=None if self.noise is None else self.noise[rows],
        )

    def so_far(self, row: int) -> tuple[Float[np.ndarray, "F J 3"], tuple[Segment, ...]]:
        """One sample's frames and segments as they stand."""
        if not self.chunks:
            return self.past[row], self.segments[row]
        return self.ended(row, self.num_made, stopped=False)

    def ended(
        self, row: int, num_frames: int, *, stopped: bool
    ) -> tuple[Float[np.ndarray, "F J 3"], tuple[Segment, ...]]:
        """One sample's frames and segments when this action has so many frames."""
        frames = np.concatenate([self.past[row], *(chunk[row] for chunk in self.chunks)])
        before = self.segments[row]
        start = before[-1].end if before else 0
        segment = Segment(
            action=self.request.actions[len(before)],
            start=start,
            end=start + num_frames,
            stopped=stopped,
        )
        return frames[: len(self.past[row]) + num_frames], (*before, segment)


class Performer:
    """The progress of a bundle that performs actions; every turn makes one chunk of frames."""

    def __init__(self, runner: Runner, costs: Costs, spec: ActionsSpec) -> None:
        self._runner = runner
        self._costs = costs
        self._manifest = runner.manifest
        self._spec = spec
        self._encoder_draws = runner.takes("encoder", "noise")
        self._draws = self._encoder_draws or runner.takes("decoder", "noise")
        decoder = self._manifest.decoder
        self._asked = [tensor.name for tensor in decoder.inputs if tensor.name != "noise"]

    def steps_of(self, request: Request) -> int:
        """The chunks of all its actions at their longest."""
        return self._turns(request, num_actions=len(request.actions))

    def start(self, request_id: int, request: Request) -> list[Performance]:
        """All samples before their first action; they share a context."""
        num_samples = request.num_samples if self._draws else 1
        samples = Performance(
            request_id=request_id,
            request=request,
            sample_indices=np.arange(num_samples),
            turns_left=self.steps_of(request),
            context=_before(request.observation[None], action=request.actions[0]),
            past=(request.observation,) * num_samples,
            segments=((),) * num_samples,
            steps_run=np.zeros(num_samples, np.int64),
        )
        return [samples]

    def advance(self, rows: Sequence[Performance]) -> list[Performance | Samples]:
        """Make the next chunk of each row; where an action ends, turn to the next one."""
        ended = [samples for part in rows if part.is_cut for samples in self._cut(part)]
        running = [self._drawn(part) for part in _joined(part for part in rows if not part.is_cut)]
        if not running:
            return [*ended]
        waiting = unencoded(part.context for part in running)
        if waiting:
            with self._costs.timed("encode", sum(map(len, waiting))):
                self._runner.encode(waiting)
        drawn = np.concatenate([part.noise for part in running if part.noise is not None])
        with self._costs.timed("step", len(drawn)):
            parts = [(part.context, len(part)) for part in running]
            outputs = self._runner.run("decoder", {"noise": drawn}, parts)
        after: list[Performance | Samples] = [*ended]
        start = 0
        for part in running:
            end = start + len(part)
            after += self._continued(part, {name: t[start:end] for name, t in outputs.items()})
            start = end
        return after

    def _continued(self, part: Performance, outputs: Tensors) -> list[Performance | Samples]:
        """The samples with their next chunk; those whose action it ends, before the next action."""
        before, longest = part.num_made, part.request.max_frames or self._manifest.horizon
        # A copy: what the graph gave holds the rows of every request.
        chunk = outputs["future"][:, : longest - before].copy()
        state = {
            name.removeprefix(NEXT): values
            for name, values in outputs.items()
            if name.startswith(NEXT)
        }
        # What was for the encoder alone would be copied with these rows wherever they part.
        kept = gathered(self._asked, [(part.context, len(part))])
        part = replace(
            part,
            turns_left=part.turns_left - 1,
            steps_run=part.steps_run + 1,
            chunks=(*part.chunks, chunk),
            context=Context(tensors=kept | state, encoded=True),
        )
        rest = self._rests(part, before, outputs.get(EARLIEST_END))
        is_over = (rest >= 0) | (part.num_made >= longest)
        after: list[Performance | Samples] = []
        if not is_over.all():
            after.append(part.part(np.flatnonzero(~is_over)))
        if is_over.any():
            after += self._turned(part, np.flatnonzero(is_over), rest)
        return after

    def _rests(
        self,
        part: Performance,
        before: int,
        earliest_end: Float[np.ndarray, "n 1"] | None,
    ) -> Int64[np.ndarray, "n"]:
        """The frame of this action at which each sample comes to rest in the last chunk, or -1."""
        spec, window = self._spec, self._spec.stop_window
        shortest = np.full(len(part), spec.min_frames)
        if earliest_end is not None:
            shortest = np.maximum(shortest, earliest_end[:, 0].astype(np.int64))
        # Windows that ended before this chunk were judged with the chunk before.
        start = np.maximum(shortest, before - window + 2) - 1
        skipped, chunks = 0, part.chunks
        while len(chunks) > 1 and skipped + chunks[0].shape[1] <= before - window + 1:
            skipped, chunks = skipped + chunks[0].shape[1], chunks[1:]
        rest = rest_frames(
            chunks[0] if len(chunks) == 1 else np.concatenate(chunks, axis=1),
            start=start - skipped,
            window=window,
            threshold_m=part.request.stop_threshold_m or spec.stop_threshold_m,
        )
        return np.where(rest < 0, rest, rest + skipped)

    def _turned(
        self,
        part: Performance,
        rows: Int64[np.ndarray, "m"],
        rest: Int64[np.ndarray, "n"],
    ) -> list[Performance | Samples]:
        """Samples whose action has just ended, before the next one; after the last, whole."""
        found = [
            part.ended(row, part.num_made if frame < 0 else frame + 1, stopped=frame >= 0)
            for row, frame in zip(rows.tolist(), rest[rows].tolist(), strict=True)
        ]
        actions = part.request.actions[part.actions_ended + 1 :]
        if not actions:
            return [
                self._whole(part, row, *one, stopped_by="end")
                for row, one in zip(rows.tolist(), found, strict=True)
            ]
        seen = np.stack([frames[-self._manifest.num_observed :] for frames, _ in found])
        following = replace(
            part,
            sample_indices=part.sample_indices[rows],
            steps_run=part.steps_run[rows],
            turns_left=self._turns(part.request, num_actions=len(actions)),
            context=_before(seen, action=actions[0]),
            past=tuple(frames for frames, _ in found),
            segments=tuple(segments for _, segments in found),
            chunks=(),
            noise=None,
        )
        return [following]

    def _cut(self, part: Performance) -> list[Samples]:
        """Samples that were cut: their action stops with the frames so far."""
        return [
            self._whole(part, row, *part.so_far(row), stopped_by="deadline")
            for row in range(len(part))
        ]

    def _whole(
        self,
        part: Performance,
        row: int,
        frames: Float[np.ndarray, "F J 3"],
        segments: tuple[Segment, ...],
        *,
        stopped_by: StoppedBy,
    ) -> Samples:
        return Samples(
            request_id=part.request_id,
            sample_indices=part.sample_indices[row : row + 1],
            futures=frames[None, self._manifest.num_observed :],
            steps_run=int(part.steps_run[row]),
            stopped_by=stopped_by,
            segments=(segments,),
        )

    def _turns(self, request: Request, *, num_actions: int) -> int:
        """The chunks of so many actions at their longest."""
        longest = request.max_frames or self._manifest.horizon
        return num_actions * -(-longest // self._spec.chunk_frames)

    def _drawn(self, part: Performance) -> Performance:
        """The samples with noise for their present action."""
        if part.noise is not None:
            return part
        drawn = noise(
            self._manifest.x_t_shape,
            seed=part.request.seed,
            sample_indices=part.sample_indices.tolist(),
            draw=part.actions_ended,
        )
        context = part.context
        if self._encoder_draws:
            each = joined([(context, len(part))])
            context = Context(tensors=each.tensors | {"noise": drawn})
        return replace(part, noise=drawn, context=context)


def _before(observation: Float[np.ndarray, "B T J 3"], *, action: int) -> Context:
    """What is known of rows before they begin an action."""
    return Context(
        tensors={"observation": observation, "action": np.full(len(observation), action)}
    )


def _joined(rows: Iterable[Performance]) -> list[Performance]:
    """The same samples, those at the same chunk of the same action of a request as one."""

    def state(part: Performance) -> tuple[int, int, int, bool]:
        return part.request_id, part.actions_ended, part.num_made, part.context.encoded

    groups = [list(parts) for _, parts in groupby(sorted(rows, key=state), state)]
    return [_one(parts) for parts in groups]


def _one(parts: Sequence[Performance]) -> Performance:
    first = parts[0]
    if len(parts) == 1:
        return first
    drawn = [part.noise for part in parts if part.noise is not None]
    is_shared = all(part.context is first.context for part in parts)
    return replace(
        first,
        sample_indices=np.concatenate([part.sample_indices for part in parts]),
        context=first.context
        if is_shared
        else joined([(part.context, len(part)) for part in parts]),
        past=tuple(past for part in parts for past in part.past),
        segments=tuple(segments for part in parts for segments in part.segments),
        steps_run=np.concatenate([part.steps_run for part in parts]),
        chunks=tuple(map(np.concatenate, zip(*(part.chunks for part in parts), strict=True))),
        noise=np.concatenate(drawn) if drawn else None,
    )
