"""Counts, ages and lists of names in messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

_AGES: Final = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
"""Units of an age in seconds, longest first. An age is given in the longest unit of which it has two."""


def age_in_words(seconds: float) -> str:
    """Return an age: `9 min`."""
    for length, unit in _AGES:
        if seconds >= 2 * length:
            return f"{seconds // length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


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
