"""Speed of actions as ratios of one run: the engine against the same network in PyTorch eager.

Run by ``make benchmarks``.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import typer
from torch import Tensor

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]  # noqa: TID251 - a script, not an installed module

from benchmarks._rounds import medians  # noqa: E402
from tiny_bundles import walking  # noqa: E402

from models.bundle import read_manifest  # noqa: E402
from models.system import Graph, Recipe  # noqa: E402
from service.engine.engine import Engine, predict  # noqa: E402
from service.engine.runner import Runner  # noqa: E402
from service.engine.trajectory import Request  # noqa: E402
from training.cli import load_recipe  # noqa: E402
from training.export import unstopped  # noqa: E402

NUM_SAMPLES = 50


def stepped(recipe: Recipe, *, frames_per_step: int) -> Callable[[], Tensor]:
    """One action in PyTorch eager, a step at a time to its longest: the stop is found afterwards.

    So the authors' code does it, at whatever frame the motion then turns out to end.
    """
    make_graphs: Callable[..., tuple[Graph, ...]] = recipe.graphs
    encoder, decoder = make_graphs(recipe.build().eval(), chunk_frames=frames_per_step)
    seen = torch.from_numpy(walking().astype(np.float32))[None]

    @torch.no_grad()
    def perform() -> Tensor:
        tensors = {
            "observation": seen.expand(NUM_SAMPLES, -1, -1, -1),
            "action": torch.zeros(NUM_SAMPLES, dtype=torch.int64),
            "noise": torch.randn(NUM_SAMPLES, *recipe.x_t_shape),
        }
        tensors |= outputs(encoder, tensors)
        frames = []
        for _ in range(0, recipe.data.horizon, frames_per_step):
            given = outputs(decoder, tensors)
            frames.append(given.pop("future"))
            tensors |= {name.removeprefix("next_"): value for name, value in given.items()}
        return torch.cat(frames, dim=1)

    return perform


def outputs(graph: Graph, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """What a graph's module gives, by name."""
    values = graph.module(*(tensors[name] for name in graph.inputs))
    return dict(zip(graph.outputs, values, strict=True))


def engine_on(
    bundle: Path, *, num_actions: int, threads: int, to_the_end: bool = False
) -> Callable[[], np.ndarray]:
    """One request of N samples through the service's engine."""
    manifest = read_manifest(bundle)
    engine = Engine(
        Runner(unstopped(manifest) if to_the_end else manifest, bundle, threads=threads)
    )
    request = Request(
        observation=walking().astype(np.float32),
        num_samples=NUM_SAMPLES,
        seed=1,
        actions=(0,) * num_actions,
    )
    return lambda: predict(engine, request).futures


def main(
    bundle: Path = ROOT / "models/bundles/wat",
    recipe: str = "models.systems.wat.recipes:mocap",
    frames_per_step: int = 5,
    rounds: int = 15,
    threads: int = 2,
) -> None:
    """Print one Markdown table."""
    if not bundle.exists():
        print(f"{bundle}: found no bundle; train and export one, or name another.")
        return
    torch.set_num_threads(threads)
    found = medians(
        {
            "eager": stepped(load_recipe(recipe), frames_per_step=frames_per_step),
            "longest": engine_on(bundle, num_actions=1, threads=threads, to_the_end=True),
            "one": engine_on(bundle, num_actions=1, threads=threads),
            "two": engine_on(bundle, num_actions=2, threads=threads),
            "four": engine_on(bundle, num_actions=4, threads=threads),
        },
        rounds=rounds,
    )
    eager, one, name = found["eager"], found["one"], bundle.name
    print(f"N = {NUM_SAMPLES}, {threads} threads, medians of {rounds} interleaved rounds\n")
    print("| | ms | ratio |\n|---|--:|--:|")
    print(f"| one action in PyTorch eager, step by step to its longest | {eager:.1f} | 1 |")
    longest = found["longest"]
    print(f"| {name}, one action to its longest | {longest:.1f} | {eager / longest:.1f} x |")
    print(f"| {name}, one action until it stops | {one:.1f} | {eager / one:.1f} x |")
    for count, several in ((2, found["two"]), (4, found["four"])):
        print(f"| {name}, {count} actions | {several:.1f} | {several / one:.1f} x one action |")


if __name__ == "__main__":
    typer.run(main)
