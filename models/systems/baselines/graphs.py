"""Forecasts without learning: a decoder alone, from the observation."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.system import Graph


class ZeroVelocity(nn.Module):
    """The last observed pose, held."""

    def __init__(self, *, horizon: int) -> None:
        super().__init__()
        self.horizon = horizon

    def forward(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        return observation[:, -1:] + torch.zeros(1, self.horizon, 1, 1)


class ConstantVelocity(nn.Module):
    """The last observed pose, carried on at the root's mean velocity over the last frames.

    Joints keep their pose: extrapolating every joint by itself tears a body apart within
    half a second.
    """

    def __init__(self, *, horizon: int, num_frames: int) -> None:
        super().__init__()
        self.num_frames = num_frames
        steps = torch.arange(1, horizon + 1, dtype=torch.float32)
        self.register_buffer("steps", steps.reshape(1, -1, 1, 1), persistent=False)

    steps: Tensor

    def forward(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        root = observation[:, -1 - self.num_frames :, :1]
        velocity = (root[:, -1:] - root[:, :1]) / self.num_frames  # metres a frame
        return observation[:, -1:] + velocity * self.steps


def graphs(network: nn.Module) -> tuple[Graph, ...]:
    """The decoder."""
    return (Graph(role="decoder", module=network, inputs=("observation",), outputs=("future",)),)
