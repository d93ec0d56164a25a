"""Our parts, sized for a CPU server: motion as spectra, latents as vectors.

Every part speaks features ``(B, L, F)``: poses in a representation of `models.pose`, flattened.
Names follow Barquero et al. 2023: behaviour encoder p, target encoder g, behaviour coupler B,
auxiliary decoder r, observation encoder h, denoiser f.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from models.layers import MLP
from models.pose import continuation_basis, cosine_basis
from models.system import Batch

LOG_VARIANCE_LIMIT = 10.0


class SpectralBehaviourEncoder(nn.Module):
    """p(z | x_m, Y): the future's offsets in the continuation basis, through an MLP."""

    basis: Tensor

    def __init__(
        self, *, features: int, num_target: int, horizon: int, latent: int, hidden: int, bases: int
    ) -> None:
        super().__init__()
        self.register_buffer("basis", continuation_basis(bases, horizon), persistent=False)
        self.principal = nn.Linear(bases * features, latent)
        self.network = MLP((num_target + bases) * features, hidden, hidden, 2 * latent)
        _start_from_zero(self.network)

    def spectrum(
        self, target: Float[Tensor, "B C F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B KF"]:
        """Coefficients of the future's offsets from the last observed pose."""
        return torch.einsum("hk,bhf->bkf", self.basis, future - target[:, -1:]).flatten(1)

    def forward(
        self, target: Float[Tensor, "B C F"], future: Float[Tensor, "B H F"]
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """Mean and log variance of the behaviour's posterior."""
        last = target[:, -1:]
        spectrum = self.spectrum(target, future)
        joined = torch.cat([(target[:, :-1] - last).flatten(1), last.flatten(1)], dim=1)
        mean, log_variance = self.network(torch.cat([joined, spectrum], dim=1)).chunk(2, dim=1)
        log_variance = (log_variance - 6.0).clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)
        return mean + self.principal(spectrum), log_variance


class SpectralCoupler(nn.Module):
    """B(z, g(x_m)): offsets from the last observed pose, as coefficients of the basis.

    The basis is zero at the last observed frame, so no latent can make the first frame jump.
    """

    basis: Tensor

    def __init__(
        self, *, features: int, num_target: int, horizon: int, latent: int, hidden: int, bases: int
    ) -> None:
        super().__init__()
        self.shape = (bases, features)
        self.register_buffer("basis", continuation_basis(bases, horizon), persistent=False)
        self.target_encoder = nn.Linear(num_target * features, latent)
        self.principal = nn.Linear(latent, bases * features)
        self.network = MLP(2 * latent, hidden, hidden, bases * features)
        _start_from_zero(self.network)

    def encode_target(self, target: Float[Tensor, "B C F"]) -> Float[Tensor, "B G"]:
        """g(x_m)."""
        last = target[:, -1:]
        joined = torch.cat([(target[:, :-1] - last).flatten(1) * 10, last.flatten(1)], dim=1)
        return self.target_encoder(joined)

    def offsets(
        self, z: Float[Tensor, "*B D"], code: Float[Tensor, "*B G"]
    ) -> Float[Tensor, "*B KF"]:
        """Coefficients of the offsets; the basis is orthonormal, so distances equal the motion's."""
        coefficients: Tensor = self.principal(z) + self.network(torch.cat([z, code], dim=-1))
        return coefficients

    def frames(self, offsets: Float[Tensor, "B KF"]) -> Float[Tensor, "B H F"]:
        """Offsets frame by frame."""
        return torch.matmul(self.basis, offsets.unflatten(1, self.shape))


@torch.no_grad()
def fit_principal_components(
    network: Any, next_batch: Callable[[], Batch], *, num_batches: int
) -> None:
    """Start behaviour encoder and coupler as the principal components of the offsets, whitened.

    The networks beside them then only learn what a linear code cannot say, which spares most of
    the updates that the autoencoder would need from scratch.
    """
    encoder, coupler = network.behaviour_encoder, network.coupler
    batches = (network.features(next_batch()) for _ in range(num_batches))
    spectra = torch.cat([encoder.spectrum(target, future) for _, target, future in batches])
    mean = spectra.mean(dim=0)
    values, vectors = torch.linalg.eigh(torch.cov((spectra - mean).T.double()))
    latent = encoder.principal.out_features
    vectors, deviation = vectors[:, -latent:].float(), values[-latent:].clamp(min=1e-10).sqrt()
    encoder.principal.weight.copy_((vectors / deviation.float()).T)
    encoder.principal.bias.copy_(-(mean @ vectors) / deviation.float())
    coupler.principal.weight.copy_(vectors * deviation.float())
    coupler.principal.bias.copy_(mean)


def _start_from_zero(network: nn.Sequential) -> None:
    for parameter in network[-1].parameters():
        nn.init.zeros_(parameter)


class SpectralAuxiliaryDecoder(nn.Module):
    """r(z): x_m and the future in absolute features from the behaviour alone."""

    basis: Tensor

    def __init__(
        self, *, features: int, num_frames: int, latent: int, hidden: int, bases: int
    ) -> None:
        super().__init__()
        self.shape = (bases, features)
        self.register_buffer("basis", cosine_basis(bases, num_frames), persistent=False)
        self.network = MLP(latent, hidden, bases * features)

    def forward(self, z: Float[Tensor, "B D"]) -> Float[Tensor, "B L F"]:
        """The whole motion Y_e."""
        return torch.matmul(self.basis, self.network(z).unflatten(1, self.shape))


class SpectralObservationAutoencoder(nn.Module):
    """h: the observation's cosine spectrum through an MLP, and a decoder that pre-trains it."""

    basis: Tensor

    def __init__(
        self, *, features: int, num_observed: int, context: int, hidden: int
    ) -> None:
        super().__init__()
        self.shape = (num_observed, features)
        # Differences to the last frame and the frame itself are what a forecast needs; the
        # spectrum of the former separates motion from sensor noise.
        self.register_buffer("basis", cosine_basis(num_observed, num_observed), persistent=False)
        self.encoder = MLP((num_observed + 1) * features, hidden, hidden, context)
        self.decoder = MLP(context, hidden, num_observed * features)

    def encode(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B C"]:
        """The context c = h(X)."""
        last = observation[:, -1]
        spectrum = torch.einsum("tk,btf->bkf", self.basis, observation - last[:, None])
        context: Tensor = self.encoder(torch.cat([last, spectrum.flatten(1)], dim=1))
        return context

    def forward(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B T F"]:
        """The observation, reconstructed from its context."""
        return self.decoder(self.encode(observation)).unflatten(1, self.shape)


class DenseBlock(nn.Module):
    """Residual block on a vector: norm, FiLM, SiLU, linear, SiLU, zero-initialised linear."""

    def __init__(self, narrow: int, wide: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(narrow, elementwise_affine=False)
        self.first = nn.Linear(narrow, wide)
        self.second = nn.Linear(wide, wide)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)
        self.skip = nn.Identity() if narrow == wide else nn.Linear(narrow, wide)

    def forward(
        self, x: Float[Tensor, "*B W"], scale: Float[Tensor, "*C W"], shift: Float[Tensor, "*C W"]
    ) -> Float[Tensor, "*B V"]:
        """Features of the next width."""
        h = F.silu(self.norm(x) * (1 + scale) + shift)
        return self.skip(x) + self.second(F.silu(self.first(h)))


class DenseUNet(nn.Module):
    """f(z_t, t, c): a conditional U-Net whose levels are widths of a vector.

    A latent vector has no neighbourhoods, so convolutions over an arbitrary reshaping of it buy
    nothing and cost most of the time. What remains of the U-Net are its levels, its skips and
    FiLM. ``film`` holds every block's scale and shift of the context and is computed once for a
    request; a table adds the timestep's.
    """

    def __init__(
        self, *, latent: int, context: int, widths: tuple[int, ...], num_steps: int
    ) -> None:
        super().__init__()
        self.stem = nn.Linear(latent, widths[0])
        blocks = [(w, w) for w in widths]
        rising = list(zip(widths[-2::-1], widths[:0:-1], strict=True))
        self.down = nn.ModuleList(
            nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)
        )
        self.falling = nn.ModuleList(DenseBlock(*b) for b in blocks)
        self.middle = DenseBlock(widths[-1], widths[-1])
        self.rising = nn.ModuleList(DenseBlock(wide + low, wide) for wide, low in rising)
        self.norm = nn.LayerNorm(widths[0])
        self.head = nn.Linear(widths[0], latent)
        every = [*self.falling, self.middle, *self.rising]
        self.sizes = tuple(size for block in every for size in [block.first.in_features] * 2)
        self.context_film = nn.Linear(context, sum(self.sizes))
        self.timestep_film = nn.Embedding(num_steps, sum(self.sizes))
        nn.init.normal_(self.timestep_film.weight, std=0.1)

    def condition(self, context: Float[Tensor, "B C"]) -> Float[Tensor, "B M"]:
        """The context's share of every scale and shift, computed once for a request."""
        result: Tensor = self.context_film(F.silu(context))
        return result

    def forward(
        self, x_t: Float[Tensor, "*B D"], timestep: Int[Tensor, "*C"], film: Float[Tensor, "*C M"]
    ) -> Float[Tensor, "*B D"]:
        """x0."""
        parts = iter((film + self.timestep_film(timestep)).split(self.sizes, dim=-1))
        h = self.stem(x_t)
        skips = []
        for level, block in enumerate(self.falling):
            h = block(h, next(parts), next(parts))
            if level < len(self.down):
                skips.append(h)
                h = self.down[level](h)
        h = self.middle(h, next(parts), next(parts))
        for block in self.rising:
            h = block(torch.cat([skips.pop(), h], dim=-1), next(parts), next(parts))
        x0: Tensor = self.head(F.silu(self.norm(h)))
        return x0
