"""Complete training runs of BeLFusion."""

import dataclasses
from functools import partial

from models.continuation import Continuation
from models.diffusion import sqrt_schedule
from models.pose import RootRelativePoses, WorldPoses
from models.protocols import AMASS, H36M, HELD_OUT, ONE_STYLE, TWO_SECONDS, mocap_data
from models.system import Data, Recipe, Stage, goes_on, stepwise
from models.systems.belfusion import objective, recurrent, spectral
from models.systems.belfusion.dense_unet import DenseUNet
from models.systems.belfusion.graphs import graphs
from models.systems.belfusion.objective import BeLFusion
from models.systems.belfusion.unet import PictureUNet

NUM_STEPS = 10


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class SpectralSizes:
    """Widths of our own form."""

    latent: int = 192
    context: int = 256
    encoder: int = 1024
    coupler: int = 256
    observation: int = 1024
    bases: int = 24
    num_target: int = 6
    levels: tuple[int, ...] = (512, 256, 128)


def build_spectral(*, data: Data, sizes: SpectralSizes, root_weight: float) -> BeLFusion:
    """Our form: everything dense, the world trajectory among the features."""
    representation = WorldPoses(data.skeleton, root_weight=root_weight)
    features = representation.num_features
    continuation = Continuation(
        features=features,
        num_target=sizes.num_target,
        horizon=data.horizon,
        bases=sizes.bases,
    )
    shared = {"features": features, "num_target": sizes.num_target, "latent": sizes.latent}
    return BeLFusion(
        representation=representation,
        num_target=sizes.num_target,
        behaviour_encoder=spectral.SpectralBehaviourEncoder(
            continuation, hidden=sizes.encoder, **shared
        ),
        coupler=spectral.SpectralCoupler(continuation, hidden=sizes.coupler, **shared),
        auxiliary=spectral.SpectralAuxiliaryDecoder(
            features=features,
            num_frames=sizes.num_target + data.horizon,
            latent=sizes.latent,
            hidden=sizes.coupler,
            bases=sizes.bases,
        ),
        observation=spectral.SpectralObservationAutoencoder(
            features=features,
            num_observed=data.num_observed,
            context=sizes.context,
            hidden=sizes.observation,
        ),
        denoiser=DenseUNet(
            latent=sizes.latent, context=sizes.context, widths=sizes.levels, num_steps=NUM_STEPS
        ),
        latent=sizes.latent,
        context=sizes.context,
    )


def build_recurrent(
    *,
    data: Data,
    latent: int = 128,
    context: int = 64,
    multipliers: tuple[int, ...] = (1, 2, 4, 8),
) -> BeLFusion:
    """The paper's form and sizes."""
    representation = RootRelativePoses(data.skeleton)
    features, num_target = representation.num_features, 3
    return BeLFusion(
        representation=representation,
        num_target=num_target,
        behaviour_encoder=recurrent.RecurrentBehaviourEncoder(
            features=features, latent=latent, hidden=128
        ),
        coupler=recurrent.RecurrentCoupler(
            features=features,
            num_target=num_target,
            horizon=data.horizon,
            latent=latent,
            hidden=128,
        ),
        auxiliary=recurrent.ConstantInputGRU(
            width=latent,
            hidden=128,
            features=features,
            num_frames=num_target + data.horizon,
        ),
        observation=recurrent.RecurrentObservationAutoencoder(
            features=features,
            num_observed=data.num_observed,
            context=context,
            hidden=(300, 200),
        ),
        denoiser=PictureUNet(picture=(latent // 8, 8), context=context, multipliers=multipliers),
        latent=latent,
        context=context,
    )


def mocap(
    *,
    shares: dict[str, float] | None = None,
    hold_out: tuple[str, ...] = (),
    updates: tuple[int, int, int, int] = (1_500, 500, 300, 14_000),
) -> Recipe:
    """Ours: 30 fps, half a second to two seconds, world trajectory, on public motion capture."""
    data = mocap_data(shares=shares, hold_out=hold_out)
    return _spectral_recipe("mocap", data, SpectralSizes(), updates)


def mocap_held_out() -> Recipe:
    """`mocap` without two styles, two subjects and four actions, to be measured on them."""
    return dataclasses.replace(mocap(hold_out=HELD_OUT), name="mocap_held_out")


def mocap_longer() -> Recipe:
    """A finished `mocap_held_out` goes on: what is measured."""
    return goes_on("mocap_longer", mocap_held_out(), num_updates=8_000, learning_rate=8e-4)


def mocap_one_style() -> Recipe:
    """`mocap` without one style, two subjects and four actions: is measured too."""
    return dataclasses.replace(mocap(hold_out=ONE_STYLE), name="mocap_one_style")


def mocap_everything() -> Recipe:
    """What ships: a finished `mocap_longer` goes on, on every training clip, latents kept."""
    return goes_on("mocap_everything", mocap(), num_updates=6_000, learning_rate=4e-4)


def mocap_cmu() -> Recipe:
    """`mocap` on the CMU database alone, whose terms permit commercial use."""
    return dataclasses.replace(
        mocap(shares={"cmu": 1.0}, updates=(1_500, 500, 300, 5_000)), name="mocap_cmu"
    )


def tiny() -> Recipe:
    """Seconds of training, for tests."""
    sizes = SpectralSizes(
        latent=16,
        context=16,
        encoder=32,
        coupler=32,
        observation=32,
        bases=8,
        num_target=3,
        levels=(32, 16),
    )
    recipe = _spectral_recipe("tiny", TWO_SECONDS, sizes, (8, 4, 4, 8), batch_size=16, candidates=4)
    return recipe


def tiny_recurrent() -> Recipe:
    """The paper's form after seconds of training, for tests."""
    recipe = h36m()
    return dataclasses.replace(
        recipe,
        name="tiny_recurrent",
        build=partial(build_recurrent, data=recipe.data, multipliers=(1, 2, 4)),
        stages=_recurrent_stages(
            updates=(2, 2, 2, 2),
            rates=(0.005, 0.0005),
            reconstruction_weight=5.0,
            batch_size=4,
            candidates=2,
        ),
    )


def h36m() -> Recipe:
    """The paper's sizes and protocol on Human3.6M: 50 Hz, 25 frames seen, 100 predicted."""
    return _recurrent_recipe(
        "h36m",
        H36M,
        _recurrent_stages(
            updates=(39_000, 39_000, 39_000, 34_000),
            rates=(0.005, 0.0005),
            reconstruction_weight=5.0,
        ),
    )


def amass() -> Recipe:
    """The paper's sizes and protocol on AMASS: 60 Hz, 30 frames seen, 120 predicted."""
    return _recurrent_recipe(
        "amass",
        AMASS,
        _recurrent_stages(
            updates=(78_000, 78_000, 39_000, 197_000),
            rates=(0.001, 0.005),
            reconstruction_weight=1.0,
        ),
    )


def _recurrent_recipe(name: str, data: Data, stages: tuple[Stage, ...]) -> Recipe:
    return Recipe(
        name=name,
        system="belfusion",
        description="BeLFusion at the paper's sizes and protocol: root-relative, root dropped.",
        data=data,
        build=partial(build_recurrent, data=data),
        graphs=graphs,
        stages=stages,
        schedule=sqrt_schedule(NUM_STEPS),
        x_t_shape=(128,),
        trajectory="root-relative",
        symmetries=("translation",),
    )


def _recurrent_stages(
    *,
    updates: tuple[int, int, int, int],
    rates: tuple[float, float],
    reconstruction_weight: float,
    batch_size: int = 64,
    candidates: int = 50,
) -> tuple[Stage, ...]:
    behaviour, coupler, observation, denoiser = updates
    main, auxiliary = rates
    epochs_10 = partial(stepwise, factor=0.9, steps=10)
    return (
        Stage(
            name="behaviour",
            loss=partial(objective.behaviour_loss, kl_weight=1e-4, adversarial_weight=0.05),
            trains=("behaviour_encoder", "coupler", "auxiliary"),
            num_updates=behaviour,
            batch_size=batch_size,
            learning_rate=main,
            learning_rates={"auxiliary": auxiliary},
            decay=epochs_10,
            amsgrad=True,
        ),
        Stage(
            name="coupler",
            loss=objective.coupler_loss,
            trains=("coupler",),
            num_updates=coupler,
            batch_size=batch_size,
            learning_rate=main,
            decay=partial(stepwise, factor=0.9, steps=20),
            amsgrad=True,
        ),
        Stage(
            name="observation",
            loss=objective.observation_loss,
            trains=("observation",),
            num_updates=observation,
            batch_size=batch_size,
            learning_rate=1e-3,
            decay=partial(stepwise, factor=0.8, steps=1),
            amsgrad=True,
        ),
        Stage(
            name="denoiser",
            prepare=partial(objective.measure_ranges, num_batches=50),
            loss=partial(
                objective.denoiser_loss,
                schedule=sqrt_schedule(NUM_STEPS),
                num_candidates=candidates,
                reconstruction_weight=reconstruction_weight,
            ),
            trains=("denoiser",),
            num_updates=denoiser,
            batch_size=batch_size,
            learning_rate=5e-4,
            decay=partial(stepwise, factor=0.9, steps=2),
            amsgrad=True,
            ema_decay=0.999,
        ),
    )


def _spectral_recipe(
    name: str,
    data: Data,
    sizes: SpectralSizes,
    updates: tuple[int, int, int, int],
    *,
    batch_size: int = 64,
    candidates: int = 24,
) -> Recipe:
    schedule = sqrt_schedule(NUM_STEPS)
    behaviour, coupler, observation, denoiser = updates
    return Recipe(
        name=name,
        system="belfusion",
        description="Latent diffusion of behaviour; half a second of 3D poses to two seconds.",
        data=data,
        build=partial(build_spectral, data=data, sizes=sizes, root_weight=2.0),
        graphs=graphs,
        schedule=schedule,
        x_t_shape=(sizes.latent,),
        stages=(
            Stage(
                name="behaviour",
                prepare=partial(
                    spectral.fit_linear_parts, num_batches=100, noise_m=0.004, whitening=0.5
                ),
                loss=partial(objective.behaviour_loss, kl_weight=1e-4, adversarial_weight=0.001),
                trains=("behaviour_encoder", "coupler", "auxiliary"),
                num_updates=behaviour,
                batch_size=batch_size,
                learning_rate=3e-4,
                warmup=min(200, behaviour),
                weight_decay=1e-4,
            ),
            Stage(
                name="coupler",
                loss=objective.coupler_loss,
                trains=("coupler",),
                num_updates=coupler,
                batch_size=batch_size,
                learning_rate=3e-4,
                weight_decay=1e-4,
            ),
            Stage(
                name="observation",
                prepare=partial(spectral.fit_observation_inputs, num_batches=100),
                loss=objective.observation_loss,
                trains=("observation",),
                num_updates=observation,
                batch_size=batch_size,
                learning_rate=1e-3,
            ),
            Stage(
                name="denoiser",
                prepare=partial(objective.measure_ranges, num_batches=50),
                loss=partial(
                    objective.denoiser_loss,
                    schedule=schedule,
                    num_candidates=candidates,
                    reconstruction_weight=15.0,
                    noisiest_share=0.5,
                    root_weight=0.5,
                ),
                trains=("denoiser", "observation.encoder"),
                num_updates=denoiser,
                batch_size=batch_size,
                learning_rate=1e-3,
                warmup=min(200, denoiser),
                weight_decay=1e-4,
                gradient_clip=1.0,
                ema_decay=0.999,
            ),
        ),
    )
