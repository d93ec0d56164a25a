"""Poses as the observation that a bundle takes: its skeleton, its rate, metres, +Z up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Shaped

from models.bundle import Manifest
from models.motion.axes import Axes
from models.motion.bones import bone_parents
from models.motion.gaps import (
    MIN_CONFIDENCE,
    at_even_times,
    even_rate,
    filled,
    num_even,
    steadied,
    trusted,
)
from models.motion.guesses import body_of
from models.motion.kinematics import bone_lengths
from models.motion.motion import Motion
from models.motion.skeleton import Skeleton, SkeletonError, joint_map
from models.motion.trees import without_joints
from service.errors import PosesError, TooFewFramesError, UnknownSkeletonError
from service.poses.arrays import confidence_array, poses_array, times_array
from service.poses.person import check_person
from service.poses.skeletons import OwnJoints, own_skeleton, sent_order
from service.poses.stance import Finding, guessed_axes, stance

Source = Literal["observed", "derived", "imputed"]

MIN_FPS, MAX_FPS = 5.0, 300.0
LONG_GAP_S = 0.25
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
    sources: tuple[Source, ...]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Observation:
    """What the engine takes, near the origin, and what the answer needs to be the caller's."""

    positions: Float[np.ndarray, "T Jb 3"]
    caller: Caller
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Seen:
    """A person as sent, in metres, +Z up, NaN where a joint was not seen.

    ``order`` is the index of each joint of ``skeleton`` in the caller's lists. ``times`` are
    seconds, where frames are uneven; ``confidence`` is what each joint is worth, from 0 to 1.
    """

    world: Float[np.ndarray, "T J 3"]
    skeleton: Skeleton
    order: tuple[int, ...]
    times: Float[np.ndarray, "T"] | None = None
    confidence: Float[np.ndarray, "T J"] | None = None


def read_seen(
    poses: Sequence[Any] | Shaped[np.ndarray, "..."],
    *,
    skeleton: Skeleton | OwnJoints,
    axes: Axes,
    times: Sequence[Any] | None = None,
    confidence: Sequence[Any] | Shaped[np.ndarray, "..."] | None = None,
) -> Seen:
    """Poses as they were sent, in the order of a tree.

    Raises:
        PosesError: a frame or joint has a wrong shape, or a coordinate is no finite number.
        FieldError: times or confidence do not go with them.
        UnknownSkeletonError: own joints do not make a body.
    """
    joints = skeleton.joints
    world = axes.to_metres(poses_array(poses, num_joints=len(joints)))
    if isinstance(skeleton, OwnJoints):
        pose = world[-1] if len(world) else np.full((len(joints), 3), np.nan)
        tree, order = own_skeleton(skeleton, pose)
    else:
        tree, order = skeleton, sent_order(skeleton)
    worth = None
    if confidence is not None:
        worth = confidence_array(confidence, num_frames=len(world), num_joints=len(joints))
    return Seen(
        world=world[:, order],
        skeleton=tree,
        order=order,
        times=None if times is None else times_array(times, num_frames=len(world)),
        confidence=None if worth is None else worth[:, order],
    )


def read_observation(  # noqa: PLR0913 - all that a request says of its poses
    poses: Sequence[Any] | Shaped[np.ndarray, "..."],
    *,
    skeleton: Skeleton | OwnJoints,
    axes: Axes,
    fps: float | None,
    manifest: Manifest,
    times: Sequence[Any] | None = None,
    confidence: Sequence[Any] | Shaped[np.ndarray, "..."] | None = None,
) -> Observation:
    """The observation in poses as they were sent, whose last frame is now.

    Without ``fps`` the rate is that of ``times``, or else the bundle's.

    Raises:
        PosesError: the poses are not those of a person.
        TooFewFramesError: they are shorter than the bundle needs.
        FieldError: times or confidence do not go with them.
        UnknownSkeletonError: own joints do not make a body.
    """
    seen = read_seen(poses, skeleton=skeleton, axes=axes, times=times, confidence=confidence)
    return observe(seen, axes=axes, fps=caller_rate(seen, fps, manifest), manifest=manifest)


def caller_rate(seen: Seen, fps: float | None, manifest: Manifest) -> float:
    """Frames per second of the answer: as asked for, as most frames came, or the bundle's."""
    if fps is not None:
        return fps
    if seen.times is None or len(seen.times) < 2:
        return manifest.fps
    return min(max(round(even_rate(seen.times), 3), MIN_FPS), MAX_FPS)


def observe(seen: Seen, *, axes: Axes, fps: float, manifest: Manifest) -> Observation:
    """The observation in positions in metres, +Z up, NaN where a joint was not seen.

    Raises:
        PosesError: the positions are not those of a person.
        TooFewFramesError: they are shorter than the bundle needs.
    """
    skeleton = seen.skeleton
    _check_length(seen, fps, manifest)
    num_frames = frames_needed(manifest, fps)
    target = manifest.skeleton.skeleton()
    used = _used(skeleton, target)
    check_person(seen.world[:, used], order=[seen.order[j] for j in used], units=axes.units)
    # One frame more than needed where there is one, so that another rate has a value to aim from.
    recent = _last(seen, (num_frames + 0.5) / fps, num_frames + 1)
    window, warnings = _whole(recent, fps)
    window = window[-num_frames - 1 :]
    is_seen = np.isfinite(window[0, :, 0])
    weights, guessed = body_weights(skeleton, is_seen, target)
    body = body_of(window[:, is_seen], without_joints(skeleton, is_seen))
    odd = [_warning(finding) for finding in stance(body, axes, guessed_axes(body, axes))]
    root = np.matmul(weights[0], window[-1, is_seen])
    lowest = float(window[-1, is_seen, 2].min())
    offset = np.array([root[0], root[1], lowest if abs(lowest) > MAX_HEIGHT_M else 0.0])
    near = window - offset
    mapped = np.einsum("ij,tjk->tik", weights, near[:, is_seen])
    back, _ = joint_map(target, skeleton)
    near[:, ~is_seen] = np.einsum("ij,tjk->tik", back[~is_seen], mapped)
    fixed = _fixed(near, used)
    caller = Caller(
        skeleton=skeleton,
        order=seen.order,
        fps=fps,
        axes=axes,
        offset=offset,
        last_pose=near[-1],
        bones=np.median(bone_lengths(near[-num_frames:], skeleton.parents), axis=0),
        bone_parents=bone_parents(skeleton, loose=np.flatnonzero(fixed).tolist()),
        fixed=fixed,
        sources=sources(recent),
    )
    positions = _at_rate(mapped, fps, manifest).astype(np.float32)
    return Observation(positions=positions, caller=caller, warnings=(*warnings, *guessed, *odd))


def _warning(finding: Finding) -> str:
    """A finding about how the body stands, as an answer says it."""
    where = "poses" if finding.about == "sides" else f"axes.{finding.about}"
    return f"{where}: {finding.sentence[0].lower()}{finding.sentence[1:]}"


def sources(seen: Seen) -> tuple[Source, ...]:
    """Where each joint comes from, in the order of the skeleton.

    `observed` was seen in half of the frames or more; `derived` was not, but follows from those
    that were; `imputed` is a guess, or carried over from other frames, or never trusted.
    """
    is_seen = np.isfinite(seen.world[:, :, 0])
    if seen.confidence is not None:
        is_seen &= seen.confidence >= MIN_CONFIDENCE
    ever = np.isfinite(seen.world[:, :, 0]).any(axis=0)
    _, known = joint_map(without_joints(seen.skeleton, ever), seen.skeleton)
    often = is_seen.mean(axis=0) >= 0.5

    def source(joint: int) -> Source:
        if often[joint]:
            return "observed"
        return "derived" if known[joint] and not ever[joint] else "imputed"

    return tuple(map(source, range(seen.skeleton.num_joints)))


def frames_needed(manifest: Manifest, fps: float) -> int:
    """How many frames at a rate last as long as the bundle's observation."""
    return max(2, ceil(manifest.num_observed / manifest.fps * fps - 1e-6))


def _check_length(seen: Seen, fps: float, manifest: Manifest) -> None:
    found, needed = len(seen.world), frames_needed(manifest, fps)
    if seen.times is not None and found > 1:
        found = num_even(float(seen.times[-1] - seen.times[0]), fps)
    if found < needed:
        seconds = manifest.num_observed / manifest.fps
        raise TooFewFramesError(
            pointer="/poses",
            found=f"{len(seen.world)} frames at {fps:g} fps ({found / fps:.2f} s)",
            expected=f"{manifest.name} needs {needed} frames at this rate ({seconds:.2f} s)",
        )


def _last(seen: Seen, seconds: float, frames: int) -> Seen:
    """The last seconds, or where frames came evenly, the last frames."""
    start = max(0, len(seen.world) - frames)
    if seen.times is not None:
        # The frame before them is kept, from which the first of them can be told.
        before = int(np.searchsorted(seen.times, seen.times[-1] - seconds)) - 1
        start = min(max(0, before), len(seen.world) - 2)
    return replace(
        seen,
        world=seen.world[start:],
        times=None if seen.times is None else seen.times[start:],
        confidence=None if seen.confidence is None else seen.confidence[start:],
    )


def _whole(recent: Seen, fps: float) -> tuple[Float[np.ndarray, "T J 3"], list[str]]:
    """Frames at an even rate without gaps; a joint that was never seen stays NaN."""
    world, warnings = recent.world.copy(), []
    names, parents, frames = recent.skeleton.joints, recent.skeleton.parents, len(recent.world)
    if recent.confidence is not None:
        world[~trusted(recent.confidence)] = np.nan
        doubted = (recent.confidence < MIN_CONFIDENCE).all(axis=0)
        warnings += [
            f"confidence: {names[j]} is below {MIN_CONFIDENCE} in every frame used; it was taken "
            "as it is."
            for j in np.flatnonzero(doubted & np.isfinite(recent.world[:, :, 0]).any(axis=0))
        ]
    seen = np.isfinite(world[:, :, 0])  # (T, J)
    warnings += [
        f"poses: {names[j]} is null in {frames - int(seen[:, j].sum())} of the last "
        f"{frames} frames; filled from its neighbours in time."
        for j in np.flatnonzero(~seen.all(axis=0) & seen.any(axis=0))
    ]
    times = np.arange(frames) / fps if recent.times is None else recent.times
    world = filled(world, times, parents)
    worth = None if recent.confidence is None else np.where(seen, recent.confidence, 0.0)
    if recent.times is not None:
        if (longest := float(np.diff(times).max())) > LONG_GAP_S:
            warnings.append(
                f"timestamps: {longest:.2f} s lie between two frames; filled with a straight line."
            )
        world = at_even_times(world, times, fps)
        worth = None if worth is None else at_even_times(worth, times, fps)
    return world if worth is None else steadied(world, worth, fps), warnings


def body_weights(
    skeleton: Skeleton, seen: Bool[np.ndarray, "J"], target: Skeleton
) -> tuple[Float[np.ndarray, "Jb S"], list[str]]:
    """The map from the joints that were seen, and a warning for those that it has to guess.

    Raises:
        PosesError: too few joints were seen.
        UnknownSkeletonError: the skeleton has too few.
    """
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
    weights, _ = body_weights(skeleton, np.ones(skeleton.num_joints, dtype=bool), target)
    return [int(joint) for joint in np.flatnonzero(weights.any(axis=0))]


def _fixed(near: Float[np.ndarray, "T J 3"], used: Sequence[int]) -> Bool[np.ndarray, "J"]:
    """Which joints held still to a millimetre while the body moved."""
    moved = np.linalg.norm(near - near[-1], axis=-1).max(axis=0)
    fixed = (moved < 1e-3) & (moved[list(used)].min() > 1e-2)
    fixed[list(used)] = False
    return np.asarray(fixed)


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
