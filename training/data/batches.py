"""An endless source of augmented batches, the same for the same seed and start."""

import queue
import threading
from collections.abc import Generator

import numpy as np
import torch
from torch import Tensor

from models.system import Data
from training.data.augment import add_sensor_noise, augment, warped_frames
from training.data.store import ClipRecord, Store, StoreError, select
from training.data.windows import Windows

TAKEN_AHEAD = 4


def training_clips(store: Store, data: Data) -> tuple[ClipRecord, ...]:
    """Clips of the split ``train`` from the recipe's sources, without those it holds out."""
    wanted = select(store.clips, ("split=train",))
    held_out = set(select(store.clips, data.hold_out))
    sources = tuple(data.shares) if data.shares else ("",)
    return tuple(c for c in wanted if c not in held_out and c.source.startswith(sources))


class Batches:
    """Draws window, rate and variation of each row from one generator per batch number.

    Batch number n is a pure function of (seed, n), so a resumed run sees what an uninterrupted
    one would have seen.
    """

    def __init__(self, store: Store, data: Data, *, seed: int) -> None:
        """Index the windows.

        Raises:
            StoreError: skeleton or frame rate of store and recipe differ, or nothing is left.
        """
        if (store.skeleton.joints, store.fps) != (data.skeleton.joints, data.fps):
            raise StoreError(
                f"store: found {store.skeleton.name} at {store.fps} fps; the recipe needs "
                f"{data.skeleton.name} at {data.fps} fps; prepare a store for it."
            )
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
        # Uniform on a logarithmic scale, so that slower and faster are equally likely.
        rates = how.slowest * (fastest / how.slowest) ** generator.random(size)
        whole, fraction = warped_frames(self._length, rates)
        first = self.windows.starts[drawn][:, None] + whole
        last = self.windows.starts[drawn][:, None] + np.minimum(whole + 1, room[:, None] - 1)
        poses = self._positions[first] * (1 - fraction) + self._positions[last] * fraction
        poses = poses - poses[:, data.num_observed - 1, :1][:, None] * np.array(
            [1, 1, 0], np.float32
        )  # worlds are large, windows are not
        poses = augment(
            poses.astype(np.float32),
            how=how,
            skeleton=data.skeleton,
            generator=generator,
        )
        observation = np.ascontiguousarray(poses[:, : data.num_observed])
        seen = add_sensor_noise(observation, deviation_m=how.observation_noise, generator=generator)
        return {
            "observation": torch.from_numpy(observation),
            "seen": torch.from_numpy(seen),
            "future": torch.from_numpy(np.ascontiguousarray(poses[:, data.num_observed :])),
        }

    def stream(self, *, first: int, size: int) -> Generator[dict[str, Tensor], None, None]:
        """Batches from number ``first`` on, made ahead by a thread."""
        ready: queue.Queue[dict[str, Tensor]] = queue.Queue(TAKEN_AHEAD)
        stop = threading.Event()

        def fill() -> None:
            number = first
            while not stop.is_set():
                batch = self.batch(number, size)
                number += 1
                while not stop.is_set():
                    try:
                        ready.put(batch, timeout=0.2)
                        break
                    except queue.Full:
                        continue

        thread = threading.Thread(target=fill, daemon=True)
        thread.start()
        try:
            while True:
                yield ready.get()
        finally:
            stop.set()
            thread.join()
