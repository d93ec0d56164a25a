"""ROS 2 messages to poses and futures to markers: arithmetic on messages, without rclpy.

Messages are made by the types that are handed in, so that no ROS is needed to read or test this.
Axes are those of REP-103, metres and +Z up, which are the service's own.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

# Links of REP-155's human description, without the body's id, and the joints of body21 they are.
REP155_LINKS = {
    "body": "hips", "torso": "chest", "head": "head",
    "l_shoulder": "left_upper_arm", "l_elbow": "left_lower_arm", "l_wrist": "left_hand",
    "r_shoulder": "right_upper_arm", "r_elbow": "right_lower_arm", "r_wrist": "right_hand",
    "l_hip": "left_upper_leg", "l_knee": "left_lower_leg", "l_ankle": "left_foot",
    "r_hip": "right_upper_leg", "r_knee": "right_lower_leg", "r_ankle": "right_foot",
}  # fmt: skip
BONES = (
    ("body", "torso"), ("torso", "head"),
    ("torso", "l_shoulder"), ("l_shoulder", "l_elbow"), ("l_elbow", "l_wrist"),
    ("torso", "r_shoulder"), ("r_shoulder", "r_elbow"), ("r_elbow", "r_wrist"),
    ("body", "l_hip"), ("l_hip", "l_knee"), ("l_knee", "l_ankle"),
    ("body", "r_hip"), ("r_hip", "r_knee"), ("r_knee", "r_ankle"),
)  # fmt: skip

LINE_LIST, ADD, DELETEALL = 5, 0, 3  # of visualization_msgs/Marker


def skeleton() -> dict[str, Any]:
    """The skeleton of a request whose poses list the links of `REP155_LINKS`."""
    links = list(REP155_LINKS)
    above = {child: parent for parent, child in BONES}
    parents = [links.index(above[link]) if link in above else -1 for link in links]
    return {"joints": links, "map": REP155_LINKS, "parents": parents}


def seconds(stamp: Any) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def pose_of_transforms(positions: Mapping[str, Any], body_id: str) -> np.ndarray:
    """Pose (J, 3) of the links of a body, from {frame id: geometry_msgs/Vector3}; else NaN."""
    unseen = (np.nan, np.nan, np.nan)
    return np.array(
        [_xyz(positions.get(f"{link}_{body_id}")) or unseen for link in REP155_LINKS], dtype=float
    )


def pose_of_array(message: Any, *, num_joints: int) -> np.ndarray:
    """Pose (J, 3) of a geometry_msgs/PoseArray whose poses are the joints, NaN where not seen.

    Raises:
        ValueError: it has another number of poses.
    """
    if len(message.poses) != num_joints:
        raise ValueError(
            f"poses: found {len(message.poses)}; the skeleton has {num_joints} joints."
        )
    return np.array([_xyz(pose.position) for pose in message.poses], dtype=float)


def markers(  # noqa: PLR0913 - the message's own parts
    futures: Iterable[np.ndarray],
    *,
    parents: Sequence[int],
    header: Any,
    marker: Callable[[], Any],
    point: Callable[..., Any],
    every: int = 10,
    probabilities: Sequence[float] | None = None,
) -> list[Any]:
    """Markers of a visualization_msgs/MarkerArray: one deletes the last ones, one for each future.

    A future (H, J, 3) is the lines of its bones in every tenth frame or so, the fainter the less
    probable it is; futures without ``probabilities`` are all as probable.
    """
    futures = list(futures)
    shares = probabilities or [1.0 / max(1, len(futures))] * len(futures)
    clear = marker()
    clear.header, clear.ns, clear.action = header, "futures", DELETEALL
    drawn = [clear]
    bones = [(parent, joint) for joint, parent in enumerate(parents) if parent >= 0]
    for i, (future, share) in enumerate(zip(futures, shares, strict=True)):
        lines = marker()
        lines.header, lines.ns, lines.id = header, "futures", i
        lines.type, lines.action = LINE_LIST, ADD
        lines.pose.orientation.w = 1.0
        lines.scale.x = 0.015
        lines.color.r, lines.color.g, lines.color.b = 0.9, 0.38, 0.0
        lines.color.a = float(np.clip(share * len(futures), 0.1, 1.0)) * 0.6
        lines.points = [
            point(x=float(x), y=float(y), z=float(z))
            for pose in future[every - 1 :: every]
            for bone in bones
            for x, y, z in pose[list(bone)]
        ]
        drawn.append(lines)
    return drawn


def _xyz(vector: Any) -> tuple[float, float, float] | None:
    return None if vector is None else (vector.x, vector.y, vector.z)
