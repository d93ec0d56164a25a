"""Measures how often regions hold the truth, and how much wider they must be to do so as said."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from tqdm import tqdm

from models.bundle import CalibrationSpec, Manifest, read_manifest, write_calibration
from service.answers.quantiles import regions, widening
from service.engine.engine import Engine
from service.engine.runner import Runner
from training.data.corpora import take_name
from training.data.store import Store
from training.evaluate import (
    Cutting,
    EvaluateError,
    Group,
    common_shape,
    cut_group,
    learnt_from,
    trained_on,
)
from training.predictors import BundlePredictor
from training.tables import heading, table

LEVELS = (0.5, 0.8, 0.9, 0.95)
NUM_TIMES = 12
NUM_SPLITS = 20

Reaches = Float[np.ndarray, "B L H J"]
"""How many radii of each level's region the true joint is from its centre."""

COLUMNS: tuple[tuple[str, str], ...] = (
    ("clips", "{clips}"),
    ("takes", "{takes}"),
    ("windows", "{windows}"),
    ("level", "{level:.0%}"),
    ("covered before", "{before:.1%}"),
    ("covered after", "{after:.1%}"),
    ("lowest", "{lowest:.1%}"),
    ("highest", "{highest:.1%}"),
    ("radius before, m", "{radius_before:.3f}"),
    ("radius after, m", "{radius_after:.3f}"),
)
LEGEND = f"""\
Covered: share of the true joints, over windows and frames, that are inside their region. After, on
the clips that calibrate: what the factors of one half of the takes cover of the other half, as
mean, lowest and highest of {NUM_SPLITS} drawn halves. The bundle keeps the factors of all takes;
on other clips it is those that are measured. Radii are means over windows, frames and joints."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Coverage:
    """How often the regions of a level hold the truth on some clips."""

    clips: str
    takes: int
    windows: int
    level: float
    before: float
    after: float
    radius_before: float
    radius_after: float
    lowest: float | None = None
    highest: float | None = None

    def values(self) -> dict[str, Any]:
        """What the table shows of it."""
        return {key: x for key, x in dataclasses.asdict(self).items() if x is not None}


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibrated:
    """What a bundle's manifest now says, and how often its regions hold the truth."""

    command: str
    protocol: Mapping[str, Any]
    manifest: Manifest
    coverage: tuple[Coverage, ...]

    def __str__(self) -> str:
        lines = heading(self.command, self.protocol, LEGEND)
        return "\n".join([*lines, "", *table(COLUMNS, (row.values() for row in self.coverage))])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Measured:
    clips: str
    takes: Int[np.ndarray, "B"]
    """Which take each window is of."""
    reaches: Reaches
    radii: Float[np.ndarray, "L H"]
    """Before any factor, mean over windows and joints."""


def calibrate(  # noqa: PLR0913  # a measurement's protocol, spelled out
    folder: Path,
    store: Store,
    hold: Sequence[str],
    *,
    groups: Mapping[str, Sequence[str]],
    num_samples: int = 50,
    stride: int = 15,
    max_windows: int = 600,
    seed: int = 0,
    command: str = "",
) -> Calibrated:
    """Write into a bundle's manifest the factors by which its regions hold as much as they say.

    Split conformal prediction (Lei et al. 2018): a factor is the level's quantile of how many radii
    the true joints are away, over windows, joints and the frames about a time.

    Args:
        folder: of the bundle.
        store: where windows are cut.
        hold: selectors of the clips to calibrate on.
        groups: selectors of other clips to report on, by the name of their group.
        num_samples: futures for each observation.
        stride: frames between windows of a clip.
        max_windows: windows to calibrate on, and of each group, evenly spread.
        seed: of the first window's samples, each later one having the next, and of the halves.
        command: what was typed; it stands at the head of the table.

    Raises:
        EvaluateError: bundle and store do not fit, the bundle has learnt some of the clips, there
            are too few takes or windows, or all samples are alike.
        BundleError: the bundle cannot be used.
        StoreError: a selector is wrong, or no clip is long enough.
        ServiceError: the bundle cannot be run, or not without actions, or the samples are too few.
    """
    manifest = read_manifest(folder)
    num_observed, horizon = common_shape([manifest], store)
    cutting = Cutting(
        num_observed=num_observed, horizon=horizon, stride=stride, max_windows=max_windows
    )
    tests = [
        cut_group(name, chosen, store, cutting)
        for name, chosen in {", ".join(hold): hold, **groups}.items()
    ]
    for test in tests:
        _refuse_learnt(test, manifest, store)
    predict = BundlePredictor(
        engine=Engine(Runner(manifest, folder, threads=1)),
        num_samples=num_samples,
        num_steps=None,
        seed=seed,
    )
    held_out, *others = [_measured(test, predict) for test in tests]

    def fitted(reaches: Reaches) -> CalibrationSpec:
        return _fitted(reaches, fps=manifest.fps, num_samples=num_samples, measured_on=hold)

    calibration = fitted(held_out.reaches)
    widths = _factors(calibration, manifest)
    halves = [
        _covered(held_out.reaches[~half], _factors(fitted(held_out.reaches[half]), manifest))
        for half in _halves(held_out.takes, np.random.default_rng(seed))
    ]
    rows = [*_coverage(held_out, widths, np.array(halves))]
    for other in others:
        rows += _coverage(other, widths, _covered(other.reaches, widths)[None])
    return Calibrated(
        command=command,
        protocol={"num_samples": num_samples, "seed": seed, **dataclasses.asdict(cutting)},
        manifest=write_calibration(folder, calibration),
        coverage=tuple(rows),
    )


def _refuse_learnt(group: Group, manifest: Manifest, store: Store) -> None:
    learnt = trained_on(group.owners, store, learnt_from(manifest, store))
    if learnt:
        raise EvaluateError(
            f"{group.name}: {manifest.name} was trained on {learnt:.0%} of these windows; "
            "they must be of clips that it has not learnt."
        )


def _measured(group: Group, predict: BundlePredictor) -> _Measured:
    reaches, radii = [], []
    answers = predict(group.windows.observations, ("observed",))
    progress = tqdm(answers, total=len(group.owners), desc=group.name, disable=None)
    fps = predict.engine.manifest.fps
    for answer, future in zip(progress, group.windows.futures, strict=True):
        found = regions(answer["observed"], fps=fps, calibration=None, levels=LEVELS)
        away = np.linalg.norm(future - found.centre, axis=-1)
        beyond = np.where(away > 0, np.inf, np.zeros_like(found.radius))
        reaches.append(np.divide(away, found.radius, out=beyond, where=found.radius > 0))
        radii.append(found.radius.mean(axis=-1))
    names = [take_name(clip.name) for clip in group.owners]
    return _Measured(
        clips=group.name,
        takes=np.unique(names, return_inverse=True)[1],
        reaches=np.stack(reaches),
        radii=np.mean(radii, axis=0),
    )


def _fitted(
    reaches: Reaches, *, fps: float, num_samples: int, measured_on: Sequence[str]
) -> CalibrationSpec:
    """Factors at times that lie closer together at first, where regions grow fastest."""
    horizon = reaches.shape[2]
    edges = np.unique(np.rint(horizon * np.linspace(0, 1, NUM_TIMES + 1) ** 2).astype(int))
    factors = [
        [
            round(float(np.quantile(reaches[:, index, start:end], level, method="higher")), 4)
            for start, end in pairwise(edges)
        ]
        for index, level in enumerate(LEVELS)
    ]
    if not np.isfinite(factors).all():
        raise EvaluateError("samples: found them all alike; no factor makes such regions wider.")
    return CalibrationSpec(
        levels=LEVELS,
        times_s=tuple(np.round((edges[:-1] + edges[1:] + 1) / 2 / fps, 4).tolist()),
        factors=tuple(map(tuple, factors)),
        num_samples=num_samples,
        num_windows=len(reaches),
        measured_on=tuple(measured_on),
    )


def _factors(calibration: CalibrationSpec, manifest: Manifest) -> Float[np.ndarray, "L H"]:
    return widening(calibration, calibration.levels, num_frames=manifest.horizon, fps=manifest.fps)


def _covered(reaches: Reaches, factors: Float[np.ndarray, "L H"]) -> Float[np.ndarray, "L"]:
    return np.asarray((reaches <= factors[:, :, None]).mean(axis=(0, 2, 3)))


def _halves(takes: Int[np.ndarray, "B"], generator: np.random.Generator) -> Iterator[np.ndarray]:
    """True for the windows of one half of the takes, drawn anew each time."""
    count = takes.max() + 1
    if count < 2:
        raise EvaluateError("hold: found a single take; one must calibrate and another report.")
    for _ in range(NUM_SPLITS):
        yield np.isin(takes, generator.permutation(count)[: count // 2])


def _coverage(
    measured: _Measured, factors: Float[np.ndarray, "L H"], after: Float[np.ndarray, "draws L"]
) -> Iterator[Coverage]:
    before = _covered(measured.reaches, np.ones_like(factors))
    drawn = len(after) > 1
    for index, level in enumerate(LEVELS):
        yield Coverage(
            clips=measured.clips,
            takes=int(measured.takes.max()) + 1,
            windows=len(measured.takes),
            level=level,
            before=float(before[index]),
            after=float(after[:, index].mean()),
            lowest=float(after[:, index].min()) if drawn else None,
            highest=float(after[:, index].max()) if drawn else None,
            radius_before=float(measured.radii[index].mean()),
            radius_after=float((measured.radii * factors)[index].mean()),
        )
