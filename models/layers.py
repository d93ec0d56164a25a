"""Blocks that several networks share, in torch."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

LANES = 8


def in_lanes(
    function: Callable[[Tensor], Tensor], values: Float[Tensor, "*B"]
) -> Float[Tensor, "*B"]:
    """A sine, say, that rounds alike for a row whatever its batch, in an exported graph too.

    onnxruntime's vector code and its code for what is left over round differently; of rows of
    eight, or twice as many, nothing is left over.
    """
    width = int(values.shape[-1])
    return function(nn.functional.pad(values, (0, -width % LANES)))[..., :width]


class MLP(nn.Sequential):
    """Linear layers of the given widths with SiLU between them."""

    def __init__(self, *widths: int) -> None:
        layers: list[nn.Module] = []
        for narrow, wide in pairwise(widths):
            layers += [nn.Linear(narrow, wide), nn.SiLU()]
        super().__init__(*layers[:-1])


class Affine(nn.Module):
    """Shift and scale per feature to a range set from data, kept in the checkpoint."""

    shift: Tensor
    scale: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("shift", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def fit(self, shift: Float[Tensor, "D"], scale: Float[Tensor, "D"]) -> None:
        """Set ``forward(x) = (x - shift) / scale``; scales near zero count as one."""
        self.shift.copy_(shift)
        self.scale.copy_(torch.where(scale > 1e-8, scale, torch.ones_like(scale)))

    def forward(self, x: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        """Features in the common range."""
        return (x - self.shift) / self.scale

    def inverse(self, x: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        """Features as they were."""
        return x * self.scale + self.shift


class _Reversal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(weight)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (weight,) = ctx.saved_tensors
        return -weight * gradients[0], None


def reverse_gradient(x: Float[Tensor, "B D"], weight: Float[Tensor, "B 1"]) -> Float[Tensor, "B D"]:
    """The same tensor, whose gradient arrives times -weight (Ganin and Lempitsky 2015)."""
    result: Tensor = _Reversal.apply(x, weight)
    return result
