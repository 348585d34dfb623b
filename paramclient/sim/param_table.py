"""Parameter tables of simulated vehicles: two recorded ones, and tables of the caller."""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from typing import TypeAlias

from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    WireValue,
    bits_of,
    check_name,
    check_value,
    from_bits,
    known_type,
)
from paramclient.protocol.param_pck import PACKABLE, PackedParam

__all__ = [
    "Entry",
    "SimParam",
    "Table",
    "ardupilot_table",
    "as_table",
    "ek2_group",
    "px4_table",
    "with_system_id",
]

FLT_EPSILON = 2.0**-23
"""Difference from the default up to which ArduPilot does not report the default separately."""


@dataclass(frozen=True, slots=True)
class SimParam:
    """One parameter of a simulated vehicle's table, with its initial value.

    Attributes:
        name: 1 to 16 printable ASCII characters.
        type: any MAV_PARAM_TYPE, or the number of a type that MAVLink does not define.
        value: within the type; four raw bytes for a type that MAVLink does not define.
        volatile: whether PX4 excludes the parameter from the hash.
        default: the firmware's default as the number in its source, or None if unknown.
        bits: the value's own bytes, as in `paramclient.Param.bits`.

    Raises:
        UsageError: the name or the value is invalid.
    """

    name: str
    type: ParamType | int
    value: WireValue = field(compare=False)
    volatile: bool = False
    default: float | None = None
    bits: int = field(init=False)

    def __post_init__(self) -> None:
        check_name(self.name)
        object.__setattr__(self, "type", known_type(self.type))
        object.__setattr__(self, "bits", bits_of(self.value, self.type))


Table: TypeAlias = Iterable[SimParam] | Mapping[str, WireValue | tuple[ParamType | int, WireValue]]
"""A table: `SimParam`s, or a mapping from names to values, where an int becomes an INT32, a float a REAL32,
and `(type, value)` gives another type."""


class Entry:
    """A parameter with its current value on board.

    Attributes:
        name, type, volatile, default: as in `SimParam`.
        bits: the value, as in `SimParam.bits`.
        order: its position among all parameters of the vehicle, listed or not.
        index: its position in the list, or None if it is not listed.
        raw: the four bytes of the value in a message.
    """

    __slots__ = (
        *("_encoding", "_packed"),
        *("bits", "default", "index", "name", "order", "raw", "type", "volatile"),
    )

    def __init__(self, row: SimParam, order: int, encoding: Encoding) -> None:
        self._encoding = encoding
        self.name = row.name
        self.type = row.type
        self.volatile = row.volatile
        self.default = row.default
        self.order = order
        self._packed: PackedParam | None = None
        self.index: int | None = None
        self.store(row.bits)

    @property
    def value(self) -> WireValue:
        return from_bits(self.bits, self.type)

    @property
    def param(self) -> Param:
        return Param(self.name, self.value, self.type, self.index, self.bits)

    @property
    def packed(self) -> PackedParam | None:
        """The entry in param.pck, with its default if that differs; None for a type that param.pck lacks."""
        if self._packed is None and isinstance(self.type, ParamType) and self.type in PACKABLE:
            default = None
            if self.default is not None and self._differs_from(self.default):
                is_float = self.type is ParamType.REAL32
                raw = (
                    _cast(self.default) if is_float else int(self.default).to_bytes(8, "little", signed=True)
                )
                default = int.from_bytes(raw[: self.type.size], "little")
            self._packed = PackedParam(self.name, self.type, self.bits, default)
        return self._packed

    def store(self, bits: int) -> None:
        """Set another value."""
        self.bits = bits
        self._packed = None
        value = self.value
        if (
            self._encoding is Encoding.BYTEWISE
            or self.type == ParamType.REAL32
            or isinstance(value, bytes | str)
        ):
            self.raw = (bits & 0xFFFFFFFF).to_bytes(4, "little")
        else:
            self.raw = _cast(value)

    def _differs_from(self, default: float) -> bool:
        """Compare as ArduPilot does: as float32, and with a tolerance of FLT_EPSILON."""
        value = self.value
        if isinstance(value, bytes | str):
            return True
        difference = struct.unpack("<f", _cast(value))[0] - struct.unpack("<f", _cast(default))[0]
        return not abs(difference) < FLT_EPSILON


def as_table(table: Table) -> tuple[SimParam, ...]:
    """Return any form of `Table` as a tuple of `SimParam`, in the given order.

    Raises:
        UsageError: a name or value is invalid.
    """
    if isinstance(table, Mapping):
        return tuple(_row(name, entry) for name, entry in table.items())
    return tuple(table)


def with_system_id(rows: Iterable[SimParam], name: str, system: int) -> tuple[SimParam, ...]:
    """Return a table in which the parameter with this name is set to the system id."""
    return tuple(replace(row, value=system) if row.name == name else row for row in rows)


@cache
def px4_table() -> tuple[SimParam, ...]:
    """Return the 903 parameters of a PX4 1.17 quad, read from a real one; 58 of them are volatile."""
    rows = []
    for row in _read("px4.csv"):
        kind = ParamType[row["type"]]
        rows.append(
            SimParam(row["name"], kind, from_bits(int(row["bits"], 16), kind), row["volatile"] == "1")
        )
    return tuple(rows)


@cache
def ardupilot_table() -> tuple[SimParam, ...]:
    """Return the 1382 parameters of an ArduCopter 4.6 quad, read from a real one."""
    return tuple(map(_plain, _read("ardupilot.csv")))


@cache
def ek2_group() -> tuple[SimParam, ...]:
    """Return the 52 parameters that EK2_ENABLE shows on that quad. Only their number is measured."""
    return tuple(map(_plain, _read("ardupilot_ek2.csv")))


def _row(name: str, entry: WireValue | tuple[ParamType | int, WireValue]) -> SimParam:
    if isinstance(entry, tuple):
        return SimParam(name, *entry)
    value = check_value(entry)
    return SimParam(name, ParamType.REAL32 if isinstance(value, float) else ParamType.INT32, value)


def _plain(row: dict[str, str]) -> SimParam:
    kind = ParamType[row["type"]]
    value = int(row["value"]) if kind.is_integer else float(row["value"])
    default = float(row["default"]) if "default" in row else None
    return SimParam(row["name"], kind, value, default=default)


def _read(name: str) -> Iterable[dict[str, str]]:
    text = resources.files(__package__).joinpath("tables", name).read_text(encoding="ascii")
    return csv.DictReader(text.splitlines())


def _cast(value: float) -> bytes:
    """Return a number cast to float as in C; a REAL64 beyond its range becomes infinite."""
    try:
        return struct.pack("<f", value)
    except OverflowError:
        return struct.pack("<f", math.copysign(math.inf, value))
