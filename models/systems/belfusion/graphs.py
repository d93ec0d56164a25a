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
    ) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B G"]]:
        """The denoiser's condition and the code of the target motion."""
        features = self.network.representation.enter(observation, observation)
        condition = self.network.denoiser.condition(self.network.context(features))
        code = self.network.coupler.encode_target(features[:, -self.network.num_target :])
        return condition, code


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
        observation: Float[Tensor, "B T J 3"],
    ) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        coupler, representation = self.network.coupler, self.network.representation
        offsets = coupler.offsets(self.network.latent_range.inverse(x0), target_code)
        target = representation.enter(observation, observation[:, -self.network.num_target :])
        return representation.leave(observation, coupler.frames(offsets, target))


def graphs(network: BeLFusion) -> tuple[Graph, ...]:
    """Encoder, denoiser and decoder of a trained network."""
    return (
        Graph(
            role="encoder",
            module=Encoder(network),
            inputs=("observation",),
            outputs=("condition", "target_code"),
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
            inputs=("x0", "target_code", "observation"),
            outputs=("future",),
        ),
    )
