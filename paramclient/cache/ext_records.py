"""Records of extended parameters that the cache stores and returns, apart from those of plain ones."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias

from paramclient.cache.cells import YEAR_10000, Damaged
from paramclient.cache.param_columns import BY_VEHICLE
from paramclient.cache.records import SnapshotSummary
from paramclient.model.ext_params import EXT_VALUE_SIZE, ExtParam
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.values import Trust

__all__ = [
    "CachedExtTable",
    "ExtHistoryEntry",
    "ExtLine",
    "ExtSnapshot",
    "ExtTableUpdate",
    "StoredExtParam",
    "ext_checksum",
    "read_ext_line",
    "read_ext_rows",
]

ExtLine: TypeAlias = tuple[float, str, str, int, bytes, int | None, bytes | None]
"""A history line: at, name, by; type and raw of the old value, and of the new one, or None."""
TYPES_END: Final = 256
"""Upper limit of the numbers of types, exclusive."""


class StoredExtParam(NamedTuple):
    """One observation of an extended parameter to store, or one stored parameter.

    Attributes:
        name: param_id.
        type: number of the MAV_PARAM_EXT_TYPE.
        raw: `ExtParam.raw`.
        param_index: index, or None.
        heard_at: time of the observation, in unix seconds.
        by: author, if the value is a change; "" for a stored parameter.
    """

    name: str
    type: int
    raw: bytes
    param_index: int | None
    heard_at: float
    by: str = BY_VEHICLE

    @classmethod
    def of(cls, param: ExtParam, heard_at: float, by: str = BY_VEHICLE) -> StoredExtParam:
        """Return an observation of a parameter."""
        return cls(param.name, int(param.type), param.raw, param.index, float(heard_at), by)

    @property
    def param(self) -> ExtParam:
        """The parameter, with trust CACHED."""
        return ExtParam.of(self.name, self.raw, self.type, self.param_index, Trust.CACHED)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtTableUpdate:
    """Update of the extended parameters of one component.

    Attributes:
        identity: the vehicle.
        component: component id.
        autopilot: MAV_AUTOPILOT of this component's heartbeat.
        at: time of the update, in unix seconds.
        params: parameters to insert or change.
        removed: by name, the times at which parameters were found missing.
        count: param_count of the component; None does not change the stored one.
        complete: whether every index below the count was received; None does not change it.
    """

    identity: Identity
    component: int
    autopilot: int
    at: float
    params: Sequence[StoredExtParam] = ()
    removed: Mapping[str, float] = field(default_factory=dict)
    count: int | None = None
    complete: bool | None = None


@dataclass(frozen=True, slots=True)
class CachedExtTable:
    """The cached extended parameters of one component.

    Attributes:
        key: key of the vehicle in the cache.
        component: component id.
        params: the parameters by name, with trust CACHED, in the order of their indices.
        heard_at: when each value was observed last, in unix seconds, by name.
        count: param_count of the component, or None.
        complete: whether the table has every index below the count.
    """

    key: str
    component: int
    params: Mapping[str, ExtParam]
    heard_at: Mapping[str, float]
    count: int | None
    complete: bool


@dataclass(frozen=True, slots=True)
class ExtHistoryEntry:
    """One change of an extended value.

    Attributes:
        at: time at which the change was received, in unix seconds.
        component: component id.
        name: the parameter.
        old: the previous value. Its index is None.
        new: the new value; None if the component no longer has the parameter.
        by: author, as in `StoredExtParam`.
    """

    at: float
    component: int
    name: str
    old: ExtParam
    new: ExtParam | None
    by: str


@dataclass(frozen=True, slots=True, repr=False)
class ExtSnapshot(SnapshotSummary):
    """A snapshot of a table of extended parameters. Its `hash` is None.

    Attributes:
        params: its parameters, and the identity of the vehicle at that time.
    """

    params: ExtParamSet = field(hash=False)


def read_ext_rows(found: Iterable[Sequence[Any]]) -> dict[str, StoredExtParam]:
    """Return stored parameters by name, from cells in the order of `StoredExtParam` without the author.

    Raises:
        Damaged: a cell is not valid.
    """
    rows = {}
    for name, number, raw, index, heard_at in found:
        is_valid = _is_value(number, raw) and isinstance(name, str) and isinstance(index, int | None)
        if not (is_valid and isinstance(heard_at, float) and 0 <= heard_at < YEAR_10000):
            raise Damaged(f"an extended parameter is {(name, number, raw, index, heard_at)!r:.80}")
        rows[name] = StoredExtParam(name, number, raw, index, heard_at, "")
    return rows


def read_ext_line(row: Sequence[Any]) -> ExtLine:
    """Return a history line of its cells.

    Raises:
        Damaged: a cell is not valid.
    """
    at, name, by, old_type, old_raw, new_type, new_raw = row
    is_valid = isinstance(name, str) and isinstance(by, str) and _is_value(old_type, old_raw)
    is_removal = new_type is None and new_raw is None
    if not (is_valid and isinstance(at, float) and (is_removal or _is_value(new_type, new_raw))):
        raise Damaged(f"a change of an extended parameter is {tuple(row)!r:.80}")
    return at, name, by, old_type, old_raw, new_type, new_raw


def ext_checksum(rows: Mapping[str, StoredExtParam]) -> int:
    """Return a CRC-32 of all parameters of a table, independent of their order."""
    return zlib.crc32(repr([row[:-1] for _, row in sorted(rows.items())]).encode())


def _is_value(number: object, raw: object) -> bool:
    is_type = isinstance(number, int) and 0 <= number < TYPES_END
    return is_type and isinstance(raw, bytes) and len(raw) <= EXT_VALUE_SIZE
