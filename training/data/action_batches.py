"""Batches of labelled actions, each joined to what was seen before it (Mao et al. 2022)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from models.motion.skeleton import Skeleton
from models.system import Actions, Data
from training.data.augment import draw_mirrored, draw_rates
from training.data.batch_source import BatchSource
from training.data.batches import require_fit, training_clips, varied_rows
from training.data.store import ClipRecord, Store, StoreError, select
from training.data.transitions import facing_poses, frames_per_metre, leg_lengths, set_down

FIRST_PART = 0.1
"""Share of a clip in which it may begin to be seen, or be entered from another action."""
LEAST_START, LEAST_ENTRY = 10, 15
"""Frames that count as the first part of the shortest clips."""
STOPPED_SHARE = 0.5
"""Of the observations of another action, those that end with it and stand still for a while."""
MOST_REPEATS = 10
_POSES_MEASURED = 9
_EXCHANGED = {"left": "right", "right": "left"}

Rows = Int[np.ndarray, "B"]
"""For each row the index of a label, of a clip or of a frame."""
Times = Float[np.ndarray, "B L"]
"""Frames of a clip at its recorded rate, from its first one on."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Clips:
    """The clips of all labels, one label after another."""

    starts: Int[np.ndarray, "C"]
    lengths: Int[np.ndarray, "C"]
    floors: Float[np.ndarray, "C"]
    legs: Float[np.ndarray, "C"]
    first_of_label: Int[np.ndarray, "A"]
    count_of_label: Int[np.ndarray, "A"]

    def draw(self, labels: Rows, generator: np.random.Generator) -> Rows:
        """A clip of each label, all clips of a label alike."""
        return self.first_of_label[labels] + generator.integers(self.count_of_label[labels])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Entries:
    """The poses at which each clip may be entered, facing alike, on legs of one metre."""

    poses: Float[np.ndarray, "E J 3"]
    first_of_clip: Int[np.ndarray, "C"]
    count_of_clip: Int[np.ndarray, "C"]

    def nearest(
        self, clips: Rows, poses: Float[np.ndarray, "B J 3"]
    ) -> tuple[Rows, Float[np.ndarray, "B"]]:
        """The frame at which to enter each clip from a pose of the same form, and how far it is."""
        counts = self.count_of_clip[clips]
        frames = np.minimum(np.arange(counts.max(initial=1)), counts[:, None] - 1)
        entries = self.poses[self.first_of_clip[clips][:, None] + frames]  # (B, E, J, 3)
        distances = np.linalg.norm(entries - poses[:, None], axis=(-2, -1))
        return distances.argmin(axis=1), distances.min(axis=1)


class ActionBatches(BatchSource):
    """Draws label, clips, rates and variation of each row from one generator per batch number.

    Labels are drawn alike, then the clips of a label. A row of one clip sees it from a place in
    its first part on and continues to its end. A row of two sees a person in the midst of another
    action or standing at its end; the clip of the label is then entered at that pose of its first
    part which is nearest to the last one seen, after a transition as long as `frames_per_metre`
    says, on the ground and in the size of the person seen. Futures are cut at the horizon: of a
    clip that is much longer, only what begins in the first part is learnt, and not its end.
    """

    frames_per_metre: float
    """k of the length of a transition, by `transitions.frames_per_metre`."""

    def __init__(self, store: Store, data: Data, *, seed: int) -> None:
        """Index the clips of the labels and measure their people.

        Raises:
            StoreError: skeleton or frame rate of store and recipe differ, the recipe has no
                actions that can be learnt, or a label has no clip that is long enough.
        """
        require_fit(store, data)
        self._actions = _checked(data)
        self._data = data
        self._seed = seed
        self._positions = np.asarray(store.positions)
        self._shortest = data.num_observed + self._actions.min_frames
        by_label = _clips_by_label(training_clips(store, data), self._actions, self._shortest)
        self._clips = _indexed(by_label, self._positions, data.skeleton)
        # The shortest clips cannot be played as fast as the others.
        limits = (self._clips.lengths - 1) / (self._shortest - 1)
        self._fastest = np.minimum(data.augmentation.fastest, limits)
        self._entries = self._find_entries()
        self._mirrors = mirrored_labels(tuple(self._actions.labels))
        self.frames_per_metre = frames_per_metre(
            self._positions, self._clips.starts, self._clips.lengths, data.skeleton
        )

    def batch(self, number: int, size: int) -> dict[str, Tensor]:
        """Batch number ``number``, as `models.system.Batch` describes it."""
        data, generator = self._data, np.random.default_rng([self._seed, number])
        labels = generator.integers(len(self._mirrors), size=size)
        clips = self._clips.draw(labels, generator)
        rates = self._rates(clips, generator)
        begins = self._begins(clips, rates, generator)
        observed = self._poses(clips, _steady(begins, rates, data.num_observed))
        begins += rates * data.num_observed
        first = np.zeros(size, np.int64)

        others = np.flatnonzero(generator.random(size) < self._actions.other_share)
        seen, times = self._another(labels[others], generator)
        observed[others] = self._poses(seen, times)
        begins[others], first[others] = self._entered(
            clips[others], observed[others, -1], self._clips.legs[seen]
        )
        frames = np.maximum(np.arange(data.horizon) - first[:, None], 0)
        future = self._poses(clips, begins[:, None] + rates[:, None] * frames)
        future[others] = set_down(
            self._fitted(future[others], clips[others], seen),
            observed[others],
            first=first[others],
            skeleton=data.skeleton,
        )

        mirrored = draw_mirrored(size, how=data.augmentation, generator=generator)
        mirrored &= self._mirrors[labels] >= 0
        poses = np.concatenate([observed, future], axis=1)
        left = np.floor((self._clips.lengths[clips] - 1 - begins) / rates + 1e-6).astype(np.int64)
        rows = {
            "action": np.where(mirrored, self._mirrors[labels], labels),
            "first": first,
            "length": np.minimum(first + left + 1, data.horizon),
        }
        return varied_rows(poses, mirrored=mirrored, data=data, generator=generator) | {
            name: torch.from_numpy(values) for name, values in rows.items()
        }

    def _rates(self, clips: Rows, generator: np.random.Generator) -> Float[np.ndarray, "B"]:
        return draw_rates(self._fastest[clips], how=self._data.augmentation, generator=generator)

    def _begins(
        self, clips: Rows, rates: Float[np.ndarray, "B"], generator: np.random.Generator
    ) -> Float[np.ndarray, "B"]:
        """Where a clip begins to be seen that is continued for `Actions.min_frames` or more."""
        lengths = self._clips.lengths[clips]
        first_part = np.maximum(FIRST_PART * lengths, LEAST_START)
        room = np.minimum(first_part, lengths - 1 - rates * (self._shortest - 1))
        return _whole_up_to(room, generator)

    def _another(self, labels: Rows, generator: np.random.Generator) -> tuple[Rows, Times]:
        """Clips of other labels, and when they are seen: anywhere, or at their end and after it."""
        count, num_observed = len(labels), self._data.num_observed
        others = labels + generator.integers(1, max(len(self._mirrors), 2), size=count)
        clips = self._clips.draw(others % len(self._mirrors), generator)
        rates = self._rates(clips, generator)
        room = self._clips.lengths[clips] - 1 - rates * (num_observed - 1)
        anywhere = _whole_up_to(room, generator)
        at_end = room + rates * generator.integers(MOST_REPEATS + 1, size=count)
        stopped = generator.random(count) < STOPPED_SHARE
        return clips, _steady(np.where(stopped, at_end, anywhere), rates, num_observed)

    def _entered(
        self, clips: Rows, last: Float[np.ndarray, "B J 3"], legs: Float[np.ndarray, "B"]
    ) -> tuple[Rows, Rows]:
        """The frame at which to enter a clip from the pose of a person, and frames to get there."""
        scale = legs[:, None, None]
        poses = facing_poses(last, self._data.skeleton) / scale
        frames, distances = self._entries.nearest(clips, poses.astype(np.float32))
        needed = np.floor(self.frames_per_metre * distances * legs).astype(np.int64) + 1
        return frames, np.minimum(needed, self._actions.longest_transition)

    def _fitted(
        self, poses: Float[np.ndarray, "B L J 3"], clips: Rows, seen: Rows
    ) -> Float[np.ndarray, "B L J 3"]:
        """Poses of clips, with their path, in the size and on the floor of other clips' people."""
        table = self._clips
        scale = (table.legs[seen] / table.legs[clips]).astype(np.float32)
        fitted = poses * scale[:, None, None, None]
        lift = (table.floors[seen] - table.floors[clips] * scale).astype(np.float32)
        fitted[..., 2] += lift[:, None, None]
        return fitted

    def _poses(self, clips: Rows, times: Times) -> Float[np.ndarray, "B L J 3"]:
        """Poses of clips between recorded frames; after the end the last pose."""
        last = self._clips.lengths[clips][:, None] - 1
        times = np.minimum(times, last)
        whole = times.astype(np.int64)
        fraction = (times - whole).astype(np.float32)[..., None, None]
        start = self._clips.starts[clips][:, None]
        poses = self._positions[start + whole]
        after = self._positions[start + np.minimum(whole + 1, last)]
        after -= poses
        after *= fraction
        poses += after
        return poses

    def _find_entries(self) -> _Entries:
        starts, lengths = self._clips.starts, self._clips.lengths
        latest = lengths - 1 - self._fastest * (self._actions.min_frames - 1)
        counts = np.minimum(np.maximum(FIRST_PART * lengths, LEAST_ENTRY), latest + 1 + 1e-6)
        counts = counts.astype(np.int64)
        frames = [
            np.arange(start, start + count) for start, count in zip(starts, counts, strict=True)
        ]
        poses = facing_poses(self._positions[np.concatenate(frames)], self._data.skeleton)
        poses /= np.repeat(self._clips.legs, counts)[:, None, None]
        return _Entries(poses=poses, first_of_clip=np.cumsum(counts) - counts, count_of_clip=counts)


def mirrored_labels(labels: tuple[str, ...]) -> Int[np.ndarray, "A"]:
    """The label of the mirror image of each: left and right exchanged among its hyphened words.

    -1 where it names a side and the label of the other side is not there.
    """
    images = ["-".join(_EXCHANGED.get(w, w) for w in label.split("-")) for label in labels]
    return np.array([labels.index(image) if image in labels else -1 for image in images])


def _checked(data: Data) -> Actions:
    """The actions of a recipe whose rows can be made.

    Raises:
        StoreError: they cannot.
    """
    actions = data.actions
    if actions is None or not actions.labels:
        raise StoreError("actions: the recipe has no labels; whole actions need one at least.")
    if len(actions.labels) == 1 and actions.other_share > 0:
        raise StoreError(
            f"actions.other_share: found {actions.other_share} with one label; it must be 0, "
            "there is no other action to come from."
        )
    if data.horizon < actions.longest_transition + 2:
        raise StoreError(
            f"data.horizon: found {data.horizon} frames; it must be longer than "
            f"longest_transition, {actions.longest_transition} frames, by 2 at least."
        )
    return actions


def _clips_by_label(
    known: tuple[ClipRecord, ...], actions: Actions, shortest: int
) -> list[list[ClipRecord]]:
    found = []
    for label, selectors in actions.labels.items():
        clips = [clip for clip in select(known, selectors) if clip.length >= shortest]
        if not clips:
            raise StoreError(
                f"actions.labels[{label!r}]: found no training clip of {shortest} frames or more "
                f"for {', '.join(selectors)}; prepare a store that has some."
            )
        found.append(clips)
    return found


def _indexed(
    by_label: list[list[ClipRecord]], positions: Float[np.ndarray, "N J 3"], skeleton: Skeleton
) -> _Clips:
    clips = [clip for mine in by_label for clip in mine]
    counts = np.array([len(mine) for mine in by_label])
    starts = np.array([clip.start for clip in clips])
    lengths = np.array([clip.length for clip in clips])
    measured = np.linspace(starts, starts + lengths - 1, _POSES_MEASURED).astype(np.int64)
    return _Clips(
        starts=starts,
        lengths=lengths,
        floors=np.array([clip.floor for clip in clips]),
        legs=np.median(leg_lengths(positions[measured], skeleton), axis=0),
        first_of_label=np.cumsum(counts) - counts,
        count_of_label=counts,
    )


def _steady(begins: Float[np.ndarray, "B"], rates: Float[np.ndarray, "B"], count: int) -> Times:
    return begins[:, None] + rates[:, None] * np.arange(count)


def _whole_up_to(
    room: Float[np.ndarray, "B"], generator: np.random.Generator
) -> Float[np.ndarray, "B"]:
    """A whole number from 0 to each limit, all alike."""
    return np.floor(generator.random(len(room)) * (np.floor(room + 1e-6) + 1))
