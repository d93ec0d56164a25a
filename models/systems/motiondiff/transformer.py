"""The Transformer layer that both forms are made of."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


class Layer(nn.Module):
    """A pre-norm Transformer layer over any set of tokens.

    Where a condition is given, its scales and shifts (FiLM) follow the two norms.
    """

    def __init__(self, *, width: int, heads: int, feed_forward: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.heads = heads
        self.num_conditions = 4 * width
        self.norms = nn.ModuleList(nn.LayerNorm(width, eps=1e-6) for _ in range(2))
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, feed_forward), nn.SiLU(), nn.Linear(feed_forward, width)
        )
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, x: Float[Tensor, "B S W"], condition: Float[Tensor, "B P"] | None = None
    ) -> Float[Tensor, "B S W"]:
        """The tokens after attention and feed-forward."""
        parts: Sequence[Tensor | float] = (0.0,) * 4
        if condition is not None:
            parts = condition[:, None].chunk(4, dim=-1)
        x = x + self.dropout(self._attended(self.norms[0](x) * (1 + parts[0]) + parts[1]))
        h = self.norms[1](x) * (1 + parts[2]) + parts[3]
        result: Tensor = x + self.dropout(self.feed_forward(h))
        return result

    def _attended(self, x: Float[Tensor, "B S W"]) -> Float[Tensor, "B S W"]:
        query, key, value = (
            part.unflatten(2, (self.heads, -1)).transpose(1, 2)
            for part in self.qkv(x).chunk(3, dim=-1)
        )
        seen = F.scaled_dot_product_attention(query, key, value)
        attended: Tensor = self.out(seen.transpose(1, 2).flatten(2))
        return attended
