"""What is printed: JSON for programs, tables and lines for people.

Results go to stdout; progress, summaries, warnings and errors to stderr. Text from the wire reaches neither
as it came: in JSON everything outside ASCII is escaped, and people see `printable` text only.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from paramclient.model.values import Param, format_value
from paramclient.protocol.params.fetch_result import Progress

if TYPE_CHECKING:
    from rich.table import Table

    from paramclient.documents.document import Document

__all__ = [
    "Coloured",
    "by_index",
    "default_text",
    "live_view",
    "milliseconds",
    "print_document",
    "print_line",
    "print_table",
    "printable",
    "progress_bar",
    "report",
    "say",
]

UNLIMITED: Final = 10_000
"""Columns of an output that is no terminal: nothing is wrapped or cut there."""


@dataclass(frozen=True, slots=True)
class Coloured:
    """A cell of a table that is to stand out, in words of rich: `bold red`. It does so on terminals only."""

    text: str
    style: str

    def __str__(self) -> str:
        return self.text


def printable(text: str) -> str:
    """Text that is safe on any terminal: whatever is not printable ASCII becomes `\\x1b`, `\\u202e`, …"""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character.isascii() and character.isprintable() else _escaped(character)
        for character in text
    )


def milliseconds(seconds: float) -> str:
    """A short time for people: `103 ms`, and `0.4 ms` where whole ones say nothing."""
    text = f"{seconds * 1000:.0f}" if seconds >= 0.01 else f"{seconds * 1000:.1f}"
    return f"{text} ms"


def default_text(param: Param) -> str | None:
    """The firmware's default as people see it, or None where it is not known."""
    return None if param.default is None else format_value(param.default, param.type)


def by_index(params: Iterable[Param]) -> list[Param]:
    """In the vehicle's own order; those without an index last, by name."""
    return sorted(params, key=lambda param: (param.index is None, param.index or 0, param.name))


# for programs


def print_document(document: Document) -> None:
    """Print a document of `paramclient.documents` on one line, at once."""
    print(json.dumps(document.as_json(), allow_nan=False), flush=True)


# for people


def print_line(text: str) -> None:
    """Print one line of the result, at once."""
    print(printable(text), flush=True)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: str = "") -> None:
    """Print a table: as wide as the terminal allows, and as wide as it needs where there is none.

    Args:
        columns: their headings.
        rows: their cells; None is an empty one.
        right: the headings of the columns that are aligned to the right.
    """
    from rich.console import Console  # only here: not needed to get started

    table = _table(columns, rows, right.split())
    console = Console(width=None if sys.stdout.isatty() else UNLIMITED)
    # rich would end the process by itself when the output is closed
    with console.capture() as captured:
        console.print(table)
    lines = [line.rstrip() for line in captured.get().splitlines()]
    print(*lines, sep="\n", flush=True)


@contextmanager
def live_view() -> Iterator[Callable[[Sequence[str], Iterable[Sequence[object]], Iterable[str]], None]]:
    """What draws a table with lines below it, each time in the place of the one before, for the time of the
    block. The last one stays. All columns but the first two are aligned to the right.
    """
    from rich.console import Console, Group  # only here: not needed to get started
    from rich.live import Live
    from rich.text import Text

    with Live(console=Console(), auto_refresh=False) as live:

        def draw(columns: Sequence[str], rows: Iterable[Sequence[object]], lines: Iterable[str]) -> None:
            below = [Text(printable(line)) for line in lines]
            live.update(Group(_table(columns, rows, columns[2:]), *below), refresh=True)

        yield draw


def report(text: str) -> None:
    """Tell on stderr what went wrong. Further lines, as the forms of a link name, stay lines."""
    say("\n".join(printable(line) for line in f"paramclient: {text}".splitlines()))


def say(text: str) -> None:
    """Print to stderr what accompanies a result."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[Progress], None] | None]:
    """What draws the progress of a fetch, for the time of the block; None where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    with ExitStack() as stack:
        yield _bar(printable(title), stack)


def _bar(title: str, stack: ExitStack) -> Callable[[Progress], None]:
    update: Callable[[Progress], None] | None = None

    def draw(state: Progress) -> None:
        nonlocal update
        if update is None and state.received:  # nothing is drawn for a fetch that needs no download
            update = _start_bar(title, stack)
        if update is not None:
            update(state)

    return draw


def _start_bar(title: str, stack: ExitStack) -> Callable[[Progress], None]:
    from rich.console import Console  # only here: not needed to get started
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = ("{task.description}", "{task.completed}/{task.fields[of]}", "{task.fields[pace]}")
    title_column, count_column, pace_column = (TextColumn(text, markup=False) for text in columns)
    bar = stack.enter_context(
        Bar(
            title_column,
            BarColumn(),
            count_column,
            pace_column,
            console=Console(stderr=True),
            auto_refresh=False,
            transient=True,
        )
    )
    task = bar.add_task(title, total=None, of="?", pace="")

    def update(state: Progress) -> None:
        left = "" if state.seconds_left is None else f", {state.seconds_left:.0f} s left"
        bar.update(
            task,
            total=state.total,
            completed=state.received,
            of="?" if state.total is None else state.total,
            pace=f"{state.rate:.0f}/s{left}",
            refresh=True,
        )

    return update


def _table(columns: Sequence[str], rows: Iterable[Sequence[object]], right: Container[str]) -> Table:
    from rich.table import Table  # only here: not needed to get started
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        table.add_row(
            *(
                Text(
                    "" if cell is None else printable(str(cell)),
                    style=cell.style if isinstance(cell, Coloured) else "",
                )
                for cell in row
            )
        )
    return table


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
