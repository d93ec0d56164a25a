"""Skeletons: joint names and parents, the standard ones, and the linear maps between them."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from models.motion.joint_tables import (
    ALIASES,
    BODY21_FROM_H36M17,
    BODY21_FROM_HUMANEVA15,
    BODY21_FROM_SMPL22,
    ESTIMATES,
    H36M17_FROM_BODY21,
    HUMANEVA15_FROM_BODY21,
    PLACEHOLDERS,
    REQUIRED,
    SMPL22_FROM_BODY21,
    Weights,
)

Side = Literal["left", "right", "center"]

_SIDE_TOKENS = (  # how names write a side: LeftArm, LHip, Hand_L, thigh_l, WristL
    (re.compile(r"left", re.IGNORECASE), re.compile(r"right", re.IGNORECASE)),
    (
        re.compile(r"(?<![A-Za-z])L(?=[A-Z][a-z]|[_. ]|$)"),
        re.compile(r"(?<![A-Za-z])R(?=[A-Z][a-z]|[_. ]|$)"),
    ),
    (re.compile(r"(?<=[_. ])l(?![A-Za-z])"), re.compile(r"(?<=[_. ])r(?![A-Za-z])")),
    (re.compile(r"(?<![A-Za-z])l(?=[_. ])"), re.compile(r"(?<![A-Za-z])r(?=[_. ])")),
    (re.compile(r"(?<=[a-z])L$"), re.compile(r"(?<=[a-z])R$")),
)
_WORDS = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "L": "R", "l": "r"}
_SWAPPED = _WORDS | {right: left for left, right in _WORDS.items()}
_RIG_PREFIX = re.compile(r"^(.*:|mixamorig\d*_?|CC_Base_|Bip0*1[ _]?)", re.IGNORECASE)


class SkeletonError(ValueError):
    """A skeleton that is not a tree of named joints, or names that cannot be resolved."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Skeleton:
    """Named joints in a tree; parents come before children and the root's parent is -1.

    `mapping` holds pairs (own joint, body21 joint) where the user says which is which; where it is
    empty, names are recognised by the alias table.
    """

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    mapping: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        _check_tree(self.name, self.joints, self.parents)

    @property
    def num_joints(self) -> int:
        """The number of joints J."""
        return len(self.joints)

    @property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """For each joint the indices of its children, in order."""
        return children_of(self.parents)

    @property
    def sides(self) -> tuple[Side, ...]:
        """For each joint the side its name says; `center` where it says none."""
        return tuple(_side(joint, frozenset(self.joints)) for joint in self.joints)

    @property
    def mirror(self) -> tuple[int, ...]:
        """The permutation that exchanges left and right; unpaired joints stay where they are."""
        index = {joint: i for i, joint in enumerate(self.joints)}
        return tuple(
            index.get(_counterpart(joint, frozenset(index)), i) for joint, i in index.items()
        )

    def index(self, joint: str) -> int:
        """The index of a joint.

        Raises:
            SkeletonError: There is no such joint.
        """
        if joint not in self.joints:
            known = ", ".join(self.joints)
            raise SkeletonError(f"{self.name}: found no joint {joint!r}; it has: {known}.")
        return self.joints.index(joint)


def children_of(parents: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """For each joint the indices of its children, in order."""
    children: list[list[int]] = [[] for _ in parents]
    for child, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(child)
    return tuple(map(tuple, children))


def _check_tree(name: str, joints: tuple[str, ...], parents: tuple[int, ...]) -> None:
    if len(joints) != len(parents) or not joints:
        raise SkeletonError(
            f"{name}: found {len(joints)} joints and {len(parents)} parents; "
            "there must be one parent for each of at least one joint."
        )
    duplicates = sorted(joint for joint, count in Counter(joints).items() if count > 1)
    if duplicates:
        raise SkeletonError(f"{name}.joints: found {duplicates} twice; names must be unique.")
    for i, parent in enumerate(parents):
        if (parent != -1) if i == 0 else not 0 <= parent < i:
            raise SkeletonError(
                f"{name}.parents[{i}]: found {parent}; the root comes first with -1 and every "
                "other joint after its parent."
            )


def _side_match(joint: str) -> tuple[Side, re.Match[str]] | None:
    for left, right in _SIDE_TOKENS:
        if match := left.search(joint):
            return "left", match
        if match := right.search(joint):
            return "right", match
    return None


def _counterpart(joint: str, joints: frozenset[str]) -> str:
    found = _side_match(joint)
    if found:
        match = found[1]
        return joint[: match.start()] + _SWAPPED.get(match.group(), "") + joint[match.end() :]
    swapped = _SWAPPED.get(joint[:1], "")  # ASF: lfemur and rfemur, told from "lowerback" by pairs
    return swapped + joint[1:] if swapped in ("l", "r") and swapped + joint[1:] in joints else joint


def _side(joint: str, joints: frozenset[str]) -> Side:
    found = _side_match(joint)
    if found:
        return found[0]
    if _counterpart(joint, joints) == joint:
        return "center"
    return "left" if joint.startswith("l") else "right"


def _standard(name: str, table: Sequence[tuple[str, int]]) -> Skeleton:
    return Skeleton(
        name=name, joints=tuple(j for j, _ in table), parents=tuple(p for _, p in table)
    )


# fmt: off
BODY21 = _standard("body21", (
    ("hips", -1), ("spine", 0), ("chest", 1), ("neck", 2), ("head", 3),
    ("left_shoulder", 2), ("left_upper_arm", 5), ("left_lower_arm", 6), ("left_hand", 7),
    ("right_shoulder", 2), ("right_upper_arm", 9), ("right_lower_arm", 10), ("right_hand", 11),
    ("left_upper_leg", 0), ("left_lower_leg", 13), ("left_foot", 14), ("left_toes", 15),
    ("right_upper_leg", 0), ("right_lower_leg", 17), ("right_foot", 18), ("right_toes", 19),
))
SMPL22 = _standard("smpl22", (
    ("pelvis", -1), ("left_hip", 0), ("right_hip", 0), ("spine1", 0),
    ("left_knee", 1), ("right_knee", 2), ("spine2", 3), ("left_ankle", 4), ("right_ankle", 5),
    ("spine3", 6), ("left_foot", 7), ("right_foot", 8), ("neck", 9),
    ("left_collar", 9), ("right_collar", 9), ("head", 12),
    ("left_shoulder", 13), ("right_shoulder", 14), ("left_elbow", 16), ("right_elbow", 17),
    ("left_wrist", 18), ("right_wrist", 19),
))
H36M17 = _standard("h36m17", (
    ("Hip", -1), ("RHip", 0), ("RKnee", 1), ("RAnkle", 2), ("LHip", 0), ("LKnee", 4),
    ("LAnkle", 5), ("Spine", 0), ("Thorax", 7), ("Neck", 8), ("Head", 9),
    ("LShoulder", 8), ("LElbow", 11), ("LWrist", 12), ("RShoulder", 8), ("RElbow", 14),
    ("RWrist", 15),
))
HUMANEVA15 = _standard("humaneva15", (
    ("Pelvis", -1), ("Thorax", 0), ("LShoulder", 1), ("LElbow", 2), ("LWrist", 3),
    ("RShoulder", 1), ("RElbow", 5), ("RWrist", 6), ("LHip", 0), ("LKnee", 8), ("LAnkle", 9),
    ("RHip", 0), ("RKnee", 11), ("RAnkle", 12), ("Head", 1),
))
# fmt: on
SKELETONS: dict[str, Skeleton] = {s.name: s for s in (BODY21, SMPL22, H36M17, HUMANEVA15)}

_IDENTITY: Mapping[str, Weights] = {joint: {joint: 1.0} for joint in BODY21.joints}
_TABLES: dict[frozenset[str], tuple[Mapping[str, Weights], Mapping[str, Weights]]] = {
    frozenset(BODY21.joints): (_IDENTITY, _IDENTITY),
    frozenset(SMPL22.joints): (BODY21_FROM_SMPL22, SMPL22_FROM_BODY21),
    frozenset(H36M17.joints): (BODY21_FROM_H36M17, H36M17_FROM_BODY21),
    frozenset(HUMANEVA15.joints): (BODY21_FROM_HUMANEVA15, HUMANEVA15_FROM_BODY21),
}


def _plain(joint: str) -> str:
    return re.sub(r"[^a-z0-9]", "", _RIG_PREFIX.sub("", joint).casefold())


@lru_cache(maxsize=256)
def resolve_joints(skeleton: Skeleton) -> Mapping[str, str]:
    """The body21 joints that the skeleton has, each with the skeleton's own name for it."""
    if skeleton.mapping:
        return {body21: own for own, body21 in skeleton.mapping}
    plain: dict[str, str] = {}
    for joint in skeleton.joints:
        plain.setdefault(_plain(joint), joint)
    found: dict[str, str] = {}
    for body21, aliases in ALIASES.items():
        alias = next((a for a in aliases if a in plain), None)
        if alias is not None:
            found[body21] = plain.pop(alias)
    return found


def skeleton_from_names(
    joints: Sequence[str],
    mapping: Mapping[str, str] | None = None,
    parents: Sequence[int] | None = None,
) -> Skeleton:
    """A skeleton of the user's own joints, resolved to body21 by `mapping` or by their names.

    `mapping` is {own joint: body21 joint}. Without `parents` every joint hangs on the first, which
    is enough for maps but not for bones.

    Raises:
        SkeletonError: The map names joints that do not exist, or a required joint is missing.
    """
    pairs = tuple((mapping or {}).items())
    for own, body21 in pairs:
        if own not in joints:
            raise SkeletonError(f"map[{own!r}]: found no such joint; joints are: {list(joints)}.")
        if body21 not in BODY21.joints:
            known = ", ".join(BODY21.joints)
            raise SkeletonError(f"map[{own!r}]: found {body21!r}; it must be one of: {known}.")
    if len({body21 for _, body21 in pairs}) < len(pairs):
        raise SkeletonError("map: found two joints for one of body21; each may be named once.")
    tree = tuple(parents) if parents is not None else (-1, *[0] * (len(joints) - 1))
    skeleton = Skeleton(name="custom", joints=tuple(joints), parents=tree, mapping=pairs)
    _to_body21(skeleton)  # raises where a required joint is missing
    return skeleton


def _standard_tables(
    skeleton: Skeleton,
) -> tuple[Mapping[str, Weights], Mapping[str, Weights]] | None:
    return None if skeleton.mapping else _TABLES.get(frozenset(skeleton.joints))


def _matrix(rows: Sequence[Weights], columns: Sequence[str]) -> Float[np.ndarray, "rows columns"]:
    index = {joint: i for i, joint in enumerate(columns)}
    weights = np.zeros((len(rows), len(columns)))
    for i, row in enumerate(rows):
        for joint, weight in row.items():
            weights[i, index[joint]] = weight
    return weights


def _to_body21(
    source: Skeleton,
) -> tuple[Float[np.ndarray, "21 Js"], Bool[np.ndarray, "21"]]:
    tables = _standard_tables(source)
    found = tables[0] if tables else {b: {own: 1.0} for b, own in resolve_joints(source).items()}
    missing = [joint for joint in REQUIRED if joint not in found]
    if missing:
        raise SkeletonError(
            f"{source.name}.joints: found nothing for {', '.join(missing)}; both upper legs, "
            "knees (lower_leg), ankles (foot) and upper arms are needed: name them in `map`."
        )
    rows = {joint: _matrix([row], source.joints)[0] for joint, row in found.items()}
    known = set(rows)
    for table in (ESTIMATES, PLACEHOLDERS):
        for joint, row in table.items():
            if joint not in rows:
                rows[joint] = np.sum([w * rows[other] for other, w in row.items()], axis=0)
        known |= set(rows) if table is ESTIMATES else set()
    weights = np.stack([rows[joint] for joint in BODY21.joints])
    return weights, np.array([joint in known for joint in BODY21.joints])


def _from_body21(
    target: Skeleton,
) -> tuple[Float[np.ndarray, "Jt 21"], Bool[np.ndarray, "Jt"]]:
    tables = _standard_tables(target)
    own = {own: body21 for body21, own in resolve_joints(target).items()}
    table = tables[1] if tables else {joint: {body21: 1.0} for joint, body21 in own.items()}
    rows: list[Weights] = []
    for joint, parent in zip(target.joints, target.parents, strict=True):
        above = rows[parent] if parent >= 0 else {"hips": 1.0}
        rows.append(table.get(joint, above))
    known = np.array([joint in table for joint in target.joints])
    return _matrix(rows, BODY21.joints), known


@lru_cache(maxsize=256)
def joint_map(
    source: Skeleton, target: Skeleton
) -> tuple[Float[np.ndarray, "Jt Js"], Bool[np.ndarray, "Jt"]]:
    """Weights such that target positions = weights @ source positions, and which can be trusted.

    Rows sum to 1, so the map keeps translations. Where `known` is false there is no linear estimate
    and the row holds a nearby joint (for toes the ankle). The arrays are shared and read-only.

    Raises:
        SkeletonError: A required joint of body21 is missing in the source.
    """
    if source.joints == target.joints:
        weights, known = np.eye(source.num_joints), np.ones(source.num_joints, dtype=bool)
    else:
        to_body21, known21 = _to_body21(source)
        from_body21, known = _from_body21(target)
        weights = from_body21 @ to_body21
        known = known & ~((from_body21 != 0) & ~known21).any(axis=1)
    weights.setflags(write=False)
    known.setflags(write=False)
    return weights, known
