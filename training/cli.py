"""Command line ``posefutures-train``: prepare, train, export, evaluate, calibrate bundles."""

import importlib
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from models.bundle import CARD_FILE, BundleError, read_manifest
from models.motion.formats.errors import FormatError
from models.motion.skeleton import SKELETONS
from models.system import Recipe
from service.errors import ServiceError
from training.action_classifier import classifier_recipe, read_judge
from training.calibrate import calibrate
from training.checkpoint import CheckpointError
from training.contact_sheet import action_sheet, contact_sheet
from training.data.batches import training_clips
from training.data.prepare import PrepareError, prepare
from training.data.store import StoreError, open_store, select
from training.data.windows import Windows, cut
from training.evaluate import EvaluateError, evaluate
from training.evaluate_actions import evaluate_actions
from training.export import ExportError, Label, export
from training.loop import RunError, train, trained_network
from training.step_curve import step_curve

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Prepare motion, train a recipe or the judge of its actions, export and evaluate bundles.",
)
ERRORS = (
    BundleError,
    CheckpointError,
    EvaluateError,
    ExportError,
    FormatError,
    PrepareError,
    RunError,
    ServiceError,
    StoreError,
)
RecipeArgument = Annotated[
    str, typer.Argument(help="Dotted path and name, such as models.systems.NAME.recipes:mocap.")
]
StoreOption = Annotated[Path, typer.Option(help="Folder made by prepare.")]
BundlesArgument = Annotated[list[Path], typer.Argument(help="Folders of bundles to compare.")]
BundleArgument = Annotated[Path, typer.Argument(help="Folder of the bundle.")]
HoldOption = Annotated[list[str], typer.Option(help="Clips that the bundle has not learnt.")]
StrideOption = Annotated[int, typer.Option(help="Frames between windows.")]
SeedOption = Annotated[int, typer.Option(help="Of the samples.")]


class RecipeError(Exception):
    """No recipe has that name."""


def main() -> None:
    """Run the command line; every expected error is one line."""
    try:
        app()
    except (*ERRORS, RecipeError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def load_recipe(path: str) -> Recipe:
    """The recipe that a dotted path names.

    Raises:
        RecipeError: the path is malformed or names no recipe.
    """
    module, _, name = path.partition(":")
    try:
        make: Callable[[], Recipe] = getattr(importlib.import_module(module), name)
        recipe = make()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise RecipeError(
            f"recipe: found {path!r} ({error}); must be package.module:function."
        ) from error
    if not isinstance(recipe, Recipe):
        raise RecipeError(f"recipe: {path!r} returns {type(recipe).__name__}; must be a Recipe.")
    return recipe


@app.command("prepare")
def prepare_command(
    sources: Annotated[list[Path], typer.Argument(help="Folders of BVH or AMC, or npz archives.")],
    out: Annotated[Path, typer.Option(help="Folder of the store.")],
    skeleton: Annotated[str, typer.Option(help="A standard skeleton's name.")] = "body21",
    fps: Annotated[float, typer.Option(help="Frames per second of the store.")] = 30.0,
) -> None:
    """Turn public motion files into a store, with a report of what was dropped and why."""
    if skeleton not in SKELETONS:
        raise StoreError(f"skeleton: found {skeleton!r}; must be one of {', '.join(SKELETONS)}.")
    typer.echo(prepare(sources, out, skeleton=SKELETONS[skeleton], fps=fps).table())


@app.command("train")
def train_command(
    recipe: RecipeArgument,
    store: StoreOption,
    out: Annotated[Path, typer.Option(help="Folder of the run; a killed run continues there.")],
    device: Annotated[str, typer.Option(help="cpu or cuda; the GPU if there is one.")] = "",
    seed: Annotated[int, typer.Option(help="Of weights, windows and noise.")] = 0,
    start_from: Annotated[
        Path | None, typer.Option(help="Folder of a finished run to take the weights of.")
    ] = None,
) -> None:
    """Train every stage of a recipe."""
    chosen = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    train(
        load_recipe(recipe),
        open_store(store),
        out,
        device=chosen,
        seed=seed,
        start_from=start_from,
    )


@app.command("export")
def export_command(
    recipe: RecipeArgument,
    store: StoreOption,
    out: Annotated[Path, typer.Option(help="Folder of the bundle; its name names the bundle.")],
    licence: Annotated[str, typer.Option(help="Licence of the weights.")],
    run: Annotated[Path | None, typer.Option(help="Folder of the finished run.")] = None,
    card: Annotated[
        Path | None, typer.Option(help="The model card; the one in the bundle's folder if none.")
    ] = None,
    attribution: Annotated[list[str] | None, typer.Option(help="A text that users owe.")] = None,
    version: Annotated[str, typer.Option(help="Version of the bundle.")] = "1",
    machine: Annotated[str, typer.Option(help="What it was trained on, for the manifest.")] = "",
) -> None:
    """Write the bundle of a finished run, if torch and onnxruntime agree."""
    chosen = load_recipe(recipe)
    network, progress = trained_network(chosen, run)
    training = {
        "updates": progress.total_updates,
        "hours": round(progress.seconds / 3600, 2),
        "machine": machine,
    }
    manifest = export(
        chosen,
        network,
        out,
        label=Label(
            name=out.name,
            version=version,
            licence=licence,
            attribution=tuple(attribution or ()),
            training=training if chosen.stages else {},
        ),
        card=_card(card or out / CARD_FILE),
        observations=_some_observations(chosen, store),
    )
    typer.echo(f"{out}: {manifest.name} {manifest.version}, digest {manifest.digest}")


def _card(path: Path) -> str:
    if not path.is_file():
        raise ExportError(f"{path}: found no model card; every bundle that ships carries one.")
    return path.read_text()


def _some_observations(recipe: Recipe, store: Path) -> np.ndarray:
    opened, frames = open_store(store), recipe.data.num_observed
    windows = Windows.of(training_clips(opened, recipe.data), num_frames=frames)
    spread = np.linspace(0, len(windows) - 1, 5).astype(int)
    return cut(opened, windows, num_frames=frames, indices=spread)


@app.command("evaluate")
def evaluate_command(
    bundles: BundlesArgument,
    store: StoreOption,
    out: Annotated[Path, typer.Option(help="Folder for evaluation.json and evaluation.md.")],
    group: Annotated[
        list[str],
        typer.Option(help="name:selector[,selector…], such as style:style=tired."),
    ],
    num_samples: Annotated[int, typer.Option(help="Futures for each window.")] = 50,
    num_steps: Annotated[int | None, typer.Option(help="Denoising steps of each.")] = None,
    stride: StrideOption = 10,
    max_windows: Annotated[int, typer.Option(help="Windows of a group at most.")] = 300,
    seed: SeedOption = 0,
    sheet: Annotated[Path | None, typer.Option(help="Also draw ten windows to this PNG.")] = None,
) -> None:
    """Measure bundles through the service's own engine, beside reference forecasts."""
    started = time.monotonic()
    opened = open_store(store)
    groups = dict(_group(text) for text in group)
    table = evaluate(
        [(folder, read_manifest(folder)) for folder in bundles],
        opened,
        groups,
        out=out,
        num_samples=num_samples,
        num_steps=num_steps,
        stride=stride,
        max_windows=max_windows,
        seed=seed,
        command=_command(),
    )
    typer.echo(table)
    if sheet:
        contact_sheet(bundles[0], opened, select(opened.clips, next(iter(groups.values()))), sheet)
    typer.echo(f"{time.monotonic() - started:.0f} s", err=True)


@app.command("calibrate")
def calibrate_command(
    bundle: BundleArgument,
    store: StoreOption,
    hold: HoldOption,
    group: Annotated[
        list[str] | None,
        typer.Option(help="name:selector[,selector…] of other clips to report on."),
    ] = None,
    samples: Annotated[int, typer.Option(help="Futures for each window.")] = 50,
    stride: StrideOption = 15,
    max_windows: Annotated[int, typer.Option(help="Windows of a group at most.")] = 600,
    seed: SeedOption = 0,
) -> None:
    """Measure what a bundle's regions cover; write what makes them hold into its manifest."""
    calibrated = calibrate(
        bundle,
        open_store(store),
        hold,
        groups=dict(_group(text) for text in group or ()),
        num_samples=samples,
        stride=stride,
        max_windows=max_windows,
        seed=seed,
        command=_command(),
    )
    typer.echo(calibrated)
    typer.echo(f"{bundle}: calibrated, digest {calibrated.manifest.digest}")


@app.command("steps")
def steps_command(
    bundle: BundleArgument,
    store: StoreOption,
    hold: HoldOption,
    out: Annotated[Path, typer.Option(help="Folder for steps_<bundle>.md, .json and .png.")],
    samples: Annotated[int, typer.Option(help="Futures for each window.")] = 50,
    stride: StrideOption = 15,
    max_windows: Annotated[int, typer.Option(help="Windows at most.")] = 200,
    rounds: Annotated[int, typer.Option(help="How often each number of steps is timed.")] = 25,
    seed: SeedOption = 0,
) -> None:
    """Measure what running fewer denoising steps costs in quality and saves in time."""
    curve = step_curve(
        bundle,
        open_store(store),
        hold,
        out=out,
        num_samples=samples,
        stride=stride,
        max_windows=max_windows,
        rounds=rounds,
        seed=seed,
        command=_command(),
    )
    typer.echo(curve, nl=False)


def _command() -> str:
    return f"posefutures-train {shlex.join(sys.argv[1:])}"


def _group(text: str) -> tuple[str, tuple[str, ...]]:
    name, _, selectors = text.partition(":")
    if not selectors:
        raise StoreError(f"group: found {text!r}; must be name:selector[,selector…].")
    return name, tuple(selectors.split(","))


@app.command("classifier")
def classifier_command(
    recipe: RecipeArgument,
    store: StoreOption,
    out: Annotated[Path, typer.Option(help="Folder of the run; a killed run continues there.")],
    updates: Annotated[int, typer.Option(help="Steps of training.")] = 1_000,
) -> None:
    """Train the classifier that judges a recipe's actions, on the clips that the recipe learns."""
    train(
        classifier_recipe(load_recipe(recipe), num_updates=updates),
        open_store(store),
        out,
        device=torch.device("cpu"),
    )


@app.command("evaluate-actions")
def evaluate_actions_command(
    bundles: BundlesArgument,
    store: StoreOption,
    classifier: Annotated[Path, typer.Option(help="Folder of a finished run of classifier.")],
    out: Annotated[Path, typer.Option(help="Folder for evaluation_actions.json and .md.")],
    hold: Annotated[
        list[str] | None,
        typer.Option(help="Clips to evaluate on; those that the recipe held out if none."),
    ] = None,
    samples: Annotated[int, typer.Option(help="Futures of each history and action.")] = 10,
    histories: Annotated[int, typer.Option(help="Beginnings of clips to continue.")] = 60,
    actions_in_sequence: Annotated[int, typer.Option(help="Performed one after another.")] = 5,
    seed: SeedOption = 0,
    sheet: Annotated[Path | None, typer.Option(help="Also draw every action to this PNG.")] = None,
) -> None:
    """Measure bundles that perform actions through the service's own engine, beside real clips."""
    started = time.monotonic()
    opened = open_store(store)
    judge = read_judge(classifier, opened)
    evaluation = evaluate_actions(
        [(folder, read_manifest(folder)) for folder in bundles],
        opened,
        judge,
        out=out,
        hold=hold or (),
        num_samples=samples,
        num_histories=histories,
        actions_in_sequence=actions_in_sequence,
        seed=seed,
        command=_command(),
    )
    typer.echo(evaluation)
    if sheet:
        held_out = select(opened.clips, tuple(hold or judge.data.hold_out))
        action_sheet(bundles[0], opened, held_out, sheet, seed=seed)
    typer.echo(f"{time.monotonic() - started:.0f} s", err=True)
