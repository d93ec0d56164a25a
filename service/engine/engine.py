"""The engine: ``add`` requests, ``step`` until they are finished; rows of many share each step."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count, groupby
from threading import Lock
from time import perf_counter
from typing import Any, TypeAlias

from service.engine.admission import check
from service.engine.context import unencoded
from service.engine.costs import Costs
from service.engine.denoising import Denoiser
from service.engine.job import Job
from service.engine.performing import Performer
from service.engine.runner import Runner
from service.engine.scheduler import Scheduler
from service.engine.trajectory import (
    Failure,
    Preview,
    Progress,
    Request,
    Result,
    Samples,
    Shown,
    Trajectory,
)
from service.errors import DeadlineError, EngineError, ServiceError

ROWS_PER_STEP = 64
THERE_AND_BACK = 2
"""A request was on its way for as long as an answer is, before anybody could count it."""

Event: TypeAlias = Result | Failure | Preview


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Turn:
    """A step that has run: of how many rows, and what came of it.

    ``num_unwanted`` are the rows whose caller left while they ran; ``dispatch_s`` were spent on
    choosing the rows.
    """

    num_rows: int
    events: list[Event]
    num_unwanted: int = 0
    dispatch_s: float = 0.0


class Engine:
    """Runs requests on one bundle; synchronous, and stepped by any number of threads."""

    def __init__(
        self,
        runner: Runner,
        *,
        rows_per_step: int = ROWS_PER_STEP,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self.manifest = runner.manifest
        self.costs = Costs(clock)
        self._clock = clock
        self._rows_per_step = rows_per_step
        self._scheduler: Scheduler[Trajectory] = Scheduler(rows_per_step=rows_per_step)
        self._jobs: dict[int, Job] = {}
        self._ids = count()
        self._lock = Lock()
        spec = self.manifest.actions
        self._progress: Progress[Any] = (
            Performer(runner, self.costs, spec) if spec else Denoiser(runner, self.costs)
        )

    @property
    def num_requests(self) -> int:
        """How many requests are under way; a cancelled one is until its rows have stopped."""
        return self._scheduler.num_requests

    @property
    def num_rows(self) -> int:
        """How many rows wait or run."""
        return self._scheduler.num_rows

    @property
    def num_waiting(self) -> int:
        """How many rows wait."""
        return self._scheduler.num_waiting

    @property
    def num_pressing_waiting(self) -> int:
        """How many of them are of pressing requests, which may have turns of their own."""
        return self._scheduler.num_pressing_waiting

    def add(self, request: Request) -> int:
        """Queue a request and return its id; no graph runs yet.

        Raises:
            FieldError: the observation does not fit the bundle, or a number is out of range.
        """
        check(request, self.manifest)
        request_id = next(self._ids)
        rows = self._progress.start(request_id, request)
        job = Job(
            request_id=request_id,
            request=request,
            steps_of=self.steps_of(request),
            num_rows=sum(map(len, rows)),
            deadline_s=math.inf if request.deadline_s is None else request.deadline_s,
            added_s=self._clock(),
        )
        with self._lock:
            self._jobs[request_id] = job
            self._scheduler.add(
                request_id,
                rows,
                deadline_s=job.deadline_s,
                now_s=job.added_s,
                seconds_per_turn=self._seconds_per_turn(self._rows_per_step, 1),
            )
        return request_id

    def cancel(self, request_id: int) -> float:
        """Forget a request; its rows that wait are free now, those that run after their step.

        Returns the seconds since its first turn; 0 if it has had none, or has ended.
        """
        with self._lock:
            if request_id not in self._jobs:
                return 0.0
            now_s = self._clock()
            started_s = self._forget(request_id).started_s
            return 0.0 if started_s is None else now_s - started_s

    def hurry(self) -> None:
        """Let every request end with what it has; one that has nothing to show yet fails."""
        with self._lock:
            for job in self._jobs.values():
                job.deadline_s = -math.inf

    def step(self) -> list[Event]:
        """Advance the rows whose turn it is by one; return what this ended, and previews."""
        return self.turn().events

    def turn(self, *, shares: int = 1, pressing: bool = False) -> Turn:
        """The same, as one of so many threads that share the rows.

        A ``pressing`` turn is for pressing requests alone. Where it raises, the requests of its
        rows never end by themselves.
        """
        started_s = self._clock()
        with self._lock:
            taken, rows, failures = self._taken(shares, pressing=pressing)
        dispatch_s = self._clock() - started_s
        unwanted = 0
        advanced: list[Trajectory | Samples] = []
        errors: dict[int, ServiceError] = {}
        try:
            advanced = self._advanced(rows, errors)
        finally:
            with self._lock:
                unwanted = sum(len(some) for some in taken if some.request_id not in self._jobs)
                failures += [self._failure(i, e) for i, e in errors.items() if i in self._jobs]
                ended, shown = self._settled(taken, advanced)
        return Turn(
            num_rows=sum(map(len, taken)),
            num_unwanted=unwanted,
            dispatch_s=dispatch_s,
            events=[
                *failures,
                *(job.preview(*some) for job, some in shown),
                *(job.result() for job in ended),
            ],
        )

    def steps_of(self, request: Request) -> int:
        """The steps of a request, were it to run them all."""
        return self._progress.steps_of(request)

    def seconds_until_free(self, *, requests: int, rows: int, shares: int = 1) -> float:
        """When so many requests, with so many rows, will probably have ended."""
        with self._lock:
            queues = self._scheduler.work()
        seconds = 0.0
        for turns, num_rows in queues:
            if requests <= 0 and rows <= 0:
                break
            calls = self.costs.expected(decode=num_rows, answer=num_rows)
            seconds += turns * self._seconds_per_turn(self._rows_per_step, shares) + calls / shares
            requests, rows = requests - 1, rows - num_rows
        # The request that is next to end has half of each turn, and its share of the other half.
        return seconds * 2.0 / (1.0 + 1.0 / max(1, len(queues)))

    def run(self, requests: Iterable[Request]) -> Iterator[Result]:
        """Results in the order of the requests, which are read only as rows become free.

        Raises:
            EngineError: a request could not be computed.
            FieldError: a request does not fit the bundle.
        """
        order: deque[int] = deque()
        finished: dict[int, Result] = {}
        for request in requests:
            order.append(self.add(request))
            while self.num_waiting >= self._rows_per_step:
                finished |= _by_id(self.step())
            while order and order[0] in finished:
                yield finished.pop(order.popleft())
        for request_id in order:
            while request_id not in finished:
                finished |= _by_id(self.step())
            yield finished.pop(request_id)

    def _taken(
        self, shares: int, *, pressing: bool
    ) -> tuple[list[Trajectory], list[Trajectory], list[Failure]]:
        """The rows of this turn, as they waited and as they run, and requests that are too late.

        Where another step would be too much for some, the turn is theirs, and cuts them. Those that
        lack their first step fail when not even that fits. The earliest deadline is judged first:
        what the earlier ones need at least runs before.
        """
        now_s, size = self._clock(), self._scheduler.num_next(shares=shares, pressing=pressing)
        late: list[Trajectory] = []
        expired: list[Failure] = []
        ahead_s = 0.0
        for request_id, job, waiting, is_begun in self._hasty():
            step = {"encode": sum(map(len, unencoded(rows.context for rows in waiting)))}
            left = job.num_rows - job.num_whole
            last = {"decode": left, "answer": job.request.num_samples}
            last |= {"deliver": THERE_AND_BACK, "send": THERE_AND_BACK}
            # Rows that another thread has come back a step later.
            elsewhere = size if left > sum(map(len, waiting)) else 0
            left_s = job.deadline_s - now_s - ahead_s - self.costs.expected(step=elsewhere)
            ahead_s += self.costs.expected(**last) / shares
            if is_begun:
                if left_s < self.costs.at_most(**step, step=size, **last):
                    late += self._scheduler.take_of(request_id)
                    if sum(map(len, late)) >= self._rows_per_step:
                        break
            elif left_s < (needed_s := self.costs.expected(**step, step=size, **last)):
                error = DeadlineError(
                    f"the deadline: found {1e3 * max(0.0, left_s):.0f} ms left for the first step "
                    f"of {job.request.num_samples} samples; it takes {1e3 * needed_s:.0f} ms now."
                )
                expired.append(self._failure(request_id, error))
                ahead_s -= self.costs.expected(**last) / shares
            else:
                ahead_s += self.costs.expected(**step, step=job.num_rows) / shares
        if late:
            return late, [rows.cut() for rows in late], expired
        taken = self._scheduler.take(
            shares=shares,
            pressing=pressing,
            now_s=now_s,
            seconds_per_turn=self._seconds_per_turn(size, shares),
        )
        for rows in taken:
            job = self._jobs[rows.request_id]
            job.started_s = now_s if job.started_s is None else job.started_s
        return taken, taken, expired

    def _hasty(self) -> list[tuple[int, Job, Sequence[Trajectory], bool]]:
        """The requests that have a deadline, their rows that wait, and whether all have begun.

        The earliest deadline comes first; of equal ones, those that lack their first step.
        """
        found = [
            (request_id, job, waiting, all(rows.steps_behind for rows in waiting))
            for request_id, job in self._jobs.items()
            if job.deadline_s < math.inf
            for waiting in [self._scheduler.waiting(request_id)]
        ]
        return sorted(found, key=lambda one: (one[1].deadline_s, one[3]))

    def _seconds_per_turn(self, size: int, shares: int) -> float:
        """Seconds that one row takes for one turn, in turns of so many rows of so many threads."""
        return self.costs.expected(step=size) / max(1, size) / shares

    def _advanced(
        self, rows: Sequence[Trajectory], errors: dict[int, ServiceError]
    ) -> list[Trajectory | Samples]:
        """The rows one turn later; when they cannot run, each request runs and fails by itself."""
        if not rows:
            return []
        try:
            return self._progress.advance(rows)
        except EngineError as error:
            groups = [list(group) for _, group in groupby(rows, lambda some: some.request_id)]
            if len(groups) == 1:
                errors[rows[0].request_id] = error
                return []
        return [some for group in groups for some in self._advanced(group, errors)]

    def _settled(
        self, taken: Sequence[Trajectory], advanced: Sequence[Trajectory | Samples]
    ) -> tuple[list[Job], list[tuple[Job, tuple[int, int, list[Shown]]]]]:
        """The requests that a turn has ended, and the previews that it has made whole."""
        following: list[Trajectory] = []
        for some in advanced:
            if some.request_id not in self._jobs:
                continue
            if isinstance(some, Samples):
                self._jobs[some.request_id].put(some)
            else:
                self._jobs[some.request_id].show(some)
                following.append(some)
        self._scheduler.settle(taken, following)
        touched = [self._jobs[i] for i in {s.request_id for s in advanced} & self._jobs.keys()]
        shown = [(job, some) for job in touched for some in job.ready()]
        ended = [self._forget(job.request_id) for job in touched if job.finished]
        return ended, shown

    def _forget(self, request_id: int) -> Job:
        self._scheduler.remove(request_id)
        return self._jobs.pop(request_id)

    def _failure(self, request_id: int, error: ServiceError) -> Failure:
        job = self._forget(request_id)
        return Failure(
            request_id=request_id,
            error=error,
            queued_s=job.queued_s(self._clock()),
            order=job.order(),
        )


def predict(engine: Engine, request: Request) -> Result:
    """The result of one request, run by itself on an idle engine."""
    return next(engine.run([request]))


def _by_id(ended: Iterable[Event]) -> dict[int, Result]:
    results: dict[int, Result] = {}
    for end in ended:
        if isinstance(end, Failure):
            raise end.error
        if isinstance(end, Result):
            results[end.request_id] = end
    return results
