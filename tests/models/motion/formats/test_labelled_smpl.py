"""The papers' files of labelled actions, made small by the tests in each of their layouts."""

import numpy as np
import pytest

from models.motion.formats.errors import (
    FormatError,
    InvalidNumberError,
    MalformedFileError,
    UnsupportedFileError,
)
from models.motion.formats.labelled_smpl import holds_labelled_smpl, read_labelled_smpl
from models.motion.skeleton import BODY21, SMPL22
from training.data.prepare import prepare
from training.data.store import open_store


def moving(num_frames, width, *, seed=0, pelvis=(np.pi / 2, 0.0, 0.0)):
    """Smooth parameters of a person who stands, here in a world with +Z up."""
    generator = np.random.default_rng(seed)
    times = np.arange(num_frames)[:, None] / 30
    rates, phases = generator.uniform(0.5, 1.5, (2, width))
    parameters = 0.4 * np.sin(2 * np.pi * rates * times + 6 * phases)
    parameters[:, :3] = pelvis
    return parameters


def written(folder, name, by_action):
    path = folder / name
    candidates = {f"{action}_0": {} for action in by_action}
    np.savez(path, data=np.array(by_action), data_cand=np.array(candidates))
    return path


LAYOUTS = {
    "grab_100_501_wact_candi_train.npz": (165, "drink", lambda poses: poses),
    "ntu_35_201_wact_candi_test.npz": (72, 6, lambda poses: poses),
    "humanact12_35_290_wact_candi_train.npz": (72, "lift_dumbbell", lambda poses: poses),
    "babel_30_300_wact_candi_test.npz": (156, "stand up", lambda poses: {"poses": poses}),
}


@pytest.mark.parametrize(("name", "layout"), LAYOUTS.items(), ids=LAYOUTS)
def test_layouts_of_the_four_collections(tmp_path, name, layout):
    width, action, as_clip = layout
    clips = [as_clip(moving(40 + i, width, seed=i)) for i in range(3)]
    path = written(tmp_path, name, {action: clips, "other": clips[:1]})
    assert holds_labelled_smpl(path)
    found = list(read_labelled_smpl(path))
    assert [label for label, _ in found] == [str(action)] * 3 + ["other"]
    assert [motion.num_frames for _, motion in found] == [40, 41, 42, 40]
    assert len({motion.name for _, motion in found}) == 4
    for _, motion in found:
        assert (motion.skeleton, motion.fps) == (SMPL22, 30.0)
        assert (motion.positions[:, SMPL22.index("neck"), 2] > 0.3).all()


def test_clip_of_several_actions_is_cut_where_they_change(tmp_path):
    poses = moving(150, 156)
    clip = {"poses": poses, "frame_split": [0, 60, 80, 150], "act": ["walk", "transition", "sit"]}
    two = {"poses": poses, "frame_split": np.array([0, 90, 150]), "act": ["walk", "sit"]}
    path = written(tmp_path, "babel_transi_30_300_train.npz", {"walk-sit": [clip, two]})
    found = list(read_labelled_smpl(path))
    assert [(label, motion.num_frames) for label, motion in found] == [
        ("walk", 60), ("sit", 70), ("walk", 90), ("sit", 60),
    ]  # fmt: skip
    assert [motion.name.rpartition("_part")[2] for _, motion in found] == ["1", "3", "1", "2"]


def test_store_has_the_labels_and_keeps_the_test_files_apart(tmp_path):
    clips = {
        "drink": [moving(90, 165, seed=1)],
        "take_pick something up": [moving(80, 165, seed=2)],
    }
    folder = tmp_path / "files"
    folder.mkdir()
    written(folder, "grab_100_501_wact_candi_train.npz", clips)
    camera = moving(90, 72, seed=3, pelvis=(np.pi, 0.0, 0.0))
    written(folder, "ntu_35_201_wact_candi_test.npz", {6: [camera]})
    prepare([folder], tmp_path / "store")
    store = open_store(tmp_path / "store")
    assert {(c.source, c.split, c.action) for c in store.clips} == {
        ("grab", "train", "drink"),
        ("grab", "train", "take_pick something up"),
        ("ntu", "test", "6"),
    }
    for clip in store.clips:
        poses = store.clip_positions(clip)
        assert -1.0 < clip.floor < -0.8
        assert (poses[:, BODY21.index("neck"), 2] > 0.3).all()


def test_rotations_come_into_a_store_of_their_own_skeleton(tmp_path):
    clips = {"drink": [moving(90, 165)]}
    path = written(tmp_path, "grab_100_501_wact_candi_train.npz", clips)
    prepare([path], tmp_path / "store", skeleton=SMPL22)
    assert (tmp_path / "store" / "rotations.npy").exists()


WRONG = {
    "no dictionary": ([1, 2], MalformedFileError, "found ndarray"),
    "no list": ({"drink": "poses"}, MalformedFileError, "drink: found str"),
    "no poses": ({"sit": [{"pose": 1}]}, MalformedFileError, r"sit, 0: found \['pose'\]"),
    "no numbers": ({"sit": [[["a"]]]}, MalformedFileError, "sit, 0: found could not convert"),
    "width": ({"sit": [np.zeros((9, 63))]}, UnsupportedFileError, r"the shape \(9, 63\)"),
    "axes": ({"sit": [np.zeros((9, 22, 3))]}, UnsupportedFileError, r"\(9, 22, 3\)"),
    "no frames": ({"sit": [np.zeros((0, 72))]}, UnsupportedFileError, r"\(0, 72\)"),
    "no clips": ({"sit": []}, MalformedFileError, "found no clips"),
    "NaN": ({"sit": [np.full((9, 72), np.nan)]}, InvalidNumberError, "sit, 0: found NaN"),
    "frame_split": (
        {"a-b": [{"poses": np.zeros((9, 156)), "frame_split": [0, 12], "act": ["a", "b"]}]},
        MalformedFileError,
        r"frame_split: found \[0, 12\] for 2 actions",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "error", "says"), WRONG.values(), ids=WRONG)
def test_wrong_contents_are_named(tmp_path, content, error, says):
    np.savez(tmp_path / "grab_train.npz", data=np.array(content, dtype=object))
    with pytest.raises(error, match=says) as raised:
        list(read_labelled_smpl(tmp_path / "grab_train.npz"))
    assert "\n" not in str(raised.value)


def test_damaged_file_is_an_error_of_the_format(tmp_path):
    path = written(tmp_path, "grab_train.npz", {"drink": [moving(90, 165)]})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    assert holds_labelled_smpl(path)
    with pytest.raises(FormatError, match=r"damage .*; get the file again"):
        list(read_labelled_smpl(path))
