"""Values of extended parameters: up to 128 bytes, numbers, text or bytes."""

from __future__ import annotations

from typing import Final

from paramclient.errors import UsageError
from paramclient.model.values import (
    HEX,
    TYPES_BY_NAME,
    Param,
    ParamType,
    Settable,
    Trust,
    WireValue,
    bits_of,
    byte_length,
    check_number,
    from_bits,
)

EXT_VALUE_SIZE: Final = 128
"""Bytes of `param_value` in PARAM_EXT_VALUE, PARAM_EXT_SET and PARAM_EXT_ACK (MAVLink common message set)."""

_SIZES: Final = {int(kind): kind.size for kind in TYPES_BY_NAME.values()}
"""Bytes of a number, by its type."""


def own_bytes(data: bytes, number: int) -> bytes:
    """Return the bytes of a message's value that count for its type: all but zeros at the end, as the message
    carries no length, for a type that is no number."""
    size = _SIZES.get(number)
    return data[:EXT_VALUE_SIZE].rstrip(b"\0") if size is None else data[:size].ljust(size, b"\0")


def ext_param(
    name: str, data: bytes, number: int, index: int | None = None, trust: Trust = Trust.LIVE
) -> Param:
    """Return the extended parameter whose value has these bytes, those of a message or of `ext_bytes`."""
    bits = int.from_bytes(own_bytes(data, number), "little")
    return Param(name, from_bits(bits, number), number, index, bits, trust)


def ext_bytes(param: Param) -> bytes:
    """Return the bytes of the value of an extended parameter, without zeros at the end of text and bytes."""
    return param.bits.to_bytes(_SIZES.get(param.type, byte_length(param.bits)), "little")


def check_ext_value(value: Settable) -> WireValue:
    """Convert a caller's value to an int, a float, a str or bytes; else raise UsageError."""
    if not isinstance(value, bytes | str):
        return check_number(value, "an extended parameter is a number, text or bytes; a number")
    data = value if isinstance(value, bytes) else value.encode(errors="surrogatepass")
    if len(data) > EXT_VALUE_SIZE:
        raise UsageError(f"the value has {len(data)} bytes; an extended parameter holds {EXT_VALUE_SIZE}")
    if isinstance(value, str) and ("\0" in value or data != value.encode(errors="replace")):
        raise UsageError("text for an extended parameter is UTF-8 without NUL; give bytes for anything else")
    return value


def encode_ext_value(value: WireValue, number: int) -> bytes:
    """Return the bytes of a value in a type, as `own_bytes` does.

    Raises:
        UsageError: the value does not fit the type: a number only fits a numeric type, text and bytes only
            CUSTOM, and bytes a type that MAVLink does not define.
    """
    name, is_custom = ParamType(number).name, number == ParamType.CUSTOM
    if number in _SIZES:
        if isinstance(value, str | bytes):
            raise UsageError(f"{value!r} is not a number, and the parameter is {name}")
        return bits_of(value, number).to_bytes(_SIZES[number], "little")
    if isinstance(value, str) and is_custom:
        value = value.encode()
    if isinstance(value, bytes):
        return own_bytes(value, number)
    wanted = "text or bytes" if is_custom else "bytes"
    raise UsageError(f"{value!r} is not {wanted}, and the parameter is {name}")


def parse_ext_value(name: str, text: str, number: int) -> WireValue:
    """Return the value that a text gives in a type: a number, text, or bytes after `hex:`.

    Raises:
        UsageError: the text is no value of this type.
    """
    try:
        value: WireValue = bytes.fromhex(text.removeprefix(HEX)) if text.startswith(HEX) else text
        if isinstance(value, str) and number in _SIZES:
            value = float(text) if number >= ParamType.REAL32 else int(text, 0)
    except ValueError:
        raise UsageError(f"{name}: {text!r} is not a value of type {ParamType(number).name}") from None
    try:
        encode_ext_value(check_ext_value(value), number)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None
    return value
