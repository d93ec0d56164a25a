"""Motions of AMASS: pose parameters of the SMPL family with a path, in npz files."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from models.motion import rotations as rot
from models.motion.formats.errors import InvalidNumberError, MalformedFileError
from models.motion.motion import Motion
from models.motion.smpl import smpl_motion, smpl_rotations, upright

RATES = ("mocap_framerate", "mocap_frame_rate")
"""Keys of the rate: of the files for SMPL-H, and of those for SMPL-X."""
KEYS = ("poses", "trans")
_FROM_BODY = rot.from_matrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))


def amass_motion(arrays: Mapping[str, np.ndarray], path: Path) -> Motion:
    """The motion of the parameters ``poses`` (T, D) and ``trans`` (T, 3), joints of ``smpl22``.

    The body is the template of `models.motion.smpl`, whatever the person's shape. The world is the
    file's where its +Z is up, as in AMASS, and turned upright where it is not.

    Raises:
        MalformedFileError: The rate is missing, or an array has another shape.
        InvalidNumberError: A value is not finite.
    """
    rate = next((key for key in RATES if key in arrays), None)
    if rate is None:
        raise MalformedFileError(
            path.name, found=f"none of {', '.join(RATES)}", right="one must tell the frame rate"
        )
    poses, trans = arrays["poses"], arrays["trans"]
    if poses.ndim != 2 or poses.shape[1] < 66 or trans.shape != (len(poses), 3) or not len(poses):
        raise MalformedFileError(
            path.name,
            found=f"poses {poses.shape} and trans {trans.shape}",
            right="they must be (frames, 66 or more) and (frames, 3)",
        )
    fps = float(arrays[rate])
    if not (np.isfinite(poses).all() and np.isfinite(trans).all() and 0.0 < fps < 1e4):
        raise InvalidNumberError(path.name, found="a value that is not finite", right="all must be")
    rotations = smpl_rotations(poses)
    turn = upright(rotations[:, 0])
    # The world is turned with the body, which has +Z forward: its up is +X where the file's is +Z.
    if np.allclose(rot.rotate(turn, np.array([1.0, 0.0, 0.0])), [0.0, 0.0, 1.0]):
        turn = _FROM_BODY
    path_m = rot.rotate(turn, trans.astype(np.float64)[:, [2, 0, 1]])
    return smpl_motion(rotations, turn=turn, name=path.stem, fps=fps, path=path_m)
