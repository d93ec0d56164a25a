"""ASF skeletons (Acclaim): bones with their directions, axes and degrees of freedom."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from models.motion.formats.errors import (
    MalformedFileError,
    TruncatedFileError,
    UnsupportedFileError,
)
from models.motion.formats.text import numbers, read_lines

_ROTATIONS = ("rx", "ry", "rz")
_ROOT_DOF = ("tx", "ty", "tz", *_ROTATIONS)


@dataclass(frozen=True, kw_only=True, slots=True)
class Bone:
    """A bone: `vector` from its start to its end in file units; `dof` as AMC lists its values.

    `axis_angles` turn the bone's own axes, the first about the innermost of `axis_order`.
    """

    name: str
    parent: int = -1
    vector: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis_angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis_order: str = "XYZ"
    dof: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Asf:
    """A skeleton: bones with the root first and parents before children.

    `scale` is metres per unit, `angle_unit` radians per unit of angle.
    """

    bones: tuple[Bone, ...]
    scale: float
    angle_unit: float
    root_position: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Line:
    where: str
    words: list[str]


def read_asf(path: Path) -> Asf:
    """The skeleton of an ASF file.

    Raises:
        FormatError: The file is cut, malformed, or has bones that do more than rotate.
    """
    sections = _sections(path)
    root, position = _root(sections[":root"])
    found = {bone.name: bone for bone in _bones(sections[":bonedata"], path.name)}
    last = sections[":hierarchy"][-1]
    if last.words != ["end"]:
        raise TruncatedFileError(
            last.where, found=repr(last.words[0][:40]), right=":hierarchy must close with end"
        )
    bones = [root]
    for line in sections[":hierarchy"]:
        if line.words[0] in ("begin", "end"):
            continue
        names = {bone.name: i for i, bone in enumerate(bones)}
        parent, children = line.words[0], line.words[1:]
        for child in children:
            if parent not in names or child in names or child not in found:
                raise MalformedFileError(
                    line.where,
                    found=f"{child[:40]!r} below {parent[:40]!r}",
                    right="a parent must come before its children, and every bone once",
                )
            names[child] = len(bones)
            bones.append(replace(found[child], parent=names[parent]))
    if len(bones) < 1 + len(found):
        raise TruncatedFileError(
            path.name,
            found=f"{len(bones) - 1} bones in :hierarchy",
            right=f":bonedata has {len(found)}; each must have its place",
        )
    length, angle_unit = _units(sections[":units"])
    scale = 0.0254 / length
    return Asf(bones=tuple(bones), scale=scale, angle_unit=angle_unit, root_position=position)


def _sections(path: Path) -> dict[str, list[_Line]]:
    sections: dict[str, list[_Line]] = {":units": []}
    current: list[_Line] = []
    for number, text in enumerate(read_lines(path), start=1):
        words = text.split("#")[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0].lower(), [])
        elif words:
            current.append(_Line(where=f"{path.name}:{number}", words=words))
    for name in (":root", ":bonedata", ":hierarchy"):
        if not sections.get(name):
            raise TruncatedFileError(
                path.name, found=f"no {name}", right=":root, :bonedata and :hierarchy are needed"
            )
    return sections


def _units(lines: Sequence[_Line]) -> tuple[float, float]:
    """The unit of length, and radians per unit of angle."""
    length, angle_unit = 1.0, math.radians(1.0)
    for line in lines:
        if line.words[0] == "length":
            (length,) = _values(line, 1)
            if length <= 0:
                raise MalformedFileError(
                    line.where, found=f"length {length}", right="it must be positive"
                )
        if line.words[0] == "angle" and line.words[1:2] == ["rad"]:
            angle_unit = 1.0
    return length, angle_unit


def _values(line: _Line, count: int) -> list[float]:
    if len(line.words) <= count:
        raise MalformedFileError(
            line.where, found=" ".join(line.words)[:60], right=f"{count} numbers must follow"
        )
    return numbers(line.words[1 : 1 + count], line.where)


def _triple(line: _Line) -> tuple[float, float, float]:
    x, y, z = _values(line, 3)
    return x, y, z


def _order(line: _Line, index: int) -> str:
    order = "".join(line.words[index : index + 1]).upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise MalformedFileError(
            line.where, found=" ".join(line.words)[:60], right="an order such as XYZ must follow"
        )
    return order


def _root(lines: Sequence[_Line]) -> tuple[Bone, tuple[float, float, float]]:
    bone = Bone(name="root", dof=_ROOT_DOF)
    position = (0.0, 0.0, 0.0)
    for line in lines:
        match line.words[0]:
            case "order":
                dof = tuple(word.lower() for word in line.words[1:])
                if sorted(dof) != sorted(_ROOT_DOF):
                    raise UnsupportedFileError(
                        line.where,
                        found=" ".join(line.words)[:60],
                        right="the root must have TX TY TZ RX RY RZ in some order",
                    )
                bone = replace(bone, dof=dof)
            case "axis":
                bone = replace(bone, axis_order=_order(line, 1))
            case "orientation":
                bone = replace(bone, axis_angles=_triple(line))
            case "position":
                position = _triple(line)
    return bone, position


def _bones(lines: Sequence[_Line], file: str) -> list[Bone]:
    bones: list[Bone] = []
    block: list[_Line] | None = None
    names = {"root"}
    for line in lines:
        if line.words[0] == "begin" and block is None:
            block = []
        elif line.words[0] == "end" and block is not None:
            bones.append(_bone(block, line.where))
            if bones[-1].name in names:
                raise MalformedFileError(
                    line.where, found=f"a second {bones[-1].name[:40]!r}", right="names are unique"
                )
            names.add(bones[-1].name)
            block = None
        elif block is not None:
            block.append(line)
        else:
            raise MalformedFileError(
                line.where, found=" ".join(line.words)[:60], right="bones stand in begin and end"
            )
    if block is not None:
        raise TruncatedFileError(file, found="a bone without end", right="begin needs an end")
    return bones


def _bone(block: Sequence[_Line], where: str) -> Bone:
    fields = {line.words[0]: line for line in block}
    missing = [key for key in ("name", "direction", "length", "axis") if key not in fields]
    if missing or len(fields["name"].words) != 2:
        raise MalformedFileError(
            where,
            found=f"a bone without {', '.join(missing) or 'one name'}",
            right="a bone has name, direction, length and axis",
        )
    x, y, z = _triple(fields["direction"])
    (length,) = _values(fields["length"], 1)
    dof = tuple(word.lower() for word in fields["dof"].words[1:]) if "dof" in fields else ()
    if not set(dof) <= set(_ROTATIONS) or len(set(dof)) < len(dof):
        raise UnsupportedFileError(
            fields["dof"].where, found=" ".join(dof)[:60], right="bones may have rx, ry and rz"
        )
    return Bone(
        name=fields["name"].words[1],
        vector=(x * length, y * length, z * length),
        axis_angles=_triple(fields["axis"]),
        axis_order=_order(fields["axis"], 4),
        dof=dof,
    )
