"""The conditional autoencoder and the denoiser on the typed graph."""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from models.systems.skeletondiffusion.noise import NodeGraph
from models.systems.skeletondiffusion.typed_graph import (
    ResidualBlock,
    TypedGraphAttention,
    TypedGraphGRU,
    TypedGraphLinear,
)

Activation = Callable[[Tensor], Tensor]


class Encoder(nn.Module):
    """e: the last state of typed-graph GRUs over a sequence, as a latent within ``limit``.

    With ``shortcut_ticks`` a typed-graph layer over that many ticks at once stands beside the
    recurrence: what is linear in a motion need not be learnt through time.
    """

    layers: Any  # a list of typed-graph GRUs

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        graph: NodeGraph,
        *,
        inputs: int,
        hidden: int,
        latent: int,
        layers: int = 1,
        shortcut_ticks: int = 0,
        limit: float = 1.0,
    ) -> None:
        super().__init__()
        self.limit = limit
        self.shortcut_ticks = shortcut_ticks
        self.shortcut = (
            TypedGraphLinear(graph, inputs * shortcut_ticks, latent, bias=False)
            if shortcut_ticks
            else None
        )
        self.first = TypedGraphLinear(graph, inputs, hidden)
        widths = [inputs, *[hidden] * (layers - 1)]
        self.layers = nn.ModuleList(TypedGraphGRU(graph, width, hidden) for width in widths)
        self.latent = TypedGraphLinear(graph, hidden, latent)

    def forward(self, ticks: Float[Tensor, "N B K F"]) -> Float[Tensor, "N B L"]:
        """z = e(Y)."""
        first = self.first(ticks[:, :, 0])
        states = [first] * len(self.layers)
        mixings = [layer.mixings(1)[0] for layer in self.layers]
        for k in range(ticks.shape[2]):
            value = ticks[:, :, k]
            for i, layer in enumerate(self.layers):
                value = states[i] = layer(layer.inputs(value), states[i], mixings[i])
        z = self.latent(states[-1])
        if self.shortcut is not None:
            missing = self.shortcut_ticks - ticks.shape[2]
            z = z + self.shortcut(nn.functional.pad(ticks, (0, 0, 0, missing)).flatten(2))
        return torch.tanh(z / self.limit) * self.limit


class Decoder(nn.Module):
    """d: a typed-graph GRU whose graph drifts, started by z and the last poses.

    ``shortcut_ticks`` is as the `Encoder`'s: a layer that gives the outputs of all ticks at once.
    """

    def __init__(
        self,
        graph: NodeGraph,
        *,
        start: int,
        latent: int,
        hidden: int,
        outputs: int,
        shortcut_ticks: int = 0,
    ) -> None:
        super().__init__()
        self.shortcut = (
            TypedGraphLinear(graph, start + latent, outputs * shortcut_ticks, bias=False)
            if shortcut_ticks
            else None
        )
        self.first = TypedGraphLinear(graph, start + latent, hidden)
        self.cell = TypedGraphGRU(graph, start + latent, hidden, drifts=True)
        self.out = TypedGraphLinear(graph, hidden, outputs)

    def forward(
        self, z: Float[Tensor, "N B L"], start: Float[Tensor, "N B S"], num_ticks: int
    ) -> Float[Tensor, "N B K O"]:
        """The outputs of each tick."""
        given = torch.cat([start, z], dim=2)
        state, inputs = torch.tanh(self.first(given)), self.cell.inputs(given)
        states = []
        for mixing in self.cell.mixings(num_ticks):
            state = self.cell(inputs, state, mixing)
            states.append(state)
        by_tick: Tensor = self.out(torch.cat(states, dim=1))
        outputs = torch.stack(by_tick.chunk(num_ticks, dim=1), dim=2)
        if self.shortcut is None:
            return outputs
        straight = self.shortcut(given).unflatten(2, (-1, outputs.shape[3]))
        return outputs + straight[:, :, :num_ticks]


class PastNetwork(nn.Module):
    """What the denoiser knows of the past: typed layers over all observed frames of each node."""

    def __init__(
        self, graph: NodeGraph, *, inputs: int, width: int, activation: Activation
    ) -> None:
        super().__init__()
        self.activation = activation
        self.enter = TypedGraphLinear(graph, inputs, width)
        self.inner = nn.ModuleList(TypedGraphLinear(graph, width, width) for _ in range(2))
        self.leave = TypedGraphLinear(graph, width, width)

    def forward(self, observed: Float[Tensor, "N B T 3"]) -> Float[Tensor, "N B C"]:
        """Features of each node."""
        value = self.activation(self.enter(observed.flatten(2)))
        for layer in self.inner:
            value = value + self.activation(layer(value))
        result: Tensor = self.leave(value)
        return result


class Denoiser(nn.Module):
    """g: residual blocks and attention over the nodes; x0 from x_t, the past and the timestep.

    With ``joins_first`` the last block also sees what entered the first one, as the paper's does;
    without, only as far as the residual paths carry it.
    """

    steps: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        graph: NodeGraph,
        *,
        latent: int,
        past: int,
        width: int,
        depth: int,
        heads: int,
        head_width: int,
        time: int,
        num_steps: int,
        activation: Activation,
        joins_first: bool = True,
    ) -> None:
        super().__init__()
        self.joins_first = joins_first
        self.condition = TypedGraphLinear(graph, past, width, bias=False)
        self.enter = TypedGraphLinear(graph, latent, width)
        frequencies = torch.exp(-math.log(10_000) * torch.arange(width // 2) / (width // 2))
        angles = torch.arange(num_steps)[:, None] * frequencies
        self.register_buffer(
            "steps", torch.cat([angles.sin(), angles.cos()], dim=1), persistent=False
        )
        self.time = nn.Sequential(
            nn.Linear(2 * (width // 2), time), nn.GELU(), nn.Linear(time, time)
        )
        self.blocks = nn.ModuleList(
            ResidualBlock(graph, width, width, time=time, activation=activation)
            for _ in range(2 * depth)
        )
        self.attentions = nn.ModuleList(
            TypedGraphAttention(graph, width, heads=heads, head_width=head_width)
            for _ in range(2 * depth - 1)
        )
        self.last = ResidualBlock(
            graph, 2 * width if joins_first else width, width, time=time, activation=activation
        )
        self.leave = TypedGraphLinear(graph, width, latent)

    def forward(
        self,
        x_t: Float[Tensor, "N B L"],
        timestep: Int[Tensor, "B"],
        condition: Float[Tensor, "N B C"],
    ) -> Float[Tensor, "N B L"]:
        """x0, the latent that the noise hides.

        Args:
            x_t: noisy latents.
            timestep: of each row.
            condition: ``self.condition`` of the past's features.
        """
        time = self.time(self.steps)
        first = value = self.enter(x_t) + condition
        for block, attention in zip(self.blocks, [*self.attentions, nn.Identity()], strict=True):
            value = attention(block(value, time, timestep))
        joined = torch.cat([first, value], dim=2) if self.joins_first else value
        result: Tensor = self.leave(self.last(joined, time, timestep))
        return result
