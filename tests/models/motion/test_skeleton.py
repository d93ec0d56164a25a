import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.motion.joint_tables import REQUIRED
from models.motion.skeleton import (
    BODY21,
    H36M17,
    SKELETONS,
    SMPL22,
    Skeleton,
    SkeletonError,
    joint_map,
    resolve_joints,
    skeleton_from_names,
)

MIXAMO = [
    "Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "HeadTop_End",
    *(f"{side}{part}" for side in ("Left", "Right") for part in (
        "Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase", "Toe_End")),
]  # fmt: skip
BANDAI = [
    "joint_Root", "Hips", "Spine", "Chest", "Neck", "Head",
    *(f"{part}_{side}" for side in "LR" for part in (
        "Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes")),
]  # fmt: skip
ASF = [
    "root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head",
    *(f"{side}{part}" for side in "lr" for part in (
        "clavicle", "humerus", "radius", "wrist", "hand", "fingers", "thumb", "hipjoint", "femur",
        "tibia", "foot", "toes")),
]  # fmt: skip
LIMBS = tuple(
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("shoulder", "upper_arm", "lower_arm", "hand", "upper_leg", "lower_leg", "foot")
)


def body(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(21, 3))


@pytest.mark.parametrize(
    ("joints", "parents", "message"),
    [
        (("a", "b"), (-1,), "2 joints and 1 parents"),
        ((), (), "0 joints"),
        (("a", "a"), (-1, 0), "unique"),
        (("a", "b"), (0, 0), "root comes first"),
        (("a", "b", "c"), (-1, 2, 0), r"parents\[1\]"),
        (("a", "b"), (-1, -1), r"parents\[1\]"),
    ],
)
def test_a_list_that_is_no_tree_is_refused(joints, parents, message):
    with pytest.raises(SkeletonError, match=message):
        Skeleton(name="x", joints=joints, parents=parents)


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=lambda s: s.name)
def test_mirror_exchanges_sides_and_keeps_the_tree(skeleton):
    mirror = skeleton.mirror
    assert sorted(mirror) == list(range(skeleton.num_joints))
    opposite = {"left": "right", "right": "left", "center": "center"}
    for joint, mirrored in enumerate(mirror):
        assert mirror[mirrored] == joint
        assert skeleton.sides[mirrored] == opposite[skeleton.sides[joint]]
        parent = skeleton.parents[joint]
        assert skeleton.parents[mirrored] == (mirror[parent] if parent >= 0 else -1)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left_foot", "right_foot"), ("LHip", "RHip"), ("LeftArm", "RightArm"),
        ("mixamorig:LeftArm", "mixamorig:RightArm"), ("Hand_L", "Hand_R"), ("thigh_l", "thigh_r"),
        ("CC_Base_L_Thigh", "CC_Base_R_Thigh"), ("lfemur", "rfemur"), ("WristL", "WristR"),
        ("l_knee", "r_knee"),
    ],
)  # fmt: skip
def test_sides_are_read_from_names_as_rigs_write_them(left, right):
    joints = ("lowerback", right, left, "RL_BoneRoot", "Lower", "L5")
    skeleton = Skeleton(name="x", joints=joints, parents=(-1, 0, 0, 0, 0, 0))
    assert skeleton.mirror == (0, 2, 1, 3, 4, 5)
    assert skeleton.sides == ("center", "right", "left", "center", "center", "center")


def test_index_names_the_joints_there_are():
    assert BODY21.index("left_toes") == 16
    with pytest.raises(SkeletonError, match="no joint 'nose'; it has: hips"):
        BODY21.index("nose")


def test_children_are_the_inverse_of_parents():
    assert BODY21.children[0] == (1, 13, 17)
    assert BODY21.children[4] == ()


def test_h36m_has_the_right_leg_first():
    assert H36M17.joints[:7] == ("Hip", "RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle")
    assert H36M17.parents == (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 9, 8, 11, 12, 8, 14, 15)


@pytest.mark.parametrize("source", SKELETONS.values(), ids=lambda s: s.name)
@pytest.mark.parametrize("target", SKELETONS.values(), ids=lambda s: s.name)
def test_maps_keep_translations_and_exchange_sides_with_the_skeletons(source, target):
    weights, known = joint_map(source, target)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    mirrored = weights[list(target.mirror)][:, list(source.mirror)]
    np.testing.assert_allclose(weights, mirrored, atol=1e-12)
    assert known.any()
    assert not weights.flags.writeable


def test_the_map_of_a_skeleton_to_itself_is_the_identity():
    weights, known = joint_map(SMPL22, SMPL22)
    np.testing.assert_array_equal(weights, np.eye(22))
    assert known.all()


@pytest.mark.parametrize("other", [SMPL22, H36M17], ids=lambda s: s.name)
def test_limbs_survive_the_way_to_another_skeleton_and_back(other):
    there, _ = joint_map(BODY21, other)
    back, _ = joint_map(other, BODY21)
    pose = body()
    returned = back @ there @ pose
    kept = [j for j in LIMBS if "shoulder" not in j or other is SMPL22]
    indices = [BODY21.index(joint) for joint in kept]
    np.testing.assert_allclose(returned[indices], pose[indices], atol=1e-12)


def test_toes_of_h36m_are_unknown_and_sit_on_the_ankle():
    weights, known = joint_map(H36M17, BODY21)
    unknown = [j for j, k in zip(BODY21.joints, known, strict=True) if not k]
    assert unknown == ["left_toes", "right_toes"]
    np.testing.assert_array_equal(weights[16], weights[15])
    _, known = joint_map(H36M17, SMPL22)
    assert [SMPL22.joints[i] for i in np.flatnonzero(~known)] == ["left_foot", "right_foot"]


@pytest.mark.parametrize("prefix", ["", "mixamorig:", "mixamorig1:"])
def test_mixamo_names_are_recognised(prefix):
    skeleton = skeleton_from_names([prefix + joint for joint in MIXAMO])
    found = resolve_joints(skeleton)
    assert set(found) == set(BODY21.joints)
    assert found["chest"] == prefix + "Spine2"
    assert found["left_shoulder"] == prefix + "LeftShoulder"
    assert found["left_upper_arm"] == prefix + "LeftArm"
    assert found["right_foot"] == prefix + "RightFoot"
    assert joint_map(skeleton, BODY21)[1].all()


def test_bandai_and_asf_names_are_recognised():
    assert set(resolve_joints(skeleton_from_names(BANDAI))) == set(BODY21.joints)
    found = resolve_joints(skeleton_from_names(ASF))
    assert set(found) == set(BODY21.joints) - {"hips"}
    assert found["spine"] == "lowerback"
    assert found["left_hand"] == "lhand"
    assert joint_map(skeleton_from_names(ASF), BODY21)[1].all()


def test_body21_names_in_any_order_give_a_permutation():
    joints = list(reversed(BODY21.joints))
    weights, known = joint_map(skeleton_from_names(joints), BODY21)
    np.testing.assert_array_equal(weights, np.eye(21)[::-1])
    assert known.all()


def test_a_map_of_own_names_wins_over_recognition():
    names = {joint: f"joint{i}" for i, joint in enumerate(BODY21.joints)}
    skeleton = skeleton_from_names(
        list(names.values()), {own: body21 for body21, own in names.items()}
    )
    np.testing.assert_array_equal(joint_map(skeleton, BODY21)[0], np.eye(21))
    np.testing.assert_array_equal(joint_map(BODY21, skeleton)[0], np.eye(21))


def test_the_required_joints_are_enough_and_the_rest_is_estimated():
    skeleton = skeleton_from_names(list(REQUIRED))
    weights, known = joint_map(skeleton, BODY21)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    guessed = {j for j, k in zip(BODY21.joints, known, strict=True) if not k}
    ends = {f"{s}_{p}" for s in ("left", "right") for p in ("lower_arm", "hand", "toes")}
    assert guessed == {"head"} | ends
    t_pose = np.zeros((len(REQUIRED), 3))
    for i, joint in enumerate(REQUIRED):
        height = {"upper_leg": 0.9, "lower_leg": 0.5, "foot": 0.1, "upper_arm": 1.4}
        t_pose[i] = 0, 0.2 if "left" in joint else -0.2, height[joint.partition("_")[2]]
    heights = (weights @ t_pose)[:5, 2]
    assert (np.diff(heights) > 0.05).all()  # hips, spine, chest, neck, head
    assert 0.91 < heights[0] < 0.93


def test_extra_joints_of_a_target_are_unknown_and_sit_on_a_joint_above():
    joints = (*BODY21.joints, "left_thumb")
    target = Skeleton(name="x", joints=joints, parents=(*BODY21.parents, 8))
    weights, known = joint_map(BODY21, target)
    assert list(np.flatnonzero(~known)) == [21]
    np.testing.assert_array_equal(weights[21], weights[8])


@given(st.sets(st.sampled_from([j for j in REQUIRED if "arm" not in j]), min_size=1))
def test_missing_required_joints_are_all_named(missing):
    with pytest.raises(SkeletonError) as error:
        skeleton_from_names([joint for joint in BODY21.joints if joint not in missing])
    for joint in REQUIRED:
        assert (joint in missing) == bool(re.search(rf"\b{joint}\b", str(error.value)))


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"nose": "head"}, "no such joint"),
        ({"hips": "belly"}, "must be one of: hips"),
        ({"hips": "hips", "spine": "hips"}, "two joints for one"),
        ({"hips": "hips"}, "found nothing for left_upper_leg"),
    ],
)
def test_a_wrong_map_is_refused(mapping, message):
    with pytest.raises(SkeletonError, match=message):
        skeleton_from_names(list(BODY21.joints), mapping)
