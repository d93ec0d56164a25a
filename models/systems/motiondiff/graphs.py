"""The three graphs of a MotionDiff bundle: metres in, metres out."""

from jaxtyping import Float, Int
from torch import Tensor, nn

from models.system import Graph
from models.systems.motiondiff.objective import MotionDiff


class Encoder(nn.Module):
    """Observation to all that the steps need of it, once for a request."""

    def __init__(self, network: MotionDiff) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Float[Tensor, "B T J 3"]) -> tuple[Tensor, ...]:
        """The conditions of the denoiser."""
        features = self.network.representation.enter(observation, observation)
        return self.network.conditions(features)


class Denoiser(nn.Module):
    """One call of eps_theta, and the motion that is left once its noise is taken away."""

    def __init__(self, network: MotionDiff) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, x_t: Float[Tensor, "B M N 3"], timestep: Int[Tensor, "B"], *conditions: Tensor
    ) -> Float[Tensor, "B M N 3"]:
        """x0."""
        return self.network.x0(x_t, timestep, conditions)


class Decoder(nn.Module):
    """From x0 to poses; the refinement, where a recipe has one, comes between."""

    def __init__(self, network: MotionDiff, *, refines: bool) -> None:
        super().__init__()
        self.network = network
        self.refines = refines

    def forward(
        self, x0: Float[Tensor, "B M N 3"], observation: Float[Tensor, "B T J 3"]
    ) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        representation = self.network.representation
        features = representation.enter(observation, observation)
        future = self.network.motion.leave(features, x0)
        if self.refines:
            future = self.network.refined(features, future)
        return representation.leave(observation, future)


def graphs(network: MotionDiff, *, refines: bool = True) -> tuple[Graph, ...]:
    """Encoder, denoiser and decoder of a trained network."""
    conditions = network.encoder.conditions
    return (
        Graph(role="encoder", module=Encoder(network), inputs=("observation",), outputs=conditions),
        Graph(
            role="denoiser",
            module=Denoiser(network),
            inputs=("x_t", "timestep", *conditions),
            outputs=("x0",),
        ),
        Graph(
            role="decoder",
            module=Decoder(network, refines=refines),
            inputs=("x0", "observation"),
            outputs=("future",),
        ),
    )
