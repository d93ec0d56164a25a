"""Retrieval, and the evaluation of bundles through the service's engine."""

import json
from pathlib import Path

import numpy as np
import pytest
from people import small_store
from PIL import Image

from models.bundle import read_manifest
from models.motion.kinematics import bone_lengths, rotate_yaw
from models.motion.skeleton import BODY21
from service.engine.engine import Engine
from service.engine.runner import Runner
from training.contact_sheet import contact_sheet
from training.data.store import Store, StoreError, select
from training.data.windows import Windows, cut
from training.evaluate import EvaluateError, evaluate
from training.predictors import BundlePredictor
from training.retrieval import nearest_windows, retrieved_futures
from training.scores import STRETCH_TOLERANCES, score_at

GROUPS = {"old": ("style=old",), "valid": ("split=valid",)}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("small") / "store")


def some_windows(store: Store, *, stride: int = 9) -> tuple[Windows, np.ndarray]:
    windows = Windows.of(store.clips, num_frames=75, stride=stride)
    return windows, cut(store, windows, num_frames=75)


def test_a_window_is_its_own_nearest_wherever_it_is_moved(store: Store):
    windows, poses = some_windows(store)
    moved = rotate_yaw(poses[:, :15], 2.0) + np.array([7.0, -3.0, 0.5], np.float32)
    near = nearest_windows(moved, store=store, windows=windows, count=3)
    np.testing.assert_array_equal(near[:, 0], np.arange(len(windows)))


def test_nearest_windows_are_those_of_a_search_one_by_one(store: Store, monkeypatch):
    monkeypatch.setattr("training.retrieval.WINDOWS_AT_ONCE", 7)
    windows, poses = some_windows(store)
    queries = poses[::3, :15] + 0.01 * np.random.default_rng(0).standard_normal((1, 15, 21, 3))

    def canonical(pose: np.ndarray) -> np.ndarray:
        legs = pose[-1, [13, 6]] - pose[-1, [17, 10]]
        across = legs.sum(axis=0)
        turned = rotate_yaw(pose - pose[-1, 0], -float(np.arctan2(-across[0], across[1])))
        turned[:, 1:] -= turned[:, :1]
        return turned.ravel()

    bank = np.stack([canonical(pose[:15]) for pose in poses])
    near = nearest_windows(queries, store=store, windows=windows, count=5)
    for query, found in zip(queries, near, strict=True):
        distances = np.linalg.norm(bank - canonical(query), axis=1)
        np.testing.assert_array_equal(np.sort(found), np.sort(np.argsort(distances)[:5]))
        assert np.all(np.diff(distances[found]) >= 0)


def test_retrieving_the_window_itself_gives_its_future_in_the_moved_world(store: Store):
    windows, poses = some_windows(store)
    world = rotate_yaw(poses, 1.0) + np.array([2.0, 5.0, 0.0], np.float32)
    futures = retrieved_futures(
        world[4, :15], store=store, windows=windows, indices=np.array([4, 5]), horizon=60
    )
    np.testing.assert_allclose(futures[0], world[4, 15:], atol=1e-5)


def test_retrieved_futures_start_at_the_observed_pose(store: Store):
    windows, poses = some_windows(store)
    futures = retrieved_futures(
        poses[0, :15], store=store, windows=windows, indices=np.arange(8), horizon=60
    )
    step = np.linalg.norm(futures[:, 0] - poses[0, 14], axis=-1)
    assert step.max() < 0.15  # as far as a walker's joint moves in one frame


def test_evaluation_scores_bundles_beside_the_baselines(
    store: Store, bundles: Path, tmp_path: Path
):
    chosen = [(bundles / name, read_manifest(bundles / name)) for name in ("diffusion", "still")]
    evaluation = evaluate(
        chosen, store, GROUPS, out=tmp_path, command="the command", num_samples=4, max_windows=3
    )
    rows = {(row.group, row.bone_lengths, row.name): row for row in evaluation.rows}
    assert len(rows) == len(evaluation.rows) == 2 * 2 * 5
    assert {row.windows for row in evaluation.rows} == {3}
    for group in GROUPS:
        still, zero = rows[group, "observed", "still"], rows[group, "observed", "zero velocity"]
        for key in ("ade", "fde", "world_ade", "world_fde", "cmd"):
            assert still.scores[key] == pytest.approx(zero.scores[key], abs=2e-3)
        assert zero.scores["ade_ratio"] == 1.0
        assert zero.scores["apd"] == zero.scores["jitter"] == 0.0
        assert zero.scores["jump"] == pytest.approx(0.0, abs=1e-4)
        moving = rows[group, "observed", "diffusion"].scores
        assert moving["apd"] > 0
        assert moving["stretch"] < 0.05
        assert moving["stretch"] < rows[group, "free", "diffusion"].scores["stretch"]
    written = json.loads((tmp_path / "evaluation.json").read_text())
    assert written["protocol"]["num_samples"] == 4
    table = (tmp_path / "evaluation.md").read_text()
    assert table.startswith("`the command`\n")
    assert "### old, 3 windows, bone lengths observed" in table
    assert table == str(evaluation)
    with Image.open(tmp_path / "validity.png") as plot:
        assert plot.size[0] > 500


def test_evaluation_shows_how_many_futures_are_valid(store: Store, bundles: Path, tmp_path: Path):
    chosen = [(bundles / "diffusion", read_manifest(bundles / "diffusion"))]
    evaluation = evaluate(
        chosen, store, GROUPS, out=tmp_path, num_samples=4, max_windows=3, bone_lengths=("free",)
    )
    (row,) = (row for row in evaluation.rows if (row.name, row.group) == ("diffusion", "old"))
    shares = [row.scores[score_at("valid", tolerance)] for tolerance in STRETCH_TOLERANCES]
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] <= 1
    assert shares[0] < 1  # the tiny network stretches limbs
    assert "valid at 2.5 %" in str(evaluation)


def test_evaluation_is_the_same_every_time(store: Store, bundles: Path, tmp_path: Path):
    chosen = [(bundles / "diffusion", read_manifest(bundles / "diffusion"))]

    def run(seed: int) -> dict[str, float]:
        rows = evaluate(
            chosen, store, {"old": ("style=old",)}, out=tmp_path, num_samples=2, seed=seed
        ).rows
        return dict(next(row for row in rows if row.name == "diffusion").scores)

    assert run(0) == run(0)
    assert run(0) != run(1)


def test_bundle_is_asked_as_the_server_asks_it(store: Store, bundles: Path):
    manifest = read_manifest(bundles / "diffusion")
    _, poses = some_windows(store, stride=40)
    far = poses[:2, :15] + np.array([400.0, -300.0, 0.0], np.float32)
    predict = BundlePredictor(
        engine=Engine(Runner(manifest, bundles / "diffusion")), num_samples=3, num_steps=2, seed=5
    )
    answers = list(predict(far, ("observed", "free")))
    assert [answer["free"].shape for answer in answers] == [(3, 60, 21, 3)] * 2
    for observation, answer in zip(far, answers, strict=True):
        wanted = np.median(bone_lengths(observation, BODY21.parents), axis=0)
        found = bone_lengths(answer["observed"].astype(np.float64), BODY21.parents)
        np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=2e-4)
    assert not np.array_equal(answers[0]["free"][0], answers[0]["free"][1])


def test_bundles_that_do_not_fit_are_refused(store: Store, bundles: Path, tmp_path: Path):
    manifest = read_manifest(bundles / "still")
    slow = manifest.model_copy(update={"fps": 25.0})
    with pytest.raises(EvaluateError, match="still: found body21 at 25 fps; the store holds"):
        evaluate([(bundles / "still", slow)], store, GROUPS, out=tmp_path)
    long = manifest.model_copy(update={"horizon": 90})
    both = [(bundles / "still", manifest), (bundles / "still", long)]
    with pytest.raises(EvaluateError, match=r"found 15 \+ 60, 15 \+ 90 frames"):
        evaluate(both, store, GROUPS, out=tmp_path)
    with pytest.raises(EvaluateError, match="found none"):
        evaluate([], store, GROUPS, out=tmp_path)


def test_groups_that_hold_nothing_or_everything_are_refused(
    store: Store, bundles: Path, tmp_path: Path
):
    chosen = [(bundles / "still", read_manifest(bundles / "still"))]
    with pytest.raises(EvaluateError, match="elders: found no clip"):
        evaluate(chosen, store, {"elders": ("style=elder",)}, out=tmp_path)
    with pytest.raises(EvaluateError, match="no training clip is left"):
        evaluate(chosen, store, {"everyone": ("all",)}, out=tmp_path)
    with pytest.raises(StoreError, match="must be field=value"):
        evaluate(chosen, store, {"wrong": ("tired",)}, out=tmp_path)


def test_manifest_tells_what_a_bundle_was_trained_on(store: Store, bundles: Path, tmp_path: Path):
    manifest = read_manifest(bundles / "still").model_copy(
        update={"recipe": {"stages": [{}], "data": {"shares": None, "hold_out": ["style=old"]}}}
    )
    groups = {"old": ("style=old",), "third": ("subject=2",)}
    rows = evaluate(
        [(bundles / "still", manifest)], store, groups, out=tmp_path, bone_lengths=("free",)
    ).rows
    seen = {row.group: row.trained_on for row in rows if row.name == "still"}
    assert seen == {"old": 0.0, "third": 1.0}


def test_contact_sheet_is_a_small_picture(store: Store, bundles: Path, tmp_path: Path):
    path = tmp_path / "docs" / "sheet.png"
    contact_sheet(bundles / "diffusion", store, select(store.clips, ("all",)), path)
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) < 400_000
