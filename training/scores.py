"""The scores of a predictor on some windows, and the table that shows them."""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from models.motion.skeleton import Skeleton
from training import metrics
from training.tables import Report, heading, percent, table

COLUMNS: tuple[tuple[str, str], ...] = (  # heading, how a row shows it
    ("predictor", "{name}"),
    ("ADE", "{ade:.3f} ({ade_ratio:.2f})"),
    ("FDE", "{fde:.3f} ({fde_ratio:.2f})"),
    ("world ADE", "{world_ade:.3f} ({world_ade_ratio:.2f})"),
    ("world FDE", "{world_fde:.3f} ({world_fde_ratio:.2f})"),
    ("APD", "{apd:.2f}"),
    ("CMD", "{cmd:.2f}"),
    ("stretch % (RMSE)", "{stretch:.2f} ({stretch_rmse:.2f})"),
    ("jitter % (RMSE)", "{jitter:.2f} ({jitter_rmse:.2f})"),
    ("jump, x real", "{jump:.2f}"),
    ("velocity change, x real", "{velocity_change:.2f}"),
    ("trained on", "{trained_on}"),
)
STRETCH_TOLERANCES = (0.5, 1.0, 2.5, 5.0, 10.0, 20.0)
JITTER_TOLERANCES = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0)


def score_at(score: str, tolerance: float) -> str:
    """The key of a score at a tolerance; a format string takes a dot for an attribute."""
    return f"{score}_{tolerance:g}".replace(".", "_")


REALISM_COLUMNS: tuple[tuple[str, str], ...] = (
    ("predictor", "{name}"),
    ("stretch % (RMSE)", "{stretch:.2f} ({stretch_rmse:.2f})"),
    ("mean length off, %", "{mean_length_error:.2f}"),
    ("jitter % (RMSE)", "{jitter:.3f} ({jitter_rmse:.3f})"),
    *((f"valid at {t:g} %", f"{{{score_at('valid', t)}:.0%}}") for t in STRETCH_TOLERANCES),
    *((f"APD at {t:g} %", f"{{{score_at('valid_apd', t)}:.0%}}") for t in JITTER_TOLERANCES),
)
ERRORS = ("ade", "fde", "world_ade", "world_fde")

LEGEND = """\
In brackets after an error: its ratio to zero velocity. ADE and FDE in metres, best of the samples,
a pose as one vector: relative to the root without it, or all joints in the world. APD in metres.
CMD with the action as class, its mean motion being that of the real futures here. Stretch and
jitter in % over all bones, by eq. 13 of Curreli et al. (2025). Jump and velocity change at the
first predicted frame: times the real ones. Trained on: share of these windows that the bundle's
training data hold."""
REALISM_LEGEND = """\
Body realism (Curreli et al. 2025, Figs. 7 and 8). Mean length off: what the authors' published
code calls mean stretch. Valid at t: share of futures of which no bone in any frame is stretched by
t. APD at t: APD among the futures of which no bone changes by t from frame to frame, as a share of
all the futures' APD."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TestWindows:
    """What predictors are asked, and what really happened."""

    observations: Float[np.ndarray, "B T J 3"]
    futures: Float[np.ndarray, "B H J 3"]
    classes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.classes)


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """The scores of one predictor on one group of windows."""

    group: str
    bone_lengths: str
    name: str
    windows: int
    scores: Mapping[str, float]
    trained_on: float | None = None
    """Share of the windows that come from clips the bundle was trained on, where that is known."""

    def with_ratios(self, reference: "Row") -> "Row":
        """The row with the ratios of its errors to those of another."""
        ratios = {f"{key}_ratio": self.scores[key] / reference.scores[key] for key in ERRORS}
        return dataclasses.replace(self, scores=dict(self.scores) | ratios)

    def values(self) -> dict[str, Any]:
        """What the table shows of the row."""
        return {"name": self.name, "trained_on": percent(self.trained_on), **self.scores}


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation(Report[Row]):
    """The rows of predictors on groups of windows."""

    def markdown(self) -> str:
        """A table for each group of windows and treatment of bones."""
        lines = heading(self.command, self.protocol, LEGEND)
        for group, bones in dict.fromkeys((row.group, row.bone_lengths) for row in self.rows):
            mine = [row for row in self.rows if (row.group, row.bone_lengths) == (group, bones)]
            lines += ["", f"### {group}, {mine[0].windows} windows, bone lengths {bones}", ""]
            lines += table(COLUMNS, (row.values() for row in mine))
            if bones == "free":
                lines += ["", REALISM_LEGEND, ""]
                lines += table(REALISM_COLUMNS, (row.values() for row in mine))
        return "\n".join(lines) + "\n"


class Scorer:
    """Takes answers one at a time, so that the futures of many windows need not be kept."""

    def __init__(self, windows: TestWindows, skeleton: Skeleton) -> None:
        self._windows = windows
        self._limbs = metrics.bones(skeleton.parents)
        self._items: list[dict[str, float]] = []
        self._motion: list[Float[np.ndarray, " M"]] = []

    def add(self, samples: Float[np.ndarray, "S H J 3"]) -> None:
        """The answer to the next window."""
        index = len(self._items)
        observation = self._windows.observations[index, None]
        future = self._windows.futures[index, None]
        answer = samples[None]
        stretch, stretch_rmse = metrics.limb_stretch(answer, future, self._limbs)
        jitter, jitter_rmse = metrics.limb_jitter(answer, future, self._limbs)
        worst_stretch, worst_jitter = metrics.worst_limb_errors(answer, future, self._limbs)
        distances = metrics.sample_distances(answer)
        values = {
            "ade": metrics.ade(answer, future),
            "fde": metrics.fde(answer, future),
            "world_ade": metrics.world_ade(answer, future),
            "world_fde": metrics.world_fde(answer, future),
            "apd": metrics.mean_over_pairs(distances),
            "mean_length_error": metrics.mean_length_error(answer, future, self._limbs),
            "stretch": stretch,
            "stretch_rmse": stretch_rmse,
            "jitter": jitter,
            "jitter_rmse": jitter_rmse,
            "jump": metrics.first_frame_jump(answer, observation),
            "velocity_change": metrics.velocity_change(answer, observation),
            **{
                score_at("valid", tolerance): metrics.valid_share(worst_stretch, tolerance)
                for tolerance in STRETCH_TOLERANCES
            },
            **{
                score_at("valid_apd", tolerance): metrics.valid_apd(
                    distances, worst_jitter, tolerance
                )
                for tolerance in JITTER_TOLERANCES
            },
        }
        self._items.append({key: float(value[0]) for key, value in values.items()})
        self._motion.append(metrics.motion_per_frame(answer)[0])

    def means(self) -> dict[str, float]:
        """Means over the windows; jump and velocity change as ratios to the real means."""
        windows = self._windows
        means = {key: _mean(item[key] for item in self._items) for key in self._items[0]}
        real = windows.futures[:, None]
        real_jump = metrics.first_frame_jump(real, windows.observations).mean()
        real_change = metrics.velocity_change(real, windows.observations).mean()
        means["jump"] /= float(real_jump)
        means["velocity_change"] /= float(real_change)
        classes = metrics.class_means(metrics.motion_per_frame(real), windows.classes)
        for tolerance in JITTER_TOLERANCES:
            means[score_at("valid_apd", tolerance)] /= max(means["apd"], 1e-12)
        means["cmd"] = metrics.cmd(np.stack(self._motion), windows.classes, classes)
        return means


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
