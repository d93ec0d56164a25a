"""Archives of many clips on body21 in one `.npz`, as the README of the data describes them."""

import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int16

from models.motion.formats.errors import (
    EmptyMotionError,
    InvalidNumberError,
    MalformedFileError,
    UnsupportedFileError,
)
from models.motion.kinematics import inverse_kinematics, rest_pose
from models.motion.motion import Motion
from models.motion.skeleton import BODY21

_UNIT_M = 1e-4
_ONE = 32767
_TEXTS = ("name", "action", "style", "subject", "split", "source", "description")
_FRAME_SHAPES = {"positions": (21, 3), "root": (3,), "rotations": (21, 4)}
_KINDS = {"positions": "i", "root": "f", "rotations": "i", "rest_offsets": "f", "clip_floor": "f"}
DAMAGE = (  # what numpy and zipfile raise on damaged archives
    zipfile.BadZipFile, zlib.error, OSError, EOFError, KeyError, ValueError, TypeError,
    SyntaxError, NotImplementedError, RuntimeError, MemoryError, OverflowError,
    AttributeError,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Clip:
    """One clip as stored: `positions` relative to the hips in 0.1 mm, `rotations` times 32767.

    `floor` is the height of the lower toe joint in metres when it is down. '' means unknown.
    """

    name: str
    positions: Int16[np.ndarray, "T 21 3"]
    root: Float32[np.ndarray, "T 3"]
    rotations: Int16[np.ndarray, "T 21 4"]
    rest_offsets: Float32[np.ndarray, "21 3"]
    fps: float
    floor: float = 0.0
    action: str = ""
    style: str = ""
    subject: str = ""
    split: str = ""
    source: str = ""
    description: str = ""

    @property
    def num_frames(self) -> int:
        """The number of frames T."""
        return len(self.root)

    @property
    def motion(self) -> Motion:
        """The clip in the world as float32, made anew at every call."""
        world = self.positions * np.float32(_UNIT_M) + self.root[:, None]
        return Motion(
            name=self.name,
            skeleton=BODY21,
            positions=world,
            fps=self.fps,
            rotations=self.rotations * np.float32(1 / _ONE),
            rest_offsets=self.rest_offsets,
        )


def clip_of(motion: Motion, *, split: str = "", action: str = "", subject: str = "") -> Clip:
    """A motion on body21 as a clip; rotations that it lacks come from its positions.

    Raises:
        UnsupportedFileError: The motion is on another skeleton, or a joint is over 3.2 m off.
    """
    if motion.skeleton.joints != BODY21.joints:
        raise UnsupportedFileError(
            motion.name, found=motion.skeleton.name, right="archives hold body21 only"
        )
    rest, rotations = motion.rest_offsets, motion.rotations
    if rest is None or rotations is None:
        rest = rest_pose(motion.positions, BODY21)
        rotations = inverse_kinematics(motion.positions, rest, BODY21.parents)
    root = motion.positions[:, 0].astype(np.float32)
    relative = np.round((motion.positions - root[:, None]) / _UNIT_M)
    if np.abs(relative).max() > _ONE:
        raise UnsupportedFileError(
            motion.name, found="a joint over 3.2 m from the hips", right="archives hold people"
        )
    toes = motion.positions[:, [BODY21.index("left_toes"), BODY21.index("right_toes")], 2]
    return Clip(
        name=motion.name,
        positions=relative.astype(np.int16),
        root=root,
        rotations=np.round(rotations * _ONE).astype(np.int16),
        rest_offsets=rest.astype(np.float32),
        fps=motion.fps,
        floor=float(np.percentile(toes.min(axis=1), 10)),
        action=action,
        subject=subject,
        split=split,
    )


def read_archive(path: Path) -> Iterator[Clip]:
    """The clips of an archive; each array is read once and shared by all of them.

    Raises:
        FormatError: The archive is damaged, or not of this layout.
    """
    arrays = _load(path)
    _check(arrays, path.name)
    fps = float(arrays["fps"])
    for i, (start, length) in enumerate(
        zip(arrays["clip_start"], arrays["clip_length"], strict=True)
    ):
        frames = slice(int(start), int(start) + int(length))
        texts = {key: str(arrays[f"clip_{key}"][i]) for key in _TEXTS}
        yield Clip(
            positions=arrays["positions"][frames],
            root=arrays["root"][frames],
            rotations=arrays["rotations"][frames],
            rest_offsets=arrays["rest_offsets"][i],
            fps=fps,
            floor=float(arrays["clip_floor"][i]),
            **texts,
        )


def write_archive(path: Path, clips: Iterable[Clip]) -> None:
    """Writes clips of one frame rate as an archive that `read_archive` reads.

    Raises:
        EmptyMotionError: There are no clips.
        UnsupportedFileError: Clips differ in their frame rate.
    """
    clips = list(clips)
    if not clips:
        raise EmptyMotionError(path.name, found="no clips", right="give at least one")
    rates = {clip.fps for clip in clips}
    if len(rates) > 1:
        raise UnsupportedFileError(path.name, found=f"rates {rates}", right="resample to one rate")
    lengths = np.array([clip.num_frames for clip in clips], dtype=np.int32)
    arrays: dict[str, np.ndarray] = {
        "positions": np.concatenate([clip.positions for clip in clips]),
        "root": np.concatenate([clip.root for clip in clips]),
        "rotations": np.concatenate([clip.rotations for clip in clips]),
        "rest_offsets": np.stack([clip.rest_offsets for clip in clips]),
        "clip_start": np.cumsum(lengths, dtype=np.int64) - lengths,
        "clip_length": lengths,
        "clip_floor": np.array([clip.floor for clip in clips], dtype=np.float32),
        "joint_names": np.array(BODY21.joints),
        "parents": np.array(BODY21.parents, dtype=np.int32),
        "fps": np.array(rates.pop()),
    }
    arrays |= {f"clip_{key}": np.array([getattr(clip, key) for clip in clips]) for key in _TEXTS}
    np.savez_compressed(path, allow_pickle=False, **arrays)


def _load(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as file:  # a file that is not there is an OSError, not a damaged archive
        try:
            with np.load(file, allow_pickle=False) as archive:
                return {key: archive[key] for key in archive.files}
        except DAMAGE as error:
            raise MalformedFileError(
                path.name,
                found=f"{type(error).__name__} ({error})",
                right="it must be a whole .npz of plain arrays",
            ) from error


def _check(arrays: Mapping[str, np.ndarray], file: str) -> None:
    """Refuses arrays that are missing, of another shape or kind, or not finite."""
    needed = {*_KINDS, "clip_start", "clip_length", "joint_names", "parents", "fps"}
    missing = sorted((needed | {f"clip_{key}" for key in _TEXTS}) - set(arrays))
    if missing:
        raise MalformedFileError(file, found=f"no {', '.join(missing)}", right="all are needed")
    if tuple(arrays["joint_names"].tolist()) != BODY21.joints:
        raise UnsupportedFileError(file, found="other joint_names", right="archives hold body21")
    num_frames, num_clips = len(arrays["positions"]), arrays["clip_start"].size
    shapes = {key: (num_frames, *shape) for key, shape in _FRAME_SHAPES.items()}
    shapes |= {key: (num_clips,) for key in arrays if key.startswith("clip_")}
    shapes |= {"rest_offsets": (num_clips, 21, 3), "fps": ()}
    for key, shape in shapes.items():
        if arrays[key].shape != shape:
            found = f"the shape {arrays[key].shape}"
            raise MalformedFileError(f"{file}[{key}]", found=found, right=f"it must be {shape}")
    for key, kind in _KINDS.items():
        _check_kind(arrays[key], kind, f"{file}[{key}]")
    _check_spans(arrays, num_frames, file)


def _check_kind(array: np.ndarray, kind: str, where: str) -> None:
    size = 2 if kind == "i" else 4
    if (array.dtype.kind, array.dtype.itemsize) != (kind, size):
        raise MalformedFileError(where, found=str(array.dtype), right=f"it must be {kind}{size}")
    if kind == "f" and not np.isfinite(array).all():
        raise InvalidNumberError(where, found="a value that is not finite", right="all must be")


def _check_spans(arrays: Mapping[str, np.ndarray], num_frames: int, file: str) -> None:
    start, length = arrays["clip_start"], arrays["clip_length"]
    if start.dtype.kind != "i" or length.dtype.kind != "i" or arrays["fps"].dtype.kind not in "if":
        raise MalformedFileError(file, found="clips that are no integers", right="use int64, int32")
    if not (start.size and num_frames):
        raise EmptyMotionError(file, found="no clips", right="there must be at least one")
    if start.min() < 0 or length.min() < 1 or (start + length).max() > num_frames:
        raise MalformedFileError(
            f"{file}[clip_start]", found="frames outside the archive", right=f"0 to {num_frames}"
        )
    if not 0 < float(arrays["fps"]) < 1e4:
        raise InvalidNumberError(
            f"{file}[fps]", found=str(arrays["fps"]), right="it must be positive"
        )
