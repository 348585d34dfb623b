"""Parameter names that are similar to a mistyped one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Final

__all__ = ["nearest_names"]

SIMILAR_NAMES_MAX: Final = 3
"""Names that are suggested for one mistyped name, so that the message stays short."""
SIMILARITY_MIN: Final = 0.8
"""Ratio of `difflib.SequenceMatcher` from which two names count as similar: names of ten characters that
differ in two of them. Unrelated names share more than half by chance: `ATC_RAT_RLL_P` and `ATC_RAT_YAW_P`."""
AFFIX_LENGTH: Final = 2
"""Characters at the start or at the end that two names must share before they are compared: a comparison
is slow."""


def nearest_names(name: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names most similar to `name`, most similar first, at most `SIMILAR_NAMES_MAX`.

    The case of the letters of `name` does not matter.
    """
    wanted = name.upper()
    likely = [
        other
        for other in sorted(names)
        if other[:AFFIX_LENGTH] == wanted[:AFFIX_LENGTH] or other[-AFFIX_LENGTH:] == wanted[-AFFIX_LENGTH:]
    ]
    matcher = difflib.SequenceMatcher(autojunk=False)
    matcher.set_seq2(wanted)
    scored = []
    for other in likely:
        matcher.set_seq1(other)
        if matcher.real_quick_ratio() >= SIMILARITY_MIN and matcher.quick_ratio() >= SIMILARITY_MIN:
            scored.append((-matcher.ratio(), other))
    return tuple(other for score, other in sorted(scored)[:SIMILAR_NAMES_MAX] if -score >= SIMILARITY_MIN)
