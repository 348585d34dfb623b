"""The cache as users and the client see it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

import platformdirs

from paramclient.cache import tables
from paramclient.cache.database import Database
from paramclient.cache.merge import merge
from paramclient.cache.records import (
    CachedComponent,
    CachedSummary,
    CachedVehicle,
    HistoryEntry,
    TableUpdate,
)
from paramclient.errors import CacheError

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
        self, vehicle: str, component: int | None = None, name: str | None = None, limit: int | None = None
    ) -> list[HistoryEntry]:
        """The changes of a vehicle's values, newest last. Of each table the newest `HISTORY_LINES` are kept.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            component: of this component only.
            name: of this parameter only.
            limit: the newest so many.

        Raises:
            CacheError: there is no such vehicle, or more than one.
        """

        return self._database.read(
            lambda connection: tables.history(
                connection, self._choose(connection, vehicle), component, name, limit
            )
        )

    def remove(self, vehicle: str, component: int | None = None) -> int:
        """Forget a vehicle's tables and their history; give the number of tables.

        Args:
            vehicle: its key, or the beginning of its hardware id.
            component: this component's only.

        Raises:
            CacheError: there is no such vehicle, or more than one.
        """
        key = self._database.read(lambda connection: self._choose(connection, vehicle))
        return self._database.write(lambda connection: tables.remove(connection, key, component))

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
