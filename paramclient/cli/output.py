"""Output of the command line: JSON, tables, lines, the status line of a terminal, and errors.

Results go to stdout; status, summaries, warnings and errors to stderr. Text from the wire is never printed
unchanged: JSON escapes all characters outside ASCII, and all other output is `printable` text.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from enum import IntEnum
from typing import ClassVar, Final, Self, TextIO

import anyio
import anyio.to_thread

from paramclient import errors
from paramclient.errors import ParamClientError
from paramclient.model.names import first_of

STDIN: Final = "./-"
"""What `-` among the arguments becomes, which cyclopts would take for an option: the standard input, or where
only a file is possible, a file of this name."""

LINE_NAMES_MAX: Final = 10
"""Parameters or vehicles that a line names, so that it stays short; it gives the number of further ones."""
NOTICE_INTERVAL: Final = 0.5
"""Seconds until a terminal shows what is awaited, as most arrives earlier, and between two updates."""
ERASE: Final = "\r\x1b[K"
"""Moves the cursor of a terminal to the start of the line, and erases the line."""
GAP: Final = "  "
"""Blanks between two columns of a table, and before the second and later lines of a text."""
SENTENCE_WIDTH_MIN: Final = 20
"""Columns that sentences in the last column of a table take at least; in less they are hard to read."""

_STYLES: Final = {
    **dict.fromkeys(("set", "accepted", "only right"), "32"),
    **dict.fromkeys(("later", "adjusted", "unproven", "different", "slow"), "33"),
    **dict.fromkeys(("refused", "unknown", "only left", "conflict", "problem"), "31"),
    **dict.fromkeys(("skipped", "not tried"), "2"),
}
"""Codes of the styles of outcomes, differences and findings on a terminal: green, yellow, red and dim."""


def printable(text: str) -> str:
    """Return text that is safe on any terminal: characters that are not printable ASCII become `\\x1b`, …"""
    text = text.replace("…", "...")  # of the library's messages
    if text.isascii() and text.isprintable():
        return text
    return "".join(each if " " <= each <= "~" else each.encode("unicode_escape").decode() for each in text)


def milliseconds(seconds: float) -> str:
    """Return a time in seconds as milliseconds: `103 ms`, or `0.4 ms` below 10 ms."""
    return f"{seconds * 1000:.{0 if seconds >= 0.01 else 1}f} ms"


def local_time(at: float) -> str:
    """Return a unix time as ISO 8601 in the time zone of this computer, with milliseconds and the zone."""
    return datetime.fromtimestamp(at).astimezone().isoformat(timespec="milliseconds").replace("+00:00", "Z")


def listed(words: Sequence[object]) -> str:
    """Return the first words, such as names of parameters, and the number of further ones."""
    return first_of(words, LINE_NAMES_MAX)


# Lines


def print_json(item: object) -> None:
    """Print an object on one line, and flush."""
    print(json.dumps(item, allow_nan=False), flush=True)


def print_line(text: str) -> None:
    """Print one line of the result, wrapped at spaces on a terminal, and flush."""
    print(_wrapped(text, sys.stdout), flush=True)


def say(text: str) -> None:
    """Print lines on stderr that accompany a result, wrapped at spaces on a terminal."""
    Status.erase()
    print(_wrapped(text, sys.stderr), file=sys.stderr, flush=True)


def report(text: str) -> None:
    """Print an error or a warning on stderr. Line breaks, as in the list of link names, are kept."""
    say(f"paramclient: {text}")


def _wrapped(text: str, stream: TextIO) -> str:
    """Return printable lines; for a terminal wrapped at spaces, as it would break names and values in two."""
    lines = [printable(line) for line in text.split("\n")]
    if stream.isatty():
        lines = [part for line in lines for part in _fold(line, shutil.get_terminal_size().columns)]
    return "\n".join(lines)


def _fold(text: str, width: int) -> list[str]:
    """Return text as lines of at most this width; words, such as names and values, stay whole."""
    indent = text[: len(text) - len(text.lstrip())] + GAP
    whole = textwrap.TextWrapper(
        width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return whole.wrap(text) or [text]


# Tables


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table; on a terminal with styles, and with sentences in the last column wrapped at spaces.

    Args:
        columns: the headings.
        rows: the cells of each row; None is an empty cell. A column without any cell is left out, as is the
            whole table without rows; a column with numbers is aligned at the right.
    """
    cells, begin = [*rows], 0
    kept = [column for column in zip(columns, *cells, strict=True) if {*column[1:]} - {None}]
    lines = [""] * (len(cells) + 1)
    for column in kept:
        texts = ["" if cell is None else printable(str(cell)) for cell in column]
        if column is kept[-1] and sys.stdout.isatty():
            left = max(shutil.get_terminal_size().columns - begin, SENTENCE_WIDTH_MIN)
            texts = [f"\n{' ' * begin}".join(_fold(text, left)) for text in texts]
        width, is_number = max(map(len, texts)), any(isinstance(cell, int | float) for cell in column)
        for at, text in enumerate(texts):
            style = _STYLES.get(text.partition(", ")[0]) if at else "1"
            shown, padding = _styled(text, style), " " * (width - len(text))
            lines[at] += (padding + shown if is_number else shown + padding) + GAP
        begin += width + len(GAP)
    if kept:
        print("\n".join(line.rstrip() for line in lines), flush=True)


def show(
    item: object, columns: Sequence[str], rows: Iterable[Sequence[object]], *, json: bool, empty: str = ""
) -> None:
    """Print an object as JSON, or its rows as a table; if `empty` is given and there are none, say that."""
    if json:
        print_json(item)
    elif (cells := list(rows)) or not empty:
        print_table(columns, cells)
    else:
        say(empty)


def print_result(item: object, words: str, *, json: bool) -> None:
    """Print an object as JSON, or the result in words."""
    if json:
        print_json(item)
    else:
        print_line(words)


def cells_of(objects: Mapping[str, Mapping[str, object]], *members: str) -> Iterator[list[object]]:
    """Yield the row of each object of JSON: its name, and these members; the meaning is the member text."""
    keys = ["text" if member == "meaning" else member for member in members]
    return ([name, *map(each.get, keys)] for name, each in objects.items())


def _styled(text: str, style: str | None) -> str:
    is_plain = style is None or "NO_COLOR" in os.environ or not sys.stdout.isatty()
    return text if is_plain else f"\x1b[{style}m{text}\x1b[0m"


# Questions


def can_ask() -> bool:
    """Return whether a user can read a question and answer it: stdin and stderr are a terminal."""
    return sys.stdin.isatty() and sys.stderr.isatty()


async def confirm(question: str) -> bool:
    """Ask a question on stderr; return whether the answer is y or yes. The link is served meanwhile.

    Cancellation, as by Ctrl-C, ends the question.
    """
    print(printable(f"{question} [y/N] "), end="", file=sys.stderr, flush=True)
    if sys.platform == "win32":  # a console cannot be waited for
        answer = await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True)
    else:
        await anyio.wait_readable(sys.stdin)  # a terminal becomes readable with a whole line
        answer = sys.stdin.readline()
    return answer.strip().lower() in ("y", "yes")


# The status of a command


class Status:
    """The line on stderr, if that is a terminal, that says what the command awaits, until its block ends.

    Several at once share the line. It is erased before any other output, and at the end. After an
    interruption, a line without a progress is printed, on a terminal or not.

    Args:
        awaited: what is awaited before the first progress.
        title: the beginning of the line that shows the progress; "" if there is none.
        heard: returns what was received so far, as a sentence.
    """

    _active: ClassVar[list[Status]] = []
    _is_drawn: ClassVar[bool] = False

    def __init__(self, awaited: str, title: str = "", heard: Callable[[], str] = lambda: "") -> None:
        self._awaited, self._title, self._heard = awaited, title, heard
        self._progress = ""
        self._first: tuple[float, int] | None = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            self._loop = asyncio.get_running_loop()
            self._began = self._loop.time()
            self._next = self._loop.call_later(NOTICE_INTERVAL, self._tick)
            self._active.append(self)
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if self in self._active:
            self._next.cancel()
            self._active.remove(self)
            self.erase()
        if not self._title and kind is asyncio.CancelledError:
            say(f"interrupted while {self._awaited}. {self._heard()}".rstrip())

    def count(self, received: int, total: int | None) -> None:
        """Show a progress at the next update, with the rate since the first one."""
        if not received or self not in self._active:
            return
        now = self._loop.time()
        began, before = self._first = self._first or (now, received)
        self._progress = f"{self._title} {received}/{total or '?'}"
        if (elapsed := now - began) > NOTICE_INTERVAL / 2:  # a shorter one may be a burst
            rate = (received - before) / elapsed
            self._progress += f" {rate:.0f}/s"
            if rate and total:
                self._progress += f", {(total - received) / rate:.0f} s left"

    @classmethod
    def erase(cls) -> None:
        """Erase the line, until it is drawn again."""
        if cls._is_drawn:
            print(ERASE, end="", file=sys.stderr, flush=True)
            cls._is_drawn = False

    def _tick(self) -> None:
        self._next = self._loop.call_later(NOTICE_INTERVAL, self._tick)
        line = printable("; ".join(each._text for each in self._active))
        print(f"{ERASE}{line[: shutil.get_terminal_size().columns - 1]}", end="", file=sys.stderr, flush=True)
        Status._is_drawn = True

    @property
    def _text(self) -> str:
        waited = int(self._loop.time() - self._began)
        return self._progress or f"{self._awaited} ({waited} s). {self._heard()}".rstrip()


# Errors


class ExitCode(IntEnum):
    """The exit codes. If several apply, the highest one is used."""

    DONE = 0
    """The command succeeded."""
    INCOMPLETE = 1
    """The vehicle refused something, some parameters are missing, or the compared ones differ."""
    USAGE = 2
    """The arguments are invalid."""
    NO_ANSWER = 3
    """No vehicle was heard, or it did not answer."""
    LINK = 4
    """The link failed."""
    CACHE = 5
    """The cache failed, or does not have the requested data."""


def code_of(error: ParamClientError) -> ExitCode:
    """Return the exit code for an error."""
    return next(code for kind, code in _CODES.items() if isinstance(error, kind))


def text_of(error: ParamClientError, *, takes_all: bool) -> str:
    """Return the message of an error for the command line, with options in place of Python arguments."""
    if isinstance(error, errors.AmbiguousVehicle) and error.choose_by:
        address = error.vehicles[0].partition(" ")[0] if error.vehicles else "1/1"
        all_too = ", or all with --vehicle all" if takes_all and error.choose_by == "system" else ""
        return f"{error.summary} Choose one with --vehicle {address}{all_too}."
    if isinstance(error, errors.InvalidParameters):
        return f"{error}\n--partial skips these, and writes the others"
    return str(error)


_CODES: Final = {
    errors.UnknownParameter: ExitCode.USAGE,  # as everywhere for a name that does not exist
    errors.VehicleError: ExitCode.INCOMPLETE,
    errors.PackError: ExitCode.INCOMPLETE,
    errors.UsageError: ExitCode.USAGE,
    errors.NoReply: ExitCode.NO_ANSWER,
    errors.LinkError: ExitCode.LINK,
    errors.CacheError: ExitCode.CACHE,
}
"""Exit codes by class of error; the first class that matches applies."""


def report_all(found: Collection[ParamClientError], prefix: str = "") -> int:
    """Print every error; return the exit code for all of them."""
    for error in found:
        report(f"{prefix}{text_of(error, takes_all=False)}")
    return max(map(code_of, found), default=ExitCode.DONE)
