"""The parameter table of one component: values by name, how far each is trusted, and the hash that covers
them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from struct import unpack
from typing import Final, NamedTuple

from paramclient.model.params import (
    CACHED,
    COMPACT_NO_INDEX,
    LIVE,
    VERIFIED,
    CompactParam,
    Params,
    as_params,
    has_index,
    is_listed,
    number_of,
    pack_fields,
    param_of,
    same_compact,
    trust_of,
    unpack_fields,
    with_index,
    with_trust_number,
)
from paramclient.model.px4_hash import hash_bits
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    WireValue,
    as_reported,
    bits_of_wire,
    from_bits,
    is_portable_name,
    known_type,
)
from paramclient.protocol.ftp.param_pck import Pack
from paramclient.protocol.params.change import Added, Change, Changed, FirstValue, Removed
from paramclient.protocol.params.change_origin import is_ours
from paramclient.protocol.wire import NO_INDEX, PARAMETERS_MAX, ParamValue

__all__ = ["NAMES_MAX", "Observation", "NameQuota", "Table"]

NAMES_MAX: Final = 65_535
"""Names in one table: as many as there are indices, and as many again without an index (parameters not in
use). No real component has more."""

NAMES_GUARANTEED: Final = 2_000
"""Names that every table may hold, however full the other tables of the link are: more than autopilots
have."""
LINK_NAMES_MAX: Final = 400_000
"""Names in all tables of one link, above which each table is limited to `NAMES_GUARANTEED`: 250 vehicles with
1,600 parameters each. A name takes about 0.25 kB."""
OVERWRITTEN_MAX: Final = 1_024
"""Replaced values that wait for the cache: some tens fit between two writes to the disk."""
REMOVED_NAMES_MAX: Final = NAMES_MAX
"""Changed and removed names that wait for the cache. Above it, further removals are not reported: the next
complete table in the cache is without these names."""

_EXACT = 1 << 24  # every integer up to here is a float32
_new = tuple.__new__  # the constructor of a tuple ends in this call and takes several times as long


class NameQuota:
    """The number of names in the tables of one link.

    Attributes:
        taken: names in all tables of the link.
    """

    __slots__ = ("taken",)

    def __init__(self) -> None:
        self.taken = 0

    def has_capacity(self, count: int) -> bool:
        """Return whether a table with this many names may add one."""
        return count < NAMES_MAX and (count < NAMES_GUARANTEED or self.taken < LINK_NAMES_MAX)


class Observation(NamedTuple):
    """One observed value of a parameter.

    Attributes:
        param: the parameter with that value.
        by: the author of the change to that value, as in `Change`.
        moment: when the value arrived from the link, in seconds of the core's clock.
    """

    param: Param
    by: str
    moment: float


class Table:
    """The parameters of one component.

    Each value carries the moment at which it arrived from the link (`Params.moments`), in seconds of the
    core's clock, whenever it is processed or written to the cache.

    Args:
        encoding: how the component encodes values, as far as known.
        name_quota: the name count shared by all tables of the link; None for a table on its own.

    Attributes:
        params: by name, in the order of first reception. Shared with readers; never replaced.
        count: the latest param_count, or None. Indices are valid for this count only: a changed count
            invalidates all of them.
        volatile: names that the vehicle excludes from its hash, as far as known.
        volatile_known: whether a recomputed hash has proven `volatile`.
        complete: whether the table has a parameter for every index below `count`.
        hash: the PX4 hash by which the vehicle would confirm exactly this table, or None while unknown.
        outdated_indices: names whose index belongs to an earlier count. The vehicle may no longer have them;
            some may have been received again since.
        doubts: how often live values were marked as stale.
        dirty: names whose value, type or index changed since the last `take_dirty`.
        removed_at: when each removed name was found missing, since the last `take_removed_at`.
        suspended: seconds of system suspend by which moments were moved back, see `age`.
        left_out: PARAM_VALUEs ignored because no parameter file can hold their name, see `leave_out`.
        left_out_name: the last such name, or an empty text.
        overwritten: values that never reached the cache and are no longer current: values that our writes set
            or replaced, and the first observation of a changed value that was received again.
    """

    def __init__(self, encoding: Encoding = Encoding.BYTEWISE, name_quota: NameQuota | None = None) -> None:
        self._name_quota = NameQuota() if name_quota is None else name_quota
        self.params = Params()
        self._compact = self.params.compact
        self._defaults = self.params.defaults
        self._moments = self.params.moments
        self._latest = -math.inf  # the moment of the newest observation
        self._changed: dict[str, tuple[float, str]] = {}  # when it changed, author: not yet in the cache
        self.removed_at: dict[str, float] = {}
        self.suspended = 0.0
        self.count: int | None = None
        self.volatile: frozenset[str] = frozenset()
        self.volatile_known = False
        self.complete = False
        self._was_complete = False  # before the count changed
        self.outdated_indices: set[str] = set()
        self.doubts = 0
        self.dirty: dict[str, str] = {}
        self.overwritten: list[Observation] = []
        self.left_out = 0
        self.left_out_name = ""
        self._hash: int | None = None
        self._hash_is_stale = False
        self._encoding = encoding
        self._wire: dict[str, bytes] = {}  # the 4 bytes as received, to decode them again in another encoding
        self._filed: set[str] = set()  # values received in a file, which does not depend on the encoding

    @property
    def encoding(self) -> Encoding:
        return self._encoding

    @property
    def hash(self) -> int | None:
        if self._hash_is_stale:
            self._hash_is_stale = False
            self._hash = hash_bits(self.listed_bits(), leave_out=self.volatile)
        return self._hash

    @property
    def live_count(self) -> int | None:
        """The count that the component has sent on this link; None if it is only that of the cache."""
        return self.count if self._latest > -math.inf else None

    def confirm(self, announced: int, volatile: frozenset[str], *, proven: bool) -> None:
        """Record that the vehicle announced this hash for exactly this table.

        With `proven`, the hash computed here without the volatile names was the same. The hash can then be
        recomputed whenever a value changes, and the vehicle can confirm the table in the next session as
        well. Names that become volatile, or are no longer volatile, are dirty for the cache.
        """
        for name in volatile ^ self.volatile:
            if name in self.params:
                self.dirty.setdefault(name, "vehicle")
        self._hash = announced
        self._hash_is_stale = False
        self.volatile = volatile
        self.volatile_known = proven

    def leave_out(self, name: str) -> None:
        """Count a PARAM_VALUE that is ignored because no parameter file can hold its name."""
        self.left_out += 1
        self.left_out_name = name

    def unconfirm(self) -> None:
        """Forget the hash: none is known to belong to this table any more."""
        self._hash = None
        self._hash_is_stale = False

    def rehash(self) -> None:
        """Mark the hash as stale, so that the next access recomputes it."""
        self._hash_is_stale = self._hash is not None

    def store_value(
        self, message: ParamValue, by: str, moment: float = 0.0, *, is_exact: bool = False
    ) -> Change | None:
        """Store one PARAM_VALUE and return the change, if there is one (a first value is one).

        The value counts whatever its index is. Index 65535 keeps the known index; an index that is not below
        the count is ignored.

        Args:
            message: the PARAM_VALUE.
            by: the author of the change, as in `Change`.
            moment: when it arrived from the link, not before the previous one.
            is_exact: whether it repeats the value that was just written, so that it cannot be a rounded form
                of a known integer.
        """
        name, raw, number, count, given = message
        everything = self._compact
        old = everything.get(name)
        self._latest = moment
        if old is None:  # fast path for a first value
            quota = self._name_quota
            if not quota.has_capacity(len(everything)):
                return None
            quota.taken += 1
            place = COMPACT_NO_INDEX if given >= count or count > PARAMETERS_MAX else given
            bits, is_raw = bits_of_wire(raw, number, self._encoding)
            new = everything[name] = pack_fields(bits, number, is_raw, LIVE, place)
            self._wire[name] = raw
            self._moments[name] = moment
            self.dirty[name] = by
            if self._hash is not None:
                self._invalidate_hash(name)
            return _new(self._kind_of_first, (name, None, new, by, None, None))
        return self._update(name, old, message, by, moment, is_exact=is_exact)

    def with_known_type(self, message: ParamValue) -> ParamValue:
        """Return a PARAM_VALUE of the type REAL32 with the integer type that is known of the parameter.

        ArduPilot answers a PARAM_SET with REAL32, whatever the parameter's type is, if the value is the
        default and was never stored (measured on 4.6-dev). A cached, unconfirmed type does not count. Without
        a known type, or if the number is not whole or out of its range, the message is returned unchanged.
        """
        name = message.param_id
        compact = self._compact.get(name)
        if compact is None:
            return message
        _, number, _, trust, _ = unpack_fields(compact)
        if trust == CACHED and name not in self._wire:
            return message
        known = known_type(number)
        (value,) = unpack("<f", message.raw)
        if not isinstance(known, ParamType) or not known.is_integer or not value.is_integer():
            return message
        low, high = known.bounds
        return message._replace(param_type=known) if low <= value <= high else message

    def hear_index(self, message: ParamValue) -> None:
        """Store the index of a PARAM_VALUE of a known parameter, without its value."""
        name, _, _, count, given = message
        compact = self._compact[name]
        if given < count <= PARAMETERS_MAX and not has_index(compact, given):
            self._compact[name] = with_index(compact, given)
            self.dirty.setdefault(name, "vehicle")

    def _update(
        self, name: str, old: CompactParam, message: ParamValue, by: str, moment: float, *, is_exact: bool
    ) -> Change | None:
        """Store a PARAM_VALUE of a known parameter."""
        _, raw, number, count, given = message
        old_bits, old_number, old_is_raw, _, old_place = unpack_fields(old)
        place = old_place
        if given != NO_INDEX:
            place = COMPACT_NO_INDEX if given >= count or count > PARAMETERS_MAX else given
        seen_at = self._moments.get(name, moment)
        self._moments[name] = moment
        is_same_type = old_number == number
        if is_same_type and self._wire.get(name) == raw and not is_exact:
            if place != old_place:
                self._compact[name] = pack_fields(old_bits, number, old_is_raw, LIVE, place)
                self.dirty.setdefault(name, by)
            return None
        if is_same_type and not is_exact and self._is_rounded(old, raw):
            bits, is_raw = old_bits, old_is_raw
        else:
            bits, is_raw = bits_of_wire(raw, number, self._encoding)
            self._filed.discard(name)
        before = self._defaults.get(name) if is_same_type else self._defaults.pop(name, None)
        new = self._compact[name] = pack_fields(bits, number, is_raw, LIVE, place)
        self._wire[name] = raw
        if same_compact(old, new):
            if place != old_place:
                self.dirty.setdefault(name, by)
            return None
        self._record_change(name, old, by, before, seen_at)
        if self._hash is not None:
            self._invalidate_hash(name)
        return _new(Changed, (name, old, new, by, self._defaults.get(name), before))

    def store_file_entry(
        self,
        name: str,
        number: int,
        bits: int,
        index: int,
        default: int | None,
        moment: float = 0.0,
        *,
        is_older: bool,
    ) -> Change | None:
        """Store one entry of a packed parameter file and return the change, if there is one.

        The file's integers are exact, also where a PARAM_VALUE rounds them.

        Args:
            name, number: param_id and type.
            bits, default: the value and the firmware's default, as in `Param.bits`.
            index: its index in the list.
            moment: when the file was requested: the vehicle may have read the value at any time since.
            is_older: whether a PARAM_VALUE of the parameter was received since the file was requested. That
                value then wins, unless it is a rounded form of the file's.
        """
        initial = None if default is None else from_bits(default, number)
        old = self._compact.get(name)
        if old is None:
            if not self._name_quota.has_capacity(len(self._compact)):
                return None
            self._name_quota.taken += 1
        raw = as_reported(bits, number, self._encoding)
        before = self._defaults.get(name)
        is_same_type = old is None or unpack_fields(old)[1] == number
        if is_older and old is not None and not (is_same_type and self._wire.get(name) == raw):
            if is_same_type:  # otherwise the default belongs to another type
                self._set_default(name, initial)
            self._compact[name] = with_index(old, index)
            self.dirty.setdefault(name, "vehicle")
            return None
        self._set_default(name, initial)
        is_raw = isinstance(from_bits(bits, number), bytes)
        seen_at = self._moments.get(name, moment)
        self._moments[name] = max(moment, seen_at)
        self._latest = max(self._latest, moment)
        new = self._compact[name] = pack_fields(bits, number, is_raw, LIVE, index)
        self._wire[name] = raw
        self._filed.add(name)
        if old is None or not has_index(old, index) or initial != before:
            self.dirty.setdefault(name, "vehicle")
        if old is not None and same_compact(old, new):
            return None
        self._record_change(name, old, "vehicle", before, seen_at)
        self._invalidate_hash(name)
        kind = self._kind_of_first if old is None else Changed
        return _new(kind, (name, old, new, "vehicle", initial, before))

    def take_pack(self, pack: Pack, moment: float, newer: Collection[str], *, start: int = 0) -> list[Change]:
        """Store the entries of a packed parameter file and return the changes.

        Entries whose names no other file format can hold are left out.

        Args:
            pack: the file, or a part of it.
            moment: when it was requested.
            newer: names with a PARAM_VALUE received since the file was requested, as in `store_file_entry`.
            start: the index of the first entry.
        """
        changes = []
        for index, (name, number, bits, default) in enumerate(pack.entries, start=start):
            if not is_portable_name(name):
                self.leave_out(name)
                continue
            if default is None and pack.with_defaults:
                default = bits  # the file has only defaults that differ from the value
            change = self.store_file_entry(name, number, bits, index, default, moment, is_older=name in newer)
            if change is not None:
                changes.append(change)
        return changes

    def use_encoding(self, encoding: Encoding) -> list[Change]:
        """Decode all received values again in another encoding and return the values that differ."""
        if encoding is self._encoding:
            return []
        self._encoding = encoding
        changes = []
        for name, raw in self._wire.items():
            old = self._compact[name]
            bits, number, _, trust, place = unpack_fields(old)
            if name in self._filed:
                self._wire[name] = as_reported(bits, number, encoding)
                continue
            bits, is_raw = bits_of_wire(raw, number, encoding)
            new = self._compact[name] = pack_fields(bits, number, is_raw, trust, place)
            if not same_compact(old, new):
                self.dirty.setdefault(name, "vehicle")
                changes.append(self._change(name, old, new))
        return changes

    def restore(
        self,
        params: Mapping[str, Param],
        *,
        count: int | None,
        confirmed: int | None,
        complete: bool,
        placed: bool,
        volatile: frozenset[str],
        volatile_known: bool,
        moments: Mapping[str, float] | None = None,
    ) -> list[Change]:
        """Load the cached table as *cached*; values received on this link stay.

        A table whose list has a name that no parameter file can hold was cached by an earlier version: that
        name is left out, and the table is downloaded again.

        Args:
            params: the cached table.
            count: its param_count; if a different one was received, all arguments below are ignored.
            confirmed: the hash by which the vehicle would confirm it, or None.
            placed: whether its indices are still valid.
            complete, volatile, volatile_known: as the attributes.
            moments: as in `fill`.
        """
        known = as_params(params)
        if any(is_listed(compact) and not is_portable_name(name) for name, compact in known.compact.items()):
            complete = placed = False
        changes = self.fill(known, are_placed=placed and self.count in (None, count), moments=moments)
        if self.count not in (None, count):
            return changes
        self.count = count
        self.complete = complete
        if confirmed is not None:
            self.confirm(confirmed, volatile, proven=volatile_known)
            if volatile_known:
                self.rehash()  # the hash covers the table's values, not those stored with the hash
            elif any(
                name not in self._compact or not same_compact(self._compact[name], compact)
                for name, compact in known.compact.items()
                if name not in volatile
            ):
                self.unconfirm()
        return changes

    def fill(
        self,
        params: Mapping[str, Param],
        *,
        are_placed: bool = True,
        moments: Mapping[str, float] | None = None,
    ) -> list[Change]:
        """Add cached values as *cached*; values received on this link stay.

        A received value is completed with the firmware's default, and with the exact integer that the message
        rounded.

        Args:
            params: the cached table.
            are_placed: whether its indices are still valid.
            moments: when each value was observed last, in seconds of the core's clock.
        """
        seen = {} if moments is None else moments
        changes = []
        known = as_params(params)
        for name, cached in known.compact.items():
            old = self._compact.get(name)
            default = known.defaults.get(name)
            if old is not None:
                if unpack_fields(old)[1] == unpack_fields(cached)[1] and name not in self._filed:
                    changes += self._merge_cached(name, old, cached, default)
            elif is_portable_name(name) and self._name_quota.has_capacity(len(self._compact)):
                self._name_quota.taken += 1
                new = with_trust_number(cached, CACHED)
                if not are_placed and is_listed(new):
                    new = self._with_outdated_index(name, new)
                self._compact[name] = new
                if name in seen:
                    self._moments[name] = seen[name]
                if default is not None:
                    self._defaults[name] = default
                changes.append(self._change(name, None, new))
        return changes

    def change_count(self, count: int) -> None:
        """Take a changed count: all indices become invalid."""
        if self.count is not None:
            if self.complete:
                self._was_complete = True
            self.complete = False
            for name, compact in self._compact.items():
                if is_listed(compact):
                    self._compact[name] = self._with_outdated_index(name, compact)
        self.count = count

    @property
    def has_outdated_indices(self) -> bool:
        """Whether some names have no valid index since the count changed."""
        compact = self._compact
        self.outdated_indices = {
            name for name in self.outdated_indices if name in compact and not is_listed(compact[name])
        }
        return bool(self.outdated_indices)

    def place(self, names: Mapping[int, str]) -> None:
        """Set the indices that a download has determined."""
        everything = self._compact
        for index, name in names.items():
            compact = everything.get(name)
            if compact is None:
                continue
            if not has_index(compact, index):
                everything[name] = with_index(compact, index)
                self.dirty.setdefault(name, "vehicle")

    def settle(self, names: Mapping[int, str]) -> list[Change]:
        """Finish a complete download: set its indices and remove what the vehicle no longer has."""
        self.place(names)
        present = frozenset(names.values())
        removed = [
            name
            for name, compact in self._compact.items()
            if name not in present and (is_listed(compact) or name in self.outdated_indices)
        ]
        self.outdated_indices.clear()
        return self._remove(removed)

    def present(self) -> dict[int, str]:
        """Return the names by index under the present count, without indices that two names claim."""
        names: dict[int, str] = {}
        twice = set()
        for name, compact in self._compact.items():
            index = unpack_fields(compact)[4]
            if index != COMPACT_NO_INDEX and names.setdefault(index, name) != name:
                twice.add(index)
        count = self.count or 0
        return {index: name for index, name in names.items() if index < count and index not in twice}

    def verify(self) -> None:
        """Mark cached values that the hash covers as *verified*: the vehicle's hash has confirmed them."""
        if not self.volatile_known:
            return  # the hash may cover none of them
        for name, compact in self._compact.items():
            if trust_of(compact) == CACHED and is_listed(compact) and name not in self.volatile:
                self._compact[name] = with_trust_number(compact, VERIFIED)

    def doubt(self, *trusts: Trust) -> None:
        """Mark all values of these trust levels as *cached*: they may have changed unnoticed."""
        self.doubts += Trust.LIVE in trusts
        doubted = {number_of(trust) for trust in trusts}
        for name, compact in self._compact.items():
            if trust_of(compact) in doubted:
                self._wire.pop(name, None)  # the next value counts, even if it is the same
                self._compact[name] = with_trust_number(compact, CACHED)

    def doubt_value(self, name: str) -> None:
        """Mark one value as *cached*: it may have changed unnoticed."""
        compact = self._compact.get(name)
        if compact is not None:
            self._wire.pop(name, None)  # the next value counts, even if it is the same
            self._compact[name] = with_trust_number(compact, CACHED)

    def remove(self, condition: Callable[[Param], bool]) -> list[Change]:
        """Remove the parameters that meet a condition."""
        return self._remove([param.name for param in self.params.values() if condition(param)])

    def forget(self) -> list[Change]:
        """Remove everything: another vehicle uses the address."""
        changes = self._remove(list(self._compact))
        self.unconfirm()
        self.volatile = frozenset()
        self.volatile_known = False
        self.count = None
        self.complete = self._was_complete = False
        return changes

    def forget_defaults(self) -> None:
        """Remove the defaults: they belong to another firmware."""
        self._defaults.clear()

    @property
    def _kind_of_first(self) -> type[Change]:
        """The class of the change by the first value of a name."""
        return Added if self.complete or self._was_complete else FirstValue

    @property
    def is_provable(self) -> bool:
        """Whether the vehicle's hash can prove the present values of all parameters that it covers."""
        return self.complete and self.volatile_known and self.hash is not None

    def is_hashed(self, name: str) -> bool:
        """Return whether the vehicle's hash is known to cover a parameter."""
        compact = self._compact.get(name)
        return compact is not None and is_listed(compact) and name not in self.volatile

    def listed_bits(self) -> dict[str, int]:
        """Return the bits of the listed parameters by name: those with an index, which count and hash
        cover."""
        return {
            name: unpack_fields(compact)[0] for name, compact in self._compact.items() if is_listed(compact)
        }

    @property
    def size(self) -> int:
        """The number of listed parameters."""
        return sum(map(is_listed, self._compact.values()))

    @property
    def only_cached(self) -> int:
        """The number of listed parameters that are only *cached*."""
        return sum(trust_of(compact) == CACHED and is_listed(compact) for compact in self._compact.values())

    def gaps(self) -> tuple[int, tuple[int, ...]]:
        """Return the number of parameters that the table should have, and the missing indices."""
        present = {unpack_fields(compact)[4] for compact in self._compact.values()}
        present.discard(COMPACT_NO_INDEX)
        count = len(present) if self.count is None else self.count
        return count, tuple(index for index in range(count) if index not in present)

    def unhashed(self) -> set[str]:
        """Return the names that the hash does not cover: the volatile ones, or all while those are
        unknown."""
        return set(self.volatile) if self.volatile_known else set(self.listed_bits())

    def take_dirty(self) -> dict[str, str]:
        """Return names changed or removed since the last call, each with the author of the change."""
        dirty, self.dirty = self.dirty, {}
        return dirty

    def take_overwritten(self) -> list[Observation]:
        """Return the observations since the last call that are not the latest of their parameter.

        A value that changed and was received again is among them, with the moment of the change.
        """
        overwritten, self.overwritten = self.overwritten, []
        changed, self._changed = self._changed, {}
        for name, (moment, by) in changed.items():
            if name in self._compact and moment < self._moments[name]:
                overwritten.append(Observation(self.params[name], by, moment))
        return overwritten

    def take_removed_at(self) -> dict[str, float]:
        """Return when each name removed since the last call was found missing."""
        removed_at, self.removed_at = self.removed_at, {}
        return removed_at

    def age(self, seconds: float) -> None:
        """Move every moment back by time that the core's clock has left out.

        Args:
            seconds: of system suspend, see `Station.handle_suspend`.
        """
        if not seconds:
            return
        for moments in (self._moments, self.removed_at):
            moments.update({name: moment - seconds for name, moment in moments.items()})
        self._changed = {name: (moment - seconds, by) for name, (moment, by) in self._changed.items()}
        self.overwritten = [each._replace(moment=each.moment - seconds) for each in self.overwritten]
        self._latest -= seconds
        self.suspended += seconds

    def _remove(self, names: Collection[str]) -> list[Change]:
        """Remove these names."""
        changes: list[Change] = []
        for name in names:
            compact = self._compact.pop(name)
            default = self._defaults.pop(name, None)
            self._wire.pop(name, None)
            self._filed.discard(name)
            self._moments.pop(name, None)
            self._changed.pop(name, None)
            if name in self.dirty or len(self.dirty) < REMOVED_NAMES_MAX:
                self.dirty[name] = "vehicle"
                if self._latest > -math.inf:
                    self.removed_at[name] = self._latest
            if self._hash is not None:
                self._invalidate_hash(name)
            changes.append(_new(Removed, (name, compact, None, "vehicle", None, default)))
        self._name_quota.taken -= len(changes)
        return changes

    def _set_default(self, name: str, default: WireValue | None) -> None:
        if default is None:
            self._defaults.pop(name, None)
        else:
            self._defaults[name] = default

    def _change(self, name: str, old: CompactParam | None, new: CompactParam) -> Change:
        default = self._defaults.get(name)
        kind = FirstValue if old is None else Changed
        return _new(kind, (name, old, new, "vehicle", default, default))

    def _record_change(
        self, name: str, old: CompactParam | None, by: str, default: WireValue | None, seen_at: float
    ) -> None:
        """Record that a value has changed, at the moment that the table already has for it.

        The cache receives each value that our writes have set, however short its life, and the values that
        they replaced.

        Args:
            name, by: the parameter and the author of the change.
            old, default: the value before, and the default of its type then; None for a new parameter.
            seen_at: when the value before was observed last.
        """
        before = self.dirty.get(name)
        if old is not None:
            if before is not None and (is_ours(before) or is_ours(by)):
                since, author = self._changed.get(name, (seen_at, before))
                param = param_of(name, old, default)
                if since < seen_at:
                    self.overwritten.append(Observation(param, author, since))
                self.overwritten.append(Observation(param, before, seen_at))
                del self.overwritten[:-OVERWRITTEN_MAX]
            self._changed[name] = (self._moments[name], by)
        self.dirty[name] = by

    def _merge_cached(
        self, name: str, live: CompactParam, cached: CompactParam, default: WireValue | None
    ) -> list[Change]:
        """Complete a received value with what its message lacks: the default and the exact integer."""
        bits, number, is_raw, trust, place = unpack_fields(live)
        if self._is_rounded(cached, self._wire.get(name, b"")):
            bits, _, is_raw, *_ = unpack_fields(cached)
        if default is not None and name not in self._defaults:
            self._defaults[name] = default
            self.dirty.setdefault(name, "vehicle")
        new = self._compact[name] = pack_fields(bits, number, is_raw, trust, place)
        if same_compact(live, new):
            return []
        self.dirty.setdefault(name, "vehicle")
        return [self._change(name, live, new)]

    def _is_rounded(self, known: CompactParam, raw: bytes) -> bool:
        """Return whether a message is a rounded form of a known integer beyond the 24 bits of a float32."""
        if self._encoding is not Encoding.C_CAST:
            return False
        bits, number, is_raw, *_ = unpack_fields(known)
        value = from_bits(bits, number, is_raw=is_raw)
        return (
            isinstance(value, int)
            and abs(value) > _EXACT
            and as_reported(bits, number, self._encoding) == raw
        )

    def _with_outdated_index(self, name: str, compact: CompactParam) -> CompactParam:
        self.outdated_indices.add(name)
        return with_index(compact, COMPACT_NO_INDEX)

    def _invalidate_hash(self, name: str) -> None:
        if name in self.volatile:
            return
        if self.volatile_known:
            self._hash_is_stale = True
        else:
            self._hash = None
