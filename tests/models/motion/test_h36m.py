"""Human3.6M's customary file, made small by the tests in both of its layouts."""

import numpy as np
import pytest
from tiny_bundles import walking

from models.motion.formats.errors import FormatError
from models.motion.formats.h36m import KEPT_OF_32, holds_h36m, read_h36m
from models.motion.skeleton import BODY21, H36M17, joint_map
from training.data.prepare import prepare
from training.data.store import open_store


def walk(num_frames=120):
    weights, _ = joint_map(BODY21, H36M17)
    poses = walking(num_frames, fps=50.0)
    return np.einsum("ij,tjx->tix", weights, poses).astype(np.float32)


def of_32(poses):
    wide = np.full((len(poses), 32, 3), 7.0, np.float32)
    wide[:, KEPT_OF_32] = poses
    return wide


def written(folder, subjects):
    path = folder / "data_3d_h36m.npz"
    np.savez(path, positions_3d=np.array(subjects, dtype=object))
    return path


@pytest.mark.parametrize("layout", [of_32, lambda poses: poses], ids=["32 joints", "17 joints"])
def test_both_layouts_give_the_seventeen_joints(tmp_path, layout):
    path = written(tmp_path, {"S1": {"Walking 1": layout(walk())}})
    assert holds_h36m(path)
    [(subject, motion)] = read_h36m(path)
    assert (subject, motion.name, motion.fps) == ("S1", "S1_Walking_1", 50.0)
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


@pytest.mark.parametrize(
    "value",
    [np.zeros((5, 16, 3)), np.zeros((5, 32)), np.full((5, 17, 3), np.nan)],
    ids=["joints", "axes", "NaN"],
)
def test_other_shapes_and_values_are_refused(tmp_path, value):
    path = written(tmp_path, {"S1": {"Walking": value}})
    with pytest.raises(FormatError, match="S1, Walking"):
        list(read_h36m(path))


def test_file_of_another_kind_is_not_taken_for_one(tmp_path):
    np.savez(tmp_path / "other.npz", positions=np.zeros(3))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 and then nothing")
    assert not holds_h36m(tmp_path / "other.npz")
    assert not holds_h36m(tmp_path / "broken.npz")
