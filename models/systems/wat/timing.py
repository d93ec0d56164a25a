"""When an action ends and where in its rhythm it is, as both forms of the decoder are told.

A timing is four numbers: logarithms of length and of frequency, cosine and sine of the phase at the
first frame. They are measured in the true future, drawn from the prior when there is none, and are
the last coordinates of z.
"""

import math
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from models.layers import in_lanes
from models.motion.skeleton import Skeleton
from models.pose import facing

NUM_TIMES = 4
LENGTH_UNIT, PERIOD_UNIT = 100.0, 30.0
"""Frames of a length, and of a period, whose logarithm is 0."""
SHORTEST_PERIOD, LONGEST_PERIOD = 15.0, 60.0
"""Frames of a stride: of a sprinter, and of somebody who strolls."""
NUM_FREQUENCIES = 150
STILL_M = 0.05
"""How far feet swing, root mean square, where a rhythm begins to count."""
NUM_RATES = 8
"""Sines and cosines of periods 4 to 512 steps tell age and time left."""
LEFT_AT_REST = -1.0
"""Steps left that stay as they are: all of standing still is alike."""

Gaussian: TypeAlias = tuple[Float[Tensor, "B Z"], Float[Tensor, "B Z"]]
"""Mean and log variance of z, whose last coordinates are a timing."""


class Clock(nn.Module):
    """Age, time left and rhythm of steps, as sines and cosines."""

    num_features = 4 * NUM_RATES + 5
    rates: Tensor

    def __init__(self, frames_per_step: int) -> None:
        super().__init__()
        self.frames_per_step = frames_per_step
        rates = torch.pi / 2 ** torch.arange(1, NUM_RATES + 1)
        self.register_buffer("rates", rates, persistent=False)

    def forward(
        self, age: Float[Tensor, "*B 1"], timing: Float[Tensor, "*#B 4"]
    ) -> Float[Tensor, "*B C"]:
        """Features of steps of an age; frequency and phase may be any numbers."""
        log_length, log_frequency, cos, sin = torch.split(timing, 1, dim=-1)
        left = LENGTH_UNIT / self.frames_per_step * log_length.exp() - age
        slowest, fastest = (math.log(PERIOD_UNIT / p) for p in (LONGEST_PERIOD, SHORTEST_PERIOD))
        log_frequency = log_frequency.clamp(slowest, fastest)
        turned = 2 * torch.pi * self.frames_per_step / PERIOD_UNIT * log_frequency.exp() * age
        angles = [age * self.rates, left.clamp(min=LEFT_AT_REST) * self.rates, turned]
        sizes = [2 * NUM_RATES, 1]
        all_angles = torch.cat(angles, dim=-1)
        sines, turned_sin = torch.split(in_lanes(torch.sin, all_angles), sizes, dim=-1)
        cosines, turned_cos = torch.split(in_lanes(torch.cos, all_angles), sizes, dim=-1)
        size = (cos.square() + sin.square()).add(1e-8).sqrt()
        cos, sin = cos / size, sin / size
        c, s = turned_cos * cos - turned_sin * sin, turned_sin * cos + turned_cos * sin
        beat = [c, s, c * c - s * s, 2 * c * s, log_frequency + 0.0 * age]
        return torch.cat([sines, cosines, *beat], dim=-1)


class Rhythm(nn.Module):
    """Finds the gait of motions: the one wave that fits best how far the left foot is ahead."""

    feet: Tensor
    frequencies: Tensor

    def __init__(self, skeleton: Skeleton) -> None:
        super().__init__()
        self._pairs = facing(skeleton)
        mirror = skeleton.mirror
        sides = [(j, mirror[j]) for j, side in enumerate(skeleton.sides) if side == "left"]
        self._sides = torch.tensor(sides)
        self.register_buffer("feet", self._sides[-1])
        frequencies = torch.linspace(1 / LONGEST_PERIOD, 1 / SHORTEST_PERIOD, NUM_FREQUENCIES)
        self.register_buffer("frequencies", frequencies, persistent=False)

    @torch.no_grad()
    def fit(self, poses: Float[Tensor, "B L J 3"]) -> None:
        """Take the lowest pair of joints for the feet."""
        heights = poses[:, :, self._sides.to(poses.device), 2].mean(dim=(0, 1, 3))
        self.feet.copy_(self._sides[heights.argmin()])

    def measure(
        self, poses: Float[Tensor, "B L J 3"], known: Bool[Tensor, "B L"]
    ) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B"]]:
        """Log frequency, cosine and sine of the phase at the first frame, and how sure they are.

        Least squares over the known frames, at every frequency of a grid; sure is from 0 to 1.
        """
        weight = known.float()
        ahead = self._ahead(poses)
        ahead = (ahead - (ahead * weight).sum(1, keepdim=True) / _count(weight)) * weight
        frame = torch.arange(poses.shape[1], device=poses.device)
        angles = 2 * torch.pi * frame[:, None] * self.frequencies  # (L, F)
        cos, sin = angles.cos(), angles.sin()
        cc, ss, cs = weight @ cos.square(), weight @ sin.square(), weight @ (cos * sin)
        along, across = ahead @ cos, ahead @ sin
        area = (cc * ss - cs.square()).clamp(min=1e-3)
        a, b = (ss * along - cs * across) / area, (cc * across - cs * along) / area
        explained, best = (a * along + b * across).max(dim=1)
        row = torch.arange(len(poses), device=poses.device)
        a, b = a[row, best], b[row, best]
        size = (a.square() + b.square()).add(1e-12).sqrt()
        total = ahead.square().sum(dim=1)
        moving = total / (total + STILL_M**2 * _count(weight)[:, 0])
        sure = (explained / total.clamp(min=1e-9)).clamp(0, 1) * moving
        log_frequency = (PERIOD_UNIT * self.frequencies[best]).log()
        return torch.stack([log_frequency, a / size, -b / size], dim=1), sure

    def _ahead(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B L"]:
        """Metres by which the left foot is before the right one, where the person faces."""
        left, right = ([pair[side] for pair in self._pairs] for side in (0, 1))
        across = (poses[:, :, left] - poses[:, :, right]).mean(dim=2)
        forward = torch.stack([across[..., 1], -across[..., 0]], dim=-1)
        forward = forward / forward.square().sum(dim=-1, keepdim=True).add(1e-8).sqrt()
        apart = poses[:, :, self.feet[0], :2] - poses[:, :, self.feet[1], :2]
        return (apart * forward).sum(dim=-1)


def _count(weight: Float[Tensor, "B L"]) -> Float[Tensor, "B 1"]:
    return weight.sum(dim=1, keepdim=True).clamp(min=1.0)
