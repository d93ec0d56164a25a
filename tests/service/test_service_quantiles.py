"""Regions: balls about the samples' mean, widened by what the bundle was measured to need."""

import numpy as np
import pytest

from models.bundle import CalibrationSpec
from models.motion.kinematics import rotate_yaw
from service.answers.quantiles import MIN_SAMPLES, check_levels, regions
from service.errors import FieldError

CALIBRATION = CalibrationSpec(
    levels=(0.5, 0.9),
    times_s=(0.2, 0.4),
    factors=((1.0, 2.0), (3.0, 2.0)),
    num_samples=50,
    num_windows=100,
    measured_on=("split=valid",),
)


def futures_about(centre: np.ndarray, *, num_samples: int, seed: int = 0) -> np.ndarray:
    """(N, *centre) metres, wider from frame to frame."""
    generator = np.random.default_rng(seed)
    noise = generator.normal(size=(num_samples, *centre.shape))
    return centre + 0.1 * np.arange(1, len(centre) + 1)[:, None, None] * noise


def drift(num_frames: int = 8, num_joints: int = 5) -> np.ndarray:
    return np.random.default_rng(9).normal(size=(num_frames, num_joints, 3)).cumsum(axis=0)


@pytest.mark.parametrize("num_samples", [MIN_SAMPLES, 50, 200])
def test_another_sample_is_inside_as_often_as_the_level_says(num_samples: int):
    centre = np.zeros((100, 60, 3))
    samples = np.random.default_rng(1).normal(size=(num_samples, *centre.shape))
    truth = np.random.default_rng(2).normal(size=centre.shape)
    found = regions(samples, fps=30.0, calibration=None, levels=(0.5, 0.8, 0.9))
    inside = np.linalg.norm(truth - found.centre, axis=-1) <= found.radius
    more = inside.mean(axis=(1, 2)) - found.levels
    assert np.all(more > -0.02)
    assert np.all(more < 0.02 + 1 / (num_samples + 1))  # ranks are whole
    assert not found.calibrated


def test_higher_levels_have_wider_regions_about_the_mean():
    futures = futures_about(drift(), num_samples=50)
    found = regions(futures, fps=30.0, calibration=None)
    assert found.levels == (0.5, 0.9)
    assert found.centre.shape == (8, 5, 3)
    assert found.radius.shape == (2, 8, 5)
    assert np.all(found.radius[0] < found.radius[1])
    np.testing.assert_allclose(found.centre, futures.mean(axis=0))


def test_calibration_widens_by_the_time_of_a_frame_at_any_rate():
    futures = futures_about(drift(), num_samples=20)
    plain = regions(futures, fps=10.0, calibration=None)
    wider = regions(futures, fps=10.0, calibration=CALIBRATION)
    assert wider.calibrated
    factors = wider.radius / plain.radius
    expected = np.array([[1, 1, 1.5, 2, 2, 2, 2, 2], [3, 3, 2.5, 2, 2, 2, 2, 2]])
    np.testing.assert_allclose(factors, np.repeat(expected[:, :, None], 5, axis=2))
    twice_as_slow = regions(futures, fps=5.0, calibration=CALIBRATION, levels=(0.9,))
    np.testing.assert_allclose(twice_as_slow.radius[0, 0], 3.0 * plain.radius[1, 0])
    np.testing.assert_allclose(twice_as_slow.radius[0, 1], 2.0 * plain.radius[1, 1])


def test_regions_turn_and_move_with_the_world():
    futures = futures_about(drift(), num_samples=12)
    moved = rotate_yaw(futures, 0.7) + np.array([3.0, -2.0, 0.0])
    here = regions(futures, fps=30.0, calibration=None)
    there = regions(moved, fps=30.0, calibration=None)
    expected = rotate_yaw(here.centre, 0.7) + np.array([3.0, -2.0, 0.0])
    np.testing.assert_allclose(there.centre, expected, atol=1e-9)
    np.testing.assert_allclose(there.radius, here.radius, atol=1e-9)


def test_samples_that_are_all_alike_have_regions_of_no_width():
    futures = np.repeat(drift()[None], 20, axis=0)
    found = regions(futures, fps=30.0, calibration=CALIBRATION)
    np.testing.assert_allclose(found.radius, 0.0, atol=1e-12)


def test_too_few_samples_are_refused_by_their_field():
    futures = futures_about(drift(), num_samples=MIN_SAMPLES - 1)
    with pytest.raises(FieldError, match=r"num_samples: found 9; must be at least 10") as error:
        regions(futures, fps=30.0, calibration=None)
    assert error.value.pointer == "/num_samples"


def test_level_that_was_not_measured_is_refused_before_anything_runs():
    with pytest.raises(FieldError, match=r"found 0\.7; must be one of 0\.5, 0\.9") as error:
        check_levels((0.5, 0.7), num_samples=50, calibration=CALIBRATION)
    assert error.value.pointer == "/quantile_levels/1"
    check_levels((0.7,), num_samples=50, calibration=None)
