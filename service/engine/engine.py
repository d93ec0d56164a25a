"""The engine: ``add`` requests, ``step`` until they are finished; rows of many share each step."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count, groupby
from typing import Any

import numpy as np
from jaxtyping import Float

from service.engine.admission import check
from service.engine.denoising import Denoiser
from service.engine.performing import Performer
from service.engine.runner import Runner
from service.engine.scheduler import Scheduler
from service.engine.trajectory import (
    Failure,
    Progress,
    Request,
    Result,
    Sample,
    Segment,
    Trajectory,
)
from service.errors import EngineError

ROWS_PER_STEP = 64


@dataclass(kw_only=True, slots=True, eq=False)
class _Job:
    """A request under way, and its futures that are done; row R has ``lengths[R]`` frames."""

    request: Request
    futures: Float[np.ndarray, "R H J 3"]
    lengths: dict[int, int] = field(default_factory=dict)
    segments: dict[int, tuple[Segment, ...]] = field(default_factory=dict)

    def put(self, sample: Sample) -> None:
        """Keep a sample that is done."""
        length = len(sample.future)
        self.futures[sample.sample_index, :length] = sample.future
        self.lengths[sample.sample_index] = length
        self.segments[sample.sample_index] = sample.segments

    @property
    def finished(self) -> bool:
        """Whether every sample is done."""
        return len(self.lengths) == len(self.futures)


class Engine:
    """Runs requests on one bundle; synchronous, and used by one thread at a time."""

    def __init__(self, runner: Runner, *, rows_per_step: int = ROWS_PER_STEP) -> None:
        self.manifest = runner.manifest
        self._rows_per_step = rows_per_step
        self._scheduler = Scheduler(rows_per_step=rows_per_step)
        self._jobs: dict[int, _Job] = {}
        self._ids = count()
        spec = self.manifest.actions
        self._progress: Progress[Any] = Performer(runner, spec) if spec else Denoiser(runner)

    @property
    def num_requests(self) -> int:
        """How many requests are under way."""
        return len(self._jobs)

    def add(self, request: Request) -> int:
        """Queue a request and return its id; no graph runs yet.

        Raises:
            FieldError: the observation does not fit the bundle, or a number is out of range.
        """
        check(request, self.manifest)
        request_id = next(self._ids)
        rows = self._progress.start(request_id, request)
        longest = max(1, len(request.actions)) * (request.max_frames or self.manifest.horizon)
        shape = (len(rows), longest, len(self.manifest.skeleton.joints), 3)
        self._jobs[request_id] = _Job(request=request, futures=np.empty(shape, np.float32))
        for row in rows:
            self._scheduler.put(row)
        return request_id

    def cancel(self, request_id: int) -> None:
        """Forget a request; its rows are free at the next step."""
        self._scheduler.remove(request_id)
        self._jobs.pop(request_id, None)

    def step(self) -> list[Result | Failure]:
        """Advance the rows whose turn it is by one; return the requests that this ended."""
        failures: dict[int, EngineError] = {}
        for row in self._advanced(self._scheduler.take(), failures):
            if isinstance(row, Sample):
                self._jobs[row.request_id].put(row)
            else:
                self._scheduler.put(row)
        for request_id in failures:
            self.cancel(request_id)
        failed = [Failure(request_id=i, error=error) for i, error in failures.items()]
        finished = [request_id for request_id, job in self._jobs.items() if job.finished]
        return [*failed, *(self._result(request_id) for request_id in finished)]

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
            while len(self._scheduler) >= self._rows_per_step:
                finished |= _by_id(self.step())
            while order and order[0] in finished:
                yield finished.pop(order.popleft())
        for request_id in order:
            while request_id not in finished:
                finished |= _by_id(self.step())
            yield finished.pop(request_id)

    def _advanced(
        self, rows: Sequence[Trajectory], failures: dict[int, EngineError]
    ) -> list[Trajectory | Sample]:
        """The rows one turn later; when they cannot run, each request runs and fails by itself."""
        if not rows:
            return []
        try:
            return self._progress.advance(rows)
        except EngineError as error:
            groups = [list(group) for _, group in groupby(rows, lambda row: row.request_id)]
            if len(groups) == 1:
                failures[rows[0].request_id] = error
                return []
        return [row for group in groups for row in self._advanced(group, failures)]

    def _result(self, request_id: int) -> Result:
        job = self._jobs.pop(request_id)
        longest = max(job.lengths.values())
        for sample_index, length in job.lengths.items():
            job.futures[sample_index, length:longest] = job.futures[sample_index, length - 1]
        futures = np.ascontiguousarray(job.futures[:, :longest])
        segments = tuple(job.segments[i] for i in range(len(futures)) if job.segments[i])
        # Where every sample is alike, a single row has been run for all of them.
        copies = job.request.num_samples // len(futures)
        return Result(
            request_id=request_id,
            futures=futures if copies == 1 else np.repeat(futures, copies, axis=0),
            steps_run=job.request.num_steps or self.manifest.num_steps,
            steps_of=self.manifest.num_steps,
            segments=segments * copies,
        )


def predict(engine: Engine, request: Request) -> Result:
    """The result of one request, run by itself on an idle engine."""
    return next(engine.run([request]))


def _by_id(ended: Sequence[Result | Failure]) -> dict[int, Result]:
    results = {}
    for end in ended:
        if isinstance(end, Failure):
            raise end.error
        results[end.request_id] = end
    return results
