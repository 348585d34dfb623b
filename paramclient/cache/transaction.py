"""Transaction: one transaction on the tables of a cache.

The statements are SQL that both SQLite and PostgreSQL accept, with `?` for each value. `sqlite` and
`postgres` implement the differences. Other modules interpret the rows and have no SQL.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from paramclient.cache.cells import Damaged, cells, identity_cells, read_identity, time_cell
from paramclient.cache.ext_records import (
    ExtHistoryEntry,
    ExtLine,
    StoredExtParam,
    ext_checksum,
    read_ext_line,
    read_ext_rows,
)
from paramclient.cache.history_columns import (
    HISTORY_COLUMNS,
    HISTORY_MARKS,
    HistoryLine,
    NumberedLine,
    read_entry,
    read_line,
)
from paramclient.cache.param_columns import StoredParam, StoredTable, checksum
from paramclient.cache.records import CachedSummary, CachedVehicle, HistoryEntry, SnapshotSummary, TableUpdate
from paramclient.model.ext_params import ExtParam
from paramclient.model.values import Trust

__all__ = ["ExtState", "Transaction"]

# Columns of a vehicle, in the order of `identity_cells`.
_IDENTITY: Final = (
    "system, link, uid, autopilot, vehicle_type, firmware, git_hash,"
    " board, vendor_id, product_id, capabilities"
)
_SUMMARY: Final = "s.id, vehicle, component, at, reason, size, s.hash, s.complete"


_EXT_LINE: Final = "at, name, by, old_type, old_raw, new_type, new_raw"


@dataclass(frozen=True, slots=True)
class ExtState:
    """State of a table of extended parameters.

    Attributes:
        count: param_count of the component, or None.
        complete: whether the table has every index below it.
        checksum: checksum of its parameters.
        known_since: time since which its states are known, or None.
    """

    count: int | None
    complete: bool
    checksum: int
    known_since: float | None


class Transaction(ABC):
    """The tables within one transaction. An `owner` is the id of a component's table in this database.

    Attributes:
        is_shared: whether several stations write to it, each with its own clock and observations.
    """

    is_shared: bool = False

    # vehicles and their tables

    def upsert_table(self, update: TableUpdate) -> int:
        """Write the vehicle and component of an update, and return the id of the table, which may be new."""
        at = time_cell(update.at)
        key = update.identity.key
        columns = f"{_IDENTITY}, last_seen"
        values = ", ".join(f"excluded.{column}" for column in columns.split(", "))
        self._do(
            f"INSERT INTO vehicle (key, first_seen, {columns}) VALUES (?{', ?' * 13})"
            f" ON CONFLICT (key) DO UPDATE SET ({columns}) = ({values})",
            (key, at, *identity_cells(update.identity), at),
        )
        self._do(
            "INSERT INTO component (vehicle, component, own_autopilot, checksum, updated_at)"
            " VALUES (?, ?, ?, ?, ?)"
            " ON CONFLICT (vehicle, component) DO UPDATE"
            " SET own_autopilot = excluded.own_autopilot, updated_at = excluded.updated_at",
            (key, update.component, update.autopilot, checksum({}), at),
        )
        owner = self.owner_of(key, update.component)
        assert owner is not None
        return owner

    def owner_of(self, key: str, component: int) -> int | None:
        """Return the id of a table; None if there is none."""
        found = self._all("SELECT id FROM component WHERE vehicle = ? AND component = ?", (key, component))
        return int(found[0][0]) if found else None

    def component_row(self, owner: int) -> tuple[str, int, float | None]:
        """Return key and component id of a table, and the time since which its states are known, or None."""
        [row] = self._all("SELECT vehicle, component, known_since FROM component WHERE id = ?", (owner,))
        key, component, since = cells(row, "siF")
        return key, component, since

    def vehicles(self, key: str | None = None) -> list[CachedVehicle]:
        """Return all vehicles, the last seen first; or the one with this key."""
        components: dict[str, list[int]] = {}
        which = (key,)
        for row in self._all(
            "SELECT vehicle, component FROM component WHERE vehicle = coalesce(?, vehicle)"
            " ORDER BY component",
            which,
        ):
            key, component = cells(row, "si")
            components.setdefault(key, []).append(component)
        found = []
        for row in self._all(
            f"SELECT key, first_seen, last_seen, {_IDENTITY} FROM vehicle WHERE key = coalesce(?, key)"
            " ORDER BY last_seen DESC, key",
            which,
        ):
            key, first, last = cells(row[:3], "sff")
            known = tuple(components.get(key, ()))
            found.append(CachedVehicle(key, read_identity(row[3:]), first, last, known))
        return found

    def set_seen_times(self, key: str, first: float, last: float) -> None:
        """Set the first and last time at which a vehicle was seen."""
        self._do("UPDATE vehicle SET first_seen = ?, last_seen = ? WHERE key = ?", (first, last, key))

    def summaries(
        self, key: str | None = None, component: int | None = None
    ) -> list[tuple[int, CachedSummary]]:
        """Return tables with their ids, without parameters, optionally of one vehicle or component."""
        rows = self._all(
            f"SELECT id, component, own_autopilot, {self.SIZE}, hash,"
            f" count, complete, volatile_known, synced_at, updated_at, file_works, source, key, {_IDENTITY}"
            " FROM component c JOIN vehicle ON key = vehicle"
            " WHERE key = coalesce(?, key) AND component = coalesce(?, component)"
            " ORDER BY last_seen DESC, key, component",
            (key, component),
        )
        return [_summary(row) for row in rows]

    def updated_at(self, key: str, component: int) -> float | None:
        """Return the time of the last write to a table; None if there is none."""
        found = self._all(
            "SELECT updated_at FROM component WHERE vehicle = ? AND component = ?", (key, component)
        )
        if not found:
            return None
        [at] = cells(found[0], "f")
        return float(at)

    def of_other_firmware(self, key: str, firmware: int, git_hash: str) -> list[int]:
        """Return the ids of a vehicle's tables, if its stored firmware differs from this one."""
        found = self._all(
            "SELECT c.id FROM vehicle JOIN component c ON vehicle = key"
            " WHERE key = ? AND (firmware != ? OR git_hash != ?)",
            (key, firmware, git_hash),
        )
        return [int(owner) for (owner,) in found]

    def update_component(self, owner: int, **cells_: object) -> None:
        """Set columns of a table as a whole, by column name."""
        named = ", ".join(f"{name} = ?" for name in cells_)
        values = (int(cell) if isinstance(cell, bool) else cell for cell in cells_.values())
        self._do(f"UPDATE component SET {named} WHERE id = ?", (*values, owner))

    def remove(self, key: str, component: int | None) -> int:
        """Delete tables with all dependent rows. Return their number."""
        removed = self._do(
            "DELETE FROM component WHERE vehicle = ? AND component = coalesce(?, component)", (key, component)
        )
        self._do("DELETE FROM vehicle WHERE key NOT IN (SELECT vehicle FROM component)")
        return removed

    # parameters

    SIZE: ClassVar[str]
    """SQL expression for the number of parameters of the table `c.id`."""

    @abstractmethod
    def columns(self, owner: int) -> StoredTable:
        """Return the parameters of a table by column, ordered by index, then name; without an index last.

        Raises:
            Damaged: the checksum does not match.
        """

    @abstractmethod
    def table(self, owner: int) -> dict[str, StoredParam]:
        """Return the parameters of a table by name, in the order of `columns`.

        Raises:
            Damaged: the checksum does not match.
        """

    @abstractmethod
    def put_table(
        self, owner: int, before: Mapping[str, StoredParam] | None, after: Mapping[str, StoredParam]
    ) -> None:
        """Replace the rows of a table.

        Args:
            owner: id of the table.
            before: the stored rows; None if they are unknown, and possibly damaged.
            after: the new rows, which differ from `before`.

        Raises:
            UsageError: a row cannot be stored.
        """

    @abstractmethod
    def heard_last(self, owner: int) -> float:
        """Return the time of the last observation in a table; minus infinity for an empty table."""

    # history

    def history(
        self, key: str, component: int | None, name: str | None, limit: int | None, since: float | None
    ) -> list[HistoryEntry]:
        """Return the history of a vehicle, newest last."""
        end = "" if limit is None or limit < 0 else f" LIMIT {int(limit)}"
        rows = self._all(
            f"SELECT component, {HISTORY_COLUMNS}"
            " FROM history h JOIN component c ON c.id = owner"
            " WHERE vehicle = ? AND component = coalesce(?, component) AND name = coalesce(?, name)"
            f" AND at >= coalesce(?, at) ORDER BY h.id DESC{end}",
            (key, component, name, since),
        )
        return [read_entry(row) for row in reversed(rows)]

    def lines(self, owner: int, after: float | None = None) -> list[NumberedLine]:
        """Return the history lines of a table in order; with `after`, only those of a later time."""
        if after is None:
            return self._lines("", (owner,))
        return self._lines(" AND at > ?", (owner, after))

    def lines_from(self, owner: int, since: float) -> list[NumberedLine]:
        """Return the history lines in order, starting with the first one of a later time than `since`."""
        where = " AND id >= (SELECT min(id) FROM history WHERE owner = ? AND at > ?)"
        return self._lines(where, (owner, owner, since))

    def add_lines(self, owner: int, lines: Sequence[HistoryLine]) -> None:
        """Append history lines in this order."""
        self._many(
            f"INSERT INTO history (owner, {HISTORY_COLUMNS}) VALUES (?, {HISTORY_MARKS})",
            [(owner, *line) for line in lines],
        )

    def trim_lines(self, owner: int, keep: int) -> float | None:
        """Delete all but the newest lines of a table. Return the latest time of the deleted ones, or None."""
        found = self._all(
            f"SELECT id FROM history WHERE owner = ? ORDER BY id DESC LIMIT 1 OFFSET {int(keep)}", (owner,)
        )
        if not found:
            return None
        [(last,)] = found
        [(at,)] = self._all("SELECT max(at) FROM history WHERE owner = ? AND id <= ?", (owner, last))
        self._do("DELETE FROM history WHERE owner = ? AND id <= ?", (owner, last))
        return float(at)

    def replace_lines(
        self, owner: int, lines: Sequence[tuple[int | None, HistoryLine]], *, start: int = 0
    ) -> None:
        """Replace the history lines of a table, in this order, with new numbers.

        Args:
            owner: id of the table.
            lines: lines, each with its previous number, or None for a new one. Names that appeared after a
                line move with it.
            start: number of the first line to replace.
        """
        [(ahead,)] = self._all(
            "SELECT coalesce(max(id), 0) FROM history WHERE owner = ? AND id < ?", (owner, start)
        )
        numbers = self._put_lines(owner, [line for _, line in lines], start)
        places = {old: number for number, (old, _) in zip(numbers, lines, strict=True) if old is not None}
        behind = self._all("SELECT DISTINCT line FROM birth WHERE owner = ? AND line >= ?", (owner, start))
        # in descending order, as every new number is above every old one
        for (line,) in sorted(behind, reverse=True):
            place = max((new for old, new in places.items() if old <= line), default=ahead)
            if place == line:
                continue
            self._do(
                "DELETE FROM birth WHERE owner = ? AND line = ?"
                " AND name IN (SELECT name FROM birth WHERE owner = ? AND line = ?)",
                (owner, place, owner, line),
            )
            self._do("UPDATE birth SET line = ? WHERE owner = ? AND line = ?", (place, owner, line))

    def values_between(self, owner: int, name: str, after: float, until: float) -> list[tuple[Any, ...]]:
        """Return the new values of a parameter's lines in a period: type, bits, is_raw."""
        return self._all(
            "SELECT new_type, new_bits, new_is_raw FROM history"
            " WHERE owner = ? AND name = ? AND at > ? AND at <= ?",
            (owner, name, after, until),
        )

    def last_became(self, owner: int, name: str, until: float) -> tuple[Any, ...] | None:
        """Return the new value of the last line of a parameter up to a time; None without a line."""
        found = self._all(
            "SELECT new_type, new_bits, new_is_raw FROM history"
            " WHERE owner = ? AND name = ? AND at <= ? ORDER BY id DESC LIMIT 1",
            (owner, name, until),
        )
        return found[0] if found else None

    def last_line_at(self, owner: int) -> float:
        """Return the time of the last line of a table; minus infinity without a line."""
        found = self._all("SELECT at FROM history WHERE owner = ? ORDER BY id DESC LIMIT 1", (owner,))
        return max((float(at) for (at,) in found), default=float("-inf"))

    def removal_times(self, owner: int) -> Mapping[str, float]:
        """Return the time of the last removal of each removed parameter, by name."""
        found = self._all(
            "SELECT name, max(at) FROM history WHERE owner = ? AND new_type IS NULL GROUP BY name", (owner,)
        )
        return dict(cells(row, "sf") for row in found)

    def removal_time(self, owner: int, name: str) -> float:
        """Return the time of the last removal of a parameter; minus infinity if it was never removed."""
        [(at,)] = self._all(
            "SELECT max(at) FROM history WHERE owner = ? AND name = ? AND new_type IS NULL", (owner, name)
        )
        return float("-inf") if at is None else float(at)

    # records for earlier states, in addition to the lines

    def set_known_since(self, owner: int, at: float) -> None:
        """Set the time since which the states of a table are known, unless it is set."""
        self._do("UPDATE component SET known_since = ? WHERE id = ? AND known_since IS NULL", (at, owner))

    def raise_known_since(self, owner: int, at: float) -> None:
        """Mark the states of a table up to this time as unknown."""
        self._do(
            "UPDATE component SET known_since = CASE WHEN known_since > ? THEN known_since ELSE ? END"
            " WHERE id = ? AND known_since IS NOT NULL",
            (at, at, owner),
        )
        for table, column in (("birth", "at"), ("setback", "until")):
            self._do(
                f"DELETE FROM {table} WHERE owner = ?"
                f" AND {column} <= (SELECT known_since FROM component WHERE id = ?)",
                (owner, owner),
            )

    def record_added_names(self, owner: int, added: Iterable[tuple[str, float]]) -> None:
        """Record new names after the last line, if the states of the table are known."""
        _, _, known_since = self.component_row(owner)
        if known_since is not None:
            self.add_first_times(owner, added)

    def add_first_times(self, owner: int, times: Iterable[tuple[str, float]]) -> None:
        """Record names with their first times, after the last line. The earlier of two times counts."""
        self._many(
            "INSERT INTO birth (owner, name, line, at)"
            " VALUES (?, ?, coalesce((SELECT max(id) FROM history WHERE owner = ?), 0), ?)"
            " ON CONFLICT (owner, name, line) DO UPDATE"
            " SET at = CASE WHEN excluded.at < birth.at THEN excluded.at ELSE birth.at END",
            [(owner, name, owner, at) for name, at in times],
        )

    def first_times(self, owner: int) -> dict[str, float]:
        """Return the earliest recorded time of each name."""
        found = self._all("SELECT name, min(at) FROM birth WHERE owner = ? GROUP BY name", (owner,))
        return dict(cells(row, "sf") for row in found)

    def added_names(self, owner: int) -> list[tuple[str, int, float]]:
        """Return name, number of the preceding line and time of every recorded name."""
        found = self._all("SELECT name, line, at FROM birth WHERE owner = ? ORDER BY line, name", (owner,))
        return [(name, line, at) for name, line, at in (cells(row, "sif") for row in found)]

    def clock_rollbacks(self, owner: int) -> list[tuple[float, float]]:
        """Return the periods, from and until, that the clock has passed twice."""
        found = self._all("SELECT since, until FROM setback WHERE owner = ? ORDER BY id", (owner,))
        return [(since, until) for since, until in (cells(row, "ff") for row in found)]

    def put_past(
        self, owner: int, lines: Sequence[HistoryLine], clock_rollbacks: Iterable[tuple[float, float]]
    ) -> Sequence[int]:
        """Replace history and clock_rollbacks of a table. Return the numbers of the lines."""
        for table in ("history", "birth", "setback"):
            self._do(f"DELETE FROM {table} WHERE owner = ?", (owner,))
        for since, until in clock_rollbacks:
            self.add_clock_rollback(owner, since, until)
        return self._put_lines(owner, lines)

    def put_added_names(self, owner: int, added: Iterable[tuple[str, float, int]]) -> None:
        """Record new names: name, time, and number of the preceding line."""
        self._many(
            "INSERT INTO birth (owner, name, at, line) VALUES (?, ?, ?, ?)",
            [(owner, *birth) for birth in added],
        )

    def added_names_after(self, owner: int, when: float) -> list[tuple[int, str]]:
        """Return the names that appeared after a given time, each with the number of the preceding line."""
        found = self._all("SELECT line, name FROM birth WHERE owner = ? AND at > ?", (owner, when))
        return [(line, name) for line, name in (cells(row, "is") for row in found)]

    def add_clock_rollback(self, owner: int, since: float, until: float) -> None:
        """Record a period that the clock has passed twice."""
        self._do("INSERT INTO setback (owner, since, until) VALUES (?, ?, ?)", (owner, since, until))

    def clock_rollback_over(self, owner: int, when: float) -> tuple[float, float] | None:
        """Return a period, from and until, that the clock has passed twice and that includes this time."""
        found = self._all(
            "SELECT since, until FROM setback WHERE owner = ? AND since <= ? AND until > ?",
            (owner, when, when),
        )
        return (float(found[0][0]), float(found[0][1])) if found else None

    # snapshots

    SNAPSHOT_ORDER: ClassVar[str] = "s.id"
    """SQL columns that order snapshots from old to new."""

    def add_snapshot(
        self,
        owner: int,
        row: Sequence[object],
        blob: bytes,
        crc: int,
        number: int | None = None,
        *,
        is_extended: bool = False,
    ) -> int:
        """Write a snapshot. Return its number.

        Args:
            owner: id of the table.
            row: at, reason, size, hash, complete.
            blob: encoded parameters.
            crc: checksum.
            number: number that another store has assigned; None for the next one.
            is_extended: whether it is of extended parameters.
        """
        given = () if number is None else (number,)
        return self._insert(
            f"INSERT INTO snapshot ({'id, ' * len(given)}owner, at, reason, size, hash, complete, params,"
            f" checksum, is_extended) VALUES ({'?, ' * len(given)}?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*given, owner, *row, blob, crc, int(is_extended)),
        )

    def trim_snapshots(self, owner: int, keep: int, *, is_extended: bool = False) -> None:
        """Delete all but the newest snapshots of a table of plain or of extended parameters."""
        found = self._all(
            f"SELECT s.id FROM snapshot s WHERE owner = ? AND is_extended = ? ORDER BY {self._newest_first}",
            (owner, int(is_extended)),
        )
        self._many("DELETE FROM snapshot WHERE id = ?", found[keep:])

    def drop_snapshots(self, numbers: Iterable[int]) -> None:
        """Delete snapshots."""
        self._many("DELETE FROM snapshot WHERE id = ?", [(number,) for number in numbers])

    def has_snapshot(self, number: int) -> bool:
        """Return whether a snapshot of any table has this number."""
        return bool(self._all("SELECT 1 FROM snapshot WHERE id = ?", (number,)))

    def snapshots(
        self, key: str, component: int | None, *, is_extended: bool = False
    ) -> list[SnapshotSummary]:
        """Return the snapshots of a vehicle's tables of plain or of extended parameters, newest last."""
        rows = self._all(
            f"SELECT {_SUMMARY} FROM snapshot s JOIN component c ON c.id = owner"
            " WHERE vehicle = ? AND component = coalesce(?, component) AND is_extended = ?"
            f" ORDER BY {self.SNAPSHOT_ORDER}",
            (key, component, int(is_extended)),
        )
        return [_snapshot(row) for row in rows]

    def snapshot(
        self, owner: int, number: int, *, is_extended: bool = False
    ) -> tuple[SnapshotSummary, Sequence[object], object, object] | None:
        """Return a snapshot: summary, row as written, encoded parameters, checksum; None if there is none."""
        found = self._all(
            f"SELECT {_SUMMARY}, params, s.checksum FROM snapshot s JOIN component c ON c.id = owner"
            " WHERE s.id = ? AND owner = ? AND is_extended = ?",
            (number, owner, int(is_extended)),
        )
        if not found:
            return None
        *described, blob, expected = found[0]
        return _snapshot(described), described[3:], blob, expected

    def snapshots_around(
        self, owner: int, when: float, *, is_extended: bool = False
    ) -> list[tuple[int, float]]:
        """Return number and time of the last snapshot up to a given time, and of the first after it."""
        return [
            (number, at)
            for order in ("at <= ? ORDER BY at DESC, id DESC", "at > ? ORDER BY at, id")
            for number, at in (
                cells(row, "if")
                for row in self._all(
                    f"SELECT id, at FROM snapshot WHERE owner = ? AND is_extended = ? AND {order} LIMIT 1",
                    (owner, int(is_extended), when),
                )
            )
        ]

    def snapshot_at(self, owner: int, when: float, *, is_extended: bool = False) -> int | None:
        """Return the number of the last snapshot with exactly this time, or None."""
        [(number,)] = self._all(
            "SELECT max(id) FROM snapshot WHERE owner = ? AND is_extended = ? AND at = ?",
            (owner, int(is_extended), when),
        )
        return None if number is None else int(number)

    # extended parameters

    def ext_state(self, owner: int) -> ExtState | None:
        """Return the state of a table of extended parameters; None if there is none."""
        found = self._all(
            "SELECT count, complete, checksum, known_since FROM ext_table WHERE owner = ?", (owner,)
        )
        for row in found:
            count, complete, crc, known_since = cells(row, "IiiF")
            return ExtState(count, bool(complete), crc, known_since)
        return None

    def put_ext_state(self, owner: int, state: ExtState) -> None:
        """Write the state of a table of extended parameters."""
        self._do(
            "INSERT INTO ext_table (owner, count, complete, checksum, known_since) VALUES (?, ?, ?, ?, ?)"
            " ON CONFLICT (owner) DO UPDATE SET (count, complete, checksum, known_since)"
            " = (excluded.count, excluded.complete, excluded.checksum, excluded.known_since)",
            (owner, state.count, int(state.complete), state.checksum, state.known_since),
        )

    def ext_sizes(self) -> dict[tuple[str, int], int]:
        """Return the number of extended parameters of each table that has some, by key and component."""
        found = self._all(
            "SELECT vehicle, component, count(*) FROM ext_param JOIN component c ON c.id = owner"
            " GROUP BY vehicle, component"
        )
        return {(key, component): size for key, component, size in (cells(row, "sii") for row in found)}

    def ext_rows(self, owner: int) -> dict[str, StoredExtParam]:
        """Return the extended parameters of a table by name, in the order of their indices, then names.

        Raises:
            Damaged: the checksum does not match.
        """
        rows = read_ext_rows(
            self._all(
                "SELECT name, type, raw, param_index, heard_at FROM ext_param WHERE owner = ?"
                " ORDER BY param_index IS NULL, param_index, name",
                (owner,),
            )
        )
        state = self.ext_state(owner)
        if ext_checksum(rows) != (ext_checksum({}) if state is None else state.checksum):
            raise Damaged("a table of extended parameters is not what was written")
        return rows

    def put_ext_rows(
        self, owner: int, before: Mapping[str, StoredExtParam], after: Mapping[str, StoredExtParam]
    ) -> None:
        """Write the changed rows of a table of extended parameters, and delete those that are gone."""
        self._many(
            "DELETE FROM ext_param WHERE owner = ? AND name = ?",
            [(owner, name) for name in before if name not in after],
        )
        self._many(
            "INSERT INTO ext_param (owner, name, type, raw, param_index, heard_at) VALUES (?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (owner, name) DO UPDATE SET (type, raw, param_index, heard_at)"
            " = (excluded.type, excluded.raw, excluded.param_index, excluded.heard_at)",
            [(owner, *row[:-1]) for name, row in after.items() if before.get(name) != row],
        )

    def ext_lines(self, owner: int) -> list[ExtLine]:
        """Return the history lines of extended parameters of a table, in order."""
        rows = self._all(f"SELECT {_EXT_LINE} FROM ext_history WHERE owner = ? ORDER BY id", (owner,))
        return list(map(read_ext_line, rows))

    def add_ext_lines(self, owner: int, lines: Sequence[ExtLine]) -> None:
        """Append history lines of extended parameters in this order."""
        self._many(
            f"INSERT INTO ext_history (owner, {_EXT_LINE}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            [(owner, *line) for line in lines],
        )

    def trim_ext_lines(self, owner: int, keep: int) -> float | None:
        """Delete all but the newest history lines of extended parameters of a table. Return the latest time
        of the deleted ones, or None."""
        dropped = (
            "owner = ? AND id <="
            f" (SELECT id FROM ext_history WHERE owner = ? ORDER BY id DESC LIMIT 1 OFFSET {int(keep)})"
        )
        [(at,)] = self._all(f"SELECT max(at) FROM ext_history WHERE {dropped}", (owner, owner))
        self._do(f"DELETE FROM ext_history WHERE {dropped}", (owner, owner))
        return None if at is None else float(at)

    def ext_history(
        self, key: str, component: int | None, name: str | None, limit: int | None, since: float | None
    ) -> list[ExtHistoryEntry]:
        """Return the history of a vehicle's extended parameters, newest last."""
        end = "" if limit is None or limit < 0 else f" LIMIT {int(limit)}"
        rows = self._all(
            f"SELECT component, {_EXT_LINE} FROM ext_history h JOIN component c ON c.id = owner"
            " WHERE vehicle = ? AND component = coalesce(?, component) AND name = coalesce(?, name)"
            f" AND at >= coalesce(?, at) ORDER BY h.id DESC{end}",
            (key, component, name, since),
        )
        return [_ext_entry(row) for row in reversed(rows)]

    def drop_ext(self, owner: int) -> None:
        """Delete the extended parameters of a table with their history."""
        for table in ("ext_param", "ext_history", "ext_table"):
            self._do(f"DELETE FROM {table} WHERE owner = ?", (owner,))

    # fleet comparison

    def tables_of(self, component: int) -> list[tuple[int, str, int, bool, int]]:
        """Return the tables of a component: id, key, system, complete, the vehicle's MAV_AUTOPILOT.

        The last seen vehicle is the first.
        """
        found = self._all(
            "SELECT c.id, key, system, complete, autopilot FROM component c JOIN vehicle ON key = vehicle"
            " WHERE component = ? ORDER BY last_seen DESC, key",
            (component,),
        )
        return [
            (owner, key, system, bool(done), autopilot)
            for owner, key, system, done, autopilot in (cells(row, "isiii") for row in found)
        ]

    @abstractmethod
    def names_between(self, component: int, first: str, end: str) -> list[str]:
        """Return the names in the tables of a component from `first` to before `end`."""

    @abstractmethod
    def holders(self, owners: Sequence[int], names: Sequence[str]) -> Mapping[tuple[Any, ...], list[int]]:
        """Return the ids of tables by name, type, bits, is_raw of these parameters, in arbitrary order."""

    @abstractmethod
    def value_dates(self, named: Mapping[int, Sequence[str]]) -> list[tuple[int, str, str, int, float]]:
        """Return times that date the current values of some parameters, by table.

        The rows have owner, name, what, line, at. For "heard", `at` is the last observation of the value; for
        "line", the last history line; for "birth", the last appearance of the name, after `line`; for "known"
        with an empty name, the time since which the states of the table are known.
        """

    # implemented by each database

    @abstractmethod
    def _all(self, sql: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """Execute a statement and return all rows."""

    @abstractmethod
    def _do(self, sql: str, values: Sequence[object] = ()) -> int:
        """Execute a statement and return the number of affected rows."""

    @abstractmethod
    def _many(self, sql: str, rows: Iterable[Sequence[object]]) -> None:
        """Execute a statement for each row, in order."""

    @abstractmethod
    def _insert(self, sql: str, values: Sequence[object]) -> int:
        """Insert a row into a table with an `id`, and return the id."""

    def _put_lines(self, owner: int, lines: Sequence[HistoryLine], start: int = 0) -> Sequence[int]:
        numbers = self._numbers(len(lines))  # above the deleted ones, so that added refer to either clearly
        self._do("DELETE FROM history WHERE owner = ? AND id >= ?", (owner, start))
        self._many(
            f"INSERT INTO history (id, owner, {HISTORY_COLUMNS}) VALUES (?, ?, {HISTORY_MARKS})",
            [(number, owner, *line) for number, line in zip(numbers, lines, strict=True)],
        )
        return numbers

    def _lines(self, where: str, values: Sequence[object]) -> list[NumberedLine]:
        sql = f"SELECT id, {HISTORY_COLUMNS} FROM history WHERE owner = ?{where} ORDER BY id"
        return [read_line(row) for row in self._all(sql, values)]

    @abstractmethod
    def _numbers(self, count: int) -> Sequence[int]:
        """Return ascending numbers for new history lines, above all existing ones."""

    @property
    def _newest_first(self) -> str:
        return ", ".join(f"{column} DESC" for column in self.SNAPSHOT_ORDER.split(", "))


def _summary(row: Sequence[object]) -> tuple[int, CachedSummary]:
    owner, component, autopilot, size, *state, key = cells(row[:13], "iiiiIIiiFfISs")
    crc, count, complete, volatile_known, synced_at, updated_at, file_works, source = state
    return owner, CachedSummary(
        key=key,
        identity=read_identity(row[13:]),
        component=component,
        autopilot=autopilot,
        size=size,
        hash=crc,
        count=count,
        complete=bool(complete),
        volatile_known=bool(volatile_known),
        synced_at=synced_at,
        updated_at=updated_at,
        file_works=None if file_works is None else bool(file_works),
        source=source,
    )


def _ext_entry(row: Sequence[Any]) -> ExtHistoryEntry:
    [component] = cells(row[:1], "i")
    at, name, by, old_type, old_raw, new_type, new_raw = read_ext_line(row[1:])
    old = ExtParam.of(name, old_raw, old_type, None, Trust.CACHED)
    is_gone = new_type is None or new_raw is None
    new = None if is_gone else ExtParam.of(name, new_raw or b"", new_type or 0, None, Trust.CACHED)
    return ExtHistoryEntry(at, component, name, old, new, by)


def _snapshot(row: Sequence[object]) -> SnapshotSummary:
    number, key, component, at, reason, size, crc, complete = cells(row, "isifsiIi")
    return SnapshotSummary(number, key, component, at, reason, size, crc, bool(complete))
