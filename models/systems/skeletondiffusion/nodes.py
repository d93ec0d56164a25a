"""Motion as sequences on the nodes of a skeleton's graph, and back: two representations.

Both cut a motion into ticks, the time steps of the recurrent networks, and say what a decoder must
know of the observation (``start``: one row of numbers per node).
"""

import functools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.motion.skeleton import Skeleton
from models.pose import Frame, facing, per_axis, relative_to_root
from models.systems.skeletondiffusion.noise import NodeGraph, with_root, without_root

SHORTEST_SQUARED = 1e-8
MOVES_BY = 3.0
"""What was moved in half a second counts this much more than where it is."""

LAST, VELOCITY, LENGTH = slice(0, 3), slice(6, 9), slice(9, 10)
"""What `CanonicalNodes.start` says of a node; between them, where it was a frame before."""


class RootRelativeNodes(nn.Module):
    """The paper's: joints relative to the dropped root, a frame per tick, in a box of metres."""

    start_width = 6
    inputs_per_tick = 3
    outputs_per_tick = 3

    def __init__(
        self, skeleton: Skeleton, *, num_observed: int, horizon: int, box_m: float
    ) -> None:
        super().__init__()
        self.graph: NodeGraph = without_root(skeleton)
        self.box_m = box_m
        self.num_ticks = horizon
        self.decoder_ticks = horizon
        self.observed_width = 3 * num_observed

    def _nodes(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "N B L 3"]:
        return (poses[:, :, 1:] - poses[:, :, :1]).permute(2, 0, 1, 3) / self.box_m

    def start(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "N B S"]:
        """The last two poses."""
        return self._nodes(observation[:, -2:]).flatten(2)

    def observed(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "N B T 3"]:
        """The ticks of the observation."""
        return self._nodes(observation)

    def future(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B H J 3"]
    ) -> Float[Tensor, "N B H 3"]:
        """The ticks of the future."""
        del observation
        return self._nodes(poses)

    def target(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B H J 3"]
    ) -> Float[Tensor, "B H F"]:
        """What `motion` should be."""
        del observation
        return (poses[:, :, 1:] - poses[:, :, :1]).flatten(2)

    def motion(
        self, outputs: Float[Tensor, "N B H 3"], start: Float[Tensor, "N B S"], *, every: int = 1
    ) -> Float[Tensor, "B frames F"]:
        """Joints relative to the root, metres, from a decoder's outputs; absolute, in the box.

        Args:
            outputs: of the decoder, tick by tick.
            start: what it started from.
            every: 2 gives every second frame, up to the last.
        """
        del start
        chosen = outputs[:, :, every - 1 :: every].permute(1, 2, 0, 3).flatten(2)
        return torch.tanh(chosen) * self.box_m

    def weigh(self, difference: Float[Tensor, "*B F"]) -> Float[Tensor, "*B F"]:
        """A difference of motions as it counts: every joint alike."""
        return difference

    def leave(
        self, observation: Float[Tensor, "B T J 3"], motion: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H J 3"]:
        """Poses around the last observed root."""
        root = observation[:, -1:, :1]
        joints = motion.unflatten(2, (-1, 3)) + root
        return torch.cat([root.expand(-1, joints.shape[1], -1, -1), joints], dim=2)


class CanonicalNodes(nn.Module):
    """Ours: every joint but the root as its limb, the root as its path, in the canonical frame.

    A future is a cubic B-spline that leaves the last observed pose with the observed velocity;
    limbs are turned, never stretched: each keeps its mean observed length. Nodes that are not
    ``rigid`` say positions relative to the root instead, as the paper's do, and limbs can stretch.
    """

    start_width = 10
    scale: Tensor
    basis: Tensor
    of_one_limb: Tensor
    to_joints: Tensor
    weights: Tensor
    root: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the representation
        self,
        skeleton: Skeleton,
        *,
        num_observed: int,
        horizon: int,
        frames_per_tick: int,
        knot_frames: int,
        knots_per_tick: int,
        root_weight: float,
        rigid: bool = True,
    ) -> None:
        super().__init__()
        self.graph: NodeGraph = with_root(skeleton)
        self.frames_per_tick = frames_per_tick
        self.num_ticks = horizon // frames_per_tick
        self.inputs_per_tick = 3 * frames_per_tick
        spline, glide = continuing_spline(horizon, knot_frames)
        self.decoder_ticks = -(-spline.shape[1] // knots_per_tick)
        self.outputs_per_tick = 3 * knots_per_tick
        self.observed_width = 3 * num_observed
        self.register_buffer("scale", torch.ones(skeleton.num_joints))
        held = torch.cat([spline, glide, torch.ones_like(glide)], dim=1)
        self.register_buffer("basis", held, persistent=False)
        self.rigid = rigid
        self._origins = list(skeleton.parents[1:]) if rigid else [0] * (skeleton.num_joints - 1)
        joints, xyz = torch.eye(skeleton.num_joints), torch.ones(3, 3)
        self.register_buffer("of_one_limb", torch.kron(joints, xyz), persistent=False)
        self.register_buffer("to_joints", per_axis(_chains(self._origins)), persistent=False)
        self.register_buffer(
            "weights",
            relative_to_root(skeleton.num_joints, root_weight=root_weight),
            persistent=False,
        )
        is_root = torch.arange(self.of_one_limb.shape[0]) < 3
        self.register_buffer("root", is_root.float(), persistent=False)
        self._pairs = facing(skeleton)

    @property
    def spline(self) -> Float[Tensor, "H P"]:
        """What each free control point adds to the frames."""
        return self.basis[:, :-2]

    @property
    def glide(self) -> Float[Tensor, "H 1"]:
        """What the observed velocity adds to the frames."""
        return self.basis[:, -2:-1]

    def _vectors(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B L J 3"]
    ) -> Float[Tensor, "N B L 3"]:
        """From the joint that a node is relative to, to its own; the root's path."""
        canonical = Frame(observation, self._pairs).enter(poses).permute(2, 0, 1, 3)
        return torch.cat([canonical[:1], canonical[1:] - canonical[self._origins]])

    def start(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "N B S"]:
        """The last vectors and those before, their velocity in metres a frame, their lengths."""
        vectors = self._vectors(observation, observation)
        velocity = (vectors[:, :, -1] - vectors[:, :, -3]) / 2
        lengths = vectors.square().sum(dim=3).add(1e-12).sqrt()
        # Term by term: onnxruntime's sums round differently in vectors and in what is left over.
        frames = lengths.unbind(dim=2)
        mean = functools.reduce(torch.add, frames) / len(frames)
        return torch.cat([vectors[:, :, -1], vectors[:, :, -2], velocity, mean[:, :, None]], dim=2)

    def observed(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "N B T 3"]:
        """The frames of the observation, relative to the last, in whose place it stands itself."""
        vectors = self._vectors(observation, observation)
        relative = (vectors[:, :, :-1] - vectors[:, :, -1:]) * MOVES_BY
        return torch.cat([relative, vectors[:, :, -1:]], dim=2) / self.scale[:, None, None, None]

    def future(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B H J 3"]
    ) -> Float[Tensor, "N B K F"]:
        """The ticks of the future, relative to the last observed pose."""
        last = self._vectors(observation, observation[:, -1:])
        relative = (self._vectors(observation, poses) - last) / self.scale[:, None, None, None]
        return relative.unflatten(2, (-1, self.frames_per_tick)).flatten(3)

    def target(
        self, observation: Float[Tensor, "B T J 3"], poses: Float[Tensor, "B H J 3"]
    ) -> Float[Tensor, "B H F"]:
        """What `motion` should be."""
        return Frame(observation, self._pairs).enter(poses).flatten(2)

    def motion(
        self, outputs: Float[Tensor, "N B K O"], start: Float[Tensor, "N B S"], *, every: int = 1
    ) -> Float[Tensor, "B frames F"]:
        """Joints in the canonical frame from a decoder's outputs.

        Args:
            outputs: the spline's control points, tick by tick.
            start: what the decoder started from.
            every: 2 gives every second frame, up to the last.
        """
        # Products of matrices throughout: what runs over three coordinates at a time is slow.
        points = outputs.flatten(2).unflatten(2, (-1, 3)) * self.scale[:, None, None, None]
        free = points[:, :, : self.spline.shape[1]].permute(1, 2, 0, 3).flatten(2)
        last, velocity, length = (
            start[:, :, part].transpose(0, 1) for part in (LAST, VELOCITY, LENGTH)
        )
        given = torch.stack([velocity.flatten(1), last.flatten(1)], dim=1)
        moved = torch.matmul(self.basis[every - 1 :: every], torch.cat([free, given], dim=1))
        if not self.rigid:
            return torch.matmul(moved, self.to_joints)
        squared = torch.matmul(moved * moved, self.of_one_limb)
        lengths = length.expand(-1, -1, 3).flatten(1)[:, None]
        turned = moved * (lengths * (squared + SHORTEST_SQUARED).rsqrt())
        limbs = torch.where(self.root > 0, moved, turned)
        return torch.matmul(limbs, self.to_joints)

    def weigh(self, difference: Float[Tensor, "*B F"]) -> Float[Tensor, "*B F"]:
        """A difference of motions as it counts: joints relative to the root, the root by weight."""
        return torch.matmul(difference, self.weights)

    def leave(
        self, observation: Float[Tensor, "B T J 3"], motion: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H J 3"]:
        """Poses in the world of the observation."""
        return Frame(observation, self._pairs).leave(motion.unflatten(2, (-1, 3)))


def continuing_spline(
    horizon: int, knot_frames: int
) -> tuple[Float[Tensor, "horizon P"], Float[Tensor, "horizon 1"]]:
    """A uniform cubic B-spline over the frames 1 ... horizon that is 0 at frame 0.

    Returns:
        What each free control point adds, and what a velocity at frame 0 of one a frame adds: of
        the control points -1 to n, the first two follow from value and velocity at frame 0.
    """
    segments = -(-horizon // knot_frames)
    frame = torch.arange(1, horizon + 1, dtype=torch.float64) / knot_frames
    away = (frame[:, None] - torch.arange(-1, segments + 2, dtype=torch.float64)).abs()
    near = 2 / 3 - away.square() + away**3 / 2
    far = (2 - away).clamp(min=0) ** 3 / 6
    basis = torch.where(away < 1, near, far)  # (horizon, n + 2), points -1 ... n + 1
    before, at, after = basis[:, 0], basis[:, 1], basis[:, 2:]
    # value: (c_-1 + 4 c_0 + c_1) / 6 = 0; velocity: (c_1 - c_-1) / (2 h) = v.
    spline = after.clone()
    spline[:, 0] += before - at / 2
    glide = knot_frames * (at / 2 - 2 * before)
    return spline.float(), glide[:, None].float()


def _chains(origins: Sequence[int]) -> Float[Tensor, "J J"]:
    """1 where a node (row) lies on the way from the root to a joint (column)."""
    chains = torch.eye(len(origins) + 1)
    for joint, origin in enumerate(origins, start=1):
        chains[:, joint] += chains[:, origin]
    return chains
