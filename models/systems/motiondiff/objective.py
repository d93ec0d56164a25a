"""MotionDiff as one module of parts, its sampling, and the losses of its two stages."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn

from models.diffusion import Schedule, ddim_step, q_sample, timesteps
from models.pose import RootRelativePoses, WorldPoses, root_counts
from models.system import Batch, Losses


class MotionDiff(nn.Module):
    """The parts of the system (Wei et al. 2023, Fig. 2)."""

    # Either form's: `keyframes` or `paper`, whose classes have the same methods.
    motion: Any
    encoder: Any
    denoiser: Any
    refiner: Any

    def __init__(
        self,
        *,
        representation: WorldPoses | RootRelativePoses,
        motion: nn.Module,
        encoder: nn.Module,
        denoiser: nn.Module,
        refiner: nn.Module,
        gamma: float,
    ) -> None:
        super().__init__()
        self.representation = representation
        self.motion = motion
        self.encoder = encoder
        self.denoiser = denoiser
        self.refiner = refiner
        self.gamma = gamma

    def features(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Features of the observation as a sensor saw it, of the true one and of the future."""
        clean, seen = batch["observation"], batch["seen"]
        observation = self.representation.enter(clean, clean)
        future = self.representation.enter(clean, batch["future"])
        return self.representation.enter(seen, seen), observation, future

    def conditions(self, observation: Float[Tensor, "B T F"]) -> tuple[Tensor, ...]:
        """All that the steps need of the observation, computed once for a request."""
        context, *more = self.encoder(observation)
        return (self.denoiser.condition(context), *more)

    def x0(
        self,
        x_t: Float[Tensor, "B M N 3"],
        timestep: Int[Tensor, "B"],
        conditions: tuple[Tensor, ...],
    ) -> Float[Tensor, "B M N 3"]:
        """The motion that the noise hides, from the noise that is found in it (Eq. 2, solved)."""
        alpha_bar = self.denoiser.alpha_bar[timestep][:, None, None, None]
        eps = self.denoiser(x_t, timestep, *conditions)
        return (x_t - (1 - alpha_bar).sqrt() * eps) / alpha_bar.sqrt()

    def expectation(
        self, conditions: tuple[Tensor, ...], clock: Tensor | None = None
    ) -> tuple[Float[Tensor, "B M N 3"], ...]:
        """The x0 of an x_T that says nothing, if the refinement looks at it.

        ``clock``: the denoiser's ``last_clock``, where it is known already.
        """
        if not self.refiner.conditions:
            return ()
        clock = self.denoiser.last_clock() if clock is None else clock
        return (self.denoiser.expectation(*conditions, clock=clock),)

    def refined(
        self,
        observation: Float[Tensor, "B T F"],
        future: Float[Tensor, "B H F"],
        *expectation: Float[Tensor, "B M N 3"],
    ) -> Float[Tensor, "B H F"]:
        """Z = Y + gamma eps_phi(Y, C)."""
        expected = (self.motion.leave(observation, x0) for x0 in expectation)
        return future + self.gamma * self.refiner(observation, future, *expected)


@torch.no_grad()
def fit_motion(
    network: MotionDiff,
    next_batch: Callable[[], Batch],
    *,
    num_batches: int,
    noise_m: float,
    whitening: float,
) -> None:
    """Fit expectation, scales and the ranges of the inputs to some batches."""
    rows = [network.features(next_batch()) for _ in range(num_batches)]
    seen, observation, future = (torch.cat(part) for part in zip(*rows, strict=True))
    variance = network.motion.fit(observation, future, noise_m=noise_m, whitening=whitening)
    network.denoiser.variance.copy_(variance)
    network.encoder.fit(seen)


def diffusion_loss(
    network: MotionDiff, batch: Batch, generator: Generator, *, schedule: Schedule
) -> Losses:
    """Eq. 6: the mean squared error of the noise."""
    _, eps, found = _noise_found(network, batch, generator, schedule)
    return {"total": (eps - found).square().mean()}


def weighted_diffusion_loss(
    network: MotionDiff, batch: Batch, generator: Generator, *, schedule: Schedule
) -> Losses:
    """Eq. 6, timesteps weighted as the variance of x_t over alpha_bar.

    That is the squared error of x0 while the noise is larger than x0, and that of the noise once
    it is smaller: what decides which future is told counts as much as its finish.
    """
    timestep, eps, found = _noise_found(network, batch, generator, schedule)
    alpha_bar = network.denoiser.alpha_bar[timestep][:, None, None, None]
    weight = network.denoiser.total_variance(timestep) / alpha_bar
    error = (eps - found).square()
    total = (weight * error).mean() / network.denoiser.variance.mean()
    return {"total": total, "eps": error.mean()}


def _noise_found(
    network: MotionDiff, batch: Batch, generator: Generator, schedule: Schedule
) -> tuple[Tensor, Tensor, Tensor]:
    seen, observation, future = network.features(batch)
    x0 = network.motion.enter(observation, future)
    rows, device = len(x0), x0.device
    # One timestep of each of so many equal parts of the chain: as uniform as it can be.
    place = torch.arange(rows, device=device) + torch.rand(rows, generator=generator, device=device)
    timestep = (place * schedule.num_steps / rows).long().clamp(max=schedule.num_steps - 1)
    noise = torch.randn(x0.shape, generator=generator, device=device)
    alpha_bar = network.denoiser.alpha_bar[timestep][:, None, None, None]
    x_t = q_sample(x0=x0, noise=noise, alpha_bar=alpha_bar, variance=1 - alpha_bar)
    return timestep, noise, network.denoiser(x_t, timestep, *network.conditions(seen))


@torch.no_grad()
def sample(
    network: MotionDiff,
    observation: Float[Tensor, "B T F"],
    generator: Generator,
    *,
    schedule: Schedule,
    num_samples: int,
    num_steps: int,
) -> Float[Tensor, "B N H F"]:
    """Futures of the diffusion alone, by DDIM over so many evenly spread timesteps."""
    rows = len(observation) * num_samples
    conditions = tuple(
        part.repeat_interleave(num_samples, dim=0) for part in network.conditions(observation)
    )
    x_t = torch.randn((rows, *network.motion.shape), generator=generator, device=observation.device)
    chain = timesteps(schedule.num_steps, num_steps, plan="stride")
    x0 = x_t
    for t, following in zip(chain, (*chain[1:], None), strict=True):
        x0 = network.x0(x_t, torch.full((rows,), t, device=x_t.device), conditions)
        if following is not None:
            x_t = ddim_step(
                x_t=x_t,
                x0=x0,
                alpha_bar=float(schedule.alpha_bar[t]),
                variance=float(schedule.variance[t, 0]),
                alpha_bar_next=float(schedule.alpha_bar[following]),
                variance_next=float(schedule.variance[following, 0]),
            )
    motion = network.motion.leave(observation.repeat_interleave(num_samples, dim=0), x0)
    return motion.unflatten(0, (len(observation), num_samples))


@torch.no_grad()
def fit_refiner(network: MotionDiff, next_batch: Callable[[], Batch], *, num_batches: int) -> None:
    """Fit the units of the refinement's coefficients to some batches."""
    rows = [network.features(next_batch()) for _ in range(num_batches)]
    seen, _, future = (torch.cat(part) for part in zip(*rows, strict=True))
    network.eval()
    (expectation,) = network.expectation(network.conditions(seen))
    network.refiner.fit(seen, future, network.motion.leave(seen, expectation))


def refinement_loss(  # noqa: PLR0913 - the symbols of Eq. 10
    network: MotionDiff,
    batch: Batch,
    generator: Generator,
    *,
    schedule: Schedule,
    num_samples: int,
    num_steps: int,
    sigma: float,
    reconstruction_weight: float,
    diversity_weight: float,
    exponent: float = 2.0,
    root_weight: float = 1.0,
    root_diversity: float = 1.0,
) -> Losses:
    """Eq. 10: the best refined sample comes nearer, and the refined samples stay apart.

    The first three features, the root's where a representation has it, count root_weight times in
    the former and root_diversity times in the latter.
    """
    seen, _, future = network.features(batch)
    network.denoiser.eval(), network.encoder.eval()
    with torch.no_grad():
        expectation = network.expectation(network.conditions(seen))
    with torch.autocast(seen.device.type, dtype=torch.bfloat16):
        samples = sample(
            network,
            seen,
            generator,
            schedule=schedule,
            num_samples=num_samples,
            num_steps=num_steps,
        ).float()
    rows = (part.repeat_interleave(num_samples, dim=0) for part in (seen, *expectation))
    refined = network.refined(next(rows), samples.flatten(0, 1), *rows)
    refined = refined.unflatten(0, samples.shape[:2])
    near = root_counts(future[0, 0], root_weight)
    apart = root_counts(future[0, 0], root_diversity)
    reconstruction = best_of(near * refined, near * future, exponent=exponent)
    diversity = closeness(apart * refined, sigma=sigma)
    return {
        "total": reconstruction_weight * reconstruction + diversity_weight * diversity,
        "reconstruction": reconstruction,
        "unrefined": best_of(near * samples, near * future, exponent=exponent),
        "diversity": diversity,
        "unrefined_diversity": closeness(apart * samples, sigma=sigma),
    }


def best_of(
    samples: Float[Tensor, "B N H F"], future: Float[Tensor, "B H F"], *, exponent: float = 2.0
) -> Float[Tensor, ""]:
    """Eq. 8: of each row's samples the one nearest to its future; distances of poses are summed.

    With the exponent 2 as in the paper, with 1 as in the ADE.
    """
    squared = (samples - future[:, None]).square().sum(dim=-1)
    return squared.add(1e-8).pow(exponent / 2).sum(dim=-1).amin(dim=1).mean()


def closeness(samples: Float[Tensor, "B N H F"], *, sigma: float) -> Float[Tensor, ""]:
    """Eq. 9: how near each row's samples are to one another, 1 if they are all the same."""
    flat = samples.flatten(2)
    squares = flat.square().sum(dim=-1)
    products = torch.matmul(flat, flat.transpose(1, 2))
    distance = (squares[:, :, None] + squares[:, None] - 2 * products).clamp(min=0)
    near = (-distance / sigma).exp()
    count = samples.shape[1]
    apart = near.sum(dim=(1, 2)) - near.diagonal(dim1=1, dim2=2).sum(dim=1)
    return (apart / (count * (count - 1))).mean()
