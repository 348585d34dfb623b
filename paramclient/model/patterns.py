"""Selection of parameter names by name or by shell pattern such as `MC_*`."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from fnmatch import translate
from typing import Final

from paramclient.model.similar_names import nearest_names

__all__ = ["NameChoice", "is_pattern"]

UNMATCHED_LISTED_MAX: Final = 20
"""Names and patterns without a match that one message lists, so that the message stays readable."""


def is_pattern(text: str) -> bool:
    """Return whether a text is a pattern; otherwise it is an exact name."""
    return not _WILDCARDS.isdisjoint(text)


class NameChoice:
    """A selection of names. An exact name costs one look-up, a pattern one comparison with each name.

    Args:
        given: exact names or shell patterns (`MC_*`, `SERVO?_TRIM`). Upper and lower case do not matter.
    """

    def __init__(self, given: Iterable[str]) -> None:
        each = dict.fromkeys(given)
        self._names = {name.upper(): name for name in each if not is_pattern(name)}
        self._patterns = {
            text: re.compile(translate(text), re.IGNORECASE) for text in each if is_pattern(text)
        }

    def has(self, name: str) -> bool:
        """Return whether a name is selected."""
        return name.upper() in self._names or any(pattern.match(name) for pattern in self._patterns.values())

    def choose(self, known: Collection[str]) -> tuple[set[str], str]:
        """Select among these names.

        Returns:
            The selected names; and a text that lists the names and patterns without a match, with the most
            similar known names, or "".
        """
        chosen, unmatched = self.divide(known)
        listed = [_with_nearest(text, known) for text in unmatched[:UNMATCHED_LISTED_MAX]]
        more = len(unmatched) - len(listed)
        words = " or ".join(listed)
        return chosen, f"{words} (and {more} more)" if more > 0 else words

    def divide(self, known: Collection[str]) -> tuple[set[str], list[str]]:
        """Return the selected ones of these names, and the given names and patterns without a match."""
        names = frozenset(known)
        chosen = {name for name in names if name.upper() in self._names}
        found = {name.upper() for name in chosen}
        unmatched = [name for upper, name in self._names.items() if upper not in found]
        for text, pattern in self._patterns.items():
            fitting = [name for name in names if pattern.match(name)]
            chosen.update(fitting)
            if not fitting:
                unmatched.append(text)
        return chosen, unmatched


def _with_nearest(text: str, known: Collection[str]) -> str:
    nearest = () if is_pattern(text) else nearest_names(text, known)
    return f"{text} (did you mean {', '.join(nearest)}?)" if nearest else text


_WILDCARDS: Final = frozenset("*?[")
