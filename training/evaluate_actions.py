"""Measures bundles that perform actions on held-out clips, through the service's engine."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from models.bundle import Manifest
from service.engine.engine import Engine
from service.engine.runner import Runner
from service.engine.trajectory import Request, Result
from training.action_classifier import Judge
from training.action_scores import (
    ActionEvaluation,
    ActionRow,
    ActionScorer,
    Performance,
    RealActions,
    inner_changes,
)
from training.data.batches import training_clips
from training.data.store import ClipRecord, Store, select
from training.evaluate import EvaluateError, common_shape, learnt_from, trained_on

JSON_FILE, TABLE_FILE = "evaluation_actions.json", "evaluation_actions.md"
SHORTEST_FUTURE = 3
"""Frames: as many as a change of velocity has."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _RealAction:
    """A labelled clip: its first frames, and what is left of it, as long as bundles predict."""

    label: int
    clip: ClipRecord
    observation: Float[np.ndarray, "T J 3"]
    future: Float[np.ndarray, "_ J 3"]


def evaluate_actions(  # noqa: PLR0913  # an evaluation's protocol, spelled out
    bundles: Sequence[tuple[Path, Manifest]],
    store: Store,
    judge: Judge,
    *,
    out: Path,
    hold: Sequence[str] = (),
    command: str = "",
    num_samples: int = 10,
    num_histories: int = 60,
    actions_in_sequence: int = 5,
    seed: int = 0,
    threads: int = 2,
) -> ActionEvaluation:
    """Score bundles beside the real held-out clips; write a JSON and Markdown tables.

    Args:
        bundles: folders and manifests, for the store's skeleton, of one observation and horizon.
        store: where histories and real actions are taken from.
        judge: the classifier of the bundles' labels, from the clips that it was trained on.
        out: folder for the two files.
        hold: selectors of the clips to evaluate on; by default those that the judge held out.
        command: what was typed; it stands at the head of the table.
        num_samples: futures of each history and action.
        num_histories: the first frames of held-out clips, evenly spread over the actions.
        actions_in_sequence: random actions that are performed one after another.
        seed: of the first history; each later one has the next.
        threads: of the engine.

    Raises:
        EvaluateError: bundles, judge and store do not fit, or no labelled clip is held out.
        StoreError: a selector is wrong.
        EngineError: a bundle cannot be run.
    """
    num_observed, horizon = common_shape([manifest for _, manifest in bundles], store)
    for _, manifest in bundles:
        _require_labels(manifest, judge)
    chosen = select(store.clips, tuple(hold) or judge.data.hold_out)
    held_out = _real_actions(chosen, store, judge, num_observed=num_observed, horizon=horizon)
    if not held_out:
        raise EvaluateError("hold: found no labelled clip that is long enough; choose others.")
    learnt = _real_actions(
        training_clips(store, judge.data), store, judge, num_observed=num_observed, horizon=horizon
    )
    spread = np.linspace(0, len(held_out) - 1, min(num_histories, len(held_out)))
    study = _Study(
        judge=judge,
        store=store,
        horizon=horizon,
        histories=tuple(held_out[i] for i in spread.round().astype(int)),
        num_samples=num_samples,
        actions_in_sequence=actions_in_sequence,
        seed=seed,
    )
    real, row = _reality(study, held_out, learnt)
    rows = [row]
    owners = [action.clip for action in held_out]
    for folder, manifest in bundles:
        engine = Engine(Runner(manifest, folder, threads=threads))
        known = trained_on(owners, store, learnt_from(manifest, store))
        rows.append(_row(study, engine, real, trained=known))
    protocol = {
        "num_samples": num_samples,
        "num_histories": len(study.histories),
        "held-out clips": len(held_out),
        "training clips": len(learnt),
        "actions": len(judge.labels),
        "seed": seed,
        "num_observed": num_observed,
        "horizon": horizon,
    }
    evaluation = ActionEvaluation(command=command, protocol=protocol, rows=tuple(rows))
    out.mkdir(parents=True, exist_ok=True)
    (out / JSON_FILE).write_text(evaluation.json())
    (out / TABLE_FILE).write_text(evaluation.markdown())
    return evaluation


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Study:
    """What every bundle is asked, and who judges."""

    judge: Judge
    store: Store
    horizon: int
    histories: tuple[_RealAction, ...]
    num_samples: int
    actions_in_sequence: int
    seed: int

    def scorer(self) -> ActionScorer:
        return ActionScorer(self.judge, skeleton=self.store.skeleton, longest=self.horizon)

    def named(self, by_label: Mapping[int, dict[str, float]]) -> dict[str, dict[str, float]]:
        names = tuple(self.judge.labels)
        return {names[label]: values for label, values in by_label.items()}

    def sequences(self) -> list[list[int]]:
        """Labels to perform one after another, for each history."""
        generator = np.random.default_rng(self.seed)
        shape = (len(self.histories), self.actions_in_sequence)
        drawn: list[list[int]] = generator.integers(len(self.judge.labels), size=shape).tolist()
        return drawn


def _require_labels(manifest: Manifest, judge: Judge) -> None:
    if manifest.actions is None:
        raise EvaluateError(
            f"{manifest.name}: it performs no actions; evaluate it with the evaluate command."
        )
    if set(manifest.actions.labels) != set(judge.labels):
        raise EvaluateError(
            f"{manifest.name}: found the actions {', '.join(manifest.actions.labels)}; "
            f"the classifier knows {', '.join(judge.labels)}."
        )


def _real_actions(
    clips: Iterable[ClipRecord], store: Store, judge: Judge, *, num_observed: int, horizon: int
) -> tuple[_RealAction, ...]:
    """The labelled clips that are long enough, label by label."""
    owned = tuple(clip for clip in clips if clip.length >= num_observed + SHORTEST_FUTURE)
    found = []
    for label, selectors in enumerate(judge.labels.values()):
        for clip in select(owned, selectors):
            poses = np.asarray(store.clip_positions(clip)[: num_observed + horizon], np.float32)
            found.append(
                _RealAction(
                    label=label,
                    clip=clip,
                    observation=poses[:num_observed],
                    future=poses[num_observed:],
                )
            )
    return tuple(found)


def _reality(
    study: _Study, held_out: Sequence[_RealAction], learnt: Sequence[_RealAction]
) -> tuple[RealActions, ActionRow]:
    """The real clips as what predictions are held against, and as a row of their own."""
    scorer = study.scorer()
    for performance in _performed(held_out):
        scorer.add(performance)
    trained = study.scorer()
    for performance in _performed(learnt):
        trained.add(performance)
    changes = np.concatenate([inner_changes(action.future) for action in held_out])
    real = RealActions(
        by_label=scorer.by_label(),
        features={"train": trained.recognised(), "held_out": scorer.recognised()},
        velocity_change=float(changes.mean()),
    )
    scores, by_label = real.compare(scorer)
    return real, ActionRow(name="real", scores=scores, by_label=study.named(by_label))


def _performed(actions: Sequence[_RealAction]) -> Iterator[Performance]:
    """Of every action and style: a history shows its style, and a person keeps it."""
    groups: dict[tuple[int, str], list[_RealAction]] = {}
    for action in actions:
        groups.setdefault((action.label, action.clip.style), []).append(action)
    for (label, _), mine in groups.items():
        yield Performance(
            label=label,
            histories=np.stack([action.observation for action in mine]),
            futures=tuple(action.future for action in mine),
        )


def _row(study: _Study, engine: Engine, real: RealActions, *, trained: float | None) -> ActionRow:
    """What one bundle makes of single actions and of sequences of them."""
    name = engine.manifest.name
    labels = range(len(study.judge.labels))
    asked = [(i, [label]) for i in range(len(study.histories)) for label in labels]
    scorer = study.scorer()
    for i, (performance,) in _performances(study, engine, asked, description=f"{name}: actions"):
        history = study.histories[i]
        own = performance.label == history.label
        scorer.add(performance, real=history.future if own else None)
    steps = [study.scorer() for _ in range(study.actions_in_sequence)]
    sequences = list(enumerate(study.sequences()))
    for _, performances in _performances(
        study, engine, sequences, description=f"{name}: sequences"
    ):
        for step, performance in zip(steps, performances, strict=True):
            step.add(performance)
    scores, by_label = real.compare(scorer)
    return ActionRow(
        name=name,
        scores=scores,
        by_label=study.named(by_label),
        steps=tuple(real.compare(step)[0] for step in steps),
        trained_on=trained,
    )


def _performances(
    study: _Study,
    engine: Engine,
    asked: Sequence[tuple[int, list[int]]],
    *,
    description: str,
) -> Iterator[tuple[int, list[Performance]]]:
    """For histories by index and labels to perform: the index, and a performance of each label."""
    known = engine.manifest.actions.labels if engine.manifest.actions else ()
    own = [known.index(label) for label in study.judge.labels]
    requests = (
        Request(
            observation=study.histories[i].observation,
            num_samples=study.num_samples,
            seed=study.seed + i,
            actions=tuple(own[label] for label in labels),
        )
        for i, labels in asked
    )
    results = tqdm(engine.run(requests), total=len(asked), desc=description, disable=None)
    for (i, labels), result in zip(asked, results, strict=True):
        yield i, _split(study.histories[i].observation, result, labels)


def _split(
    observation: Float[np.ndarray, "T J 3"], result: Result, labels: Sequence[int]
) -> list[Performance]:
    """The performance of each label in turn, its histories the frames before it."""
    num_observed = len(observation)
    whole = [np.concatenate([observation, future]) for future in result.futures]
    performances = []
    for label, segments in zip(labels, zip(*result.segments, strict=True), strict=True):
        pairs = list(zip(whole, segments, strict=True))
        performances.append(
            Performance(
                label=label,
                histories=np.stack([one[s.start : s.start + num_observed] for one, s in pairs]),
                futures=tuple(
                    one[num_observed + s.start : num_observed + s.end] for one, s in pairs
                ),
                stopped=tuple(s.stopped for s in segments),
            )
        )
    return performances
