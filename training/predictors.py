"""Whatever can answer an observation: bundles, by way of the server's own code, and references."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from models.motion.axes import Axes
from models.motion.kinematics import bone_lengths, fit_bone_lengths
from models.motion.skeleton import Skeleton
from service.engine.engine import Engine
from service.engine.trajectory import Request
from service.futures import BoneLengths, caller_futures, written
from service.observation import Seen, observe
from training.data.store import Store
from training.data.windows import Windows
from training.retrieval import nearest_windows, retrieved_futures

VELOCITY_FRAMES = 5

Observations = Float[np.ndarray, "B T J 3"]
Answer = dict[BoneLengths, np.ndarray]
"""Futures (S, H, J, 3) of one observation, for each treatment of bones that was asked for."""


Predictor = Callable[[Observations, Sequence[BoneLengths]], Iterator[Answer]]
"""Answers observations, one after another, in order."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BundlePredictor:
    """A bundle as HTTP users meet it: observation read, engine run, futures fitted and rounded.

    Observation i is asked with the seed ``seed + i``.
    """

    engine: Engine
    num_samples: int
    num_steps: int | None
    seed: int

    def __call__(
        self, observations: Observations, bones: Sequence[BoneLengths]
    ) -> Iterator[Answer]:
        """One answer for each observation, in order."""
        manifest = self.engine.manifest
        skeleton = manifest.skeleton.skeleton()
        seen = [
            observe(
                Seen(
                    world=observation,
                    skeleton=skeleton,
                    order=tuple(range(skeleton.num_joints)),
                ),
                axes=Axes(),
                fps=manifest.fps,
                manifest=manifest,
            )
            for observation in observations.astype(np.float64)
        ]
        requests = (
            Request(
                observation=observation.positions,
                num_samples=self.num_samples,
                num_steps=self.num_steps,
                seed=self.seed + i,
            )
            for i, observation in enumerate(seen)
        )
        for result, observation in zip(self.engine.run(requests), seen, strict=True):
            yield {
                kind: written(
                    caller_futures(
                        result.futures, observation, manifest=manifest, bone_lengths=kind
                    ),
                    observation.caller,
                )
                for kind in bones
            }


def held(observation: Float[np.ndarray, "T J 3"], horizon: int) -> Float[np.ndarray, "H J 3"]:
    """The last pose, at every frame."""
    return np.repeat(observation[-1:], horizon, axis=0)


def carried_on(observation: Float[np.ndarray, "T J 3"], horizon: int) -> Float[np.ndarray, "H J 3"]:
    """The last pose, carried on at the root's mean velocity over the last few frames."""
    frames = np.arange(1, horizon + 1, dtype=np.float32)[:, None, None]
    root = observation[-1 - VELOCITY_FRAMES :, :1]
    return observation[-1] + frames * ((root[-1] - root[0]) / (len(root) - 1))


@dataclass(frozen=True, kw_only=True, slots=True)
class Extrapolation:
    """One future by a rule, from the observation alone."""

    rule: Callable[[np.ndarray, int], np.ndarray]
    skeleton: Skeleton
    horizon: int

    def __call__(
        self, observations: Observations, bones: Sequence[BoneLengths]
    ) -> Iterator[Answer]:
        """One answer for each observation, in order."""
        for observation in observations:
            future = self.rule(observation, self.horizon)
            yield _fitted(future[None], observation, self.skeleton, bones)


@dataclass(frozen=True, kw_only=True, slots=True)
class Retrieval:
    """What training clips did after the windows nearest to the observation."""

    store: Store
    windows: Windows
    horizon: int
    num_samples: int

    def __call__(
        self, observations: Observations, bones: Sequence[BoneLengths]
    ) -> Iterator[Answer]:
        """One answer for each observation, in order."""
        near: Int[np.ndarray, "B S"] = nearest_windows(
            observations, store=self.store, windows=self.windows, count=self.num_samples
        )
        for observation, indices in zip(observations, near, strict=True):
            futures = retrieved_futures(
                observation,
                store=self.store,
                windows=self.windows,
                indices=indices,
                horizon=self.horizon,
            )
            yield _fitted(futures, observation, self.store.skeleton, bones)


def _fitted(
    futures: Float[np.ndarray, "S H J 3"],
    observation: Float[np.ndarray, "T J 3"],
    skeleton: Skeleton,
    bones: Sequence[BoneLengths],
) -> Answer:
    answer: Answer = {}
    for kind in bones:
        if kind == "observed":
            lengths = np.median(bone_lengths(observation, skeleton.parents), axis=0)
            answer[kind] = fit_bone_lengths(futures, lengths, skeleton.parents)
        else:
            answer[kind] = futures
    return answer
