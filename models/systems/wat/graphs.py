"""The two graphs of a WAT bundle: an action begins, and goes on chunk by chunk."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.system import Graph
from models.systems.wat.objective import WAT
from models.systems.wat.timing import LENGTH_UNIT, NUM_TIMES

FRAMES_AT_REST = 20
"""Before the longest that an action may take; one that is drawn longer ends as they begin."""


class Encoder(nn.Module):
    """All that the chunks of an action need of observation and label.

    So many times the prior's deviation is z's: the first of the ``spreads``, the second for the
    length, 1 for frequency and phase.
    """

    factors: Tensor

    def __init__(self, network: WAT, *, size_of_z: int, spreads: tuple[float, float]) -> None:
        super().__init__()
        self.network = network
        factors = torch.full((size_of_z,), spreads[0])
        factors[-NUM_TIMES] = spreads[1]
        factors[-NUM_TIMES + 1 :] = 1.0
        self.register_buffer("factors", factors)

    def forward(
        self, observation: Float[Tensor, "B T J 3"], action: Int[Tensor, "B"]
    ) -> tuple[Tensor, ...]:
        """The prior of z, the person's body, place and heading, and the form's own tensors."""
        poses = self.network.poses
        observed, bones = poses.enter_observation(observation)
        origin, ground = poses.standing(observation)
        (mean, log_variance), own = self.network.begin(observed, action)
        beginning = 1.0 + 0.0 * mean[:, :1]  # ones_like would fix the batch's size
        deviation = self.factors * (0.5 * log_variance).exp()
        arms, bound_for = poses.articulation.arms(bones), self.network.bound_for(observed)
        return mean, deviation, arms, bound_for, origin, beginning, ground, *own


class Decoder(nn.Module):
    """The next chunk of frames."""

    most: Tensor

    def __init__(self, network: WAT, *, size_of_z: int, chunk_frames: int, horizon: int) -> None:
        super().__init__()
        self.network = network
        self.chunk_frames = chunk_frames
        most = torch.full((size_of_z,), math.inf)
        most[-NUM_TIMES] = math.log((horizon - FRAMES_AT_REST) / LENGTH_UNIT)
        self.register_buffer("most", most)

    def forward(  # noqa: PLR0913 - the tensors of the graph
        self,
        noise: Float[Tensor, "B Z"],
        mean: Float[Tensor, "B Z"],
        deviation: Float[Tensor, "B Z"],
        arms: Float[Tensor, "B J A"],
        bound_for: Float[Tensor, "B 2 F"],
        origin: Float[Tensor, "B 3"],
        beginning: Float[Tensor, "B 1"],
        ground: Float[Tensor, "B 4"],
        *own: Tensor,
    ) -> tuple[Tensor, ...]:
        """Poses in the world of the observation, and the tensors that the next chunk takes."""
        z = torch.minimum(mean + deviation * noise, self.most)
        features, carried = self.network.form.advance(z, own, self.chunk_frames)
        features = self.network.joined(features, bound_for, beginning)
        future, ground = self.network.poses.leave(features, arms, origin, ground)
        earliest_end = LENGTH_UNIT * z[:, -NUM_TIMES : 1 - NUM_TIMES].exp()
        return future, earliest_end, 0.0 * beginning, ground, *carried


def graphs(
    network: WAT,
    *,
    size_of_z: int,
    chunk_frames: int,
    horizon: int,
    spreads: tuple[float, float],
) -> tuple[Graph, ...]:
    """Encoder and decoder of a trained network."""
    kept, carried = network.form.kept, network.form.carried
    given = ("mean", "deviation", "arms", "bound_for", "origin", "beginning", "ground")
    return (
        Graph(
            role="encoder",
            module=Encoder(network, size_of_z=size_of_z, spreads=spreads),
            inputs=("observation", "action"),
            outputs=(*given, *kept, *carried),
        ),
        Graph(
            role="decoder",
            module=Decoder(
                network, size_of_z=size_of_z, chunk_frames=chunk_frames, horizon=horizon
            ),
            inputs=("noise", *given, *kept, *carried),
            outputs=(
                "future",
                "earliest_end",
                "next_beginning",
                "next_ground",
                *(f"next_{name}" for name in carried),
            ),
        ),
    )
