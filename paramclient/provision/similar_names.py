"""Names that look like a mistyped one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Final

__all__ = ["nearest_names"]

MOST_NAMES: Final = 3
LIKENESS: Final = 0.8
"""Of two names of ten characters that differ in two of them. Unrelated ones share more than half by chance:
`ATC_RAT_RLL_P` and `ATC_RAT_YAW_P`."""
SHARED_END: Final = 2
"""Characters at the start or at the end that two names share, or they are not compared: it takes long."""


def nearest_names(name: str, names: Iterable[str]) -> tuple[str, ...]:
    """The names that look most like this one, the likeliest first; in any case of the letters."""
    wanted = name.upper()
    likely = [
        other
        for other in sorted(names)
        if other[:SHARED_END] == wanted[:SHARED_END] or other[-SHARED_END:] == wanted[-SHARED_END:]
    ]
    matcher = difflib.SequenceMatcher(autojunk=False)
    matcher.set_seq2(wanted)
    scored = []
    for other in likely:
        matcher.set_seq1(other)
        if matcher.real_quick_ratio() >= LIKENESS and matcher.quick_ratio() >= LIKENESS:
            scored.append((-matcher.ratio(), other))
    return tuple(other for score, other in sorted(scored)[:MOST_NAMES] if -score >= LIKENESS)
