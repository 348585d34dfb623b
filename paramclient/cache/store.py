"""The cache as users and the client see it."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import platformdirs

from paramclient.cache import earlier, fleet, tables
from paramclient.cache.database import Database
from paramclient.cache.fleet import FleetDiff
from paramclient.cache.merge import merge
from paramclient.cache.records import (
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    Snapshot,
    SnapshotSummary,
    TableUpdate,
)
from paramclient.cache.rows import read_param
from paramclient.errors import CacheError
from paramclient.identity import Identity
from paramclient.paramset import ParamSet

__all__ = ["ParamCache", "default_path"]


def default_path() -> Path:
    """Where the cache is kept unless told otherwise: `parameters.sqlite3` in the user's cache folder."""
    return platformdirs.user_cache_path("paramclient") / "parameters.sqlite3"


class ParamCache:
    """Tables, identities and history on disk. Usable with no link, by several threads and processes at once.

    The file is opened by the first call that needs it. Reading creates nothing. Every call blocks, as a rule
    for milliseconds, and for a few seconds at most where another process holds the file. What a call has
    written survives the death of the process at any moment; a power cut may take the last calls, never the
    file. A file that is damaged, or newer than this version, is set aside with a warning in the log, and a
    fresh one begins.

    Args:
        path: the file; None for `default_path()`.

    Attributes:
        path: the file, absolute.

    Raises:
        CacheError: from every method that reads or writes: the file cannot be used (read-only, disk full,
            held for too long by another process), or the cache is closed. Nothing was written then.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None) -> None:
        self.path = Path(default_path() if path is None else path).resolve()
        self._database = Database(self.path)

    def __enter__(self) -> ParamCache:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ParamCache {self.path}>"

    def close(self) -> None:
        """Close the file; later calls raise CacheError. A cache that is thrown away closes by itself."""
        self._database.close()

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong with the file so far and was mended: one text for each file set aside."""
        return tuple(self._database.notes)

    @property
    def replacements(self) -> int:
        """How often a fresh file was made, or another one found in its place: what was saved is not in it."""
        return self._database.replacements

    def save(self, update: TableUpdate | Sequence[TableUpdate]) -> None:
        """Write what was learnt, in one transaction: all of it is kept, or nothing.

        A parameter that appears for the first time leaves no line of history, one that goes leaves a line
        with its last value. −0 and 0 are no change of a value.

        Raises:
            UsageError: a time that is not in unix seconds.
        """
        updates = (update,) if isinstance(update, TableUpdate) else tuple(update)
        if updates:
            self._database.write(lambda connection: tables.save(connection, updates))

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
            self._database.write(lambda connection: merge(connection, updates, based_on or {}))

    def load(self, key: str, component: int) -> CachedComponent | None:
        """The table of a vehicle's component, or None.

        Args:
            key: `Identity.key`.
            component: component id.
        """
        return self._database.read(lambda connection: self._load(connection, key, component))

    def vehicles(self) -> list[CachedVehicle]:
        """Every vehicle, the one seen last first."""
        return self._database.read(tables.vehicles)

    def components(self, vehicle: str | None = None) -> list[CachedSummary]:
        """Every table, without its parameters, ordered as `vehicles()`, then by component id.

        Args:
            vehicle: of this one only: its key, or the beginning of its hardware id.

        Raises:
            CacheError: there is no such vehicle, or more than one.
        """

        def work(connection: sqlite3.Connection) -> list[CachedSummary]:
            key = None if vehicle is None else self._choose(connection, vehicle)
            return [summary for _, summary in tables.summaries(connection, key)]

        return self._database.read(work)

    def component(
        self, vehicle: str | None = None, *, system: int | None = None, component: int = 1
    ) -> CachedComponent:
        """The one table that fits.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            system: its system id.
            component: component id; the autopilot's is 1.

        Raises:
            CacheError: none fits, or more than one; the text says what there is.
        """

        def work(connection: sqlite3.Connection) -> CachedComponent:
            key = self._choose(connection, vehicle, system=system, component=component)
            found = self._load(connection, key, component)
            assert found is not None, "what was chosen exists for the whole transaction"
            return found

        return self._database.read(work)

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
            vehicle: its key, or the beginning of its hardware id.
            component: of this component only.
            name: of this parameter only.
            limit: the newest so many.
            since: those from this time on only, in unix seconds.

        Raises:
            CacheError: there is no such vehicle, or more than one.
        """

        return self._database.read(
            lambda connection: tables.history(
                connection, self._choose(connection, vehicle), component, name, limit, since
            )
        )

    def snapshot(self, vehicle: str, component: int, *, reason: str, at: float | None = None) -> Snapshot:
        """Set a table down as it is kept now, so that it can be had again however it changes.

        Of each table the newest `SNAPSHOTS` are kept.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            component: component id.
            reason: what for, in words.
            at: unix seconds; None for now.

        Raises:
            CacheError: there is no such table, or more than one.
        """

        def work(connection: sqlite3.Connection) -> Snapshot:
            key, owner = self._table(connection, vehicle, component)
            [(_, state)] = tables.summaries(connection, key, component)
            params = ParamSet.of(
                (
                    read_param(name, *row.value, row.param_index, row.default_bits)
                    for name, row in tables.stored_rows(connection, owner).items()
                ),
                identity=state.identity,
            )
            return earlier.store(
                connection, owner, params, at=moment, reason=reason, hash=state.hash, complete=state.complete
            )

        moment = time.time() if at is None else at
        self._database.read(lambda connection: self._table(connection, vehicle, component))
        return self._database.write(work)

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
            vehicle: who it is; one that the cache does not know yet is written down. Or the key of one that
                it knows, or the beginning of its hardware id.
            component: component id.
            params: names, values, types and defaults are kept, comments and lines are not.
            reason: what for, in words.
            at: unix seconds; None for now.
            hash: the hash under which the vehicle would confirm these parameters, where it is known.
            complete: these are all the parameters that the vehicle has.

        Raises:
            CacheError: a key was given, and there is no such table, or more than one.
        """
        moment = time.time() if at is None else at

        def work(connection: sqlite3.Connection) -> Snapshot:
            if isinstance(vehicle, Identity):
                identity, autopilot = vehicle, vehicle.autopilot if component == 1 else 0
                owner = tables.owner_of(connection, vehicle.key, component)
                if owner is None:
                    owner = tables.make(
                        connection,
                        TableUpdate(identity=vehicle, component=component, autopilot=autopilot, at=moment),
                    )
            else:
                key, owner = self._table(connection, vehicle, component)
                [(_, state)] = tables.summaries(connection, key, component)
                identity = state.identity
            whole = replace(params, identity=identity)
            return earlier.store(
                connection, owner, whole, at=moment, reason=reason, hash=hash, complete=complete
            )

        if isinstance(vehicle, str):
            self._database.read(lambda connection: self._table(connection, vehicle, component))
        return self._database.write(work)

    def snapshots(self, vehicle: str, component: int | None = None) -> list[SnapshotSummary]:
        """The snapshots of a vehicle's tables, newest last.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            component: of this component only.

        Raises:
            CacheError: there is no such vehicle, or more than one.
        """
        return self._database.read(
            lambda connection: earlier.snapshots(connection, self._choose(connection, vehicle), component)
        )

    def state_at(self, vehicle: str, component: int, when: float) -> ParamSet:
        """A table as it was at a moment.

        Exact where a snapshot was made then. Else it is worked backwards from the present table over the
        lines of history, and is what was last known at that moment: a change counts from when it was heard.
        It reaches back to the moment when the table was first complete, or to the oldest line of history
        that was dropped (`HISTORY_LINES`) if that is later. Names heard for the first time after `when` are
        not in it. Defaults and the firmware of the vehicle are only known of snapshots.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            component: component id.
            when: a float is a time, in unix seconds; an int is the id of a snapshot.

        Raises:
            UsageError: a time that is not in unix seconds.
            CacheError: there is no such table, or more than one; there is no such snapshot of it, or it is
                damaged; history does not reach back so far (the text says how far, and which snapshots are
                next to it), or the clock of this computer went through that moment twice.
        """

        def work(connection: sqlite3.Connection) -> ParamSet:
            key, owner = self._table(connection, vehicle, component)
            if isinstance(when, int):
                return earlier.snapshot(connection, owner, when).params
            [(_, state)] = tables.summaries(connection, key, component)
            rows = tables.stored_rows(connection, owner)
            return earlier.state_at(connection, owner, state.identity, rows, when)

        return self._database.read(work)

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

        def work(connection: sqlite3.Connection) -> FleetDiff:
            chosen = {name: fleet.names_like(connection, number, name) for name in names}
            plain: dict[str, None] = dict.fromkeys(each for like in chosen.values() for each in like)
            found = fleet.fleet_diff(connection, number, plain if written is None else written)
            if not found.vehicles:
                raise CacheError(f"the cache {self.path} holds no table of component {number}")
            held = {each.name for each in found.names if each.values}
            for name, like in chosen.items():
                if held.isdisjoint(like):
                    raise CacheError(f"no vehicle in the cache {self.path} has a parameter {name}")
            return found

        return self._database.read(work)

    def remove(self, vehicle: str, component: int | None = None) -> int:
        """Forget a vehicle's tables with their history and snapshots; give the number of tables.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            component: this component's only.

        Raises:
            CacheError: there is no such vehicle, or more than one.
        """
        key = self._database.read(lambda connection: self._choose(connection, vehicle))
        return self._database.write(lambda connection: tables.remove(connection, key, component))

    def _table(self, connection: sqlite3.Connection, vehicle: str, component: int) -> tuple[str, int]:
        """The key of the vehicle that is meant, and the id of its table."""
        key = self._choose(connection, vehicle, component=component)
        owner = tables.owner_of(connection, key, component)
        assert owner is not None, "what was chosen exists for the whole transaction"
        return key, owner

    def _load(self, connection: sqlite3.Connection, key: str, component: int) -> CachedComponent | None:
        def history(name: str | None, limit: int | None) -> list[HistoryEntry]:
            return self._database.read(
                lambda connection: tables.history(connection, key, component, name, limit)
            )

        return tables.component(connection, key, component, history=history)

    def _choose(
        self,
        connection: sqlite3.Connection,
        vehicle: str | None,
        *,
        system: int | None = None,
        component: int | None = None,
    ) -> str:
        """The key of the one vehicle that fits; an exact key is preferred to the beginning of another id."""
        kept = tables.vehicles(connection)
        fits = [
            known
            for known in kept
            if (system is None or known.identity.system == system)
            and (component is None or component in known.components)
        ]
        if vehicle is not None:
            start = vehicle.removeprefix("uid:").lower()
            fits = [known for known in fits if known.key == vehicle] or [
                known for known in fits if known.identity.uid and known.identity.uid.startswith(start)
            ]
        if len(fits) == 1:
            return fits[0].key
        wanted = {"vehicle": vehicle, "system": system, "component": component}
        named = ", ".join(f"{what} {value}" for what, value in wanted.items() if value is not None)
        if fits:
            raise CacheError(f"{named} fits more than one vehicle in the cache: {'; '.join(map(str, fits))}")
        raise CacheError(
            f"{named} is not in the cache {self.path}, which holds {'; '.join(map(str, kept)) or 'nothing'}"
        )
