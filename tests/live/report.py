"""What the checks have shown: one row each, and the table that is printed at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

__all__ = ["Report", "Result", "Row"]

OK = "ok"
SKIPPED = "skipped"
FAILED = "FAILED"
Result = str
"""`OK`, `SKIPPED` or `FAILED`."""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: what was checked.
        result: see `Result`.
        measured: what was measured or seen, or the reason why it failed or was skipped.
        promise: what the documentation promises.
    """

    name: str
    result: Result
    measured: str
    promise: str = ""


@dataclass
class Report:
    """All rows so far.

    Args:
        report: prints a line as soon as a row is there.
    """

    report: Callable[[str], None]
    rows: list[Row] = field(default_factory=list)

    def add(self, row: Row) -> None:
        """Add a row and print its line."""
        self.rows.append(row)
        self.report(f"{row.result:8}{row.name}: {row.measured}")

    @property
    def failures(self) -> int:
        """How many rows failed."""
        return sum(row.result == FAILED for row in self.rows)

    def table(self) -> list[str]:
        """Return the lines of a Markdown table with all rows."""
        head = Row("check", "result", "measured", "the documentation promises")
        cells = [[row.name, row.measured, row.promise, row.result] for row in (head, *self.rows)]
        widths = [max(len(line[column]) for line in cells) for column in range(4)]
        lines = [
            "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |"
            for line in cells
        ]
        lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
        return lines
