"""A motion: joint positions over time, with rotations where the source has them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.skeleton import Skeleton, SkeletonError, joint_map


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Motion:
    """Joint positions of one person in the world.

    `positions` are metres, right-handed, +Z up, NaN where a joint was not seen. `rotations` are
    (w, x, y, z), each joint relative to its parent, the root to the world; `rest_offsets` are the
    bone vectors at the identity.
    """

    name: str
    skeleton: Skeleton
    positions: Float[np.ndarray, "T J 3"]
    fps: float
    rotations: Float[np.ndarray, "T J 4"] | None = None
    rest_offsets: Float[np.ndarray, "J 3"] | None = None

    def __post_init__(self) -> None:
        if self.positions.shape[1] != self.skeleton.num_joints:
            raise SkeletonError(
                f"{self.name}.positions: found {self.positions.shape[1]} joints; "
                f"{self.skeleton.name} has {self.skeleton.num_joints}."
            )

    @property
    def num_frames(self) -> int:
        """The number of frames T."""
        return len(self.positions)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.num_frames - 1) / self.fps

    def __getitem__(self, frames: slice) -> "Motion":
        rotations = None if self.rotations is None else self.rotations[frames]
        fps = self.fps / (frames.step or 1)
        return replace(self, positions=self.positions[frames], rotations=rotations, fps=fps)

    def resample(self, fps: float) -> "Motion":
        """The motion at another rate, from the first frame on, as long as frames last.

        Positions by the cubic of Catmull and Rom (1974) through the four frames around, rotations
        by slerp. Frames that coincide are kept; there is no low-pass filter on the way down.
        """
        if fps == self.fps:
            return self
        count = int(np.floor(self.duration * fps + 1e-6)) + 1
        time = np.minimum(np.arange(count) * (self.fps / fps), self.num_frames - 1)
        time = np.where(np.abs(time - np.round(time)) < 1e-6, np.round(time), time)
        before = time.astype(np.int64)
        weight = time - before
        rotations = self.rotations
        if rotations is not None:
            after = np.minimum(before + 1, self.num_frames - 1)
            turned = rot.slerp(rotations[before], rotations[after], weight[:, None])
            rotations = rot.continuous_sign(turned).astype(rotations.dtype)
        positions = _catmull_rom(self.positions, before, weight)
        return replace(self, positions=positions, rotations=rotations, fps=fps)

    def to(self, skeleton: Skeleton) -> "Motion":
        """The motion of another skeleton by `joint_map`; rotations are dropped.

        Joints that the map does not know sit on a neighbour: ask `joint_map` which.
        """
        if skeleton.joints == self.skeleton.joints:
            return replace(self, skeleton=skeleton)
        weights, _ = joint_map(self.skeleton, skeleton)
        positions = np.einsum("ij,tjk->tik", weights, self.positions).astype(self.positions.dtype)
        return Motion(name=self.name, skeleton=skeleton, positions=positions, fps=self.fps)


def _catmull_rom(
    positions: Float[np.ndarray, "T J 3"],
    before: np.ndarray,
    weight: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N J 3"]:
    # Beyond the ends the motion goes on straight, so that a line stays a line.
    first, last = 2 * positions[:1] - positions[1:2], 2 * positions[-1:] - positions[-2:-1]
    if len(positions) == 1:
        first = last = positions
    padded = np.concatenate([first, positions, last])
    p0, p1, p2, p3 = (padded[np.minimum(before + i, len(padded) - 1)] for i in range(4))
    t = weight[:, None, None]
    bend = (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3
    between: np.ndarray = p1 + 0.5 * ((p2 - p0) * t + bend)
    return between.astype(positions.dtype)
