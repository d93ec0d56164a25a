"""Who goes next: row by row in turn among the requests, so that none waits for a larger one."""

from collections import deque

from service.engine.trajectory import Trajectory


class Scheduler:
    """Queues of trajectories, one per request; it looks at no array."""

    def __init__(self, *, rows_per_step: int) -> None:
        if rows_per_step < 1:
            raise ValueError(f"rows_per_step: found {rows_per_step}; must be 1 or more.")
        self._rows_per_step = rows_per_step
        self._queues: dict[int, deque[Trajectory]] = {}
        self._turns: deque[int] = deque()

    def __len__(self) -> int:
        """How many trajectories wait."""
        return sum(map(len, self._queues.values()))

    def put(self, trajectory: Trajectory) -> None:
        """Queue a trajectory behind the others of its request."""
        request_id = trajectory.request_id
        if request_id not in self._queues:
            self._queues[request_id] = deque()
            self._turns.append(request_id)
        self._queues[request_id].append(trajectory)

    def take(self) -> list[Trajectory]:
        """The next trajectories to run, grouped by request; at most ``rows_per_step`` of them.

        Requests give one row each in turn, and a later call goes on where this one stopped. Within
        a request the row that has waited longest goes first, so its samples advance together.
        """
        taken: dict[int, list[Trajectory]] = {}
        for _ in range(min(self._rows_per_step, len(self))):
            request_id = self._turns.popleft()
            queue = self._queues[request_id]
            taken.setdefault(request_id, []).append(queue.popleft())
            if queue:
                self._turns.append(request_id)
            else:
                del self._queues[request_id]
        return [trajectory for rows in taken.values() for trajectory in rows]

    def remove(self, request_id: int) -> None:
        """Forget what waits of a request."""
        if self._queues.pop(request_id, None) is not None:
            self._turns.remove(request_id)
