import io
from pathlib import Path

import numpy as np
import pybvh
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models.motion import rotations as rot
from models.motion.formats.bvh import read_bvh, write_bvh
from models.motion.formats.errors import (
    ChannelCountError,
    EmptyMotionError,
    FormatError,
    InvalidNumberError,
    MalformedFileError,
    TruncatedFileError,
    UnsupportedFileError,
)
from models.motion.kinematics import bone_lengths, fit_bone_lengths, forward_kinematics
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, SMPL22, Skeleton

TREE = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -40 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT Left Foot
      {
        OFFSET 0 -42 0
        CHANNELS 1 Xrotation
        End Site
        {
          OFFSET 0 0 15
        }
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 90 0  0 0 0  0 0 0  0 0 0  0
100 90 200  0 0 90  0 -90 0  0 0 0  0
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "walk.bvh"
    path.write_text(text, encoding="utf-8", newline="")
    return path


def replaced(old: str, new: str) -> str:
    assert old in TREE
    return TREE.replace(old, new, 1)


def test_positions_are_metres_with_z_up_and_a_person_faces_x(tmp_path):
    motion = read_bvh(write(tmp_path, TREE))
    assert motion.skeleton.joints == ("Hips", "LeftUpLeg", "LeftLeg", "Left Foot")
    assert motion.skeleton.parents == (-1, 0, 1, 2)
    assert motion.fps == 30.0
    standing = [[0, 0, 0.9], [0, 0.1, 0.9], [0, 0.1, 0.5], [0, 0.1, 0.08]]
    np.testing.assert_allclose(motion.positions[0], standing, atol=1e-12)
    # a turn to the left by 90 degrees, then the thigh raised: now it points to the left
    np.testing.assert_allclose(motion.positions[1, 1], [1.9, 1, 0.9], atol=1e-12)
    np.testing.assert_allclose(motion.positions[1, 2], [1.9, 1.4, 0.9], atol=1e-12)


def test_rotations_and_rest_offsets_give_the_positions(tmp_path):
    motion = read_bvh(write(tmp_path, TREE))
    assert motion.rotations is not None
    assert motion.rest_offsets is not None
    positions = forward_kinematics(
        motion.rotations, motion.rest_offsets, motion.skeleton.parents, motion.positions[:, 0]
    )
    np.testing.assert_allclose(positions, motion.positions, atol=1e-12)


@pytest.mark.parametrize("factor", [1.0, 0.01, 10.0, 1 / 2.54, 0.45 / 2.54])
def test_the_unit_is_guessed_from_the_legs(tmp_path, factor):
    numbers = {"10 0 0": (10, 0, 0), "0 -40 0": (0, -40, 0), "0 -42 0": (0, -42, 0)}
    text = TREE
    for old, new in numbers.items():
        text = text.replace(old, " ".join(repr(factor * x) for x in new))
    motion = read_bvh(write(tmp_path, text))
    np.testing.assert_allclose(
        bone_lengths(motion.positions, motion.skeleton.parents)[0], [0, 0.1, 0.4, 0.42], rtol=1e-9
    )


def test_the_unit_can_be_given(tmp_path):
    motion = read_bvh(write(tmp_path, TREE), scale=1.0)
    assert motion.positions[0, 0, 2] == 90.0


def test_a_roots_position_adds_to_its_offset_where_that_brings_the_feet_to_the_floor(tmp_path):
    relative = replaced("OFFSET 0 0 0", "OFFSET 0 90 0").replace(" 90 0  0", " 0 0  0", 1)
    relative = relative.replace("100 90 200", "100 0 200")
    expected = read_bvh(write(tmp_path, TREE)).positions
    np.testing.assert_allclose(read_bvh(write(tmp_path, relative)).positions, expected)
    absolute = replaced("OFFSET 0 0 0", "OFFSET 5 90 3")
    np.testing.assert_allclose(read_bvh(write(tmp_path, absolute)).positions, expected)


def test_position_channels_of_other_joints_replace_their_offset(tmp_path):
    text = replaced("CHANNELS 1 Xrotation", "CHANNELS 2 Yposition Xrotation")
    text = text.replace("0 0 0  0\n", "0 0 0  -30 0\n")
    motion = read_bvh(write(tmp_path, text))
    np.testing.assert_allclose(motion.positions[0, 3], [0, 0.1, 0.2], atol=1e-12)


def test_line_ends_case_and_blank_lines_do_not_matter(tmp_path):
    expected = read_bvh(write(tmp_path, TREE)).positions
    for text in (
        TREE.replace("\n", "\r\n"),
        TREE.replace("\n", "\n\n"),
        TREE.replace("rotation", "ROTATION").replace("JOINT", "joint"),
        TREE.replace("\n{", " {"),
    ):
        np.testing.assert_array_equal(read_bvh(write(tmp_path, text)).positions, expected)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("", TruncatedFileError, r"walk\.bvh:0: found the end of the file; MOTION must"),
        (TREE[:200], TruncatedFileError, "MOTION must follow"),
        (TREE[: TREE.index("Frames")], TruncatedFileError, r":26: found .*'Frames:' must follow"),
        (TREE[: TREE.index("Frame Time")], TruncatedFileError, "'Frame Time:' must follow"),
        (TREE[:-20], TruncatedFileError, r":30: found \d+ values; every frame must have 13"),
        (TREE[: TREE.index("100 90")], TruncatedFileError, "found 1 frames; there must be 2"),
        (TREE + "1 2 3\n", ChannelCountError, "found 3 frames; there must be 2"),
        (replaced("0 90 0  ", "0 90 "), ChannelCountError, r":29: found 12 values"),
        (replaced("0 90 0  ", "0 x 0  "), InvalidNumberError, r":29: found 'x'; every value"),
        (replaced("0 90 0  ", "0 nan 0  "), InvalidNumberError, r":29: found 'nan'"),
        (replaced("0 90 0  ", "0 1e300 0  "), InvalidNumberError, r":29: found '1e300'"),
        (replaced("-40", "inf"), InvalidNumberError, r":12: found 'inf'"),
        (replaced("OFFSET 10 0 0", "OFFSET 10 0"), MalformedFileError, r":8: .*x, y and z"),
        (replaced("CHANNELS 3", "CHANNELS 4"), MalformedFileError, r":9: .*CHANNELS takes"),
        (replaced("Zrotation", "Wrotation"), MalformedFileError, r":5: .*CHANNELS takes"),
        (replaced("Zrotation", "Xrotation"), MalformedFileError, "each once"),
        (replaced("HIERARCHY\n", ""), MalformedFileError, r":1: found 'ROOT'; .*HIERARCHY"),
        (replaced("JOINT LeftLeg", "JOINT Hips"), MalformedFileError, "second joint 'Hips'"),
        (replaced("    OFFSET 10 0 0\n", ""), MalformedFileError, "'LeftUpLeg' before its OFFSET"),
        (replaced("{\n", ""), MalformedFileError, r":3: found 'OFFSET'; the order"),
        (replaced("}\nMOTION", "MOTION"), MalformedFileError, "closed tree"),
        (replaced("}\nMOTION", "}\n}\nMOTION"), MalformedFileError, "a } without {"),
        (replaced("}\nMOTION", "}\nROOT b\nMOTION"), UnsupportedFileError, "one person"),
        (replaced("Frame Time", "Time"), MalformedFileError, "'Frame Time:' must come here"),
        (replaced("0.0333333", "0"), EmptyMotionError, r":28: .*positive"),
        (replaced("Frames: 2", "Frames: 0"), EmptyMotionError, r":27: .*positive"),
        (replaced("Frames: 2", "Frames: -2"), MalformedFileError, "positive"),
        (replaced("Frames: 2", "Frames: 2 3"), MalformedFileError, "one number"),
    ],
)
def test_a_damaged_file_is_refused_with_the_place(tmp_path, text, error, message):
    with pytest.raises(error, match=message):
        read_bvh(write(tmp_path, text))


@settings(max_examples=300,
          suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(st.data())
def test_garbage_is_read_or_refused_but_never_breaks_the_reader(tmp_path, data):
    content = bytearray(TREE.encode())
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "fuzz.bvh"
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    try:
        positions = read_bvh(path).positions
    except FormatError as error:
        positions, message = np.zeros(3), str(error)
    else:
        message = "fuzz.bvh:"
    assert message.startswith("fuzz.bvh:")
    assert np.isfinite(positions).all()


def read_back(folder: Path, motion: Motion) -> tuple[Motion, str, np.ndarray]:
    path = folder / "out.bvh"
    write_bvh(path, motion)
    back = read_bvh(path, scale=0.01)
    order = [back.skeleton.index(joint) for joint in motion.skeleton.joints]
    return back, path.read_text(), back.positions[:, order]


def rigid(num_frames: int = 20) -> Motion:
    rng = np.random.default_rng(0)
    path = rng.normal(size=(num_frames, 21, 3)).cumsum(axis=0) * 0.1
    rest = rng.normal(size=(21, 3)) * 0.2
    rest[0] = 0.0
    for joint, z in {"left_lower_leg": -0.4, "left_foot": -0.42}.items():
        rest[BODY21.index(joint)] = 0.0, 0.0, z
    rotations = rot.continuous_sign(rot.from_axis_angles(path, "XYZ"))
    root = rng.normal(size=(num_frames, 3))
    positions = forward_kinematics(rotations, rest, BODY21.parents, root)
    return Motion(
        name="rigid", skeleton=BODY21, positions=positions, fps=30.0,
        rotations=rotations, rest_offsets=rest,
    )  # fmt: skip


def test_a_rigid_motion_comes_back_with_rotations_alone(tmp_path):
    motion = rigid()
    back, text, positions = read_back(tmp_path, motion)
    np.testing.assert_allclose(positions, motion.positions, atol=1e-6)
    assert text.count("CHANNELS 6") == 1
    assert back.fps == 30.0
    assert back.rotations is not None
    np.testing.assert_allclose(
        rot.to_matrix(back.rotations), rot.to_matrix(motion.rotations), atol=1e-6
    )
    np.testing.assert_allclose(back.rest_offsets, motion.rest_offsets, atol=1e-7)


def test_a_rigid_motion_without_rotations_gets_them_from_its_positions(tmp_path):
    motion = rigid()
    bare = Motion(name="bare", skeleton=BODY21, positions=motion.positions, fps=30.0)
    _, text, positions = read_back(tmp_path, bare)
    np.testing.assert_allclose(positions, motion.positions, atol=5e-6)
    assert text.count("CHANNELS 6") == 1


def soft(skeleton: Skeleton) -> np.ndarray:
    rng = np.random.default_rng(1)
    still = rng.normal(size=(1, skeleton.num_joints, 3))
    return still + 0.02 * rng.normal(size=(15, skeleton.num_joints, 3))


def with_bones(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    lengths = np.full(skeleton.num_joints, 0.3)
    return fit_bone_lengths(positions, lengths, skeleton.parents)


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22], ids=lambda s: s.name)
def test_bones_that_stretch_get_position_channels_without_offset(tmp_path, skeleton):
    motion = Motion(name="soft", skeleton=skeleton, positions=soft(skeleton), fps=24.0)
    _, text, back = read_back(tmp_path, motion)
    assert np.linalg.norm(back - motion.positions, axis=-1).max() < 1e-4
    assert text.count("CHANNELS 6") > 1
    assert text.count("OFFSET 0.000000 0.000000 0.000000") >= text.count("CHANNELS 6")


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22], ids=lambda s: s.name)
def test_siblings_that_change_their_angles_hang_on_joints_that_turn_for_them(tmp_path, skeleton):
    path = with_bones(soft(skeleton), skeleton)
    motion = Motion(name="loose", skeleton=skeleton, positions=path, fps=24.0)
    back, text, positions = read_back(tmp_path, motion)
    assert np.linalg.norm(positions - path, axis=-1).max() < 1e-4
    assert text.count("CHANNELS 6") == 1
    turning = [joint for joint in back.skeleton.joints if "_to_" in joint]
    assert turning
    for joint in turning:
        index = back.skeleton.index(joint)
        (child,) = back.skeleton.children[index]
        assert joint.endswith(f"_to_{back.skeleton.joints[child]}")


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22], ids=lambda s: s.name)
def test_another_reader_finds_the_same_positions(tmp_path, skeleton):
    path = with_bones(soft(skeleton), skeleton)
    write_bvh(tmp_path / "x.bvh", Motion(name="x", skeleton=skeleton, positions=path, fps=24.0))
    read = pybvh.read_bvh_file(tmp_path / "x.bvh")
    assert read.fps == pytest.approx(24.0, abs=1e-4)
    found = np.asarray(read.joint_positions())[..., [2, 0, 1]] / 100.0
    order = [read.joint_names.index(joint) for joint in skeleton.joints]
    assert np.linalg.norm(found[:, order] - path, axis=-1).max() < 1e-3


def test_writing_what_was_read_is_the_identity(tmp_path):
    motion = read_bvh(write(tmp_path, TREE))
    _, text, positions = read_back(tmp_path, motion)
    np.testing.assert_allclose(positions, motion.positions, atol=1e-8)
    file = io.StringIO()
    write_bvh(file, motion)
    assert file.getvalue() == text
