"""How evaluations are written down: JSON, and tables in Markdown."""

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

MISSING = "-"


def as_json(evaluation: Any) -> str:
    """Everything that a dataclass holds."""
    return json.dumps(dataclasses.asdict(evaluation), indent=1)


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
