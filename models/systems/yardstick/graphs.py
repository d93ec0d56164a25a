"""The graphs of the yardstick: its one step hands the noise on, the decoder does the work."""

from jaxtyping import Float
from torch import Tensor, nn

from models.system import Graph
from models.systems.yardstick.networks import Yardstick


class Encoder(nn.Module):
    """The observation as the first layer has it, once for a request."""

    def __init__(self, network: Yardstick) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B D"]:
        """The context."""
        return self.network.context(self.network.representation.enter(observation, observation))


class Denoiser(nn.Module):
    """A diffusion of one step without signal: x_t is all noise, and so is what it hides."""

    def forward(self, x_t: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
        """x0."""
        return x_t * 1.0


class Decoder(nn.Module):
    """Noise and context to a future."""

    def __init__(self, network: Yardstick) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        x0: Float[Tensor, "B N"],
        context: Float[Tensor, "B D"],
        observation: Float[Tensor, "B T J 3"],
    ) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        representation = self.network.representation
        last = representation.enter(observation, observation[:, -1:])[:, 0]
        return representation.leave(observation, self.network.future(x0, context, last))


def graphs(network: Yardstick) -> tuple[Graph, ...]:
    """Encoder, denoiser and decoder of a trained network."""
    return (
        Graph(
            role="encoder", module=Encoder(network), inputs=("observation",), outputs=("context",)
        ),
        Graph(role="denoiser", module=Denoiser(), inputs=("x_t",), outputs=("x0",)),
        Graph(
            role="decoder",
            module=Decoder(network),
            inputs=("x0", "context", "observation"),
            outputs=("future",),
        ),
    )
