import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from models.motion import rotations as rot

ORDERS = ["".join(order) for order in itertools.permutations("XYZ")]
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def quaternions(seed: int, *shape: int) -> np.ndarray:
    return rot.normalise(np.random.default_rng(seed).normal(size=(*shape, 4)))


seeds = st.integers(0, 2**31)
angles = arrays(np.float64, (5, 3), elements=st.floats(-7, 7))
directions = arrays(np.float64, (4, 3), elements=st.floats(-10, 10))


def same(a: np.ndarray, b: np.ndarray) -> None:
    """a and b are the same rotations, whatever their signs."""
    np.testing.assert_allclose(np.abs((a * b).sum(axis=-1)), 1.0, atol=1e-12)


def test_a_quarter_turn_about_up_takes_forward_to_left():
    turn = rot.from_axis_angles(np.array([np.pi / 2]), "Z")
    np.testing.assert_allclose(turn, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    np.testing.assert_allclose(rot.rotate(turn, np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-15)


@given(seeds)
def test_products_of_quaternions_are_products_of_matrices(seed):
    a, b = quaternions(seed, 6), quaternions(seed + 1, 6)
    product = rot.to_matrix(a) @ rot.to_matrix(b)
    np.testing.assert_allclose(rot.to_matrix(rot.multiply(a, b)), product, atol=1e-12)
    inverse = rot.multiply(a, rot.conjugate(a))
    np.testing.assert_allclose(inverse, np.broadcast_to(IDENTITY, a.shape), atol=1e-12)


@given(seeds)
def test_matrices_and_6d_values_come_back_as_the_same_rotations(seed):
    q = quaternions(seed, 20)
    matrix = rot.to_matrix(q)
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0)
    same(rot.from_matrix(matrix), q)
    np.testing.assert_allclose(rot.from_six(rot.to_six(matrix)), matrix, atol=1e-12)


def test_half_turns_come_back_from_matrices():
    for axis in np.eye(3):
        q = np.concatenate([[0.0], axis])
        same(rot.from_matrix(rot.to_matrix(q)), q)


@given(arrays(np.float64, (3, 6), elements=st.floats(-1e3, 1e3)))
def test_any_6d_value_gives_finite_columns_and_most_a_rotation(six):
    matrix = rot.from_six(six)
    assert np.isfinite(matrix).all()
    independent = np.linalg.norm(np.cross(six[:, :3], six[:, 3:]), axis=-1) > 1e-3
    gram = np.swapaxes(matrix, -1, -2) @ matrix
    np.testing.assert_allclose(gram[independent], np.eye(3)[None].repeat(independent.sum(), 0),
                               atol=1e-5)  # fmt: skip


@pytest.mark.parametrize("order", ORDERS)
@given(angles)
def test_euler_angles_come_back_as_the_same_rotation(order, values):
    q = rot.from_axis_angles(values, order)
    same(rot.from_axis_angles(rot.to_euler(q, order), order), q)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("middle", [np.pi / 2, -np.pi / 2])
def test_euler_angles_survive_gimbal_lock(order, middle):
    q = rot.from_axis_angles(np.array([0.4, middle, -1.1]), order)
    found = rot.to_euler(q, order)
    np.testing.assert_allclose(
        rot.to_matrix(rot.from_axis_angles(found, order)), rot.to_matrix(q), atol=1e-7
    )


def test_euler_angles_are_those_put_in():
    values = np.array([0.3, -0.7, 1.2])
    np.testing.assert_allclose(rot.to_euler(rot.from_axis_angles(values, "ZXY"), "ZXY"), values)
    with pytest.raises(ValueError, match="'XYX'"):
        rot.to_euler(IDENTITY, "XYX")


@given(directions, directions)
def test_swing_turns_one_direction_onto_the_other(start, end):
    lengths = np.linalg.norm(start, axis=-1), np.linalg.norm(end, axis=-1)
    ok = (lengths[0] > 1e-3) & (lengths[1] > 1e-3)
    q = rot.swing(start, end)
    assert np.isfinite(q).all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0)
    turned = rot.rotate(q, start)[ok] / lengths[0][ok, None]
    np.testing.assert_allclose(turned, end[ok] / lengths[1][ok, None], atol=1e-5)


def test_swing_takes_the_shortest_way_and_turns_about_when_opposite():
    q = rot.swing(np.array([1.0, 0, 0]), np.array([0.0, 2.0, 0]))
    np.testing.assert_allclose(q, rot.from_axis_angles(np.array([np.pi / 2]), "Z"))
    there = rot.rotate(rot.swing(np.array([0.0, 0, 3]), np.array([0.0, 0, -1])), np.eye(3)[2])
    np.testing.assert_allclose(there, [0, 0, -1], atol=1e-12)
    np.testing.assert_array_equal(rot.swing(np.zeros(3), np.ones(3)), IDENTITY)


@given(st.floats(-3, 3), st.floats(0, 1))
def test_slerp_turns_at_a_constant_rate(angle, weight):
    end = rot.from_axis_angles(np.array([angle]), "Y")
    q = rot.slerp(IDENTITY, -end, np.array(weight))
    expected = rot.from_axis_angles(np.array([angle * weight]), "Y")
    np.testing.assert_allclose(rot.to_matrix(q), rot.to_matrix(expected), atol=1e-9)


def test_signs_follow_the_frame_before():
    path = rot.from_axis_angles(np.linspace(0, 12, 50)[:, None], "Z")
    flipped = path * np.random.default_rng(0).choice([-1.0, 1.0], size=(50, 1))
    np.testing.assert_allclose(rot.continuous_sign(flipped) * np.sign(flipped[0, 0]), path)


def test_a_zero_quaternion_becomes_the_identity():
    np.testing.assert_array_equal(rot.normalise(np.zeros((2, 4))), [IDENTITY, IDENTITY])


@pytest.mark.parametrize("axis", "XYZ")
def test_a_vector_along_an_axis_is_a_turn_about_it(axis):
    angles = np.array([-3.0, -0.4, 0.0, 1e-9, 0.7, 3.1])
    vectors = angles[:, None] * np.eye(3)["XYZ".index(axis)]
    turns = rot.from_rotation_vectors(vectors)
    np.testing.assert_allclose(turns, rot.from_axis_angles(angles[:, None], axis), atol=1e-15)


@given(seeds)
def test_a_turn_keeps_its_vector_and_follows_it_from_frame_to_frame(seed):
    vectors = np.random.default_rng(seed).normal(size=(6, 3))
    turns, turned = rot.from_rotation_vectors(vectors), quaternions(seed, 6)
    np.testing.assert_allclose(rot.rotate(turns, vectors), vectors, atol=1e-12)
    seen = rot.from_rotation_vectors(rot.rotate(turned, vectors))
    same(seen, rot.multiply(rot.multiply(turned, turns), rot.conjugate(turned)))
