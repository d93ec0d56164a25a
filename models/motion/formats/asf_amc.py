"""ASF skeletons with AMC motions (Acclaim), as CMU and HDM05 publish them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.formats.asf import Asf, Bone, read_asf
from models.motion.formats.errors import (
    ChannelCountError,
    EmptyMotionError,
    MalformedFileError,
    TruncatedFileError,
    UnsupportedFileError,
)
from models.motion.formats.text import numbers, read_lines
from models.motion.kinematics import forward_kinematics
from models.motion.motion import Motion
from models.motion.skeleton import Skeleton


def read_asf_amc(asf_path: Path, amc_path: Path, *, fps: float = 120.0) -> Motion:
    """The motion of an AMC file on its ASF skeleton: one joint where each bone starts.

    A joint bears its bone's name (`ltibia` is the left knee); the ends of the last bones are
    dropped. The file is Y-up: its (x, y, z) become (z, x, y). One unit is 0.0254 / length metres,
    with the length of the ASF's `:units`. AMC files do not tell their rate: CMU's and HDM05's are
    120 frames per second but for a few of 60.

    Raises:
        FormatError: A file is cut, malformed, or holds values that are no finite numbers.
    """
    asf = read_asf(asf_path)
    values = _read_frames(amc_path, asf.bones)
    rotations = np.stack([_local_rotations(bone, values[bone.name], asf) for bone in asf.bones], 1)
    root_bone = asf.bones[0]
    places = [root_bone.dof.index(axis) for axis in ("tx", "ty", "tz")]
    root = values[root_bone.name][:, places] * asf.scale + np.array(asf.root_position) * asf.scale
    parents = tuple(bone.parent for bone in asf.bones)
    rest = np.array([asf.bones[max(p, 0)].vector for p in parents]) * asf.scale
    rest[0] = 0.0
    positions = forward_kinematics(rotations, rest, parents, root)
    return Motion(
        name=amc_path.stem,
        skeleton=Skeleton(
            name=asf_path.stem, joints=tuple(bone.name for bone in asf.bones), parents=parents
        ),
        positions=positions[..., [2, 0, 1]],
        fps=fps,
        rotations=rot.continuous_sign(rotations[..., [0, 3, 1, 2]]),
        rest_offsets=rest[:, [2, 0, 1]],
    )


def _local_rotations(
    bone: Bone, values: Float[np.ndarray, "T D"], asf: Asf
) -> Float[np.ndarray, "T 4"]:
    """C M C^-1 with the bone's own axes C and its motion M; later angles turn about outer axes."""
    turns = [i for i, name in enumerate(bone.dof) if name[0] == "r"]
    angles = values[:, turns[::-1]] * asf.angle_unit
    axes = [bone.dof[i][1].upper() for i in turns[::-1]]
    own = rot.from_axis_angles(
        np.array(bone.axis_angles)[::-1] * asf.angle_unit, bone.axis_order[::-1]
    )
    motion = rot.from_axis_angles(angles, axes)
    return rot.multiply(rot.multiply(own, motion), rot.conjugate(own))


@dataclass(frozen=True, kw_only=True, slots=True)
class _Frame:
    line: int
    rows: dict[str, list[float]]


def _read_frames(path: Path, bones: Sequence[Bone]) -> dict[str, Float[np.ndarray, "T D"]]:
    lines = read_lines(path)
    _check_header(lines, path.name)
    widths = {bone.name: len(bone.dof) for bone in bones}
    moving = [name for name, width in widths.items() if width]
    columns: dict[str, list[list[float]]] = {name: [] for name in moving}
    num_frames = 0
    for frame in _frames(lines, widths, path.name):
        missing = [name for name in moving if name not in frame.rows]
        if missing:
            where = f"{path.name}:{frame.line}"
            error = TruncatedFileError if frame.line == len(lines) else MalformedFileError
            found = f"a frame that ends without {', '.join(missing)}"
            raise error(where, found=found, right="a frame must have a line for every bone")
        for name in moving:
            columns[name].append(frame.rows[name])
        num_frames += 1
    if num_frames == 0:
        where = f"{path.name}:{len(lines)}"
        raise EmptyMotionError(where, found="no frame", right="there must be at least one")
    return {
        name: np.array(columns[name]) if width else np.zeros((num_frames, 0))
        for name, width in widths.items()
    }


def _check_header(lines: Sequence[str], file: str) -> None:
    for number, line in enumerate(lines, start=1):
        if line.strip().upper() == ":RADIANS":
            raise UnsupportedFileError(
                f"{file}:{number}", found=":RADIANS", right="angles must be in :DEGREES"
            )
        if line.strip().isdigit():
            return


def _frames(lines: Sequence[str], widths: dict[str, int], file: str) -> Iterator[_Frame]:
    """The frames of an AMC file, each with the number of its last line."""
    rows: dict[str, list[float]] | None = None
    last = 0
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0][0] in "#:":
            continue
        if len(words) == 1 and words[0].isdigit():
            if rows is not None:
                yield _Frame(line=last, rows=rows)
            rows = {}
        else:
            where = f"{file}:{number}"
            if rows is None or words[0] in rows:
                raise MalformedFileError(
                    where, found=repr(words[0][:40]), right="a frame must begin with its number"
                )
            rows[words[0]] = _row(words, widths, where, is_last=number == len(lines))
        last = number
    if rows is not None:
        yield _Frame(line=len(lines), rows=rows)


def _row(words: list[str], widths: dict[str, int], where: str, *, is_last: bool) -> list[float]:
    if not widths.get(words[0]):
        error = TruncatedFileError if is_last else MalformedFileError
        raise error(
            where, found=repr(words[0][:40]), right="a line must name a bone that moves in the ASF"
        )
    if len(words) - 1 != widths[words[0]]:
        cut = is_last and len(words) - 1 < widths[words[0]]
        raise (TruncatedFileError if cut else ChannelCountError)(
            where,
            found=f"{len(words) - 1} values for {words[0]}",
            right=f"its dof in the ASF are {widths[words[0]]}",
        )
    return numbers(words[1:], where)
