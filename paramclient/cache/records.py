"""Records that the cache stores and returns. All times are in unix seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple

from paramclient.errors import UsageError
from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.paramset import ParamMap, WrittenParam
from paramclient.model.values import WIRE_SIZE, Param, Trust, bits_of, byte_length, from_bits, same_bits

BY_VEHICLE: Final = "vehicle"
"""Author of a change by the vehicle, and of a change that a download has shown."""
BY_US: Final = "us"
"""Author of a change by a write of this client; `us for NAME` if the write names a user."""
AUTHOR_LENGTH_MAX: Final = 128
"""Characters of an author's name: enough for a name with an address, and a program's own description."""
BITS_SIZE: Final = 8
"""Bytes of a stored value, the size of the largest type of a number."""


def check_author(author: str | None) -> str:
    """Check the author of a change, and return how the history names it.

    Raises:
        UsageError: it is empty, too long, or contains more than printable ASCII.
    """
    if author is None:
        return BY_US
    if not 1 <= len(author) <= AUTHOR_LENGTH_MAX or not (author.isascii() and author.isprintable()):
        raise UsageError(
            f"author must have 1 to {AUTHOR_LENGTH_MAX} printable ASCII characters, not {author!r:.200}"
        )
    return f"{BY_US} for {author}"


class StoredValue(NamedTuple):
    """A value as it is stored, plain or extended.

    Attributes:
        type: number of the type.
        value: `Param.bits`, little-endian, in 8 bytes, and in more for text and bytes; or the four bytes of
            the message, if a plain value is only known as these.
    """

    type: int
    value: bytes

    @classmethod
    def of(cls, number: int, bits: int, *, is_raw: bool = False) -> StoredValue:
        """Return the value with these bits."""
        least = WIRE_SIZE if is_raw else BITS_SIZE
        return cls(number, bits.to_bytes(max(least, byte_length(bits)), "little"))

    def is_same(self, other: StoredValue) -> bool:
        """Return whether both are the same value in the same type (−0 equals 0)."""
        one, two = (int.from_bytes(each.value, "little") for each in (self, other))
        is_alike = (self.type, len(self.value)) == (other.type, len(other.value))
        return self == other or (is_alike and same_bits(self.type, one, two))

    def param(self, name: str, index: int | None = None, default: bytes | None = None) -> Param:
        """Return it as a parameter, with trust CACHED."""
        bits = int.from_bytes(self.value, "little")
        is_raw = len(self.value) < BITS_SIZE
        value = from_bits(bits, self.type, is_raw=is_raw)
        given = None if default is None else from_bits(int.from_bytes(default, "little"), self.type)
        return Param(name, value, self.type, index, bits, Trust.CACHED, given, is_raw)


class StoredParam(NamedTuple):
    """One observation of a parameter to store, or one stored parameter. Create it by `of`.

    Attributes:
        name: param_id.
        stored: the value; None if the vehicle no longer has the parameter.
        param_index: index, or None. None does not change a stored index, except in a whole table.
        volatile: 1 if the vehicle's hash excludes the parameter; None does not change the stored flag.
        heard_at: time of the observation. The later of two observations of a parameter counts.
        default: the firmware's default in the form of the value, or None.
        by: author, if the value is a change: `BY_US`, `us for NAME`, `BY_VEHICLE` or `station 254/190`.
    """

    name: str
    stored: StoredValue | None
    param_index: int | None
    volatile: int | None
    heard_at: float
    default: bytes | None = None
    by: str = BY_VEHICLE

    @classmethod
    def of(
        cls, param: Param | WrittenParam, heard_at: float, volatile: bool | None = None, by: str = BY_VEHICLE
    ) -> StoredParam:
        """Return an observation of a parameter, whose type is known; its trust is not stored.

        Raises:
            UsageError: the type does not hold the value.
        """
        number, default = int(param.type or 0), param.default
        bits, index = (param.bits, param.index) if isinstance(param, Param) else (param.bits_as(number), None)
        return cls(
            param.name,
            StoredValue.of(number, bits, is_raw=param.is_raw),
            index,
            None if volatile is None else int(volatile),
            heard_at,
            None if default is None else StoredValue.of(number, bits_of(default, number)).value,
            by,
        )

    @classmethod
    def gone(cls, name: str, at: float) -> StoredParam:
        """Return the observation that the vehicle no longer has a parameter."""
        return cls(name, None, None, None, at)

    @property
    def hashed(self) -> StoredValue | None:
        """The value if the vehicle's hash covers it; None if the parameter is volatile or not in use."""
        return None if self.volatile or self.param_index is None else self.stored


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
    """

    hash: int | None = None
    count: int | None = None
    complete: bool = False
    volatile_known: bool = False
    synced_at: float | None = None
    file_works: bool | None = None


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
        params: observations of parameters, in the order of reception.
        replace: whether `params` are the whole table: other names are removed.
        extended: whether these are the extended parameters of the component.
    """

    identity: Identity
    component: int
    autopilot: int
    at: float
    table: TableState | None = None
    params: Sequence[StoredParam] = ()
    replace: bool = False
    extended: bool = False


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


@dataclass(frozen=True, slots=True)
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
        ended: for a snapshot that an `apply` or `restore` has stored before its first write, whether that
            operation has ended. False: it was interrupted, or is still running. None: another snapshot.
    """

    id: int
    key: str
    component: int
    at: float
    reason: str
    size: int
    hash: int | None
    complete: bool
    ended: bool | None = None


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
        return (
            f"{self.key} (system {self.identity.system}, {autopilot}, components {components}, "
            f"last seen {_minute(self.last_seen)})"
        )


@dataclass(frozen=True, slots=True, repr=False, kw_only=True)
class CachedSummary(TableState):
    """The cached table of one component, without its parameters.

    Attributes:
        key: key of the vehicle in the cache.
        identity: the vehicle.
        component: component id.
        autopilot: MAV_AUTOPILOT of this component's heartbeat.
        size: number of cached parameters.
        updated_at: time of the last write to the table.
    """

    key: str
    identity: Identity
    component: int
    autopilot: int
    size: int
    updated_at: float

    @property
    def system(self) -> int:
        """The last known system id of the vehicle."""
        return self.identity.system

    def __repr__(self) -> str:
        of = f" of {self.count}" if self.count is not None and not self.complete else ""
        synced = "not synced" if self.synced_at is None else f"synced {_minute(self.synced_at)}"
        address = f"{self.system}/{self.component} {autopilot_name(self.autopilot)}"
        return f"<{type(self).__name__} {address} {self.size}{of} params {synced}>"


@dataclass(frozen=True, slots=True, repr=False, kw_only=True)
class CachedComponent(CachedSummary):
    """The cached table of one component, usable without a link.

    Attributes:
        params: parameters by name, ordered by index, then name; those without an index last. Trust is CACHED.
        volatile: known names outside the vehicle's hash.
        heard_at: by name, time of the last observation of the value.
    """

    params: ParamMap = field(hash=False)
    volatile: frozenset[str]
    heard_at: Mapping[str, float] = field(hash=False)


class StoredTable(NamedTuple):
    """A stored table without its parameters.

    Attributes:
        owner: its id in this cache.
        known_since: time since which its states are known, or None.
        summary: its description for users.
    """

    owner: int
    known_since: float | None
    summary: CachedSummary


def stored_params(rows: Mapping[str, StoredParam]) -> dict[str, Param]:
    """Return the stored parameters that the vehicle has, with trust CACHED."""
    return {
        name: row.stored.param(name, row.param_index, row.default)
        for name, row in rows.items()
        if row.stored is not None
    }


def stored_value(cells: Sequence[Any]) -> StoredValue | None:
    """Return the value of its three cells, which are all None where there is none."""
    return None if cells[0] is None else StoredValue(*cells)


def is_same_value(one: StoredValue | None, other: StoredValue | None) -> bool:
    """Return whether two values, or missing ones, are the same."""
    return one is other or (one is not None and other is not None and one.is_same(other))


def _minute(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%MZ}"
