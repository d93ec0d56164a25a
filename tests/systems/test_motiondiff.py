"""MotionDiff's parts against the equations of its paper."""

import math

import pytest
import torch
from tiny_networks import network_of

from models.diffusion import linear_schedule, timesteps
from models.pose import cosine_basis
from models.system import describe
from models.systems.motiondiff import objective, recipes
from models.systems.motiondiff.keyframes import Keyframes
from models.systems.motiondiff.refiner import GraphConvolution, Refiner, SpreadRefiner

FORMS = {"keyframes": recipes.tiny, "paper": recipes.tiny_paper}


@pytest.fixture(params=FORMS.values(), ids=FORMS)
def recipe(request):
    return request.param()


def seen_by(network, recipe, rows):
    features = network.representation.num_features
    return torch.randn(rows, recipe.data.num_observed, features, generator=torch.Generator())


@torch.no_grad()
def test_x0_and_eps_are_the_two_parts_of_x_t(recipe):
    network = network_of(recipe)
    timestep = torch.tensor([0, 40, 99])
    x_t = torch.randn(3, *recipe.x_t_shape)
    conditions = network.conditions(seen_by(network, recipe, 3))
    eps = network.denoiser(x_t, timestep, *conditions)
    x0 = network.x0(x_t, timestep, conditions)
    alpha_bar = torch.from_numpy(linear_schedule(100).alpha_bar)[timestep][:, None, None, None]
    assert torch.allclose(
        alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * eps, x_t.double(), atol=1e-5
    )
    assert float(eps.std()) > 0.01


@torch.no_grad()
def test_a_single_step_answers_with_the_x0_of_pure_noise(recipe):
    network = network_of(recipe)
    observation = seen_by(network, recipe, 2)
    found = objective.sample(
        network,
        observation,
        torch.Generator().manual_seed(4),
        schedule=linear_schedule(100),
        num_samples=1,
        num_steps=1,
    )
    noise = torch.randn((2, *recipe.x_t_shape), generator=torch.Generator().manual_seed(4))
    x0 = network.x0(noise, torch.full((2,), 99), network.conditions(observation))
    assert torch.equal(found[:, 0], network.motion.leave(observation, x0))


@torch.no_grad()
def test_sampling_ends_at_x0_and_not_at_the_last_x_t(recipe):
    """One step more than the chain's last would change nothing: alpha_bar there is 1."""
    network = network_of(recipe)
    observation = seen_by(network, recipe, 1)
    arguments = {"schedule": linear_schedule(100), "num_samples": 3}
    few, many = (
        objective.sample(
            network, observation, torch.Generator().manual_seed(1), num_steps=n, **arguments
        )
        for n in (5, 100)
    )
    assert (
        few.shape == many.shape == (1, 3, recipe.data.horizon, network.representation.num_features)
    )
    assert not torch.allclose(few, many)
    assert few.isfinite().all()


def test_keyframes_of_a_motion_give_it_back_and_nothing_jumps():
    motion = Keyframes(features=6, num_target=3, horizon=20, num_frames=8)
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(50, 5, 6, generator=generator)
    future = torch.randn(50, 20, 6, generator=generator)
    motion.fit(observation, future, noise_m=0.01, whitening=0.5)
    x0 = motion.enter(observation, future)
    assert x0.shape == (50, 8, 2, 3)
    told = motion.leave(observation, x0)
    assert torch.allclose(motion.enter(observation, told), x0, atol=1e-5)
    still = motion.leave(observation, torch.zeros_like(x0))
    assert torch.allclose(still, motion.continuation.expected(observation[:, -3:]), atol=1e-6)
    # What remains is no smaller along any other offset that the basis can tell.
    remains = torch.matmul(motion.continuation.basis.T, future - told)
    assert torch.allclose(remains, torch.zeros_like(remains), atol=1e-4)


def test_direction_that_varies_most_has_the_deviation_two():
    motion = Keyframes(features=6, num_target=3, horizon=20, num_frames=8)
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(400, 5, 6, generator=generator)
    future = torch.randn(400, 20, 6, generator=generator).cumsum(dim=1)
    variance = motion.fit(observation, future, noise_m=0.01, whitening=0.5)
    x0 = motion.enter(observation, future)
    assert torch.allclose(variance, x0.var(dim=0), atol=1e-6)
    values = torch.linalg.eigvalsh(torch.cov(x0.flatten(1).T))
    assert float(values[-1].sqrt()) == pytest.approx(2.0, rel=1e-3)


def test_dct_of_a_motion_gives_it_back():
    motion = torch.randn(4, 30, 9, generator=torch.Generator().manual_seed(2))
    basis = cosine_basis(30, 30)
    assert torch.allclose(torch.matmul(basis, torch.matmul(basis.T, motion)), motion, atol=1e-5)


def test_graph_convolution_is_the_product_of_its_paper():
    layer = GraphConvolution(2, 1, nodes=3)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[1.0], [10.0]]))
        layer.adjacency.copy_(torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 2.0], [1.0, 1.0, 1.0]]))
        layer.bias.fill_(0.5)
    nodes = torch.tensor([[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]])  # X W = 21, 43, 65
    assert layer(nodes).flatten().tolist() == pytest.approx([43.5, 130.5, 129.5])


SIZES = {"features": 6, "num_observed": 5, "horizon": 7, "hidden": 8, "blocks": 2}
REFINERS = {
    "paper": lambda: Refiner(**SIZES, coefficients=12),
    "spread": lambda: SpreadRefiner(**SIZES, coefficients=6),
}


@pytest.fixture(params=REFINERS.values(), ids=REFINERS)
def refiner(request):
    torch.manual_seed(1)  # noqa: TID251 - a test may fix the weights it makes
    return request.param()


def motions(rows, refiner):
    """An observation, a future, and what is expected where a refinement looks at it."""
    generator = torch.Generator().manual_seed(5)
    frames = (5, 7, 7) if refiner.conditions else (5, 7)
    return tuple(torch.randn(rows, count, 6, generator=generator) for count in frames)


def with_weights(refiner):
    for part in refiner.modules():
        if isinstance(part, GraphConvolution) and not part.weight.any():
            torch.nn.init.normal_(part.weight)
    return refiner.eval()


def test_refiner_learns_which_coordinates_move_one_another(refiner):
    with_weights(refiner)(*motions(2, refiner)).square().sum().backward()
    convolutions = [part for part in refiner.modules() if isinstance(part, GraphConvolution)]
    assert len(convolutions) == {"Refiner": 6, "SpreadRefiner": 8}[type(refiner).__name__]
    assert all(float(part.adjacency.grad.abs().sum()) > 0 for part in convolutions)


def test_refiner_starts_by_changing_nothing(refiner):
    assert torch.equal(refiner(*motions(2, refiner)), torch.zeros(2, 7, 6))


@torch.no_grad()
def test_what_is_expected_is_refined_by_what_the_noise_asks_for_alone():
    refiner = with_weights(REFINERS["spread"]())
    observation, future, expected = motions(2, refiner)
    mended = refiner(observation, expected, expected)
    assert float(mended.abs().max()) > 0.1
    still = observation[:, -1:].expand_as(observation)  # whose spectrum is zero
    assert torch.equal(refiner(still, expected, expected), torch.zeros_like(future))
    moved = refiner(still, future, expected)
    assert float(moved.abs().max()) > 0.1
    deviation = torch.matmul(refiner.basis.T, future - expected)
    grown = torch.matmul(refiner.basis.T, future + moved - expected)
    ratio = grown / deviation
    assert float(ratio.min()) >= 0
    assert float(ratio.max()) <= 2


@torch.no_grad()
def test_units_of_the_spread_are_those_of_real_deviations():
    refiner = REFINERS["spread"]()
    observation, future, expected = motions(400, refiner)
    refiner.fit(observation, 3 * future, 3 * expected)
    deviation = torch.matmul(refiner.basis.T, 3 * (future - expected))
    assert torch.allclose(refiner.scale, deviation.std(dim=0).T, atol=1e-5)


@torch.no_grad()
def test_expectation_is_the_x0_of_a_last_timestep_that_says_nothing():
    network = network_of(recipes.tiny())
    conditions = network.conditions(seen_by(network, recipes.tiny(), 3))
    (found,) = network.expectation(conditions)
    nothing = torch.zeros(3, *recipes.tiny().x_t_shape)
    wanted = network.x0(nothing, torch.full((3,), 99), conditions)
    assert torch.allclose(found, wanted.float(), atol=1e-5)
    assert float(found.std()) > 0.01
    paper = network_of(recipes.tiny_paper())
    assert paper.expectation(paper.conditions(seen_by(paper, recipes.tiny_paper(), 2))) == ()


def test_only_the_nearest_sample_is_reconstructed():
    future = torch.zeros(1, 2, 3)
    near = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 12.0]])  # poses 5 and 12 away
    far = torch.tensor([[13.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # poses 13 and 0 away
    samples = torch.stack([near, far])[None]
    assert float(objective.best_of(samples, future)) == pytest.approx(169.0)
    assert float(objective.best_of(samples[:, :1], future)) == pytest.approx(169.0)
    assert float(objective.best_of(samples, future, exponent=1.0)) == pytest.approx(13.0, abs=1e-3)
    assert float(objective.best_of(samples[:, :1], future, exponent=1.0)) == pytest.approx(17.0)


def test_diversity_loss_is_that_of_three_samples_by_hand():
    samples = torch.tensor([0.0, 1.0, 3.0])[None, :, None, None]
    wanted = 2 * (math.exp(-1 / 2) + math.exp(-9 / 2) + math.exp(-4 / 2)) / 6
    assert float(objective.closeness(samples, sigma=2.0)) == pytest.approx(wanted, rel=1e-5)
    assert float(objective.closeness(torch.ones(2, 4, 3, 3), sigma=2.0)) == pytest.approx(1.0)


def test_stage_without_refinement_is_the_diffusion_as_it_is():
    whole, bare = recipes.mocap_held_out(), recipes.mocap_diffusion_held_out()
    assert describe(bare.stages) == describe(whole.stages[:1])
    network = network_of(recipes.tiny())
    graphs = {refines: bare.graphs.func(network, refines=refines) for refines in (True, False)}
    x0, seen = torch.randn(2, *recipes.tiny().x_t_shape), torch.randn(2, 15, 21, 3)
    *conditions, expectation = graphs[True][0].module(seen)
    assert len(conditions) == len(graphs[False][0].module(seen))
    refined = graphs[True][2].module(x0, seen, expectation)
    plain = graphs[False][2].module(x0, seen)
    features = network.representation.enter(seen, seen)
    expected = network.representation.leave(seen, network.motion.leave(features, x0))
    assert torch.allclose(plain, expected)
    assert not torch.allclose(refined, expected, atol=1e-4)


def test_paper_s_sizes_are_the_counted_ones():
    network = recipes.h36m().build()
    counts = {
        name: sum(parameter.numel() for parameter in part.parameters()) / 1e6
        for name, part in network.named_children()
    }
    assert counts["encoder"] == pytest.approx(1.61, abs=0.01)
    assert counts["refiner"] == pytest.approx(2.29, abs=0.01)


@pytest.mark.parametrize("make", [recipes.mocap, recipes.h36m], ids=["mocap", "h36m"])
def test_ablation_of_the_spatial_transformer_has_none(make):
    name = f"{make.__name__}_without_spatial_transformer"
    ablated = getattr(recipes, name)()
    assert ablated.name == name
    spatial = ablated.build().get_submodule("denoiser.spatial")
    assert sum("qkv" in key for key, _ in spatial.named_parameters()) == 0
    whole = make().build().get_submodule("denoiser.spatial")
    assert sum("qkv" in key for key, _ in whole.named_parameters()) > 0


@pytest.mark.parametrize("make", [recipes.mocap, recipes.h36m], ids=["mocap", "h36m"])
def test_default_is_a_stride_of_ten(make):
    recipe = make()
    taken = timesteps(recipe.schedule.num_steps, recipe.default_steps, plan=recipe.plan)
    assert taken == tuple(range(99, 0, -10))
    assert recipe.schedule.alpha_bar[-1] == pytest.approx(0.0782, abs=1e-4)
