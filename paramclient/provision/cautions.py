"""What a set-up has to know of particular parameters, read from `cautions.toml`."""

from __future__ import annotations

import fnmatch
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

from paramclient.errors import UsageError
from paramclient.model.patterns import NameChoice

__all__ = ["CATEGORIES", "OUT_OF_RANGE", "READ_ONLY", "Caution", "Cautions", "Choice", "cautions_for"]

READ_ONLY: Final = "read-only"
OUT_OF_RANGE: Final = "out-of-range"
CATEGORIES: Final = (
    *("identity", "hardware", "calibration", "measured", "counter", "action"),
    *(READ_ONLY, OUT_OF_RANGE),
)
"""What a choice of what to include may name besides globs. The last two come from metadata too."""


@dataclass(frozen=True, slots=True)
class Caution:
    """One entry of the list.

    Attributes:
        names: globs, in the case of param_id.
        reason: why it is there; a sentence that begins with what the parameter is or does.
        category: for what is left out, one of `CATEGORIES`; else "".
        autopilot: "px4" or "ardupilot".
        unless: other parameters with values; the entry does not count while one of them has its value.
        elsewhere: by glob, where those belong that the tables of the simulated vehicles do not have.
        vehicle_types: the MAV_TYPEs for which it holds; empty for all.
    """

    names: tuple[str, ...]
    reason: str
    category: str
    autopilot: str
    unless: Mapping[str, int]
    elsewhere: Mapping[str, str]
    vehicle_types: tuple[int, ...] = ()


class Cautions:
    """The list for one autopilot.

    Attributes:
        entries: by section of the file.
    """

    def __init__(self, entries: Mapping[str, Sequence[Caution]]) -> None:
        self.entries = entries
        self._patterns = {
            section: [(_pattern(caution.names), caution) for caution in cautions]
            for section, cautions in entries.items()
        }

    def left_out(self, name: str, value_of: Callable[[str], object] | None = None) -> Caution | None:
        """Why a parameter is left out unless asked for, or None.

        Args:
            name: param_id.
            value_of: the value that another parameter has, or is to have; by default none has a value.
        """
        for pattern, caution in self._patterns["left_out"]:
            if pattern.match(name) and (
                value_of is None or all(value_of(other) != value for other, value in caution.unless.items())
            ):
                return caution
        return None

    def chooses_frame(self, name: str) -> bool:
        return self._first("frame", name) is not None

    def resets(self, name: str) -> bool:
        """Whether a change of it gives others other values at the next start."""
        return self._first("resets", name) is not None

    def reveals(self, name: str) -> bool:
        """Whether others may appear, or go, when it changes."""
        return self._first("reveals", name) is not None

    def is_last(self, name: str) -> bool:
        """Whether a change of it may cut us off."""
        return self._first("last", name) is not None

    def is_system_id(self, name: str) -> bool:
        return self._first("system_id", name) is not None

    def needs_reboot(self, name: str, vehicle_type: int | None = None) -> bool:
        """Whether it is known to take effect after a reboot; metadata may know better.

        Args:
            name: of the parameter.
            vehicle_type: MAV_TYPE of the vehicle; None where it is not known.
        """
        return any(
            pattern.match(name) and (not caution.vehicle_types or vehicle_type in caution.vehicle_types)
            for pattern, caution in self._patterns["reboot"]
        )

    def _first(self, section: str, name: str) -> Caution | None:
        for pattern, caution in self._patterns[section]:
            if pattern.match(name):
                return caution
        return None


class Choice:
    """What is included although the list leaves it out.

    Args:
        include: names of `CATEGORIES`, and globs of parameter names; one alone may be a string.

    Raises:
        UsageError: one of them is neither.
    """

    def __init__(self, include: str | Iterable[str]) -> None:
        given = (include,) if isinstance(include, str) else tuple(include)
        self._categories = frozenset(given).intersection(CATEGORIES)
        globs = [each for each in given if each not in self._categories]
        for each in globs:
            if not each or each != each.upper():
                raise UsageError(
                    f"{each!r} cannot be included: it is neither a glob of parameter names, such as "
                    f"COMPASS_OFS*, nor one of {', '.join(CATEGORIES)}"
                )
        self._names = NameChoice(globs)

    def has(self, name: str, category: str) -> bool:
        """Whether a parameter of this category is included."""
        return category in self._categories or self._names.has(name)


@cache
def cautions_for(autopilot: str) -> Cautions:
    """The list for "px4" or "ardupilot"; for any other autopilot, both.

    Of a parameter that several entries name, the first counts.
    """
    found: dict[str, list[Caution]] = {}
    known = autopilot in ("px4", "ardupilot")
    for section, entries in _read().items():
        found[section] = [
            Caution(
                names=tuple(entry["names"]),
                reason=entry["reason"],
                category=entry.get("category", ""),
                autopilot=entry["autopilot"],
                unless=entry.get("unless", {}),
                elsewhere=entry.get("elsewhere", {}),
                vehicle_types=tuple(entry.get("vehicle_types", ())),
            )
            for entry in entries
            if not known or entry["autopilot"] == autopilot
        ]
    return Cautions(found)


def _read() -> dict[str, list[dict[str, Any]]]:
    text = resources.files(__package__).joinpath("cautions.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _pattern(globs: Sequence[str]) -> re.Pattern[str]:
    return re.compile("|".join(map(fnmatch.translate, globs)))
