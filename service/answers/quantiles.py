"""Where each joint will be at each frame: balls that hold it as often as their level says."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from models.bundle import CalibrationSpec
from service.errors import FieldError

DEFAULT_LEVELS = (0.5, 0.9)
MIN_SAMPLES = 10


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Regions:
    """Balls about one centre, in metres; ball l of a joint and frame holds it at ``levels[l]``.

    Only if ``calibrated`` has it been measured that they do; else they hold as many samples.
    """

    levels: tuple[float, ...]
    centre: Float[np.ndarray, "H J 3"]
    radius: Float[np.ndarray, "L H J"]
    calibrated: bool


def check_levels(
    levels: Sequence[float], *, num_samples: int, calibration: CalibrationSpec | None
) -> None:
    """Refuses what `regions` could not answer, before anything is computed.

    Raises:
        FieldError: there are too few samples, or a level that the bundle was not measured at.
    """
    if num_samples < MIN_SAMPLES:
        raise FieldError(
            pointer="/num_samples",
            found=str(num_samples),
            expected=f"must be at least {MIN_SAMPLES} for quantiles",
        )
    for index, level in enumerate(levels):
        known = calibration.levels if calibration else ()
        if known and level not in known:
            raise FieldError(
                pointer=f"/quantile_levels/{index}",
                found=f"{level:g}",
                expected=f"must be one of {', '.join(f'{one:g}' for one in known)}",
            )


def regions(
    futures: Float[np.ndarray, "N H J 3"],
    *,
    fps: float,
    calibration: CalibrationSpec | None,
    levels: Sequence[float] = DEFAULT_LEVELS,
) -> Regions:
    """Balls about the mean of the samples, as wide as the samples and the calibration say.

    Args:
        futures: at least `MIN_SAMPLES`, in metres, from the frame after the last one observed.
        fps: of the futures.
        calibration: of the bundle; beyond its times the factors of the last one hold.
        levels: between 0 and 1; of those of the calibration where there is one.

    Raises:
        FieldError: there are too few samples, or a level that the bundle was not measured at.
    """
    check_levels(levels, num_samples=len(futures), calibration=calibration)
    samples = futures.astype(np.float64)
    count, centre = len(samples), samples.mean(axis=0)
    # As far as each is from the mean of the others: the truth has no share in the mean either.
    away = count / (count - 1) * np.linalg.norm(samples - centre, axis=-1)  # (N, H, J)
    ranks = np.ceil(np.multiply(levels, count + 1)).astype(int)
    radius = np.sort(away, axis=0)[np.minimum(ranks, count) - 1]
    if calibration is not None:
        factors = widening(calibration, levels, num_frames=len(centre), fps=fps)
        radius *= factors[:, :, None]
    return Regions(
        levels=tuple(levels),
        centre=centre,
        radius=radius,
        calibrated=calibration is not None,
    )


def widening(
    calibration: CalibrationSpec, levels: Sequence[float], *, num_frames: int, fps: float
) -> Float[np.ndarray, "L H"]:
    """What multiplies the radius of each level and frame."""
    times = np.arange(1, num_frames + 1) / fps
    return np.stack([calibration.at(level, times) for level in levels])
