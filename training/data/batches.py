"""Batches of windows, and how any window becomes a row of a batch."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from models.system import Data
from training.data.augment import (
    add_sensor_noise,
    augment,
    draw_mirrored,
    draw_rates,
    warped_frames,
)
from training.data.batch_source import BatchSource
from training.data.store import ClipRecord, Store, StoreError, select
from training.data.windows import Windows


def training_clips(store: Store, data: Data) -> tuple[ClipRecord, ...]:
    """Clips of the split ``train`` from the recipe's sources, without those it holds out."""
    wanted = select(store.clips, ("split=train",))
    held_out = set(select(store.clips, data.hold_out))
    sources = tuple(data.shares) if data.shares else ("",)
    return tuple(c for c in wanted if c not in held_out and c.source.startswith(sources))


def described_data(
    said: Mapping[str, Any], store: Store, *, num_observed: int, horizon: int
) -> Data:
    """What `training_clips` needs of the data of a recipe that was described as JSON."""
    return Data(
        skeleton=store.skeleton,
        fps=store.fps,
        num_observed=num_observed,
        horizon=horizon,
        shares=said.get("shares"),
        hold_out=tuple(said.get("hold_out", ())),
    )


def require_fit(store: Store, data: Data) -> None:
    """Refuses a store of another skeleton or frame rate than the recipe's.

    Raises:
        StoreError: they differ.
    """
    if (store.skeleton.joints, store.fps) != (data.skeleton.joints, data.fps):
        raise StoreError(
            f"store: found {store.skeleton.name} at {store.fps} fps; the recipe needs "
            f"{data.skeleton.name} at {data.fps} fps; prepare a store for it."
        )


def varied_rows(
    poses: Float[np.ndarray, "B L J 3"],
    *,
    mirrored: Bool[np.ndarray, "B"],
    data: Data,
    generator: np.random.Generator,
) -> dict[str, Tensor]:
    """Observation, what is seen of it and future, from windows of the capture's world."""
    last = poses[:, data.num_observed - 1, None, :1]
    at_origin = poses - last * np.array([1, 1, 0], np.float32)  # worlds are large, windows are not
    how = data.augmentation
    varied = augment(
        at_origin.astype(np.float32, copy=False),
        mirrored=mirrored,
        how=how,
        skeleton=data.skeleton,
        generator=generator,
    )
    observation = np.ascontiguousarray(varied[:, : data.num_observed])
    seen = add_sensor_noise(observation, deviation_m=how.observation_noise, generator=generator)
    return {
        "observation": torch.from_numpy(observation),
        "seen": torch.from_numpy(seen),
        "future": torch.from_numpy(np.ascontiguousarray(varied[:, data.num_observed :])),
    }


class Batches(BatchSource):
    """Draws window, rate and variation of each row from one generator per batch number."""

    def __init__(self, store: Store, data: Data, *, seed: int) -> None:
        """Index the windows.

        Raises:
            StoreError: skeleton or frame rate of store and recipe differ, or nothing is left.
        """
        require_fit(store, data)
        self._data = data
        self._seed = seed
        self._positions = np.asarray(store.positions)
        self._length = data.num_observed + data.horizon
        shortest = int(np.ceil((self._length - 1) * data.augmentation.slowest)) + 1
        self.windows = Windows.of(
            training_clips(store, data), num_frames=shortest, shares=data.shares
        )

    def batch(self, number: int, size: int) -> dict[str, Tensor]:
        """Batch number ``number``, as `models.system.Batch` describes it."""
        data, how = self._data, self._data.augmentation
        generator = np.random.default_rng([self._seed, number])
        drawn = self.windows.draw(size, generator)
        room = self.windows.room[drawn]
        fastest = np.minimum(how.fastest, (room - 1) / (self._length - 1))
        rates = draw_rates(fastest, how=how, generator=generator)
        whole, fraction = warped_frames(self._length, rates)
        first = self.windows.starts[drawn][:, None] + whole
        last = self.windows.starts[drawn][:, None] + np.minimum(whole + 1, room[:, None] - 1)
        poses = self._positions[first] * (1 - fraction) + self._positions[last] * fraction
        mirrored = draw_mirrored(size, how=how, generator=generator)
        return varied_rows(poses, mirrored=mirrored, data=data, generator=generator)
