"""Who goes next: the tightest deadline, then the least work left, and a share for everybody.

A turn runs at most ``rows_per_step`` rows, and no more than its thread's share of all that are
under way. They go to requests in the order of

1. their deadlines, where these are tight: the work left would take half of the time left or more;
2. their work left, turns times rows, so that a short request passes the long ones, and of equal
   ones that which came first ends first;
3. their arrival.

Of these, an eighth goes round instead: to the request that has waited longest for it, so that none
starves. More would have all requests half done and none whole, and a turn of a few rows of each
costs more than one of many rows of few. Within a request the rows that have waited longest go
first, and its samples advance together.

A request is pressing if its whole work fits into one turn, or its deadline was tight when it came.
Turns may be asked for that run those alone, so that they need not wait for what is under way.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Generic

from service.engine.rows import RowsT

GOES_ROUND = 8
"""One of so many rows of a turn does."""


@dataclass(kw_only=True, slots=True, eq=False)
class _Queue(Generic[RowsT]):
    """A request: the rows of it that wait, and what is known of those that a turn runs."""

    request_id: int
    deadline_s: float
    waiting: deque[RowsT] = field(default_factory=deque)
    num_waiting: int = 0
    num_running: int = 0
    work: int = 0
    is_pressing: bool = False
    last_share: int = -1
    removed: bool = False

    def popped(self, count: int) -> list[RowsT]:
        """So many of the rows that have waited longest."""
        self.num_running += count
        popped: list[RowsT] = []
        while count:
            rows = self.waiting.popleft()
            if len(rows) > count:
                rows, rest = rows.split(count)
                self.waiting.appendleft(rest)
            popped.append(rows)
            count -= len(rows)
        return popped


class Scheduler(Generic[RowsT]):
    """The rows of every request, those that wait and those that run; it looks at no array."""

    def __init__(self, *, rows_per_step: int) -> None:
        if rows_per_step < 1:
            raise ValueError(f"rows_per_step: found {rows_per_step}; must be 1 or more.")
        self._rows_per_step = rows_per_step
        self._queues: dict[int, _Queue[RowsT]] = {}
        self._num_shares = 0
        self.num_waiting = 0
        self.num_pressing_waiting = 0
        self.num_running = 0

    @property
    def num_rows(self) -> int:
        """How many rows wait or run."""
        return self.num_waiting + self.num_running

    @property
    def num_requests(self) -> int:
        """How many requests have rows, those included that were removed and still run."""
        return len(self._queues)

    def add(
        self,
        request_id: int,
        rows: Iterable[RowsT],
        *,
        deadline_s: float = math.inf,
        now_s: float = 0.0,
        seconds_per_turn: float = 0.0,
    ) -> None:
        """Queue all rows of a new request; its work should be done at this time."""
        queue: _Queue[RowsT] = _Queue(request_id=request_id, deadline_s=deadline_s)
        added = tuple(rows)
        work = sum(len(some) * some.turns_left for some in added)
        tight = _is_tight(work, deadline_s, now_s=now_s, seconds_per_turn=seconds_per_turn)
        queue.is_pressing = tight or work <= self._rows_per_step
        self._queues[request_id] = queue
        for some in added:
            self._put(queue, some)

    def num_next(self, *, shares: int = 1, pressing: bool = False) -> int:
        """How many rows the next turn runs, one of so many threads' turns."""
        if pressing:
            return min(self._rows_per_step, self.num_pressing_waiting)
        share = math.ceil((self.num_waiting + self.num_running) / shares)
        return min(self._rows_per_step, share, self.num_waiting)

    def take(
        self,
        *,
        shares: int = 1,
        pressing: bool = False,
        now_s: float = 0.0,
        seconds_per_turn: float = 0.0,
    ) -> list[RowsT]:
        """The rows to run next, grouped by request, until they are settled.

        ``seconds_per_turn`` of a single row tell which deadlines are tight. A ``pressing`` turn
        runs rows of pressing requests alone.
        """

        def order(queue: _Queue[RowsT]) -> tuple[float, int]:
            tight = _is_tight(
                queue.work, queue.deadline_s, now_s=now_s, seconds_per_turn=seconds_per_turn
            )
            return (queue.deadline_s if tight else math.inf, queue.work)

        total = self.num_next(shares=shares, pressing=pressing)
        left = total - (max(1, total // GOES_ROUND) if total > 1 else 0)
        asked = (
            q for q in self._queues.values() if q.num_waiting and (q.is_pressing or not pressing)
        )
        waiting = sorted(asked, key=order)
        counts = dict.fromkeys(waiting, 0)
        for queue in waiting:
            if not left:
                break
            counts[queue] = min(left, queue.num_waiting)
            left -= counts[queue]
        self._share(counts, total - sum(counts.values()))
        return [
            rows for queue, count in counts.items() if count for rows in self._popped(queue, count)
        ]

    def waiting(self, request_id: int) -> Sequence[RowsT]:
        """The rows of one request that wait."""
        return tuple(self._queues[request_id].waiting)

    def take_of(self, request_id: int) -> list[RowsT]:
        """All rows of one request that wait, until they are settled."""
        queue = self._queues[request_id]
        return self._popped(queue, queue.num_waiting)

    def settle(self, taken: Iterable[RowsT], following: Iterable[RowsT]) -> None:
        """Put back what a turn made of the rows that it had taken."""
        for rows in taken:
            queue = self._queues[rows.request_id]
            queue.num_running -= len(rows)
            queue.work -= len(rows) * rows.turns_left
            self.num_running -= len(rows)
            self._forget(queue)
        for rows in following:
            if rows.request_id in self._queues and not self._queues[rows.request_id].removed:
                self._put(self._queues[rows.request_id], rows)

    def remove(self, request_id: int) -> None:
        """Forget what waits of a request, and what runs of it once that is settled."""
        queue = self._queues.get(request_id)
        if queue is None:
            return
        queue.work -= sum(len(rows) * rows.turns_left for rows in queue.waiting)
        self._wait(queue, -queue.num_waiting)
        queue.waiting.clear()
        queue.removed = True
        self._forget(queue)

    def work(self) -> Sequence[tuple[int, int]]:
        """The turns left and the rows of each request, those first that probably end first."""
        return sorted((q.work, q.num_waiting + q.num_running) for q in self._queues.values())

    def _put(self, queue: _Queue[RowsT], rows: RowsT) -> None:
        queue.waiting.append(rows)
        queue.work += len(rows) * rows.turns_left
        self._wait(queue, len(rows))

    def _popped(self, queue: _Queue[RowsT], count: int) -> list[RowsT]:
        self._wait(queue, -count)
        self.num_running += count
        return queue.popped(count)

    def _wait(self, queue: _Queue[RowsT], count: int) -> None:
        """Count so many more rows of a request, or fewer, that wait."""
        queue.num_waiting += count
        self.num_waiting += count
        if queue.is_pressing:
            self.num_pressing_waiting += count

    def _share(self, counts: dict[_Queue[RowsT], int], left: int) -> None:
        for queue in sorted(counts, key=lambda queue: (counts[queue] > 0, queue.last_share)):
            if not left:
                break
            count = min(left, queue.num_waiting - counts[queue])
            if count:
                counts[queue] += count
                left -= count
                self._num_shares += 1
                queue.last_share = self._num_shares

    def _forget(self, queue: _Queue[RowsT]) -> None:
        if queue.removed and not queue.num_running:
            self._queues.pop(queue.request_id, None)


def _is_tight(work: int, deadline_s: float, *, now_s: float, seconds_per_turn: float) -> bool:
    """Whether the work would take half of the time left or more."""
    return now_s + 2.0 * seconds_per_turn * work >= deadline_s
