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
    shape: tuple[int, ...], *, schedule: Schedule, seed: int, sample_indices: Sequence[int]
) -> Float[np.ndarray, "S ..."]:
    """x at the noisiest timestep; a schedule's N directions lie along the first axis of x_t."""
    scale = schedule.variance[-1].reshape(-1, *[1] * (len(shape) - 1)) ** 0.5
    drawn = noise(shape, seed=seed, sample_indices=sample_indices, draw=0)
    return np.asarray(scale * drawn, np.float32)


def x_next(
    x_t: Float[np.ndarray, "B ..."],
    x0: Float[np.ndarray, "B ..."],
    *,
    timestep: Int64[np.ndarray, "B"],
    schedule: Schedule,
    eta: float,
    noise: Float[np.ndarray, "..."],
) -> Float[np.ndarray, "B ..."]:
    """x at each row's next, less noisy timestep; the step is taken in float64."""
    # Entry 0 is the clean end, where the step after timestep 0 arrives.
    alpha_bar = np.concatenate([[1.0], schedule.alpha_bar])
    variance = np.concatenate([np.zeros_like(schedule.variance[:1]), schedule.variance])
    ones = (1,) * (x_t.ndim - 2)
    x = ddim_step(
        x_t=x_t,
        x0=x0,
        alpha_bar=alpha_bar[timestep + 1].reshape(-1, 1, *ones),
        variance=variance[timestep + 1].reshape(len(timestep), -1, *ones),
        alpha_bar_next=alpha_bar[timestep].reshape(-1, 1, *ones),
        variance_next=variance[timestep].reshape(len(timestep), -1, *ones),
        eta=eta,
        noise=noise,
    )
    return np.asarray(x, np.float32)
