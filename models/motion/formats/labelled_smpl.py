"""Labelled actions in pose parameters of the SMPL family, as Mao et al. 2022 pass them on.

GRAB, NTU RGB+D, HumanAct12 and BABEL, each in a file for training and one for testing.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from models.motion.formats.errors import (
    InvalidNumberError,
    MalformedFileError,
    UnsupportedFileError,
)
from models.motion.formats.pickled import holds_key, read_dictionary
from models.motion.motion import Motion
from models.motion.smpl import smpl_motion, smpl_rotations, upright

KEY = "data"
FPS = 30.0
"""Of all four as published; clips of GRAB have 15 to 30, and do not say which."""
NUM_PARAMETERS = (66, 72, 156, 165)
"""Of 22 joints alone, of SMPL, SMPL-H and SMPL-X."""
UNNAMED = "transition"
"""What lies between two actions of one clip, and shows none."""

Part = tuple[str, str, np.ndarray]
"""Action, name of the clip and its parameters."""


def holds_labelled_smpl(path: Path) -> bool:
    """Whether an npz file has the key of this format; damaged files have not."""
    return holds_key(path, KEY)


def read_labelled_smpl(path: Path) -> Iterator[tuple[str, Motion]]:
    """Action and motion of every clip, joints of ``smpl22``, on one template and without a path.

    The file is a pickled dictionary by action of lists of (T, D) parameters, or of dictionaries
    that hold them as ``poses``. Those that hold several actions are cut where they change. All
    clips of a file are put upright by the same turn.
    A pickle can run code when it is read: read only files from those you trust.

    Raises:
        UnsupportedFileError: parameters are not those of a body of the family.
        MalformedFileError: the file is damaged or of another layout.
        InvalidNumberError: a value is not finite.
    """
    parts = [
        (action, name, smpl_rotations(parameters))
        for action, name, parameters in _parts(read_dictionary(path, KEY), path.name)
    ]
    if not parts:
        raise MalformedFileError(f"{path.name}: {KEY}", found="no clips", right="must hold some")
    turn = upright(np.concatenate([rotations[:, 0] for _, _, rotations in parts]))
    for action, name, rotations in parts:
        yield action, smpl_motion(rotations, turn=turn, name=f"{path.stem}_{name}", fps=FPS)


def _parts(by_action: Mapping[Any, Any], file: str) -> Iterator[Part]:
    for action, clips in by_action.items():
        if not isinstance(clips, list | tuple | np.ndarray):
            raise MalformedFileError(
                f"{file}: {action}", found=type(clips).__name__, right="must be a list of clips"
            )
        for index, clip in enumerate(clips):
            where = f"{file}: {action}, {index}"
            name = f"{action}_{index}".replace(" ", "_")
            if not isinstance(clip, dict):
                yield str(action), name, _parameters(clip, where)
            elif "poses" not in clip:
                raise MalformedFileError(where, found=f"{sorted(clip)}", right="must hold poses")
            elif "frame_split" in clip and "act" in clip:
                yield from _cut(clip, name, where)
            else:
                yield str(action), name, _parameters(clip["poses"], where)


def _cut(clip: Mapping[str, Any], name: str, where: str) -> Iterator[Part]:
    """The actions of a clip that holds several, without what lies between them."""
    parameters, bounds = _parameters(clip["poses"], where), list(map(int, clip["frame_split"]))
    if len(bounds) != len(clip["act"]) + 1 or sorted({0, *bounds, len(parameters)}) != bounds:
        raise MalformedFileError(
            f"{where}: frame_split",
            found=f"{bounds} for {len(clip['act'])} actions",
            right=f"must rise from 0 to {len(parameters)} and enclose each action",
        )
    for part, action in enumerate(clip["act"]):
        if action != UNNAMED:
            frames = slice(bounds[part], bounds[part + 1])
            yield str(action), f"{name}_part{part + 1}", parameters[frames]


def _parameters(value: object, where: str) -> np.ndarray:
    try:
        parameters = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise MalformedFileError(where, found=str(error), right="must be numbers") from error
    if parameters.ndim != 2 or parameters.shape[1] not in NUM_PARAMETERS or not len(parameters):
        raise UnsupportedFileError(
            where,
            found=f"the shape {parameters.shape}",
            right=f"must be (frames, one of {', '.join(map(str, NUM_PARAMETERS))})",
        )
    if not np.isfinite(parameters).all():
        raise InvalidNumberError(where, found="NaN or infinity", right="must be finite radians")
    return parameters
