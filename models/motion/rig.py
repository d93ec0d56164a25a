"""Motions as animation tools take them: a rest pose, and how each joint turns and moves in it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.kinematics import global_rotations, inverse_kinematics, rest_pose
from models.motion.motion import Motion

TOLERANCE_M = 8e-5


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Rig:
    """Local rotations on the bone vectors ``rest``; ``translations`` are places beside the parent.

    Only joints that are ``moving``, the root among them, need their translations: others are where
    their bone puts them.
    """

    rest: Float[np.ndarray, "J 3"]
    rotations: Float[np.ndarray, "T J 4"]
    translations: Float[np.ndarray, "T J 3"]
    moving: tuple[bool, ...]


def rigged(motion: Motion, *, tolerance_m: float = TOLERANCE_M) -> Rig:
    """The rig of a motion without gaps, whose joints are within the tolerance of their positions.

    Rotations are the motion's own, or else those of `inverse_kinematics` from a T-pose. A joint
    that its rigid bone would miss by more than the tolerance is moving.
    """
    rotations, rest = _rotations_and_rest(motion)
    positions = motion.positions.astype(np.float64)
    turned = global_rotations(rotations, motion.skeleton.parents)
    reached = positions.copy()
    translations = positions.copy()
    moving = [True] * motion.skeleton.num_joints
    for j, parent in enumerate(motion.skeleton.parents):
        if parent < 0:
            continue
        bone = positions[:, j] - reached[:, parent]
        translations[:, j] = rot.rotate(rot.conjugate(turned[:, parent]), bone)
        rigid = reached[:, parent] + rot.rotate(turned[:, parent], rest[j])
        moving[j] = bool(np.linalg.norm(rigid - positions[:, j], axis=-1).max() > tolerance_m)
        reached[:, j] = positions[:, j] if moving[j] else rigid
    return Rig(rest=rest, rotations=rotations, translations=translations, moving=tuple(moving))


def _rotations_and_rest(
    motion: Motion,
) -> tuple[Float[np.ndarray, "T J 4"], Float[np.ndarray, "J 3"]]:
    if motion.rotations is not None and motion.rest_offsets is not None:
        rotations = rot.normalise(motion.rotations.astype(np.float64))
        return rotations, motion.rest_offsets.astype(np.float64)
    rest = rest_pose(motion.positions, motion.skeleton)
    return inverse_kinematics(motion.positions, rest, motion.skeleton.parents), rest
