"""Complete training runs of the yardstick."""

from functools import partial

import numpy as np

from models.diffusion import isotropic
from models.protocols import HELD_OUT, ONE_STYLE, TWO_SECONDS, mocap_data
from models.system import Data, Recipe, Stage
from models.systems.yardstick.graphs import graphs
from models.systems.yardstick.networks import Yardstick, best_of_many_loss


def mocap() -> Recipe:
    """Two seconds of our motion capture; ten minutes on two cores."""
    return _recipe("mocap", mocap_data())


def mocap_held_out() -> Recipe:
    """`mocap` without two styles, two subjects and four actions, to be measured on them."""
    return _recipe("mocap_held_out", mocap_data(hold_out=HELD_OUT))


def mocap_one_style() -> Recipe:
    """`mocap` without one style, two subjects and four actions, to be measured on them."""
    return _recipe("mocap_one_style", mocap_data(hold_out=ONE_STYLE))


def tiny() -> Recipe:
    """Seconds of training, for tests."""
    return _recipe("tiny", TWO_SECONDS, noise=4, hidden=16, num_updates=8, batch_size=16)


def _recipe(
    name: str,
    data: Data,
    *,
    noise: int = 32,
    hidden: int = 1024,
    num_updates: int = 6_000,
    batch_size: int = 64,
) -> Recipe:
    return Recipe(
        name=name,
        system="yardstick",
        description="A feed-forward network with a vector of noise, best of 24.",
        data=data,
        build=partial(Yardstick, data, noise=noise, hidden=hidden, bases=24),
        graphs=graphs,
        schedule=isotropic(np.zeros(1)),
        x_t_shape=(noise,),
        stages=(
            Stage(
                name="yardstick",
                loss=partial(best_of_many_loss, num_candidates=24),
                trains=("enter", "add_noise", "network"),
                num_updates=num_updates,
                batch_size=batch_size,
                learning_rate=1e-3,
                warmup=min(200, num_updates),
                weight_decay=1e-4,
                gradient_clip=1.0,
                ema_decay=0.999,
            ),
        ),
    )
