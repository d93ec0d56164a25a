"""The customary files of Human3.6M and HumanEva-I, made small by the tests in their layouts."""

import numpy as np
import pytest
from tiny_bundles import walking

from models.motion.formats.errors import FormatError
from models.motion.formats.positions_3d import KEPT_OF_32, holds_positions_3d, read_positions_3d
from models.motion.skeleton import BODY21, H36M17, HUMANEVA15, Skeleton, joint_map
from training.data.prepare import prepare
from training.data.store import open_store


def walk(num_frames: int = 120, *, skeleton: Skeleton = H36M17, fps: float = 50.0) -> np.ndarray:
    weights, _ = joint_map(BODY21, skeleton)
    poses = walking(num_frames, fps=fps)
    return np.einsum("ij,tjx->tix", weights, poses).astype(np.float32)


def of_32(poses):
    wide = np.full((len(poses), 32, 3), 7.0, np.float32)
    wide[:, KEPT_OF_32] = poses
    return wide


def written(folder, subjects, name="data_3d_h36m.npz"):
    path = folder / name
    np.savez(path, positions_3d=np.array(subjects, dtype=object))
    return path


@pytest.mark.parametrize("layout", [of_32, lambda poses: poses], ids=["32 joints", "17 joints"])
def test_both_layouts_give_the_seventeen_joints(tmp_path, layout):
    path = written(tmp_path, {"S1": {"Walking 1": layout(walk())}})
    assert holds_positions_3d(path)
    [(subject, action, motion)] = read_positions_3d(path)
    assert (subject, action, motion.fps) == ("S1", "Walking 1", 50.0)
    assert motion.name == "S1_Walking_1"
    assert np.array_equal(motion.positions, walk())


def test_store_keeps_the_literature_s_test_subjects_apart(tmp_path):
    clips = {"Walking 1": of_32(walk()), "Walking": of_32(walk(150))}
    path = written(tmp_path, {"S1": clips, "S9": {"Eating 2": of_32(walk(200))}})
    prepare([path], tmp_path / "store", skeleton=H36M17, fps=50.0)
    found = {(c.name, c.split, c.action, c.subject) for c in open_store(tmp_path / "store").clips}
    assert ("S9_Eating_2", "test", "Eating", "S9") in found
    assert {(split, action) for name, split, action, _ in found if name.startswith("S1")} == {
        ("train", "Walking")
    }


def test_humaneva_keeps_its_fifteen_joints_and_its_rate(tmp_path):
    poses = walk(skeleton=HUMANEVA15, fps=60.0)
    path = written(tmp_path, {"Train/S1": {"Walking 1 chunk0": poses}}, "data_3d_humaneva15.npz")
    [(subject, action, motion)] = read_positions_3d(path)
    assert (subject, action, motion.fps) == ("Train/S1", "Walking 1 chunk0", 60.0)
    assert motion.name == "Train_S1_Walking_1_chunk0"
    assert motion.skeleton == HUMANEVA15
    assert np.array_equal(motion.positions, poses)


def test_humaneva_s_validation_is_the_test_and_damaged_chunks_are_left_out(tmp_path):
    def chunk(num_frames):
        return walk(num_frames, skeleton=HUMANEVA15, fps=60.0)

    clips = {
        "Train/S1": {"Jog 1 chunk2": chunk(120)},
        "Train/S3": {"Walking 1 chunk0": chunk(130), "Walking 1 chunk1": chunk(140)},
        "Validate/S3": {"Walking 1 chunk4": chunk(150), "Gestures 1 chunk4": chunk(160)},
    }
    path = written(tmp_path, clips, "data_3d_humaneva15.npz")
    prepare([path], tmp_path / "store", skeleton=HUMANEVA15, fps=60.0)
    found = {(c.source, c.split, c.action, c.subject) for c in open_store(tmp_path / "store").clips}
    assert found == {
        ("humaneva", "train", "Jog", "S1"),
        ("humaneva", "train", "Walking", "S3"),
        ("humaneva", "test", "Gestures", "S3"),
    }
    assert len(open_store(tmp_path / "store").clips) == 3


@pytest.mark.parametrize(
    "value",
    [np.zeros((5, 16, 3)), np.zeros((5, 32)), np.full((5, 17, 3), np.nan)],
    ids=["joints", "axes", "NaN"],
)
def test_other_shapes_and_values_are_refused(tmp_path, value):
    path = written(tmp_path, {"S1": {"Walking": value}})
    with pytest.raises(FormatError, match="S1, Walking"):
        list(read_positions_3d(path))


def test_file_of_another_kind_is_not_taken_for_one(tmp_path):
    np.savez(tmp_path / "other.npz", positions=np.zeros(3))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 and then nothing")
    assert not holds_positions_3d(tmp_path / "other.npz")
    assert not holds_positions_3d(tmp_path / "broken.npz")
