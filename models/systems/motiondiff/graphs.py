"""The three graphs of a MotionDiff bundle: metres in, metres out."""

from jaxtyping import Float, Int
from torch import Tensor, nn

from models.system import Graph
from models.systems.motiondiff.objective import MotionDiff


class Encoder(nn.Module):
    """Observation to all that steps and refinement need of it, once for a request."""

    clock: Tensor | None

    def __init__(self, network: MotionDiff, *, refines: bool) -> None:
        super().__init__()
        self.network = network
        self.refines = refines
        # What no observation changes is a constant of the graph, without the weights behind it.
        looks_ahead = refines and network.refiner.conditions
        clock = network.denoiser.last_clock().detach() if looks_ahead else None
        self.register_buffer("clock", clock)

    def forward(self, observation: Float[Tensor, "B T J 3"]) -> tuple[Tensor, ...]:
        """The conditions of the denoiser, and those of the refinement."""
        features = self.network.representation.enter(observation, observation)
        conditions = self.network.conditions(features)
        return conditions + (
            self.network.expectation(conditions, self.clock) if self.refines else ()
        )


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
        self,
        x0: Float[Tensor, "B M N 3"],
        observation: Float[Tensor, "B T J 3"],
        *expectation: Float[Tensor, "B M N 3"],
    ) -> Float[Tensor, "B H J 3"]:
        """Future poses in the world of the observation."""
        representation = self.network.representation
        features = representation.enter(observation, observation)
        future = self.network.motion.leave(features, x0)
        if self.refines:
            future = self.network.refined(features, future, *expectation)
        return representation.leave(observation, future)


def graphs(network: MotionDiff, *, refines: bool = True) -> tuple[Graph, ...]:
    """Encoder, denoiser and decoder of a trained network."""
    conditions = network.encoder.conditions
    refinement = network.refiner.conditions if refines else ()
    return (
        Graph(
            role="encoder",
            module=Encoder(network, refines=refines),
            inputs=("observation",),
            outputs=(*conditions, *refinement),
        ),
        Graph(
            role="denoiser",
            module=Denoiser(network),
            inputs=("x_t", "timestep", *conditions),
            outputs=("x0",),
        ),
        Graph(
            role="decoder",
            module=Decoder(network, refines=refines),
            inputs=("x0", "observation", *refinement),
            outputs=("future",),
        ),
    )
