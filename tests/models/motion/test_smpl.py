"""Pose parameters of the SMPL family, on the template."""

import numpy as np
import pytest

from models.motion import rotations as rot
from models.motion.kinematics import bone_lengths, forward_kinematics, yaw
from models.motion.skeleton import BODY21, SMPL22
from models.motion.smpl import REST_OFFSETS, smpl_motion, smpl_rotations, upright

STILL = np.array([1.0, 0.0, 0.0, 0.0])
ORIENTATIONS = {  # of a person who stands, in worlds of several kinds
    "y up": (0.0, 0.0, 0.0),
    "z up": (np.pi / 2, 0.0, 0.0),
    "camera, y down": (np.pi, 0.0, 0.0),
    "x up": (0.0, 0.0, -np.pi / 2),
}


def posed(num_frames: int = 4, **joints: tuple[float, float, float]) -> np.ndarray:
    """(T, 66) parameters in which some joints are turned, in the axes of the body model."""
    parameters = np.zeros((num_frames, 22, 3))
    for joint, vector in joints.items():
        parameters[:, SMPL22.index(joint)] = vector
    return parameters.reshape(num_frames, 66)


def joint(poses: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(poses[..., SMPL22.index(name), :])


def test_template_is_a_symmetric_person_in_a_t_pose_who_faces_forward():
    pose = smpl_motion(smpl_rotations(posed(1)), turn=STILL, name="rest", fps=30.0).positions
    np.testing.assert_allclose(pose[:, SMPL22.mirror], pose * [1, -1, 1], atol=1e-12)
    assert yaw(pose, SMPL22) == pytest.approx(0.0)
    assert 1.4 < np.ptp(pose[..., 2]) < 1.7  # the joint of the head lies below the crown
    assert joint(pose, "left_wrist")[0, 1] > 0.6
    assert joint(pose, "left_wrist")[0, 2] == pytest.approx(joint(pose, "neck")[0, 2], abs=0.15)
    assert joint(pose, "left_foot")[0, 0] > joint(pose, "left_ankle")[0, 0]


def test_knee_bends_backwards_and_arm_is_lifted_as_in_the_body_model():
    bent = posed(1, left_knee=(1.2, 0.0, 0.0), left_shoulder=(0.0, 0.0, 0.8))
    pose = smpl_motion(smpl_rotations(bent), turn=STILL, name="bent", fps=30.0).positions[0]
    rest = smpl_motion(smpl_rotations(posed(1)), turn=STILL, name="rest", fps=30.0).positions[0]
    moved = (pose - pose[0]) - (rest - rest[0])
    assert joint(moved, "left_ankle")[0] < -0.2
    assert joint(moved, "left_wrist")[2] > 0.2
    still = [SMPL22.index(j) for j in ("head", "right_wrist", "right_foot", "left_knee")]
    np.testing.assert_allclose(moved[still], 0.0, atol=1e-12)


@pytest.mark.parametrize("width", [66, 72, 156, 165])
def test_hands_and_faces_of_the_family_are_left_out(width: int):
    body = 0.3 * np.random.default_rng(0).normal(size=(5, 66))
    wide = np.concatenate([body, np.ones((5, width - 66))], axis=1)
    np.testing.assert_array_equal(smpl_rotations(wide), smpl_rotations(body))


@pytest.mark.parametrize("orientation", ORIENTATIONS.values(), ids=ORIENTATIONS)
def test_people_stand_upright_whatever_their_world(orientation):
    rotations = smpl_rotations(posed(pelvis=orientation, left_hip=(0.5, 0.0, 0.0)))
    turn = upright(rotations[:, 0])
    motion = smpl_motion(rotations, turn=turn, name="person", fps=30.0)
    np.testing.assert_array_equal(motion.positions[:, 0], 0.0)
    assert (joint(motion.positions, "head")[:, 2] > 0.5).all()
    assert (joint(motion.positions, "right_ankle")[:, 2] < -0.8).all()


def test_up_is_where_most_people_point_though_one_lies_and_one_bows():
    roots = [posed(3, pelvis=vector) for vector in ((1.5, 0.0, 0.0), (1.7, 0.3, 0.0), (0, 0, 0))]
    turn = upright(smpl_rotations(np.concatenate(roots))[:, 0])
    np.testing.assert_allclose(turn, upright(smpl_rotations(posed(pelvis=(1.57, 0, 0)))[:, 0]))


def test_bones_keep_the_template_s_length_and_rotations_give_the_positions():
    parameters = 0.4 * np.random.default_rng(1).normal(size=(20, 66))
    motion = smpl_motion(smpl_rotations(parameters), turn=STILL, name="any", fps=30.0)
    wanted = np.linalg.norm(REST_OFFSETS, axis=-1)
    lengths = bone_lengths(motion.positions, SMPL22.parents)
    np.testing.assert_allclose(lengths, np.broadcast_to(wanted, lengths.shape), atol=1e-12)
    assert motion.rotations is not None
    same = forward_kinematics(
        motion.rotations, REST_OFFSETS, SMPL22.parents, motion.positions[:, 0]
    )
    np.testing.assert_allclose(same, motion.positions, atol=1e-12)


def test_a_turned_head_turns_nothing_else():
    turned = smpl_rotations(posed(1, head=(0.0, 0.9, 0.0)))
    others = [j for j in range(22) if j != SMPL22.index("head")]
    np.testing.assert_array_equal(turned[0, others], np.broadcast_to(STILL, (21, 4)))
    about_up = rot.from_axis_angles(np.array([0.9]), "Z")
    np.testing.assert_allclose(turned[0, SMPL22.index("head")], about_up, atol=1e-12)


def test_template_is_a_person_on_body21_too():
    motion = smpl_motion(smpl_rotations(posed(1)), turn=STILL, name="rest", fps=30.0).to(BODY21)
    assert yaw(motion.positions, BODY21) == pytest.approx(0.0)
