"""A parameter file as the cached table of a vehicle: types, indices and hash of its values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

from paramclient.cache.param_columns import StoredParam
from paramclient.cache.records import CachedSummary, TableState, TableUpdate
from paramclient.cache.transaction import Transaction
from paramclient.errors import UsageError
from paramclient.model.identity import Identity, version_difference
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.px4_hash import hash_bits, usual_volatile
from paramclient.model.values import (
    Param,
    Trust,
    bits_of,
    check_name,
    from_bits,
    is_portable_name,
    known_type,
)
from paramclient.model.wording import counted, first_of

__all__ = ["AddedTable", "FileTable"]

ADDED_NAMES_MAX: Final = 10
"""Parameters that a message names, so that it stays readable; it gives the number of further ones."""

_PX4: Final = 12
"""MAV_AUTOPILOT_PX4: the only autopilot with a hash."""


@dataclass(frozen=True, slots=True)
class AddedTable:
    """The result of adding a file to the cache.

    Attributes:
        key: key of the vehicle in the cache.
        system, component: its address.
        size: number of parameters.
        hash: the PX4 hash of the values, by which the vehicle may confirm them at the first contact; None for
            a vehicle without a hash, or a file that lacks parameters.
        complete: whether the file has every parameter that is known of the vehicle or its firmware.
        at: time of the values, in unix seconds.
        notes: remarks for the user, in sentences.
    """

    key: str
    system: int
    component: int
    size: int
    hash: int | None
    complete: bool
    at: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Reference:
    """What cached tables contain about the parameters of a firmware.

    Attributes:
        name: the table that the other attributes are of, in words; "" without one.
        rows: parameters of the vehicle's own table, or of another one of the same firmware.
        complete: whether these are all parameters of that vehicle.
        volatile_known: whether the volatile ones among them are proven.
    """

    name: str = ""
    rows: Mapping[str, StoredParam] = field(default_factory=dict)
    complete: bool = False
    volatile_known: bool = False

    @classmethod
    def find(cls, transaction: Transaction, identity: Identity, component: int) -> _Reference:
        """Return that of the vehicle's own table, or of the largest one of the same firmware."""
        fits = [
            (owner, each)
            for owner, each in transaction.summaries()
            if each.component == component
            and each.source is None
            and each.size
            and (each.key == identity.key or _is_same_firmware(each.identity, identity))
        ]
        if not fits:
            return cls()
        owner, best = max(
            fits, key=lambda pair: (pair[1].complete, pair[1].key == identity.key, pair[1].size)
        )
        words = f"the cached table of {best.system}/{best.component} ({best.key})"
        return cls(words, transaction.table(owner), best.complete, best.volatile_known)

    @property
    def listed(self) -> list[str]:
        """The names with an index; none if some may be unknown."""
        return [name for name, row in self.rows.items() if self.complete and row.param_index is not None]


@dataclass(frozen=True)
class FileTable:
    """The parameters of a file, to be added as the table of a vehicle.

    Attributes:
        identity: the vehicle.
        component: component id.
        params: the parameters. `source` is the mark of the table.
        at: time of the values, in unix seconds.
    """

    identity: Identity
    component: int
    params: ParamSet
    at: float

    def update(self, transaction: Transaction, kept: CachedSummary | None) -> tuple[TableUpdate, AddedTable]:
        """Return the update that replaces the stored table, and its description.

        Args:
            transaction: the transaction.
            kept: the stored table; None if there is none.

        Raises:
            UsageError: types are unknown, a value does not fit its type, or a name is not valid.
        """
        reference = _Reference.find(transaction, self.identity, self.component)
        notes = [*self._notes(reference)]
        typed = self._typed(reference)
        missing = [name for name in reference.listed if name not in typed]
        if missing:
            notes.append(
                f"the file lacks {counted(len(missing), 'parameter')} of {reference.name}: "
                f"{first_of(missing, ADDED_NAMES_MAX)}. The table counts as incomplete"
            )
        elif not reference.complete:
            notes.append(
                "the cache has no complete table of this vehicle or firmware, so it is not known whether the "
                "file has every parameter; the next fetch checks this"
            )
        volatile = self._volatile(typed, reference)
        placed = self._placed(typed, reference) if not missing else typed
        crc = None
        if not missing and self._autopilot(kept) == _PX4:
            crc = hash_bits({name: each.bits for name, each in placed.items()}, leave_out=volatile)
        else:
            notes.append("the next fetch downloads the table and replaces these values")
        state = TableState(
            hash=crc,
            count=None if missing else len(placed),
            complete=not missing,
            volatile_known=crc is not None,  # an equal hash of the vehicle proves the volatile names too
            file_works=None if kept is None else kept.file_works,
            source=self.params.source or "a file",
        )
        update = TableUpdate(
            identity=self.identity,
            component=self.component,
            autopilot=self._autopilot(kept),
            at=self.at,
            table=state,
            params=[
                StoredParam(each, self.at, name in volatile, f"file {state.source}")
                for name, each in placed.items()
            ],
            replace=True,
        )
        added = AddedTable(
            self.identity.key,
            self.identity.system,
            self.component,
            size=len(placed),
            hash=crc,
            complete=not missing,
            at=self.at,
            notes=tuple(notes),
        )
        return update, added

    def _autopilot(self, kept: CachedSummary | None) -> int:
        return self.identity.autopilot if kept is None else kept.autopilot

    def _notes(self, reference: _Reference) -> Iterator[str]:
        file = self.params.identity
        if file is None:
            return
        if file.uid is not None and file.uid != self.identity.uid:
            yield f"the file is of another vehicle: {file.key}"
        if difference := version_difference(file, self.identity):
            yield difference

    def _typed(self, reference: _Reference) -> dict[str, Param]:
        """Return the parameters with their types, without indices.

        Raises:
            UsageError: as `update`.
        """
        unknown = [
            name
            for name, each in self.params.items()
            if each.type_number is None and name not in reference.rows
        ]
        if unknown:
            where = (
                f"{reference.name} lacks them" if reference.rows else "no cached table of its firmware does"
            )
            raise UsageError(
                f"{self.params.source or 'the file'} has no types of its parameters, and {where}: "
                f"{first_of(unknown, ADDED_NAMES_MAX)}. Fetch the vehicle, or another one with its firmware, "
                "once; or use a file with types (.params, .pck, .json)"
            )
        return {name: self._param(each, reference) for name, each in self.params.items()}

    def _param(self, written: WrittenParam, reference: _Reference) -> Param:
        name = check_name(written.name)
        if not is_portable_name(name):
            raise UsageError(f"parameter name {name!r}: no parameter file can hold it")
        kind = known_type(reference.rows[name].type) if written.type_number is None else written.type_number
        bits = written.bits_as(kind)  # its error names value and type
        default = None
        if written.default is not None:
            with suppress(UsageError):
                default = from_bits(bits_of(written.default, kind), kind)
        value = from_bits(bits, kind, is_raw=written.is_raw)
        return Param(name, value, kind, None, bits, Trust.CACHED, default)

    def _placed(self, typed: Mapping[str, Param], reference: _Reference) -> dict[str, Param]:
        """Return the parameters with the indices of the reference, else of PX4's order, which is sorted."""
        if set(reference.listed) == set(typed):
            indices = {name: reference.rows[name].param_index for name in typed}
        else:
            names: Sequence[str] = sorted(typed) if self.identity.autopilot == _PX4 else list(typed)
            indices = {name: index for index, name in enumerate(names)}
        return {name: replace(each, index=indices[name]) for name, each in typed.items()}

    def _volatile(self, typed: Mapping[str, Param], reference: _Reference) -> frozenset[str]:
        if reference.volatile_known:
            return frozenset(
                name for name in typed if name in reference.rows and reference.rows[name].volatile
            )
        return usual_volatile(typed) if self.identity.autopilot == _PX4 else frozenset()


def _is_same_firmware(one: Identity, other: Identity) -> bool:
    own, others = ((each.autopilot, each.vehicle_type, each.firmware, each.git_hash) for each in (one, other))
    return own == others and bool(one.firmware or one.git_hash)
