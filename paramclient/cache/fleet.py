"""The same parameters of many vehicles beside each other: who differs, and since when.

Only the parameters that are asked for are read, and put together by value before anything is made of them: a
fleet has many vehicles and few values. The checksums of whole tables are not looked at here. Each function
that takes a session works inside its caller's transaction.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Final, TypeAlias

from paramclient.cache.rows import cells, read_param
from paramclient.cache.transaction import Session
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
    """One vehicle of those that are compared.

    Attributes:
        key: the name under which its tables are kept.
        system: system id under which it was last seen.
        complete: its table was heard to the end: what is not in it, the vehicle does not have.
    """

    key: str
    system: int
    complete: bool


@dataclass(frozen=True, slots=True)
class Holder:
    """A vehicle with what it has.

    Attributes:
        vehicle: which.
        since: when it was heard to change to this, or that it has this, in unix seconds. None where that is
            not known, and for those that do not stand out.
        changed: `since` is the moment of a change. Else it was so at that moment already, and maybe before.
    """

    vehicle: FleetVehicle
    since: float | None = None
    changed: bool = False


@dataclass(frozen=True, slots=True)
class FleetValue:
    """A value, and who has it.

    Attributes:
        param: the value. Its index is None.
        holders: the vehicles, in the order of `FleetDiff.vehicles`.
        agrees: it is what is wanted, or, where nothing is, what more vehicles have than any other value.
    """

    param: Param
    holders: tuple[Holder, ...]
    agrees: bool


@dataclass(frozen=True, slots=True)
class NameSpread:
    """One parameter across the vehicles.

    Attributes:
        name: param_id.
        wanted: what it is compared with; None where the vehicles are compared with each other.
        values: the values there are, the most common first.
        lacking: the vehicles that do not have it.
        unknown: those of which it was never heard, and whose table is not complete.
    """

    name: str
    wanted: WrittenParam | None
    values: tuple[FleetValue, ...]
    lacking: tuple[Holder, ...]
    unknown: tuple[Holder, ...]

    @property
    def differs(self) -> bool:
        """Whether any vehicle stands out, or cannot be told not to."""
        return bool(self.lacking or self.unknown) or not all(each.agrees for each in self.values)


@dataclass(frozen=True, slots=True)
class FleetDiff:
    """How vehicles stand to each other, or to what is wanted of them.

    Attributes:
        component: the id of the component that was compared.
        vehicles: those that have a table of it, the one seen last first.
        names: what was asked for, in that order.
    """

    component: int
    vehicles: tuple[FleetVehicle, ...]
    names: tuple[NameSpread, ...]

    @property
    def differs(self) -> bool:
        """Whether anything stands out."""
        return any(each.differs for each in self.names)


Cells: TypeAlias = tuple[int, int, int]
"""type, bits, is_raw: a value as the database has it."""

_CHUNK: Final = 500
"""Names in one statement: older builds of SQLite take 999 variables."""


def spread(
    name: str,
    wanted: WrittenParam | None,
    values: Mapping[Cells, Sequence[Holder]],
    without: Iterable[Holder] = (),
) -> NameSpread:
    """Put vehicles together that have the same value, and say which of the values agree.

    Args:
        wanted: what is wanted of all; None to compare them with each other. Then the most common value is
            the one that agrees, and none does where two are equally common.
        values: who has what.
        without: those that have no such parameter.

    Raises:
        Damaged: what is no value.
    """
    same: dict[tuple[int, bool, int], tuple[Param, list[Holder]]] = {}
    for value, holders in values.items():
        param = read_param(name, *value)
        bits = 0 if same_bits(param.type, param.bits, 0) else param.bits  # -0 is no other value than 0
        same.setdefault((param.type, param.is_raw, bits), (param, []))[1].extend(holders)
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


def fleet_diff(session: Session, component: int, wanted: Mapping[str, WrittenParam | None]) -> FleetDiff:
    """Compare the vehicles in what is wanted, by name; None stands for: with each other."""
    owners = {
        owner: FleetVehicle(key, system, complete)
        for owner, key, system, complete in session.tables_of(component)
    }
    places = {owner: place for place, owner in enumerate(owners)}
    holders = [Holder(vehicle) for vehicle in owners.values()]
    values: defaultdict[str, dict[Cells, list[Holder]]] = defaultdict(dict)
    for row, same in session.holders(list(owners), list(wanted)).items():
        name, *value = cells(row, "siii")
        values[name][tuple(value)] = [holders[place] for place in sorted(places[each] for each in same)]
    names = []
    for name, written in wanted.items():
        without: list[Holder] = []
        if sum(map(len, values[name].values())) < len(holders):
            having = {holder.vehicle.key for same in values[name].values() for holder in same}
            without = [holder for holder in holders if holder.vehicle.key not in having]
        names.append(spread(name, written, values[name], without))
    return FleetDiff(component, tuple(owners.values()), tuple(_dated(session, owners, names)))


def names_like(session: Session, component: int, pattern: str) -> list[str]:
    """The names that any vehicle has and that fit a pattern of the shell, in alphabetical order.

    What is no pattern stands for itself, whether any vehicle has it or not.
    """
    start = pattern[: next((at for at, sign in enumerate(pattern) if sign in "*?["), len(pattern))]
    if start == pattern:
        return [pattern]
    names = session.names_between(component, start, f"{start}\U0010ffff")
    return sorted(name for name in names if fnmatchcase(name, pattern))


def _dated(
    session: Session, owners: Mapping[int, FleetVehicle], names: Iterable[NameSpread]
) -> Iterator[NameSpread]:
    """The same, with the times of those that stand out."""
    names = list(names)
    standing_out: defaultdict[str, list[str]] = defaultdict(list)
    for each in names:
        for holder in (*_others(each), *each.lacking):
            standing_out[holder.vehicle.key].append(each.name)
    ids = {vehicle.key: owner for owner, vehicle in owners.items()}
    found = _times(session, {ids[key]: some for key, some in standing_out.items()})
    times = {key: found[ids[key]] for key in standing_out}

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
    session: Session, named: Mapping[int, Sequence[str]]
) -> Mapping[int, dict[str, tuple[float, bool]]]:
    """By table and name, since when it is as it is, and whether that is the moment of a change."""
    rows: list[tuple[int, str, str, int, float]] = []
    for start in range(0, max(map(len, named.values()), default=0), _CHUNK):
        parts = {owner: names[start : start + _CHUNK] for owner, names in named.items()}
        rows += session.since({owner: names for owner, names in parts.items() if names})
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
