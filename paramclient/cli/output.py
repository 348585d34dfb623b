"""Output of the command line: JSON, tables, lines, progress bars and errors.

Results go to stdout; progress, summaries, warnings and errors to stderr. Text from the wire is never printed
unchanged: JSON escapes all characters outside ASCII, and all other output is `printable` text.
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

WIDTH_UNLIMITED: Final = 10_000
"""Width in columns of an output that is not a terminal, so that nothing is wrapped or cut."""


@dataclass(frozen=True, slots=True)
class Coloured:
    """A cell of a table with a style of rich, such as `bold red`, which only terminals show."""

    text: str
    style: str

    def __str__(self) -> str:
        return self.text


def printable(text: str) -> str:
    """Return text that is safe on any terminal: characters that are not printable ASCII become `\\x1b`, …"""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character.isascii() and character.isprintable() else _escaped(character)
        for character in text
    )


def milliseconds(seconds: float) -> str:
    """Return a time in seconds as milliseconds: `103 ms`, or `0.4 ms` below 10 ms."""
    text = f"{seconds * 1000:.0f}" if seconds >= 0.01 else f"{seconds * 1000:.1f}"
    return f"{text} ms"


def default_text(param: Param) -> str | None:
    """Return the firmware's default as text, or None if it is not known."""
    return None if param.default is None else format_value(param.default, param.type)


def by_index(params: Iterable[Param]) -> list[Param]:
    """Return parameters in the vehicle's order; those without an index last, by name."""
    return sorted(params, key=lambda param: (param.index is None, param.index or 0, param.name))


# JSON


def print_document(document: Document) -> None:
    """Print a document of `paramclient.documents` on one line, and flush."""
    print(json.dumps(document.as_json(), allow_nan=False), flush=True)


# Tables and lines


def print_line(text: str) -> None:
    """Print one line of the result, and flush."""
    print(printable(text), flush=True)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: str = "") -> None:
    """Print a table, at most as wide as the terminal; without a terminal, as wide as needed.

    Args:
        columns: the headings.
        rows: the cells of each row; None is an empty cell.
        right: the headings of the right-aligned columns, separated by spaces.
    """
    from rich.console import Console  # only here: not needed to get started

    table = _table(columns, rows, right.split())
    console = Console(width=None if sys.stdout.isatty() else WIDTH_UNLIMITED)
    # rich would end the process when the output is closed
    with console.capture() as captured:
        console.print(table)
    lines = [line.rstrip() for line in captured.get().splitlines()]
    print(*lines, sep="\n", flush=True)


@contextmanager
def live_view() -> Iterator[Callable[[Sequence[str], Iterable[Sequence[object]], Iterable[str]], None]]:
    """Yield a function that draws a table with lines below it, in the place of the one before.

    The last one stays after the block. All columns except the first two are right-aligned.
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
    """Print an error or a warning on stderr. Line breaks, as in the list of link names, are kept."""
    say("\n".join(printable(line) for line in f"paramclient: {text}".splitlines()))


def say(text: str) -> None:
    """Print a line on stderr that accompanies a result."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[Progress], None] | None]:
    """Yield a function that draws the progress of a fetch; None if stderr is not a terminal."""
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
