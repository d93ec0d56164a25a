"""Where a recording leaps as no body can, and what is left when it is cut there."""

import itertools

import numpy as np
from jaxtyping import Bool, Float

from models.motion.skeleton import Skeleton, resolve_joints
from training.data.corpora import GlitchLimits


def glitch_steps(
    positions: Float[np.ndarray, "T J 3"], *, skeleton: Skeleton, fps: float, limits: GlitchLimits
) -> Bool[np.ndarray, "T-1"]:
    """True at t where the step from frame t to t + 1 breaks one of the limits."""
    root = positions[:, 0]
    joint_speed = _speed(positions - root[:, None], fps).max(axis=1)
    root_speed = _speed(root, fps)
    return np.asarray(
        (joint_speed > limits.joint_speed)
        | (root_speed > limits.root_speed)
        | _accelerated(root, root_speed, fps, limits.root_acceleration)
        | (_turn_rate(positions, skeleton, fps) > limits.root_turn)
        | _jumps(_speed(positions - root[:, None], fps), limits).any(axis=1)
        | _jumps(root_speed[:, None], limits).any(axis=1)
    )


def clean_parts(
    glitches: Bool[np.ndarray, "steps"], *, shortest: int
) -> tuple[tuple[slice, ...], int]:
    """The runs of at least ``shortest`` frames between glitches, and how many frames are lost."""
    cuts = [0, *(np.flatnonzero(glitches) + 1).tolist(), len(glitches) + 1]
    runs = [slice(a, b) for a, b in itertools.pairwise(cuts)]
    kept = tuple(run for run in runs if run.stop - run.start >= shortest)
    return kept, len(glitches) + 1 - sum(run.stop - run.start for run in kept)


def _speed(path: Float[np.ndarray, "T *any 3"], fps: float) -> Float[np.ndarray, "steps *any"]:
    return np.asarray(np.linalg.norm(np.diff(path, axis=0), axis=-1) * fps)


def _accelerated(
    root: Float[np.ndarray, "T 3"], speed: Float[np.ndarray, "steps"], fps: float, limit: float
) -> Bool[np.ndarray, "steps"]:
    """Of the two steps around a frame that is accelerated too much, the faster one."""
    found = np.zeros(len(speed), dtype=bool)
    acceleration = np.linalg.norm(np.diff(root, n=2, axis=0), axis=-1) * fps**2
    for t in np.flatnonzero(acceleration > limit):
        found[t + int(speed[t + 1] > speed[t])] = True
    return found


def _turn_rate(
    positions: Float[np.ndarray, "T J 3"], skeleton: Skeleton, fps: float
) -> Float[np.ndarray, "steps"]:
    """Angular speed of the line between the hip joints; 0 where the skeleton has none."""
    own = resolve_joints(skeleton)
    if not {"left_upper_leg", "right_upper_leg"} <= own.keys():
        return np.zeros(len(positions) - 1)
    left, right = (skeleton.index(own[f"{side}_upper_leg"]) for side in ("left", "right"))
    across = (positions[:, left] - positions[:, right]).astype(np.float64)
    sine = np.linalg.norm(np.cross(across[1:], across[:-1]), axis=-1)
    return np.asarray(np.arctan2(sine, (across[1:] * across[:-1]).sum(axis=-1)) * fps)


def _jumps(
    speed: Float[np.ndarray, "steps J"], limits: GlitchLimits
) -> Bool[np.ndarray, "steps J"]:
    around = np.pad(speed, ((1, 1), (0, 0)), constant_values=np.inf)  # ends have one neighbour
    neighbours = np.maximum(around[:-2], around[2:])
    return np.asarray((speed > limits.jump_speed) & (speed > limits.jump_factor * neighbours))
