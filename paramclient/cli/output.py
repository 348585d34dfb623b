"""Output of the command line: JSON, tables, lines, the status line of a terminal, and errors.

Results go to stdout; status, summaries, warnings and errors to stderr. Text from the wire is never printed
unchanged: JSON escapes all characters outside ASCII, and all other output is `printable` text.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import accumulate
from typing import ClassVar, Final, Self, TextIO

import anyio
import anyio.to_thread

from paramclient.model.values import Param
from paramclient.protocol.fetch import Progress

__all__ = [
    "STDIN",
    "Coloured",
    "LiveView",
    "Status",
    "by_index",
    "can_ask",
    "confirm",
    "in_local_time",
    "local_time",
    "milliseconds",
    "print_json",
    "print_line",
    "print_table",
    "printable",
    "report",
    "say",
    "show",
]

STDIN: Final = "stdin:"
"""What `-` among the arguments becomes, which cyclopts would take for an option: the standard input."""

WIDTH_UNLIMITED: Final = 10_000
"""Width in columns of an output that is not a terminal, so that nothing is wrapped or cut."""
NOTICE_INTERVAL: Final = 0.5
"""Seconds until a terminal shows the awaited response, as most arrive earlier, and between two updates."""
DRAW_INTERVAL: Final = 0.1
"""Seconds between two drawings of the progress."""
ERASE: Final = "\r\x1b[K"
"""Moves the cursor of a terminal to the start of the line, and erases the line."""
ELLIPSIS: Final = "..."
"""Stands for the middle of a shortened text; ASCII, which every terminal shows."""
GAP: Final = 2
"""Blanks between two columns of a table, and before the second and later lines of a row."""
SENTENCE_WIDTH_MIN: Final = 20
"""Columns that sentences in the last column of a table take at least; in less they are hard to read."""

_UTC_TIME: Final = re.compile(
    r"(?<!\S)[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{3})?Z(?![^\s;,])"
)
"""A time in a message, between words."""
_STYLES: Final = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33"}
"""Codes of the styles of a terminal."""


@dataclass(frozen=True, slots=True)
class Coloured:
    """A cell of a table with a style, such as `bold red`, which only terminals show."""

    text: str
    style: str

    def __str__(self) -> str:
        return self.text


def printable(text: str) -> str:
    """Return text that is safe on any terminal: characters that are not printable ASCII become `\\x1b`, …"""
    text = text.replace("…", "...")  # of the library's messages
    if text.isascii() and text.isprintable():
        return text
    return "".join(each if each.isascii() and each.isprintable() else _escaped(each) for each in text)


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def milliseconds(seconds: float) -> str:
    """Return a time in seconds as milliseconds: `103 ms`, or `0.4 ms` below 10 ms."""
    return f"{seconds * 1000:.{0 if seconds >= 0.01 else 1}f} ms"


def local_time(at: float) -> str:
    """Return a unix time as ISO 8601 in the time zone of this computer, with milliseconds and the zone."""
    return _in_words(datetime.fromtimestamp(at).astimezone(), "milliseconds")


def in_local_time(text: str) -> str:
    """Return a message of the cache with its times, which are in UTC, in the time zone of this computer."""

    def local(found: re.Match[str]) -> str:
        try:
            return _in_words(
                datetime.fromisoformat(found[0]).astimezone(), "milliseconds" if found[1] else "seconds"
            )
        except (ValueError, OverflowError):  # no time, but a name
            return found[0]

    return _UTC_TIME.sub(local, text)


def _in_words(at: datetime, precision: str) -> str:
    return at.isoformat(timespec=precision).replace("+00:00", "Z")


def by_index(params: Iterable[Param]) -> list[Param]:
    """Return parameters in the vehicle's order; those without an index last, by name."""
    return sorted(params, key=lambda param: (param.index is None, param.index or 0, param.name))


# Lines


def print_json(item: object) -> None:
    """Print an object on one line, and flush."""
    print(json.dumps(item, allow_nan=False), flush=True)


def print_line(text: str) -> None:
    """Print one line of the result, wrapped at spaces on a terminal, and flush."""
    print(_wrapped(printable(text), sys.stdout), flush=True)


def say(text: str) -> None:
    """Print lines on stderr that accompany a result, wrapped at spaces on a terminal."""
    Status.erase()
    lines = "\n".join(map(printable, text.split("\n")))
    print(_wrapped(lines, sys.stderr), file=sys.stderr, flush=True)


def report(text: str) -> None:
    """Print an error or a warning on stderr. Line breaks, as in the list of link names, are kept."""
    say(f"paramclient: {text}")


def _wrapped(text: str, stream: TextIO) -> str:
    """Return text whose lines fit a terminal: a terminal itself would break values and names in two."""
    if not stream.isatty():
        return text
    return "\n".join(_wrapped_line(line, shutil.get_terminal_size().columns) for line in text.split("\n"))


def _wrapped_line(line: str, width: int) -> str:
    indent = line[: len(line) - len(line.lstrip())] + " " * GAP
    return "\n".join(_fold(line, width, indent))


def _fold(text: str, width: int, indent: str = "") -> list[str]:
    """Return text as lines of at most this width; words, such as names and values, stay whole."""
    return textwrap.wrap(
        text,
        max(width, 1),
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    ) or [text]


# Tables


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: str = "") -> None:
    """Print a table, at most as wide as the terminal; without a terminal, as wide as needed.

    No value is broken in two: if the columns do not fit beside each other, each row takes several lines, of
    which the second and later ones are indented. Only sentences in the last column are wrapped, at spaces.

    Args:
        columns: the headings.
        rows: the cells of each row; None is an empty cell.
        right: the headings of the right-aligned columns, separated by spaces.
    """
    is_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if is_terminal else WIDTH_UNLIMITED
    for line in _table_lines(columns, rows, right.split(), width, styled=is_terminal):
        print(line)
    sys.stdout.flush()


def show(
    item: object,
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    json: bool,
    right: str = "",
    empty: str = "",
) -> None:
    """Print an object as JSON, or its rows as a table; if `empty` is given and there are none, say that."""
    if json:
        print_json(item)
    elif (cells := list(rows)) or not empty:
        print_table(columns, cells, right=right)
    else:
        say(empty)


class LiveView:
    """A table with lines below it that is drawn again and again in the same place of a terminal."""

    def __init__(self) -> None:
        self._height = 0

    def draw(self, columns: Sequence[str], rows: Iterable[Sequence[object]], lines: Iterable[str]) -> None:
        """Draw in the place of the last drawing. All columns except the first two are right-aligned."""
        width, height = shutil.get_terminal_size()
        shown = [*_table_lines(columns, rows, columns[2:], width, styled=True)]
        shown += [part for line in lines for part in _broken_at_clauses(printable(line), width)]
        shown = shown[: height - 1]  # a line that has left the screen cannot be drawn again
        up = f"\x1b[{self._height}A\r\x1b[J" if self._height else ""
        print(f"{up}{chr(10).join(shown)}", flush=True)
        self._height = len(shown)


def _broken_at_clauses(text: str, width: int) -> list[str]:
    """Return a line as lines of at most this width, broken behind commas, colons and semicolons.

    A value and its unit stay together, unless a clause is longer than a line.
    """
    lines = [""]
    for clause in re.split(r"(?<=[,:;]) ", text):
        longer = f"{lines[-1]} {clause}" if lines[-1] else clause
        if len(longer) <= width or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(clause)
    return [part for line in lines for part in _fold(line, width)]


def _table_lines(
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    right: Sequence[str],
    width: int,
    *,
    styled: bool,
) -> Iterator[str]:
    """Yield the lines of a table of at most this width, in which no value is broken in two."""
    table: list[Sequence[object]] = [[Coloured(each, "bold") for each in columns], *rows]
    texts = [["" if cell is None else printable(str(cell)) for cell in row] for row in table]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    *ends, end = accumulate(each + GAP for each in widths)
    begin = ends[-1] if ends else 0  # of the last column
    words = [word for row in texts[1:] for word in row[-1].split()]
    longest = max(SENTENCE_WIDTH_MIN, *map(len, [columns[-1], *words]))
    fits = end - GAP <= width or begin + longest <= width
    groups = [[*range(len(columns))]] if fits else _groups(widths, width)
    for row, cells in zip(table, texts, strict=True):
        for number, group in enumerate(groups):
            line = " " * GAP * bool(number)
            for at in group:
                parts = _fold(cells[at], width - begin) if fits and at == len(cells) - 1 else [cells[at]]
                shown = [part.rjust(widths[at]) if columns[at] in right else part for part in parts]
                padding = " " * (widths[at] - len(shown[-1]) + GAP)
                style = getattr(row[at], "style", "")
                styles = [_styled(part, style) if styled else part for part in shown]
                line += f"\n{' ' * begin}".join(styles) + padding
            yield line.rstrip()


def _groups(widths: Sequence[int], width: int) -> list[list[int]]:
    """Return the columns that stand on each line of a row."""
    groups: list[list[int]] = [[]]
    used = 0
    for at, wide in enumerate(widths):
        if groups[-1] and used + wide > width:
            groups.append([])
            used = GAP
        groups[-1].append(at)
        used += wide + GAP
    return groups


def _styled(text: str, style: str) -> str:
    codes = [_STYLES[each] for each in style.split()]
    if "NO_COLOR" in os.environ:
        codes = [each for each in codes if len(each) == 1]
    return f"\x1b[{';'.join(codes)}m{text}\x1b[0m" if codes and text else text


# Questions


def can_ask() -> bool:
    """Return whether a user can read a question and answer it: stdin and stderr are a terminal."""
    return sys.stdin.isatty() and sys.stderr.isatty()


async def confirm(question: str) -> bool:
    """Ask a question on stderr; return whether the answer is y or yes. The link is served meanwhile.

    Cancellation, as by Ctrl-C, ends the question.
    """
    sys.stderr.write(printable(f"{question} [y/N] "))
    sys.stderr.flush()
    if sys.platform == "win32":  # a console cannot be waited for
        answer = await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True)
    else:
        await anyio.wait_readable(sys.stdin)  # a terminal becomes readable with a whole line
        answer = sys.stdin.readline()
    return answer.strip().lower() in ("y", "yes")


# The status of a command


class Status:
    """The line on stderr, if that is a terminal, that says what the command awaits, until its block ends.

    Several at once share the line. It is erased before any other output, and at the end.

    Args:
        awaited: what is awaited before the first progress.
        title: the beginning of the line that shows the progress.
        heard: returns what was received so far, as a sentence.
    """

    _active: ClassVar[list[Status]] = []
    _is_drawn: ClassVar[bool] = False
    _drawn_at: ClassVar[float] = 0.0

    def __init__(self, awaited: str, title: str = "", heard: Callable[[], str] = lambda: "") -> None:
        self._awaited, self._title, self._heard = printable(awaited), printable(title), heard
        self._progress: Progress | None = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            self._loop = asyncio.get_running_loop()
            self._began = self._loop.time()
            self._next = self._loop.call_later(NOTICE_INTERVAL, self._tick)
            self._active.append(self)
        return self

    def __exit__(self, *error: object) -> None:
        if self in self._active:
            self._next.cancel()
            self._active.remove(self)
            self.erase()

    def update(self, progress: Progress) -> None:
        """Show a progress, as that of a fetch."""
        if progress.received and self in self._active:
            self._progress = progress
            if self._loop.time() - Status._drawn_at >= DRAW_INTERVAL:
                self._draw()

    @classmethod
    def erase(cls) -> None:
        """Erase the line, until it is drawn again."""
        if cls._is_drawn:
            sys.stderr.write(ERASE)
            sys.stderr.flush()
            cls._is_drawn = False

    def _tick(self) -> None:
        self._next = self._loop.call_later(NOTICE_INTERVAL, self._tick)
        self._draw()

    def _draw(self) -> None:
        columns = shutil.get_terminal_size().columns - 1
        line = "; ".join(each._text(columns) for each in self._active)
        sys.stderr.write(f"{ERASE}{line[:columns]}")
        sys.stderr.flush()
        Status._is_drawn, Status._drawn_at = True, self._loop.time()

    def _text(self, columns: int) -> str:
        state = self._progress
        if state is None:
            duration = f" ({int(self._loop.time() - self._began)} s)."
            shown = _shortened(self._awaited, columns - len(duration))
            return f"{shown}{duration} {printable(self._heard())}".rstrip()
        left = "" if state.seconds_left is None else f", {state.seconds_left:.0f} s left"
        total = "?" if state.total is None else state.total
        return f"{self._title} {state.received}/{total} {state.rate:.0f}/s{left}"


def _shortened(text: str, length: int) -> str:
    """Return a text of at most `length` characters: its beginning and its end if it is longer."""
    kept = length - len(ELLIPSIS)
    if len(text) <= length or kept < 1:
        return text
    return f"{text[: kept - kept // 2]}{ELLIPSIS}{text[len(text) - kept // 2 :]}"
