"""The Transformer form (Mao et al. 2022, Fig. 3b; supplement, Table 5)."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from models.systems.wat.timing import NUM_TIMES, Clock, Gaussian


class Layer(nn.Module):
    """A post-norm Transformer layer whose attention may see condition tokens too.

    Pseudo self-attention (Ziegler et al. 2019): linear maps of the condition stand before the
    sequence's own keys and values.
    """

    def __init__(self, *, width: int, heads: int, feed_forward: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.condition = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, feed_forward),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(feed_forward, width),
        )
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        x: Float[Tensor, "B S W"],
        may_see: Bool[Tensor, "#B #S K"],
        condition: Float[Tensor, "B C W"] | None = None,
    ) -> Float[Tensor, "B S W"]:
        """The sequence after attention and feed-forward."""
        query, key, value = self.qkv(x).chunk(3, dim=-1)
        if condition is not None:
            more_keys, more_values = self.condition(condition).chunk(2, dim=-1)
            key, value = torch.cat([more_keys, key], 1), torch.cat([more_values, value], 1)
        query, key, value = (
            part.unflatten(2, (self.heads, -1)).transpose(1, 2) for part in (query, key, value)
        )
        scores = torch.matmul(query, key.transpose(2, 3)) / math.sqrt(query.shape[-1])
        weights = scores.masked_fill(~may_see[:, None], -1e9).softmax(dim=-1)
        seen = torch.matmul(weights, value).transpose(1, 2).flatten(2)
        x = self.norms[0](x + self.dropout(self.out(seen)))
        result: Tensor = self.norms[1](x + self.dropout(self.feed_forward(x)))
        return result


class Stack(nn.Module):
    """Frames to tokens, several layers, and nothing else; a token holds several frames."""

    positions: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        *,
        patch: int,
        tokens: int,
        width: int,
        heads: int,
        feed_forward: int,
        layers: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.embed = nn.Linear(patch, width)
        self.layers = nn.ModuleList(
            Layer(width=width, heads=heads, feed_forward=feed_forward, dropout=dropout)
            for _ in range(layers)
        )
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("positions", _sinusoids(tokens, width), persistent=False)

    def tokens(self, patches: Float[Tensor, "B S P"]) -> Float[Tensor, "B S W"]:
        """The layers' input."""
        result: Tensor = self.dropout(self.embed(patches) + self.positions[: patches.shape[1]])
        return result

    def forward(
        self,
        tokens: Float[Tensor, "B S W"],
        may_see: Bool[Tensor, "#B #S K"],
        condition: Float[Tensor, "B C W"] | None = None,
    ) -> Float[Tensor, "B S W"]:
        """The sequence after all layers."""
        for layer in self.layers:
            tokens = layer(tokens, may_see, condition)
        return tokens


class TransformerVAE(nn.Module):
    """Encoders with a token for mean and one for variance; a decoder without recursion.

    A token holds ``frames_per_step`` frames. The decoder's input is the observation, padded with
    its last pose; it is all known beforehand, so one call gives every frame.
    """

    kept = ("observed_frames", "action_code")
    carried: tuple[str, ...] = ()
    may_see: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        *,
        features: int,
        num_actions: int,
        num_observed: int,
        horizon: int,
        width: int,
        heads: int,
        feed_forward: int,
        layers: int,
        frames_per_step: int,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.frames_per_step = frames_per_step
        self.num_observed = num_observed // frames_per_step
        patch, tokens = features * frames_per_step, (num_observed + horizon) // frames_per_step
        self.action = nn.Embedding(num_actions, width)
        self.prior_summary = nn.Embedding(num_actions, 2 * width)
        self.posterior_summary = nn.Embedding(num_actions, 2 * width)
        self.prior_stack, self.posterior_stack, self.decoder_stack = (
            Stack(
                patch=patch,
                tokens=tokens,
                width=width,
                heads=heads,
                feed_forward=feed_forward,
                layers=layers,
                dropout=dropout,
            )
            for _ in range(3)
        )
        self.timing = nn.Linear(width, 2 * NUM_TIMES)
        self.clock = Clock(frames_per_step)
        self.from_clock = nn.Linear(self.clock.num_features, width)
        self.output = nn.Linear(width, patch)
        nn.init.normal_(self.output.weight, std=1e-3)
        nn.init.zeros_(self.output.bias)
        seen = torch.ones(tokens, tokens, dtype=torch.bool).tril()
        seen[: self.num_observed, : self.num_observed] = True
        condition = torch.ones(tokens, 2, dtype=torch.bool)
        self.register_buffer("may_see", torch.cat([condition, seen], dim=1), persistent=False)

    def posterior(
        self,
        observed: Float[Tensor, "B T F"],
        future: Float[Tensor, "B L F"],
        num_frames: Int[Tensor, "B"],
        action: Int[Tensor, "B"],
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """Mean and log variance of z after the first ``num_frames`` frames of the future."""
        last = (num_frames - 1).div(self.frames_per_step, rounding_mode="floor")
        frames = torch.cat([observed, future], dim=1)
        index = torch.arange(2 + frames.shape[1] // self.frames_per_step, device=action.device)
        known = index[None] < (2 + self.num_observed + 1 + last)[:, None]
        return self._summarised(
            self.posterior_stack, self.posterior_summary(action), frames, known[:, None]
        )

    def begin(
        self, observed: Float[Tensor, "B T F"], action: Int[Tensor, "B"]
    ) -> tuple[Gaussian, tuple[Tensor, ...]]:
        """The prior of z, timing included, and what `advance` takes beside z: ``kept``."""
        everything = self.may_see[None, -1:, : 2 + self.num_observed]
        summary = self.prior_summary(action)
        mean, log_variance = self._summarised(self.prior_stack, summary, observed, everything)
        time, time_log_variance = self.timing(mean).chunk(2, dim=1)
        prior = torch.cat([mean, time], 1), torch.cat([log_variance, time_log_variance], 1)
        return prior, (observed, self.action(action))

    def advance(
        self,
        z: Float[Tensor, "B Z"],
        state: tuple[Tensor, ...],
        num_frames: int,
        told: object = None,
    ) -> tuple[Float[Tensor, "B L F"], tuple[Tensor, ...]]:
        """The first ``num_frames`` frames, all in one go; it cannot be told any of them."""
        del told
        observed, action = state
        last = observed[:, -1:]
        padded = torch.cat([observed, last.expand(-1, num_frames, -1)], dim=1)
        tokens = self.decoder_stack.tokens(self._patches(padded))
        count = num_frames // self.frames_per_step
        timing = z[:, None, -NUM_TIMES:].expand(-1, count, -1)
        age = torch.arange(count, device=z.device, dtype=z.dtype)[:, None]
        clock = self.from_clock(self.clock(age.expand_as(timing[..., :1]), timing))
        tokens = torch.cat([tokens[:, :-count], tokens[:, -count:] + clock], dim=1)
        may_see = self.may_see[None, : tokens.shape[1], : 2 + tokens.shape[1]]
        seen = self.decoder_stack(tokens, may_see, torch.stack([z[:, :-NUM_TIMES], action], dim=1))
        patches = self.output(seen[:, self.num_observed :])
        return patches.unflatten(2, (self.frames_per_step, -1)).flatten(1, 2) + last, ()

    def _summarised(
        self,
        stack: Stack,
        summary: Float[Tensor, "B S2"],
        frames: Float[Tensor, "B L F"],
        may_see: Bool[Tensor, "#B 1 K"],
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """What the two summary tokens say after seeing the frames."""
        pair = summary.unflatten(1, (2, -1))
        tokens = torch.cat([pair, stack.tokens(self._patches(frames))], dim=1)
        result = stack(tokens, may_see)
        return result[:, 0], result[:, 1]

    def _patches(self, frames: Float[Tensor, "B L F"]) -> Float[Tensor, "B S P"]:
        return frames.unflatten(1, (-1, self.frames_per_step)).flatten(2)


def _sinusoids(count: int, width: int) -> Float[Tensor, "count width"]:
    position = torch.arange(count)[:, None]
    rate = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000.0) / width))
    return torch.stack([(position * rate).sin(), (position * rate).cos()], dim=-1).flatten(1)
