"""What goes into the cache and what comes out. All times are unix seconds, given by the caller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Final

from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param

__all__ = [
    "BY_US",
    "BY_VEHICLE",
    "CacheChange",
    "CachedComponent",
    "CachedSummary",
    "CachedVehicle",
    "HistoryEntry",
    "Snapshot",
    "SnapshotSummary",
    "StoredParam",
    "TableState",
    "TableUpdate",
    "by_station",
]

BY_US: Final = "us"
"""A change that one of our own writes caused; `us for NAME` where it was told for whom."""
BY_VEHICLE: Final = "vehicle"
"""A change that the vehicle made itself, or that came to light in a download."""


def by_station(system: int, component: int) -> str:
    """A change that another ground station's write caused: `station 254/190`."""
    return f"station {system}/{component}"


@dataclass(frozen=True, slots=True)
class StoredParam:
    """One parameter to keep.

    Attributes:
        param: the parameter; its trust is not kept. An index of None leaves a known index as it is, except
            in a whole table.
        heard_at: when the vehicle said so, not after the update's `at`. Of two observations of a parameter
            the later one counts, whichever is saved first.
        volatile: whether the vehicle leaves it out of its hash; None leaves what is known.
        by: who caused the change, should it be one: `BY_US`, `us for NAME`, `BY_VEHICLE` or `by_station(…)`.
    """

    param: Param
    heard_at: float
    volatile: bool | None = None
    by: str = BY_VEHICLE


@dataclass(frozen=True, slots=True)
class TableState:
    """What is known of a table as a whole.

    Attributes:
        hash: the hash under which the vehicle would confirm exactly this table; None while unknown.
        count: param_count of the vehicle.
        complete: every index was heard.
        volatile_known: which parameters are volatile was proven by computing the hash anew.
        synced_at: when the table was last proven to be the vehicle's.
        file_works: whether the vehicle, with this firmware, gives the table as one file; None while unknown.
    """

    hash: int | None = None
    count: int | None = None
    complete: bool = False
    volatile_known: bool = False
    synced_at: float | None = None
    file_works: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TableUpdate:
    """What was learnt of one component's table.

    Attributes:
        identity: the vehicle.
        component: component id.
        autopilot: MAV_AUTOPILOT of this component's heartbeat.
        at: when this was learnt.
        table: the state of the table with this update applied. None leaves it, with one exception: a change
            of what the hash covers takes the hash away.
        params: what to insert or change, in the order in which it was heard.
        removed: names that the vehicle no longer has.
        removed_at: when each of them was found missing; of the others it was at `at`.
        replace: `params` are the whole table: names that are not in it go.
        whole_at: when the vehicle was found to have no other names than those; None for `at`.
    """

    identity: Identity
    component: int
    autopilot: int
    at: float
    table: TableState | None = None
    params: Sequence[StoredParam] = ()
    removed: Sequence[str] = ()
    removed_at: Mapping[str, float] = field(default_factory=dict)
    replace: bool = False
    whole_at: float | None = None

    def gone_at(self, name: str) -> float:
        """Return when a name that this update takes away was found missing."""
        at = self.removed_at.get(name)
        if at is None:
            at = self.whole_at if self.replace and name not in self.removed else None
        return self.at if at is None else at


@dataclass(frozen=True, slots=True)
class HistoryEntry:
    """One change of a value.

    Attributes:
        at: when it was heard.
        component: component id.
        name: the parameter.
        old: what it was. Its index is None.
        new: what it became; None where the vehicle no longer has the parameter.
        by: who caused it, as in `StoredParam.by`.
    """

    at: float
    component: int
    name: str
    old: Param
    new: Param | None
    by: str


@dataclass(frozen=True, slots=True, repr=False)
class SnapshotSummary:
    """A table as it was set down at a moment, without its parameters.

    Attributes:
        id: its number in the cache, which no other snapshot ever gets.
        key: the name under which the vehicle's tables are kept.
        component: component id.
        at: when, to the millisecond.
        reason: what for, in words.
        size: parameters in it.
        hash: the hash under which the vehicle would have confirmed it; None where none was known.
        complete: it has every parameter that the vehicle had.
    """

    id: int
    key: str
    component: int
    at: float
    reason: str
    size: int
    hash: int | None
    complete: bool

    def __repr__(self) -> str:
        at = datetime.fromtimestamp(self.at, UTC)
        what = f"{self.id} of {self.key}/{self.component}: {self.size} params, {at:%Y-%m-%d %H:%MZ}"
        return f"<{type(self).__name__} {what}, {self.reason!r}>"


@dataclass(frozen=True, slots=True, repr=False)
class Snapshot(SnapshotSummary):
    """A table as it was set down at a moment.

    Attributes:
        params: its parameters, with type and default where they were known, and who the vehicle was then.
    """

    params: ParamSet = field(hash=False)


@dataclass(frozen=True, slots=True)
class CacheChange:
    """A table that another station has written to.

    Attributes:
        key: the name under which the vehicle's tables are kept.
        component: component id.
    """

    key: str
    component: int


@dataclass(frozen=True, slots=True)
class CachedVehicle:
    """A vehicle of which tables are kept.

    Attributes:
        key: the name under which its tables are kept.
        identity: as it was last seen.
        first_seen, last_seen: when.
        components: the ids of the components that have a table.
    """

    key: str
    identity: Identity
    first_seen: float
    last_seen: float
    components: tuple[int, ...]

    def __str__(self) -> str:
        components = ", ".join(map(str, self.components))
        autopilot = autopilot_name(self.identity.autopilot)
        return f"{self.key} (system {self.identity.system}, {autopilot}, components {components})"


@dataclass(frozen=True, slots=True, repr=False)
class CachedSummary:
    """One component's table, without its parameters.

    Attributes:
        key: the name under which the vehicle's tables are kept.
        identity: the vehicle.
        component: component id.
        autopilot: MAV_AUTOPILOT of this component's heartbeat.
        size: parameters kept.
        hash, count, complete, volatile_known, synced_at, file_works: as in `TableState`.
        updated_at: when anything of it was last written.
    """

    key: str
    identity: Identity
    component: int
    autopilot: int
    size: int
    hash: int | None
    count: int | None
    complete: bool
    volatile_known: bool
    synced_at: float | None
    updated_at: float
    file_works: bool | None

    @property
    def system(self) -> int:
        """System id under which the vehicle was last seen."""
        return self.identity.system

    def __repr__(self) -> str:
        of = f" of {self.count}" if self.count is not None and not self.complete else ""
        synced = "not synced"
        if self.synced_at is not None:
            synced = f"synced {datetime.fromtimestamp(self.synced_at, UTC):%Y-%m-%d %H:%MZ}"
        who = f"{self.system}/{self.component} {autopilot_name(self.autopilot)}"
        return f"<{type(self).__name__} {who} {self.size}{of} params {synced}>"


@dataclass(frozen=True, slots=True, repr=False)
class CachedComponent(CachedSummary):
    """One component's table as it was last known, usable with no link.

    Attributes:
        params: by name, ordered by index, then name; those without an index last. Trust is CACHED.
        volatile: the names that the vehicle leaves out of its hash, as far as known.
        heard_at: by name, when the vehicle last gave the value.
        left_out: names that an earlier version has kept and no parameter file can hold: they are not in
            `params`, and go with the next whole table.
    """

    params: ParamMap = field(hash=False)
    volatile: frozenset[str]
    heard_at: Mapping[str, float] = field(hash=False)
    left_out: tuple[str, ...]
    _history: Callable[[str | None, int | None], list[HistoryEntry]] = field(compare=False)

    def history(self, name: str | None = None, limit: int | None = None) -> list[HistoryEntry]:
        """The changes of its values, newest last; none once the table has been removed from the cache.

        Args:
            name: of this parameter only.
            limit: the newest so many.

        Raises:
            CacheError: the cache cannot be read, or is closed.
        """
        return self._history(name, limit)
