"""The MOTION part of a BVH file: the number of frames, their time, and one row for each."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from models.motion.formats.errors import (
    ChannelCountError,
    EmptyMotionError,
    MalformedFileError,
    TruncatedFileError,
)
from models.motion.formats.text import numbers


def read_counts(lines: Sequence[str], start: int, file: str) -> tuple[int, float, int]:
    """The number of frames, the frame time in seconds, and the index of the first row."""
    values: list[float] = []
    index = start
    for key in ("Frames:", "Frame Time:"):
        index = next((i for i in range(index + 1, len(lines)) if lines[i].strip()), len(lines))
        if index == len(lines):
            raise TruncatedFileError(
                f"{file}:{index}", found="the end of the file", right=f"{key!r} must follow MOTION"
            )
        where, line = f"{file}:{index + 1}", lines[index].strip()
        if not line.lower().startswith(key.lower()):
            raise MalformedFileError(where, found=repr(line[:40]), right=f"{key!r} must come here")
        words = line[len(key) :].split()
        if len(words) != 1:
            raise MalformedFileError(where, found=repr(line[:40]), right="one number must follow")
        values += numbers(words, where)
        if values[-1] <= 0 or (key == "Frames:" and values[-1] % 1):
            error = EmptyMotionError if values[-1] == 0 else MalformedFileError
            raise error(where, found=repr(line[:40]), right="the number must be positive")
    return int(values[0]), values[1], index + 1


def read_rows(
    lines: Sequence[str], first: int, num_frames: int, num_channels: int, file: str
) -> Float[np.ndarray, "T C"]:
    """The values of every frame, one row each, from the line `first` on.

    Raises:
        FormatError: Rows are missing, too many, or of another length.
    """
    indices = [i for i in range(first, len(lines)) if lines[i].strip()]
    rows: list[list[float]] = []
    for i in indices[:num_frames]:
        words = lines[i].split()
        if len(words) != num_channels:
            is_cut = i == len(lines) - 1 and len(words) < num_channels
            error = TruncatedFileError if is_cut else ChannelCountError
            right = f"every frame must have {num_channels}, as the CHANNELS say"
            raise error(f"{file}:{i + 1}", found=f"{len(words)} values", right=right)
        rows.append(numbers(words, f"{file}:{i + 1}"))
    if len(indices) != num_frames:
        error = TruncatedFileError if len(indices) < num_frames else ChannelCountError
        where = f"{file}:{len(lines)}"
        raise error(
            where, found=f"{len(indices)} frames", right=f"there must be {num_frames}, as it says"
        )
    return np.array(rows).reshape(num_frames, num_channels)


def frames_per_second(frame_time: float) -> float:
    """The rate, whole where the frame time was only rounded: 0.0333333 s is 30."""
    fps = 1.0 / frame_time
    return float(round(fps)) if abs(fps - round(fps)) < 2e-4 * fps else fps
