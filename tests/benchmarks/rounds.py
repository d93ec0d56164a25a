"""Interleaved rounds, so that a noisy neighbour slows all sides alike."""

import statistics
import time
from collections.abc import Callable


def medians(sides: dict[str, Callable[[], object]], *, rounds: int) -> dict[str, float]:
    """Median milliseconds of each side over interleaved rounds."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for index in range(rounds + 1):
        for name, run in sides.items():
            time.sleep(0.02)  # thread pools spin after a call and would slow the next side
            started = time.perf_counter()
            run()
            if index:  # the first round warms up
                times[name].append(1e3 * (time.perf_counter() - started))
    return {name: statistics.median(values) for name, values in times.items()}
