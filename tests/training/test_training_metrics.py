"""Metrics against closed forms, invariances and the figures that need no data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.motion.skeleton import BODY21
from training.metrics import (
    ade,
    apd,
    apd_of_largest,
    bones,
    class_means,
    cmd,
    fde,
    first_frame_jump,
    limb_jitter,
    limb_stretch,
    mean_length_error,
    mmade,
    mmfde,
    motion_per_frame,
    multimodal_groups,
    root_free_limbs,
    sample_distances,
    valid_apd,
    valid_share,
    velocity_change,
    world_ade,
    world_fde,
    worst_limb_errors,
)


def random_poses(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((*shape, 5, 3))


def test_error_of_the_truth_is_zero():
    future = random_poses(3, 7)
    samples = np.stack([future + 1.0, future, future * 2.0], axis=1)
    for metric in (ade, fde, world_ade, world_fde):
        np.testing.assert_array_equal(metric(samples, future), 0.0)


def test_errors_take_the_norm_of_the_whole_pose_and_the_mean_over_time():
    future = np.zeros((1, 4, 5, 3))
    samples = np.zeros((1, 1, 4, 5, 3))
    samples[0, 0, :, 1, 0] = [0.0, 3.0, 0.0, 3.0]
    samples[0, 0, :, 2, 1] = [0.0, 4.0, 0.0, 4.0]
    assert ade(samples, future)[0] == 2.5
    assert fde(samples, future)[0] == 5.0


def test_a_moved_root_counts_in_the_world_only():
    future = random_poses(2, 4)
    samples = (future + np.array([3.0, 4.0, 0.0]))[:, None]
    np.testing.assert_allclose(ade(samples, future), 0.0, atol=1e-12)
    np.testing.assert_allclose(world_ade(samples, future), 5 * np.sqrt(5))
    np.testing.assert_allclose(world_fde(samples, future), 5 * np.sqrt(5))


def test_ade_and_fde_choose_their_own_best_sample():
    future = np.zeros((1, 2, 2, 3))
    samples = np.zeros((1, 2, 2, 2, 3))
    samples[0, 0, :, 1, 0] = [0.0, 2.0]  # ade 1, fde 2
    samples[0, 1, :, 1, 0] = [4.0, 1.0]  # ade 2.5, fde 1
    assert ade(samples, future)[0] == 1.0
    assert fde(samples, future)[0] == 1.0


@settings(max_examples=20)
@given(st.integers(2, 8), st.integers(0, 1000))
def test_more_samples_never_raise_the_error_and_order_never_matters(count: int, seed: int):
    samples, future = random_poses(2, count, 3, seed=seed), random_poses(2, 3, seed=seed + 1)
    for metric in (ade, fde, world_ade, world_fde):
        assert np.all(metric(samples, future) <= metric(samples[:, 1:], future))
    np.testing.assert_allclose(apd(samples), apd(samples[:, ::-1]))


def test_apd_of_one_dimensional_samples_is_the_mean_over_all_pairs():
    samples = np.zeros((1, 4, 1, 2, 3))
    samples[0, :, 0, 1, 0] = [0.0, 1.0, 2.0, 3.0]
    assert apd(samples)[0] == pytest.approx(10 / 6)


def test_apd_of_the_largest_leaves_the_nearer_pairs_out():
    samples = np.zeros((1, 4, 1, 2, 3))
    samples[0, :, 0, 1, 0] = [0.0, 1.0, 2.0, 3.0]  # distances 3, 2, 2, 1, 1, 1
    assert apd_of_largest(samples, pairs=2)[0] == pytest.approx(5 / 2)
    assert apd_of_largest(samples)[0] == pytest.approx(apd(samples)[0])
    assert apd_of_largest(samples[:, :1])[0] == 0.0


def test_apd_of_equal_samples_and_of_one_sample_is_zero():
    samples = np.repeat(random_poses(2, 1, 3), 4, axis=1)
    np.testing.assert_array_equal(apd(samples), 0.0)
    np.testing.assert_array_equal(apd(samples[:, :1]), 0.0)


def test_an_item_alone_in_its_group_has_its_plain_error():
    samples, future = random_poses(3, 4, 2), random_poses(3, 2, seed=1)
    alone = np.eye(3, dtype=bool)
    np.testing.assert_array_equal(mmade(samples, future, alone), ade(samples, future))
    np.testing.assert_array_equal(mmfde(samples, future, alone), fde(samples, future))


def test_multimodal_error_is_the_mean_over_the_group():
    samples, future = random_poses(2, 4, 3), random_poses(2, 3, seed=1)
    everyone = np.ones((2, 2), dtype=bool)
    crossed = (ade(samples, future) + ade(samples, future[::-1])) / 2
    np.testing.assert_allclose(mmade(samples, future, everyone), crossed)


def test_groups_join_near_poses_wherever_they_stand():
    pose = random_poses(1)[0]
    apart = pose.copy()
    apart[3, 0] += 0.6
    groups = multimodal_groups(np.stack([pose, pose + 9.0, apart]), threshold=0.5)
    np.testing.assert_array_equal(groups, [[1, 1, 0], [1, 1, 0], [0, 0, 1]])


def test_group_of_an_item_holds_it_at_any_threshold():
    assert multimodal_groups(random_poses(4), threshold=0.0).diagonal().all()


def test_cmd_of_a_still_body_is_the_published_figure_of_zero_velocity():
    # Class means and item counts of AMASS as published; the paper's figure is 39.262.
    counts = {"DFaust": 97, "DanceDB": 5979, "GRAB": 4116, "HUMAN4D": 1880, "SOMA": 410, "SSM": 12}
    counts |= {"Transitions": 233}
    means = {"DFaust": 0.00486, "DanceDB": 0.00816, "GRAB": 0.00177, "HUMAN4D": 0.00439}
    means |= {"SOMA": 0.00760, "SSM": 0.00576, "Transitions": 0.00853}
    classes = [name for name, count in counts.items() for _ in range(count)]
    still = np.zeros((len(classes), 119))
    assert cmd(still, classes, means) == pytest.approx(39.262, rel=5e-4)


def test_cmd_weighs_a_difference_by_the_frames_that_follow():
    assert cmd(np.zeros((1, 99)), ["a"], {"a": 1.0}) == 4950
    late = np.zeros((1, 4))
    late[0, -1] = 1.0
    assert cmd(late, ["a"], {"a": 0.0}) == 1.0


def test_cmd_of_motion_that_is_as_real_as_its_class_is_zero():
    motion = np.array([[1.0, 1.0], [3.0, 3.0], [5.0, 5.0]])
    assert cmd(motion, ["a", "a", "b"], class_means(motion, ["a", "a", "b"])) == 0.0


def test_motion_per_frame_is_a_mean_over_joints():
    samples = np.zeros((1, 1, 3, 5, 3))
    samples[0, 0, 1:, 1] = [0.0, 0.0, 4.0]
    np.testing.assert_array_equal(motion_per_frame(samples), [[1.0, 0.0]])


def test_bodies_of_the_real_lengths_neither_stretch_nor_jitter():
    future = np.repeat(random_poses(2, 1), 6, axis=1)
    limbs = bones((-1, 0, 1, 2, 0))
    for metric in (limb_stretch, limb_jitter):
        for values in metric(future[:, None] + 1.0, future, limbs):
            np.testing.assert_allclose(values, 0.0, atol=1e-12)


def test_limbs_ten_percent_longer_stretch_by_ten_and_do_not_jitter():
    future = np.repeat(random_poses(2, 1), 6, axis=1)
    limbs = bones((-1, 0, 1, 2, 0))
    for values in limb_stretch(1.1 * future[:, None], future, limbs):
        np.testing.assert_allclose(values, 10.0)
    for values in limb_jitter(1.1 * future[:, None], future, limbs):
        np.testing.assert_allclose(values, 0.0, atol=1e-12)


def test_limbs_that_swing_by_ten_percent_jitter_by_twenty_around_their_length():
    future = np.repeat(random_poses(1, 1), 6, axis=1)
    swing = np.array([1.1, 0.9] * 3)[None, None, :, None, None]
    limbs = bones((-1, 0, 1, 2, 0))
    mean, rmse = limb_stretch(swing * future[:, None], future, limbs)
    np.testing.assert_allclose([mean, rmse], [[10.0], [10.0]])
    error = mean_length_error(swing * future[:, None], future, limbs)
    np.testing.assert_allclose(error, 0.0, atol=1e-12)
    for values in limb_jitter(swing * future[:, None], future, limbs):
        np.testing.assert_allclose(values, 20.0)


def one_limb(*lengths: float) -> np.ndarray:
    """A sample (1, 1, H, 2, 3) of one limb with these lengths."""
    sample = np.zeros((1, 1, len(lengths), 2, 3))
    sample[0, 0, :, 1, 2] = lengths
    return sample


def test_worst_errors_are_those_of_the_worst_frame():
    future = one_limb(1.0, 1.0, 1.0)[:, 0]
    samples = np.concatenate([one_limb(1.0, 1.0, 1.0), one_limb(1.0, 1.02, 0.97)], axis=1)
    stretch, jitter = worst_limb_errors(samples, future, bones((-1, 0)))
    np.testing.assert_allclose(stretch, [[0.0, 3.0]], atol=1e-9)
    np.testing.assert_allclose(jitter, [[0.0, 5.0]], atol=1e-9)
    np.testing.assert_array_equal(valid_share(stretch, 2.0), [0.5])
    np.testing.assert_array_equal(valid_share(stretch, 4.0), [1.0])


def test_apd_of_valid_samples_leaves_the_others_out():
    samples = random_poses(2, 5, 3)
    distances = sample_distances(samples)
    worst = np.array([[0.0, 9.0, 0.0, 0.0, 9.0], [9.0, 9.0, 9.0, 9.0, 0.0]])
    kept = samples[:1, [0, 2, 3]]
    np.testing.assert_allclose(valid_apd(distances, worst, 1.0), [apd(kept)[0], 0.0])
    np.testing.assert_allclose(valid_apd(distances, worst, 10.0), apd(samples))


def test_joints_that_sit_on_their_parent_are_no_limbs():
    future = np.repeat(random_poses(1, 1), 2, axis=1)
    future[:, :, 4] = future[:, :, 0]
    mean, _ = limb_stretch(1.1 * future[:, None], future, bones((-1, 0, 1, 2, 0)))
    np.testing.assert_allclose(mean, 10.0)


def test_limbs_without_the_root_join_its_children():
    pairs = {frozenset(pair) for pair in root_free_limbs(BODY21.parents).tolist()}
    assert len(pairs) == 17 + 3
    assert frozenset((13, 17)) in pairs
    assert not any(0 in pair for pair in pairs)


def test_a_line_goes_on_without_change_of_velocity():
    times = np.arange(8)[None, :, None, None]
    line = random_poses(2, 1) + times * np.array([0.3, 0.0, 0.4])
    observation, samples = line[:, :4], line[:, None, 4:]
    np.testing.assert_allclose(first_frame_jump(samples, observation), 0.5)
    np.testing.assert_allclose(velocity_change(samples, observation), 0.0, atol=1e-12)


def test_a_body_that_stops_loses_the_velocity_it_had():
    times = np.arange(8)[None, :, None, None]
    line = random_poses(2, 1) + times * np.array([0.3, 0.0, 0.4])
    stopped = np.repeat(line[:, None, 3:4], 4, axis=2)
    np.testing.assert_array_equal(first_frame_jump(stopped, line[:, :4]), 0.0)
    np.testing.assert_allclose(velocity_change(stopped, line[:, :4]), 0.5)
