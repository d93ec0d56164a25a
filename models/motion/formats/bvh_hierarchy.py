"""The HIERARCHY part of a BVH file: joints, offsets and channels, in the file's own units."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from models.motion.formats.errors import (
    FormatError,
    MalformedFileError,
    TruncatedFileError,
    UnsupportedFileError,
)
from models.motion.formats.text import numbers

_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)
_ORDER = "the order is ROOT or JOINT, {, OFFSET, CHANNELS, joints or an End Site, }"


@dataclass(kw_only=True, slots=True)
class Joint:
    """A joint of the file; `channels` are pairs of an axis and "position" or "rotation"."""

    name: str
    parent: int
    offset: tuple[float, float, float] | None = None
    channels: tuple[tuple[str, str], ...] | None = None


@dataclass(kw_only=True, slots=True)
class _Reader:
    """The tree as far as it is read; `stack` holds open joints, None for an End Site."""

    where: str = ""
    joints: list[Joint] = field(default_factory=list)
    names: set[str] = field(default_factory=set)
    stack: list[int | None] = field(default_factory=list)
    pending: bool = False  # a joint was named and its { is still to come
    seen_hierarchy: bool = False

    def statement(self, words: list[str]) -> None:
        keyword = words[0].upper()
        actions: dict[str, Callable[[list[str]], None]] = {
            "HIERARCHY": self._hierarchy,
            "ROOT": self._joint,
            "JOINT": self._joint,
            "END": self._end_site,
            "{": self._open,
            "}": self._close,
            "OFFSET": self._offset,
            "CHANNELS": self._channels,
        }
        if keyword not in actions:
            raise self._malformed(repr(words[0][:40]))
        if not self.seen_hierarchy and keyword != "HIERARCHY":
            raise MalformedFileError(
                self.where, found=repr(words[0][:40]), right="a BVH file begins with HIERARCHY"
            )
        if self.pending != (keyword == "{"):
            raise self._malformed(repr(words[0][:40]))
        actions[keyword](words)

    def _malformed(self, found: str) -> FormatError:
        return MalformedFileError(self.where, found=found, right=_ORDER)

    def _hierarchy(self, words: list[str]) -> None:
        if self.seen_hierarchy or len(words) > 1:
            raise self._malformed("a second HIERARCHY")
        self.seen_hierarchy = True

    def _joint(self, words: list[str]) -> None:
        is_root = words[0].upper() == "ROOT"
        if is_root and self.joints:
            raise UnsupportedFileError(
                self.where, found="a second ROOT", right="a file must hold one person"
            )
        parent = None if is_root else (self.stack[-1] if self.stack else None)
        if len(words) < 2 or (parent is None) != is_root:
            raise self._malformed(" ".join(words)[:40])
        name = " ".join(words[1:])
        if name in self.names:
            raise MalformedFileError(
                self.where, found=f"a second joint {name[:40]!r}", right="names must be unique"
            )
        self.names.add(name)
        self.joints.append(Joint(name=name, parent=-1 if parent is None else parent))
        self.stack.append(len(self.joints) - 1)
        self.pending = True

    def _end_site(self, words: list[str]) -> None:
        if not self.stack or self.stack[-1] is None or len(words) < 2:
            raise self._malformed("an End Site outside a joint")
        self.stack.append(None)
        self.pending = True

    def _open(self, words: list[str]) -> None:
        del words
        self.pending = False

    def _close(self, words: list[str]) -> None:
        del words
        if not self.stack:
            raise self._malformed("a } without {")
        closed = self.stack.pop()
        if closed is not None and None in (
            self.joints[closed].offset,
            self.joints[closed].channels,
        ):
            name = self.joints[closed].name[:40]
            raise self._malformed(f"the end of joint {name!r} before its OFFSET and CHANNELS")

    def _offset(self, words: list[str]) -> None:
        values = numbers(words[1:], self.where)
        if not self.stack or len(values) != 3:
            raise MalformedFileError(
                self.where, found=" ".join(words)[:60], right="OFFSET takes x, y and z of a joint"
            )
        if self.stack[-1] is not None:
            self.joints[self.stack[-1]].offset = (values[0], values[1], values[2])

    def _channels(self, words: list[str]) -> None:
        matches = [_CHANNEL.fullmatch(word) for word in words[2:]]
        channels = tuple((m[1].upper(), m[2].lower()) for m in matches if m)
        current = self.stack[-1] if self.stack else None
        if (
            current is None
            or words[1:2] != [str(len(matches))]
            or len(set(channels)) != len(matches)
        ):
            raise MalformedFileError(
                self.where,
                found=" ".join(words)[:80],
                right="CHANNELS takes their number, then as many names such as Xposition or "
                "Zrotation, each once",
            )
        self.joints[current].channels = channels


def read_hierarchy(lines: Sequence[str], file: str) -> tuple[list[Joint], int]:
    """The joints of a BVH file, and the index of its line MOTION.

    Raises:
        FormatError: The part is incomplete or not as BVH is written.
    """
    reader = _Reader()
    for index, words in _statements(lines):
        reader.where = f"{file}:{index + 1}"
        if words[0].upper() == "MOTION":
            if reader.stack or not reader.joints:
                raise MalformedFileError(
                    reader.where, found="MOTION", right="a closed tree of joints comes before it"
                )
            return reader.joints, index
        if index == len(lines) - 1:
            break
        reader.statement(words)
    raise TruncatedFileError(
        f"{file}:{len(lines)}", found="the end of the file", right="MOTION must follow the joints"
    )


def _statements(lines: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    for index, line in enumerate(lines):
        for part in re.split(r"([{}])", line):
            if words := part.split():
                yield index, words
