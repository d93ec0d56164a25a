"""The engine: ``add`` requests, ``step`` until they are finished; rows of many share each step."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count, groupby

import numpy as np
from jaxtyping import Float, Int64

from models.diffusion import timesteps
from service.engine.runner import Runner, Tensors
from service.engine.sampling import noise, x_first, x_next
from service.engine.scheduler import Scheduler
from service.engine.trajectory import Failure, Request, Result, Trajectory
from service.errors import EngineError, FieldError

ROWS_PER_STEP = 64


@dataclass(kw_only=True, slots=True, eq=False)
class _Job:
    """A request under way: what its rows share, and the futures that are done."""

    request: Request
    timesteps: tuple[int, ...]
    futures: Float[np.ndarray, "R H J 3"]
    num_done: int = 0
    context: Tensors | None = None


class Engine:
    """Runs requests on one bundle; synchronous, and used by one thread at a time."""

    def __init__(self, runner: Runner, *, rows_per_step: int = ROWS_PER_STEP) -> None:
        self.manifest = runner.manifest
        self._runner = runner
        self._rows_per_step = rows_per_step
        self._scheduler = Scheduler(rows_per_step=rows_per_step)
        self._jobs: dict[int, _Job] = {}
        self._ids = count()
        spec = self.manifest.schedule
        self._schedule = spec.schedule() if spec else None
        self._eta = spec.eta if spec else 0.0

    @property
    def num_requests(self) -> int:
        """How many requests are under way."""
        return len(self._jobs)

    def add(self, request: Request) -> int:
        """Queue a request and return its id; no graph runs yet.

        Raises:
            FieldError: the observation does not fit the bundle, or a number is out of range.
        """
        self._check(request)
        request_id = next(self._ids)
        # Without a denoiser nothing is drawn: one row, already finished, serves every sample.
        steps: tuple[int, ...] = ()
        num_rows = 1
        if self._schedule is not None:
            steps = timesteps(self.manifest.num_steps, self._num_steps(request))
            num_rows = request.num_samples
        shape = (num_rows, self.manifest.horizon, len(self.manifest.skeleton.joints), 3)
        self._jobs[request_id] = _Job(
            request=request, timesteps=steps, futures=np.empty(shape, np.float32)
        )
        for sample_index, x_t in enumerate(self._x_first(request.seed, num_rows)):
            self._scheduler.put(
                Trajectory(
                    request_id=request_id,
                    sample_index=sample_index,
                    num_steps=len(steps),
                    x_t=x_t,
                )
            )
        return request_id

    def cancel(self, request_id: int) -> None:
        """Forget a request; its rows are free at the next step."""
        self._scheduler.remove(request_id)
        self._jobs.pop(request_id, None)

    def step(self) -> list[Result | Failure]:
        """Run one timestep of the rows whose turn it is; return the requests that this ended."""
        failures: dict[int, EngineError] = {}
        taken = self._scheduler.take()
        waiting = [row for row in taken if not row.finished]
        advanced = self._alone_on_error(self._denoised, waiting, failures)
        for row in advanced:
            if not row.finished:
                self._scheduler.put(row)
        ended = [row for row in (*taken, *advanced) if row.finished]
        decoded = self._alone_on_error(self._decoded, ended, failures)
        for request_id in failures:
            self.cancel(request_id)
        failed = [Failure(request_id=i, error=error) for i, error in failures.items()]
        return [*failed, *self._completed(decoded)]

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

    def _check(self, request: Request) -> None:
        shape = (self.manifest.num_observed, len(self.manifest.skeleton.joints), 3)
        if request.observation.shape != shape:
            raise FieldError(
                pointer="/observation",
                found=f"shape {request.observation.shape}",
                expected=f"{self.manifest.name} takes (frames, joints, xyz) = {shape}",
            )
        if request.num_samples < 1:
            raise FieldError(
                pointer="/num_samples", found=str(request.num_samples), expected="must be 1 or more"
            )
        if not 1 <= self._num_steps(request) <= self.manifest.num_steps:
            raise FieldError(
                pointer="/num_steps",
                found=str(request.num_steps),
                expected=f"{self.manifest.name} runs 1 to {self.manifest.num_steps} steps",
            )

    def _num_steps(self, request: Request) -> int:
        return self.manifest.num_steps if request.num_steps is None else request.num_steps

    def _alone_on_error(
        self,
        run: Callable[[Sequence[Trajectory]], list[Trajectory]],
        rows: Sequence[Trajectory],
        failures: dict[int, EngineError],
    ) -> list[Trajectory]:
        """What ``run`` makes of the rows; when it cannot, each request runs and fails by itself."""
        if not rows:
            return []
        try:
            return run(rows)
        except EngineError as error:
            groups = [list(group) for _, group in groupby(rows, lambda row: row.request_id)]
            if len(groups) == 1:
                failures[rows[0].request_id] = error
                return []
        return [row for group in groups for row in self._alone_on_error(run, group, failures)]

    def _x_first(self, seed: int, num_rows: int) -> Float[np.ndarray, "S ..."]:
        if self._schedule is None:
            return np.zeros((num_rows, 1), np.float32)
        return x_first(
            self.manifest.x_t_shape,
            schedule=self._schedule,
            seed=seed,
            sample_indices=range(num_rows),
        )

    def _denoised(self, rows: Sequence[Trajectory]) -> list[Trajectory]:
        if self._schedule is None:
            raise EngineError(f"{self.manifest.name}: found rows to denoise, but no schedule.")
        contexts, index = self._contexts(rows)
        steps = np.array([self._jobs[row.request_id].timesteps[row.steps_run] for row in rows])
        x_t = np.stack([row.x_t for row in rows])
        x0 = self._runner.denoise(x_t, timestep=steps, contexts=contexts, index=index)
        following = x_next(
            x_t, x0, timestep=steps, schedule=self._schedule, eta=self._eta, noise=self._draw(rows)
        )
        # The answer of a row is the x0 of the last step that it runs, early stop or not.
        return [
            row.advanced(x0[i] if row.steps_run + 1 == row.num_steps else following[i])
            for i, row in enumerate(rows)
        ]

    def _draw(self, rows: Sequence[Trajectory]) -> Float[np.ndarray, "..."]:
        if self._eta == 0.0:
            return np.zeros(1, np.float32)
        draws = [
            noise(
                row.x_t.shape,
                seed=self._jobs[row.request_id].request.seed,
                sample_indices=(row.sample_index,),
                draw=row.steps_run + 1,
            )
            for row in rows
        ]
        return np.concatenate(draws)

    def _decoded(self, rows: Sequence[Trajectory]) -> list[Trajectory]:
        contexts, index = self._contexts(rows)
        x0 = np.stack([row.x_t for row in rows])
        futures = self._runner.decode(x0, contexts=contexts, index=index)
        for row, future in zip(rows, futures, strict=True):
            job = self._jobs[row.request_id]
            job.futures[row.sample_index] = future
            job.num_done += 1
        return list(rows)

    def _contexts(self, rows: Sequence[Trajectory]) -> tuple[list[Tensors], Int64[np.ndarray, "B"]]:
        position = {request_id: i for i, request_id in enumerate({r.request_id: 0 for r in rows})}
        contexts = []
        for request_id in position:
            job = self._jobs[request_id]
            if job.context is None:
                job.context = self._runner.encode(job.request.observation)
            contexts.append(job.context)
        return contexts, np.array([position[row.request_id] for row in rows])

    def _completed(self, rows: Sequence[Trajectory]) -> list[Result]:
        results = []
        for request_id in {row.request_id: 0 for row in rows}:
            job = self._jobs.get(request_id)
            if job is not None and job.num_done == len(job.futures):
                results.append(_result(request_id, job, steps_of=self.manifest.num_steps))
                del self._jobs[request_id]
        return results


def predict(engine: Engine, request: Request) -> Result:
    """The result of one request, run by itself on an idle engine."""
    return next(engine.run([request]))


def _result(request_id: int, job: _Job, *, steps_of: int) -> Result:
    futures = job.futures
    if len(futures) < job.request.num_samples:
        futures = np.repeat(futures, job.request.num_samples, axis=0)
    return Result(
        request_id=request_id,
        futures=futures,
        steps_run=max(1, len(job.timesteps)),
        steps_of=steps_of,
    )


def _by_id(ended: Sequence[Result | Failure]) -> dict[int, Result]:
    results = {}
    for end in ended:
        if isinstance(end, Failure):
            raise end.error
        results[end.request_id] = end
    return results
