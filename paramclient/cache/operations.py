"""What can be written to a cache: each a record, done in one transaction, wherever and whenever."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from paramclient.cache import snapshots
from paramclient.cache.merge import merge
from paramclient.cache.reconciliation import settle
from paramclient.cache.records import Snapshot, TableUpdate
from paramclient.cache.rows import read_param
from paramclient.cache.transaction import Session
from paramclient.errors import NotInCache
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import is_portable_name

__all__ = ["Merge", "Operation", "Remove", "Save", "SetDown"]

T_co = TypeVar("T_co", covariant=True)


class Operation(ABC, Generic[T_co]):
    """One change of a cache. It happens as a whole, or not at all.

    Attributes:
        is_durable: whether it is done only when it is on the disk, past a loss of power.
    """

    is_durable: bool = False

    @property
    @abstractmethod
    def tables(self) -> Iterable[tuple[str, int | None]]:
        """The tables that it may change, by key and component; None for all of the vehicle's."""

    @abstractmethod
    def do(self, session: Session) -> T_co:
        """Do it within a transaction."""

    def done(self, session: Session) -> T_co | None:
        """What `do` gave, where it is known only that it was done; None where that says nothing."""
        return None


@dataclass(frozen=True)
class Save(Operation[None]):
    """Write what was learnt, see `ParamCache.save`.

    Attributes:
        updates: in the order given.
        clock: gives the present by the clock that their times were read from; None for `at` of each, which is
            what counts after a wait, too.
        is_durable: as in `Operation`; without updates it is about all that was saved before.
    """

    updates: Sequence[TableUpdate]
    clock: Callable[[], float] | None = field(default=None, compare=False)
    is_durable: bool = field(default=False, compare=False)

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return {(each.identity.key, each.component) for each in self.updates}

    def do(self, session: Session) -> None:
        settle(session, self.updates, None if self.clock is None else self.clock())


@dataclass(frozen=True)
class Merge(Operation[None]):
    """Write what was observed in the past, see `ParamCache.merge`."""

    updates: Sequence[TableUpdate]
    based_on: Mapping[tuple[str, int], float] = field(default_factory=dict)

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return {(each.identity.key, each.component) for each in self.updates}

    def do(self, session: Session) -> None:
        merge(session, self.updates, self.based_on)


@dataclass(frozen=True)
class SetDown(Operation[Snapshot]):
    """Make a snapshot, see `ParamCache.store_snapshot`.

    Attributes:
        vehicle: who it is, or the key of one that is known.
        params: what to set down; None for the table as it is kept, with its hash.
        number: the one that it was given elsewhere, or None.
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

    def do(self, session: Session) -> Snapshot:
        [(key, _)] = self.tables
        owner = session.owner_of(key, self.component)
        if owner is None:
            if isinstance(self.vehicle, str):
                raise NotInCache(f"the table of {key}, component {self.component}, has just been removed")
            autopilot = self.vehicle.autopilot if self.component == 1 else 0
            new = TableUpdate(
                identity=self.vehicle, component=self.component, autopilot=autopilot, at=self.at
            )
            owner = session.make(new)
        [(_, kept)] = session.summaries(key, self.component)
        identity = kept.identity if isinstance(self.vehicle, str) else self.vehicle
        shown = self.resolved(session)
        assert shown.params is not None
        return snapshots.store(
            session,
            owner,
            replace(shown.params, identity=identity),
            at=self.at,
            reason=self.reason,
            hash=shown.hash,
            complete=shown.complete,
            number=self.number,
        )

    def done(self, session: Session) -> Snapshot:
        """The snapshot of this time."""
        [(key, _)] = self.tables
        owner = session.owner_of(key, self.component)
        number = None if owner is None else session.snapshot_at(owner, snapshots.kept_time(self.at))
        if owner is None or number is None:
            raise NotInCache(f"the table of {key}, component {self.component}, has just been removed")
        return snapshots.snapshot(session, owner, number)

    def resolved(self, session: Session) -> SetDown:
        """The same with the parameters that the table has now, where it has none of its own."""
        if self.params is not None:
            return self
        [(key, _)] = self.tables
        found = session.summaries(key, self.component)
        if not found:
            raise NotInCache(f"the table of {key}, component {self.component}, has just been removed")
        [(owner, kept)] = found
        return replace(self, params=_kept(session, owner), hash=kept.hash, complete=kept.complete)


@dataclass(frozen=True)
class Remove(Operation[int]):
    """Forget tables, see `ParamCache.remove`.

    Attributes:
        known: how many there were when that was asked for.
    """

    key: str
    component: int | None
    known: int = 0

    @property
    def tables(self) -> Iterable[tuple[str, int | None]]:
        return [(self.key, self.component)]

    def do(self, session: Session) -> int:
        return session.remove(self.key, self.component)

    def done(self, session: Session) -> int:
        """How many there were."""
        return self.known


def _kept(session: Session, owner: int) -> ParamSet:
    rows = session.table(owner)
    return ParamSet.of(
        read_param(name, *row.value, row.param_index, row.default_bits)
        for name, row in rows.items()
        if is_portable_name(name)
    )
