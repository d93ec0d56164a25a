"""The baselines as bundles; nothing is trained."""

from functools import partial

from torch import nn

from models.motion.skeleton import BODY21
from models.system import Data, Recipe
from models.systems.baselines.graphs import ConstantVelocity, ZeroVelocity, graphs

DATA = Data(skeleton=BODY21, fps=30.0, num_observed=15, horizon=60)


def _untrained(name: str, description: str, module: type[nn.Module], **sizes: int) -> Recipe:
    return Recipe(
        name=name,
        system="baselines",
        description=description,
        data=DATA,
        build=partial(module, horizon=DATA.horizon, **sizes),
        graphs=graphs,
    )


def zero_velocity() -> Recipe:
    """Hold the last pose."""
    return _untrained(
        "zero_velocity", "The last observed pose, held for two seconds.", ZeroVelocity
    )


def constant_velocity() -> Recipe:
    """Hold the last pose and keep walking."""
    return _untrained(
        "constant_velocity",
        "The last observed pose, carried on at the hips' mean velocity of the last 5 frames.",
        ConstantVelocity,
        num_frames=5,
    )
