"""Rotations of joints and positions on a person's own bones, in torch.

Matrices are (joint, column, xyz, person, frame): so every operation goes along the long rows of
people and frames. A processor spends far more on a thousand products of 3x3 matrices than on nine
products of a thousand numbers.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.layers import LANES
from models.motion.skeleton import Skeleton

_EPSILON = 1e-8
_FINE = 1e-3  # how much grandchildren count; all there is where siblings lie on one point


class Articulation(nn.Module):
    """Positions to rotations relative to the parent joint and back, for any tree of joints.

    A joint with several children turns with them as one rigid body; its axes follow the line
    between its left and right children and the bones of the others. A joint with one child takes
    the shortest swing from ``rest_direction``, where that bone lies on average (`fit`). Leaves turn
    nothing and have no rotation. From the `frames` of poses come their `rotations` and `bones`, and
    `positions` of these gives the poses back where bones keep their lengths and siblings their
    angles.
    """

    rest_direction: Tensor
    path: Tensor
    lines: Tensor

    def __init__(self, skeleton: Skeleton) -> None:
        super().__init__()
        self.parents = skeleton.parents
        self.turning = tuple(j for j, children in enumerate(skeleton.children) if children)
        """The joints that have a rotation, parents first."""
        self._children = skeleton.children
        self._branching = [j for j in self.turning if len(self._children[j]) > 1]
        # Joints of one level are computed together: a graph's calls cost more than its numbers.
        self._levels = _levels(self.turning, self.parents)
        swinging = [j for j in self.turning if len(self._children[j]) == 1]
        self._swinging = _levels(swinging, self.parents)
        rest = torch.zeros(skeleton.num_joints, 3)  # until fitted: trunks rise, limbs hang
        rest[:, 2] = torch.tensor([1.0 if side == "center" else -1.0 for side in skeleton.sides])
        self.register_buffer("rest_direction", rest)
        path = torch.eye(skeleton.num_joints)  # row j: the bones from the root to joint j
        for joint, parent in enumerate(self.parents[1:], start=1):
            path[joint] += path[parent]
        path[:, 0] = 0.0
        self.register_buffer("path", path, persistent=False)
        lines = torch.zeros(2, len(self._branching), skeleton.num_joints)
        for i, joint in enumerate(self._branching):
            lines[:, i] = _axes(joint, skeleton)
        self.register_buffer("lines", lines, persistent=False)

    @torch.no_grad()
    def fit(self, poses: Float[Tensor, "B L J 3"]) -> None:
        """Let lone children rest in their mean direction, as far as can be from where swings flip.

        Args:
            poses: many poses of many people, seen from their own frame.
        """
        for joints in self._swinging:
            above = self.frames(poses)[self._above(joints)]
            mean = self._lone_bones(joints, above, poses).mean(dim=(-2, -1))
            self.rest_direction[[self._children[j][0] for j in joints]] = _unit(mean)

    def frames(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "N 3 3 B L"]:
        """The axes of the world, then every turning joint's in the world."""
        rows = _in_rows(poses)
        eye = torch.eye(3, dtype=poses.dtype, device=poses.device)
        world = eye[None, :, :, None, None] + 0.0 * rows[:1, :1, None]
        across, upward = (_weighted(line, rows) for line in self.lines)
        left = _unit(across)
        up = _unit(upward - (upward * left).sum(dim=1, keepdim=True) * left)
        frames = torch.cat([world, torch.stack([_cross(left, up), left, up], dim=1)])
        order = [-1, *self._branching]
        for joints in self._swinging:
            above = frames[[order.index(self.parents[j]) for j in joints]]
            rest = self.rest_direction[[self._children[j][0] for j in joints]]
            swing = _swing(rest, self._lone_bones(joints, above, poses))
            frames, order = torch.cat([frames, _product(above, swing)]), [*order, *joints]
        return frames[[order.index(joint) for joint in (-1, *self.turning)]]

    def rotations(self, frames: Float[Tensor, "N 3 3 B L"]) -> Float[Tensor, "K 3 3 B L"]:
        """Rotation of every turning joint relative to its parent, the root's to the world."""
        above = frames[self._above(self.turning)]
        return _product(above.transpose(1, 2), frames[1:])

    def bones(
        self, poses: Float[Tensor, "B L J 3"], frames: Float[Tensor, "N 3 3 B L"]
    ) -> Float[Tensor, "B J 3"]:
        """Each person's bone vectors in the frame of the parent joint, means over the frames."""
        rows = _in_rows(poses)
        vectors = rows - rows[[max(parent, 0) for parent in self.parents]]
        lengths = vectors.square().sum(dim=1, keepdim=True).sqrt()
        bones = lengths * self.rest_direction[:, :, None, None]
        siblings = [child for joint in self._branching for child in self._children[joint]]
        above = frames[self._above(siblings)].transpose(1, 2)
        own = _product(above, vectors[siblings, None])[:, 0]
        sources = list(range(len(self.parents)))
        for i, joint in enumerate(siblings):
            sources[joint] = len(self.parents) + i
        # onnxruntime's means along a row round otherwise where it starts elsewhere in memory.
        mean = poses.new_full((poses.shape[1], LANES), 1.0 / poses.shape[1])
        return torch.matmul(torch.cat([bones, own])[sources], mean)[..., 0].permute(2, 0, 1)

    def positions(
        self,
        rotations: Float[Tensor, "K 3 3 B L"],
        bones: Float[Tensor, "B J 3"],
        root: Float[Tensor, "B L 3"],
    ) -> Float[Tensor, "B L J 3"]:
        """Forward kinematics: p_j = p_parent + G_parent b_j."""
        row = rotations.new_ones(rotations.shape[-1])
        arms = bones.permute(1, 2, 0)[:, None, :, :, None] * row  # (J, 1, 3, B, L)
        (root_joint,), *others = self._levels
        frames, order = rotations[:1], [root_joint]
        for joints in others:
            above = frames[[order.index(self.parents[j]) for j in joints]]
            own = rotations[[self.turning.index(j) for j in joints]]
            frames, order = torch.cat([frames, _product(above, own)]), [*order, *joints]
        above = frames[[order.index(max(parent, 0)) for parent in self.parents]]
        turned = _product(above, arms)[:, 0]
        placed = _weighted(self.path, turned) + root.permute(2, 0, 1)
        return placed.permute(2, 3, 0, 1)

    def _above(self, joints: Sequence[int]) -> list[int]:
        """Where the parents of joints are among `frames`."""
        order = (-1, *self.turning)
        return [order.index(self.parents[joint]) for joint in joints]

    def _lone_bones(
        self,
        joints: Sequence[int],
        above: Float[Tensor, "n 3 3 B L"],
        poses: Float[Tensor, "B L J 3"],
    ) -> Float[Tensor, "n 3 B L"]:
        """Directions from joints to their only children, in the frames of the joints' parents."""
        rows = _in_rows(poses)
        children = [self._children[joint][0] for joint in joints]
        bones = _unit(rows[children] - rows[list(joints)])
        return _product(above.transpose(1, 2), bones[:, None])[:, 0]


def _levels(joints: Sequence[int], parents: Sequence[int]) -> list[list[int]]:
    """Joints by the number of these that lead up from them without a gap, fewest first."""
    depths: dict[int, int] = {}
    for joint in joints:
        depths[joint] = depths.get(parents[joint], -1) + 1
    return [
        [joint for joint, found in depths.items() if found == depth]
        for depth in range(1 + max(depths.values(), default=-1))
    ]


def _axes(joint: int, skeleton: Skeleton) -> Float[Tensor, "2 J"]:
    """What each joint counts for the line across of one with several children, and upwards."""
    children, mirror = list(skeleton.children[joint]), skeleton.mirror
    left = [c for c in children if skeleton.sides[c] == "left" and mirror[c] in children]
    right = [mirror[c] for c in left]
    others = [c for c in children if c not in left + right]
    if left:  # without a child between the pair, its own middle points away from the joint
        (start, end), top = (right, left), others or left + right
    else:  # no pair: any two children span the frame
        (start, end), top = ([joint], children[:1]), children[1:]
    below = [[c for j in joints for c in skeleton.children[j]] for joints in (start, end)]
    fine = _line(*(below if all(below) else (start, end)), like=skeleton)
    return torch.stack(
        [_line(start, end, like=skeleton) + _FINE * fine, _line([joint], top, like=skeleton)]
    )


def _line(start: list[int], end: list[int], *, like: Skeleton) -> Float[Tensor, "J"]:
    """What each joint counts for the line that connects the middles of two sets of them."""
    line = torch.zeros(like.num_joints)
    line[end] += 1.0 / len(end)
    line[start] -= 1.0 / len(start)
    return line


def _in_rows(poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "J 3 B L"]:
    return poses.permute(2, 3, 0, 1)


def _weighted(
    weights: Float[Tensor, "n J"], rows: Float[Tensor, "J 3 B L"]
) -> Float[Tensor, "n 3 B L"]:
    """Weighted sums of joints."""
    return torch.matmul(weights, rows.flatten(1)).reshape(len(weights), 3, -1, rows.shape[3])


def _product(
    matrices: Float[Tensor, "n 3 3 B L"], columns: Float[Tensor, "n c 3 B L"]
) -> Float[Tensor, "n c 3 B L"]:
    """Products of matrices with the columns of others."""
    x, y, z = (matrices[:, i : i + 1] * columns[:, :, i : i + 1] for i in range(3))
    return x + y + z


def _unit(vectors: Float[Tensor, "n 3 *B"]) -> Float[Tensor, "n 3 *B"]:
    return vectors / vectors.square().sum(dim=1, keepdim=True).add(_EPSILON**2).sqrt()


def _cross(a: Float[Tensor, "n 3 *B"], b: Float[Tensor, "n 3 *B"]) -> Float[Tensor, "n 3 *B"]:
    x, y, z = a.unbind(dim=1)
    u, v, w = b.unbind(dim=1)
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u], dim=1)


def _swing(rest: Float[Tensor, "n 3"], to: Float[Tensor, "n 3 B L"]) -> Float[Tensor, "n 3 3 B L"]:
    """The shortest rotation that takes unit vectors to others: 1 + V + V V / (1 + cos)."""
    rest = rest[:, :, None, None]
    x, y, z = _cross(rest.expand_as(to), to).unbind(dim=1)
    zero = 0.0 * x
    columns = ([zero, z, -y], [-z, zero, x], [y, -x, zero])
    v = torch.stack([torch.stack(column, dim=1) for column in columns], dim=1)
    cosine = (rest * to).sum(dim=1)[:, None, None]
    eye = torch.eye(3, dtype=to.dtype, device=to.device)[:, :, None, None]
    return eye + v + _product(v, v) / (1.0 + cosine).clamp(min=1e-4)


def to_6d(rotations: Float[Tensor, "K 3 3 *B"]) -> Float[Tensor, "K 6 *B"]:
    """The first two columns of rotation matrices (Zhou et al. 2019)."""
    return rotations[:, :2].flatten(1, 2)


def from_6d(values: Float[Tensor, "K 6 *B"]) -> Float[Tensor, "K 3 3 *B"]:
    """Rotation matrices from two columns that need be neither of length 1 nor orthogonal."""
    first = _unit(values[:, :3])
    second = values[:, 3:]
    second = _unit(second - (first * second).sum(dim=1, keepdim=True) * first)
    return torch.stack([first, second, _cross(first, second)], dim=1)
