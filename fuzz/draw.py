"""A source of decisions that reads values from the bytes of an input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

__all__ = ["Draw"]

Item = TypeVar("Item")


class Draw:
    """Reads values from the start of an input; after its end, all bytes are zero."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def is_over(self) -> bool:
        """Whether all bytes have been read."""
        return self._at >= len(self._data)

    def take(self, size: int) -> bytes:
        """Return `size` bytes, padded with zeros."""
        self._at += size
        return self._data[self._at - size : self._at].ljust(size, b"\0")

    def number(self, size: int = 1) -> int:
        """Return an unsigned number of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def one_of(self, items: Sequence[Item]) -> Item:
        """Return one of the items."""
        return items[self.number() % len(items)]

    def rest(self) -> bytes:
        """Return all remaining bytes."""
        rest, self._at = self._data[self._at :], len(self._data)
        return rest
