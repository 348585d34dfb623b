"""Names chosen by name, or by patterns of the shell such as `MC_*`."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from fnmatch import translate
from typing import Final

__all__ = ["NameChoice", "is_pattern"]

NAMED_MAX: Final = 20
"""Names and patterns that one message lists."""


def is_pattern(text: str) -> bool:
    """Whether a text is a pattern; else it is the name that it stands for."""
    return not _SIGNS.isdisjoint(text)


class NameChoice:
    """A choice of names. An exact name costs one look-up, a pattern one comparison with each name.

    Args:
        given: names, or patterns of the shell (`MC_*`, `SERVO?_TRIM`), in the spelling of the names.
    """

    def __init__(self, given: Iterable[str]) -> None:
        each = dict.fromkeys(given)
        self._names = {name: None for name in each if not is_pattern(name)}
        self._patterns = {text: re.compile(translate(text)) for text in each if is_pattern(text)}

    def has(self, name: str) -> bool:
        """Whether a name is chosen."""
        return name in self._names or any(pattern.match(name) for pattern in self._patterns.values())

    def choose(self, known: Collection[str]) -> tuple[set[str], str]:
        """Choose among these names.

        Returns:
            The names that are chosen; and, in words, the names and patterns that fit none, or "".
        """
        names = frozenset(known)
        chosen = {name for name in self._names if name in names}
        useless = [name for name in self._names if name not in names]
        for text, pattern in self._patterns.items():
            fitting = [name for name in names if pattern.match(name)]
            chosen.update(fitting)
            if not fitting:
                useless.append(text)
        more = len(useless) - NAMED_MAX
        words = " or ".join(useless[:NAMED_MAX])
        return chosen, f"{words} (and {more} more)" if more > 0 else words


_SIGNS: Final = frozenset("*?[")
