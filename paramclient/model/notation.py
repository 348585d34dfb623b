"""How values, bits, hashes and times are written in JSON: the one place for it."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TypeAlias

from paramclient.errors import UsageError
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Param, ParamType, Value, format_value, shortest_float

__all__ = [
    "Scalar",
    "bits_text",
    "bits_written",
    "hash_text",
    "rounded",
    "time_or_none",
    "time_text",
    "typed",
    "value_json",
    "value_written",
]

Scalar: TypeAlias = int | float | str
"""A value as strict JSON can say it."""


def value_json(value: Value, number: ParamType | int) -> Scalar:
    """A value as strict JSON knows it: NaN and infinities as text, raw bytes as hexadecimal text.

    A REAL32 is given by the shortest number that rounds to the same float32.
    """
    if isinstance(value, bytes):
        return format_value(value, number)
    if isinstance(value, int):
        return value
    if math.isfinite(value):
        return shortest_float(value) if number == ParamType.REAL32 else value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def value_written(value: Value, param: WrittenParam) -> Scalar:
    """The same for a parameter that may have no type: then it is the number as it is written."""
    return value_json(value, ParamType.REAL64 if param.type is None else param.type)


def typed(value: Value, number: ParamType | int | None) -> tuple[Value, ParamType | int]:
    """A value that was written for a parameter of this type, and the type in which to say it.

    A whole number that was written for a float is the float that it is. Where the type is not known, it is
    said as a REAL32.
    """
    kind = ParamType.REAL32 if number is None else number
    is_float = number in (ParamType.REAL32, ParamType.REAL64)
    return (float(value) if is_float and isinstance(value, int) else value), kind


def bits_text(param: Param) -> str:
    """`Param.bits` as hexadecimal digits: 16 for the types of 8 bytes, else 8."""
    return _digits(param.bits, param.type)


def bits_written(param: WrittenParam) -> str | None:
    """The value's bits as hexadecimal digits; None where no type stands beside it, or one that it exceeds."""
    if param.type is None:
        return None
    try:
        return _digits(param.bits_as(param.type), param.type)
    except UsageError:
        return None


def hash_text(crc: int | None) -> str | None:
    """A PX4 hash as 8 hexadecimal digits."""
    return None if crc is None else f"{crc:08x}"


def time_text(at: float) -> str:
    """A unix time in ISO 8601, UTC, with milliseconds."""
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def time_or_none(at: float | None) -> str | None:
    """The same, and None for none."""
    return None if at is None else time_text(at)


def rounded(seconds: float | None) -> float | None:
    """Seconds to a tenth of a millisecond."""
    return None if seconds is None else round(seconds, 4)


def _digits(bits: int, number: ParamType | int) -> str:
    is_wide = isinstance(number, ParamType) and number.size == 8
    return f"{bits:0{16 if is_wide else 8}x}"
