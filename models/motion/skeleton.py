"""Skeletons: joint names and parents, the standard ones, and the linear maps between them."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from models.motion.joint_tables import (
    ALIASES,
    BODY21_FROM_H36M17,
    BODY21_FROM_KINECT25,
    BODY21_FROM_SMPL22,
    BODY21_FROM_SMPL24,
    ESTIMATES,
    FACE_ALIASES,
    H36M17_FROM_BODY21,
    KINECT25_FROM_BODY21,
    PLACEHOLDERS,
    REQUIRED,
    SMPL22_FROM_BODY21,
    SMPL24_FROM_BODY21,
    Weights,
)
from models.motion.standards import STANDARDS

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


def parents_first(parents: Sequence[int]) -> tuple[int, ...]:
    """The indices of a tree's joints in an order that puts parents before their children.

    Raises:
        SkeletonError: It is no tree.
    """
    num_joints = len(parents)
    if not all(-1 <= parent < num_joints for parent in parents):
        raise SkeletonError(
            f"parents: found {list(parents)[:40]}; each must be an index from -1 (the root) to "
            f"{num_joints - 1}."
        )
    if all(parent < joint for joint, parent in enumerate(parents)) and parents[1:].count(-1) == 0:
        return tuple(range(num_joints))
    roots = [joint for joint, parent in enumerate(parents) if parent < 0]
    order = list(roots)
    for joint in order:
        order += [child for child, parent in enumerate(parents) if parent == joint]
    if len(roots) != 1 or len(order) != num_joints:
        raise SkeletonError("parents: found no tree; exactly one joint has -1 and none is a loop.")
    return tuple(order)


def in_tree_order(
    name: str,
    joints: Sequence[str],
    parents: Sequence[int],
    mapping: tuple[tuple[str, str], ...] = (),
) -> tuple[Skeleton, tuple[int, ...]]:
    """A skeleton of joints in any order, and for each joint of it the index in that order.

    Raises:
        SkeletonError: They are no tree of named joints.
    """
    if len(parents) != len(joints):
        raise SkeletonError(
            f"parents: found {len(parents)}; there must be one for each of {len(joints)} joints."
        )
    order = parents_first(tuple(parents))
    place = {joint: i for i, joint in enumerate(order)}
    tree = tuple(-1 if parents[joint] < 0 else place[parents[joint]] for joint in order)
    names = tuple(joints[joint] for joint in order)
    return Skeleton(name=name, joints=names, parents=tree, mapping=mapping), order


_TREES = {name: in_tree_order(name, s.joints, s.parents) for name, s in STANDARDS.items()}
SKELETONS: dict[str, Skeleton] = {name: tree for name, (tree, _) in _TREES.items()}
SENT_ORDERS: dict[str, tuple[int, ...]] = {name: order for name, (_, order) in _TREES.items()}
"""For each joint of a standard skeleton its index in the order in which its source sends it."""
BODY21, SMPL22, H36M17 = SKELETONS["body21"], SKELETONS["smpl22"], SKELETONS["h36m17"]

_Tables: TypeAlias = tuple[Mapping[str, Weights], Mapping[str, Weights]]
_IDENTITY: Mapping[str, Weights] = {joint: {joint: 1.0} for joint in BODY21.joints}
_TABLES: dict[str, _Tables] = {
    "body21": (_IDENTITY, _IDENTITY),
    "smpl22": (BODY21_FROM_SMPL22, SMPL22_FROM_BODY21),
    "smpl24": (BODY21_FROM_SMPL24, SMPL24_FROM_BODY21),
    "h36m17": (BODY21_FROM_H36M17, H36M17_FROM_BODY21),
    "kinect25": (BODY21_FROM_KINECT25, KINECT25_FROM_BODY21),
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


def _standard_tables(skeleton: Skeleton) -> _Tables | None:
    """The tables of the standard skeleton that this one is, or of whose joints it has some."""
    if skeleton.mapping:
        return None
    joints = set(skeleton.joints)
    for name, tables in _TABLES.items():
        own = set(SKELETONS[name].joints)
        if joints == own or (skeleton.name == name and joints < own):
            return tables
    return None


def _faces(skeleton: Skeleton) -> Mapping[str, str]:
    """The points of the head that the skeleton has: {its name: what it is}."""
    meant = {alias: point for point, aliases in FACE_ALIASES.items() for alias in aliases}
    return {
        joint: meant[_plain(joint)]
        for joint in skeleton.joints
        if not skeleton.mapping and _plain(joint) in meant
    }


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
    found = {joint: row for joint, row in found.items() if set(row) <= set(source.joints)}
    missing = [joint for joint in REQUIRED if joint not in found]
    if missing:
        raise SkeletonError(
            f"{source.name}.joints: found nothing for {', '.join(missing)}; both upper legs, "
            "knees (lower_leg), ankles (foot) and upper arms are needed: name them in `map`."
        )
    found = {point: {own: 1.0} for own, point in _faces(source).items()} | found
    rows = {joint: _matrix([row], source.joints)[0] for joint, row in found.items()}
    known = set(rows)
    for table in (ESTIMATES, PLACEHOLDERS):
        for joint, row in table.items():
            if joint not in rows and set(row) <= rows.keys():
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
    faces = _faces(target)
    rows: list[Weights] = []
    for joint, parent in zip(target.joints, target.parents, strict=True):
        above = {"head": 1.0} if joint in faces else rows[parent] if parent >= 0 else {"hips": 1.0}
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
