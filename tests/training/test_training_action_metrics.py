"""Metrics of actions against cases by hand, invariances, and warping the slow way."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from people import walker

from models.motion.kinematics import rotate_yaw
from models.motion.skeleton import BODY21
from training.action_metrics import (
    displacement,
    diversity,
    pose_vectors,
    warped_displacement,
    warped_distance,
    warped_diversity,
)


def line(*values: float) -> np.ndarray:
    """Poses of two numbers each, of which the second stays 0."""
    return np.stack([np.array(values), np.zeros(len(values))], axis=1)


def by_hand(first: np.ndarray, second: np.ndarray) -> set[float]:
    """Mean distances along all alignments of the least sum, each of which is right."""
    cost = np.linalg.norm(first[:, None] - second[None], axis=-1)
    best: dict[tuple[int, int], tuple[float, set[int]]] = {(0, 0): (cost[0, 0], {1})}
    for i, j in np.ndindex(*cost.shape):
        if (i, j) == (0, 0):
            continue
        before = [best[c] for c in ((i - 1, j), (i, j - 1), (i - 1, j - 1)) if c in best]
        least = min(total for total, _ in before)
        counts = {n + 1 for total, mine in before if total <= least + 1e-12 for n in mine}
        best[i, j] = (least + cost[i, j], counts)
    total, counts = best[cost.shape[0] - 1, cost.shape[1] - 1]
    return {total / count for count in counts}


@settings(max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 1000))
def test_warping_is_that_of_a_search_one_by_one(first: int, second: int, seed: int):
    generator = np.random.default_rng(seed)
    a, b = generator.standard_normal((first, 4)), generator.standard_normal((second, 4))
    found = warped_distance(a, b)
    assert any(found == pytest.approx(wanted) for wanted in by_hand(a, b))


def test_warping_forgives_pauses_but_not_poses():
    assert warped_distance(line(0, 1, 2), line(0, 0, 1, 1, 1, 2)) == 0.0
    assert warped_distance(line(0, 0), line(3, 3)) == 3.0
    assert warped_distance(line(1), line(0, 2, 1)) == pytest.approx(2 / 3)


def test_diversity_holds_the_last_pose_to_the_end():
    short, long = line(1), line(1, 3, 3, 3)
    assert diversity([short, long], longest=4) == pytest.approx(6 / 4)
    assert diversity([short, long], longest=8) == pytest.approx(14 / 8)


def test_diversity_is_the_mean_over_all_pairs():
    futures = [line(0, 0), line(1, 1), line(3, 3)]
    assert diversity(futures, longest=2) == pytest.approx((1 + 3 + 2) / 3)
    assert warped_diversity(futures) == pytest.approx((1 + 3 + 2) / 3)
    assert diversity(futures[:1], longest=2) == warped_diversity(futures[:1]) == 0.0


def test_displacement_is_over_the_real_length_and_of_the_best_sample():
    real = line(0, 1, 2)
    assert displacement([line(0, 1), line(5, 5, 5)], real) == pytest.approx(1 / 3)
    assert displacement([line(0, 1, 2, 9, 9)], real) == 0.0
    assert warped_displacement([line(9), line(0, 0, 1, 2, 2)], real) == 0.0


def test_pose_vectors_forget_place_and_heading_at_the_start_but_not_turns():
    poses = walker(30, seed=3).positions
    moved = rotate_yaw(poses, 2.0) + np.array([5.0, -3.0, 0.2])
    mine, theirs = (pose_vectors(p[9], p[10:], BODY21) for p in (poses, moved))
    assert mine.shape == (20, 60)
    np.testing.assert_allclose(mine, theirs, atol=1e-9)
    turning = poses.copy()
    turning[20:] = rotate_yaw(poses[20:], 1.0)
    assert np.abs(pose_vectors(turning[9], turning[10:], BODY21) - mine).max() > 0.1
