"""Vehicles in the cache by name: system id, address, kind, hardware id or key.

The only place that decides which vehicle a name means. In this order:

1. A key, as `Identity.key` has it.
2. One to three decimal digits: a system id, and nothing else. With `/` and a component id: an address. A
   vehicle with an autopilot has priority over a camera or another payload that has the same system id and a
   hardware id of its own.
3. `px4` or `ardupilot`: the only vehicle with this autopilot.
4. `uid:` and at least six hexadecimal digits: the beginning of a hardware id. `/` and a system id may follow
   for a hardware id that many vehicles share.
5. Four or more hexadecimal digits: a hardware id in full, also when all of its digits are decimal.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from paramclient.cache.records import CachedVehicle
from paramclient.errors import AmbiguousVehicle, UnknownVehicle
from paramclient.model.identity import autopilot_name, has_autopilot
from paramclient.model.names import counted

KINDS: Final = ("px4", "ardupilot")
"""Autopilots that name a vehicle where only one has them."""

PREFIX_DIGITS_MIN: Final = 6
"""Hexadecimal digits that the beginning of a hardware id has at least: fewer fit by accident, as those of a
system id do."""
VEHICLES_LISTED_MAX: Final = 50
"""Vehicles that an error message lists. A station with more has `paramclient cache list`."""

_SYSTEM_ID: Final = re.compile(r"[0-9]{1,3}")
_UID: Final = re.compile(r"(?P<prefix>uid:)?(?P<digits>[0-9a-f]+)(/(?P<system>[0-9]{1,3}))?", re.IGNORECASE)
_ADDRESS: Final = re.compile(r"([0-9]{1,3})/([0-9]{1,3})")
_NAME: Final = re.compile(
    rf"uid:.*|system:.*|[0-9]+|{_ADDRESS.pattern}|[0-9a-f]{{4,}}(/[0-9]*)?|{'|'.join(KINDS)}", re.IGNORECASE
)


def is_vehicle_name(text: str) -> bool:
    """Return whether a text can only be the name of a vehicle. The cache need not have that vehicle."""
    return _NAME.fullmatch(text) is not None


def address_of(text: str) -> tuple[int, int] | None:
    """Return the system and component id of an address such as `4/1`; None for another name."""
    found = _ADDRESS.fullmatch(text)
    return None if found is None else (int(found[1]), int(found[2]))


def find_vehicle(
    kept: Sequence[CachedVehicle],
    name: str | None,
    *,
    place: str,
    system: int | None = None,
    component: int | None = None,
) -> CachedVehicle:
    """Return the only vehicle of the cache that fits.

    Args:
        kept: the vehicles in the cache.
        name: one of the names above; None for any.
        place: the cache, for messages.
        system: only a vehicle with this system id.
        component: only a vehicle of which the table of this component is kept.

    Raises:
        UnknownVehicle: none fits, or the name can be no vehicle's.
        AmbiguousVehicle: several fit.
    """
    named, problem = (kept, None) if name is None else _named(kept, name)
    fits = [
        known
        for known in named
        if system in (None, known.identity.system) and (component is None or component in known.components)
    ]
    if len(fits) > 1 and name is not None and _SYSTEM_ID.fullmatch(name):
        fits = [known for known in fits if has_autopilot(known.identity.autopilot)] or fits
    if len(fits) == 1:
        return fits[0]
    conditions = {"vehicle": name, "system": system, "component": component}
    wanted = ", ".join(f"{what} {value}" for what, value in conditions.items() if value is not None)
    if fits:
        raise AmbiguousVehicle(
            f"{wanted or 'no name'} fits {len(fits)} vehicles in the cache {place}:{_listed(fits)}\n"
            f"Choose one by its key, as {fits[0].key}.",
            vehicles=tuple(map(str, fits)),
        )
    reason = "" if problem is None else f": {problem}"
    raise UnknownVehicle(
        f"{wanted} is not in the cache {place}{reason}. The cache holds "
        + (f"{counted(len(kept), 'vehicle')}:{_listed(kept)}" if kept else "no vehicle"),
        vehicles=tuple(map(str, kept)),
    )


def _named(kept: Sequence[CachedVehicle], name: str) -> tuple[Sequence[CachedVehicle], str | None]:
    """Return the vehicles that a name fits, and why it fits none where the name itself is the reason."""
    if same := [known for known in kept if known.key == name]:
        return same, None
    if _SYSTEM_ID.fullmatch(name):
        is_valid = 1 <= int(name) <= 255
        problem = f"no vehicle has system id {int(name)}" if is_valid else "system ids are 1 to 255"
        return [known for known in kept if known.identity.system == int(name)], problem
    if (address := address_of(name)) is not None:
        fits = [known for known in kept if known.identity.system == address[0]]
        problem = f"no vehicle has system id {address[0]} and a table of component {address[1]}"
        return [known for known in fits if address[1] in known.components], problem
    if name.lower() in KINDS:
        fits = [known for known in kept if autopilot_name(known.identity.autopilot) == name.lower()]
        return fits, f"no vehicle has the autopilot {name.lower()}"
    uid = _UID.fullmatch(name)
    if uid is None:
        if name.lower().startswith("uid:"):
            return [], "a hardware id has hexadecimal digits"
        return [], None
    digits = uid["digits"].lower()
    candidates = [
        known
        for known in kept
        if known.identity.uid is not None
        and (uid["system"] is None or known.key == f"uid:{known.identity.uid}/{int(uid['system'])}")
    ]
    if same := [known for known in candidates if known.identity.uid == digits]:
        return same, None
    if uid["prefix"] is None:
        return [], f"{name} is neither a system id nor a hardware id in full; uid: goes before a part of one"
    if len(digits) < PREFIX_DIGITS_MIN:
        return [], f"uid: takes at least {PREFIX_DIGITS_MIN} digits of a hardware id"
    return [known for known in candidates if (known.identity.uid or "").startswith(digits)], None


def _listed(vehicles: Sequence[CachedVehicle]) -> str:
    """Return a line for each vehicle."""
    lines = [f"\n  {known}" for known in vehicles[:VEHICLES_LISTED_MAX]]
    more = len(vehicles) - len(lines)
    return "".join(lines) + (f"\n  and {more} more; `paramclient cache list` shows all" if more else "")
