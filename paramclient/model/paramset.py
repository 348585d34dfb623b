"""Parameters by name: sets without a vehicle, such as files; a view of a table; the firmware's defaults."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from types import MappingProxyType
from typing import TypeAlias, TypeVar

from paramclient.errors import UsageError
from paramclient.model.identity import Identity, autopilot_name, check_ids
from paramclient.model.names import ByName, NameChoice, counted
from paramclient.model.values import (
    WIRE_SIZE,
    Param,
    ParamType,
    Settable,
    Value,
    bits_of,
    byte_length,
    check_ext_value,
    check_name,
    check_value,
    format_value,
    from_bits,
)


@dataclass(frozen=True, slots=True, init=False)
class WrittenParam:
    """One parameter of a set.

    Attributes:
        name: param_id.
        value: int for a written whole number, else float. A number without a type is kept as written: only
            the vehicle's own type shows which float32 it becomes (see `bits_as`). Where `is_raw`, the
            unsigned number of the four raw bytes, little-endian.
        type: MAV_PARAM_TYPE, also of a number that MAVLink does not define; None if the source has no types.
        default: the firmware's default, or None if the source does not contain it as a number.
        comment: the comment in the file, without the comment character; "" for none.
        line: the line in the source file, from 1; None for other sources. Takes no part in equality.
        is_raw: whether the source has the four raw bytes instead of a number of the type (see
            `Param.is_raw`). Write such a value elsewhere as `settable`, not as `value`.

    Args:
        value: as the attribute, or the four raw bytes.
        type: as the attribute, or its number.
    """

    name: str
    value: Value
    type: ParamType | None
    default: Value | None
    comment: str
    line: int | None = field(compare=False)
    is_raw: bool

    def __init__(
        self,
        name: str,
        value: Value,
        type: ParamType | int | None = None,  # noqa: A002 - the name of the field
        default: Value | None = None,
        comment: str = "",
        line: int | None = None,
        is_raw: bool = False,
    ) -> None:
        kind = None if type is None else ParamType(type)
        if isinstance(value, bytes) and (is_raw or kind != ParamType.CUSTOM):
            value, is_raw = int.from_bytes(value, "little"), True
        given = (name, value, kind, None if isinstance(default, bytes) else default, comment, line, is_raw)
        for attribute, each in zip(fields(self), given, strict=True):
            object.__setattr__(self, attribute.name, each)

    @property
    def settable(self) -> Value:
        """The value as `set` takes it: the number, or the four raw bytes where `is_raw`."""
        if not self.is_raw:
            return self.value
        bits = int(self.value)
        return bits.to_bytes(max(WIRE_SIZE, byte_length(bits)), "little")

    @classmethod
    def of(cls, param: Param) -> WrittenParam:
        """Return the value, type and default of a table's parameter, without index and trust."""
        return cls(param.name, param.settable, param.type, param.default, is_raw=param.is_raw)

    def bits_as(self, number: ParamType | int) -> int:
        """Return the bits (see `Param.bits`) of a parameter of this type with this value.

        Raises:
            UsageError: the value does not fit the type.
        """
        # four bytes of a raw value also if the type has fewer
        return int(self.value) if self.is_raw else bits_of(self.value, number)

    def __str__(self) -> str:
        kind = 0 if self.is_raw else ParamType.REAL32 if self.type is None else self.type
        return f"{self.name} = {format_value(self.settable, kind)}"


AnyParams: TypeAlias = Mapping[str, WrittenParam | Param | Settable]
"""Parameters by name: a `ParamSet`, a table, or plain values."""


def _written(name: str, given: WrittenParam | Param | Settable, is_extended: bool) -> WrittenParam:
    """Return a parameter. Of plain values, text and bytes that are not four are extended ones."""
    if isinstance(given, WrittenParam | Param):
        if given.name != name:
            raise UsageError(f"{name} is given as the parameter {given.name}; a value alone is set")
        return given if isinstance(given, WrittenParam) else WrittenParam.of(given)
    value = check_ext_value(given) if is_extended else check_value(given)
    is_raw = isinstance(value, bytes) and len(value) == WIRE_SIZE
    is_custom = isinstance(value, bytes | str) and not is_raw
    return WrittenParam(check_name(name), value, ParamType.CUSTOM if is_custom else None)


@dataclass(frozen=True, slots=True, init=False)
class ParamSet(ByName[WrittenParam]):
    """The parameters of one component by name, in the order of the source. Immutable.

    `ParamSet(component.params)` is a copy of a vehicle's table. `ParamSet({"MC_ROLL_P": 6.0})` holds plain
    values, as `Component.set_many` takes them.

    Attributes:
        params: the parameters; as an argument, each may also be a `Param` or a plain value.
        component: component id, or None if the source does not contain it (then the autopilot's is meant).
        system: system id, or None if the source does not contain it.
        identity: the vehicle's identity, or None if the source does not contain it.
        at: when the values were observed, as a Unix time in seconds, or None if unknown.
        source: the source, for messages: a file's name, `link udpin:…`, `cache uid:…`.
        is_extended: whether these are extended parameters.
        lacks: what is missing of an incomplete table, in words; "" if nothing is known to be.

    Raises:
        UsageError: a plain value, its name, or an id is not valid.
    """

    params: Mapping[str, WrittenParam]
    component: int | None
    system: int | None
    identity: Identity | None
    at: float | None
    source: str
    is_extended: bool
    lacks: str

    def __init__(
        self,
        params: AnyParams,
        component: int | None = None,
        system: int | None = None,
        identity: Identity | None = None,
        at: float | None = None,
        source: str = "",
        is_extended: bool = False,
        lacks: str = "",
    ) -> None:
        check_ids(system, component)
        written = {name: _written(name, value, is_extended) for name, value in dict(params).items()}
        given = (written, component, system, identity, at, source, is_extended, lacks)
        for attribute, content in zip(fields(self), given, strict=True):
            object.__setattr__(self, attribute.name, content)

    def only(self, patterns: Iterable[str]) -> ParamSet:
        """Return the set with only the selected parameters.

        Args:
            patterns: names or shell patterns (`MC_*`, `SERVO?_TRIM`). Upper and lower case do not matter.

        Raises:
            UsageError: a pattern matches no name. Without this error, a misspelt name would go unnoticed.
        """
        chosen = NameChoice(patterns).choose(self.keys(), f" of {self.source}" if self.source else "")
        return replace(self, params={name: param for name, param in self.items() if name in chosen})

    @property
    def autopilot(self) -> str:
        """The autopilot that these are of: "px4"; "" if that is unknown, or they are of another component."""
        is_own = self.component in (None, 1)
        return autopilot_name(self.identity.autopilot) if self.identity is not None and is_own else ""

    def __repr__(self) -> str:
        origin = f" from {self.source}" if self.source else ""
        return f"<ParamSet {counted(len(self.params), 'param')}{origin}>"


def set_of(params: AnyParams, *, is_extended: bool = False) -> ParamSet:
    """Return parameters by name as a set; plain values are extended ones with `is_extended`."""
    return params if isinstance(params, ParamSet) else ParamSet(params, is_extended=is_extended)


@dataclass(frozen=True, slots=True)
class RestorePoint:
    """The state of a component before the last `apply`.

    Attributes:
        snapshot: number of the snapshot that `apply` stored.
        at: its time in unix seconds.
        state: its parameters.
        changes: the time of the latest change of each parameter that has another value in the cache than in
            `state`, newest first, as far as the history has them. They are those of the `apply` and later
            ones, of all authors.
    """

    snapshot: int
    at: float
    state: ParamSet
    changes: Mapping[str, float]


AnyParam = TypeVar("AnyParam", Param, WrittenParam)


class DefaultSource(StrEnum):
    """The origin of a default.

    Attributes:
        VEHICLE: the vehicle, or the file or log that a parameter set is from, gives it with the value.
        METADATA: the metadata of the firmware. It does not have the defaults of an airframe, which PX4 sets
            by `param set-default`.
    """

    VEHICLE = "vehicle"
    METADATA = "metadata"


@dataclass(frozen=True, slots=True)
class Default:
    """The firmware's default of a parameter, as a number of the parameter's type, and its origin."""

    value: Value
    source: DefaultSource


def default_of(param: Param | WrittenParam, described: Value | None = None) -> Default | None:
    """Return the default of a parameter, or None if it is not known.

    Every command, the service and the page use this rule: the default that the vehicle has given, else that
    of the metadata as far as the type of the parameter can hold it.

    Args:
        param: the parameter.
        described: the default in the metadata (`ParamInfo.default`), or None.
    """
    if param.default is not None:
        return Default(param.default, DefaultSource.VEHICLE)
    if described is None:
        return None
    if param.type is None:
        return Default(described, DefaultSource.METADATA)
    try:
        return Default(from_bits(bits_of(described, param.type), param.type), DefaultSource.METADATA)
    except UsageError:  # not in the range of the type
        return None


def add_default(param: AnyParam, described: Value | None) -> AnyParam:
    """Return a parameter with its default; see `default_of`."""
    default = default_of(param, described)
    return param if default is None else replace(param, default=default.value)


def add_defaults(params: ParamSet, described: Mapping[str, Value]) -> ParamSet:
    """Return a parameter set with its defaults; see `default_of`.

    Args:
        params: the set.
        described: the defaults in the metadata by name, such as `Metadata.defaults_of`.
    """
    if not described:
        return params
    known = {name: add_default(each, described.get(name)) for name, each in params.items()}
    return replace(params, params=known)


class ParamMap(ByName[Param]):
    """Parameters by name: a read-only view of a table that may still change.

    An iteration is over the names at its start.

    Args:
        params: the table. It is not copied; its order is kept.
    """

    __slots__ = ("params",)

    def __init__(self, params: Mapping[str, Param]) -> None:
        self.params = MappingProxyType(params)

    def changed(self, defaults: Mapping[str, Value] | None = None) -> dict[str, Param]:
        """Return a copy of the parameters whose value differs from the firmware's default.

        Parameters without a known default are left out.

        Args:
            defaults: defaults of parameters whose default the vehicle has not given (see `Param.default`), by
                name, such as `Metadata.defaults_of`. They become the `default` of the returned parameters.
        """
        described = defaults or {}
        known = (add_default(param, described.get(name)) for name, param in tuple(self.params.items()))
        return {param.name: param for param in known if param.is_changed}

    def __repr__(self) -> str:
        return f"<ParamMap {counted(len(self), 'param')}>"
