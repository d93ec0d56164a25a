"""The paper's denoiser: a two-dimensional U-Net over the latent read as a 16 x 8 picture.

The pattern is that of Dhariwal and Nichol 2021; sizes and conditioning as in Barquero et al. 2023,
supplement, section B, and ``README.md`` of this folder.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

GROUPS = 32
HEAD_CHANNELS = 16


def sinusoid(timestep: Int[Tensor, "B"], width: int) -> Float[Tensor, "B W"]:
    """Cosines, then sines, of the timestep at geometric frequencies (Vaswani et al. 2017)."""
    half = width // 2
    exponent = torch.arange(half, device=timestep.device, dtype=torch.float32) / half
    angle = timestep[:, None].float() * torch.exp(-math.log(10000.0) * exponent)
    return torch.cat([angle.cos(), angle.sin()], dim=1)


class ResidualBlock(nn.Module):
    """Two convolutions with FiLM between them, resampling by a factor of 2 where asked."""

    def __init__(self, narrow: int, wide: int, embedding: int, resample: float = 1.0) -> None:
        super().__init__()
        self.resample = resample
        self.norm_in = nn.GroupNorm(GROUPS, narrow)
        self.conv_in = nn.Conv2d(narrow, wide, 3, padding=1)
        self.film = nn.Linear(embedding, 2 * wide)
        self.norm_out = nn.GroupNorm(GROUPS, wide)
        self.conv_out = nn.Conv2d(wide, wide, 3, padding=1)
        nn.init.zeros_(self.conv_out.weight)
        nn.init.zeros_(self.conv_out.bias)  # type: ignore[arg-type]  # torch's stub: there is one
        self.skip = nn.Identity() if narrow == wide else nn.Conv2d(narrow, wide, 1)

    def _resampled(self, x: Tensor) -> Tensor:
        if self.resample == 1.0:
            return x
        if self.resample > 1.0:
            return F.interpolate(x, scale_factor=2.0, mode="nearest")
        return F.avg_pool2d(x, 2)

    def forward(
        self, x: Float[Tensor, "B C Y X"], embedding: Float[Tensor, "B E"]
    ) -> Float[Tensor, "B D V U"]:
        """Features of the next level."""
        h = self.conv_in(self._resampled(F.silu(self.norm_in(x))))
        scale, shift = self.film(F.silu(embedding))[:, :, None, None].chunk(2, dim=1)
        h = self.conv_out(F.silu(self.norm_out(h) * (1 + scale) + shift))
        result: Tensor = self.skip(self._resampled(x)) + h
        return result


class SelfAttention(nn.Module):
    """Attention among the pixels, 16 channels a head, zero-initialised output."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.heads = channels // HEAD_CHANNELS
        self.norm = nn.GroupNorm(GROUPS, channels)
        self.joined = nn.Conv1d(channels, 3 * channels, 1)
        self.out = nn.Conv1d(channels, channels, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)  # type: ignore[arg-type]  # torch's stub: there is one

    def forward(
        self, x: Float[Tensor, "B C Y X"], embedding: Float[Tensor, "B E"]
    ) -> Float[Tensor, "B C Y X"]:
        """Features that have seen one another; the embedding has no part here."""
        del embedding
        joined = self.joined(self.norm(x).flatten(2)).unflatten(1, (self.heads, 3, HEAD_CHANNELS))
        query, key, value = joined.transpose(-1, -2).unbind(dim=2)  # (B, heads, pixels, 16)
        mixed = F.scaled_dot_product_attention(query, key, value)
        result: Tensor = x + self.out(mixed.transpose(-1, -2).flatten(1, 2)).unflatten(
            2, x.shape[2:]
        )
        return result


class PictureUNet(nn.Module):
    """f(z_t, t, c) of the paper; 12,657,121 parameters at its sizes."""

    def __init__(
        self,
        *,
        picture: tuple[int, int],
        context: int,
        base: int = 32,
        multipliers: tuple[int, ...] = (1, 2, 4, 8),
        attention_from: int = 2,
    ) -> None:
        super().__init__()
        self.picture = picture
        self.base = base
        self.time = nn.Sequential(
            nn.Linear(base, 4 * base), nn.SiLU(), nn.Linear(4 * base, 4 * base)
        )
        embedding = 4 * base + context
        self.stem = nn.Conv2d(1, base, 3, padding=1)
        self.falling, self.rising = nn.ModuleList(), nn.ModuleList()
        channels, skipped = base, [base]
        for level, multiplier in enumerate(multipliers):
            wide = base * multiplier
            attention = [SelfAttention(wide)] if level >= attention_from else []
            block = ResidualBlock(channels, wide, embedding)
            self.falling.append(nn.ModuleList([block, *attention]))
            channels = wide
            skipped.append(wide)
            if level < len(multipliers) - 1:
                down = ResidualBlock(wide, wide, embedding, 0.5)
                self.falling.append(nn.ModuleList([down]))
                skipped.append(wide)
        self.middle = nn.ModuleList(
            [
                ResidualBlock(channels, channels, embedding),
                SelfAttention(channels),
                ResidualBlock(channels, channels, embedding),
            ]
        )
        for level, multiplier in reversed(list(enumerate(multipliers))):
            wide = base * multiplier
            for last in (False, True):
                parts: list[nn.Module] = [ResidualBlock(channels + skipped.pop(), wide, embedding)]
                channels = wide
                if level >= attention_from:
                    parts.append(SelfAttention(wide))
                if last and level:
                    parts.append(ResidualBlock(wide, wide, embedding, 2.0))
                self.rising.append(nn.ModuleList(parts))
        self.norm = nn.GroupNorm(GROUPS, channels)
        self.head = nn.Conv2d(channels, 1, 3, padding=1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]  # torch's stub: there is one

    def condition(self, context: Float[Tensor, "B C"]) -> Float[Tensor, "B C"]:
        """What the steps take of the context: here the context itself."""
        return context

    def forward(
        self,
        x_t: Float[Tensor, "*B D"],
        timestep: Int[Tensor, "*C"],
        condition: Float[Tensor, "*C E"],
    ) -> Float[Tensor, "*B D"]:
        """x0; rows and candidates may stand in any leading axes."""
        leading = x_t.shape[:-1]
        rows = x_t.reshape(-1, 1, *self.picture)
        embedding = torch.cat(
            [
                self.time(sinusoid(timestep.expand(leading).flatten(), self.base)),
                condition.expand(*leading, -1).flatten(0, -2),
            ],
            dim=1,
        )
        h = self.stem(rows)
        skips = [h]
        for parts in self.falling:
            h = _through(parts, h, embedding)
            skips.append(h)
        h = _through(self.middle, h, embedding)
        for parts in self.rising:
            h = _through(parts, torch.cat([h, skips.pop()], dim=1), embedding)
        return self.head(F.silu(self.norm(h))).reshape(x_t.shape)


def _through(parts: nn.Module, h: Tensor, embedding: Tensor) -> Tensor:
    for part in parts.children():
        h = part(h, embedding)
    return h
