"""What a viewer draws of an answer: the bones of its poses as lines, and a colour for each."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from models.motion.skeleton import SKELETONS

OBSERVED_RGB = (40, 40, 46)
_HUES = ((230, 97, 1), (94, 60, 153), (27, 158, 119), (231, 41, 138), (31, 120, 180))


def parents_of(joints: Sequence[str], parents: Sequence[int] | None) -> Sequence[int]:
    """The parent of each joint, as given or as the standard skeleton of these joints has it.

    Raises:
        ValueError: none are given, and no standard skeleton has these joints.
    """
    if parents is not None:
        return parents
    for skeleton in SKELETONS.values():
        if skeleton.joints == tuple(joints):
            return skeleton.parents
    raise ValueError(
        f"parents: found none for {len(joints)} joints that are no standard skeleton's; give the "
        "index of each joint's parent, -1 for the root."
    )


def bones(
    poses: Float[np.ndarray, "*batch J 3"], parents: Sequence[int]
) -> Float[np.ndarray, "*batch B 2 3"]:
    """A line from each joint's parent to the joint; the root has none."""
    joints = [joint for joint, parent in enumerate(parents) if parent >= 0]
    above = [parents[joint] for joint in joints]
    return np.stack([poses[..., above, :], poses[..., joints, :]], axis=-2)


def future_rgb(sample: int) -> tuple[int, int, int]:
    """The colour of a future."""
    return _HUES[sample % len(_HUES)]
