"""What several stations hear of one vehicle, in one table: of each value the later observation counts.

What comes in the order of its time is written as ever. What comes late (a station was away, or another one
was quicker) finds its place in the history, and changes of the table only what nobody has heard since. So it
does not matter which of two stations comes first. That a value was heard again and was the same leaves no
line, so a late observation may find its change later, or earlier, than a log of everything would have it.
Times are those of the stations' clocks: these have to agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from paramclient.cache import tables
from paramclient.cache.merge import SAME_CHANGE
from paramclient.cache.records import BY_VEHICLE, CachedSummary, StoredParam, TableUpdate
from paramclient.cache.rows import Row, time_cell
from paramclient.cache.session import Line, NumberedLine, Session
from paramclient.cache.tables import (
    applied,
    forget_other_firmware,
    hashed,
    save,
    write_state,
)

__all__ = ["Past", "settle"]


def settle(session: Session, updates: Iterable[TableUpdate]) -> None:
    """Write what stations learnt, see `ParamCache.save`."""
    for update in updates:
        key = update.identity.key
        at = time_cell(update.at)
        vehicle = next(iter(session.vehicles(key)), None)
        if vehicle is not None and vehicle.last_seen > at:
            update = replace(update, identity=vehicle.identity)
        found = session.summaries(key, update.component)
        if not found:
            save(session, [update])
        else:
            [(owner, table)] = found
            heard = session.heard_last(owner)
            is_late = at < table.updated_at or any(item.heard_at < heard for item in update.params)
            if not is_late:
                save(session, [_respectful(update, table)])
            else:
                _bring_in(session, update, owner, table)
        if vehicle is not None:
            session.seen(key, min(vehicle.first_seen, at), max(vehicle.last_seen, at))


@dataclass
class Past:
    """The history of a table from some moment on, into which more is put.

    Attributes:
        lines: in their order, with the numbers that they have; None for a new one.
        known_since: since when the states of the table are known.
        new_names: that have appeared later than the observations that come.
    """

    lines: list[tuple[int | None, Line]]
    known_since: float | None = None
    new_names: frozenset[str] = frozenset()

    def observe(self, name: str, seen: Row, by: str, kept: Row | None) -> None:
        """Put in what was observed at a time after which the value was heard again.

        Args:
            seen: the value and its time.
            by: who caused it, should it be a change.
            kept: what the table has now, heard later; None where it has no such name.
        """
        at = seen.heard_at
        place = next((n for n, (_, line) in enumerate(self.lines) if line[1] == name and line[0] > at), None)
        if place is None:
            if kept is None or seen.same_value(kept):
                return
            is_first = self.known_since is None or at < self.known_since or name in self.new_names
            if not is_first:
                self._insert((at, name, by, *kept.value, *seen.value))
            self._insert((kept.heard_at, name, BY_VEHICLE, *seen.value, *kept.value))
            return
        number, (later, _, later_by, *values) = self.lines[place]
        old, new = tuple(values[:3]), tuple(values[3:])
        if _same(seen, old):
            return
        if _same(seen, new):
            if later - at > SAME_CHANGE:  # it was so earlier than anybody knew
                del self.lines[place]
                self._insert((at, name, by, *old, *new))
            return
        self.lines[place] = (number, (later, name, later_by, *seen.value, *new))
        self._insert((at, name, by, *old, *seen.value))

    def add(self, line: Line) -> None:
        """Put in a line."""
        self._insert(line)

    def _insert(self, line: Line) -> None:
        place = next((n for n, (_, each) in enumerate(self.lines) if each[0] > line[0]), len(self.lines))
        self.lines.insert(place, (None, line))


def _bring_in(session: Session, update: TableUpdate, owner: int, table: CachedSummary) -> None:
    """Bring in what others have overtaken, wholly or in part."""
    forget_other_firmware(session, update.identity)
    session.make(update)
    before = session.table(owner)
    gone_since = table.synced_at if table.complete and table.synced_at is not None else float("-inf")
    is_late = update.at < table.updated_at
    newer: list[StoredParam] = []
    older: list[StoredParam] = []
    agrees = True
    for item in update.params:
        row = before.get(item.param.name)
        known_at = max(gone_since, session.gone_at(owner, item.param.name)) if row is None else row.heard_at
        if known_at <= item.heard_at:
            newer.append(item)
            continue
        older.append(item)
        if row is not None and row.same_value(Row.of(item.param, None, False, item.heard_at)):
            newer.append(replace(item, heard_at=row.heard_at))  # its place, perhaps, was not known yet
        else:
            agrees = False
    count = None if update.table is None else update.table.count
    if is_late and (count is None or table.count not in (None, count)):
        newer = [_placeless(item) for item in newer]  # the places may be those of another count
    heard = {item.param.name for item in update.params}
    gone = before.keys() - heard if update.replace else update.removed
    part = replace(
        update,
        params=newer,
        removed=[name for name in gone if name in before and before[name].heard_at <= update.at],
        replace=False,
    )
    after, lines, births = applied(part, before)
    if after != before:
        session.put_table(owner, before, after)
    session.add_births(owner, births)
    _write_past(session, owner, older, lines, before)
    session.describe(owner, updated_at=max(table.updated_at, update.at))
    state = _respectful(update, table).table
    is_whole = not update.replace or after.keys() == heard
    if state is not None and agrees and is_whole and (state.complete or not is_late):
        write_state(session, owner, state)
        if state.complete:
            session.begin(owner, update.at)
    elif hashed(before) != hashed(after):
        session.describe(owner, hash=None)


def _write_past(
    session: Session,
    owner: int,
    older: Sequence[StoredParam],
    lines: Sequence[Line],
    before: Mapping[str, Row],
) -> None:
    times = [item.heard_at for item in older] + [line[0] for line in lines]
    if not times:
        return
    since = min(times)
    _, _, known_since = session.described(owner)
    kept: list[NumberedLine] = session.lines_from(owner, since)
    past = Past(list(kept), known_since, frozenset(name for _, name in session.births_after(owner, since)))
    for line in lines:
        past.add(line)
    for item in older:
        name = item.param.name
        past.observe(name, Row.of(item.param, None, False, item.heard_at), item.by, before.get(name))
    if past.lines == kept:
        return
    if past.lines[: len(kept)] == kept:
        session.add_lines(owner, [line for _, line in past.lines[len(kept) :]])
    else:
        session.replace_lines(owner, past.lines, start=kept[0][0])
    at = session.trim_lines(owner, tables.HISTORY_LINES)
    if at is not None:
        session.forget(owner, at)


def _respectful(update: TableUpdate, table: CachedSummary) -> TableUpdate:
    """The same, without what a station that knows less than the table would say of it as a whole."""
    state = update.table
    knows_less = state is not None and not state.complete and table.complete and not update.replace
    if knows_less and state is not None and state.count in (None, table.count):
        return replace(update, table=None)
    return update


def _placeless(item: StoredParam) -> StoredParam:
    return replace(item, param=replace(item.param, index=None))


def _same(row: Row, value: Sequence[int | None]) -> bool:
    number, bits, is_raw = value
    if number is None or bits is None or is_raw is None:
        return False
    return row.same_value(Row(number, bits, is_raw, None, 0, 0.0))
