"""Our parts, sized for a CPU server: the future as a few keyframes, joints as whole trajectories.

Features are ``(B, L, F)``: poses in a representation of `models.pose`, F = 3 J.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from models.continuation import Continuation
from models.layers import Affine
from models.pose import continuation_basis, cosine_basis
from models.systems.motiondiff.transformer import Layer

INPUT_LIMIT = 8.0
LATENT_DEVIATION = 2.0
STILL_M = 1e-4


class Keyframes(nn.Module):
    """x0: what sets M frames, evenly spread, apart from where the observation points.

    Between them the motion is the smoothest that passes through them: a turn within the sines
    that are zero at the last observed frame, so whatever x0, position and velocity go on.
    """

    turn: Tensor
    scale: Tensor

    def __init__(self, *, features: int, num_target: int, horizon: int, num_frames: int) -> None:
        super().__init__()
        self.num_target = num_target
        self.shape = (num_frames, features // 3, 3)
        self.continuation = Continuation(
            features=features, num_target=num_target, horizon=horizon, bases=num_frames
        )
        turn = continuation_basis(num_frames, num_frames)
        self.register_buffer("turn", turn, persistent=False)
        self.register_buffer("scale", torch.ones(num_frames, features))

    def enter(
        self, observation: Float[Tensor, "B T F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B M J 3"]:
        """x0 of a future."""
        spectrum = self.continuation.spectrum(observation[:, -self.num_target :], future)
        frames = torch.matmul(self.turn, spectrum.unflatten(1, (self.shape[0], -1)))
        return (frames / self.scale).unflatten(2, (-1, 3))

    def leave(
        self, observation: Float[Tensor, "B T F"], x0: Float[Tensor, "B M J 3"]
    ) -> Float[Tensor, "B H F"]:
        """The future of an x0."""
        spectrum = torch.matmul(self.turn.T, x0.flatten(2) * self.scale)
        expected = self.continuation.expected(observation[:, -self.num_target :])
        return self.continuation.frames(spectrum.flatten(1), expected)

    @torch.no_grad()
    def fit(
        self,
        observation: Float[Tensor, "B T F"],
        future: Float[Tensor, "B H F"],
        *,
        noise_m: float,
        whitening: float,
    ) -> Float[Tensor, "M J 3"]:
        """Set the expectation and the scales; return the variances of x0.

        The direction in which x0 varies most gets the deviation 2, so that hardly any of it shows
        through the noise of the last timestep, from which sampling starts without it.
        """
        self.continuation.fit(observation[:, -self.num_target :], future, noise_m=noise_m)
        self.scale.fill_(1.0)
        deviation = self.enter(observation, future).flatten(2).std(dim=0).clamp(min=STILL_M)
        self.scale.copy_(deviation**whitening)
        x0 = self.enter(observation, future).flatten(1)
        widest = torch.linalg.eigvalsh(torch.cov(x0.T.double()))[-1].sqrt().to(x0)
        self.scale.mul_(widest / LATENT_DEVIATION)
        return self.enter(observation, future).var(dim=0)


class Encoder(nn.Module):
    """f_psi: the state embedding, and a token for the trajectory that each joint was seen on."""

    conditions = ("condition", "joints")
    basis: Tensor

    def __init__(
        self,
        *,
        features: int,
        num_observed: int,
        width: int,
        layers: int,
        state: int,
        context: int,
    ) -> None:
        super().__init__()
        num_joints = features // 3
        self.register_buffer("basis", cosine_basis(num_observed, num_observed), persistent=False)
        self.trajectories = Affine((num_observed + 1) * features)
        self.frames = Affine(2 * features)
        self.embed = nn.Linear(3 * (num_observed + 1), width)
        self.joint = nn.Parameter(0.02 * torch.randn(num_joints, width))
        self.spatial = nn.ModuleList(
            Layer(width=width, heads=4, feed_forward=2 * width) for _ in range(layers)
        )
        self.recurrence = nn.GRU(2 * features, state, batch_first=True)
        self.context = nn.Sequential(
            nn.Linear(state + num_joints * width, context), nn.SiLU(), nn.Linear(context, context)
        )

    def spectra(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B N"]:
        """The last pose, and the coefficients of the differences from it."""
        last = observation[:, -1:]
        coefficients = torch.matmul(self.basis.T, observation - last)
        return torch.cat([last, coefficients], dim=1).flatten(1)

    def steps(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B T G"]:
        """Every frame beside its difference from the one before."""
        before = torch.cat([observation[:, :1], observation[:, :-1]], dim=1)
        return torch.cat([observation, observation - before], dim=2)

    def forward(
        self, observation: Float[Tensor, "B T F"]
    ) -> tuple[Float[Tensor, "B C"], Float[Tensor, "B J W"]]:
        """The context and the joints' tokens."""
        scaled = _limited(self.trajectories(self.spectra(observation)))
        joints = scaled.unflatten(1, (-1, len(self.joint), 3)).transpose(1, 2).flatten(2)
        tokens = self.embed(joints) + self.joint
        for layer in self.spatial:
            tokens = layer(tokens)
        _, state = self.recurrence(_limited(self.frames(self.steps(observation))))
        context: Tensor = self.context(torch.cat([state[0], tokens.flatten(1)], dim=1))
        return context, tokens

    @torch.no_grad()
    def fit(self, observation: Float[Tensor, "B T F"]) -> None:
        """Give every input mean 0 and deviation 1 over some observations."""
        spectra, steps = self.spectra(observation), self.steps(observation).flatten(0, 1)
        self.trajectories.fit(spectra.mean(dim=0), spectra.std(dim=0))
        self.frames.fit(steps.mean(dim=0), steps.std(dim=0))


def _limited(values: Tensor) -> Tensor:
    return values.clamp(-INPUT_LIMIT, INPUT_LIMIT)


class Denoiser(nn.Module):
    """eps_theta: a Transformer over the joints' trajectories, then one over the keyframes.

    Of eps, what x_t tells by itself is known from the variance of x0; the network adds the rest,
    in units of its deviation.
    """

    alpha_bar: Tensor
    variance: Tensor
    clock: Tensor

    def __init__(  # noqa: PLR0913 - the sizes of the network
        self,
        *,
        shape: tuple[int, int, int],
        alpha_bar: Float[Tensor, "K"],
        context: int,
        spatial_width: int,
        spatial_layers: int,
        temporal_width: int,
        temporal_layers: int,
        per_joint: int = 4,
    ) -> None:
        super().__init__()
        num_frames, num_joints, _ = shape
        self.shape, self.per_joint = shape, per_joint
        self.register_buffer("alpha_bar", alpha_bar.float(), persistent=False)
        self.register_buffer("variance", torch.ones(shape))
        self.register_buffer("clock", _clock(alpha_bar), persistent=False)
        self.joints = nn.Linear(3 * num_frames, spatial_width)
        self.spatial = nn.ModuleList(
            Layer(width=spatial_width, heads=4, feed_forward=2 * spatial_width)
            for _ in range(spatial_layers)
        )
        self.spread = nn.Linear(spatial_width, per_joint * num_frames)
        self.frames = nn.Linear((3 + per_joint) * num_joints, temporal_width)
        self.frame = nn.Parameter(0.02 * torch.randn(num_frames, temporal_width))
        self.temporal = nn.ModuleList(
            Layer(width=temporal_width, heads=4, feed_forward=2 * temporal_width)
            for _ in range(temporal_layers)
        )
        self.norm = nn.LayerNorm(temporal_width, eps=1e-6)
        self.head = nn.Linear(temporal_width, 3 * num_joints)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.sizes = [layer.num_conditions for layer in (*self.spatial, *self.temporal)]
        self.from_context = nn.Linear(context, sum(self.sizes))
        self.from_clock = nn.Sequential(
            nn.Linear(self.clock.shape[1], 128), nn.SiLU(), nn.Linear(128, sum(self.sizes))
        )

    def condition(self, context: Float[Tensor, "B C"]) -> Float[Tensor, "B P"]:
        """The context's share of every scale and shift, computed once for a request."""
        result: Tensor = self.from_context(F.silu(context))
        return result

    def total_variance(self, timestep: Int[Tensor, "B"]) -> Float[Tensor, "B M J 3"]:
        """The variance of x_t."""
        alpha_bar = self.alpha_bar[timestep][:, None, None, None]
        return alpha_bar * self.variance + (1 - alpha_bar)

    def forward(
        self,
        x_t: Float[Tensor, "B M J 3"],
        timestep: Int[Tensor, "B"],
        condition: Float[Tensor, "B P"],
        joints: Float[Tensor, "B J W"],
    ) -> Float[Tensor, "B M J 3"]:
        """eps."""
        alpha_bar = self.alpha_bar[timestep][:, None, None, None]
        total = self.total_variance(timestep)
        known = (1 - alpha_bar).sqrt() * x_t / total
        deviation = (alpha_bar * self.variance / total).sqrt()
        parts = condition + self.from_clock(self.clock[timestep])
        return known + deviation * self._rest(x_t / total.sqrt(), joints, parts)

    def last_clock(self) -> Float[Tensor, "1 P"]:
        """The last timestep's share of every scale and shift."""
        result: Tensor = self.from_clock(self.clock[-1:])
        return result

    def expectation(
        self,
        condition: Float[Tensor, "B P"],
        joints: Float[Tensor, "B J W"],
        *,
        clock: Float[Tensor, "1 P"],
    ) -> Float[Tensor, "B M J 3"]:
        """The x0 of an x_T that says nothing, with the clock of the last timestep."""
        alpha_bar = self.alpha_bar[-1]
        total = alpha_bar * self.variance + (1 - alpha_bar)
        # Of so many rows; zeros would become a constant of the exported graph, of one row.
        nothing = (0 * condition[:, :1])[:, :, None, None].expand(-1, *self.shape)
        rest = self._rest(nothing, joints, condition + clock)
        return -(self.variance * (1 - alpha_bar) / total).sqrt() * rest

    def _rest(
        self,
        x: Float[Tensor, "B M J 3"],
        joints: Float[Tensor, "B J W"],
        condition: Float[Tensor, "B P"],
    ) -> Float[Tensor, "B M J 3"]:
        parts = iter(condition.split(self.sizes, dim=1))
        tokens = joints + self.joints(x.transpose(1, 2).flatten(2))
        for layer in self.spatial:
            tokens = layer(tokens, next(parts))
        by_frame = self.spread(tokens).unflatten(2, (self.shape[0], -1)).transpose(1, 2)
        frames = self.frames(torch.cat([x, by_frame], dim=-1).flatten(2)) + self.frame
        for layer in self.temporal:
            frames = layer(frames, next(parts))
        rest: Tensor = self.head(self.norm(frames)).unflatten(2, (-1, 3))
        return rest


def _clock(alpha_bar: Float[Tensor, "K"]) -> Float[Tensor, "K 32"]:
    """Waves over the logarithm of the signal-to-noise ratio, a row for each timestep."""
    level = torch.log(alpha_bar / (1 - alpha_bar)).double()
    waves = 0.1 * 1.4 ** torch.arange(16, dtype=torch.float64)
    angle = level[:, None] * waves
    return torch.cat([angle.sin(), angle.cos()], dim=1).float()
