"""The canonical frame and the spectral form of motion, in torch."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from models.motion.skeleton import Skeleton


def facing(skeleton: Skeleton) -> tuple[tuple[int, int], ...]:
    """Pairs (left, right) of joints whose connecting line tells where a body faces."""
    mirror = skeleton.mirror
    pairs = [(j, mirror[j]) for j, side in enumerate(skeleton.sides) if side == "left"]
    hips = [pair for pair in pairs if skeleton.parents[pair[0]] == 0]
    return tuple(hips or pairs)


class Frame:
    """The canonical frame: last observed root at the origin, last observed facing along +X.

    Args:
        observation: poses in the world, metres, root first.
        pairs: the joints that define the facing, from `facing`.
    """

    def __init__(
        self, observation: Float[Tensor, "B T J 3"], pairs: tuple[tuple[int, int], ...]
    ) -> None:
        last = observation[:, -1]
        left = last[:, [pair[0] for pair in pairs]].mean(dim=1)
        right = last[:, [pair[1] for pair in pairs]].mean(dim=1)
        across = left - right
        length = across[:, :2].square().sum(dim=-1, keepdim=True).add(1e-12).sqrt()
        unit = across[:, :2] / length  # a person who faces +X has the left side at +Y
        cos, sin, zero, one = unit[:, 1], -unit[:, 0], 0 * unit[:, 0], 0 * unit[:, 0] + 1
        self.origin = last[:, :1].unsqueeze(1)  # (B, 1, 1, 3)
        turn = [cos, -sin, zero, sin, cos, zero, zero, zero, one]
        self.turn = torch.stack(turn, dim=1).unflatten(1, (3, 3))

    def enter(self, world: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B L J 3"]:
        """Poses of the world in the canonical frame."""
        turned = torch.matmul((world - self.origin).flatten(1, 2), self.turn)
        return turned.unflatten(1, world.shape[1:3])

    def leave(self, canonical: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B L J 3"]:
        """Poses of the canonical frame in the world."""
        frames, joints = canonical.shape[1:3]
        turned = torch.matmul(canonical.flatten(1, 2), self.turn.transpose(1, 2))
        # Whole poses are added: what runs over three coordinates at a time is slow.
        origin = self.origin.expand(-1, -1, joints, -1).flatten(1)[:, None]
        return (turned.reshape(-1, frames, 3 * joints) + origin).unflatten(2, (joints, 3))


def continuation_basis(num_bases: int, length: int) -> Float[Tensor, "length num_bases"]:
    """Orthonormal sines over the frames 1 … length that are 0 at frame 0, the last observed one.

    The discrete sine transform whose right end is free: a motion written in it starts where the
    observation ends, whatever its coefficients.
    """
    frame = torch.arange(1, length + 1, dtype=torch.float64)[:, None]
    order = torch.arange(num_bases, dtype=torch.float64)[None] + 0.5
    basis = torch.sin(math.pi * order * frame / (length + 0.5))
    return (basis * math.sqrt(2 / (length + 0.5))).float()


def cosine_basis(num_bases: int, length: int) -> Float[Tensor, "length num_bases"]:
    """Orthonormal discrete cosine transform, type 2, of the first num_bases frequencies."""
    frame = torch.arange(length, dtype=torch.float64)[:, None] + 0.5
    order = torch.arange(num_bases, dtype=torch.float64)[None]
    basis = torch.cos(math.pi * order * frame / length) * math.sqrt(2 / length)
    basis[:, 0] /= math.sqrt(2)
    return basis.float()


def relative_to_root(num_joints: int, *, root_weight: float) -> Float[Tensor, "F F"]:
    """Flat poses (rows) to joints relative to the root, beside the root itself, weighted."""
    mixing = torch.eye(num_joints)
    mixing[0, 1:] = -1
    mixing[0, 0] = root_weight
    return per_axis(mixing)


def posture_and_steps(features: Float[Tensor, "B L F"]) -> Float[Tensor, "B LF"]:
    """The steps that led to the last pose, and that pose."""
    # Steps from frame to frame are centimetres; ten times as much puts them on a pose's scale.
    steps = (features[:, 1:] - features[:, :-1]) * 10
    return torch.cat([steps.flatten(1), features[:, -1]], dim=1)


def root_counts(feature: Float[Tensor, "F"], root_weight: float) -> Float[Tensor, "F"]:
    """What each feature of a frame like this counts: the first three, the root's, by weight."""
    counts = torch.ones_like(feature)
    counts[:3] = root_weight
    return counts


def per_axis(matrix: Float[Tensor, "J K"]) -> Float[Tensor, "F G"]:
    """A matrix over joints as one over flat poses: the same for each of the three coordinates."""
    return torch.kron(matrix, torch.eye(3))


class WorldPoses:
    """Features of poses in the canonical frame, the root's path included.

    Joints are relative to their frame's root, so that the features of a walk repeat; the root's
    path counts root_weight times, because an error of the root moves every joint of the body.
    """

    def __init__(self, skeleton: Skeleton, *, root_weight: float) -> None:
        self.num_features = 3 * skeleton.num_joints
        self._pairs = facing(skeleton)
        # Rows in, columns out: one small product takes the place of slices and sums.
        self._to_features = relative_to_root(skeleton.num_joints, root_weight=root_weight)
        self._to_poses = torch.linalg.inv(self._to_features.double()).float()

    def enter(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B L J 3"]
    ) -> Float[Tensor, "B L F"]:
        """Features of poses of the observation's world."""
        canonical = Frame(observation, self._pairs).enter(poses).flatten(2)
        return torch.matmul(canonical, self._to_features.to(canonical.device))

    def leave(
        self, observation: Float[Tensor, "B T J 3"], features: Float[Tensor, "B L F"]
    ) -> Float[Tensor, "B L J 3"]:
        """Poses in the observation's world."""
        canonical = torch.matmul(features, self._to_poses.to(features.device))
        return Frame(observation, self._pairs).leave(canonical.unflatten(2, (-1, 3)))


class RootRelativePoses:
    """Features of the field's benchmarks: joints relative to the root, the root itself dropped.

    Answers keep the root where it was last seen.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        self.num_features = 3 * (skeleton.num_joints - 1)

    def enter(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B L J 3"]
    ) -> Float[Tensor, "B L F"]:
        """Features of poses; the observation has no part in them."""
        del observation
        return (poses[:, :, 1:] - poses[:, :, :1]).flatten(2)

    def leave(
        self, observation: Float[Tensor, "B T J 3"], features: Float[Tensor, "B L F"]
    ) -> Float[Tensor, "B L J 3"]:
        """Poses around the last observed root."""
        joints = features.unflatten(2, (-1, 3))
        root = observation[:, -1:, :1].expand(-1, joints.shape[1], -1, -1)
        return torch.cat([root, joints + root], dim=2)
