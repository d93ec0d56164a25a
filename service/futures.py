"""The engine's futures as the caller's answer: skeleton, bones, rate, world, axes and units."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Literal

import numpy as np
from jaxtyping import Float

from models.bundle import Manifest
from models.motion.axes import UNITS_PER_METRE
from models.motion.kinematics import fit_bone_lengths, rotate_yaw, yaw
from models.motion.motion import Motion
from models.motion.skeleton import Skeleton, joint_map
from service.engine.trajectory import Segment
from service.observation import Caller, Observation

BoneLengths = Literal["observed", "free"]

DECIMALS = 4  # of a metre: 0.1 mm


def caller_futures(
    futures: Float[np.ndarray, "N H Jb 3"],
    observation: Observation,
    *,
    manifest: Manifest,
    bone_lengths: BoneLengths,
    segments: Sequence[Sequence[Segment]] = (),
) -> Float[np.ndarray, "N Hc J 3"]:
    """Futures in metres, +Z up, in the caller's world, skeleton and rate, from the next frame.

    A future of ``segments`` repeats its last frame after the last of them, as ``Result`` does.
    """
    caller = observation.caller
    last = observation.positions[-1].astype(np.float64)
    skeleton = manifest.skeleton.skeleton()
    paths = futures.astype(np.float64)
    if caller.fps != manifest.fps:
        ends = [parts[-1].end for parts in segments] or [paths.shape[1]] * len(paths)
        trimmed = [path[:end] for path, end in zip(paths, ends, strict=True)]
        paths = _at_rate(trimmed, last, skeleton, manifest=manifest, fps=caller.fps)
    answer = _in_skeleton(paths, last, skeleton, caller)
    if bone_lengths == "observed":
        answer = fit_bone_lengths(answer, caller.bones, caller.bone_parents)
    answer += caller.offset
    answer[:, :, caller.fixed] = caller.last_pose[caller.fixed] + caller.offset
    return answer


def written(
    futures: Float[np.ndarray, "N Hc J 3"], caller: Caller
) -> Float[np.ndarray, "N Hc J 3"]:
    """Futures in the caller's joint order, axes and units, rounded to 0.1 mm.

    They are float32 where that keeps 0.1 mm, as in a room, and float64 far from the origin.
    """
    units = UNITS_PER_METRE[caller.axes.units]
    rounded = caller.axes.from_metres(futures)
    np.round(rounded, DECIMALS - round(np.log10(units)), out=rounded)
    spacing = float(np.spacing(np.float32(max(rounded.max(), -rounded.min())))) / units
    dtype = np.float32 if spacing < 0.5 * 10**-DECIMALS else np.float64
    ordered = np.empty(rounded.shape, dtype)
    for joint, place in enumerate(caller.order):
        ordered[:, :, place] = rounded[:, :, joint]
    return ordered


def caller_segments(
    segments: Sequence[Sequence[Segment]], *, manifest: Manifest, fps: float
) -> list[list[Segment]]:
    """The segments of each future in frames of the caller's rate; its last one ends where it does.

    One that is shorter than a frame of the caller's may have none.
    """

    def at_rate(segment: Segment) -> Segment:
        start = num_frames(segment.start, manifest=manifest, fps=fps)
        return replace(
            segment, start=start, end=num_frames(segment.end, manifest=manifest, fps=fps)
        )

    return [[at_rate(segment) for segment in parts] for parts in segments]


def num_frames(frames: int, *, manifest: Manifest, fps: float) -> int:
    """How many frames at a rate last as long as some of the bundle's; one at least, of any."""
    return round(frames / manifest.fps * fps) or min(frames, 1)


def _at_rate(
    futures: Sequence[Float[np.ndarray, "_ Jb 3"]],
    last: Float[np.ndarray, "Jb 3"],
    skeleton: Skeleton,
    *,
    manifest: Manifest,
    fps: float,
) -> Float[np.ndarray, "N Hc Jb 3"]:
    counts = [num_frames(len(future), manifest=manifest, fps=fps) for future in futures]
    resampled = np.empty((len(futures), max(counts), *last.shape))
    # From the last frame seen, straight on for a frame beyond the end: rounding may ask for it.
    beyond = np.arange(1, ceil(manifest.fps / fps) + 1)[:, None, None]
    for row, future, count in zip(resampled, futures, counts, strict=True):
        speed = future[-1] - (future[-2] if len(future) > 1 else last)
        path = np.concatenate([last[None], future, future[-1] + beyond * speed])
        motion = Motion(name="future", skeleton=skeleton, positions=path, fps=manifest.fps)
        row[:count] = motion.resample(fps).positions[1 : count + 1]
        row[count:] = row[count - 1]
    return resampled


def _in_skeleton(
    paths: Float[np.ndarray, "N Hc Jb 3"],
    last: Float[np.ndarray, "Jb 3"],
    skeleton: Skeleton,
    caller: Caller,
) -> Float[np.ndarray, "N Hc J 3"]:
    """Paths of the caller's joints, each as far from its estimate as it was in the last frame.

    The difference turns with the body, so nothing jumps at the first frame.
    """
    if skeleton.joints == caller.skeleton.joints:
        return paths
    weights, _ = joint_map(skeleton, caller.skeleton)
    estimate: np.ndarray = np.einsum("ij,nhjk->nhik", weights, paths, optimize=True)
    difference = caller.last_pose - np.matmul(weights, last)
    if np.abs(difference).max() < 1e-6:
        return estimate
    turned = yaw(paths, skeleton) - yaw(last, skeleton)
    carried = np.broadcast_to(difference, estimate.shape)
    return np.asarray(estimate + rotate_yaw(carried, turned))
