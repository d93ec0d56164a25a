"""``data_3d_h36m.npz``, in both of its layouts, and ``data_3d_humaneva15.npz``.

The files in which the field passes Human3.6M and HumanEva-I on.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from models.motion.formats.errors import InvalidNumberError, UnsupportedFileError
from models.motion.formats.pickled import holds_key, read_dictionary
from models.motion.motion import Motion
from models.motion.skeleton import H36M17, HUMANEVA15, Skeleton

KEY = "positions_3d"
KEPT_OF_32 = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)
LAYOUTS: dict[tuple[int, ...], tuple[Skeleton, float, tuple[int, ...]]] = {
    (32, 3): (H36M17, 50.0, KEPT_OF_32),
    (17, 3): (H36M17, 50.0, tuple(range(17))),
    (15, 3): (HUMANEVA15, 60.0, tuple(range(15))),
}
"""Skeleton, frames per second and the joints that are kept, by the shape of a frame."""


def holds_positions_3d(path: Path) -> bool:
    """Whether an npz file has the key of these formats; damaged files have not."""
    return holds_key(path, KEY)


def read_positions_3d(path: Path) -> Iterator[tuple[str, str, Motion]]:
    """Subject, action and motion of every clip in metres, joints of `h36m17` or `humaneva15`.

    The file is a pickled dictionary by subject and action of (T, 32, 3), (T, 17, 3) or, for
    HumanEva-I, (T, 15, 3) positions. A pickle can run code when it is read: read only files from
    those you trust.

    Raises:
        UnsupportedFileError: the file holds another number of joints.
        MalformedFileError: it is damaged or not a dictionary.
        InvalidNumberError: a value is not finite.
    """
    for subject, actions in read_dictionary(path, KEY).items():
        for action, found in actions.items():
            where = f"{path.name}: {subject}, {action}"
            positions = np.asarray(found, np.float32)
            if positions.ndim != 3 or positions.shape[1:] not in LAYOUTS:
                raise UnsupportedFileError(
                    where,
                    found=f"the shape {positions.shape}",
                    right="must be (frames, 32, 17 or 15, 3)",
                )
            if not np.isfinite(positions).all():
                raise InvalidNumberError(
                    where, found="NaN or infinity", right="must be finite metres"
                )
            skeleton, fps, kept = LAYOUTS[positions.shape[1:]]
            name = f"{subject}_{action}".replace(" ", "_").replace("/", "_")
            poses = positions[:, kept]
            yield subject, action, Motion(name=name, skeleton=skeleton, positions=poses, fps=fps)
