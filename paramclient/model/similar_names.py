"""Parameter names that are similar to a mistyped one."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Sequence
from typing import Final

__all__ = ["did_you_mean", "nearest_names", "unknown_name"]

SIMILAR_NAMES_MAX: Final = 3
"""Names that are suggested for one mistyped name, so that the message stays short."""
SIMILARITY_MIN: Final = 0.8
"""Ratio of `difflib.SequenceMatcher` from which two names count as similar: names of ten characters that
differ in two of them. Unrelated names share more than half by chance: `ATC_RAT_RLL_P` and `ATC_RAT_YAW_P`."""
AFFIX_LENGTH: Final = 2
"""Characters at the start or at the end that two names must share before they are compared: a comparison
is slow."""
COMPARED_NAMES_MAX: Final = 250
"""Names that are compared: each takes about 10 µs. An autopilot has fewer with one start or end."""


def nearest_names(name: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names most similar to `name`, most similar first, at most `SIMILAR_NAMES_MAX`.

    Upper and lower case do not matter: a name that differs only in them is the first one. `name` itself is
    left out. Of more than `COMPARED_NAMES_MAX` names with the start or the end of `name`, those that share
    more characters are compared. It takes less than 1 ms for the names of an autopilot, and 8 ms for 10,000
    names.
    """
    upper_name = name.upper()
    matcher = difflib.SequenceMatcher(autojunk=False)
    matcher.set_seq2(upper_name)
    scored = []
    for upper, other in _candidates(upper_name, name, names):
        matcher.set_seq1(upper)
        if matcher.real_quick_ratio() >= SIMILARITY_MIN and matcher.quick_ratio() >= SIMILARITY_MIN:
            scored.append((-matcher.ratio(), other))
    return tuple(other for score, other in sorted(scored)[:SIMILAR_NAMES_MAX] if -score >= SIMILARITY_MIN)


def _candidates(upper_name: str, name: str, names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the names to compare with `name`, each in upper case and as given."""
    length = AFFIX_LENGTH
    others = [other for other in names if other != name]
    head, tail = upper_name[:length], upper_name[-length:]
    found = [
        pair
        for pair in zip(map(str.upper, others), others, strict=True)  # one pair at a time: names are many
        if pair[0].startswith(head) or pair[0].endswith(tail)
    ]
    while len(found) > COMPARED_NAMES_MAX and length < len(upper_name):
        length *= 2
        head, tail = upper_name[:length], upper_name[-length:]
        closer = [pair for pair in found if pair[0].startswith(head) or pair[0].endswith(tail)]
        if not closer:
            break
        found = closer
    return sorted(found)[:COMPARED_NAMES_MAX]


def did_you_mean(nearest: Sequence[str]) -> str:
    """Return the suggestion of similar names as a sentence that begins with a space; "" without any."""
    if not nearest:
        return ""
    *others, last = nearest
    return f" Did you mean {', '.join(others)} or {last}?" if others else f" Did you mean {last}?"


def unknown_name(name: object, names: Collection[str], *, among: bool = False) -> KeyError:
    """Return the KeyError for a parameter that a mapping does not have, with the most similar names.

    Args:
        name: the name.
        names: the names that the mapping has.
        among: without similar names, give the number of names: the vehicle may have further parameters.
    """
    nearest = nearest_names(name, names) if isinstance(name, str) else ()
    if nearest:
        return KeyError(f"no parameter {name}.{did_you_mean(nearest)}")
    return KeyError(f"no parameter {name}{f' among the {len(names)} known ones' if among else ''}")
