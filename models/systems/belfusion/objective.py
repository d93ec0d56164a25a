"""BeLFusion as one module of parts, and the losses of its three stages."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from models.diffusion import Schedule, q_sample
from models.layers import Affine, reverse_gradient
from models.pose import RootRelativePoses, WorldPoses, root_counts
from models.system import Batch, Losses

RANGE_IN_DEVIATIONS = 3.0


class BeLFusion(nn.Module):
    """The six parts of the system (Barquero et al. 2023, Figs. 2 and 3)."""

    # Either form's: `spectral` or `recurrent`, whose classes have the same methods.
    behaviour_encoder: Any
    coupler: Any
    auxiliary: Any
    observation: Any
    denoiser: Any

    def __init__(  # noqa: PLR0913 - one argument per part
        self,
        *,
        representation: WorldPoses | RootRelativePoses,
        num_target: int,
        behaviour_encoder: nn.Module,
        coupler: nn.Module,
        auxiliary: nn.Module,
        observation: nn.Module,
        denoiser: nn.Module,
        latent: int,
        context: int,
    ) -> None:
        super().__init__()
        self.representation = representation
        self.num_target = num_target
        self.behaviour_encoder = behaviour_encoder
        self.coupler = coupler
        self.auxiliary = auxiliary
        self.observation = observation
        self.denoiser = denoiser
        self.latent_range = Affine(latent)
        self.context_range = Affine(context)

    def features(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Features of the observation as a sensor saw it, of x_m and of the future."""
        clean, seen = batch["observation"], batch["seen"]
        observation = self.representation.enter(seen, seen)
        target = self.representation.enter(clean, clean[:, -self.num_target :])
        return observation, target, self.representation.enter(clean, batch["future"])

    def context(self, observation: Float[Tensor, "B T F"]) -> Float[Tensor, "B C"]:
        """h(X) in the denoiser's range."""
        scaled: Tensor = self.context_range(self.observation.encode(observation))
        return scaled

    def future(
        self, z: Float[Tensor, "B D"], target: Float[Tensor, "B C F"]
    ) -> Float[Tensor, "B H F"]:
        """Features of the future that performs behaviour z from x_m on."""
        offsets = self.coupler.offsets(z, self.coupler.encode_target(target))
        frames: Tensor = self.coupler.frames(offsets, self.coupler.expected(target))
        return frames


def _squared(difference: Tensor) -> Tensor:
    return difference.square().flatten(1).sum(dim=1).mean()


def behaviour_loss(
    network: BeLFusion,
    batch: Batch,
    generator: Generator,
    *,
    kl_weight: float,
    adversarial_weight: float,
) -> Losses:
    """Eqs. 3 and 4 in one backward pass: the auxiliary decoder learns, the encoder unlearns.

    The encoder receives the auxiliary gradient times -adversarial_weight (see the README of this
    folder for why it is small).
    """
    _, target, future = network.features(batch)
    mean, log_variance = network.behaviour_encoder(target, future)
    noise = torch.randn(mean.shape, generator=generator, device=mean.device)
    z = mean + (0.5 * log_variance).exp() * noise
    reconstruction = _squared(network.future(z, target) - future)
    kl = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=1).mean()
    whole = torch.cat([target, future], dim=1)
    weight = adversarial_weight * _not_yet_fooled(network.auxiliary, z, whole)
    auxiliary = _squared(network.auxiliary(reverse_gradient(z, weight)) - whole)
    return {
        "total": reconstruction + kl_weight * kl + auxiliary,
        "reconstruction": reconstruction,
        "kl": kl,
        "auxiliary": auxiliary,
    }


@torch.no_grad()
def _not_yet_fooled(
    auxiliary: nn.Module, z: Float[Tensor, "B D"], whole: Float[Tensor, "B L F"]
) -> Float[Tensor, "B 1"]:
    """1 for rows that the auxiliary decoder tells better than a constant would, else 0.

    Once it does no better, nothing is left to unlearn, and an unbounded reward for fooling it
    further would drive the latents to infinity.
    """
    error = (auxiliary(z) - whole).square().flatten(1).sum(dim=1, keepdim=True)
    constant = (whole - whole.mean(dim=0)).square().flatten(1).sum(dim=1).mean()
    return (error < constant).to(z.dtype)


def coupler_loss(network: BeLFusion, batch: Batch, generator: Generator) -> Losses:
    """Refinement of the coupler with the behaviour encoder frozen (supplement, section B)."""
    del generator
    _, target, future = network.features(batch)
    mean, _ = network.behaviour_encoder(target, future)
    reconstruction = _squared(network.future(mean, target) - future)
    return {"total": reconstruction, "reconstruction": reconstruction}


def observation_loss(network: BeLFusion, batch: Batch, generator: Generator) -> Losses:
    """The observation autoencoder's mean squared error."""
    del generator
    observation, _, _ = network.features(batch)
    error = (network.observation(observation) - observation).square().mean()
    return {"total": error}


@torch.no_grad()
def measure_ranges(
    network: BeLFusion, next_batch: Callable[[], Batch], *, num_batches: int
) -> None:
    """Scale latents and contexts so that three standard deviations of the widest become 1."""
    latents, contexts = [], []
    for _ in range(num_batches):
        observation, target, future = network.features(next_batch())
        latents.append(network.behaviour_encoder(target, future)[0])
        contexts.append(network.observation.encode(observation))
    for part, values in ((network.latent_range, latents), (network.context_range, contexts)):
        joined = torch.cat(values)
        widest = joined.std(dim=0).max() * RANGE_IN_DEVIATIONS
        part.fit(joined.mean(dim=0), widest.expand(joined.shape[1]))


def denoiser_loss(  # noqa: PLR0913 - the symbols of the equation
    network: BeLFusion,
    batch: Batch,
    generator: Generator,
    *,
    schedule: Schedule,
    num_candidates: int,
    reconstruction_weight: float,
    noisiest_share: float = 0.0,
    root_weight: float = 1.0,
) -> Losses:
    """Eq. 6: of k candidates, the one nearest in latents and the one nearest in motion learn.

    In motion the first three features, the root's where a representation has it, count root_weight
    times what they count in the representation.

    All k candidates are first judged without gradients and in bfloat16; the two winners of each
    row are then run again, which gives the gradient of the plain loss at a fraction of its cost.
    """
    observation, target, future = network.features(batch)
    rows, device = len(target), target.device
    with torch.no_grad():
        z = network.latent_range(network.behaviour_encoder(target, future)[0])
        code = network.coupler.encode_target(target)
        wanted = network.coupler.offsets(network.latent_range.inverse(z), code)
        counts = root_counts(future[0, 0], root_weight).repeat(wanted.shape[1] // future.shape[2])
    timestep = torch.randint(schedule.num_steps, (rows,), generator=generator, device=device)
    timestep[: round(noisiest_share * rows)] = schedule.num_steps - 1
    alpha_bar = torch.as_tensor(schedule.alpha_bar, dtype=z.dtype, device=device)[timestep]
    variance = torch.as_tensor(schedule.variance, dtype=z.dtype, device=device)[timestep]
    noise = torch.randn((rows, num_candidates, z.shape[1]), generator=generator, device=device)
    x_t = q_sample(
        x0=z[:, None],
        noise=noise,
        alpha_bar=alpha_bar[:, None, None],
        variance=variance[:, None],
    )
    condition = network.denoiser.condition(network.context(observation))
    with torch.no_grad(), torch.autocast(device.type, dtype=torch.bfloat16):
        near_latent, near_motion = _winners(
            network, x_t, (timestep, condition, code), (z, wanted, counts)
        )
    row = torch.arange(rows, device=device)
    chosen = torch.cat([x_t[row, near_latent], x_t[row, near_motion]])
    x0 = network.denoiser(chosen, timestep.repeat(2), condition.repeat(2, 1))
    latent = (x0[:rows] - z).abs().sum(dim=1).mean()
    motion = network.coupler.offsets(network.latent_range.inverse(x0[rows:]), code)
    reconstruction = (
        ((motion - wanted) * counts).square().flatten(1).sum(dim=1).add(1e-8).sqrt().mean()
    )
    return {
        "total": latent + reconstruction_weight * reconstruction,
        "latent": latent,
        "reconstruction": reconstruction,
    }


def _winners(
    network: BeLFusion,
    x_t: Float[Tensor, "B k D"],
    given: tuple[Tensor, Tensor, Tensor],
    wanted: tuple[Tensor, Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    timestep, condition, code = (value[:, None] for value in given)
    x0 = network.denoiser(x_t, timestep, condition)
    z = network.latent_range.inverse(x0)
    motion = network.coupler.offsets(z, code.expand(-1, x_t.shape[1], -1))
    latent_error = (x0 - wanted[0][:, None]).abs().sum(dim=-1)
    motion_error = ((motion - wanted[1][:, None]) * wanted[2]).square().sum(dim=-1)
    return latent_error.argmin(dim=1), motion_error.argmin(dim=1)
