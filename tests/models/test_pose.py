"""The canonical frame, the features and the bases."""

import numpy as np
import pytest
import torch
from tiny_bundles import walking

from models.motion.kinematics import rotate_yaw, yaw
from models.motion.skeleton import BODY21, H36M17, SMPL22
from models.pose import (
    Frame,
    RootRelativePoses,
    WorldPoses,
    continuation_basis,
    cosine_basis,
    facing,
    root_counts,
)


@pytest.fixture
def walk():
    turned = rotate_yaw(walking(20, speed=1.4), 0.8) + np.array([3.0, -1.0, 0.2])
    return torch.from_numpy(turned).float()[None]


def test_last_pose_stands_at_the_origin_and_faces_x(walk):
    canonical = Frame(walk, facing(BODY21)).enter(walk)
    assert canonical[0, -1, 0].tolist() == pytest.approx([0, 0, 0], abs=1e-6)
    assert float(yaw(canonical[0, -1].numpy(), BODY21)) == pytest.approx(0, abs=0.05)
    assert canonical[0, 0, 0, 0] < -0.5  # the walker came from behind


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22, H36M17], ids=lambda s: s.name)
def test_facing_is_told_by_left_and_right_of_the_same_joint(skeleton):
    for left, right in facing(skeleton):
        assert skeleton.mirror[left] == right
        assert skeleton.sides[left] == "left"


def test_world_features_come_back_as_the_same_poses(walk):
    representation = WorldPoses(BODY21, root_weight=2.0)
    features = representation.enter(walk, walk)
    assert features.shape == (1, 20, representation.num_features)
    assert torch.allclose(representation.leave(walk, features), walk, atol=2e-6)


def test_world_features_are_joints_around_a_weighted_root(walk):
    features = WorldPoses(BODY21, root_weight=2.0).enter(walk, walk).unflatten(2, (-1, 3))
    canonical = Frame(walk, facing(BODY21)).enter(walk)
    assert torch.allclose(features[:, :, 0], 2 * canonical[:, :, 0], atol=1e-5)
    relative = canonical[:, :, 1:] - canonical[:, :, :1]
    assert torch.allclose(features[:, :, 1:], relative, atol=1e-5)


def test_root_counts_by_its_weight_and_everything_else_once():
    assert root_counts(torch.zeros(6), 0.5).tolist() == [0.5, 0.5, 0.5, 1.0, 1.0, 1.0]


def test_root_relative_features_keep_the_last_root(walk):
    representation = RootRelativePoses(BODY21)
    back = representation.leave(walk, representation.enter(walk, walk))
    assert torch.allclose(back[:, :, 0], walk[:, -1:, 0].expand(-1, 20, -1))
    assert torch.allclose(back[:, -1], walk[:, -1], atol=1e-6)


@pytest.mark.parametrize("basis", [continuation_basis(24, 60), cosine_basis(15, 15)])
def test_bases_are_orthonormal(basis):
    assert torch.allclose(basis.T @ basis, torch.eye(basis.shape[1]), atol=1e-5)


def test_continuation_starts_at_nothing():
    """Extended to frame 0 by its own symmetry, every sine is zero there."""
    basis = continuation_basis(24, 60).double()
    at_zero = 2 * basis[0] * torch.cos(torch.pi * (torch.arange(24) + 0.5) / 60.5) - basis[1]
    assert torch.allclose(at_zero, torch.zeros(24, dtype=torch.float64), atol=1e-6)
