"""Earlier states of a table of extended parameters: snapshots, and states computed from the history.

As for plain tables (see `snapshots`), with one difference: the appearance of a name is not recorded, so that
a state also has parameters that appeared after its time.

Each function runs inside the transaction of its caller.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from paramclient.cache.cells import Damaged, identity_cells, read_identity, time_cell
from paramclient.cache.ext_records import ExtSnapshot, StoredExtParam, read_ext_rows
from paramclient.cache.snapshots import (
    SNAPSHOTS,
    kept_reason,
    kept_time,
    no_such_snapshot,
    snapshot_checksum,
    snapshots_near,
    utc_text,
)
from paramclient.cache.transaction import Transaction
from paramclient.errors import NotInCache
from paramclient.model.ext_params import ExtParam
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.values import Trust

__all__ = ["ext_snapshot", "ext_state_at", "store_ext_snapshot"]


def store_ext_snapshot(
    transaction: Transaction,
    owner: int,
    content: ExtParamSet,
    *,
    at: float,
    reason: str,
    complete: bool,
    number: int | None = None,
) -> ExtSnapshot:
    """Store a snapshot of extended parameters, and delete the oldest ones of the table beyond `SNAPSHOTS`.

    Args:
        transaction: the transaction.
        owner: id of the table.
        content: the parameters, with the identity of the vehicle.
        at: time of the snapshot, in unix seconds.
        reason: the reason, as text.
        complete: whether these are all extended parameters of the component.
        number: number that another store has assigned; None for the next one.
    """
    assert content.identity is not None
    blob = _packed(content.identity, content.params)
    row = (kept_time(at), kept_reason(reason), len(content.params), None, int(complete))
    crc = snapshot_checksum(row, blob)
    number = transaction.add_snapshot(owner, row, blob, crc, number, is_extended=True)
    transaction.trim_snapshots(owner, SNAPSHOTS, is_extended=True)
    return ext_snapshot(transaction, owner, number)


def ext_snapshot(transaction: Transaction, owner: int, number: int) -> ExtSnapshot:
    """Return a snapshot of extended parameters.

    Raises:
        NotInCache: the table has no such snapshot, or it is damaged.
    """
    found = transaction.snapshot(owner, number, is_extended=True)
    if found is None:
        raise NotInCache(no_such_snapshot(transaction, owner, number, is_extended=True))
    summary, row, blob, expected = found
    try:
        if not isinstance(blob, bytes) or snapshot_checksum(row, blob) != expected:
            raise ValueError("it is not what was written")
        identity, params = _unpacked(blob)
    except (LookupError, TypeError, ValueError, Damaged, zlib.error) as error:
        raise NotInCache(
            f"snapshot {number} of {summary.key}, component {summary.component}, is damaged: {error}"
        ) from error
    return ExtSnapshot(
        **{field.name: getattr(summary, field.name) for field in fields(summary)},
        params=ExtParamSet(
            params,
            identity.system,
            summary.component,
            summary.at,
            f"snapshot {number} of {summary.key}",
            identity,
        ),
    )


def ext_state_at(transaction: Transaction, owner: int, identity: Identity, when: float) -> ExtParamSet:
    """Return a table of extended parameters as it was known at a given time.

    Args:
        transaction: the transaction.
        owner: id of the table.
        identity: the last known identity of the vehicle.
        when: unix seconds.

    Raises:
        NotInCache: the history begins later, or the clock has passed this time twice.
    """
    when = time_cell(when)
    _, number, _ = transaction.component_row(owner)
    exact = transaction.snapshot_at(owner, when, is_extended=True)
    if exact is not None:
        return ext_snapshot(transaction, owner, exact).params
    state = transaction.ext_state(owner)
    since = None if state is None else state.known_since
    title = f"the extended parameters of {identity.key}, component {number},"
    if since is None or when < since:
        reach = (
            "are not known: the table was never complete"
            if since is None
            else f"at {utc_text(when)} are not known: the history begins at {utc_text(since)}"
        )
        raise NotInCache(f"{title} {reach}{snapshots_near(transaction, owner, when, is_extended=True)}")
    twice = transaction.clock_rollback_over(owner, when)
    if twice is not None:
        back, until = twice
        raise NotInCache(
            f"{title} at {utc_text(when)} are ambiguous: the clock of this computer was set back from"
            f" {utc_text(until)} to {utc_text(back)}"
            f"{snapshots_near(transaction, owner, when, is_extended=True)}"
        )
    params = {name: row.param for name, row in transaction.ext_rows(owner).items()}
    first: dict[str, ExtParam] = {}
    for at, name, _, old_type, old_raw, _, _ in transaction.ext_lines(owner):
        if at > when:
            known = params.get(name)
            index = None if known is None else known.index
            first.setdefault(name, ExtParam.of(name, old_raw, old_type, index, Trust.CACHED))
    last_identity = replace(identity, firmware=0, git_hash="", capabilities=0)
    source = f"history of {identity.key}"
    return ExtParamSet(params | first, identity.system, number, when, source, last_identity)


def _packed(identity: Identity, params: Mapping[str, ExtParam]) -> bytes:
    """Encode identity, and name, type, bytes and index of each parameter, as compressed JSON."""
    rows = [[each.name, int(each.type), each.raw.hex(), each.index] for each in params.values()]
    text = json.dumps([identity_cells(identity), rows], separators=(",", ":"))
    return zlib.compress(text.encode("ascii"))


def _unpacked(blob: bytes) -> tuple[Identity, dict[str, ExtParam]]:
    identity, cells = json.loads(zlib.decompress(blob))
    rows: dict[str, StoredExtParam] = read_ext_rows(_with_bytes(each) for each in cells)
    return read_identity(identity), {name: row.param for name, row in rows.items()}


def _with_bytes(row: list[Any]) -> tuple[Any, ...]:
    name, number, raw, index = row
    return name, number, bytes.fromhex(raw), index, 0.0
