"""Parameters by name: how tables keep them, and the read-only mapping in which users see them.

A table keeps each parameter as a few bytes, and makes a `Param` of it when it is asked for. Python's garbage
collector goes through every object that might be part of a cycle, a `Param` or a tuple too: with the tables
of 250 vehicles it took up to 80 ms at a time, in which nothing else was done. Bytes, and dictionaries of
them, it leaves out.
"""

from __future__ import annotations

import struct
from collections.abc import ItemsView, Iterable, Iterator, Mapping, MutableMapping, ValuesView
from typing import Final, TypeAlias

from paramclient.model.values import Param, Trust, Value, from_bits, known_type, same_bits

__all__ = [
    "CACHED",
    "LIVE",
    "NOWHERE",
    "VERIFIED",
    "Held",
    "ParamMap",
    "Params",
    "copy_params",
    "held_of",
    "is_listed",
    "iter_parts",
    "kept",
    "number_of",
    "param_of",
    "parts_of",
    "placed",
    "same_held",
    "to_hold",
    "trust_of",
    "trusted",
]

Held: TypeAlias = bytes
"""A parameter as it is kept, without its name and default: what `to_hold` makes and `parts_of` reads."""

LIVE: Final = 0
VERIFIED: Final = 1
CACHED: Final = 2
"""The numbers of `Trust` in it."""
NOWHERE: Final = -1
"""The place of a parameter without an index."""

_LAYOUT = struct.Struct("<QBBBi")
to_hold = _LAYOUT.pack
"""Bits, the number of the type, whether it stays raw bytes, the number of the trust, and the place."""
parts_of = _LAYOUT.unpack
"""The same, from what is kept."""
iter_parts = _LAYOUT.iter_unpack
"""The same of many, whose bytes follow each other."""
_TRUST_AT: Final = 10
_PLACE_AT: Final = 11
_NO_PLACE: Final = NOWHERE.to_bytes(4, "little", signed=True)
_TRUSTS: Final = (Trust.LIVE, Trust.VERIFIED, Trust.CACHED)
_NUMBERS: Final = {trust: number for number, trust in enumerate(_TRUSTS)}
_KNOWN_TYPES: Final = tuple(map(known_type, range(256)))


class Params(MutableMapping[str, Param]):
    """Parameters by name, in the order in which they were put in first, each made when it is asked for.

    Attributes:
        held: what is kept, by name.
        defaults: the firmware's defaults, by the names of those of which they are known.
        moments: when each value was observed last, by name, in seconds of the clock of whoever fills this;
            without the names of which that is not known.
    """

    __slots__ = ("defaults", "held", "moments")

    def __init__(
        self,
        held: dict[str, Held] | None = None,
        defaults: dict[str, Value] | None = None,
        moments: dict[str, float] | None = None,
    ) -> None:
        self.held: dict[str, Held] = {} if held is None else held
        self.defaults: dict[str, Value] = {} if defaults is None else defaults
        self.moments: dict[str, float] = {} if moments is None else moments

    def __getitem__(self, name: str) -> Param:
        return param_of(name, self.held[name], self.defaults.get(name))

    def __setitem__(self, name: str, param: Param) -> None:
        self.held[name] = held_of(param)
        if param.default is None:
            self.defaults.pop(name, None)
        else:
            self.defaults[name] = param.default

    def __delitem__(self, name: str) -> None:
        del self.held[name]
        self.defaults.pop(name, None)
        self.moments.pop(name, None)

    def __contains__(self, name: object) -> bool:
        return name in self.held

    def __iter__(self) -> Iterator[str]:
        return iter(self.held)

    def __len__(self) -> int:
        return len(self.held)

    def values(self) -> ValuesView[Param]:
        """Each parameter, made as it is come to."""
        return _Values(self)

    def items(self) -> ItemsView[str, Param]:
        """Each name with its parameter, made as it is come to."""
        return _Items(self)

    def copy(self) -> Params:
        """The same parameters, as they are now."""
        return Params(self.held.copy(), self.defaults.copy(), self.moments.copy())

    def only(self, names: Iterable[str]) -> Params:
        """Those of these names that there are, as they are now."""
        held, defaults, moments = self.held, self.defaults, self.moments
        known = [name for name in names if name in held]
        return Params(
            {name: held[name] for name in known},
            {name: defaults[name] for name in known if name in defaults} if defaults else None,
            {name: moments[name] for name in known if name in moments},
        )

    def __repr__(self) -> str:
        return f"Params({dict(self)!r})"


class _Values(ValuesView[Param]):
    """The parameters of a `Params`, without a look for each name."""

    _mapping: Params

    def __iter__(self) -> Iterator[Param]:
        default_of = self._mapping.defaults.get
        return (param_of(name, held, default_of(name)) for name, held in self._mapping.held.items())


class _Items(ItemsView[str, Param]):
    """The same with their names."""

    _mapping: Params

    def __iter__(self) -> Iterator[tuple[str, Param]]:
        return zip(self._mapping.held, self._mapping.values(), strict=True)


def kept(params: Mapping[str, Param]) -> Params:
    """Parameters as a table keeps them: these themselves where they are kept so, or are shown by a view."""
    shown = params._params if isinstance(params, ParamMap) else params
    if isinstance(shown, Params):
        return shown
    made = Params()
    made.update(shown)
    return made


def copy_params(params: Mapping[str, Param]) -> Mapping[str, Param]:
    """Return a copy of a table, for another thread to read. Makes no `Param`: 0.5 ms for 10,000 names."""
    shown = params._params if isinstance(params, ParamMap) else params
    return shown.copy() if isinstance(shown, Params) else dict(shown)


def held_of(param: Param) -> Held:
    """A parameter as it is kept."""
    place = NOWHERE if param.index is None else param.index
    return to_hold(param.bits, param.type, isinstance(param.value, bytes), number_of(param.trust), place)


def number_of(trust: Trust) -> int:
    """The number of a trust in what is kept."""
    return _NUMBERS[trust]


def param_of(name: str, held: Held, default: Value | None = None) -> Param:
    """The parameter that is kept like this."""
    bits, number, is_raw, trust, place = parts_of(held)
    value = from_bits(bits, number, is_raw=is_raw)
    index = None if place == NOWHERE else place
    return Param(name, value, _KNOWN_TYPES[number], index, bits, _TRUSTS[trust], default)


def trust_of(held: Held) -> int:
    """The number of its trust."""
    return held[_TRUST_AT]


def trusted(held: Held, trust: int) -> Held:
    """The same parameter, trusted like this."""
    return held[:_TRUST_AT] + bytes((trust,)) + held[_PLACE_AT:]


def is_listed(held: Held) -> bool:
    """Whether it has an index."""
    return held[_PLACE_AT:] != _NO_PLACE


def placed(held: Held, place: int) -> Held:
    """The same parameter at this place."""
    return held[:_PLACE_AT] + place.to_bytes(4, "little", signed=True)


def same_held(one: Held, other: Held) -> bool:
    """Whether both hold the same value in the same type, as `Param.same_value` says it."""
    if one[:_TRUST_AT] == other[:_TRUST_AT]:
        return True
    bits, number, is_raw, *_ = parts_of(one)
    bits2, number2, is_raw2, *_ = parts_of(other)
    return (number, is_raw) == (number2, is_raw2) and same_bits(number, bits, bits2)


class ParamMap(Mapping[str, Param]):
    """Parameters by name: a read-only view of a table that may go on changing.

    Take a copy, `dict(params)`, to iterate over it across an `await`: names may come and go meanwhile.

    Args:
        params: what to show. It is not copied; its order is kept.
    """

    __slots__ = ("_params",)

    def __init__(self, params: Mapping[str, Param]) -> None:
        self._params = params

    def __getitem__(self, name: str) -> Param:
        return self._params[name]

    def __contains__(self, name: object) -> bool:
        return name in self._params

    def __iter__(self) -> Iterator[str]:
        return iter(self._params)

    def __len__(self) -> int:
        return len(self._params)

    def changed(self) -> dict[str, Param]:
        """Those whose value differs from the firmware's default, by name: a copy.

        None where the vehicle has not said what its defaults are (see `Param.default`).
        """
        return {name: param for name, param in self._params.items() if param.is_changed}

    def __repr__(self) -> str:
        count = len(self._params)
        return f"<ParamMap {count} {'param' if count == 1 else 'params'}>"
