"""Poses as features: joint rotations, turns and steps, in torch."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.articulation import Articulation, to_6d
from models.layers import in_lanes
from models.motion.skeleton import Skeleton
from models.pose import Frame, facing

TURN_RAD, STEP_M, HEIGHT_M = 0.1, 0.1, 1 / 3
"""What counts as 1 among the features."""
LASTING_FRAMES = 3.0
"""For how long a wrong step or turn is taken to stay wrong."""
_EPSILON = 1e-8


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
        bones = self.articulation.bones(canonical, self.articulation.frames(canonical))
        rest = torch.matmul(self.articulation.path, bones).mean(dim=0)
        reach = (rest[:, None] - rest[None]).square().sum(dim=-1)  # (J, J)
        below = self.articulation.path.T  # row j: the joints that the bone to j carries
        for place, joint in enumerate(self.articulation.turning):
            carried = below[joint] if joint else torch.ones_like(below[0])
            # Two rotations of a small rotation change by 4/3 angle^2, positions by 2/3 of that.
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
        canonical = Frame(observation, self._pairs).enter(frames)
        rotations, changes = self._felt(canonical, self.articulation.frames(canonical))
        return torch.cat([rotations[:, 1:], changes], dim=2)

    def enter_observation(
        self, observation: Float[Tensor, "B T J 3"]
    ) -> tuple[Float[Tensor, "B T F"], Float[Tensor, "B J 3"]]:
        """Features of the observation itself, and the person's bone vectors.

        The first step is taken to be as the second.
        """
        canonical = Frame(observation, self._pairs).enter(observation)
        frames = self.articulation.frames(canonical)
        rotations, changes = self._felt(canonical, frames)
        first = torch.cat([changes[:, :1, :-1], canonical[:, :1, 0, 2:] / HEIGHT_M], dim=2)
        features = torch.cat([rotations, torch.cat([first, changes], dim=1)], dim=2)
        return features, self.articulation.bones(canonical, frames)

    def standing(
        self, observation: Float[Tensor, "B T J 3"]
    ) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 4"]]:
        """Where the root was last seen, and the ground from which `leave` goes on there."""
        frame = Frame(observation, self._pairs)
        cos, sin = frame.turn[:, 0, :1], frame.turn[:, 1, :1]
        return frame.origin[:, 0, 0], torch.cat([cos, sin, 0.0 * cos, 0.0 * cos], dim=1)

    def leave(
        self,
        features: Float[Tensor, "B L F"],
        arms: Float[Tensor, "B J A"],
        origin: Float[Tensor, "B 3"],
        ground: Float[Tensor, "B 4"],
    ) -> tuple[Float[Tensor, "B L J 3"], Float[Tensor, "B 4"]]:
        """Poses in the world, and the ground after them.

        ``origin`` and the first ``ground`` are from `standing`. The ground is cosine and sine of
        the heading, and the place (x, y) from the origin, of the frame before the first.
        """
        rows = features.permute(2, 0, 1)  # (F, B, L)
        rotations, changes = torch.split(rows, [self.num_features - 4, 4])
        changes = changes * self.units[:, None, None]
        turn, forward, left, height = torch.split(changes, 1)
        angle = turn.cumsum(dim=2)
        before, start = torch.split(ground.T[:, :, None], 2)
        cos, sin = torch.split(before, 1)
        turned = _turned(cos, sin, in_lanes(torch.cos, angle), in_lanes(torch.sin, angle))
        heading = torch.cat(turned)
        # A step is told in the heading of the frame before.
        cos, sin = torch.split(torch.cat([before, heading[:, :, :-1]], dim=2), 1)
        place = start + torch.cat(_turned(cos, sin, forward, left)).cumsum(dim=2)
        root = torch.cat([place, height]) + origin.T[:, :, None]
        after = torch.cat([heading, place])[:, :, -1].T
        return self.articulation.positions(rotations, arms, root, heading), after

    def _felt(
        self, canonical: Float[Tensor, "B L J 3"], frames: Float[Tensor, "N 3 3 B L"]
    ) -> tuple[Float[Tensor, "B L R"], Float[Tensor, "B M 4"]]:
        """Rotations of every frame, and what changed since the frame before from the second on."""
        rotations = self.articulation.rotations(frames)
        along, across, up = rotations[:1].unbind(dim=2)
        left_x, left_y = along[0, 1], across[0, 1]  # the root's left, seen from above
        length = (left_x.square() + left_y.square()).add(_EPSILON).sqrt()
        cos, sin = left_y / length, -left_x / length
        level = torch.stack([*_turned(cos, -sin, along, across), up], dim=2)
        values = to_6d(torch.cat([level, rotations[1:]])).flatten(0, 1).permute(1, 2, 0)
        root = canonical[:, :, 0]
        step = (root[:, 1:, :2] - root[:, :-1, :2]).unbind(dim=2)
        c, s = cos[:, :-1], sin[:, :-1]
        turned_cos, turned_sin = _turned(c, -s, cos[:, 1:], sin[:, 1:])
        angle = in_lanes(torch.atan, turned_sin / turned_cos.clamp(min=0.1))
        parts = [angle, *_turned(c, -s, *step), root[:, 1:, 2]]
        return values, torch.stack(parts, dim=2) / self.units


def _turned(
    cos: Float[Tensor, "*#B"],
    sin: Float[Tensor, "*#B"],
    x: Float[Tensor, "*#B"],
    y: Float[Tensor, "*#B"],
) -> tuple[Tensor, Tensor]:
    """Coordinates after a turn about the third axis."""
    return cos * x - sin * y, sin * x + cos * y
