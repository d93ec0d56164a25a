import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator, Sequence
from contextlib import aclosing
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock
from time import perf_counter, sleep
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from tiny_bundles import NUM_STEPS, walking

from models.bundle import read_manifest
from service.engine.context import Part, Tensors
from service.engine.engine import Engine, Turn
from service.engine.runner import Runner
from service.engine.trajectory import Preview, Request, Result
from service.errors import (
    CancelledRequestError,
    DeadlineError,
    EngineError,
    FieldError,
    NonFiniteError,
    OverloadedError,
    ServiceError,
    UnavailableError,
)
from service.worker import MAX_UNREAD_BYTES, Load, Timing, Worker

WALK = Request(observation=walking().astype(np.float32), num_samples=2)
HUGE = replace(WALK, num_samples=2000)
TOO_FAST = replace(WALK, observation=walking(speed=99.0).astype(np.float32))
AMPLE = 100_000  # rows
IDLE = Load(requests=0, rows=0)


class HeldRunner(Runner):
    """Runs no graph before it may, and none at all in the call that it is told to crash in."""

    def __init__(self, folder: Path) -> None:
        super().__init__(read_manifest(folder), folder)
        self.may_run = Event()
        self.may_run.set()
        self.running = Event()
        self.crashes = 0

    def run(self, role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        self.running.set()
        self.may_run.wait()
        if self.crashes:
            self.crashes -= 1
            raise ZeroDivisionError
        return super().run(role, tensors, parts)


class Recorder:
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.rows: list[int] = []
        self.ends: list[dict[str, Any]] = []

    def stepped(self, *, turn: Turn, **_: Any) -> None:
        self.rows.append(turn.num_rows)

    def ended(self, **facts: Any) -> None:
        self.ends.append(facts)

    @property
    def outcomes(self) -> list[str]:
        return [facts["outcome"] for facts in self.ends]


def answer(result: Result, _: Timing) -> bytes:
    return result.futures.tobytes()


def step_number(preview: Preview) -> bytes:
    return b"%d" % preview.steps_run


def broken(*_: object) -> bytes:
    raise ZeroDivisionError


def run(work: Coroutine[Any, Any, Any]) -> Any:
    return asyncio.run(work)


async def raised(work: Coroutine[Any, Any, Any]) -> Exception:
    try:
        await work
    except Exception as error:  # noqa: BLE001 - which one is the caller's question
        return error
    raise AssertionError


async def after_its_rows_run(runner: HeldRunner) -> None:
    await asyncio.to_thread(runner.running.wait)


@pytest.fixture
def runner(bundles: Path) -> HeldRunner:
    return HeldRunner(bundles / "diffusion")


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def start(runner: HeldRunner, recorder: Recorder) -> Iterator[Callable[..., Worker]]:
    """Starts workers, which are idle and stopped in the end."""
    workers: list[Worker] = []

    def started(*, max_rows: int = AMPLE, threads: int = 2, rows_per_step: int = 64) -> Worker:
        engine = Engine(runner, rows_per_step=rows_per_step)
        workers.append(Worker(engine, threads=threads, max_rows=max_rows, observer=recorder))
        return workers[-1]

    yield started
    runner.may_run.set()
    for worker in workers:
        worker.stop()
        assert worker.load() == IDLE


@pytest.mark.parametrize("threads", [1, 3])
def test_answers_many_callers_at_once(
    start: Callable[..., Worker], recorder: Recorder, threads: int
):
    worker = start(threads=threads, rows_per_step=8)

    async def together() -> list[bytes]:
        return await asyncio.gather(*(worker.predict(WALK, answer) for _ in range(20)))

    assert len(set(run(together()))) == 1
    assert recorder.outcomes == ["finished"] * 20
    assert {facts["steps_run"] for facts in recorder.ends} == {NUM_STEPS}
    assert sum(recorder.rows) == 20 * 2 * NUM_STEPS


def test_another_request_is_computed_while_an_answer_is_written(start: Callable[..., Worker]):
    worker, writes, may_write = start(threads=1), asyncio.Event(), Event()

    async def both() -> tuple[bytes, bytes]:
        loop = asyncio.get_running_loop()

        def held(result: Result, timing: Timing) -> bytes:
            loop.call_soon_threadsafe(writes.set)
            assert may_write.wait(30.0)
            return answer(result, timing)

        first = asyncio.ensure_future(worker.predict(WALK, held))
        await writes.wait()
        try:
            second = await asyncio.wait_for(worker.predict(WALK, answer), 30.0)
        finally:
            may_write.set()
        return await first, second

    first, second = run(both())
    assert first == second


def test_no_more_threads_compute_than_may(start: Callable[..., Worker], runner: HeldRunner):
    computing: list[int] = []
    now, lock, computed = 0, Lock(), runner.run

    def counted(*args: Any) -> Tensors:
        nonlocal now
        with lock:
            now += 1
            computing.append(now)
        sleep(0.001)
        try:
            return computed(*args)
        finally:
            with lock:
                now -= 1

    runner.run = counted  # type: ignore[method-assign]
    worker = start(threads=2, rows_per_step=8)

    async def together() -> None:
        await asyncio.gather(*(worker.predict(WALK, answer) for _ in range(20)))

    run(together())
    assert max(computing) == 2


def test_request_of_one_turn_does_not_wait_for_those_under_way(
    start: Callable[..., Worker], runner: HeldRunner
):
    worker, computed = start(threads=1), runner.run
    long, is_held, may_go_on = replace(WALK, num_samples=60), Event(), Event()

    def held(role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        if sum(count for _, count in parts) == long.num_samples:
            is_held.set()
            assert may_go_on.wait(30.0)
        return computed(role, tensors, parts)

    runner.run = held  # type: ignore[method-assign]

    async def both() -> None:
        first = asyncio.ensure_future(worker.predict(long, answer))
        await asyncio.to_thread(is_held.wait)
        others = replace(WALK, num_samples=61)  # of more than a turn, so it waits for its own
        second = asyncio.ensure_future(worker.predict(others, answer))
        try:
            await asyncio.wait_for(worker.predict(WALK, answer), 30.0)
            assert not any(task.done() for task in (first, second))
        finally:
            may_go_on.set()
        await asyncio.gather(first, second)

    run(both())


def test_timing_is_within_the_time_that_passed(start: Callable[..., Worker]):
    timings: list[Timing] = []

    def timed(_: Result, timing: Timing) -> bytes:
        timings.append(timing)
        return b""

    started_s = perf_counter()
    run(start().predict(WALK, timed))
    (timing,) = timings
    assert timing.queue_s >= 0.0
    assert timing.engine_s > 0.0
    assert timing.queue_s + timing.engine_s < perf_counter() - started_s


def test_requests_that_fail_do_so_by_themselves(start: Callable[..., Worker], recorder: Recorder):
    worker = start()
    bad = replace(WALK, observation=WALK.observation[1:])

    async def together() -> list[bytes | BaseException]:
        jobs = (worker.predict(request, answer) for request in (WALK, bad, TOO_FAST, WALK))
        return await asyncio.gather(*jobs, return_exceptions=True)

    first, misfit, nan, last = run(together())
    assert first == last
    assert isinstance(misfit, FieldError)
    assert isinstance(nan, NonFiniteError)
    assert sorted(recorder.outcomes) == ["failed", "finished", "finished", "refused"]


def test_answer_that_cannot_be_written_fails_by_itself(
    start: Callable[..., Worker], recorder: Recorder, caplog: pytest.LogCaptureFixture
):
    worker = start()
    with pytest.raises(EngineError, match="unforeseen"):
        run(worker.predict(WALK, broken))
    assert "ZeroDivisionError" in caplog.text
    assert run(worker.predict(WALK, answer))
    assert recorder.outcomes == ["failed", "finished"]


def test_threads_survive_an_engine_that_breaks(
    start: Callable[..., Worker],
    runner: HeldRunner,
    recorder: Recorder,
    caplog: pytest.LogCaptureFixture,
):
    worker = start()
    runner.crashes = 1
    with pytest.raises(EngineError, match="unforeseen"):
        run(worker.predict(WALK, answer))
    assert "the engine failed" in caplog.text
    assert run(worker.predict(WALK, answer))
    assert recorder.outcomes == ["failed", "finished"]


def test_caller_that_leaves_frees_its_rows_once_they_have_stopped(
    start: Callable[..., Worker], runner: HeldRunner, recorder: Recorder
):
    worker = start(threads=1, rows_per_step=8)
    runner.may_run.clear()

    async def leave_and_return() -> bytes:
        leaving = asyncio.create_task(worker.predict(HUGE, answer))
        await asyncio.sleep(0)
        assert worker.load() == Load(requests=1, rows=2000)
        await after_its_rows_run(runner)
        leaving.cancel()
        await asyncio.gather(leaving, return_exceptions=True)
        assert leaving.cancelled()
        assert worker.load() == Load(requests=1, rows=8)
        runner.may_run.set()
        return await worker.predict(WALK, answer)

    assert run(leave_and_return())
    assert worker.load() == IDLE
    assert recorder.rows[0] == 8
    assert recorder.outcomes == ["cancelled", "finished"]
    assert recorder.ends[0]["engine_s"] > 0.0


def test_request_is_cancelled_by_its_key(
    start: Callable[..., Worker], runner: HeldRunner, recorder: Recorder
):
    worker = start()
    runner.may_run.clear()

    async def cancelled() -> tuple[BaseException, bytes]:
        busy = asyncio.create_task(raised(worker.predict(HUGE, answer, request_key="a")))
        other = asyncio.create_task(worker.predict(WALK, answer, request_key="b"))
        await asyncio.sleep(0)
        assert worker.cancel("a")
        assert not worker.cancel("a")
        assert not worker.cancel("c")
        runner.may_run.set()
        return await busy, await other

    error, _ = run(cancelled())
    assert isinstance(error, CancelledRequestError)
    assert recorder.outcomes == ["cancelled", "finished"]


def test_more_than_may_be_under_way_is_refused_at_once(
    start: Callable[..., Worker], runner: HeldRunner, recorder: Recorder
):
    worker = start(max_rows=5)
    run(worker.predict(WALK, answer))  # from which it learns what a request takes
    runner.may_run.clear()

    async def overload() -> OverloadedError:
        taken = [asyncio.create_task(worker.predict(WALK, answer)) for _ in range(2)]
        await asyncio.sleep(0)
        error = await raised(worker.predict(WALK, answer))
        runner.may_run.set()
        await asyncio.gather(*taken)
        assert isinstance(error, OverloadedError)
        return error

    assert 0.0 < run(overload()).retry_after_s < 10.0
    assert run(worker.predict(WALK, answer))
    assert recorder.outcomes == ["finished", "refused", "finished", "finished", "finished"]


def test_single_request_is_taken_however_large(start: Callable[..., Worker]):
    worker = start(max_rows=1)
    assert run(worker.predict(replace(WALK, num_samples=100), answer))


def test_deadline_that_nothing_fits_is_refused(
    start: Callable[..., Worker], runner: HeldRunner, recorder: Recorder
):
    worker = start()
    past = replace(WALK, deadline_s=perf_counter())
    assert isinstance(run(raised(worker.predict(past, answer))), DeadlineError)
    assert recorder.outcomes == ["refused"]
    assert not runner.running.is_set()


async def items(stream: AsyncGenerator[bytes, None]) -> list[bytes]:
    return [item async for item in stream]


def test_stream_ends_with_the_plain_answer(start: Callable[..., Worker]):
    worker = start()
    plain = run(worker.predict(WALK, answer))

    async def streamed() -> list[bytes]:
        return await items(worker.stream(replace(WALK, previews=True), answer, step_number))

    *previews, final = run(streamed())
    assert final == plain
    assert [int(step) for step in previews] == list(range(1, NUM_STEPS))


@pytest.mark.parametrize("slow", [1, NUM_STEPS - 1])
def test_no_preview_is_overtaken_by_what_follows_it(start: Callable[..., Worker], slow: int):
    worker = start(threads=2)
    following = Event()

    def taking_its_time(preview: Preview) -> bytes:
        if preview.steps_run == slow:
            following.wait(0.3)  # meanwhile another thread could write the next one, or the answer
        elif preview.steps_run > slow:
            following.set()
        return step_number(preview)

    def last(*result: Any) -> bytes:
        following.set()
        return answer(*result)

    async def streamed() -> list[bytes]:
        return await items(worker.stream(replace(WALK, previews=True), last, taking_its_time))

    *previews, final = run(streamed())
    assert [int(step) for step in previews] == list(range(1, NUM_STEPS))
    assert final == run(worker.predict(WALK, answer))


@pytest.mark.parametrize("size", [1, MAX_UNREAD_BYTES])
def test_previews_wait_for_their_reader_as_far_as_there_is_room(
    start: Callable[..., Worker], size: int
):
    worker = start(threads=1)
    ended = Event()

    def long_preview(preview: Preview) -> bytes:
        return bytes([preview.steps_run]) * size

    def last(*result: Any) -> bytes:
        ended.set()
        return answer(*result)

    async def streamed() -> list[bytes]:
        stream = worker.stream(replace(WALK, previews=True), last, long_preview)
        await asyncio.to_thread(ended.wait)
        return await items(stream)

    *previews, final = run(streamed())
    all_steps = list(range(1, NUM_STEPS))
    assert [preview[0] for preview in previews] == (all_steps if size == 1 else all_steps[-1:])
    assert final == run(worker.predict(WALK, answer))


@pytest.mark.parametrize("begun", [True, False])
def test_closed_stream_frees_its_rows(
    start: Callable[..., Worker], runner: HeldRunner, recorder: Recorder, begun: bool
):
    worker = start(threads=1)

    async def closed() -> None:
        if not begun:
            runner.may_run.clear()
        stream = worker.stream(replace(HUGE, previews=True), answer, step_number)
        async with aclosing(stream):
            if begun:
                await anext(stream)
        assert await items(stream) == []
        runner.may_run.set()
        await worker.predict(WALK, answer)

    run(closed())
    assert worker.load() == IDLE
    assert recorder.outcomes == ["cancelled", "finished"]


def test_cancelled_reader_frees_its_rows(
    start: Callable[..., Worker], runner: HeldRunner, recorder: Recorder
):
    worker = start()
    runner.may_run.clear()

    async def cancelled() -> None:
        reading = asyncio.create_task(items(worker.stream(HUGE, answer, step_number)))
        await asyncio.sleep(0)
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
        assert reading.cancelled()

    run(cancelled())
    assert recorder.outcomes == ["cancelled"]


def test_stream_whose_previews_cannot_be_written_fails(
    start: Callable[..., Worker], recorder: Recorder, caplog: pytest.LogCaptureFixture
):
    worker = start()

    async def streamed() -> list[bytes]:
        return await items(worker.stream(replace(WALK, previews=True), answer, broken))

    with pytest.raises(EngineError, match="unforeseen"):
        run(streamed())
    assert "a preview could not be written" in caplog.text
    assert recorder.outcomes == ["failed"]


def test_stream_is_refused_before_it_is_read(start: Callable[..., Worker]):
    worker = start()
    bad = replace(WALK, observation=WALK.observation[1:])

    async def refused() -> None:
        with pytest.raises(FieldError):
            worker.stream(bad, answer, step_number)

    run(refused())


def test_stopping_fails_what_is_under_way_and_what_comes_later(
    start: Callable[..., Worker], recorder: Recorder
):
    worker = start()

    async def stopped() -> None:
        busy = asyncio.create_task(raised(worker.predict(HUGE, answer)))
        await asyncio.sleep(0)
        await asyncio.to_thread(worker.stop)
        assert isinstance(await busy, UnavailableError)
        with pytest.raises(UnavailableError, match="stopping"):
            await worker.predict(WALK, answer)

    run(stopped())
    assert recorder.outcomes == ["failed", "refused"]


def test_draining_finishes_what_is_under_way(start: Callable[..., Worker], runner: HeldRunner):
    worker = start()
    runner.may_run.clear()

    async def drained() -> bytes:
        busy = asyncio.create_task(worker.predict(WALK, answer))
        await asyncio.sleep(0)
        draining = asyncio.create_task(worker.drain(60.0))
        await after_its_rows_run(runner)
        assert isinstance(await raised(worker.predict(WALK, answer)), UnavailableError)
        runner.may_run.set()
        await draining
        return await busy

    assert len(run(drained())) > 0


class HurriedEngine(Engine):
    """Says when it has been told to hurry."""

    def __init__(self, runner: Runner) -> None:
        super().__init__(runner, rows_per_step=2)
        self.hurried = Event()

    def hurry(self) -> None:
        super().hurry()
        self.hurried.set()


def test_draining_hands_over_what_is_ready_at_its_end(runner: HeldRunner):
    engine = HurriedEngine(runner)
    worker = Worker(engine, max_rows=AMPLE)
    reasons: list[tuple[str, int]] = []

    def noted(result: Result, _: Timing) -> bytes:
        reasons.append((result.stopped_by, result.steps_run))
        return b""

    async def drained() -> Exception:
        runner.may_run.clear()
        busy = asyncio.create_task(worker.predict(WALK, noted))
        await asyncio.sleep(0)
        await after_its_rows_run(runner)
        waiting = asyncio.create_task(raised(worker.predict(HUGE, answer)))
        await asyncio.sleep(0)
        draining = asyncio.create_task(worker.drain(0.0))
        await asyncio.to_thread(engine.hurried.wait)
        runner.may_run.set()
        await draining
        await busy
        return await waiting

    assert isinstance(run(drained()), UnavailableError)
    assert reasons == [("deadline", 1)]
    assert worker.load() == IDLE


class Submissions(RuleBasedStateMachine):
    """Whatever happens, each request is answered once, and no slot leaks."""

    runner: HeldRunner

    def __init__(self) -> None:
        super().__init__()
        self.recorder = Recorder()
        self.worker = Worker(
            Engine(self.runner, rows_per_step=8),
            threads=2,
            max_rows=60,
            observer=self.recorder,
        )
        self.loop = asyncio.Runner()
        self.tasks: list[asyncio.Task[Any]] = []
        self.num_ended = 0

    async def _submit(self, work: Callable[[], Coroutine[Any, Any, Any]]) -> None:
        self.tasks.append(asyncio.create_task(work()))
        await asyncio.sleep(0)

    @rule(
        num_samples=st.integers(1, 30),
        num_steps=st.integers(1, NUM_STEPS),
        within_s=st.sampled_from([None, None, -1.0, 0.003, 0.02, 60.0]),
        tolerance_m=st.sampled_from([None, None, 0.4]),
        horizon=st.sampled_from([None, None, 90]),
        key=st.sampled_from("abc"),
        fast=st.booleans(),
        breaks=st.booleans(),
        streams=st.booleans(),
    )
    def submit(  # noqa: PLR0913 - all that a request may be
        self,
        num_samples: int,
        num_steps: int,
        within_s: float | None,
        tolerance_m: float | None,
        horizon: int | None,
        key: str,
        *,
        fast: bool,
        breaks: bool,
        streams: bool,
    ) -> None:
        request = replace(
            TOO_FAST if fast and breaks else WALK,
            num_samples=num_samples,
            num_steps=num_steps,
            deadline_s=None if within_s is None else perf_counter() + within_s,
            tolerance_m=tolerance_m,
            horizon=horizon,
            previews=streams,
        )
        write = broken if breaks and not fast else answer

        async def streamed() -> bytes:
            stream = self.worker.stream(request, write, step_number, request_key=key)
            async with aclosing(stream):
                return (await items(stream))[-1]

        async def plain() -> bytes:
            return await self.worker.predict(request, write, request_key=key)

        self.loop.run(self._submit(streamed if streams else plain))

    @rule(index=st.integers(0, 99))
    def leave(self, index: int) -> None:
        if self.tasks:
            self.tasks[index % len(self.tasks)].cancel()

    @rule(key=st.sampled_from("abc"))
    def cancel(self, key: str) -> None:
        self.worker.cancel(key)

    @rule()
    def crash(self) -> None:
        self.runner.crashes = 1

    @rule()
    def pause(self) -> None:
        """Let something end."""

        async def one_ends() -> None:
            await asyncio.wait(self.tasks, return_when=asyncio.FIRST_COMPLETED)

        if any(not task.done() for task in self.tasks):
            self.tasks = [task for task in self.tasks if not self._is_right(task)]
            if self.tasks:
                self.loop.run(one_ends())

    def _is_right(self, task: "asyncio.Task[Any]") -> bool:
        """Whether it has ended as it may."""
        if not task.done():
            return False
        if not task.cancelled() and (error := task.exception()) is not None:
            assert isinstance(error, ServiceError), repr(error)
        self.num_ended += 1
        return True

    def teardown(self) -> None:
        async def all_end() -> None:
            await self.worker.drain(60.0)
            await asyncio.gather(*self.tasks, return_exceptions=True)

        self.loop.run(all_end())
        assert all([self._is_right(task) for task in self.tasks])
        assert self.worker.load() == IDLE
        self.runner.crashes = 0
        assert len(self.recorder.ends) == self.num_ended
        self.loop.close()


def test_each_request_is_answered_once_and_no_slot_leaks(runner: HeldRunner):
    class Machine(Submissions):
        pass

    Machine.runner = runner
    run_state_machine_as_test(Machine, settings=settings(max_examples=25, stateful_step_count=20))
