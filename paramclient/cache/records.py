"""Records that the cache stores and returns. All times are in unix seconds and given by the caller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from itertools import compress
from types import MappingProxyType
from typing import Final

from paramclient.cache.param_columns import StoredParam, StoredTable
from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, is_portable_name

__all__ = [
    "BY_US",
    "CacheChange",
    "CachedComponent",
    "CachedSummary",
    "CachedVehicle",
    "HistoryEntry",
    "Snapshot",
    "SnapshotSummary",
    "TableState",
    "TableUpdate",
    "by_station",
]

BY_US: Final = "us"
"""Author of a change by a write of this client; `us for NAME` if the write names a user."""


def by_station(system: int, component: int) -> str:
    """Return the author of a change by another ground station: `station 254/190`."""
    return f"station {system}/{component}"


@dataclass(frozen=True, slots=True)
class TableState:
    """State of a table as a whole.

    Attributes:
        hash: the vehicle's hash of exactly this table; None if unknown.
        count: param_count of the vehicle.
        complete: whether every index was received.
        volatile_known: whether the set of volatile parameters was verified by computing the hash.
        synced_at: time of the last verification of the table against the vehicle.
        file_works: whether the vehicle, with this firmware, serves the table as a file; None if unknown.
        source: the file from which the table was added, see `ParamCache.add`. None does not change the stored
            one, except in a state with `synced_at`: then the vehicle has replaced or confirmed the values.
    """

    hash: int | None = None
    count: int | None = None
    complete: bool = False
    volatile_known: bool = False
    synced_at: float | None = None
    file_works: bool | None = None
    source: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TableUpdate:
    """Update of the table of one component.

    Attributes:
        identity: the vehicle.
        component: component id.
        autopilot: MAV_AUTOPILOT of this component's heartbeat.
        at: time of the update.
        table: the state of the table after this update. None does not change it, with one exception: a change
            of a value that the hash covers removes the hash.
        params: parameters to insert or change, in the order of reception.
        removed: names that the vehicle no longer has.
        removed_at: times at which names were found missing; `at` for all others.
        replace: whether `params` are the whole table: other names are removed.
        whole_at: time at which the vehicle was found to have no other names; None for `at`.
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

    def removal_time(self, name: str) -> float:
        """Return the time at which a name that this update removes was found missing."""
        at = self.removed_at.get(name)
        if at is None:
            at = self.whole_at if self.replace and name not in self.removed else None
        return self.at if at is None else at


@dataclass(frozen=True, slots=True)
class HistoryEntry:
    """One change of a value.

    Attributes:
        at: time at which the change was received.
        component: component id.
        name: the parameter.
        old: the previous value. Its index is None.
        new: the new value; None if the vehicle no longer has the parameter.
        by: author, as in `StoredParam`.
    """

    at: float
    component: int
    name: str
    old: Param
    new: Param | None
    by: str


@dataclass(frozen=True, slots=True, repr=False)
class SnapshotSummary:
    """A snapshot of a table, without its parameters.

    Attributes:
        id: its number in the cache, unique for all time.
        key: key of the vehicle in the cache.
        component: component id.
        at: time of the snapshot, to the millisecond.
        reason: the reason, as text.
        size: number of parameters.
        hash: the vehicle's hash of this table; None if unknown.
        complete: whether it has every parameter that the vehicle had.
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
    """A snapshot of a table.

    Attributes:
        params: its parameters, with known types and defaults, and the identity of the vehicle at that time.
    """

    params: ParamSet = field(hash=False)


@dataclass(frozen=True, slots=True)
class CacheChange:
    """A write of another station to a table.

    Attributes:
        key: key of the vehicle in the cache.
        component: component id.
    """

    key: str
    component: int


@dataclass(frozen=True, slots=True)
class CachedVehicle:
    """A vehicle with cached tables.

    Attributes:
        key: its key in the cache.
        identity: its last known identity.
        first_seen, last_seen: times of the first and last observation.
        components: ids of the components with a table.
    """

    key: str
    identity: Identity
    first_seen: float
    last_seen: float
    components: tuple[int, ...]

    def __str__(self) -> str:
        components = ", ".join(map(str, self.components))
        autopilot = autopilot_name(self.identity.autopilot)
        seen = f"{datetime.fromtimestamp(self.last_seen, UTC):%Y-%m-%d %H:%MZ}"
        return (
            f"{self.key} (system {self.identity.system}, {autopilot}, components {components}, "
            f"last seen {seen})"
        )


@dataclass(frozen=True, slots=True, repr=False)
class CachedSummary:
    """The cached table of one component, without its parameters.

    Attributes:
        key: key of the vehicle in the cache.
        identity: the vehicle.
        component: component id.
        autopilot: MAV_AUTOPILOT of this component's heartbeat.
        size: number of cached parameters.
        hash, count, complete, volatile_known, synced_at, file_works: as in `TableState`.
        source: the file from which the table was added; None if the vehicle sent it, or the vehicle has
            confirmed it since.
        updated_at: time of the last write to the table.
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
    source: str | None

    @property
    def system(self) -> int:
        """The last known system id of the vehicle."""
        return self.identity.system

    def __repr__(self) -> str:
        of = f" of {self.count}" if self.count is not None and not self.complete else ""
        synced = "not synced"
        if self.synced_at is not None:
            synced = f"synced {datetime.fromtimestamp(self.synced_at, UTC):%Y-%m-%d %H:%MZ}"
        address = f"{self.system}/{self.component} {autopilot_name(self.autopilot)}"
        return f"<{type(self).__name__} {address} {self.size}{of} params {synced}>"


@dataclass(frozen=True, slots=True, repr=False)
class CachedComponent(CachedSummary):
    """The cached table of one component, usable without a link.

    Attributes:
        params: parameters by name, ordered by index, then name; those without an index last. Trust is CACHED.
        volatile: known names outside the vehicle's hash.
        heard_at: by name, time of the last observation of the value.
        left_out: names written by an earlier version that no parameter file can hold. They are not in
            `params`, and are removed with the next whole table.
    """

    params: ParamMap = field(hash=False)
    volatile: frozenset[str]
    heard_at: Mapping[str, float] = field(hash=False)
    left_out: tuple[str, ...]
    _history: Callable[[str | None, int | None], list[HistoryEntry]] = field(compare=False)

    @classmethod
    def of(
        cls,
        summary: CachedSummary,
        table: StoredTable,
        *,
        history: Callable[[str | None, int | None], list[HistoryEntry]],
    ) -> CachedComponent:
        """Return a table as it is stored.

        Raises:
            Damaged: a parameter is not valid.
        """
        params = table.params()
        left_out = tuple(name for name in params.compact if not is_portable_name(name))
        for name in left_out:
            del params[name]
        return cls(
            **{each.name: getattr(summary, each.name) for each in fields(summary)},
            params=ParamMap(params),
            volatile=frozenset(compress(table, table.column("volatile"))),
            heard_at=MappingProxyType(dict(zip(table, table.column("heard_at"), strict=True))),
            left_out=left_out,
            _history=history,
        )

    def history(self, name: str | None = None, limit: int | None = None) -> list[HistoryEntry]:
        """Return the changes of its values, newest last. Empty after the table was removed from the cache.

        Args:
            name: only changes of this parameter.
            limit: maximum number of changes, the newest.

        Raises:
            CacheError: the cache cannot be read, or is closed.
        """
        return self._history(name, limit)
