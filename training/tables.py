"""How evaluations are written down: JSON, and tables in Markdown."""

import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

MISSING = "-"

RowT = TypeVar("RowT")


@dataclass(frozen=True, kw_only=True, slots=True)
class Report(ABC, Generic[RowT]):
    """All rows of a measurement, and what made them."""

    command: str
    protocol: Mapping[str, Any]
    rows: tuple[RowT, ...]

    def json(self) -> str:
        """Everything, as JSON."""
        return json.dumps(dataclasses.asdict(self), indent=1)

    def __str__(self) -> str:
        return self.markdown()

    @abstractmethod
    def markdown(self) -> str:
        """Everything that is worth reading, as tables."""


def heading(command: str, protocol: Mapping[str, Any], legend: str) -> list[str]:
    """The lines above the tables: the command typed, how it was measured, what figures mean."""
    said = ", ".join(f"{key} {value}" for key, value in protocol.items())
    return [f"`{command}`", "", said + ".", "", legend]


def table(columns: Sequence[tuple[str, str]], rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The lines of a table of columns, each a heading and how a row shows it.

    Where a row lacks what a column shows, it says ``-``.
    """
    return [
        _line(title for title, _ in columns),
        "|---|" + "--:|" * (len(columns) - 1),
        *(_line(_cell(shown, row) for _, shown in columns) for row in rows),
    ]


def percent(share: float | None) -> str:
    """A share in whole percent."""
    return MISSING if share is None else f"{100 * share:.0f} %"


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(shown: str, row: Mapping[str, Any]) -> str:
    try:
        return shown.format_map(row)
    except KeyError:
        return MISSING
