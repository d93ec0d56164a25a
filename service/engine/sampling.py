"""The arithmetic of a row: its noise, its x at the first timestep, and its x at the next one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int64

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
        # Entry 0 is the clean end, where the step after timestep 0 arrives.
        alpha_bar = np.concatenate([[1.0], schedule.alpha_bar])[:, None]
        variance = np.concatenate([np.zeros_like(schedule.variance[:1]), schedule.variance])

        def weight(**one: float) -> Float[np.ndarray, "K N"]:
            """What the step makes of 1 in the place of one of the three, and 0 for the others."""
            made: Float[np.ndarray, "K N"] = ddim_step(
                **({"x_t": 0.0, "x0": 0.0, "noise": 0.0} | one),
                alpha_bar=alpha_bar[1:],
                variance=variance[1:],
                alpha_bar_next=alpha_bar[:-1],
                variance_next=variance[:-1],
                eta=eta,
            )
            return made

        self._of_x_t, self._of_x0, self._of_noise = (
            weight(x_t=1.0),
            weight(x0=1.0),
            weight(noise=1.0),
        )

    def x_next(
        self,
        x_t: Float[np.ndarray, "B ..."],
        x0: Float[np.ndarray, "B ..."],
        *,
        timestep: Int64[np.ndarray, "B"],
        noise: Float[np.ndarray, "B ..."] | None,
    ) -> Float[np.ndarray, "B ..."]:
        """x at each row's next, less noisy timestep; the step is taken in float64."""
        shape = (len(x_t), -1, *(1,) * (x_t.ndim - 2))
        x = self._of_x_t[timestep].reshape(shape) * x_t
        x += self._of_x0[timestep].reshape(shape) * x0
        if noise is not None:
            x += self._of_noise[timestep].reshape(shape) * noise
        return np.asarray(x, np.float32)
