"""What has come of a file, in whatever order it came, what is missing, and where the file ends."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

__all__ = ["Blocks"]

MOST_GAPS: Final = 8_192
"""Gaps that are kept: more than a burst of ArduPilot has blocks. A piece that would leave another one is
passed over, and is asked for again: each piece that comes is compared with every gap."""


class Blocks:
    """The pieces of a file. What was there first stays; memory is taken for what has come, and no more.

    Attributes:
        received: bytes that have come.
        reached: behind the last byte that is known to be in the file.
        end: where the file ends, or None as long as that is not known.
    """

    __slots__ = ("_gaps", "_pieces", "end", "reached", "received")

    def __init__(self) -> None:
        self.received = 0
        self.reached = 0
        self.end: int | None = None
        self._pieces: dict[int, bytes] = {}
        self._gaps: list[tuple[int, int]] = []  # rising, below `reached`

    @property
    def is_complete(self) -> bool:
        return self.end == self.reached and not self._gaps

    @property
    def content(self) -> bytes:
        """The whole file, when it is complete."""
        return b"".join(self._pieces[at] for at in sorted(self._pieces))

    @property
    def prefix(self) -> bytes:
        """Everything from the beginning of the file to its first gap."""
        pieces: list[bytes] = []
        reached = 0
        while (piece := self._pieces.get(reached)) is not None:
            pieces.append(piece)
            reached += len(piece)
        return b"".join(pieces)

    @property
    def pieces(self) -> int:
        """How many pieces it has come in."""
        return len(self._pieces)

    @property
    def beginning(self) -> bytes:
        """The first piece; b"" where that has not come."""
        return self._pieces.get(0, b"")

    def take(self, offset: int, data: bytes) -> bool:
        """A piece has come; whether anything in it is new. What lies behind the end is passed over."""
        stop = offset + len(data)
        if self.end is not None:
            stop = min(stop, self.end)
        before = self.received
        if offset > self.reached and offset < stop:
            if len(self._gaps) >= MOST_GAPS:
                return False
            self._gaps.append((self.reached, offset))
            self.reached = offset
        gaps = []
        for first, last in self._gaps:
            low, high = max(first, offset), min(last, stop)
            if low >= high:
                gaps.append((first, last))
                continue
            self._keep(low, data[low - offset : high - offset])
            if first < low:
                gaps.append((first, low))
            if high < last:
                gaps.append((high, last))
        self._gaps = gaps
        if stop > self.reached:
            self._keep(self.reached, data[self.reached - offset : stop - offset])
            self.reached = stop
        return self.received > before

    def ends_at(self, offset: int) -> None:
        """There is nothing at this offset and behind; what lies before it may still be missing."""
        if self.end is not None and offset >= self.end:
            return
        self.end = offset
        if offset >= self.reached:
            if offset > self.reached:
                self._gaps.append((self.reached, offset))
        else:
            self._gaps = [(first, min(last, offset)) for first, last in self._gaps if first < offset]
            for at in [at for at in self._pieces if at + len(self._pieces[at]) > offset]:
                piece = self._pieces.pop(at)
                self.received -= len(piece)
                if at < offset:
                    self._keep(at, piece[: offset - at])
        self.reached = offset

    def missing(self, size: int) -> Iterator[int]:
        """Where to read, `size` bytes each time, to fill the gaps, in rising order."""
        for first, last in self._gaps:
            yield from range(first, last, size)

    def is_missing(self, offset: int) -> bool:
        """Whether the byte at this offset is not there, as far as it is known to be in the file."""
        return any(first <= offset < last for first, last in self._gaps)

    def _keep(self, at: int, piece: bytes) -> None:
        self._pieces[at] = piece
        self.received += len(piece)
