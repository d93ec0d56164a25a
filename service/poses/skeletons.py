"""The caller's skeleton: a standard name or own joints, as a tree with parents before children."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from models.bundle import Manifest
from models.motion.skeleton import (
    SENT_ORDERS,
    SKELETONS,
    Skeleton,
    SkeletonError,
    in_tree_order,
    skeleton_from_names,
)
from models.motion.trees import guessed_parents
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


def requested_skeleton(asked: str | OwnJoints | None, manifest: Manifest) -> Skeleton | OwnJoints:
    """The skeleton that a request asks for; the bundle's where it asks for none.

    Raises:
        UnknownSkeletonError: no standard skeleton has this name.
    """
    if isinstance(asked, OwnJoints):
        return asked
    if asked is None or asked == manifest.skeleton.name:
        return manifest.skeleton.skeleton()
    return standard_skeleton(asked)


def sent_order(skeleton: Skeleton) -> tuple[int, ...]:
    """For each joint of a skeleton its index in the caller's lists, where that has a name."""
    if SKELETONS.get(skeleton.name) == skeleton:
        return SENT_ORDERS[skeleton.name]
    return tuple(range(skeleton.num_joints))


def sent_joints(asked: Skeleton | OwnJoints) -> tuple[str, ...]:
    """The joints of a skeleton in the order of the caller's lists."""
    if isinstance(asked, OwnJoints):
        return tuple(asked.joints)
    names = dict(zip(sent_order(asked), asked.joints, strict=True))
    return tuple(names[place] for place in range(len(names)))


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
        parents = own.parents if own.parents is not None else guessed_parents(named, pose)
        return in_tree_order(named.name, own.joints, parents, named.mapping)
    except SkeletonError as error:
        raise UnknownSkeletonError(
            pointer="/skeleton",
            found=f"{len(own.joints)} joints that do not make a body",
            expected=str(error).rstrip("."),
        ) from error
