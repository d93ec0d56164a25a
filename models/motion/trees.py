"""Trees of joints where there is none yet, or where some of its joints are missing."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from models.motion.skeleton import BODY21, Skeleton, resolve_joints


def guessed_parents(skeleton: Skeleton, pose: Float[np.ndarray, "J 3"]) -> tuple[int, ...]:
    """A parent for each joint, as an index into the skeleton's joints; the root has -1.

    A joint that body21 knows hangs on the joint before it in the body, and any other on the known
    joint nearest to it in ``pose``, where NaN is a joint that was not seen.
    """
    index = {joint: i for i, joint in enumerate(skeleton.joints)}
    # In body21's order, which puts parents first: {its joint: the skeleton's}.
    known = {
        BODY21.index(body21): index[joint]
        for body21, joint in sorted(
            resolve_joints(skeleton).items(), key=lambda pair: BODY21.index(pair[0])
        )
    }
    root = next(iter(known.values()))
    parents = {
        own: known.get(above(BODY21.parents, body21, known), root) for body21, own in known.items()
    }
    parents[root] = -1
    candidates = list(parents)
    for joint in set(range(skeleton.num_joints)) - parents.keys():
        distances = np.linalg.norm(pose[candidates] - pose[joint], axis=-1)
        seen = bool(np.isfinite(distances).any())
        parents[joint] = candidates[int(np.nanargmin(distances))] if seen else root
    return tuple(parents[joint] for joint in range(skeleton.num_joints))


def above(parents: Sequence[int], joint: int, allowed: Mapping[int, object]) -> int:
    """The nearest joint over this one in the tree that is allowed, or -1."""
    parent = parents[joint]
    while parent >= 0 and parent not in allowed:
        parent = parents[parent]
    return parent


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
        parents=tuple(place.get(above(skeleton.parents, joint, place), 0) if i else -1
                      for i, joint in enumerate(kept)),
        mapping=tuple((own, body) for own, body in skeleton.mapping if own in names),
    )  # fmt: skip
