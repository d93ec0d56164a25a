"""SkeletonDiffusion as one module of parts, and the losses of its two stages."""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn

from models.diffusion import Schedule, q_sample
from models.losses import motion_distance
from models.pose import root_counts
from models.system import Batch, Losses
from models.systems.skeletondiffusion.networks import Decoder, Denoiser, Encoder, PastNetwork
from models.systems.skeletondiffusion.nodes import VELOCITY, CanonicalNodes, RootRelativeNodes
from models.systems.skeletondiffusion.noise import NodeGraph
from models.systems.skeletondiffusion.typed_graph import mixed

JUDGED_EVERY = 3
"""Of a candidate's frames, those that tell how near it is."""


class SkeletonDiffusion(nn.Module):
    """The parts of the system (Curreli et al. 2025, Fig. 3).

    Args:
        nodes: how motion lies on the graph.
        encoder: e.
        decoder: d.
        denoiser: g.
        past: what tells the denoiser of the observation; None takes e(X), as the paper does.
    """

    eigenvectors: Tensor
    latent_scale: Tensor
    autoencoder_updates: Tensor

    def __init__(
        self,
        *,
        nodes: CanonicalNodes | RootRelativeNodes,
        encoder: Encoder,
        decoder: Decoder,
        denoiser: Denoiser,
        past: PastNetwork | None,
    ) -> None:
        super().__init__()
        self.nodes = nodes
        self.encoder = encoder
        self.decoder = decoder
        self.denoiser = denoiser
        self.past = past
        vectors = torch.from_numpy(nodes.graph.eigen()[1]).float()
        self.register_buffer("eigenvectors", vectors, persistent=False)
        self.register_buffer("latent_scale", torch.ones(()))
        self.register_buffer("autoencoder_updates", torch.zeros((), dtype=torch.int64))

    def latent(self, batch: Batch) -> Float[Tensor, "N B L"]:
        """z = e(Y) in the denoiser's range."""
        z: Tensor = self.encoder(self.nodes.future(batch["observation"], batch["future"]))
        return z / self.latent_scale

    def condition(self, observation: Float[Tensor, "B T J 3"]) -> Float[Tensor, "N B C"]:
        """What the denoiser takes of the observation at every step."""
        observed = self.nodes.observed(observation)
        past = torch.tanh(self.encoder(observed)) if self.past is None else self.past(observed)
        condition: Tensor = self.denoiser.condition(past)
        return condition

    def motion(
        self, x0: Float[Tensor, "N B L"], start: Float[Tensor, "N B S"], *, every: int = 1
    ) -> Float[Tensor, "B frames F"]:
        """What a latent in the denoiser's range is decoded to, every so many frames."""
        outputs = self.decoder(x0 * self.latent_scale, start, self.nodes.decoder_ticks)
        return self.nodes.motion(outputs, start, every=every)

    def to_eigenbasis(self, z: Float[Tensor, "N B L"]) -> Float[Tensor, "N B L"]:
        """U^T z."""
        return mixed(self.eigenvectors.T, z)

    def from_eigenbasis(self, z: Float[Tensor, "N B L"]) -> Float[Tensor, "N B L"]:
        """U z."""
        return mixed(self.eigenvectors, z)


def _length(progress: float, horizon: int, *, full_at: float, longest_at: float) -> tuple[int, int]:
    """The shortest and the longest motion to learn now, in ticks."""
    rising = 0.5 - 0.5 * math.cos(math.pi * min(1.0, progress / longest_at))
    longest = max(1, round(horizon * rising))
    shortest = round(horizon * min(1.0, progress / full_at))
    return max(1, min(shortest, longest)), longest


def autoencoder_loss(  # noqa: PLR0913 - the settings of the stage
    network: SkeletonDiffusion,
    batch: Batch,
    generator: Generator,
    *,
    num_updates: int,
    longest_at: float,
    full_at: float,
    latent_noise: float,
) -> Losses:
    """Eqs. 9 and 10 with the curriculum of the supplement, section C.

    Motions of a random length are encoded and decoded; the longest grows to the horizon as a
    cosine until the share ``longest_at`` of the updates, the shortest linearly until ``full_at``.
    """
    progress = int(network.autoencoder_updates) / num_updates
    if network.training:
        network.autoencoder_updates += 1
    nodes = network.nodes
    shortest, longest = _length(progress, nodes.num_ticks, full_at=full_at, longest_at=longest_at)
    draw = torch.randint(shortest, longest + 1, (), generator=generator, device=generator.device)
    ticks = int(draw)
    ticks_to_decode = -(-ticks * nodes.decoder_ticks // nodes.num_ticks)
    observation, future = batch["observation"], batch["future"]
    z = network.encoder(nodes.future(observation, future)[:, :, :ticks])
    noise = torch.randn(z.shape, generator=generator, device=z.device)
    start = nodes.start(observation)
    outputs = network.decoder(z + latent_noise * noise, start, ticks_to_decode)
    missing = nodes.decoder_ticks - ticks_to_decode
    outputs = nn.functional.pad(outputs, (0, 0, 0, missing))
    frames = ticks * future.shape[1] // nodes.num_ticks
    difference = nodes.motion(outputs, start) - nodes.target(observation, future)
    error = motion_distance(nodes.weigh(difference)[:, :frames]).mean()
    return {"total": error, "latent deviation": z.detach().std()}


@torch.no_grad()
def fit_linear_parts(
    network: Any,
    next_batch: Callable[[], Batch],
    *,
    num_batches: int,
    deviation: float,
    whitening: float,
) -> None:
    """Measure the limbs' scale, and start the shortcuts as principal components of each type.

    Each type's components are turned until they go together with its neighbours', so that one
    channel means the same to all: as such they have neither order nor sign in common.
    The recurrences beside them start from nothing and learn what a linear code cannot say.

    Args:
        network: a SkeletonDiffusion on `CanonicalNodes`, with shortcuts.
        next_batch: source of batches.
        num_batches: how many of them to fit to.
        deviation: of the latents.
        whitening: 1 gives every latent the same variance, 0 that of its motion.
    """
    nodes: CanonicalNodes = network.nodes
    types = torch.tensor(nodes.graph.types)
    batches = [next_batch() for _ in range(num_batches)]
    moved = [nodes.future(batch["observation"], batch["future"]) for batch in batches]
    motions = torch.cat(moved, dim=1).flatten(2)  # (N, B, frames of x, y, z)
    for kind in range(nodes.graph.num_types):
        nodes.scale[types == kind] *= motions[types == kind].square().mean().sqrt().clamp(min=1e-3)
    motions /= nodes.scale[:, None, None]
    encode, decode = network.encoder.shortcut.features, network.decoder.shortcut.features
    latent = encode.weight.shape[2]
    to_points = torch.linalg.pinv(nodes.spline)
    for kind in range(nodes.graph.num_types):
        covariance = torch.cov(motions[types == kind].flatten(0, 1).T.double())
        values, vectors = (part.float() for part in torch.linalg.eigh(covariance))
        values = values[-latent:].clamp(min=1e-8)
        spread = values ** (whitening / 2)
        common = deviation / (values / spread.square()).mean().sqrt()
        encode.weight[kind] = vectors[:, -latent:] / spread * common
        back = (vectors[:, -latent:] * spread / common).T.unflatten(1, (-1, 3))  # (L, H, 3)
        decode.weight[kind] = 0
        decode.weight[kind, -latent:] = torch.matmul(to_points, back).flatten(1)
        glide = torch.matmul(to_points, nodes.glide) / nodes.scale[types == kind][0]
        decode.weight[kind, VELOCITY] = -torch.kron(glide.T, torch.eye(3))
    turns = _turns(torch.bmm(motions, encode.weight[types]), nodes.graph)
    encode.weight.copy_(torch.bmm(encode.weight, turns))
    decode.weight[:, -latent:] = torch.bmm(turns.transpose(1, 2), decode.weight[:, -latent:])
    for last in (network.encoder.latent.features, network.decoder.out.features):
        for parameter in last.parameters():
            parameter.zero_()


def _turns(latents: Float[Tensor, "N B L"], graph: NodeGraph) -> Float[Tensor, "types L L"]:
    """For each type the rotation that makes its covariance with its parents' latents greatest.

    Types form a tree as joints do, so from the root on each answer stands (Procrustes).
    """
    centred = latents - latents.mean(dim=1, keepdim=True)
    turns = [torch.eye(latents.shape[2])]
    for kind in range(1, graph.num_types):
        together = [
            centred[child].T @ centred[parent] @ turns[graph.types[parent]]
            for parent, child in graph.edges
            if graph.types[child] == kind
        ]
        left, _, right = torch.linalg.svd(torch.stack(together).sum(dim=0))
        turns.append(left @ right)
    return torch.stack(turns)


@torch.no_grad()
def measure_latents(
    network: SkeletonDiffusion,
    next_batch: Callable[[], Batch],
    *,
    num_batches: int,
    deviation: float,
) -> None:
    """Give the latents one common deviation over some batches."""
    latents = torch.cat([network.latent(next_batch()) for _ in range(num_batches)], dim=1)
    network.latent_scale.mul_(latents.square().mean().sqrt() / deviation)


def denoiser_loss(  # noqa: PLR0913 - the symbols of the equation
    network: SkeletonDiffusion,
    batch: Batch,
    generator: Generator,
    *,
    schedule: Schedule,
    num_candidates: int,
    reconstruction_weight: float,
    weighted_by_signal: bool,
    whitens_directions_alone: bool = False,
    noisiest_share: float = 0.0,
    root_weight: float = 1.0,
) -> Losses:
    """Eq. 12: of k candidates, the one whose motion is nearest to the real one learns.

    In motion the first three coordinates, the root's where nodes have it, count root_weight times
    what the nodes weigh them.

    All candidates are judged without gradients and in bfloat16; the winners are run again. Their
    latents learn by the whitened distance of eq. 11 (of first power), times alpha_bar where
    ``weighted_by_signal``; where ``reconstruction_weight`` is not 0, their motions learn too. With
    ``whitens_directions_alone`` the noise of a timestep counts in units of its mean over the
    directions, so that no timestep weighs more than another.
    """
    observation, future = batch["observation"], batch["future"]
    rows, device = len(future), future.device
    with torch.no_grad():
        z = network.to_eigenbasis(network.latent(batch))
        start = network.nodes.start(observation)
        target = network.nodes.target(observation, future)
        counts = root_counts(target[0, 0], root_weight)
    timestep = torch.randint(schedule.num_steps, (rows,), generator=generator, device=device)
    timestep[: round(noisiest_share * rows)] = schedule.num_steps - 1
    alpha_bar = torch.as_tensor(schedule.alpha_bar, dtype=z.dtype, device=device)[timestep]
    variance = torch.as_tensor(schedule.variance, dtype=z.dtype, device=device)[timestep].T
    noise = torch.randn((num_candidates, *z.shape), generator=generator, device=device).movedim(
        0, 2
    )
    x_t = q_sample(
        x0=z[:, :, None],
        noise=noise,
        alpha_bar=alpha_bar[:, None, None],
        variance=variance[:, :, None, None],
    )
    condition = network.condition(batch["seen"])
    with torch.no_grad(), torch.autocast(device.type, dtype=torch.bfloat16):
        near = _nearest(
            network, x_t, timestep, condition.bfloat16(), start.bfloat16(), target, counts
        )
    chosen = x_t[:, torch.arange(rows, device=device), near]
    x0 = network.denoiser(network.from_eigenbasis(chosen), timestep, condition)
    difference = network.to_eigenbasis(x0) - z
    shape = variance / variance.mean(dim=0) if whitens_directions_alone else variance
    whitened = (difference / shape[:, :, None].sqrt()).abs().mean(dim=(0, 2))
    latent = (whitened * alpha_bar if weighted_by_signal else whitened).mean()
    losses = {"total": latent, "latent": latent}
    if reconstruction_weight:
        motion = network.motion(x0, start)
        reconstruction = motion_distance(network.nodes.weigh(motion - target) * counts).mean()
        losses |= {
            "total": latent + reconstruction_weight * reconstruction,
            "reconstruction": reconstruction,
        }
    return losses


def _nearest(  # noqa: PLR0913 - the symbols of the equation
    network: SkeletonDiffusion,
    x_t: Float[Tensor, "N B k L"],
    timestep: Int[Tensor, "B"],
    condition: Float[Tensor, "N B C"],
    start: Float[Tensor, "N B S"],
    target: Float[Tensor, "B H F"],
    counts: Float[Tensor, "F"],
) -> Int[Tensor, "B"]:
    count = x_t.shape[2]
    x0 = network.denoiser(
        network.from_eigenbasis(x_t.flatten(1, 2)),
        timestep.repeat_interleave(count),
        condition.repeat_interleave(count, dim=1),
    )
    starts = start.repeat_interleave(count, dim=1)
    motion = network.motion(x0, starts, every=JUDGED_EVERY).unflatten(0, (-1, count))
    wanted = target[:, JUDGED_EVERY - 1 :: JUDGED_EVERY]
    return motion_distance(network.nodes.weigh(motion - wanted[:, None]) * counts).argmin(dim=1)
