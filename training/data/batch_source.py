"""What the loop learns from: batches by number, made ahead by a thread."""

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Generator

from torch import Tensor

TAKEN_AHEAD = 4


class BatchSource(ABC):
    """An endless source of augmented batches.

    Batch number n is a pure function of (seed, n), so a resumed run sees what an uninterrupted
    one would have seen.
    """

    @abstractmethod
    def batch(self, number: int, size: int) -> dict[str, Tensor]:
        """Batch number ``number``, as `models.system.Batch` describes it."""

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
