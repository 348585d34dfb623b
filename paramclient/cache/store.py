"""ParamCache: the public class of the cache."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import platformdirs

from paramclient.cache import history, snapshots, tables
from paramclient.cache.database import SqliteStore, Store, Transaction
from paramclient.cache.lookup import find_vehicle
from paramclient.cache.records import (
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    SnapshotSummary,
    StoredTable,
    TableUpdate,
)
from paramclient.cache.tables import KnownLines, ensure_table, import_tables, save_table
from paramclient.errors import NotInCache, UsageError
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet

T = TypeVar("T")


def default_path() -> Path:
    """Return the default path of the cache: `parameters.sqlite3` in the user's cache folder."""
    return platformdirs.user_cache_path("paramclient") / "parameters.sqlite3"


def is_database_url(place: object) -> bool:
    """Return whether a place is the URL of a PostgreSQL database. Otherwise it is a file."""
    return isinstance(place, str) and place.lower().startswith(("postgresql://", "postgres://"))


class ParamCache:
    """Cache of parameter tables, vehicle identities, history and snapshots.

    It is usable without a link, and by several threads, processes and (in a database) stations at the same
    time. The later observation of a value counts; stations that share a database need equal clocks.

    The cache is a file, or a PostgreSQL database. It is opened by the first call that needs it; reading
    creates no file. Every call blocks, usually for milliseconds, and for up to 5 s if another process writes.
    Committed data survives a killed process. A file that is damaged or of another version is renamed, with a
    warning in the log, and a new one is created.

    Args:
        path: the file; None for `default_path()`; or the URL of a database, `postgresql://USER@HOST/NAME`.

    Attributes:
        path: the file, absolute. A database has none: the default path, beside which other files are kept.
        place: the file, or the URL of the database without password, for messages.

    Raises:
        UsageError: the URL is not valid, psycopg is not installed, or the path is that of no file of SQLite.
        CacheError: from every method that reads or writes: the cache cannot be used (it is read-only, the
            disk is full, another process writes for more than 5 s, the database cannot be reached), or it is
            closed. Nothing was written.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None) -> None:
        self._store: Store
        if is_database_url(path):
            try:
                from paramclient.cache.postgres import PostgresStore  # psycopg is an extra
            except ImportError as error:
                raise UsageError(
                    f"a cache in PostgreSQL needs psycopg ({error}): pip install 'paramclient[postgres]'"
                ) from error
            self.path = default_path()
            self._store = PostgresStore(str(path))
        else:
            self.path = Path(default_path() if path is None else path).resolve()
            with suppress(OSError):
                if self.path.exists() and not (self.path.is_file() or self.path.is_dir()):
                    raise UsageError(f"{self.path} is not a regular file, and no cache")  # a pipe would wait
            with suppress(OSError), self.path.open("rb") as file:
                if path is not None and file.read(16).strip(b"\0") not in (b"", b"SQLite format 3"):
                    raise UsageError(f"{self.path} is another file, and no cache; it is not touched")
            self._store = SqliteStore(self.path)
        self.place = self._store.place
        self._known_lines: KnownLines = {}

    def __enter__(self) -> ParamCache:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ParamCache {self.place}>"

    def close(self) -> None:
        """Close the cache; later calls raise CacheError."""
        self._store.close()

    @property
    def notes(self) -> tuple[str, ...]:
        """One text for each damaged file, or file of another version, that was renamed, and one if the last
        writes to a file in a read-only folder are left out."""
        return tuple(self._store.notes)

    @property
    def replacements(self) -> int:
        """Number of times that another file has taken the place of one that this object has used."""
        return self._store.replacements

    # tables

    def save(self, update: TableUpdate | Sequence[TableUpdate], *, durable: bool = False) -> None:
        """Write updates of tables, in one transaction: either all or nothing is written.

        The later of two observations of a parameter counts, independent of the order of writes; an earlier
        one that is written later has no effect. A changed value leaves a history line, as does a removed one;
        a new parameter leaves none. −0 and 0 are equal values. A stored time more than 5 s in the future is
        from before the clock was set back, and counts as older than new observations.

        Args:
            update: one update, or several in the order of their observations.
            durable: return only when this and all earlier writes are safe from power loss.

        Raises:
            UsageError: a time is not in unix seconds.
        """
        updates = (update,) if isinstance(update, TableUpdate) else tuple(update)

        def work(tx: Transaction) -> KnownLines:
            known = dict(self._known_lines)
            for each in updates:
                save_table(tx, each, time.time(), known)
            return known

        if updates or durable:
            self._known_lines = self._store.run(work, writing=True, durable=durable)

    def merge(self, updates: Sequence[TableUpdate]) -> None:
        """Insert earlier observations, such as those of a log, by their times, in one transaction.

        Later observations in the cache stay. Repeating a merge changes nothing.

        Args:
            updates: as for `save`, in the order of their times.

        Raises:
            UsageError: a time is not in unix seconds.
        """
        if updates:
            self._store.run(lambda tx: import_tables(tx, updates), writing=True)

    def load(self, key: str, component: int, *, extended: bool = False) -> CachedComponent | None:
        """Return the table of a vehicle's component; None if there is none.

        Args:
            key: `Identity.key`.
            component: component id.
        """

        def work(tx: Transaction) -> CachedComponent | None:
            table = tables.find_table(tx, key, component, extended=extended)
            if table is None:
                return None
            mark = (history.last_line(tx, table.owner), time.time())
            self._known_lines.setdefault((table.owner, ""), mark)
            return tables.load_component(tx, table)

        return self._read(work)

    def vehicles(self) -> list[CachedVehicle]:
        """Return all vehicles, the last seen first."""
        return self._read(tables.load_vehicles)

    def components(self, vehicle: str | None = None, *, extended: bool = False) -> list[CachedSummary]:
        """Return all tables without parameters, ordered as `vehicles()`, then by component id.

        Args:
            vehicle: only this vehicle: its system id (`"4"`), its address (`"4/1"`), `px4` or `ardupilot` if
                only one has that autopilot, `uid:` with at least 6 digits of its hardware id, its full
                hardware id, or its key.
            extended: tables of extended parameters, which are not empty, instead of the plain ones.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """

        def work(tx: Transaction) -> list[CachedSummary]:
            key = None if vehicle is None else self._choose(tx, vehicle)
            found = tables.load_tables(tx, key, extended=extended)
            return [each.summary for each in found if each.summary.size or not extended]

        return self._read(work)

    def component(
        self,
        vehicle: str | None = None,
        *,
        system: int | None = None,
        component: int = 1,
        extended: bool = False,
    ) -> CachedComponent:
        """Return the only table that matches.

        Args:
            vehicle: as for `components`.
            system: its system id.
            component: component id; the autopilot's is 1, that of a camera 100.
            extended: the extended parameters of the component, instead of the plain ones.

        Raises:
            UnknownVehicle: no table matches. `vehicles` and the message list the existing ones.
            AmbiguousVehicle: tables of several vehicles match. `vehicles` and the message list them.
            NotInCache: the component has no extended parameters in the cache.
        """

        def work(tx: Transaction) -> CachedComponent:
            table = self._table(tx, vehicle, component, system=system, extended=extended)
            return tables.load_component(tx, table)

        return self._read(work)

    def remove(self, vehicle: str, component: int | None = None) -> int:
        """Remove a vehicle's tables with history and snapshots, and return the number of tables.

        Args:
            vehicle: as for `components`.
            component: only the table of this component.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """
        key = self._read(lambda tx: self._choose(tx, vehicle))
        return self._store.run(lambda tx: tables.remove_tables(tx, key, component), writing=True)

    def load_all(self, listed: Sequence[CachedSummary], *, extended: bool = False) -> list[CachedComponent]:
        """Load tables as `load` does; another process may have removed one."""
        found = (self.load(each.key, each.component, extended=extended) for each in listed)
        return [each for each in found if each is not None]

    # history and snapshots

    def history(
        self,
        vehicle: str,
        component: int | None = None,
        name: str | None = None,
        limit: int | None = None,
        since: float | None = None,
        *,
        extended: bool = False,
    ) -> list[HistoryEntry]:
        """Return the changes of a vehicle's values, newest last.

        The cache keeps the newest `HISTORY_ENTRIES_MAX` (10,000) of each table.

        Args:
            vehicle: as for `components`.
            component: only changes of this component.
            name: only changes of this parameter.
            limit: maximum number of changes, the newest.
            since: only changes from this time on, in unix seconds.
            extended: those of extended parameters, instead of the plain ones.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """
        which = (component, name, limit, since, extended)
        return self._read(lambda tx: history.load_history(tx, self._choose(tx, vehicle), *which))

    def store_snapshot(
        self,
        vehicle: Identity | str,
        component: int,
        params: ParamSet | None = None,
        *,
        reason: str,
        at: float | None = None,
        hash: int | None = None,  # noqa: A002  # the word of the record
        complete: bool = True,
        is_of_operation: bool = False,
        extended: bool = False,
    ) -> SnapshotSummary:
        """Store a snapshot of a table as a restore point, and return it.

        The cached table does not change. The cache keeps the newest `SNAPSHOTS` (50) of each table.

        Args:
            vehicle: identity of the vehicle, which is added to the cache if it is new; or the name of a
                cached vehicle, as for `components`.
            component: component id.
            params: names, values, types and defaults are stored; comments and lines are not. None: those of
                the cached table, with its hash.
            reason: the reason, as text.
            at: unix seconds; None for now.
            hash: the vehicle's hash of these parameters, if known.
            complete: whether these are all parameters of the vehicle.
            is_of_operation: whether an `apply` or `restore` is about to write; it calls `end_operation` at
                its end.
            extended: whether these are extended parameters.

        Raises:
            UsageError: the type of a parameter is unknown.
            UnknownVehicle: a name was given, and there is no such table.
            AmbiguousVehicle: several vehicles have this name.
        """
        moment = tables.time_cell(time.time() if at is None else at)
        given = None if params is None else snapshots.rows_of(params)
        ended = False if is_of_operation else None

        def work(tx: Transaction) -> SnapshotSummary:
            if isinstance(vehicle, str):
                table = self._table(tx, vehicle, component, extended=extended)
            else:
                table = ensure_table(tx, vehicle, component, moment, extended=extended)
            known = table.summary
            identity = known.identity if isinstance(vehicle, str) else vehicle
            rows, state = given, (hash, complete)
            if rows is None:
                rows, state = [*tables.load_rows(tx, table.owner).values()], (known.hash, known.complete)
            new = SnapshotSummary(0, known.key, component, moment, reason, 0, *state, ended)
            return snapshots.store_snapshot(tx, table.owner, new, identity, rows)

        return self._store.run(work, writing=True)

    def end_operation(self, snapshot: int) -> None:
        """Record that the `apply` or `restore` that has stored a snapshot has ended.

        Args:
            snapshot: its number.
        """
        self._store.run(lambda tx: snapshots.end_operation(tx, snapshot), writing=True)

    def snapshots(
        self, vehicle: str, component: int | None = None, *, extended: bool = False
    ) -> list[SnapshotSummary]:
        """Return the snapshots of a vehicle's tables, without parameters, newest last.

        Args:
            vehicle: as for `components`.
            component: only snapshots of this component.
            extended: those of extended parameters.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """

        def work(tx: Transaction) -> list[SnapshotSummary]:
            found = tables.load_tables(tx, self._choose(tx, vehicle), component, extended=extended)
            kept = [each for table in found for each in snapshots.load_snapshots(tx, table)]
            return sorted(kept, key=lambda each: each.id)

        return self._read(work)

    def state_at(self, vehicle: str, component: int, when: float, *, extended: bool = False) -> ParamSet:
        """Return a table as it was at a given time.

        It is computed backwards from the current table with the history lines, and has the last values
        received before that time. It is available back to the time when the table was first complete, or to
        the newest dropped history line (`HISTORY_ENTRIES_MAX`) if that is later. Only snapshots have defaults
        and the firmware of the vehicle.

        Args:
            vehicle: as for `components`.
            component: component id.
            when: a float is a time, in unix seconds; an int is the id of a snapshot.
            extended: that of extended parameters, instead of the plain ones.

        Raises:
            UsageError: the time is not in unix seconds.
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
            CacheError: there is no such snapshot of the table; or the history begins later (the message has
                its beginning, and the nearest snapshots).
        """

        def work(tx: Transaction) -> ParamSet:
            table = self._table(tx, vehicle, component, extended=extended)
            return replace(snapshots.load_state(tx, table, when), is_extended=extended)

        return self._read(work)

    def _read(self, work: Callable[[Transaction], T]) -> T:
        return self._store.run(work, writing=False)

    def _table(
        self,
        tx: Transaction,
        vehicle: str | None,
        component: int,
        *,
        system: int | None = None,
        extended: bool = False,
    ) -> StoredTable:
        """Return the table of the only vehicle that matches."""
        key = self._choose(tx, vehicle, system=system, component=component)
        table = tables.find_table(tx, key, component, extended=extended)
        if table is None:  # only of extended parameters: a component has a plain table
            raise NotInCache(f"{key}, component {component}, has no extended parameters in the cache")
        return table

    def _choose(
        self, tx: Transaction, vehicle: str | None, *, system: int | None = None, component: int | None = None
    ) -> str:
        """Return the key of the only vehicle that matches; see `paramclient.cache.lookup`."""
        known = tables.load_vehicles(tx)
        return find_vehicle(known, vehicle, place=self.place, system=system, component=component).key
