"""Whether, when and how near a person comes to regions of the world, told from the samples.

A person is the lines of their bones; ``margin_m`` stands for flesh, and for the caution one wants.
Probabilities are shares of the samples. The calibration of a bundle is of balls about single joints
and has a factor for each level, so none of its factors is that of a whole body entering a region.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from jaxtyping import Float, Int

from service.observation import Caller

STILL_M = 1e-9
LEVELS = (0.05, 0.5, 0.95)
MAX_REGIONS = 16
MAX_MARGIN_M = 10.0

Points = Float[np.ndarray, "*batch 3"]


class Region(ABC):
    """A convex solid, in metres and +Z up: all within ``radius`` of its core."""

    radius: float = 0.0

    @abstractmethod
    def away(self, points: Points) -> Points:
        """From the nearest point of the core to each point; 0 within. Piecewise linear."""

    def distances(self, points: Points) -> Float[np.ndarray, "*batch"]:
        """Metres to each point; 0 within."""
        return np.asarray(np.maximum(np.linalg.norm(self.away(points), axis=-1) - self.radius, 0.0))

    @abstractmethod
    def breaks(self, starts: Points, steps: Points) -> Float[np.ndarray, "*batch K"]:
        """For points that go from starts by steps in a time of 1, when ``away`` leaves a piece."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Box(Region):
    """A box of half its ``size`` to each side of its centre, turned by ``yaw`` about up."""

    centre: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]
    yaw: float = 0.0

    def away(self, points: Points) -> Points:
        """From the nearest point of the box to each point."""
        inside = (points - self.centre) @ self._turn()
        return np.asarray(
            (inside - np.clip(inside, -self.size / 2, self.size / 2)) @ self._turn().T
        )

    def breaks(self, starts: Points, steps: Points) -> Float[np.ndarray, "*batch K"]:
        """When they cross the plane of a face."""
        inside, along = (starts - self.centre) @ self._turn(), steps @ self._turn()
        return np.concatenate([_when(inside, along, side * self.size / 2) for side in (-1, 1)], -1)

    def _turn(self) -> Float[np.ndarray, "3 3"]:
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Capsule(Region):
    """All within ``radius`` of a line from ``start`` to ``end``; a ball where these are one."""

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    radius: float

    def away(self, points: Points) -> Points:
        """From the nearest point of the line to each point."""
        share = np.clip((points - self.start) @ self._per_share(), 0.0, 1.0)
        return np.asarray(points - self.start - share[..., None] * (self.end - self.start))

    def breaks(self, starts: Points, steps: Points) -> Float[np.ndarray, "*batch K"]:
        """When they pass an end of the line."""
        share = ((starts - self.start) @ self._per_share())[..., None]
        return _when(share, (steps @ self._per_share())[..., None], np.array([0.0, 1.0]))

    def _per_share(self) -> Float[np.ndarray, "3"]:
        line = self.end - self.start
        return np.asarray(line / max(float(line @ line), 1e-12))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Occupancy:
    """Of one region: shares of the samples, at each frame those that last so long.

    ``first_entry_s`` and ``min_distance`` are quantiles at ``levels``; infinite is never. The
    distance is in metres, or in the caller's units where it has been answered.
    """

    probability: Float[np.ndarray, "H"]
    num_lasting: Int[np.ndarray, "H"]
    never: float
    levels: tuple[float, ...]
    first_entry_s: Float[np.ndarray, "L"]
    min_distance: Float[np.ndarray, "L"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Query:
    """The regions to watch, and the levels of the quantiles that are told of each."""

    regions: tuple[Region, ...]
    margin_m: float
    levels: tuple[float, ...]

    def of(self, futures: Sequence[Float[np.ndarray, "_ J 3"]], caller: Caller) -> list[Occupancy]:
        """What futures in metres, +Z up, in the caller's world and rate, say of each region."""
        body = np.flatnonzero(~caller.fixed)
        place = {int(joint): i for i, joint in enumerate(body)}
        parents = [place.get(caller.bone_parents[joint], -1) for joint in body]
        return [
            occupancy(
                [body_distances(future[:, body], parents, region) for future in futures],
                margin_m=self.margin_m,
                fps=caller.fps,
                levels=self.levels,
            )
            for region in self.regions
        ]


def occupancy(
    distances: Sequence[Float[np.ndarray, "_"]],
    *,
    margin_m: float,
    fps: float,
    levels: Sequence[float],
) -> Occupancy:
    """What the distances of the frames of each sample tell; it enters within the margin.

    Args:
        distances: in metres, of each sample as many as it has frames, the first one after now.
        margin_m: at most so far is within.
        fps: of the samples.
        levels: of the quantiles, from 0 to 1: the smallest value that so many samples keep to.
    """
    lengths = np.array([len(sample) for sample in distances])
    lasting = np.arange(lengths.max())[None] < lengths[:, None]  # (N, H)
    apart = np.full(lasting.shape, inf)
    apart[lasting] = np.concatenate(distances)
    within = apart <= margin_m
    entered = within.any(axis=1)
    first_s = np.where(entered, (within.argmax(axis=1) + 1) / fps, inf)
    ranks = np.ceil(np.multiply(levels, len(lengths)) - 1e-9).astype(int).clip(1) - 1
    num_lasting = lasting.sum(axis=0)
    return Occupancy(
        probability=within.sum(axis=0) / num_lasting,
        num_lasting=num_lasting,
        never=float(1.0 - entered.mean()),
        levels=tuple(levels),
        first_entry_s=np.sort(first_s)[ranks],
        min_distance=np.sort(apart.min(axis=1))[ranks],
    )


def body_distances(
    poses: Float[np.ndarray, "H J 3"], parents: Sequence[int], region: Region
) -> Float[np.ndarray, "H"]:
    """Metres from the region to the nearest joint or bone of each pose; 0 where they meet.

    A joint whose parent is -1 hangs on no bone. Of the bones only those are measured that may come
    nearer than every joint: no point of one is nearer than its nearer end by half its length.
    """
    above = [joint if parent < 0 else parent for joint, parent in enumerate(parents)]
    starts, apart = poses[:, above], region.distances(poses)
    nearest = apart.min(axis=-1, keepdims=True)
    half = np.linalg.norm(poses - starts, axis=-1) / 2
    may_be = np.minimum(apart[:, above], apart) - half < nearest  # (H, J)
    apart[may_be] = segment_distances(starts[may_be], poses[may_be], region)
    return np.asarray(apart.min(axis=-1))


def segment_distances(starts: Points, ends: Points, region: Region) -> Float[np.ndarray, "*batch"]:
    """Metres from the region to the nearest point of each line from a start to its end.

    Half the square of the distance to a convex solid is itself convex, and its gradient is ``away``
    from the nearest point. Along a line its slope therefore only rises, in straight pieces: where
    it crosses 0 is the nearest point, exactly.
    """
    steps = ends - starts
    times = np.clip(region.breaks(starts, steps), 0.0, 1.0)
    bounds = np.zeros((*times.shape[:-1], 1)), np.ones((*times.shape[:-1], 1))
    times = np.sort(np.concatenate([bounds[0], times, bounds[1]], axis=-1), axis=-1)  # (..., K)
    points = starts[..., None, :] + times[..., None] * steps[..., None, :]
    slopes = np.einsum("...kc,...c->...k", region.away(points), steps)
    after = np.clip((slopes < 0.0).sum(axis=-1, keepdims=True), 1, times.shape[-1] - 1)
    before_t, after_t = (np.take_along_axis(times, k, -1) for k in (after - 1, after))
    falls = np.maximum(-np.take_along_axis(slopes, after - 1, -1), 0.0)
    rises = np.maximum(np.take_along_axis(slopes, after, -1), 0.0)
    share = falls / np.where(falls > 0.0, falls + rises, 1.0)
    nearest = starts + (before_t + share * (after_t - before_t)) * steps
    return region.distances(nearest)


def _when(
    starts: Float[np.ndarray, "*batch _"],
    steps: Float[np.ndarray, "*batch _"],
    at: Float[np.ndarray, "K"],
) -> Float[np.ndarray, "*batch K"]:
    """When each goes through a value; what stands still, never, which any time may stand for."""
    moving = np.abs(steps) > STILL_M
    return np.where(moving, (at - starts) / np.where(moving, steps, 1.0), 0.0)
