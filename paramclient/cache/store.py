"""ParamCache: the public class of the cache."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from collections.abc import Set as AbstractSet
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import platformdirs

from paramclient.cache import fleet, snapshots, table_updates
from paramclient.cache.database_url import DatabaseAddress, is_address
from paramclient.cache.ext_records import CachedExtTable, ExtHistoryEntry, ExtSnapshot, ExtTableUpdate
from paramclient.cache.ext_snapshots import ext_snapshot, ext_state_at
from paramclient.cache.ext_tables import load_ext
from paramclient.cache.file_table import AddedTable, FileTable
from paramclient.cache.fleet import FleetDiff
from paramclient.cache.interface import Store
from paramclient.cache.lookup import find_vehicle
from paramclient.cache.nicknames import Nicknames
from paramclient.cache.operations import Merge, Remove, Save, SaveExt, StoreExtSnapshot, StoreSnapshot
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
from paramclient.cache.transaction import Transaction
from paramclient.cache.transfer import CopyResult, copy_store
from paramclient.errors import CacheError, NotInCache, UnknownVehicle, UsageError
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.notation import time_text
from paramclient.model.paramset import ParamSet

__all__ = ["ParamCache", "default_path"]


def default_path() -> Path:
    """Return the default path of the cache: `parameters.sqlite3` in the user's cache folder."""
    return platformdirs.user_cache_path("paramclient") / "parameters.sqlite3"


class ParamCache:
    """Cache of parameter tables, vehicle identities, history and snapshots.

    It is usable without a link, and by several threads and processes at the same time.

    The cache is a file, or a PostgreSQL database shared by several stations. The file is opened by the first
    call that needs it. Reading creates no file. Every call blocks, usually for milliseconds, and for up to 5
    s if another process locks the file. Committed data survives a killed process at any time; a power loss
    may lose the last calls, but does not damage the file. A file that is damaged, or newer than this version,
    is renamed with a warning in the log, and a new file is created.

    For a database (`postgresql://USER@HOST/NAME`), the tables that this program uses are also in a local
    copy. While the database cannot be reached, reads and writes use the local copy, `offline_reason` has the
    reason, and a warning is logged. After the reconnection, queued writes are executed in the database in
    order, each exactly once. Several stations that receive one vehicle write to one table: the later
    observation of a value counts, and the history has both. The clocks of the stations have to agree.

    Args:
        path: the file; None for `default_path()`; or the URL of a database.
        local: path of the local copy of a database; None for a file in the user's cache folder.

    Attributes:
        path: the file, absolute; for a database, the local copy.

    Raises:
        UsageError: the URL is not valid, or psycopg is not installed.
        CacheError: from every method that reads or writes: the file cannot be used (it is read-only, the disk
            is full, or another process locks it for more than 5 s), the database was never reached from this
            computer or refuses the call, or the cache is closed. Nothing was written.
    """

    def __init__(
        self, path: str | os.PathLike[str] | None = None, *, local: str | os.PathLike[str] | None = None
    ) -> None:
        self._store: Store
        if isinstance(path, str) and is_address(path):
            from paramclient.cache.shared import SharedStore  # imported only for a database

            address = DatabaseAddress.parse(path)
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
        """Close the cache; later calls raise CacheError. Garbage collection closes it too."""
        self._store.close()

    def limit_lock_waits(self, seconds: float) -> None:
        """Wait for locks of other processes for at most these seconds from now in all, before the end of a
        program. Each later write is still attempted once. Does not block.
        """
        self._store.limit_lock_waits(seconds)

    @property
    def place(self) -> str:
        """The file, or the URL of the database without password, for messages."""
        return self._store.place

    @property
    def offline_reason(self) -> str | None:
        """Why the local copy is used instead of the database; None while it is used, and for a file."""
        return self._store.offline_reason

    @property
    def notes(self) -> tuple[str, ...]:
        """Repaired problems of the file: one text for each damaged or newer file that was renamed."""
        return self._store.notes

    @property
    def replacements(self) -> int:
        """Number of times that a new file was created or found, which lacks earlier writes."""
        return self._store.replacements

    def save(
        self, update: TableUpdate | Sequence[TableUpdate], *, clock: Callable[[], float] | None = None
    ) -> None:
        """Write updates of tables, in one transaction: either all or nothing is written.

        The later of two observations of a parameter counts, independent of the order of writes; the other one
        is inserted into the history. A new parameter leaves no history line; a removed one leaves a line with
        its last value. −0 and 0 are equal values.

        A file is written by the clock of one computer: a stored time more than 5 s in the future is from
        before that clock was set back, and counts as older than new observations.

        Args:
            update: one update, or several.
            clock: returns the current time in unix seconds, by the clock of the updates. It is called when
                the write lock is held, from any thread. None: the current time is `at`.

        Raises:
            UsageError: a time is not in unix seconds.
        """
        updates = (update,) if isinstance(update, TableUpdate) else tuple(update)
        if updates:
            self._store.do(Save(updates, clock))

    def save_ext(
        self, updates: Sequence[ExtTableUpdate], *, clock: Callable[[], float] | None = None
    ) -> None:
        """Write updates of extended parameters, in one transaction.

        The later of two observations of a parameter counts; an older one that arrives later is dropped. A
        changed or removed value leaves a line of history.

        Args:
            updates: the updates.
            clock: as in `save`.

        Raises:
            UsageError: a time is not in unix seconds.
        """
        if updates:
            self._store.do(SaveExt(tuple(updates), clock))

    def load_ext(self, key: str, component: int) -> CachedExtTable | None:
        """Return the extended parameters of a vehicle's component; None if there are none.

        Args:
            key: `Identity.key`.
            component: component id.
        """
        found = self._store.read(lambda transaction: load_ext(transaction, key, component))
        if found is not None:
            self._store.follow(key, component)
        return found

    def extended(
        self, vehicle: str | None = None, *, system: int | None = None, component: int = 100
    ) -> CachedExtTable:
        """Return the extended parameters of the only component that matches.

        Args:
            vehicle: as for `components`.
            system: its system id.
            component: component id; that of a camera is 100.

        Raises:
            UnknownVehicle: no table matches. `vehicles` and the message list the existing ones.
            AmbiguousVehicle: tables of several vehicles match.
            NotInCache: the component has no extended parameters in the cache.
        """

        def work(transaction: Transaction) -> CachedExtTable:
            key = self._choose(transaction, vehicle, system=system, component=component)
            found = load_ext(transaction, key, component)
            if found is None:
                raise NotInCache(f"{key}, component {component}, has no extended parameters in the cache")
            return found

        return self._store.read(work)

    def ext_sizes(self) -> dict[tuple[str, int], int]:
        """Return the number of extended parameters of each component that has some, by key and component."""
        return self._store.read(lambda transaction: transaction.ext_sizes())

    def ext_history(
        self,
        vehicle: str,
        component: int | None = None,
        name: str | None = None,
        limit: int | None = None,
        since: float | None = None,
    ) -> list[ExtHistoryEntry]:
        """Return the changes of a vehicle's extended parameters, newest last.

        Args:
            vehicle, component, name, limit, since: as in `history`.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """
        return self._store.read(
            lambda transaction: transaction.ext_history(
                self._choose(transaction, vehicle), component, name, limit, since
            )
        )

    def ext_snapshot(
        self, vehicle: str, component: int, *, reason: str, at: float | None = None
    ) -> ExtSnapshot:
        """Store a snapshot of the cached extended parameters of a component, and return it.

        The cache keeps the newest `SNAPSHOTS` (50) of each table.

        Args:
            vehicle, component, reason, at: as in `snapshot`.

        Raises:
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
            NotInCache: the component has no extended parameters in the cache.
        """
        moment = time.time() if at is None else at
        key, _ = self._store.read(lambda transaction: self._table(transaction, vehicle, component))
        return self._store.do(StoreExtSnapshot(key, component, None, moment, reason))

    def store_ext_snapshot(
        self,
        vehicle: Identity | str,
        component: int,
        params: ExtParamSet,
        *,
        reason: str,
        at: float | None = None,
        complete: bool = True,
    ) -> ExtSnapshot:
        """Store a snapshot of given extended parameters, and return it.

        The cached table does not change. The cache keeps the newest `SNAPSHOTS` (50) of each table.

        Args:
            vehicle, component, reason, at, complete: as in `store_snapshot`.
            params: the parameters.

        Raises:
            UnknownVehicle: a name was given, and there is no such table.
            AmbiguousVehicle: several vehicles have this name.
        """
        moment = time.time() if at is None else at
        target = vehicle
        if isinstance(vehicle, str):
            target, _ = self._store.read(lambda transaction: self._table(transaction, vehicle, component))
        return self._store.do(StoreExtSnapshot(target, component, params, moment, reason, complete))

    def ext_snapshots(self, vehicle: str, component: int | None = None) -> list[SnapshotSummary]:
        """Return the snapshots of a vehicle's extended parameters, without the parameters, newest last.

        Args:
            vehicle, component: as in `snapshots`.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """
        return self._store.read(
            lambda transaction: transaction.snapshots(
                self._choose(transaction, vehicle), component, is_extended=True
            )
        )

    def ext_state_at(self, vehicle: str, component: int, when: float) -> ExtParamSet:
        """Return the extended parameters of a component as they were at a given time.

        As `state_at`, but parameters that appeared after `when` are included.

        Args:
            vehicle, component: as in `state_at`.
            when: a float is a time, in unix seconds; an int is the id of a snapshot of extended parameters.

        Raises:
            UsageError: the time is not in unix seconds.
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
            CacheError: as from `state_at`.
        """

        def work(transaction: Transaction) -> ExtParamSet:
            key, owner = self._table(transaction, vehicle, component)
            if isinstance(when, int):
                return ext_snapshot(transaction, owner, when).params
            [(_, state)] = transaction.summaries(key, component)
            return ext_state_at(transaction, owner, state.identity, when)

        return self._store.read(work)

    def sync(self) -> None:
        """Sync all earlier writes to the disk, safe from power loss.

        It takes the time of a disk sync, usually some milliseconds. While a database is not connected, it
        syncs the local copy.
        """
        self._store.do(Save((), is_durable=True))

    def merge(
        self, updates: Sequence[TableUpdate], *, based_on: Mapping[tuple[str, int], float] | None = None
    ) -> None:
        """Merge earlier observations, such as those of a log, in one transaction.

        Stored values with later observations do not change; earlier changes are added to the history.
        Repeating a merge changes nothing.

        Args:
            updates: as for `save`, in the order of their times.
            based_on: by key and component, `updated_at` of the stored tables on which the updates are based;
                all other updates are independent of the stored tables.

        Raises:
            UsageError: a time is not in unix seconds.
        """
        if updates:
            self._store.do(Merge(updates, based_on or {}))

    def add(
        self,
        params: ParamSet,
        vehicle: str | Identity | None = None,
        *,
        component: int | None = None,
        at: float | None = None,
        force: bool = False,
    ) -> AddedTable:
        """Make the parameters of a file the cached table of a vehicle, such as before a slow link is used.

        The table is marked with `params.source` until the vehicle has confirmed or replaced it. If the
        vehicle is a PX4 and the file is complete, the table has the hash of its values: at the first contact,
        an equal hash of the vehicle confirms them without a download. Otherwise the next fetch downloads the
        table.

        Types that the file does not have, and the indices, are those of the vehicle's previous table, or of
        another complete table of the same firmware; without one, a PX4's indices follow from the names.

        Args:
            params: the parameters.
            vehicle: a vehicle in the cache, as for `components`, or that of the file's identity; or another
                identity, which may be new; None for the identity of the file.
            component: component id; None for that of the file, else the autopilot's.
            at: time of the values in unix seconds; None for that of the file, else now.
            force: replace a table that was received later than `at`: the values then have the present time.

        Raises:
            UsageError: the file is empty, does not name its vehicle, lacks types that no cached table has, or
                has an invalid value; or the table was received later, and `force` is not given.
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """
        number = component or params.component or 1
        moment = at or params.at or time.time()
        if not params:
            raise UsageError(f"{params.source or 'the file'} has no parameters")

        def work(transaction: Transaction) -> tuple[TableUpdate, AddedTable]:
            identity = params.identity if vehicle is None else vehicle
            if isinstance(identity, str):
                identity = self._named(transaction, identity, params.identity)
            elif identity is None:
                what = params.source or "the file"
                raise UsageError(f"{what} does not name its vehicle; name one of the cache")
            kept = next((each for _, each in transaction.summaries(identity.key, number)), None)
            since = moment
            if kept is not None and kept.size:
                owner = transaction.owner_of(kept.key, number)
                assert owner is not None, "it was found in the same transaction"
                last = max(transaction.heard_last(owner), kept.synced_at or 0.0)
                if last > moment:
                    if kept.source is None and not force:
                        raise UsageError(_newer(kept, last, moment))
                    since = max(time.time(), last)
            return FileTable(identity, number, params, since).update(transaction, kept)

        update, added = self._store.read(work)
        self.save(update)
        return added

    def load(self, key: str, component: int) -> CachedComponent | None:
        """Return the table of a vehicle's component; None if there is none.

        Args:
            key: `Identity.key`.
            component: component id.
        """
        found = self._store.read(lambda transaction: self._load(transaction, key, component))
        if found is not None:
            self._store.follow(key, component)
        return found

    def vehicles(self) -> list[CachedVehicle]:
        """Return all vehicles, the last seen first."""
        return self._store.read(lambda transaction: transaction.vehicles())

    @property
    def nicknames(self) -> Mapping[str, str]:
        """The keys of vehicles by nickname: those of this computer, in a file beside `path`.

        Raises:
            CacheError: the file cannot be read.
        """
        return Nicknames.beside(self.path).load()

    def set_nickname(self, vehicle: str, nickname: str | None) -> str:
        """Give a vehicle a nickname, by which every call and the command line then know it.

        Args:
            vehicle: the vehicle, as in `components`.
            nickname: 1 to 32 letters, digits, `_` and `-`, in place of the previous one; None for none.

        Returns:
            The key of the vehicle.

        Raises:
            UsageError: the nickname is not valid, or is that of another vehicle.
            UnknownVehicle, AmbiguousVehicle: as `components`.
            CacheError: the nicknames cannot be written.
        """
        key = self.components(vehicle)[0].key
        names = Nicknames.beside(self.path)
        if nickname is None:
            names.remove(key)
        else:
            names.set(key, nickname)
        return key

    def components(self, vehicle: str | None = None) -> list[CachedSummary]:
        """Return all tables without parameters, ordered as `vehicles()`, then by component id.

        Args:
            vehicle: only this vehicle: its system id (`"4"`), its address (`"4/1"`), its nickname, `px4` or
                `ardupilot` if only one has that autopilot, `uid:` with at least 6 digits of its hardware id,
                its full hardware id, or its key.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """

        def work(transaction: Transaction) -> list[CachedSummary]:
            key = None if vehicle is None else self._choose(transaction, vehicle)
            return [summary for _, summary in transaction.summaries(key)]

        return self._store.read(work)

    def component(
        self, vehicle: str | None = None, *, system: int | None = None, component: int = 1
    ) -> CachedComponent:
        """Return the only table that matches.

        Args:
            vehicle: as for `components`.
            system: its system id.
            component: component id; the autopilot's is 1.

        Raises:
            UnknownVehicle: no table matches. `vehicles` and the message list the existing ones.
            AmbiguousVehicle: tables of several vehicles match. `vehicles` and the message list them.
        """

        def work(transaction: Transaction) -> CachedComponent:
            key = self._choose(transaction, vehicle, system=system, component=component)
            found = self._load(transaction, key, component)
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
        """Return the changes of a vehicle's values, newest last.

        The cache keeps the newest `HISTORY_ENTRIES_MAX` (10,000) of each table.

        Args:
            vehicle: as for `components`.
            component: only changes of this component.
            name: only changes of this parameter.
            limit: maximum number of changes, the newest.
            since: only changes from this time on, in unix seconds.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """

        return self._store.read(
            lambda transaction: transaction.history(
                self._choose(transaction, vehicle), component, name, limit, since
            )
        )

    def snapshot(self, vehicle: str, component: int, *, reason: str, at: float | None = None) -> Snapshot:
        """Store a snapshot of a cached table as a restore point, and return it.

        The cache keeps the newest `SNAPSHOTS` (50) of each table.

        Args:
            vehicle: as for `components`.
            component: component id.
            reason: the reason, as text.
            at: unix seconds; None for now.

        Raises:
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
        """

        moment = time.time() if at is None else at
        key, _ = self._store.read(lambda transaction: self._table(transaction, vehicle, component))
        return self._store.do(StoreSnapshot(key, component, None, moment, reason))

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
        """Store a snapshot of given parameters, and return it.

        The cached table does not change. The cache keeps the newest `SNAPSHOTS` (50) of each table.

        Args:
            vehicle: identity of the vehicle, which is added to the cache if it is new; or the name of a
                cached vehicle, as for `components`.
            component: component id.
            params: names, values, types and defaults are stored; comments and lines are not.
            reason: the reason, as text.
            at: unix seconds; None for now.
            hash: the vehicle's hash of these parameters, if known.
            complete: whether these are all parameters of the vehicle.

        Raises:
            UnknownVehicle: a name was given, and there is no such table.
            AmbiguousVehicle: several vehicles have this name.
        """
        moment = time.time() if at is None else at
        target = vehicle
        if isinstance(vehicle, str):
            target, _ = self._store.read(lambda transaction: self._table(transaction, vehicle, component))
        return self._store.do(StoreSnapshot(target, component, params, moment, reason, hash, complete))

    def snapshots(self, vehicle: str, component: int | None = None) -> list[SnapshotSummary]:
        """Return the snapshots of a vehicle's tables, without parameters, newest last.

        Args:
            vehicle: as for `components`.
            component: only snapshots of this component.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """
        return self._store.read(
            lambda transaction: transaction.snapshots(self._choose(transaction, vehicle), component)
        )

    def state_at(self, vehicle: str, component: int, when: float) -> ParamSet:
        """Return a table as it was at a given time.

        The result is exact if a snapshot has this time. Otherwise it is computed backwards from the current
        table with the history lines, and has the last values received before that time. It is available back
        to the time when the table was first complete, or to the newest dropped history line
        (`HISTORY_ENTRIES_MAX`) if that is later. Names received for the first time after `when` are not
        included. Only snapshots have defaults and the firmware of the vehicle.

        Args:
            vehicle: as for `components`.
            component: component id.
            when: a float is a time, in unix seconds; an int is the id of a snapshot.

        Raises:
            UsageError: the time is not in unix seconds.
            UnknownVehicle: there is no such table.
            AmbiguousVehicle: several vehicles have this name.
            CacheError: there is no such snapshot of the table, or it is damaged; the history begins later
                (the message has its beginning, and the nearest snapshots); or the time is ambiguous, because
                the clock of this computer was set back over it.
        """

        def work(transaction: Transaction) -> ParamSet:
            key, owner = self._table(transaction, vehicle, component)
            if isinstance(when, int):
                return snapshots.snapshot(transaction, owner, when).params
            [(_, state)] = transaction.summaries(key, component)
            rows = transaction.table(owner)
            return snapshots.state_at(transaction, owner, state.identity, rows, when)

        return self._store.read(work)

    def fleet_diff(self, wanted: Iterable[str] | ParamSet, *, component: int | None = None) -> FleetDiff:
        """Compare parameters of all vehicles: which vehicles differ, and since when.

        It takes less than a second for 1,000 vehicles and hundreds of parameters.

        Args:
            wanted: the wanted values; or names, to compare the vehicles with each other. Names may be shell
                patterns: `MC_*`.
            component: component id; None for that of `wanted`, or the autopilot's.

        Raises:
            CacheError: no vehicle has a table of the component, or none has a parameter of such a name.
        """
        written = wanted if isinstance(wanted, ParamSet) else None
        names = () if written is not None else tuple(wanted)
        number = component or (written and written.component) or 1

        def work(transaction: Transaction) -> FleetDiff:
            chosen = fleet.names_like(transaction, number, names)
            plain: dict[str, None] = dict.fromkeys(each for like in chosen.values() for each in like)
            found = fleet.fleet_diff(transaction, number, plain if written is None else written)
            self._check_fleet(
                number, found.vehicles, chosen, {each.name for each in found.names if each.values}
            )
            return found

        return self._store.read(work)

    def fleet_names(self, names: Iterable[str], *, component: int) -> tuple[int, list[str]]:
        """Return what `fleet_diff` would compare, without a comparison.

        Args:
            names: names and shell patterns.
            component: component id.

        Returns:
            The number of vehicles, and the parameter names.

        Raises:
            CacheError: no vehicle has a table of the component, or none has a parameter of such a name.
        """
        given = tuple(names)

        def work(transaction: Transaction) -> tuple[int, list[str]]:
            vehicles = transaction.tables_of(component)
            chosen = fleet.names_like(transaction, component, given)
            compared = dict.fromkeys(each for like in chosen.values() for each in like)
            self._check_fleet(component, vehicles, chosen, compared.keys())
            return len(vehicles), list(compared)

        return self._store.read(work)

    def _check_fleet(
        self, component: int, vehicles: Sized, chosen: Mapping[str, Iterable[str]], names: AbstractSet[str]
    ) -> None:
        """Check that there are vehicles, and that each pattern has a name in `names`.

        Raises:
            NotInCache: the reason.
        """
        if not vehicles:
            raise NotInCache(f"the cache {self.place} holds no table of component {component}")
        for name, like in chosen.items():
            if names.isdisjoint(like):
                raise NotInCache(f"no vehicle in the cache {self.place} has a parameter {name}")

    def subscribe(self, callback: Callable[[CacheChange], None]) -> Callable[[], None]:
        """Call a function after each write of another station to a table of the database.

        The call follows within 1 s. Writes during a lost connection are reported after the reconnection. For
        a file, the function is never called.

        Args:
            callback: called in a thread of the cache, with the table. It should return within milliseconds,
                and may use the cache.

        Returns:
            A function that ends the subscription.
        """
        return self._store.subscribe(callback)

    def copy_to(
        self, target: ParamCache, *, progress: Callable[[str, int, int], None] | None = None
    ) -> CopyResult:
        """Copy all tables with history and snapshots to another cache, and verify the copy.

        Each table is one transaction, and a table that is already complete in the target is skipped: an
        interrupted copy can be repeated. Tables in the target are merged: the later observation of a value
        counts, and no history line is duplicated.

        Args:
            target: the other cache.
            progress: called for each table with the key of the vehicle, the number of the table, and the
                total.

        Returns:
            The numbers of tables, parameters, history lines and snapshots.

        Raises:
            UsageError: both caches are the same.
            CacheError: a cache cannot be used, its database is not connected, or the verification failed.
        """
        result = copy_store(self._store, target._store, progress)
        for each in (self, target):
            if each.offline_reason is not None:
                raise CacheError(f"{each.offline_reason}; copy again once it is back")
        return result

    def remove(self, vehicle: str, component: int | None = None) -> int:
        """Remove a vehicle's tables with history and snapshots, and return the number of tables.

        Args:
            vehicle: as for `components`.
            component: only the table of this component.

        Raises:
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several vehicles have this name.
        """

        def work(transaction: Transaction) -> tuple[str, int]:
            key = self._choose(transaction, vehicle)
            return key, len(transaction.summaries(key, component))

        key, known = self._store.read(work)
        return self._store.do(Remove(key, component, known))

    def _named(self, transaction: Transaction, name: str, new: Identity | None) -> Identity:
        """Return the identity of the vehicle with this name, which may be one that the cache does not have.

        Raises:
            UnknownVehicle, AmbiguousVehicle: as `components`.
        """
        try:
            key = self._choose(transaction, name)
        except UnknownVehicle:
            if new is None:
                raise
            one = CachedVehicle(new.key, new, 0.0, 0.0, ())
            with suppress(UnknownVehicle):
                return find_vehicle([one], name, place="").identity
            raise
        [found] = transaction.vehicles(key)
        return found.identity

    def _table(self, transaction: Transaction, vehicle: str, component: int) -> tuple[str, int]:
        """Return the key of the only vehicle with this name, and the id of its table."""
        key = self._choose(transaction, vehicle, component=component)
        owner = transaction.owner_of(key, component)
        assert owner is not None, "what was chosen exists for the whole transaction"
        return key, owner

    def _load(self, transaction: Transaction, key: str, component: int) -> CachedComponent | None:
        def history(name: str | None, limit: int | None) -> list[HistoryEntry]:
            return self._store.read(
                lambda transaction: transaction.history(key, component, name, limit, None)
            )

        return table_updates.component(transaction, key, component, history=history)

    def _choose(
        self,
        transaction: Transaction,
        vehicle: str | None,
        *,
        system: int | None = None,
        component: int | None = None,
    ) -> str:
        """Return the key of the only vehicle that matches; see `paramclient.cache.lookup`."""
        return find_vehicle(
            transaction.vehicles(),
            vehicle,
            place=self.place,
            system=system,
            component=component,
            nicknames={} if vehicle is None else self.nicknames,
        ).key


def _newer(kept: CachedSummary, last: float, at: float) -> str:
    return (
        f"the cached table of {kept.system}/{kept.component} ({kept.key}) was received at {time_text(last)}, "
        f"later than the values of the file ({time_text(at)}); it is replaced only with --force (force=True)"
    )
