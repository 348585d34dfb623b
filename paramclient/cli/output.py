"""Output of the command line: JSON, tables, lines, progress bars, awaited responses and errors.

Results go to stdout; progress, summaries, warnings and errors to stderr. Text from the wire is never printed
unchanged: JSON escapes all characters outside ASCII, and all other output is `printable` text.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import textwrap
from collections.abc import Awaitable, Callable, Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Final, TextIO, TypeAlias, TypeVar

import anyio

from paramclient.cli.json_output import as_json
from paramclient.model.values import Param, format_value
from paramclient.protocol.fetch import Progress

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

__all__ = [
    "STDIN",
    "Coloured",
    "Draw",
    "StatusLine",
    "by_index",
    "default_text",
    "in_local_time",
    "live_view",
    "local_time",
    "milliseconds",
    "print_json",
    "print_line",
    "print_table",
    "printable",
    "progress_bar",
    "report",
    "say",
    "while_waiting",
    "wrapped",
]

STDIN: Final = "stdin:"
"""What `-` among the arguments becomes, which cyclopts would take for an option: the standard input."""

Draw: TypeAlias = Callable[[Sequence[str], Iterable[Sequence[object]], Iterable[str]], None]
"""Draws columns, rows and lines."""

WIDTH_UNLIMITED: Final = 10_000
"""Width in columns of an output that is not a terminal, so that nothing is wrapped or cut."""

NOTICE_DELAY: Final = 0.5
"""Seconds after which a terminal shows the awaited response: most responses arrive earlier."""
NOTICE_INTERVAL: Final = 0.5
"""Seconds between two updates of the line that names the awaited response."""
ERASE: Final = "\r\x1b[K"
"""Moves the cursor of a terminal to the start of the line, and erases the line."""
ELLIPSIS: Final = "..."
"""Stands for the middle of a shortened text; ASCII, which every terminal shows."""
GAP: Final = 2
"""Blanks between two columns of a table, and before the second and later lines of a row."""
SENTENCE_WIDTH_MIN: Final = 20
"""Columns that sentences in the last column of a table take at least; in less they are hard to read."""

Result = TypeVar("Result")
_UTC_TIME: Final = re.compile(
    r"(?<!\S)[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{3})?Z(?![^\s;,])"
)
"""A time in a message, between words."""


@dataclass(frozen=True, slots=True)
class Coloured:
    """A cell of a table with a style of rich, such as `bold red`, which only terminals show."""

    text: str
    style: str

    def __str__(self) -> str:
        return self.text


def printable(text: str) -> str:
    """Return text that is safe on any terminal: characters that are not printable ASCII become `\\x1b`, …"""
    text = text.replace("…", "...")  # of the library's messages
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
    return None if param.default is None else format_value(param.default, param.type_number)


def local_time(at: float) -> str:
    """Return a unix time as ISO 8601 in the time zone of this computer, with milliseconds and the zone."""
    text = datetime.fromtimestamp(at).astimezone().isoformat(timespec="milliseconds")
    return text.replace("+00:00", "Z")


def in_local_time(text: str) -> str:
    """Return a message of the cache with its times, which are in UTC, in the time zone of this computer."""

    def local(found: re.Match[str]) -> str:
        try:
            at = datetime.fromisoformat(found[0]).astimezone()
        except (ValueError, OverflowError):  # no time, but a name
            return found[0]
        return at.isoformat(timespec="milliseconds" if found[1] else "seconds").replace("+00:00", "Z")

    return _UTC_TIME.sub(local, text)


def by_index(params: Iterable[Param]) -> list[Param]:
    """Return parameters in the vehicle's order; those without an index last, by name."""
    return sorted(params, key=lambda param: (param.index is None, param.index or 0, param.name))


# JSON


def print_json(item: object) -> None:
    """Print an object of `paramclient.cli.json_output`, or a mapping or list of them, on one line; flush."""
    print(json.dumps(as_json(item), allow_nan=False), flush=True)


# Tables and lines


def print_line(text: str) -> None:
    """Print one line of the result, wrapped at spaces on a terminal, and flush."""
    print(_wrapped(printable(text), sys.stdout), flush=True)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: str = "") -> None:
    """Print a table, at most as wide as the terminal; without a terminal, as wide as needed.

    No value is broken in two: if the columns do not fit beside each other, each row takes several lines, of
    which the second and later ones are indented. Only sentences in the last column are wrapped, at spaces.

    Args:
        columns: the headings.
        rows: the cells of each row; None is an empty cell.
        right: the headings of the right-aligned columns, separated by spaces.
    """
    from rich.console import Console  # only here: not needed to get started
    from rich.text import Text

    console = Console(width=None if sys.stdout.isatty() else WIDTH_UNLIMITED)
    cells = [list(row) for row in rows]
    # rich would end the process when the output is closed
    with console.capture() as captured:
        table = _fitting(columns, cells, right.split(), console.width)
        console.print(table, soft_wrap=isinstance(table, Text))
    lines = [line.rstrip() for line in captured.get().splitlines()]
    print(*lines, sep="\n", flush=True)


@contextmanager
def live_view() -> Iterator[Draw]:
    """Yield a function that draws a table with lines below it, in the place of the one before.

    The last one stays after the block. All columns except the first two are right-aligned. No value is broken
    in two, as in `print_table`; lines are `wrapped`.
    """
    from rich.console import Console, Group  # only here: not needed to get started
    from rich.live import Live
    from rich.text import Text

    console = Console()
    with Live(console=console, auto_refresh=False) as live:

        def draw(columns: Sequence[str], rows: Iterable[Sequence[object]], lines: Iterable[str]) -> None:
            table = _fitting(columns, list(rows), columns[2:], console.width)
            below = (Text(part) for line in lines for part in wrapped(printable(line), console.width))
            live.update(Group(table, *below), refresh=True)

        yield draw


def wrapped(text: str, width: int) -> list[str]:
    """Return a line as lines of at most this width, broken behind commas, colons and semicolons.

    A value and its unit stay together. A clause that is longer than a line is left as it is, so that a
    terminal wraps it at spaces.
    """
    lines = [""]
    for clause in re.split(r"(?<=[,:;]) ", text):
        longer = f"{lines[-1]} {clause}" if lines[-1] else clause
        if len(longer) <= width or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(clause)
    return lines


def report(text: str) -> None:
    """Print an error or a warning on stderr. Line breaks, as in the list of link names, are kept."""
    say("\n".join(printable(line) for line in f"paramclient: {text}".splitlines()))


def say(text: str) -> None:
    """Print a line on stderr that accompanies a result, wrapped at spaces on a terminal."""
    print(_wrapped(text, sys.stderr), file=sys.stderr, flush=True)


def _wrapped(text: str, stream: TextIO) -> str:
    """Return text whose lines fit a terminal: a terminal itself would break values and names in two."""
    if not stream.isatty():
        return text
    width = shutil.get_terminal_size().columns
    return "\n".join(_wrapped_line(line, width) for line in text.split("\n"))


def _wrapped_line(line: str, width: int) -> str:
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(
        line,
        width,
        subsequent_indent=indent + " " * GAP,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )


class StatusLine:
    """A line on stderr, which must be a terminal, that is drawn again and again and erased at the end."""

    def __init__(self) -> None:
        self._is_drawn = self._has_ended = False

    def draw(self, text: str, seconds: float, more: str = "") -> None:
        """Draw a text, the seconds so far and a sentence, as much as fits on one line.

        A text that leaves no space for the seconds is shortened in its middle.

        Nothing is drawn in the first `NOTICE_DELAY` seconds, and after `end`.
        """
        if seconds < NOTICE_DELAY or self._has_ended:
            return
        columns = shutil.get_terminal_size().columns - 1
        duration = f" ({int(seconds)} s)."
        shown = _shortened(printable(text), columns - len(duration)) + duration
        self._write(f"{shown} {printable(more)}".rstrip()[:columns])
        self._is_drawn = True

    def end(self) -> None:
        """Erase the line, and draw no other."""
        if self._is_drawn and not self._has_ended:
            self._write("")
        self._has_ended = True

    def _write(self, text: str) -> None:
        sys.stderr.write(f"{ERASE}{text}")
        sys.stderr.flush()


def _shortened(text: str, length: int) -> str:
    """Return a text of at most `length` characters: its beginning and its end if it is longer."""
    kept = length - len(ELLIPSIS)
    if len(text) <= length or kept < 1:
        return text
    return f"{text[: kept - kept // 2]}{ELLIPSIS}{text[len(text) - kept // 2 :]}"


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[Progress], None] | None]:
    """Yield a function that draws the progress of a fetch; None if stderr is not a terminal.

    Before the first response, the function says that it is awaited. Needs a running event loop.
    """
    if not sys.stderr.isatty():
        yield None
        return
    with ExitStack() as stack:
        yield _bar(printable(title), stack)


def _bar(title: str, stack: ExitStack) -> Callable[[Progress], None]:
    update: Callable[[Progress], None] | None = None
    line, began = StatusLine(), anyio.current_time()
    stack.callback(line.end)

    def draw(state: Progress) -> None:
        nonlocal update
        if update is None and not state.received:
            line.draw(f"{title}: waiting for the first response", anyio.current_time() - began)
        if update is None and state.received:  # nothing is drawn for a fetch that needs no download
            line.end()
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


def _fitting(
    columns: Sequence[str], rows: Sequence[Sequence[object]], right: Container[str], width: int
) -> Table | Text:
    """Return a table of at most this width, in which no value is broken in two; see `print_table`."""
    groups = _groups(columns, rows, width)
    if groups is None:
        return _table(columns, rows, right, keeps_values=True)
    return _stacked(columns, rows, right, groups)


def _table(
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    right: Container[str],
    *,
    keeps_values: bool = False,
) -> Table:
    """Return a table of rich. With `keeps_values`, only the last column may be wrapped."""
    from rich.table import Table  # only here: not needed to get started
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for number, column in enumerate(columns, start=1):
        table.add_column(
            column,
            justify="right" if column in right else "left",
            overflow="fold",
            no_wrap=keeps_values and number < len(columns),
        )
    for row in rows:
        table.add_row(
            *(
                Text(
                    _cell_text(cell),
                    style=cell.style if isinstance(cell, Coloured) else "",
                )
                for cell in row
            )
        )
    return table


def _groups(columns: Sequence[str], rows: Sequence[Sequence[object]], width: int) -> list[list[int]] | None:
    """Return the columns that stand on each line of a row; None if all fit beside each other.

    They fit as well if the last column is left with `SENTENCE_WIDTH_MIN`, or with its longest word.
    """
    natural = _widths(columns, rows)
    if sum(natural) + GAP * (len(natural) - 1) <= width:
        return None
    words = [len(word) for row in rows for word in _cell_text(row[-1]).split()]
    left = width - sum(natural[:-1]) - GAP * (len(natural) - 1)
    if left >= max([SENTENCE_WIDTH_MIN, len(columns[-1]), *words]):
        return None
    groups: list[list[int]] = [[]]
    used = 0
    for at, wide in enumerate(natural):
        needed = wide if not groups[-1] else used + GAP + wide
        if groups[-1] and needed > width:
            groups.append([])
            needed = GAP + wide
        groups[-1].append(at)
        used = needed
    return groups


def _stacked(
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    right: Container[str],
    groups: Sequence[Sequence[int]],
) -> Text:
    """Return a table in which each row takes a line for each group of columns."""
    from rich.text import Text  # only here: not needed to get started

    natural = _widths(columns, rows)
    text = Text()
    for row in (None, *rows):
        for number, group in enumerate(groups):
            text.append("" if not number else " " * GAP)
            for place, at in enumerate(group):
                cell = columns[at] if row is None else row[at]
                shown = _cell_text(cell)
                style = "bold" if row is None else cell.style if isinstance(cell, Coloured) else ""
                text.append(" " * GAP if place else "")
                padding = " " * (natural[at] - len(shown))
                is_right = columns[at] in right
                text.append(padding if is_right else "")
                text.append(shown, style=style)
                text.append("" if is_right or place == len(group) - 1 else padding)
            text.append("\n")
    text.rstrip()
    return text


def _widths(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> list[int]:
    """Return the width of the widest cell of each column, heading included."""
    return [max([len(name), *(len(_cell_text(row[at])) for row in rows)]) for at, name in enumerate(columns)]


def _cell_text(cell: object) -> str:
    return "" if cell is None else printable(str(cell))


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


async def while_waiting(
    work: Callable[[Callable[[], None]], Awaitable[Result]],
    awaited: str,
    received: Callable[[], str] = lambda: "",
) -> Result:
    """Await `work`; meanwhile, name the awaited response on a terminal. The line is erased at the end.

    Args:
        work: the function to await. Its argument is a function that erases the line for good, to call before
            anything else is printed.
        awaited: the awaited response in words.
        received: returns what was received so far, as a sentence.

    Raises:
        Exception: as from `work`.
    """
    line = StatusLine()
    if not sys.stderr.isatty():
        return await work(line.end)
    outcome: list[Result] = []
    failure: Exception | None = None
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_draw, line, awaited, received)
        try:
            outcome.append(await work(line.end))
        except Exception as error:  # raised here, the task group would wrap it in a group
            failure = error
        finally:
            line.end()
        tasks.cancel_scope.cancel()
    if failure is not None:
        raise failure
    return outcome[0]


async def _draw(line: StatusLine, awaited: str, received: Callable[[], str]) -> None:
    began = anyio.current_time()
    while True:
        line.draw(f"waiting for {awaited}", anyio.current_time() - began, received())
        await anyio.sleep(NOTICE_INTERVAL)
