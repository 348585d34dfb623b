"""The compact form of parameters in tables, and the read-only mapping that users see.

A table stores each parameter as a few bytes, and makes a `Param` on access. Python's garbage collector
traverses every object that can be part of a cycle, including `Param` and tuples: with the tables of 250
vehicles, collections blocked the process for up to 80 ms. The collector skips bytes, and
dictionaries of bytes.
"""

from __future__ import annotations

import struct
from collections.abc import ItemsView, Iterable, Iterator, Mapping, MutableMapping, ValuesView
from typing import Final, TypeAlias, TypeVar, overload

from paramclient.model.defaults import add_default
from paramclient.model.similar_names import unknown_name
from paramclient.model.values import Param, Trust, WireValue, from_bits, known_type, same_bits
from paramclient.model.wording import counted

__all__ = [
    "CACHED",
    "LIVE",
    "COMPACT_NO_INDEX",
    "VERIFIED",
    "CompactParam",
    "ParamMap",
    "Params",
    "compact_param",
    "is_listed",
    "as_params",
    "number_of",
    "param_of",
    "unpack_fields",
    "has_index",
    "with_index",
    "same_compact",
    "pack_fields",
    "trust_of",
    "with_trust_number",
]

CompactParam: TypeAlias = bytes
"""A parameter in compact form, without name and default; see `pack_fields` and `unpack_fields`."""

LIVE: Final = 0
"""`Trust.LIVE` in the compact form."""
VERIFIED: Final = 1
"""`Trust.VERIFIED` in the compact form."""
CACHED: Final = 2
"""`Trust.CACHED` in the compact form."""
COMPACT_NO_INDEX: Final = -1
"""The index, in the compact form, of a parameter without an index."""

_LAYOUT = struct.Struct("<QBBBi")
pack_fields = _LAYOUT.pack
"""Pack bits, the number of the type, whether the value is raw bytes, the number of the trust, the index."""
unpack_fields = _LAYOUT.unpack
"""Unpack the fields that `pack_fields` takes."""
_TRUST_AT: Final = 10
"""Offset of the trust in the compact form, in bytes."""
_INDEX_AT: Final = 11
"""Offset of the index in the compact form, in bytes."""
_NO_INDEX: Final = COMPACT_NO_INDEX.to_bytes(4, "little", signed=True)
_TRUSTS: Final = (Trust.LIVE, Trust.VERIFIED, Trust.CACHED)
_NUMBERS: Final = {trust: number for number, trust in enumerate(_TRUSTS)}
_KNOWN_TYPES: Final = tuple(map(known_type, range(256)))


class Params(MutableMapping[str, Param]):
    """Parameters by name, in the order of insertion. Each `Param` is made on access.

    Attributes:
        compact: the compact form, by name.
        defaults: the firmware's defaults that are known, by name.
        moments: when each value was last observed, by name, in seconds of the clock of the table's owner.
            Names without a known time are absent.
    """

    __slots__ = ("compact", "defaults", "moments")

    def __init__(
        self,
        compact: dict[str, CompactParam] | None = None,
        defaults: dict[str, WireValue] | None = None,
        moments: dict[str, float] | None = None,
    ) -> None:
        self.compact: dict[str, CompactParam] = {} if compact is None else compact
        self.defaults: dict[str, WireValue] = {} if defaults is None else defaults
        self.moments: dict[str, float] = {} if moments is None else moments

    def __getitem__(self, name: str) -> Param:
        return param_of(name, self.compact[name], self.defaults.get(name))

    def __setitem__(self, name: str, param: Param) -> None:
        self.compact[name] = compact_param(param)
        if param.default is None:
            self.defaults.pop(name, None)
        else:
            self.defaults[name] = param.default

    def __delitem__(self, name: str) -> None:
        del self.compact[name]
        self.defaults.pop(name, None)
        self.moments.pop(name, None)

    def __contains__(self, name: object) -> bool:
        return name in self.compact

    def __iter__(self) -> Iterator[str]:
        return iter(self.compact)

    def __len__(self) -> int:
        return len(self.compact)

    def values(self) -> ValuesView[Param]:
        """Return a view of the parameters, each made when the iteration reaches it."""
        return _Values(self)

    def items(self) -> ItemsView[str, Param]:
        """Return a view of names and parameters, each made when the iteration reaches it."""
        return _Items(self)

    def copy(self) -> Params:
        """Return a copy of the table."""
        return Params(self.compact.copy(), self.defaults.copy(), self.moments.copy())

    def only(self, names: Iterable[str]) -> Params:
        """Return a copy with only those of these names that the table has."""
        compact, defaults, moments = self.compact, self.defaults, self.moments
        known = [name for name in names if name in compact]
        return Params(
            {name: compact[name] for name in known},
            {name: defaults[name] for name in known if name in defaults} if defaults else None,
            {name: moments[name] for name in known if name in moments},
        )

    def __repr__(self) -> str:
        return f"Params({dict(self)!r})"


class _Values(ValuesView[Param]):
    """The parameters of a `Params`, without one look-up for each name."""

    _mapping: Params

    def __iter__(self) -> Iterator[Param]:
        default_of = self._mapping.defaults.get
        return (param_of(name, compact, default_of(name)) for name, compact in self._mapping.compact.items())


class _Items(ItemsView[str, Param]):
    """The names and parameters of a `Params`, without one look-up for each name."""

    _mapping: Params

    def __iter__(self) -> Iterator[tuple[str, Param]]:
        return zip(self._mapping.compact, self._mapping.values(), strict=True)


def as_params(params: Mapping[str, Param]) -> Params:
    """Return parameters as a `Params`: the argument or the table behind a `ParamMap`, otherwise a copy."""
    shown = params._params if isinstance(params, ParamMap) else params
    if isinstance(shown, Params):
        return shown
    made = Params()
    made.update(shown)
    return made


def compact_param(param: Param) -> CompactParam:
    """Return a parameter in compact form."""
    index = COMPACT_NO_INDEX if param.index is None else param.index
    return pack_fields(param.bits, param.type_number, param.is_raw, number_of(param.trust), index)


def number_of(trust: Trust) -> int:
    """Return the number of a trust in the compact form."""
    return _NUMBERS[trust]


def param_of(name: str, compact: CompactParam, default: WireValue | None = None) -> Param:
    """Return the `Param` of a compact parameter."""
    bits, number, is_raw, trust, place = unpack_fields(compact)
    value = from_bits(bits, number, is_raw=is_raw)
    index = None if place == COMPACT_NO_INDEX else place
    return Param(name, value, _KNOWN_TYPES[number], index, bits, _TRUSTS[trust], default)


def trust_of(compact: CompactParam) -> int:
    """Return the number of a compact parameter's trust."""
    return compact[_TRUST_AT]


def with_trust_number(compact: CompactParam, trust: int) -> CompactParam:
    """Return a compact parameter with another trust."""
    return compact[:_TRUST_AT] + bytes((trust,)) + compact[_INDEX_AT:]


def is_listed(compact: CompactParam) -> bool:
    """Return whether a compact parameter has an index."""
    return compact[_INDEX_AT:] != _NO_INDEX


def has_index(compact: CompactParam, place: int) -> bool:
    """Return whether a compact parameter has this index."""
    place_of: int = unpack_fields(compact)[4]
    return place_of == place


def with_index(compact: CompactParam, place: int) -> CompactParam:
    """Return a compact parameter with another index."""
    return compact[:_INDEX_AT] + place.to_bytes(4, "little", signed=True)


def same_compact(one: CompactParam, other: CompactParam) -> bool:
    """Return whether both have the same value in the same type, as `Param.same_value` defines it."""
    if one[:_TRUST_AT] == other[:_TRUST_AT]:
        return True
    bits, number, is_raw, *_ = unpack_fields(one)
    bits2, number2, is_raw2, *_ = unpack_fields(other)
    return (number, is_raw) == (number2, is_raw2) and same_bits(number, bits, bits2)


T = TypeVar("T")


class ParamMap(Mapping[str, Param]):
    """Parameters by name: a read-only view of a table that may still change.

    Copy the view, `dict(params)`, before iterating over it across an `await`: names may be added and removed
    meanwhile.

    Args:
        params: the table. It is not copied; its order is kept.
    """

    __slots__ = ("_params",)

    def __init__(self, params: Mapping[str, Param]) -> None:
        self._params = params

    def __getitem__(self, name: str) -> Param:
        try:
            return self._params[name]
        except KeyError:
            raise unknown_name(name, self._params, among=True) from None

    @overload
    def get(self, name: str, /) -> Param | None: ...
    @overload
    def get(self, name: str, default: Param, /) -> Param: ...
    @overload
    def get(self, name: str, default: T, /) -> Param | T: ...
    def get(self, name: str, default: Param | T | None = None, /) -> Param | T | None:
        """Return the parameter with this name, or `default`."""
        return self._params.get(name, default)

    def __contains__(self, name: object) -> bool:
        return name in self._params

    def __iter__(self) -> Iterator[str]:
        return iter(self._params)

    def __len__(self) -> int:
        return len(self._params)

    def changed(self, defaults: Mapping[str, WireValue] | None = None) -> dict[str, Param]:
        """Return a copy of the parameters whose value differs from the firmware's default.

        Parameters without a known default are left out.

        Args:
            defaults: defaults of parameters whose default the vehicle has not given (see `Param.default`), by
                name, such as `Metadata.defaults_of`. They become the `default` of the returned parameters.
        """
        described = defaults or {}
        known = (add_default(param, described.get(name)) for name, param in self._params.items())
        return {param.name: param for param in known if param.is_changed}

    def __repr__(self) -> str:
        count = len(self._params)
        return f"<ParamMap {counted(count, 'param')}>"
