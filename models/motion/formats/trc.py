"""TRC files (OpenSim, Pose2Sim): a table of points over time, in text."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from models.motion.formats.errors import ChannelCountError, MalformedFileError, TruncatedFileError
from models.motion.formats.points import point_motion
from models.motion.formats.text import numbers, read_lines
from models.motion.motion import Motion

_ROWS_BEFORE_DATA = 5  # file type, names and values of the header, labels, coordinate names


def read_trc(path: Path) -> Motion:
    """The motion of a TRC file whose points are joints; an empty cell is a point not seen.

    Raises:
        UnsupportedFileError: The points are no joints.
        FormatError: The file is cut or malformed.
    """
    lines = read_lines(path)
    if len(lines) < _ROWS_BEFORE_DATA:
        raise TruncatedFileError(
            f"{path.name}:{len(lines)}",
            found="the end of the file",
            right="five lines of header come before the points",
        )
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    missing = [key for key in ("DataRate", "Units") if not header.get(key, "").strip()]
    if missing:
        raise MalformedFileError(
            f"{path.name}:2", found=f"no {', '.join(missing)}", right="all must be there"
        )
    (fps,) = numbers([header["DataRate"]], f"{path.name}:3")
    labels = [cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip()]
    if not labels:
        raise MalformedFileError(
            f"{path.name}:4", found="no labels", right="the points' names must follow Frame# Time"
        )
    points = _points(lines, len(labels), path.name)
    return point_motion(points, labels, name=path.stem, fps=fps, units=header["Units"])


def _points(lines: Sequence[str], num_points: int, file: str) -> Float[np.ndarray, "T N 3"]:
    rows = []
    width = 3 * num_points
    for number, line in enumerate(lines[_ROWS_BEFORE_DATA:], start=_ROWS_BEFORE_DATA + 1):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split("\t")][2:]
        if len(cells) < width:
            cells += [""] * (width - len(cells))  # some write no tabs for what is empty at the end
        if any(cells[width:]):
            found, right = f"{len(cells)} values", f"{num_points} points have {width}"
            raise ChannelCountError(f"{file}:{number}", found=found, right=right)
        given = [i for i, cell in enumerate(cells[:width]) if cell and cell.lower() != "nan"]
        row = np.full(width, np.nan)
        row[given] = numbers([cells[i] for i in given], f"{file}:{number}")
        rows.append(row)
    return np.array(rows).reshape(-1, num_points, 3)
