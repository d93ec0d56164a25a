"""The scores of predicted actions by hand, and a whole evaluation through the engine."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from people import small_store, walker
from tiny_bundles import LABELS

from models.bundle import Manifest, read_manifest
from models.motion.kinematics import rotate_yaw
from models.motion.skeleton import BODY21
from models.system import Data
from training.action_classifier import ActionClassifier, Judge
from training.action_scores import (
    ActionScorer,
    Performance,
    RealActions,
    Recognised,
    inner_changes,
    junction_change,
)
from training.contact_sheet import action_sheet
from training.data.store import Store, StoreError
from training.evaluate import EvaluateError
from training.evaluate_actions import evaluate_actions
from training.fid import fid


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("small") / "store", num_clips=9)


@pytest.fixture(scope="module")
def judge() -> Judge:
    """An untrained classifier of the tiny bundle's labels, which holds two clips of each out."""
    torch.manual_seed(0)  # noqa: TID251 - a test may fix the weights it makes
    network = ActionClassifier(skeleton=BODY21, fps=30.0, num_labels=len(LABELS))
    data = Data(
        skeleton=BODY21,
        fps=30.0,
        num_observed=15,
        horizon=60,
        hold_out=tuple(f"subject={i}" for i in range(3, 9)),
    )
    labels = {label: (f"action=action{i}",) for i, label in enumerate(LABELS)}
    return Judge(network=network.eval(), labels=labels, data=data)


@pytest.fixture(scope="module")
def bundle(actions_bundle: Path) -> tuple[Path, Manifest]:
    return actions_bundle, read_manifest(actions_bundle)


def length_judge(sequences):
    """Takes what is longer than 40 frames for the label 1; its features are length and height."""
    features = np.array([[len(one), one[..., 2].mean()] for one in sequences])
    return features, np.array([int(len(one) > 40) for one in sequences])


def scorer() -> ActionScorer:
    return ActionScorer(length_judge, skeleton=BODY21, longest=60)


def performance(label: int, *lengths: int, seed: int = 0) -> Performance:
    poses = [walker(15 + length, seed=seed + i).positions for i, length in enumerate(lengths)]
    return Performance(
        label=label,
        histories=np.stack([one[:15] for one in poses]),
        futures=tuple(one[15:] for one in poses),
        stopped=tuple(length < 60 for length in lengths),
    )


def test_scores_of_each_action_are_means_over_its_performances():
    scores = scorer()
    scores.add(performance(0, 20, 60))
    scores.add(performance(0, 10, 10, seed=5))
    scores.add(performance(1, 30, 30, seed=9))
    found = scores.by_label()
    assert found[0]["accuracy"] == 75.0  # all but the one of 75 frames
    assert found[1]["accuracy"] == 100.0
    assert found[0]["frames"] == 25.0
    assert found[0]["cut_off"] == 25.0
    assert found[1]["cut_off"] == 0.0
    assert found[0]["stretch"] == pytest.approx(0.0, abs=1e-4)  # walkers are rigid
    assert found[0]["div"] > found[0]["div_w"] > 0
    assert "ade" not in found[0]


def test_error_is_of_the_real_future_that_is_given():
    scores, asked = scorer(), performance(0, 20, 30)
    scores.add(asked, real=asked.futures[0])
    found = scores.by_label()[0]
    assert found["ade"] == found["ade_w"] == 0.0


def test_futures_are_judged_with_what_was_before_them():
    scores = scorer()
    scores.add(performance(0, 20, 60))
    recognised = scores.recognised()
    np.testing.assert_array_equal(recognised.features[:, 0], [35, 75])
    np.testing.assert_array_equal(recognised.labels, [0, 0])


def test_a_stretched_future_is_told_from_a_rigid_one():
    asked = performance(0, 20)
    longer = asked.futures[0] * 1.1
    scores = scorer()
    scores.add(dataclasses.replace(asked, futures=(longer,)))
    assert scores.by_label()[0]["stretch"] == pytest.approx(10.0, abs=1e-3)


def test_velocity_change_is_the_second_difference_at_the_first_frame():
    motion = np.zeros((6, 4, 3))
    motion[:, :, 0] = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 7.0])[:, None]
    assert junction_change(motion[:3], motion[3:]) == 2.0
    np.testing.assert_array_equal(inner_changes(motion), [0.0, 2.0, 2.0, 0.0])


def test_real_actions_are_as_good_as_themselves():
    scores = scorer()
    for real in (performance(0, 20, 30), performance(1, 40, 50, 60, seed=4)):
        scores.add(real, real=real.futures[0])
    features = {"train": scores.recognised(), "held_out": scores.recognised()}
    real = RealActions(by_label=scores.by_label(), features=features, velocity_change=1.0)
    means, labels = real.compare(scores)
    assert means["accuracy_ratio"] == means["div_w_ratio"] == 1.0
    assert means["length_off"] == means["length_off_worst"] == 0.0
    assert means["fid_held_out"] == pytest.approx(0.0, abs=1e-6)
    assert labels[1]["real_frames"] == labels[1]["frames"] == 50.0


def test_predicted_actions_are_compared_label_by_label():
    scores, reality = scorer(), scorer()
    for begun in (performance(0, 20, 20), performance(1, 20, 40)):
        scores.add(begun, real=begun.futures[0])
    reality.add(performance(0, 10, 10, seed=7))
    reality.add(performance(1, 60, 60, seed=7))
    features = {"held_out": reality.recognised()}
    real = RealActions(by_label=reality.by_label(), features=features, velocity_change=0.5)
    means, labels = real.compare(scores)
    assert labels[0]["length_off"] == 100.0
    assert labels[1]["length_off"] == 50.0
    assert means["length_off"] == 75.0
    assert means["length_off_worst"] == 100.0
    assert means["accuracy"] == means["accuracy_ratio"] * 100.0 == 75.0
    assert means["velocity_change_ratio"] == pytest.approx(2 * means["velocity_change"])
    wanted = fid(scores.recognised().features, reality.recognised().features)
    assert means["fid_held_out"] == pytest.approx(wanted)


def test_length_is_that_of_actions_that_the_history_has_begun():
    scores, reality = scorer(), scorer()
    scores.add(performance(0, 90, 90))  # from another action
    begun = performance(0, 30, 40, seed=2)
    scores.add(begun, real=begun.futures[0])
    reality.add(performance(0, 50, 50))
    features = {"held_out": reality.recognised()}
    real = RealActions(by_label=reality.by_label(), features=features, velocity_change=0.5)
    _, labels = real.compare(scores)
    assert labels[0]["length_off"] == pytest.approx(30.0)
    assert labels[0]["frames"] == pytest.approx(62.5)


def test_action_without_a_real_clip_counts_in_no_comparison():
    scores, reality = scorer(), scorer()
    scores.add(performance(0, 20, 20))
    scores.add(performance(2, 20, 20))
    reality.add(performance(0, 20, 20))
    features = {"held_out": reality.recognised()}
    real = RealActions(by_label=reality.by_label(), features=features, velocity_change=0.5)
    means, labels = real.compare(scores)
    assert "real_frames" not in labels[2]
    assert means["accuracy"] == 50.0
    assert means["accuracy_ratio"] == 1.0
    assert means["fid_held_out"] == pytest.approx(0.0, abs=1e-6)


def test_balanced_features_have_every_label_alike():
    features = np.arange(5.0)[:, None]
    few = Recognised(features=features, labels=np.array([2, 0, 0, 0, 2]))
    balanced = few.balanced()
    assert np.bincount(balanced.labels).tolist() == [3, 0, 3]
    assert balanced.features[:, 0].tolist() == [1, 2, 3, 0, 4, 0]
    assert few.of_labels(np.array([2])).features[:, 0].tolist() == [0, 4]


def test_evaluation_of_actions_stands_beside_the_real_clips(
    store: Store, judge: Judge, bundle: tuple[Path, Manifest], tmp_path: Path
):
    evaluation = evaluate_actions(
        [bundle],
        store,
        judge,
        out=tmp_path,
        command="the command",
        num_samples=3,
        num_histories=4,
        actions_in_sequence=2,
    )
    real, mine = evaluation.rows
    assert (real.name, mine.name) == ("real", "actions")
    assert set(mine.by_label) == set(real.by_label) == set(LABELS)
    assert real.scores["accuracy_ratio"] == real.scores["div_w_ratio"] == 1.0
    assert real.scores["fid_held_out"] == pytest.approx(0.0, abs=1e-6)
    assert real.by_label["wave"]["frames"] == 60.0
    assert 0 <= mine.scores["cut_off"] <= 100
    assert mine.scores["ade_w"] <= mine.scores["ade"]
    assert mine.scores["div"] > 0
    assert mine.scores["fid_train"] > real.scores["fid_train"] > 0
    assert mine.scores["length_off_worst"] >= mine.scores["length_off"] > 0
    assert len(mine.steps) == 2
    written = json.loads((tmp_path / "evaluation_actions.json").read_text())
    assert written["protocol"]["num_histories"] == 4
    assert written["rows"][1]["steps"][1]["accuracy"] == mine.steps[1]["accuracy"]
    table = (tmp_path / "evaluation_actions.md").read_text()
    assert table == str(evaluation)
    assert table.startswith("`the command`\n")
    assert "### actions, one random action after another" in table


def test_evaluation_of_actions_is_the_same_every_time(
    store: Store, judge: Judge, bundle: tuple[Path, Manifest], tmp_path: Path
):
    def run(seed: int) -> dict[str, float]:
        evaluation = evaluate_actions(
            [bundle], store, judge, out=tmp_path, num_samples=2, num_histories=2, seed=seed
        )
        return dict(evaluation.rows[1].scores)

    assert run(0) == run(0)
    assert run(0) != run(1)


def test_real_clips_are_told_apart_within_their_style_alone(
    store: Store, judge: Judge, bundle: tuple[Path, Manifest], tmp_path: Path
):
    def differing(styles: list[str]) -> set[str]:
        clips = [
            dataclasses.replace(clip, style=style)
            for clip, style in zip(store.clips, styles, strict=True)
        ]
        styled = dataclasses.replace(store, clips=tuple(clips))
        evaluation = evaluate_actions(
            [bundle], styled, judge, out=tmp_path, num_samples=2, num_histories=2
        )
        return {label for label, scores in evaluation.rows[0].by_label.items() if "div_w" in scores}

    assert differing(["calm"] * 9) == set(LABELS)
    one_of_each = [clip.subject for clip in store.clips]
    assert differing(one_of_each) == set()


def test_what_does_not_fit_is_refused(
    store: Store, judge: Judge, bundle: tuple[Path, Manifest], bundles: Path, tmp_path: Path
):
    still = (bundles / "still", read_manifest(bundles / "still"))
    with pytest.raises(EvaluateError, match="still: it performs no actions"):
        evaluate_actions([still], store, judge, out=tmp_path)
    fewer = dataclasses.replace(judge, labels=dict(list(judge.labels.items())[:2]))
    with pytest.raises(EvaluateError, match="the classifier knows reach, crouch"):
        evaluate_actions([bundle], store, fewer, out=tmp_path)
    with pytest.raises(EvaluateError, match="found no labelled clip"):
        evaluate_actions([bundle], store, judge, out=tmp_path, hold=("style=elder",))
    with pytest.raises(StoreError, match="must be field=value"):
        evaluate_actions([bundle], store, judge, out=tmp_path, hold=("elder",))


def test_the_world_of_a_performance_does_not_count():
    far = performance(0, 20, 30)
    moved = dataclasses.replace(
        far,
        histories=rotate_yaw(far.histories, 1.0) + np.array([4.0, 2.0, 0.0]),
        futures=tuple(rotate_yaw(one, 1.0) + np.array([4.0, 2.0, 0.0]) for one in far.futures),
    )
    here, there = scorer(), scorer()
    here.add(far, real=far.futures[1])
    there.add(moved, real=moved.futures[1])
    assert there.by_label()[0] == pytest.approx(here.by_label()[0], abs=1e-9)


def test_sheet_of_actions_is_a_small_picture(store: Store, actions_bundle: Path, tmp_path: Path):
    path = tmp_path / "docs" / "actions.png"
    action_sheet(actions_bundle, store, store.clips, path)
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) < 200_000
