"""The refinement: graph convolutions over the DCT of a whole motion (Mao et al. 2019, LTD-GCN)."""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.layers import Affine
from models.pose import cosine_basis

STILL = 1e-3


class GraphConvolution(nn.Module):
    """A X W + b over nodes whose adjacency A is learnt (Mao et al. 2019, Eq. 3)."""

    def __init__(self, narrow: int, wide: int, *, nodes: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(narrow, wide).uniform_(-1, 1) / wide**0.5)
        self.adjacency = nn.Parameter(torch.empty(nodes, nodes).uniform_(-1, 1) / nodes**0.5)
        self.bias = nn.Parameter(torch.zeros(wide))

    def forward(self, x: Float[Tensor, "B N V"]) -> Float[Tensor, "B N W"]:
        """Features of every node from those of all nodes."""
        return torch.matmul(self.adjacency, torch.matmul(x, self.weight)) + self.bias


def batch_norm(nodes: int, width: int) -> nn.Module:
    """The paper's norm: every feature of every node over the batch."""
    return nn.Sequential(
        nn.Flatten(1), nn.BatchNorm1d(nodes * width), nn.Unflatten(1, (nodes, width))
    )


def layer_norm(nodes: int, width: int) -> nn.Module:
    """A norm that does not mix rows: each node's features among themselves."""
    del nodes
    return nn.LayerNorm(width)


class _Convolved(nn.Sequential):
    def __init__(
        self,
        narrow: int,
        wide: int,
        *,
        nodes: int,
        norm: Callable[[int, int], nn.Module],
        dropout: float,
    ) -> None:
        super().__init__(
            GraphConvolution(narrow, wide, nodes=nodes),
            norm(nodes, wide),
            nn.Tanh(),
            nn.Dropout(dropout),
        )


class Refiner(nn.Module):
    """eps_phi: a displacement of the future, from its DCT coefficients and the observation's.

    Every coordinate of every joint is a node, its features the first coefficients of its
    trajectory through observation and future. Their units are one until `fit`.
    """

    basis: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        *,
        features: int,
        num_observed: int,
        horizon: int,
        coefficients: int,
        hidden: int,
        blocks: int,
        norm: Callable[[int, int], nn.Module],
        dropout: float,
    ) -> None:
        super().__init__()
        self.num_observed = num_observed
        basis = cosine_basis(coefficients, num_observed + horizon)
        self.register_buffer("basis", basis, persistent=False)
        self.coefficients = Affine(features * coefficients)
        convolved = partial(_Convolved, nodes=features, norm=norm, dropout=dropout)
        self.first = convolved(coefficients, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(convolved(hidden, hidden), convolved(hidden, hidden))
            for _ in range(blocks)
        )
        self.last = GraphConvolution(hidden, coefficients, nodes=features)
        nn.init.zeros_(self.last.weight)

    def forward(
        self, observation: Float[Tensor, "B T F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H F"]:
        """The displacement of every frame of the future."""
        nodes = self._nodes(observation, future)
        h = self.first(self.coefficients(nodes.flatten(1)).view_as(nodes))
        for block in self.blocks:
            h = h + block(h)
        moved = self.last(h) * self.coefficients.scale.view_as(nodes[0])
        return torch.matmul(self.basis[self.num_observed :], moved.transpose(1, 2))

    def _nodes(
        self, observation: Float[Tensor, "B T F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B F C"]:
        motion = torch.cat([observation, future], dim=1)
        return torch.matmul(motion.transpose(1, 2), self.basis)

    @torch.no_grad()
    def fit(self, observation: Float[Tensor, "B T F"], future: Float[Tensor, "B H F"]) -> None:
        """Give every coefficient mean 0 and deviation 1 over some motions."""
        nodes = self._nodes(observation, future).flatten(1)
        self.coefficients.fit(nodes.mean(dim=0), nodes.std(dim=0).clamp(min=STILL))
