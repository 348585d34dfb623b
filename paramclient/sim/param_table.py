"""Parameter tables of simulated vehicles: two recorded ones, and tables of the caller."""

from __future__ import annotations

import csv
import struct
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import SupportsIndex, TypeAlias

from paramclient.errors import UsageError
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Value,
    as_reported,
    bits_of,
    check_name,
    from_bits,
)
from paramclient.protocol.param_pck import PACKABLE, PackedParam

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
        default: the firmware's default as the number in its source; None for the value.
        bits: the value's own bytes, as in `paramclient.Param.bits`.

    Raises:
        UsageError: the name or the value is invalid.
    """

    name: str
    type: ParamType | int
    value: Value = field(compare=False)
    volatile: bool = False
    default: float | None = None
    bits: int = field(init=False)

    def __post_init__(self) -> None:
        check_name(self.name)
        object.__setattr__(self, "type", ParamType(self.type))
        object.__setattr__(self, "bits", bits_of(self.value, self.type))


Table: TypeAlias = Iterable[SimParam] | Mapping[str, Value | tuple[ParamType | int, Value]]
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

    __slots__ = ("_encoding", "_packed", "bits", "index", "name", "order", "raw", "row", "type")

    def __init__(self, row: SimParam, order: int, encoding: Encoding) -> None:
        self._encoding = encoding
        self.row = row
        self.name = row.name
        self.type = row.type
        self.order = order
        self.index: int | None = None
        self._packed: PackedParam | None = None
        self.store(row.bits)

    @property
    def value(self) -> Value:
        return from_bits(self.bits, self.type)

    @property
    def param(self) -> Param:
        return Param(self.name, self.value, self.type, self.index, self.bits)

    @property
    def packed(self) -> PackedParam | None:
        """The entry in param.pck, with its default if that differs; None for a type that param.pck lacks."""
        if self._packed is None and self.type in PACKABLE:
            kind, other = ParamType(self.type), None
            default = float(self.row.value) if self.row.default is None else self.row.default
            one, two = struct.unpack("<2f", struct.pack("<2f", float(self.value), default))
            if not abs(one - two) < FLT_EPSILON:
                other = int(default) & (1 << 8 * kind.size) - 1 if kind.is_integer else bits_of(default, kind)
            self._packed = PackedParam(self.name, kind, self.bits, other)
        return self._packed

    def store(self, bits: int) -> None:
        """Set another value."""
        self.bits = bits
        self._packed = None
        self.raw = as_reported(bits, self.type, self._encoding)


def as_table(table: Table) -> tuple[SimParam, ...]:
    """Return any form of `Table` as a tuple of `SimParam`, in the given order.

    Raises:
        UsageError: a name or value is invalid.
    """
    if not isinstance(table, Mapping):
        return tuple(table)
    return tuple(SimParam(name, *typed(entry)) for name, entry in table.items())


def typed(entry: Value | tuple[ParamType | int, Value]) -> tuple[ParamType | int, Value]:
    """Return the type and the value of an entry of a mapping."""
    if isinstance(entry, tuple):
        return entry
    if isinstance(entry, bytes | str):
        return ParamType.CUSTOM, entry
    return ParamType.INT32 if isinstance(entry, SupportsIndex) else ParamType.REAL32, entry


def px4_table() -> tuple[SimParam, ...]:
    """Return the 903 parameters of a PX4 1.17 quad, read from a real one; 58 of them are volatile."""
    return stored_table("px4.csv")


def ardupilot_table() -> tuple[SimParam, ...]:
    """Return the 1382 parameters of an ArduCopter 4.6 quad, read from a real one."""
    return stored_table("ardupilot.csv")


def check_range(low: float, high: float = sys.float_info.max, /, **numbers: float) -> None:
    """Raise UsageError, with the name, unless all these numbers are from `low` to `high`."""
    for name, number in numbers.items():
        if not low <= number <= high:
            limits = f"{low:g} or more" if high == sys.float_info.max else f"{low:g} to {high:g}"
            raise UsageError(f"{name} must be {limits}, not {number}")


def rows_of(name: str) -> Iterable[dict[str, str]]:
    """Return the rows of a stored table."""
    text = resources.files(__package__).joinpath("tables", name).read_text(encoding="ascii")
    return csv.DictReader(text.splitlines())


@cache
def stored_table(name: str) -> tuple[SimParam, ...]:
    """Return a stored table of plain parameters.

    Besides the two quads': `px4_compass.csv`, those of a third compass, not in use on that quad, with the
    second's values; `ardupilot_ek2.csv`, the 52 that EK2_ENABLE shows. Only their number is measured.
    """
    rows = []
    for row in rows_of(name):
        kind = ParamType[row["type"]]
        value = int(row["value"]) if kind.is_integer else float(row["value"])
        default = float(row["default"]) if "default" in row else None
        rows.append(SimParam(row["name"], kind, value, row.get("volatile") == "1", default))
    return tuple(rows)
