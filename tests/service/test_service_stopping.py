import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.engine.stopping import rest_frames


def settling(num_frames: int, *, rate: float, seed: int = 0) -> np.ndarray:
    """(F, 3, 3) metres: joints that come to rest, nearer by a factor at every frame."""
    reach = np.random.default_rng(seed).normal(size=(3, 3))
    return (rate ** np.arange(num_frames)[:, None, None] * reach).astype(np.float32)


def slow_obvious_rest(frames, start: int, window: int, threshold_m: float) -> int:
    for i in range(start, len(frames) - window + 1):
        poses = [frame.astype(np.float64) for frame in frames[i : i + window]]
        mean = sum(poses) / window
        if sum(np.sqrt(((pose - mean) ** 2).sum()) for pose in poses) / window < threshold_m:
            return i
    return -1


def rest_frame(frames, *, start: int, window: int, threshold_m: float) -> int:
    """That of a single row."""
    starts = np.array([start])
    (found,) = rest_frames(frames[None], start=starts, window=window, threshold_m=threshold_m)
    return int(found)


@given(
    num_frames=st.integers(1, 40),
    rate=st.floats(0.5, 1.0),
    seed=st.integers(0, 9),
    start=st.integers(0, 45),
    window=st.integers(2, 8),
    threshold_m=st.sampled_from([1e-4, 0.01, 0.1, 1.0]),
)
def test_rest_is_that_of_a_loop_over_the_frames(num_frames, rate, seed, start, window, threshold_m):
    frames = settling(num_frames, rate=rate, seed=seed)
    found = rest_frame(frames, start=start, window=window, threshold_m=threshold_m)
    assert found == slow_obvious_rest(frames, start, window, threshold_m)


def test_spread_is_the_mean_distance_from_the_mean_pose_of_all_joints_as_one_vector():
    frames = np.zeros((2, 2, 3), np.float32)
    frames[1] = 1.0  # both poses are sqrt(6) / 2 from the mean
    assert rest_frame(frames, start=0, window=2, threshold_m=6**0.5 / 2 + 1e-6) == 0
    assert rest_frame(frames, start=0, window=2, threshold_m=6**0.5 / 2 - 1e-6) == -1


def test_body_that_stands_still_rests_at_the_first_frame_that_may_be_the_last():
    frames = np.ones((10, 21, 3), np.float32)
    assert rest_frame(frames, start=4, window=5, threshold_m=1e-9) == 4


@pytest.mark.parametrize("num_frames", [1, 8])
def test_window_that_is_not_whole_is_no_rest(num_frames):
    frames = np.ones((num_frames, 21, 3), np.float32)
    assert rest_frame(frames, start=4, window=5, threshold_m=1.0) == -1


def test_rows_do_not_depend_on_each_other():
    frames = np.stack([settling(30, rate=rate, seed=1) for rate in (0.6, 0.8, 0.9, 1.0)])
    starts = np.array([2, 9, 0, 3])
    together = rest_frames(frames, start=starts, window=5, threshold_m=0.1)
    alone = [
        rest_frame(row, start=start, window=5, threshold_m=0.1)
        for row, start in zip(frames, starts, strict=True)
    ]
    assert together.tolist() == alone
    assert len(set(alone)) == 4
