"""Variations that keep a window human."""

import numpy as np
import pytest
from people import walker
from tiny_bundles import standing_pose

from models.motion.kinematics import bone_lengths
from models.motion.skeleton import BODY21, H36M17, SMPL22, Skeleton
from models.system import Augmentation
from training.data.augment import (
    add_sensor_noise,
    augment,
    draw_mirrored,
    mirror,
    rotate,
    scale_bones,
)
from training.data.augment import warped_frames as warped


def windows(skeleton: Skeleton = BODY21, *, count: int = 3) -> np.ndarray:
    motions = [walker(20, seed=i).to(skeleton).positions for i in range(count)]
    return np.stack(motions).astype(np.float32)


def varied_by(how: Augmentation, poses: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    mirrored = draw_mirrored(len(poses), how=how, generator=generator)
    return augment(poses, mirrored=mirrored, how=how, skeleton=BODY21, generator=generator)


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22, H36M17])
def test_mirror_is_an_involution_that_keeps_bones(skeleton: Skeleton):
    poses = windows(skeleton)
    np.testing.assert_array_equal(mirror(mirror(poses, skeleton), skeleton), poses)
    lengths = bone_lengths(poses, skeleton.parents)
    mirrored = bone_lengths(mirror(poses, skeleton), skeleton.parents)
    np.testing.assert_allclose(mirrored, lengths[..., list(skeleton.mirror)], atol=1e-6)


def test_mirror_exchanges_left_and_right():
    left, right = BODY21.index("left_hand"), BODY21.index("right_hand")
    pose = standing_pose()[None, None].astype(np.float32)
    raised = pose.copy()
    raised[..., left, :] += [0.1, 0.2, 0.7]
    mirrored = mirror(raised, BODY21)
    np.testing.assert_allclose(mirrored[0, 0, left], pose[0, 0, left], atol=1e-6)
    np.testing.assert_allclose(
        mirrored[0, 0, right], pose[0, 0, right] + [0.1, -0.2, 0.7], atol=1e-6
    )


def test_rotate_turns_about_the_vertical_and_keeps_bones():
    poses = windows(count=2)
    turned = rotate(poses, np.array([np.pi / 2, 1.3]))
    np.testing.assert_allclose(turned[0, ..., 0], -poses[0, ..., 1], atol=1e-5)
    np.testing.assert_allclose(turned[0, ..., 1], poses[0, ..., 0], atol=1e-5)
    np.testing.assert_array_equal(turned[..., 2], poses[..., 2])
    np.testing.assert_allclose(
        bone_lengths(turned, BODY21.parents), bone_lengths(poses, BODY21.parents), atol=1e-5
    )


def test_scaled_bones_have_exactly_the_wanted_lengths_and_directions():
    poses = windows().astype(np.float64)
    factors = np.random.default_rng(0).uniform(0.9, 1.1, (3, 21))
    scaled = scale_bones(poses, factors, BODY21.parents)
    lengths = bone_lengths(poses, BODY21.parents) * factors[:, None]
    np.testing.assert_allclose(bone_lengths(scaled, BODY21.parents), lengths)
    np.testing.assert_allclose(scaled[:, :, 0], poses[:, :, 0] * factors[:, None, :1])
    thigh = poses[:, :, 14] - poses[:, :, 13]
    ratio = (scaled[:, :, 14] - scaled[:, :, 13]) / thigh
    np.testing.assert_allclose(ratio, np.broadcast_to(factors[:, 14, None, None], ratio.shape))


def test_rate_one_is_the_recording():
    whole, fraction = warped(10, np.ones(2))
    np.testing.assert_array_equal(whole, [np.arange(10)] * 2)
    np.testing.assert_array_equal(fraction, 0.0)


def test_rate_tells_how_much_of_a_clip_passes():
    whole, fraction = warped(11, np.array([0.5, 1.25]))
    position = whole + fraction[..., 0, 0]
    np.testing.assert_allclose(position[:, -1], [5.0, 12.5])
    np.testing.assert_allclose(np.diff(position), [[0.5] * 10, [1.25] * 10])


def test_augmented_bodies_stay_symmetric_and_near_their_size():
    how = Augmentation(body_scale=0.05, bone_scale=0.06)
    poses = np.repeat(standing_pose()[None, None], 50, axis=0).astype(np.float32)
    varied = varied_by(how, poses, np.random.default_rng(3))
    before, after = (bone_lengths(p, BODY21.parents)[:, 0, 1:] for p in (poses, varied))
    ratio = after / before
    assert 0.95 * 0.94 < ratio.min() < 0.97
    assert 1.03 < ratio.max() < 1.05 * 1.06
    mirrored = np.array(BODY21.mirror[1:]) - 1
    np.testing.assert_allclose(ratio, ratio[:, mirrored], rtol=1e-4)
    assert np.ptp(ratio, axis=1).min() > 0.01  # bones vary, not the body alone


def test_about_half_of_the_rows_are_mirrored_and_only_those():
    how, generator = Augmentation(yaw=False), np.random.default_rng(0)
    mirrored = draw_mirrored(400, how=how, generator=generator)
    assert 160 < mirrored.sum() < 240
    poses = windows(count=3)
    chosen = np.array([True, False, True])
    varied = augment(poses, mirrored=chosen, how=how, skeleton=BODY21, generator=generator)
    np.testing.assert_array_equal(varied[chosen], mirror(poses[chosen], BODY21))
    np.testing.assert_array_equal(varied[1], poses[1])


def test_no_augmentation_changes_nothing():
    how = Augmentation(mirror=False, yaw=False)
    poses = windows()
    same = varied_by(how, poses, np.random.default_rng(0))
    np.testing.assert_array_equal(same, poses)


def test_augmentation_leaves_its_input_alone():
    poses = windows()
    kept = poses.copy()
    how = Augmentation(body_scale=0.05, bone_scale=0.06)
    varied_by(how, poses, np.random.default_rng(0))
    add_sensor_noise(poses, deviation_m=0.01, generator=np.random.default_rng(0))
    np.testing.assert_array_equal(poses, kept)
