"""What is odd about an observation, each thing in one plain sentence."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from models.motion.axes import Axes
from models.motion.gaps import filled
from models.motion.guesses import Body, body_of, middle
from models.motion.trees import without_joints
from service.observation import Seen, sources
from service.poses.stance import Finding, stance, turned

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


def whole_body(seen: Seen) -> Body:
    """The body that the joints which were ever seen tell of, without gaps in time."""
    ever = np.isfinite(seen.world[:, :, 0]).any(axis=0)
    tree = without_joints(seen.skeleton, ever)
    times = np.arange(len(seen.world), dtype=float) if seen.times is None else seen.times
    return body_of(filled(seen.world[:, ever], times, tree.parents), tree)


def findings(seen: Seen, body: Body, *, axes: Axes, looks: Axes, fps: float) -> list[Finding]:
    """All that is odd; beyond the axes, as if those were what the poses look like.

    Args:
        seen: as it was sent.
        body: what `whole_body` makes of it.
        axes: that it is said to be in.
        looks: those that the body looks like.
        fps: of the frames, where they have no times.
    """
    found = [*stance(body, axes, looks), *_joints(seen), *_frozen(seen)]
    upright = turned(body, axes, looks)
    times = np.arange(len(seen.world)) / fps if seen.times is None else seen.times
    return [*found, *_limbs(upright), *_teleport(upright, times), *_path(upright)]


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


def _limbs(body: Body) -> Iterator[Finding]:
    noise = {}
    for upper, lower in LIMBS:
        if upper in body and lower in body:
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


def _teleport(body: Body, times: Float[np.ndarray, "T"]) -> Iterator[Finding]:
    steps = np.linalg.norm(np.diff(middle(body, "upper_leg"), axis=0), axis=-1)
    speeds = steps / np.diff(times)
    if len(speeds) and speeds.max() > MAX_SPEED_M_S:
        frame = int(np.argmax(speeds))
        yield Finding(
            about="teleport",
            sentence=f"Between frames {frame} and {frame + 1} the body moves by "
            f"{steps[frame]:.2f} m at once, at {speeds[frame]:.0f} m/s; it may be another person.",
        )


def _path(body: Body) -> Iterator[Finding]:
    moved = np.max(np.ptp(middle(body, "upper_leg"), axis=0))
    stepped = np.max(np.ptp(body["left_foot"], axis=0))
    if moved < 1e-3 and stepped > 0.1:
        yield Finding(
            about="path",
            sentence="The hips never leave their place while the feet move: the path of the "
            "person is missing, so futures stay in place too.",
        )
