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
    carried: Tensor
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
        by_level = [joint for joints in self._levels for joint in joints]
        self._by_level = [self.turning.index(joint) for joint in by_level]
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
        carrying = torch.zeros(len(by_level), skeleton.num_joints)  # which joint turns which bone
        for joint, parent in enumerate(self.parents[1:], start=1):
            carrying[by_level.index(parent), joint] = 1.0
        carried = path[:, None] * carrying  # (J, K, J)
        self.register_buffer("carried", carried.flatten(0, 1), persistent=False)
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

    def arms(self, bones: Float[Tensor, "B J 3"]) -> Float[Tensor, "B J A"]:
        """What every joint is away from the root, in the axes of all that turn: for `positions`."""
        arms = torch.matmul(self.carried, bones)
        return arms.reshape(-1, len(self.parents), 3 * len(self.turning))

    def positions(
        self,
        values: Float[Tensor, "K6 B L"],
        arms: Float[Tensor, "B J A"],
        root: Float[Tensor, "3 B L"],
        heading: Float[Tensor, "2 B L"] | None = None,
    ) -> Float[Tensor, "B L J 3"]:
        """Forward kinematics of `to_6d` rotations: p_j = p_parent + G_parent b_j.

        ``heading``, a cosine and a sine, turns the whole body about the third axis. The numbers of
        all people and frames stay in rows until they are positions.
        """
        num_frames = int(values.shape[2])  # a plain number, so that a graph need not ask for it
        values = values.reshape(len(self.turning), 6, -1, num_frames)[self._by_level]
        first, *others = torch.split(from_6d(values), [len(joints) for joints in self._levels])
        frames = [first if heading is None else _headed(first, heading)]
        for above, joints, own in zip(self._levels, self._levels[1:], others, strict=False):
            carrier = frames[-1]
            places = [above.index(self.parents[joint]) for joint in joints]
            if len(above) > 1 and places != list(range(len(above))):
                carrier = carrier[places]
            frames.append(_product(carrier, own))
        axes = torch.cat(frames).permute(3, 0, 1, 2, 4)  # (B, K, 3, 3, L)
        axes = axes.reshape(-1, 3 * len(self.turning), 3 * num_frames)
        placed = torch.matmul(arms, axes) + root.permute(1, 0, 2).reshape(-1, 1, 3 * num_frames)
        return placed.reshape(-1, len(self.parents), 3, num_frames).permute(0, 3, 1, 2)

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
    matrices: Float[Tensor, "#n 3 3 B L"], columns: Float[Tensor, "n c 3 B L"]
) -> Float[Tensor, "n c 3 B L"]:
    """Products of matrices with the columns of others."""
    parts = zip(torch.split(matrices, 1, dim=1), torch.split(columns, 1, dim=2), strict=True)
    x, y, z = (matrix * column for matrix, column in parts)
    return x + y + z


def _headed(
    rotations: Float[Tensor, "1 3 3 B L"], heading: Float[Tensor, "2 B L"]
) -> Float[Tensor, "1 3 3 B L"]:
    """Rotations after a turn about the third axis."""
    x, y, z = torch.split(rotations, 1, dim=2)
    cos, sin = torch.split(heading, 1)
    return torch.cat([cos * x - sin * y, sin * x + cos * y, z], dim=2)


def _unit(vectors: Float[Tensor, "n 3 *B"]) -> Float[Tensor, "n 3 *B"]:
    return vectors / vectors.square().sum(dim=1, keepdim=True).add(_EPSILON**2).sqrt()


def _cross(a: Float[Tensor, "n 3 *#B"], b: Float[Tensor, "n 3 *#B"]) -> Float[Tensor, "n 3 *#B"]:
    x, y, z = torch.split(a, 1, dim=1)
    u, v, w = torch.split(b, 1, dim=1)
    return torch.cat([y * w - z * v, z * u - x * w, x * v - y * u], dim=1)


def _swing(rest: Float[Tensor, "n 3"], to: Float[Tensor, "n 3 B L"]) -> Float[Tensor, "n 3 3 B L"]:
    """The shortest rotation that takes unit vectors to others: 1 + V + V V / (1 + cos)."""
    rest = rest[:, :, None, None]
    axis = _cross(rest, to)
    x, y, z = torch.split(axis, 1, dim=1)
    zero = 0.0 * x
    columns = torch.cat([zero, z, -y, -z, zero, x, y, -x, zero], dim=1)
    v = columns.reshape(len(rest), 3, 3, -1, int(to.shape[3]))
    share = 1.0 / (1.0 + (rest * to).sum(dim=1, keepdim=True)).clamp(min=1e-4)
    eye = torch.eye(3, dtype=to.dtype, device=to.device)[:, :, None, None]
    # V V is v v - |v|^2, v their cross product.
    along = axis[:, None] * (share * axis)[:, :, None]
    return (1.0 - share * axis.square().sum(dim=1, keepdim=True))[:, None] * eye + v + along


def to_6d(rotations: Float[Tensor, "K 3 3 B L"]) -> Float[Tensor, "K 6 B L"]:
    """The first two columns of rotation matrices (Zhou et al. 2019)."""
    return rotations[:, :2].flatten(1, 2)


def from_6d(values: Float[Tensor, "K 6 B L"]) -> Float[Tensor, "K 3 3 B L"]:
    """Rotation matrices from two columns that need be neither of length 1 nor orthogonal."""
    first, second = torch.split(values, 3, dim=1)
    first = _unit(first)
    second = _unit(second - (first * second).sum(dim=1, keepdim=True) * first)
    columns = torch.cat([first, second, _cross(first, second)], dim=1)
    return columns.reshape(len(values), 3, 3, -1, int(values.shape[3]))
