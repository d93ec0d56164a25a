"""Strided steps through the engine against all steps of the paper's sizes in PyTorch eager.

``PYTHONPATH=tests python -m benchmarks.strides`` prints it. A step of the baseline takes seconds:
a few of its hundred are timed, and the others taken to be like them.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
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


def main(
    *,
    bundle: Annotated[Path, typer.Option(help="whose plan is a stride")] = BUNDLE,
    num_samples: Annotated[int, typer.Option(min=1)] = 50,
    num_steps: Annotated[int, typer.Option(min=1)] = 10,
    rounds: Annotated[int, typer.Option(min=1, help="of the engine")] = 15,
    timed_steps: Annotated[int, typer.Option(min=2, help="of the baseline")] = 4,
    threads: Annotated[int, typer.Option(min=1)] = 2,
) -> None:
    """Print the milliseconds of either, and their ratio."""
    torch.set_num_threads(threads)
    manifest = read_manifest(bundle)
    engine = Engine(Runner(manifest, bundle, threads=threads))
    seen = walking(manifest.num_observed, fps=manifest.fps).astype("float32")
    request = Request(observation=seen, num_samples=num_samples, num_steps=num_steps)
    ours = sorted(_seconds(lambda: predict(engine, request)) for _ in range(rounds))[rounds // 2]
    recipe = load_recipe(RECIPE)
    assert recipe.schedule
    steps = recipe.schedule.num_steps
    one, some = (
        _seconds(paper_sized(replace(recipe, schedule=linear_schedule(n)), num_samples=num_samples))
        for n in (1, timed_steps)
    )
    theirs = one + (some - one) * (steps - 1) / (timed_steps - 1)
    print(f"{manifest.name}, {num_steps} steps, engine: {1e3 * ours:.0f} ms")
    print(f"{recipe.name}, {steps} steps, PyTorch eager, one call: {1e3 * theirs:.0f} ms")
    print(f"{theirs / ours:.0f} x")


def _seconds(run: Callable[[], object]) -> float:
    started_s = perf_counter()
    run()
    return perf_counter() - started_s


if __name__ == "__main__":
    typer.run(main)
