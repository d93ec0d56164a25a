"""Threads that drive one engine, so that no model ever runs in the event loop."""

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Condition, Thread
from time import perf_counter
from types import TracebackType
from typing import Literal, NoReturn, Protocol, TypeAlias, runtime_checkable

from service.engine.engine import Engine, Event, Turn
from service.engine.trajectory import Failure, Preview, Request, Result
from service.errors import (
    CancelledRequestError,
    DeadlineError,
    EngineError,
    OverloadedError,
    ServiceError,
    UnavailableError,
)

_log = logging.getLogger(__name__)

MAX_UNREAD_BYTES = 1 << 20
WRITERS, EXPRESS = 1, 1
"""Threads beside those that compute: one to write meanwhile, and one for pressing requests."""

Outcome: TypeAlias = Literal["finished", "failed", "cancelled", "refused"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Timing:
    """Seconds from a request's arrival to its first step, and from there to its last."""

    queue_s: float
    engine_s: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Load:
    """Requests and rows that wait or run; those of a caller who left count until they stop."""

    requests: int
    rows: int


@runtime_checkable
class Observer(Protocol):
    """Is told what happens, from the worker's threads and its callers'."""

    def stepped(self, *, model: str, turn: Turn, seconds: float) -> None:
        """A step has run."""

    def ended(  # noqa: PLR0913 - all that a request has been
        self,
        *,
        model: str,
        outcome: Outcome,
        stopped_by: str | None,
        steps_run: int,
        steps_of: int,
        rows: int,
        queue_s: float,
        engine_s: float,
    ) -> None:
        """A request for so many samples has ended; refused is one of which nothing has run."""


@dataclass(kw_only=True, slots=True, eq=False)
class _Job:
    """A request, who waits for it, and the latest of its previews that nobody has read yet."""

    request: Request
    answer: Callable[[Result, Timing], bytes]
    preview: Callable[[Preview], bytes] | None = None
    key: str | None = None
    arrived_s: float = field(default_factory=perf_counter)
    written_s: float = 0.0
    answered: Future[bytes] = field(default_factory=Future)
    shown: deque[bytes] = field(default_factory=deque)
    unwritten: dict[int, Event] = field(default_factory=dict)
    num_written: int = 0
    has_writer: bool = False
    news: Callable[[], None] = lambda: None


class Worker:
    """Runs the requests of many callers on one engine, by several threads, until it is stopped.

    So many ``threads`` compute at a time. One that has something to write lets another compute
    meanwhile: neither does a turn wait for an answer, nor a core for who writes one. Nor does a
    pressing request wait for the turns under way: one thread more may run it, which shares the
    cores with the others meanwhile.
    At most ``max_rows`` of theirs are under way; where none is, one request of any size. How many
    requests there may be is up to the guard, who counts them before they are read.
    """

    def __init__(
        self,
        engine: Engine,
        *,
        threads: int = 1,
        max_rows: int,
        observer: Observer | None = None,
    ) -> None:
        self._engine = engine
        self._shares = threads
        self._num_computing = 0
        self._max_rows = max_rows
        self._observer = observer
        self._jobs: dict[int, _Job] = {}
        # Guards the jobs, the two flags and who computes; told of rows that wait, of threads that
        # no longer compute, and of jobs that have ended.
        self._changed = Condition()
        self._closed = False
        self._stopped = False
        name = f"engine-{engine.manifest.name}"
        self._threads = [
            Thread(target=self._drive, name=f"{name}-{i}", daemon=True)
            for i in range(threads + WRITERS + EXPRESS)
        ]
        for thread in self._threads:
            thread.start()

    async def predict(
        self,
        request: Request,
        answer: Callable[[Result, Timing], bytes],
        *,
        request_key: str | None = None,
    ) -> bytes:
        """What ``answer`` makes of the result; it too runs in one of the worker's threads.

        A caller that is cancelled frees its rows after their step.

        Raises:
            OverloadedError: as much is under way as may be.
            DeadlineError: not even one step fits.
            CancelledRequestError: it was cancelled by its key.
            ServiceError: the request does not fit, could not be computed, or the worker stops.
        """
        job = _Job(request=request, answer=answer, key=request_key)
        request_id = self._add(job)
        try:
            body = await asyncio.wrap_future(job.answered)
            self._engine.costs.learn("deliver", 1, perf_counter() - job.written_s)
            return body
        except asyncio.CancelledError:
            self._cancel(request_id)
            raise

    def stream(
        self,
        request: Request,
        answer: Callable[[Result, Timing], bytes],
        preview: Callable[[Preview], bytes],
        *,
        request_key: str | None = None,
    ) -> AsyncGenerator[bytes, None]:
        """What ``preview`` makes of each preview, and at last the answer.

        Who reads slowly misses previews: the latest `MAX_UNREAD_BYTES` wait. Closing it frees the
        rows; so does a cancelled reader.

        Raises:
            ServiceError: as for ``predict``, what is known at once before anything is read.
        """
        job = _Job(request=request, answer=answer, preview=preview, key=request_key)
        news = asyncio.Event()
        loop = asyncio.get_running_loop()

        def tell() -> None:
            with suppress(RuntimeError):  # the loop is closed: nobody reads any more
                loop.call_soon_threadsafe(news.set)

        job.news = tell
        job.answered.add_done_callback(lambda _: tell())
        request_id = self._add(job)
        return _Stream(job, news, leave=lambda: self._cancel(request_id))

    def sent(self, seconds: float) -> None:
        """Learn how long an answer took on its way out, from who waited for it to the network."""
        self._engine.costs.learn("send", 1, seconds)

    def cancel(self, request_key: str) -> bool:
        """End what is under way by this key with a CancelledRequestError; False if nothing is."""
        with self._changed:
            ids = [i for i, job in self._jobs.items() if job.key == request_key]
        return any([self._cancel(request_id) for request_id in ids])

    def steps_of(self, request: Request) -> int:
        """The steps of a request, were it to run them all."""
        return self._engine.steps_of(request)

    def load(self) -> Load:
        """What is under way."""
        return Load(requests=self._engine.num_requests, rows=self._engine.num_rows)

    def seconds_until_free(self, *, requests: int = 1, rows: int = 1) -> float:
        """When so many requests, with so many rows, will probably have ended."""
        return self._engine.seconds_until_free(requests=requests, rows=rows, shares=self._shares)

    async def drain(self, within_s: float) -> None:
        """Take no more; after this time let what is under way end with what it has; then stop."""
        with self._changed:
            self._closed = True
        await asyncio.to_thread(self._drain, within_s)

    def stop(self) -> None:
        """Fail what is under way, and end the threads."""
        with self._changed:
            self._closed = self._stopped = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._fail_all(_stopped)

    def _drain(self, within_s: float) -> None:
        with self._changed:
            self._changed.wait_for(self._is_idle, timeout=within_s)
            self._engine.hurry()
            self._changed.wait_for(self._is_idle)
        self.stop()

    def _is_idle(self) -> bool:
        return self._stopped or not self._jobs

    def _add(self, job: _Job) -> int:
        """Queue a request and return its id.

        Raises:
            ServiceError: it is refused.
        """
        try:
            with self._changed:
                if self._closed:
                    raise _stopped()
                self._check_room(job.request)
                request_id = self._engine.add(job.request)
                self._jobs[request_id] = job
                self._changed.notify_all()
        except ServiceError:
            self._tell(job, "refused")
            raise
        return request_id

    def _check_room(self, request: Request) -> None:
        load = self.load()
        rows = load.rows + request.num_samples - self._max_rows
        if load.requests and rows > 0:
            raise OverloadedError(
                f"the server: found {load.rows} samples under way; it takes at most "
                f"{self._max_rows}.",
                retry_after_s=self.seconds_until_free(requests=0, rows=rows),
            )

    def _cancel(self, request_id: int) -> bool:
        with self._changed:
            ran_s = self._engine.cancel(request_id)
            job = self._popped(request_id)
        if job is not None:
            self._tell(job, "cancelled", queue_s=perf_counter() - job.arrived_s - ran_s)
            _fail(job, CancelledRequestError("the request: it was cancelled before its answer."))
        return job is not None

    def _popped(self, request_id: int) -> _Job | None:
        """The job, which is whoever's who gets it first to end; None if it has been ended."""
        job = self._jobs.pop(request_id, None)
        self._changed.notify_all()
        return job

    def _drive(self) -> None:
        while (pressing := self._pressing_or_not()) is not None:
            try:
                for event in self._computed(pressing=pressing):
                    self._write(event)
            except Exception:  # noqa: BLE001 - the outermost loop: the thread must live
                # Nobody can say whose fault it was, so everything under way fails.
                _log.exception("the engine failed")
                self._fail_all(_unforeseen)

    def _pressing_or_not(self) -> bool | None:
        """Wait until there is a row to run, and a thread too few; None once it is stopped.

        True if the turn is to be for pressing requests alone, as enough others compute already.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: self._stopped or self._lacks_threads(self._num_computing)
            )
            pressing = self._num_computing >= self._shares
            self._num_computing += 1
            return None if self._stopped else pressing

    def _lacks_threads(self, num_computing: int) -> bool:
        """Whether there are rows that one thread more may run, beside so many that compute."""
        if num_computing < self._shares:
            return self._engine.num_waiting > 0
        return num_computing < self._shares + EXPRESS and self._engine.num_pressing_waiting > 0

    def _computed(self, *, pressing: bool) -> list[Event]:
        """What comes of a turn, which has been this thread's to compute."""
        started_s, writes = perf_counter(), True
        try:
            turn = self._engine.turn(shares=self._shares, pressing=pressing)
            writes = bool(turn.events)
        finally:
            with self._changed:
                self._num_computing -= 1
                # Who has nothing to write computes on: to wake another for that would be in vain.
                if self._lacks_threads(self._num_computing + (not writes)):
                    self._changed.notify_all()
        if self._observer is not None and turn.num_rows:
            self._observer.stepped(
                model=self._engine.manifest.name, turn=turn, seconds=perf_counter() - started_s
            )
        return turn.events

    def _write(self, event: Event) -> None:
        """Write what is told of a request, in order, whichever thread has what comes first.

        Who finds another at it leaves its own to the other.
        """
        with self._changed:
            job = self._jobs.get(event.request_id)
            if job is None:
                return
            job.unwritten[event.order] = event
            if job.has_writer:
                return
            job.has_writer = True
        while (following := self._next_of(job)) is not None:
            if isinstance(following, Preview):
                self._show(following)
            else:
                self._end(following)

    def _next_of(self, job: _Job) -> Event | None:
        with self._changed:
            event = job.unwritten.pop(job.num_written, None)
            if event is None:
                job.has_writer = False
            else:
                job.num_written += 1
            return event

    def _show(self, preview: Preview) -> None:
        with self._changed:
            job = self._jobs.get(preview.request_id)
        if job is None or job.preview is None:
            return
        try:
            body = job.preview(preview)
        except Exception:  # noqa: BLE001 - the outermost loop: this request fails, no other
            _log.exception("a preview could not be written")
            with self._changed:
                self._engine.cancel(preview.request_id)
            self._end(Failure(request_id=preview.request_id, error=_unforeseen()))
            return
        with self._changed:
            job.shown.append(body)
            while len(job.shown) > 1 and sum(map(len, job.shown)) > MAX_UNREAD_BYTES:
                job.shown.popleft()
        job.news()

    def _end(self, ended: Result | Failure) -> None:
        with self._changed:
            job = self._popped(ended.request_id)
        if job is None:
            return
        if isinstance(ended, Failure):
            self._fail(job, ended.error, queue_s=ended.queued_s)
            return
        engine_s = perf_counter() - job.arrived_s - ended.queued_s
        try:
            with self._engine.costs.timed("answer", job.request.num_samples):
                body = job.answer(ended, Timing(queue_s=ended.queued_s, engine_s=engine_s))
        except Exception:  # noqa: BLE001 - the outermost loop: this request fails, no other
            _log.exception("an answer could not be written")
            self._fail(job, _unforeseen(), queue_s=ended.queued_s)
            return
        self._tell(job, "finished", queue_s=ended.queued_s, result=ended)
        job.written_s = perf_counter()
        with suppress(InvalidStateError):  # the caller left meanwhile
            job.answered.set_result(body)

    def _fail_all(self, error: Callable[[], ServiceError]) -> None:
        with self._changed:
            jobs = list(self._jobs.values())
            for request_id in list(self._jobs):
                self._engine.cancel(request_id)
                self._popped(request_id)
        for job in jobs:
            self._fail(job, error(), queue_s=0.0)

    def _fail(self, job: _Job, error: ServiceError, *, queue_s: float) -> None:
        late = isinstance(error, DeadlineError)
        if late and job.request.deadline_s is None:  # the deadline is the worker's own end
            error = _stopped()
        self._tell(job, "refused" if late else "failed", queue_s=queue_s)
        _fail(job, error)

    def _tell(
        self, job: _Job, outcome: Outcome, *, queue_s: float = 0.0, result: Result | None = None
    ) -> None:
        if self._observer is None:
            return
        self._observer.ended(
            model=self._engine.manifest.name,
            outcome=outcome,
            stopped_by=result.stopped_by if result else None,
            steps_run=result.steps_run if result else 0,
            steps_of=self._engine.steps_of(job.request),
            rows=job.request.num_samples,
            queue_s=queue_s,
            engine_s=0.0 if outcome == "refused" else perf_counter() - job.arrived_s - queue_s,
        )


class _Stream(AsyncGenerator[bytes, None]):
    """The previews and the answer of a job, for one reader."""

    def __init__(self, job: _Job, news: asyncio.Event, *, leave: Callable[[], object]) -> None:
        self._job = job
        self._news = news
        self._leave = leave
        self._over = False

    async def asend(self, value: None) -> bytes:  # noqa: ARG002 - as generators have it
        """The next preview once there is one, or the answer; after that, the end."""
        if self._over:
            raise StopAsyncIteration
        try:
            while not (self._job.answered.done() or self._job.shown):
                await self._news.wait()
                self._news.clear()
        except asyncio.CancelledError:
            self._end()
            raise
        with suppress(IndexError):
            return self._job.shown.popleft()
        self._over = True
        return self._job.answered.result()

    async def athrow(
        self,
        kind: type[BaseException] | BaseException,
        error: BaseException | object = None,
        traceback: TracebackType | None = None,  # noqa: ARG002 - as generators have it
    ) -> NoReturn:
        """End the request, and raise what was thrown."""
        self._end()
        raise error if isinstance(error, BaseException) else kind

    def _end(self) -> None:
        self._over = True
        self._leave()


def _fail(job: _Job, error: ServiceError) -> None:
    with suppress(InvalidStateError):  # the caller left meanwhile
        job.answered.set_exception(error)


def _stopped() -> UnavailableError:
    return UnavailableError("the server is stopping; ask another one, or again in a second.")


def _unforeseen() -> EngineError:
    return EngineError("the server: an unforeseen error; its log says which.")
