"""The store: prepared motion on disk, one skeleton and one frame rate, ready to be windowed.

A folder of ``positions.npy`` (float32 (N, J, 3), world metres, all clips one after another),
``rotations.npy`` (int16 (N, J, 4), quaternions wxyz times 32767; absent if a clip has none),
``rest_offsets.npy`` (float32 (K, J, 3)) and ``clips.json``.
"""

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int16

from models.motion.skeleton import SKELETONS, Skeleton

TABLE_FILE = "clips.json"
POSITIONS_FILE = "positions.npy"
REST_FILE = "rest_offsets.npy"
ROTATIONS_FILE = "rotations.npy"


class StoreError(Exception):
    """A store is missing, incomplete or does not hold what was asked for."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipRecord:
    """One clip of the store; empty text where a source does not say."""

    name: str
    source: str
    split: str
    start: int
    length: int
    action: str = ""
    style: str = ""
    subject: str = ""
    floor: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Store:
    """An opened store."""

    skeleton: Skeleton
    fps: float
    clips: tuple[ClipRecord, ...]
    positions: Float[np.ndarray, "N J 3"]

    def clip_positions(self, clip: ClipRecord) -> Float[np.ndarray, "L J 3"]:
        """World positions of one clip, metres."""
        return self.positions[clip.start : clip.start + clip.length]


def open_store(folder: Path) -> Store:
    """The store in a folder, its positions mapped from disk.

    Raises:
        StoreError: the folder holds no complete store.
    """
    table_path = folder / TABLE_FILE
    if not table_path.is_file():
        raise StoreError(f"{folder}: found no {TABLE_FILE}; make a store with the prepare command.")
    table = json.loads(table_path.read_text())
    positions = np.load(folder / POSITIONS_FILE, mmap_mode="r")
    clips = tuple(ClipRecord(**clip) for clip in table["clips"])
    if positions.shape[0] != sum(clip.length for clip in clips):
        raise StoreError(
            f"{folder / POSITIONS_FILE}: found {positions.shape[0]} frames; {TABLE_FILE} lists "
            f"{sum(clip.length for clip in clips)}; prepare the store again."
        )
    return Store(
        skeleton=SKELETONS[table["skeleton"]], fps=table["fps"], clips=clips, positions=positions
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Recording:
    """The frames of one clip on their way into a store."""

    positions: Float[np.ndarray, "L J 3"]
    rest_offsets: Float[np.ndarray, "J 3"]
    rotations: Int16[np.ndarray, "L J 4"] | None = None


def write_store(
    folder: Path,
    *,
    skeleton: Skeleton,
    fps: float,
    clips: Sequence[tuple[ClipRecord, Recording]],
    files: Mapping[str, str],
) -> None:
    """Write a store: the whole folder appears, or nothing does. An older store is replaced.

    The starts of the clips are set here. ``files`` holds other text files by name.

    Raises:
        StoreError: there are no clips, or the folder holds something else than a store.
    """
    if not clips:
        raise StoreError(f"{folder}: found no clips to store; there must be at least one.")
    if folder.exists() and any(folder.iterdir()) and not (folder / TABLE_FILE).is_file():
        raise StoreError(f"{folder}: found other files; it must be a store, empty or new.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".writing-") as scratch:
        new = Path(scratch) / "new"
        new.mkdir()
        for name, content in files.items():
            (new / name).write_text(content)
        _write_arrays(new, [recording for _, recording in clips])
        starts = np.cumsum([0] + [record.length for record, _ in clips]).tolist()
        records = [
            dataclasses.asdict(record) | {"start": start}
            for (record, _), start in zip(clips, starts, strict=False)
        ]
        table = {"skeleton": skeleton.name, "fps": fps, "clips": records}
        (new / TABLE_FILE).write_text(json.dumps(table))
        if folder.exists():
            shutil.move(folder, Path(scratch) / "old")
        new.rename(folder)


def _write_arrays(folder: Path, recordings: Sequence[Recording]) -> None:
    positions = [recording.positions.astype(np.float32) for recording in recordings]
    np.save(folder / POSITIONS_FILE, np.concatenate(positions))
    rest = np.stack([recording.rest_offsets for recording in recordings])
    np.save(folder / REST_FILE, rest.astype(np.float32))
    rotations = [r.rotations for r in recordings if r.rotations is not None]
    if len(rotations) == len(recordings):
        np.save(folder / ROTATIONS_FILE, np.concatenate(rotations))


def select(clips: Iterable[ClipRecord], selectors: tuple[str, ...]) -> tuple[ClipRecord, ...]:
    """Clips that match any of the selectors, each ``field=value``, ``field=value*`` or ``all``.

    Raises:
        StoreError: a selector is not of that form or names no field of a clip.
    """
    tests = [_parse(selector) for selector in selectors]
    return tuple(clip for clip in clips if any(_matches(clip, *test) for test in tests))


def _parse(selector: str) -> tuple[tuple[str, str], ...]:
    fields = {field.name for field in dataclasses.fields(ClipRecord)}
    if selector == "all":
        return ()
    parts = tuple(tuple(part.partition("=")[::2]) for part in selector.split("&"))
    for name, value in parts:
        if name not in fields or not value:
            raise StoreError(
                f"selector: found {selector!r}; must be field=value, joined by & where several "
                f"must hold, with a field of {', '.join(sorted(fields))}."
            )
    return parts  # type: ignore[return-value]  # partition()[::2] is a pair


def _matches(clip: ClipRecord, *conditions: tuple[str, str]) -> bool:
    for name, wanted in conditions:
        found = str(getattr(clip, name))
        if not (found.startswith(wanted[:-1]) if wanted.endswith("*") else found == wanted):
            return False
    return True
