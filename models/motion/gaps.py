"""Positions with holes, at uneven times or of uneven worth, as whole motions at an even rate."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from models.motion.motion import Motion
from models.motion.trees import without_joints

MIN_CONFIDENCE = 0.3  # below, a joint counts as not seen
STIFFNESS = 0.1  # of `steadied`, at 30 frames per second
NEAR_S = 1e-6  # of a moment: a frame is taken as it is


def filled(
    positions: Float[np.ndarray, "T J 3"],
    times: Float[np.ndarray, "T"],
    parents: Sequence[int],
) -> Float[np.ndarray, "T J 3"]:
    """The positions, NaN where unseen, with their gaps in time closed; what was never seen stays.

    Each joint is carried by its parent: what is filled on a line between neighbours in time, and
    held before the first and after the last, is its place beside the parent. A joint without one
    is carried by the middle of all joints that were always seen.
    """
    result = positions.copy()
    seen = np.isfinite(positions[:, :, 0])  # (T, J)
    always = seen.all(axis=0)
    middle = positions[:, always].mean(axis=1) if always.any() else np.zeros((len(positions), 3))
    for joint, parent in enumerate(parents):
        present = seen[:, joint]
        if present.all() or not present.any():
            continue
        whole = parent >= 0 and np.isfinite(result[:, parent]).all()
        carrier = result[:, parent] if whole else middle
        beside = positions[:, joint] - carrier
        result[:, joint] = carrier + _interpolated(times, times[present], beside[present])
    return result


def at_even_times(
    values: Float[np.ndarray, "T *rest"], times: Float[np.ndarray, "T"], fps: float
) -> Float[np.ndarray, "N *rest"]:
    """Values, such as positions, at an even rate that ends at the last of rising times.

    A frame that is there at such a moment is taken as it is; the others lie on lines between
    neighbours. The first one may be half a frame before the first time.
    """
    count = num_even(float(times[-1] - times[0]), fps)
    even = times[-1] - np.arange(count)[::-1] / fps
    nearest = times[np.searchsorted(times, even - NEAR_S)]
    even = np.where(np.abs(nearest - even) <= NEAR_S, nearest, even)
    flat = values.reshape(len(values), -1)
    return _interpolated(even, times, flat).reshape(count, *values.shape[1:])


def num_even(seconds: float, fps: float) -> int:
    """How many frames `at_even_times` makes of times that span so many seconds."""
    return int(np.floor(seconds * fps + 0.5)) + 1


def even_rate(times: Float[np.ndarray, "T"]) -> float:
    """The frames per second of most of the steps between rising times."""
    return float(1.0 / np.median(np.diff(times)))


def steadied(
    positions: Float[np.ndarray, "T J 3"], confidence: Float[np.ndarray, "T J"], fps: float
) -> Float[np.ndarray, "T J 3"]:
    """Positions that bend the less the less they are trusted (Whittaker 1923).

    They minimise sum w |z - x|^2 + s sum |second difference of z|^2 with the weights w of the
    confidence c, c / (1.02 - c); what is sure moves by next to nothing.
    """
    bend = np.diff(np.eye(len(positions)), n=2, axis=0)  # (T - 2, T)
    stiffness = STIFFNESS * (fps / 30.0) ** 4 * bend.T @ bend
    weights = np.maximum(confidence / (1.02 - confidence), 1e-3).T  # (J, T)
    system = weights[:, :, None] * np.eye(len(positions)) + stiffness
    wanted = weights[:, :, None] * np.moveaxis(positions, 1, 0)  # (J, T, 3)
    return np.moveaxis(np.linalg.solve(system, wanted), 0, 1)


def trusted(confidence: Float[np.ndarray, "T J"]) -> Bool[np.ndarray, "T J"]:
    """Where joints are worth using; for one that never is, everywhere: better than nothing."""
    enough = confidence >= MIN_CONFIDENCE
    return enough | ~enough.any(axis=0)


def _interpolated(
    at: Float[np.ndarray, "N"], times: Float[np.ndarray, "P"], values: Float[np.ndarray, "P D"]
) -> Float[np.ndarray, "N D"]:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=-1)


def without_gaps(motion: Motion) -> Motion:
    """The motion with its gaps closed as by `filled`; joints that were never seen are left out."""
    seen = np.isfinite(motion.positions[:, :, 0])
    if seen.all():
        return motion
    ever = seen.any(axis=0)
    skeleton = without_joints(motion.skeleton, ever)
    times = np.arange(motion.num_frames) / motion.fps
    whole = filled(motion.positions[:, ever], times, skeleton.parents)
    return Motion(name=motion.name, skeleton=skeleton, positions=whole, fps=motion.fps)
