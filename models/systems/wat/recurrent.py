"""The recurrent form (Mao et al. 2022, Fig. 3a; supplement, Table 4)."""

from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from models.systems.wat.timing import NUM_TIMES, Clock, Gaussian


class TanhMLP(nn.Sequential):
    """Linear layers with tanh after each."""

    def __init__(self, *widths: int) -> None:
        layers: list[nn.Module] = []
        for narrow, wide in pairwise(widths):
            layers += [nn.Linear(narrow, wide), nn.Tanh()]
        super().__init__(*layers)


class Told(NamedTuple):
    """True frames that a decoder in training goes on from instead of its own, where ``here``."""

    future: Float[Tensor, "B L F"]
    here: Bool[Tensor, "B L"]


class RecurrentVAE(nn.Module):
    """Encoders and decoder of gated recurrent units; a unit sees ``frames_per_step`` frames."""

    kept = ("request",)
    """Tensors of `begin` that stay as they are while an action goes on."""
    carried = ("hidden", "latest_frame", "steps")
    """Tensors of `begin` that `advance` replaces."""

    def __init__(
        self,
        *,
        features: int,
        num_actions: int,
        latent: int,
        hidden: int,
        widths: tuple[int, int],
        frames_per_step: int,
    ) -> None:
        super().__init__()
        self.frames_per_step = frames_per_step
        self.latent, self.hidden = latent, hidden
        patch = features * frames_per_step
        self.action = nn.Embedding(num_actions, hidden)
        self.observed = nn.GRU(patch, hidden, batch_first=True)
        self.performed = nn.GRU(patch, hidden, batch_first=True)
        self.prior_network = nn.Sequential(
            TanhMLP(2 * hidden, *widths), nn.Linear(widths[-1], 2 * (latent + NUM_TIMES))
        )
        self.posterior_network = nn.Sequential(
            TanhMLP(3 * hidden, *widths), nn.Linear(widths[-1], 2 * latent)
        )
        self.clock = Clock(frames_per_step)
        self.from_clock = nn.Linear(self.clock.num_features, 3 * hidden, bias=False)
        self.first_hidden = TanhMLP(hidden, hidden)
        self.from_request = nn.Linear(2 * hidden + latent, 3 * hidden)
        self.from_frame = nn.Linear(features, 3 * hidden, bias=False)
        self.from_hidden = nn.Linear(hidden, 3 * hidden)
        self.output = nn.Sequential(TanhMLP(hidden, *widths), nn.Linear(widths[-1], patch))
        for parameter in self.output[-1].parameters():
            nn.init.normal_(parameter, std=1e-3)

    def posterior(
        self,
        observed: Float[Tensor, "B T F"],
        future: Float[Tensor, "B L F"],
        num_frames: Int[Tensor, "B"],
        action: Int[Tensor, "B"],
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """Mean and log variance of z after the first ``num_frames`` frames of the future."""
        states, _ = self.performed(self._patches(future))
        last = (num_frames - 1).div(self.frames_per_step, rounding_mode="floor")
        seen = states[torch.arange(len(states), device=states.device), last]
        joined = torch.cat([self._code(observed), seen, self.action(action)], dim=1)
        mean, log_variance = self.posterior_network(joined).chunk(2, dim=1)
        return mean, log_variance

    def begin(
        self, observed: Float[Tensor, "B T F"], action: Int[Tensor, "B"]
    ) -> tuple[Gaussian, tuple[Tensor, ...]]:
        """The prior of z, timing included, and what `advance` takes beside z.

        The latter are the tensors of ``kept``, then those of ``carried``.
        """
        code = self._code(observed)
        known = torch.cat([code, self.action(action)], dim=1)
        mean, log_variance = self.prior_network(known).chunk(2, dim=1)
        weight, bias = self.from_request.weight[:, : 2 * self.hidden], self.from_request.bias
        request = nn.functional.linear(known, weight, bias)
        state = (request, self.first_hidden(code), observed[:, -1], 0.0 * code[:, :1])
        return (mean, log_variance), state

    def advance(
        self,
        z: Float[Tensor, "B Z"],
        state: tuple[Tensor, ...],
        num_frames: int,
        told: Told | None = None,
    ) -> tuple[Float[Tensor, "B L F"], tuple[Tensor, ...]]:
        """The next frames, and the tensors of ``carried`` after them."""
        request, hidden, latest, steps = state
        size, width = self.frames_per_step, int(latest.shape[1])
        count = num_frames // size
        latent, timing = torch.split(z, [self.latent, NUM_TIMES], dim=1)
        fixed = request + nn.functional.linear(latent, self.from_request.weight[:, -self.latent :])
        # What does not hang on the frames before is computed for all steps at once.
        ages = steps + torch.arange(count, dtype=z.dtype, device=z.device)[:, None, None]
        given = fixed + self.from_clock(self.clock(ages, timing))  # (count, B, 3 H)
        deep, to_patch = self.output
        weight, bias = (parameter[-width:] for parameter in to_patch.parameters())
        before, thoughts = [], []
        for step, clock in enumerate(given.unbind()):
            before.append(latest)
            hidden = self._cell(clock + self.from_frame(latest), hidden)
            thoughts.append(deep(hidden))
            latest = latest + nn.functional.linear(thoughts[-1], weight, bias)
            if told is not None:
                last = (step + 1) * size - 1
                latest = torch.where(told.here[:, last, None], told.future[:, last], latest)
        changes = to_patch(torch.stack(thoughts, dim=1)).reshape(-1, count, size, width)
        frames = changes + torch.cat(before, dim=1).reshape(-1, count, 1, width)
        return frames.reshape(-1, num_frames, width), (hidden, latest, steps + count)

    def _cell(
        self, given: Float[Tensor, "B G"], hidden: Float[Tensor, "B H"]
    ) -> Float[Tensor, "B H"]:
        """A gated recurrent unit whose input was multiplied beforehand where it stays the same."""
        sizes = [2 * self.hidden, self.hidden]
        gates, new = torch.split(given, sizes, dim=1)
        own_gates, own_new = torch.split(self.from_hidden(hidden), sizes, dim=1)
        reset, update = torch.split(torch.sigmoid(gates + own_gates), self.hidden, dim=1)
        candidate = torch.tanh(new + reset * own_new)
        return candidate + update * (hidden - candidate)

    def _code(self, observed: Float[Tensor, "B T F"]) -> Float[Tensor, "B H"]:
        states, _ = self.observed(self._patches(observed))
        code: Tensor = states[:, -1]
        return code

    def _patches(self, frames: Float[Tensor, "B L F"]) -> Float[Tensor, "B S P"]:
        return frames.unflatten(1, (-1, self.frames_per_step)).flatten(2)
