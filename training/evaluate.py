"""Measures bundles and reference forecasts on a store's clips, through the service's engine."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from models.bundle import Manifest
from models.system import Data
from service.engine.engine import Engine
from service.engine.runner import Runner
from service.futures import BoneLengths
from training.contact_sheet import save_small
from training.data.batches import described_data, training_clips
from training.data.store import ClipRecord, Store, select
from training.data.windows import Windows, cut
from training.predictors import (
    BundlePredictor,
    Extrapolation,
    Predictor,
    Retrieval,
    carried_on,
    held,
)
from training.scores import Evaluation, Row, Scorer, TestWindows
from training.validity import validity_figure

RETRIEVAL_STRIDE = 2
REFERENCE = "zero velocity"
JSON_FILE, TABLE_FILE, VALIDITY_FILE = "evaluation.json", "evaluation.md", "validity.png"


class EvaluateError(Exception):
    """Bundles, store and groups do not fit each other."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Cutting:
    """How windows are cut from clips, in frames; of more than ``max_windows``, an even spread."""

    num_observed: int
    horizon: int
    stride: int
    max_windows: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Group:
    """Windows of some clips, to be asked for."""

    name: str
    windows: TestWindows
    owners: tuple[ClipRecord, ...]
    """The clip of each window."""


def evaluate(  # noqa: PLR0913  # an evaluation's protocol, spelled out
    bundles: Sequence[tuple[Path, Manifest]],
    store: Store,
    groups: Mapping[str, Sequence[str]],
    *,
    out: Path,
    command: str = "",
    num_samples: int = 50,
    num_steps: int | None = None,
    seed: int = 0,
    stride: int = 15,
    max_windows: int = 300,
    bone_lengths: Sequence[BoneLengths] = ("observed", "free"),
    threads: int = 2,
) -> Evaluation:
    """Score bundles, zero and constant velocity and retrieval; write JSON, a table and a plot.

    Args:
        bundles: folders and manifests, for the store's skeleton, of one observation and horizon.
        store: where windows are cut.
        groups: selectors of clips, by the name of their group.
        out: folder for the files; the plot is of body realism in the first group.
        command: what was typed; it stands at the head of the table.
        num_samples: futures for each observation; retrieval takes as many neighbours.
        num_steps: denoising steps to run; None runs as many as each bundle says.
        seed: of a group's first window; each later one has the next.
        stride: frames between windows of a clip.
        max_windows: windows of a group, evenly spread.
        bone_lengths: treatments of the futures' bones to report.
        threads: of the engine.

    Retrieval looks at the training clips of the bundles' recipes, without what any of them held
    out and without the evaluated clips themselves.

    Raises:
        EvaluateError: bundles and store do not fit, or nothing is left for retrieval.
        StoreError: a selector is wrong, or no clip of a group is long enough.
        EngineError: a bundle cannot be run.
    """
    num_observed, horizon = common_shape([manifest for _, manifest in bundles], store)
    cutting = Cutting(
        num_observed=num_observed, horizon=horizon, stride=stride, max_windows=max_windows
    )
    tests = [cut_group(name, chosen, store, cutting) for name, chosen in groups.items()]
    data = {manifest.name: learnt_from(manifest, store) for _, manifest in bundles}
    predictors: dict[str, Predictor] = {
        REFERENCE: Extrapolation(rule=held, skeleton=store.skeleton, horizon=horizon),
        "constant velocity": Extrapolation(
            rule=carried_on, skeleton=store.skeleton, horizon=horizon
        ),
        "retrieval": Retrieval(
            store=store,
            windows=_bank(store, data, tests, num_frames=num_observed + horizon),
            horizon=horizon,
            num_samples=num_samples,
        ),
    }
    for folder, manifest in bundles:
        predictors[manifest.name] = BundlePredictor(
            engine=Engine(Runner(manifest, folder, threads=threads)),
            num_samples=num_samples,
            num_steps=num_steps,
            seed=seed,
        )
    rows = [
        row
        for group in tests
        for row in _group_rows(group, predictors, store, tuple(bone_lengths), data)
    ]
    protocol = {
        "num_samples": num_samples,
        "num_steps": num_steps or "default",
        "seed": seed,
        **dataclasses.asdict(cutting),
    }
    evaluation = Evaluation(command=command, protocol=protocol, rows=tuple(rows))
    out.mkdir(parents=True, exist_ok=True)
    (out / JSON_FILE).write_text(evaluation.json())
    (out / TABLE_FILE).write_text(evaluation.markdown())
    if "free" in bone_lengths:
        first = (row for row in rows if row.group == tests[0].name)
        save_small(validity_figure(first), out / VALIDITY_FILE)
    return evaluation


def common_shape(manifests: Sequence[Manifest], store: Store) -> tuple[int, int]:
    """Observed frames and horizon of bundles that are evaluated together.

    Raises:
        EvaluateError: bundles and store do not fit.
    """
    if not manifests:
        raise EvaluateError("bundles: found none; there must be at least one to evaluate.")
    for manifest in manifests:
        if (manifest.skeleton.joints, manifest.fps) != (store.skeleton.joints, store.fps):
            raise EvaluateError(
                f"{manifest.name}: found {manifest.skeleton.name} at {manifest.fps:g} fps; the "
                f"store holds {store.skeleton.name} at {store.fps:g} fps."
            )
    shapes = {(manifest.num_observed, manifest.horizon) for manifest in manifests}
    if len(shapes) > 1:
        found = ", ".join(f"{seen} + {ahead}" for seen, ahead in sorted(shapes))
        raise EvaluateError(f"bundles: found {found} frames; evaluate those of one shape together.")
    return shapes.pop()


def cut_group(name: str, selectors: Sequence[str], store: Store, cutting: Cutting) -> Group:
    """Windows of the clips that are selected.

    Raises:
        EvaluateError: there are no such clips.
        StoreError: a selector is wrong, or no clip is long enough.
    """
    clips = select(store.clips, tuple(selectors))
    if not clips:
        raise EvaluateError(f"{name}: found no clip of this group in the store.")
    num_observed, num_frames = cutting.num_observed, cutting.num_observed + cutting.horizon
    windows = Windows.of(clips, num_frames=num_frames, stride=cutting.stride)
    count = min(cutting.max_windows, len(windows))
    indices = np.linspace(0, len(windows) - 1, count).round().astype(np.int64)
    poses = cut(store, windows, num_frames=num_frames, indices=indices)
    owners = tuple(clips[i] for i in windows.clip_index[indices])
    return Group(
        name=name,
        owners=owners,
        windows=TestWindows(
            observations=poses[:, :num_observed],
            futures=poses[:, num_observed:],
            classes=tuple(owner.action for owner in owners),
        ),
    )


def learnt_from(manifest: Manifest, store: Store) -> Data | None:
    """Which clips a bundle was trained on; None where its manifest does not say."""
    said: dict[str, Any] | None = manifest.recipe.get("data")
    if said is None or not manifest.recipe.get("stages"):
        return None
    return described_data(said, store, num_observed=manifest.num_observed, horizon=manifest.horizon)


def _bank(
    store: Store, data: Mapping[str, Data | None], tests: Sequence[Group], *, num_frames: int
) -> Windows:
    """The windows that retrieval may look at."""
    known = [one for one in data.values() if one is not None]
    pool = {clip for one in known for clip in training_clips(store, one)}
    if not known:
        pool = set(select(store.clips, ("split=train",)))
    held_out = {clip for one in known for clip in select(store.clips, one.hold_out)}
    tested = {owner for group in tests for owner in group.owners}
    clips = tuple(clip for clip in store.clips if clip in pool - held_out - tested)
    if not clips:
        raise EvaluateError(
            "retrieval: no training clip is left beside the evaluated ones; "
            "choose groups that leave some."
        )
    return Windows.of(clips, num_frames=num_frames, stride=RETRIEVAL_STRIDE)


def _group_rows(
    group: Group,
    predictors: Mapping[str, Predictor],
    store: Store,
    bones: Sequence[BoneLengths],
    data: Mapping[str, Data | None],
) -> Iterator[Row]:
    """A row for each predictor and treatment of bones, by treatment."""
    rows: dict[str, dict[str, Row]] = {kind: {} for kind in bones}
    for name, predictor in predictors.items():
        scorers = {kind: Scorer(group.windows, store.skeleton) for kind in bones}
        answers = predictor(group.windows.observations, bones)
        for answer in tqdm(
            answers, total=len(group.owners), desc=f"{group.name}: {name}", disable=None
        ):
            for kind, futures in answer.items():
                scorers[kind].add(futures)
        trained = trained_on(group.owners, store, data.get(name))
        for kind, scorer in scorers.items():
            rows[kind][name] = Row(
                group=group.name,
                bone_lengths=kind,
                name=name,
                windows=len(group.owners),
                scores=scorer.means(),
                trained_on=trained,
            )
    for mine in rows.values():
        yield from (row.with_ratios(mine[REFERENCE]) for row in mine.values())


def trained_on(owners: Sequence[ClipRecord], store: Store, data: Data | None) -> float | None:
    """The share of some clips that a bundle was trained on; None where that is not known."""
    if data is None:
        return None
    learnt = set(training_clips(store, data))
    return sum(owner in learnt for owner in owners) / len(owners)
