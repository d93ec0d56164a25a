"""Public collections as data: how they name their takes, and how fast a body can be.

A collection that is not listed here is read as well; its takes then have no action, style or
subject, and bear the name of their folder as source.
"""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from models.motion.formats.files import read_motion
from models.motion.formats.labelled_smpl import holds_labelled_smpl, read_labelled_smpl
from models.motion.formats.npz import Clip, read_archive
from models.motion.formats.positions_3d import holds_positions_3d, read_positions_3d
from models.motion.motion import Motion
from models.motion.skeleton import HUMANEVA15

VALID_SHARE = 0.08
H36M_TEST_SUBJECTS = ("S9", "S11")
HUMANEVA_DAMAGED = (
    ("Train/S3", "Walking 1 chunk0"),
    ("Train/S3", "Walking 1 chunk2"),
    ("Validate/S3", "Walking 1 chunk4"),
)
"""Chunks that the field's protocol leaves out (Yuan and Kitani 2020)."""
KINDS = (".npz", ".amc", ".bvh")
"""In this order, so that where a take is found twice the one on the actor's own skeleton stays."""

NAMES: tuple[tuple[str, str], ...] = (  # pattern of a file's stem, source
    (r"dataset-(?P<set>\d)_(?P<action>[^_]+)_(?P<style>[^_]+)_\d+", "bandai-{set}"),
    (r"HDM_(?P<subject>[a-z]+)_(?P<action>[^_]+)_\d+(_\d+)?", "hdm05"),
    (r"0?(?P<subject>\d{2,3})_\d{2,3}", "cmu-{kind}"),  # BVH of CMU's takes are on other rigs
)
_PART = re.compile(r"(_part\d+)+$")


@dataclass(frozen=True, kw_only=True, slots=True)
class GlitchLimits:
    """Speeds above which a step from one frame to the next is not human, in m, s and radians."""

    joint_speed: float = 12.0
    """Of a joint relative to the root."""
    root_speed: float = 12.0
    root_acceleration: float = 60.0
    root_turn: float = 18.0
    jump_speed: float = 5.0
    """A joint jumps if it is faster than this and than `jump_factor` times the steps around."""
    jump_factor: float = 3.0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Take:
    """One recording as its source has it, with what the source says about it."""

    motion: Motion
    source: str
    split: str
    action: str = ""
    style: str = ""
    subject: str = ""
    floor: float | None = None


def read_takes(path: Path) -> Iterator[Take]:
    """The takes of one file: all clips of an archive, or the motion of a BVH or AMC file.

    Raises:
        FormatError: the file cannot be read.
    """
    if path.suffix.lower() == ".npz" and holds_positions_3d(path):
        for subject, action, motion in read_positions_3d(path):
            if motion.skeleton != HUMANEVA15:
                yield _of_h36m(subject, action, motion)
            elif (subject, action) not in HUMANEVA_DAMAGED:
                yield _of_humaneva(subject, action, motion)
    elif path.suffix.lower() == ".npz" and holds_labelled_smpl(path):
        yield from (_labelled(path, action, motion) for action, motion in read_labelled_smpl(path))
    elif path.suffix.lower() == ".npz":
        yield from (_archived(clip) for clip in read_archive(path))
    else:
        motion = read_motion(path)
        said = take_fields(path)
        yield Take(
            motion=motion,
            split=split_of(motion.name),
            source=said["source"],
            action=said.get("action", ""),
            style=said.get("style", ""),
            subject=said.get("subject", ""),
        )


def _of_h36m(subject: str, action: str, motion: Motion) -> Take:
    split = "test" if subject in H36M_TEST_SUBJECTS else "train"
    return Take(
        motion=motion,
        split=split,
        source="h36m",
        action=action.replace(" ", "_").rstrip("_0123456789"),
        subject=subject,
    )


def _of_humaneva(subject: str, action: str, motion: Motion) -> Take:
    """A chunk of a take such as ``Walking 1 chunk0`` of ``Validate/S1``."""
    part, _, person = subject.partition("/")
    return Take(
        motion=motion,
        split="train" if part == "Train" else "test",
        source="humaneva",
        action=action.split(" ")[0],
        subject=person,
    )


def _labelled(path: Path, action: str, motion: Motion) -> Take:
    """A take of a file such as ``grab_100_501_wact_candi_train.npz``."""
    words = path.stem.split("_")
    split = words[-1] if words[-1] in ("train", "test") else split_of(motion.name)
    return Take(motion=motion, split=split, source=words[0], action=action)


def take_fields(path: Path) -> dict[str, str]:
    """Source, action, style and subject as the name of a file tells them."""
    for pattern, source in NAMES:
        if match := re.fullmatch(pattern, path.stem):
            fields = match.groupdict()
            named = source.format(kind=path.suffix[1:].lower(), **fields)
            return {k: v for k, v in fields.items() if k != "set"} | {"source": named}
    return {"source": path.parent.name}


def take_name(clip_name: str) -> str:
    """The name of the take that a clip is a part of."""
    return _PART.sub("", clip_name)


def split_of(name: str) -> str:
    """``valid`` for a fixed share of the takes, chosen by name alone, else ``train``."""
    digest = hashlib.sha256(take_name(name).encode()).digest()
    return "valid" if int.from_bytes(digest[:8]) < VALID_SHARE * 2**64 else "train"


def floor_height(positions: Float[np.ndarray, "T J 3"]) -> float:
    """The height of the lowest joint when it is down: the tenth percentile over time."""
    return float(np.percentile(positions[..., 2].min(axis=1), 10))


def _archived(clip: Clip) -> Take:
    return Take(
        motion=clip.motion,
        source=clip.source,
        split=clip.split or split_of(clip.name),
        action=clip.action,
        style=clip.style,
        subject=clip.subject,
        floor=clip.floor,
    )
