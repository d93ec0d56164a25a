"""Motions as animation tools take them: a rest pose, and how each joint turns in it."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.kinematics import global_rotations, inverse_kinematics, rest_pose
from models.motion.motion import Motion
from models.motion.skeleton import children_of

TOLERANCE_M = 8e-5


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Rig:
    """Joints with local rotations on the bone vectors ``rest``, parents before children.

    Where a joint's children do not keep their angles, some hang on joints of their own, which lie
    in it and turn for them: ``hips_to_left_upper_leg``. Bones that stretch cannot be had from
    rotations: their joints, and the root, are ``moving``, and have ``translations``, their places
    beside the parent.
    """

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Float[np.ndarray, "K 3"]
    rotations: Float[np.ndarray, "T K 4"]
    translations: Float[np.ndarray, "T K 3"]
    moving: tuple[bool, ...]

    @property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """For each joint the indices of its children, in order."""
        return children_of(self.parents)


@dataclass(kw_only=True, slots=True, eq=False)
class _Growing:
    """A rig as far as it is made; ``turned`` and ``reached`` are its joints in the world."""

    joints: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    rest: list[np.ndarray] = field(default_factory=list)
    rotations: list[np.ndarray] = field(default_factory=list)
    translations: list[np.ndarray] = field(default_factory=list)
    moving: list[bool] = field(default_factory=list)
    turned: list[np.ndarray] = field(default_factory=list)
    reached: list[np.ndarray] = field(default_factory=list)

    def add(
        self,
        joint: str,
        parent: int,
        turned: Float[np.ndarray, "T 4"],
        *,
        rest: Float[np.ndarray, "3"],
        beside: Float[np.ndarray, "T 3"] | None = None,
    ) -> int:
        """The index of a new joint, ``rest`` from its parent, or where it moves, ``beside`` it."""
        above = rot.conjugate(self.turned[parent]) if parent >= 0 else None
        local = turned if above is None else rot.multiply(above, turned)
        place = np.broadcast_to(rest, (len(turned), 3)) if beside is None else beside
        if parent >= 0:
            reached = self.reached[parent] + rot.rotate(self.turned[parent], place)
        else:
            reached = place
        self.joints.append(joint)
        self.parents.append(parent)
        self.rest.append(rest)
        self.rotations.append(rot.continuous_sign(local))
        self.translations.append(place)
        self.moving.append(beside is not None)
        self.turned.append(turned)
        self.reached.append(reached)
        return len(self.joints) - 1


def rigged(motion: Motion, *, tolerance_m: float = TOLERANCE_M) -> Rig:
    """The rig of a motion without gaps, whose joints are within the tolerance of their positions.

    Rotations are the motion's own, or else those of `inverse_kinematics` from a T-pose.
    """
    rotations, rest = _rotations_and_rest(motion)
    positions = motion.positions.astype(np.float64)
    turned = global_rotations(rotations, motion.skeleton.parents)
    rig = _Growing()
    place: list[int] = []  # of each joint of the motion among those of the rig
    for j, parent in enumerate(motion.skeleton.parents):
        name = motion.skeleton.joints[j]
        if parent < 0:
            place.append(rig.add(name, -1, turned[:, j], rest=rest[j], beside=positions[:, j]))
            continue
        over = place[parent]
        bone = positions[:, j] - rig.reached[over]  # (T, 3)
        beside = rot.rotate(rot.conjugate(rig.turned[over]), bone)
        if np.linalg.norm(beside - rest[j], axis=-1).max() <= tolerance_m:
            place.append(rig.add(name, over, turned[:, j], rest=rest[j]))
            continue
        stretch = np.abs(np.linalg.norm(bone, axis=-1) - np.linalg.norm(rest[j]))
        if stretch.max() > tolerance_m:
            place.append(rig.add(name, over, turned[:, j], rest=rest[j], beside=beside))
            continue
        swing = rot.swing(np.broadcast_to(rest[j], beside.shape), beside)
        own = f"{motion.skeleton.joints[parent]}_to_{name}"
        over = rig.add(own, over, rot.multiply(rig.turned[over], swing), rest=np.zeros(3))
        place.append(rig.add(name, over, turned[:, j], rest=rest[j]))
    return Rig(
        joints=tuple(rig.joints),
        parents=tuple(rig.parents),
        rest=np.stack(rig.rest),
        rotations=np.stack(rig.rotations, axis=1),
        translations=np.stack(rig.translations, axis=1),
        moving=tuple(rig.moving),
    )


def _rotations_and_rest(
    motion: Motion,
) -> tuple[Float[np.ndarray, "T J 4"], Float[np.ndarray, "J 3"]]:
    if motion.rotations is not None and motion.rest_offsets is not None:
        rotations = rot.normalise(motion.rotations.astype(np.float64))
        return rotations, motion.rest_offsets.astype(np.float64)
    rest = rest_pose(motion.positions, motion.skeleton)
    return inverse_kinematics(motion.positions, rest, motion.skeleton.parents), rest
