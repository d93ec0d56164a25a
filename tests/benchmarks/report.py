"""The rows of the table: what is wanted, what was found, and whether it is met."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """A figure with what is wanted of it; ``wanted`` is None where nothing is."""

    name: str
    value: float
    form: str
    sense: Literal["at least", "at most"] = "at least"
    wanted: float | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the value is at least, or at most, what is wanted."""
        if self.wanted is None:
            return None
        return self.value >= self.wanted if self.sense == "at least" else self.value <= self.wanted

    def line(self) -> str:
        """The row in Markdown."""
        sign = "≥" if self.sense == "at least" else "≤"
        wanted = "" if self.wanted is None else f"{sign} {self.form.format(self.wanted)}"
        met = {None: "", True: "met", False: "**not met**"}[self.met]
        return f"| {self.name} | {wanted} | {self.form.format(self.value)} | {met} | {self.note} |"

    def record(self) -> dict[str, Any]:
        """The row as JSON has it."""
        return asdict(self) | {"met": self.met}


def markdown(rows: Sequence[Row]) -> str:
    """A table of rows."""
    head = "| | wanted | found | | |\n|---|--:|--:|---|---|"
    return "\n".join([head, *(row.line() for row in rows)])
