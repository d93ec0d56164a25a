"""The curves of body realism: valid motions, and their diversity, against the tolerance."""

from collections.abc import Iterable

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.scores import JITTER_TOLERANCES, STRETCH_TOLERANCES, Row, score_at

PANELS = (
    ("valid", STRETCH_TOLERANCES, "largest stretch, % of the limb", "valid futures"),
    ("valid_apd", JITTER_TOLERANCES, "largest jitter, % of the limb", "APD of the valid, of all"),
)


def validity_figure(rows: Iterable[Row]) -> Figure:
    """One picture of a group's rows with free bones (Curreli et al. 2025, Figs. 7 and 8)."""
    shown = [row for row in rows if row.bone_lengths == "free" and row.scores["apd"] > 0]
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, len(PANELS))
    for axis, (score, tolerances, xlabel, ylabel) in zip(axes, PANELS, strict=True):
        for row in shown:
            _curve(axis, row, score, tolerances)
        axis.set(xscale="log", ylim=(-0.02, 1.02), xlabel=xlabel, ylabel=ylabel)
        axis.grid(alpha=0.3)
    axes[0].legend()
    return figure


def _curve(axis: Axes, row: Row, score: str, tolerances: tuple[float, ...]) -> None:
    values = [row.scores[score_at(score, tolerance)] for tolerance in tolerances]
    axis.plot(tolerances, values, marker="o", label=row.name)
