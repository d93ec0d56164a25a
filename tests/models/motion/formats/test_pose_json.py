import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_bundles import walking

from models.motion.axes import Axes
from models.motion.formats.errors import (
    EmptyMotionError,
    FormatError,
    InvalidNumberError,
    MalformedFileError,
    UnsupportedFileError,
)
from models.motion.formats.files import read_motion, write_motion
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, SENT_ORDERS, SKELETONS, joint_map
from models.motion.standards import STANDARDS

WALK = walking(12)


def read(folder: Path, content: Any) -> Motion:
    path = folder / "x.json"
    path.write_text(json.dumps(content))
    return read_motion(path)


def in_skeleton(name: str) -> np.ndarray:
    """The walk in a standard skeleton as its source sends it: its order, axes and units."""
    weights, _ = joint_map(BODY21, SKELETONS[name])
    sent = np.empty((len(WALK), len(weights), 3))
    sent[:, list(SENT_ORDERS[name])] = np.einsum("ij,tjk->tik", weights, WALK)
    return STANDARDS[name].axes.from_metres(sent)


def assert_same(motion: Motion, name: str, atol: float = 1e-6) -> None:
    weights, _ = joint_map(BODY21, SKELETONS[name])
    assert motion.skeleton.joints == SKELETONS[name].joints
    expected = np.einsum("ij,tjk->tik", weights, WALK)
    np.testing.assert_allclose(motion.positions, expected, atol=atol)


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_request_of_a_standard_skeleton_is_a_file(tmp_path: Path, name: str):
    content = {"poses": in_skeleton(name).tolist(), "skeleton": name, "fps": 25}
    motion = read(tmp_path, content)
    assert motion.fps == 25.0
    assert_same(motion, name)


def test_request_of_own_joints_in_any_order_is_a_file(tmp_path: Path):
    order = np.random.default_rng(0).permutation(21)
    own = {"joints": [f"j_{BODY21.joints[i]}" for i in order]}
    own_map = {f"j_{joint}": joint for joint in BODY21.joints}
    axes = Axes(up="y", units="cm")
    content = {
        "poses": axes.from_metres(WALK[:, order]).tolist(),
        "skeleton": own | {"map": own_map},
        "axes": {"up": "y", "units": "cm"},
        "timestamps": [10.0 + i / 40 for i in range(12)],
    }
    motion = read(tmp_path, content)
    assert motion.fps == pytest.approx(40.0)
    found = [motion.skeleton.index(f"j_{joint}") for joint in BODY21.joints]
    np.testing.assert_allclose(motion.positions[:, found], WALK, atol=1e-6)
    assert motion.to(BODY21).positions.shape == (12, 21, 3)


def test_what_is_written_is_read_again_with_what_was_not_seen(tmp_path: Path):
    poses = WALK.copy()
    poses[3, 8] = np.nan
    motion = Motion(name="x", skeleton=BODY21, positions=poses, fps=29.97)
    for suffix in ("json", "npz"):
        write_motion(tmp_path / f"x.{suffix}", motion)
        back = read_motion(tmp_path / f"x.{suffix}")
        np.testing.assert_allclose(back.positions, poses, atol=1e-4)
        assert (back.fps, back.skeleton.parents) == (29.97, BODY21.parents)
    text = json.loads((tmp_path / "x.json").read_text())
    assert text["poses"][3][8] is None


def test_gaps_are_closed_in_files_that_have_none(tmp_path: Path):
    poses = WALK.copy()
    poses[3, 8] = poses[:, 16] = np.nan
    write_motion(tmp_path / "x.bvh", Motion(name="x", skeleton=BODY21, positions=poses, fps=30.0))
    back = read_motion(tmp_path / "x.bvh")
    assert set(back.skeleton.joints) >= set(BODY21.joints) - {"left_toes"}
    hand = back.positions[3, back.skeleton.index("left_hand")]
    assert np.linalg.norm(hand - WALK[3, 8]) < 0.01


def mediapipe(frame: np.ndarray, visibility: float = 0.9) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": z, "visibility": visibility} for x, y, z in frame.tolist()]


@pytest.mark.parametrize(
    "frames",
    [
        lambda poses: [
            {"worldLandmarks": [mediapipe(pose)], "timestampMs": 40.0 * i}
            for i, pose in enumerate(poses)
        ],
        lambda poses: {
            "frames": [
                {"pose_world_landmarks": mediapipe(pose), "timestamp": 7 + 0.04 * i}
                for i, pose in enumerate(poses)
            ]
        },
    ],
    ids=["tasks", "solutions"],
)
def test_landmarks_of_mediapipe_are_read(tmp_path: Path, frames: Any):
    motion = read(tmp_path, frames(in_skeleton("mediapipe33")))
    assert motion.fps == 25.0
    assert_same(motion, "mediapipe33")


def test_landmarks_that_are_hardly_visible_were_not_seen(tmp_path: Path):
    frames = [{"worldLandmarks": [mediapipe(pose)]} for pose in in_skeleton("mediapipe33")]
    frames[4]["worldLandmarks"][0][15]["visibility"] = 0.1
    frames[6] = {"worldLandmarks": []}
    motion = read(tmp_path, frames)
    missing = np.isnan(motion.positions[..., 0])
    assert missing[4].nonzero()[0].tolist() == [15]
    assert missing[6].all()
    assert missing.sum() == 34


def openpose(frame: np.ndarray) -> dict[str, Any]:
    values = np.concatenate([frame, np.ones((25, 1))], axis=1).ravel().tolist()
    return {"version": 1.3, "people": [{"pose_keypoints_2d": [], "pose_keypoints_3d": values}]}


def test_keypoints_of_openpose_are_read_from_one_file_or_from_a_folder(tmp_path: Path):
    frames = [openpose(pose) for pose in in_skeleton("body25")]
    frames[2]["people"][0]["pose_keypoints_3d"][4 * 7 : 4 * 8] = [0.0] * 4
    (tmp_path / "frames").mkdir()
    for i, frame in enumerate(frames):
        (tmp_path / f"frames/x_{i:04d}_keypoints.json").write_text(json.dumps(frame))
    for motion in (read(tmp_path, frames), read_motion(tmp_path / "frames")):
        missing = np.argwhere(np.isnan(motion.positions[..., 0])).tolist()
        assert missing == [[2, motion.skeleton.index("LWrist")]]
        whole = np.delete(np.arange(12), 2)
        weights, _ = joint_map(BODY21, SKELETONS["body25"])
        expected = np.einsum("ij,tjk->tik", weights, WALK)[whole]
        np.testing.assert_allclose(motion.positions[whole], expected, atol=1e-6)


POSES = WALK.tolist()


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ({}, UnsupportedFileError, 'must hold "poses"'),
        ([1, 2], UnsupportedFileError, "a list"),
        ({"poses": []}, EmptyMotionError, "no frames"),
        ({"poses": [[1, 2, 3]]}, MalformedFileError, r"\[frames\]\[joints\]"),
        ({"poses": "x"}, MalformedFileError, r"\[frames\]\[joints\]"),
        ({"poses": POSES, "skeleton": "smpl22"}, MalformedFileError, "21 joints; it has 22"),
        ({"poses": POSES, "skeleton": "octopus"}, MalformedFileError, "skeleton"),
        ({"poses": POSES, "skeleton": {"joints": ["a"] * 21}}, MalformedFileError, "skeleton"),
        ({"poses": POSES, "axes": {"up": "w"}}, MalformedFileError, "axes"),
        ({"poses": POSES, "axes": {"down": "z"}}, MalformedFileError, "axes"),
        ({"poses": POSES, "fps": 0}, InvalidNumberError, "0.0 frames a second"),
        ({"poses": POSES, "fps": "x"}, MalformedFileError, "numbers"),
        ({"poses": POSES, "timestamps": [0.0] * 12}, InvalidNumberError, "times must rise"),
        ({"people": []}, EmptyMotionError, "nobody in 3D"),
        ({"people": [{"pose_keypoints_3d": [1.0] * 99}]}, MalformedFileError, "frame 0"),
        ([{"worldLandmarks": [[{"x": 1}]]}], MalformedFileError, "1 joints, not 33"),
    ],
)
def test_what_is_no_motion_is_refused(tmp_path: Path, content: Any, error: Any, message: str):
    with pytest.raises(error, match=message):
        read(tmp_path, content)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda children: (
        st.lists(children, max_size=3)
        | st.dictionaries(
            st.sampled_from(["poses", "people", "worldLandmarks", "frames", "x", "skeleton",
                             "axes", "fps", "timestamps", "joints", "pose_keypoints_3d"]),
            children, max_size=3,
        )
    ),
    max_leaves=15,
)  # fmt: skip


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=JSON, inside=st.sampled_from(["skeleton", "axes", "fps", "timestamps", None]))
def test_any_json_is_read_or_refused(tmp_path: Path, content: Any, inside: str | None):
    whole = content if inside is None else {"poses": POSES, inside: content}
    with contextlib.suppress(FormatError):
        assert not np.isinf(read(tmp_path, whole).positions).any()


def amass(**changes: Any) -> dict[str, Any]:
    num_frames = 10
    poses = np.zeros((num_frames, 156))
    poses[:, 0] = np.pi / 2  # the body is Y-up; this puts it upright in the world of AMASS
    trans = np.linspace([0, 0, 0.95], [0.4, 0.3, 0.95], num_frames)
    arrays: dict[str, Any] = {
        "poses": poses, "trans": trans, "betas": np.zeros(16), "gender": np.array("female"),
        "mocap_framerate": np.float64(120.0), "dmpls": np.zeros((num_frames, 8)),
    }  # fmt: skip
    return {key: value for key, value in (arrays | changes).items() if value is not None}


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate"])
def test_amass_is_read_on_the_template_in_its_own_world(tmp_path: Path, key: str):
    np.savez(tmp_path / "x.npz", **amass(**{"mocap_framerate": None, key: np.float64(120.0)}))
    motion = read_motion(tmp_path / "x.npz")
    assert motion.fps == 120.0
    np.testing.assert_allclose(
        motion.positions[:, 0], np.linspace([0, 0, 0.95], [0.4, 0.3, 0.95], 10), atol=1e-9
    )
    joint = {name: motion.positions[0, i] for i, name in enumerate(motion.skeleton.joints)}
    assert joint["head"][2] > 1.5
    assert joint["left_foot"][2] < 0.1
    # Turned upright about +X, what was forward, +Z, is -Y; so the left side is at +X.
    assert joint["left_hip"][0] > joint["right_hip"][0]
    assert joint["left_foot"][1] < joint["left_ankle"][1]


def test_amass_with_another_axis_up_is_put_upright(tmp_path: Path):
    poses = np.zeros((10, 156))
    np.savez(tmp_path / "x.npz", **amass(poses=poses, trans=np.tile([0, 0.95, 0], (10, 1))))
    motion = read_motion(tmp_path / "x.npz")
    heights = dict(zip(motion.skeleton.joints, motion.positions[0, :, 2], strict=True))
    assert heights["head"] > 1.5
    assert heights["left_foot"] < 0.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mocap_framerate": None}, "none of mocap_framerate, mocap_frame_rate"),
        ({"poses": np.zeros((10, 60))}, r"poses \(10, 60\)"),
        ({"trans": np.zeros((9, 3))}, r"trans \(9, 3\)"),
        ({"trans": np.full((10, 3), np.nan)}, "not finite"),
        ({"trans": None}, "the arrays betas"),
        ({"trans": None, "poses": None, "positions": np.zeros((3, 2, 3)), "joints": ["a"],
          "fps": 3.0}, "1 joints"),
    ],
)  # fmt: skip
def test_npz_that_is_no_motion_is_refused(tmp_path: Path, changes: Any, message: str):
    np.savez(tmp_path / "x.npz", **amass(**changes))
    with pytest.raises(FormatError, match=message):
        read_motion(tmp_path / "x.npz")
