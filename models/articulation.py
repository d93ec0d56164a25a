"""Poses as joint rotations on a person's own bones, in torch."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.layers import in_lanes
from models.motion.skeleton import Skeleton
from models.pose import Frame, facing

TURN_RAD, STEP_M, HEIGHT_M = 0.1, 0.1, 1 / 3
"""What counts as 1 among the features."""
LASTING_FRAMES = 3.0
"""For how long a wrong step or turn is taken to stay wrong."""
_EPSILON = 1e-8
_FINE = 1e-3  # how much grandchildren count; all there is where siblings lie on one point


Ends = tuple[tuple[int, ...], tuple[int, ...]]
"""Two sets of joints, whose middles a line connects."""


class Articulation(nn.Module):
    """Positions to rotations relative to the parent joint and back, for any tree of joints.

    A joint with several children turns with them as one rigid body; its axes follow the line
    between its left and right children and the bones of the others. A joint with one child takes
    the shortest swing from ``rest_direction``, where that bone lies on average (`fit`). Leaves turn
    nothing and have no rotation. `positions` of `rotations` on `bones` gives the poses back where
    bones keep their lengths and siblings their angles.
    """

    rest_direction: Tensor
    path: Tensor

    def __init__(self, skeleton: Skeleton) -> None:
        super().__init__()
        self.parents = skeleton.parents
        self.turning = tuple(j for j, children in enumerate(skeleton.children) if children)
        """The joints that have a rotation, parents first."""
        self._children = skeleton.children
        self._axes = {j: _axes(j, skeleton) for j in self.turning if len(self._children[j]) > 1}
        self._place = {joint: i for i, joint in enumerate(self.turning)}
        rest = torch.zeros(skeleton.num_joints, 3)  # until fitted: trunks rise, limbs hang
        rest[:, 2] = torch.tensor([1.0 if side == "center" else -1.0 for side in skeleton.sides])
        self.register_buffer("rest_direction", rest)
        path = torch.eye(skeleton.num_joints)  # row j: the bones from the root to joint j
        for joint, parent in enumerate(self.parents[1:], start=1):
            path[joint] += path[parent]
        path[:, 0] = 0.0
        self.register_buffer("path", path, persistent=False)

    @torch.no_grad()
    def fit(self, poses: Float[Tensor, "B L J 3"]) -> None:
        """Let lone children rest in their mean direction, as far as can be from where swings flip.

        Args:
            poses: many poses of many people, seen from their own frame.
        """
        frames: list[Tensor] = []
        for joint in self.turning:
            above = self._above(joint, frames, poses)
            if joint not in self._axes:
                (child,) = self._children[joint]
                bone = _unit(poses[:, :, child] - poses[:, :, joint])
                mean = torch.matmul(bone[:, :, None], above).mean(dim=(0, 1))
                self.rest_direction[child] = _unit(mean[0])
            frames.append(self._frame(joint, above, poses))

    def rotations(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B L K 3 3"]:
        """Rotation of every turning joint relative to its parent, the root's to the world."""
        frames = self._frames(poses)
        local = [
            torch.matmul(self._above(joint, frames, poses).transpose(-1, -2), frame)
            for joint, frame in zip(self.turning, frames, strict=True)
        ]
        return torch.stack(local, dim=2)

    def bones(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B J 3"]:
        """Each person's bone vectors in the frame of the parent joint, means over the frames."""
        # zeros_like would fix the batch's size
        bones = [0.0 * poses[:, 0, 0]] * len(self.parents)
        for joint, frame in zip(self.turning, self._frames(poses), strict=True):
            for child in self._children[joint]:
                bone = poses[:, :, child] - poses[:, :, joint]
                if joint in self._axes:
                    bones[child] = torch.matmul(bone[:, :, None], frame)[:, :, 0].mean(dim=1)
                else:
                    length = bone.square().sum(dim=-1, keepdim=True).sqrt().mean(dim=1)
                    bones[child] = length * self.rest_direction[child]
        return torch.stack(bones, dim=1)

    def positions(
        self,
        rotations: Float[Tensor, "B L K 3 3"],
        bones: Float[Tensor, "B J 3"],
        root: Float[Tensor, "B L 3"],
    ) -> Float[Tensor, "B L J 3"]:
        """Forward kinematics: p_j = p_parent + G_parent b_j."""
        frames: list[Tensor] = []
        for i, joint in enumerate(self.turning):
            local = rotations[:, :, i]
            frames.append(torch.matmul(self._above(joint, frames, local), local) if i else local)
        parents = [self._place[max(parent, 0)] for parent in self.parents]
        turned = torch.matmul(torch.stack(frames, dim=2)[:, :, parents], bones[:, None, :, :, None])
        return root[:, :, None] + torch.matmul(self.path, turned[..., 0])

    def _frames(self, poses: Float[Tensor, "B L J 3"]) -> list[Tensor]:
        """Every turning joint's axes in the world, (B, L, 3, 3)."""
        frames: list[Tensor] = []
        for joint in self.turning:
            frames.append(self._frame(joint, self._above(joint, frames, poses), poses))
        return frames

    def _above(self, joint: int, frames: list[Tensor], like: Tensor) -> Tensor:
        if joint == 0:
            return torch.eye(3, dtype=like.dtype, device=like.device)
        return frames[self._place[self.parents[joint]]]

    def _frame(
        self, joint: int, above: Tensor, poses: Float[Tensor, "B L J 3"]
    ) -> Float[Tensor, "B L 3 3"]:
        """The joint's axes in the world, as columns."""
        if joint in self._axes:
            across, upward = self._axes[joint]
            left = _between(poses, *across)
            left = _unit(left + _FINE * _between(poses, *self._beyond(*across)))
            up = _between(poses, *upward)
            up = _unit(up - (up * left).sum(dim=-1, keepdim=True) * left)
            return torch.stack([_cross(left, up), left, up], dim=-1)
        (child,) = self._children[joint]
        bone = _unit(poses[:, :, child] - poses[:, :, joint])
        own = torch.matmul(bone[:, :, None], above)[:, :, 0]
        return torch.matmul(above, _swing(self.rest_direction[child], own))

    def _beyond(self, start: tuple[int, ...], end: tuple[int, ...]) -> Ends:
        """The children of two sets of joints, or these themselves where one has none."""
        nexts = [
            tuple(c for joint in joints for c in self._children[joint]) for joints in (start, end)
        ]
        return (nexts[0], nexts[1]) if all(nexts) else (start, end)


def _axes(joint: int, skeleton: Skeleton) -> tuple[Ends, Ends]:
    """From which joints to which its line across and its line upwards lead."""
    children, mirror = skeleton.children[joint], skeleton.mirror
    left = tuple(c for c in children if skeleton.sides[c] == "left" and mirror[c] in children)
    if not left:  # no pair: any two children span the frame
        return ((joint,), children[:1]), ((joint,), children[1:])
    right = tuple(mirror[c] for c in left)
    others = tuple(c for c in children if c not in left + right)
    # Without a child between the pair, the pair's own middle points away from the joint.
    return (right, left), ((joint,), others or left + right)


def _between(
    poses: Float[Tensor, "B L J 3"], start: tuple[int, ...], end: tuple[int, ...]
) -> Float[Tensor, "B L 3"]:
    return poses[:, :, list(end)].mean(dim=2) - poses[:, :, list(start)].mean(dim=2)


def _unit(vector: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    return vector / vector.square().sum(dim=-1, keepdim=True).add(_EPSILON**2).sqrt()


def _cross(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    x, y, z = a.unbind(dim=-1)
    u, v, w = b.unbind(dim=-1)
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u], dim=-1)


def _swing(rest: Float[Tensor, "3"], to: Float[Tensor, "B L 3"]) -> Float[Tensor, "B L 3 3"]:
    """The shortest rotation that takes one unit vector to others: 1 + V + V V / (1 + cos)."""
    x, y, z = _cross(rest.expand_as(to), to).unbind(dim=-1)
    zero = 0.0 * x
    rows = ([zero, -z, y], [z, zero, -x], [-y, x, zero])
    v = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    cosine = (rest * to).sum(dim=-1)[..., None, None]
    eye = torch.eye(3, dtype=to.dtype, device=to.device)
    turned: Tensor = eye + v + torch.matmul(v, v) / (1.0 + cosine).clamp(min=1e-4)
    return turned


def to_6d(rotations: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 6"]:
    """The first two columns of rotation matrices (Zhou et al. 2019)."""
    return rotations[..., :2].transpose(-1, -2).flatten(-2)


def from_6d(values: Float[Tensor, "*B 6"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation matrices from two columns that need be neither of length 1 nor orthogonal."""
    first = _unit(values[..., :3])
    second = values[..., 3:]
    second = _unit(second - (first * second).sum(dim=-1, keepdim=True) * first)
    return torch.stack([first, second, _cross(first, second)], dim=-1)


class ArticulatedPoses(nn.Module):
    """Features of poses as a walker feels them: rotations, turns and steps in the own heading.

    A frame is ``6 K`` numbers for the joints that turn, the root's without its heading; then the
    change of heading since the frame before, the root's step in the heading of that frame (forward,
    left), and its height over the last observed root. `weights` say what an error of each is worth:
    weighted squared errors sum up to about the squared distance between two poses in metres.
    """

    weights: Tensor
    units: Tensor

    def __init__(self, skeleton: Skeleton) -> None:
        super().__init__()
        self.articulation = Articulation(skeleton)
        self.num_features = 6 * len(self.articulation.turning) + 4
        self._pairs = facing(skeleton)
        self.register_buffer("units", torch.tensor([TURN_RAD, STEP_M, STEP_M, HEIGHT_M]))
        self.register_buffer("weights", torch.ones(self.num_features))

    @torch.no_grad()
    def fit(self, observation: Float[Tensor, "B T J 3"]) -> None:
        """Set rest directions and weights to those of the people in some observations."""
        canonical = Frame(observation, self._pairs).enter(observation)
        self.articulation.fit(canonical)
        bones = self.articulation.bones(canonical)
        rest = torch.matmul(self.articulation.path, bones).mean(dim=0)
        reach = (rest[:, None] - rest[None]).square().sum(dim=-1)  # (J, J)
        below = self.articulation.path.T  # row j: the joints that the bone to j carries
        for place, joint in enumerate(self.articulation.turning):
            carried = below[joint] if joint else torch.ones_like(below[0])
            # Two columns of a small rotation change by 4/3 angle^2, positions by 2/3 of that.
            self.weights[6 * place : 6 * place + 6] = 0.5 * (reach[joint] * carried).sum()
        around = rest[:, :2].square().sum()  # what a turn about the root moves
        moved = torch.stack([around, *[around.new_tensor(float(len(rest)))] * 3])
        lasting = torch.tensor([LASTING_FRAMES, LASTING_FRAMES, LASTING_FRAMES, 1.0])
        self.weights[-4:] = moved * (lasting.to(moved) * self.units).square()

    def enter(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B L J 3"]
    ) -> Float[Tensor, "B L F"]:
        """Features of poses that go on from the observation's last frame."""
        frames = torch.cat([observation[:, -1:], poses], dim=1)
        rotations, changes = self._felt(Frame(observation, self._pairs).enter(frames))
        return torch.cat([rotations[:, 1:], changes], dim=2)

    def enter_observation(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B T F"]:
        """Features of the observation itself; its first step is taken to be as its second."""
        canonical = Frame(observation, self._pairs).enter(observation)
        rotations, changes = self._felt(canonical)
        first = torch.cat([changes[:, :1, :-1], canonical[:, :1, 0, 2:] / HEIGHT_M], dim=2)
        return torch.cat([rotations, torch.cat([first, changes], dim=1)], dim=2)

    def bones(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B J 3"]:
        """The observed person's bone vectors."""
        return self.articulation.bones(Frame(observation, self._pairs).enter(observation))

    def leave(
        self,
        observation: Float[Tensor, "B T J 3"],
        features: Float[Tensor, "B L F"],
        bones: Float[Tensor, "B J 3"],
        start: Float[Tensor, "B 3"],
    ) -> tuple[Float[Tensor, "B L J 3"], Float[Tensor, "B 3"]]:
        """Poses in the observation's world, and heading and place of the last one.

        ``start`` is the canonical heading (radians) and place (x, y) of the frame before the first.
        """
        changes = features[:, :, -4:] * self.units
        headings = start[:, None, 0] + changes[:, :, 0].cumsum(dim=1)
        before = torch.cat([start[:, :1], headings[:, :-1]], dim=1)
        cos, sin = in_lanes(torch.cos, before), in_lanes(torch.sin, before)
        forward, left = changes[:, :, 1:3].unbind(dim=2)
        steps = torch.stack([cos * forward - sin * left, sin * forward + cos * left], dim=2)
        ground = start[:, None, 1:] + steps.cumsum(dim=1)
        rotations = from_6d(features[:, :, :-4].reshape(*features.shape[:2], -1, 6))
        cos, sin = in_lanes(torch.cos, headings), in_lanes(torch.sin, headings)
        upright = torch.matmul(_about_z(cos, sin), rotations[:, :, 0])
        rotations = torch.cat([upright[:, :, None], rotations[:, :, 1:]], dim=2)
        root = torch.cat([ground, changes[:, :, 3:]], dim=2)
        poses = Frame(observation, self._pairs).leave(
            self.articulation.positions(rotations, bones, root)
        )
        return poses, torch.cat([headings[:, -1:], ground[:, -1]], dim=1)

    def _felt(
        self, canonical: Float[Tensor, "B L J 3"]
    ) -> tuple[Float[Tensor, "B L R"], Float[Tensor, "B M 4"]]:
        """Rotations of every frame, and what changed since the frame before from the second on."""
        rotations = self.articulation.rotations(canonical)
        across = rotations[:, :, 0, :2, 1]  # the root's left, seen from above
        across = across / across.square().sum(dim=2, keepdim=True).add(_EPSILON).sqrt()
        cos, sin = across[..., 1], -across[..., 0]
        level = torch.matmul(_about_z(cos, -sin), rotations[:, :, 0])
        rotations = torch.cat([level[:, :, None], rotations[:, :, 1:]], dim=2)
        root = canonical[:, :, 0]
        dx, dy = (root[:, 1:, :2] - root[:, :-1, :2]).unbind(dim=2)
        c, s = cos[:, :-1], sin[:, :-1]
        turned = (sin[:, 1:] * c - cos[:, 1:] * s) / (cos[:, 1:] * c + sin[:, 1:] * s).clamp(
            min=0.1
        )
        parts = [in_lanes(torch.atan, turned), c * dx + s * dy, c * dy - s * dx, root[:, 1:, 2]]
        return to_6d(rotations).flatten(2), torch.stack(parts, dim=2) / self.units


def _about_z(cos: Float[Tensor, "B L"], sin: Float[Tensor, "B L"]) -> Float[Tensor, "B L 3 3"]:
    zero, one = 0.0 * cos, 1.0 + 0.0 * cos
    rows = ([cos, -sin, zero], [sin, cos, zero], [zero, zero, one])
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
