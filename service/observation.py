"""Poses as the observation that a bundle takes: its skeleton, its rate, metres, +Z up."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from models.bundle import Manifest
from models.motion.kinematics import bone_lengths
from models.motion.motion import Motion
from models.motion.skeleton import Skeleton, SkeletonError, joint_map, resolve_joints
from service.axes import Axes
from service.errors import PosesError, TooFewFramesError, UnknownSkeletonError
from service.person import check_person
from service.poses import poses_array
from service.skeletons import OwnJoints, own_skeleton, without_joints

MAX_HEIGHT_M = 10.0  # of the lowest joint over z = 0; above, it is brought down to the ground


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Caller:
    """How the caller describes the person, and the person as last seen.

    Joints are in the order of ``skeleton``; ``order`` is each one's index in the caller's lists.
    Positions are metres, +Z up; adding ``offset`` puts them back into the caller's world. ``fixed``
    joints are points of the scene, such as a file's root; ``bone_parents`` is -1 where no bone is.
    """

    skeleton: Skeleton
    order: tuple[int, ...]
    fps: float
    axes: Axes
    offset: Float[np.ndarray, "3"]
    last_pose: Float[np.ndarray, "J 3"]
    bones: Float[np.ndarray, "J"]
    bone_parents: tuple[int, ...]
    fixed: Bool[np.ndarray, "J"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Observation:
    """What the engine takes, near the origin, and what the answer needs to be the caller's."""

    positions: Float[np.ndarray, "T Jb 3"]
    caller: Caller
    warnings: tuple[str, ...]


def read_observation(
    poses: Sequence[Any] | Shaped[np.ndarray, "..."],
    *,
    skeleton: Skeleton | OwnJoints,
    axes: Axes,
    fps: float,
    manifest: Manifest,
) -> Observation:
    """The observation in poses as they were sent, whose last frame is now.

    Raises:
        PosesError: the poses are not those of a person.
        TooFewFramesError: they are shorter than the bundle needs.
        UnknownSkeletonError: own joints do not make a body.
    """
    if isinstance(skeleton, OwnJoints):
        world = axes.to_metres(poses_array(poses, num_joints=len(skeleton.joints)))
        pose = world[-1] if len(world) else np.full((len(skeleton.joints), 3), np.nan)
        tree, order = own_skeleton(skeleton, pose)
    else:
        tree = skeleton
        order = tuple(range(tree.num_joints))
        world = axes.to_metres(poses_array(poses, num_joints=tree.num_joints))
    return observe(
        world[:, order], skeleton=tree, order=order, axes=axes, fps=fps, manifest=manifest
    )


def observe(
    world: Float[np.ndarray, "T J 3"],
    *,
    skeleton: Skeleton,
    order: tuple[int, ...],
    axes: Axes,
    fps: float,
    manifest: Manifest,
) -> Observation:
    """The observation in positions in metres, +Z up, NaN where a joint was not seen.

    Raises:
        PosesError: the positions are not those of a person.
        TooFewFramesError: they are shorter than the bundle needs.
    """
    num_frames = _num_frames(len(world), fps, manifest)
    target = manifest.skeleton.skeleton()
    used = _used(skeleton, target)
    check_person(world[:, used], order=[order[j] for j in used], units=axes.units)
    # One frame more than needed where there is one, so that another rate has a value to aim from.
    window, warnings = _filled(world[-num_frames - 1 :], skeleton)
    seen = np.isfinite(window[0, :, 0])
    weights, guessed = _weights(skeleton, seen, target)
    root = np.matmul(weights[0], window[-1, seen])
    lowest = float(window[-1, seen, 2].min())
    offset = np.array([root[0], root[1], lowest if abs(lowest) > MAX_HEIGHT_M else 0.0])
    near = window - offset
    mapped = np.einsum("ij,tjk->tik", weights, near[:, seen])
    back, _ = joint_map(target, skeleton)
    near[:, ~seen] = np.einsum("ij,tjk->tik", back[~seen], mapped)
    fixed = _fixed(near, used)
    caller = Caller(
        skeleton=skeleton,
        order=order,
        fps=fps,
        axes=axes,
        offset=offset,
        last_pose=near[-1],
        bones=np.median(bone_lengths(near[-num_frames:], skeleton.parents), axis=0),
        bone_parents=_bone_parents(skeleton, fixed),
        fixed=fixed,
    )
    positions = _at_rate(mapped, fps, manifest).astype(np.float32)
    return Observation(positions=positions, caller=caller, warnings=(*warnings, *guessed))


def frames_needed(manifest: Manifest, fps: float) -> int:
    """How many frames at a rate last as long as the bundle's observation."""
    return max(2, ceil(manifest.num_observed / manifest.fps * fps - 1e-6))


def _num_frames(found: int, fps: float, manifest: Manifest) -> int:
    needed = frames_needed(manifest, fps)
    if found < needed:
        seconds = manifest.num_observed / manifest.fps
        raise TooFewFramesError(
            pointer="/poses",
            found=f"{found} frames at {fps:g} fps ({found / fps:.2f} s)",
            expected=f"{manifest.name} needs {needed} frames at this rate ({seconds:.2f} s)",
        )
    return needed


def _filled(
    world: Float[np.ndarray, "T J 3"], skeleton: Skeleton
) -> tuple[Float[np.ndarray, "T J 3"], list[str]]:
    """Gaps in time closed by lines between neighbours; a joint that was never seen stays NaN."""
    filled, warnings = world.copy(), []
    seen = np.isfinite(world[:, :, 0])  # (T, J)
    frames = np.arange(len(world))
    for joint in np.flatnonzero(~seen.all(axis=0) & seen.any(axis=0)):
        present = frames[seen[:, joint]]
        for axis in range(3):
            filled[:, joint, axis] = np.interp(frames, present, world[present, joint, axis])
        warnings.append(
            f"poses: {skeleton.joints[joint]} is null in {len(frames) - len(present)} of the last "
            f"{len(frames)} frames; filled from its neighbours in time."
        )
    return filled, warnings


def _weights(
    skeleton: Skeleton, seen: Bool[np.ndarray, "J"], target: Skeleton
) -> tuple[Float[np.ndarray, "Jb S"], list[str]]:
    """The map from the joints that were seen, and a warning for those that it has to guess."""
    missing = [joint for joint, is_seen in zip(skeleton.joints, seen, strict=True) if not is_seen]
    try:
        weights, known = joint_map(without_joints(skeleton, seen), target)
    except SkeletonError as error:
        if not missing:
            raise UnknownSkeletonError(
                pointer="/skeleton", found=skeleton.name, expected=str(error).rstrip(".")
            ) from error
        raise PosesError(
            pointer="/poses",
            found=f"no position of {', '.join(missing)}",
            expected=f"too few joints were seen: {str(error).rstrip('.')}",
        ) from error
    guessed = [joint for joint, is_known in zip(target.joints, known, strict=True) if not is_known]
    warnings = [
        f"poses: {joint} is null in every frame used; it was estimated." for joint in missing
    ]
    if guessed:
        warnings.append(f"skeleton: the model's {', '.join(guessed)} had to be guessed from yours.")
    return weights, warnings


def _used(skeleton: Skeleton, target: Skeleton) -> list[int]:
    """The joints that the model sees; a file may hold others, such as the origin of its scene."""
    weights, _ = _weights(skeleton, np.ones(skeleton.num_joints, dtype=bool), target)
    return [int(joint) for joint in np.flatnonzero(weights.any(axis=0))]


def _fixed(near: Float[np.ndarray, "T J 3"], used: Sequence[int]) -> Bool[np.ndarray, "J"]:
    """Which joints held still to a millimetre while the body moved."""
    moved = np.linalg.norm(near - near[-1], axis=-1).max(axis=0)
    fixed = (moved < 1e-3) & (moved[list(used)].min() > 1e-2)
    fixed[list(used)] = False
    return np.asarray(fixed)


def _bone_parents(skeleton: Skeleton, fixed: Bool[np.ndarray, "J"]) -> tuple[int, ...]:
    """Parents without those that no bone joins to their child: above the hips, or fixed."""
    loose = {int(joint) for joint in np.flatnonzero(fixed)}
    hips = resolve_joints(skeleton).get("hips", skeleton.joints[0])
    above = skeleton.parents[skeleton.index(hips)]
    while above >= 0:
        loose.add(above)
        above = skeleton.parents[above]
    return tuple(
        -1 if joint in loose or parent in loose else parent
        for joint, parent in enumerate(skeleton.parents)
    )


def _at_rate(
    mapped: Float[np.ndarray, "T Jb 3"], fps: float, manifest: Manifest
) -> Float[np.ndarray, "To Jb 3"]:
    # Time runs backwards here, so that the last frame seen is the one that every rate keeps.
    onwards = 2.0 * mapped[:1] - mapped[1:2]
    backwards = Motion(
        name="observation",
        skeleton=manifest.skeleton.skeleton(),
        positions=np.concatenate([onwards, mapped])[::-1],
        fps=fps,
    ).resample(manifest.fps)
    return backwards.positions[: manifest.num_observed][::-1]
