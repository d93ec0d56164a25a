"""Complete training runs of SkeletonDiffusion."""

import dataclasses
from collections.abc import Callable
from functools import partial

import torch
from torch.nn import functional

from models.diffusion import Schedule, cosine_schedule
from models.motion.skeleton import BODY21
from models.protocols import AMASS, H36M, HELD_OUT, ONE_STYLE, TWO_SECONDS, mocap_data
from models.system import Data, Recipe, Stage, goes_on, stepwise
from models.systems.skeletondiffusion import objective
from models.systems.skeletondiffusion.graphs import graphs
from models.systems.skeletondiffusion.networks import Decoder, Denoiser, Encoder, PastNetwork
from models.systems.skeletondiffusion.nodes import CanonicalNodes, RootRelativeNodes
from models.systems.skeletondiffusion.noise import (
    NodeGraph,
    constant,
    falling,
    nonisotropic,
    with_root,
    without_root,
)
from models.systems.skeletondiffusion.objective import SkeletonDiffusion

NUM_STEPS = 10
DEFAULT_STEPS = 3  # the knee of the curve on `valid`
ROOT_WEIGHT = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class Sizes:
    """Widths of a network."""

    latent: int = 24
    hidden: int = 64
    encoder_layers: int = 1
    shortcuts: bool = True
    limit: float = 4.0
    past: int = 96
    width: int = 80
    depth: int = 1
    heads: int = 4
    head_width: int = 16
    time: int = 96
    joins_first: bool = False
    activation: Callable[[torch.Tensor], torch.Tensor] = functional.silu


def build(*, data: Data, sizes: Sizes, root_weight: float, rigid: bool = True) -> SkeletonDiffusion:
    """Our form: the hips a node with the trajectory, ``rigid`` limbs or positions that stretch."""
    nodes = CanonicalNodes(
        data.skeleton,
        num_observed=data.num_observed,
        horizon=data.horizon,
        frames_per_tick=10,
        knot_frames=3,
        knots_per_tick=7,
        root_weight=root_weight,
        rigid=rigid,
    )
    past = PastNetwork(
        nodes.graph, inputs=nodes.observed_width, width=sizes.past, activation=sizes.activation
    )
    return _network(nodes, sizes, past, past_width=sizes.past)


def build_paper(*, data: Data, sizes: Sizes, box_m: float) -> SkeletonDiffusion:
    """The paper's form: a frame per tick, the root dropped, e(X) as the past."""
    nodes = RootRelativeNodes(
        data.skeleton, num_observed=data.num_observed, horizon=data.horizon, box_m=box_m
    )
    return _network(nodes, sizes, None, past_width=sizes.latent)


def _network(
    nodes: CanonicalNodes | RootRelativeNodes,
    sizes: Sizes,
    past: PastNetwork | None,
    *,
    past_width: int,
) -> SkeletonDiffusion:
    return SkeletonDiffusion(
        nodes=nodes,
        encoder=Encoder(
            nodes.graph,
            inputs=nodes.inputs_per_tick,
            hidden=sizes.hidden,
            latent=sizes.latent,
            layers=sizes.encoder_layers,
            shortcut_ticks=nodes.num_ticks if sizes.shortcuts else 0,
            limit=sizes.limit,
        ),
        decoder=Decoder(
            nodes.graph,
            start=nodes.start_width,
            latent=sizes.latent,
            hidden=sizes.hidden,
            outputs=nodes.outputs_per_tick,
            shortcut_ticks=nodes.decoder_ticks if sizes.shortcuts else 0,
        ),
        denoiser=Denoiser(
            nodes.graph,
            latent=sizes.latent,
            past=past_width,
            width=sizes.width,
            depth=sizes.depth,
            heads=sizes.heads,
            head_width=sizes.head_width,
            time=sizes.time,
            num_steps=NUM_STEPS,
            activation=sizes.activation,
            joins_first=sizes.joins_first,
        ),
        past=past,
    )


def _autoencoder_stage(num_updates: int, *, batch_size: int = 64) -> Stage:
    return Stage(
        name="autoencoder",
        prepare=partial(objective.fit_linear_parts, num_batches=50, deviation=0.35, whitening=0.5),
        loss=partial(
            objective.autoencoder_loss,
            num_updates=num_updates,
            longest_at=0.1,
            full_at=0.5,
            latent_noise=0.05,
        ),
        trains=("encoder", "decoder"),
        num_updates=num_updates,
        batch_size=batch_size,
        learning_rate=2e-3,
        warmup=min(200, num_updates),
        weight_decay=1e-4,
        gradient_clip=1.0,
    )


def _denoiser_stage(
    num_updates: int, schedule: Schedule, *, batch_size: int = 64, candidates: int = 16
) -> Stage:
    return Stage(
        name="denoiser",
        prepare=partial(objective.measure_latents, num_batches=50, deviation=0.5),
        loss=partial(
            objective.denoiser_loss,
            schedule=schedule,
            num_candidates=candidates,
            reconstruction_weight=5.0,
            weighted_by_signal=False,
            whitens_directions_alone=True,
            noisiest_share=0.5,
            root_weight=0.5,
        ),
        trains=("denoiser", "past"),
        num_updates=num_updates,
        batch_size=batch_size,
        learning_rate=1e-3,
        warmup=min(200, num_updates),
        weight_decay=1e-4,
        gradient_clip=1.0,
        ema_decay=0.999,
    )


def _recipe(
    name: str,
    data: Data,
    sizes: Sizes,
    schedule: Schedule,
    *,
    stages: tuple[Stage, ...],
) -> Recipe:
    return Recipe(
        name=name,
        system="skeletondiffusion",
        description="Latent diffusion on the skeleton's graph; half a second to two seconds.",
        data=data,
        build=partial(build, data=data, sizes=sizes, root_weight=ROOT_WEIGHT),
        graphs=graphs,
        schedule=schedule,
        x_t_shape=(data.skeleton.num_joints, sizes.latent),
        default_steps=DEFAULT_STEPS,
        stages=stages,
    )


def _schedule(graph: NodeGraph, gamma: Callable[[float], float]) -> Schedule:
    return nonisotropic(cosine_schedule(NUM_STEPS).alpha_bar, graph.eigen()[0], gamma=gamma)


def _with_hips(gamma: Callable[[float], float]) -> Schedule:
    return _schedule(with_root(BODY21), gamma)


def mocap_autoencoder() -> Recipe:
    """The autoencoder that `mocap_held_out` and its ablations start from, held-out clips unseen."""
    return _recipe(
        "mocap_autoencoder",
        mocap_data(hold_out=HELD_OUT),
        Sizes(),
        _with_hips(falling),
        stages=(_autoencoder_stage(4_000),),
    )


def _held_out(name: str, schedule: Schedule, *, num_updates: int) -> Recipe:
    stages = (_denoiser_stage(num_updates, schedule),)
    return _recipe(name, mocap_data(hold_out=HELD_OUT), Sizes(), schedule, stages=stages)


def mocap_held_out() -> Recipe:
    """`mocap` without two styles, two subjects and four actions, to be measured on them.

    Goes on from a finished `mocap_autoencoder`.
    """
    return _held_out("mocap_held_out", _with_hips(falling), num_updates=5_000)


def mocap_longer() -> Recipe:
    """A finished `mocap_held_out`, or itself, goes on, latents kept: what is measured."""
    return goes_on("mocap_longer", mocap_held_out(), num_updates=5_000, learning_rate=8e-4)


def mocap_everything() -> Recipe:
    """What ships: a finished `mocap_longer` goes on, on every training clip, latents kept."""
    return goes_on("mocap_everything", mocap(), num_updates=2_000, learning_rate=4e-4)


def mocap_one_style() -> Recipe:
    """`mocap` in one long run without one style, two subjects and four actions: is measured."""
    return _in_one_run("mocap_one_style", mocap_data(hold_out=ONE_STYLE), num_updates=7_000)


def mocap_short() -> Recipe:
    """`mocap_held_out` after half of its updates, which is what ablations are compared with."""
    return _held_out("mocap_short", _with_hips(falling), num_updates=2_500)


def mocap_isotropic() -> Recipe:
    """The ablation of Table 4: `mocap_short` with noise that knows no skeleton."""
    return _held_out("mocap_isotropic", cosine_schedule(NUM_STEPS), num_updates=2_500)


def mocap_constant_gamma() -> Recipe:
    """The ablation of Table 4: `mocap_short` with gamma_t = 1."""
    return _held_out("mocap_constant_gamma", _with_hips(constant), num_updates=2_500)


def _positions(recipe: Recipe) -> Recipe:
    """The recipe where nodes say joint positions, as the paper's do, and limbs can stretch."""
    return dataclasses.replace(
        recipe,
        name=recipe.name.replace("mocap", "mocap_positions"),
        build=partial(build, data=recipe.data, sizes=Sizes(), root_weight=ROOT_WEIGHT, rigid=False),
    )


def mocap_positions_autoencoder() -> Recipe:
    """The autoencoder that the ablations on positions start from."""
    return _positions(mocap_autoencoder())


def mocap_positions_short() -> Recipe:
    """`mocap_short` on positions, from a finished `mocap_positions_autoencoder`."""
    return _positions(mocap_short())


def mocap_positions_isotropic() -> Recipe:
    """The ablation of Table 4 on positions: noise that knows no skeleton."""
    return _positions(mocap_isotropic())


def mocap() -> Recipe:
    """Ours: 30 fps, half a second to two seconds, world trajectory, on public motion capture."""
    return _in_one_run("mocap", mocap_data(), num_updates=5_000)


def _in_one_run(name: str, data: Data, *, num_updates: int) -> Recipe:
    schedule = _with_hips(falling)
    stages = (_autoencoder_stage(4_000), _denoiser_stage(num_updates, schedule))
    return _recipe(name, data, Sizes(), schedule, stages=stages)


def tiny() -> Recipe:
    """Seconds of training, for tests."""
    sizes = Sizes(latent=4, hidden=8, past=8, width=8, heads=2, head_width=4, time=8)
    schedule = _with_hips(falling)
    return _recipe(
        "tiny",
        TWO_SECONDS,
        sizes,
        schedule,
        stages=(
            _autoencoder_stage(8, batch_size=16),
            _denoiser_stage(8, schedule, batch_size=16, candidates=4),
        ),
    )


PAPER = Sizes(
    latent=96,
    hidden=96,
    encoder_layers=1,
    shortcuts=False,
    limit=1.0,
    width=192,
    depth=4,
    heads=8,
    head_width=32,
    time=768,
    joins_first=True,
    activation=torch.tanh,
)


def h36m() -> Recipe:
    """The paper's sizes and protocol on Human3.6M: 50 Hz, 25 frames seen, 100 predicted."""
    return _paper_recipe("h36m", H36M, PAPER, box_m=1.5, updates=(97_000, 48_500))


def amass() -> Recipe:
    """The paper's sizes and protocol on AMASS: 60 Hz, 30 frames seen, 120 predicted."""
    sizes = dataclasses.replace(PAPER, encoder_layers=2)
    return _paper_recipe("amass", AMASS, sizes, box_m=1.2, updates=(174_000, 87_000))


def tiny_paper() -> Recipe:
    """The paper's form after seconds of training, for tests."""
    sizes = dataclasses.replace(
        PAPER, latent=4, hidden=8, width=8, depth=1, heads=2, head_width=4, time=8
    )
    data = dataclasses.replace(H36M, horizon=20)
    return _paper_recipe(
        "tiny_paper", data, sizes, box_m=1.5, updates=(2, 2), batch_size=4, candidates=2
    )


def _paper_recipe(  # noqa: PLR0913 - the parts of a recipe
    name: str,
    data: Data,
    sizes: Sizes,
    *,
    box_m: float,
    updates: tuple[int, int],
    batch_size: int = 64,
    candidates: int = 50,
) -> Recipe:
    schedule = _schedule(without_root(data.skeleton), falling)
    autoencoder, denoiser = updates
    return Recipe(
        name=name,
        system="skeletondiffusion",
        description="SkeletonDiffusion at the paper's sizes: root-relative, root dropped.",
        data=data,
        build=partial(build_paper, data=data, sizes=sizes, box_m=box_m),
        graphs=graphs,
        schedule=schedule,
        x_t_shape=(data.skeleton.num_joints - 1, sizes.latent),
        eta=1.0,
        trajectory="root-relative",
        symmetries=("translation",),
        stages=(
            Stage(
                name="autoencoder",
                loss=partial(
                    objective.autoencoder_loss,
                    num_updates=autoencoder,
                    longest_at=1 / 30,
                    full_at=20 / 3,  # the shortest is a tenth of the horizon at two thirds
                    latent_noise=0.0,
                ),
                trains=("encoder", "decoder"),
                num_updates=autoencoder,
                batch_size=batch_size,
                learning_rate=5e-3,
                decay=partial(stepwise, factor=0.98, steps=200, flat=10),
                amsgrad=True,
                gradient_clip=1.0,
            ),
            Stage(
                name="denoiser",
                loss=partial(
                    objective.denoiser_loss,
                    schedule=schedule,
                    num_candidates=candidates,
                    reconstruction_weight=0.0,
                    weighted_by_signal=True,
                ),
                trains=("denoiser",),
                num_updates=denoiser,
                batch_size=batch_size,
                learning_rate=1e-3,
                decay=partial(stepwise, factor=0.99, steps=150, flat=75),
                gradient_clip=1.0,
                ema_decay=0.995,
            ),
        ),
    )
