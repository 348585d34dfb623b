"""Parameters that no vehicle stands behind: as a file, a snapshot or a kept table has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from paramclient.errors import UsageError
from paramclient.model.identity import Identity
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param, ParamType, Value, bits_of, format_value, same_bits

__all__ = ["ParamSet", "WrittenParam"]


@dataclass(frozen=True, slots=True)
class WrittenParam:
    """One parameter as it is written down.

    Attributes:
        name: param_id.
        value: int where a whole number is written, else float; the raw four bytes for what cannot be said
            as a number. A number that no type stands beside is kept as written: what it is as a float32
            only shows beside the vehicle's own type (see `bits_as`).
        type: param_type, or None where the source does not say.
        default: the value that the firmware gives it, or None where the source does not say.
        comment: what stands beside it in words, without the mark that begins it; "" for nothing.
        line: its line in the file it comes from, from 1; None where there is none. Takes no part in equality.
    """

    name: str
    value: Value
    type: ParamType | int | None = None
    default: Value | None = None
    comment: str = ""
    line: int | None = field(default=None, compare=False)

    @classmethod
    def of(cls, param: Param) -> WrittenParam:
        """The same value without what only a table knows of it."""
        return cls(param.name, param.value, param.type, param.default)

    def bits_as(self, number: ParamType | int) -> int:
        """The bits (see `Param.bits`) that a parameter of this type has when it holds this value.

        Raises:
            UsageError: the value does not fit the type.
        """
        if isinstance(self.value, bytes):
            return int.from_bytes(self.value, "little")  # all four, also of a type that has fewer
        return bits_of(self.value, number)

    def is_held_by(self, param: Param) -> bool:
        """Whether a vehicle's parameter has this value, compared in the type that the vehicle gives it.

        −0 equals 0, a NaN equals only the same NaN, and a float is rounded to float32 first. False where the
        value does not fit that type at all. Raw bytes equal only the same raw bytes: what they mean as a
        number is not known.
        """
        if isinstance(self.value, bytes) or param.is_raw:
            return self.value == param.value
        try:
            bits = self.bits_as(param.type)
        except UsageError:
            return False
        return same_bits(param.type, bits, param.bits)

    def __str__(self) -> str:
        kind = ParamType.REAL32 if self.type is None else self.type
        return f"{self.name} = {format_value(self.value, kind)}"


@dataclass(frozen=True, slots=True)
class ParamSet(Mapping[str, WrittenParam]):
    """Parameters of one component by name, in the order in which they are written. It does not change.

    Attributes:
        params: the parameters.
        component: component id, or None where the source does not say (the autopilot's then).
        system: system id, or None where the source does not say.
        identity: who the vehicle was, where the source says so.
        at: when it was so, in unix seconds, or None.
        source: where it comes from, in words for people: a file's name, `link udpin:…`, `cache uid:…`.
    """

    params: Mapping[str, WrittenParam]
    component: int | None = None
    system: int | None = None
    identity: Identity | None = None
    at: float | None = None
    source: str = ""

    @classmethod
    def of(
        cls,
        params: Iterable[Param],
        *,
        component: int | None = None,
        system: int | None = None,
        identity: Identity | None = None,
        at: float | None = None,
        source: str = "",
    ) -> ParamSet:
        """A copy of a table, such as `component.params.values()`, as it is at this moment."""
        written = {param.name: WrittenParam.of(param) for param in params}
        return cls(written, component, system, identity, at, source)

    def only(self, patterns: Iterable[str]) -> ParamSet:
        """Those that are named.

        Args:
            patterns: names, or patterns of the shell (`MC_*`, `SERVO?_TRIM`) in the spelling of the set.

        Raises:
            UsageError: one fits no name. Whoever misspells one must not hear that all is well.
        """
        chosen, useless = NameChoice(patterns).choose(self.keys())
        if useless:
            of = f" of {self.source}" if self.source else ""
            raise UsageError(f"no parameter{of} is called {useless}")
        return replace(self, params={name: param for name, param in self.items() if name in chosen})

    def __getitem__(self, name: str) -> WrittenParam:
        return self.params[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.params)

    def __len__(self) -> int:
        return len(self.params)

    def __repr__(self) -> str:
        count = len(self.params)
        origin = f" from {self.source}" if self.source else ""
        return f"<ParamSet {count} {'param' if count == 1 else 'params'}{origin}>"
