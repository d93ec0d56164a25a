"""npz files of one motion: our own plain ones, those of AMASS, and archives of one clip."""

from collections.abc import Mapping
from io import BufferedIOBase
from pathlib import Path

import numpy as np

from models.motion.formats.amass import KEYS as AMASS_KEYS
from models.motion.formats.amass import amass_motion
from models.motion.formats.errors import MalformedFileError, UnsupportedFileError
from models.motion.formats.npz import DAMAGE, read_archive
from models.motion.motion import Motion
from models.motion.skeleton import SkeletonError, in_tree_order

KEYS = ("positions", "joints", "fps")
_ARCHIVE_KEY = "clip_start"


def read_npz(path: Path) -> Motion:
    """The one motion in an npz file.

    Our own hold ``positions`` (T, J, 3) in metres, +Z up, NaN where unseen, ``joints`` (J,),
    ``fps`` and, where there are bones, ``parents`` (J,).

    Raises:
        FormatError: The file is damaged, of another layout, or holds several clips.
    """
    names = _names(path)
    if _ARCHIVE_KEY in names:
        clips = list(read_archive(path))
        if len(clips) == 1:
            return clips[0].motion
        raise UnsupportedFileError(
            path.name, found=f"{len(clips)} clips", right="use read_archive for more than one"
        )
    if set(AMASS_KEYS) <= names:
        return amass_motion(_arrays(path, names), path)
    if set(KEYS) <= names:
        return _motion(_arrays(path, names), path)
    raise UnsupportedFileError(
        path.name,
        found=f"the arrays {', '.join(sorted(names)[:20]) or 'of nothing'}",
        right=f"it must hold {', '.join(KEYS)}, or AMASS's {', '.join(AMASS_KEYS)} and rate",
    )


def write_npz(path_or_file: Path | BufferedIOBase, motion: Motion) -> None:
    """Writes a motion so that `read_npz` reads it, positions as float32."""
    np.savez_compressed(
        path_or_file,
        allow_pickle=False,
        positions=motion.positions.astype(np.float32),
        joints=np.array(motion.skeleton.joints),
        parents=np.array(motion.skeleton.parents),
        fps=np.float64(motion.fps),
    )


def _names(path: Path) -> set[str]:
    with path.open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                return set(archive.files)
        except DAMAGE as error:
            raise _damaged(path, error) from error


def _arrays(path: Path, names: set[str]) -> dict[str, np.ndarray]:
    """Every array that is no pickled object, of which AMASS has some that are not needed."""
    arrays = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            for name in names - {"gender", "surface_model_type", "marker_labels"}:
                arrays[name] = archive[name]
    except DAMAGE as error:
        raise _damaged(path, error) from error
    return arrays


def _motion(arrays: Mapping[str, np.ndarray], path: Path) -> Motion:
    positions, joints = arrays["positions"], [str(joint) for joint in arrays["joints"].ravel()]
    numeric = positions.dtype.kind == "f" and arrays["fps"].dtype.kind in "if"
    if not numeric or positions.shape[1:] != (len(joints), 3) or not len(positions):
        raise MalformedFileError(
            path.name,
            found=f"positions {positions.shape} of {positions.dtype} and {len(joints)} joints",
            right="they must be numbers, (frames, joints, 3)",
        )
    wrong = ~np.isfinite(positions) & ~np.isnan(positions).all(axis=-1, keepdims=True)
    if wrong.any() or not 0.0 < float(arrays["fps"]) < 1e4:
        raise MalformedFileError(
            path.name, found="a value that is not finite", right="all must be, or three be NaN"
        )
    given = arrays.get("parents")
    parents = [-1, *[0] * (len(joints) - 1)] if given is None else given.ravel().tolist()
    try:
        tree, order = in_tree_order(path.stem, joints, parents)
    except (SkeletonError, TypeError) as error:
        raise MalformedFileError(path.name, found="no tree", right=str(error)) from error
    return Motion(
        name=path.stem, skeleton=tree, positions=positions[:, order], fps=float(arrays["fps"])
    )


def _damaged(path: Path, error: Exception) -> MalformedFileError:
    return MalformedFileError(
        path.name,
        found=f"{type(error).__name__} ({error})",
        right="it must be a whole .npz of plain arrays",
    )
