"""Schedules and the reverse step against closed forms and published tables."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.diffusion import (
    Schedule,
    cosine_schedule,
    ddim_step,
    isotropic,
    linear_schedule,
    q_sample,
    sqrt_schedule,
    timesteps,
)

SCHEDULES = {
    "sqrt": sqrt_schedule(10),
    "cosine": cosine_schedule(10),
    "linear": linear_schedule(100),
}


def betas(schedule: Schedule) -> np.ndarray:
    previous = np.concatenate([[1.0], schedule.alpha_bar[:-1]])
    return 1 - schedule.alpha_bar / previous


def test_sqrt_schedule_is_the_table_of_belfusion():
    expected = [0.309481, 0.191540, 0.181822, 0.187358, 0.203129]
    expected += [0.230459, 0.275401, 0.353768, 0.514163, 0.999]
    assert betas(SCHEDULES["sqrt"]) == pytest.approx(expected, abs=1e-6)
    assert SCHEDULES["sqrt"].alpha_bar[0] == pytest.approx(0.6836 / 0.99, abs=1e-4)
    assert SCHEDULES["sqrt"].alpha_bar[-1] == pytest.approx(0.000052, abs=1e-6)


def test_cosine_schedule_is_the_table_of_skeletondiffusion():
    expected = [0.972, 0.8987, 0.7869, 0.6475, 0.4938, 0.3408, 0.2031, 0.0940, 0.0241, 0.000024]
    assert SCHEDULES["cosine"].alpha_bar == pytest.approx(expected, abs=1e-4)
    assert betas(SCHEDULES["cosine"])[-1] == pytest.approx(0.999)


def test_linear_schedule_is_the_table_of_motiondiff():
    assert SCHEDULES["linear"].alpha_bar[[49, 99]] == pytest.approx([0.534, 0.0782], abs=5e-4)


@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_last_step_returns_x0(schedule):
    x_t, x0 = np.random.default_rng(0).standard_normal((2, 5, 7))
    following = ddim_step(
        x_t=x_t,
        x0=x0,
        alpha_bar=schedule.alpha_bar[0],
        variance=schedule.variance[0],
        alpha_bar_next=1.0,
        variance_next=0.0,
    )
    assert following == pytest.approx(x0, abs=1e-12)


@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_exact_x0_carries_the_same_noise_to_every_timestep(schedule):
    rng = np.random.default_rng(1)
    x0, noise = rng.standard_normal((2, 4, 3))
    noisiest = schedule.num_steps - 1
    x = _noised(schedule, noisiest, x0, noise)
    for t in range(noisiest, 0, -1):
        x = ddim_step(
            x_t=x,
            x0=x0,
            alpha_bar=schedule.alpha_bar[t],
            variance=schedule.variance[t],
            alpha_bar_next=schedule.alpha_bar[t - 1],
            variance_next=schedule.variance[t - 1],
        )
        assert x == pytest.approx(_noised(schedule, t - 1, x0, noise), abs=1e-9)


def _noised(schedule, t, x0, noise):
    return q_sample(
        x0=x0, noise=noise, alpha_bar=schedule.alpha_bar[t], variance=schedule.variance[t]
    )


@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
@pytest.mark.parametrize("t", [1, 4, 9])
def test_eta_one_is_the_posterior_of_ddpm(schedule, t):
    """Mean and variance of q(x_{t-1} | x_t, x0) by Ho et al. 2020, eqs. 6 and 7."""
    rng = np.random.default_rng(2)
    x_t, x0 = rng.standard_normal((2, 6))
    alpha_bar, before = schedule.alpha_bar[t], schedule.alpha_bar[t - 1]
    alpha, beta = alpha_bar / before, 1 - alpha_bar / before
    mean = np.sqrt(before) * beta * x0 + np.sqrt(alpha) * (1 - before) * x_t
    mean /= 1 - alpha_bar
    variance = (1 - before) / (1 - alpha_bar) * beta
    tables = {
        "alpha_bar": alpha_bar,
        "variance": schedule.variance[t],
        "alpha_bar_next": before,
        "variance_next": schedule.variance[t - 1],
    }
    still = ddim_step(x_t=x_t, x0=x0, eta=1.0, noise=0.0, **tables)
    moved = ddim_step(x_t=x_t, x0=x0, eta=1.0, noise=1.0, **tables)
    assert still == pytest.approx(mean, abs=1e-10)
    assert (moved - still) ** 2 == pytest.approx(np.full(6, variance), abs=1e-10)


def test_eta_one_is_the_posterior_for_each_direction_of_nonisotropic_noise():
    """Gaussian conditioning by hand: x' = a x0 + n', x = b x' + m, for two unlike variances."""
    alpha_bar, before = 0.3, 0.6
    variance_next = np.array([0.5, 0.1])
    step = alpha_bar / before
    variance = step * variance_next + np.array([0.3, 0.7])  # m has the variances .3 and .7
    x_t, x0 = np.array([0.4, -1.1]), np.array([0.9, 0.2])
    gain = variance_next * np.sqrt(step) / variance
    prior = np.sqrt(before) * x0
    mean = prior + gain * (x_t - np.sqrt(step) * prior)
    posterior = variance_next - gain * np.sqrt(step) * variance_next
    tables = {
        "alpha_bar": alpha_bar,
        "variance": variance,
        "alpha_bar_next": before,
        "variance_next": variance_next,
    }
    still = ddim_step(x_t=x_t, x0=x0, eta=1.0, noise=0.0, **tables)
    moved = ddim_step(x_t=x_t, x0=x0, eta=1.0, noise=1.0, **tables)
    assert still == pytest.approx(mean, abs=1e-14)
    assert (moved - still) ** 2 == pytest.approx(posterior, abs=1e-14)


def test_q_sample_has_the_stated_moments():
    noise = np.random.default_rng(3).standard_normal(200_000)
    drawn = q_sample(x0=2.0, noise=noise, alpha_bar=0.49, variance=0.51)
    assert drawn.mean() == pytest.approx(1.4, abs=0.01)
    assert drawn.var() == pytest.approx(0.51, abs=0.01)


def test_numpy_and_torch_take_the_same_step():
    rng = np.random.default_rng(4)
    x_t, x0, noise = rng.standard_normal((3, 5))
    tables = {"alpha_bar": 0.4, "variance": 0.6, "alpha_bar_next": 0.7, "variance_next": 0.3}
    by_numpy = ddim_step(x_t=x_t, x0=x0, noise=noise, eta=0.7, **tables)
    by_torch = ddim_step(
        x_t=torch.from_numpy(x_t),
        x0=torch.from_numpy(x0),
        noise=torch.from_numpy(noise),
        eta=0.7,
        **tables,
    )
    assert by_torch.numpy() == pytest.approx(by_numpy, abs=1e-15)


@given(num_steps=st.integers(1, 200), data=st.data())
def test_early_stop_takes_the_noisiest_timesteps_first(num_steps, data):
    stop_after = data.draw(st.integers(1, num_steps))
    taken = timesteps(num_steps, stop_after)
    assert taken == tuple(reversed(range(num_steps)))[:stop_after]


@given(num_timesteps=st.integers(1, 200), data=st.data())
def test_stride_starts_at_the_noisiest_and_spreads_evenly(num_timesteps, data):
    num_steps = data.draw(st.integers(1, num_timesteps))
    taken = timesteps(num_timesteps, num_steps, plan="stride")
    assert (len(taken), taken[0]) == (num_steps, num_timesteps - 1)
    gaps = -np.diff([*taken, -1])
    assert {*gaps} <= {num_timesteps // num_steps, -(-num_timesteps // num_steps)}


def test_stride_of_ten_of_a_hundred():
    assert timesteps(100, 10, plan="stride") == (99, 89, 79, 69, 59, 49, 39, 29, 19, 9)


@pytest.mark.parametrize("plan", ["stop_early", "stride"])
@pytest.mark.parametrize("num_steps", [0, 11, -1])
def test_more_steps_than_the_chain_has_are_refused(num_steps, plan):
    with pytest.raises(ValueError, match="must be from 1 to 10"):
        timesteps(10, num_steps, plan=plan)


@pytest.mark.parametrize(
    ("alpha_bar", "variance"),
    [
        ([0.5, 0.6], [[0.5], [0.4]]),
        ([1.2, 0.6], [[0.5], [0.4]]),
        ([0.9, 0.6], [[0.0], [0.4]]),
    ],
)
def test_impossible_tables_are_refused(alpha_bar, variance):
    with pytest.raises(ValueError, match="schedule"):
        Schedule(alpha_bar=np.array(alpha_bar), variance=np.array(variance))


def test_isotropic_noise_has_one_direction():
    schedule = isotropic(np.array([0.9, 0.5]))
    assert schedule.variance.tolist() == pytest.approx(np.array([[0.1], [0.5]]))
