"""From public motion files to a store, with a report of what was left out and why."""

import dataclasses
import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.motion.formats.errors import FormatError
from models.motion.kinematics import rest_pose
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, Skeleton, SkeletonError
from training.data.corpora import KINDS, GlitchLimits, Take, floor_height, read_takes
from training.data.duplicates import find_duplicates
from training.data.glitches import clean_parts, glitch_steps
from training.data.store import ClipRecord, Recording, write_store

REPORT_FILE = "report.json"
SHORTEST_S = 1.0
ROTATION_ONE = 32767


class PrepareError(Exception):
    """Nothing can be prepared from what was given."""


Prepared = tuple[ClipRecord, Recording]


@dataclass(frozen=True, kw_only=True, slots=True)
class Loss:
    """Something that did not come into the store whole: a file, a take or a clip."""

    name: str
    reason: str
    """``unreadable``, ``too short``, ``glitch`` or ``duplicate``."""
    detail: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Report:
    """What became of the sources."""

    fps: float
    kept: tuple[ClipRecord, ...]
    cut: tuple[Loss, ...]
    """Takes that were cut at glitches, of which parts were kept."""
    dropped: tuple[Loss, ...]

    def table(self) -> str:
        """Clips and minutes by source, then what was cut and dropped, by reason."""
        frames: dict[str, Counter[str]] = defaultdict(Counter)
        clips = Counter(clip.source for clip in self.kept)
        for clip in self.kept:
            frames[clip.source][clip.split] += clip.length
        lines = [f"{'source':24} {'clips':>6} {'train min':>10} {'valid min':>10}"]
        for source, found in sorted(frames.items()):
            train, valid = (found[split] / self.fps / 60 for split in ("train", "valid"))
            lines.append(f"{source:24} {clips[source]:6} {train:10.2f} {valid:10.2f}")
        reasons = Counter(loss.reason for loss in self.dropped)
        lines.append(f"cut at glitches: {len(self.cut)}")
        lines += [f"dropped, {reason}: {count}" for reason, count in sorted(reasons.items())]
        unreadable = [loss for loss in self.dropped if loss.reason == "unreadable"]
        return "\n".join([*lines, *(f"  {loss.detail}" for loss in unreadable)])

    def json(self) -> str:
        """The report as JSON."""
        losses = {
            "cut": [dataclasses.asdict(loss) for loss in self.cut],
            "dropped": [dataclasses.asdict(loss) for loss in self.dropped],
        }
        frames = sum(clip.length for clip in self.kept)
        total = {"clips": len(self.kept), "minutes": round(frames / self.fps / 60, 2)}
        return json.dumps({"kept": total} | losses, indent=1)


def prepare(
    sources: Sequence[Path],
    out: Path,
    *,
    skeleton: Skeleton = BODY21,
    fps: float = 30.0,
    limits: GlitchLimits = GlitchLimits(),  # noqa: B008  # frozen
) -> Report:
    """Write a store of all takes in some files and folders, and its report beside it.

    Takes are brought to one skeleton and frame rate, and cut at glitches. A clip that shows a
    recording of an earlier source once more is dropped, so the order of the sources tells which
    of two conversions is the better one. A file that cannot be read is reported, and left out.

    Raises:
        PrepareError: a source is missing, or nothing usable was found.
        StoreError: the output folder holds something else than a store.
    """
    prepared: list[Prepared] = []
    cut: list[Loss] = []
    dropped: list[Loss] = []
    for path in find_files(tuple(sources)):
        try:
            for take in read_takes(path):
                clips, loss = _clips_of(take, skeleton, fps, limits)
                prepared += clips
                if loss:
                    (cut if clips else dropped).append(loss)
        except (FormatError, SkeletonError, OSError) as error:
            dropped.append(Loss(name=path.name, reason="unreadable", detail=str(error)))
    if not prepared:
        first = f"; the first: {dropped[0].detail}" if dropped else ""
        raise PrepareError(f"{out}: none of {len(dropped)} takes can be used{first}")
    kept, duplicates = _without_duplicates(prepared, skeleton, fps)
    report = Report(
        fps=fps,
        kept=tuple(record for record, _ in kept),
        cut=tuple(cut),
        dropped=(*dropped, *duplicates),
    )
    write_store(out, skeleton=skeleton, fps=fps, clips=kept, files={REPORT_FILE: report.json()})
    return report


def find_files(sources: tuple[Path, ...]) -> tuple[Path, ...]:
    """The motion files among some files and folders, in a fixed order.

    Raises:
        PrepareError: a source is missing, or a folder holds no motion file.
    """
    found: list[Path] = []
    for source in sources:
        if not source.exists():
            raise PrepareError(f"{source}: found nothing there; must be a motion file or a folder.")
        inside = source.rglob("*") if source.is_dir() else (source,)
        mine = [path for path in inside if path.suffix.lower() in KINDS]
        if not mine:
            raise PrepareError(f"{source}: found no file of the kinds {', '.join(KINDS)}.")
        found += sorted(mine, key=lambda path: (KINDS.index(path.suffix.lower()), path))
    return tuple(found)


def _clips_of(
    take: Take, skeleton: Skeleton, fps: float, limits: GlitchLimits
) -> tuple[list[Prepared], Loss | None]:
    """The clean parts of a take, and what is to be said of the rest."""
    motion = take.motion.to(skeleton).resample(fps)
    name, shortest = motion.name, round(SHORTEST_S * fps)
    if motion.num_frames < shortest:
        detail = f"{name}: {motion.num_frames} frames; must be {shortest} or more."
        return [], Loss(name=name, reason="too short", detail=detail)
    glitches = glitch_steps(motion.positions, skeleton=skeleton, fps=fps, limits=limits)
    if not glitches.any():
        return [_prepared(take, motion, name)], None
    parts, lost = clean_parts(glitches, shortest=shortest)
    clips = [_prepared(take, motion[part], f"{name}_part{k}") for k, part in enumerate(parts, 1)]
    detail = (
        f"{name}: {int(glitches.sum())} steps are not human, the first at "
        f"{glitches.argmax() / fps:.2f} s; {len(parts)} parts kept, {lost} frames lost."
    )
    return clips, Loss(name=name, reason="glitch", detail=detail)


def _prepared(take: Take, motion: Motion, name: str) -> Prepared:
    positions = motion.positions.astype(np.float32)
    rest = motion.rest_offsets
    if rest is None:
        rest = rest_pose(positions, motion.skeleton)
    rotations = motion.rotations
    if rotations is not None:
        rotations = np.round(rotations * ROTATION_ONE).astype(np.int16)
    record = ClipRecord(
        name=name,
        source=take.source,
        split=take.split,
        start=0,
        length=motion.num_frames,
        action=take.action,
        style=take.style,
        subject=take.subject,
        floor=floor_height(positions) if take.floor is None else take.floor,
    )
    return record, Recording(positions=positions, rest_offsets=rest, rotations=rotations)


def _without_duplicates(
    prepared: Sequence[Prepared], skeleton: Skeleton, fps: float
) -> tuple[list[Prepared], list[Loss]]:
    found = find_duplicates(
        [record.source for record, _ in prepared],
        [recording.positions for _, recording in prepared],
        skeleton=skeleton,
        fps=fps,
    )
    losses = []
    for clip, other in found.items():
        record, same = prepared[clip][0], prepared[other][0]
        detail = f"{record.name} ({record.source}): the motion of {same.name} ({same.source})."
        losses.append(Loss(name=record.name, reason="duplicate", detail=detail))
    return [clip for index, clip in enumerate(prepared) if index not in found], losses
