"""C3D files, by the library ezc3d, which is an extra: ``pip install 'posefutures[formats]'``."""

from pathlib import Path

import numpy as np

from models.motion.formats.errors import MalformedFileError, UnsupportedFileError
from models.motion.formats.points import point_motion
from models.motion.motion import Motion

MAGIC = 0x50  # the second byte of every C3D file


def read_c3d(path: Path) -> Motion:
    """The motion of a C3D file whose points are joints.

    Raises:
        UnsupportedFileError: ezc3d is not installed, or the points are no joints.
        FormatError: The file is damaged.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise UnsupportedFileError(
            path.name,
            found="a C3D file, and no ezc3d to read it with",
            right="pip install 'posefutures[formats]'",
        ) from error
    with path.open("rb") as file:
        head = file.read(512)
    if len(head) < 512 or head[1] != MAGIC:
        raise MalformedFileError(path.name, found="another header", right="it must be a C3D file")
    try:
        content = ezc3d.c3d(str(path))
        points = np.moveaxis(content["data"]["points"][:3], 0, -1)  # (N, T, 3)
        about = content["parameters"]["POINT"]
        labels = [str(label) for label in about["LABELS"]["value"]]
        fps = float(about["RATE"]["value"][0])
        units = str(about.get("UNITS", {"value": ["mm"]})["value"][0])
    except (RuntimeError, ValueError, KeyError, IndexError, MemoryError, OSError) as error:
        found = f"{type(error).__name__} ({error})"
        raise MalformedFileError(path.name, found=found, right="it must be a whole C3D") from error
    # A point that was lost is 0 in all coordinates in some files, and NaN in ezc3d's reading.
    poses = np.where((points == 0.0).all(axis=-1, keepdims=True), np.nan, points).swapaxes(0, 1)
    return point_motion(poses, labels[: poses.shape[1]], name=path.stem, fps=fps, units=units)
