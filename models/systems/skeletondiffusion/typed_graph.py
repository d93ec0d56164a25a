"""Layers on the graph of a skeleton; nodes are the first axis: ``(N, B, C)``."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.systems.skeletondiffusion.noise import NodeGraph


class TypedLinear(nn.Module):
    """f^_j = W_type(j) x_j + b_type(j) (eq. 8); all types start with the same weights."""

    types: Tensor

    def __init__(self, graph: NodeGraph, inputs: int, outputs: int, *, bias: bool = True) -> None:
        super().__init__()
        weight = torch.empty(outputs, inputs)
        nn.init.kaiming_uniform_(weight, a=math.sqrt(5))
        self.weight = nn.Parameter(weight.T.repeat(graph.num_types, 1, 1))
        bound = 1 / math.sqrt(inputs)
        start = torch.empty(outputs).uniform_(-bound, bound).repeat(graph.num_types, 1, 1)
        self.bias = nn.Parameter(start) if bias else None
        self.register_buffer("types", torch.tensor(graph.types), persistent=False)

    def forward(self, x: Float[Tensor, "N B I"]) -> Float[Tensor, "N B O"]:
        """The features of each node by the weights of its type."""
        features = torch.bmm(x, self.weight[self.types])
        if self.bias is None:
            return features
        # As autocast computes: a sum of two precisions is slow, and so is all that follows from it.
        return features + self.bias[self.types].to(features.dtype)


class TypedGraphLinear(nn.Module):
    """f = G f^ (eq. 8): typed features gathered over a learnt graph, which starts as identity."""

    def __init__(self, graph: NodeGraph, inputs: int, outputs: int, *, bias: bool = True) -> None:
        super().__init__()
        self.features = TypedLinear(graph, inputs, outputs, bias=bias)
        self.mixing = nn.Parameter(torch.eye(graph.num_nodes))

    def forward(self, x: Float[Tensor, "N B I"]) -> Float[Tensor, "N B O"]:
        """The features of each node, gathered from all."""
        return mixed(row_normalised(self.mixing), self.features(x))


def row_normalised(mixing: Float[Tensor, "N N"]) -> Float[Tensor, "N N"]:
    """Rows divided by the sum of their absolute values; signs survive."""
    return mixing / mixing.abs().sum(dim=1, keepdim=True)


def mixed(mixing: Float[Tensor, "N N"], x: Float[Tensor, "N B C"]) -> Float[Tensor, "N B C"]:
    """G x."""
    # Plain numbers: what the exporter traces of a shape, a graph computes at every call.
    return torch.matmul(mixing, x.flatten(1)).reshape(len(mixing), -1, int(x.shape[2]))


class TypedGraphGRU(nn.Module):
    """A gated recurrent cell whose products are typed and gathered over the graph.

    With ``drifts`` the graph changes from tick to tick by a learnt sum, which starts as 0.
    """

    def __init__(self, graph: NodeGraph, inputs: int, hidden: int, *, drifts: bool = False) -> None:
        super().__init__()
        self.inputs = TypedLinear(graph, inputs, 3 * hidden)
        self.state = TypedLinear(graph, hidden, 3 * hidden)
        self.mixing = nn.Parameter(torch.eye(graph.num_nodes))
        self.drift = nn.Parameter(torch.zeros(graph.num_nodes, graph.num_nodes)) if drifts else None

    def mixings(self, num_ticks: int) -> list[Float[Tensor, "N N"]]:
        """G of each tick; it depends on no input, so that an exported graph holds a table."""
        mixing = row_normalised(self.mixing)
        table = [mixing]
        for _ in range(num_ticks - 1):
            mixing = mixing if self.drift is None else row_normalised(mixing + self.drift)
            table.append(mixing)
        return table

    def forward(
        self,
        inputs: Float[Tensor, "N B H3"],
        state: Float[Tensor, "N B H"],
        mixing: Float[Tensor, "N N"],
    ) -> Float[Tensor, "N B H"]:
        """The next state, from what ``self.inputs`` makes of the input."""
        width = int(state.shape[2])
        of_state = self.state(state)
        gates, new = torch.split(inputs, [2 * width, width], dim=2)
        gates_state, new_state = torch.split(of_state, [2 * width, width], dim=2)
        # The graph is linear: what is added anyway is gathered once.
        opened = torch.sigmoid(mixed(mixing, gates + gates_state))
        reset, update = torch.split(opened, width, dim=2)
        candidate = torch.tanh(mixed(mixing, new) + reset * mixed(mixing, new_state))
        return candidate + update * (state - candidate)


class TypedGraphAttention(nn.Module):
    """Multi-head self-attention of a row's nodes, with a residual (eqs. 50 and 51)."""

    def __init__(self, graph: NodeGraph, width: int, *, heads: int, head_width: int) -> None:
        super().__init__()
        self.heads, self.head_width = heads, head_width
        self.scale = nn.Parameter(torch.ones(width))
        self.queries_keys_values = nn.ModuleList(
            TypedGraphLinear(graph, width, heads * head_width, bias=False) for _ in range(3)
        )
        self.out = TypedGraphLinear(graph, heads * head_width, width)

    def forward(self, x: Float[Tensor, "N B C"]) -> Float[Tensor, "N B C"]:
        """x and what each node took from the others."""
        scale = self.scale.to(x.dtype)
        normed = x * (x.square().mean(dim=2, keepdim=True) + 1e-6).rsqrt() * scale
        nodes, shape = int(x.shape[0]), (self.heads, self.head_width)
        query, key, value = (
            part(normed).reshape(nodes, -1, *shape).permute(1, 2, 0, 3)
            for part in self.queries_keys_values
        )
        weights = torch.matmul(query, key.transpose(2, 3)) * self.head_width**-0.5
        attended = torch.matmul(weights.softmax(dim=3), value).permute(2, 0, 1, 3)
        result: Tensor = x + self.out(attended.reshape(nodes, -1, self.heads * self.head_width))
        return result


class ResidualBlock(nn.Module):
    """Two typed layers around a scale and shift told by the timestep."""

    def __init__(
        self,
        graph: NodeGraph,
        inputs: int,
        outputs: int,
        *,
        time: int,
        activation: Callable[[Tensor], Tensor],
    ) -> None:
        super().__init__()
        self.activation = activation
        self.enter = TypedGraphLinear(graph, inputs, outputs)
        self.film = nn.Linear(time, 2 * outputs)
        self.leave = TypedGraphLinear(graph, outputs, outputs)
        self.skip = (
            nn.Identity()
            if inputs == outputs
            else TypedGraphLinear(graph, inputs, outputs, bias=False)
        )

    def forward(
        self, x: Float[Tensor, "N B I"], time: Float[Tensor, "K E"], timestep: Int[Tensor, "B"]
    ) -> Float[Tensor, "N B O"]:
        """The block's features; the table over all K timesteps becomes a constant when exported."""
        scale, shift = self.film(torch.tanh(time)).chunk(2, dim=1)
        inner = self.activation(self.enter(x) * (scale + 1)[timestep] + shift[timestep])
        result: Tensor = self.skip(x) + self.activation(self.leave(inner))
        return result
