"""Our parts, sized for a CPU server: motion as spectra, latents as vectors.

Every part speaks features ``(B, L, F)``: poses in a representation of `models.pose`, flattened.
Names follow Barquero et al. 2023: behaviour encoder p, target encoder g, behaviour coupler B,
auxiliary decoder r, observation encoder h, denoiser f.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.continuation import Continuation
from models.layers import MLP, Affine
from models.pose import cosine_basis, posture_and_steps
from models.system import Batch

LOG_VARIANCE_LIMIT = 10.0
INPUT_LIMIT = 8.0


class SpectralBehaviourEncoder(nn.Module):
    """p(z | x_m, Y): principal components of the future's spectrum, corrected by an MLP."""

    def __init__(
        self,
        continuation: Continuation,
        *,
        features: int,
        num_target: int,
        latent: int,
        hidden: int,
    ) -> None:
        super().__init__()
        self.continuation = continuation
        coefficients = continuation.bases * features
        self.principal = nn.Linear(coefficients, latent)
        self.network = MLP(num_target * features + coefficients, hidden, hidden, 2 * latent)
        _start_from_zero(self.network)

    def forward(
        self, target: Float[Tensor, "B C F"], future: Float[Tensor, "B H F"]
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """Mean and log variance of the behaviour's posterior."""
        spectrum = self.continuation.spectrum(target, future)
        seen = torch.cat([posture_and_steps(target), spectrum], dim=1)
        mean, log_variance = self.network(seen).chunk(2, dim=1)
        log_variance = (log_variance - 8.0).clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)
        return mean + self.principal(spectrum), log_variance


class SpectralCoupler(nn.Module):
    """B(z, g(x_m)): the future's spectrum, principal components corrected by an MLP."""

    def __init__(
        self,
        continuation: Continuation,
        *,
        features: int,
        num_target: int,
        latent: int,
        hidden: int,
    ) -> None:
        super().__init__()
        self.continuation = continuation
        coefficients = continuation.bases * features
        self.target_encoder = nn.Linear(num_target * features, latent)
        self.principal = nn.Linear(latent, coefficients)
        self.network = MLP(2 * latent, hidden, hidden, coefficients)
        _start_from_zero(self.network)

    def encode_target(self, target: Float[Tensor, "B C F"]) -> Float[Tensor, "B G"]:
        """g(x_m)."""
        code: Tensor = self.target_encoder(posture_and_steps(target))
        return code

    def offsets(
        self, z: Float[Tensor, "*B D"], code: Float[Tensor, "*B G"]
    ) -> Float[Tensor, "*B KF"]:
        """The spectrum; its basis is orthonormal, so distances equal those of the motions."""
        spectrum: Tensor = self.principal(z) + self.network(torch.cat([z, code], dim=-1))
        return spectrum

    def expected(self, target: Float[Tensor, "B C F"]) -> Float[Tensor, "B H F"]:
        """Where x_m points; offsets deviate from there."""
        return self.continuation.expected(target)

    def frames(
        self, offsets: Float[Tensor, "B KF"], expected: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H F"]:
        """The future frame by frame."""
        return self.continuation.frames(offsets, expected)


@torch.no_grad()
def fit_linear_parts(
    network: Any,
    next_batch: Callable[[], Batch],
    *,
    num_batches: int,
    noise_m: float,
    whitening: float,
) -> None:
    """Fit the expectation's filter, then start encoder and coupler as principal components.

    The networks beside them only learn what a linear code cannot say, which spares most of the
    updates that an autoencoder needs from scratch.

    Args:
        network: a BeLFusion of spectral parts.
        next_batch: source of batches.
        num_batches: how many of them to fit to.
        noise_m: the sensor noise that the filter must bear (its ridge).
        whitening: 1 gives every latent the same variance, 0 that of its motion in metres; between
            them, what moves the body most is also what the noise of the diffusion hides last.
    """
    encoder, coupler = network.behaviour_encoder, network.coupler
    continuation = coupler.continuation
    pairs = [network.features(next_batch())[1:] for _ in range(num_batches)]
    target = torch.cat([pair[0] for pair in pairs])
    future = torch.cat([pair[1] for pair in pairs])
    continuation.fit(target, future, noise_m=noise_m)
    spectra = continuation.spectrum(target, future)
    mean = spectra.mean(dim=0)
    values, vectors = torch.linalg.eigh(torch.cov((spectra - mean).T.double()))
    latent = encoder.principal.out_features
    vectors = vectors[:, -latent:].to(spectra)
    scale = values[-latent:].clamp(min=1e-10).sqrt().to(spectra) ** whitening
    encoder.principal.weight.copy_((vectors / scale).T)
    encoder.principal.bias.copy_(-(mean @ vectors) / scale)
    coupler.principal.weight.copy_(vectors * scale)
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
    """h: the last pose and the cosine spectrum of what led to it, through an MLP.

    The decoder only serves to pre-train the encoder.
    """

    basis: Tensor

    def __init__(self, *, features: int, num_observed: int, context: int, hidden: int) -> None:
        super().__init__()
        self.shape = (num_observed, features)
        self.register_buffer("basis", cosine_basis(num_observed, num_observed), persistent=False)
        self.inputs = Affine((num_observed + 1) * features)
        self.encoder = MLP((num_observed + 1) * features, hidden, hidden, context)
        self.decoder = MLP(context, hidden, num_observed * features)

    def spectrum(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B N"]:
        """The last pose, and the coefficients of the differences from it."""
        last = observation[:, -1:]
        coefficients = torch.matmul(self.basis.T, observation - last)
        return torch.cat([last, coefficients], dim=1).flatten(1)

    def encode(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B C"]:
        """The context c = h(X)."""
        # Fine motion is millimetres where a pose is decimetres; both count alike.
        scaled = self.inputs(self.spectrum(observation))
        context: Tensor = self.encoder(scaled.clamp(-INPUT_LIMIT, INPUT_LIMIT))
        return context

    def forward(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B T F"]:
        """The observation, reconstructed from its context."""
        return self.decoder(self.encode(observation)).unflatten(1, self.shape)


@torch.no_grad()
def fit_observation_inputs(
    network: Any, next_batch: Callable[[], Batch], *, num_batches: int
) -> None:
    """Give every input of the observation encoder mean 0 and deviation 1 over some batches."""
    part = network.observation
    observations = (network.features(next_batch())[0] for _ in range(num_batches))
    spectra = torch.cat([part.spectrum(observation) for observation in observations])
    part.inputs.fit(spectra.mean(dim=0), spectra.std(dim=0))
