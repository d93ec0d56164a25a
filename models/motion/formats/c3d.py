"""C3D files, by the library ezc3d, which is an extra: ``pip install 'posefutures[formats]'``.

Damaged files make ezc3d end its process or run for ever, so it reads in one of its own, which is
this module run as a program: ``python -m models.motion.formats.c3d walk.c3d points.npz``.
"""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from models.motion.formats.errors import MalformedFileError, UnsupportedFileError
from models.motion.formats.points import point_motion
from models.motion.motion import Motion

_MAGIC = 0x50  # the second byte of every C3D file
_PATIENCE_S = 30.0


def read_c3d(path: Path) -> Motion:
    """The motion of a C3D file whose points are joints.

    Raises:
        UnsupportedFileError: ezc3d is not installed, or the points are no joints.
        FormatError: The file is damaged.
    """
    with path.open("rb") as file:
        head = file.read(512)
    if len(head) < 512 or head[1] != _MAGIC:
        raise MalformedFileError(path.name, found="another header", right="it must be a C3D file")
    if find_spec("ezc3d") is None:
        raise UnsupportedFileError(
            path.name,
            found="a C3D file, and no ezc3d to read it with",
            right="pip install 'posefutures[formats]'",
        )
    with TemporaryDirectory(prefix="posefutures-") as folder:
        out = Path(folder) / "points.npz"
        command = [sys.executable, "-m", __name__, str(path), str(out)]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PATIENCE_S)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            raise MalformedFileError(
                path.name, found="damage", right="it must be a whole C3D file"
            ) from error
        with np.load(out, allow_pickle=False) as arrays:
            points, labels = arrays["points"], [str(label) for label in arrays["labels"]]
            fps, units = float(arrays["fps"]), str(arrays["units"])
    # A point that was lost is 0 in all coordinates in some files, and NaN in ezc3d's reading.
    poses = np.where((points == 0.0).all(axis=-1, keepdims=True), np.nan, points)
    return point_motion(
        poses[:, : len(labels)],
        labels[: poses.shape[1]],
        name=path.stem,
        fps=fps,
        units=units,
    )


def _extract(path: str, out: str) -> None:
    """Writes points (T, N, 3) of a C3D file, their labels, rate and unit."""
    import ezc3d

    content = ezc3d.c3d(path)
    about = content["parameters"]["POINT"]
    np.savez(
        out,
        allow_pickle=False,
        points=content["data"]["points"][:3].transpose(2, 1, 0),
        labels=np.array([str(label) for label in about["LABELS"]["value"]], dtype=np.str_),
        fps=np.float64(about["RATE"]["value"][0]),
        units=np.array(str((about.get("UNITS", {}).get("value") or ["mm"])[0])),
    )


if __name__ == "__main__":
    _extract(*sys.argv[1:])
