"""The arithmetic of a row: its noise, its x at the first timestep, and its x at the next one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from models.diffusion import Schedule, ddim_step


def noise(
    shape: tuple[int, ...], *, seed: int, sample_indices: Sequence[int], draw: int
) -> Float[np.ndarray, "S ..."]:
    """Standard normal noise that depends on nothing but the seed, the sample and the draw.

    Draw 0 starts the sample, draw k feeds the k-th stochastic step. Each sample is a Philox stream
    of its own, so the first k of N samples are those of a request for k.
    """
    bits = np.random.Philox(key=[seed, 0], counter=[0, 0, 0, draw])
    generator, state = np.random.Generator(bits), bits.state
    rows = np.empty((len(sample_indices), *shape), np.float32)
    for row, sample_index in zip(rows, sample_indices, strict=True):
        # The stream of key (seed, sample) from its start; a new generator costs ten times as much.
        state["state"]["key"][1] = sample_index
        bits.state = state
        row[...] = generator.standard_normal(shape, dtype=np.float32)
    return rows


def x_first(
    shape: tuple[int, ...],
    *,
    schedule: Schedule,
    seed: int,
    sample_indices: Sequence[int],
    draw: int = 0,
) -> Float[np.ndarray, "S ..."]:
    """x at the noisiest timestep; a schedule's N directions lie along the first axis of x_t."""
    scale = schedule.variance[-1].reshape(-1, *[1] * (len(shape) - 1)) ** 0.5
    drawn = noise(shape, seed=seed, sample_indices=sample_indices, draw=draw)
    return np.asarray(scale * drawn, np.float32)


class Stepper:
    """The step of a schedule as a sum: of x_t, of x0 and of noise, weighted by timestep."""

    def __init__(self, schedule: Schedule, *, eta: float) -> None:
        self._schedule = schedule
        self._eta = eta
        self._weights: dict[tuple[int, int | None], Float[np.ndarray, "3 N"]] = {}

    def weights(self, timestep: int, following: int | None) -> Float[np.ndarray, "3 N"]:
        """How much of x_t, of x0 and of noise the step to a timestep, or to the end, adds up."""
        if (timestep, following) not in self._weights:
            self._weights[timestep, following] = self._made(timestep, following)
        return self._weights[timestep, following]

    def _made(self, timestep: int, following: int | None) -> Float[np.ndarray, "3 N"]:
        alpha_bar, variance = self._schedule.alpha_bar, self._schedule.variance
        clean = following is None
        return np.stack(
            [
                ddim_step(
                    **dict(zip(("x_t", "x0", "noise"), one, strict=True)),
                    alpha_bar=alpha_bar[timestep],
                    variance=variance[timestep],
                    alpha_bar_next=1.0 if clean else alpha_bar[following],
                    variance_next=np.zeros_like(variance[0]) if clean else variance[following],
                    eta=self._eta,
                )
                for one in np.eye(3)
            ]
        )

    def x_next(
        self,
        x_t: Float[np.ndarray, "B ..."],
        x0: Float[np.ndarray, "B ..."],
        *,
        weights: Float[np.ndarray, "B 3 N"],
        noise: Float[np.ndarray, "B ..."] | None,
    ) -> Float[np.ndarray, "B ..."]:
        """x at each row's next, less noisy timestep; the step is taken in float64."""
        shape = (len(x_t), -1, *(1,) * (x_t.ndim - 2))
        x = weights[:, 0].reshape(shape) * x_t
        x += weights[:, 1].reshape(shape) * x0
        if noise is not None:
            x += weights[:, 2].reshape(shape) * noise
        return np.asarray(x, np.float32)
