"""Frames of pose estimators in JSON: MediaPipe's world landmarks and OpenPose's 3D keypoints."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from models.motion.formats.errors import EmptyMotionError, InvalidNumberError, MalformedFileError
from models.motion.gaps import at_even_times, even_rate, trusted
from models.motion.motion import Motion
from models.motion.skeleton import SENT_ORDERS, SKELETONS
from models.motion.standards import STANDARDS

LANDMARKS = ("worldLandmarks", "world_landmarks", "pose_world_landmarks", "poseWorldLandmarks")
"""Keys of MediaPipe Tasks in JavaScript and Python, and of the older solutions."""
PEOPLE, KEYPOINTS = "people", "pose_keypoints_3d"
_MILLISECONDS = ("timestamp_ms", "timestampMs", "frame_timestamp_ms")
_SECONDS = ("timestamp", "time", "t")

_Frame = Mapping[str, Any]


def holds_landmarks(content: object) -> bool:
    """Whether JSON is a frame of either estimator, a list of them, or has one under ``frames``."""
    frames = _frames(content)
    return bool(frames) and any(key in frames[0] for key in (*LANDMARKS, PEOPLE))


def read_landmarks(content: object, *, name: str, file: str, fps: float) -> Motion:
    """The motion of the first person in every frame, joints of ``mediapipe33`` or ``body25``.

    A joint that is hardly trusted in a frame was not seen there. Frames are at ``fps``, or where
    they tell their times, at the rate of most of them.

    Raises:
        FormatError: A frame is not as the others, or holds no 3D.
    """
    frames = _frames(content)
    skeleton = "body25" if PEOPLE in frames[0] else "mediapipe33"
    read = _openpose if skeleton == "body25" else _mediapipe
    num_joints = SKELETONS[skeleton].num_joints
    values = np.full((len(frames), num_joints, 4), np.nan)
    for i, frame in enumerate(frames):
        rows = read(frame)
        if rows is None:
            continue
        try:
            array = np.array(rows, dtype=np.float64).reshape(-1, 4)
        except (TypeError, ValueError) as error:
            raise _malformed(f"{file}: frame {i}", str(error)) from error
        if array.shape[0] != num_joints:
            raise _malformed(f"{file}: frame {i}", f"{len(array)} joints, not {num_joints}")
        values[i] = array
    seen = np.isfinite(values).all(axis=-1) & (values[..., 3] > 0.0)
    if not seen.any():
        raise EmptyMotionError(file, found="nobody in 3D", right="some frame must show a person")
    if np.isinf(values).any():
        raise InvalidNumberError(file, found="infinity", right="coordinates must be finite")
    worth = np.where(seen, values[..., 3], 0.0)
    world = STANDARDS[skeleton].axes.to_metres(values[..., :3])
    world[~(trusted(worth) & seen)] = np.nan
    return _timed(world[:, list(SENT_ORDERS[skeleton])], frames, skeleton, name, fps)


def _frames(content: object) -> Sequence[_Frame]:
    if isinstance(content, dict):
        content = content.get("frames", [content])
    listed = content if isinstance(content, list) else []
    return listed if listed and all(isinstance(frame, dict) for frame in listed) else []


def _mediapipe(frame: _Frame) -> Any:
    """x, y, z and visibility of each landmark of the first person; None where there is nobody."""
    found: Any = next((frame[key] for key in LANDMARKS if frame.get(key)), None)
    if not isinstance(found, list):
        return None
    if isinstance(found[0], list):
        found = found[0]
    return [
        [joint.get("x"), joint.get("y"), joint.get("z"), joint.get("visibility", 1.0)]
        for joint in found
        if isinstance(joint, dict)
    ]


def _openpose(frame: _Frame) -> Any:
    """x, y, z and confidence of each keypoint of the first person; None where there is nobody."""
    people = frame.get(PEOPLE)
    first = people[0] if isinstance(people, list) and people else {}
    return (first.get(KEYPOINTS) or None) if isinstance(first, dict) else None


def _timed(
    world: Float[np.ndarray, "T J 3"],
    frames: Sequence[_Frame],
    skeleton: str,
    name: str,
    fps: float,
) -> Motion:
    seconds = np.array([_seconds(frame) for frame in frames])
    if np.isfinite(seconds).all() and len(seconds) > 1 and (np.diff(seconds) > 0).all():
        fps = round(even_rate(seconds), 3)
        world = at_even_times(world, seconds, fps)
    return Motion(name=name, skeleton=SKELETONS[skeleton], positions=world, fps=fps)


def _seconds(frame: _Frame) -> float:
    for keys, unit in ((_MILLISECONDS, 1e-3), (_SECONDS, 1.0)):
        for key in keys:
            if isinstance(value := frame.get(key), int | float):
                return float(value) * unit
    return float("nan")


def _malformed(where: str, found: str) -> MalformedFileError:
    return MalformedFileError(
        where, found=found[:100], right="each joint has x, y, z and what it is worth"
    )
