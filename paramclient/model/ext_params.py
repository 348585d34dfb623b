"""Extended parameters: values of up to 128 bytes, their types and their notation.

They are apart from `Param`, so that the values of plain parameters stay numbers.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Final, SupportsFloat, SupportsIndex, TypeAlias

from paramclient.errors import UsageError
from paramclient.model.values import ParamType, Trust, format_value, same_bits

__all__ = [
    "EXT_VALUE_SIZE",
    "ExtParam",
    "ExtParamType",
    "ExtSettable",
    "ExtValue",
    "check_ext_value",
    "decode_ext_value",
    "encode_ext_value",
    "ext_type_name",
    "ext_type_number",
    "format_ext_value",
]

EXT_VALUE_SIZE: Final = 128
"""Bytes of `param_value` in PARAM_EXT_VALUE, PARAM_EXT_SET and PARAM_EXT_ACK (MAVLink common message set)."""

ExtValue: TypeAlias = int | float | str | bytes
"""The value of an extended parameter, by its type: int, float, and for CUSTOM text, or bytes that are no
text."""
ExtSettable: TypeAlias = SupportsIndex | SupportsFloat | str | bytes
"""What `set` of an extended parameter accepts."""


class ExtParamType(IntEnum):
    """MAV_PARAM_EXT_TYPE. The numeric types have the numbers of `ParamType`."""

    UINT8 = 1
    INT8 = 2
    UINT16 = 3
    INT16 = 4
    UINT32 = 5
    INT32 = 6
    UINT64 = 7
    INT64 = 8
    REAL32 = 9
    REAL64 = 10
    CUSTOM = 11


_LAYOUTS: Final = {
    number: struct.Struct("<" + code) for number, code in enumerate("BbHhIiQqfd", start=ExtParamType.UINT8)
}


@dataclass(frozen=True, slots=True)
class ExtParam:
    """One extended parameter as a component holds it.

    Attributes:
        name: param_id, 1 to 16 characters.
        value: int for integer types, also those of 64 bits; float for REAL32 and REAL64; for CUSTOM str where
            its bytes are UTF-8 text, else bytes. The bytes of a type that MAVLink does not define.
        type: an `ExtParamType`, or the number of a type that MAVLink does not define.
        index: the component's index of the parameter, or None while unknown.
        raw: the value's own bytes: as many as a numeric type has; otherwise up to 128, without the zero bytes
            at the end, as the message carries no length. Two parameters are equal by these, not by `value`.
        trust: how the value was confirmed.
    """

    name: str
    value: ExtValue = field(compare=False)
    type: ExtParamType | int
    index: int | None
    raw: bytes
    trust: Trust = Trust.LIVE

    @classmethod
    def of(
        cls, name: str, data: bytes, number: int, index: int | None = None, trust: Trust = Trust.LIVE
    ) -> ExtParam:
        """Return the parameter whose value has these bytes, those of a message or `ExtParam.raw`."""
        raw = own_bytes(data, number)
        kind = ExtParamType(number) if number in _TYPES else number
        return cls(name, decode_ext_value(raw, number), kind, index, raw, trust)

    def with_trust(self, trust: Trust) -> ExtParam:
        """Return this parameter with another trust."""
        return self if self.trust is trust else _copied(self, self.index, trust)

    def with_index(self, index: int | None) -> ExtParam:
        """Return this parameter with another index."""
        return self if self.index == index else _copied(self, index, self.trust)

    def same_value(self, other: ExtParam) -> bool:
        """Return whether both have the same value in the same type (−0 equals 0, NaN is compared by bits)."""
        if self.type != other.type:
            return False
        if self.raw == other.raw:
            return True
        bits = (int.from_bytes(each.raw, "little") for each in (self, other))
        return self.type in _LAYOUTS and same_bits(self.type, *bits)

    def __str__(self) -> str:
        return f"{self.name} = {format_ext_value(self.value, self.type)}"


_set_name, _set_value, _set_type, _set_index, _set_raw, _set_trust = (
    vars(ExtParam)[each.name].__set__ for each in fields(ExtParam)
)


def _copied(param: ExtParam, index: int | None, trust: Trust) -> ExtParam:
    """Return a parameter with another index and trust.

    In a quarter of the time of `dataclasses.replace`: one message may change the index of 32,768 parameters.
    """
    copy = object.__new__(ExtParam)
    _set_name(copy, param.name)
    _set_value(copy, param.value)
    _set_type(copy, param.type)
    _set_index(copy, index)
    _set_raw(copy, param.raw)
    _set_trust(copy, trust)
    return copy


_TYPES: Final = frozenset(ExtParamType)


def own_bytes(data: bytes, number: int) -> bytes:
    """Return the bytes of a message's value that count for its type; see `ExtParam.raw`."""
    layout = _LAYOUTS.get(number)
    if layout is None:
        return data[:EXT_VALUE_SIZE].rstrip(b"\0")
    return data[: layout.size].ljust(layout.size, b"\0")


def ext_type_name(number: ExtParamType | int) -> str:
    """Return the name of a type, `INT32`, `CUSTOM`, …, or `EXT_TYPE_77` for an unknown type."""
    return ExtParamType(number).name if number in _TYPES else f"EXT_TYPE_{number}"


_unknown_type: Final = re.compile(r"EXT_TYPE_([0-9]{1,3})").fullmatch


def ext_type_number(name: str) -> int:
    """Return the number of a type by its name, the inverse of `ext_type_name`.

    Raises:
        ValueError: there is no such type.
    """
    if name in ExtParamType.__members__:
        return ExtParamType[name]
    found = _unknown_type(name)
    if found is None or int(found[1]) > 255:
        raise ValueError(f"{name!r:.40} is no type of an extended parameter")
    return int(found[1])


def decode_ext_value(data: bytes, number: int) -> ExtValue:
    """Decode a value.

    Args:
        data: the 128 bytes of a message, or `ExtParam.raw`. Bytes behind a number are ignored.
        number: param_type of the message.

    Returns:
        The value. That of CUSTOM is str if the bytes up to the zeros at the end are UTF-8 text without
        control characters other than tabs and line ends, else bytes. Text of 128 bytes has no zero at its
        end.
    """
    raw = own_bytes(data, number)
    layout = _LAYOUTS.get(number)
    if layout is not None:
        value: int | float = layout.unpack(raw)[0]
        return value
    if number != ExtParamType.CUSTOM:
        return raw
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        return raw
    return text if is_text(text) else raw


def is_text(text: str) -> bool:
    """Return whether a CUSTOM value counts as text: no control characters but tabs and line ends."""
    return all(each.isprintable() or each in "\t\r\n" for each in text)


def check_ext_value(value: ExtSettable) -> ExtValue:
    """Convert a caller's value to an int, a float, a str or bytes; else raise UsageError."""
    if isinstance(value, bytes | str):
        data = value if isinstance(value, bytes) else value.encode(errors="surrogatepass")
        if len(data) > EXT_VALUE_SIZE:
            raise UsageError(f"the value has {len(data)} bytes; an extended parameter holds {EXT_VALUE_SIZE}")
        if isinstance(value, str) and ("\0" in value or not _is_encodable(value)):
            raise UsageError(
                "text for an extended parameter is UTF-8 without NUL; give bytes for anything else"
            )
        return value
    try:
        if isinstance(value, SupportsIndex):
            return value.__index__()
        if isinstance(value, SupportsFloat):
            return float(value)
    except (ArithmeticError, TypeError, ValueError) as error:
        raise UsageError(f"the value must be a number in the range of a float: {error}") from error
    raise UsageError(f"an extended parameter is a number, text or bytes, not {type(value).__name__}")


def encode_ext_value(value: ExtValue, number: int) -> bytes:
    """Return `ExtParam.raw` of a value in a type.

    Raises:
        UsageError: the value does not fit the type: a number only fits a numeric type, text and bytes only
            CUSTOM, and bytes a type that MAVLink does not define.
    """
    name = ext_type_name(number)
    layout = _LAYOUTS.get(number)
    if layout is None:
        if isinstance(value, str) and number == ExtParamType.CUSTOM:
            return own_bytes(value.encode(), number)
        if isinstance(value, bytes):
            return own_bytes(value, number)
        wanted = "text or bytes" if number == ExtParamType.CUSTOM else "bytes"
        raise UsageError(f"{value!r} is not {wanted}, and the parameter is {name}")
    if isinstance(value, str | bytes):
        raise UsageError(f"{value!r} is not a number, and the parameter is {name}")
    if number >= ExtParamType.REAL32:
        try:
            return layout.pack(float(value))
        except OverflowError:
            raise UsageError(f"{value} is beyond the range of {name}") from None
    if isinstance(value, float):
        if not (math.isfinite(value) and value.is_integer()):
            raise UsageError(f"{value!r} is not a whole number, and the parameter is {name}")
        value = int(value)
    low, high = ParamType(number).bounds
    if not low <= value <= high:
        raise UsageError(f"{value} does not fit {name}, which holds {low} to {high}")
    return layout.pack(value)


def format_ext_value(value: ExtValue, number: int) -> str:
    """Return the text of a value: numbers as of plain parameters, text as it is, bytes as hexadecimal."""
    if isinstance(value, str):
        return value
    if isinstance(value, bytes):
        return f"0x{value.hex()}"
    return format_value(value, number)


def _is_encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
