"""What is BeLFusion's own: which of the candidates of a row learn."""

import pytest
import torch

from models.systems.belfusion import objective, recipes

RIGHT, OTHER = 4, 1


@pytest.fixture
def network():
    torch.manual_seed(0)  # noqa: TID251 - a test may fix the weights it makes
    network = recipes.tiny().build().eval()
    with torch.no_grad():
        for parameter in network.parameters():  # zero-initialised layers would hide errors
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return network


@torch.no_grad()
@pytest.mark.parametrize(("root_weight", "nearest"), [(0.0, RIGHT), (1_000.0, OTHER)])
def test_the_winner_in_motion_is_found_with_the_root_counting_as_told(
    network, root_weight, nearest
):
    x_t = torch.randn(1, 6, 16)
    timestep, condition = torch.tensor([9]), network.denoiser.condition(torch.randn(1, 16))
    code = torch.randn(1, 16)
    x0 = network.denoiser(x_t, timestep[:, None], condition[:, None])
    motion = network.coupler.offsets(
        network.latent_range.inverse(x0), code[:, None].expand(-1, 6, -1)
    ).unflatten(2, (-1, 63))
    wanted = motion[:, RIGHT].clone()
    wanted[..., :3] = motion[:, OTHER, :, :3]
    counts = torch.ones(63)
    counts[:3] = root_weight
    near_latent, near_motion = objective._winners(
        network, x_t, (timestep, condition, code),
        (x0[:, RIGHT], wanted.flatten(1), counts.repeat(8)),
    )  # fmt: skip
    assert near_latent.tolist() == [RIGHT]
    assert near_motion.tolist() == [nearest]
