"""The retrieval baseline: what training clips did after moments like the one observed."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float32, Int

from models.motion.kinematics import rotate_yaw, yaw
from models.motion.skeleton import Skeleton
from training.data.store import Store
from training.data.windows import Windows, cut

WINDOWS_AT_ONCE = 4096


def nearest_windows(
    observations: Float[np.ndarray, "B T J 3"],
    *,
    store: Store,
    windows: Windows,
    count: int,
) -> Int[np.ndarray, "B count"]:
    """Indices of the windows whose first T frames are nearest to each observation, nearest first.

    Both stand in their canonical frame: last root at the origin, last facing along +X. The
    distance is that of the joints relative to the root and of the root's path, all frames alike.
    """
    queries = _features(observations, store.skeleton)
    best = np.zeros((len(queries), 0), dtype=np.int64)
    distances = np.zeros((len(queries), 0), dtype=np.float32)
    for indices in _chunks(len(windows)):
        poses = cut(store, windows, num_frames=observations.shape[1], indices=indices)
        features = _features(poses, store.skeleton)
        # |q - f|^2 without |q|^2, which changes no order.
        mine = np.square(features).sum(axis=1) - 2 * (queries @ features.T)
        distances = np.concatenate([distances, mine], axis=1)
        best = np.concatenate([best, np.broadcast_to(indices, mine.shape)], axis=1)
        if distances.shape[1] > count:
            kept = np.argpartition(distances, count - 1, axis=1)[:, :count]
            distances = np.take_along_axis(distances, kept, axis=1)
            best = np.take_along_axis(best, kept, axis=1)
    return np.take_along_axis(best, np.argsort(distances, axis=1, kind="stable"), axis=1)


def retrieved_futures(
    observation: Float[np.ndarray, "T J 3"],
    *,
    store: Store,
    windows: Windows,
    indices: Int[np.ndarray, "S"],
    horizon: int,
) -> Float32[np.ndarray, "S H J 3"]:
    """The futures of some windows, moved onto the observed pose.

    How every joint moves away from its last place is taken over, turned to the observed facing.
    """
    num_observed = len(observation)
    poses = cut(store, windows, num_frames=num_observed + horizon, indices=indices)
    now = poses[:, num_observed - 1]
    turn = yaw(observation[-1], store.skeleton) - yaw(now, store.skeleton)
    offsets = poses[:, num_observed:] - now[:, None]
    return np.asarray(observation[-1] + rotate_yaw(offsets, turn[:, None]), np.float32)


def _chunks(total: int) -> Iterator[Int[np.ndarray, "chunk"]]:
    for first in range(0, total, WINDOWS_AT_ONCE):
        yield np.arange(first, min(first + WINDOWS_AT_ONCE, total))


def _features(
    observations: Float[np.ndarray, "B T J 3"], skeleton: Skeleton
) -> Float32[np.ndarray, "B F"]:
    now = observations[:, -1]
    poses = observations - now[:, None, :1]
    poses = rotate_yaw(poses, -yaw(now, skeleton)[:, None])
    poses[:, :, 1:] -= poses[:, :, :1]
    return np.ascontiguousarray(poses.reshape(len(poses), -1), dtype=np.float32)
