"""Parameters that `apply` leaves out, orders specially or reboots for, read from `apply_rules.toml`."""

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
from paramclient.model.names import NameChoice, is_group_switch

__all__ = ["CATEGORIES", "OUT_OF_RANGE", "READ_ONLY", "ApplyRule", "ApplyRules", "Choice", "rules_for"]

READ_ONLY: Final = "read-only"
"""The category of parameters that the vehicle lets no client write."""
OUT_OF_RANGE: Final = "out-of-range"
"""The category of values outside of the range in the metadata."""
CATEGORIES: Final = (
    *("identity", "hardware", "calibration", "measured", "counter", "action"),
    *(READ_ONLY, OUT_OF_RANGE),
)
"""The categories that `include` accepts besides globs. The last two are also assigned from metadata."""


@dataclass(frozen=True, slots=True)
class ApplyRule:
    """One entry of `apply_rules.toml`.

    Attributes:
        names: globs, in the case of param_id.
        reason: the predicate of a sentence whose subject is the parameter, such as "is counted by the
            vehicle".
        category: one of `CATEGORIES` for a parameter that is left out; else "".
        autopilot: "px4" or "ardupilot".
        unless: values of other parameters; the entry does not apply while one of them has its value.
        elsewhere: by glob, the vehicles or settings that have the parameter, for globs that match nothing in
            the tables of the simulated vehicles.
        vehicle_types: the MAV_TYPEs to which the entry applies; empty for all.
    """

    names: tuple[str, ...]
    reason: str
    category: str
    autopilot: str
    unless: Mapping[str, int]
    elsewhere: Mapping[str, str]
    vehicle_types: tuple[int, ...] = ()


class ApplyRules:
    """The entries of `apply_rules.toml` for one autopilot, and its group switches.

    Attributes:
        entries: the entries by section of the file.
        autopilot: "px4" or "ardupilot"; any other one for both.
    """

    def __init__(self, entries: Mapping[str, Sequence[ApplyRule]], autopilot: str) -> None:
        self.entries = entries
        self.autopilot = autopilot
        self._patterns = {
            section: [(_pattern(rule.names), rule) for rule in rules] for section, rules in entries.items()
        }

    def left_out(self, name: str, value_of: Callable[[str], object] | None = None) -> ApplyRule | None:
        """Return the entry that leaves a parameter out by default, or None.

        Args:
            name: param_id.
            value_of: returns the value of another parameter, or the value it is to get; by default no other
                parameter has a value.
        """
        for pattern, rule in self._patterns["left_out"]:
            if pattern.match(name) and (
                value_of is None or all(value_of(other) != value for other, value in rule.unless.items())
            ):
                return rule
        return None

    def chooses_frame(self, name: str) -> bool:
        """Return whether the parameter selects the airframe."""
        return self._first("frame", name) is not None

    def resets(self, name: str) -> bool:
        """Return whether a change of the parameter resets other parameters at the next reboot."""
        return self._first("resets", name) is not None

    def reveals(self, name: str) -> bool:
        """Return whether a change of the parameter may show or hide other parameters."""
        return is_group_switch(name, self.autopilot)

    def brings_any(self, name: str) -> bool:
        """Return whether a change of the parameter may reveal parameters whose names differ from its own."""
        return self._first("brings_any", name) is not None

    def is_last(self, name: str) -> bool:
        """Return whether a change of the parameter may end the connection, so that it is written last."""
        return self._first("last", name) is not None

    def is_system_id(self, name: str) -> bool:
        """Return whether the parameter is the MAVLink system id."""
        return self._first("system_id", name) is not None

    def needs_reboot(self, name: str, vehicle_type: int | None = None) -> bool:
        """Return whether the parameter is listed as one that takes effect after a reboot.

        Metadata may name further parameters.

        Args:
            name: param_id.
            vehicle_type: MAV_TYPE of the vehicle; None if unknown.
        """
        return any(
            pattern.match(name) and (not rule.vehicle_types or vehicle_type in rule.vehicle_types)
            for pattern, rule in self._patterns["reboot"]
        )

    def _first(self, section: str, name: str) -> ApplyRule | None:
        for pattern, rule in self._patterns[section]:
            if pattern.match(name):
                return rule
        return None


class Choice:
    """The parameters that are included although `apply_rules.toml` leaves them out.

    Args:
        include: names of `CATEGORIES`, and globs of parameter names; a single one may be a string.

    Raises:
        UsageError: an element is neither a category nor an upper-case glob.
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
        """Return whether the parameter `name`, which is left out for `category`, is included."""
        return category in self._categories or self._names.has(name)


@cache
def rules_for(autopilot: str, *, is_extended: bool = False) -> ApplyRules:
    """Return the entries for "px4" or "ardupilot"; for any other autopilot, the entries of both.

    If several entries match a parameter, the first one applies. The entries are of the plain parameters of
    autopilots: there are none for extended ones.
    """
    found: dict[str, list[ApplyRule]] = {}
    if is_extended:
        return ApplyRules(dict.fromkeys(_read(), ()), autopilot)
    known = autopilot in ("px4", "ardupilot")
    for section, entries in _read().items():
        found[section] = [
            ApplyRule(
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
    return ApplyRules(found, autopilot)


def _read() -> dict[str, list[dict[str, Any]]]:
    text = resources.files(__package__).joinpath("apply_rules.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _pattern(globs: Sequence[str]) -> re.Pattern[str]:
    return re.compile("|".join(map(fnmatch.translate, globs)))
