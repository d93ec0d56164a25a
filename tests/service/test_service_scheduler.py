import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.engine.scheduler import Scheduler


@dataclass(frozen=True)
class Some:
    request_id: int
    first: int
    count: int
    turns_left: int = 10

    def __len__(self) -> int:
        return self.count

    def split(self, count: int) -> tuple["Some", "Some"]:
        rest = replace(self, first=self.first + count, count=self.count - count)
        return replace(self, count=count), rest

    @property
    def samples(self) -> list[int]:
        return list(range(self.first, self.first + self.count))


def scheduler_of(*requests: tuple[int, int], rows_per_step: int) -> Scheduler[Some]:
    """With requests 0, 1, ... of so many rows and turns each."""
    scheduler: Scheduler[Some] = Scheduler(rows_per_step=rows_per_step)
    for request_id, (num_rows, turns) in enumerate(requests):
        scheduler.add(request_id, [Some(request_id, 0, num_rows, turns)])
    return scheduler


def counts(rows: Sequence[Some]) -> Counter[int]:
    return Counter({i: sum(len(r) for r in rows if r.request_id == i) for i in ids(rows)})


def ids(rows: Sequence[Some]) -> list[int]:
    return list(dict.fromkeys(r.request_id for r in rows))


def settle(scheduler: Scheduler[Some], taken: Sequence[Some]) -> None:
    """One turn later; what has no turn left has arrived."""
    later = [replace(rows, turns_left=rows.turns_left - 1) for rows in taken]
    scheduler.settle(taken, [rows for rows in later if rows.turns_left])


def order_of_ends(scheduler: Scheduler[Some], num_requests: int) -> list[int]:
    ended: list[int] = []
    while scheduler.num_rows:
        settle(scheduler, scheduler.take())
        alive = {i for i in range(num_requests) if i not in ended and scheduler.waiting(i)}
        ended += [i for i in range(num_requests) if i not in alive and i not in ended]
    return ended


def test_least_work_left_has_the_turn_but_for_what_goes_round():
    scheduler = scheduler_of((100, 10), (100, 2), (100, 10), (100, 10), rows_per_step=16)
    assert [counts(scheduler.take()) for _ in range(4)] == [
        {1: 14, 0: 2},
        {1: 14, 2: 2},
        {1: 14, 3: 2},
        {1: 14, 0: 2},
    ]


def test_a_small_turn_has_a_row_that_goes_round():
    scheduler = scheduler_of(*[(100, 10)] * 5, rows_per_step=4)
    served: Counter[int] = sum((counts(scheduler.take()) for _ in range(5)), Counter())
    assert served == {0: 3 * 5, 1: 2, 2: 1, 3: 1, 4: 1}


def test_short_request_among_long_ones_runs_in_its_first_turn():
    scheduler = scheduler_of(*[(50, 10)] * 8, rows_per_step=64)
    settle(scheduler, scheduler.take())
    scheduler.add(8, [Some(8, 0, 50, turns_left=1)])
    first = scheduler.take()
    assert counts(first)[8] == 50
    settle(scheduler, first)
    assert scheduler.waiting(8) == ()


def test_pressing_turn_is_for_requests_that_fit_into_one():
    scheduler = scheduler_of((50, 10), (8, 8), (65, 1), rows_per_step=64)
    assert counts(scheduler.take(pressing=True)) == {1: 8}
    assert scheduler.take(pressing=True) == []
    assert scheduler.num_waiting == 50 + 65


def test_pressing_turn_is_for_deadlines_that_were_tight_from_the_start():
    scheduler = scheduler_of((50, 10), rows_per_step=8)
    for request_id, deadline_s in ((1, 12.0), (2, 99.0)):  # of work of 5 seconds, from 10.0 on
        rows = [Some(request_id, 0, 10, turns_left=10)]
        scheduler.add(request_id, rows, deadline_s=deadline_s, now_s=10.0, seconds_per_turn=0.05)
    assert counts(scheduler.take(pressing=True)) == {1: 8}


def test_what_is_left_of_a_long_request_is_not_pressing():
    scheduler = scheduler_of((50, 2), rows_per_step=64)
    settle(scheduler, scheduler.take())
    assert (scheduler.num_waiting, scheduler.num_pressing_waiting) == (50, 0)


def test_pressing_rows_that_wait_are_counted_until_they_run_or_are_forgotten():
    scheduler = scheduler_of((3, 2), (4, 1), (50, 10), rows_per_step=16)
    assert scheduler.num_pressing_waiting == 7
    scheduler.remove(1)
    assert scheduler.num_pressing_waiting == 3
    taken = scheduler.take(pressing=True)
    assert scheduler.num_pressing_waiting == 0
    settle(scheduler, taken)
    assert scheduler.num_pressing_waiting == 3
    scheduler.take_of(0)
    assert scheduler.num_pressing_waiting == 0


@pytest.mark.parametrize("rows_per_step", [32, 64, 128])
def test_equal_requests_end_about_in_the_order_of_their_arrival(rows_per_step: int):
    scheduler = scheduler_of(*[(50, 10)] * 8, rows_per_step=rows_per_step)
    places = enumerate(order_of_ends(scheduler, 8))
    assert all(abs(request_id - place) <= 1 for place, request_id in places)


def test_tight_deadlines_go_first_the_earliest_before_the_others():
    scheduler = scheduler_of((100, 1), rows_per_step=8)
    scheduler.add(1, [Some(1, 0, 2, turns_left=10)], deadline_s=30.0)
    scheduler.add(2, [Some(2, 0, 2, turns_left=10)], deadline_s=20.0)
    scheduler.add(3, [Some(3, 0, 2, turns_left=10)], deadline_s=1e6)
    assert ids(scheduler.take(now_s=10.0, seconds_per_turn=0.5))[:2] == [2, 1]


def test_lenient_deadlines_change_nothing():
    scheduler = scheduler_of((100, 1), rows_per_step=8)
    scheduler.add(1, [Some(1, 0, 2, turns_left=100)], deadline_s=1e6)
    assert ids(scheduler.take(now_s=0.0, seconds_per_turn=1.0))[0] == 0


def test_samples_of_a_request_advance_together():
    scheduler = scheduler_of((5, 2), rows_per_step=3)
    seen = []
    while scheduler.num_rows:
        taken = scheduler.take()
        seen += [(rows.turns_left, sample) for rows in taken for sample in rows.samples]
        settle(scheduler, taken)
    assert seen == [(turns, sample) for turns in (2, 1) for sample in range(5)]


def test_rows_come_grouped_by_request():
    scheduler = scheduler_of((30, 10), (30, 10), (30, 10), rows_per_step=9)
    for _ in range(5):
        taken = scheduler.take()
        assert [r.request_id for r in taken] == sorted(
            (r.request_id for r in taken), key=ids(taken).index
        )
        settle(scheduler, taken)


def test_threads_share_the_rows_of_a_request():
    scheduler = scheduler_of((50, 10), rows_per_step=64)
    first, second = scheduler.take(shares=2), scheduler.take(shares=2)
    assert (counts(first), counts(second)) == ({0: 25}, {0: 25})
    settle(scheduler, first)
    assert counts(scheduler.take(shares=2)) == {0: 25}


def test_removed_request_gets_no_row_and_counts_until_its_rows_have_stopped():
    scheduler = scheduler_of((3, 10), (3, 10), rows_per_step=4)
    taken = scheduler.take()
    scheduler.remove(0)
    scheduler.remove(0)
    assert scheduler.num_requests == 2
    settle(scheduler, taken)
    assert (scheduler.num_requests, scheduler.num_rows) == (1, 3)
    assert counts(scheduler.take()) == {1: 3}
    assert scheduler.take() == []


def test_rows_of_one_request_are_taken_together():
    scheduler = scheduler_of((3, 10), (30, 10), rows_per_step=4)
    late = scheduler.take_of(1)
    assert counts(late) == {1: 30}
    assert counts(scheduler.take()) == {0: 3}
    settle(scheduler, late)
    assert counts(scheduler.take()) == {1: 4}


def test_a_step_has_at_least_one_row():
    with pytest.raises(ValueError, match="rows_per_step: found 0"):
        Scheduler(rows_per_step=0)


@settings(max_examples=50)
@given(
    requests=st.lists(
        st.tuples(st.integers(1, 60), st.integers(1, 6), st.floats(0.0, 99.0)),
        min_size=1,
        max_size=12,
    ),
    rows_per_step=st.integers(2, 40),
    shares=st.integers(1, 3),
)
def test_every_turn_is_full_and_bounded_and_no_request_starves(requests, rows_per_step, shares):
    scheduler: Scheduler[Some] = Scheduler(rows_per_step=rows_per_step)
    for request_id, (num_rows, turns, deadline_s) in enumerate(requests):
        rows = [Some(request_id, 0, num_rows, turns)]
        scheduler.add(request_id, rows, deadline_s=deadline_s)
    run, work, waited = Counter(), sum(n * turns for n, turns, _ in requests), Counter()
    while scheduler.num_rows:
        bound = min(rows_per_step, -(-scheduler.num_rows // shares))
        taken = [scheduler.take(shares=shares, seconds_per_turn=0.5) for _ in range(shares)]
        assert sum(map(len, taken[0])) == bound
        assert all(sum(map(len, rows)) <= bound for rows in taken)
        for rows in taken:
            for some in rows:
                run.update((some.request_id, some.turns_left, i) for i in some.samples)
            settle(scheduler, rows)
        served = {some.request_id for rows in taken for some in rows}
        for request_id in range(len(requests)):
            waits = request_id not in served and scheduler.waiting(request_id)
            waited[request_id] = waited[request_id] + 1 if waits else 0
            # Some rows of a turn go round among all requests.
            assert waited[request_id] <= len(requests)
    assert sum(run.values()) == len(run) == work


@settings(max_examples=50)
@given(shorter=st.integers(1, 9), others=st.integers(1, 8), rows_per_step=st.integers(2, 64))
def test_one_row_never_waits_longer_for_more_rows_of_others(shorter, others, rows_per_step):
    scheduler = scheduler_of(*[(50, 10)] * others, rows_per_step=rows_per_step)
    scheduler.add(others, [Some(others, 0, 1, turns_left=shorter)])
    for _ in range(shorter):
        taken = scheduler.take()
        assert counts(taken)[others] == 1
        settle(scheduler, taken)


def test_scheduler_imports_no_array_library():
    code = (
        "import sys, service.engine.scheduler, service.engine.costs; "
        "sys.exit(bool({'numpy', 'onnxruntime', 'jaxtyping'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
