from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest

from service.engine.scheduler import Scheduler
from service.engine.trajectory import Trajectory


@dataclass(frozen=True)
class Row:
    request_id: int
    sample_index: int
    steps_run: int = 0


def put(scheduler: Scheduler, request_id: int, num_rows: int) -> None:
    for sample_index in range(num_rows):
        scheduler.put(Row(request_id, sample_index))


def counts(rows: Sequence[Trajectory]) -> Counter[int]:
    return Counter(row.request_id for row in rows)


def test_rows_are_shared_evenly():
    scheduler = Scheduler(rows_per_step=9)
    for request_id, num_rows in enumerate((100, 100, 2)):
        put(scheduler, request_id, num_rows)
    assert counts(scheduler.take()) == {0: 4, 1: 3, 2: 2}
    assert counts(scheduler.take()) == {0: 4, 1: 5}


def test_small_request_does_not_wait_for_a_large_one():
    scheduler = Scheduler(rows_per_step=8)
    put(scheduler, 0, 1000)
    scheduler.take()
    put(scheduler, 1, 4)
    assert counts(scheduler.take())[1] == 4


def test_no_request_starves_when_there_are_more_requests_than_rows():
    scheduler = Scheduler(rows_per_step=3)
    for request_id in range(10):
        put(scheduler, request_id, 5)
    served = sum((counts(scheduler.take()) for _ in range(10)), Counter())
    assert set(served.values()) == {3}


def test_samples_of_a_request_advance_together():
    scheduler = Scheduler(rows_per_step=3)
    put(scheduler, 0, 5)
    seen = []
    while len(scheduler):
        for row in scheduler.take():
            assert isinstance(row, Row)
            seen.append((row.steps_run, row.sample_index))
            if row.steps_run < 1:
                scheduler.put(replace(row, steps_run=row.steps_run + 1))
    assert seen == [(step, sample) for step in range(2) for sample in range(5)]


def test_rows_come_grouped_by_request():
    scheduler = Scheduler(rows_per_step=6)
    put(scheduler, 0, 3)
    put(scheduler, 1, 3)
    assert [row.request_id for row in scheduler.take()] == [0, 0, 0, 1, 1, 1]


def test_removed_request_gets_no_row():
    scheduler = Scheduler(rows_per_step=4)
    put(scheduler, 0, 3)
    put(scheduler, 1, 3)
    scheduler.remove(0)
    scheduler.remove(0)
    assert counts(scheduler.take()) == {1: 3}
    assert scheduler.take() == []


def test_a_step_has_at_least_one_row():
    with pytest.raises(ValueError, match="rows_per_step: found 0"):
        Scheduler(rows_per_step=0)
