import numpy as np
import pytest

from models.motion import rotations as rot
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, H36M17, SkeletonError, joint_map

ROTATIONS = rot.from_axis_angles(np.linspace(0, 3, 41)[:, None, None] * np.ones((1, 21, 1)), "Z")


def motion_of(positions: np.ndarray, fps: float = 20.0) -> Motion:
    return Motion(
        name="m",
        skeleton=BODY21,
        positions=positions,
        fps=fps,
        rotations=ROTATIONS[: len(positions)],
        rest_offsets=np.zeros((21, 3)),
    )


def curve(time: np.ndarray) -> np.ndarray:
    phase = np.arange(63).reshape(21, 3)
    return np.sin(3 * time[:, None, None] + phase)


def test_resampling_a_straight_line_keeps_it_straight():
    motion = motion_of(np.arange(41)[:, None, None] * np.ones((1, 21, 3)))
    up = motion.resample(50.0)
    assert up.num_frames == 101
    np.testing.assert_allclose(up.positions[:, 3, 1], np.arange(101) * 0.4, atol=1e-12)
    assert up.duration == pytest.approx(motion.duration) == pytest.approx(2.0)


def test_resampling_follows_a_curve_to_third_order():
    motion = motion_of(curve(np.arange(41) / 20))
    error = motion.resample(60.0).positions - curve(np.arange(121) / 60)
    assert np.abs(error[3:-3]).max() < 4e-4


def test_resampling_turns_at_a_constant_rate():
    motion = motion_of(curve(np.arange(41) / 20)).resample(40.0)
    assert motion.rotations is not None
    expected = rot.from_axis_angles(np.linspace(0, 3, 81)[:, None], "Z")
    np.testing.assert_allclose(motion.rotations[:, 4], expected, atol=1e-12)


def test_resampling_to_a_part_of_the_rate_keeps_frames():
    motion = motion_of(curve(np.arange(41) / 20))
    down = motion.resample(5.0)
    np.testing.assert_array_equal(down.positions, motion.positions[::4])
    assert down.fps == 5.0
    assert motion.resample(20.0) is motion


@pytest.mark.parametrize("num_frames", [1, 2, 3])
def test_short_motions_can_be_resampled(num_frames):
    motion = motion_of(curve(np.arange(num_frames) / 20).astype(np.float32))
    up = motion.resample(40.0)
    assert up.num_frames == 2 * num_frames - 1
    assert up.positions.dtype == np.float32
    np.testing.assert_array_equal(up.positions[::2], motion.positions)


def test_a_slice_is_a_motion_of_those_frames():
    motion = motion_of(curve(np.arange(41) / 20))
    part = motion[10:20:2]
    assert part.num_frames == 5
    assert part.fps == 10.0
    assert part.rotations is not None
    np.testing.assert_array_equal(part.rotations, ROTATIONS[10:20:2])


def test_another_skeleton_is_reached_by_the_joint_map():
    motion = motion_of(curve(np.arange(4) / 20))
    other = motion.to(H36M17)
    assert other.rotations is None
    np.testing.assert_allclose(
        other.positions[2], joint_map(BODY21, H36M17)[0] @ motion.positions[2], atol=1e-12
    )
    assert motion.to(BODY21).rotations is motion.rotations


def test_positions_of_another_skeleton_are_refused():
    with pytest.raises(SkeletonError, match="found 17 joints; body21 has 21"):
        Motion(name="m", skeleton=BODY21, positions=np.zeros((2, 17, 3)), fps=20.0)
