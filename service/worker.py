"""A thread that drives one engine, so that no model ever runs in the event loop."""

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from threading import Thread
from time import perf_counter

from service.engine.engine import Engine
from service.engine.trajectory import Failure, Request, Result
from service.errors import EngineError, ServiceError, UnavailableError

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class Timing:
    """Seconds from a request's arrival to its first step, and from there to its last."""

    queue_s: float
    engine_s: float


@dataclass(kw_only=True, slots=True, eq=False)
class _Job:
    request: Request
    answer: Callable[[Result, Timing], bytes]
    future: Future[bytes] = field(default_factory=Future)
    arrived_s: float = field(default_factory=perf_counter)
    started_s: float = 0.0


class Worker:
    """Runs the requests of many callers on one engine until it is stopped."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._inbox: SimpleQueue[_Job | None] = SimpleQueue()
        self._jobs: dict[int, _Job] = {}
        self._stopping = False
        name = f"engine-{engine.manifest.name}"
        self._thread = Thread(target=self._drive, name=name, daemon=True)
        self._thread.start()

    async def predict(self, request: Request, answer: Callable[[Result, Timing], bytes]) -> bytes:
        """What ``answer`` makes of the result; it too runs in the worker's thread.

        A caller that is cancelled frees its rows at the next step.

        Raises:
            ServiceError: the request does not fit, could not be computed, or the worker stops.
        """
        if self._stopping:
            raise _stopped()
        job = _Job(request=request, answer=answer)
        self._inbox.put(job)
        return await asyncio.wrap_future(job.future)

    def stop(self) -> None:
        """Fail what is under way, and end the thread."""
        self._stopping = True
        self._inbox.put(None)
        self._thread.join()

    def _drive(self) -> None:
        while self._accept():
            try:
                self._step()
            except Exception:  # noqa: BLE001 - the outermost loop: the thread must live
                # Nobody can say whose fault it was, so everything under way fails.
                _log.exception("the engine failed")
                for request_id in list(self._jobs):
                    self._engine.cancel(request_id)
                    _fail(self._jobs.pop(request_id), _unforeseen())
        for job in self._jobs.values():
            _fail(job, _stopped())

    def _accept(self) -> bool:
        """Take in what has arrived, waiting for it when idle; False once told to stop."""
        while not self._jobs or not self._inbox.empty():
            job = self._inbox.get()
            if job is None:
                return False
            job.started_s = perf_counter()
            try:
                self._jobs[self._engine.add(job.request)] = job
            except ServiceError as error:
                _fail(job, error)
        return True

    def _step(self) -> None:
        for request_id in [i for i, job in self._jobs.items() if job.future.cancelled()]:
            self._engine.cancel(request_id)
            del self._jobs[request_id]
        for ended in self._engine.step():
            _end(self._jobs.pop(ended.request_id), ended)


def _end(job: _Job, ended: Result | Failure) -> None:
    if isinstance(ended, Failure):
        _fail(job, ended.error)
        return
    timing = Timing(queue_s=job.started_s - job.arrived_s, engine_s=perf_counter() - job.started_s)
    try:
        body = job.answer(ended, timing)
    except Exception:  # noqa: BLE001 - the outermost loop: this request fails, no other
        _log.exception("an answer could not be written")
        _fail(job, _unforeseen())
        return
    with suppress(InvalidStateError):  # the caller left meanwhile
        job.future.set_result(body)


def _fail(job: _Job, error: Exception) -> None:
    with suppress(InvalidStateError):  # the caller left meanwhile
        job.future.set_exception(error)


def _stopped() -> UnavailableError:
    return UnavailableError("the server is stopping; ask another one, or again in a second.")


def _unforeseen() -> EngineError:
    return EngineError("the server: an unforeseen error; its log says which.")
