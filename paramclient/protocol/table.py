"""The parameters of one component as its messages show them: values with trust, indices, count, hash."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias

from paramclient.model.px4_hash import find_volatile, hash_bits
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    as_reported,
    encoding_of,
    format_value,
    from_bits,
    is_portable_name,
)
from paramclient.protocol.dialect import PLAIN, Dialect, Digest, ReportedValue
from paramclient.protocol.param_pck import PackedParam
from paramclient.wire.messages import HASH_CHECK, PARAMETERS_MAX

NAMES_MAX: Final = 65_535
"""Names in one table: as many as there are indices, and as many again without an index (parameters not in
use). No real component has more."""

BEYOND_MAX: Final = 64
"""Indices by which a value may be beyond the count, so that the count is false: more than are lost in a row.
Values further beyond are stored without their index."""
FLOAT32_EXACT: Final = 2**24
"""The largest integer up to which float32 holds all."""
LEFT_OUT_MAX: Final = 1_000
"""Names that are not stored, but told: more than any component has, unless it sends noise."""

Kind: TypeAlias = Literal["changed", "first", "added", "removed"]


@dataclass(frozen=True, slots=True)
class Change:
    """One parameter that appeared, changed its value or type, or was removed.

    Attributes:
        name: param_id.
        old: the parameter before, or None for a new one.
        new: the parameter now, or None when the vehicle no longer has it.
        by: the author: "us" (a `set` of this client), "us for NAME" (a `set` on behalf of NAME), "vehicle",
            or the system and component of another station whose PARAM_SET was seen.
        kind: "changed"; "first" for a value of a table that was never complete; "added" for a parameter that
            a complete table lacked; "removed".
    """

    name: str
    old: Param | None
    new: Param | None
    by: str
    kind: Kind


class Table:
    """The parameters of one component in one dialect.

    Args:
        dialect: decodes the values.

    Attributes:
        params: by name, in the order of first reception. Shared with readers; never replaced.
        count: the latest param_count, or None.
        names: the name at each known index. Indices are valid for one count only.
        moments: when each value arrived, by name, in seconds of the event loop's clock.
        volatile: names outside the vehicle's hash, as far as known.
        author_of: returns the author of a change of a name.
        left_out: received names that not every parameter file can hold, and that are not stored.
        evidence: for each encoding, a value that shows it: name, bytes and type.
        is_growing: whether each value so far was the last one by its own param_count, or some were beyond it:
            the count grows with the values that arrive, and only a pause tells the end of the list.
        begins_at_1: whether the component has no index 0, as far as known.
        changed: called with each change, after it is stored.
        revision: differs where a stored value, its index or its trust may, but for what is verified.
        recounted: called when the count of a complete table changes, or may have changed.
    """

    def __init__(self, dialect: Dialect = PLAIN) -> None:
        self.dialect = dialect
        self.params: dict[str, Param] = {}
        self.count: int | None = None
        self.names: dict[int, str] = {}
        self.moments: dict[str, float] = {}
        self.volatile: frozenset[str] = frozenset()
        self.volatile_is_known = False
        self.left_out: set[str] = set()
        self.revision = 0
        self.is_growing = True
        self.begins_at_1 = False
        self.author_of: Callable[[str], str] = lambda name: "vehicle"
        self.changed: Callable[[Change], None] = lambda change: None
        self.recounted: Callable[[], None] = lambda: None
        self._held: dict[str, Change] | None = {} if dialect is PLAIN else None
        self._encoding = Encoding.BYTEWISE
        self._wire: dict[str, tuple[bytes, int]] = {}  # as received, until the encoding is certain
        self._exact: set[str] = set()  # names whose value a file or a checksum has shown
        self.evidence: dict[Encoding, tuple[str, bytes, int]] = {}
        self.was_complete = False
        self._false_count: int | None = None  # a param_count that values exceeded
        self._outdated: set[str] = set()  # names whose index belongs to an earlier count
        self._hash: int | None = None
        self._hash_is_stale = False

    # what is known

    @property
    def is_complete(self) -> bool:
        """Whether every index below the count has a parameter."""
        return self.count is not None and len(self.names) >= self.count and not self.missing()

    def missing(self, received: Container[int] | None = None) -> list[int]:
        """Return the indices without a parameter, or those that were not received. They begin at 1 if the
        count itself is one, and 0 is none."""
        present, count = self.names if received is None else received, self.count or 0
        first = int(0 not in present and (self.begins_at_1 or (count in present and not self.is_growing)))
        return [index for index in range(first, first + count) if index not in present]

    @property
    def encoding(self) -> Encoding:
        """How the component encodes values; a change decodes all received values again.

        Later than `report_held`, as by a heartbeat that comes late, the received values are forgotten. Those
        from the cache stay, and floats, which are the same in both.
        """
        return self._encoding

    @encoding.setter
    def encoding(self, encoding: Encoding) -> None:
        if encoding is self._encoding:
            return
        self._encoding = encoding
        if self._held is None:
            received = {name: each for name, each in self.params.items() if each.trust is not Trust.CACHED}
            integers = {name for name, each in received.items() if each.type is not ParamType.REAL32}
            self._forget(integers - self._exact)
        for name, (raw, number) in self._wire.items():
            old = self.params[name]
            new = self.dialect.param(name, raw, number, old.index, encoding)
            self.params[name] = replace(new, default=old.default)

    @property
    def hash(self) -> int | None:
        """The PX4 hash by which the vehicle would confirm exactly this table, or None while unknown."""
        if self._hash_is_stale:
            self._hash_is_stale = False
            self._hash = hash_bits(self.listed_bits(), leave_out=self.volatile)
        return self._hash

    @property
    def rounded(self) -> set[str]:
        """Names of integers that may stand for others: a C-cast PARAM_VALUE rounds them to float32."""
        names = self.params.keys() - self._exact if self._encoding is Encoding.C_CAST else ()
        return {name for name in names if _may_be_rounded(self.params[name])}

    def listed_bits(self) -> dict[str, int]:
        """Return the bits of the parameters that have an index, by name."""
        return {name: param.bits for name, param in self.params.items() if param.index is not None}

    # messages

    def store(self, message: ReportedValue, now: float, *, is_exact: bool = False) -> None:
        """Store one received value, whatever its index is.

        Args:
            message: the value.
            now: when it arrived.
            is_exact: whether it repeats a value that was just written, so that it cannot be a rounded form
                of a known integer.
        """
        name, raw, number, count, index = message
        if name == HASH_CHECK or (not name and (self.is_growing or index >= count)):
            return  # without a name, some firmware says that there is none
        place = self._take_count(name, count, index)
        if not self._may_store(name):
            if place is not None:
                self.names[place] = name
            return
        old = self.params.get(name)
        if place is None and old is not None:
            place = old.index
        elif place is not None:
            self._take_place(name, place)
        self.moments[name] = now
        self._take_evidence(name, raw, number)
        if old is None and len(self.params) >= NAMES_MAX:
            return
        if old is not None and not is_exact and self.is_reported(old, raw, number):
            new = replace(old, index=place, trust=Trust.LIVE)
        else:
            new = self.dialect.param(name, raw, number, place, self._encoding)
            if old is not None and new.type == old.type:
                new = replace(new, default=old.default)
        if self._held is not None:
            self._wire[name] = (raw, number)
        self._put(name, old, new)
        if is_exact and not (old and self.is_reported(old, raw, number)):  # else it may be the old one
            self._exact.add(name)
        elif not is_exact and index >= PARAMETERS_MAX:
            self._exact.discard(name)  # somebody has set it, perhaps to another value of the same float32

    def _take_count(self, name: str, count: int, index: int) -> int | None:
        """Take the count of a value, unless it is false. Return the index; None for a value without one."""
        if index >= PARAMETERS_MAX:
            if 0 < count <= PARAMETERS_MAX and count != self._false_count:
                self.recount(count)
            return None
        count, before = count if count <= PARAMETERS_MAX else 0, self.count or 0
        is_beyond = index > count or (index == count and (0 in self.names or index == 0))
        if is_beyond or (index == 0 and count == before and count in self.names):
            known = self.params.get(name)
            if index > before + BEYOND_MAX or (known is not None and known.index not in (None, index)):
                return None  # some firmware answers reads by name with such an index
            if not self.is_growing and self.is_complete:
                self.recounted()
            self.is_growing, self._false_count = True, count
        if count == self._false_count:
            self.count = max(before, index + (not self.begins_at_1))
        elif self.is_growing and index >= count - 1:
            self.count = max(before, count)
        else:
            self.recount(count)
            self.is_growing = index >= count - 1 and not self.names
        return index

    def end_list(self) -> None:
        """Take note that a list has ended, and that its first and last index are certain."""
        self.begins_at_1 = 0 not in self.names and (self.is_growing or self.count in self.names)
        if self.is_growing and self.names:
            self.count = max(self.names) + (0 in self.names)

    def _take_evidence(self, name: str, raw: bytes, number: int) -> None:
        if self.dialect is PLAIN and len(self.evidence) < len(Encoding):
            encoding = encoding_of(raw, number)
            if encoding is not None:
                self.evidence.setdefault(encoding, (name, raw, number))

    @property
    def contradicts(self) -> str:
        """The evidence of the values against their encoding, in words; "" without any, or with any for it."""
        if not self.evidence or self._encoding in self.evidence:
            return ""
        ((against, (name, raw, number)),) = self.evidence.items()
        looks = "bytes (a denormal float32)" if against is Encoding.BYTEWISE else "a float32"
        params = (self.dialect.param(name, raw, number, None, each) for each in (self._encoding, against))
        read, meant = (format_value(each.settable, number) for each in params)
        return f"each integer looks like {looks}; {name} = {read} is {meant} with --encoding {against}"

    def store_entry(self, entry: PackedParam, index: int, now: float, *, with_defaults: bool) -> None:
        """Store one entry of a parameter file: its integers are exact, its default may be given.

        A value that was received after the file was requested wins, unless it is a rounded form of it.

        Args:
            entry: the entry.
            index: its index in the list.
            now: when the file was requested: the vehicle may have read the value at any time since.
            with_defaults: whether an entry without a default has its default value.
        """
        name, kind, bits, own_default = entry
        if not self._may_store(name):
            self.names[index] = name
            return
        old = self.params.get(name)
        self._take_place(name, index)
        default_bits = own_default if own_default is not None else bits if with_defaults else None
        default = None if default_bits is None else from_bits(default_bits, kind)
        new = Param(name, from_bits(bits, kind), kind, index, bits, Trust.LIVE, default)
        raw = as_reported(bits, kind, self._encoding)
        moment = max(now, self.moments.get(name, now))
        is_newer = old is not None and moment > now and old.trust is Trust.LIVE
        if old is not None and is_newer and not self.is_reported(old, raw, kind):
            self.params[name] = replace(old, index=index, default=default)
            return
        self.moments[name] = moment
        self._wire.pop(name, None)  # it has no encoding
        self._put(name, old, new)
        self._exact.add(name)

    def _take_place(self, name: str, index: int) -> None:
        self.names[index] = name
        self._outdated.discard(name)

    def _may_store(self, name: str) -> bool:
        is_stored = is_portable_name(name)
        if not is_stored and len(self.left_out) < LEFT_OUT_MAX:
            self.left_out.add(name)
        return is_stored

    def complete(self, since: float = math.inf) -> None:
        """Drop the parameters that a complete list no longer has.

        Where several have one index, all stay that came since then.
        """
        if not self.is_complete:
            return
        self.was_complete = True
        listed = {*self.names.values()}
        gone = [
            name
            for name, param in self.params.items()
            if name in self._outdated
            or (param.index is not None and name not in listed and self.moments[name] < since)
        ]
        self._outdated.clear()
        for name in gone:
            self._report(Change(name, self._drop(name), None, "vehicle", "removed"))
        self._invalidate_hash()

    def _drop(self, name: str) -> Param:
        self.moments.pop(name, None)
        self._wire.pop(name, None)
        self._exact.discard(name)
        return self.params.pop(name)

    def recount(self, count: int) -> None:
        """Take a count; another one invalidates all indices."""
        was_growing, self.is_growing = self.is_growing, False
        if count == self.count:
            return
        was_complete = self.is_complete
        if not was_growing:
            self._outdated |= set(self.names.values())
            self.names.clear()
        self.count, self._false_count, self.begins_at_1 = count, None, False
        self.unconfirm()
        if was_complete:
            self.recounted()

    def is_reported(self, known: Param, raw: bytes, number: int) -> bool:
        """Return whether these bytes are the component's form of a known value, which may be rounded."""
        if known.type != number or self.dialect is not PLAIN:
            return False
        if known.is_raw:
            return int.from_bytes(raw, "little") == known.bits
        return as_reported(known.bits, number, self._encoding) == raw

    def _put(self, name: str, old: Param | None, new: Param) -> None:
        self.params[name] = new
        self.revision += old != new
        if old is not None and old.same_value(new):
            return
        self._exact.discard(name)
        self._invalidate_hash(name)
        kind: Kind = "changed" if old is not None else "added" if self.was_complete else "first"
        self._report(Change(name, old, new, self.author_of(name), kind))

    def _report(self, change: Change) -> None:
        if self._held is None:
            self.changed(change)
        else:
            self._held.setdefault(change.name, change)

    def report_held(self) -> None:
        """Report the changes that waited until the encoding was certain, with the values in that encoding."""
        held, self._held = self._held or {}, None
        self._wire.clear()
        for name, change in held.items():
            if change.new is not None and name in self.params:
                self.changed(replace(change, new=self.params[name]))

    def with_default(self, param: Param) -> Param:
        """Return a parameter that was received earlier with the default that is known by now."""
        now = self.params.get(param.name, param)
        is_new = param.default is None and now.default is not None and now.type == param.type
        return replace(param, default=now.default) if is_new else param

    # trust

    def doubt(self, *names: str) -> None:
        """Mark values as cached, or all: the component may have others by now."""
        self.revision += 1
        for name in self.params.keys() & (names or self.params):
            self.params[name] = self.params[name].with_trust(Trust.CACHED)
            self._exact.discard(name)

    def verify(self) -> None:
        """Mark the cached values that the confirmed hash covers as verified."""
        if self.volatile_is_known:
            self._verify(but=self.volatile)

    def prove(self, checksum: int) -> None:
        """Take a checksum that covers the whole table, and mark the cached values as verified."""
        self._hash, self._hash_is_stale = checksum, False
        self._exact.update(self.names.values())
        self._verify(but=frozenset())

    def _verify(self, *, but: frozenset[str]) -> None:
        for name, param in self.params.items():
            if param.trust is Trust.CACHED and param.index is not None and name not in but:
                self.params[name] = param.with_trust(Trust.VERIFIED)

    def unverified(self, since: float = math.inf) -> list[str]:
        """Return the names whose values are cached; with `since`, without those that were received since then
        from a component that was lost afterwards."""
        return [
            name
            for name, param in self.params.items()
            if param.trust is Trust.CACHED and self.moments[name] < since
        ]

    def clear(self) -> None:
        """Forget everything: another vehicle uses the address."""
        for each in (self.params, self.names, self.moments, self._wire, self.evidence):
            each.clear()
        for names in (self._outdated, self._exact, self.left_out):
            names.clear()
        self.count = self._false_count = None
        self.is_growing, self.begins_at_1 = True, False
        self.volatile, self.volatile_is_known = frozenset(), False
        self.was_complete = False
        self.unconfirm()

    def forget_doubtful(self) -> None:
        """Forget the values that may be of another vehicle: the component was lost since, and is identified
        only now. A table that the vehicle has confirmed stays."""
        if any(param.trust is Trust.VERIFIED for param in self.params.values()):
            return
        self._forget(name for name, param in self.params.items() if param.trust is Trust.CACHED)

    def _forget(self, names: Iterable[str]) -> None:
        for name in list(names):
            if (index := self._drop(name).index) is not None and self.names.get(index) == name:
                del self.names[index]
        if not self.params:
            self.clear()

    def load(
        self,
        params: Iterable[Param],
        *,
        count: int | None,
        hash: int | None,  # noqa: A002 - the name of the attribute
        volatile: Iterable[str],
        volatile_is_known: bool,
        moments: Mapping[str, float],
    ) -> None:
        """Take the cached table of the component; values that were received on this link stay.

        `moments`: when the values arrived in earlier sessions, by the event loop's clock.
        """
        has_indices = count is not None and self.count in (None, count)
        for param in params:
            old = self.params.get(param.name)
            if old is None:
                self.params[param.name] = param.with_trust(Trust.CACHED)
                self.moments[param.name] = moments[param.name]
            elif old.type == param.type:
                index = old.index if old.index is not None or not has_indices else param.index
                default = old.default if old.default is not None else param.default
                self.params[param.name] = replace(old, index=index, default=default)
            if param.index is not None and has_indices:
                self.names.setdefault(param.index, param.name)
        if self.count is None:
            self.count = count
        if self.count == count:
            self.is_growing = False
            self._hash, self._hash_is_stale = hash, False
            self.volatile = frozenset(volatile)
            self.volatile_is_known = volatile_is_known
            self.was_complete = self.is_complete

    # PX4's hash

    def agrees_with(self, digest: Digest | None) -> bool:
        """Return whether a hash that the vehicle announced is that of the complete table."""
        is_same = digest is not None and (self.hash, self.count) == (digest.hash, digest.count)
        return is_same and self.is_complete

    def confirm(self, announced: int) -> bool:
        """Take a hash that the vehicle announced for exactly this table, and return whether it is proven.

        It is proven where the hash computed here, without some volatile names, is the same.
        """
        volatile, is_proven = find_volatile(self.listed_bits(), announced, believed=self.volatile)
        self._hash, self._hash_is_stale = announced, False
        if is_proven or not self.volatile_is_known:
            self.volatile = volatile
        self.volatile_is_known = is_proven
        return is_proven

    def unconfirm(self) -> None:
        """Forget the hash: none is known to belong to this table."""
        self._hash, self._hash_is_stale = None, False

    def _invalidate_hash(self, name: str = "") -> None:
        if not self.volatile_is_known:
            self.unconfirm()
        elif name not in self.volatile:
            self._hash_is_stale = self._hash is not None


def _may_be_rounded(param: Param) -> bool:
    return param.type is ParamType.INT32 and not param.is_raw and abs(int(param.value)) >= FLOAT32_EXACT
