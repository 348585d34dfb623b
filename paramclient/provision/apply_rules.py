"""Parameters that `apply` leaves out, orders specially or reboots for, read from `apply_rules.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, Final

from paramclient.errors import UsageError
from paramclient.model.names import NameChoice

READ_ONLY: Final = "read-only"
"""The category of parameters that the vehicle lets no client write."""
OUT_OF_RANGE: Final = "out-of-range"
"""The category of values outside of the range in the metadata."""
ACTION: Final = "action"
"""The category of parameters that make the vehicle do something, such as to reset all others. None is
included: `set` writes them."""
CATEGORIES: Final = ("identity", "hardware", "calibration", "measured", "counter", READ_ONLY, OUT_OF_RANGE)
"""The categories that `include` accepts besides globs. The last two are also assigned from metadata."""


@dataclass(frozen=True, kw_only=True)
class ApplyRule:
    """One entry of `apply_rules.toml`.

    Attributes:
        autopilot: "px4" or "ardupilot".
        names: the parameters.
        reason: the predicate of a sentence whose subject is the parameter, such as "is counted by the
            vehicle".
        category: `ACTION` or one of `CATEGORIES` for a parameter that is left out; else "".
        unless: values of other parameters; the entry does not apply while one of them has its value.
        vehicle_types: the MAV_TYPEs to which the entry applies; empty for all.
    """

    autopilot: str
    names: NameChoice
    reason: str
    category: str = ""
    unless: Mapping[str, int] = field(default_factory=dict)
    vehicle_types: Sequence[int] = ()


@dataclass(frozen=True, slots=True)
class ApplyRules:
    """The entries of `apply_rules.toml` for one autopilot.

    Attributes:
        sections: the entries by section of the file. If several entries of a section match a parameter, the
            first one applies.
    """

    sections: Mapping[str, Sequence[ApplyRule]]

    def left_out(self, name: str, value_of: Callable[[str], object] = lambda _: None) -> ApplyRule | None:
        """Return the entry that leaves a parameter out by default, or None.

        Args:
            name: param_id.
            value_of: returns the value of another parameter, or the value it is to get; by default no other
                parameter has a value.
        """
        rules = (rule for rule in self.sections["left_out"] if rule.names.has(name))
        return next((each for each in rules if all(value_of(n) != v for n, v in each.unless.items())), None)

    def has(self, section: str, name: str) -> bool:
        """Return whether a section has a parameter.

        Sections are `frame` (selects the airframe), `resets` (gives others new values at the next start),
        `brings_any` (may reveal parameters with any name), `last` (may end the connection, and is written
        last), and `system_id`.
        """
        return any(rule.names.has(name) for rule in self.sections[section])

    def needs_reboot(self, name: str, vehicle_type: int | None = None) -> bool:
        """Return whether the parameter is listed as one that takes effect after a reboot.

        Metadata may name further parameters.

        Args:
            name: param_id.
            vehicle_type: MAV_TYPE of the vehicle; None if unknown.
        """
        return any(
            rule.names.has(name) and (not rule.vehicle_types or vehicle_type in rule.vehicle_types)
            for rule in self.sections["reboot"]
        )


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
        """Return whether a parameter that is left out for `category` is included."""
        return category in self._categories or self._names.has(name)


@cache
def rules_for(autopilot: str, *, is_extended: bool = False) -> ApplyRules:
    """Return the entries for "px4" or "ardupilot"; for any other autopilot, the entries of both.

    The entries are of the plain parameters of autopilots: there are none for extended ones.
    """
    text = resources.files(__package__).joinpath("apply_rules.toml").read_text(encoding="utf-8")
    entries: dict[str, list[dict[str, Any]]] = tomllib.loads(text)
    known = (autopilot,) if autopilot in ("px4", "ardupilot") else ("px4", "ardupilot")
    fitting = () if is_extended else known
    return ApplyRules(
        {
            section: [
                ApplyRule(**entry | {"names": NameChoice(entry["names"])})
                for entry in found
                if entry["autopilot"] in fitting
            ]
            for section, found in entries.items()
        }
    )
