"""The engine where time is short, on a clock that only the graphs move."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from tiny_bundles import CHUNK_FRAMES, NUM_STEPS, walking

from models.bundle import read_manifest
from service.engine.context import Part, Tensors
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Failure, Preview, Request, Result
from service.errors import DeadlineError

WALK = walking().astype(np.float32)


class SlowRunner(Runner):
    """A row takes a while on a clock of its own; six of them, 1 s for a step, 0.5 s to decode."""

    seconds: ClassVar = {"encoder": 0.25, "denoiser": 1.0 / 6.0, "decoder": 0.5 / 6.0}

    def __init__(self, folder: Path) -> None:
        super().__init__(read_manifest(folder), folder)
        self.now_s = 0.0
        self.rows = 0

    def run(self, role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        num_rows = sum(count for _, count in parts)
        self.now_s += self.seconds[role] * num_rows
        self.rows += num_rows
        return super().run(role, tensors, parts)


def request(*, num_samples: int = 6, **options: object) -> Request:
    return Request(observation=WALK, num_samples=num_samples, **options)  # type: ignore[arg-type]


def knowing(
    folder: Path, *, rows_per_step: int = 64, **options: object
) -> tuple[Engine, SlowRunner]:
    """An engine that has seen what calls cost."""
    runner = SlowRunner(folder)
    engine = Engine(runner, rows_per_step=rows_per_step, clock=lambda: runner.now_s)
    predict(engine, request(num_samples=rows_per_step, **options))
    runner.rows = 0
    return engine, runner


def ended(engine: Engine) -> dict[int, Result | Failure | Preview]:
    events = []
    while engine.num_requests:
        events += engine.step()
    return {event.request_id: event for event in events}


@pytest.mark.parametrize(
    ("seconds", "steps"),
    [(1.8, 1), (2.7, 1), (2.8, 2), (5.8, 5), (10.7, 9), (10.8, 10), (99.0, 10)],
)
def test_answer_is_the_best_that_is_ready_in_time(bundles: Path, seconds: float, steps: int):
    engine, runner = knowing(bundles / "diffusion")
    deadline_s = runner.now_s + seconds
    result = predict(engine, request(deadline_s=deadline_s))
    assert result.steps_run == steps
    assert result.stopped_by == ("deadline" if steps < NUM_STEPS else "end")
    assert runner.now_s <= deadline_s
    fewer = predict(engine, request(num_steps=steps))
    assert result.futures.tobytes() == fewer.futures.tobytes()


@pytest.mark.parametrize("role", ["deliver", "send"])
def test_the_way_there_and_back_is_left_for_an_answer(bundles: Path, role: str):
    engine, runner = knowing(bundles / "diffusion")
    for _ in range(50):
        engine.costs.learn(role, 1, 1.0)
    result = predict(engine, request(deadline_s=runner.now_s + 7.8))
    assert result.steps_run == 5


def test_asked_steps_that_fit_are_not_the_deadlines_doing(bundles: Path):
    engine, runner = knowing(bundles / "diffusion")
    result = predict(engine, request(deadline_s=runner.now_s + 9.0, num_steps=3))
    assert (result.steps_run, result.stopped_by) == (3, "num_steps")


@pytest.mark.parametrize("seconds", [-1.0, 0.0, 1.7])
def test_request_that_has_no_time_for_a_step_fails_before_any(bundles: Path, seconds: float):
    engine, runner = knowing(bundles / "diffusion")
    with pytest.raises(DeadlineError, match="the first step of 6 samples; it takes 1750 ms"):
        predict(engine, request(deadline_s=runner.now_s + seconds))
    assert runner.rows == 0
    assert engine.num_requests == 0


def test_rows_that_wait_too_long_are_never_started(bundles: Path):
    engine, runner = knowing(bundles / "diffusion", rows_per_step=8)
    deadline_s = runner.now_s + 6.0
    ids = [engine.add(request(num_samples=8, deadline_s=deadline_s)) for _ in range(9)]
    ends = ended(engine)
    failed = [i for i in ids if isinstance(ends[i], Failure)]
    assert failed
    assert set(ids) - set(failed)
    assert runner.now_s <= deadline_s
    for request_id in failed:
        assert isinstance(getattr(ends[request_id], "error", None), DeadlineError)


@pytest.mark.parametrize("num_requests", [1, 3, 8])
def test_answers_that_are_due_together_are_all_in_time(bundles: Path, num_requests: int):
    engine, runner = knowing(bundles / "diffusion", rows_per_step=8)
    deadline_s = runner.now_s + 25.0
    for _ in range(num_requests):
        engine.add(request(num_samples=8, deadline_s=deadline_s))
    while engine.num_requests:
        for event in engine.step():
            assert isinstance(event, Result)
            assert runner.now_s <= deadline_s


def test_tight_deadline_overtakes_requests_without_one(bundles: Path):
    engine, runner = knowing(bundles / "diffusion", rows_per_step=8)
    engine.add(request(num_samples=100, num_steps=1))
    hasty = engine.add(request(num_samples=4, deadline_s=runner.now_s + 11.0))
    events = []
    while not any(event.request_id == hasty for event in events):
        events += engine.step()
    (result,) = [event for event in events if event.request_id == hasty]
    assert isinstance(result, Result)
    assert result.steps_run > 5


def test_time_that_ends_in_a_later_leg_leaves_what_there_is(bundles: Path):
    engine, runner = knowing(bundles / "diffusion")
    result = predict(engine, request(horizon=150, deadline_s=runner.now_s + 15.0))
    assert result.stopped_by == "deadline"
    assert (result.steps_run, result.steps_of) == (12, 3 * NUM_STEPS)
    assert result.futures.shape == (6, 120, 21, 3)
    whole = predict(engine, request(horizon=60))
    assert result.futures[:, :60].tobytes() == whole.futures.tobytes()


def test_action_ends_with_the_frames_so_far(actions_bundle: Path):
    options = {"actions": (0, 1), "stop_threshold_m": 1e-9}
    engine, runner = knowing(actions_bundle, **options)
    deadline_s = runner.now_s + 2.8
    result = predict(engine, request(deadline_s=deadline_s, **options))
    assert result.stopped_by == "deadline"
    assert runner.now_s <= deadline_s
    whole = predict(engine, request(**options))
    num_frames = 5 * CHUNK_FRAMES
    for segments in result.segments:
        (segment,) = segments
        assert (segment.action, segment.start, segment.end) == (0, 0, num_frames)
        assert not segment.stopped
    assert result.futures.tobytes() == whole.futures[:, :num_frames].tobytes()


def test_action_that_has_just_begun_is_left_out(actions_bundle: Path):
    options = {"actions": (0, 1), "max_frames": 2 * CHUNK_FRAMES, "stop_threshold_m": 1e-9}
    engine, runner = knowing(actions_bundle, **options)
    result = predict(engine, request(deadline_s=runner.now_s + 1.3, **options))
    assert {segments[-1].action for segments in result.segments} == {0}
    assert result.futures.shape[1] == 2 * CHUNK_FRAMES


def test_hurry_ends_everything_with_what_it_has(bundles: Path):
    engine, _ = knowing(bundles / "diffusion", rows_per_step=8)
    started = engine.add(request(num_samples=4))
    engine.step()
    engine.step()
    waiting = [engine.add(request(num_samples=4)) for _ in range(2)]
    engine.hurry()
    ends = ended(engine)
    result = ends[started]
    assert isinstance(result, Result)
    assert (result.steps_run, result.stopped_by) == (2, "deadline")
    assert all(isinstance(ends[i], Failure) for i in waiting)


def test_time_until_room_is_that_of_the_work_ahead(bundles: Path):
    engine, _ = knowing(bundles / "diffusion", rows_per_step=8)
    engine.add(request(num_samples=8))
    alone_s = engine.seconds_until_free(requests=1, rows=0)
    assert alone_s == pytest.approx((10 * 1.0 + 0.5) * 8 / 6)
    engine.add(request(num_samples=8))
    assert engine.seconds_until_free(requests=2, rows=0) > 2 * alone_s
    assert engine.seconds_until_free(requests=1, rows=0, shares=2) < alone_s
