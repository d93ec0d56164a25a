"""Poses as they are sent, as an array, or an error that says which number is wrong."""

import json
import sys
from collections.abc import Sequence
from itertools import chain
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float, Int, Shaped

from service.errors import FieldError, PosesError

_NUMBERS = {float, int}


def poses_array(
    poses: Sequence[Any] | Shaped[np.ndarray, "..."], *, num_joints: int
) -> Float[np.ndarray, "T J 3"]:
    """Poses in float64, a joint that is null, or three NaN in an array, as three NaN.

    Raises:
        PosesError: a frame or joint has a wrong shape, or a coordinate is not a finite number.
    """
    if isinstance(poses, np.ndarray):
        return _checked(poses, num_joints)
    for frame_index, frame in enumerate(poses):
        _check_frame(frame, frame_index, num_joints)
    joints = list(chain.from_iterable(poses))
    seen = [joint for joint in joints if joint is not None]
    if set(map(type, seen)) - {list} or set(map(len, seen)) - {3}:
        _refuse_joint(joints, num_joints)
    present = np.array([joint is not None for joint in joints], dtype=bool)
    array = np.full((len(joints), 3), np.nan)
    array[present] = _finite(list(chain.from_iterable(seen)), np.flatnonzero(present), num_joints)
    return array.reshape(len(poses), num_joints, 3)


def times_array(times: Sequence[Any], *, num_frames: int) -> Float[np.ndarray, "T"]:
    """Seconds of each frame.

    Raises:
        FieldError: there is not one for each frame, or they do not rise.
    """
    if len(times) != num_frames:
        raise FieldError(
            pointer="/timestamps",
            found=f"{len(times)} times",
            expected=f"there must be one for each of {num_frames} frames",
        )
    for i, time in enumerate(times):
        if not _is_finite(time) or (i and time <= times[i - 1]):
            raise FieldError(
                pointer=f"/timestamps/{i}",
                found=shown(time),
                expected="times are seconds, finite numbers of which each is later than the last",
            )
    return np.array(times, dtype=np.float64)


def confidence_array(
    confidence: Sequence[Any] | Shaped[np.ndarray, "..."], *, num_frames: int, num_joints: int
) -> Float[np.ndarray, "T J"]:
    """What each joint of each frame is worth.

    Raises:
        FieldError: there is not one number from 0 to 1 for each joint of each frame.
    """
    rows = confidence.tolist() if isinstance(confidence, np.ndarray) else list(confidence)
    if len(rows) != num_frames:
        raise FieldError(
            pointer="/confidence",
            found=f"{len(rows)} frames",
            expected=f"there must be one for each of {num_frames} frames",
        )
    expected = f"each frame has {num_joints} numbers from 0 to 1, one for each joint"
    for i, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != num_joints:
            raise FieldError(pointer=f"/confidence/{i}", found=shown(row), expected=expected)
        for j, value in enumerate(row):
            if not _is_finite(value) or not 0.0 <= value <= 1.0:
                raise FieldError(
                    pointer=f"/confidence/{i}/{j}", found=shown(value), expected=expected
                )
    return np.array(rows, dtype=np.float64).reshape(num_frames, num_joints)


def _checked(poses: Shaped[np.ndarray, "..."], num_joints: int) -> Float[np.ndarray, "T J 3"]:
    if poses.ndim != 3 or poses.shape[1:] != (num_joints, 3):
        raise PosesError(
            pointer="/poses",
            found=f"an array of shape {poses.shape}",
            expected=f"the skeleton has {num_joints} joints: its shape is (T, {num_joints}, 3)",
        )
    array = poses.astype(np.float64)
    wrong = ~np.isfinite(array) & ~np.isnan(array).all(axis=-1, keepdims=True)
    if wrong.any():
        frame, joint, axis = np.argwhere(wrong)[0]
        raise PosesError(
            pointer=f"/poses/{frame}/{joint}/{axis}",
            found=shown(float(array[frame, joint, axis])),
            expected="a coordinate is a finite number; a joint that was not seen is three NaN",
        )
    return array


def _refuse_joint(joints: Sequence[Any], num_joints: int) -> NoReturn:
    index = next(
        i
        for i, joint in enumerate(joints)
        if joint is not None and (not isinstance(joint, list) or len(joint) != 3)
    )
    raise PosesError(
        pointer=_pointer(index, num_joints),
        found=shown(joints[index]),
        expected="a joint is [x, y, z], or null where it was not seen",
    )


def _check_frame(frame: Any, frame_index: int, num_joints: int) -> None:
    if not isinstance(frame, list):
        raise PosesError(
            pointer=f"/poses/{frame_index}",
            found=shown(frame),
            expected=f"a frame is a list of {num_joints} joints",
        )
    if len(frame) != num_joints:
        raise PosesError(
            pointer=f"/poses/{frame_index}",
            found=f"{len(frame)} joints",
            expected=f"the skeleton has {num_joints} joints, and every frame lists them all",
        )


def _finite(
    numbers: list[Any], joint_indices: Int[np.ndarray, "P"], num_joints: int
) -> Float[np.ndarray, "P 3"]:
    if set(map(type, numbers)) <= _NUMBERS:
        try:
            array = np.array(numbers, dtype=np.float64).reshape(-1, 3)
        except OverflowError:  # an integer of more than 308 digits
            array = np.full((len(joint_indices), 3), np.inf)
        if np.isfinite(array).all():
            return array
    wrong = next(i for i, number in enumerate(numbers) if not _is_finite(number))
    raise PosesError(
        pointer=f"{_pointer(int(joint_indices[wrong // 3]), num_joints)}/{wrong % 3}",
        found=shown(numbers[wrong]),
        expected="a coordinate is a finite number; a joint that was not seen is null",
    )


def _is_finite(number: Any) -> bool:
    return type(number) in _NUMBERS and abs(number) <= sys.float_info.max


def _pointer(joint_index: int, num_joints: int) -> str:
    return f"/poses/{joint_index // num_joints}/{joint_index % num_joints}"


def shown(value: object) -> str:
    """What a value of a body is, in a few words."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, list | dict):
        return f"{'a list' if isinstance(value, list) else 'an object'} of {len(value)}"
    if isinstance(value, float) and not np.isfinite(value):
        return "NaN" if np.isnan(value) else "infinity"
    text = json.dumps(value, default=lambda other: type(other).__name__)
    return text if len(text) <= 40 else f"{text[:37]}..."
