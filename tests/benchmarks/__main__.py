"""Measures what is wanted of the server, in interleaved rounds on two cores: ``make bench``.

In each round the paper's sizes in PyTorch, single requests and loads take turns, so that a machine
that slowly drifts drifts for all; a ratio is taken within a round, and the median of them is told.
"""

import os
import platform
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from statistics import mean, median
from typing import Annotated

import orjson
import torch
import typer
from benchmarks import actions
from benchmarks.baseline import paper_sized
from benchmarks.figures import (
    CLIENTS,
    LEAVING_SAMPLES,
    NUM_SAMPLES,
    Bench,
    Figures,
    figures_of_a_round,
)
from benchmarks.load import NICENESS, be_nice
from benchmarks.report import Row, markdown
from benchmarks.server import ROOT, serving

from models.bundle import read_manifest
from training.cli import load_recipe

RECIPE = "models.systems.belfusion.recipes:h36m"
BUNDLES = ROOT / "models/bundles"
BUNDLE = "belfusion"

HOW = f"""\
N = {NUM_SAMPLES} futures, all 10 steps where nothing else is said. The baseline is our recipe
`h36m`, the paper's sizes, in PyTorch eager on both cores: {NUM_SAMPLES} rows in one call, decoded
once. Medians of the ratios of {{rounds}} interleaved rounds. The server is `posefutures serve` in a
process of its own: with `POSEFUTURES_PROFILE=latency` for one request at a time, as it comes for
everything else. Load comes from one process on the same cores, nicer by {NICENESS}, which sends
bytes made beforehand and does not decode answers; /livez is probed from a third.
"""

BUSY = """\
**The machine was busy** (load average {busy:.1f} before): the baseline suffers from that more than
the server does, and the server's tails more than its medians. These figures say nothing.
"""
MAX_LOAD = 0.5


def main(
    *,
    quick: Annotated[bool, typer.Option(help="one short round, only printed")] = False,
    rounds: Annotated[int, typer.Option(min=1)] = 9,
    cores: Annotated[int, typer.Option(min=1, help="that everything runs on")] = 2,
    out: Annotated[Path, typer.Option(help="of benchmark.md and .json")] = ROOT / "docs",
) -> None:
    """Print the table, and write it."""
    rounds, singles, seconds = (1, 1, 1.0) if quick else (rounds, 3, 4.0)
    busy = os.getloadavg()[0]
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    torch.set_num_threads(cores)
    found, peak_mb, start_s = measured(rounds, singles=singles, seconds=seconds)
    manifest = read_manifest(BUNDLES / BUNDLE)
    rows = table(found, peak_mb=peak_mb, start_s=start_s)
    performed = actions.table(BUNDLES / "wat", rounds=1 if quick else 25, cores=cores)
    machine = f"{cores} cores of {processor()}, {datetime.now(UTC):%Y-%m-%d}"
    text = "\n".join(
        [
            "# Benchmark\n",
            f"`make bench` on {machine}; bundle {manifest.name} {manifest.digest}.\n",
            HOW.format(rounds=rounds),
            *([BUSY.format(busy=busy)] if busy > MAX_LOAD else []),
            markdown(rows),
            f"\n{NUM_SAMPLES} futures that perform an action; the same network on either side:\n",
            "| | ms | ratio |\n|---|--:|--:|",
            *(f"| {name} | {ms:.1f} | {ratio} |" for name, ms, ratio in performed),
        ]
    )
    print(text)
    if not quick:
        (out / "benchmark.md").write_text(text + "\n")
        record = {
            "machine": machine,
            "bundle": manifest.name,
            "digest": manifest.digest,
            "rows": [row.record() for row in rows],
            "rounds": found,
            "actions": [{"name": name, "ms": ms} for name, ms, _ in performed],
        }
        options = orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE
        (out / "benchmark.json").write_bytes(orjson.dumps(record, option=options))


def measured(rounds: int, *, singles: int, seconds: float) -> tuple[list[Figures], float, float]:
    """The figures of each round, the peak memory of the server in MB, and seconds to its start."""
    context = get_context("spawn")
    with ExitStack() as stack:
        bench = Bench(
            paper=paper_sized(load_recipe(RECIPE), num_samples=NUM_SAMPLES),
            latency=stack.enter_context(serving(default_model=BUNDLE, profile="latency")),
            throughput=(server := stack.enter_context(serving(default_model=BUNDLE))),
            loader=stack.enter_context(
                ProcessPoolExecutor(1, mp_context=context, initializer=be_nice)
            ),
            prober=stack.enter_context(ProcessPoolExecutor(1, mp_context=context)),
            singles=singles,
            seconds=seconds,
        )
        bench.paper()
        found = []
        for index in range(rounds):
            typer.echo(f"round {index + 1} of {rounds}", err=True)
            found.append(figures_of_a_round(bench))
        return found, server.peak_memory_mb(), server.start_s


def table(rounds: list[Figures], *, peak_mb: float, start_s: float) -> list[Row]:
    """The rows of issue 4, and what else is worth knowing."""
    mid = {name: median(figures[name] for figures in rounds) for name in rounds[0]}
    share = {name: mean(figures[name] for figures in rounds) for name in ("in_time", "polite")}
    left = max(figures["steps_after_leaving"] for figures in rounds)
    since = max(figures["steps_since_look"] for figures in rounds)
    faster, times, percent = "{:.1f} x", "{:.2f}", "{:.1%}"
    return [
        Row(name="one request, compute", wanted=14, value=mid["compute"], form=faster,
            note=f"{mid['binary_engine_ms']:.1f} ms; the baseline {mid['paper_ms']:.0f} ms"),
        Row(name="one request through HTTP, binary", wanted=13, value=mid["over_binary"],
            form=faster, note=f"{mid['binary_ms']:.1f} ms"),
        Row(name="one request through HTTP, JSON", wanted=9, value=mid["over_json"], form=faster,
            note=f"{mid['json_ms']:.1f} ms"),
        Row(name="the same, binary, profile `throughput`", value=mid["shared_over_binary"],
            form=faster, note=f"{mid['shared_ms']:.1f} ms"),
        Row(name="one denoising step, of ten", wanted=0.25, value=mid["one_step"], form=times,
            sense="at most", note=f"{mid['one_step_engine_ms']:.1f} ms, compute"),
        Row(name=f"throughput, {CLIENTS} clients, against 1 / baseline", wanted=25,
            value=mid["throughput"], form=faster,
            note=f"{mid['per_s']:.0f} requests/s; CPU time of each "
            f"{mid['crowd_server_ms']:.1f} ms, of the load {mid['crowd_load_ms']:.1f} ms"),
        Row(name=f"p99 / p50 at {CLIENTS} clients of equal requests", wanted=1.3,
            value=mid["spread"], form=times, sense="at most",
            note=f"p50 {mid['crowd_p50_ms']:.0f} ms"),
        Row(name=f"a 1-step request among {CLIENTS} ten-step ones waits, in step times", wanted=2,
            value=mid["wait_steps"], form=times, sense="at most",
            note=f"p99 until its first step; a step of {NUM_SAMPLES} rows is "
            f"{mid['step_ms']:.1f} ms; answered {mid['later_steps']:.1f} step times later than "
            "alone (median)"),
        Row(name="goodput at 10 x overload, of capacity", wanted=0.95, value=mid["goodput"],
            form=percent, note=f"offered {mid['offered']:.1f} x; the server has "
            f"{mid['overload_server_s']:.2f} cores, the load {mid['overload_load_s']:.2f}"),
        Row(name="refusals that are a 429 with Retry-After", wanted=1.0, value=share["polite"],
            form=percent),
        Row(name="feasible deadlines met, on the client's clock", wanted=0.99,
            value=share["in_time"], form=percent,
            note=f"among {CLIENTS} others; from the p99 of a 1-step request to the p50 of a "
            "ten-step one, in that crowd; the client itself waits "
            f"{mid['in_time_late_ms']:.1f} ms for a core for each answer"),
        Row(name="steps still computed after a disconnect", wanted=1, value=left, form=times,
            sense="at most",
            note=f"the worst, by the server's count; {LEAVING_SAMPLES} futures; since the client's "
            f"last look at its metrics {since:.1f}"),
        Row(name="peak memory of the server", wanted=400, value=peak_mb, form="{:.0f} MB",
            sense="at most", note="VmHWM, after all of this"),
        Row(name=f"/livez, p99 at {CLIENTS} clients", wanted=5, value=mid["livez_p99_ms"],
            form="{:.1f} ms", sense="at most",
            note=f"{mid['overloaded_livez_p99_ms']:.1f} ms at 10 x overload"),
        Row(name="cold start to /readyz", value=1e3 * start_s, form="{:.0f} ms"),
    ]  # fmt: skip


def processor() -> str:
    """The name of the processor."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(": ", 1)[1] for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


if __name__ == "__main__":
    typer.run(main)
