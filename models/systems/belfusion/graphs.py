"""The three graphs of a BeLFusion bundle: metres in, metres out."""

from jaxtyping import Float, Int
from torch import Tensor, nn

from models.system import Graph
from models.systems.belfusion.objective import BeLFusion


class Encoder(nn.Module):
    """Observation to all that the steps and the decoder need of it, once for a request."""

    def __init__(self, network: BeLFusion) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, observation: Float[Tensor, "B T J 3"]
    ) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B G"], Float[Tensor, "B H F"]]:
        """The denoiser's condition, the code of the target motion, and where that points."""
        features = self.network.representation.enter(observation, observation)
        condition = self.network.denoiser.condition(self.network.context(features))
        target, coupler = features[:, -self.network.num_target :], self.network.coupler
        return condition, coupler.encode_target(target), coupler.expected(target)


class Denoiser(nn.Module):
    """One call of f, its x0 kept within the range of the latents."""

    def __init__(self, network: BeLFusion) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        x_t: Float[Tensor, "B D"],
        timestep: Int[Tensor, "B"],
        condition: Float[Tensor, "B M"],
    ) -> Float[Tensor, "B D"]:
        """x0, the behaviour that the noise hides."""
        x0: Tensor = self.network.denoiser(x_t, timestep, condition)
        return x0.clamp(-1, 1)


class Decoder(nn.Module):
    """The behaviour coupler: the behaviour, performed from the observation on."""

    def __init__(self, network: BeLFusion) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        x0: Float[Tensor, "B D"],
        target_code: Float[Tensor, "B G"],
        expected: Float[Tensor, "B H F"],
        observation: Float[Tensor, "B T J 3"],
    ) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        coupler, representation = self.network.coupler, self.network.representation
        offsets = coupler.offsets(self.network.latent_range.inverse(x0), target_code)
        return representation.leave(observation, coupler.frames(offsets, expected))


def graphs(network: BeLFusion) -> tuple[Graph, ...]:
    """Encoder, denoiser and decoder of a trained network."""
    return (
        Graph(
            role="encoder",
            module=Encoder(network),
            inputs=("observation",),
            outputs=("condition", "target_code", "expected"),
        ),
        Graph(
            role="denoiser",
            module=Denoiser(network),
            inputs=("x_t", "timestep", "condition"),
            outputs=("x0",),
        ),
        Graph(
            role="decoder",
            module=Decoder(network),
            inputs=("x0", "target_code", "expected", "observation"),
            outputs=("future",),
        ),
    )
