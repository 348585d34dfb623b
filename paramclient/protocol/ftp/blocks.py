"""The received pieces of a file, its gaps, and its end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

__all__ = ["Blocks"]

GAPS_MAX: Final = 8_192
"""Gaps of a file: more than a burst of ArduPilot has blocks. A piece that would leave another gap is dropped,
and requested again: each received piece is compared with every gap."""


class Blocks:
    """The pieces of a file. The first piece for an offset stays; memory is used for received bytes only.

    Attributes:
        received: bytes received.
        reached: the offset behind the last byte that is known to be in the file.
        end: the end of the file, or None while unknown.
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
        """The bytes from the beginning of the file to its first gap."""
        pieces: list[bytes] = []
        reached = 0
        while (piece := self._pieces.get(reached)) is not None:
            pieces.append(piece)
            reached += len(piece)
        return b"".join(pieces)

    @property
    def pieces(self) -> int:
        """The number of pieces received."""
        return len(self._pieces)

    @property
    def gaps(self) -> tuple[tuple[int, int], ...]:
        """First byte and end of what is missing, as far as it is known to be in the file, rising."""
        return tuple(self._gaps)

    @property
    def beginning(self) -> bytes:
        """The first piece; b"" before it is received."""
        return self._pieces.get(0, b"")

    def take(self, offset: int, data: bytes) -> bool:
        """Store a piece and return whether it has new bytes. Bytes behind the end are dropped."""
        stop = offset + len(data)
        if self.end is not None:
            stop = min(stop, self.end)
        before = self.received
        if offset > self.reached and offset < stop:
            if len(self._gaps) >= GAPS_MAX:
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
        """Set the end of the file; bytes before it may still be missing."""
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
        """Yield the offsets of reads of `size` bytes that fill the gaps, rising."""
        for first, last in self._gaps:
            yield from range(first, last, size)

    def is_missing(self, offset: int) -> bool:
        """Return whether the byte at this offset is missing, as far as it is known to be in the file."""
        return any(first <= offset < last for first, last in self._gaps)

    def _keep(self, at: int, piece: bytes) -> None:
        self._pieces[at] = piece
        self.received += len(piece)
