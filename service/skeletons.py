"""The caller's skeleton: a standard name or own joints, as a tree with parents before children."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from models.motion.skeleton import (
    BODY21,
    SKELETONS,
    Skeleton,
    SkeletonError,
    resolve_joints,
    skeleton_from_names,
)
from service.errors import UnknownSkeletonError


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnJoints:
    """Joints as the caller names and orders them; ``mapping`` is {own joint: body21 joint}."""

    joints: tuple[str, ...]
    mapping: Mapping[str, str] | None = None
    parents: tuple[int, ...] | None = None


def standard_skeleton(name: str) -> Skeleton:
    """The standard skeleton of this name.

    Raises:
        UnknownSkeletonError: there is none.
    """
    if name not in SKELETONS:
        raise UnknownSkeletonError(
            pointer="/skeleton",
            found=repr(name[:40]),
            expected=f"must be one of {', '.join(sorted(SKELETONS))}, or own joints and a map",
        )
    return SKELETONS[name]


def own_skeleton(
    own: OwnJoints, pose: Float[np.ndarray, "J 3"]
) -> tuple[Skeleton, tuple[int, ...]]:
    """The caller's joints as a tree, and for each joint of it the index in the caller's order.

    Where no parents are given, a joint that the map knows hangs on the joint before it in the body,
    and any other on the known joint nearest to it in ``pose``.

    Raises:
        UnknownSkeletonError: the joints, the map or the parents do not make a body.
    """
    try:
        named = skeleton_from_names(own.joints, own.mapping)
        parents = own.parents if own.parents is not None else _guessed_parents(named, pose)
        order = _parents_first(parents, num_joints=len(own.joints))
        place = {joint: i for i, joint in enumerate(order)}
        tree = [-1 if parents[joint] < 0 else place[parents[joint]] for joint in order]
        joints = [own.joints[joint] for joint in order]
        return skeleton_from_names(joints, own.mapping, tree), order
    except SkeletonError as error:
        raise UnknownSkeletonError(
            pointer="/skeleton",
            found=f"{len(own.joints)} joints that do not make a body",
            expected=str(error).rstrip("."),
        ) from error


def without_joints(skeleton: Skeleton, seen: Bool[np.ndarray, "J"]) -> Skeleton:
    """The skeleton of the joints that were seen; children of the others move up the tree."""
    kept = [int(joint) for joint in np.flatnonzero(seen)]
    if len(kept) == skeleton.num_joints:
        return skeleton
    place = {joint: i for i, joint in enumerate(kept)}
    names = [skeleton.joints[joint] for joint in kept]
    return Skeleton(
        name=skeleton.name,
        joints=tuple(names),
        parents=tuple(place.get(_above(skeleton.parents, joint, place), 0) if i else -1
                      for i, joint in enumerate(kept)),
        mapping=tuple((own, body) for own, body in skeleton.mapping if own in names),
    )  # fmt: skip


def _above(parents: Sequence[int], joint: int, allowed: Mapping[int, int]) -> int:
    parent = parents[joint]
    while parent >= 0 and parent not in allowed:
        parent = parents[parent]
    return parent


def _guessed_parents(skeleton: Skeleton, pose: Float[np.ndarray, "J 3"]) -> tuple[int, ...]:
    index = {joint: i for i, joint in enumerate(skeleton.joints)}
    # In body21's order, which puts parents first: {its joint: the caller's}.
    known = {
        BODY21.index(body21): index[joint]
        for body21, joint in sorted(
            resolve_joints(skeleton).items(), key=lambda pair: BODY21.index(pair[0])
        )
    }
    root = next(iter(known.values()))
    parents = {
        own: known.get(_above(BODY21.parents, body21, known), root) for body21, own in known.items()
    }
    parents[root] = -1
    candidates = list(parents)
    for joint in set(range(skeleton.num_joints)) - parents.keys():
        distances = np.linalg.norm(pose[candidates] - pose[joint], axis=-1)
        parents[joint] = candidates[int(np.nanargmin(distances))] if _any(distances) else root
    return tuple(parents[joint] for joint in range(skeleton.num_joints))


def _any(distances: Float[np.ndarray, "C"]) -> bool:
    return bool(np.isfinite(distances).any())


def _parents_first(parents: Sequence[int], *, num_joints: int) -> tuple[int, ...]:
    if len(parents) != num_joints or not all(-1 <= parent < num_joints for parent in parents):
        raise SkeletonError(
            f"parents: found {list(parents)[:40]}; there must be one index from -1 (the root) to "
            f"{num_joints - 1} for each of {num_joints} joints."
        )
    roots = [joint for joint, parent in enumerate(parents) if parent < 0]
    order = list(roots)
    for joint in order:
        order += [child for child, parent in enumerate(parents) if parent == joint]
    if len(roots) != 1 or len(order) != num_joints:
        raise SkeletonError("parents: found no tree; exactly one joint has -1 and none is a loop.")
    return tuple(order)
