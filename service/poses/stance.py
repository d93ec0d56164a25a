"""Whether a body stands as its caller says: the units, the up axis, and which side is left."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from models.motion.axes import UNITS_PER_METRE, Axes
from models.motion.guesses import LEGS_M, UPRIGHT, Body, guess_units, guess_up, leg_length

About = Literal["units", "up", "sides", "joints", "frozen", "limbs", "teleport", "path"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """Something odd: what it is about, and a sentence that says it."""

    about: About
    sentence: str


def stance(body: Body, axes: Axes, looks: Axes) -> list[Finding]:
    """What is odd about a body in metres, +Z up, that came in axes and looks like others."""
    upright = turned(body, axes, looks)
    return [*_units(body, axes, looks), *_up(axes, looks), *_sides(upright)]


def guessed_axes(body: Body, axes: Axes) -> Axes:
    """The up axis and the unit that it looks like."""
    raw = {joint: axes.from_metres(body[joint]) for joint in UPRIGHT}
    leg = leg_length(body) * UNITS_PER_METRE[axes.units]
    return Axes(up=guess_up(raw), units=guess_units(leg), handed=axes.handed)


def turned(body: Body, axes: Axes, looks: Axes) -> Body:
    """The same as if it had come in the axes that it looks like."""
    if looks == axes:
        return body
    return {joint: looks.to_metres(axes.from_metres(path)) for joint, path in body.items()}


def _units(body: Body, axes: Axes, looks: Axes) -> Iterator[Finding]:
    leg_m = leg_length(body)
    looks_m = leg_m * UNITS_PER_METRE[axes.units] / UNITS_PER_METRE[looks.units]
    if not LEGS_M[0] <= looks_m <= LEGS_M[1]:
        yield Finding(
            about="units",
            sentence=f"A leg is {leg_m:.3g} m long, which no unit makes that of a person.",
        )
    elif looks.units != axes.units:
        yield Finding(
            about="units",
            sentence=f"A leg is {leg_m:.3g} m long where units are {axes.units!r}; they look like "
            f"{looks.units!r}.",
        )


def _up(axes: Axes, looks: Axes) -> Iterator[Finding]:
    if looks.up != axes.up:
        yield Finding(
            about="up",
            sentence=f"The shoulders are over the feet along {looks.up!r}, not along "
            f"{axes.up!r}: the person lies, or up is {looks.up!r}.",
        )


def _sides(body: Body) -> Iterator[Finding]:
    """Toes point to where the body faces if left is left; without toes, knees bend to there."""
    legs = body["left_upper_leg"] - body["right_upper_leg"]
    arms = body["left_upper_arm"] - body["right_upper_arm"]
    if np.median((legs[:, :2] * arms[:, :2]).sum(axis=-1)) < 0.0:
        yield Finding(
            about="sides",
            sentence="The left leg is on the side of the right arm: the sides of the legs or of "
            "the arms are swapped.",
        )
        return
    forward = np.stack([legs[:, 1], -legs[:, 0]], axis=-1)
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
    ahead = []
    for side in ("left", "right"):
        hip, knee, ankle = (body[f"{side}_{p}"] for p in ("upper_leg", "lower_leg", "foot"))
        toes = body.get(f"{side}_toes")
        pointing = knee - (hip + ankle) / 2.0 if toes is None else toes - ankle
        ahead.append((pointing[:, :2] * forward).sum(axis=-1))
    if np.median(ahead) < -0.01:
        what = "toes point" if "left_toes" in body else "knees bend"
        yield Finding(
            about="sides",
            sentence=f"The {what} backwards: left and right look swapped, or the picture mirrored.",
        )
