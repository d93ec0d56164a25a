"""Complete training runs of WAT."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

from models.articulated_poses import ArticulatedPoses
from models.motion.skeleton import BODY21, SMPL22
from models.system import Actions, Augmentation, Data, Recipe, Stage
from models.systems.wat import objective
from models.systems.wat.graphs import graphs
from models.systems.wat.objective import WAT
from models.systems.wat.recurrent import RecurrentVAE
from models.systems.wat.timing import NUM_TIMES, Rhythm
from models.systems.wat.transformer import TransformerVAE

FRAMES_PER_STEP = 5
MOCAP_EXAMPLES = {
    "raise-up-both-hands": "lifts both hands over the head and lowers them",
    "raise-up-left-hand": "lifts the left hand over the head and lowers it",
    "raise-up-right-hand": "lifts the right hand over the head and lowers it",
    "run": "runs ahead and stops",
    "walk": "walks ahead and stops",
    "walk-turn-left": "walks, turns to the left and stops",
    "walk-turn-right": "walks, turns to the right and stops",
    "wave-both-hands": "waves with both hands",
    "wave-left-hand": "waves with the left hand",
    "wave-right-hand": "waves with the right hand",
}


HELD_OUT = ("style=feminine",)

MOCAP_LABELS = {label: (f"action={label}&source=bandai*",) for label in MOCAP_EXAMPLES}
"""The labels with a hundred clips or more; the others have two to thirty and are left out."""


def build_recurrent(
    *,
    data: Data,
    latent: int,
    hidden: int,
    widths: tuple[int, int],
    frames_per_step: int,
) -> WAT:
    """The recurrent form."""
    poses = ArticulatedPoses(data.skeleton)
    form = RecurrentVAE(
        features=poses.num_features,
        num_actions=len(_actions(data).labels),
        latent=latent,
        hidden=hidden,
        widths=widths,
        frames_per_step=frames_per_step,
    )
    return WAT(poses=poses, rhythm=Rhythm(data.skeleton), form=form)


def build_transformer(
    *,
    data: Data,
    width: int,
    heads: int,
    feed_forward: int,
    layers: int,
    frames_per_step: int,
) -> WAT:
    """The Transformer form."""
    poses = ArticulatedPoses(data.skeleton)
    form = TransformerVAE(
        features=poses.num_features,
        num_actions=len(_actions(data).labels),
        num_observed=data.num_observed,
        horizon=data.horizon,
        width=width,
        heads=heads,
        feed_forward=feed_forward,
        layers=layers,
        frames_per_step=frames_per_step,
    )
    return WAT(poses=poses, rhythm=Rhythm(data.skeleton), form=form)


def mocap() -> Recipe:
    """Ours, recurrent: the labelled actions of Bandai-Namco's datasets, 30 fps, up to 10 s."""
    return _mocap_recurrent("mocap", _mocap_data())


def mocap_transformer() -> Recipe:
    """Ours, as a Transformer."""
    return _mocap_transformer("mocap_transformer", _mocap_data())


def mocap_held_out() -> Recipe:
    """`mocap` without a style, to be measured on it."""
    return _mocap_recurrent("mocap_held_out", _mocap_data(hold_out=HELD_OUT))


def mocap_transformer_held_out() -> Recipe:
    """`mocap_transformer` without a style, to be measured on it."""
    return _mocap_transformer("mocap_transformer_held_out", _mocap_data(hold_out=HELD_OUT))


def mocap_without_padding() -> Recipe:
    """`mocap_held_out`, never shown how to stand still: what P buys."""
    return _mocap_recurrent("mocap_without_padding", _mocap_data(hold_out=HELD_OUT, padding=0))


def mocap_without_weak_supervision() -> Recipe:
    """`mocap_held_out`, every pair from one clip: what pairs of two actions buy."""
    data = _mocap_data(hold_out=HELD_OUT, other_share=0.0)
    return _mocap_recurrent("mocap_without_weak_supervision", data)


def mocap_transformer_without_padding() -> Recipe:
    """`mocap_transformer_held_out`, never shown how to stand still."""
    data = _mocap_data(hold_out=HELD_OUT, padding=0)
    return _mocap_transformer("mocap_transformer_without_padding", data)


def mocap_transformer_without_weak_supervision() -> Recipe:
    """`mocap_transformer_held_out`, every pair from one clip."""
    data = _mocap_data(hold_out=HELD_OUT, other_share=0.0)
    return _mocap_transformer("mocap_transformer_without_weak_supervision", data)


def tiny() -> Recipe:
    """Seconds of training, for tests."""
    return _recurrent(
        "tiny",
        _tiny_data(),
        sizes={"latent": 8, "hidden": 16, "widths": (16, 16), "frames_per_step": 5},
        stage=_stage(_tiny_data(), num_updates=4, batch_size=8),
    )


def tiny_transformer() -> Recipe:
    """Seconds of training, for tests."""
    return _transformer(
        "tiny_transformer",
        _tiny_data(),
        sizes={"width": 16, "heads": 2, "feed_forward": 16, "layers": 2, "frames_per_step": 5},
        stage=_stage(_tiny_data(), num_updates=4, batch_size=8),
    )


def grab() -> Recipe:
    """The paper's sizes and protocol on GRAB, recurrent."""
    return _paper_recurrent("grab", GRAB)


def grab_transformer() -> Recipe:
    """The paper's sizes and protocol on GRAB, as a Transformer."""
    return _paper_transformer("grab_transformer", GRAB)


def ntu() -> Recipe:
    """The paper's sizes and protocol on NTU RGB-D, recurrent."""
    return _paper_recurrent("ntu", NTU, samples_per_epoch=4_000, smooth_weight=20.0)


def ntu_transformer() -> Recipe:
    """The paper's sizes and protocol on NTU RGB-D, as a Transformer."""
    return _paper_transformer(
        "ntu_transformer",
        NTU,
        feed_forward=512,
        layers=8,
        samples_per_epoch=4_000,
        reconstruction_weight=100.0,
        smooth_weight=20.0,
    )


def babel() -> Recipe:
    """The paper's sizes and protocol on BABEL, recurrent."""
    return _paper_recurrent(
        "babel",
        BABEL,
        sizes={"latent": 256, "hidden": 256, "widths": (512, 256), "frames_per_step": 1},
        samples_per_epoch=10_000,
        batch_size=64,
        rate=1e-3,
        reconstruction_weight=50.0,
        smooth_weight=10.0,
    )


def babel_transformer() -> Recipe:
    """The paper's sizes and protocol on BABEL, as a Transformer."""
    return _paper_transformer(
        "babel_transformer",
        BABEL,
        samples_per_epoch=10_000,
        batch_size=64,
        rate=1e-4,
        reconstruction_weight=100.0,
        smooth_weight=10.0,
    )


def humanact12() -> Recipe:
    """The paper's sizes and protocol on HumanAct12, recurrent."""
    return _paper_recurrent("humanact12", HUMANACT12)


def humanact12_transformer() -> Recipe:
    """The paper's sizes and protocol on HumanAct12, as a Transformer."""
    return _paper_transformer("humanact12_transformer", HUMANACT12, padding=50)


_MOCAP_AUGMENTATION = Augmentation(
    yaw=False,  # the canonical frame undoes it
    slowest=0.9,
    fastest=1.1,
    body_scale=0.05,
    bone_scale=0.06,
    observation_noise=0.005,
)


def _mocap_data(
    *, hold_out: tuple[str, ...] = (), padding: int = 20, other_share: float = 0.5
) -> Data:
    return Data(
        skeleton=BODY21,
        fps=30.0,
        num_observed=15,
        horizon=300,
        hold_out=hold_out,
        augmentation=_MOCAP_AUGMENTATION,
        actions=Actions(
            labels=MOCAP_LABELS,
            examples=MOCAP_EXAMPLES,
            other_share=other_share,
            padding=padding,
            chunk_frames=50,
            min_frames=15,
            stop_threshold_m=0.06,
        ),
    )


def _tiny_data() -> Data:
    actions = Actions(
        labels={"wave-left-hand": ("action=wave-left-hand",), "walk": ("action=walk",)},
        padding=10,
        chunk_frames=10,
    )
    return Data(skeleton=BODY21, fps=30.0, num_observed=15, horizon=40, actions=actions)


def _paper_data(*, labels: tuple[str, ...], num_observed: int, horizon: int, shortest: int) -> Data:
    return Data(
        skeleton=SMPL22,
        fps=30.0,
        num_observed=num_observed,
        horizon=horizon,
        augmentation=Augmentation(mirror=False),
        actions=Actions(
            labels={label: (f"action={label}",) for label in labels},
            padding=50,
            chunk_frames=10,
            min_frames=shortest - num_observed,
        ),
    )


GRAB = _paper_data(
    labels=("pass", "lift", "inspect", "drink"), num_observed=25, horizon=526, shortest=100
)
NTU = _paper_data(
    labels=tuple(f"{number}" for number in (6, 7, 8, 9, 22, 23, 24, 38, 80, 93, 99, 100, 102)),
    num_observed=10,
    horizon=241,
    shortest=35,
)
HUMANACT12 = _paper_data(
    labels=tuple(
        [
            "warm_up",
            "walk",
            "run",
            "jump",
            "drink",
            "lift_dumbbell",
            "sit",
            "eat",
            "turn_steering_wheel",
            "phone",
            "boxing",
            "throw",
        ]
    ),
    num_observed=10,
    horizon=330,
    shortest=35,
)
BABEL = _paper_data(
    labels=tuple(
        [
            "stand",
            "walk",
            "step",
            "stretch",
            "sit",
            "place_something",
            "take/pick_something_up",
            "bend",
            "stand_up",
            "jump",
            "throw",
            "kick",
            "run",
            "catch",
            "wave",
            "squat",
            "punch",
            "jog",
            "kneel",
            "hop",
        ]
    ),
    num_observed=10,
    horizon=340,
    shortest=30,
)


def _mocap_recurrent(name: str, data: Data) -> Recipe:
    sizes = {
        "latent": 64,
        "hidden": 256,
        "widths": (300, 200),
        "frames_per_step": FRAMES_PER_STEP,
    }
    return _recurrent(
        name, data, sizes=sizes, stage=_stage(data, num_updates=5_000), spreads=(0.3, 0.5)
    )


def _mocap_transformer(name: str, data: Data) -> Recipe:
    sizes = {
        "width": 128,
        "heads": 4,
        "feed_forward": 256,
        "layers": 4,
        "frames_per_step": FRAMES_PER_STEP,
    }
    stage = _stage(data, num_updates=5_000, rate=5e-4)
    return _transformer(name, data, sizes=sizes, stage=stage, spreads=(0.2, 0.5))


def _paper_recurrent(
    name: str, data: Data, *, sizes: dict[str, Any] | None = None, **terms: Any
) -> Recipe:
    sizes = sizes or {"latent": 128, "hidden": 128, "widths": (300, 200), "frames_per_step": 1}
    return _recurrent(name, data, sizes=sizes, stage=_paper_stage(data, **terms))


def _paper_transformer(
    name: str,
    data: Data,
    *,
    feed_forward: int = 256,
    layers: int = 6,
    padding: int = 20,
    **terms: Any,
) -> Recipe:
    data = dataclasses.replace(data, actions=dataclasses.replace(_actions(data), padding=padding))
    sizes = {
        "width": 128,
        "heads": 4,
        "feed_forward": feed_forward,
        "layers": layers,
        "frames_per_step": 1,
    }
    terms = {"rate": 5e-4, "reconstruction_weight": 1_000.0} | terms
    return _transformer(name, data, sizes=sizes, stage=_paper_stage(data, **terms))


def _recurrent(
    name: str,
    data: Data,
    *,
    sizes: dict[str, Any],
    stage: Stage,
    spreads: tuple[float, float] = (1.0, 1.0),
) -> Recipe:
    build = partial(build_recurrent, data=data, **sizes)
    return _recipe(name, data, build, stage, latent=sizes["latent"], spreads=spreads)


def _transformer(
    name: str,
    data: Data,
    *,
    sizes: dict[str, Any],
    stage: Stage,
    spreads: tuple[float, float] = (1.0, 1.0),
) -> Recipe:
    # Its decoder needs no recursion: one chunk is the whole of an action.
    actions = dataclasses.replace(_actions(data), chunk_frames=data.horizon)
    data = dataclasses.replace(data, actions=actions)
    build = partial(build_transformer, data=data, **sizes)
    return _recipe(name, data, build, stage, latent=sizes["width"], spreads=spreads)


def _recipe(
    name: str,
    data: Data,
    build: Callable[[], WAT],
    stage: Stage,
    *,
    latent: int,
    spreads: tuple[float, float],
) -> Recipe:
    size_of_z = latent + NUM_TIMES
    return Recipe(
        name=name,
        system="wat",
        description="Performs labelled actions one after the other, each as long as it takes.",
        data=data,
        build=build,
        graphs=partial(
            graphs,
            size_of_z=size_of_z,
            chunk_frames=_actions(data).chunk_frames,
            horizon=data.horizon,
            spreads=spreads,
        ),
        stages=(stage,),
        x_t_shape=(size_of_z,),
    )


def _stage(  # noqa: PLR0913 - the terms of the loss
    data: Data,
    *,
    num_updates: int,
    batch_size: int = 32,
    rate: float = 2e-3,
    reconstruction_weight: float = 3_000.0,
    smooth_weight: float = 300.0,
    step_weight: float = 20_000.0,
    kl_weight: float = 0.1,
    told: tuple[float, float] = (0.0, 1.0),
) -> Stage:
    return Stage(
        name="vae",
        prepare=partial(objective.fit_poses, num_batches=20),
        loss=partial(
            objective.loss,
            reconstruction_weight=reconstruction_weight,
            smooth_weight=smooth_weight,
            step_weight=step_weight,
            kl_weight=kl_weight,
            padding=_actions(data).padding,
            told=told,
        ),
        trains=("form",),
        num_updates=num_updates,
        batch_size=batch_size,
        learning_rate=rate,
        warmup=min(200, num_updates),
        weight_decay=1e-4,
        gradient_clip=1.0,
        ema_decay=0.999,
    )


def _constant_then_falling(progress: float) -> float:
    return min(1.0, (1.0 - progress) / 0.8)


def _paper_stage(
    data: Data,
    *,
    samples_per_epoch: int = 1_000,
    batch_size: int = 128,
    rate: float = 2e-3,
    reconstruction_weight: float = 100.0,
    smooth_weight: float = 100.0,
) -> Stage:
    stage = _stage(
        data,
        num_updates=500 * samples_per_epoch // batch_size,
        batch_size=batch_size,
        rate=rate,
        reconstruction_weight=reconstruction_weight,
        smooth_weight=smooth_weight,
        step_weight=0.0,
        kl_weight=1.0,
        told=(0.0, 0.0),
    )
    return dataclasses.replace(
        stage,
        decay=_constant_then_falling,
        warmup=0,
        weight_decay=0.0,
        gradient_clip=None,
        ema_decay=None,
    )


def _actions(data: Data) -> Actions:
    if data.actions is None:
        raise ValueError("data: found no actions; this system learns labelled actions.")
    return data.actions
