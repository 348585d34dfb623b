"""Earlier states of a table: snapshots, and states computed from the history.

A state is computed backwards from the current table; each history line reverts one change. A new name leaves
no line, so after a table was first complete, every new name is recorded with its time (`birth`). The time of
the first complete table is `known_since`; it moves forward when history lines are dropped. No state is
available before it, nor for a period that the clock of this computer has passed twice because it was set back
(`setback`). For a name of the first table whose value has changed since, `birth` has the observation time of
its first value.

Each function runs inside the transaction of its caller.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any, Final

from paramclient.cache.cells import Damaged, identity_cells, read_identity, time_cell
from paramclient.cache.param_columns import StoredParam, read_param
from paramclient.cache.records import Snapshot
from paramclient.cache.transaction import Transaction
from paramclient.errors import NotInCache
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import WireValue, is_portable_name, known_type

__all__ = [
    "CLOCK_SLACK",
    "SNAPSHOTS",
    "kept_reason",
    "kept_time",
    "no_such_snapshot",
    "read_written",
    "snapshot",
    "snapshot_checksum",
    "snapshots_near",
    "state_at",
    "store",
    "record_clock_rollback",
    "utc_text",
    "written_cells",
]

SNAPSHOTS: Final = 50
"""Maximum number of snapshots of each table, the newest: one is stored before each applied file, so they
cover weeks of work on one vehicle. A snapshot of 1,000 parameters takes about 10 kB."""

CLOCK_SLACK: Final = 5.0
"""Seconds by which a time may be before the last written one although the clock was not set back: a process
may wait this long for the lock before it writes (`LOCK_WAIT_MAX`)."""


def record_clock_rollback(transaction: Transaction, key: str, component: int, at: float) -> None:
    """Record that the clock was set back, if a table is written at an earlier time than before."""
    written_at = transaction.updated_at(key, component)
    if written_at is not None and written_at > at + CLOCK_SLACK:
        owner = transaction.owner_of(key, component)
        assert owner is not None
        transaction.add_clock_rollback(owner, at, written_at)


def store(
    transaction: Transaction,
    owner: int,
    params: ParamSet,
    *,
    at: float,
    reason: str,
    hash: int | None,  # noqa: A002  # the word of the record
    complete: bool,
    number: int | None = None,
) -> Snapshot:
    """Store a snapshot of a table, and delete the oldest ones beyond `SNAPSHOTS`.

    Args:
        transaction: the transaction.
        owner: id of the table.
        params: the parameters, with the identity of the vehicle.
        at: time of the snapshot, in unix seconds.
        reason: the reason, as text.
        hash: the vehicle's hash of these parameters, or None.
        complete: whether these are all parameters of the vehicle.
        number: number that another store has assigned; None for the next one.
    """
    assert params.identity is not None
    blob = _packed(params.identity, params)
    row = (kept_time(at), kept_reason(reason), len(params), hash, int(complete))
    number = transaction.add_snapshot(owner, row, blob, snapshot_checksum(row, blob), number)
    transaction.trim_snapshots(owner, SNAPSHOTS)
    return snapshot(transaction, owner, number)


def snapshot(transaction: Transaction, owner: int, number: int) -> Snapshot:
    """Return a snapshot of a table.

    Raises:
        NotInCache: the table has no snapshot with this number, or it is damaged.
    """
    found = transaction.snapshot(owner, number)
    if found is None:
        raise NotInCache(no_such_snapshot(transaction, owner, number))
    summary, row, blob, expected = found
    try:
        if not isinstance(blob, bytes) or snapshot_checksum(row, blob) != expected:
            raise ValueError("it is not what was written")
        identity, params = _unpacked(blob)
    except (ArithmeticError, LookupError, TypeError, ValueError, Damaged, struct.error, zlib.error) as error:
        raise NotInCache(
            f"snapshot {number} of {summary.key}, component {summary.component}, is damaged: {error}"
        ) from error
    return Snapshot(
        **{field.name: getattr(summary, field.name) for field in fields(summary)},
        params=ParamSet(
            {name: each for name, each in params.items() if is_portable_name(name)},
            summary.component,
            identity.system,
            identity,
            summary.at,
            f"snapshot {number} of {summary.key}",
        ),
    )


def kept_reason(reason: str) -> str:
    """Return the reason of a snapshot as it is stored."""
    text = reason.encode("utf-8", "backslashreplace").decode()  # a file name in it may not be UTF-8
    return text.replace("\0", "\\x00")  # PostgreSQL's text type does not allow NUL


def kept_time(at: float) -> float:
    """Return the time of a snapshot as it is stored: to the millisecond."""
    return round(time_cell(at), 3)


def state_at(
    transaction: Transaction, owner: int, identity: Identity, rows: Mapping[str, StoredParam], when: float
) -> ParamSet:
    """Return a table as it was known at a given time.

    Args:
        transaction: the transaction.
        owner: id of the table.
        identity: the last known identity of the vehicle.
        rows: the current table.
        when: unix seconds.

    Raises:
        NotInCache: the history begins later, or the clock has passed this time twice.
    """
    when = time_cell(when)
    _, number, since = transaction.component_row(owner)
    exact = transaction.snapshot_at(owner, when)
    if exact is not None:
        return snapshot(transaction, owner, exact).params
    title = f"{identity.key}, component {number}"
    if since is None or when < since:
        reach = (
            "is not known: its table was never complete"
            if since is None
            else f"at {utc_text(when)} is not known: what is kept of its history begins at {utc_text(since)}"
        )
        raise NotInCache(f"the state of {title} {reach}{snapshots_near(transaction, owner, when)}")
    twice = transaction.clock_rollback_over(owner, when)
    if twice is not None:
        back, until = twice
        raise NotInCache(
            f"the state of {title} at {utc_text(when)} is ambiguous: the clock of this computer was set back"
            f" from {utc_text(until)} to {utc_text(back)}{snapshots_near(transaction, owner, when)}"
        )
    first = _first_events_after(transaction, owner, when)
    state = {name: first.get(name, row.value) for name, row in rows.items()} | first
    params = {}
    for name, value in state.items():
        if value is not None and is_portable_name(name):
            params[name] = WrittenParam.of(read_param(name, *value))
    last_identity = replace(identity, firmware=0, git_hash="", capabilities=0)
    return ParamSet(params, number, identity.system, last_identity, when, f"history of {identity.key}")


# The value before the first event after a given time; None if the name did not exist.
_Taken = tuple[int, int, int] | None


def _first_events_after(transaction: Transaction, owner: int, when: float) -> dict[str, _Taken]:
    """Return, by name, the value before the first event after a given time."""
    events: list[tuple[int, int, str, _Taken]] = [
        (number, 0, line.name, line.old) for number, line in transaction.lines(owner, when)
    ]
    for line, name in transaction.added_names_after(owner, when):
        events.append((line, 1, name, None))  # after the last line at that time
    first: dict[str, _Taken] = {}
    for _, _, name, value in sorted(events, key=lambda event: event[:2]):
        first.setdefault(name, value)
    return first


def snapshots_near(transaction: Transaction, owner: int, when: float, *, is_extended: bool = False) -> str:
    """Return the nearest snapshots of a time, for messages."""
    found = transaction.snapshots_around(owner, when, is_extended=is_extended)
    listed = " and ".join(f"snapshot {number} of {utc_text(at)}" for number, at in found)
    return f"; there is {listed}" if listed else "; there is no snapshot"


def no_such_snapshot(transaction: Transaction, owner: int, number: int, *, is_extended: bool = False) -> str:
    """Return the message for an unknown number, with the existing ones."""
    key, component, _ = transaction.component_row(owner)
    kept = [str(each.id) for each in transaction.snapshots(key, component, is_extended=is_extended)]
    listed = f"those kept are {', '.join(kept)}" if kept else "none is kept"
    return f"there is no snapshot {number} of {key}, component {component}: {listed}"


def utc_text(at: float) -> str:
    """Return a time in UTC, for messages."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%dT%H:%M:%SZ}"


def snapshot_checksum(described: Sequence[object], blob: bytes) -> int:
    """Return the checksum of a snapshot: of its row, and of its encoded parameters."""
    return zlib.crc32(blob, zlib.crc32(repr(tuple(described)).encode()))


def _packed(identity: Identity, params: Mapping[str, WrittenParam]) -> bytes:
    """Encode identity, and name, type, value, default of each parameter, as compressed strict JSON."""
    rows = [written_cells(each) for each in params.values()]
    text = json.dumps([identity_cells(identity), rows], separators=(",", ":"), allow_nan=False)
    return zlib.compress(text.encode("ascii"))


def _unpacked(blob: bytes) -> tuple[Identity, dict[str, WrittenParam]]:
    identity, rows = json.loads(zlib.decompress(blob))
    found = [read_written(each) for each in rows]
    return read_identity(identity), {each.name: each for each in found}


def written_cells(param: WrittenParam) -> tuple[str, int | None, int | str | None, int | str | None]:
    """Return a parameter's name, type, value and default in JSON types."""
    number = None if param.type_number is None else int(param.type_number)
    return param.name, number, _cell(param.settable), _cell(param.default)


def read_written(cells: Sequence[Any]) -> WrittenParam:
    """Return the parameter of a result of `written_cells`."""
    name, number, value, default = cells
    kind = None if number is None else known_type(number)
    written = _written(value)
    assert written is not None
    return WrittenParam(str(name), written, kind, _written(default))


def _cell(value: WireValue | None) -> int | str | None:
    """Encode a value without loss: a float by its 8 bytes, or by 4 bytes if a float32 is exact."""
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, bytes):
        return f"x{value.hex()}"
    wide = struct.pack("<d", value)
    try:
        narrow = struct.pack("<f", value)
    except OverflowError:
        return f"d{wide.hex()}"
    is_whole = struct.pack("<d", *struct.unpack("<f", narrow)) == wide
    return f"f{narrow.hex()}" if is_whole else f"d{wide.hex()}"


def _written(cell: Any) -> WireValue | None:
    if cell is None or isinstance(cell, int):
        return cell
    kind, data = cell[0], bytes.fromhex(cell[1:])
    if kind == "x":
        return data
    value: float = struct.unpack({"f": "<f", "d": "<d"}[kind], data)[0]
    return value
