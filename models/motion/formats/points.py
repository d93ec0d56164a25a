"""Labelled points of motion capture, as C3D and TRC files hold them, where they are joints."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from models.motion.axes import UNITS_PER_METRE, Axes
from models.motion.formats.errors import EmptyMotionError, InvalidNumberError, UnsupportedFileError
from models.motion.formats.text import LARGEST
from models.motion.gaps import filled
from models.motion.guesses import body_of, guess_units, guess_up, leg_length
from models.motion.motion import Motion
from models.motion.skeleton import SkeletonError, in_tree_order, skeleton_from_names
from models.motion.trees import guessed_parents

MAX_LABELS_SHOWN = 40


def point_motion(
    points: Float[np.ndarray, "T N 3"],
    labels: Sequence[str],
    *,
    name: str,
    fps: float,
    units: str,
) -> Motion:
    """The motion of points that are joints by their names, NaN where one was not seen.

    The up axis is guessed from the body, and the unit where ``units`` is none that is known. Points
    without a name (``*12``), of a name that came before, or never seen are left out.

    Raises:
        UnsupportedFileError: The names are not those of joints, as those of markers are not.
        EmptyMotionError: There are no frames.
        InvalidNumberError: The rate or a coordinate is absurd.
    """
    if not len(points):
        raise EmptyMotionError(name, found="no frames", right="there must be at least one")
    if not 0.0 < fps < 1e4:
        raise InvalidNumberError(name, found=f"{fps} frames a second", right="it must be positive")
    if np.abs(np.nan_to_num(points)).max(initial=0.0) > LARGEST:
        raise InvalidNumberError(name, found="a coordinate over 1e6", right="all must be smaller")
    seen = np.isfinite(points).all(axis=-1)
    kept = [
        i
        for i, label in enumerate(labels)
        if not label.startswith("*") and label not in labels[:i] and seen[:, i].any()
    ]
    joints = [labels[i] for i in kept]
    raw = np.where(seen[:, kept, None], points[:, kept], np.nan)
    try:
        named = skeleton_from_names(joints) if joints else None
    except SkeletonError as error:
        raise _no_joints(name, labels, str(error)) from error
    if named is None:
        raise _no_joints(name, labels, "")
    whole = filled(raw, np.arange(len(raw), dtype=float), named.parents)
    tree, order = in_tree_order(name, joints, guessed_parents(named, whole[0]))
    said = [unit for unit in UNITS_PER_METRE if unit == units.strip().lower()]
    body = body_of(whole, named)
    axes = Axes(up=guess_up(body), units=said[0] if said else guess_units(leg_length(body)))
    return Motion(name=name, skeleton=tree, positions=axes.to_metres(raw[:, order]), fps=fps)


def _no_joints(name: str, labels: Sequence[str], reason: str) -> UnsupportedFileError:
    shown = ", ".join(labels[:MAX_LABELS_SHOWN]) or "none"
    more = f" and {len(labels) - MAX_LABELS_SHOWN} more" if len(labels) > MAX_LABELS_SHOWN else ""
    missing = reason.partition("found ")[2].partition(";")[0]
    return UnsupportedFileError(
        name,
        found=f"the points {shown}{more}" + (f", and {missing}" if missing else ""),
        right="points must be joints with names such as LHip or LeftKnee; markers on the skin are "
        "none, so compute the joints' centres first",
    )
