"""The classifier of actions: what it may not see, what it learns, and its run on disk."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from people import small_store, walker
from tiny_bundles import standing_pose

from models.motion.kinematics import rotate_yaw
from models.motion.skeleton import BODY21
from models.system import Actions, Data, Recipe
from training import action_classifier
from training.action_classifier import (
    ActionClassifier,
    Judge,
    classifier_recipe,
    read_judge,
    recognition_loss,
)
from training.cli import load_recipe
from training.data.store import Store
from training.loop import RECIPE_FILE, RunError, train

CPU = torch.device("cpu")
LABELS = {"reach": ("action=action0",), "crouch": ("action=action1",), "wave": ("action=action2",)}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("small") / "store")


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    tiny = load_recipe("models.systems.belfusion.recipes:tiny")
    data = dataclasses.replace(
        tiny.data, hold_out=("style=old",), actions=Actions(labels=LABELS, other_share=0.7)
    )
    return dataclasses.replace(tiny, data=data)


def made_up() -> dict[str, torch.Tensor]:
    """People who walk, stand and raise a hand: action, length and world of each its own."""
    rows, lengths = [], []
    for i in range(12):
        length = 25 + 2 * i
        poses = walker(75, seed=i).positions.copy()
        if i % 3:
            poses[:] = standing_pose()
        if i % 3 == 2:
            poses[:, BODY21.index("left_hand"), 2] += 0.02 * np.arange(75)
        poses[15 + length :] = poses[15 + length - 1]
        rows.append(rotate_yaw(poses, float(i)) + np.array([float(i), -5.0, 0.0]))
        lengths.append(length)
    poses = torch.from_numpy(np.stack(rows).astype(np.float32))
    return {
        "observation": poses[:, :15],
        "future": poses[:, 15:],
        "action": torch.arange(12) % 3,
        "first": torch.zeros(12, dtype=torch.int64),
        "length": torch.tensor(lengths),
    }


def network(seed: int = 0) -> ActionClassifier:
    torch.manual_seed(seed)  # noqa: TID251 - a test may fix the weights it makes
    return ActionClassifier(skeleton=BODY21, fps=30.0, num_labels=3)


def judge(network: ActionClassifier) -> Judge:
    data = Data(skeleton=BODY21, fps=30.0, num_observed=15, horizon=60)
    return Judge(network=network.eval(), labels=LABELS, data=data)


def sequences() -> list[np.ndarray]:
    return [walker(20 + 7 * i, seed=i).positions for i in range(5)]


def test_features_do_not_depend_on_place_or_heading():
    ask = judge(network())
    features, _ = ask(sequences())
    moved, _ = ask([rotate_yaw(poses, 2.0) + np.array([3.0, -4.0, 0.5]) for poses in sequences()])
    np.testing.assert_allclose(moved, features, atol=1e-4)
    assert features.shape == (5, 200)
    assert features.min() == 0.0  # those after the last ReLU


def test_motion_is_judged_alone_as_among_others(monkeypatch):
    ask = judge(network())
    together = ask(sequences())[0]
    monkeypatch.setattr("training.action_classifier.SEQUENCES_AT_ONCE", 1)
    np.testing.assert_allclose(ask(sequences())[0], together, atol=1e-5)


def test_frames_after_the_end_are_not_seen():
    ask, length = network().eval(), torch.tensor([21, 30])
    poses = torch.from_numpy(np.stack([walker(60, seed=i).positions for i in range(2)])).float()
    changed = poses.clone()
    changed[0, 21:], changed[1, 30:] = 7.0, float("nan")
    torch.testing.assert_close(ask.features(poses, length), ask.features(changed, length))
    changed[0, 18, 8] += 0.3
    assert not torch.allclose(ask.features(poses, length)[0], ask.features(changed, length)[0])


def test_transition_leads_straight_to_the_first_pose_that_is_known():
    batch = made_up()
    batch["first"][0] = 4
    batch["future"][0, :4] = batch["future"][0, 4]  # as batches of actions repeat it
    joined = action_classifier._with_transition(batch)
    steps = torch.cat([batch["observation"][0, -1:], joined[0, :5]]).diff(dim=0)
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), atol=1e-5, rtol=0)
    assert torch.equal(joined[0, 4:], batch["future"][0, 4:])
    assert torch.equal(joined[1:], batch["future"][1:])


def test_some_updates_tell_actions_apart():
    chosen, batch = network(), made_up()
    optimiser = torch.optim.Adam(chosen.parameters(), lr=2e-3)
    generator = torch.Generator().manual_seed(0)
    first = recognition_loss(chosen, batch, generator)["total"].item()
    for _ in range(100):
        optimiser.zero_grad()
        losses = recognition_loss(chosen, batch, generator)
        losses["total"].backward()
        optimiser.step()
    assert losses["total"].item() < 0.3 * first
    ends = 15 + batch["length"]
    whole = torch.cat([batch["observation"], batch["future"]], dim=1).numpy()
    _, found = judge(chosen)([one[:end] for one, end in zip(whole, ends, strict=True)])
    np.testing.assert_array_equal(found, batch["action"])
    _, early = judge(chosen)([one[: int(0.6 * end)] for one, end in zip(whole, ends, strict=True)])
    np.testing.assert_array_equal(early, batch["action"])


def test_classifier_learns_from_the_clips_of_its_recipe_and_is_read_again(
    store: Store, recipe: Recipe, tmp_path: Path
):
    chosen = classifier_recipe(recipe, num_updates=3)
    assert chosen.data.hold_out == recipe.data.hold_out
    assert chosen.data.actions == recipe.data.actions
    assert chosen.graphs(chosen.build()) == ()
    trained = train(chosen, store, tmp_path, device=CPU)
    ask = read_judge(tmp_path, store)
    assert list(ask.labels.items()) == list(LABELS.items())
    assert (ask.data.num_observed, ask.data.horizon) == (15, 60)
    assert ask.data.hold_out == ("style=old",)
    features, found = ask(sequences())
    wanted, _ = judge(trained)(sequences())
    np.testing.assert_array_equal(features, wanted)
    assert set(found) <= {0, 1, 2}


def test_runs_of_another_kind_and_recipes_without_actions_are_refused(
    store: Store, recipe: Recipe, tmp_path: Path
):
    plain = load_recipe("models.systems.belfusion.recipes:tiny")
    with pytest.raises(RunError, match="learns no actions"):
        classifier_recipe(plain)
    train(
        dataclasses.replace(plain, stages=plain.stages[:1]), store, tmp_path / "plain", device=CPU
    )
    with pytest.raises(RunError, match="another kind"):
        read_judge(tmp_path / "plain", store)
    folder = tmp_path / "judge"
    train(classifier_recipe(recipe, num_updates=1), store, folder, device=CPU)
    said = json.loads((folder / RECIPE_FILE).read_text())
    said["data"]["fps"] = 25.0
    (folder / RECIPE_FILE).write_text(json.dumps(said))
    with pytest.raises(RunError, match="found body21 at 25 fps; the store holds"):
        read_judge(folder, store)
