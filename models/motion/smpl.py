"""Pose parameters of the SMPL family as motion, on the bones of a template.

The family's bodies are licensed and not here. Whatever their shape and sex, people get the bones of
`REST_OFFSETS`, a body of 1.7 m to the centimetre.
"""

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.kinematics import forward_kinematics
from models.motion.motion import Motion
from models.motion.skeleton import SMPL22

_OFFSETS = {
    "pelvis": (0.0, 0.0, 0.0),
    "spine1": (-0.04, 0.0, 0.12),
    "spine2": (0.03, 0.0, 0.14),
    "spine3": (0.0, 0.0, 0.06),
    "neck": (-0.03, 0.0, 0.21),
    "head": (0.05, 0.0, 0.09),
    "left_hip": (-0.02, 0.06, -0.08),
    "left_knee": (0.01, 0.04, -0.38),
    "left_ankle": (-0.04, -0.01, -0.42),
    "left_foot": (0.12, 0.04, -0.06),
    "left_collar": (-0.02, 0.07, 0.11),
    "left_shoulder": (-0.02, 0.12, 0.05),
    "left_elbow": (-0.02, 0.26, -0.02),
    "left_wrist": (-0.01, 0.27, 0.01),
}
REST_OFFSETS: Float[np.ndarray, "22 3"] = np.array(
    [
        _OFFSETS[joint.replace("right_", "left_")] * np.array([1, -1 if side == "right" else 1, 1])
        for joint, side in zip(SMPL22.joints, SMPL22.sides, strict=True)
    ]
)
"""Bone vectors of ``smpl22`` in the family's rest pose, a T-pose, facing +X."""
_UP = np.array([0.0, 0.0, 1.0])


def smpl_rotations(parameters: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "T 22 4"]:
    """Rotations of ``smpl22`` on `REST_OFFSETS`, from rotation vectors of 22 joints or more.

    SMPL, SMPL-H and SMPL-X agree in the first 22. Their bodies have +Y up and +Z forward; the
    world is turned with the body, so its up is not +Z before `upright` has found it.
    """
    vectors = parameters[:, : 3 * SMPL22.num_joints].reshape(-1, SMPL22.num_joints, 3)
    return rot.from_rotation_vectors(vectors[..., [2, 0, 1]].astype(np.float64))


def upright(root: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "4"]:
    """The turn that takes up to +Z, for a world known by the root rotations of people in it.

    Up is the axis of the world, either way, along which most of their trunks point.
    """
    trunk = rot.rotate(root, _UP).mean(axis=0)
    axis = int(np.abs(trunk).argmax())
    return rot.swing(np.eye(3)[axis] * np.sign(trunk[axis]), _UP)


def smpl_motion(
    rotations: Float[np.ndarray, "T 22 4"],
    *,
    turn: Float[np.ndarray, "4"],
    name: str,
    fps: float,
    path: Float[np.ndarray, "T 3"] | None = None,
) -> Motion:
    """The motion of rotations in a world that is turned by ``turn``.

    Without a path the root stays at the origin, so people who crouch lift their feet.
    """
    turned = rotations.copy()
    turned[:, 0] = rot.multiply(turn, rotations[:, 0])
    root = np.zeros((len(rotations), 3)) if path is None else path
    return Motion(
        name=name,
        skeleton=SMPL22,
        positions=forward_kinematics(turned, REST_OFFSETS, SMPL22.parents, root),
        fps=fps,
        rotations=rot.continuous_sign(turned),
        rest_offsets=REST_OFFSETS,
    )
