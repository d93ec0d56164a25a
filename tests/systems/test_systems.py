"""What every system must pass; finds every system by itself, by its recipes."""

import functools
import importlib
import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_bundles import walking

from models.bundle import read_manifest
from models.motion.kinematics import rotate_yaw
from models.motion.skeleton import BODY21, joint_map
from models.system import Recipe, describe
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from training.export import Label, export, reference_futures, trial_request, unstopped

ROOT = Path(__file__).parents[2]


def all_recipes() -> dict[str, Recipe]:
    found = {}
    for path in sorted((ROOT / "models/systems").glob("*/recipes.py")):
        module = importlib.import_module(f"models.systems.{path.parent.name}.recipes")
        for name, function in inspect.getmembers(module, inspect.isfunction):
            public = not name.startswith("_") and function.__module__ == module.__name__
            if public and inspect.signature(function).return_annotation is Recipe:
                found[f"{path.parent.name}.{name}"] = function()
    return found


RECIPES = all_recipes()
SMALL = {name: recipe for name, recipe in RECIPES.items() if not recipe.stages or ".tiny" in name}


def people(recipe: Recipe, *, count: int, num_frames: int) -> np.ndarray:
    """Walkers of different speeds in the recipe's skeleton, (count, num_frames, J, 3)."""
    weights, _ = joint_map(BODY21, recipe.data.skeleton)
    speeds = np.linspace(0.3, 1.8, count)
    walkers = [walking(num_frames, fps=recipe.data.fps, speed=speed) for speed in speeds]
    return np.einsum("ij,ntjx->ntix", weights, np.stack(walkers)).astype(np.float32)


def observations(recipe: Recipe, count: int) -> np.ndarray:
    return people(recipe, count=count, num_frames=recipe.data.num_observed)


@pytest.fixture(scope="module", params=SMALL.values(), ids=SMALL)
def bundle(request, tmp_path_factory):
    """A recipe, its network with made-up weights, and the engine on its bundle."""
    recipe = request.param
    torch.manual_seed(3)  # noqa: TID251 - a test may fix the weights it makes
    network = recipe.build()
    with torch.no_grad():
        for parameter in network.parameters():  # zero-initialised layers would hide errors
            parameter.add_(0.02 * torch.randn(parameter.shape))
    folder = tmp_path_factory.mktemp("bundles") / recipe.name.replace("_", "-")
    export(
        recipe,
        network,
        folder,
        label=Label(name=folder.name, version="1", licence="none", attribution=("us",)),
        card="# A card",
        observations=observations(recipe, 5),
    )
    manifest = unstopped(read_manifest(folder))
    return recipe, network, lambda rows=64: Engine(Runner(manifest, folder), rows_per_step=rows)


def futures(recipe, engine, observation, *, num_samples=2, seed=5):
    request = trial_request(recipe, observation, num_samples=num_samples, seed=seed)
    return predict(engine, request).futures


def test_prediction_turns_and_moves_with_the_person(bundle):
    recipe, _, engine = bundle
    seen = observations(recipe, 1)[0]
    plain = futures(recipe, engine(), seen)
    moved = futures(recipe, engine(), (seen + np.array([3.0, -2.0, 0.0], np.float32)))
    # A second action starts from frames that the first has rounded.
    exact = functools.partial(pytest.approx, abs=1e-4 if recipe.data.actions else 1e-5)
    if "translation" in recipe.symmetries:
        assert moved == exact(plain + np.array([3.0, -2.0, 0.0]))
    if "yaw" in recipe.symmetries:
        turned = futures(recipe, engine(), rotate_yaw(seen, 1.1).astype(np.float32))
        assert turned == exact(rotate_yaw(plain, 1.1))


def test_row_does_not_depend_on_its_batch(bundle):
    recipe, _, engine = bundle
    seen = observations(recipe, 4)
    # Odd numbers of rows too: what is left over by vectors of eight must be no different.
    requests = [
        trial_request(recipe, one, num_samples=count, seed=5)
        for one, count in zip(seen, (3, 1, 4, 5), strict=True)
    ]
    alone = [predict(engine(1), request).futures for request in requests]
    for expected, result in zip(alone, engine().run(requests), strict=True):
        assert np.array_equal(expected, result.futures)


def test_onnxruntime_agrees_with_torch(bundle):
    recipe, network, engine = bundle
    graphs = {graph.role: graph for graph in recipe.graphs(network)}
    seen = observations(recipe, 5)
    expected = reference_futures(recipe, graphs, seen, seed=11)
    for one, future in zip(seen, expected, strict=True):
        (served,) = futures(recipe, engine(), one, num_samples=1, seed=11)
        assert served == pytest.approx(future, abs=1e-4)


def test_seed_decides(bundle):
    recipe, _, engine = bundle
    seen = observations(recipe, 1)[0]
    first, again = (futures(recipe, engine(), seen) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    assert futures(recipe, engine(), seen, num_samples=1).tobytes() == first[:1].tobytes()
    if recipe.x_t_shape:
        assert not np.allclose(futures(recipe, engine(), seen, seed=6), first)


def test_future_has_the_shape_of_the_recipe(bundle):
    recipe, _, engine = bundle
    data = recipe.data
    request = trial_request(recipe, observations(recipe, 1)[0], num_samples=2, seed=5)
    result = predict(engine(), request)
    num_frames = data.horizon
    if data.actions:
        num_frames = request.max_frames * len(request.actions)
        assert [[part.action for part in parts] for parts in result.segments] == [
            [*request.actions]
        ] * 2
    assert result.futures.shape == (2, num_frames, data.skeleton.num_joints, 3)


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_recipe_is_a_record_that_json_holds(recipe):
    written = json.loads(json.dumps(describe(recipe)))
    assert written["name"] == recipe.name
    assert [stage["name"] for stage in written["stages"]] == [s.name for s in recipe.stages]


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_system_of_a_recipe_is_its_folder(recipe):
    graphs = recipe.graphs
    function = graphs.func if isinstance(graphs, functools.partial) else graphs
    assert function.__module__.split(".")[-2] == recipe.system


def batch_of(recipe: Recipe, count: int) -> dict[str, torch.Tensor]:
    """Walkers; those who perform actions do so for different times, after gaps of 0 to 3 frames."""
    data = recipe.data
    windows = torch.from_numpy(
        people(recipe, count=count, num_frames=data.num_observed + data.horizon)
    )
    observation, future = windows[:, : data.num_observed], windows[:, data.num_observed :]
    batch = {"observation": observation, "seen": observation, "future": future}
    if data.actions is None:
        return batch
    rows = torch.arange(count)
    first = rows % 4
    longest = data.horizon - data.actions.padding
    length = torch.linspace(longest / 2, longest, count).round().long()
    known = torch.arange(data.horizon).clamp(first[:, None], length[:, None] - 1)  # (B, H)
    return batch | {
        "future": future[rows[:, None], known],
        "action": rows % len(data.actions.labels),
        "first": first,
        "length": length,
    }


LEARNERS = {name: recipe for name, recipe in SMALL.items() if recipe.stages}


@pytest.mark.parametrize("recipe", LEARNERS.values(), ids=LEARNERS)
def test_a_few_updates_on_one_batch_lower_every_stage_s_loss(recipe):
    torch.manual_seed(0)  # noqa: TID251 - a test may fix the weights it makes
    network, batch = recipe.build(), batch_of(recipe, 8)
    for stage in recipe.stages:
        if stage.prepare:
            stage.prepare(network, lambda: batch)
        network.requires_grad_(False)
        learning = []
        for name in stage.trains:
            part = network.get_submodule(name).requires_grad_(True)
            learning += list(part.parameters())
        optimiser = torch.optim.Adam(learning, lr=1e-3)
        totals = []
        for _ in range(25):
            losses = stage.loss(network, batch, torch.Generator().manual_seed(1))
            optimiser.zero_grad()
            losses["total"].backward()
            optimiser.step()
            totals.append(float(losses["total"].detach()))
        assert totals[-1] < totals[0], stage.name
