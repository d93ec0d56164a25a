"""Progress by denoising: step after step towards x0, which is then decoded."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Float, Shaped

from service.engine.context import Context, unencoded
from service.engine.costs import Costs
from service.engine.runner import Runner
from service.engine.sampling import Stepper, noise, x_first
from service.engine.trajectory import Request, Samples, Shown, StoppedBy


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Denoising:
    """Samples of one request at the same step of the same leg.

    ``past`` has the frames of the legs before. Of this one's timesteps ``steps_run`` are behind it;
    before the first there is no ``x_t``, and ``x0`` is that of the last. ``future`` is what was
    decoded from it, with the past, where something has asked for that.
    """

    request_id: int
    request: Request
    sample_indices: Shaped[np.ndarray, "n"]
    context: Context
    timesteps: tuple[int, ...]
    num_legs: int
    stopped_by: StoppedBy
    past: Float[np.ndarray, "n F J 3"]
    legs_run: int = 0
    steps_before: int = 0
    steps_run: int = 0
    x_t: Float[np.ndarray, "n ..."] | None = None
    x0: Float[np.ndarray, "n ..."] | None = None
    future: Float[np.ndarray, "n H J 3"] | None = None

    def __len__(self) -> int:
        """How many samples these are."""
        return len(self.sample_indices)

    @property
    def turns_left(self) -> int:
        """The steps left, of all legs."""
        return (self.num_legs - self.legs_run) * len(self.timesteps) - self.steps_run

    @property
    def steps_behind(self) -> int:
        """The steps run, of all legs."""
        return self.steps_before + self.steps_run

    @property
    def shown(self) -> list[Shown]:
        """The futures as they stand, where the request asks for previews."""
        if self.future is None or not self.request.previews:
            return []
        indices, steps = self.sample_indices, self.steps_behind
        return [Shown(sample_indices=indices, futures=self.future, steps_run=steps)]

    @property
    def now_and_next(self) -> tuple[int, int | None]:
        """The timestep whose turn it is, and the one after; None after the last."""
        following = self.timesteps[self.steps_run + 1 :]
        return self.timesteps[self.steps_run], following[0] if following else None

    @property
    def over(self) -> bool:
        """Whether the leg has no step left."""
        return self.steps_run == len(self.timesteps)

    def cut(self) -> "Denoising":
        """The same samples, which end in their next turn with what they have."""
        steps = self.timesteps[: self.steps_run]
        return replace(self, timesteps=steps, num_legs=0, stopped_by="deadline")

    def split(self, count: int) -> tuple["Denoising", "Denoising"]:
        """The first ``count`` samples, and the others."""
        return self.part(slice(0, count)), self.part(slice(count, None))

    def part(self, rows: slice | Shaped[np.ndarray, "..."]) -> "Denoising":
        """Some of the samples."""
        return replace(
            self,
            sample_indices=self.sample_indices[rows],
            context=self.context.part(rows),
            past=self.past[rows],
            x_t=None if self.x_t is None else self.x_t[rows],
            x0=None if self.x0 is None else self.x0[rows],
            future=None if self.future is None else self.future[rows],
        )


class Denoiser:
    """The progress of a bundle that denoises; without a denoiser there is nothing but to decode."""

    def __init__(self, runner: Runner, costs: Costs) -> None:
        self._runner = runner
        self._costs = costs
        self._manifest = runner.manifest
        spec = runner.manifest.schedule
        self._schedule = spec.schedule() if spec else None
        self._stepper = Stepper(spec.schedule(), eta=spec.eta) if spec else None
        self._draws = spec is not None and spec.eta > 0.0

    def steps_of(self, request: Request) -> int:
        """The steps of all its legs."""
        legs = -(-(request.horizon or self._manifest.horizon) // self._manifest.horizon)
        return legs * self._manifest.chain_steps(request.num_steps)

    def start(self, request_id: int, request: Request) -> list[Denoising]:
        """All samples before their first step; where nothing is drawn, a single one."""
        manifest = self._manifest
        num_samples = request.num_samples if self._schedule else 1
        steps = manifest.timesteps(request.num_steps)
        wanted = min(manifest.default_steps, manifest.chain_steps(request.num_steps))
        horizon = request.horizon or manifest.horizon
        parts = Denoising(
            request_id=request_id,
            request=request,
            sample_indices=np.arange(num_samples),
            context=Context(tensors={"observation": request.observation[None]}),
            timesteps=steps,
            num_legs=-(-horizon // manifest.horizon),
            stopped_by="end" if len(steps) >= wanted else "num_steps",
            past=np.empty((num_samples, 0, len(manifest.skeleton.joints), 3), np.float32),
        )
        return [parts]

    def advance(self, rows: Sequence[Denoising]) -> list[Denoising | Samples]:
        """Run one timestep of each row; those at the end of their last leg are samples."""
        running = _joined(part for part in rows if not part.over)
        stepped = [*self._stepped(running), *(part for part in rows if part.over)]
        looked_at = [part for part in stepped if _is_looked_at(part)]
        futures = self._futures(looked_at)
        return [
            later
            for part in stepped
            for later in (self._judged(part, next(futures)) if _is_looked_at(part) else (part,))
        ]

    def _stepped(self, rows: Sequence[Denoising]) -> list[Denoising]:
        if not rows:
            return []
        drawn = [self._x_first(part) if part.x_t is None else part.x_t for part in rows]
        self._encode(rows)
        with self._costs.timed("step", sum(map(len, rows))):
            x_t = _whole(drawn)
            x0, following = (
                (x_t, x_t) if self._stepper is None else self._denoised(rows, x_t, self._stepper)
            )
        after: list[Denoising] = []
        start = 0
        for part in rows:
            rows_of_it = slice(start, start + len(part))
            start += len(part)
            after.append(
                replace(
                    part,
                    steps_run=part.steps_run + 1,
                    x_t=following[rows_of_it],
                    x0=x0[rows_of_it],
                )
            )
        return after

    def _encode(self, rows: Sequence[Denoising]) -> None:
        waiting = unencoded(part.context for part in rows)
        if waiting:
            with self._costs.timed("encode", sum(map(len, waiting))):
                self._runner.encode(waiting)

    def _x_first(self, part: Denoising) -> Float[np.ndarray, "n ..."]:
        if self._schedule is None:
            return np.zeros((len(part), 1), np.float32)
        return x_first(
            self._manifest.x_t_shape,
            schedule=self._schedule,
            seed=part.request.seed,
            sample_indices=part.sample_indices.tolist(),
            draw=self._first_draw(part),
        )

    def _first_draw(self, part: Denoising) -> int:
        return part.legs_run * (self._manifest.num_steps + 1)

    def _denoised(
        self, rows: Sequence[Denoising], x_t: Float[np.ndarray, "B ..."], stepper: Stepper
    ) -> tuple[Float[np.ndarray, "B ..."], Float[np.ndarray, "B ..."]]:
        """x0 as it is expected now, and x at the next timestep."""
        counts = [len(part) for part in rows]
        steps = np.repeat([part.timesteps[part.steps_run] for part in rows], counts)
        parts = [(part.context, len(part)) for part in rows]
        x0 = self._runner.run("denoiser", {"x_t": x_t, "timestep": steps}, parts)["x0"]
        drawn = self._draw(rows) if self._draws else None
        weights = np.repeat([stepper.weights(*part.now_and_next) for part in rows], counts, axis=0)
        return x0, stepper.x_next(x_t, x0, weights=weights, noise=drawn)

    def _draw(self, rows: Sequence[Denoising]) -> Float[np.ndarray, "B ..."]:
        draws = [
            noise(
                self._manifest.x_t_shape,
                seed=part.request.seed,
                sample_indices=part.sample_indices.tolist(),
                draw=self._first_draw(part) + part.steps_run + 1,
            )
            for part in rows
        ]
        return np.concatenate(draws)

    def _futures(self, rows: Sequence[Denoising]) -> Iterator[Float[np.ndarray, "n H J 3"]]:
        """What each part's x0 is decoded to, after its past; of one without an x0 that alone."""
        decoded = [part for part in rows if part.x0 is not None]
        futures: Float[np.ndarray, "B H J 3"] | None = None
        if decoded:
            parts = [(part.context, len(part)) for part in decoded]
            x0 = _whole([part.x0 for part in decoded if part.x0 is not None])
            with self._costs.timed("decode", len(x0)):
                futures = self._runner.run("decoder", {"x0": x0}, parts)["future"]
        start = 0
        for part in rows:
            if part.x0 is None or futures is None:
                yield part.past
            else:
                end = start + len(part)
                made = futures[start:end]
                yield np.concatenate([part.past, made], axis=1) if part.legs_run else made
                start = end

    def _judged(
        self, part: Denoising, future: Float[np.ndarray, "n H J 3"]
    ) -> list[Denoising | Samples]:
        """What becomes of samples whose future has been looked at."""
        tolerance_m, before = part.request.tolerance_m, part.future
        if part.over:
            return [self._leg_ended(part, future)]
        seen = replace(part, future=future)
        if tolerance_m is None or before is None or part.steps_run == 1:
            return [seen]
        moved_m = np.linalg.norm(future - before, axis=-1).max(axis=(1, 2))
        is_settled = moved_m < tolerance_m
        settled, unsettled = np.flatnonzero(is_settled), np.flatnonzero(~is_settled)
        judged: list[Denoising | Samples] = [seen.part(unsettled)] if len(unsettled) else []
        if len(settled):
            ended = replace(seen.part(settled), stopped_by="tolerance")
            judged.append(self._leg_ended(ended, future[settled]))
        return judged

    def _leg_ended(
        self, part: Denoising, future: Float[np.ndarray, "n H J 3"]
    ) -> Denoising | Samples:
        """The samples at the start of their next leg, or whole."""
        if part.legs_run + 1 >= part.num_legs:
            return Samples(
                request_id=part.request_id,
                sample_indices=part.sample_indices,
                futures=future[:, : part.request.horizon],
                steps_run=part.steps_behind,
                stopped_by=part.stopped_by,
            )
        observed = np.repeat(part.request.observation[None], len(part), axis=0)
        frames = np.concatenate([observed, future], axis=1)
        last = np.ascontiguousarray(frames[:, -self._manifest.num_observed :])
        return replace(
            part,
            context=Context(tensors={"observation": last}),
            past=future,
            future=future,
            legs_run=part.legs_run + 1,
            steps_before=part.steps_behind,
            steps_run=0,
            x_t=None,
            x0=None,
        )


def _is_looked_at(part: Denoising) -> bool:
    """Whether the futures of samples that have just advanced are decoded."""
    return part.over or part.request.previews or part.request.tolerance_m is not None


def _joined(rows: Iterable[Denoising]) -> list[Denoising]:
    """The same samples, those that follow each other at the same step as one."""

    def state(part: Denoising) -> tuple[int, int, int]:
        return part.request_id, id(part.context), part.steps_run

    return [_one(list(parts)) for _, parts in groupby(rows, state)]


def _one(parts: Sequence[Denoising]) -> Denoising:
    first = parts[0]
    if len(parts) == 1:
        return first
    return replace(
        first,
        sample_indices=_whole([part.sample_indices for part in parts]),
        past=_whole([part.past for part in parts]),
        x_t=None if first.x_t is None else _whole([p.x_t for p in parts if p.x_t is not None]),
        x0=None if first.x0 is None else _whole([p.x0 for p in parts if p.x0 is not None]),
        future=None
        if first.future is None
        else _whole([p.future for p in parts if p.future is not None]),
    )


def _whole(arrays: Sequence[Shaped[np.ndarray, "..."]]) -> Shaped[np.ndarray, "B ..."]:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
