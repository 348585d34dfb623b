"""Tables: written, compared, read. Each function works inside its caller's transaction.

One mechanism writes history: `applied` compares every value that it is given with the one that is stored,
and where they differ there is a line, written in the same transaction. So no change of a stored value can
miss its line, and when two processes hear the same change, the second finds nothing to write. Which values
count is said by `settle` and `merge`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from types import MappingProxyType
from typing import Final

from paramclient.cache import snapshots
from paramclient.cache.observed_table import HeardParams
from paramclient.cache.records import (
    BY_VEHICLE,
    CachedComponent,
    HistoryEntry,
    StoredParam,
    TableState,
    TableUpdate,
)
from paramclient.cache.rows import Row, time_cell
from paramclient.cache.transaction import Line, Session
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.values import is_portable_name

__all__ = [
    "HISTORY_LINES",
    "applied",
    "component",
    "forget_other_firmware",
    "hashed",
    "save",
    "write_lines",
    "write_state",
]

HISTORY_LINES: Final = 10_000
"""Lines of history kept for each table, the newest ones: about a megabyte, and years of tuning by hand. Each
`save` writes a line for each value that changed, so what a vehicle changes many times a second should be
gathered before it is saved."""


def save(session: Session, updates: Iterable[TableUpdate]) -> None:
    """Write what was learnt, in the order given: whatever is kept is older."""
    for update in updates:
        forget_other_firmware(session, update.identity)
        snapshots.watch_clock(session, update.identity.key, update.component, time_cell(update.at))
        owner = session.make(update)
        before: Mapping[str, Row] = {}
        after = before
        if update.params or update.removed or update.replace:  # else it is about the table as a whole only
            before = session.table(owner)
            after, lines, births = applied(update, before)
            if len(after) != len(before) or after != before:
                session.put_table(owner, before, after)
            session.add_births(owner, births)
            write_lines(session, owner, lines)
        if update.table is not None:
            write_state(session, owner, update.table)
            if update.table.complete:
                session.begin(owner, update.at)
        elif hashed(before) != hashed(after):
            session.describe(owner, hash=None)


def component(
    session: Session,
    key: str,
    number: int,
    *,
    history: Callable[[str | None, int | None], list[HistoryEntry]],
) -> CachedComponent | None:
    """One table with its parameters, or None."""
    for owner, summary in session.summaries(key, number):
        params, volatile, heard_at = session.params(owner)
        left_out = tuple(name for name in params.held if not is_portable_name(name))
        for name in left_out:
            del params.held[name]
            params.defaults.pop(name, None)
        return CachedComponent(
            **{field.name: getattr(summary, field.name) for field in fields(summary)},
            params=ParamMap(params),
            left_out=left_out,
            volatile=volatile,
            heard_at=MappingProxyType(heard_at),
            _history=history,
        )
    return None


def forget_other_firmware(session: Session, identity: Identity) -> None:
    """Where a vehicle has another firmware than before: drop what was true of that one only."""
    for owner in session.of_other_firmware(identity.key, identity.firmware, identity.git_hash):
        before = session.table(owner)
        after = {name: row._replace(default_bits=None) for name, row in before.items()}
        if after != before:
            session.put_table(owner, before, after)
        session.describe(owner, file_works=None)


def applied(
    update: TableUpdate, before: Mapping[str, Row], stays: Collection[str] = ()
) -> tuple[Mapping[str, Row], list[Line], Iterable[tuple[str, float]]]:
    """The rows after an update, the lines of history that it causes, and the new names with their times.

    Args:
        update: what is news of it.
        before: the rows.
        stays: names that it does not take away.
    """
    if not before and isinstance(update.params, HeardParams):
        first = update.params.first_rows()
        if first is not None:
            return first, [], ((name, first[name].heard_at) for name in first)
    after = dict(before)
    births: list[tuple[str, float]] = []
    news = list(_news(update.params))
    heard = {name for name, *_ in news}
    lines: list[Line] = [
        (update.gone_at(name), name, BY_VEHICLE, *after.pop(name).value, None, None, None)
        for name in dict.fromkeys(before if update.replace else update.removed)
        if name in before and name not in heard and name not in stays
    ]
    for name, new, volatile, by in news:
        old = after.get(name)
        if old is None:
            after[name] = new
            births.append((name, new.heard_at))
            continue
        if new.param_index is None and not update.replace:
            new = new._replace(param_index=old.param_index)
        if volatile is None:
            new = new._replace(volatile=old.volatile)
        after[name] = new
        if not old.same_value(new):
            lines.append((new.heard_at, name, by, *old.value, *new.value))
    return after, lines, births


def _news(params: Iterable[StoredParam]) -> Iterable[tuple[str, Row, bool | None, str]]:
    """What is to be kept: names and rows, whether they are volatile, and who caused the changes."""
    if isinstance(params, HeardParams):
        return params.rows()
    return (
        (
            item.param.name,
            Row.of(item.param, item.param.index, bool(item.volatile), item.heard_at),
            item.volatile,
            item.by,
        )
        for item in params
    )


def hashed(rows: Mapping[str, Row]) -> dict[str, tuple[int, int, int]]:
    """What the vehicle's hash covers of a table."""
    return {name: row.hashed for name, row in rows.items() if row.hashed is not None}


def write_lines(session: Session, owner: int, lines: Sequence[Line]) -> None:
    """Append lines of history, and drop the oldest ones beyond `HISTORY_LINES`."""
    if not lines:
        return
    session.add_lines(owner, lines)
    at = session.trim_lines(owner, HISTORY_LINES)
    if at is not None:
        session.forget(owner, at)


def write_state(session: Session, owner: int, state: TableState) -> None:
    """Say of a table what is known of it as a whole."""
    session.describe(
        owner,
        hash=state.hash,
        count=state.count,
        complete=state.complete,
        volatile_known=state.volatile_known,
        synced_at=None if state.synced_at is None else time_cell(state.synced_at),
        file_works=state.file_works,
    )
