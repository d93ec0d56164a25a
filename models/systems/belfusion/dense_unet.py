"""Our denoiser: a U-Net whose levels are widths of a vector, for a CPU."""

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F


class DenseBlock(nn.Module):
    """Residual block on a vector: norm, FiLM, SiLU, linear, SiLU, zero-initialised linear."""

    def __init__(self, narrow: int, wide: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(narrow, elementwise_affine=False)
        self.first = nn.Linear(narrow, wide)
        self.second = nn.Linear(wide, wide)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)
        self.skip = nn.Identity() if narrow == wide else nn.Linear(narrow, wide)

    def forward(
        self, x: Float[Tensor, "*B W"], scale: Float[Tensor, "*C W"], shift: Float[Tensor, "*C W"]
    ) -> Float[Tensor, "*B V"]:
        """Features of the next width."""
        h = F.silu(self.norm(x) * (1 + scale) + shift)
        return self.skip(x) + self.second(F.silu(self.first(h)))


class DenseUNet(nn.Module):
    """f(z_t, t, c): a conditional U-Net whose levels are widths of a vector.

    A latent vector has no neighbourhoods, so convolutions over an arbitrary reshaping of it buy
    nothing and cost most of the time. What remains of the U-Net are its levels, its skips and
    FiLM. ``film`` holds every block's scale and shift of the context and is computed once for a
    request; a table adds the timestep's.
    """

    def __init__(
        self, *, latent: int, context: int, widths: tuple[int, ...], num_steps: int
    ) -> None:
        super().__init__()
        self.stem = nn.Linear(latent, widths[0])
        rising = list(zip(widths[-2::-1], widths[:0:-1], strict=True))
        self.down = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.falling = nn.ModuleList(DenseBlock(width, width) for width in widths)
        self.middle = DenseBlock(widths[-1], widths[-1])
        self.rising = nn.ModuleList(DenseBlock(wide + low, wide) for wide, low in rising)
        self.norm = nn.LayerNorm(widths[0])
        self.head = nn.Linear(widths[0], latent)
        every = [*self.falling, self.middle, *self.rising]
        self.sizes = tuple(size for block in every for size in [block.first.in_features] * 2)
        self.context_film = nn.Linear(context, sum(self.sizes))
        self.timestep_film = nn.Embedding(num_steps, sum(self.sizes))
        nn.init.normal_(self.timestep_film.weight, std=0.1)

    def condition(self, context: Float[Tensor, "B C"]) -> Float[Tensor, "B M"]:
        """The context's share of every scale and shift, computed once for a request."""
        result: Tensor = self.context_film(F.silu(context))
        return result

    def forward(
        self, x_t: Float[Tensor, "*B D"], timestep: Int[Tensor, "*C"], film: Float[Tensor, "*C M"]
    ) -> Float[Tensor, "*B D"]:
        """x0."""
        parts = iter((film + self.timestep_film(timestep)).split(self.sizes, dim=-1))
        h = self.stem(x_t)
        skips = []
        for level, block in enumerate(self.falling):
            h = block(h, next(parts), next(parts))
            if level < len(self.down):
                skips.append(h)
                h = self.down[level](h)
        h = self.middle(h, next(parts), next(parts))
        for block in self.rising:
            h = block(torch.cat([skips.pop(), h], dim=-1), next(parts), next(parts))
        x0: Tensor = self.head(F.silu(self.norm(h)))
        return x0
