"""What programs and stations observe of one vehicle, in one table: the later observation of a value counts.

An observation that is not older than what is kept of its parameter is written, with a line where the value
has changed. An older one (its program was slow, or a station was away) finds its place in the history, and
changes of the table only what nobody has observed since. So it does not matter which of two programs comes
first. That a value was heard again and was the same leaves no line, so a late observation may find its change
later, or earlier, than a log of everything would have it. Of two observations of the same moment the one that
is written later counts.

Times are those of the clocks of the stations: these have to agree. Programs that share a file share a clock
too. What such a file has of a later time than it is shows that the clock was set back since: that is older
than what comes, whatever its time says.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from paramclient.cache import tables
from paramclient.cache.merge import SAME_CHANGE
from paramclient.cache.observed_table import HeardParams
from paramclient.cache.records import BY_VEHICLE, CachedSummary, StoredParam, TableState, TableUpdate
from paramclient.cache.rows import Row, time_cell
from paramclient.cache.snapshots import CLOCK_SLACK
from paramclient.cache.tables import (
    applied,
    forget_other_firmware,
    hashed,
    write_lines,
    write_state,
)
from paramclient.cache.transaction import Line, NumberedLine, Session

__all__ = ["Past", "settle"]


def settle(session: Session, updates: Iterable[TableUpdate], present: float | None = None) -> None:
    """Write what was learnt, see `ParamCache.save`.

    Args:
        session: the transaction.
        updates: in the order given.
        present: unix seconds by the clock that the times of the updates were read from; None for `at` of
            each.
    """
    for update in updates:
        _settle(session, update, max(time_cell(update.at), 0.0 if present is None else present))


@dataclass
class Past:
    """The history of a table from some moment on, into which more is put.

    Attributes:
        lines: in their order, with the numbers that they have; None for a new one.
        known_since: since when the states of the table are known.
        births: by name, when it appeared, or, of one that was in the first table and has changed since, when
            the value that it had there was observed; the earliest of these times.
        new_births: those that the observations bring.
    """

    lines: list[tuple[int | None, Line]]
    known_since: float | None = None
    births: Mapping[str, float] = field(default_factory=dict)
    new_births: dict[str, float] = field(default_factory=dict)

    def observe(
        self, name: str, seen: Row, by: str, kept: Row | None, *, ahead: Sequence[int | None] | None = None
    ) -> None:
        """Put in what was observed at a time after which the value was heard again.

        Args:
            name: the parameter.
            seen: the value and its time.
            by: who caused it, should it be a change.
            kept: what the table has now, heard later; None where it has no such name.
            ahead: what the last line of it ahead of `lines` made of it; None where there is none.
        """
        at = seen.heard_at
        place = next((n for n, (_, line) in enumerate(self.lines) if line[1] == name and line[0] > at), None)
        for _, line in self.lines[:place]:
            if line[1] == name:
                ahead = line[6:]
        is_known = ahead is not None
        has_come_back = ahead is not None and ahead[0] is None  # with this value, or one that is older still
        if place is None:
            if kept is None or seen.same_value(kept):
                return
            if has_come_back:
                self._insert((kept.heard_at, name, BY_VEHICLE, *seen.value, *kept.value))
                return
            since = self._born(name, self.known_since)
            is_new = since is None or at < since
            if is_known or not is_new:
                self._insert((at, name, by, *kept.value, *seen.value))
            else:
                self.new_births[name] = at
            self._insert((kept.heard_at, name, BY_VEHICLE, *seen.value, *kept.value))
            return
        number, (later, _, later_by, *values) = self.lines[place]
        old, new = tuple(values[:3]), tuple(values[3:])
        if _same(seen, old) or has_come_back:  # when it became `old` is not known
            return
        born = self._born(name)
        if born is not None and at < born <= later and not is_known:  # it was `old` at `born`
            self.new_births[name] = at
            self._insert((born, name, BY_VEHICLE, *seen.value, *old), before=place)
            return
        if _same(seen, new):
            if later - at > SAME_CHANGE:  # it was so earlier than anybody knew
                del self.lines[place]
                self._insert((at, name, by, *old, *new))
            return
        self.lines[place] = (number, (later, name, later_by, *seen.value, *new))
        self._insert((at, name, by, *old, *seen.value))

    def _born(self, name: str, default: float | None = None) -> float | None:
        """The time before which nothing is known of a name, as noted for it; a new one is the earlier."""
        return self.new_births.get(name, self.births.get(name, default))

    def add(self, line: Line) -> None:
        """Put in a line."""
        self._insert(line)

    def _insert(self, line: Line, *, before: int | None = None) -> None:
        """Put in a line by its time, and ahead of the line in a place, should they be of one time."""
        place = next((n for n, (_, each) in enumerate(self.lines) if each[0] > line[0]), len(self.lines))
        self.lines.insert(place if before is None else min(place, before), (None, line))


def _settle(session: Session, update: TableUpdate, present: float) -> None:
    key, at = update.identity.key, update.at
    horizon = math.inf if session.is_shared else present + CLOCK_SLACK
    vehicle = next(iter(session.vehicles(key)), None)
    if vehicle is not None and at < vehicle.last_seen <= horizon:
        update = replace(update, identity=vehicle.identity)
    forget_other_firmware(session, update.identity)
    found = next(iter(session.summaries(key, update.component)), None)
    owner = session.make(update)
    if vehicle is not None:
        last = vehicle.last_seen if vehicle.last_seen <= horizon else at
        session.seen(key, min(vehicle.first_seen, at), max(last, at))
    table = None if found is None else found[1]
    is_late = False
    if table is not None:
        if table.updated_at > horizon:
            session.add_setback(owner, present, table.updated_at)
        elif table.updated_at > at:
            is_late = True
            session.describe(owner, updated_at=table.updated_at)
    before: Mapping[str, Row] = {}
    after = before
    agrees = is_whole = True
    if update.params or update.removed or update.replace:  # else it is about the table as a whole only
        before = session.table(owner)
        seen = _Seen(session, owner, table, before, horizon)
        after, agrees, is_whole = _write_values(session, owner, update, seen, is_late=is_late)
    state = update.table if table is None else _respectful(update, table)
    if state is not None and is_whole and (state.complete or not is_late):
        if agrees:
            write_state(session, owner, state)
        elif state.complete and table is not None and not table.complete:
            write_state(session, owner, replace(state, hash=None))  # the hash is of other values
        else:
            state = None
    else:
        state = None
    if state is not None and state.complete:
        session.begin(owner, at)
    if state is None and hashed(before) != hashed(after):
        session.describe(owner, hash=None)


def _write_values(
    session: Session, owner: int, update: TableUpdate, seen: _Seen, *, is_late: bool
) -> tuple[Mapping[str, Row], bool, bool]:
    """Write the values of an update.

    Returns:
        the rows then, whether they agree with the update, and whether it has all of their names, where it is
        of a whole table.
    """
    before = seen.rows
    part = update
    older: Sequence[StoredParam] = ()
    agrees = True
    if seen.table is not None and not all(seen.is_news(name, at) for name, at in _times(update.params)):
        part, older, agrees = _divided(update, seen, is_late=is_late)
    gone: Collection[str] = update.removed
    if update.replace:
        gone = before.keys() - {name for name, _ in _times(update.params)} if before else ()
    stays = {name for name in gone if name in before and not seen.is_news(name, update.gone_at(name))}
    after, lines, births = applied(part, before, stays.union(item.param.name for item in older))
    if len(after) != len(before) or after != before:
        session.put_table(owner, before, after)
    session.add_births(owner, births)
    if lines:
        session.add_first_times(owner, _first_changes(session, owner, before, dict(births), lines))
    _write_past(session, owner, older, lines, seen)
    return after, agrees, not (stays and update.replace)


def _divided(
    update: TableUpdate, seen: _Seen, *, is_late: bool
) -> tuple[TableUpdate, list[StoredParam], bool]:
    """Return what of an update is news, what is overtaken, and whether that agrees with what is kept."""
    table = seen.table
    newer: list[StoredParam] = []
    older: list[StoredParam] = []
    agrees = True
    overtaken: dict[str, float] = {}  # what is older than an overtaken observation is overtaken too
    for item in update.params:
        name, is_listed = item.param.name, item.param.index is not None
        if not seen.is_news(name, item.heard_at, is_listed=is_listed):
            overtaken[name] = max(item.heard_at, overtaken.get(name, -math.inf))
    for item in update.params:
        name = item.param.name
        if item.heard_at > overtaken.get(name, -math.inf):
            newer.append(item)
            continue
        row = seen.rows.get(name)
        older.append(item)
        if row is not None and row.same_value(Row.of(item.param, None, False, item.heard_at)):
            newer.append(replace(item, heard_at=row.heard_at))  # its place, perhaps, was not known yet
        else:
            agrees = False
    count = None if update.table is None else update.table.count
    if is_late and table is not None and (count is None or table.count not in (None, count)):
        newer = [_placeless(item) for item in newer]  # the places may be those of another count
    return replace(update, params=newer), older, agrees


def _first_changes(
    session: Session,
    owner: int,
    before: Mapping[str, Row],
    births: Mapping[str, float],
    lines: Sequence[Line],
) -> list[tuple[str, float]]:
    """Return when the values of a first table were observed that change now: their rows say it no more.

    Args:
        session, owner: where the table is.
        before: its rows.
        births: the names that appear now, and when they were observed first.
        lines: the changes.
    """
    _, _, known_since = session.described(owner)
    until = math.inf if known_since is None else known_since
    first = {
        name: before[name].heard_at if name in before else births.get(name, math.inf)
        for name in {line[1] for line in lines}
    }
    changed = {name for name, at in first.items() if at < until}
    if changed:
        changed -= session.first_times(owner).keys()
    return [(name, first[name]) for name in sorted(changed)]


@dataclass
class _Seen:
    """What is kept of a table, and since when it is known.

    Attributes:
        session, owner: where it is.
        table: as it was before the update; None where there was none.
        rows: its parameters.
        horizon: unix seconds; what is kept of a later time is of a clock that was set back since.
        gone: when parameters went last, once that was looked up.
    """

    session: Session
    owner: int
    table: CachedSummary | None
    rows: Mapping[str, Row]
    horizon: float
    gone: Mapping[str, float] | None = None

    def is_news(self, name: str, at: float, *, is_listed: bool = True) -> bool:
        """Whether nothing later is kept of a parameter than an observation of this time.

        Args:
            name: the parameter.
            at: the time.
            is_listed: whether a whole table would have it, if the vehicle has.
        """
        row, table = self.rows.get(name), self.table
        if row is not None:
            return row.heard_at <= at or row.heard_at > self.horizon
        if table is None or table.updated_at <= at or table.updated_at > self.horizon:
            return True
        is_whole = table.complete and table.size >= (table.count or 0)  # a fresh file may have a part of it
        if is_listed and is_whole and table.synced_at is not None and table.synced_at > at:
            return False
        if self.gone is None:
            self.gone = self.session.gone(self.owner)
        return self.gone.get(name, -math.inf) <= at


def _write_past(
    session: Session,
    owner: int,
    older: Sequence[StoredParam],
    lines: Sequence[Line],
    seen: _Seen,
) -> None:
    """Put lines and overtaken observations into their places in the history, by their times."""
    times = [item.heard_at for item in older] + [line[0] for line in lines]
    if not times:
        return
    since = min(times)
    if not older and not since < session.last_line_at(owner) <= seen.horizon:
        write_lines(session, owner, sorted(lines, key=_time_of))
        return
    _, _, known_since = session.described(owner)
    kept: list[NumberedLine] = session.lines_from(owner, since)
    ahead = max((place for place, (_, line) in enumerate(kept, 1) if line[0] > seen.horizon), default=0)
    kept = kept[ahead:]
    past = Past(list(kept), known_since, session.first_times(owner))
    for item in older:
        name = item.param.name
        row = Row.of(item.param, None, False, item.heard_at)
        became = session.last_became(owner, name, since)
        past.observe(name, row, item.by, seen.rows.get(name), ahead=became)
    for line in lines:  # after the others: up to here it was as the row says
        past.add(line)
    session.add_first_times(owner, past.new_births.items())
    if past.lines == kept:
        return
    if past.lines[: len(kept)] == kept:
        session.add_lines(owner, [line for _, line in past.lines[len(kept) :]])
    else:
        session.replace_lines(owner, past.lines, start=kept[0][0])
    at = session.trim_lines(owner, tables.HISTORY_LINES)
    if at is not None:
        session.forget(owner, at)


def _respectful(update: TableUpdate, table: CachedSummary) -> TableState | None:
    """What an update says of the table as a whole, unless that is less than what is known."""
    state = update.table
    if state is None or state.complete or update.replace or not table.complete:
        return state
    has_heard_less = state.count == table.count or (state.count is None and not update.params)
    return None if has_heard_less else state


def _times(params: Sequence[StoredParam]) -> Iterator[tuple[str, float]]:
    if isinstance(params, HeardParams):
        return params.heard_at()
    return ((item.param.name, item.heard_at) for item in params)


def _time_of(line: Line) -> float:
    return float(line[0])


def _placeless(item: StoredParam) -> StoredParam:
    return replace(item, param=replace(item.param, index=None))


def _same(row: Row, value: Sequence[int | None]) -> bool:
    number, bits, is_raw = value
    if number is None or bits is None or is_raw is None:
        return False
    return row.same_value(Row(number, bits, is_raw, None, 0, 0.0))
