"""What is BeLFusion's own: which of the candidates of a row learn."""

import pytest
import torch
from tiny_networks import network_of

from models.pose import root_counts
from models.systems.belfusion import objective, recipes

RIGHT, OTHER = 4, 1


@torch.no_grad()
@pytest.mark.parametrize(("root_weight", "nearest"), [(0.0, RIGHT), (1_000.0, OTHER)])
def test_the_winner_in_motion_is_found_with_the_root_counting_as_told(root_weight, nearest):
    network = network_of(recipes.tiny())
    x_t = torch.randn(1, 6, 16)
    timestep, condition = torch.tensor([9]), network.denoiser.condition(torch.randn(1, 16))
    code = torch.randn(1, 16)
    x0 = network.denoiser(x_t, timestep[:, None], condition[:, None])
    motion = network.coupler.offsets(
        network.latent_range.inverse(x0), code[:, None].expand(-1, 6, -1)
    ).unflatten(2, (-1, 63))
    wanted = motion[:, RIGHT].clone()
    wanted[..., :3] = motion[:, OTHER, :, :3]
    counts = root_counts(wanted[0, 0], root_weight)
    near_latent, near_motion = objective._winners(
        network, x_t, (timestep, condition, code),
        (x0[:, RIGHT], wanted.flatten(1), counts.repeat(8)),
    )  # fmt: skip
    assert near_latent.tolist() == [RIGHT]
    assert near_motion.tolist() == [nearest]
