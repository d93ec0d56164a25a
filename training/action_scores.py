"""The scores of predicted actions, and the tables that show them."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from models.motion.skeleton import Skeleton
from training import metrics
from training.action_metrics import (
    displacement,
    diversity,
    pose_vectors,
    warped_displacement,
    warped_diversity,
)
from training.fid import fid
from training.tables import Report, heading, percent, table

COLUMNS: tuple[tuple[str, str], ...] = (  # heading, how a row shows it
    ("predictor", "{name}"),
    ("Acc % (x real)", "{accuracy:.1f} ({accuracy_ratio:.2f})"),
    ("FID train", "{fid_train:.2f}"),
    ("FID held out", "{fid_held_out:.2f}"),
    ("Div_w (x real)", "{div_w:.3f} ({div_w_ratio:.2f})"),
    ("Div", "{div:.3f}"),
    ("ADE_w", "{ade_w:.3f}"),
    ("ADE", "{ade:.3f}"),
    ("cut off %", "{cut_off:.1f}"),
    ("length off by % (worst)", "{length_off:.0f} ({length_off_worst:.0f})"),
    ("velocity change, x real", "{velocity_change_ratio:.2f}"),
    ("stretch %", "{stretch:.2f}"),
    ("trained on", "{trained_on}"),
)
LABEL_COLUMNS: tuple[tuple[str, str], ...] = (
    ("action", "{label}"),
    ("Acc %", "{accuracy:.1f}"),
    ("real Acc %", "{real_accuracy:.1f}"),
    ("Div_w", "{div_w:.3f}"),
    ("real Div_w", "{real_div_w:.3f}"),
    ("frames", "{frames:.0f}"),
    ("begun already", "{begun_frames:.0f}"),
    ("real frames", "{real_frames:.0f}"),
    ("off by %", "{length_off:.0f}"),
    ("cut off %", "{cut_off:.1f}"),
)
STEP_COLUMNS: tuple[tuple[str, str], ...] = (
    ("step", "{step}"),
    ("Acc %", "{accuracy:.1f}"),
    ("FID train", "{fid_train:.2f}"),
    ("FID held out", "{fid_held_out:.2f}"),
    ("Div_w", "{div_w:.3f}"),
    ("frames", "{frames:.0f}"),
    ("cut off %", "{cut_off:.1f}"),
    ("velocity change, x real", "{velocity_change_ratio:.2f}"),
)

LEGEND = """\
Every history is continued with every action; real: the held-out clips themselves. Acc: how many
observations with their futures the classifier takes for the action asked for. FID of its features
to those of real clips, all actions alike. Div, Div_w, ADE and ADE_w in metres, a pose as one
vector, relative to the root without it; Div holds the last pose to the longest future, _w is after
dynamic time warping; real Div_w is among clips of one action and style, predicted among futures of
one history. ADE where the action is the history's own, best of the samples. Cut off: not stopped by
itself at the longest. Length: the mean of an action that the history has begun already beside that
of the held-out clips, mean and worst action; frames are those after any history, most of which
have to get into the action first. Velocity change at the first predicted frame: times the real one,
mean of all frames. Stretch over all bones, no bone lengths fitted. Trained on: share of the
held-out clips that the bundle's training data hold. Means over actions, all alike."""

MOST_COMPARED = 16
"""Futures of which all pairs are compared; of more, so many are taken, evenly spread."""
SEQUENCES_KEPT = 256

Recognise = Callable[
    [Sequence[Float[np.ndarray, "_ J 3"]]],
    tuple[Float[np.ndarray, "N F"], Int[np.ndarray, "N"]],
]
"""Features of motions of any length, and the index of the label that each is taken for."""

Means = dict[str, float]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Performance:
    """Futures in which one action was asked for, each with the frames before it."""

    label: int
    histories: Float[np.ndarray, "S T J 3"]
    futures: tuple[Float[np.ndarray, "_ J 3"], ...]
    stopped: tuple[bool, ...] = ()
    """Which ended by themselves; real ones do not say."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Recognised:
    """Features of motions, and the action that each was asked for."""

    features: Float[np.ndarray, "N F"]
    labels: Int[np.ndarray, "N"]

    def balanced(self) -> "Recognised":
        """As many of every label as the most frequent one has; items of the others are repeated."""
        most = int(np.bincount(self.labels).max())
        chosen = [
            np.resize(np.flatnonzero(self.labels == label), most)
            for label in np.unique(self.labels)
        ]
        return self.only(np.concatenate(chosen))

    def of_labels(self, labels: Int[np.ndarray, "M"]) -> "Recognised":
        """Those of some labels."""
        return self.only(np.flatnonzero(np.isin(self.labels, labels)))

    def only(self, indices: Int[np.ndarray, "M"]) -> "Recognised":
        """Some items, by index."""
        return Recognised(features=self.features[indices], labels=self.labels[indices])


class ActionScorer:
    """Takes performances one at a time, so that their futures need not be kept."""

    def __init__(self, recognise: Recognise, *, skeleton: Skeleton, longest: int) -> None:
        self._recognise = recognise
        self._skeleton = skeleton
        self._longest = longest
        self._limbs = metrics.bones(skeleton.parents)
        self._items: list[tuple[int, Means]] = []
        self._waiting: list[np.ndarray] = []
        self._asked: list[int] = []
        self._found: list[np.ndarray] = []
        self._features: list[np.ndarray] = []

    def add(
        self, performance: Performance, *, real: Float[np.ndarray, "_ J 3"] | None = None
    ) -> None:
        """Score a performance, and its error where the real future is known."""
        histories, futures = performance.histories, performance.futures
        pairs = list(zip(histories, futures, strict=True))
        vectors = [pose_vectors(seen[-1], future, self._skeleton) for seen, future in pairs]
        item = {
            "frames": _mean([len(future) for future in futures]),
            "velocity_change": _mean([junction_change(*pair) for pair in pairs]),
            "stretch": _mean([self._stretch(*pair) for pair in pairs]),
        }
        if performance.stopped:
            item["cut_off"] = 100 * _mean([not stopped for stopped in performance.stopped])
        if len(vectors) > 1:
            compared = vectors[:: math.ceil(len(vectors) / MOST_COMPARED)]
            item["div"] = diversity(compared, longest=self._longest)
            item["div_w"] = warped_diversity(compared)
        if real is not None:
            item["begun_frames"] = item["frames"]
            truth = pose_vectors(histories[0, -1], real, self._skeleton)
            item["ade"] = displacement(vectors, truth)
            item["ade_w"] = warped_displacement(vectors, truth)
        self._items.append((performance.label, item))
        self._asked += [performance.label] * len(pairs)
        self._waiting += [np.concatenate(pair) for pair in pairs]
        if len(self._waiting) >= SEQUENCES_KEPT:
            self._judge()

    def recognised(self) -> Recognised:
        """Features and actions asked for of all futures, each with the frames before it."""
        self._judge()
        return Recognised(
            features=np.concatenate(self._features).astype(np.float64),
            labels=np.array(self._asked),
        )

    def by_label(self) -> dict[int, Means]:
        """Means over the performances of each action; what none of them has is left out."""
        self._judge()
        asked, found = np.array(self._asked), np.concatenate(self._found)
        result = {}
        for label in sorted(set(self._asked)):
            mine = [item for owner, item in self._items if owner == label]
            result[label] = _means(mine) | {
                "accuracy": 100 * float((found[asked == label] == label).mean())
            }
        return result

    def _judge(self) -> None:
        if self._waiting:
            features, found = self._recognise(self._waiting)
            self._features.append(features)
            self._found.append(found)
            self._waiting = []

    def _stretch(
        self, history: Float[np.ndarray, "T J 3"], future: Float[np.ndarray, "L J 3"]
    ) -> float:
        """In % of the lengths when last observed."""
        now = np.repeat(history[-1:], len(future), axis=0)
        mean, _ = metrics.limb_stretch(future[None, None], now[None], self._limbs)
        return float(mean[0])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RealActions:
    """What predicted actions are held against."""

    by_label: Mapping[int, Means]
    features: Mapping[str, Recognised]
    """Of the real clips, by the name of the set."""
    velocity_change: float
    """Mean of `metrics.velocity_change` over the frames of the held-out clips."""

    def compare(self, scorer: ActionScorer) -> tuple[Means, dict[int, Means]]:
        """The scores of predicted actions, and those of each action."""
        labels = scorer.by_label()
        for label in labels.keys() & self.by_label.keys():
            labels[label] |= _beside(labels[label], self.by_label[label])
        means = _means(list(labels.values()))
        means["velocity_change_ratio"] = means["velocity_change"] / self.velocity_change
        shared = [values for values in labels.values() if "real_frames" in values]
        for key in ("accuracy", "div_w"):
            both = [values for values in shared if f"real_{key}" in values and key in values]
            real = _mean([values[f"real_{key}"] for values in both]) if both else 0.0
            if real > 0:
                means[f"{key}_ratio"] = _mean([values[key] for values in both]) / real
        if shared:
            offs = [values["length_off"] for values in shared if "length_off" in values]
            means["length_off_worst"] = max(offs, default=math.nan)
        mine = scorer.recognised()
        for name, real_features in self.features.items():
            comparable = mine.of_labels(real_features.labels).balanced()
            means[f"fid_{name}"] = fid(comparable.features, real_features.balanced().features)
        return means, labels


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionRow:
    """The scores of one predictor of actions."""

    name: str
    scores: Mapping[str, float]
    by_label: Mapping[str, Mapping[str, float]]
    steps: tuple[Mapping[str, float], ...] = ()
    """Of each step of sequences of actions."""
    trained_on: float | None = None
    """Share of the held-out clips that a bundle was trained on, where that is known."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionEvaluation(Report[ActionRow]):
    """The rows of predictors of actions."""

    def markdown(self) -> str:
        """A table of all rows, then what each makes of every action and of sequences of them."""
        lines = [*heading(self.command, self.protocol, LEGEND), "", "### All actions", ""]
        lines += table(
            COLUMNS,
            (
                {"name": row.name, "trained_on": percent(row.trained_on), **row.scores}
                for row in self.rows
            ),
        )
        for row in self.rows:
            if not row.steps:  # the real clips, which stand in the tables of all others
                continue
            lines += ["", f"### {row.name}, each action", ""]
            labels = ({"label": label, **values} for label, values in row.by_label.items())
            lines += table(LABEL_COLUMNS, labels)
            lines += ["", f"### {row.name}, one random action after another", ""]
            steps = ({"step": i, **values} for i, values in enumerate(row.steps, start=1))
            lines += table(STEP_COLUMNS, steps)
        return "\n".join(lines) + "\n"


def junction_change(
    history: Float[np.ndarray, "T J 3"], future: Float[np.ndarray, "L J 3"]
) -> float:
    """`metrics.velocity_change` of one future."""
    return float(metrics.velocity_change(future[None, None], history[None])[0])


def inner_changes(motion: Float[np.ndarray, "L J 3"]) -> Float[np.ndarray, "M"]:
    """`metrics.velocity_change` at every frame of a motion that has two before it."""
    before = np.stack([motion[:-2], motion[1:-1]], axis=1)
    return metrics.velocity_change(motion[2:, None, None], before)


def _beside(values: Means, real: Means) -> Means:
    kept = ("accuracy", "div_w", "frames")
    beside = {f"real_{key}": real[key] for key in kept if key in real}
    if "begun_frames" in values:
        off = abs(values["begun_frames"] - real["frames"]) / real["frames"]
        beside["length_off"] = 100 * off
    return beside


def _means(items: Sequence[Means]) -> Means:
    keys = dict.fromkeys(key for item in items for key in item)
    return {key: _mean([item[key] for item in items if key in item]) for key in keys}


def _mean(values: Sequence[float] | Sequence[int]) -> float:
    return float(np.mean(values))
