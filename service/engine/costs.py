"""What a call costs at the present load: so many seconds for the call, and so many for each row."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from time import perf_counter

MEMORY = 0.9
"""The weight of what was known before, beside a call that was just seen."""
TOWARDS_PROPORTIONAL = 0.01
"""How much calls of one size alone say of other sizes: that each row costs the same."""
DEVIATIONS = 7.0
"""So many mean deviations above the mean lies what hardly any call exceeds (RFC 6298: four)."""


@dataclass(kw_only=True, slots=True)
class _Seen:
    """Exponentially weighted sums over the calls of one role."""

    weight: float = 0.0
    rows: float = 0.0
    seconds: float = 0.0
    rows_rows: float = 0.0
    rows_seconds: float = 0.0
    deviation: float = 0.0

    def add(self, rows: int, seconds: float) -> None:
        off = abs(seconds - self.expected(rows)) if self.weight else 0.0
        self.weight = MEMORY * self.weight + 1.0
        self.rows = MEMORY * self.rows + rows
        self.seconds = MEMORY * self.seconds + seconds
        self.rows_rows = MEMORY * self.rows_rows + rows * rows
        self.rows_seconds = MEMORY * self.rows_seconds + rows * seconds
        self.deviation = MEMORY * self.deviation + off

    @property
    def deviation_s(self) -> float:
        """Mean of how far off the line the calls have been."""
        return self.deviation / self.weight

    def expected(self, rows: int) -> float:
        """The line through the calls, by least squares with a ridge; no part of it is negative."""
        mean_rows, mean_s = self.rows / self.weight, self.seconds / self.weight
        spread = self.rows_rows / self.weight - mean_rows**2
        together = self.rows_seconds / self.weight - mean_rows * mean_s
        ridge = TOWARDS_PROPORTIONAL
        slope = (together + ridge * mean_rows * mean_s) / (spread + ridge * mean_rows**2)
        slope = min(max(slope, 0.0), mean_s / mean_rows)
        return mean_s + slope * (rows - mean_rows)


class Costs:
    """Learns from every call; several threads may use it."""

    def __init__(self, clock: Callable[[], float] = perf_counter) -> None:
        self._clock = clock
        self._seen: dict[str, _Seen] = {}
        self._lock = Lock()

    @contextmanager
    def timed(self, role: str, rows: int) -> Iterator[None]:
        """Learn from a call of this role, with one row at least; one that fails teaches nothing."""
        started_s = self._clock()
        yield
        self.learn(role, rows, self._clock() - started_s)

    def learn(self, role: str, rows: int, seconds: float) -> None:
        """Learn that a call of so many rows took so long."""
        with self._lock:
            self._seen.setdefault(role, _Seen()).add(rows, seconds)

    def expected(self, **calls: int) -> float:
        """Seconds of one call each, of so many rows, on average; 0 for one that was never seen."""
        with self._lock:
            return math.fsum(seen.expected(rows) for seen, rows in self._known(calls))

    def at_most(self, **calls: int) -> float:
        """Seconds that such calls hardly ever exceed together; what delays one delays all."""
        with self._lock:
            known = list(self._known(calls))
            expected_s = math.fsum(seen.expected(rows) for seen, rows in known)
            return expected_s + DEVIATIONS * math.fsum(seen.deviation_s for seen, _ in known)

    def _known(self, calls: dict[str, int]) -> Iterator[tuple[_Seen, int]]:
        return ((self._seen[role], n) for role, n in calls.items() if n and role in self._seen)
