import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.engine.costs import Costs

SIZES = [8, 50, 3, 64, 20] * 8


def test_line_through_the_calls_is_found():
    costs = Costs()
    for rows in SIZES:
        costs.learn("step", rows, 0.002 + 0.0001 * rows)
    assert costs.expected(step=40) == pytest.approx(0.006, rel=0.02)
    assert costs.expected(step=1) == pytest.approx(0.0021, rel=0.05)


def test_one_size_says_of_another_that_each_row_costs_the_same():
    costs = Costs()
    for _ in range(5):
        costs.learn("decode", 50, 0.01)
    assert costs.expected(decode=100) == pytest.approx(0.02)


def test_calls_add_up_and_those_never_seen_cost_nothing():
    costs = Costs()
    costs.learn("step", 10, 0.5)
    costs.learn("decode", 10, 0.25)
    assert costs.expected(step=10, decode=10, encode=10) == pytest.approx(0.75)
    assert costs.expected(step=0) == 0.0


def test_load_is_followed():
    costs = Costs()
    for _ in range(50):
        costs.learn("step", 50, 0.01)
    for _ in range(30):
        costs.learn("step", 50, 0.03)
    assert costs.expected(step=50) == pytest.approx(0.03, rel=0.05)


def test_hardly_any_call_exceeds_the_most():
    costs, generator = Costs(), np.random.default_rng(0)
    seconds = 0.01 + 0.002 * generator.random(1000)
    exceeded = 0
    for some in seconds:
        exceeded += some > costs.at_most(step=50)
        costs.learn("step", 50, some)
    assert exceeded < 20
    assert costs.at_most(step=50) < 0.02


def test_calls_are_late_together():
    costs = Costs()
    for some in (0.01, 0.02, 0.03, 0.01, 0.04):
        costs.learn("step", 50, some)
        costs.learn("answer", 50, 2 * some)
    each = costs.at_most(step=50), costs.at_most(answer=50)
    assert costs.at_most(step=50, answer=50) == pytest.approx(sum(each))


def test_clock_is_read_around_a_call_and_not_where_it_fails():
    times = iter([1.0, 1.5, 2.0])
    costs = Costs(lambda: next(times))
    with costs.timed("step", 5):
        pass
    with pytest.raises(ZeroDivisionError), costs.timed("step", 5):
        raise ZeroDivisionError
    assert costs.expected(step=5) == pytest.approx(0.5)


@given(
    calls=st.lists(st.tuples(st.integers(1, 500), st.floats(0.0, 60.0)), min_size=1),
    rows=st.integers(1, 1000),
)
def test_estimates_are_finite_and_never_fall_with_more_rows(calls, rows):
    costs = Costs()
    for size, seconds in calls:
        costs.learn("step", size, seconds)
    fewer, more = costs.expected(step=rows), costs.expected(step=rows + 7)
    assert 0.0 <= fewer <= more + 1e-9
    assert math.isfinite(costs.at_most(step=rows))
    assert costs.at_most(step=rows) >= fewer - 1e-9
