"""The state of one sample on its way from noise to a future, and what goes into and out of it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Request:
    """An observation in the bundle's skeleton, rate and metres, and how to continue it.

    ``num_steps`` of the bundle's K denoising steps are run; None runs them all.
    """

    observation: Float[np.ndarray, "T J 3"]
    num_samples: int = 1
    num_steps: int | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Result:
    """N futures of a request, in metres in the world of its observation."""

    request_id: int
    futures: Float[np.ndarray, "N H J 3"]
    steps_run: int
    steps_of: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Failure:
    """A request that could not be computed, and why."""

    request_id: int
    error: Exception


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Trajectory:
    """One sample of one request: its x at the next timestep to run.

    ``steps_run`` of ``num_steps`` are behind it; after the last, ``x_t`` holds x0.
    """

    request_id: int
    sample_index: int
    num_steps: int
    x_t: Float[np.ndarray, "..."]
    steps_run: int = 0

    @property
    def finished(self) -> bool:
        """Whether every step has run."""
        return self.steps_run == self.num_steps

    def advanced(self, x_t: Float[np.ndarray, "..."]) -> "Trajectory":
        """The same sample one step later."""
        return Trajectory(
            request_id=self.request_id,
            sample_index=self.sample_index,
            num_steps=self.num_steps,
            x_t=x_t,
            steps_run=self.steps_run + 1,
        )
