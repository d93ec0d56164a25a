"""SkeletonDiffusion against its equations and the published tables (Curreli et al. 2025)."""

import numpy as np
import pytest
import torch
from tiny_bundles import walking

from models.diffusion import cosine_schedule, ddim_step
from models.motion.kinematics import bone_lengths
from models.motion.skeleton import BODY21, H36M17, SMPL22
from models.systems.skeletondiffusion import objective, recipes
from models.systems.skeletondiffusion.nodes import (
    CanonicalNodes,
    RootRelativeNodes,
    continuing_spline,
)
from models.systems.skeletondiffusion.noise import (
    SMALLEST_EIGENVALUE,
    NodeGraph,
    constant,
    falling,
    nonisotropic,
    with_root,
    without_root,
)
from models.systems.skeletondiffusion.typed_graph import (
    TypedGraphAttention,
    TypedGraphGRU,
    TypedGraphLinear,
)

ALPHA_BAR = cosine_schedule(10).alpha_bar
CHAIN = NodeGraph(types=(0, 1, 1), edges=((0, 1), (1, 2)))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_like(module: torch.nn.Module, seed: int = 0) -> torch.nn.Module:
    """The module with weights that no initialisation hides."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator(seed)) * 0.4)
    return module


def body(num_frames: int, *, speed: float = 1.0) -> torch.Tensor:
    poses = walking(num_frames, fps=30.0, speed=speed)
    return torch.from_numpy(poses.astype(np.float32))[None]


# The graph and its noise


def test_left_and_right_joints_share_a_type():
    expected = (0, 1, 2, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 7, 8, 9)
    assert without_root(H36M17).types == expected
    assert without_root(SMPL22).types == (0, 0, 1, 2, 2, 3, 4, 4, 5, 6, 6, 7, 8, 8, 9, 10, 10, 11,
                                          11, 12, 12)  # fmt: skip
    assert len(with_root(BODY21).types) == 21
    assert with_root(BODY21).types[0] not in with_root(BODY21).types[1:]


@pytest.mark.parametrize(
    ("skeleton", "edges", "spectrum"),
    [(H36M17, 16, (-2.3016, 2.5908)), (SMPL22, 21, (-2.2971, 2.5314))],
)
def test_adjacency_has_the_published_spectrum(skeleton, edges, spectrum):
    graph = without_root(skeleton)
    assert graph.adjacency.sum() == 2 * edges
    values = np.linalg.eigvalsh(graph.adjacency)
    assert (values[0], values[-1]) == pytest.approx(spectrum, abs=1e-4)


@pytest.mark.parametrize("graph", [with_root(BODY21), without_root(H36M17), CHAIN])
def test_correlation_is_eq_4_with_its_zero_raised(graph: NodeGraph):
    adjacency = np.linalg.eigvalsh(graph.adjacency)
    plain = (adjacency - adjacency[0]) / (adjacency[-1] - adjacency[0])
    values, vectors = graph.eigen()
    assert values == pytest.approx(np.maximum(plain, SMALLEST_EIGENVALUE))
    assert vectors * values @ vectors.T == pytest.approx(graph.correlation)
    assert graph.correlation @ graph.adjacency == pytest.approx(graph.adjacency @ graph.correlation)


@pytest.mark.parametrize("gamma", [falling, constant])
def test_variance_is_the_sum_of_what_every_transition_adds(gamma):
    eigenvalues = with_root(BODY21).eigen()[0]
    schedule = nonisotropic(ALPHA_BAR, eigenvalues, gamma=gamma)
    alpha = ALPHA_BAR / np.concatenate([[1.0], ALPHA_BAR[:-1]])
    total = np.zeros_like(eigenvalues)
    for t in range(10):
        share = gamma(t / 10)
        step = (1 - alpha[t]) * (share * eigenvalues + (1 - share))  # eq. 5
        total = alpha[t] * total + step
        assert schedule.variance[t] == pytest.approx(total, rel=1e-12)


def test_noise_goes_from_the_skeleton_s_shape_to_isotropic():
    schedule = nonisotropic(ALPHA_BAR, np.array([0.0001]), gamma=falling)
    shaped = 1 - schedule.variance[:, 0] / (1 - ALPHA_BAR)
    assert shaped[0] == pytest.approx(1.0, abs=1e-3)
    assert shaped[-1] == pytest.approx(0.10, abs=5e-3)
    assert np.all(np.diff(shaped) < 0)


def test_isotropic_spectrum_gives_the_isotropic_schedule():
    schedule = nonisotropic(ALPHA_BAR, np.ones(4))
    np.testing.assert_allclose(schedule.variance, np.repeat(1 - ALPHA_BAR[:, None], 4, axis=1))


def test_ddpm_step_is_the_posterior_of_eq_7():
    graph = with_root(BODY21)
    schedule = nonisotropic(ALPHA_BAR, graph.eigen()[0])
    rng = np.random.default_rng(0)
    x_t, x0, noise = rng.standard_normal((3, 21))
    for t in range(1, 10):
        alpha = ALPHA_BAR[t] / ALPHA_BAR[t - 1]
        before, now = schedule.variance[t - 1], schedule.variance[t]
        added = now - alpha * before
        mean = alpha**0.5 * before / now * x_t + ALPHA_BAR[t - 1] ** 0.5 * added / now * x0
        expected = mean + (added * before / now) ** 0.5 * noise
        found = ddim_step(
            x_t=x_t, x0=x0, alpha_bar=ALPHA_BAR[t], variance=now,
            alpha_bar_next=ALPHA_BAR[t - 1], variance_next=before, eta=1.0, noise=noise,
        )  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


# Layers


def test_typed_graph_layer_is_eq_8():
    layer = random_like(TypedGraphLinear(CHAIN, 4, 5))
    x = torch.randn(3, 2, 4, generator=generator())
    weight, bias, mixing = layer.features.weight, layer.features.bias, layer.mixing
    found = layer(x)
    for j in range(3):
        share = mixing[j] / mixing[j].abs().sum()
        terms = [share[i] * (x[i] @ weight[t] + bias[t]) for i, t in enumerate(CHAIN.types)]
        torch.testing.assert_close(found[j], sum(terms))


def test_recurrent_cell_without_a_graph_is_a_plain_one():
    alone = NodeGraph(types=(0,), edges=())
    cell, plain = random_like(TypedGraphGRU(alone, 4, 6)), torch.nn.GRUCell(4, 6)
    with torch.no_grad():
        cell.mixing.copy_(torch.eye(1))
        # ours orders reset, update, new as torch does
        plain.weight_ih.copy_(cell.inputs.weight[0].T)
        plain.bias_ih.copy_(cell.inputs.bias[0, 0])
        plain.weight_hh.copy_(cell.state.weight[0].T)
        plain.bias_hh.copy_(cell.state.bias[0, 0])
    x, state = torch.randn(3, 4, generator=generator(1)), torch.randn(3, 6, generator=generator(2))
    found = cell(cell.inputs(x[None]), state[None], cell.mixings(1)[0])
    torch.testing.assert_close(found[0], plain(x, state))


def test_graph_of_a_decoder_drifts_from_tick_to_tick():
    cell = TypedGraphGRU(CHAIN, 2, 2, drifts=True)
    still = cell.mixings(3)
    torch.testing.assert_close(still[0], still[2])
    with torch.no_grad():
        cell.drift.copy_(torch.full((3, 3), 0.5))
    first, second, third = cell.mixings(3)
    torch.testing.assert_close(second, (first + 0.5) / (first + 0.5).abs().sum(1, keepdim=True))
    torch.testing.assert_close(third, (second + 0.5) / (second + 0.5).abs().sum(1, keepdim=True))


def test_attention_is_over_the_nodes_of_a_row():
    attention = random_like(TypedGraphAttention(CHAIN, 8, heads=2, head_width=4))
    x = torch.randn(3, 5, 8, generator=generator())
    found = attention(x)
    normed = torch.nn.functional.rms_norm(x, (8,), attention.scale, eps=1e-6)
    query, key, value = (
        part(normed).permute(1, 0, 2).unflatten(2, (2, 4)).transpose(1, 2)
        for part in attention.queries_keys_values
    )
    mixed = torch.nn.functional.scaled_dot_product_attention(query, key, value)
    expected = x + attention.out(mixed.transpose(1, 2).flatten(2).permute(1, 0, 2))
    torch.testing.assert_close(found, expected)
    other = x.clone()
    other[:, 0] += 1.0  # another row
    torch.testing.assert_close(attention(other)[:, 1:], found[:, 1:])


@pytest.mark.parametrize(
    ("recipe", "autoencoder", "denoiser"),
    [(recipes.h36m, 1.06e6, 25.5e6), (recipes.amass, 2.10e6, 32.1e6)],
)
def test_networks_have_the_published_sizes(recipe, autoencoder, denoiser):
    network = recipe().build()

    def count(*parts: torch.nn.Module) -> int:
        return sum(p.numel() for part in parts for p in part.parameters())

    assert count(network.encoder, network.decoder) == pytest.approx(autoencoder, rel=0.01)
    assert count(network.denoiser) == pytest.approx(denoiser, rel=0.01)


# Motion on the nodes


def canonical_nodes(*, rigid: bool) -> CanonicalNodes:
    return CanonicalNodes(
        BODY21, num_observed=15, horizon=60, frames_per_tick=10,
        knot_frames=3, knots_per_tick=7, root_weight=2.0, rigid=rigid,
    )  # fmt: skip


@pytest.mark.parametrize(
    "nodes",
    [
        canonical_nodes(rigid=True),
        canonical_nodes(rigid=False),
        RootRelativeNodes(BODY21, num_observed=15, horizon=60, box_m=1.5),
    ],
    ids=["limbs", "positions", "root-relative"],
)
def test_motion_comes_back_into_the_world(nodes):
    poses = body(75)
    observation, future = poses[:, :15], poses[:, 15:]
    back = nodes.leave(observation, nodes.target(observation, future))
    if isinstance(nodes, RootRelativeNodes):  # which leaves the root where it was
        future = future - future[:, :, :1] + observation[:, -1:, :1]
    torch.testing.assert_close(back, future, atol=1e-5, rtol=0)


def test_limbs_keep_their_length_whatever_the_decoder_says():
    nodes = canonical_nodes(rigid=True)
    observation = body(15)
    outputs = torch.randn(21, 1, 3, 21, generator=generator())
    start = nodes.start(observation)
    future = nodes.leave(observation, nodes.motion(outputs, start))[0].numpy()
    seen = bone_lengths(observation[0].numpy(), BODY21.parents).mean(axis=0)
    lengths = bone_lengths(future, BODY21.parents)
    np.testing.assert_allclose(lengths, np.broadcast_to(seen, lengths.shape), atol=2e-5)


def test_positions_follow_a_body_that_grows():
    nodes = canonical_nodes(rigid=False)
    observation = body(1).repeat(1, 15, 1, 1)  # at rest, as the growth begins
    growth = 1 + 0.2 * (torch.arange(1, 61) / 60)[:, None, None].square()
    hips = observation[:, -1:, :1]
    future = hips + (observation[:, -1:] - hips) * growth
    frames = nodes.future(observation, future).flatten(2).unflatten(2, (60, 3))
    points = torch.matmul(torch.linalg.pinv(nodes.spline), frames)  # a parabola is such a spline
    missing = nodes.decoder_ticks * nodes.outputs_per_tick - points.flatten(2).shape[2]
    outputs = torch.nn.functional.pad(points.flatten(2), (0, missing))
    motion = nodes.motion(outputs.unflatten(2, (nodes.decoder_ticks, -1)), nodes.start(observation))
    torch.testing.assert_close(motion, nodes.target(observation, future), atol=1e-5, rtol=0)


def test_spline_starts_with_the_observed_value_and_velocity():
    spline, glide = continuing_spline(60, 3)
    points = torch.randn(spline.shape[1], 1, dtype=torch.float64, generator=generator())
    velocity = 0.7
    frames = spline.double() @ points + velocity * glide.double()
    # The first three frames lie on one cubic, which is 0 at frame 0.
    powers = torch.arange(1.0, 4.0, dtype=torch.float64)[:, None] ** torch.arange(1.0, 4.0)
    cubic = torch.linalg.solve(powers, frames[:3])
    assert float(cubic[0]) == pytest.approx(velocity, abs=1e-5)


def test_spline_holds_a_constant_step():
    spline, glide = continuing_spline(60, 3)
    frame = torch.arange(1, 61).float()[:, None]
    points = torch.linalg.lstsq(spline, 0.3 * frame - 0.3 * glide).solution
    torch.testing.assert_close(spline @ points + 0.3 * glide, 0.3 * frame, atol=1e-3, rtol=0)


@pytest.mark.parametrize("rigid", [True, False])
@pytest.mark.parametrize("every", [2, 3, 5])
def test_frames_that_are_judged_are_frames_of_the_motion(every: int, rigid: bool):
    nodes = canonical_nodes(rigid=rigid)
    start = nodes.start(body(15))
    outputs = torch.randn(21, 1, 3, 21, generator=generator())
    whole = nodes.motion(outputs, start)
    torch.testing.assert_close(
        nodes.motion(outputs, start, every=every), whole[:, every - 1 :: every]
    )


# Training


def test_curriculum_grows_to_the_horizon():
    lengths = [objective._length(p, 60, longest_at=0.1, full_at=0.5) for p in (0.0, 0.05, 0.1, 0.5)]
    assert lengths == [(1, 1), (6, 30), (12, 60), (60, 60)]


def test_linear_parts_reconstruct_motions_that_principal_components_span():
    recipe = recipes.tiny()
    network = recipe.build()
    poses = torch.cat([body(75, speed=speed) for speed in np.linspace(0.4, 1.6, 16)])
    batch = {"observation": poses[:, :15], "seen": poses[:, :15], "future": poses[:, 15:]}
    observation, future = batch["observation"], batch["future"]
    objective.fit_linear_parts(network, lambda: batch, num_batches=1, deviation=0.05, whitening=0.5)
    start = network.nodes.start(observation)
    motion = network.motion(network.latent(batch), start)
    error = (network.nodes.leave(observation, motion) - future).norm(dim=-1)
    still = (observation[:, -1:] - future).norm(dim=-1)
    assert error.mean().item() < 0.2 * still.mean().item()


def test_latents_start_as_alike_along_limbs_as_turning_can_make_them():
    graph = with_root(BODY21)
    found = torch.randn(21, 500, 4, generator=generator())
    for parent, child in graph.edges:  # a child's latents are its parent's, turned by its type
        hidden = torch.linalg.qr(torch.full((4, 4), float(graph.types[child])) + torch.eye(4))[0]
        found[child] = found[parent] @ hidden
    turns = objective._turns(found, graph)
    turned = torch.bmm(found, turns[torch.tensor(graph.types)])
    for parent, child in graph.edges:
        torch.testing.assert_close(turned[child], turned[parent], atol=1e-3, rtol=0)
    for turn in turns:
        torch.testing.assert_close(turn @ turn.T, torch.eye(4), atol=1e-5, rtol=0)


def test_candidate_nearest_to_the_real_motion_learns():
    network = random_like(recipes.tiny().build())
    poses = torch.cat([body(75), body(75, speed=0.5)])
    observation = poses[:, :15]
    start, condition = network.nodes.start(observation), network.condition(observation)
    x_t = torch.randn(21, 2, 6, 4, generator=generator())
    timestep = torch.tensor([9, 4])
    right = torch.tensor([4, 1])
    chosen = network.from_eigenbasis(x_t[:, torch.arange(2), right])
    target = network.motion(network.denoiser(chosen, timestep, condition), start)
    found = objective._nearest(
        network, x_t, timestep, condition, start, target, torch.ones_like(target[0, 0])
    )
    torch.testing.assert_close(found, right)


def loss_of_constant_latents(eigenvalues, **how) -> float:
    """The latent term where the denoiser says the same whatever the noise."""
    network = random_like(recipes.tiny().build())
    with torch.no_grad():
        for parameter in network.denoiser.leave.features.parameters():
            parameter.zero_()
    poses = body(75).repeat(4, 1, 1, 1)
    batch = {"observation": poses[:, :15], "seen": poses[:, :15], "future": poses[:, 15:]}
    losses = objective.denoiser_loss(
        network, batch, generator(),
        schedule=nonisotropic(ALPHA_BAR, eigenvalues, gamma=constant),
        num_candidates=2, reconstruction_weight=0.0, **how,
    )  # fmt: skip
    return losses["latent"].item()


def test_latents_are_whitened_in_the_loss_by_the_noise_of_their_direction():
    eigenvalues = with_root(BODY21).eigen()[0]
    wide, narrow = (
        loss_of_constant_latents(scale * eigenvalues, weighted_by_signal=True) for scale in (4, 1)
    )
    assert narrow == pytest.approx(2 * wide, rel=1e-4)


def test_whitening_of_directions_alone_is_blind_to_how_much_noise_there_is():
    eigenvalues = with_root(BODY21).eigen()[0]
    how = {"weighted_by_signal": False, "whitens_directions_alone": True}
    wide, narrow = (loss_of_constant_latents(scale * eigenvalues, **how) for scale in (4, 1))
    assert narrow == pytest.approx(wide, rel=1e-4)
    assert loss_of_constant_latents(np.ones(21), **how) != pytest.approx(wide, rel=1e-2)
