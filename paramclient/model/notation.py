"""JSON notation of values, bits, hashes and times."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TypeAlias

from paramclient.errors import UsageError
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Param, ParamType, Value, format_value, shortest_float

Scalar: TypeAlias = int | float | str
"""A value in strict JSON."""


def value_json(value: Value, number: ParamType | int) -> Scalar:
    """Return a value in strict JSON: NaN and infinities as text, raw bytes as hexadecimal text.

    A REAL32 becomes the shortest number that rounds to the same float32.
    """
    if isinstance(value, bytes):
        return format_value(value, number)
    if isinstance(value, int | str):
        return value
    if math.isfinite(value):
        return shortest_float(value) if number == ParamType.REAL32 else value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def value_written(value: Value, param: WrittenParam) -> Scalar:
    """Return a written value in strict JSON; without a type, as the number that was written."""
    return value_json(value, ParamType.REAL64 if param.type is None else param.type)


def typed(value: Value, number: ParamType | int | None) -> tuple[Value, ParamType | int]:
    """Return a written value and the type in which to show it.

    A whole number for a REAL32 or REAL64 becomes a float. A value without a type is shown as a REAL32.
    """
    kind = ParamType.REAL32 if number is None else number
    is_float = number in (ParamType.REAL32, ParamType.REAL64)
    return (float(value) if is_float and isinstance(value, int) else value), kind


def bits_text(param: Param) -> str:
    """Return `Param.bits` as hexadecimal digits: 16 for types of 8 bytes, else 8."""
    return _digits(param.bits, param.type)


def bits_written(param: WrittenParam) -> str | None:
    """Return a written value's bits as hexadecimal digits; None without a type or beyond its range."""
    if param.type is None:
        return None
    try:
        return _digits(param.bits_as(param.type), param.type)
    except UsageError:
        return None


def hash_text(crc: int | None) -> str | None:
    """Return a PX4 hash as 8 hexadecimal digits; None for None."""
    return None if crc is None else f"{crc:08x}"


def time_text(at: float, digits: str = "milliseconds") -> str:
    """Return a Unix time in ISO 8601, UTC.

    Raises:
        UsageError: the time is outside the range of the calendar.
    """
    try:
        moment = datetime.fromtimestamp(at, UTC)
    except (ArithmeticError, OSError, ValueError):
        raise UsageError(f"{at!r} is not a valid Unix time in seconds") from None
    return moment.isoformat(timespec=digits).replace("+00:00", "Z")


def time_or_none(at: float | None) -> str | None:
    """Return a Unix time as `time_text` does; None for None."""
    return None if at is None else time_text(at)


def rounded(seconds: float | None) -> float | None:
    """Return seconds rounded to 0.1 ms; None for None."""
    return None if seconds is None else round(seconds, 4)


def _digits(bits: int, number: ParamType | int) -> str:
    is_wide = isinstance(number, ParamType) and number.size == 8
    return f"{bits:0{16 if is_wide else 8}x}"
