"""Networks that nobody has trained, for tests of what their parts compute."""

import torch
from torch import nn

from models.system import Recipe


def network_of(recipe: Recipe) -> nn.Module:
    """The recipe's network, with weights that no initialisation hides."""
    torch.manual_seed(0)  # noqa: TID251 - a test may fix the weights it makes
    network = recipe.build().eval()
    with torch.no_grad():
        for parameter in network.parameters():  # zero-initialised layers would hide errors
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return network
