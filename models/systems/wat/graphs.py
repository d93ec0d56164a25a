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

    ``spread`` times the prior's deviation is that of z, timing apart.
    """

    def __init__(self, network: WAT, *, spread: float) -> None:
        super().__init__()
        self.network = network
        self.spread = spread

    def forward(
        self, observation: Float[Tensor, "B T J 3"], action: Int[Tensor, "B"]
    ) -> tuple[Tensor, ...]:
        """The prior of z, the bones, where the person stands, and the form's own tensors."""
        observed, bones = self.network.poses.enter_observation(observation)
        (mean, log_variance), own = self.network.begin(observed, action)
        beginning = 1.0 + 0.0 * mean[:, :1]  # ones_like would fix the batch's size
        ground = 0.0 * bones[:, 0]  # heading, x, y
        deviation = (0.5 * log_variance).exp()
        narrowed = self.spread * deviation[:, :-NUM_TIMES]
        deviation = torch.cat([narrowed, deviation[:, -NUM_TIMES:]], dim=1)
        return mean, deviation, bones, observed[:, -3:], beginning, ground, *own


class Decoder(nn.Module):
    """The next chunk of frames."""

    def __init__(self, network: WAT, *, chunk_frames: int, horizon: int) -> None:
        super().__init__()
        self.network = network
        self.chunk_frames = chunk_frames
        self.longest = math.log((horizon - FRAMES_AT_REST) / LENGTH_UNIT)

    def forward(  # noqa: PLR0913 - the tensors of the graph
        self,
        noise: Float[Tensor, "B Z"],
        observation: Float[Tensor, "B T J 3"],
        mean: Float[Tensor, "B Z"],
        deviation: Float[Tensor, "B Z"],
        bones: Float[Tensor, "B J 3"],
        latest_observed: Float[Tensor, "B 3 F"],
        beginning: Float[Tensor, "B 1"],
        ground: Float[Tensor, "B 3"],
        *own: Tensor,
    ) -> tuple[Tensor, ...]:
        """Poses in the world of the observation, and the tensors that the next chunk takes."""
        z = mean + deviation * noise
        length = z[:, -NUM_TIMES, None].clamp(max=self.longest)
        z = torch.cat([z[:, :-NUM_TIMES], length, z[:, 1 - NUM_TIMES :]], dim=1)
        features, carried = self.network.form.advance(z, own, self.chunk_frames)
        features = self.network.joined(features, latest_observed, beginning)
        future, ground = self.network.poses.leave(observation, features, bones, ground)
        earliest_end = LENGTH_UNIT * length.exp()
        return future, earliest_end, 0.0 * beginning, ground, *carried


def graphs(network: WAT, *, chunk_frames: int, horizon: int, spread: float) -> tuple[Graph, ...]:
    """Encoder and decoder of a trained network."""
    kept, carried = network.form.kept, network.form.carried
    given = ("mean", "deviation", "bones", "latest_observed", "beginning", "ground")
    return (
        Graph(
            role="encoder",
            module=Encoder(network, spread=spread),
            inputs=("observation", "action"),
            outputs=(*given, *kept, *carried),
        ),
        Graph(
            role="decoder",
            module=Decoder(network, chunk_frames=chunk_frames, horizon=horizon),
            inputs=("noise", "observation", *given, *kept, *carried),
            outputs=(
                "future",
                "earliest_end",
                "next_beginning",
                "next_ground",
                *(f"next_{name}" for name in carried),
            ),
        ),
    )
