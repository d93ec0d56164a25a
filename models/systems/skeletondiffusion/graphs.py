"""The three graphs of a SkeletonDiffusion bundle: metres in, metres out, rows first."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.system import Graph
from models.systems.skeletondiffusion.objective import SkeletonDiffusion


class EncoderGraph(nn.Module):
    """Observation to all that the steps and the decoder need of it, once for a request."""

    def __init__(self, network: SkeletonDiffusion) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, observation: Float[Tensor, "B T J 3"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, "B N S"]]:
        """The denoiser's condition, and what the decoder starts from."""
        condition = self.network.condition(observation)
        return condition.transpose(0, 1), self.network.nodes.start(observation).transpose(0, 1)


class DenoiserGraph(nn.Module):
    """One call of g between eigenbases."""

    def __init__(self, network: SkeletonDiffusion) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        x_t: Float[Tensor, "B N L"],
        timestep: Int[Tensor, "B"],
        condition: Float[Tensor, "B N C"],
    ) -> Float[Tensor, "B N L"]:
        """x0 in the eigenbasis, its latents kept in the encoder's range."""
        network = self.network
        nodes = network.from_eigenbasis(x_t.transpose(0, 1))
        x0 = network.denoiser(nodes, timestep, condition.transpose(0, 1))
        limit = network.encoder.limit / network.latent_scale
        kept = torch.minimum(torch.maximum(x0, -limit), limit)
        return network.to_eigenbasis(kept).transpose(0, 1)


class DecoderGraph(nn.Module):
    """d, and the way back into the world."""

    def __init__(self, network: SkeletonDiffusion) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        x0: Float[Tensor, "B N L"],
        start: Float[Tensor, "B N S"],
        observation: Float[Tensor, "B T J 3"],
    ) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        network = self.network
        z = network.from_eigenbasis(x0.transpose(0, 1))
        motion = network.motion(z, start.transpose(0, 1))
        return network.nodes.leave(observation, motion)


def graphs(network: SkeletonDiffusion) -> tuple[Graph, ...]:
    """Encoder, denoiser and decoder of a trained network."""
    return (
        Graph(
            role="encoder",
            module=EncoderGraph(network),
            inputs=("observation",),
            outputs=("condition", "start"),
        ),
        Graph(
            role="denoiser",
            module=DenoiserGraph(network),
            inputs=("x_t", "timestep", "condition"),
            outputs=("x0",),
        ),
        Graph(
            role="decoder",
            module=DecoderGraph(network),
            inputs=("x0", "start", "observation"),
            outputs=("future",),
        ),
    )
