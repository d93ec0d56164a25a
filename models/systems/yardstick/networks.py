"""The yardstick: a plain network from an observation and a vector of noise to a future."""

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from models.layers import MLP
from models.losses import motion_distance
from models.pose import WorldPoses, cosine_basis, posture_and_steps
from models.system import Batch, Data, Losses


class Yardstick(nn.Module):
    """A feed-forward network from what was observed and noise to the future's cosine spectrum.

    Args:
        data: the windows.
        noise: width of the noise.
        hidden: width of the layers.
        bases: cosines of the offset from the last observed pose.
    """

    basis: Tensor

    def __init__(self, data: Data, *, noise: int, hidden: int, bases: int) -> None:
        super().__init__()
        self.representation = WorldPoses(data.skeleton, root_weight=1.0)
        features = self.representation.num_features
        self.shape = (bases, features)
        self.register_buffer("basis", cosine_basis(bases, data.horizon), persistent=False)
        self.enter = nn.Linear(data.num_observed * features, hidden)
        self.add_noise = nn.Linear(noise, hidden, bias=False)
        self.network = MLP(hidden, hidden, hidden, bases * features)

    def context(self, observed: Float[Tensor, "B T F"]) -> Float[Tensor, "B D"]:
        """What the first layer makes of the last pose and the steps that led to it."""
        context: Tensor = self.enter(posture_and_steps(observed))
        return context

    def future(
        self,
        noise: Float[Tensor, "*B N"],
        context: Float[Tensor, "*#B D"],
        last: Float[Tensor, "*#B F"],
    ) -> Float[Tensor, "*B H F"]:
        """Features of the future, which leave from those of the last pose."""
        hidden = nn.functional.silu(context + self.add_noise(noise))
        spectrum = self.network(hidden).unflatten(-1, self.shape)
        return last[..., None, :] + torch.matmul(self.basis, spectrum)


def best_of_many_loss(
    network: Yardstick, batch: Batch, generator: Generator, *, num_candidates: int
) -> Losses:
    """The distance of the nearest of several futures (Guzman-Rivera et al. 2012).

    All are judged without gradients and in bfloat16; the nearest is run again.
    """
    observation, future = batch["observation"], batch["future"]
    enter = network.representation.enter
    wanted, last = enter(observation, future), enter(observation, observation[:, -1:])[:, 0]
    rows, device = len(future), future.device
    width = network.add_noise.in_features
    noise = torch.randn((rows, num_candidates, width), generator=generator, device=device)
    context = network.context(enter(batch["seen"], batch["seen"]))
    with torch.no_grad(), torch.autocast(device.type, dtype=torch.bfloat16):
        tried = network.future(noise, context[:, None], last[:, None])
        nearest = motion_distance(tried - wanted[:, None]).argmin(dim=1)
    chosen = noise[torch.arange(rows, device=device), nearest]
    return {"total": motion_distance(network.future(chosen, context, last) - wanted).mean()}
