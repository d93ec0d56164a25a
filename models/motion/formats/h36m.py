"""``data_3d_h36m.npz``, the file in which the field passes Human3.6M on, in both of its layouts."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from models.motion.formats.errors import InvalidNumberError, UnsupportedFileError
from models.motion.formats.pickled import holds_key, read_dictionary
from models.motion.motion import Motion
from models.motion.skeleton import H36M17

KEY = "positions_3d"
FPS = 50.0
KEPT_OF_32 = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)


def holds_h36m(path: Path) -> bool:
    """Whether an npz file has the key of this format; damaged files have not."""
    return holds_key(path, KEY)


def read_h36m(path: Path) -> Iterator[tuple[str, Motion]]:
    """Subject and motion of every clip, joints of ``h36m17``, metres, 50 frames per second.

    The file is a pickled dictionary by subject and action of (T, 32, 3) or (T, 17, 3) positions.
    A pickle can run code when it is read: read only files from those you trust.

    Raises:
        UnsupportedFileError: the file holds another number of joints.
        MalformedFileError: it is damaged or not a dictionary.
        InvalidNumberError: a value is not finite.
    """
    for subject, actions in read_dictionary(path, KEY).items():
        for action, positions in actions.items():
            where = f"{path.name}: {subject}, {action}"
            poses = _joints(np.asarray(positions, np.float32), where)
            name = f"{subject}_{action}".replace(" ", "_")
            yield subject, Motion(name=name, skeleton=H36M17, positions=poses, fps=FPS)


def _joints(positions: np.ndarray, where: str) -> np.ndarray:
    if positions.ndim != 3 or positions.shape[1:] not in ((32, 3), (17, 3)):
        raise UnsupportedFileError(
            where, found=f"the shape {positions.shape}", right="must be (frames, 32 or 17, 3)"
        )
    if not np.isfinite(positions).all():
        raise InvalidNumberError(where, found="NaN or infinity", right="must be finite metres")
    return positions[:, KEPT_OF_32] if positions.shape[1] == 32 else positions
