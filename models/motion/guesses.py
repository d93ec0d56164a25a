"""What positions alone tell of a person: which axis is up, and how long a unit is."""

import math
from collections.abc import Iterable, Mapping
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from models.motion.axes import UNITS_PER_METRE, Units, Up
from models.motion.skeleton import BODY21, Skeleton, joint_map

LEGS_M = (0.4, 1.15)  # hip to ankle, from a child of four to a very tall adult
UPRIGHT = ("left_upper_arm", "right_upper_arm", "left_foot", "right_foot")
_UPS: tuple[tuple[Up, Up], ...] = (("x", "-x"), ("y", "-y"), ("z", "-z"))


Body: TypeAlias = Mapping[str, np.ndarray]
"""The paths of joints of body21, (T, 3) each."""


def body_of(positions: Float[np.ndarray, "T J 3"], skeleton: Skeleton) -> Body:
    """The paths of body21's joints that can be told.

    Raises:
        SkeletonError: A required joint of body21 is missing.
    """
    weights, known = joint_map(skeleton, BODY21)
    paths: dict[str, np.ndarray] = {}
    for row, joint, is_known in zip(weights, BODY21.joints, known, strict=True):
        used = np.flatnonzero(row)
        if is_known:
            paths[joint] = row[used] @ positions[:, used]
    return paths


def guess_up(body: Body) -> Up:
    """The axis along which the upper arms are above the feet, most of the time; by `UPRIGHT`."""
    upwards = middle(body, "upper_arm") - middle(body, "foot")
    mean = np.median(upwards, axis=0)
    axis = int(np.abs(mean).argmax())
    return _UPS[axis][int(mean[axis] < 0)]


def leg_length(body: Body) -> float:
    """Hip to knee to ankle in units of the body, the mean of both legs; median over time."""
    lengths = [
        np.linalg.norm(body[f"{side}_{lower}"] - body[f"{side}_{upper}"], axis=-1)
        for side in ("left", "right")
        for upper, lower in (("upper_leg", "lower_leg"), ("lower_leg", "foot"))
    ]
    return float(np.median(np.sum(lengths, axis=0))) / 2.0


def guess_units(leg: float) -> Units:
    """The unit that makes a leg of this length one of a person, or nearly so."""
    factors: dict[Units, float] = {unit: 1.0 / per for unit, per in UNITS_PER_METRE.items()}
    factor = plausible_factor(leg, factors.values())
    return next(unit for unit in factors if factors[unit] == factor)


def plausible_factor(leg: float, factors: Iterable[float]) -> float:
    """The first factor that makes a leg of this length one of a person; else the one nearest."""
    tried = tuple(factors)
    fitting = (factor for factor in tried if LEGS_M[0] <= leg * factor <= LEGS_M[1])
    nearest = min(tried, key=lambda f: abs(math.log(max(leg * f, 1e-12))))
    return next(fitting, nearest)


def middle(body: Body, part: str) -> Float[np.ndarray, "T 3"]:
    """Half way between the left and the right one of a part, such as ``foot``."""
    return np.asarray((body[f"left_{part}"] + body[f"right_{part}"]) / 2.0)
