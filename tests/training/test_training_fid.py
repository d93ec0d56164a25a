"""The Fréchet distance against closed forms and invariances."""

import numpy as np
import pytest

from training.fid import fid


def whitened(*shape: int, seed: int = 0) -> np.ndarray:
    """Features whose mean is 0 and whose covariance is the identity, exactly."""
    drawn = np.random.default_rng(seed).standard_normal(shape)
    centred = drawn - drawn.mean(axis=0)
    lower = np.linalg.cholesky(np.cov(centred, rowvar=False))
    return np.linalg.solve(lower, centred.T).T


def test_distance_to_itself_is_zero():
    features = np.random.default_rng(1).standard_normal((50, 8))
    assert fid(features, features[::-1]) == pytest.approx(0.0, abs=1e-9)


def test_moved_features_are_apart_by_the_square_of_the_way():
    features = np.random.default_rng(1).standard_normal((50, 3))
    assert fid(features, features + np.array([3.0, 4.0, 0.0])) == pytest.approx(25.0)


def test_axis_aligned_gaussians_have_the_closed_form():
    first, second = np.array([1.0, 2.0, 3.0]), np.array([4.0, 0.5, 3.0])
    a, b = whitened(40, 3) * first, whitened(70, 3, seed=1) * second
    assert fid(a, b) == pytest.approx(np.square(first - second).sum())


def test_gaussians_that_do_not_commute_have_the_root_of_their_product():
    a = whitened(40, 2) @ np.array([[2.0, 0.0], [1.0, 1.0]])
    b = whitened(40, 2, seed=1) @ np.array([[1.0, -2.0], [0.0, 3.0]])
    product = np.cov(a, rowvar=False) @ np.cov(b, rowvar=False)
    # The root of a 2 x 2 matrix has the trace sqrt(trace + 2 sqrt(determinant)).
    shared = np.sqrt(np.trace(product) + 2 * np.sqrt(np.linalg.det(product)))
    wanted = np.trace(np.cov(a, rowvar=False)) + np.trace(np.cov(b, rowvar=False)) - 2 * shared
    assert fid(a, b) == pytest.approx(wanted)
    assert fid(b, a) == pytest.approx(wanted)


def test_fewer_items_than_features_give_a_number():
    generator = np.random.default_rng(2)
    a, b = generator.standard_normal((5, 20)), generator.standard_normal((6, 20))
    assert fid(a, a) == pytest.approx(0.0, abs=1e-6)
    assert 0 < fid(a, b) < np.inf


def test_the_mean_does_not_count_as_spread():
    far = whitened(40, 2) + 1000.0
    assert fid(far, 2.0 * (far - 1000.0) + 1000.0) == pytest.approx(2.0)
