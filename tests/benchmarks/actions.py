"""Speed of actions as ratios: the engine against the same network in PyTorch eager."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import torch
from benchmarks.rounds import milliseconds
from tiny_bundles import walking
from torch import Tensor

from models.bundle import read_manifest
from models.system import Graph, Recipe
from service.engine.engine import Engine
from service.engine.runner import Runner
from service.engine.trajectory import Request
from service.worker import Worker
from training.cli import load_recipe
from training.export import unstopped

NUM_SAMPLES = 50
RECIPE = "models.systems.wat.recipes:mocap"
FRAMES_PER_STEP = 5


def table(bundle: Path, *, rounds: int, cores: int) -> list[tuple[str, float, str]]:
    """What ran, its milliseconds, and how often it fits into what."""
    found = milliseconds(
        {
            "eager": stepped(load_recipe(RECIPE), frames_per_step=FRAMES_PER_STEP),
            "longest": served_on(bundle, num_actions=1, cores=cores, to_the_end=True),
            "one": served_on(bundle, num_actions=1, cores=cores),
            "two": served_on(bundle, num_actions=2, cores=cores),
            "four": served_on(bundle, num_actions=4, cores=cores),
        },
        rounds=rounds,
    )
    name = bundle.name

    def ratio(above: str, below: str) -> float:
        # Within a round, as a machine that drifts does so from round to round.
        return median(a / b for a, b in zip(found[above], found[below], strict=True))

    told = {
        "one action in PyTorch eager, step by step to its longest": ("eager", "1"),
        f"{name}, one action to its longest": ("longest", f"{ratio('eager', 'longest'):.1f} x"),
        f"{name}, one action until it stops": ("one", f"{ratio('eager', 'one'):.1f} x"),
        f"{name}, 2 actions": ("two", f"{ratio('two', 'one'):.1f} x one action"),
        f"{name}, 4 actions": ("four", f"{ratio('four', 'one'):.1f} x one action"),
    }
    return [(what, median(found[side]), times) for what, (side, times) in told.items()]


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


def served_on(
    bundle: Path, *, num_actions: int, cores: int, to_the_end: bool = False
) -> Callable[[], None]:
    """One request of N samples, whose rows a thread for each core shares, as the server has it."""
    manifest = read_manifest(bundle)
    engine = Engine(Runner(unstopped(manifest) if to_the_end else manifest, bundle))
    worker = Worker(engine, threads=cores, max_rows=NUM_SAMPLES)
    request = Request(
        observation=walking().astype(np.float32),
        num_samples=NUM_SAMPLES,
        seed=1,
        actions=(0,) * num_actions,
    )

    async def perform() -> None:  # what it returned, asyncio.run would write out twice
        await worker.predict(request, lambda result, _: result.futures.tobytes())

    return lambda: asyncio.run(perform())
