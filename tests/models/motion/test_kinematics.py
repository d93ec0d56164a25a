import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.motion import rotations as rot
from models.motion.kinematics import (
    bone_lengths,
    fit_bone_lengths,
    forward_kinematics,
    inverse_kinematics,
    rest_pose,
    rotate_yaw,
    yaw,
)
from models.motion.skeleton import BODY21, H36M17, SKELETONS, joint_map

REST = np.zeros((21, 3))
for _joint, _offset in {
    "spine": (-0.02, 0, 0.1), "chest": (0, 0, 0.22), "neck": (0, 0, 0.14), "head": (0.02, 0, 0.18),
    "left_shoulder": (0, 0.04, 0.12), "left_upper_arm": (0, 0.14, 0),
    "left_lower_arm": (0, 0.28, 0), "left_hand": (0, 0.26, 0), "left_upper_leg": (0, 0.09, -0.02),
    "left_lower_leg": (0, 0, -0.41), "left_foot": (0, 0, -0.42), "left_toes": (0.14, 0, -0.04),
}.items():  # fmt: skip
    REST[BODY21.index(_joint)] = _offset
    if _joint.startswith("left"):
        REST[BODY21.index("right" + _joint[4:])] = np.array(_offset) * (1, -1, 1)

seeds = st.integers(0, 2**31)


def rigid_motion(seed: int, num_frames: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Smooth random rotations and the positions of REST under them."""
    rng = np.random.default_rng(seed)
    path = rng.normal(size=(num_frames, 21, 3)).cumsum(axis=0) * 0.2
    rotations = rot.continuous_sign(rot.from_axis_angles(path, "ZXY"))
    root = rng.normal(size=(num_frames, 3))
    return rotations, forward_kinematics(rotations, REST, BODY21.parents, root)


def test_the_identity_is_the_rest_pose():
    rotations = np.tile([1.0, 0, 0, 0], (21, 1))
    pose = forward_kinematics(rotations, REST, BODY21.parents, np.array([1.0, 2.0, 0.9]))
    np.testing.assert_allclose(pose[BODY21.index("left_hand")], [0.98, 2.72, 1.34])
    np.testing.assert_allclose(pose[0], [1, 2, 0.9])


def test_a_bent_elbow_moves_only_the_hand():
    rotations = np.tile([1.0, 0, 0, 0], (21, 1))
    elbow = BODY21.index("left_lower_arm")
    straight = forward_kinematics(rotations, REST, BODY21.parents, np.zeros(3))
    rotations[elbow] = rot.from_axis_angles(np.array([-np.pi / 2]), "Z")
    bent = forward_kinematics(rotations, REST, BODY21.parents, np.zeros(3))
    moved = np.flatnonzero(np.linalg.norm(bent - straight, axis=-1) > 1e-9)
    assert list(moved) == [BODY21.index("left_hand")]
    np.testing.assert_allclose(bent[moved[0]] - bent[elbow], [0.26, 0, 0], atol=1e-12)


def test_forward_kinematics_is_the_product_of_matrices_down_the_tree():
    rotations, positions = rigid_motion(3)
    for t in (0, 7):
        world = [np.eye(3)] * 21
        for j, parent in enumerate(BODY21.parents):
            matrix = rot.to_matrix(rotations[t, j])
            world[j] = matrix if parent < 0 else world[parent] @ matrix
            if parent >= 0:
                expected = positions[t, parent] + world[parent] @ REST[j]
                np.testing.assert_allclose(positions[t, j], expected, atol=1e-12)


@settings(max_examples=25)
@given(seeds)
def test_rotations_found_from_rigid_positions_give_them_back(seed):
    _, positions = rigid_motion(seed)
    rotations = inverse_kinematics(positions, REST, BODY21.parents)
    back = forward_kinematics(rotations, REST, BODY21.parents, positions[:, 0])
    np.testing.assert_allclose(back, positions, atol=2e-6)
    assert ((rotations[1:] * rotations[:-1]).sum(axis=-1) >= 0).all()


def test_rotations_found_have_no_twist_where_bones_lie_on_one_line():
    rest = REST.copy()
    for side in ("left", "right"):  # as in the CMU clips: collar bones begin at the neck
        rest[BODY21.index(f"{side}_shoulder")] = rest[BODY21.index("neck")]
    still = np.tile([1.0, 0, 0, 0], (5, 21, 1))
    positions = forward_kinematics(still, rest, BODY21.parents, np.zeros((5, 3)))
    found = inverse_kinematics(positions, rest, BODY21.parents)
    np.testing.assert_allclose(found, still, atol=1e-6)


def test_rotations_are_finite_when_all_joints_coincide():
    found = inverse_kinematics(np.zeros((3, 21, 3)), REST, BODY21.parents)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0)


@given(seeds)
def test_fitted_bones_have_the_lengths_asked_for_and_keep_their_directions(seed):
    rng = np.random.default_rng(seed)
    poses, lengths = rng.normal(size=(2, 3, 21, 3)), rng.uniform(0.05, 0.5, size=21)
    lengths[0] = 0.0
    fitted = fit_bone_lengths(poses, lengths, BODY21.parents)
    np.testing.assert_allclose(
        bone_lengths(fitted, BODY21.parents), np.broadcast_to(lengths, (2, 3, 21)), atol=1e-12
    )
    np.testing.assert_array_equal(fitted[..., 0, :], poses[..., 0, :])
    parents = [max(p, 0) for p in BODY21.parents]
    before, after = poses - poses[..., parents, :], fitted - fitted[..., parents, :]
    np.testing.assert_allclose(np.cross(before, after), 0.0, atol=1e-12)
    assert ((before * after).sum(axis=-1)[..., 1:] > 0).all()


def test_fitting_to_the_own_lengths_changes_nothing_and_no_length_stays_finite():
    _, positions = rigid_motion(1)
    lengths = bone_lengths(positions, BODY21.parents)[0]
    np.testing.assert_allclose(
        fit_bone_lengths(positions, lengths, BODY21.parents), positions, atol=1e-12
    )
    flat = fit_bone_lengths(np.zeros((1, 21, 3)), lengths, BODY21.parents)
    np.testing.assert_allclose(bone_lengths(flat, BODY21.parents)[0], lengths)


@given(seeds, st.floats(-3.1, 3.1))
def test_turning_a_pose_turns_its_facing(seed, angle):
    rest = np.tile([1.0, 0, 0, 0], (2, 21, 1))
    poses = forward_kinematics(rest, REST, BODY21.parents, np.zeros((2, 3)))
    np.testing.assert_allclose(yaw(poses, BODY21), 0.0, atol=1e-12)
    turned = rotate_yaw(poses, np.array([angle, -angle]))
    np.testing.assert_allclose(yaw(turned, BODY21), [angle, -angle], atol=1e-9)
    shift = np.random.default_rng(seed).normal(size=3)
    np.testing.assert_allclose(yaw(turned + shift, BODY21), [angle, -angle], atol=1e-9)


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=lambda s: s.name)
def test_facing_does_not_depend_on_the_skeleton(skeleton):
    _, positions = rigid_motion(5)
    mapped = np.einsum("ij,tjk->tik", joint_map(BODY21, skeleton)[0], positions)
    np.testing.assert_allclose(yaw(mapped, skeleton), yaw(positions, BODY21), atol=1e-12)


def test_a_person_facing_x_has_the_left_side_at_y():
    pose = np.zeros((17, 3))
    pose[H36M17.index("LHip"), 1], pose[H36M17.index("RHip"), 1] = 0.1, -0.1
    assert yaw(pose, H36M17) == 0.0


def test_a_rest_pose_made_from_positions_has_straight_limbs_and_faces_x():
    rotations = np.tile([1.0, 0, 0, 0], (4, 21, 1))
    rotations[:, 0] = rot.from_axis_angles(np.array([2.0]), "Z")
    rotations[:, BODY21.index("left_lower_arm")] = rot.from_axis_angles(np.array([1.0]), "X")
    positions = forward_kinematics(rotations, REST, BODY21.parents, np.ones((4, 3)))
    np.testing.assert_allclose(rest_pose(positions, BODY21), REST, atol=1e-12)
