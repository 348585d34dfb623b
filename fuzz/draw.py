"""Bytes as a source of decisions: what a target makes of its input, in the order in which it asks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

__all__ = ["Draw"]

Item = TypeVar("Item")


class Draw:
    """Takes bytes from the front of an input; behind its end everything is zero."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def is_over(self) -> bool:
        """Whether every byte has been taken."""
        return self._at >= len(self._data)

    def take(self, size: int) -> bytes:
        """So many bytes, padded with zeros."""
        self._at += size
        return self._data[self._at - size : self._at].ljust(size, b"\0")

    def number(self, size: int = 1) -> int:
        """An unsigned number of so many bytes."""
        return int.from_bytes(self.take(size), "little")

    def one_of(self, items: Sequence[Item]) -> Item:
        """One of the items."""
        return items[self.number() % len(items)]

    def rest(self) -> bytes:
        """All that is left."""
        rest, self._at = self._data[self._at :], len(self._data)
        return rest
