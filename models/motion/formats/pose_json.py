"""Poses as JSON: the fields of a request of this service, and what pose estimators write."""

import json
from collections.abc import Mapping
from io import TextIOBase
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from models.motion.axes import UNITS_PER_METRE, Axes, Handed, Up
from models.motion.formats.errors import (
    EmptyMotionError,
    InvalidNumberError,
    MalformedFileError,
    UnsupportedFileError,
)
from models.motion.formats.landmarks import holds_landmarks, read_landmarks
from models.motion.gaps import at_even_times, even_rate
from models.motion.motion import Motion
from models.motion.skeleton import (
    SENT_ORDERS,
    SKELETONS,
    SkeletonError,
    in_tree_order,
    skeleton_from_names,
)
from models.motion.standards import STANDARDS
from models.motion.trees import guessed_parents

DECIMALS = 4


def read_json(path: Path, *, fps: float = 30.0) -> Motion:
    """The motion in a JSON file: a request's poses, or frames of MediaPipe or OpenPose.

    A folder is frames, a file for each, in the order of their names, as OpenPose writes them.
    ``fps`` is for frames that do not tell their time.

    Raises:
        FormatError: It is no JSON, or none of these.
    """
    try:
        content = _content(path)
    except (ValueError, RecursionError) as error:
        raise MalformedFileError(path.name, found=str(error), right="it must be JSON") from error
    if isinstance(content, dict) and "poses" in content:
        return _requested(content, path)
    if holds_landmarks(content):
        return read_landmarks(content, name=path.stem, file=path.name, fps=fps)
    raise UnsupportedFileError(
        path.name,
        found=f"an object of {', '.join(list(content)[:8])}"
        if isinstance(content, dict)
        else f"a {type(content).__name__}",
        right='it must hold "poses", or frames of MediaPipe (worldLandmarks) or OpenPose '
        "(pose_keypoints_3d)",
    )


def _content(path: Path) -> Any:
    if not path.is_dir():
        return json.loads(path.read_text(encoding="utf-8", errors="replace"))
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".json")
    return [json.loads(file.read_text(encoding="utf-8", errors="replace")) for file in files]


def write_json(path_or_file: Path | TextIOBase, motion: Motion) -> None:
    """Writes a motion as the fields of a request, to 0.1 mm."""
    fields = request_fields(motion)
    text = json.dumps(fields | {"poses": with_nulls(fields["poses"])})
    if isinstance(path_or_file, Path):
        path_or_file.write_text(text, encoding="utf-8")
    else:
        path_or_file.write(text)


def request_fields(motion: Motion) -> dict[str, Any]:
    """A motion as a request tells it; poses are an array in which NaN was not seen."""
    joints, parents = list(motion.skeleton.joints), list(motion.skeleton.parents)
    return {
        "name": motion.name,
        "poses": np.round(motion.positions, DECIMALS),
        "skeleton": {
            "joints": joints,
            "parents": parents,
            "map": dict(motion.skeleton.mapping) or None,
        },
        "axes": {"up": "z", "units": "m", "handed": "right"},
        "fps": motion.fps,
    }


def with_nulls(poses: Float[np.ndarray, "T J 3"]) -> list[Any]:
    """Poses for JSON, which has no NaN: a joint not seen is null."""
    frames: list[Any] = poses.tolist()
    for frame, joint in np.argwhere(np.isnan(poses[..., 0])):
        frames[frame][joint] = None
    return frames


def _requested(content: Mapping[str, Any], path: Path) -> Motion:
    raw = _positions(content["poses"], path)
    asked = content.get("skeleton", "body21")
    try:
        if isinstance(asked, str) and asked in SKELETONS:
            tree, order, axes = SKELETONS[asked], SENT_ORDERS[asked], STANDARDS[asked].axes
        else:
            named = skeleton_from_names(asked["joints"], asked.get("map"))
            axes = Axes()
            parents = asked.get("parents") or guessed_parents(named, raw[0])
            tree, order = in_tree_order(path.stem, named.joints, parents, named.mapping)
        if raw.shape[1] != tree.num_joints:
            raise SkeletonError(f"poses: found {raw.shape[1]} joints; it has {tree.num_joints}.")
    except (SkeletonError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise MalformedFileError(
            f"{path.name}: skeleton", found=str(asked)[:60], right=str(error).rstrip(".")
        ) from error
    if content.get("axes"):
        axes = _axes(content["axes"], path)
    positions, fps = _timed(axes.to_metres(raw[:, order]), content, path)
    name = str(content.get("name") or path.stem)
    return Motion(name=name, skeleton=tree, positions=positions, fps=fps)


def _axes(given: Any, path: Path) -> Axes:
    try:
        axes = Axes(**given)
        known = axes.units in UNITS_PER_METRE and axes.handed in get_args(Handed)
    except TypeError:
        known = False
    if not known or axes.up not in get_args(Up):
        raise MalformedFileError(
            f"{path.name}: axes",
            found=str(given)[:60],
            right='must be such as {"up": "y", "units": "cm", "handed": "right"}',
        )
    return axes


def _positions(poses: Any, path: Path) -> Float[np.ndarray, "T J 3"]:
    unseen = [np.nan] * 3
    try:
        listed = [[unseen if joint is None else joint for joint in frame] for frame in poses]
        raw = np.array(listed, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MalformedFileError(
            f"{path.name}: poses", found=str(error), right="must be [frames][joints][x, y, z]"
        ) from error
    if not len(raw):
        raise EmptyMotionError(f"{path.name}: poses", found="no frames", right="give at least one")
    if raw.ndim != 3 or raw.shape[2] != 3 or not raw.shape[1]:
        raise MalformedFileError(
            f"{path.name}: poses",
            found=f"the shape {raw.shape}",
            right="must be [frames][joints][x, y, z]",
        )
    if np.isinf(raw).any() or (np.isnan(raw).any(axis=-1) != np.isnan(raw).all(axis=-1)).any():
        raise InvalidNumberError(
            f"{path.name}: poses", found="NaN or infinity", right="numbers must be finite"
        )
    return raw


def _timed(
    positions: Float[np.ndarray, "T J 3"], content: Mapping[str, Any], path: Path
) -> tuple[Float[np.ndarray, "T J 3"], float]:
    """The positions at the rate that the file tells, or at that of most of its times."""
    try:
        times = np.array(content.get("timestamps") or [], dtype=np.float64)
        asked = None if content.get("fps") is None else float(content["fps"])
    except (TypeError, ValueError) as error:
        raise MalformedFileError(path.name, found=str(error), right="must be numbers") from error
    if times.size and not (times.shape == positions.shape[:1] and (np.diff(times) > 0).all()):
        raise InvalidNumberError(
            f"{path.name}: timestamps",
            found=f"{times.size} times",
            right="there must be one for each frame, and times must rise",
        )
    rate = asked or (even_rate(times) if times.size > 1 else 30.0)
    if asked == 0.0 or not 0.0 < rate < 1e4:
        raise InvalidNumberError(
            path.name, found=f"{asked} frames a second", right="it must be positive"
        )
    return (at_even_times(positions, times, rate) if times.size > 1 else positions), rate
