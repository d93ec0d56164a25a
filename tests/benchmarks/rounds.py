"""Interleaved rounds, so that a noisy neighbour slows all sides alike."""

import time
from collections.abc import Callable


def milliseconds(sides: dict[str, Callable[[], object]], *, rounds: int) -> dict[str, list[float]]:
    """Of each side, how long it took in each of the interleaved rounds."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for index in range(rounds + 1):
        for name, run in sides.items():
            time.sleep(0.02)  # thread pools spin after a call and would slow the next side
            started = time.perf_counter()
            run()
            if index:  # the first round warms up
                times[name].append(1e3 * (time.perf_counter() - started))
    return times
