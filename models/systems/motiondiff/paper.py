"""The paper's parts at its sizes: every frame of the future diffuses, joints root-relative.

Features are ``(B, L, F)``: poses in a representation of `models.pose`, F = 3 J.
"""

import math
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from models.systems.motiondiff.transformer import Layer

DROPOUT = 0.1


class Frames(nn.Module):
    """x0: the frames of the future as they are, in metres."""

    def __init__(self, *, features: int, horizon: int) -> None:
        super().__init__()
        self.shape = (horizon, features // 3, 3)

    def enter(
        self, observation: Float[Tensor, "B T F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H J 3"]:
        """x0 of a future; the observation has no part in it."""
        del observation
        return future.unflatten(2, (-1, 3))

    def leave(
        self, observation: Float[Tensor, "B T F"], x0: Float[Tensor, "B H J 3"]
    ) -> Float[Tensor, "B H F"]:
        """The future of an x0."""
        del observation
        return x0.flatten(2)


class SpatialTransformer(nn.Module):
    """S: the joints of each frame attend to one another; a frame becomes one vector.

    Without layers it is the plain embedding of a pose.
    """

    def __init__(self, *, num_joints: int, width: int, layers: int) -> None:
        super().__init__()
        self.embed = nn.Linear(3, width)
        self.joint = nn.Parameter(0.02 * torch.randn(num_joints, width))
        self.layers = nn.ModuleList(
            Layer(width=width, heads=8, feed_forward=2 * width, dropout=DROPOUT)
            for _ in range(layers)
        )

    def forward(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B L W"]:
        """A vector for each frame."""
        tokens = (self.embed(poses) + self.joint).flatten(0, 1)
        for layer in self.layers:
            tokens = layer(tokens)
        return tokens.flatten(1).unflatten(0, (-1, poses.shape[1]))


class Encoder(nn.Module):
    """f_psi: spatial Transformer and GRU; the last state embeds the observation."""

    conditions = ("condition",)

    def __init__(self, *, num_joints: int, width: int, layers: int, state: int) -> None:
        super().__init__()
        self.spatial = SpatialTransformer(num_joints=num_joints, width=width, layers=layers)
        self.recurrence = nn.GRU(num_joints * width, state, batch_first=True)

    def forward(self, observation: Float[Tensor, "B T F"]) -> tuple[Float[Tensor, "B C"]]:
        """The state embedding."""
        _, state = self.recurrence(self.spatial(observation.unflatten(2, (-1, 3))))
        return (state[0],)


class Gated(nn.Module):
    """A linear layer whose outputs the condition gates and shifts."""

    def __init__(self, narrow: int, wide: int, *, condition: int) -> None:
        super().__init__()
        self.linear = nn.Linear(narrow, wide)
        self.gate = nn.Linear(condition, wide)
        self.shift = nn.Linear(condition, wide, bias=False)

    def forward(
        self, x: Float[Tensor, "B L V"], condition: Float[Tensor, "B C"]
    ) -> Float[Tensor, "B L W"]:
        """Features of the next width."""
        gate, shift = self.gate(condition).sigmoid(), self.shift(condition)
        result: Tensor = self.linear(x) * gate[:, None] + shift[:, None]
        return result


class Denoiser(nn.Module):
    """eps_theta: PoseFormer, then a Transformer over the frames fused with state and step."""

    alpha_bar: Tensor
    step: Tensor
    order: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        *,
        horizon: int,
        num_joints: int,
        alpha_bar: Float[Tensor, "K"],
        width: int,
        spatial_layers: int,
        pose_layers: int,
        fused_layers: int,
        state: int,
        fused: int,
    ) -> None:
        super().__init__()
        self.register_buffer("alpha_bar", alpha_bar.float(), persistent=False)
        beta = 1 - alpha_bar / torch.cat([alpha_bar.new_ones(1), alpha_bar[:-1]])
        step = torch.stack([beta, beta.sin(), beta.cos()], dim=1).float()
        self.register_buffer("step", step, persistent=False)
        self.register_buffer("order", _sinusoids(horizon, fused), persistent=False)
        frame, condition = num_joints * width, state + 3
        self.spatial = SpatialTransformer(num_joints=num_joints, width=width, layers=spatial_layers)
        self.frame = nn.Parameter(0.02 * torch.randn(horizon, frame))
        self.pose_layers = _layers(pose_layers, width=frame, heads=8, feed_forward=2 * frame)
        self.fuse = Gated(frame, fused, condition=condition)
        self.fused_layers = _layers(fused_layers, width=fused, heads=4, feed_forward=2 * fused)
        widths = (fused, fused // 2, fused // 4, 3 * num_joints)
        self.head = nn.ModuleList(
            Gated(narrow, wide, condition=condition) for narrow, wide in pairwise(widths)
        )

    def condition(self, context: Float[Tensor, "B C"]) -> Float[Tensor, "B C"]:
        """The state embedding itself."""
        return context

    def forward(
        self,
        x_t: Float[Tensor, "B H J 3"],
        timestep: Int[Tensor, "B"],
        condition: Float[Tensor, "B C"],
    ) -> Float[Tensor, "B H J 3"]:
        """eps."""
        tokens = self.spatial(x_t) + self.frame
        for layer in self.pose_layers:
            tokens = layer(tokens)
        fused = torch.cat([self.step[timestep], condition], dim=1)
        tokens = self.fuse(tokens, fused) + self.order
        for layer in self.fused_layers:
            tokens = layer(tokens)
        for index, layer in enumerate(self.head):
            tokens = layer(F.leaky_relu(tokens) if index else tokens, fused)
        return tokens.unflatten(2, (-1, 3))


def _layers(count: int, *, width: int, heads: int, feed_forward: int) -> nn.ModuleList:
    return nn.ModuleList(
        Layer(width=width, heads=heads, feed_forward=feed_forward, dropout=DROPOUT)
        for _ in range(count)
    )


def _sinusoids(length: int, width: int) -> Float[Tensor, "length width"]:
    """Positional encoding (Vaswani et al. 2017, section 3.5)."""
    place = torch.arange(length, dtype=torch.float64)[:, None]
    rate = torch.exp(torch.arange(0, width, 2, dtype=torch.float64) * (-math.log(1e4) / width))
    waves = torch.stack([(place * rate).sin(), (place * rate).cos()], dim=2)
    return waves.flatten(1).float()
