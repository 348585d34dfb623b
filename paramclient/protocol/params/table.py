"""The parameters of one component as they are known now, by name, each with how far it can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from struct import unpack
from typing import Final, NamedTuple

from paramclient.model.params import (
    CACHED,
    LIVE,
    NOWHERE,
    VERIFIED,
    Held,
    Params,
    as_params,
    is_listed,
    number_of,
    pack_fields,
    param_of,
    same_held,
    trust_of,
    unpack_fields,
    with_index,
    with_trust_number,
)
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    Value,
    as_sent,
    bits_of_wire,
    from_bits,
    is_portable_name,
    known_type,
)
from paramclient.protocol.ftp.param_pck import Pack
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.change_origin import is_ours
from paramclient.protocol.params.hash_exclusions import hash_of
from paramclient.protocol.wire import MOST_PARAMETERS, NO_INDEX, ParamValue

__all__ = ["MOST_NAMES", "Observation", "Room", "Table"]

MOST_NAMES: Final = 65_535
"""Names that one table may hold: as many as can have an index, and as many again of parameters that are not
in use and have none. A component that invents further ones is ill."""

ENOUGH_NAMES: Final = 2_000
"""Names that every table may hold, whatever the others of its link do: more than autopilots have."""
MOST_NAMES_OF_LINK: Final = 400_000
"""Names that all tables of one link may hold together before each is held to `ENOUGH_NAMES`: 250 vehicles
with 1,600 parameters each. A name takes about a quarter of a kilobyte."""
MOST_OVERWRITTEN: Final = 1_024
"""What we wrote and was replaced before the cache was told: some tens fit between two writes to the disk."""
MOST_GONE: Final = MOST_NAMES
"""Names that have changed or gone and wait to be told to the cache, above which further gone ones are not
told: the next whole table that is kept is without them."""

_EXACT = 1 << 24  # up to here every integer is a float32
_new = tuple.__new__  # what the constructor of a tuple ends in, after several times the time


class Room:
    """How many names the tables of one link hold together.

    Attributes:
        taken: so many.
    """

    __slots__ = ("taken",)

    def __init__(self) -> None:
        self.taken = 0

    def has_some(self, held: int) -> bool:
        """Whether a table that holds so many names may take another one."""
        return held < MOST_NAMES and (held < ENOUGH_NAMES or self.taken < MOST_NAMES_OF_LINK)


class Observation(NamedTuple):
    """One value of a parameter as it was observed.

    Attributes:
        param: the parameter with that value.
        by: the author of the change that brought it, as in `Change`.
        moment: when the value came from the link, in seconds of the core's clock.
    """

    param: Param
    by: str
    moment: float


class Table:
    """All that is known of a component's parameters.

    Each value carries the moment at which it came from the link (`Params.moments`), in seconds of the core's
    clock, whenever it is processed or written to the cache.

    Args:
        encoding: how the component writes values, as far as known.
        room: what all tables of the link share; None for one that is alone.

    Attributes:
        params: by name, in the order in which they were first heard. Shared with readers; never replaced.
        count: the param_count heard last, or None. Indices are those under this count: when it moves, none is
            known any more.
        volatile: names that the vehicle leaves out of its hash, as far as known.
        volatile_known: whether a recomputed hash has proven that set.
        complete: whether every index below `count` has its parameter here.
        hash: the PX4 hash under which the vehicle would confirm exactly this table, or None while unknown.
        displaced: names whose index was of an earlier count, and that the vehicle may no longer have; some of
            them may have come again since.
        doubts: how often what had been heard was no longer to be relied on.
        passed_over: by a name that several parameters share, the indices of those that it does not mean.
        dirty: names whose value, type or index changed since `take_dirty` was called last.
        gone: the moments at which removed names were found missing, since `take_gone` was called last.
        slept: seconds of sleep of this computer by which moments were moved back, see `age`.
        left_out: how often something was said under a name that no parameter file can hold, see `leave_out`.
        left_out_name: the last such name, or an empty text.
        keeps_all: whether `overwritten` has every value that was replaced before the cache was told of it, as
            while the cache cannot be written; else only those of our writes.
        overwritten: values that the cache has not been told of and that are no longer current: those that
            our writes have set or replaced, and the first observation of a changed value that came again.
    """

    def __init__(self, encoding: Encoding = Encoding.BYTEWISE, room: Room | None = None) -> None:
        self._room = Room() if room is None else room
        self.params = Params()
        self._held = self.params.held
        self._defaults = self.params.defaults
        self._moments = self.params.moments
        self._latest = -math.inf  # the moment of the newest observation
        self._changed: dict[str, tuple[float, str]] = {}  # when a value changed, by whom: not yet told
        self.gone: dict[str, float] = {}
        self.slept = 0.0
        self.count: int | None = None
        self.volatile: frozenset[str] = frozenset()
        self.volatile_known = False
        self.complete = False
        self.displaced: set[str] = set()
        self.doubts = 0
        self.passed_over: dict[str, frozenset[int]] = {}
        self.dirty: dict[str, str] = {}
        self.overwritten: list[Observation] = []
        self.keeps_all = False
        self.left_out = 0
        self.left_out_name = ""
        self._hash: int | None = None
        self._hash_is_stale = False
        self._encoding = encoding
        self._wire: dict[str, bytes] = {}  # the four bytes as they came, for another encoding
        self._filed: set[str] = set()  # whose value came in a file, which has no such encoding

    @property
    def encoding(self) -> Encoding:
        return self._encoding

    @property
    def hash(self) -> int | None:
        if self._hash_is_stale:
            self._hash_is_stale = False
            self._hash = hash_of(self.listed_bits(), leave_out=self.volatile)
        return self._hash

    def confirm(self, announced: int, volatile: frozenset[str], *, proven: bool) -> None:
        """The vehicle announced this hash for exactly this table.

        With `proven`, the hash computed here without the volatile names was the same. Then it can be computed
        again whenever a value moves, and the vehicle can confirm the table in the next session as well. What
        is taken for volatile now and was not before, or the other way round, is news for the cache.
        """
        for name in volatile ^ self.volatile:
            if name in self.params:
                self.dirty.setdefault(name, "vehicle")
        self._hash = announced
        self._hash_is_stale = False
        self.volatile = volatile
        self.volatile_known = proven

    def leave_out(self, name: str) -> None:
        """Count what was said under a name that no parameter file can hold: it is not taken."""
        self.left_out += 1
        self.left_out_name = name

    def unconfirm(self) -> None:
        """No hash is known to belong to this table any more."""
        self._hash = None
        self._hash_is_stale = False

    def rehash(self) -> None:
        """Values may have moved under the confirmed hash: compute it again when it is asked for."""
        self._hash_is_stale = self._hash is not None

    def hear(
        self, message: ParamValue, by: str, moment: float = 0.0, *, is_exact: bool = False
    ) -> Change | None:
        """Take one PARAM_VALUE; give the change if it brought one (a first value is one).

        The value counts whatever the index says. An index of 65535 leaves the known one as it is, one that
        is not below the count is no index.

        Args:
            message: what came.
            by: who did it, as in `Change`.
            moment: when it came from the link, not before the last one.
            is_exact: whether it says what was just written, so that it cannot stand for an integer that it
                would round.
        """
        name, raw, number, count, given = message
        if self.passed_over and given in self.passed_over.get(name, ()):
            return None
        everything = self._held
        old = everything.get(name)
        self._latest = moment
        if old is None:  # the short way for a first value
            room = self._room
            if not room.has_some(len(everything)):
                return None
            room.taken += 1
            place = NOWHERE if given >= count or count > MOST_PARAMETERS else given
            bits, is_raw = bits_of_wire(raw, number, self._encoding)
            new = everything[name] = pack_fields(bits, number, is_raw, LIVE, place)
            self._wire[name] = raw
            self._moments[name] = moment
            self.dirty[name] = by
            if self._hash is not None:
                self._moved(name)
            return _new(Change, (name, None, new, by, None, None))
        return self._hear_again(name, old, message, by, moment, is_exact=is_exact)

    def with_known_type(self, message: ParamValue) -> ParamValue:
        """Return a PARAM_VALUE of the type REAL32 with the integer type that is known of the parameter.

        ArduPilot answers a PARAM_SET with REAL32, whatever the parameter's type is, if the value is the
        default and was never stored (measured on 4.6-dev). A cached type that nothing has confirmed does not
        count. Without a type, or if the number is not whole or out of its range, the message is returned
        unchanged.
        """
        name = message.param_id
        held = self._held.get(name)
        if held is None:
            return message
        _, number, _, trust, _ = unpack_fields(held)
        if trust == CACHED and name not in self._wire:
            return message
        known = known_type(number)
        (value,) = unpack("<f", message.raw)
        if not isinstance(known, ParamType) or not known.is_integer or not value.is_integer():
            return message
        low, high = known.bounds
        return message._replace(param_type=known) if low <= value <= high else message

    def hear_index(self, message: ParamValue) -> None:
        """Take the index of a PARAM_VALUE of a known parameter, and leave the value as it is."""
        name, _, _, count, given = message
        held = self._held[name]
        is_index = given < count <= MOST_PARAMETERS and given not in self.passed_over.get(name, ())
        if is_index and with_index(held, given) != held:
            self._held[name] = with_index(held, given)
            self.dirty.setdefault(name, "vehicle")

    def _hear_again(
        self, name: str, old: Held, message: ParamValue, by: str, moment: float, *, is_exact: bool
    ) -> Change | None:
        """Take a PARAM_VALUE of a parameter that is known."""
        _, raw, number, count, given = message
        old_bits, old_number, old_is_raw, _, place = unpack_fields(old)
        if given != NO_INDEX:
            place = NOWHERE if given >= count or count > MOST_PARAMETERS else given
        seen_at = self._moments.get(name, moment)
        self._moments[name] = moment
        is_same_type = old_number == number
        if is_same_type and self._wire.get(name) == raw and not is_exact:
            if with_index(old, place) != old:
                self._held[name] = pack_fields(old_bits, number, old_is_raw, LIVE, place)
                self.dirty.setdefault(name, by)
            return None
        if is_same_type and not is_exact and self._rounds(old, raw):
            bits, is_raw = old_bits, old_is_raw
        else:
            bits, is_raw = bits_of_wire(raw, number, self._encoding)
            self._filed.discard(name)
        before = self._defaults.get(name) if is_same_type else self._defaults.pop(name, None)
        new = self._held[name] = pack_fields(bits, number, is_raw, LIVE, place)
        self._wire[name] = raw
        if same_held(old, new):
            if with_index(old, place) != old:
                self.dirty.setdefault(name, by)
            return None
        self._news(name, old, by, before, seen_at)
        if self._hash is not None:
            self._moved(name)
        return _new(Change, (name, old, new, by, self._defaults.get(name), before))

    def take(
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
        """Take one entry of a packed parameter file; give the change if it brought one.

        Its integers are exact, also where a PARAM_VALUE rounds them.

        Args:
            name, number: param_id and type.
            bits, default: the value and the firmware's default, as in `Param.bits`.
            index: its place in the list.
            moment: when the file was requested: the vehicle may have read the value at any time since.
            is_older: whether a PARAM_VALUE of it was heard since the file was asked for: then that counts,
                unless it rounds what the file says.
        """
        initial = None if default is None else from_bits(default, number)
        old = self._held.get(name)
        if old is None:
            if not self._room.has_some(len(self._held)):
                return None
            self._room.taken += 1
        raw = as_sent(bits, number, self._encoding)
        before = self._defaults.get(name)
        is_same_type = old is None or unpack_fields(old)[1] == number
        if is_older and old is not None and not (is_same_type and self._wire.get(name) == raw):
            if is_same_type:  # else it is the default of something else
                self._set_default(name, initial)
            self._held[name] = with_index(old, index)
            self.dirty.setdefault(name, "vehicle")
            return None
        self._set_default(name, initial)
        is_raw = isinstance(from_bits(bits, number), bytes)
        seen_at = self._moments.get(name, moment)
        self._moments[name] = max(moment, seen_at)
        self._latest = max(self._latest, moment)
        new = self._held[name] = pack_fields(bits, number, is_raw, LIVE, index)
        self._wire[name] = raw
        self._filed.add(name)
        if old is None or with_index(old, index) != old or initial != before:
            self.dirty.setdefault(name, "vehicle")
        if old is not None and same_held(old, new):
            return None
        self._news(name, old, "vehicle", before, seen_at)
        self._moved(name)
        return _new(Change, (name, old, new, "vehicle", initial, before))

    def take_pack(self, pack: Pack, moment: float, newer: Collection[str], *, start: int = 0) -> list[Change]:
        """Take the entries of a packed parameter file; give the changes that they brought.

        Entries whose names no other form of file can hold are left out.

        Args:
            pack: the file, or a part of it.
            moment: when it was asked for.
            newer: names of which a PARAM_VALUE was heard since the file was asked for, as in `take`.
            start: the index of the first entry.
        """
        changes = []
        for index, (name, number, bits, default) in enumerate(pack.entries, start=start):
            if not is_portable_name(name):
                self.leave_out(name)
                continue
            if default is None and pack.with_defaults:
                default = bits  # the vehicle gives those that differ
            change = self.take(name, number, bits, index, default, moment, is_older=name in newer)
            if change is not None:
                changes.append(change)
        return changes

    def use_encoding(self, encoding: Encoding) -> list[Change]:
        """Read everything that was heard in another encoding; give what looks different now."""
        if encoding is self._encoding:
            return []
        self._encoding = encoding
        changes = []
        for name, raw in self._wire.items():
            old = self._held[name]
            bits, number, _, trust, place = unpack_fields(old)
            if name in self._filed:
                self._wire[name] = as_sent(bits, number, encoding)
                continue
            bits, is_raw = bits_of_wire(raw, number, encoding)
            new = self._held[name] = pack_fields(bits, number, is_raw, trust, place)
            if not same_held(old, new):
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
        """Put in what the cache knows, as *cached*; what was heard on this link stays.

        A table whose list has a name that no parameter file can hold was kept by an earlier version: that
        name is left out, and the table is downloaded anew.

        Args:
            params: the cached table.
            count: the param_count with it; with another one than was heard, nothing below counts.
            confirmed: the hash under which the vehicle would confirm it, or None.
            placed: whether its indices still hold.
            complete, volatile, volatile_known: as the attributes.
            moments: as in `fill`.
        """
        known = as_params(params)
        if any(is_listed(held) and not is_portable_name(name) for name, held in known.held.items()):
            complete = placed = False
        changes = self.fill(known, are_placed=placed and self.count in (None, count), moments=moments)
        if self.count not in (None, count):
            return changes
        self.count = count
        self.complete = complete
        if confirmed is not None:
            self.confirm(confirmed, volatile, proven=volatile_known)
            if volatile_known:
                self.rehash()  # what is in the table counts, not what stood beside it
            elif any(
                name not in self._held or not same_held(self._held[name], held)
                for name, held in known.held.items()
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
        """Put in what the cache knows, as *cached*; what was heard on this link stays.

        To that it adds the firmware's default, and an integer that the message has rounded.

        Args:
            params: the cached table.
            are_placed: whether its indices are still worth anything.
            moments: when each value was observed last, in seconds of the core's clock.
        """
        seen = {} if moments is None else moments
        changes = []
        known = as_params(params)
        for name, cached in known.held.items():
            old = self._held.get(name)
            default = known.defaults.get(name)
            if old is not None:
                if unpack_fields(old)[1] == unpack_fields(cached)[1] and name not in self._filed:
                    changes += self._complement(name, old, cached, default)
            elif is_portable_name(name) and self._room.has_some(len(self._held)):
                self._room.taken += 1
                new = with_trust_number(cached, CACHED)
                if not are_placed and is_listed(new):
                    new = self._displaced(name, new)
                self._held[name] = new
                if name in seen:
                    self._moments[name] = seen[name]
                if default is not None:
                    self._defaults[name] = default
                changes.append(self._change(name, None, new))
        return changes

    def renew(self, params: Mapping[str, Param], moments: Mapping[str, float] | None = None) -> list[Change]:
        """Take what another station has heard since, where a value is only *cached* here.

        Args:
            params: the table as it is cached now.
            moments: as in `fill`.
        """
        seen = {} if moments is None else moments
        changes = []
        for name, cached in as_params(params).held.items():
            old = self._held.get(name)
            if old is None or trust_of(old) != CACHED or name in self.dirty or same_held(old, cached):
                continue
            _, number, _, _, place = unpack_fields(old)
            is_same_type = unpack_fields(cached)[1] == number
            before = self._defaults.get(name) if is_same_type else self._defaults.pop(name, None)
            new = self._held[name] = with_index(with_trust_number(cached, CACHED), place)
            if name in seen:
                self._moments[name] = seen[name]
            self._wire.pop(name, None)  # should the vehicle say that again, it is a change
            if self._hash is not None:
                self._moved(name)
            changes.append(_new(Change, (name, old, new, "vehicle", self._defaults.get(name), before)))
        return changes

    def move(self, count: int) -> None:
        """Another count was heard: which parameter has which index is open again."""
        if self.count is not None:
            self.complete = False
            self.passed_over.clear()
            for name, held in self._held.items():
                if is_listed(held):
                    self._held[name] = self._displaced(name, held)
        self.count = count

    @property
    def is_displaced(self) -> bool:
        """Whether there are names whose index is open since the count moved."""
        held = self._held
        self.displaced = {name for name in self.displaced if name in held and not is_listed(held[name])}
        return bool(self.displaced)

    def place(self, names: Mapping[int, str]) -> None:
        """A download has settled which parameter has which index."""
        everything, passed_over = self._held, self.passed_over
        for index, name in names.items():
            held = everything.get(name)
            if held is None or (passed_over and index in passed_over.get(name, ())):
                continue
            now = with_index(held, index)
            if now != held:
                everything[name] = now
                self.dirty.setdefault(name, "vehicle")

    def settle(self, names: Mapping[int, str]) -> list[Change]:
        """A download is whole: place what it brought, and take out what the vehicle no longer has."""
        self.place(names)
        present = frozenset(names.values())
        gone = [
            name
            for name, held in self._held.items()
            if name not in present and (is_listed(held) or name in self.displaced)
        ]
        self.displaced.clear()
        return self._remove(gone)

    def present(self) -> dict[int, str]:
        """Names by index, as far as they are known under the count of now; none where two claim one index."""
        names: dict[int, str] = {}
        twice = set()
        for name, held in self._held.items():
            index = unpack_fields(held)[4]
            if index != NOWHERE and names.setdefault(index, name) != name:
                twice.add(index)
        count = self.count or 0
        return {index: name for index, name in names.items() if index < count and index not in twice}

    def verify(self) -> None:
        """The vehicle's hash has confirmed it: what is cached and counts into it becomes *verified*."""
        if not self.volatile_known:
            return  # the hash may say nothing of any of them
        for name, held in self._held.items():
            if trust_of(held) == CACHED and is_listed(held) and name not in self.volatile:
                self._held[name] = with_trust_number(held, VERIFIED)

    def doubt(self, *trusts: Trust) -> None:
        """It may have moved unheard: what was trusted like this is no more than *cached*."""
        self.doubts += Trust.LIVE in trusts
        doubted = {number_of(trust) for trust in trusts}
        for name, held in self._held.items():
            if trust_of(held) in doubted:
                self._wire.pop(name, None)  # the next value counts, also if it is the same
                self._held[name] = with_trust_number(held, CACHED)

    def doubt_value(self, name: str) -> None:
        """One value may have changed unheard: it is no more than *cached*."""
        held = self._held.get(name)
        if held is not None:
            self._wire.pop(name, None)  # the next value counts, also if it is the same
            self._held[name] = with_trust_number(held, CACHED)

    def remove(self, condition: Callable[[Param], bool]) -> list[Change]:
        """Take out the parameters that meet a condition."""
        return self._remove([param.name for param in self.params.values() if condition(param)])

    def forget(self) -> list[Change]:
        """It is another vehicle's: nothing is known of it."""
        changes = self._remove(list(self._held))
        self.unconfirm()
        self.volatile = frozenset()
        self.volatile_known = False
        self.count = None
        self.complete = False
        return changes

    def forget_defaults(self) -> None:
        """They were those of another firmware."""
        self._defaults.clear()

    @property
    def is_provable(self) -> bool:
        """Whether the vehicle's hash can prove the present values of all that it covers."""
        return self.complete and self.volatile_known and self.hash is not None

    def is_hashed(self, name: str) -> bool:
        """Whether the vehicle's hash covers a parameter, while that is known."""
        held = self._held.get(name)
        return held is not None and is_listed(held) and name not in self.volatile

    def listed_bits(self) -> dict[str, int]:
        """The bits of those that have an index, which the count and the hash are about, by name."""
        return {name: unpack_fields(held)[0] for name, held in self._held.items() if is_listed(held)}

    @property
    def size(self) -> int:
        """How many those are."""
        return sum(map(is_listed, self._held.values()))

    @property
    def only_cached(self) -> int:
        """How many of those are no more than *cached*."""
        return sum(trust_of(held) == CACHED and is_listed(held) for held in self._held.values())

    def gaps(self) -> tuple[int, tuple[int, ...]]:
        """How many parameters there should be, and the indices of those that are not known."""
        present = {unpack_fields(held)[4] for held in self._held.values()}
        present.discard(NOWHERE)
        count = len(present) if self.count is None else self.count
        return count, tuple(index for index in range(count) if index not in present)

    def unhashed(self) -> set[str]:
        """The names that the hash says nothing about: the volatile ones, or any while those are not known."""
        return set(self.volatile) if self.volatile_known else set(self.listed_bits())

    def take_dirty(self) -> dict[str, str]:
        """Names that changed since the last call, each with who did it; gone names too."""
        dirty, self.dirty = self.dirty, {}
        return dirty

    def take_overwritten(self) -> list[Observation]:
        """Return the observations since the last call that are not the latest of their parameter.

        A value that changed and was heard again is among them with the moment of the change.
        """
        overwritten, self.overwritten = self.overwritten, []
        changed, self._changed = self._changed, {}
        for name, (moment, by) in changed.items():
            if name in self._held and moment < self._moments[name]:
                overwritten.append(Observation(self.params[name], by, moment))
        return overwritten

    @property
    def changed(self) -> dict[str, tuple[float, str]]:
        """When each value has changed since `take_overwritten` was called last, and by whom."""
        return self._changed.copy()

    def give_back(
        self,
        dirty: Mapping[str, str],
        overwritten: Sequence[Observation],
        gone: Mapping[str, float],
        changed: Mapping[str, tuple[float, str]],
        params: Params,
    ) -> None:
        """Take back what the cache was to be told and was not: it is news again, with its moments.

        A value that was replaced meanwhile is kept in `overwritten`.

        Args:
            dirty, overwritten, gone, changed: as they were taken.
            params: the dirty parameters as they were then.
        """
        replaced = []
        for name, by in dirty.items():
            heard_at = params.moments.get(name)
            if heard_at is None or name not in params.held:
                continue
            if name in self._changed or name not in self._held:
                replaced.append(Observation(params[name], by, heard_at))
            elif changed.get(name, (math.inf, ""))[0] == heard_at:  # else `overwritten` has it
                self._changed[name] = changed[name]
        self.dirty = {**dirty, **self.dirty}
        self.overwritten = [*overwritten, *replaced, *self.overwritten][-MOST_OVERWRITTEN:]
        self.gone = {**gone, **self.gone}

    def take_gone(self) -> dict[str, float]:
        """Return the moments at which names removed since the last call were found missing."""
        gone, self.gone = self.gone, {}
        return gone

    def age(self, seconds: float) -> None:
        """Move every moment back by time that has passed but that the core's clock has left out.

        Args:
            seconds: of sleep of this computer, see `Station.stood_still`.
        """
        if not seconds:
            return
        for moments in (self._moments, self.gone):
            moments.update({name: moment - seconds for name, moment in moments.items()})
        self._changed = {name: (moment - seconds, by) for name, (moment, by) in self._changed.items()}
        self.overwritten = [each._replace(moment=each.moment - seconds) for each in self.overwritten]
        self._latest -= seconds
        self.slept += seconds

    def _remove(self, names: Collection[str]) -> list[Change]:
        """Take out these."""
        changes = []
        for name in names:
            held = self._held.pop(name)
            default = self._defaults.pop(name, None)
            self._wire.pop(name, None)
            self._filed.discard(name)
            self._moments.pop(name, None)
            self._changed.pop(name, None)
            if name in self.dirty or len(self.dirty) < MOST_GONE:
                self.dirty[name] = "vehicle"
                if self._latest > -math.inf:
                    self.gone[name] = self._latest
            if self._hash is not None:
                self._moved(name)
            changes.append(_new(Change, (name, held, None, "vehicle", None, default)))
        self._room.taken -= len(changes)
        return changes

    def _set_default(self, name: str, default: Value | None) -> None:
        if default is None:
            self._defaults.pop(name, None)
        else:
            self._defaults[name] = default

    def _change(self, name: str, old: Held | None, new: Held) -> Change:
        default = self._defaults.get(name)
        return _new(Change, (name, old, new, "vehicle", default, default))

    def _news(self, name: str, old: Held | None, by: str, default: Value | None, seen_at: float) -> None:
        """Note that a value has changed, at the moment that the table has of it by now.

        The cache is told of each value that our writes have set, however short it stood, and of what they
        replaced; with `keeps_all`, of each value.

        Args:
            name, by: the parameter and the author of the change.
            old, default: what it was, and the default of its type then; None where it is new.
            seen_at: the moment at which it was observed last as it was.
        """
        before = self.dirty.get(name)
        if old is not None:
            if before is not None and (self.keeps_all or is_ours(before) or is_ours(by)):
                since, author = self._changed.get(name, (seen_at, before))
                param = param_of(name, old, default)
                if since < seen_at:
                    self.overwritten.append(Observation(param, author, since))
                self.overwritten.append(Observation(param, before, seen_at))
                del self.overwritten[:-MOST_OVERWRITTEN]
            self._changed[name] = (self._moments[name], by)
        self.dirty[name] = by

    def _complement(self, name: str, heard: Held, cached: Held, default: Value | None) -> list[Change]:
        """Add to what was heard what its message does not say."""
        bits, number, is_raw, trust, place = unpack_fields(heard)
        if self._rounds(cached, self._wire.get(name, b"")):
            bits, _, is_raw, *_ = unpack_fields(cached)
        if default is not None and name not in self._defaults:
            self._defaults[name] = default
            self.dirty.setdefault(name, "vehicle")
        new = self._held[name] = pack_fields(bits, number, is_raw, trust, place)
        if same_held(heard, new):
            return []
        self.dirty.setdefault(name, "vehicle")
        return [self._change(name, heard, new)]

    def _rounds(self, known: Held, raw: bytes) -> bool:
        """Whether a message rounds what is known exactly: an integer beyond the 24 bits of a float32."""
        if self._encoding is not Encoding.C_CAST:
            return False
        bits, number, is_raw, *_ = unpack_fields(known)
        value = from_bits(bits, number, is_raw=is_raw)
        return isinstance(value, int) and abs(value) > _EXACT and as_sent(bits, number, self._encoding) == raw

    def _displaced(self, name: str, held: Held) -> Held:
        self.displaced.add(name)
        return with_index(held, NOWHERE)

    def _moved(self, name: str) -> None:
        if name in self.volatile:
            return
        if self.volatile_known:
            self._hash_is_stale = True
        else:
            self._hash = None
