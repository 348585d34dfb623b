"""Names of parameters: selection, similar names, switches of groups; counts and lists in messages; choices by
name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from fnmatch import translate
from typing import Final, NoReturn, TypeVar

from paramclient.errors import UsageError

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

    def choose(self, known: Collection[str], of: str = "") -> set[str]:
        """Select among these names.

        Args:
            known: the names.
            of: what has them, for the error: ` of quad.param`.

        Raises:
            UsageError: a given name or pattern has no match; the text has the most similar known names.
                Without this error, a misspelt name would go unnoticed.
        """
        chosen, unmatched = self.divide(known)
        if unmatched:
            listed = " or ".join(_with_nearest(text, known) for text in unmatched[:UNMATCHED_LISTED_MAX])
            more = len(unmatched) - UNMATCHED_LISTED_MAX
            raise UsageError(f"no parameter{of} is called {listed}{f' (and {more} more)' * (more > 0)}")
        return chosen

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
    left out. It takes about 1 ms for the names of an autopilot.
    """
    wanted = name.upper()
    head, tail = wanted[:AFFIX_LENGTH], wanted[-AFFIX_LENGTH:]
    others = {other.upper(): other for other in names if other not in (name, "")}
    near = [upper for upper in others if upper.startswith(head) or upper.endswith(tail)]
    matcher = difflib.SequenceMatcher(b=wanted)
    scored = []
    for upper in near:
        matcher.set_seq1(upper)
        if matcher.quick_ratio() >= SIMILARITY_MIN and (ratio := matcher.ratio()) >= SIMILARITY_MIN:
            scored.append((-ratio, others[upper]))
    return tuple(other for _, other in sorted(scored)[:SIMILAR_NAMES_MAX])


def did_you_mean(nearest: Sequence[str]) -> str:
    """Return the suggestion of similar names as the end of a sentence, from its semicolon; "" without any."""
    if not nearest:
        return ""
    *others, last = nearest
    return f"; did you mean {', '.join(others)} or {last}?" if others else f"; did you mean {last}?"


AnyHeld = TypeVar("AnyHeld")


class ByName(Mapping[str, AnyHeld]):
    """Base of the mappings of parameters by name. An iteration is over the names at its start.

    Attributes:
        params: the parameters.
    """

    __slots__ = ()
    params: Mapping[str, AnyHeld]

    def __getitem__(self, name: str) -> AnyHeld:
        try:
            return self.params[name]
        except KeyError:
            raise _NoSuchName(name, self.params) from None

    def __contains__(self, name: object) -> bool:
        return name in self.params

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self.params))

    def __len__(self) -> int:
        return len(self.params)


class _NoSuchName(KeyError):
    """A name, and the names that a mapping has; its text has the most similar ones."""

    def __str__(self) -> str:
        name, names = self.args
        nearest = nearest_names(name, names) if isinstance(name, str) else ()
        return f"no parameter {name}{did_you_mean(nearest) or f' among the {len(names)} known ones'}"


def is_group_switch(name: str, autopilot: str) -> bool:
    """Return whether a change of the parameter may show or hide other parameters.

    Args:
        name: param_id.
        autopilot: "px4" or "ardupilot"; for any other one, the parameters of both count.
    """
    return _CHOICES.get(autopilot, _OF_BOTH).has(name)


_CHOICES: Final = {"px4": NameChoice(PX4_SWITCHES), "ardupilot": NameChoice(ARDUPILOT_SWITCHES)}
_OF_BOTH: Final = NameChoice((*PX4_SWITCHES, *ARDUPILOT_SWITCHES))


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


class NamedChoice(StrEnum):
    """Options that a user names; UsageError for another name."""

    @classmethod
    def _missing_(cls, value: object) -> NoReturn:
        what = re.sub(r"\B(?=[A-Z])", " ", cls.__name__).lower()
        raise UsageError(f"unknown {what} {value!r}; choose one of {', '.join(cls)}")
