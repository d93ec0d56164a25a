"""The bundles that ship: whole, small, labelled, and human in what they predict."""

from pathlib import Path

import numpy as np
import pytest
from tiny_bundles import walking

from models.bundle import CARD_FILE, read_manifest
from models.motion.kinematics import bone_lengths, yaw
from models.motion.skeleton import BODY21
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Request

BUNDLES = Path(__file__).parents[1] / "models/bundles"
FOLDERS = sorted(path.parent for path in BUNDLES.glob("*/manifest.json"))
MAX_GRAPH_BYTES = 15 * 2**20

each_bundle = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


def test_the_bundles_of_the_readme_ship():
    names = {folder.name for folder in FOLDERS}
    assert {"belfusion", "belfusion-cmu", "zero-velocity", "constant-velocity"} <= names
    assert names >= set((BUNDLES / "DEFAULT").read_text().split())


@each_bundle
def test_bundle_is_whole_and_small(folder):
    manifest = read_manifest(folder)
    assert manifest.name == folder.name
    for graph in manifest.graphs().values():
        assert (folder / graph.file).stat().st_size <= MAX_GRAPH_BYTES


@each_bundle
def test_card_tells_data_licence_attribution_and_failures(folder):
    manifest, card = read_manifest(folder), (folder / CARD_FILE).read_text()
    for heading in ("## Data", "## Licence", "## Figures", "## Known failures"):
        assert heading in card, heading
    for text in manifest.attribution:
        assert text in card
    assert manifest.licence in card


def futures(folder: Path, observation: np.ndarray) -> np.ndarray:
    manifest = read_manifest(folder)
    engine = Engine(Runner(manifest, folder))
    request = Request(
        observation=observation.astype(np.float32),
        num_samples=20,
        seed=3,
        actions=(0,) if manifest.actions else (),
    )
    return predict(engine, request).futures.astype(np.float64)


@each_bundle
def test_walker_goes_on_upright_and_whole(folder):
    observation = walking(speed=1.2)
    found = futures(folder, observation)
    head, hips, feet = found[..., 4, 2], found[..., 0, 2], found[..., [15, 19], 2]
    assert np.all(head > hips)
    assert np.all(hips > feet.min(axis=-1))
    seen = bone_lengths(observation[-1], BODY21.parents)[1:]
    limbs = seen > 0.2  # metres; what is left after the fit of the answer's bones is the direction
    stretch = bone_lengths(found, BODY21.parents)[..., 1:][..., limbs] / seen[limbs]
    assert stretch.min() > 0.5
    assert stretch.max() < 2.0
    assert np.abs(yaw(found, BODY21)).mean() < 1.2  # most do not turn round at once


@each_bundle
def test_first_frame_continues_the_observation(folder):
    observation = walking(speed=1.2)
    found = futures(folder, observation)
    step = np.linalg.norm(observation[-1] - observation[-2], axis=-1).max()
    jump = np.linalg.norm(found[:, 0] - observation[-1], axis=-1)
    assert jump.max() < 2.5 * step
