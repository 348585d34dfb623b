"""The parameters of one component as they are known now, by name, each with how far it can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

from paramclient.protocol.authors import is_ours
from paramclient.protocol.wire import MOST_PARAMETERS, NO_INDEX, ParamValue
from paramclient.values import Encoding, Param, Trust, Value, as_sent, decode, from_bits, known_type, px4_hash

__all__ = ["MOST_NAMES", "Change", "Room", "Table"]

MOST_NAMES: Final = 65_535
"""Names that one table may hold: as many as can have an index, and as many again of parameters that are not
in use and have none. A component that invents further ones is ill."""

ENOUGH_NAMES: Final = 2_000
"""Names that every table may hold, whatever the others of its link do: more than autopilots have."""
MOST_NAMES_OF_LINK: Final = 400_000
"""Names that all tables of one link may hold together before each is held to `ENOUGH_NAMES`: 250 vehicles
with 1,600 parameters each. A name takes about half a kilobyte."""
MOST_OVERWRITTEN: Final = 1_024
"""What we wrote and was replaced before the cache was told: some tens fit between two writes to the disk."""
MOST_GONE: Final = MOST_NAMES
"""Names that have changed or gone and wait to be told to the cache, above which further gone ones are not
told: the next whole table that is kept is without them."""

_EXACT = 1 << 24  # up to here every integer is a float32
_LIVE = Trust.LIVE  # each look into an enumeration takes a tenth of what a value takes here
_KNOWN_TYPES = tuple(map(known_type, range(256)))
_new = tuple.__new__  # what a named tuple's own constructor ends in, after twice the time


class Change(NamedTuple):
    """One parameter that appeared, changed its value or went away. A named tuple: each first value makes one.

    Attributes:
        name: param_id.
        old: what was known before, or None when the parameter is new.
        new: what is known now, or None when the vehicle no longer has it.
        by: "us" (our own `set`), "us for NAME" (one for which it was told who asked), "vehicle", or "station
            S/C" when another station was heard setting it.
    """

    name: str
    old: Param | None
    new: Param | None
    by: str = "vehicle"


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


class Table:
    """All that is known of a component's parameters.

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
        overwritten: what writes of ours had made of them or have replaced, and is no more; each with who did
            it.
    """

    def __init__(self, encoding: Encoding = Encoding.BYTEWISE, room: Room | None = None) -> None:
        self._room = Room() if room is None else room
        self.params: dict[str, Param] = {}
        self.count: int | None = None
        self.volatile: frozenset[str] = frozenset()
        self.volatile_known = False
        self.complete = False
        self.displaced: set[str] = set()
        self.doubts = 0
        self.passed_over: dict[str, frozenset[int]] = {}
        self.dirty: dict[str, str] = {}
        self.overwritten: list[tuple[Param, str]] = []
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
            self._hash = px4_hash(self.listed(), leave_out=self.volatile)
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

    def unconfirm(self) -> None:
        """No hash is known to belong to this table any more."""
        self._hash = None
        self._hash_is_stale = False

    def rehash(self) -> None:
        """Values may have moved under the confirmed hash: compute it again when it is asked for."""
        self._hash_is_stale = self._hash is not None

    def hear(self, message: ParamValue, by: str, *, is_exact: bool = False) -> Change | None:
        """Take one PARAM_VALUE; give the change if it brought one (a first value is one).

        The value counts whatever the index says. An index of 65535 leaves the known one as it is, one that
        is not below the count is no index.

        Args:
            message: what came.
            by: who did it, as in `Change`.
            is_exact: whether it says what was just written, so that it cannot stand for an integer that it
                would round.
        """
        name, raw, number, count, given = message
        index: int | None = given
        if self.passed_over and given in self.passed_over.get(name, ()):
            return None
        params = self.params
        old = params.get(name)
        if given == NO_INDEX:
            index = None if old is None else old.index
        elif count > MOST_PARAMETERS or given >= count:
            index = None
        if old is None:
            if not self._room.has_some(len(params)):
                return None
            self._room.taken += 1
        elif old.type == number and self._wire.get(name) == raw and not is_exact:
            if old.index != index:
                params[name] = Param(name, old.value, old.type, index, old.bits, Trust.LIVE, old.default)
                self.dirty.setdefault(name, by)
            return None
        value, bits = decode(raw, number, self._encoding)
        default: Value | None = None
        is_rounded = False
        if old is not None and old.type == number:
            default = old.default
            is_rounded = not is_exact and self._rounds(old, raw)
        if is_rounded and old is not None:
            value, bits = old.value, old.bits
        elif self._filed:
            self._filed.discard(name)
        new = params[name] = Param(name, value, _KNOWN_TYPES[number], index, bits, _LIVE, default)
        self._wire[name] = raw
        if old is not None and old.same_value(new):
            if old.index != index:
                self.dirty.setdefault(name, by)
            return None
        if old is None:  # the short way for a first value
            self.dirty[name] = by
        else:
            self._news(name, old, by)
        if self._hash is not None:
            self._moved(name)
        return _new(Change, (name, old, new, by))

    def take(
        self, name: str, number: int, bits: int, index: int, default: int | None, *, is_older: bool
    ) -> Change | None:
        """Take one entry of a packed parameter file; give the change if it brought one.

        Its integers are exact, also where a PARAM_VALUE rounds them.

        Args:
            name, number: param_id and type.
            bits, default: the value and the firmware's default, as in `Param.bits`.
            index: its place in the list.
            is_older: whether a PARAM_VALUE of it was heard since the file was asked for: then that counts,
                unless it rounds what the file says.
        """
        kind = known_type(number)
        initial = None if default is None else from_bits(default, number)
        old = self.params.get(name)
        if old is None:
            if not self._room.has_some(len(self.params)):
                return None
            self._room.taken += 1
        raw = as_sent(bits, number, self._encoding)
        if is_older and old is not None and (old.type != number or self._wire.get(name) != raw):
            self.params[name] = replace(old, index=index, default=initial)
            self.dirty.setdefault(name, "vehicle")
            return None
        new = self.params[name] = Param(name, from_bits(bits, number), kind, index, bits, _LIVE, initial)
        self._wire[name] = raw
        self._filed.add(name)
        if old is None or old.index != index or old.default != initial:
            self.dirty.setdefault(name, "vehicle")
        if old is not None and old.same_value(new):
            return None
        self._news(name, old, "vehicle")
        self._moved(name)
        return Change(name, old, new)

    def use_encoding(self, encoding: Encoding) -> list[Change]:
        """Read everything that was heard in another encoding; give what looks different now."""
        if encoding is self._encoding:
            return []
        self._encoding = encoding
        changes = []
        for name, raw in self._wire.items():
            old = self.params[name]
            if name in self._filed:
                self._wire[name] = as_sent(old.bits, old.type, encoding)
                continue
            value, bits = decode(raw, old.type, encoding)
            new = Param(name, value, old.type, old.index, bits, old.trust, old.default)
            self.params[name] = new
            if not old.same_value(new):
                self.dirty.setdefault(name, "vehicle")
                changes.append(Change(name, old, new))
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
    ) -> list[Change]:
        """Put in what the cache knows, as *cached*; what was heard on this link stays.

        Args:
            params: the cached table.
            count: the param_count with it; with another one than was heard, nothing below counts.
            confirmed: the hash under which the vehicle would confirm it, or None.
            placed: whether its indices still hold.
            complete, volatile, volatile_known: as the attributes.
        """
        changes = self.fill(params, placed=placed and self.count in (None, count))
        if self.count not in (None, count):
            return changes
        self.count = count
        self.complete = complete
        if confirmed is not None:
            self.confirm(confirmed, volatile, proven=volatile_known)
            if volatile_known:
                self.rehash()  # what is in the table counts, not what stood beside it
            elif any(
                name not in self.params or not self.params[name].same_value(param)
                for name, param in params.items()
                if name not in volatile
            ):
                self.unconfirm()
        return changes

    def fill(self, params: Mapping[str, Param], *, placed: bool = True) -> list[Change]:
        """Put in what the cache knows, as *cached*; what was heard on this link stays.

        To that it adds the firmware's default, and an integer that the message has rounded.

        Args:
            params: the cached table.
            placed: whether its indices are still worth anything.
        """
        changes = []
        for name, param in params.items():
            old = self.params.get(name)
            if old is not None:
                if old.type == param.type and name not in self._filed:
                    changes += self._complement(old, param)
            elif self._room.has_some(len(self.params)):
                self._room.taken += 1
                new = param.with_trust(Trust.CACHED)
                if not placed and new.index is not None:
                    new = self._displaced(new)
                self.params[name] = new
                changes.append(Change(name, None, new))
        return changes

    def renew(self, params: Mapping[str, Param]) -> list[Change]:
        """Take what another station has heard since, where a value is only *cached* here.

        Args:
            params: the table as it is cached now.
        """
        changes = []
        for name, param in params.items():
            old = self.params.get(name)
            if old is None or old.trust is not Trust.CACHED or name in self.dirty or old.same_value(param):
                continue
            new = replace(param.with_trust(Trust.CACHED), index=old.index, default=old.default)
            self.params[name] = new
            self._wire.pop(name, None)  # should the vehicle say that again, it is a change
            if self._hash is not None:
                self._moved(name)
            changes.append(Change(name, old, new))
        return changes

    def move(self, count: int) -> None:
        """Another count was heard: which parameter has which index is open again."""
        if self.count is not None:
            self.complete = False
            self.passed_over.clear()
            for param in self.listed():
                self.params[param.name] = self._displaced(param)
        self.count = count

    @property
    def is_displaced(self) -> bool:
        """Whether there are names whose index is open since the count moved."""
        params = self.params
        self.displaced = {name for name in self.displaced if name in params and params[name].index is None}
        return bool(self.displaced)

    def place(self, names: Mapping[int, str]) -> None:
        """A download has settled which parameter has which index."""
        for index, name in names.items():
            param = self.params.get(name)
            if index in self.passed_over.get(name, ()):
                continue
            if param is not None and param.index != index:
                self.params[name] = replace(param, index=index)
                self.dirty.setdefault(name, "vehicle")

    def settle(self, names: Mapping[int, str]) -> list[Change]:
        """A download is whole: place what it brought, and take out what the vehicle no longer has."""
        self.place(names)
        present = frozenset(names.values())
        gone = self.remove(
            lambda param: (
                param.name not in present and (param.index is not None or param.name in self.displaced)
            )
        )
        self.displaced.clear()
        return gone

    def present(self) -> dict[int, str]:
        """Names by index, as far as they are known under the count of now; none where two claim one index."""
        names: dict[int, str] = {}
        twice = set()
        for param in self.listed():
            assert param.index is not None
            if names.setdefault(param.index, param.name) != param.name:
                twice.add(param.index)
        count = self.count or 0
        return {index: name for index, name in names.items() if index < count and index not in twice}

    def verify(self) -> None:
        """The vehicle's hash has confirmed it: what is cached and counts into it becomes *verified*."""
        unhashed = self.unhashed()
        for param in self.listed():
            if param.trust is Trust.CACHED and param.name not in unhashed:
                self.params[param.name] = param.with_trust(Trust.VERIFIED)

    def doubt(self, *trusts: Trust) -> None:
        """It may have moved unheard: what was trusted like this is no more than *cached*."""
        self.doubts += Trust.LIVE in trusts
        for name, param in self.params.items():
            if param.trust in trusts:
                self._wire.pop(name, None)  # the next value counts, also if it is the same
                self.params[name] = param.with_trust(Trust.CACHED)

    def remove(self, condition: Callable[[Param], bool]) -> list[Change]:
        """Take out the parameters that meet a condition."""
        gone = [param for param in self.params.values() if condition(param)]
        for param in gone:
            del self.params[param.name]
            self._wire.pop(param.name, None)
            self._filed.discard(param.name)
            if param.name in self.dirty or len(self.dirty) < MOST_GONE:
                self.dirty[param.name] = "vehicle"
            if self._hash is not None:
                self._moved(param.name)
        self._room.taken -= len(gone)
        return [Change(param.name, param, None) for param in gone]

    def forget(self) -> list[Change]:
        """It is another vehicle's: nothing is known of it."""
        changes = self.remove(lambda param: True)
        self.unconfirm()
        self.volatile = frozenset()
        self.volatile_known = False
        self.count = None
        self.complete = False
        return changes

    def forget_defaults(self) -> None:
        """They were those of another firmware."""
        for name, param in self.params.items():
            if param.default is not None:
                self.params[name] = replace(param, default=None)

    def listed(self) -> list[Param]:
        """The parameters that have an index: those that the count and the hash are about."""
        return [param for param in self.params.values() if param.index is not None]

    def gaps(self) -> tuple[int, tuple[int, ...]]:
        """How many parameters there should be, and the indices of those that are not known."""
        present = {param.index for param in self.listed()}
        count = len(present) if self.count is None else self.count
        return count, tuple(index for index in range(count) if index not in present)

    def unhashed(self) -> set[str]:
        """The names that the hash says nothing about: the volatile ones, or any while those are not known."""
        return set(self.volatile) if self.volatile_known else {param.name for param in self.listed()}

    def take_dirty(self) -> dict[str, str]:
        """Names that changed since the last call, each with who did it; gone names too."""
        dirty, self.dirty = self.dirty, {}
        return dirty

    def take_overwritten(self) -> list[tuple[Param, str]]:
        """Values of ours that have come and gone since the last call, each with who did it."""
        overwritten, self.overwritten = self.overwritten, []
        return overwritten

    def _news(self, name: str, old: Param | None, by: str) -> None:
        """A value has changed. What was written for somebody is told of, however short it stood, and with
        what it has replaced, however short that was known."""
        before = self.dirty.get(name)
        if old is not None and before is not None and (is_ours(before) or is_ours(by)):
            self.overwritten.append((old, before))
            del self.overwritten[:-MOST_OVERWRITTEN]
        self.dirty[name] = by

    def _complement(self, heard: Param, cached: Param) -> list[Change]:
        """Add to what was heard what its message does not say."""
        new = heard if heard.default is not None else replace(heard, default=cached.default)
        if self._rounds(cached, self._wire.get(heard.name, b"")):
            new = replace(new, value=cached.value, bits=cached.bits)
        self.params[heard.name] = new
        if new.default != heard.default:
            self.dirty.setdefault(heard.name, "vehicle")
        if heard.same_value(new):
            return []
        self.dirty.setdefault(heard.name, "vehicle")
        return [Change(heard.name, heard, new)]

    def _rounds(self, known: Param, raw: bytes) -> bool:
        """Whether a message rounds what is known exactly: an integer beyond the 24 bits of a float32."""
        return (
            self._encoding is Encoding.C_CAST
            and isinstance(known.value, int)
            and abs(known.value) > _EXACT
            and as_sent(known.bits, known.type, self._encoding) == raw
        )

    def _displaced(self, param: Param) -> Param:
        self.displaced.add(param.name)
        return replace(param, index=None)

    def _moved(self, name: str) -> None:
        if name in self.volatile:
            return
        if self.volatile_known:
            self._hash_is_stale = True
        else:
            self._hash = None
