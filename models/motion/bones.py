"""Which lines between joints are bones, and motions whose bones keep their length."""

from collections.abc import Collection
from functools import lru_cache

import numpy as np

from models.motion.kinematics import bone_lengths, fit_bone_lengths
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, Skeleton, joint_map, resolve_joints

MAX_BONES = 3  # of body21, that move as one


def bone_parents(skeleton: Skeleton, *, loose: Collection[int] = ()) -> tuple[int, ...]:
    """Parents, or -1 where no bone joins them to their child: above the hips, loose, far off."""
    apart = set(loose)
    hips = resolve_joints(skeleton).get("hips", skeleton.joints[0])
    over = skeleton.parents[skeleton.index(hips)]
    while over >= 0:
        apart.add(over)
        over = skeleton.parents[over]
    return tuple(
        parent if near and not {joint, parent} & apart else -1
        for joint, (parent, near) in enumerate(zip(skeleton.parents, _near(skeleton), strict=True))
    )


@lru_cache(maxsize=256)
def _near(skeleton: Skeleton) -> tuple[bool, ...]:
    """Whether each joint is so near to its parent in the body that a bone may join them.

    From a shoulder to a hip, as where there is no trunk, is no bone.
    """
    nearest = joint_map(BODY21, skeleton)[0].argmax(axis=1)
    lines = []
    for joint in map(int, nearest):
        line = {joint}
        while (joint := BODY21.parents[joint]) >= 0:
            line.add(joint)
        lines.append(line)
    return tuple(
        len(lines[joint] ^ lines[parent]) <= MAX_BONES
        for joint, parent in enumerate(skeleton.parents)
    )


def with_fixed_bones(motion: Motion) -> Motion:
    """A motion without gaps whose every bone has the median of its lengths, in its own direction.

    Where a joint hangs on no bone it keeps its place. Rotations are left out: they are those of
    other bones.
    """
    parents = bone_parents(motion.skeleton)
    lengths = np.median(bone_lengths(motion.positions, motion.skeleton.parents), axis=0)
    return Motion(
        name=motion.name,
        skeleton=motion.skeleton,
        positions=fit_bone_lengths(motion.positions, lengths, parents),
        fps=motion.fps,
    )
