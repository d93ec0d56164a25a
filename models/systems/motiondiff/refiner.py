"""The refinements of both forms: graph convolutions over the coefficients of a motion."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.layers import Affine
from models.pose import continuation_basis, cosine_basis

STILL_M = 1e-3
INPUT_LIMIT = 8.0
SENSOR_NOISE_M = 0.008
NUM_FINE = 5


class GraphConvolution(nn.Module):
    """A X W + b over nodes whose adjacency A is learnt (Mao et al. 2019, Eq. 3)."""

    def __init__(self, narrow: int, wide: int, *, nodes: int, by_itself: bool = False) -> None:
        """``by_itself``: each node starts by looking at hardly any other."""
        super().__init__()
        self.weight = nn.Parameter(torch.empty(narrow, wide).uniform_(-1, 1) / wide**0.5)
        adjacency = torch.empty(nodes, nodes).uniform_(-1, 1) / nodes**0.5
        if by_itself:
            adjacency = torch.eye(nodes) + 0.1 * adjacency
        self.adjacency = nn.Parameter(adjacency)
        self.bias = nn.Parameter(torch.zeros(wide))

    def forward(self, x: Float[Tensor, "B N V"]) -> Float[Tensor, "B N W"]:
        """Features of every node from those of all nodes."""
        return torch.matmul(self.adjacency, torch.matmul(x, self.weight)) + self.bias


class _Residual(nn.Module):
    """LTD-GCN without its sum of input and output: convolutions, residual in twos."""

    def __init__(
        self,
        layer: Callable[[int, int], nn.Module],
        last: GraphConvolution,
        *,
        widths: tuple[int, int],
        blocks: int,
    ) -> None:
        super().__init__()
        narrow, hidden = widths
        self.first = layer(narrow, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(layer(hidden, hidden), layer(hidden, hidden)) for _ in range(blocks)
        )
        self.last = last
        nn.init.zeros_(last.weight)

    def forward(self, x: Float[Tensor, "B N V"]) -> Float[Tensor, "B N W"]:
        """At first zero."""
        h = self.first(x)
        for block in self.blocks:
            h = h + block(h)
        result: Tensor = self.last(h)
        return result


class Refiner(nn.Module):
    """eps_phi of the paper: a displacement, from the DCT of observation and future.

    Every coordinate of every joint is a node, its features the first coefficients of its
    trajectory through both.
    """

    conditions: tuple[str, ...] = ()
    basis: Tensor

    def __init__(
        self,
        *,
        features: int,
        num_observed: int,
        horizon: int,
        coefficients: int,
        hidden: int,
        blocks: int,
    ) -> None:
        super().__init__()
        self.num_observed = num_observed
        basis = cosine_basis(coefficients, num_observed + horizon)
        self.register_buffer("basis", basis, persistent=False)

        def layer(narrow: int, wide: int) -> nn.Module:
            return nn.Sequential(
                GraphConvolution(narrow, wide, nodes=features),
                nn.Flatten(1),
                nn.BatchNorm1d(features * wide),
                nn.Unflatten(1, (features, wide)),
                nn.Tanh(),
                nn.Dropout(0.5),
            )

        last = GraphConvolution(hidden, coefficients, nodes=features)
        self.network = _Residual(layer, last, widths=(coefficients, hidden), blocks=blocks)

    def forward(
        self, observation: Float[Tensor, "B T F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H F"]:
        """The displacement of every frame of the future."""
        motion = torch.cat([observation, future], dim=1)
        moved = self.network(torch.matmul(motion.transpose(1, 2), self.basis))
        return torch.matmul(self.basis[self.num_observed :], moved.transpose(1, 2))


class SpreadRefiner(nn.Module):
    """eps_phi of our form, which looks at how far a sample is from what is expected.

    Of that deviation it lets each coefficient grow, up to twice, or vanish. To all samples alike it
    adds what the noise of the observation asks for, as much as there is of it.
    """

    conditions = ("expectation",)
    basis: Tensor
    seen_basis: Tensor
    scale: Tensor
    average: Tensor

    def __init__(
        self,
        *,
        features: int,
        num_observed: int,
        horizon: int,
        coefficients: int,
        hidden: int,
        blocks: int,
    ) -> None:
        super().__init__()
        basis = continuation_basis(coefficients, horizon)
        self.register_buffer("basis", basis, persistent=False)
        seen_basis = cosine_basis(num_observed, num_observed)
        self.register_buffer("seen_basis", seen_basis, persistent=False)
        self.register_buffer("scale", torch.ones(features, coefficients))
        average = torch.full((1, features * NUM_FINE), 1 / (features * NUM_FINE))
        self.register_buffer("average", average, persistent=False)
        self.seen = Affine(features * (num_observed + 1))

        def convolution(narrow: int, wide: int) -> GraphConvolution:
            return GraphConvolution(narrow, wide, nodes=features, by_itself=True)

        def layer(narrow: int, wide: int) -> nn.Module:
            return nn.Sequential(convolution(narrow, wide), nn.LayerNorm(wide), nn.SiLU())

        def network(narrow: int, blocks: int) -> _Residual:
            last = convolution(hidden, coefficients)
            return _Residual(layer, last, widths=(narrow, hidden), blocks=blocks)

        self.gate = network(coefficients, blocks)
        self.mending = network(num_observed + 1, 0)

    def forward(
        self,
        observation: Float[Tensor, "B T F"],
        future: Float[Tensor, "B H F"],
        expected: Float[Tensor, "B H F"],
    ) -> Float[Tensor, "B H F"]:
        """The displacement of every frame of the future, zero at the last observed one."""
        deviation = self._deviation(future, expected)
        grown = deviation * torch.tanh(self.gate(deviation / self.scale))
        seen = self._seen(observation)
        scaled = self.seen(seen.flatten(1)).clamp(-INPUT_LIMIT, INPUT_LIMIT).view_as(seen)
        fine = seen[:, :, -NUM_FINE:].flatten(1)[:, :, None]
        # onnxruntime rounds the mean of a row by where in memory the row lies, a product never.
        noise = torch.matmul(self.average, fine.square()).sqrt()
        mended = noise / SENSOR_NOISE_M * self.mending(scaled) * self.scale
        return torch.matmul(self.basis, (grown + mended).transpose(1, 2))

    def _deviation(
        self, future: Float[Tensor, "B H F"], expected: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B F K"]:
        return torch.matmul((future - expected).transpose(1, 2), self.basis)

    def _seen(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B F T+1"]:
        """Of each coordinate the last position, and the spectrum of the way there."""
        last = observation[:, -1:]
        way = torch.matmul((observation - last).transpose(1, 2), self.seen_basis)
        return torch.cat([last.transpose(1, 2), way], dim=2)

    @torch.no_grad()
    def fit(
        self,
        observation: Float[Tensor, "B T F"],
        future: Float[Tensor, "B H F"],
        expected: Float[Tensor, "B H F"],
    ) -> None:
        """Set the units of all coefficients to their deviations over some motions."""
        self.scale.copy_(self._deviation(future, expected).std(dim=0).clamp(min=STILL_M))
        seen = self._seen(observation).flatten(1)
        self.seen.fit(seen.mean(dim=0), seen.std(dim=0).clamp(min=STILL_M))
