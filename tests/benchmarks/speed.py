"""Speed as ratios of one run: the engine on a shipped bundle against the paper's sizes in PyTorch.

Run by ``make benchmarks``. Rounds are interleaved, so that a noisy neighbour slows both sides
alike; medians are reported.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import torch
import typer
from torch import Tensor

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]  # noqa: TID251 - a script, not an installed module

from benchmarks._rounds import medians  # noqa: E402
from tiny_bundles import walking  # noqa: E402

from models.bundle import read_manifest  # noqa: E402
from models.diffusion import ddim_step, timesteps  # noqa: E402
from models.system import Recipe  # noqa: E402
from service.engine.engine import Engine, predict  # noqa: E402
from service.engine.runner import Runner  # noqa: E402
from service.engine.trajectory import Request  # noqa: E402
from training.cli import load_recipe  # noqa: E402

NUM_SAMPLES = 50


def paper_sized(recipe: Recipe) -> Callable[[], Tensor]:
    """The recipe's whole loop in PyTorch eager: N rows in one call, decoded once at the end."""
    network = recipe.build().eval()
    encoder, denoiser, decoder = (graph.module for graph in recipe.graphs(network))
    data, schedule = recipe.data, recipe.schedule
    assert schedule is not None
    seen = torch.randn(1, data.num_observed, data.skeleton.num_joints, 3)

    @torch.no_grad()
    def sample() -> Tensor:
        condition, *others = encoder(seen)
        x = torch.randn(NUM_SAMPLES, *recipe.x_t_shape)
        rows = [value.expand(NUM_SAMPLES, *value.shape[1:]) for value in (condition, *others, seen)]
        x0 = x
        for t in timesteps(schedule.num_steps, schedule.num_steps):
            x0 = denoiser(x, torch.full((NUM_SAMPLES,), t), rows[0])
            x = ddim_step(
                x_t=x,
                x0=x0,
                alpha_bar=float(schedule.alpha_bar[t]),
                variance=float(schedule.variance[t, 0]),
                alpha_bar_next=float(schedule.alpha_bar[t - 1]) if t else 1.0,
                variance_next=float(schedule.variance[t - 1, 0]) if t else 0.0,
            )
        return decoder(x0, *rows[1:])

    return sample


def engine_on(bundle: Path, *, num_steps: int, threads: int) -> Callable[[], np.ndarray]:
    """One request of N samples through the service's engine."""
    engine = Engine(Runner(read_manifest(bundle), bundle, threads=threads))
    seen = walking().astype(np.float32)
    request = Request(observation=seen, num_samples=NUM_SAMPLES, num_steps=num_steps, seed=1)
    return lambda: predict(engine, request).futures


def cold_start(port: int) -> float:
    """Seconds from starting the server to a 200 of /readyz."""
    command = [str(Path(sys.executable).with_name("posefutures")), "serve", "--port", str(port)]
    started = time.perf_counter()
    server = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        while time.perf_counter() - started < 30:
            try:
                if httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200:
                    return time.perf_counter() - started
            except httpx.TransportError:
                pass
            time.sleep(0.02)
        raise SystemExit("the server was not ready within 30 s")
    finally:
        server.terminate()
        server.wait()


def main(
    bundle: Path = ROOT / "models/bundles/belfusion",
    recipe: str = "models.systems.belfusion.recipes:h36m",
    rounds: int = 15,
    threads: int = 2,
    port: int = 8765,
) -> None:
    """Print one Markdown table."""
    torch.set_num_threads(threads)
    found = medians(
        {
            "paper": paper_sized(load_recipe(recipe)),
            "ten": engine_on(bundle, num_steps=10, threads=threads),
            "one": engine_on(bundle, num_steps=1, threads=threads),
        },
        rounds=rounds,
    )
    starts = [cold_start(port + index) for index in range(3)]
    print(f"N = {NUM_SAMPLES}, {threads} threads, medians of {rounds} interleaved rounds\n")
    print("| | ms | ratio |\n|---|--:|--:|")
    print(f"| the paper's sizes in PyTorch eager, 10 steps | {found['paper']:.1f} | 1 |")
    print(
        f"| {bundle.name}, 10 steps | {found['ten']:.1f} | {found['paper'] / found['ten']:.1f} x |"
    )
    ratio = found["ten"] / found["one"]
    print(f"| {bundle.name}, 1 step | {found['one']:.1f} | {ratio:.1f} x faster than 10 steps |")
    print(f"| cold start to /readyz | {1e3 * statistics.median(starts):.0f} | |")


if __name__ == "__main__":
    typer.run(main)
