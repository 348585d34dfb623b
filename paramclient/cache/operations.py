"""Write operations of a cache: records that a store executes in one transaction, now or later."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from paramclient.cache import snapshots
from paramclient.cache.ext_records import ExtSnapshot, ExtTableUpdate
from paramclient.cache.ext_snapshots import ext_snapshot, store_ext_snapshot
from paramclient.cache.ext_tables import load_ext, save_ext
from paramclient.cache.merge import merge
from paramclient.cache.reconciliation import reconcile
from paramclient.cache.records import Snapshot, TableUpdate
from paramclient.cache.transaction import Transaction
from paramclient.errors import NotInCache
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import is_portable_name

__all__ = ["Merge", "StoreOperation", "Remove", "Save", "SaveExt", "StoreExtSnapshot", "StoreSnapshot"]

T_co = TypeVar("T_co", covariant=True)


class StoreOperation(ABC, Generic[T_co]):
    """A write to a cache, executed completely or not at all.

    Attributes:
        is_durable: whether it ends only when it is synced to the disk, safe from power loss.
    """

    is_durable: bool = False

    @property
    @abstractmethod
    def tables(self) -> Iterable[tuple[str, int | None]]:
        """Key and component of the tables that it may change; None as component: all of the vehicle."""

    @abstractmethod
    def do(self, transaction: Transaction) -> T_co:
        """Execute the operation in a transaction, and return its result."""

    def done(self, transaction: Transaction) -> T_co | None:
        """Return the result of an earlier `do` that was committed but whose result was lost."""
        return None


@dataclass(frozen=True)
class Save(StoreOperation[None]):
    """Write updates of tables, see `ParamCache.save`.

    Attributes:
        updates: the updates, in order of execution.
        clock: returns the current time by the clock of the updates; None uses `at` of each update, which also
            counts for a delayed execution.
        is_durable: as in `StoreOperation`; without updates it applies to all earlier writes.
    """

    updates: Sequence[TableUpdate]
    clock: Callable[[], float] | None = field(default=None, compare=False)
    is_durable: bool = field(default=False, compare=False)

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return {(each.identity.key, each.component) for each in self.updates}

    def do(self, transaction: Transaction) -> None:
        reconcile(transaction, self.updates, None if self.clock is None else self.clock())


@dataclass(frozen=True)
class SaveExt(StoreOperation[None]):
    """Write updates of extended parameters, see `ParamCache.save_ext`.

    Attributes:
        updates, clock: as in `Save`.
    """

    updates: Sequence[ExtTableUpdate]
    clock: Callable[[], float] | None = field(default=None, compare=False)

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return {(each.identity.key, each.component) for each in self.updates}

    def do(self, transaction: Transaction) -> None:
        save_ext(transaction, self.updates, None if self.clock is None else self.clock())


@dataclass(frozen=True)
class Merge(StoreOperation[None]):
    """Merge earlier updates, see `ParamCache.merge`.

    Attributes:
        updates: the updates, in order of their times.
        based_on: as in `ParamCache.merge`.
    """

    updates: Sequence[TableUpdate]
    based_on: Mapping[tuple[str, int], float] = field(default_factory=dict)

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return {(each.identity.key, each.component) for each in self.updates}

    def do(self, transaction: Transaction) -> None:
        merge(transaction, self.updates, self.based_on)


@dataclass(frozen=True)
class StoreSnapshot(StoreOperation[Snapshot]):
    """Store a snapshot, see `ParamCache.store_snapshot`.

    Attributes:
        vehicle: identity of the vehicle, or the key of a cached one.
        component: component id.
        params: the parameters; None for the stored table and its hash.
        at: time of the snapshot, in unix seconds.
        reason: the reason, as text.
        hash: the vehicle's hash of these parameters, or None.
        complete: whether these are all parameters of the vehicle.
        number: number that another store has assigned, or None.
    """

    vehicle: Identity | str
    component: int
    params: ParamSet | None
    at: float
    reason: str
    hash: int | None = None
    complete: bool = True
    number: int | None = None

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return [(self.vehicle if isinstance(self.vehicle, str) else self.vehicle.key, self.component)]

    def do(self, transaction: Transaction) -> Snapshot:
        owner, identity = _owner_of_snapshot(transaction, self.vehicle, self.component, self.at)
        shown = self.resolved(transaction)
        assert shown.params is not None
        return snapshots.store(
            transaction,
            owner,
            replace(shown.params, identity=identity),
            at=self.at,
            reason=self.reason,
            hash=shown.hash,
            complete=shown.complete,
            number=self.number,
        )

    def done(self, transaction: Transaction) -> Snapshot:
        """Return the stored snapshot of this time."""
        [(key, _)] = self.tables
        owner = transaction.owner_of(key, self.component)
        number = None if owner is None else transaction.snapshot_at(owner, snapshots.kept_time(self.at))
        if owner is None or number is None:
            raise NotInCache(f"the table of {key}, component {self.component}, has just been removed")
        return snapshots.snapshot(transaction, owner, number)

    def resolved(self, transaction: Transaction) -> StoreSnapshot:
        """Return this operation with the parameters of the stored table, if it has none of its own."""
        if self.params is not None:
            return self
        [(key, _)] = self.tables
        found = transaction.summaries(key, self.component)
        if not found:
            raise NotInCache(f"the table of {key}, component {self.component}, has just been removed")
        [(owner, kept)] = found
        return replace(self, params=_kept(transaction, owner), hash=kept.hash, complete=kept.complete)


@dataclass(frozen=True)
class StoreExtSnapshot(StoreOperation[ExtSnapshot]):
    """Store a snapshot of extended parameters, see `ParamCache.store_ext_snapshot`.

    Attributes:
        vehicle, component, at, reason, complete, number: as in `StoreSnapshot`.
        params: the parameters; None for the stored table.
    """

    vehicle: Identity | str
    component: int
    params: ExtParamSet | None
    at: float
    reason: str
    complete: bool = True
    number: int | None = None

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return [(self.vehicle if isinstance(self.vehicle, str) else self.vehicle.key, self.component)]

    def do(self, transaction: Transaction) -> ExtSnapshot:
        owner, identity = _owner_of_snapshot(transaction, self.vehicle, self.component, self.at)
        shown = self.resolved(transaction)
        assert shown.params is not None
        return store_ext_snapshot(
            transaction,
            owner,
            replace(shown.params, identity=identity),
            at=self.at,
            reason=self.reason,
            complete=shown.complete,
            number=self.number,
        )

    def done(self, transaction: Transaction) -> ExtSnapshot:
        """Return the stored snapshot of this time."""
        [(key, _)] = self.tables
        owner, at = transaction.owner_of(key, self.component), snapshots.kept_time(self.at)
        number = None if owner is None else transaction.snapshot_at(owner, at, is_extended=True)
        if owner is None or number is None:
            raise NotInCache(f"the table of {key}, component {self.component}, has just been removed")
        return ext_snapshot(transaction, owner, number)

    def resolved(self, transaction: Transaction) -> StoreExtSnapshot:
        """Return this operation with the parameters of the stored table, if it has none of its own."""
        if self.params is not None:
            return self
        [(key, _)] = self.tables
        found = load_ext(transaction, key, self.component)
        if found is None:
            raise NotInCache(f"{key}, component {self.component}, has no extended parameters in the cache")
        return replace(self, params=ExtParamSet(found.params), complete=found.complete)


@dataclass(frozen=True)
class Remove(StoreOperation[int]):
    """Remove tables, see `ParamCache.remove`.

    Attributes:
        key: key of the vehicle.
        component: component id, or None for all of its tables.
        known: number of tables at the time of the call.
    """

    key: str
    component: int | None
    known: int = 0

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return [(self.key, self.component)]

    def do(self, transaction: Transaction) -> int:
        return transaction.remove(self.key, self.component)

    def done(self, transaction: Transaction) -> int:
        """Return the number of tables at the time of the call."""
        return self.known


def _owner_of_snapshot(
    transaction: Transaction, vehicle: Identity | str, component: int, at: float
) -> tuple[int, Identity]:
    """Return the id of the table of a snapshot, which may be new, and the identity of the vehicle.

    Raises:
        NotInCache: the vehicle is named by its key, and the table is gone.
    """
    key = vehicle if isinstance(vehicle, str) else vehicle.key
    owner = transaction.owner_of(key, component)
    if owner is None:
        if isinstance(vehicle, str):
            raise NotInCache(f"the table of {key}, component {component}, has just been removed")
        autopilot = vehicle.autopilot if component == 1 else 0
        new = TableUpdate(identity=vehicle, component=component, autopilot=autopilot, at=at)
        owner = transaction.upsert_table(new)
    [(_, kept)] = transaction.summaries(key, component)
    return owner, kept.identity if isinstance(vehicle, str) else vehicle


def _kept(transaction: Transaction, owner: int) -> ParamSet:
    rows = transaction.table(owner).values()
    return ParamSet.of(row.param for row in rows if is_portable_name(row.name))
