"""The strip of a download: a character for each part, by the values received and requested again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import Final

from paramclient.cli.block_characters import Marks, Piece
from paramclient.protocol.params.download_ranges import DownloadRange
from paramclient.protocol.params.fetch_result import Progress

__all__ = ["strip_lines"]

STRIP_WIDTH_MAX: Final = 120
"""Maximum number of characters of a strip: more are hard to read."""
ITEM_GAP: Final = 2
"""Blanks between two items of a line."""
RECEIVED_STYLE: Final = "green"
"""Colour of a part that was received."""
PARTLY_STYLE: Final = "cyan"
"""Colour of a part of which some was received, and of the rest nothing was requested again."""
REQUESTED_STYLE: Final = "yellow"
"""Colour of a part with lost values that were requested again."""
MISSING_STYLE: Final = "dim"
"""Style of a part of which nothing was received."""


def strip_lines(title: str, state: Progress, marks: Marks, width: int) -> list[list[Piece]]:
    """Return the lines that show a download on a terminal: the figures, the strip, and its key.

    No item is broken in two. Without the parts of the download, only the figures are shown.

    Args:
        title: the table that is downloaded.
        state: the progress.
        marks: the characters of the strip.
        width: columns of the terminal.
    """
    total = "?" if state.total is None else str(state.total)
    left = "" if state.seconds_left is None else f", {state.seconds_left:.0f} s left"
    figures = [title, f"{state.received}/{total} {state.rate:.0f}/s{left}"]
    lines = _filled([[(each, "")] for each in figures], width)
    ranges = state.ranges
    parts = () if ranges is None else ranges.split(max(min(width, STRIP_WIDTH_MAX), 1))
    if ranges is None or not parts:
        return lines
    return [*lines, _strip(parts, marks), *_filled(_key(parts, marks, ranges.unit), width)]


def _strip(parts: Iterable[DownloadRange], marks: Marks) -> list[Piece]:
    cells = (_cell(part, marks) for part in parts)
    return [
        ("".join(character for character, _ in run), style)
        for style, run in groupby(cells, key=lambda cell: cell[1])
    ]


def _cell(part: DownloadRange, marks: Marks) -> Piece:
    if part.requested_again:
        return marks.requested_again, REQUESTED_STYLE
    if not part.missing:
        return marks.full, RECEIVED_STYLE
    if not part.received:
        return marks.missing, MISSING_STYLE
    return marks.column(part.received / part.size), PARTLY_STYLE


def _key(parts: Sequence[DownloadRange], marks: Marks, unit: str) -> list[list[Piece]]:
    """Return the characters with their meanings, and the numbers of values or bytes."""
    counts = (
        (marks.full, RECEIVED_STYLE, sum(part.received for part in parts), "received"),
        (
            marks.requested_again,
            REQUESTED_STYLE,
            sum(part.requested_again for part in parts),
            "requested again",
        ),
        (marks.missing, MISSING_STYLE, sum(part.missing for part in parts), "missing"),
    )
    items = [[(mark, style), (f" {number:,} {what}", "")] for mark, style, number, what in counts]
    if unit == "bytes":
        items.append([("in bytes", MISSING_STYLE)])
    return items


def _filled(items: Iterable[list[Piece]], width: int) -> list[list[Piece]]:
    """Return lines of at most `width` characters; an item that is longer has a line of its own."""
    return list(_fill(items, width))


def _fill(items: Iterable[list[Piece]], width: int) -> Iterator[list[Piece]]:
    line: list[Piece] = []
    used = 0
    for item in items:
        wide = sum(len(text) for text, _ in item)
        if line and used + ITEM_GAP + wide > width:
            yield line
            line, used = [], 0
        if line:
            line.append((" " * ITEM_GAP, ""))
            used += ITEM_GAP
        line += item
        used += wide
    if line:
        yield line
