"""The paper's recurrent parts (Barquero et al. 2023, supplement, section B)."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

LOG_VARIANCE_LIMIT = 10.0


class RecurrentBehaviourEncoder(nn.Module):
    """p(z | x_m, Y): an LSTM over x_m and the future, its last state through two heads."""

    def __init__(self, *, features: int, latent: int, hidden: int) -> None:
        super().__init__()
        self.recurrence = nn.LSTM(features, hidden, batch_first=True)
        self.heads = nn.Linear(hidden, 2 * latent)

    def forward(
        self, target: Float[Tensor, "B C F"], future: Float[Tensor, "B H F"]
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """Mean and log variance of the behaviour's posterior."""
        _, (state, _) = self.recurrence(torch.cat([target, future], dim=1))
        mean, log_variance = self.heads(state[-1]).chunk(2, dim=1)
        return mean, log_variance.clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)


class ConstantInputGRU(nn.Module):
    """A GRU that sees the same input at every step: the form of both of the paper's decoders."""

    def __init__(self, *, width: int, hidden: int, features: int, num_frames: int) -> None:
        super().__init__()
        self.num_frames = num_frames
        self.recurrence = nn.GRU(width, hidden, batch_first=True)
        self.head = nn.Linear(hidden, features)

    def forward(self, x: Float[Tensor, "B W"]) -> Float[Tensor, "B L F"]:
        """One output per frame."""
        states, _ = self.recurrence(x[:, None].expand(-1, self.num_frames, -1))
        result: Tensor = self.head(states)
        return result


class RecurrentCoupler(nn.Module):
    """B(z, g(x_m)): offsets from the last frame of x_m, not accumulated."""

    def __init__(
        self, *, features: int, num_target: int, horizon: int, latent: int, hidden: int
    ) -> None:
        super().__init__()
        self.num_target = num_target
        self.target_encoder = nn.Linear(num_target * features, hidden)
        # It also emits the frames of x_m, which nothing uses: the behaviour spans both.
        self.decoder = ConstantInputGRU(
            width=latent + hidden,
            hidden=hidden,
            features=features,
            num_frames=num_target + horizon,
        )

    def encode_target(self, target: Float[Tensor, "B C F"]) -> Float[Tensor, "B G"]:
        """g(x_m)."""
        code: Tensor = self.target_encoder(target.flatten(1))
        return code

    def offsets(
        self, z: Float[Tensor, "*B D"], code: Float[Tensor, "*B G"]
    ) -> Float[Tensor, "*B HF"]:
        """Offsets of the future, its frames and features in one axis."""
        joined = torch.cat([z, code], dim=-1)
        frames = self.decoder(joined.flatten(0, -2))[:, self.num_target :]
        return frames.reshape(*joined.shape[:-1], -1)

    def expected(self, target: Float[Tensor, "B C F"]) -> Float[Tensor, "B H F"]:
        """The last pose at every frame, from which the offsets count."""
        return target[:, -1:].expand(-1, self.decoder.num_frames - self.num_target, -1)

    def frames(
        self, offsets: Float[Tensor, "B HF"], expected: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H F"]:
        """The future frame by frame."""
        return expected + offsets.unflatten(1, (-1, expected.shape[2]))


class RecurrentObservationAutoencoder(nn.Module):
    """h: a GRU over the observation, and a decoder of increments that pre-trains it."""

    def __init__(
        self, *, features: int, num_observed: int, context: int, hidden: tuple[int, ...]
    ) -> None:
        super().__init__()
        self.num_observed = num_observed
        self.recurrence = nn.GRU(features, context, batch_first=True)
        self.initial = _tanh_mlp(context, *hidden, context)
        self.cell = nn.GRUCell(context + features, context)
        self.head = _tanh_mlp(context, *hidden, features)

    def encode(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B C"]:
        """The context c = h(X)."""
        _, state = self.recurrence(observation)
        last: Tensor = state[-1]
        return last

    def forward(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B T F"]:
        """The observation, rebuilt from its context and its first frame by increments."""
        context = self.encode(observation)
        state, pose = self.initial(context), observation[:, 0]
        poses = [pose]
        for _ in range(self.num_observed - 1):
            state = self.cell(torch.cat([context, pose], dim=1), state)
            pose = pose + self.head(state)
            poses.append(pose)
        return torch.stack(poses, dim=1)


def _tanh_mlp(*widths: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for narrow, wide in pairwise(widths):
        layers += [nn.Linear(narrow, wide), nn.Tanh()]
    return nn.Sequential(*layers[:-1])
