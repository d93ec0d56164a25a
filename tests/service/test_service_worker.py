import asyncio
from pathlib import Path

import numpy as np
import pytest
from tiny_bundles import walking

from models.bundle import read_manifest
from service.engine.engine import Engine
from service.engine.runner import Runner
from service.engine.trajectory import Request, Result
from service.errors import EngineError, FieldError, UnavailableError
from service.worker import Timing, Worker

WALK = Request(observation=walking().astype(np.float32), num_samples=2)


def answer(result: Result, _: Timing) -> bytes:
    return result.futures.tobytes()


def broken_answer(_: Result, __: Timing) -> bytes:
    raise ZeroDivisionError


@pytest.fixture
def engine(bundles: Path) -> Engine:
    folder = bundles / "diffusion"
    return Engine(Runner(read_manifest(folder), folder))


def test_answers_many_callers_at_once(engine: Engine):
    worker = Worker(engine)

    async def together() -> list[bytes]:
        return await asyncio.gather(*(worker.predict(WALK, answer) for _ in range(20)))

    assert len(set(asyncio.run(together()))) == 1
    worker.stop()


def test_request_that_does_not_fit_fails_by_itself(engine: Engine):
    worker = Worker(engine)
    bad = Request(observation=WALK.observation[1:])

    async def together() -> list[bytes | BaseException]:
        jobs = (worker.predict(request, answer) for request in (WALK, bad, WALK))
        return await asyncio.gather(*jobs, return_exceptions=True)

    first, error, last = asyncio.run(together())
    assert first == last
    assert isinstance(error, FieldError)
    worker.stop()


def test_answer_that_cannot_be_written_fails_by_itself(
    engine: Engine, caplog: pytest.LogCaptureFixture
):
    worker = Worker(engine)
    with pytest.raises(EngineError, match="unforeseen"):
        asyncio.run(worker.predict(WALK, broken_answer))
    assert "ZeroDivisionError" in caplog.text
    assert asyncio.run(worker.predict(WALK, answer))
    worker.stop()


def test_thread_survives_an_engine_that_breaks(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    worker = Worker(engine)
    step, calls = engine.step, []

    def breaks_once():
        calls.append(None)
        if len(calls) == 1:
            raise ZeroDivisionError
        return step()

    monkeypatch.setattr(engine, "step", breaks_once)
    with pytest.raises(EngineError, match="unforeseen"):
        asyncio.run(worker.predict(WALK, answer))
    assert "the engine failed" in caplog.text
    assert asyncio.run(worker.predict(WALK, answer))
    assert engine.num_requests == 0
    worker.stop()


def test_caller_that_leaves_frees_its_rows(engine: Engine):
    worker = Worker(engine)
    huge = Request(observation=WALK.observation, num_samples=2000)

    async def leave_and_return() -> bytes:
        leaving = asyncio.create_task(worker.predict(huge, answer))
        await asyncio.sleep(0)
        leaving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await leaving
        return await worker.predict(WALK, answer)

    assert asyncio.run(leave_and_return())
    worker.stop()
    assert engine.num_requests == 0


def test_stopping_fails_what_is_under_way_and_what_comes_later(engine: Engine):
    worker = Worker(engine)
    huge = Request(observation=WALK.observation, num_samples=2000)

    async def stopped() -> None:
        busy = asyncio.create_task(worker.predict(huge, answer))
        await asyncio.sleep(0)
        await asyncio.to_thread(worker.stop)
        with pytest.raises(UnavailableError, match="stopping"):
            await busy
        with pytest.raises(UnavailableError, match="stopping"):
            await worker.predict(WALK, answer)

    asyncio.run(stopped())
