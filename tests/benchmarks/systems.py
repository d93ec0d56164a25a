"""A bundle through the engine against its paper's sizes in PyTorch eager, and another bundle.

``PYTHONPATH=tests python -m benchmarks.systems`` prints it; so does the same with ``--bundle
models/bundles/skeletondiffusion --recipe models.systems.skeletondiffusion.recipes:h36m``. A step of
a baseline of a hundred takes seconds: a few are timed, and the others taken to be like them.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Annotated

import torch
import typer
from benchmarks.baseline import paper_sized
from benchmarks.server import ROOT
from tiny_bundles import walking

from models.bundle import read_manifest
from models.diffusion import linear_schedule
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Request
from training.cli import load_recipe

RECIPE = "models.systems.motiondiff.recipes:h36m"
BUNDLE = ROOT / "models/bundles/motiondiff"
BESIDE = ROOT / "models/bundles/belfusion"


def main(  # noqa: PLR0913 - the options of a command
    *,
    bundle: Annotated[Path, typer.Option(help="whose speed is asked for")] = BUNDLE,
    recipe: Annotated[str, typer.Option(help="its paper's sizes")] = RECIPE,
    beside: Annotated[Path, typer.Option(help="another bundle, all its steps")] = BESIDE,
    num_samples: Annotated[int, typer.Option(min=1)] = 50,
    num_steps: Annotated[int, typer.Option(min=1)] = 10,
    rounds: Annotated[int, typer.Option(min=1, help="of the engine")] = 15,
    timed_steps: Annotated[int, typer.Option(min=2, help="of the baseline")] = 4,
    threads: Annotated[int, typer.Option(min=1)] = 2,
) -> None:
    """Print the milliseconds of each, medians of rounds that take turns, and their ratios."""
    torch.set_num_threads(threads)
    manifest, other = read_manifest(bundle), read_manifest(beside)
    ask = {
        "ours": _asked(bundle, num_samples=num_samples, num_steps=num_steps, threads=threads),
        "other": _asked(beside, num_samples=num_samples, num_steps=None, threads=threads),
    }
    found: dict[str, list[float]] = {name: [] for name in ask}
    for _ in range(rounds):
        for name, run in ask.items():
            found[name].append(_seconds(run))
    ours, others = median(found["ours"]), median(found["other"])
    paper = load_recipe(recipe)
    assert paper.schedule
    steps = paper.schedule.num_steps
    one, some = (
        _seconds(paper_sized(replace(paper, schedule=linear_schedule(n)), num_samples=num_samples))
        for n in (1, timed_steps)
    )
    theirs = one + (some - one) * (steps - 1) / (timed_steps - 1)
    print(f"{manifest.name}, {num_steps} steps, engine: {1e3 * ours:.0f} ms")
    print(f"{other.name}, all steps, engine: {1e3 * others:.0f} ms; {ours / others:.2f} of it")
    print(f"{paper.name}, {steps} steps, PyTorch eager, one call: {1e3 * theirs:.0f} ms")
    print(f"{theirs / ours:.0f} x")


def _asked(
    bundle: Path, *, num_samples: int, num_steps: int | None, threads: int
) -> Callable[[], object]:
    """One request of a bundle, which has been asked once."""
    manifest = read_manifest(bundle)
    engine = Engine(Runner(manifest, bundle, threads=threads))
    seen = walking(manifest.num_observed, fps=manifest.fps).astype("float32")
    request = Request(observation=seen, num_samples=num_samples, num_steps=num_steps)
    predict(engine, request)
    return lambda: predict(engine, request)


def _seconds(run: Callable[[], object]) -> float:
    started_s = perf_counter()
    run()
    return perf_counter() - started_s


if __name__ == "__main__":
    typer.run(main)
