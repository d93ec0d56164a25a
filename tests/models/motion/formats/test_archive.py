from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models.motion import rotations as rot
from models.motion.formats.errors import (
    EmptyMotionError,
    FormatError,
    InvalidNumberError,
    MalformedFileError,
    UnsupportedFileError,
)
from models.motion.formats.npz import Clip, clip_of, read_archive, write_archive
from models.motion.kinematics import forward_kinematics
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, H36M17


def motion_of(num_frames: int, *, seed: int = 0) -> Motion:
    rng = np.random.default_rng(seed)
    rest = 0.2 * rng.normal(size=(21, 3))
    rest[0] = 0.0
    path = 0.1 * rng.normal(size=(num_frames, 21, 3)).cumsum(axis=0)
    rotations = rot.continuous_sign(rot.from_axis_angles(path, "XYZ"))
    root = rng.normal(size=(num_frames, 3))
    return Motion(
        name=f"clip{seed}",
        skeleton=BODY21,
        positions=forward_kinematics(rotations, rest, BODY21.parents, root),
        fps=30.0,
        rotations=rotations,
        rest_offsets=rest,
    )


def clips() -> list[Clip]:
    return [
        clip_of(motion_of(5), action="walk", subject="01", split="train"),
        clip_of(motion_of(9, seed=1), action="run", split="valid"),
    ]


def test_clips_come_back_as_they_were_written(tmp_path):
    path = tmp_path / "a.npz"
    write_archive(path, clips())
    for clip, seed in zip(read_archive(path), (0, 1), strict=True):
        motion = motion_of((5, 9)[seed], seed=seed)
        assert (clip.name, clip.action) == (motion.name, ("walk", "run")[seed])
        assert (clip.subject, clip.split) == (("01", "train"), ("", "valid"))[seed]
        np.testing.assert_allclose(clip.motion.positions, motion.positions, atol=6e-5)
        np.testing.assert_allclose(clip.motion.rotations, motion.rotations, atol=2e-5)
        np.testing.assert_allclose(clip.motion.rest_offsets, motion.rest_offsets, atol=1e-7)
        assert clip.motion.positions.dtype == np.float32


def test_a_clip_without_rotations_gets_them_from_its_positions():
    motion = motion_of(6)
    bare = Motion(name="bare", skeleton=BODY21, positions=motion.positions, fps=30.0)
    stored = clip_of(bare).motion
    assert stored.rotations is not None
    assert stored.rest_offsets is not None
    rotations = rot.normalise(stored.rotations.astype(np.float64))
    positions = forward_kinematics(
        rotations, stored.rest_offsets.astype(np.float64), BODY21.parents, motion.positions[:, 0]
    )
    np.testing.assert_allclose(positions, motion.positions, atol=5e-4)


def test_only_people_on_body21_can_be_stored(tmp_path):
    motion = motion_of(3)
    with pytest.raises(UnsupportedFileError, match="clip0: found h36m17; archives hold body21"):
        clip_of(motion.to(H36M17))
    with pytest.raises(UnsupportedFileError, match=r"over 3\.2 m"):
        clip_of(replace(motion, positions=motion.positions * 100))
    with pytest.raises(EmptyMotionError, match="no clips"):
        write_archive(tmp_path / "a.npz", [])
    with pytest.raises(UnsupportedFileError, match="resample"):
        write_archive(tmp_path / "a.npz", [clips()[0], replace(clips()[1], fps=24.0)])


@pytest.mark.parametrize(
    ("key", "value", "error", "message"),
    [
        ("clip_name", None, MalformedFileError, "found no clip_name"),
        ("positions", np.zeros((14, 17, 3), np.int16), MalformedFileError, r"\(14, 21, 3\)"),
        ("positions", np.zeros((14, 21, 3)), MalformedFileError, "float64; it must be i2"),
        ("root", np.full((14, 3), np.nan, np.float32), InvalidNumberError, r"\[root\]"),
        ("clip_start", np.array([0, 9]), MalformedFileError, "frames outside the archive"),
        ("clip_start", np.array([0.0, 5.0]), MalformedFileError, "no integers"),
        ("joint_names", np.array(["a"]), UnsupportedFileError, "other joint_names"),
        ("fps", np.array(0), InvalidNumberError, "positive"),
        ("clip_name", np.array(["a", None]), MalformedFileError, "found ValueError"),
    ],
)
def test_an_archive_of_another_layout_is_refused(tmp_path, key, value, error, message):
    path = tmp_path / "a.npz"
    write_archive(path, clips())
    with np.load(path) as archive:
        arrays = {**archive, key: value}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(error, match=message):
        list(read_archive(path))


@pytest.fixture(scope="module")
def content(tmp_path_factory) -> bytes:
    path: Path = tmp_path_factory.mktemp("archive") / "a.npz"
    write_archive(path, clips())
    return path.read_bytes()


@settings(max_examples=200,
          suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(st.data())
def test_garbage_is_read_or_refused_but_never_breaks_the_reader(tmp_path, content, data):
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(0, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "fuzz.npz"
    path.write_bytes(bytes(damaged[: data.draw(st.integers(0, len(damaged)))]))
    try:
        found = list(read_archive(path))
    except FormatError as error:
        found, message = [], str(error)
    else:
        message = "fuzz.npz"
    assert message.startswith("fuzz.npz")
    assert all(np.isfinite(clip.motion.positions).all() for clip in found)
