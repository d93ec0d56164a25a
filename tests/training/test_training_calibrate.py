"""Calibration of a bundle's regions on clips that it has not learnt."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from people import small_store

from models.bundle import SkeletonSpec, read_manifest
from service.answers.quantiles import regions
from service.engine.engine import Engine
from service.engine.runner import Runner
from service.errors import FieldError
from training.calibrate import calibrate
from training.data.store import Store
from training.data.windows import Windows, cut
from training.evaluate import EvaluateError
from training.predictors import BundlePredictor

NUM_SAMPLES = 12


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("small") / "store")


@pytest.fixture
def bundle(bundles: Path, tmp_path: Path) -> Path:
    return shutil.copytree(bundles / "diffusion", tmp_path / "diffusion")


def test_regions_hold_the_truth_as_often_as_they_say(store: Store, bundle: Path):
    calibrated = calibrate(
        bundle, store, ("all",), groups={"old": ("style=old",)}, num_samples=NUM_SAMPLES
    )
    manifest = read_manifest(bundle)
    assert manifest == calibrated.manifest
    assert manifest.calibration is not None
    windows = Windows.of(store.clips, num_frames=75, stride=15)
    assert manifest.calibration.num_windows == len(windows)
    assert manifest.calibration.measured_on == ("all",)
    poses = cut(store, windows, num_frames=75)
    predict = BundlePredictor(
        engine=Engine(Runner(manifest, bundle)), num_samples=NUM_SAMPLES, num_steps=None, seed=0
    )
    inside = []
    answers = predict(poses[:, :15], ("observed",))
    for future, answer in zip(poses[:, 15:], answers, strict=True):
        found = regions(
            answer["observed"],
            fps=30.0,
            calibration=manifest.calibration,
            levels=manifest.calibration.levels,
        )
        inside.append(np.linalg.norm(future - found.centre, axis=-1) <= found.radius)
    covered = np.mean(inside, axis=(0, 2, 3))
    np.testing.assert_allclose(covered, manifest.calibration.levels, atol=0.02)

    rows = {(row.clips, row.level): row for row in calibrated.coverage}
    assert len(rows) == len(calibrated.coverage) == 2 * len(manifest.calibration.levels)
    for level in manifest.calibration.levels:
        here, there = rows["all", level], rows["old", level]
        assert (here.takes, there.takes) == (6, 1)
        assert here.lowest <= here.after <= here.highest
        assert there.lowest is None
        assert here.radius_after > here.radius_before  # random weights are far too sure
    assert "| old | 1 | 4 | 90% |" in str(calibrated)


def test_calibrating_again_finds_the_same(store: Store, bundle: Path):
    first = calibrate(bundle, store, ("all",), groups={}, num_samples=10, max_windows=8)
    again = calibrate(bundle, store, ("all",), groups={}, num_samples=10, max_windows=8)
    assert again == first


def test_clips_that_the_bundle_has_learnt_are_refused(store: Store, bundle: Path):
    path = bundle / "manifest.json"
    recipe = {"stages": [{}], "data": {"shares": None, "hold_out": ["style=old"]}}
    learnt = read_manifest(bundle).model_copy(update={"recipe": recipe})
    path.write_text(learnt.model_dump_json())
    with pytest.raises(EvaluateError, match=r"young: diffusion was trained on \d+% of these"):
        calibrate(bundle, store, ("style=old",), groups={"young": ("style=young",)})
    assert read_manifest(bundle) == learnt


def test_a_single_take_cannot_calibrate(store: Store, bundle: Path):
    with pytest.raises(EvaluateError, match="hold: found a single take"):
        calibrate(bundle, store, ("style=old",), groups={}, num_samples=10)


def test_bundle_whose_samples_are_alike_cannot_be_calibrated(
    store: Store, bundles: Path, tmp_path: Path
):
    folder = shutil.copytree(bundles / "still", tmp_path / "still")
    with pytest.raises(EvaluateError, match="found them all alike"):
        calibrate(folder, store, ("all",), groups={}, num_samples=10)
    assert read_manifest(folder).calibration is None


def test_bundle_of_another_skeleton_or_too_few_samples_is_refused(store: Store, bundle: Path):
    with pytest.raises(FieldError, match="num_samples: found 4"):
        calibrate(bundle, store, ("all",), groups={}, num_samples=4)
    manifest = read_manifest(bundle)
    spec = SkeletonSpec(**manifest.skeleton.model_dump() | {"joints": manifest.skeleton.joints[1:]})
    other = manifest.model_copy(update={"skeleton": spec})
    (bundle / "manifest.json").write_text(other.model_dump_json())
    with pytest.raises(EvaluateError, match="the store holds"):
        calibrate(bundle, store, ("all",), groups={})
