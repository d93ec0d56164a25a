"""Diffusion arithmetic: schedules, the forward process and the one reverse step.

Everything is written in operators that numpy arrays and torch tensors share, so that training and
serving run the same lines. A schedule is two tables over the timesteps 0 (least noise) to K - 1:
``alpha_bar (K,)`` and ``variance (K, N)``, the variance of the noise in each of N directions (N = 1
and ``variance = 1 - alpha_bar`` when the noise is isotropic).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

Plan: TypeAlias = Literal["stop_early", "stride"]
"""Which timesteps fewer steps take: the noisiest ones, or some evenly spread over the chain."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Schedule:
    """Cumulative signal and noise tables of a diffusion process of K timesteps."""

    alpha_bar: Float[np.ndarray, "K"]
    variance: Float[np.ndarray, "K N"]

    def __post_init__(self) -> None:
        """Refuse tables that no diffusion process can have."""
        if self.alpha_bar.shape[0] != self.variance.shape[0]:
            raise ValueError(
                f"schedule: found {self.alpha_bar.shape[0]} alpha_bar and "
                f"{self.variance.shape[0]} variance rows; both need one row per timestep."
            )
        falling = bool(np.all(np.diff(self.alpha_bar) < 0))
        if not falling or self.alpha_bar.min() < 0 or self.alpha_bar.max() > 1:
            raise ValueError("schedule.alpha_bar: must fall strictly within [0, 1].")
        if not np.all(self.variance > 0):
            raise ValueError("schedule.variance: found a value <= 0; noise needs a positive one.")

    @property
    def num_steps(self) -> int:
        """K, the number of timesteps."""
        return int(self.alpha_bar.shape[0])


def isotropic(alpha_bar: Float[np.ndarray, "K"]) -> Schedule:
    """Schedule whose noise has the variance 1 - alpha_bar in every direction."""
    return Schedule(alpha_bar=alpha_bar, variance=(1.0 - alpha_bar)[:, None])


def linear_schedule(
    num_steps: int, *, beta_start: float = 1e-4, beta_end: float = 0.05
) -> Schedule:
    """Betas that rise linearly (Ho et al. 2020, section 4)."""
    return isotropic(np.cumprod(1.0 - np.linspace(beta_start, beta_end, num_steps)))


def cosine_schedule(num_steps: int, *, s: float = 0.008) -> Schedule:
    """Squared-cosine alpha_bar (Nichol and Dhariwal 2021, eq. 17)."""
    return _from_alpha_bar_of(num_steps, lambda u: math.cos((u + s) / (1 + s) * math.pi / 2) ** 2)


def sqrt_schedule(num_steps: int, *, s: float = 1e-4) -> Schedule:
    """alpha_bar = 1 - sqrt(t / T + s) (Li et al. 2022, appendix A), which BeLFusion uses."""
    return _from_alpha_bar_of(num_steps, lambda u: max(0.0, 1.0 - math.sqrt(u + s)))


def _from_alpha_bar_of(num_steps: int, alpha_bar_of: Callable[[float], float]) -> Schedule:
    # The papers tabulate betas from ratios of alpha_bar and cap them at .999, so the table starts
    # from alpha_bar(1 / K) / alpha_bar(0) and never reaches zero.
    edges = [alpha_bar_of(i / num_steps) for i in range(num_steps + 1)]
    ratios = [max(edges[i + 1] / max(edges[i], 1e-5), 0.001) for i in range(num_steps)]
    return isotropic(np.cumprod(np.asarray(ratios)))


def timesteps(num_timesteps: int, num_steps: int, *, plan: Plan = "stop_early") -> tuple[int, ...]:
    """The timesteps of so many steps, from the noisiest, num_timesteps - 1, downwards.

    Stopping early takes the first of them all; the x0 of the last step that ran is the answer
    (Barquero et al. 2023, section 4.3). A stride spreads the steps evenly over the chain, ends of
    equal parts of it (Lin et al. 2024, table 2, "trailing").

    Raises:
        ValueError: num_steps is not within 1 and num_timesteps.
    """
    if not 1 <= num_steps <= num_timesteps:
        raise ValueError(f"num_steps: found {num_steps}; must be from 1 to {num_timesteps}.")
    if plan == "stride":
        return tuple(-(-num_timesteps * k // num_steps) - 1 for k in range(num_steps, 0, -1))
    return tuple(range(num_timesteps - 1, num_timesteps - 1 - num_steps, -1))


def q_sample(*, x0: Any, noise: Any, alpha_bar: Any, variance: Any) -> Any:
    """x_t drawn from the forward process: sqrt(alpha_bar) x0 + sqrt(variance) noise (eq. 4)."""
    return alpha_bar**0.5 * x0 + variance**0.5 * noise


def ddim_step(  # noqa: PLR0913 - the seven symbols of the equation
    *,
    x_t: Any,
    x0: Any,
    alpha_bar: Any,
    variance: Any,
    alpha_bar_next: Any,
    variance_next: Any,
    eta: float = 0.0,
    noise: Any = 0.0,
) -> Any:
    """x at the next, less noisy timestep, from x_t and x0 (Song et al. 2021, eq. 12).

    eta = 0 is DDIM and ignores the noise; eta = 1 is the posterior of DDPM, isotropic or, with one
    variance for each direction, nonisotropic (Curreli et al. 2025, eq. 7). After timestep 0 pass
    ``alpha_bar_next = 1`` and ``variance_next = 0``, which returns x0. All tables broadcast
    against x_t, so rows may stand at different timesteps.
    """
    eps = (x_t - alpha_bar**0.5 * x0) / variance**0.5
    posterior = variance_next / variance * (variance - alpha_bar / alpha_bar_next * variance_next)
    direction = (variance_next - eta**2 * posterior) ** 0.5 * eps
    return alpha_bar_next**0.5 * x0 + direction + eta * posterior**0.5 * noise
