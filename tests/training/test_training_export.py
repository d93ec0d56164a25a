"""Export: a bundle that agrees with torch, or nothing."""

import dataclasses

import numpy as np
import pytest
import torch
from tiny_bundles import walking

from models.bundle import read_manifest
from models.system import Graph
from training.cli import load_recipe
from training.export import ExportError, Label, export

LABEL = Label(name="made", version="2", licence="CC0-1.0", attribution=("thanks",))


@pytest.fixture(scope="module")
def recipe():
    return load_recipe("models.systems.belfusion.recipes:tiny")


@pytest.fixture(scope="module")
def seen():
    speeds = np.linspace(0.3, 1.5, 5)
    return np.stack([walking(speed=float(speed)) for speed in speeds]).astype(np.float32)


def exported(recipe, folder, seen):
    return export(recipe, recipe.build(), folder, label=LABEL, card="# Card", observations=seen)


def test_bundle_holds_graphs_manifest_card_and_recipe(recipe, seen, tmp_path):
    written = exported(recipe, tmp_path / "made", seen)
    manifest = read_manifest(tmp_path / "made")
    assert manifest == written
    names = {path.name for path in (tmp_path / "made").iterdir()}
    assert names == {
        "manifest.json",
        "MODEL_CARD.md",
        "encoder.onnx",
        "denoiser.onnx",
        "decoder.onnx",
    }
    assert manifest.recipe["name"] == "tiny"
    assert manifest.attribution == ("thanks",)
    assert (manifest.num_steps, manifest.x_t_shape) == (10, (16,))


def test_same_network_gives_the_same_bytes(recipe, seen, tmp_path):
    network = recipe.build()
    digests = [
        export(
            recipe, network, tmp_path / name, label=LABEL, card="# Card", observations=seen
        ).digest
        for name in ("one", "two")
    ]
    assert digests[0] == digests[1]


def test_graph_that_asks_for_what_none_gives_is_refused(recipe, seen, tmp_path):
    def broken(network):
        first, *others = recipe.graphs(network)
        return (dataclasses.replace(first, outputs=("condition", "misnamed", "expected")), *others)

    with pytest.raises(ExportError, match="asks for target_code"):
        exported(dataclasses.replace(recipe, graphs=broken), tmp_path / "made", seen)
    assert not (tmp_path / "made").exists()


class Restless(torch.nn.Module):
    """Answers otherwise at every call, as a graph with hidden state would."""

    def __init__(self, decoder: torch.nn.Module) -> None:
        super().__init__()
        self.decoder = decoder
        self.calls = 0

    def forward(self, x0, target_code, expected, observation):
        self.calls += 1
        return self.decoder(x0, target_code, expected, observation) + 0.01 * self.calls


def test_disagreement_between_torch_and_onnxruntime_writes_nothing(recipe, seen, tmp_path):
    def restless(network):
        *others, decoder = recipe.graphs(network)
        module = Restless(decoder.module)
        return (
            *others,
            Graph(role="decoder", module=module, inputs=decoder.inputs, outputs=("future",)),
        )

    with pytest.raises(ExportError, match="differ by"):
        exported(dataclasses.replace(recipe, graphs=restless), tmp_path / "made", seen)
    assert not (tmp_path / "made").exists()
