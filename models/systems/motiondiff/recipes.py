"""Complete training runs of MotionDiff."""

import dataclasses
from functools import partial

import torch

from models.diffusion import linear_schedule
from models.motion.skeleton import HUMANEVA15
from models.pose import RootRelativePoses, WorldPoses
from models.protocols import H36M, HELD_OUT, ONE_STYLE, TWO_SECONDS, mocap_data
from models.system import Data, Recipe, Stage, goes_on, stepwise
from models.systems.motiondiff import keyframes, objective, paper
from models.systems.motiondiff.graphs import graphs
from models.systems.motiondiff.objective import MotionDiff
from models.systems.motiondiff.refiner import Refiner, SpreadRefiner

NUM_STEPS = 100
STEPS = 10


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class Sizes:
    """Widths of our own form."""

    num_frames: int = 12
    num_target: int = 6
    state: int = 256
    context: int = 256
    spatial_width: int = 96
    spatial_layers: int = 2
    temporal_width: int = 192
    temporal_layers: int = 4
    hidden: int = 64
    blocks: int = 2


def build_keyframes(*, data: Data, sizes: Sizes) -> MotionDiff:
    """Our form: keyframes of the world's motion, everything conditioned by scale and shift."""
    representation = WorldPoses(data.skeleton, root_weight=1.0)
    features = representation.num_features
    motion = keyframes.Keyframes(
        features=features,
        num_target=sizes.num_target,
        horizon=data.horizon,
        num_frames=sizes.num_frames,
    )
    return MotionDiff(
        representation=representation,
        motion=motion,
        encoder=keyframes.Encoder(
            features=features,
            num_observed=data.num_observed,
            width=sizes.spatial_width,
            layers=sizes.spatial_layers,
            state=sizes.state,
            context=sizes.context,
        ),
        denoiser=keyframes.Denoiser(
            shape=motion.shape,
            alpha_bar=torch.from_numpy(linear_schedule(NUM_STEPS).alpha_bar),
            context=sizes.context,
            spatial_width=sizes.spatial_width,
            spatial_layers=sizes.spatial_layers,
            temporal_width=sizes.temporal_width,
            temporal_layers=sizes.temporal_layers,
        ),
        refiner=SpreadRefiner(
            features=features,
            num_observed=data.num_observed,
            horizon=data.horizon,
            coefficients=sizes.num_frames,
            hidden=sizes.hidden,
            blocks=sizes.blocks,
        ),
        gamma=1.0,
    )


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class PaperSizes:
    """Widths of the paper's form."""

    width: int = 32
    spatial_layers: int = 4
    pose_layers: int = 4
    fused_layers: int = 3
    state: int = 512
    fused: int = 512
    coefficients: int = 80
    hidden: int = 256
    blocks: int = 12


def build_paper(*, data: Data, sizes: PaperSizes) -> MotionDiff:
    """The paper's form and sizes."""
    representation = RootRelativePoses(data.skeleton)
    features = representation.num_features
    return MotionDiff(
        representation=representation,
        motion=paper.Frames(features=features, horizon=data.horizon),
        encoder=paper.Encoder(
            num_joints=features // 3,
            width=sizes.width,
            layers=sizes.spatial_layers,
            state=sizes.state,
        ),
        denoiser=paper.Denoiser(
            horizon=data.horizon,
            num_joints=features // 3,
            alpha_bar=torch.from_numpy(linear_schedule(NUM_STEPS).alpha_bar),
            width=sizes.width,
            spatial_layers=sizes.spatial_layers,
            pose_layers=sizes.pose_layers,
            fused_layers=sizes.fused_layers,
            state=sizes.state,
            fused=sizes.fused,
        ),
        refiner=Refiner(
            features=features,
            num_observed=data.num_observed,
            horizon=data.horizon,
            coefficients=sizes.coefficients,
            hidden=sizes.hidden,
            blocks=sizes.blocks,
        ),
        gamma=0.01,
    )


def mocap(
    *,
    hold_out: tuple[str, ...] = (),
    updates: tuple[int, int] = (9_000, 400),
) -> Recipe:
    """Ours: 30 fps, half a second to two seconds, world trajectory, on public motion capture."""
    data = mocap_data(hold_out=hold_out)
    return _keyframe_recipe("mocap", data, Sizes(), updates=updates)


def mocap_held_out() -> Recipe:
    """`mocap` without two styles, two subjects and four actions, to be measured on them."""
    return dataclasses.replace(mocap(hold_out=HELD_OUT), name="mocap_held_out")


def mocap_diffusion_held_out() -> Recipe:
    """`mocap_held_out` without refinement: its first stage, shown as it is."""
    return _without_refinement(mocap_held_out(), name="mocap_diffusion_held_out")


def mocap_diffusion_longer() -> Recipe:
    """A finished `mocap_diffusion_held_out`, or itself, goes on: what is refined and measured."""
    return goes_on(
        "mocap_diffusion_longer", mocap_diffusion_held_out(), num_updates=15_000, learning_rate=7e-4
    )


def mocap_refinement_held_out() -> Recipe:
    """The last of several runs: a finished `mocap_diffusion_longer` gets its refinement."""
    recipe = mocap_held_out()
    return dataclasses.replace(recipe, name="mocap_refinement_held_out", stages=recipe.stages[1:])


def mocap_one_style() -> Recipe:
    """`mocap` in one long run without one style, two subjects and four actions: is measured."""
    recipe = mocap(hold_out=ONE_STYLE, updates=(18_000, 400))
    return dataclasses.replace(recipe, name="mocap_one_style")


def mocap_diffusion_one_style() -> Recipe:
    """`mocap_one_style` without refinement: its first stage, shown as it is."""
    return _without_refinement(mocap_one_style(), name="mocap_diffusion_one_style")


def mocap_without_spatial_transformer() -> Recipe:
    """`mocap`, each joint's trajectory embedded by itself."""
    recipe = mocap()
    return dataclasses.replace(
        recipe,
        name="mocap_without_spatial_transformer",
        build=partial(build_keyframes, data=recipe.data, sizes=Sizes(spatial_layers=0)),
    )


def h36m() -> Recipe:
    """The paper's sizes and protocol on Human3.6M: 50 Hz, 25 frames seen, 100 predicted."""
    return _paper_recipe("h36m", H36M, PaperSizes(), updates=(62_500, 31_250))


def humaneva() -> Recipe:
    """The same on HumanEva-I: 60 Hz, 15 frames seen, 60 predicted."""
    data = Data(skeleton=HUMANEVA15, fps=60.0, num_observed=15, horizon=60)
    return _paper_recipe("humaneva", data, PaperSizes(), updates=(62_500, 31_250))


def h36m_without_refinement() -> Recipe:
    """Table 2: the diffusion alone."""
    return _without_refinement(h36m(), name="h36m_without_refinement")


def h36m_without_spatial_transformer() -> Recipe:
    """Table 3, group 1: poses are embedded by a linear layer."""
    recipe = h36m()
    return dataclasses.replace(
        recipe,
        name="h36m_without_spatial_transformer",
        build=partial(build_paper, data=recipe.data, sizes=PaperSizes(spatial_layers=0)),
    )


def tiny() -> Recipe:
    """Seconds of training, for tests."""
    sizes = Sizes(
        num_frames=8,
        num_target=3,
        state=16,
        context=16,
        spatial_width=16,
        spatial_layers=1,
        temporal_width=16,
        temporal_layers=1,
        hidden=16,
        blocks=1,
    )
    data = TWO_SECONDS
    return _keyframe_recipe("tiny", data, sizes, updates=(8, 4), rows=(16, 4, 3))


def tiny_paper() -> Recipe:
    """The paper's form after seconds of training, for tests."""
    sizes = PaperSizes(
        width=8,
        spatial_layers=1,
        pose_layers=1,
        fused_layers=1,
        state=16,
        fused=32,
        coefficients=16,
        hidden=16,
        blocks=1,
    )
    data = H36M
    return _paper_recipe("tiny_paper", data, sizes, updates=(2, 2), rows=(4, 2, 2))


def _without_refinement(recipe: Recipe, *, name: str) -> Recipe:
    return dataclasses.replace(
        recipe, name=name, graphs=partial(graphs, refines=False), stages=recipe.stages[:1]
    )


def _constant_then_linear(progress: float, *, constant: float) -> float:
    return min(1.0, (1.0 - progress) / (1.0 - constant))


def _paper_recipe(
    name: str,
    data: Data,
    sizes: PaperSizes,
    *,
    updates: tuple[int, int],
    rows: tuple[int, int, int] = (64, 16, 50),
) -> Recipe:
    schedule = linear_schedule(NUM_STEPS)
    diffusion, refinement = updates
    batch_size, observations, samples = rows
    return Recipe(
        name=name,
        system="motiondiff",
        description="MotionDiff at the paper's sizes and protocol: root-relative, root dropped.",
        data=data,
        build=partial(build_paper, data=data, sizes=sizes),
        graphs=graphs,
        schedule=schedule,
        plan="stride",
        default_steps=STEPS,
        x_t_shape=(data.horizon, data.skeleton.num_joints - 1, 3),
        trajectory="root-relative",
        symmetries=("translation",),
        stages=(
            Stage(
                name="diffusion",
                loss=partial(objective.diffusion_loss, schedule=schedule),
                trains=("denoiser", "encoder"),
                num_updates=diffusion,
                batch_size=batch_size,
                learning_rate=5e-4,
                decay=partial(_constant_then_linear, constant=0.1),
            ),
            Stage(
                name="refinement",
                loss=partial(
                    objective.refinement_loss,
                    schedule=schedule,
                    num_samples=samples,
                    num_steps=STEPS,
                    sigma=1e5,
                    reconstruction_weight=200 / 1e5,
                    diversity_weight=1.0,
                ),
                trains=("refiner",),
                num_updates=refinement,
                batch_size=observations,
                learning_rate=5e-4,
                decay=partial(stepwise, factor=0.96, steps=50),
                gradient_clip=1.0,
            ),
        ),
    )


def _keyframe_recipe(
    name: str,
    data: Data,
    sizes: Sizes,
    *,
    updates: tuple[int, int],
    rows: tuple[int, int, int] = (64, 16, 25),
) -> Recipe:
    schedule = linear_schedule(NUM_STEPS)
    diffusion, refinement = updates
    batch_size, observations, samples = rows
    return Recipe(
        name=name,
        system="motiondiff",
        description="Diffusion of motion, then refinement; half a second of 3D poses to two.",
        data=data,
        build=partial(build_keyframes, data=data, sizes=sizes),
        graphs=graphs,
        schedule=schedule,
        plan="stride",
        default_steps=STEPS,
        x_t_shape=(sizes.num_frames, data.skeleton.num_joints, 3),
        stages=(
            Stage(
                name="diffusion",
                prepare=partial(
                    objective.fit_motion, num_batches=100, noise_m=0.004, whitening=0.5
                ),
                loss=partial(objective.weighted_diffusion_loss, schedule=schedule),
                trains=("denoiser", "encoder"),
                num_updates=diffusion,
                batch_size=batch_size,
                learning_rate=1e-3,
                warmup=min(300, diffusion),
                weight_decay=1e-2,
                gradient_clip=1.0,
                ema_decay=0.999,
            ),
            Stage(
                name="refinement",
                prepare=partial(objective.fit_refiner, num_batches=200),
                loss=partial(
                    objective.refinement_loss,
                    schedule=schedule,
                    num_samples=samples,
                    num_steps=STEPS,
                    sigma=20.0,
                    reconstruction_weight=1.0,
                    diversity_weight=10.0,
                    exponent=1.0,
                    root_weight=1.5,
                    root_diversity=0.0,
                ),
                trains=("refiner",),
                num_updates=refinement,
                batch_size=observations,
                learning_rate=1e-3,
                warmup=min(100, refinement),
                gradient_clip=1.0,
                ema_decay=0.999,
            ),
        ),
    )
