"""Windows of observation and future, cut from a store."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from training.data.store import ClipRecord, Store, StoreError


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Windows:
    """Starts of all windows that fit into some clips, and the chance of each to be drawn."""

    starts: Int[np.ndarray, "W"]
    room: Int[np.ndarray, "W"]
    """Frames from the start to the end of its clip."""
    clip_index: Int[np.ndarray, "W"]
    cumulative: Float[np.ndarray, "W"]

    @classmethod
    def of(
        cls,
        clips: tuple[ClipRecord, ...],
        *,
        num_frames: int,
        stride: int = 1,
        shares: Mapping[str, float] | None = None,
    ) -> "Windows":  # not Self: run-time checks of types do not know it
        """Windows of at least num_frames every stride frames.

        Args:
            clips: where to cut.
            num_frames: the shortest window.
            stride: frames between two starts of one clip.
            shares: share of the draws by prefix of the clip's source; None draws all alike.

        Raises:
            StoreError: no clip is long enough, or a source has no share.
        """
        starts, rooms, owners, sources = [], [], [], []
        for index, clip in enumerate(clips):
            first = np.arange(0, clip.length - num_frames + 1, stride)
            starts.append(clip.start + first)
            rooms.append(clip.length - first)
            owners.append(np.full(len(first), index))
            sources += [clip.source] * len(first)
        total = sum(map(len, starts))
        if total == 0:
            raise StoreError(
                f"windows: none of the {len(clips)} selected clips has {num_frames} frames."
            )
        weights = _weights(np.array(sources), shares) if shares else np.ones(total)
        return cls(
            starts=np.concatenate(starts),
            room=np.concatenate(rooms),
            clip_index=np.concatenate(owners),
            cumulative=np.cumsum(weights) / weights.sum(),
        )

    def __len__(self) -> int:
        return len(self.starts)

    def draw(self, count: int, generator: np.random.Generator) -> Int[np.ndarray, "count"]:
        """Indices of windows, drawn by their chances."""
        drawn = np.searchsorted(self.cumulative, generator.random(count), side="right")
        return np.minimum(drawn, len(self.starts) - 1)


def _weights(sources: np.ndarray, shares: Mapping[str, float]) -> Float[np.ndarray, "W"]:
    weights = np.zeros(len(sources))
    for prefix, share in shares.items():
        mine = np.char.startswith(sources, prefix)
        if mine.any():
            weights[mine] = share / mine.sum()
    if not np.all(weights > 0):
        missing = sorted(set(sources[weights == 0].tolist()))
        raise StoreError(f"shares: no share is given for the source {', '.join(missing)}.")
    return weights


def cut(
    store: Store, windows: Windows, *, num_frames: int, indices: Int[np.ndarray, "B"] | None = None
) -> Float[np.ndarray, "B L J 3"]:
    """The frames of some windows (all by default), as recorded."""
    starts = windows.starts if indices is None else windows.starts[indices]
    return np.asarray(store.positions[starts[:, None] + np.arange(num_frames)])
