from math import inf, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from service.answers.occupancy import (
    Box,
    Capsule,
    Region,
    body_distances,
    occupancy,
    segment_distances,
)

UNIT = Box(centre=np.zeros(3), size=np.array([2.0, 2.0, 2.0]))
numbers = st.floats(-5.0, 5.0).map(lambda x: round(x, 3))
points = arrays(np.float64, 3, elements=numbers)
boxes = st.builds(
    Box,
    centre=points,
    size=arrays(np.float64, 3, elements=st.floats(0.0, 4.0)),
    yaw=st.floats(-pi, pi),
)
capsules = st.builds(Capsule, start=points, end=points, radius=st.floats(0.0, 2.0))
regions = boxes | capsules


def distance(start: np.ndarray, end: np.ndarray, region: Region) -> float:
    return float(segment_distances(np.asarray(start), np.asarray(end), region))


def along(*numbers: float) -> np.ndarray:
    return np.array(numbers, dtype=float)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((0, 0, 0), 0.0), ((1, 1, 1), 0.0), ((3, 0, 0), 2.0), ((0, -4, 0.5), 3.0),
        ((4, 5, 0), 5.0), ((2, 2, 2), 3**0.5), ((-3, 3, -2), 3.0),
    ],
)  # fmt: skip
def test_a_point_is_as_far_from_a_box_as_from_its_face_edge_or_corner(point, expected):
    assert distance(along(*point), along(*point), UNIT) == pytest.approx(expected)


def test_a_bone_may_be_nearer_than_both_of_its_joints():
    assert distance(along(-9, 3, 0), along(9, 3, 0), UNIT) == pytest.approx(2.0)
    assert distance(along(-9, 0, 0), along(9, 0, 0), UNIT) == 0.0
    # Past the edge at (1, 1): the line x + y = 6 is 4 / sqrt(2) from it.
    assert distance(along(6, 0, 0), along(0, 6, 0), UNIT) == pytest.approx(4 / 2**0.5)
    ball = Capsule(start=along(0, 0, 0), end=along(0, 0, 0), radius=0.5)
    assert distance(along(-9, 3, 0), along(9, 3, 0), ball) == pytest.approx(2.5)


def test_crossing_lines_are_as_far_apart_as_their_planes():
    post = Capsule(start=along(0, 0, 0), end=along(0, 0, 2), radius=0.25)
    assert distance(along(-1, 1, 1), along(1, 1, 1), post) == pytest.approx(0.75)
    assert distance(along(-1, 0, 5), along(1, 0, 5), post) == pytest.approx(2.75)
    assert distance(along(3, 4, 1), along(6, 8, 1), post) == pytest.approx(4.75)
    assert distance(along(1, 0, 0), along(1, 0, 2), post) == pytest.approx(0.75)  # parallel


def test_a_box_is_turned_about_up():
    turned = Box(centre=along(1, 0, 0), size=along(2, 0.2, 2), yaw=pi / 2)
    assert distance(along(1, 3, 0), along(1, 3, 0), turned) == pytest.approx(2.0)
    assert distance(along(3, 0, 0), along(3, 0, 0), turned) == pytest.approx(1.9)
    eighth = Box(centre=along(0, 0, 0), size=along(2, 2, 2), yaw=pi / 4)
    assert distance(along(3, 0, 0), along(3, 0, 0), eighth) == pytest.approx(3 - 2**0.5)


@given(points, points, regions)
def test_no_point_of_a_bone_is_nearer_and_one_is_as_near(start, end, region):
    """The slow obvious way: very many points of the line."""
    times = np.linspace(0.0, 1.0, 2001)[:, None]
    dense = start + times * (end - start)
    sampled = segment_distances(dense, dense, region)
    spacing = np.linalg.norm(end - start) / 2000
    found = distance(start, end, region)
    assert found <= sampled.min() + 1e-6
    assert found >= sampled.min() - spacing - 1e-6


@given(points, points, boxes, points, st.floats(-pi, pi))
def test_distance_does_not_change_when_the_world_is_turned_and_moved(start, end, box, shift, yaw):
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    moved = Box(centre=turn @ box.centre + shift, size=box.size, yaw=box.yaw + yaw)
    assert distance(turn @ start + shift, turn @ end + shift, moved) == pytest.approx(
        distance(start, end, box), abs=1e-6
    )


@given(points, points, regions)
def test_distance_does_not_depend_on_the_direction_of_a_bone(start, end, region):
    assert distance(start, end, region) == pytest.approx(distance(end, start, region), abs=1e-6)


@given(points, points, points, regions)
def test_distance_changes_by_no_more_than_the_bone_moves(start, end, shift, region):
    moved = distance(start + shift, end + shift, region)
    assert abs(moved - distance(start, end, region)) <= np.linalg.norm(shift) + 1e-6


@given(points, points, capsules)
def test_a_thicker_capsule_is_nearer_by_as_much(start, end, capsule):
    thicker = Capsule(start=capsule.start, end=capsule.end, radius=capsule.radius + 0.5)
    near = distance(start, end, capsule)
    assert distance(start, end, thicker) == pytest.approx(max(0.0, near - 0.5), abs=1e-9) or (
        near == 0.0
    )


@given(points, points, points, points)
def test_a_bone_and_a_line_are_as_far_apart_either_way(start, end, other_start, other_end):
    def to(a: np.ndarray, b: np.ndarray) -> Capsule:
        return Capsule(start=a, end=b, radius=0.0)

    one = distance(start, end, to(other_start, other_end))
    assert one == pytest.approx(distance(other_start, other_end, to(start, end)), abs=1e-5)


def test_a_body_is_as_near_as_its_nearest_bone_in_each_frame():
    """Hips and head above a post that only the arm between two joints passes."""
    poses = np.array([[[0, 0, 1], [0, 0, 2], [2, 0, 1]], [[5, 0, 1], [5, 0, 2], [5, 0, 0]]], float)
    post = Capsule(start=along(1, 0, 0), end=along(1, 0, 0.5), radius=0.1)
    np.testing.assert_allclose(body_distances(poses, (-1, 0, 0), post), [0.4, 3.9])
    apart = body_distances(poses, (-1, -1, -1), post)
    np.testing.assert_allclose(apart, [1.25**0.5 - 0.1, 3.9])


@settings(max_examples=50)
@given(st.integers(0, 2**32), regions)
def test_a_body_is_as_near_as_the_nearest_of_all_its_bones(seed, region):
    """The slow obvious way: every bone is measured."""
    poses = np.random.default_rng(seed).normal(scale=2.0, size=(20, 6, 3))
    parents = (-1, 0, 1, 2, -1, 4)
    bones = [segment_distances(poses[:, parent if parent >= 0 else joint],
                               poses[:, joint], region)
             for joint, parent in enumerate(parents)]  # fmt: skip
    np.testing.assert_allclose(
        body_distances(poses, parents, region), np.min(bones, axis=0), atol=1e-9
    )


def test_entries_are_counted_and_their_times_ranked():
    far, at_once, late = [2.0] * 4, [0.1, 0.1, 0.1, 2.0], [2.0, 1.0, 0.2, 0.0]
    found = occupancy(
        [np.array(s) for s in (far, at_once, late, late)],
        margin_m=0.2, fps=10.0, levels=(0.25, 0.5, 0.75, 1.0),
    )  # fmt: skip
    np.testing.assert_allclose(found.probability, [0.25, 0.25, 0.75, 0.5])
    np.testing.assert_array_equal(found.num_lasting, [4, 4, 4, 4])
    assert found.never == 0.25
    np.testing.assert_allclose(found.first_entry_s, [0.1, 0.3, 0.3, inf])
    np.testing.assert_allclose(found.min_distance, [0.0, 0.0, 0.1, 2.0])


def test_futures_that_have_ended_tell_nothing_of_what_comes_after():
    found = occupancy(
        [np.array([1.0, 0.0]), np.array([1.0, 1.0, 1.0, 0.0])], margin_m=0.0, fps=1.0, levels=[0.5]
    )
    np.testing.assert_allclose(found.probability, [0.0, 0.5, 0.0, 1.0])
    np.testing.assert_array_equal(found.num_lasting, [2, 2, 1, 1])
    assert found.never == 0.0


@given(st.lists(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=5), min_size=1, max_size=6))
def test_a_wider_margin_is_entered_sooner_and_more_often(distances):
    samples = [np.array(sample) for sample in distances]
    tight, wide = (
        occupancy(samples, margin_m=margin, fps=10.0, levels=(0.1, 0.5, 0.9))
        for margin in (0.5, 1.0)
    )
    assert np.all(tight.probability <= wide.probability)
    assert tight.never >= wide.never
    assert np.all(tight.first_entry_s >= wide.first_entry_s)
    np.testing.assert_array_equal(tight.min_distance, wide.min_distance)
    assert tight.never == pytest.approx(
        np.mean([min(sample) > 0.5 for sample in distances]), abs=1e-12
    )
