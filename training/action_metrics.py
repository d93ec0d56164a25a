"""What futures of actions are worth, in metres: diversity and error, before and after warping.

Futures differ in length. A pose is one vector: its joints relative to its own root, the root
itself dropped, all of a future turned so that its person faced +X when last observed (Mao et al.
2022, Eqs. 10 to 12; theirs are of joint angles).
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from dtaidistance import dtw, dtw_ndim
from jaxtyping import Float, Float64

from models.motion.kinematics import rotate_yaw, yaw
from models.motion.skeleton import Skeleton

PoseVectors = Float64[np.ndarray, "_ F"]


def pose_vectors(
    now: Float[np.ndarray, "J 3"], poses: Float[np.ndarray, "L J 3"], skeleton: Skeleton
) -> PoseVectors:
    """The poses that follow the last observed one, as the vectors that are compared."""
    turned = rotate_yaw(poses.astype(np.float64), -yaw(now.astype(np.float64), skeleton))
    return np.asarray((turned[:, 1:] - turned[:, :1]).reshape(len(poses), -1))


def diversity(futures: Sequence[PoseVectors], *, longest: int) -> float:
    """Mean distance of the poses of two futures, over all pairs (Eq. 10); 0 for a single one.

    A future repeats its last pose until ``longest`` frames.
    """
    held = [_held(future, longest) for future in futures]
    return _mean([_distances(a, b).mean() for a, b in combinations(held, 2)])


def warped_diversity(futures: Sequence[PoseVectors]) -> float:
    """Mean over all pairs of their `warped_distance` (Eq. 11); 0 for a single future."""
    return _mean([warped_distance(a, b) for a, b in combinations(futures, 2)])


def displacement(samples: Sequence[PoseVectors], future: PoseVectors) -> float:
    """Mean distance to the poses of the real future, best of the samples (Eq. 12).

    A sample that is shorter repeats its last pose, one that is longer counts as far as the real.
    """
    held = [_held(sample, len(future))[: len(future)] for sample in samples]
    return float(min(_distances(sample, future).mean() for sample in held))


def warped_displacement(samples: Sequence[PoseVectors], future: PoseVectors) -> float:
    """`warped_distance` to the real future, best of the samples."""
    return min(warped_distance(sample, future) for sample in samples)


def warped_distance(first: PoseVectors, second: PoseVectors) -> float:
    """Mean distance of the poses that dynamic time warping puts side by side (Sakoe, Chiba 1978).

    The alignment is the one of the least sum of distances; the mean is over its pairs of poses.
    """
    a, b = np.ascontiguousarray(first), np.ascontiguousarray(second)
    total, sums = dtw_ndim.warping_paths_fast(a, b, inner_dist="euclidean")
    return float(total) / len(dtw.best_path(sums))


def _held(future: PoseVectors, longest: int) -> PoseVectors:
    return np.pad(future, ((0, max(0, longest - len(future))), (0, 0)), mode="edge")


def _distances(first: PoseVectors, second: PoseVectors) -> Float[np.ndarray, "L"]:
    return np.asarray(np.linalg.norm(first - second, axis=-1))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else 0.0
