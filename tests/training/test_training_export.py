"""Export: a bundle that agrees with torch, or nothing."""

import dataclasses

import numpy as np
import pytest
import torch
from tiny_bundles import (
    CHUNK_FRAMES,
    FPS,
    HORIZON,
    LABELS,
    NOISE_SHAPE,
    NUM_JOINTS,
    NUM_OBSERVED,
    ActionDecoder,
    ActionEncoder,
    walking,
)

from models.bundle import read_manifest
from models.motion.skeleton import BODY21
from models.system import Actions, Data, Graph, Recipe
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from training.cli import load_recipe
from training.export import ExportError, Label, export, reference_futures, trial_request, unstopped

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


def performing(decoder: type[ActionDecoder] = ActionDecoder) -> Recipe:
    """A recipe of a person who performs actions."""
    return Recipe(
        name="performing",
        system="made-by-a-test",
        description="Moves towards a goal.",
        data=Data(
            skeleton=BODY21,
            fps=FPS,
            num_observed=NUM_OBSERVED,
            horizon=HORIZON,
            actions=Actions(
                labels={label: (f"action={label}",) for label in LABELS},
                examples={"wave": "raises a hand"},
                chunk_frames=CHUNK_FRAMES,
                min_frames=6,
                stop_threshold_m=0.03,
            ),
        ),
        build=lambda: torch.nn.ModuleList([ActionEncoder(), decoder()]),
        graphs=lambda network: (
            Graph(
                role="encoder",
                module=network[0],
                inputs=("observation", "action"),
                outputs=("goal", "pose"),
            ),
            Graph(
                role="decoder",
                module=network[1],
                inputs=("noise", "goal", "pose"),
                outputs=("future", "next_pose"),
            ),
        ),
        x_t_shape=NOISE_SHAPE,
    )


def test_dropout_of_a_part_of_a_graph_stays_off(seen, tmp_path):
    class Dropping(ActionDecoder):
        def __init__(self, dropout):
            super().__init__()
            self.dropout = dropout

        def forward(self, noise, goal, pose):
            return super().forward(noise, self.dropout(goal), pose)

    recipe = performing()

    def wrapped(network):
        encoder, decoder = recipe.graphs(network)
        return encoder, dataclasses.replace(decoder, module=Dropping(network[2]))

    exported(
        dataclasses.replace(
            recipe,
            build=lambda: recipe.build().append(torch.nn.Dropout(0.5)),
            graphs=wrapped,
        ),
        tmp_path / "made",
        seen,
    )
    assert (tmp_path / "made").exists()


def test_graph_that_holds_on_to_the_batch_it_was_traced_with_is_refused(seen, tmp_path):
    class Fixed(ActionDecoder):
        def forward(self, noise, goal, pose):
            still = torch.zeros(len(goal), NUM_JOINTS, 3)  # a constant in the traced graph
            return super().forward(noise, torch.cat([goal, still], dim=1)[:, :NUM_JOINTS], pose)

    with pytest.raises(ExportError, match="decoder could not run"):
        exported(performing(Fixed), tmp_path / "made", seen)
    assert not (tmp_path / "made").exists()


def test_recipe_of_actions_tells_the_manifest_how_to_perform_them(seen, tmp_path):
    exported(performing(), tmp_path / "made", seen)
    manifest = read_manifest(tmp_path / "made")
    assert manifest.actions.labels == LABELS
    assert manifest.actions.examples == {"wave": "raises a hand"}
    assert (manifest.actions.chunk_frames, manifest.actions.min_frames) == (CHUNK_FRAMES, 6)
    assert (manifest.actions.stop_threshold_m, manifest.x_t_shape) == (0.03, NOISE_SHAPE)
    assert [tensor.dtype for tensor in manifest.encoder.inputs] == ["float32", "int64"]


def test_actions_are_compared_over_all_chunks_of_two_of_them(seen, tmp_path):
    recipe = performing()
    network = recipe.build().eval()
    export(recipe, network, tmp_path / "made", label=LABEL, card="# Card", observations=seen)
    graphs = {graph.role: graph for graph in recipe.graphs(network)}
    expected = reference_futures(recipe, graphs, seen, seed=7)
    assert expected.shape == (5, 2 * (2 * CHUNK_FRAMES + CHUNK_FRAMES // 2), 21, 3)
    manifest = unstopped(read_manifest(tmp_path / "made"))
    result = predict(
        Engine(Runner(manifest, tmp_path / "made")), trial_request(recipe, seen[0], seed=7)
    )
    assert [(part.action, part.stopped) for part in result.segments[0]] == [(0, False), (2, False)]
    assert result.futures[0] == pytest.approx(expected[0], abs=1e-5)


def test_trial_ends_no_action_early_even_of_a_body_that_stands_still(seen, tmp_path):
    recipe = performing()
    network = recipe.build()
    torch.nn.init.zeros_(network[0].reach.weight)
    torch.nn.init.zeros_(network[0].linear.weight)
    torch.nn.init.zeros_(network[0].linear.bias)
    export(recipe, network, tmp_path / "made", label=LABEL, card="# Card", observations=seen)
    assert (tmp_path / "made").exists()


def test_actions_with_restless_state_write_nothing(seen, tmp_path):
    class Forgetful(ActionDecoder):
        calls = 0

        def forward(self, noise, goal, pose):
            self.calls += 1
            future, next_pose = super().forward(noise, goal, pose)
            return future, next_pose + 0.01 * self.calls

    with pytest.raises(ExportError, match="differ by"):
        exported(performing(Forgetful), tmp_path / "made", seen)
    assert not (tmp_path / "made").exists()
