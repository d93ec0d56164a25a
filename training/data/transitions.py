"""From one recording to another: how far apart two poses are, how long the way, and where it ends.

Mao et al. 2022, section 3.2, with whole bodies in the world where the paper has joint angles.
"""

import numpy as np
from jaxtyping import Float, Int

from models.motion.kinematics import bone_lengths, rotate_yaw, yaw
from models.motion.skeleton import Skeleton, resolve_joints
from training.data.augment import rotate

PAIRS_MEASURED = 20_000
FARTHEST_PAIR = 30
_LEG = ("lower_leg", "foot")


def facing_poses(
    poses: Float[np.ndarray, "*batch J 3"], skeleton: Skeleton
) -> Float[np.ndarray, "*batch J 3"]:
    """Poses with the root at the origin, facing +X: what two of them share wherever they are."""
    centred = poses - poses[..., :1, :]
    return rotate_yaw(centred, -yaw(centred, skeleton))


def leg_lengths(
    poses: Float[np.ndarray, "*batch J 3"], skeleton: Skeleton
) -> Float[np.ndarray, "*batch"]:
    """Metres from hip to ankle along the bones, the mean of both legs."""
    own = resolve_joints(skeleton)
    bones = [skeleton.index(own[f"{side}_{j}"]) for side in ("left", "right") for j in _LEG]
    return np.asarray(bone_lengths(poses, skeleton.parents)[..., bones].sum(axis=-1) / 2)


def frames_per_metre(
    positions: Float[np.ndarray, "N J 3"],
    starts: Int[np.ndarray, "C"],
    lengths: Int[np.ndarray, "C"],
    skeleton: Skeleton,
) -> float:
    """k: the frames that people take for a metre of change of their whole pose.

    The mean of |i - j| over that of the distance, on pairs of frames of one clip. The mean of the
    quotients (Mao et al. 2022, supplement, eq. 3) has no bound where people stand still.
    """
    generator = np.random.default_rng(0)
    clips = generator.integers(len(starts), size=PAIRS_MEASURED)
    first = np.floor(generator.random(PAIRS_MEASURED) * (lengths[clips] - 1)).astype(np.int64)
    room = np.minimum(lengths[clips] - 1 - first, FARTHEST_PAIR)
    apart = 1 + np.floor(generator.random(PAIRS_MEASURED) * room).astype(np.int64)
    one, other = (
        facing_poses(positions[starts[clips] + frame], skeleton) for frame in (first, first + apart)
    )
    return float(apart.sum() / np.linalg.norm(one - other, axis=(-2, -1)).sum(dtype=np.float64))


def set_down(
    target: Float[np.ndarray, "B L J 3"],
    observation: Float[np.ndarray, "B T J 3"],
    *,
    first: Int[np.ndarray, "B"],
    skeleton: Skeleton,
) -> Float[np.ndarray, "B L J 3"]:
    """Targets turned and moved along the ground to where an observed person gets.

    A target starts at its frame ``first``, first + 1 steps after the last observed pose, and faces
    then where that pose does. Its root lies where the observed one arrives when its velocity along
    the ground goes evenly over to that of the target's first step.
    """
    rows = np.arange(len(target))
    angles = yaw(observation[:, -1], skeleton) - yaw(target[rows, first], skeleton)
    turned = rotate(target, angles)
    root, seen = turned[:, :, 0, :2], observation[:, :, 0, :2]
    step = (seen[:, -1] - seen[:, -2] + root[rows, first + 1] - root[rows, first]) / 2
    place = seen[:, -1] + (first[:, None] + 1) * step
    turned[..., :2] += (place - root[rows, first])[:, None, None]
    return turned
