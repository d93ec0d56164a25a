"""The loop: stages, resuming after a kill, and what it refuses."""

import dataclasses

import numpy as np
import pytest
import torch
from people import small_store

from models.system import Recipe
from training.checkpoint import CHECKPOINT_FILE, CheckpointError, load_checkpoint
from training.cli import load_recipe
from training.data.store import Store
from training.loop import RunError, train, trained_network

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("stores") / "walkers")


@pytest.fixture
def recipe() -> Recipe:
    return load_recipe("models.systems.belfusion.recipes:tiny")


def weights(network: torch.nn.Module) -> np.ndarray:
    return torch.cat([p.detach().flatten() for p in network.parameters()]).numpy()


class Killed(BaseException):
    """Stands for the signal that ends a process in the middle of a stage."""


def killed_at(recipe: Recipe, update: int) -> Recipe:
    """The recipe, whose last stage dies at an update; checkpoints are written at every update."""
    stage, calls = recipe.stages[-1], iter(range(10**6))

    def loss(network, batch, generator):
        if next(calls) == update:
            raise Killed
        return stage.loss(network, batch, generator)

    # `describe` names a function by where it stands: a resumed run must find the same recipe.
    loss.__module__, loss.__qualname__ = "tests", "loss"
    return dataclasses.replace(
        recipe, stages=(*recipe.stages[:-1], dataclasses.replace(stage, loss=loss))
    )


def test_killed_run_ends_where_an_uninterrupted_one_does(store, recipe, tmp_path, monkeypatch):
    monkeypatch.setattr("training.loop.SECONDS_BETWEEN_CHECKPOINTS", -1.0)
    whole = train(killed_at(recipe, 10**6), store, tmp_path / "whole", device=CPU)
    with pytest.raises(Killed):
        train(killed_at(recipe, 5), store, tmp_path / "killed", device=CPU)
    left = load_checkpoint(tmp_path / "killed", CPU)["progress"]
    assert (left["stage"], left["update"]) == (len(recipe.stages) - 1, 5)
    resumed = train(killed_at(recipe, 10**6), store, tmp_path / "killed", device=CPU)
    assert weights(resumed) == pytest.approx(weights(whole), abs=1e-6)


def test_finished_run_gives_its_network_and_its_count(store, recipe, tmp_path):
    trained = train(recipe, store, tmp_path, device=CPU)
    network, progress = trained_network(recipe, tmp_path)
    assert np.array_equal(weights(network), weights(trained))
    assert progress.total_updates == sum(stage.num_updates for stage in recipe.stages)
    assert progress.seconds > 0
    assert list((tmp_path / "tensorboard").iterdir())


def test_folder_of_another_recipe_is_refused(store, recipe, tmp_path):
    train(recipe, store, tmp_path, device=CPU)
    other = dataclasses.replace(recipe, description="another")
    with pytest.raises(RunError, match="another recipe"):
        train(other, store, tmp_path, device=CPU)


def test_damaged_checkpoint_is_one_clear_error(store, recipe, tmp_path):
    train(recipe, store, tmp_path, device=CPU)
    path = tmp_path / CHECKPOINT_FILE
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="damaged"):
        trained_network(recipe, tmp_path)


def test_run_without_a_checkpoint_cannot_be_exported(recipe, tmp_path):
    with pytest.raises(CheckpointError, match="train the recipe first"):
        trained_network(recipe, tmp_path)


def test_unfinished_run_cannot_be_exported_or_started_from(store, recipe, tmp_path, monkeypatch):
    monkeypatch.setattr("training.loop.SECONDS_BETWEEN_CHECKPOINTS", -1.0)
    with pytest.raises(Killed):
        train(killed_at(recipe, 3), store, tmp_path, device=CPU)
    with pytest.raises(RunError, match="stands in stage denoiser"):
        trained_network(recipe, tmp_path)
    with pytest.raises(RunError, match="not finished"):
        train(recipe, store, tmp_path.parent / "next", device=CPU, start_from=tmp_path)


def test_new_run_starts_from_the_weights_of_a_finished_one(store, recipe, tmp_path):
    before = train(recipe, store, tmp_path / "first", device=CPU)
    no_updates = dataclasses.replace(recipe, stages=())
    after = train(no_updates, store, tmp_path / "second", device=CPU, start_from=tmp_path / "first")
    assert np.array_equal(weights(after), weights(before))


def test_seed_decides_the_noise_of_a_run_whatever_its_weights(store, recipe, tmp_path):
    stage, draws = recipe.stages[0], []

    def loss(network, batch, generator):
        draws.append(float(torch.rand((), generator=generator)))
        return stage.loss(network, batch, generator)

    noted = dataclasses.replace(recipe, stages=(dataclasses.replace(stage, loss=loss),))
    for i, seed in enumerate((1, 1, 2)):
        train(noted, store, tmp_path / str(i), device=CPU, seed=seed)
    first, again, other = np.split(np.array(draws), 3)
    assert np.array_equal(first, again)
    assert not np.isin(first, other).any()


def test_diverged_loss_stops_the_run(store, recipe, tmp_path):
    stage = recipe.stages[0]

    def loss(network, batch, generator):
        return {"total": stage.loss(network, batch, generator)["total"] * float("nan")}

    broken = dataclasses.replace(recipe, stages=(dataclasses.replace(stage, loss=loss),))
    with pytest.raises(RunError, match="diverged"):
        train(broken, store, tmp_path, device=CPU)


def test_frozen_parts_do_not_move(store, recipe, tmp_path):
    before = weights(recipe.build().denoiser.cpu())
    behaviour_only = dataclasses.replace(recipe, stages=recipe.stages[:1])
    network = train(behaviour_only, store, tmp_path, device=CPU, seed=0)
    torch.manual_seed(0)  # noqa: TID251 - the seed of the run
    assert np.array_equal(weights(network.denoiser), weights(recipe.build().denoiser))
    assert before.shape == weights(network.denoiser).shape
