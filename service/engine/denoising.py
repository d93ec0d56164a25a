"""Progress by denoising: step after step towards x0, which is then decoded."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from models.diffusion import Schedule, timesteps
from service.engine.context import Context
from service.engine.runner import Runner
from service.engine.sampling import noise, x_first, x_next
from service.engine.trajectory import Request, Sample


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Denoising:
    """One sample of one request: its x at the next timestep to run.

    ``steps_run`` of the timesteps are behind it; after the last, ``x_t`` holds x0.
    """

    request_id: int
    sample_index: int
    seed: int
    context: Context
    timesteps: tuple[int, ...]
    x_t: Float[np.ndarray, "..."]
    steps_run: int = 0

    @property
    def finished(self) -> bool:
        """Whether every step has run."""
        return self.steps_run == len(self.timesteps)

    def advanced(self, x_t: Float[np.ndarray, "..."]) -> "Denoising":
        """The same sample one step later."""
        return replace(self, x_t=x_t, steps_run=self.steps_run + 1)


class Denoiser:
    """The progress of a bundle that denoises; without a denoiser there is nothing but to decode."""

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self._manifest = runner.manifest
        spec = runner.manifest.schedule
        self._schedule = spec.schedule() if spec else None
        self._eta = spec.eta if spec else 0.0

    def start(self, request_id: int, request: Request) -> list[Denoising]:
        """Noise for every sample; where nothing is drawn, one row that has no step to run."""
        steps: tuple[int, ...] = ()
        x = np.zeros((1, 1), np.float32)
        if self._schedule is not None:
            num_steps = self._manifest.num_steps
            steps = timesteps(num_steps, request.num_steps or num_steps)
            x = x_first(
                self._manifest.x_t_shape,
                schedule=self._schedule,
                seed=request.seed,
                sample_indices=range(request.num_samples),
            )
        context = Context(tensors={"observation": request.observation[None]})
        return [
            Denoising(
                request_id=request_id,
                sample_index=sample_index,
                seed=request.seed,
                context=context,
                timesteps=steps,
                x_t=x_t,
            )
            for sample_index, x_t in enumerate(x)
        ]

    def advance(self, rows: Sequence[Denoising]) -> list[Denoising | Sample]:
        """Run one timestep of each row, and decode those that have no more to run."""
        self._runner.encode([row.context for row in rows])
        advanced = rows if self._schedule is None else self._denoised(rows, self._schedule)
        under_way = [row for row in advanced if not row.finished]
        return [*under_way, *self._decoded([row for row in advanced if row.finished])]

    def _denoised(self, rows: Sequence[Denoising], schedule: Schedule) -> list[Denoising]:
        contexts = [row.context for row in rows]
        steps = np.array([row.timesteps[row.steps_run] for row in rows])
        x_t = np.stack([row.x_t for row in rows])
        x0 = self._runner.run("denoiser", {"x_t": x_t, "timestep": steps}, contexts)["x0"]
        following = x_next(
            x_t, x0, timestep=steps, schedule=schedule, eta=self._eta, noise=self._draw(rows)
        )
        # The answer of a row is the x0 of the last step that it runs, early stop or not.
        return [
            row.advanced(x0[i] if row.steps_run + 1 == len(row.timesteps) else following[i])
            for i, row in enumerate(rows)
        ]

    def _draw(self, rows: Sequence[Denoising]) -> Float[np.ndarray, "..."]:
        if self._eta == 0.0:
            return np.zeros(1, np.float32)
        draws = [
            noise(
                row.x_t.shape,
                seed=row.seed,
                sample_indices=(row.sample_index,),
                draw=row.steps_run + 1,
            )
            for row in rows
        ]
        return np.concatenate(draws)

    def _decoded(self, rows: Sequence[Denoising]) -> list[Sample]:
        if not rows:
            return []
        x0 = np.stack([row.x_t for row in rows])
        futures = self._runner.run("decoder", {"x0": x0}, [row.context for row in rows])["future"]
        return [
            Sample(request_id=row.request_id, sample_index=row.sample_index, future=future)
            for row, future in zip(rows, futures, strict=True)
        ]
