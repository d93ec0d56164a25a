"""Poses and bones: forward and inverse kinematics, bone lengths, facing. Metres, +Z up."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.joint_tables import REQUIRED
from models.motion.skeleton import BODY21, Skeleton, children_of, joint_map, resolve_joints

_FACING = ("upper_leg", "upper_arm")
_T_POSE = {  # rest directions of limbs in a T-pose that faces +X
    "left_lower_arm": (0.0, 1.0, 0.0),
    "left_hand": (0.0, 1.0, 0.0),
    "right_lower_arm": (0.0, -1.0, 0.0),
    "right_hand": (0.0, -1.0, 0.0),
    "left_lower_leg": (0.0, 0.0, -1.0),
    "left_foot": (0.0, 0.0, -1.0),
    "right_lower_leg": (0.0, 0.0, -1.0),
    "right_foot": (0.0, 0.0, -1.0),
}


def global_rotations(
    rotations: Float[np.ndarray, "*batch J 4"], parents: Sequence[int]
) -> Float[np.ndarray, "*batch J 4"]:
    """Rotations of every joint relative to the world, from rotations relative to the parent."""
    result = np.empty_like(rotations)
    for j, parent in enumerate(parents):
        local = rotations[..., j, :]
        result[..., j, :] = local if parent < 0 else rot.multiply(result[..., parent, :], local)
    return result


def forward_kinematics(
    rotations: Float[np.ndarray, "*batch J 4"],
    rest_offsets: Float[np.ndarray, "J 3"],
    parents: Sequence[int],
    root: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch J 3"]:
    """Joint positions of local rotations, bone vectors of the rest pose, and the root's position.

    p[j] = p[parent] + G[parent] rest_offsets[j]; the root's rest offset is not used.
    """
    turned = global_rotations(rotations, parents)
    positions = np.empty((*rotations.shape[:-1], 3), dtype=np.result_type(rotations, root))
    for j, parent in enumerate(parents):
        positions[..., j, :] = (
            root
            if parent < 0
            else positions[..., parent, :] + rot.rotate(turned[..., parent, :], rest_offsets[j])
        )
    return positions


def inverse_kinematics(
    positions: Float[np.ndarray, "T J 3"],
    rest_offsets: Float[np.ndarray, "J 3"],
    parents: Sequence[int],
) -> Float[np.ndarray, "T J 4"]:
    """Local rotations that point every bone from its rest direction to where it is.

    A joint with one child takes the shortest swing, so it has no twist of its own; one with several
    takes the best rotation of all (Kabsch 1976). Exact where bones are as long as in the rest pose
    and siblings keep their angles. Leaves keep the identity; signs are continuous in time.
    """
    result = np.zeros((*positions.shape[:-1], 4))
    result[..., 0] = 1.0
    turned = result.copy()
    for j, children in enumerate(children_of(parents)):
        above = turned[:, parents[j]] if j > 0 else result[:, 0].copy()
        if children:
            bones = positions[:, list(children)] - positions[:, j, None]
            observed = rot.rotate(rot.conjugate(above)[:, None], bones)  # (T, C, 3)
            result[:, j] = _align(rest_offsets[list(children)].astype(np.float64), observed)
        turned[:, j] = rot.multiply(above, result[:, j])
    return rot.continuous_sign(result)


def _align(
    rest: Float[np.ndarray, "C 3"], observed: Float[np.ndarray, "T C 3"]
) -> Float[np.ndarray, "T 4"]:
    if len(rest) == 1:
        return rot.swing(np.broadcast_to(rest[0], observed[:, 0].shape), observed[:, 0])
    covariance = np.einsum("tci,cj->tij", observed.astype(np.float64), rest)
    # A trace of the identity picks the smallest turn where the bones leave one free, as when they
    # lie on one line; it is too small to be seen in positions.
    scale = np.abs(covariance).sum(axis=(-2, -1))[:, None, None] + 1e-12
    u, _, vt = np.linalg.svd(covariance + 1e-7 * scale * np.eye(3))
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return rot.from_matrix(u @ vt)


def bone_lengths(
    positions: Float[np.ndarray, "*batch J 3"], parents: Sequence[int]
) -> Float[np.ndarray, "*batch J"]:
    """Distance of every joint from its parent; 0 for the root."""
    above = [max(parent, 0) for parent in parents]
    lengths: np.ndarray = np.linalg.norm(positions - positions[..., above, :], axis=-1)
    return lengths


def fit_bone_lengths(
    positions: Float[np.ndarray, "*batch J 3"],
    lengths: Float[np.ndarray, "J"],
    parents: Sequence[int],
) -> Float[np.ndarray, "*batch J 3"]:
    """The poses with given bone lengths: every bone keeps its direction, the root its place.

    A bone of no length takes the direction of the bone above it, or up. In memory the result lies
    joint by joint.
    """
    # Joints and axes first: every operation then goes along a row of all poses.
    rows = np.ascontiguousarray(np.moveaxis(positions, (-2, -1), (0, 1)))
    result = np.array(rows)
    directions = np.zeros_like(rows)
    directions[0, 2] = 1.0
    for j, parent in enumerate(parents):
        if parent < 0:
            continue
        bone = rows[j] - rows[parent]
        length = np.sqrt(bone[0] ** 2 + bone[1] ** 2 + bone[2] ** 2)
        np.divide(bone, np.maximum(length, 1e-9), out=directions[j])
        none = length <= 1e-9
        if none.any():
            directions[j][:, none] = directions[parent][:, none]
        np.multiply(directions[j], lengths[j], out=result[j])
        result[j] += result[parent]
    return np.moveaxis(result, (0, 1), (-2, -1))


def yaw(
    positions: Float[np.ndarray, "*batch J 3"], skeleton: Skeleton
) -> Float[np.ndarray, "*batch"]:
    """The angle about +Z by which a pose is turned from facing +X.

    Facing is across the sum of the lines from right to left hip and from right to left upper arm.
    """
    weights, _ = joint_map(skeleton, BODY21)
    across = np.sum(
        [weights[BODY21.index(f"left_{j}")] - weights[BODY21.index(f"right_{j}")] for j in _FACING],
        axis=0,
    )
    left = np.einsum("j,...ji->...i", across, positions)
    return np.asarray(np.arctan2(-left[..., 0], left[..., 1]))


def rotate_yaw(
    positions: Float[np.ndarray, "*batch J 3"], angle: Float[np.ndarray, "*#batch"] | float
) -> Float[np.ndarray, "*batch J 3"]:
    """Poses turned about the vertical through the world's origin, one angle for each pose."""
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    x, y, z = np.moveaxis(positions, -1, 0)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1).astype(positions.dtype)


def rest_pose(
    positions: Float[np.ndarray, "T J 3"], skeleton: Skeleton
) -> Float[np.ndarray, "J 3"]:
    """Bone vectors of a rest pose for a motion that has none: facing +X, limbs as in a T-pose.

    Lengths are medians over time. Bones other than limbs are as in the first frame, so that
    siblings keep the angles they have; so are all bones of a skeleton with unknown names.
    """
    parents = skeleton.parents
    own = {joint: body21 for body21, joint in resolve_joints(skeleton).items()}
    first = positions[:1].astype(np.float64)
    if set(REQUIRED) <= set(own.values()):
        first = rotate_yaw(first, -yaw(first, skeleton))
    above = [max(parent, 0) for parent in parents]
    offsets = (first - first[:, above])[0]
    for children in skeleton.children:
        if len(children) == 1:
            name = own.get(skeleton.joints[children[0]], "")
            offsets[children[0]] = _T_POSE.get(name, offsets[children[0]])
    norms = np.linalg.norm(offsets, axis=-1, keepdims=True)
    lengths = np.median(bone_lengths(positions, parents), axis=0)[:, None]
    rest: np.ndarray = offsets / np.maximum(norms, 1e-9) * lengths
    return rest
