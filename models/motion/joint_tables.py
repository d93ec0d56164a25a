"""Joint names and weights as data: aliases of body21's joints and how other skeletons map to it."""

from collections.abc import Mapping

Weights = Mapping[str, float]

# For each body21 joint the names it goes by, best first; a name serves one joint only, in the order
# of this table: "shoulder" is the upper arm unless a better name claims that, then the collar bone.
# Names are compared without case, separators and rig prefixes.
_CENTER_ALIASES: dict[str, tuple[str, ...]] = {
    "hips": ("hips", "hip", "pelvis", "midhip", "spinebase"),
    "spine": ("lowerback", "waist", "spinenavel", "spinemid", "spine", "spine01", "spine1"),
    "chest": ("thorax", "chest", "spinechest", "spine02", "spine2", "spine1", "upperback"),
    "neck": ("lowerneck", "necktwist01", "neck", "neck01", "neck1"),
    "head": ("head",),
}
_SIDE_ALIASES: dict[str, tuple[str, ...]] = {
    "upper_arm": ("upperarm", "arm", "armupper", "humerus", "shoulder"),
    "shoulder": ("clavicle", "collar", "shoulder"),
    "lower_arm": ("lowerarm", "forearm", "armlower", "elbow", "radius"),
    "hand": ("wrist", "hand"),
    "upper_leg": ("upperleg", "upleg", "thigh", "femur", "hip"),
    "lower_leg": ("lowerleg", "calf", "shin", "tibia", "knee", "leg"),
    "foot": ("ankle", "foot"),
    "toes": ("toes", "toebase", "toe", "toe0", "ball", "bigtoe", "footindex", "foot"),
}


def _side_aliases(side: str, part: str) -> tuple[str, ...]:
    words = [f"{token}{alias}" for alias in _SIDE_ALIASES[part] for token in (side, side[0])]
    words += [f"{alias}{side[0]}" for alias in _SIDE_ALIASES[part]]
    # ASF splits the forearm at "lwrist" and starts "lhand" at the wrist.
    return (f"{side[0]}hand", *words) if part == "hand" else tuple(words)


ALIASES: dict[str, tuple[str, ...]] = _CENTER_ALIASES | {
    f"{side}_{part}": _side_aliases(side, part)
    for side in ("left", "right")
    for part in _SIDE_ALIASES
}

REQUIRED = tuple(
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("upper_leg", "lower_leg", "foot", "upper_arm")
)


def both_sides(table: Mapping[str, Weights], left: str, right: str) -> dict[str, Weights]:
    """Adds to a table of weights the mirror image of every row named with the prefix `left`."""

    def swap(name: str) -> str:
        return right + name[len(left) :] if name.startswith(left) else name

    mirrored = {
        swap(joint): {swap(source): weight for source, weight in row.items()}
        for joint, row in table.items()
        if joint.startswith(left)
    }
    return {**table, **mirrored}


# Estimates of body21 joints from others of body21, used in this order for joints without a source.
# The ratios are means over the training archives (hips to 5 mm, trunk to 2 to 4 cm).
ESTIMATES: dict[str, Weights] = both_sides(
    {
        "hips": {
            "left_upper_leg": 0.4785,
            "right_upper_leg": 0.4785,
            "left_upper_arm": 0.0215,
            "right_upper_arm": 0.0215,
        },
        "neck": {"hips": 0.05, "left_upper_arm": 0.475, "right_upper_arm": 0.475},
        "chest": {"hips": 0.36, "neck": 0.64},
        "spine": {"hips": 0.55, "chest": 0.45},
        "left_shoulder": {"neck": 0.75, "left_upper_arm": 0.25},
    },
    "left_",
    "right_",
)
# The same for joints that cannot be known from the others: a finite place, marked as unknown.
PLACEHOLDERS: dict[str, Weights] = both_sides(
    {
        "head": {"neck": 1.45, "hips": -0.45},
        "left_lower_arm": {"left_upper_arm": 1.0},
        "left_hand": {"left_lower_arm": 1.0},
        "left_toes": {"left_foot": 1.0},
    },
    "left_",
    "right_",
)

# Standard skeletons. Each row: a joint as a weighted sum of joints of the other skeleton. Limbs are
# the same points; the trunk is placed by the heights of the usual template bodies.
_SMPL_LIMBS = {
    "left_collar": "left_shoulder",
    "left_shoulder": "left_upper_arm",
    "left_elbow": "left_lower_arm",
    "left_wrist": "left_hand",
    "left_hip": "left_upper_leg",
    "left_knee": "left_lower_leg",
    "left_ankle": "left_foot",
    "left_foot": "left_toes",
}
BODY21_FROM_SMPL22: Mapping[str, Weights] = both_sides(
    {
        "hips": {"pelvis": 0.25, "left_hip": 0.375, "right_hip": 0.375},
        "spine": {"pelvis": 0.5, "spine1": 0.5},
        "chest": {"spine2": 1.0},
        "neck": {"neck": 0.5, "left_collar": 0.25, "right_collar": 0.25},
        "head": {"head": 1.0},
    }
    | {body21: {smpl: 1.0} for smpl, body21 in _SMPL_LIMBS.items()},
    "left_",
    "right_",
)
SMPL22_FROM_BODY21: Mapping[str, Weights] = both_sides(
    {
        "pelvis": {"hips": 0.55, "spine": 0.45},
        "spine1": {"spine": 0.6, "chest": 0.4},
        "spine2": {"chest": 1.0},
        "spine3": {"chest": 0.6, "neck": 0.4},
        "neck": {"neck": 0.45, "head": 0.55},
        "head": {"head": 1.0},
    }
    | {smpl: {body21: 1.0} for smpl, body21 in _SMPL_LIMBS.items()},
    "left_",
    "right_",
)

_H36M_LIMBS = {
    "RShoulder": "right_upper_arm",
    "RElbow": "right_lower_arm",
    "RWrist": "right_hand",
    "RHip": "right_upper_leg",
    "RKnee": "right_lower_leg",
    "RAnkle": "right_foot",
    "LShoulder": "left_upper_arm",
    "LElbow": "left_lower_arm",
    "LWrist": "left_hand",
    "LHip": "left_upper_leg",
    "LKnee": "left_lower_leg",
    "LAnkle": "left_foot",
}
BODY21_FROM_H36M17: Mapping[str, Weights] = {
    "hips": {"Hip": 0.956, "Thorax": 0.044},
    "spine": {"Hip": 0.53, "Spine": 0.47},
    "chest": {"Spine": 0.62, "Thorax": 0.38},
    "neck": {"Spine": 0.15, "Thorax": 0.85},
    "head": {"Neck": 0.66, "Head": 0.34},
    "left_shoulder": {"Thorax": 0.8, "LShoulder": 0.2},
    "right_shoulder": {"Thorax": 0.8, "RShoulder": 0.2},
} | {body21: {h36m: 1.0} for h36m, body21 in _H36M_LIMBS.items()}
H36M17_FROM_BODY21: Mapping[str, Weights] = {
    "Hip": {"left_upper_leg": 0.5, "right_upper_leg": 0.5},
    "Spine": {"spine": 0.45, "chest": 0.55},
    "Thorax": {"neck": 0.5, "left_upper_arm": 0.25, "right_upper_arm": 0.25},
    "Neck": {"neck": 0.4, "head": 0.6},
    "Head": {"neck": -0.4, "head": 1.4},
} | {h36m: {body21: 1.0} for h36m, body21 in _H36M_LIMBS.items()}

# HumanEva's limbs are named as Human3.6M's; between pelvis and thorax it has no joint.
BODY21_FROM_HUMANEVA15: Mapping[str, Weights] = {
    **BODY21_FROM_H36M17,
    "hips": {"Pelvis": 0.956, "Thorax": 0.044},
    "spine": {"Pelvis": 0.765, "Thorax": 0.235},
    "chest": {"Pelvis": 0.31, "Thorax": 0.69},
    "neck": {"Pelvis": 0.075, "Thorax": 0.925},
    "head": {"Thorax": 0.286, "Head": 0.714},
}
HUMANEVA15_FROM_BODY21: Mapping[str, Weights] = {"Pelvis": H36M17_FROM_BODY21["Hip"]} | {
    joint: weights
    for joint, weights in H36M17_FROM_BODY21.items()
    if joint not in ("Hip", "Spine", "Neck")
}
