"""The engine's futures as the caller's answer: skeleton, bones, rate, world, axes and units."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from models.bundle import Manifest
from models.motion.kinematics import fit_bone_lengths, rotate_yaw, yaw
from models.motion.motion import Motion
from models.motion.skeleton import Skeleton, joint_map
from service.axes import UNITS_PER_METRE
from service.observation import Caller, Observation

BoneLengths = Literal["observed", "free"]

DECIMALS = 4  # of a metre: 0.1 mm


def caller_futures(
    futures: Float[np.ndarray, "N H Jb 3"],
    observation: Observation,
    *,
    manifest: Manifest,
    bone_lengths: BoneLengths,
) -> Float[np.ndarray, "N Hc J 3"]:
    """Futures in metres, +Z up, in the caller's world, skeleton and rate, from the next frame."""
    caller = observation.caller
    last = observation.positions[-1].astype(np.float64)
    skeleton = manifest.skeleton.skeleton()
    paths = _at_rate(futures.astype(np.float64), last, skeleton, manifest=manifest, fps=caller.fps)
    answer = _in_skeleton(paths, last, skeleton, caller)
    if bone_lengths == "observed":
        answer = fit_bone_lengths(answer, caller.bones, caller.bone_parents)
    in_world = np.asarray(answer + caller.offset)
    in_world[:, :, caller.fixed] = caller.last_pose[caller.fixed] + caller.offset
    return in_world


def written(
    futures: Float[np.ndarray, "N Hc J 3"], caller: Caller
) -> Float[np.ndarray, "N Hc J 3"]:
    """Futures in the caller's joint order, axes and units, rounded to 0.1 mm.

    They are float32 where that keeps 0.1 mm, as in a room, and float64 far from the origin.
    """
    ordered = np.empty_like(futures)
    ordered[:, :, list(caller.order)] = futures
    units = UNITS_PER_METRE[caller.axes.units]
    rounded = np.round(caller.axes.from_metres(ordered), DECIMALS - round(np.log10(units)))
    spacing = float(np.spacing(np.float32(np.abs(rounded).max()))) / units
    return rounded.astype(np.float32) if spacing < 0.5 * 10**-DECIMALS else rounded


def num_frames(manifest: Manifest, fps: float) -> int:
    """How many frames the bundle's horizon lasts at a rate."""
    return max(1, round(manifest.horizon / manifest.fps * fps))


def _at_rate(
    futures: Float[np.ndarray, "N H Jb 3"],
    last: Float[np.ndarray, "Jb 3"],
    skeleton: Skeleton,
    *,
    manifest: Manifest,
    fps: float,
) -> Float[np.ndarray, "N Hc Jb 3"]:
    if fps == manifest.fps:
        return futures
    count = num_frames(manifest, fps)
    resampled = []
    for future in futures:
        # From the last frame seen, and a frame beyond the end: rounding may ask for half of one.
        beyond = 2.0 * future[-1] - (future[-2] if len(future) > 1 else last)
        path = np.concatenate([last[None], future, beyond[None]])
        motion = Motion(name="future", skeleton=skeleton, positions=path, fps=manifest.fps)
        resampled.append(motion.resample(fps).positions[1 : count + 1])
    return np.stack(resampled)


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
