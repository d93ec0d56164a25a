"""What running fewer of a bundle's denoising steps costs, and what it saves."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from tqdm import tqdm

from models.bundle import read_manifest
from service.answers.quantiles import regions
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Request
from training.contact_sheet import save_small
from training.data.store import Store
from training.evaluate import Cutting, Group, common_shape, cut_group, learnt_from, trained_on
from training.predictors import BundlePredictor
from training.scores import Row, Scorer
from training.tables import MISSING, Report, heading, percent, table

COVERED_LEVEL = 0.9
MOST_EACH = 10
COLUMNS: tuple[tuple[str, str], ...] = (
    ("steps", "{name}"),
    ("ADE", "{ade:.3f} ({ade_ratio:.3f})"),
    ("FDE", "{fde:.3f} ({fde_ratio:.3f})"),
    ("world ADE", "{world_ade:.3f} ({world_ade_ratio:.3f})"),
    ("world FDE", "{world_fde:.3f} ({world_fde_ratio:.3f})"),
    ("APD", "{apd:.2f}"),
    ("CMD", "{cmd:.2f}"),
    ("90 % region covers", "{covered:.1%}"),
    ("engine, core ms", "{milliseconds:.1f}"),
    ("of all steps' time", "{share_of_time:.2f}"),
)
LEGEND = """\
In brackets after an error: its ratio to that of all steps. ADE and FDE in metres, best of the
samples, a pose as one vector: relative to the root without it, or all joints in the world. APD in
metres. CMD with the action as class. Covered: share of the true joints in their region, as the
bundle is calibrated with all steps. Engine: of one request on one core, the time that the core
worked for it, whatever else ran; median of rounds in which the numbers of steps take turns, and its
share of what all steps took in the same round."""
PANELS = (("ade", "ADE, m"), ("fde", "FDE, m"), ("apd", "APD, m"), ("cmd", "CMD"))


@dataclass(frozen=True, kw_only=True, slots=True)
class StepCurve(Report[Row]):
    """A row for each number of steps, the last being all of them."""

    def markdown(self) -> str:
        """One table."""
        rows = (row.values() for row in self.rows)
        lines = [*heading(self.command, self.protocol, LEGEND), "", *table(COLUMNS, rows)]
        return "\n".join(lines) + "\n"

    def figure(self) -> Figure:
        """Each quality against the steps, and below against the time."""
        figure = Figure(figsize=(14, 6), layout="constrained")
        axes = (("name", "steps"), ("milliseconds", "engine, core ms"))
        grid = figure.subplots(len(axes), len(PANELS), sharey="col")
        for line, (across, label) in zip(grid, axes, strict=True):
            x = [float(row.values()[across]) for row in self.rows]
            for panel, (key, title) in zip(line, PANELS, strict=True):
                y = [row.scores[key] for row in self.rows]
                panel.plot(x, y, marker="o")
                panel.set_xlabel(label)
                panel.set_title(title)
                panel.set_ylim(0, 1.2 * max(y))
                panel.grid(alpha=0.3)
        return figure


def step_curve(  # noqa: PLR0913  # a measurement's protocol, spelled out
    folder: Path,
    store: Store,
    hold: Sequence[str],
    *,
    out: Path,
    num_samples: int = 50,
    stride: int = 15,
    max_windows: int = 200,
    rounds: int = 25,
    seed: int = 0,
    command: str = "",
) -> StepCurve:
    """Score and time a bundle with few to all of its steps; write Markdown, JSON and a picture.

    Args:
        folder: of the bundle.
        store: where windows are cut.
        hold: selectors of the clips to score on.
        out: folder of the files ``steps_<bundle>`` .md, .json and .png.
        num_samples: futures for each observation.
        stride: frames between windows of a clip.
        max_windows: windows to score, evenly spread.
        rounds: how often each number of steps is timed.
        seed: of the first window's samples; each later one has the next.
        command: what was typed; it stands at the head of the table.

    Raises:
        EvaluateError: bundle and store do not fit, or no clip is selected.
        BundleError: the bundle cannot be used.
        StoreError: a selector is wrong, or no clip is long enough.
        ServiceError: the bundle cannot be run, or not without actions.
    """
    manifest = read_manifest(folder)
    num_observed, horizon = common_shape([manifest], store)
    cutting = Cutting(
        num_observed=num_observed, horizon=horizon, stride=stride, max_windows=max_windows
    )
    group = cut_group(", ".join(hold), hold, store, cutting)
    engine = Engine(Runner(manifest, folder, threads=1))
    seconds = _timed(engine, group, num_samples=num_samples, rounds=rounds)
    shares = np.median(seconds / seconds[:, -1:], axis=0)
    calibration = manifest.calibration
    trained = trained_on(group.owners, store, learnt_from(manifest, store))
    rows = []
    counts = step_counts(manifest.num_steps)
    for index, (count, median) in enumerate(zip(counts, np.median(seconds, axis=0), strict=True)):
        ask = BundlePredictor(engine=engine, num_samples=num_samples, num_steps=count, seed=seed)
        scores = _scores(ask, group, store) | {
            "milliseconds": 1000 * float(median),
            "share_of_time": float(shares[index]),
        }
        rows.append(
            Row(
                group=group.name,
                bone_lengths="observed",
                name=f"{count}",
                windows=len(group.owners),
                scores=scores,
                trained_on=trained,
            )
        )
    protocol = {
        "clips": group.name,
        "windows": len(group.owners),
        "trained_on": percent(trained),
        "calibrated_on": ", ".join(calibration.measured_on) if calibration else MISSING,
        "num_samples": num_samples,
        "rounds": rounds,
        "seed": seed,
        **dataclasses.asdict(cutting),
    }
    curve = StepCurve(
        command=command,
        protocol=protocol,
        rows=tuple(row.with_ratios(rows[-1]) for row in rows),
    )
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"steps_{manifest.name}"
    path.with_suffix(".json").write_text(curve.json())
    path.with_suffix(".md").write_text(curve.markdown())
    save_small(curve.figure(), path.with_suffix(".png"))
    return curve


def step_counts(num_steps: int) -> tuple[int, ...]:
    """Numbers of steps to look at, the last being all: each one up to ten, else 1, 2, 5, 10, …"""
    if num_steps <= MOST_EACH:
        return tuple(range(1, num_steps + 1))
    round_numbers = (m * 10**power for power in range(6) for m in (1, 2, 5))
    return (*(count for count in round_numbers if count < num_steps), num_steps)


def _timed(
    engine: Engine, group: Group, *, num_samples: int, rounds: int
) -> Float[np.ndarray, "rounds K"]:
    """Core seconds of a request by itself, for each number of steps; a first round is not kept."""
    counts = step_counts(engine.manifest.num_steps)
    seconds = np.empty((rounds + 1, len(counts)))
    for turn in range(rounds + 1):
        observation = group.windows.observations[turn % len(group.owners)]
        for index, count in enumerate(counts):
            request = Request(observation=observation, num_samples=num_samples, num_steps=count)
            started_s = process_time()
            predict(engine, request)
            seconds[turn, index] = process_time() - started_s
    return seconds[1:]


def _scores(ask: BundlePredictor, group: Group, store: Store) -> dict[str, float]:
    manifest = ask.engine.manifest
    scorer, inside = Scorer(group.windows, store.skeleton), []
    answers = ask(group.windows.observations, ("observed",))
    progress = tqdm(answers, total=len(group.owners), desc=f"{ask.num_steps} steps", disable=None)
    for answer, future in zip(progress, group.windows.futures, strict=True):
        futures = answer["observed"]
        scorer.add(futures)
        found = regions(
            futures, fps=manifest.fps, calibration=manifest.calibration, levels=(COVERED_LEVEL,)
        )
        inside.append((np.linalg.norm(future - found.centre, axis=-1) <= found.radius[0]).mean())
    return scorer.means() | {"covered": float(np.mean(inside))}
