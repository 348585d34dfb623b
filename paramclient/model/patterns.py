"""Selection of parameter names by name or by shell pattern such as `MC_*`."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from fnmatch import translate
from typing import Final

__all__ = ["NameChoice", "is_pattern"]

UNMATCHED_LISTED_MAX: Final = 20
"""Names and patterns without a match that one message lists, so that the message stays readable."""


def is_pattern(text: str) -> bool:
    """Return whether a text is a pattern; otherwise it is an exact name."""
    return not _WILDCARDS.isdisjoint(text)


class NameChoice:
    """A selection of names. An exact name costs one look-up, a pattern one comparison with each name.

    Args:
        given: exact names or shell patterns (`MC_*`, `SERVO?_TRIM`), case-sensitive.
    """

    def __init__(self, given: Iterable[str]) -> None:
        each = dict.fromkeys(given)
        self._names = {name: None for name in each if not is_pattern(name)}
        self._patterns = {text: re.compile(translate(text)) for text in each if is_pattern(text)}

    def has(self, name: str) -> bool:
        """Return whether a name is selected."""
        return name in self._names or any(pattern.match(name) for pattern in self._patterns.values())

    def choose(self, known: Collection[str]) -> tuple[set[str], str]:
        """Select among these names.

        Returns:
            The selected names; and a text that lists the names and patterns without a match, or "".
        """
        names = frozenset(known)
        chosen = {name for name in self._names if name in names}
        useless = [name for name in self._names if name not in names]
        for text, pattern in self._patterns.items():
            fitting = [name for name in names if pattern.match(name)]
            chosen.update(fitting)
            if not fitting:
                useless.append(text)
        more = len(useless) - UNMATCHED_LISTED_MAX
        words = " or ".join(useless[:UNMATCHED_LISTED_MAX])
        return chosen, f"{words} (and {more} more)" if more > 0 else words


_WILDCARDS: Final = frozenset("*?[")
