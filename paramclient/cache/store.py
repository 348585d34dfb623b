"""The cache as users and the client see it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType

import platformdirs

from paramclient.cache import fleet, snapshots, tables
from paramclient.cache.database_url import Address, is_address
from paramclient.cache.fleet import FleetDiff
from paramclient.cache.interface import Store
from paramclient.cache.lookup import find_vehicle
from paramclient.cache.operations import Merge, Remove, Save, SetDown
from paramclient.cache.records import (
    CacheChange,
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    Snapshot,
    SnapshotSummary,
    TableUpdate,
)
from paramclient.cache.sqlite import SqliteStore
from paramclient.cache.transaction import Session
from paramclient.cache.transfer import CopyResult, copy_store
from paramclient.errors import CacheError, NotInCache
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet

__all__ = ["ParamCache", "default_path"]


def default_path() -> Path:
    """Where the cache is kept unless told otherwise: `parameters.sqlite3` in the user's cache folder."""
    return platformdirs.user_cache_path("paramclient") / "parameters.sqlite3"


class ParamCache:
    """Tables, identities and history. Usable with no link, by several threads and processes at once.

    They are in a file, or in a PostgreSQL that many stations share. The file is opened by the first call that
    needs it. Reading creates nothing. Every call blocks, as a rule
    for milliseconds, and for a few seconds at most where another process holds the file. What a call has
    written survives the death of the process at any moment; a power cut may take the last calls, never the
    file. A file that is damaged, or newer than this version, is set aside with a warning in the log, and a
    fresh one begins.

    Of a database (`postgresql://USER@HOST/NAME`), the tables that this program has to do with are also in a
    local copy. While the database cannot be reached, that is what is read and written, `away` says why, and a
    warning goes to the log. What was written goes to the database once it is back, in order and each change
    once. Several stations that hear one vehicle write to one table: of each value the later observation
    counts, and both are in the history. The clocks of the stations have to agree.

    Args:
        path: the file; None for `default_path()`; or the URL of a database.
        local: where the local copy of a database is kept; None for a file in the user's cache folder.

    Attributes:
        path: the file, absolute; of a database, the local copy.

    Raises:
        UsageError: the URL cannot be read, or psycopg is missing.
        CacheError: from every method that reads or writes: the file cannot be used (read-only, disk full,
            held for too long by another process), the database was never reached from here or refuses, or
            the cache is closed. Nothing was written then.
    """

    def __init__(
        self, path: str | os.PathLike[str] | None = None, *, local: str | os.PathLike[str] | None = None
    ) -> None:
        self._store: Store
        if isinstance(path, str) and is_address(path):
            from paramclient.cache.shared import SharedStore  # loaded only where there is a database

            address = Address.parse(path)
            self.path = Path(default_path().with_name(address.name) if local is None else local).resolve()
            self._store = SharedStore(address, self.path)
        else:
            named = Path(default_path() if path is None else path)
            self.path = named.resolve()
            self._store = SqliteStore(self.path, link=named if named.is_symlink() else None)

    def __enter__(self) -> ParamCache:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ParamCache {self.place}>"

    def close(self) -> None:
        """Close the cache; later calls raise CacheError. One that is thrown away closes by itself."""
        self._store.close()

    @property
    def place(self) -> str:
        """Where the cache is, for people: the file, or the URL of the database without a password."""
        return self._store.place

    @property
    def away(self) -> str | None:
        """Why a database is not used at present, but its local copy; None while it is, and for a file."""
        return self._store.away

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong with the file so far and was mended: one text for each file set aside."""
        return self._store.notes

    @property
    def replacements(self) -> int:
        """How often a fresh file was made, or another one found in its place: what was saved is not in it."""
        return self._store.replacements

    def save(
        self, update: TableUpdate | Sequence[TableUpdate], *, clock: Callable[[], float] | None = None
    ) -> None:
        """Write what was learnt, in one transaction: all of it is kept, or nothing.

        Of two observations of a parameter the later one counts, whichever is saved first; the other one finds
        its place in the history. A parameter that appears for the first time leaves no line of history, one
        that goes leaves a line with its last value. −0 and 0 are no change of a value.

        A file is written by the clock of one computer: what it has of a time more than 5 s after the present
        was written before that clock was set back, and counts as older than what is saved.

        Args:
            update: what was learnt, or several of these.
            clock: gives the present, in unix seconds, by the clock that the times were read from. It is asked
                when the cache is free to be written, from any thread. None: the present is `at`.

        Raises:
            UsageError: a time that is not in unix seconds.
        """
        updates = (update,) if isinstance(update, TableUpdate) else tuple(update)
        if updates:
            self._store.do(Save(updates, clock))

    def sync(self) -> None:
        """Return when all that was written so far is on the disk: a loss of power costs nothing of it.

        It takes as long as the disk does, as a rule some milliseconds. While a database is away, the disk is
        that of the local copy.
        """
        self._store.do(Save((), is_durable=True))

    def merge(
        self, updates: Sequence[TableUpdate], *, based_on: Mapping[tuple[str, int], float] | None = None
    ) -> None:
        """Write what was observed in the past, in one transaction: all of it is kept, or nothing.

        What is kept of a later time than an observation stays as it is; the history is completed with what
        changed before that. To merge the same again changes nothing.

        Args:
            updates: as for `save`, in the order of their times.
            based_on: by key and component, `updated_at` of the kept tables that the updates go on from; the
                others know nothing of what was kept.

        Raises:
            UsageError: a time that is not in unix seconds.
        """
        if updates:
            self._store.do(Merge(updates, based_on or {}))

    def load(self, key: str, component: int) -> CachedComponent | None:
        """The table of a vehicle's component, or None.

        Args:
            key: `Identity.key`.
            component: component id.
        """
        found = self._store.read(lambda session: self._load(session, key, component))
        if found is not None:
            self._store.follow(key, component)
        return found

    def vehicles(self) -> list[CachedVehicle]:
        """Every vehicle, the one seen last first."""
        return self._store.read(lambda session: session.vehicles())

    def components(self, vehicle: str | None = None) -> list[CachedSummary]:
        """Every table, without its parameters, ordered as `vehicles()`, then by component id.

        Args:
            vehicle: only this one: its system id (`"4"`), `uid:` with at least 6 digits of its hardware id,
                its hardware id in full, or its key.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have it.
        """

        def work(session: Session) -> list[CachedSummary]:
            key = None if vehicle is None else self._choose(session, vehicle)
            return [summary for _, summary in session.summaries(key)]

        return self._store.read(work)

    def component(
        self, vehicle: str | None = None, *, system: int | None = None, component: int = 1
    ) -> CachedComponent:
        """The one table that fits.

        Args:
            vehicle: as for `components`.
            system: its system id.
            component: component id; the autopilot's is 1.

        Raises:
            UnknownVehicle: no table fits. `vehicles` and the text say what there is.
            AmbiguousVehicle: tables of several vehicles fit. `vehicles` and the text list them.
        """

        def work(session: Session) -> CachedComponent:
            key = self._choose(session, vehicle, system=system, component=component)
            found = self._load(session, key, component)
            assert found is not None, "what was chosen exists for the whole transaction"
            return found

        return self._store.read(work)

    def history(
        self,
        vehicle: str,
        component: int | None = None,
        name: str | None = None,
        limit: int | None = None,
        since: float | None = None,
    ) -> list[HistoryEntry]:
        """The changes of a vehicle's values, newest last. Of each table the newest `HISTORY_LINES` are kept.

        Args:
            vehicle: as for `components`.
            component: of this component only.
            name: of this parameter only.
            limit: the newest so many.
            since: those from this time on only, in unix seconds.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have it.
        """

        return self._store.read(
            lambda session: session.history(self._choose(session, vehicle), component, name, limit, since)
        )

    def snapshot(self, vehicle: str, component: int, *, reason: str, at: float | None = None) -> Snapshot:
        """Set a table down as it is kept now, so that it can be had again however it changes.

        Of each table the newest `SNAPSHOTS` are kept.

        Args:
            vehicle: as for `components`.
            component: component id.
            reason: what for, in words.
            at: unix seconds; None for now.

        Raises:
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
        """

        moment = time.time() if at is None else at
        key, _ = self._store.read(lambda session: self._table(session, vehicle, component))
        return self._store.do(SetDown(key, component, None, moment, reason))

    def store_snapshot(
        self,
        vehicle: Identity | str,
        component: int,
        params: ParamSet,
        *,
        reason: str,
        at: float | None = None,
        hash: int | None = None,  # noqa: A002  # the word of the record
        complete: bool = True,
    ) -> Snapshot:
        """Set down a table that the caller has, as what a vehicle holds at this moment.

        The table that is kept does not change. Of each table the newest `SNAPSHOTS` are kept.

        Args:
            vehicle: who it is; one that the cache does not know yet is written down. Or the name of one that
                it knows, as for `components`.
            component: component id.
            params: names, values, types and defaults are kept, comments and lines are not.
            reason: what for, in words.
            at: unix seconds; None for now.
            hash: the hash under which the vehicle would confirm these parameters, where it is known.
            complete: these are all the parameters that the vehicle has.

        Raises:
            UnknownVehicle: a name was given, and there is no such table.
            AmbiguousVehicle: several vehicles have this name.
        """
        moment = time.time() if at is None else at
        who = vehicle
        if isinstance(vehicle, str):
            who, _ = self._store.read(lambda session: self._table(session, vehicle, component))
        return self._store.do(SetDown(who, component, params, moment, reason, hash, complete))

    def snapshots(self, vehicle: str, component: int | None = None) -> list[SnapshotSummary]:
        """The snapshots of a vehicle's tables, newest last.

        Args:
            vehicle: as for `components`.
            component: of this component only.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have it.
        """
        return self._store.read(lambda session: session.snapshots(self._choose(session, vehicle), component))

    def state_at(self, vehicle: str, component: int, when: float) -> ParamSet:
        """A table as it was at a moment.

        Exact where a snapshot was made then. Else it is worked backwards from the present table over the
        lines of history, and is what was last known at that moment: a change counts from when it was heard.
        It reaches back to the moment when the table was first complete, or to the oldest line of history
        that was dropped (`HISTORY_LINES`) if that is later. Names heard for the first time after `when` are
        not in it. Defaults and the firmware of the vehicle are only known of snapshots.

        Args:
            vehicle: as for `components`.
            component: component id.
            when: a float is a time, in unix seconds; an int is the id of a snapshot.

        Raises:
            UsageError: a time that is not in unix seconds.
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
            CacheError: there is no such snapshot of it, or it is damaged; history does not reach back so far
                (the text says how far, and which snapshots are next to it), or the clock of this computer
                went through that moment twice.
        """

        def work(session: Session) -> ParamSet:
            key, owner = self._table(session, vehicle, component)
            if isinstance(when, int):
                return snapshots.snapshot(session, owner, when).params
            [(_, state)] = session.summaries(key, component)
            rows = session.table(owner)
            return snapshots.state_at(session, owner, state.identity, rows, when)

        return self._store.read(work)

    def fleet_diff(self, wanted: Iterable[str] | ParamSet, *, component: int | None = None) -> FleetDiff:
        """Compare every vehicle in some parameters: which of them differ, and since when.

        It takes a fraction of a second for a thousand vehicles and hundreds of parameters.

        Args:
            wanted: the values that all should have; or names, to compare the vehicles with each other.
                Names may be patterns of the shell: `MC_*`.
            component: component id; None for that of `wanted`, or the autopilot's.

        Raises:
            CacheError: no vehicle has a table of the component, or none has a parameter of such a name.
        """
        written = wanted if isinstance(wanted, ParamSet) else None
        names = () if written is not None else tuple(wanted)
        number = component or (written and written.component) or 1

        def work(session: Session) -> FleetDiff:
            chosen = {name: fleet.names_like(session, number, name) for name in names}
            plain: dict[str, None] = dict.fromkeys(each for like in chosen.values() for each in like)
            found = fleet.fleet_diff(session, number, plain if written is None else written)
            if not found.vehicles:
                raise NotInCache(f"the cache {self.place} holds no table of component {number}")
            held = {each.name for each in found.names if each.values}
            for name, like in chosen.items():
                if held.isdisjoint(like):
                    raise NotInCache(f"no vehicle in the cache {self.place} has a parameter {name}")
            return found

        return self._store.read(work)

    def subscribe(self, told: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Have something called when another station has written to a table of the database.

        That is within a second. What was written while the database could not be reached is told when it is
        back. Of a file nothing is told.

        Args:
            told: is called in a thread of the cache. It should be done soon, and may use the cache.

        Returns:
            What ends it.
        """
        return self._store.subscribe(told)

    def copy_to(
        self, target: ParamCache, *, progress: Callable[[str, int, int], None] | None = None
    ) -> CopyResult:
        """Bring every table into another cache, with history and snapshots, and see that it is there.

        Each table is one transaction, and one of which everything is there already is left alone: ended at
        any moment, it is begun again in the same way. What the other cache has of a table stays: of each
        value the later observation counts, and no line of history is there twice.

        Args:
            progress: is told of each table: whose it is, its number, and how many there are.

        Raises:
            UsageError: both are the same.
            CacheError: one of them cannot be used, its database is away, or something did not arrive.
        """
        result = copy_store(self._store, target._store, progress)
        for each in (self, target):
            if each.away is not None:
                raise CacheError(f"{each.away}; copy again once it is back")
        return result

    def remove(self, vehicle: str, component: int | None = None) -> int:
        """Forget a vehicle's tables with their history and snapshots; give the number of tables.

        Args:
            vehicle: as for `components`.
            component: this component's only.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have it.
        """

        def work(session: Session) -> tuple[str, int]:
            key = self._choose(session, vehicle)
            return key, len(session.summaries(key, component))

        key, known = self._store.read(work)
        return self._store.do(Remove(key, component, known))

    def _table(self, session: Session, vehicle: str, component: int) -> tuple[str, int]:
        """The key of the vehicle that is meant, and the id of its table."""
        key = self._choose(session, vehicle, component=component)
        owner = session.owner_of(key, component)
        assert owner is not None, "what was chosen exists for the whole transaction"
        return key, owner

    def _load(self, session: Session, key: str, component: int) -> CachedComponent | None:
        def history(name: str | None, limit: int | None) -> list[HistoryEntry]:
            return self._store.read(lambda session: session.history(key, component, name, limit, None))

        return tables.component(session, key, component, history=history)

    def _choose(
        self,
        session: Session,
        vehicle: str | None,
        *,
        system: int | None = None,
        component: int | None = None,
    ) -> str:
        """Return the key of the only vehicle that fits; see `paramclient.cache.lookup`."""
        return find_vehicle(
            session.vehicles(), vehicle, place=self.place, system=system, component=component
        ).key
