import numpy as np
import pytest
import torch
from tiny_bundles import walking

from models.articulated_poses import ArticulatedPoses
from models.articulation import Articulation, from_6d, to_6d
from models.motion.kinematics import rotate_yaw
from models.motion.skeleton import BODY21, H36M17, SMPL22, Skeleton, joint_map


def walk(skeleton: Skeleton = BODY21, *, num_frames: int = 30) -> torch.Tensor:
    weights, _ = joint_map(BODY21, skeleton)
    poses = np.einsum("ij,tjx->tix", weights, walking(num_frames, fps=30.0))
    return torch.from_numpy(poses[None].astype(np.float32))


def bent(articulation: Articulation, *, seed: int = 0) -> torch.Tensor:
    """Rotations far from rest, but no joint turned right round."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randn(len(articulation.turning), 6, 2, 4, generator=generator)
    straight = torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    return from_6d(straight[:, None, None] + 0.3 * drawn)


def posed(
    articulation: Articulation,
    rotations: torch.Tensor,
    bones: torch.Tensor,
    root: torch.Tensor,
) -> torch.Tensor:
    values = to_6d(rotations).flatten(0, 1)
    return articulation.positions(values, articulation.arms(bones), root.permute(2, 0, 1))


def rotations_of(articulation: Articulation, poses: torch.Tensor) -> torch.Tensor:
    return articulation.rotations(articulation.frames(poses))


def bones_of(articulation: Articulation, poses: torch.Tensor) -> torch.Tensor:
    return articulation.bones(poses, articulation.frames(poses))


@pytest.mark.parametrize("skeleton", [BODY21, SMPL22, H36M17], ids=lambda s: s.name)
def test_positions_of_rotations_are_the_poses(skeleton):
    articulation = Articulation(skeleton)
    poses = walk(skeleton)
    # Siblings must keep their angles, as they do on a body that is made of rotations.
    rigid = posed(
        articulation,
        rotations_of(articulation, poses),
        bones_of(articulation, poses[:, :1]),
        poses[:, :, 0],
    )
    again = posed(
        articulation,
        rotations_of(articulation, rigid),
        bones_of(articulation, rigid),
        rigid[:, :, 0],
    )
    torch.testing.assert_close(again, rigid, atol=2e-4, rtol=0)


def test_bones_keep_their_length_whatever_the_rotations():
    articulation = Articulation(BODY21)
    bones = bones_of(articulation, walk())
    poses = posed(articulation, bent(articulation), bones.expand(2, -1, -1), torch.zeros(2, 4, 3))
    parents = list(BODY21.parents[1:])
    lengths = (poses[:, :, 1:] - poses[:, :, parents]).norm(dim=-1)
    torch.testing.assert_close(lengths, bones[:, 1:].norm(dim=-1).expand_as(lengths))


def test_heading_turns_the_whole_body():
    articulation = Articulation(BODY21)
    bones, angle = bones_of(articulation, walk()).expand(2, -1, -1), 2.0
    values, root = to_6d(bent(articulation)).flatten(0, 1), torch.zeros(3, 2, 4)
    heading = torch.tensor([np.cos(angle), np.sin(angle)], dtype=torch.float32)
    arms = articulation.arms(bones)
    turned = articulation.positions(values, arms, root, heading[:, None, None].expand(-1, 2, 4))
    plain = articulation.positions(values, arms, root)
    expected = torch.from_numpy(rotate_yaw(plain.numpy(), angle)).float()
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=0)


def test_rotations_are_rotations():
    articulation = Articulation(BODY21)
    rotations = rotations_of(articulation, walk())
    matrices = rotations.permute(3, 4, 0, 2, 1)  # (B, L, K, xyz, column)
    eye = torch.eye(3).expand_as(matrices)
    torch.testing.assert_close(matrices @ matrices.mT, eye, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(matrices.shape[:3]))


def test_only_the_root_turns_when_the_whole_person_does():
    articulation = Articulation(BODY21)
    poses = walk()
    turned = torch.from_numpy(rotate_yaw(poses.numpy(), 0.8))
    before, after = rotations_of(articulation, poses), rotations_of(articulation, turned)
    torch.testing.assert_close(after[1:], before[1:], atol=1e-5, rtol=0)
    assert not torch.allclose(after[0], before[0], atol=0.1)


def test_siblings_on_one_point_get_their_frame_from_their_children():
    poses = walk()
    chest, left, right = (BODY21.index(n) for n in ("chest", "left_shoulder", "right_shoulder"))
    poses[:, :, left] = poses[:, :, right] = poses[:, :, BODY21.index("neck")]
    articulation = Articulation(BODY21)
    rotations = rotations_of(articulation, poses)
    again = posed(articulation, rotations, bones_of(articulation, poses), poses[:, :, 0])
    torch.testing.assert_close(again[:, :, chest:], poses[:, :, chest:], atol=1e-3, rtol=0)


def test_fit_rests_lone_bones_where_they_are_on_average():
    articulation = Articulation(BODY21)
    poses = walk(num_frames=1)
    articulation.fit(poses)
    rotations = rotations_of(articulation, poses)
    alone = [i for i, j in enumerate(articulation.turning) if len(BODY21.children[j]) == 1]
    eye = torch.eye(3)[:, :, None, None].expand(len(alone), 3, 3, 1, 1)
    torch.testing.assert_close(rotations[alone], eye, atol=1e-5, rtol=0)


def test_six_numbers_hold_a_rotation():
    rotations = bent(Articulation(BODY21))
    torch.testing.assert_close(from_6d(to_6d(rotations)), rotations, atol=1e-6, rtol=0)
    torch.testing.assert_close(from_6d(3 * to_6d(rotations)), rotations, atol=1e-6, rtol=0)


def test_poses_return_from_their_features():
    poses = ArticulatedPoses(BODY21)
    motion = walk(num_frames=60) + torch.tensor([3.0, -2.0, 0.0])
    observation, future = motion[:, :15], motion[:, 15:]
    poses.fit(observation)
    rigid = bones_of(poses.articulation, observation)
    features = poses.enter(observation, future)
    arms, (origin, ground) = poses.articulation.arms(rigid), poses.standing(observation)
    again, arrived = poses.leave(features, arms, origin, ground)
    torch.testing.assert_close(again, future, atol=0.02, rtol=0)  # walking() is not quite rigid
    half, between = poses.leave(features[:, :20], arms, origin, ground)
    rest, end = poses.leave(features[:, 20:], arms, origin, between)
    torch.testing.assert_close(torch.cat([half, rest], dim=1), again, atol=1e-5, rtol=0)
    torch.testing.assert_close(end, arrived, atol=1e-5, rtol=0)


def test_features_do_not_depend_on_where_a_person_stands_and_faces():
    poses = ArticulatedPoses(BODY21)
    motion = walk(num_frames=30)
    moved = torch.from_numpy(rotate_yaw(motion.numpy(), 2.0)) + torch.tensor([1.0, 2.0, 0.5])
    for clip in (motion, moved):
        clip.requires_grad_(False)
    torch.testing.assert_close(
        poses.enter(moved[:, :15], moved[:, 15:]),
        poses.enter(motion[:, :15], motion[:, 15:]),
        atol=1e-4,
        rtol=0,
    )


def test_weighted_error_is_about_the_squared_distance_of_the_poses():
    poses = ArticulatedPoses(BODY21)
    observation = walk(num_frames=15)
    poses.fit(observation)
    arms = poses.articulation.arms(poses.enter_observation(observation)[1])
    origin, ground = poses.standing(observation)
    features = poses.enter(observation, observation[:, -1:])
    generator = torch.Generator().manual_seed(0)
    ratios = []
    for _ in range(50):
        noise = torch.randn(features.shape, generator=generator) * 0.02
        noise[..., -4:] = 0.0
        error = (noise.square() * poses.weights).sum()
        plain, _ = poses.leave(features, arms, origin, ground)
        moved, _ = poses.leave(features + noise, arms, origin, ground)
        ratios.append(float((moved - plain).square().sum() / error))
    assert 0.4 < np.median(ratios) < 1.6
