import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from models.motion.gaps import at_even_times, num_even

FPS = 30.0


def pose(t: float) -> np.ndarray:
    """Joints that move along lines, one of them fast."""
    return np.array([[t, 2.0 * t, 1.0], [-30.0 * t, 0.0, 2.0 + t]])


@given(st.lists(st.floats(1e-4, 0.4), min_size=1, max_size=50), st.floats(-100.0, 100.0))
def test_even_motion_is_even_however_uneven_its_frames_are(gaps: list[float], start: float):
    times = start + np.cumsum([0.0, *gaps])
    even = at_even_times(np.array([pose(t) for t in times]), times, FPS)
    assert len(even) == num_even(times[-1] - times[0], FPS)
    moments = times[-1] - np.arange(len(even))[::-1] / FPS
    held = np.maximum(moments, times[0])
    np.testing.assert_allclose(even, [pose(t) for t in held], atol=1e-6)
    assert abs(moments[0] - times[0]) <= 0.5 / FPS + 1e-9


def test_frames_that_come_evenly_are_taken_as_they_are():
    poses = np.random.default_rng(0).normal(size=(40, 2, 3))
    poses[[3, 30], 1] = np.nan
    for start in (0.0, 0.1, 1e6):
        times = start + np.arange(40) / FPS
        np.testing.assert_array_equal(at_even_times(poses, times, FPS), poses)


def test_a_joint_that_one_neighbour_lacks_was_not_seen_between_them():
    times = np.array([0.0, 0.05, 0.1])
    poses = np.array([pose(t) for t in times])
    poses[1, 1] = np.nan
    seen = np.isfinite(at_even_times(poses, times, FPS)[:, :, 0])
    np.testing.assert_array_equal(seen, [[True, True], [True, False], [True, False], [True, True]])
