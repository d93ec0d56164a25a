"""Skeletons that go by a name, as data: joints as their sources order them, and their usual axes.

Orders were compared with the enumerations of mediapipe 1.2.2, pykinect-azure 0.0.4, pykinect2 0.1.0
and mmpose 1.3.2 (COCO), with OpenPose's own list of BODY_25, and with an ASF file of CMU's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from models.motion.axes import Axes

Row = tuple[str, int]
"""A joint, and the index of its parent in the same table."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Standard:
    """Joints in the order in which they are sent; a parent may come after its child."""

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    axes: Axes


def _standard(rows: Sequence[Row], axes: Axes | None = None) -> Standard:
    joints, parents = zip(*rows, strict=True)
    return Standard(joints=joints, parents=parents, axes=axes or Axes())


def _sides(
    chains: Sequence[Sequence[tuple[str, int | str]]], sides: Sequence[str], start: int
) -> list[Row]:
    """Rows of chains, first of one side and then of the other.

    In a name, {} is the side. A parent is an index, or "-1" for the row before, "-2" for the one
    before that.
    """
    rows: list[Row] = []
    for side in sides:
        for chain in chains:
            for name, parent in chain:
                above = start + len(rows) + int(parent) if isinstance(parent, str) else parent
                rows.append((name.format(side), above))
    return rows


# fmt: off
_BODY21 = [
    ("hips", -1), ("spine", 0), ("chest", 1), ("neck", 2), ("head", 3),
    ("left_shoulder", 2), ("left_upper_arm", 5), ("left_lower_arm", 6), ("left_hand", 7),
    ("right_shoulder", 2), ("right_upper_arm", 9), ("right_lower_arm", 10), ("right_hand", 11),
    ("left_upper_leg", 0), ("left_lower_leg", 13), ("left_foot", 14), ("left_toes", 15),
    ("right_upper_leg", 0), ("right_lower_leg", 17), ("right_foot", 18), ("right_toes", 19),
]
_SMPL22 = [
    ("pelvis", -1), ("left_hip", 0), ("right_hip", 0), ("spine1", 0),
    ("left_knee", 1), ("right_knee", 2), ("spine2", 3), ("left_ankle", 4), ("right_ankle", 5),
    ("spine3", 6), ("left_foot", 7), ("right_foot", 8), ("neck", 9),
    ("left_collar", 9), ("right_collar", 9), ("head", 12),
    ("left_shoulder", 13), ("right_shoulder", 14), ("left_elbow", 16), ("right_elbow", 17),
    ("left_wrist", 18), ("right_wrist", 19),
]
_H36M17 = [
    ("Hip", -1), ("RHip", 0), ("RKnee", 1), ("RAnkle", 2), ("LHip", 0), ("LKnee", 4),
    ("LAnkle", 5), ("Spine", 0), ("Thorax", 7), ("Neck", 8), ("Head", 9),
    ("LShoulder", 8), ("LElbow", 11), ("LWrist", 12), ("RShoulder", 8), ("RElbow", 14),
    ("RWrist", 15),
]
_COCO17 = [  # it has no trunk: lines go from the nose to the shoulders, and on to the hips
    ("nose", -1), ("left_eye", 0), ("right_eye", 0), ("left_ear", 1), ("right_ear", 2),
    ("left_shoulder", 0), ("right_shoulder", 0), ("left_elbow", 5), ("right_elbow", 6),
    ("left_wrist", 7), ("right_wrist", 8), ("left_hip", 5), ("right_hip", 6),
    ("left_knee", 11), ("right_knee", 12), ("left_ankle", 13), ("right_ankle", 14),
]
_MEDIAPIPE33 = [
    ("nose", -1), ("left_eye_inner", 0), ("left_eye", 1), ("left_eye_outer", 2),
    ("right_eye_inner", 0), ("right_eye", 4), ("right_eye_outer", 5), ("left_ear", 3),
    ("right_ear", 6), ("mouth_left", 0), ("mouth_right", 0),
    ("left_shoulder", 0), ("right_shoulder", 0), ("left_elbow", 11), ("right_elbow", 12),
    ("left_wrist", 13), ("right_wrist", 14), ("left_pinky", 15), ("right_pinky", 16),
    ("left_index", 15), ("right_index", 16), ("left_thumb", 15), ("right_thumb", 16),
    ("left_hip", 11), ("right_hip", 12), ("left_knee", 23), ("right_knee", 24),
    ("left_ankle", 25), ("right_ankle", 26), ("left_heel", 27), ("right_heel", 28),
    ("left_foot_index", 27), ("right_foot_index", 28),
]
_BODY25 = [
    ("Nose", 1), ("Neck", 8), ("RShoulder", 1), ("RElbow", 2), ("RWrist", 3),
    ("LShoulder", 1), ("LElbow", 5), ("LWrist", 6), ("MidHip", -1),
    ("RHip", 8), ("RKnee", 9), ("RAnkle", 10), ("LHip", 8), ("LKnee", 12), ("LAnkle", 13),
    ("REye", 0), ("LEye", 0), ("REar", 15), ("LEar", 16),
    ("LBigToe", 14), ("LSmallToe", 14), ("LHeel", 14), ("RBigToe", 11), ("RSmallToe", 11),
    ("RHeel", 11),
]
_KINECT25 = [
    ("SpineBase", -1), ("SpineMid", 0), ("Neck", 20), ("Head", 2),
    ("ShoulderLeft", 20), ("ElbowLeft", 4), ("WristLeft", 5), ("HandLeft", 6),
    ("ShoulderRight", 20), ("ElbowRight", 8), ("WristRight", 9), ("HandRight", 10),
    ("HipLeft", 0), ("KneeLeft", 12), ("AnkleLeft", 13), ("FootLeft", 14),
    ("HipRight", 0), ("KneeRight", 16), ("AnkleRight", 17), ("FootRight", 18),
    ("SpineShoulder", 1), ("HandTipLeft", 7), ("ThumbLeft", 7), ("HandTipRight", 11),
    ("ThumbRight", 11),
]
_AZURE32 = [
    ("pelvis", -1), ("spine_navel", 0), ("spine_chest", 1), ("neck", 2),
    ("clavicle_left", 2), ("shoulder_left", 4), ("elbow_left", 5), ("wrist_left", 6),
    ("hand_left", 7), ("handtip_left", 8), ("thumb_left", 7),
    ("clavicle_right", 2), ("shoulder_right", 11), ("elbow_right", 12), ("wrist_right", 13),
    ("hand_right", 14), ("handtip_right", 15), ("thumb_right", 14),
    ("hip_left", 0), ("knee_left", 18), ("ankle_left", 19), ("foot_left", 20),
    ("hip_right", 0), ("knee_right", 22), ("ankle_right", 23), ("foot_right", 24),
    ("head", 3), ("nose", 26), ("eye_left", 26), ("ear_left", 26), ("eye_right", 26),
    ("ear_right", 26),
]
_ANIMATED = [
    ("Hips", -1), ("Spine", 0), ("Spine1", 1), ("Spine2", 2), ("Neck", 3), ("Head", 4),
    *_sides([[("{}Shoulder", 3), ("{}Arm", "-1"), ("{}ForeArm", "-1"), ("{}Hand", "-1")],
             [("{}UpLeg", 0), ("{}Leg", "-1"), ("{}Foot", "-1"), ("{}ToeBase", "-1")]],
            ("Left", "Right"), 6),
]
_VRM = [
    ("hips", -1), ("spine", 0), ("chest", 1), ("upperChest", 2), ("neck", 3), ("head", 4),
    *_sides([[("{}Shoulder", 3), ("{}UpperArm", "-1"), ("{}LowerArm", "-1"), ("{}Hand", "-1")],
             [("{}UpperLeg", 0), ("{}LowerLeg", "-1"), ("{}Foot", "-1"), ("{}Toes", "-1")]],
            ("left", "right"), 6),
]
_CMU = [
    ("root", -1),
    *_sides([[("{}hipjoint", 0), ("{}femur", "-1"), ("{}tibia", "-1"), ("{}foot", "-1"),
              ("{}toes", "-1")]], ("l", "r"), 1),
    ("lowerback", 0), ("upperback", 11), ("thorax", 12), ("lowerneck", 13), ("upperneck", 14),
    ("head", 15),
    *_sides([[("{}clavicle", 13), ("{}humerus", "-1"), ("{}radius", "-1"), ("{}wrist", "-1"),
              ("{}hand", "-1"), ("{}fingers", "-1"), ("{}thumb", "-3")]], ("l", "r"), 17),
]
# fmt: on

_Y_UP_CM = Axes(up="y", units="cm")

STANDARDS: dict[str, Standard] = {
    "body21": _standard(_BODY21),
    "smpl22": _standard(_SMPL22),
    "smpl24": _standard([*_SMPL22, ("left_hand", 20), ("right_hand", 21)]),
    "h36m17": _standard(_H36M17),
    "coco17": _standard(_COCO17),
    "mediapipe33": _standard(_MEDIAPIPE33, Axes(up="-y")),
    "body25": _standard(_BODY25, Axes(up="-y")),
    "kinect25": _standard(_KINECT25, Axes(up="y")),
    "azure32": _standard(_AZURE32, Axes(up="-y", units="mm")),
    "mixamo": _standard([(f"mixamorig:{joint}", parent) for joint, parent in _ANIMATED], _Y_UP_CM),
    "humanik": _standard(_ANIMATED, _Y_UP_CM),
    "vrm": _standard(_VRM, Axes(up="y")),
    "cmu": _standard(_CMU, Axes(up="y")),
}
