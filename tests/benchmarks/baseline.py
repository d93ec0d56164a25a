"""What speed is measured against: the paper's sizes in PyTorch eager."""

from collections.abc import Callable

import torch
from torch import Tensor

from models.diffusion import ddim_step, timesteps
from models.system import Recipe


def paper_sized(recipe: Recipe, *, num_samples: int) -> Callable[[], Tensor]:
    """The recipe's whole loop in PyTorch eager: N rows in one call, decoded once at the end."""
    network = recipe.build().eval()
    encoder, denoiser, decoder = (graph.module for graph in recipe.graphs(network))
    data, schedule = recipe.data, recipe.schedule
    assert schedule is not None
    seen = torch.randn(1, data.num_observed, data.skeleton.num_joints, 3)

    @torch.no_grad()
    def sample() -> Tensor:
        condition, *others = encoder(seen)
        x = torch.randn(num_samples, *recipe.x_t_shape)
        rows = [value.expand(num_samples, *value.shape[1:]) for value in (condition, *others, seen)]
        x0 = x
        for t in timesteps(schedule.num_steps, schedule.num_steps):
            x0 = denoiser(x, torch.full((num_samples,), t), rows[0])
            x = ddim_step(
                x_t=x,
                x0=x0,
                alpha_bar=float(schedule.alpha_bar[t]),
                variance=float(schedule.variance[t, 0]),
                alpha_bar_next=float(schedule.alpha_bar[t - 1]) if t else 1.0,
                variance_next=float(schedule.variance[t - 1, 0]) if t else 0.0,
            )
        return decoder(x0, *rows[1:])

    return sample
