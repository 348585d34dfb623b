"""Fleet comparison: parameters of many vehicles, the vehicles that differ, and since when.

Only the requested parameters are read, and they are grouped by value before they are converted: a fleet has
many vehicles and few values. Checksums of whole tables are not verified here. Each function with a
transaction runs inside the transaction of its caller.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Final, TypeAlias

from paramclient.cache.cells import cells
from paramclient.cache.param_columns import read_param
from paramclient.cache.transaction import Transaction
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Param, same_bits

__all__ = [
    "FleetDiff",
    "FleetValue",
    "FleetVehicle",
    "Holder",
    "NameSpread",
    "fleet_diff",
    "names_like",
    "spread",
]


@dataclass(frozen=True, slots=True)
class FleetVehicle:
    """A vehicle in a comparison.

    Attributes:
        key: its key in the cache.
        system: its last system id.
        complete: whether its table is complete: the vehicle has no parameter outside it.
    """

    key: str
    system: int
    complete: bool


@dataclass(frozen=True, slots=True)
class Holder:
    """A vehicle with a value, or without a parameter.

    Attributes:
        vehicle: the vehicle.
        since: time of the change to this value, or of its first observation, in unix seconds. None if it is
            not known, and for vehicles that agree.
        changed: whether `since` is the time of a change. Otherwise the value existed at that time already,
            and possibly before.
    """

    vehicle: FleetVehicle
    since: float | None = None
    changed: bool = False


@dataclass(frozen=True, slots=True)
class FleetValue:
    """A value, and the vehicles that have it.

    Attributes:
        param: the value. Its index is None.
        holders: the vehicles, in the order of `FleetDiff.vehicles`.
        agrees: whether it is the wanted value or, without a wanted value, more common than any other value.
    """

    param: Param
    holders: tuple[Holder, ...]
    agrees: bool


@dataclass(frozen=True, slots=True)
class NameSpread:
    """One parameter across the vehicles.

    Attributes:
        name: param_id.
        wanted: the wanted value; None if the vehicles are compared with each other.
        values: the existing values, the most common first.
        lacking: vehicles without the parameter; without a wanted value, only those with the autopilot of a
            vehicle that has it.
        unknown: the same for vehicles with a partial table, which may have it.
    """

    name: str
    wanted: WrittenParam | None
    values: tuple[FleetValue, ...]
    lacking: tuple[Holder, ...]
    unknown: tuple[Holder, ...]

    @property
    def differs(self) -> bool:
        """Whether any vehicle differs, lacks the parameter, or has an unknown value."""
        return bool(self.lacking or self.unknown) or not all(each.agrees for each in self.values)


@dataclass(frozen=True, slots=True)
class FleetDiff:
    """Result of a comparison of vehicles with each other, or with wanted values.

    Attributes:
        component: id of the compared component.
        vehicles: vehicles with a table of the component, the last seen first.
        names: the requested parameters, in the order of the request.
    """

    component: int
    vehicles: tuple[FleetVehicle, ...]
    names: tuple[NameSpread, ...]

    @property
    def differs(self) -> bool:
        """Whether any parameter differs."""
        return any(each.differs for each in self.names)


Cells: TypeAlias = tuple[int, int, int]
"""A value in the database: type, bits, is_raw."""

_NAMES_PER_STATEMENT: Final = 500
"""Maximum number of names in one statement: older builds of SQLite allow 999 variables."""


def spread(
    name: str,
    wanted: WrittenParam | None,
    values: Mapping[Cells, Sequence[Holder]],
    without: Iterable[Holder] = (),
) -> NameSpread:
    """Group vehicles by value, and mark the values that agree.

    Args:
        name: param_id.
        wanted: the wanted value; None to compare the vehicles with each other. Then the most common value
            agrees, and no value agrees if two are equally common.
        values: vehicles by value.
        without: vehicles without the parameter in their table.

    Raises:
        Damaged: a value is not valid.
    """
    same: dict[tuple[int, bool, int], tuple[Param, list[Holder]]] = {}
    for value, holders in values.items():
        param = read_param(name, *value)
        bits = 0 if same_bits(param.type_number, param.bits, 0) else param.bits  # -0 equals 0
        same.setdefault((param.type_number, param.is_raw, bits), (param, []))[1].extend(holders)
    groups = sorted(same.values(), key=lambda group: (-len(group[1]), group[0].bits))
    is_clear = len(groups) < 2 or len(groups[0][1]) > len(groups[1][1])
    shared = tuple(
        FleetValue(param, tuple(holders), wanted.is_held_by(param) if wanted else is_clear and number == 0)
        for number, (param, holders) in enumerate(groups)
    )
    absent = tuple(without)
    return NameSpread(
        name,
        wanted,
        shared,
        lacking=tuple(each for each in absent if each.vehicle.complete),
        unknown=tuple(each for each in absent if not each.vehicle.complete),
    )


def fleet_diff(
    transaction: Transaction, component: int, wanted: Mapping[str, WrittenParam | None]
) -> FleetDiff:
    """Compare all vehicles with wanted values, by name; with None, compare them with each other.

    Compared with each other, a vehicle lacks only parameters that another one with its autopilot has: the
    names of PX4 and ArduPilot have little in common.
    """
    tables = transaction.tables_of(component)
    owners = {owner: FleetVehicle(key, system, complete) for owner, key, system, complete, _ in tables}
    autopilots = {key: autopilot for _, key, _, _, autopilot in tables}
    places = {owner: place for place, owner in enumerate(owners)}
    holders = [Holder(vehicle) for vehicle in owners.values()]
    values: defaultdict[str, dict[Cells, list[Holder]]] = defaultdict(dict)
    for row, same in transaction.holders(list(owners), list(wanted)).items():
        name, *value = cells(row, "siii")
        values[name][tuple(value)] = [holders[place] for place in sorted(places[each] for each in same)]
    names = []
    for name, written in wanted.items():
        without: list[Holder] = []
        if sum(map(len, values[name].values())) < len(holders):
            having = {holder.vehicle.key for same in values[name].values() for holder in same}
            without = [holder for holder in holders if holder.vehicle.key not in having]
            if written is None:
                having_it = {autopilots[key] for key in having}
                without = [each for each in without if autopilots[each.vehicle.key] in having_it]
        names.append(spread(name, written, values[name], without))
    return FleetDiff(component, tuple(owners.values()), tuple(_dated(transaction, owners, names)))


def names_like(transaction: Transaction, component: int, patterns: Iterable[str]) -> dict[str, list[str]]:
    """Return by shell pattern the matching names of all vehicles, in alphabetical order.

    A text without pattern characters has itself as its only name, whether any vehicle has it or not.
    """
    starts = {each: re.split(r"[*?\[]", each, maxsplit=1)[0] for each in patterns}
    sought = [start for each, start in starts.items() if start != each]
    names: list[str] = []
    if sought:
        end = max(f"{start}\U0010ffff" for start in sought)
        names = sorted(transaction.names_between(component, min(sought), end))
    return {
        each: [each] if start == each else [name for name in names if fnmatchcase(name, each)]
        for each, start in starts.items()
    }


def _dated(
    transaction: Transaction, owners: Mapping[int, FleetVehicle], names: Iterable[NameSpread]
) -> Iterator[NameSpread]:
    """Add the times to the vehicles that differ."""
    names = list(names)
    deviating: defaultdict[str, list[str]] = defaultdict(list)
    for each in names:
        for holder in (*_others(each), *each.lacking):
            deviating[holder.vehicle.key].append(each.name)
    ids = {vehicle.key: owner for owner, vehicle in owners.items()}
    found = _times(transaction, {ids[key]: some for key, some in deviating.items()})
    times = {key: found[ids[key]] for key in deviating}

    def dated(holders: Iterable[Holder], name: str) -> tuple[Holder, ...]:
        return tuple(Holder(each.vehicle, *times[each.vehicle.key].get(name, ())) for each in holders)

    for each in names:
        yield replace(
            each,
            values=tuple(
                value if value.agrees else replace(value, holders=dated(value.holders, each.name))
                for value in each.values
            ),
            lacking=dated(each.lacking, each.name),
        )


def _others(of: NameSpread) -> Iterator[Holder]:
    return (holder for value in of.values if not value.agrees for holder in value.holders)


def _times(
    transaction: Transaction, named: Mapping[int, Sequence[str]]
) -> Mapping[int, dict[str, tuple[float, bool]]]:
    """Return, by table and name, the time since when the value exists, and whether it is that of a change."""
    rows: list[tuple[int, str, str, int, float]] = []
    for start in range(0, max(map(len, named.values()), default=0), _NAMES_PER_STATEMENT):
        parts = {owner: names[start : start + _NAMES_PER_STATEMENT] for owner, names in named.items()}
        rows += transaction.value_dates({owner: names for owner, names in parts.items() if names})
    known = {owner: at for owner, _, what, _, at in rows if what == "known"}
    times: defaultdict[int, dict[str, tuple[float, bool]]] = defaultdict(dict)
    for owner, name, what, _, at in rows:
        if what == "heard":
            times[owner][name] = (min(at, known.get(owner, at)), False)
    last: dict[tuple[int, str], int] = {}
    for owner, name, what, line, at in rows:
        if what == "line":
            last[owner, name] = line
            times[owner][name] = (at, True)
    for owner, name, what, line, at in rows:
        if what == "birth" and line >= last.get((owner, name), 0):
            times[owner][name] = (at, True)
    return times
