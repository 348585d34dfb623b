"""Counts and lists of names in messages."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["counted", "first_of"]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 parameter`, `2 parameters`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def first_of(words: Sequence[object], limit: int) -> str:
    """Return the first words and the number of further ones: `A, B and 3 more`.

    Args:
        words: names or numbers.
        limit: words that are shown at most, so that the message stays readable.
    """
    more = len(words) - limit
    return ", ".join(map(str, words[:limit])) + (f" and {more} more" if more > 0 else "")
