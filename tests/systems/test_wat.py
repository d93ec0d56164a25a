import math

import pytest
import torch

from models.motion.skeleton import BODY21
from models.systems.wat import objective, recipes
from models.systems.wat.graphs import FRAMES_AT_REST
from models.systems.wat.recurrent import RecurrentVAE
from models.systems.wat.timing import (
    LENGTH_UNIT,
    NUM_RATES,
    NUM_TIMES,
    PERIOD_UNIT,
    Clock,
    Rhythm,
)
from models.systems.wat.transformer import TransformerVAE

FEATURES, PATCH = 9, 5


def recurrent() -> RecurrentVAE:
    return RecurrentVAE(
        features=FEATURES,
        num_actions=3,
        latent=4,
        hidden=6,
        widths=(8, 8),
        frames_per_step=PATCH,
    )


def transformer() -> TransformerVAE:
    return TransformerVAE(
        features=FEATURES,
        num_actions=3,
        num_observed=15,
        horizon=60,
        width=8,
        heads=2,
        feed_forward=8,
        layers=2,
        frames_per_step=PATCH,
    ).eval()


@pytest.fixture(params=[recurrent, transformer], ids=["recurrent", "transformer"])
def form(request):
    made = request.param()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():  # outputs start near zero and would hide errors
        for parameter in made.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return made


def size_of_z(form) -> int:
    return (8 if isinstance(form, TransformerVAE) else 4) + NUM_TIMES


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_frames_do_not_depend_on_how_many_follow(form):
    observed, action = drawn(2, 15, FEATURES), torch.tensor([0, 2])
    z = drawn(2, size_of_z(form))
    _, state = form.begin(observed, action)
    short, _ = form.advance(z, state, 30)
    long, _ = form.advance(z, state, 60)
    assert long.shape == (2, 60, FEATURES)
    torch.testing.assert_close(short, long[:, :30])


def test_recurrent_form_goes_on_from_what_it_carries():
    form = recurrent()
    observed, action, z = drawn(2, 15, FEATURES), torch.tensor([0, 2]), drawn(2, 4 + NUM_TIMES)
    _, state = form.begin(observed, action)
    whole, _ = form.advance(z, state, 40)
    kept = state[: len(form.kept)]
    first, carried = form.advance(z, state, 20)
    second, _ = form.advance(z, (*kept, *carried), 20)
    torch.testing.assert_close(torch.cat([first, second], dim=1), whole)


def test_cell_is_a_gated_recurrent_unit():
    form = recurrent()
    ours, theirs = form, torch.nn.GRUCell(5, 6)
    given, hidden = drawn(3, 5), drawn(3, 6, seed=1)
    with torch.no_grad():
        ours.from_hidden.weight.copy_(theirs.weight_hh)
        ours.from_hidden.bias.copy_(theirs.bias_hh)
    projected = given @ theirs.weight_ih.T + theirs.bias_ih
    torch.testing.assert_close(ours._cell(projected, hidden), theirs(given, hidden))


def test_posterior_sees_what_is_performed_and_nothing_after(form):
    observed, action = drawn(1, 15, FEATURES), torch.tensor([1])
    future, count = drawn(1, 60, FEATURES, seed=2), torch.tensor([30])
    mean, _ = form.posterior(observed, future, count, action)
    later, earlier = future.clone(), future.clone()
    later[:, 30:] += 1.0
    earlier[:, 29] += 1.0
    torch.testing.assert_close(form.posterior(observed, later, count, action)[0], mean)
    assert not torch.allclose(form.posterior(observed, earlier, count, action)[0], mean)


def test_action_and_latent_decide_what_is_performed(form):
    observed = drawn(1, 15, FEATURES)
    z = drawn(1, size_of_z(form))

    def frames(action: int, latent: torch.Tensor) -> torch.Tensor:
        _, state = form.begin(observed, torch.tensor([action]))
        return form.advance(latent, state, 20)[0]

    assert not torch.allclose(frames(0, z), frames(1, z))
    assert not torch.allclose(frames(0, z), frames(0, -z))


def timing(*, length: float = 40.0, period: float = 30.0, phase: float = 0.0) -> torch.Tensor:
    numbers = [length / LENGTH_UNIT, PERIOD_UNIT / period, math.e ** math.cos(phase)]
    return torch.cat([torch.tensor([numbers]).log(), torch.tensor([[math.sin(phase)]])], dim=1)


@pytest.mark.parametrize("change", [{"length": 20.0}, {"period": 20.0}, {"phase": 2.0}])
def test_timing_decides_what_is_performed(form, change):
    observed, z = drawn(1, 15, FEATURES), drawn(1, size_of_z(form) - NUM_TIMES)
    _, state = form.begin(observed, torch.tensor([0]))
    frames = [
        form.advance(torch.cat([z, times], dim=1), state, 30)[0]
        for times in (timing(), timing(**change))
    ]
    assert not torch.allclose(*frames)


def clock_features(step: float, times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sines and cosines of the time left, and of the phase."""
    features = Clock(PATCH)(torch.tensor([[step]]), times)[0]
    rates = NUM_RATES
    left = torch.cat([features[rates : 2 * rates], features[3 * rates : 4 * rates]])
    return left, features[4 * rates : 4 * rates + 2]


def test_clock_counts_down_to_the_end_and_stands_still_after_it():
    def left(step: float, length: float) -> torch.Tensor:
        return clock_features(step, timing(length=length))[0]

    for step in (8.0, 50.0):
        torch.testing.assert_close(left(step, 30), left(7.0, 30))
    assert not torch.allclose(left(6.0, 30), left(7.0, 30))
    torch.testing.assert_close(left(2.0, 80), left(12.0, 130), atol=1e-5, rtol=0)


def test_clock_turns_once_in_a_period_from_its_phase():
    for step, turns in ((0.0, 0.0), (2.0, 0.5), (3.0, 0.75), (4.0, 1.0)):
        _, beat = clock_features(step, timing(period=20.0, phase=0.7))
        angle = torch.tensor(2 * math.pi * turns + 0.7)
        torch.testing.assert_close(beat, torch.stack([angle.cos(), angle.sin()]))


def walkers(*, periods: tuple[float, ...], phase: float, reach: float) -> torch.Tensor:
    """People who face +Y, their feet swinging, 90 frames."""
    joints = BODY21.joints
    poses = torch.zeros(len(periods), 90, BODY21.num_joints, 3)
    angle = 2 * math.pi * torch.arange(90) / torch.tensor(periods)[:, None] + phase
    for joint, side in enumerate(BODY21.sides):
        sign = {"left": 1.0, "right": -1.0, "center": 0.0}[side]
        poses[:, :, joint, 0] = -0.1 * sign
        poses[:, :, joint, 2] = 0.0 if "foot" in joints[joint] else 1.0
        if "foot" in joints[joint] or "toes" in joints[joint]:
            poses[:, :, joint, 1] = 0.5 * reach * sign * angle.cos()
    return poses


def test_rhythm_is_that_of_the_feet():
    rhythm = Rhythm(BODY21)
    poses = walkers(periods=(25.0, 40.0), phase=0.9, reach=0.4)
    rhythm.fit(poses)
    assert [BODY21.joints[j] for j in rhythm.feet] == ["left_foot", "right_foot"]
    known = torch.ones(2, 90, dtype=torch.bool)
    known[1, :15] = False
    poses[1, :15] = drawn(15, 21, 3)
    found, sure = rhythm.measure(poses, known)
    expected = torch.tensor([30 / 25, 30 / 40]).log()
    torch.testing.assert_close(found[:, 0], expected, atol=0.02, rtol=0)
    wanted = torch.tensor([math.cos(0.9), math.sin(0.9)]).expand(2, 2)
    torch.testing.assert_close(found[:, 1:], wanted, atol=0.15, rtol=0)
    assert sure.min() > 0.8


def test_people_who_stand_have_no_rhythm():
    rhythm = Rhythm(BODY21)
    poses = walkers(periods=(25.0,), phase=0.0, reach=0.005)
    rhythm.fit(poses)
    _, sure = rhythm.measure(poses, torch.ones(1, 90, dtype=torch.bool))
    assert sure.max() < 0.1


def test_no_length_that_is_drawn_lasts_to_the_horizon():
    recipe = recipes.tiny()
    wat = recipe.build().eval()
    graphs = {graph.role: graph for graph in recipe.graphs(wat)}
    encoder, decoder = graphs["encoder"], graphs["decoder"]
    observation, action = 0.3 * drawn(1, 15, 21, 3), torch.tensor([0])
    given = dict(zip(encoder.outputs, encoder.module(observation, action), strict=True))
    noise = torch.zeros(1, *recipe.x_t_shape)
    given |= {"observation": observation, "noise": noise, "mean": torch.zeros_like(noise)}

    def earliest_end(log_length: float) -> float:
        given["mean"][0, -NUM_TIMES] = log_length
        outputs = decoder.module(*(given[name] for name in decoder.inputs))
        return dict(zip(decoder.outputs, outputs, strict=True))["earliest_end"].item()

    assert earliest_end(math.log(0.1)) == pytest.approx(0.1 * LENGTH_UNIT)
    assert earliest_end(5.0) == pytest.approx(recipe.data.horizon - FRAMES_AT_REST)


def test_kl_is_that_of_two_normal_distributions():
    mean, prior_mean = drawn(4, 3), drawn(4, 3, seed=1)
    log_variance, prior_log_variance = drawn(4, 3, seed=2), drawn(4, 3, seed=3)
    q = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    p = torch.distributions.Normal(prior_mean, (0.5 * prior_log_variance).exp())
    expected = torch.distributions.kl_divergence(q, p).sum(dim=1)
    found = objective._kl(mean, log_variance, prior_mean, prior_log_variance)
    torch.testing.assert_close(found, expected)


def network() -> objective.WAT:
    return recipes.tiny().build()


def test_joined_frames_go_on_where_the_observation_was_heading():
    wat = network()
    width = wat.poses.num_features
    observed, features = drawn(2, 15, width), drawn(2, 40, width, seed=1)
    joined = wat.joined(features, wat.bound_for(observed), torch.ones(2, 1))
    heading = (observed[:, -1] - observed[:, -3]) / 2 * wat.momentum
    torch.testing.assert_close(joined[:, 0], observed[:, -1] + heading)
    torch.testing.assert_close(joined[:, 1], observed[:, -1] + 2 * heading, atol=1e-5, rtol=0)
    assert torch.equal(joined[:, objective.FADED_AFTER :], features[:, objective.FADED_AFTER :])
    gap = (joined - features)[:, objective.FADED_AFTER - 1].abs().max()
    assert gap < 0.1 * (joined - features)[:, 0].abs().max()
    assert torch.equal(wat.joined(features, wat.bound_for(observed), torch.zeros(2, 1)), features)


def test_smooth_prior_lets_slow_motion_pass_and_not_a_jump():
    wat = network()
    frame = torch.arange(2 * objective.HALF_WINDOW)
    slow = torch.cos(math.pi * (frame + 0.5) * 2 / len(frame))[:, None]
    jump = (frame >= objective.HALF_WINDOW).float()[:, None]
    rough = [(x - wat.smooth @ x).square().mean() for x in (slow, jump)]
    assert rough[0] < 1e-10
    assert rough[1] > 1e-2


def batch(*, first: int, length: int, num_frames: int = 60) -> dict[str, torch.Tensor]:
    poses = 0.3 * drawn(2, 15 + num_frames, 21, 3)
    return {
        "observation": poses[:, :15],
        "seen": poses[:, :15],
        "future": poses[:, 15:].clone(),
        "action": torch.tensor([0, 1]),
        "first": torch.tensor([first, first]),
        "length": torch.tensor([length, length]),
    }


def reconstruction(wat: objective.WAT, data: dict[str, torch.Tensor]) -> torch.Tensor:
    """Of a decoder that ignores z, so that what the posterior sees does not matter."""
    with torch.no_grad():
        for part in ("from_request", "output"):
            for parameter in getattr(wat.form, part).parameters():
                parameter.zero_()
    terms = objective._terms(
        wat, data, torch.Generator().manual_seed(0), padding=10, told=(0.0, 0.0)
    )
    return terms[0].detach()


def test_transition_and_what_follows_the_padding_are_not_learnt():
    wat = network()
    plain = reconstruction(wat, batch(first=10, length=30))
    for frames in (slice(0, 10), slice(41, 60)):
        data = batch(first=10, length=30)
        data["future"][:, frames] += drawn(1, seed=5)
        assert torch.allclose(reconstruction(wat, data), plain)
    for frame in (11, 30, 39):  # the action, and its end held still
        data = batch(first=10, length=30)
        data["future"][:, frame, 5] += 0.3
        assert not torch.allclose(reconstruction(wat, data), plain)


def test_loss_does_not_depend_on_the_order_of_the_rows():
    wat = network()
    stage = recipes.tiny().stages[0]
    data = batch(first=0, length=30) | {"length": torch.tensor([20, 40])}
    swapped = {name: value.flip(0) for name, value in data.items()}
    totals = [
        stage.loss(wat, rows, torch.Generator().manual_seed(0))["reconstruction"]
        for rows in (data, swapped)
    ]
    torch.testing.assert_close(totals[0], totals[1])
