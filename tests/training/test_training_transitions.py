"""What lies between two recordings, in closed form."""

import numpy as np
import pytest
from people import walker
from tiny_bundles import standing_pose, walking

from models.motion.kinematics import rotate_yaw, yaw
from models.motion.skeleton import BODY21, H36M17, SMPL22, Skeleton
from training.data.transitions import facing_poses, frames_per_metre, leg_lengths, set_down


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22, H36M17])
def test_facing_poses_do_not_depend_on_place_and_heading(skeleton: Skeleton):
    poses = walker(20, seed=2).to(skeleton).positions
    elsewhere = rotate_yaw(poses, 2.1) + np.array([3.0, -4.0, 0.5])
    same = facing_poses(elsewhere, skeleton)
    np.testing.assert_allclose(same, facing_poses(poses, skeleton), atol=1e-9)
    np.testing.assert_allclose(yaw(same, skeleton), 0.0, atol=1e-9)


def test_legs_are_as_long_as_their_bones():
    pose = standing_pose()
    foot, knee, hip = (BODY21.index(f"left_{j}") for j in ("foot", "lower_leg", "upper_leg"))
    wanted = np.linalg.norm(pose[foot] - pose[knee]) + np.linalg.norm(pose[knee] - pose[hip])
    np.testing.assert_allclose(
        leg_lengths(np.stack([pose, 1.2 * pose]), BODY21), [wanted, 1.2 * wanted]
    )


def test_a_hand_that_rises_a_centimetre_each_frame_takes_a_hundred_frames_per_metre():
    rising = np.repeat(standing_pose()[None], 80, axis=0)
    rising[:, BODY21.index("left_hand"), 2] += 0.01 * np.arange(80)
    still = np.repeat(standing_pose()[None], 20, axis=0)
    positions = np.concatenate([still, rising[:30], rising[30:], still])
    k = frames_per_metre(positions, np.array([20, 50]), np.array([30, 50]), BODY21)
    assert k == pytest.approx(100.0, rel=1e-6)
    whole = frames_per_metre(positions, np.array([0, 20, 100]), np.array([20, 80, 20]), BODY21)
    assert 150.0 < whole < np.inf  # some stand still, for whom eq. 3 would have no value


def test_a_glide_set_down_after_a_glide_continues_it():
    glide = standing_pose() + np.arange(40)[:, None, None] * [0.04, 0.01, 0.0]
    first = np.array([6])
    target = glide[None, 10 + np.maximum(np.arange(25) - 6, 0)]
    elsewhere = rotate_yaw(target, 1.0) + np.array([5.0, -2.0, 0.0])
    seen = rotate_yaw(glide[None, :4], -0.7)
    down = set_down(elsewhere, seen, first=first, skeleton=BODY21)
    np.testing.assert_allclose(down, rotate_yaw(target, -0.7), atol=1e-6)


def test_a_stop_takes_half_the_way_that_the_speed_would_go():
    walk = walking(15, fps=30.0, speed=1.5)[None]
    still = np.repeat(walking(1, fps=30.0, speed=0.0)[None], 30, axis=1)
    first = np.array([9])
    down = set_down(still, walk, first=first, skeleton=BODY21)
    way = down[0, 9, 0, :2] - walk[0, -1, 0, :2]
    velocity = walk[0, -1, 0, :2] - walk[0, -2, 0, :2]
    np.testing.assert_allclose(way, 10 * velocity / 2, atol=1e-9)
    np.testing.assert_array_equal(down[..., 2], still[..., 2])
