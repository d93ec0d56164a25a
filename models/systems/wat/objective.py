"""WAT as one module, and its loss (Mao et al. 2022, Eqs. 2, 4 and 7)."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from models.articulated_poses import ArticulatedPoses
from models.pose import cosine_basis
from models.system import Batch, Losses
from models.systems.wat.recurrent import Told
from models.systems.wat.timing import LENGTH_UNIT, NUM_TIMES, Gaussian, Rhythm

LOG_VARIANCE_LIMIT = 8.0
POSTERIOR_LOG_VARIANCE = -4.0
"""Where the posterior starts: noise that hides z teaches the decoder to ignore it."""
HALF_WINDOW = 10
"""L: frames on either side of the junction that must be smooth together."""
NUM_BASES = 5
"""M: cosines that a smooth junction consists of."""
LENGTH_GROUPS = 3
"""Parts of a batch, by length, so that short actions do not pay for the longest."""
FADING_FRAMES, FADED_AFTER = 3.0, 20
"""How fast the first frames forget where the observation was heading, and when they have."""


class WAT(nn.Module):
    """A conditional VAE of whole actions on articulated poses; ``form`` is either network."""

    smooth: Tensor
    fading: Tensor
    to_fade: Tensor
    momentum: Tensor

    def __init__(self, *, poses: ArticulatedPoses, rhythm: Rhythm, form: nn.Module) -> None:
        super().__init__()
        self.poses = poses
        # Either form's: `recurrent` or `transformer`, whose classes have the same methods.
        self.form: Any = form
        self.rhythm = rhythm
        basis = cosine_basis(NUM_BASES, 2 * HALF_WINDOW)
        self.register_buffer("smooth", basis @ basis.T, persistent=False)
        frame = torch.arange(FADED_AFTER, dtype=torch.float32)
        fading = torch.exp(-frame / FADING_FRAMES)
        self.register_buffer("fading", torch.stack([fading, frame * fading], 1), persistent=False)
        self.register_buffer("to_fade", self.fading[:2].inverse(), persistent=False)
        momentum = torch.ones(poses.num_features)
        momentum[-4:-1] = 0.0  # turns and steps are velocities already
        self.register_buffer("momentum", momentum, persistent=False)

    def begin(
        self, observed: Float[Tensor, "B T F"], action: Int[Tensor, "B"]
    ) -> tuple[Gaussian, tuple[Tensor, ...]]:
        """The prior of z given what is known when a request arrives, and the form's own tensors.

        The last coordinates of z are a timing, which is drawn like the others.
        """
        (mean, log_variance), state = self.form.begin(observed, action)
        return (mean, log_variance.clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)), state

    def posterior(
        self,
        observed: Float[Tensor, "B T F"],
        future: Float[Tensor, "B L F"],
        num_frames: Int[Tensor, "B"],
        action: Int[Tensor, "B"],
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
        """Mean and log variance of z given the future."""
        mean, log_variance = self.form.posterior(observed, future, num_frames, action)
        log_variance = log_variance + POSTERIOR_LOG_VARIANCE
        return mean, log_variance.clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)

    def bound_for(self, observed: Float[Tensor, "B T F"]) -> Float[Tensor, "B 2 F"]:
        """Where an observation was heading: what its next two frames come to as a and b."""
        heading = (observed[:, -1:] - observed[:, -3:-2]) / 2 * self.momentum
        first = observed[:, -1:] + heading
        return torch.matmul(self.to_fade, torch.cat([first, first + heading], dim=1))

    def joined(
        self,
        features: Float[Tensor, "B L F"],
        bound_for: Float[Tensor, "B 2 F"],
        beginning: Float[Tensor, "B 1"],
    ) -> Float[Tensor, "B L F"]:
        """The frames, the first two of them moved to where the observation was heading.

        What they are moved by fades out over the next ones, (a + b t) exp(-t / tau), as animators
        blend from one clip into another. ``beginning`` is 1 for rows whose action begins here.
        """
        moved = bound_for - torch.matmul(self.to_fade, features[:, :2])
        fading = self.fading[: int(features.shape[1])]
        correction = torch.matmul(fading, moved * beginning[:, None])
        count = len(fading)
        if count == features.shape[1]:
            return features + correction
        return torch.cat([features[:, :count] + correction, features[:, count:]], dim=1)


@torch.no_grad()
def fit_poses(network: WAT, next_batch: Callable[[], Batch], *, num_batches: int) -> None:
    """Set rest directions, weights of the features, and the feet, to those of the data."""
    batches = [next_batch() for _ in range(num_batches)]
    observations = torch.cat([batch["observation"] for batch in batches])
    network.poses.fit(observations)
    network.rhythm.fit(observations)


def loss(  # noqa: PLR0913 - the weights of the terms
    network: WAT,
    batch: Batch,
    generator: Generator,
    *,
    reconstruction_weight: float,
    smooth_weight: float,
    step_weight: float,
    kl_weight: float,
    padding: int,
    told: tuple[float, float],
) -> Losses:
    """Eq. 6: reconstruction where the future is known, a smooth junction, KL to the prior.

    Errors are weighted sums of squares over a pose's features, about its squared distance in
    metres. ``step_weight`` counts the error of each frame's change. A row's decoder is ``told`` a
    share of the true frames that is drawn between these two.
    """
    groups = batch["length"].argsort().chunk(LENGTH_GROUPS)
    terms = [
        _terms(
            network,
            {name: value[rows] for name, value in batch.items()},
            generator,
            padding=padding,
            told=told,
        )
        for rows in groups
    ]
    reconstruction, step, smooth, kl, timing = (
        torch.cat(term).mean() for term in zip(*terms, strict=True)
    )
    return {
        "total": reconstruction_weight * reconstruction
        + step_weight * step
        + smooth_weight * smooth
        + kl_weight * kl
        + timing,
        "reconstruction": reconstruction,
        "step": step,
        "smooth": smooth,
        "kl": kl,
        "timing": timing,
    }


def _terms(
    network: WAT,
    batch: Batch,
    generator: Generator,
    *,
    padding: int,
    told: tuple[float, float],
) -> tuple[Float[Tensor, "B"], ...]:
    """Each row's reconstruction error, error of steps, roughness of the junction, KL, and timing.

    Timing is how unlikely the prior takes the true one to be.
    """
    action, first, length = batch["action"], batch["first"], batch["length"]
    patch = network.form.frames_per_step
    needed = int((length + padding).max())
    num_frames = min(-(-needed // patch) * patch, batch["future"].shape[1])
    with torch.no_grad():
        observed, _ = network.poses.enter_observation(batch["seen"])
        future = network.poses.enter(batch["observation"], batch["future"][:, :num_frames])
    frame = torch.arange(num_frames, device=first.device)
    # After a transition the first pose is known, but not the step that led to it.
    begun = frame >= (first + (first > 0))[:, None]
    known = begun & (frame < (length + padding)[:, None])
    timing, sure = _timing(network, batch, performed=begun & (frame < length[:, None]))
    mean, log_variance = network.posterior(observed, future, length.clamp(max=num_frames), action)
    (expected, expected_log_variance), state = network.begin(observed, action)
    noise = torch.randn(mean.shape, generator=generator, device=mean.device)
    z = torch.cat([mean + (0.5 * log_variance).exp() * noise, timing], dim=1)
    least, most = told
    share = least + (most - least) * _uniform(len(z), generator, z)[:, None]
    here = known & (_uniform(known.shape, generator, z) < share)
    predicted, _ = network.form.advance(z, state, num_frames, Told(future, here))
    bound_for = network.bound_for(observed)
    predicted = network.joined(predicted, bound_for, torch.ones_like(z[:, :1]))
    weight = network.poses.weights.sqrt()
    error = (predicted - future) * weight
    window = torch.cat([observed[:, -HALF_WINDOW:], predicted[:, :HALF_WINDOW]], dim=1) * weight
    rough = window - torch.matmul(network.smooth, window)
    return (
        _mean_over_known(error, known),
        _mean_over_known(error.diff(dim=1), known[:, 1:] & known[:, :-1]),
        rough.square().sum(dim=2).mean(dim=1),
        _kl(mean, log_variance, expected[:, :-NUM_TIMES], expected_log_variance[:, :-NUM_TIMES]),
        _unlikely(timing, sure, expected[:, -NUM_TIMES:], expected_log_variance[:, -NUM_TIMES:]),
    )


def _timing(
    network: WAT, batch: Batch, *, performed: Bool[Tensor, "B L"]
) -> tuple[Float[Tensor, "B 4"], Float[Tensor, "B 4"]]:
    """The timing of the true future, and how sure each of its numbers is, 0 to 1."""
    with torch.no_grad():
        poses = batch["future"][:, : performed.shape[1]]
        rhythm, sure = network.rhythm.measure(poses, performed)
    log_length = (batch["length"][:, None] / LENGTH_UNIT).log()
    sure = sure[:, None]
    return torch.cat([log_length, rhythm], 1), torch.cat(
        [torch.ones_like(sure), sure, sure, sure], 1
    )


def _unlikely(
    timing: Float[Tensor, "B 4"],
    sure: Float[Tensor, "B 4"],
    mean: Float[Tensor, "B 4"],
    log_variance: Float[Tensor, "B 4"],
) -> Float[Tensor, "B"]:
    error = nn.functional.gaussian_nll_loss(mean, timing, log_variance.exp(), reduction="none")
    return (sure * error).sum(dim=1)


def _uniform(shape: Any, generator: Generator, like: Tensor) -> Tensor:
    return torch.rand(shape, generator=generator, device=like.device)


def _mean_over_known(
    error: Float[Tensor, "B L F"], known: Bool[Tensor, "B L"]
) -> Float[Tensor, "B"]:
    squared = error.square().sum(dim=2) * known
    return squared.sum(dim=1) / known.sum(dim=1).clamp(min=1)


def _kl(
    mean: Float[Tensor, "B D"],
    log_variance: Float[Tensor, "B D"],
    prior_mean: Float[Tensor, "B D"],
    prior_log_variance: Float[Tensor, "B D"],
) -> Float[Tensor, "B"]:
    """Eq. 2."""
    difference = (mean - prior_mean).square() + log_variance.exp()
    ratio = difference * (-prior_log_variance).exp()
    return 0.5 * (prior_log_variance - log_variance + ratio - 1).sum(dim=1)
