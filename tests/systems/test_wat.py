import math

import pytest
import torch

from models.systems.wat import objective, recipes
from models.systems.wat.recurrent import RecurrentVAE
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


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_frames_do_not_depend_on_how_many_follow(form):
    observed, action = drawn(2, 15, FEATURES), torch.tensor([0, 2])
    z = drawn(2, 8 if isinstance(form, TransformerVAE) else 4)
    state = form.begin(observed, action)
    short, _ = form.advance(z, state, 30)
    long, _ = form.advance(z, state, 60)
    assert long.shape == (2, 60, FEATURES)
    torch.testing.assert_close(short, long[:, :30])


def test_recurrent_form_goes_on_from_what_it_carries():
    form = recurrent()
    observed, action, z = drawn(2, 15, FEATURES), torch.tensor([0, 2]), drawn(2, 4)
    state = form.begin(observed, action)
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
    size = 8 if isinstance(form, TransformerVAE) else 4
    z = drawn(1, size)

    def frames(action: int, latent: torch.Tensor) -> torch.Tensor:
        return form.advance(latent, form.begin(observed, torch.tensor([action])), 20)[0]

    assert not torch.allclose(frames(0, z), frames(1, z))
    assert not torch.allclose(frames(0, z), frames(0, -z))


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
    joined = wat.joined(features, observed, torch.ones(2, 1))
    heading = (observed[:, -1] - observed[:, -3]) / 2 * wat.momentum
    torch.testing.assert_close(joined[:, 0], observed[:, -1] + heading)
    torch.testing.assert_close(joined[:, 1], observed[:, -1] + 2 * heading, atol=1e-5, rtol=0)
    assert torch.equal(joined[:, objective.FADED_AFTER :], features[:, objective.FADED_AFTER :])
    gap = (joined - features)[:, objective.FADED_AFTER - 1].abs().max()
    assert gap < 0.1 * (joined - features)[:, 0].abs().max()
    assert torch.equal(wat.joined(features, observed, torch.zeros(2, 1)), features)


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
