"""The messages here are stand-ins with the fields of ROS's own: no ROS can be installed."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from in_memory import Service
from tiny_bundles import walking

from examples.ros2.conversion import (
    ADD,
    DELETEALL,
    LINE_LIST,
    REP155_LINKS,
    markers,
    pose_of_array,
    pose_of_transforms,
    seconds,
    skeleton,
)
from models.motion.skeleton import BODY21

WALK = walking()
LINKS = [BODY21.index(joint) for joint in REP155_LINKS.values()]


def vector(x: float, y: float, z: float) -> SimpleNamespace:
    return SimpleNamespace(x=float(x), y=float(y), z=float(z))


def marker() -> SimpleNamespace:
    return SimpleNamespace(
        header=None, ns="", id=0, type=0, action=0, points=[],
        pose=SimpleNamespace(orientation=SimpleNamespace(w=0.0)),
        scale=vector(0, 0, 0), color=SimpleNamespace(r=0.0, g=0.0, b=0.0, a=0.0),
    )  # fmt: skip


def drawn(futures: list[np.ndarray], **fields: Any) -> list[SimpleNamespace]:
    return markers(
        futures, parents=BODY21.parents, header="now", marker=marker, point=vector, **fields
    )


def test_time_is_seconds():
    assert seconds(SimpleNamespace(sec=7, nanosec=250_000_000)) == 7.25


def test_links_of_a_body_become_a_pose_and_what_is_not_there_was_not_seen():
    positions = {
        f"{link}_ab": vector(*WALK[0][BODY21.index(joint)]) for link, joint in REP155_LINKS.items()
    }
    positions |= {"l_wrist_cd": vector(9, 9, 9)}
    del positions["l_wrist_ab"]
    pose = pose_of_transforms(positions, "ab")
    expected = WALK[0][LINKS].copy()
    expected[list(REP155_LINKS).index("l_wrist")] = np.nan
    np.testing.assert_array_equal(pose, expected)


def test_a_pose_array_becomes_a_pose():
    poses = [SimpleNamespace(position=vector(*joint), orientation=None) for joint in WALK[0]]
    message = SimpleNamespace(poses=poses)
    np.testing.assert_array_equal(pose_of_array(message, num_joints=21), WALK[0])
    with pytest.raises(ValueError, match="poses: found 21; the skeleton has 22 joints"):
        pose_of_array(message, num_joints=22)


def test_the_service_predicts_a_body_of_these_links(service: Service):
    poses = np.ascontiguousarray(WALK[:, LINKS])
    futures = service.futures(poses, skeleton=skeleton(), num_samples=2, seed=3)
    assert futures.shape == (2, 60, len(REP155_LINKS), 3)
    jump = np.linalg.norm(futures[:, 0] - poses[-1], axis=-1)
    assert jump.max() < 0.1


def test_futures_become_lines_of_bones():
    future = np.arange(25 * 21 * 3, dtype=float).reshape(25, 21, 3)
    clear, first, second = drawn([future, future + 1.0], every=10)
    assert (clear.action, clear.ns, clear.header) == (DELETEALL, "futures", "now")
    assert (first.type, first.action, first.ns) == (LINE_LIST, ADD, "futures")
    assert (first.id, second.id) == (0, 1)
    assert first.pose.orientation.w == 1.0
    assert first.scale.x > 0.0
    points = np.array([[p.x, p.y, p.z] for p in first.points]).reshape(2, 20, 2, 3)
    for frame, lines in zip((9, 19), points, strict=True):
        for joint, line in enumerate(lines, start=1):
            np.testing.assert_array_equal(line[0], future[frame, BODY21.parents[joint]])
            np.testing.assert_array_equal(line[1], future[frame, joint])


def test_what_is_less_probable_is_fainter():
    _, likely, unlikely = drawn([np.zeros((20, 21, 3))] * 2, probabilities=[0.9, 0.1])
    assert 0.0 < unlikely.color.a < likely.color.a <= 1.0


def test_no_future_deletes_what_was_drawn():
    assert [found.action for found in drawn([])] == [DELETEALL]
