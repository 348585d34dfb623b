"""Names of parameters: selection by name or pattern, similar names, and the switches of groups."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Sequence
from fnmatch import translate
from typing import Final

__all__ = [
    "ARDUPILOT_SWITCHES",
    "PX4_SWITCHES",
    "NameChoice",
    "did_you_mean",
    "is_group_switch",
    "is_pattern",
    "nearest_names",
    "unknown_name",
]

UNMATCHED_LISTED_MAX: Final = 20
"""Names and patterns without a match that one message lists, so that the message stays readable."""
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

PX4_SWITCHES: Final = ("*_EN", "*_ENABLE", "CA_ROTOR_COUNT", "CA_SV_CS_COUNT", "CAL_*_ID", "UAVCAN_ENABLE")
"""Patterns of parameters of PX4 that bring others into use: PX4 then lists them."""
ARDUPILOT_SWITCHES: Final = (
    *("*_ENABLE", "*_ENABLED", "*_TYPE", "*_MONITOR", "CAN_P?_DRIVER", "CAN_D?_PROTOCOL"),
    *("COMPASS_PMOT_EN", "RELAY?_FUNCTION"),
)
"""Patterns of parameters of ArduPilot that show a group of others."""

_WILDCARDS: Final = frozenset("*?[")


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
    others = [other for other in names if other not in (name, "")]
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
    """Return the suggestion of similar names as the end of a sentence, from its semicolon; "" without any."""
    if not nearest:
        return ""
    *others, last = nearest
    return f"; did you mean {', '.join(others)} or {last}?" if others else f"; did you mean {last}?"


def unknown_name(name: object, names: Collection[str], *, among: bool = False) -> KeyError:
    """Return the KeyError for a parameter that a mapping does not have, with the most similar names.

    Args:
        name: the name.
        names: the names that the mapping has.
        among: without similar names, give the number of names: the vehicle may have further parameters.
    """
    nearest = nearest_names(name, names) if isinstance(name, str) else ()
    if nearest:
        return KeyError(f"no parameter {name}{did_you_mean(nearest)}")
    return KeyError(f"no parameter {name}{f' among the {len(names)} known ones' if among else ''}")


def is_group_switch(name: str, autopilot: str) -> bool:
    """Return whether a change of the parameter may show or hide other parameters.

    Args:
        name: param_id.
        autopilot: "px4" or "ardupilot"; for any other one, the parameters of both count.
    """
    return _CHOICES.get(autopilot, _OF_BOTH).has(name)


_CHOICES: Final = {"px4": NameChoice(PX4_SWITCHES), "ardupilot": NameChoice(ARDUPILOT_SWITCHES)}
_OF_BOTH: Final = NameChoice((*PX4_SWITCHES, *ARDUPILOT_SWITCHES))
