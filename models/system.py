"""The written contract of a system: what training needs of it to train, export and evaluate.

A system is one folder in ``models/systems`` whose ``recipes.py`` holds functions that each return
a complete `Recipe`. Training calls nothing of a system but what its recipe hands over.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Generator, Tensor, nn

from models.diffusion import Plan, Schedule
from models.motion.skeleton import Skeleton

Batch = Mapping[str, Tensor]
"""``observation (B, T, J, 3)``, ``seen``, the same with sensor noise, and ``future (B, H, J, 3)``.

All in metres, in the world of the capture. Recipes with `Data.actions` get three more of int64:
``action (B,)``, the label that the future performs; ``first (B,)``, the frames of the future that
nobody has seen, which lead over from the observation; ``length (B,)``, those after which the
action has ended and its last pose is repeated. The future from ``first`` on is to be learnt up to
``length`` + `Actions.padding`; what stands outside is filled with the nearest known frame.
"""

Losses = dict[str, Tensor]
"""Named scalar terms; the loop minimises ``total``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Augmentation:
    """How a training window is varied; every amount is the half-width of a uniform draw."""

    mirror: bool = True
    yaw: bool = True
    slowest: float = 1.0
    fastest: float = 1.0
    body_scale: float = 0.0
    bone_scale: float = 0.0
    observation_noise: float = 0.0
    """Standard deviation in metres; half of the windows get none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Actions:
    """Labelled actions to learn, and how observations and actions are paired (Mao et al. 2022)."""

    labels: Mapping[str, tuple[str, ...]]
    """Selectors of clips, such as ``action=walk``, by the label that they are learnt under."""
    examples: Mapping[str, str] = field(default_factory=dict)
    other_share: float = 0.5
    """Share of pairs whose observation is from a clip of another action."""
    padding: int = 20
    """P: frames after the end in which the model learns to stand still."""
    longest_transition: int = 25
    chunk_frames: int = 20
    min_frames: int = 15
    stop_threshold_m: float = 0.02


@dataclass(frozen=True, kw_only=True, slots=True)
class Data:
    """Which windows a recipe learns from."""

    skeleton: Skeleton
    fps: float
    num_observed: int
    horizon: int
    shares: Mapping[str, float] | None = None
    """Share of the windows by source prefix; None draws every window alike."""
    hold_out: tuple[str, ...] = ()
    """Selectors such as ``style=tired`` of clips that must not be learnt from."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    actions: Actions | None = None
    """Where given, whole actions are learnt instead of windows; ``horizon`` is the longest."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Stage:
    """One run of the training loop over a part of the network."""

    name: str
    loss: Callable[[Any, Batch, Generator], Losses]
    trains: tuple[str, ...]
    """Submodules that learn; the others are frozen."""
    num_updates: int
    batch_size: int
    learning_rate: float
    learning_rates: Mapping[str, float] = field(default_factory=dict)
    """Submodules whose rate differs."""
    warmup: int = 0
    decay: Callable[[float], float] | None = None
    """Factor on the rate as a function of the progress in [0, 1]; None falls to 0 as a cosine."""
    amsgrad: bool = False
    weight_decay: float = 0.0
    gradient_clip: float | None = None
    ema_decay: float | None = None
    prepare: Callable[[Any, Callable[[], Batch]], None] | None = None
    """Called once before the stage with the network and a source of batches (statistics)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Graph:
    """A module that becomes one ONNX file: metres in, metres out, no random op."""

    role: str
    """``encoder``, ``denoiser`` or ``decoder``."""
    module: nn.Module
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Recipe:
    """A complete description of a training run and of the bundle that it makes."""

    name: str
    system: str
    description: str
    data: Data
    build: Callable[[], nn.Module]
    graphs: Callable[[Any], tuple[Graph, ...]]
    stages: tuple[Stage, ...] = ()
    schedule: Schedule | None = None
    plan: Plan = "stop_early"
    default_steps: int | None = None
    """Denoising steps that the bundle runs by default; None runs all."""
    x_t_shape: tuple[int, ...] = ()
    eta: float = 0.0
    """How the bundle samples: 0 by DDIM, 1 by DDPM."""
    trajectory: str = "world"
    symmetries: tuple[str, ...] = ("yaw", "translation")


def stepwise(progress: float, *, factor: float, steps: int, flat: int = 0) -> float:
    """A decay that multiplies by a factor at every step of a run but the first ``flat``."""
    return factor ** max(0, int(progress * steps) - flat)


def goes_on(name: str, recipe: Recipe, *, num_updates: int, learning_rate: float) -> Recipe:
    """The last stage of a recipe alone, for a run that goes on from a finished one, unprepared."""
    last = dataclasses.replace(
        recipe.stages[-1], prepare=None, num_updates=num_updates, learning_rate=learning_rate
    )
    return dataclasses.replace(recipe, name=name, stages=(last,))


def describe(value: Any) -> Any:
    """A recipe, or any part of it, as JSON: functions by dotted name, with their arguments."""
    if isinstance(value, functools.partial):
        arguments = {key: describe(item) for key, item in value.keywords.items()}
        positional = [describe(item) for item in value.args]
        return {"function": describe(value.func), "args": positional, **arguments}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: describe(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): describe(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [describe(item) for item in value]
    if hasattr(value, "tolist"):
        return value.tolist()
    if callable(value):
        return f"{value.__module__}.{value.__qualname__}"
    return value
