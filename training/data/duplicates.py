"""Clips that show the same recording twice, found by the angles of knees and elbows.

These angles do not depend on where a body stands, how large it is, or how its trunk was converted,
so a take is recognised in another collection, on another rig, or cut out of a longer take.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float32, Int

from models.motion.skeleton import Skeleton, resolve_joints

PROBE_S = 1.0
PROBE_FRAMES = 8
LEAST_MOTION_DEG = 4.0
"""Standard deviation of the angles in the liveliest second; clips below it look all alike."""
SAME_DEG = 1.6
"""Mean difference to a clip of another source. Over Bandai, CMU and HDM05 all pairs below 2.5 are
copies: 0.01 for the same recording, 0.6 to 1.6 where one was put on another rig."""
COPY_DEG = 0.1
"""The same within a source, where people repeat themselves: to within 0.5 in Bandai."""
LEAST_OVERLAP = 0.5
_PHASES = (0.0, 0.5)  # converters that keep every n-th frame do not all start at the same one
_FINE = (-0.5, -0.25, 0.0, 0.25, 0.5)
_CLIPS_AT_ONCE, _WINDOWS_AT_ONCE = 128, 1 << 14
_LIMBS = (("upper_leg", "lower_leg", "foot"), ("upper_arm", "lower_arm", "hand"))

Angles = Float32[np.ndarray, "_ 4"]


def find_duplicates(
    sources: Sequence[str],
    motions: Sequence[Float[np.ndarray, "_ J 3"]],
    *,
    skeleton: Skeleton,
    fps: float,
) -> dict[int, int]:
    """For each clip that shows a part of an earlier one, the index of the earlier one."""
    angles = [limb_angles(motion, skeleton) for motion in motions]
    length = round(PROBE_S * fps)
    probes = {
        clip: start
        for clip, mine in enumerate(angles)
        if (start := _liveliest(mine, length)) is not None
    }
    near = _nearest_earlier(angles, probes, length)
    found: dict[int, int] = {}
    for clip, (other, shift) in near.items():
        limit = COPY_DEG if sources[clip] == sources[other] else SAME_DEG
        if _differs(angles[clip], angles[other], shift) < limit:
            found[clip] = found.get(other, other)
    return found


def limb_angles(positions: Float[np.ndarray, "T J 3"], skeleton: Skeleton) -> Angles:
    """Angles in degrees of both knees and both elbows; 0 where the skeleton has none."""
    own = resolve_joints(skeleton)
    result = np.zeros((len(positions), 4), dtype=np.float32)
    chains = [[f"{side}_{j}" for j in limb] for limb in _LIMBS for side in ("left", "right")]
    for column, chain in enumerate(chains):
        if not set(chain) <= own.keys():
            continue
        above, joint, below = (positions[:, skeleton.index(own[name])] for name in chain)
        a, b = above - joint, below - joint
        sine = np.linalg.norm(np.cross(a, b), axis=-1)
        result[:, column] = np.degrees(np.arctan2(sine, (a * b).sum(axis=-1)))
    return result


def _liveliest(angles: Angles, length: int) -> int | None:
    """The start of the window that moves most; None if it hardly moves."""
    if len(angles) <= length:  # one frame more, to look between frames
        return None
    wide = np.pad(angles.astype(np.float64), ((1, 0), (0, 0)))
    sums, squares = np.cumsum(wide, axis=0), np.cumsum(wide**2, axis=0)
    mean = (sums[length:-1] - sums[: -length - 1]) / length
    square = (squares[length:-1] - squares[: -length - 1]) / length
    spread = np.sqrt(np.maximum(square - mean**2, 0)).mean(axis=1)
    start = int(spread.argmax())
    return start if spread[start] > LEAST_MOTION_DEG else None


def _nearest_earlier(
    angles: Sequence[Angles], probes: Mapping[int, int], length: int
) -> dict[int, tuple[int, float]]:
    """For each clip with a probe: the earlier clip most like it there, and its shift in frames."""
    offsets = np.linspace(0, length - 1, PROBE_FRAMES).astype(np.int64)
    starts = np.cumsum([0, *map(len, angles)])
    everything = np.concatenate(list(angles))
    windows, norms = _windows(everything, starts, offsets)
    clips = sorted(probes)
    near = {}
    for first in range(0, len(clips), _CLIPS_AT_ONCE):
        block = clips[first : first + _CLIPS_AT_ONCE]
        queries = np.stack(
            [_between(angles[c], probes[c] + offsets + phase) for c in block for phase in _PHASES]
        )
        best = _nearest(queries.reshape(len(queries), -1), windows, norms, starts[block])
        for clip, (where, phase) in zip(block, best, strict=True):
            other = int(np.searchsorted(starts, where, side="right")) - 1
            if other < clip:
                near[clip] = (other, float(probes[clip] + phase - (where - starts[other])))
    return near


def _nearest(
    queries: Float[np.ndarray, "Q D"],
    windows: Float32[np.ndarray, "N D"],
    norms: Float32[np.ndarray, "N"],
    ends: Int[np.ndarray, "clips"],
) -> list[tuple[int, float]]:
    """For each clip the window nearest to one of its phases among those before its end."""
    queries = queries.astype(np.float32)
    limits = np.repeat(ends, len(_PHASES))
    best, where = np.full(len(queries), np.inf, np.float32), np.repeat(ends, len(_PHASES))
    for first in range(0, int(ends.max()), _WINDOWS_AT_ONCE):
        block = slice(first, min(first + _WINDOWS_AT_ONCE, int(ends.max())))
        distance = norms[block] - 2 * (queries @ windows[block].T)
        if block.stop > ends.min():
            distance[np.arange(block.start, block.stop) >= limits[:, None]] = np.inf
        found = distance.argmin(axis=1)
        nearest = distance[np.arange(len(queries)), found]
        where = np.where(nearest < best, first + found, where)
        best = np.minimum(nearest, best)
    best = best + np.square(queries).sum(axis=1)  # makes the phases of one clip comparable
    phase = best.reshape(-1, len(_PHASES)).argmin(axis=1)
    rows = np.arange(len(phase)) * len(_PHASES) + phase
    return [(int(where[row]), _PHASES[p]) for row, p in zip(rows, phase, strict=True)]


def _windows(
    angles: Float32[np.ndarray, "N 4"],
    starts: Int[np.ndarray, "clips"],
    offsets: Int[np.ndarray, "P"],
) -> tuple[Float32[np.ndarray, "N D"], Float32[np.ndarray, "N"]]:
    """The frames of a probe from every frame on, and their squared norm: infinite across an end."""
    frames = np.arange(len(angles))
    inside = np.minimum(frames[:, None] + offsets, len(angles) - 1)
    windows = angles[inside].reshape(len(angles), -1)
    norms = np.square(windows).sum(axis=1)
    end = starts[np.searchsorted(starts, frames, side="right")]
    norms[frames + offsets[-1] >= end] = np.inf
    return windows, norms


def _differs(mine: Angles, other: Angles, shift: float) -> float:
    """Mean difference in degrees of frames t + shift and t; infinite if they hardly overlap."""
    smallest = np.inf
    for fine in _FINE:
        times = np.arange(len(other)) + shift + fine
        inside = (times >= 0) & (times <= len(mine) - 1)
        if inside.sum() >= LEAST_OVERLAP * len(mine):
            difference = _between(mine, times[inside]) - other[inside]
            smallest = min(smallest, float(np.abs(difference).mean()))
    return smallest


def _between(angles: Angles, times: np.ndarray) -> np.ndarray:
    before = np.minimum(times.astype(np.int64), len(angles) - 2)
    weight = (times - before)[:, None]
    return np.asarray(angles[before] * (1 - weight) + angles[before + 1] * weight)
