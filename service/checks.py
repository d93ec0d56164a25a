"""What is odd about an observation, each thing in one plain sentence."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from models.motion.axes import UNITS_PER_METRE, Axes
from models.motion.gaps import filled
from models.motion.guesses import LEGS_M, body_of, guess_units, guess_up, leg_length
from models.motion.trees import without_joints
from service.observation import Seen, sources

About = Literal["units", "up", "sides", "joints", "frozen", "limbs", "teleport", "path"]

LIMBS = tuple(
    (f"{side}_{upper}", f"{side}_{lower}")
    for side in ("left", "right")
    for upper, lower in (
        ("upper_leg", "lower_leg"),
        ("lower_leg", "foot"),
        ("upper_arm", "lower_arm"),
        ("lower_arm", "hand"),
    )
)
MAX_LIMB_NOISE = 0.03  # standard deviation of a bone's length, of its mean
MAX_SPEED_M_S = 12.0  # of the hips: what the fastest sprinter reaches
STILL_M = 1e-6

_Body = Mapping[str, np.ndarray]


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """Something odd: what it is about, and a sentence that says it."""

    about: About
    sentence: str


def whole(seen: Seen) -> Seen:
    """The joints that were ever seen, without gaps in time."""
    ever = np.isfinite(seen.world[:, :, 0]).any(axis=0)
    tree = without_joints(seen.skeleton, ever)
    times = np.arange(len(seen.world), dtype=float) if seen.times is None else seen.times
    world = filled(seen.world[:, ever], times, tree.parents)
    return replace(seen, world=world, skeleton=tree)


def guessed_axes(seen: Seen, axes: Axes) -> Axes:
    """The up axis and the unit that whole poses look like."""
    raw = axes.from_metres(seen.world)
    return Axes(
        up=guess_up(raw, seen.skeleton),
        units=guess_units(leg_length(raw, seen.skeleton)),
        handed=axes.handed,
    )


def findings(seen: Seen, axes: Axes, fps: float) -> list[Finding]:
    """All that is odd; beyond the axes, as if those were what the poses look like."""
    filled_in = whole(seen)
    looks = guessed_axes(filled_in, axes)
    found = [*_units(filled_in, axes, looks), *_up(axes, looks), *_joints(seen)]
    upright = looks.to_metres(axes.from_metres(filled_in.world))
    body = body_of(upright, filled_in.skeleton)
    times = np.arange(len(seen.world)) / fps if seen.times is None else seen.times
    found += [*_sides(body), *_frozen(seen), *_limbs(body), *_teleport(body, times), *_path(body)]
    return found


def _units(seen: Seen, axes: Axes, looks: Axes) -> Iterator[Finding]:
    leg_m = leg_length(seen.world, seen.skeleton)
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


def _joints(seen: Seen) -> Iterator[Finding]:
    given = dict(zip(seen.skeleton.joints, sources(seen), strict=True))
    for source, how in (("derived", "are derived from others"), ("imputed", "have to be guessed")):
        names = [joint for joint, found in given.items() if found == source]
        if names:
            yield Finding(
                about="joints",
                sentence=f"{len(names)} of {len(given)} joints are hardly seen and {how}: "
                f"{', '.join(names)}.",
            )


def _sides(body: _Body) -> Iterator[Finding]:
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


def _frozen(seen: Seen) -> Iterator[Finding]:
    steps = np.nan_to_num(np.abs(np.diff(seen.world, axis=0))).max(axis=(1, 2), initial=0.0)
    repeated = int((steps < STILL_M).sum())
    if repeated and repeated == len(steps):
        yield Finding(about="frozen", sentence="The person does not move at all in any frame.")
    elif repeated:
        yield Finding(
            about="frozen",
            sentence=f"{repeated} of {len(steps)} frames repeat the one before, the first of them "
            f"frame {int(np.argmax(steps < STILL_M)) + 1}: the source hangs, or is slower than "
            "its rate says.",
        )


def _limbs(body: _Body) -> Iterator[Finding]:
    noise = {}
    for upper, lower in LIMBS:
        if lower in body:
            lengths = np.linalg.norm(body[lower] - body[upper], axis=-1)
            noise[lower] = float(np.std(lengths) / max(float(np.mean(lengths)), 1e-9))
    loose = {bone: part for bone, part in noise.items() if part > MAX_LIMB_NOISE}
    if loose:
        worst = max(loose, key=lambda bone: loose[bone])
        yield Finding(
            about="limbs",
            sentence=f"{len(loose)} of {len(noise)} limbs change their length, most of all the "
            f"bone to {worst}, by {100.0 * loose[worst]:.0f} %; real bones keep it.",
        )


def _teleport(body: _Body, times: Float[np.ndarray, "T"]) -> Iterator[Finding]:
    steps = np.linalg.norm(np.diff(_pelvis(body), axis=0), axis=-1)
    speeds = steps / np.diff(times)
    if len(speeds) and speeds.max() > MAX_SPEED_M_S:
        frame = int(np.argmax(speeds))
        yield Finding(
            about="teleport",
            sentence=f"Between frames {frame} and {frame + 1} the body moves by "
            f"{steps[frame]:.2f} m at once, at {speeds[frame]:.0f} m/s; it may be another person.",
        )


def _path(body: _Body) -> Iterator[Finding]:
    moved = np.max(np.ptp(_pelvis(body), axis=0))
    stepped = np.max(np.ptp(body["left_foot"], axis=0))
    if moved < 1e-3 and stepped > 0.1:
        yield Finding(
            about="path",
            sentence="The hips never leave their place while the feet move: the path of the "
            "person is missing, so futures stay in place too.",
        )


def _pelvis(body: _Body) -> Float[np.ndarray, "T 3"]:
    return np.asarray((body["left_upper_leg"] + body["right_upper_leg"]) / 2.0)
