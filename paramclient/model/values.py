"""Values of parameters: types, the two wire encodings, float32 comparison, values of extended parameters.

A PARAM_VALUE has four bytes for the value, whatever its type. Two encodings are in use (MAVLink guide,
"Parameter Protocol"). *Byte-wise*, the standard, copies the value's own bytes into the field. *C-cast*,
ArduPilot's, converts the value to a float32. An integer is never decoded through a Python float: the
conversion would change a byte-wise integer whose bytes form a signalling NaN.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass, field, fields
from enum import IntEnum, StrEnum
from functools import lru_cache
from typing import Final, SupportsFloat, SupportsIndex, TypeAlias

from paramclient.errors import UsageError

Value: TypeAlias = int | float | str | bytes
"""The value of a parameter: a number, text or bytes. Text and bytes are those of an extended parameter of the
type CUSTOM; four bytes are those of a message that cannot be decoded as a number of the type (see
`Param.is_raw`)."""

Settable: TypeAlias = SupportsIndex | SupportsFloat | str | bytes
"""A value that can be set: a number, also of another library, or the four wire bytes."""

HEX: Final = "hex:"
"""Begins the text of a value that is bytes, in hexadecimal."""
WIRE_SIZE: Final = 4
"""Bytes of the value in PARAM_VALUE and PARAM_SET, of any type."""
TYPE_NUMBER_MAX: Final = 255
"""Largest number of a type: param_type has 8 bits."""
NAME_LENGTH = 16
"""Bytes in param_id. Shorter names end with a NUL, names of 16 bytes have none."""
PORTABLE_NAMES_CACHED: Final = 4096
"""Names in the cache of `is_portable_name`: as many as a few autopilots have."""
FLOATS_CACHED: Final = 16_384
"""Float32 values whose shortest decimal is remembered: those of a few autopilots, 100 bytes each. Finding one
takes 3 µs."""
_portable: Final = re.compile(r"(?=[^A-Za-z]*[A-Za-z])(?![@/])(?:(?![#,;=])[!-~]){1,16}(?<!:)").fullmatch


class ParamType(IntEnum):
    """MAV_PARAM_TYPE. A number that MAVLink does not define is one too: `ParamType(77).name` is `TYPE_77`."""

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
    """Text or bytes, of extended parameters only (MAV_PARAM_EXT_TYPE). A plain parameter of this number is
    raw."""

    @classmethod
    def _missing_(cls, number: object) -> ParamType | None:
        if not isinstance(number, int) or not 0 <= number <= TYPE_NUMBER_MAX:
            return None
        kind = int.__new__(cls, number)
        kind._name_ = f"TYPE_{number}"
        kind._value_ = number
        return kind

    @property
    def size(self) -> int:
        """Size of a value of this type, in bytes; 4, the size in the message, for one that is no number."""
        return _LAYOUT[self].size if self in _LAYOUT else WIRE_SIZE

    @property
    def is_integer(self) -> bool:
        return 0 < self < ParamType.REAL32

    @property
    def bounds(self) -> tuple[int, int]:
        """Smallest and largest value of an integer type."""
        bits = 8 * self.size
        return (0, (1 << bits) - 1) if self % 2 else (-(1 << (bits - 1)), (1 << (bits - 1)) - 1)


_LAYOUT = {number: struct.Struct("<" + code) for number, code in enumerate("BbHhIiQqfd", start=1)}
_FLOAT32 = _LAYOUT[ParamType.REAL32]


class Encoding(StrEnum):
    """How a component encodes values in the four bytes of PARAM_VALUE and PARAM_SET."""

    BYTEWISE = "bytewise"
    C_CAST = "c-cast"


class Trust(StrEnum):
    """How a value in a table was confirmed."""

    LIVE = "live"
    """Received from the vehicle on this link, and the component has not been lost since."""
    VERIFIED = "verified"
    """Last known value, confirmed by the vehicle's hash in this session."""
    CACHED = "cached"
    """Last known value: from the cache, or received before the component was lost."""


@dataclass(frozen=True, slots=True, init=False)
class Param:
    """One parameter as a component holds it.

    Attributes:
        name: param_id, 1 to 16 characters.
        value: int for integer types, float for REAL32 and REAL64, text or bytes for CUSTOM. A REAL32 is the
            shortest decimal that gives its float32: 6.1, not 6.099999904632568. Where `is_raw`, the unsigned
            number of the four wire bytes, little-endian.
        type: MAV_PARAM_TYPE, also of a number that MAVLink does not define.
        index: the component's index of the parameter, or None while unknown (PX4 gives none to parameters
            not in use, ArduPilot none in responses by name).
        bits: the value's own bytes in its type, as a little-endian unsigned number. Two values are
            equal if `same_bits` returns true for them; `value` does not take part in equality.
        trust: how the value was confirmed.
        default: the firmware's default, or None where the vehicle has not given it (only a packed
            parameter file does) or it is no number of the type. `default` does not take part in equality.
        is_raw: whether the wire bytes cannot be decoded as a number of the type: an unknown type, a 64-bit
            type in the byte-wise encoding, a C-cast float that the integer type cannot hold. Write such a
            value elsewhere as `settable`, not as `value`.

    Args:
        value: as the attribute, or the four wire bytes, which make the parameter raw.
        type: as the attribute, or its number.
    """

    name: str
    value: Value = field(compare=False)
    type: ParamType
    index: int | None
    bits: int
    trust: Trust = Trust.LIVE
    default: Value | None = field(default=None, compare=False)
    is_raw: bool = False

    def __init__(
        self,
        name: str,
        value: Value,
        type: ParamType | int,  # noqa: A002 - the name of the field
        index: int | None,
        bits: int,
        trust: Trust = Trust.LIVE,
        default: Value | None = None,
        is_raw: bool = False,
    ) -> None:
        # The generated __init__ takes twice as long, and every PARAM_VALUE makes a Param.
        if isinstance(value, bytes) and (is_raw or type != _CUSTOM):
            value, is_raw = int.from_bytes(value, "little"), True
        _set_name(self, name)
        _set_value(self, value)
        _set_type(self, _TYPES[type])
        _set_index(self, index)
        _set_bits(self, bits)
        _set_trust(self, trust)
        _set_default(self, None if isinstance(default, bytes) else default)
        _set_is_raw(self, is_raw or not 0 < type <= _CUSTOM)

    @property
    def settable(self) -> Value:
        """The value as `set` takes it to write it to another vehicle: the four wire bytes where `is_raw`."""
        if not self.is_raw:
            return self.value
        return self.bits.to_bytes(max(WIRE_SIZE, byte_length(self.bits)), "little")

    @property
    def is_changed(self) -> bool | None:
        """Whether the value differs from the firmware's default; None while the default is unknown."""
        if self.default is None:
            return None
        # NaN is not equal to NaN, and a default can be NaN.
        return self.is_raw or not (
            self.value == self.default or (self.value != self.value and self.default != self.default)
        )

    def with_trust(self, trust: Trust) -> Param:
        """Return this parameter with another trust."""
        value = self.name, self.value, self.type, self.index, self.bits
        return Param(*value, trust, self.default, self.is_raw)

    def same_value(self, other: Param) -> bool:
        """Return whether both have the same value in the same type (−0 equals 0, NaN is compared by bits)."""
        return (
            self.type == other.type
            and self.is_raw == other.is_raw
            and same_bits(self.type, self.bits, other.bits)
        )

    def __str__(self) -> str:
        return f"{self.name} = {format_value(self.settable, 0 if self.is_raw else self.type)}"


_CUSTOM: Final = int(ParamType.CUSTOM)
_set_name, _set_value, _set_type, _set_index, _set_bits, *_set_rest = (
    vars(Param)[each.name].__set__ for each in fields(Param)
)
_set_trust, _set_default, _set_is_raw = _set_rest
_TYPES: Final = tuple(map(ParamType, range(TYPE_NUMBER_MAX + 1)))

# Constants for `decode_value`, which runs for every received value: enumeration members are slower than
# numbers.
_REAL32 = int(ParamType.REAL32)
_REAL64 = int(ParamType.REAL64)
_BYTEWISE = Encoding.BYTEWISE
_FITTING = {number: (1 << 8 * each.size) - 1 for number, each in _LAYOUT.items() if each.size <= 4}
_BOUNDS = {int(kind): kind.bounds for kind in ParamType if kind.is_integer}
TYPES_BY_NAME: Final = {kind.name: kind for kind in map(ParamType, _LAYOUT)}
"""The types of numbers, by name."""


def check_name(name: str) -> str:
    """Return a valid param_id, 1 to 16 printable ASCII characters, unchanged; else raise UsageError."""
    if not isinstance(name, str):
        raise UsageError(f"a parameter name is a string, not {type(name).__name__}")
    if not name:
        raise UsageError("a parameter name has at least one character")
    if not (name.isascii() and name.isprintable()):
        raise UsageError(f"parameter name {name!r:.200}: only printable ASCII characters are allowed")
    if len(name) > NAME_LENGTH:
        raise UsageError(
            f"parameter name {name!r:.200} has {len(name)} bytes; a param_id holds {NAME_LENGTH}"
        )
    return name


@lru_cache(maxsize=PORTABLE_NAMES_CACHED)
def is_portable_name(name: str) -> bool:
    """Return whether every format of parameter file can hold a name.

    A portable name has 1 to 16 printable ASCII characters, at least one of them a letter, and no space, `#`,
    `,`, `;` and `=`. The first character is neither `@` nor `/`, and the last is not `:`. Names of PX4 and
    ArduPilot consist of capitals, digits and `_`.
    """
    return _portable(name) is not None


def check_portable_name(name: str) -> str:
    """Check and return a parameter name.

    Raises:
        UsageError: the name is not a valid param_id, or not every format of file can hold it. The client
            ignores such names when a vehicle sends them.
    """
    if not is_portable_name(check_name(name)):
        raise UsageError(
            f"parameter name {name!r}: not every parameter file can hold it; a name has a letter, no space,"
            " none of # , ; = ; it begins with neither @ nor / and does not end with :"
        )
    return name


def check_value(value: Settable) -> Value:
    """Convert a caller's value to an int, a float or four raw bytes; else raise UsageError.

    Numbers of other libraries (numpy's, Decimal) are converted with `__index__` or `__float__`. Text is
    rejected: only the code that read the text knows its notation.
    """
    if isinstance(value, bytes):
        if len(value) != WIRE_SIZE:
            raise UsageError(f"raw bytes for a parameter are the 4 bytes of the message, not {len(value)}")
        return value
    if isinstance(value, str):
        raise UsageError(
            f"a parameter value is a number, not the text {value!r}. The number of a value's name is "
            "ParamInfo.parse(text), with the metadata of the parameter"
        )
    return check_number(value)


def check_number(value: object, wanted: str = "a parameter value is a number") -> int | float:
    """Convert a number, also of another library, to an int or a float.

    Raises:
        UsageError: it is no number in the range of a float64; the text says what is `wanted`.
    """
    try:
        if isinstance(value, SupportsIndex):
            float(number := value.__index__())  # OverflowError beyond its range
            return number
        if isinstance(value, SupportsFloat):
            return float(value)
    except (ArithmeticError, TypeError, ValueError) as error:
        raise UsageError(f"{wanted} in the range of a float32 or float64: {error}") from error
    raise UsageError(f"{wanted}, not {type(value).__name__}")


def decode_value(raw: bytes, number: int, encoding: Encoding) -> tuple[Value, int]:
    """Decode the four wire bytes of a value.

    Args:
        raw: exactly 4 bytes.
        number: param_type of the message.
        encoding: the component's encoding.

    Returns:
        The value, and its bits (see `Param.bits`).
    """
    bits, is_raw = bits_of_wire(raw, number, encoding)
    return from_bits(bits, number, is_raw=is_raw), bits


def bits_of_wire(raw: bytes, number: int, encoding: Encoding) -> tuple[int, bool]:
    """Return the bits of a value, as `decode_value` does, and whether the value stays raw bytes."""
    bits = int.from_bytes(raw, "little")
    if number == _REAL32:
        return bits, False
    if encoding is _BYTEWISE:
        mask = _FITTING.get(number)
        return (bits, True) if mask is None else (bits & mask, False)
    number32: float = _FLOAT32.unpack(raw)[0]
    if number == _REAL64:
        return int.from_bytes(_LAYOUT[ParamType.REAL64].pack(number32), "little"), False
    bounds = _BOUNDS.get(number)
    if bounds is not None and math.isfinite(number32):
        whole = int(number32)
        low, high = bounds
        if low <= whole <= high:
            return whole & (high - low), False  # high - low has as many ones as the type has bits
    return bits, True


def encoding_of(raw: bytes, number: int) -> Encoding | None:
    """Return the encoding that the four wire bytes of an integer show; None of 0, and of other types.

    A whole float32 that fits the type is cast: as bytes, it would be a number beyond 1,000,000,000. All else
    is byte by byte: as a float32, it would be a fraction, too large or no number.
    """
    bounds = _BOUNDS.get(number)
    if bounds is None or number >= ParamType.UINT64 or raw == bytes(WIRE_SIZE):
        return None
    number32: float = _FLOAT32.unpack(raw)[0]
    low, high = bounds
    # float32 rounds the largest up; a short type may be cast beyond its bounds, and its unused bytes be any.
    fits = low <= number32 <= high + 1 or (number < ParamType.UINT32 and abs(number32) <= 0xFFFFFF)
    return Encoding.C_CAST if fits and number32.is_integer() else Encoding.BYTEWISE


def encode_value(value: Value, number: int, encoding: Encoding) -> bytes:
    """Encode a value in the four wire bytes.

    Raises:
        UsageError: the value does not fit. A fraction for an integer type fits only in the C-cast encoding,
            where the vehicle converts it (ArduPilot truncates 1234.7 to 1234). An integer that a float32
            cannot hold exactly does not fit in the C-cast encoding. A 64-bit type does not fit in the
            byte-wise encoding, and an unknown type takes raw bytes only.
    """
    if isinstance(value, bytes):
        return value
    if encoding is Encoding.BYTEWISE:
        if _LAYOUT.get(number, _FLOAT32).size > WIRE_SIZE:
            raise UsageError(
                f"{ParamType(number).name} takes 8 bytes and PARAM_SET has 4; it cannot be written this way"
            )
        return bits_of(value, number).to_bytes(WIRE_SIZE, "little")
    value, kind = _number_of(value, number)
    raw = _to_float32(value, kind)
    if kind.is_integer:
        low, high = kind.bounds
        sent = _FLOAT32.unpack(raw)[0]
        if not math.isfinite(value):
            raise UsageError(f"{value!r} is not a whole number, and the parameter is {kind.name}")
        if not low <= int(value) <= high:
            raise UsageError(f"{value} does not fit {kind.name}, which holds {low} to {high}")
        if float(value).is_integer() and sent != value:
            raise UsageError(
                f"{value} cannot be sent exactly: this vehicle takes integers as float32, "
                f"and the nearest is {int(sent)}"
            )
        if not low <= int(sent) <= high:
            raise UsageError(f"{value!r} rounds to {sent!r} as float32; {kind.name} holds {low} to {high}")
    return raw


def as_reported(bits: int, number: int, encoding: Encoding) -> bytes:
    """Return the four wire bytes with which a vehicle reports a value of these bits and this type.

    Not the inverse of `decode_value`: a C-casting vehicle rounds integers beyond 24 bits to the next float32,
    and a message holds only the first four bytes of an 8-byte type.
    """
    if encoding is Encoding.C_CAST and number in _BOUNDS:
        return struct.pack("<f", from_bits(bits, number))
    return (bits & 0xFFFFFFFF).to_bytes(4, "little")


def from_bits(bits: int, number: int, *, is_raw: bool = False) -> Value:
    """Return the value with these bits: the inverse of `Param.bits`, for values kept on disk.

    Args:
        bits: as in `Param.bits`.
        number: param_type.
        is_raw: `Param.is_raw` of the parameter.
    """
    if number == _REAL32:
        return _shortest_of_bits(bits)
    if number == _CUSTOM and not is_raw:
        return _text_or_bytes(bits)
    layout = None if is_raw else _LAYOUT.get(number)
    if layout is None:
        return bits.to_bytes(max(WIRE_SIZE, byte_length(bits)), "little")
    value: int | float = layout.unpack(bits.to_bytes(layout.size, "little"))[0]
    return value


@lru_cache(maxsize=FLOATS_CACHED)
def _shortest_of_bits(bits: int) -> float:
    number: float = _FLOAT32.unpack(bits.to_bytes(4, "little"))[0]
    return shortest_float(number)


def byte_length(bits: int) -> int:
    """Return the number of bytes of a number without leading zeros."""
    return -(-bits.bit_length() // 8)


def _text_or_bytes(bits: int) -> str | bytes:
    """Return a CUSTOM value: text where its bytes are UTF-8 without control characters, else the bytes."""
    raw = bits.to_bytes(byte_length(bits), "little")
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        return raw
    return text if all(each.isprintable() or each in "\t\r\n" for each in text) else raw


def bits_of(value: Value, number: int) -> int:
    """Return the value's own bytes in its type, as a little-endian unsigned number.

    Raises:
        UsageError: the value does not fit the type.
    """
    if number == ParamType.CUSTOM:
        if not isinstance(value, str | bytes):
            raise UsageError(f"{value!r} is a number, and the parameter is CUSTOM")
        return int.from_bytes(value.encode() if isinstance(value, str) else value, "little")
    if isinstance(value, bytes):
        check_value(value)
        return int.from_bytes(value[: _LAYOUT.get(number, _FLOAT32).size], "little")
    value, kind = _number_of(value, number)
    if kind is ParamType.REAL32:
        return int.from_bytes(_to_float32(value, kind), "little")
    if kind is ParamType.REAL64:
        try:
            return int.from_bytes(_LAYOUT[kind].pack(value), "little")
        except struct.error:
            raise UsageError(f"{value} is beyond the range of REAL64") from None
    if isinstance(value, float) and not value.is_integer():
        raise UsageError(f"{value!r} is not a whole number, and the parameter is {kind.name}")
    low, high = kind.bounds
    if not low <= value <= high:
        raise UsageError(f"{value} does not fit {kind.name}, which holds {low} to {high}")
    return int(value) & (high - low)  # high - low has as many ones as the type has bits


def _number_of(value: Value, number: int) -> tuple[int | float, ParamType]:
    """Return a number and its type; UsageError for a value or a type that is no number."""
    if isinstance(value, str | bytes):
        raise UsageError(f"{value!r} is text, and the parameter is a number")
    if number not in _LAYOUT:
        raise UsageError(f"{ParamType(number).name} is not a type that MAVLink defines; give the 4 raw bytes")
    return check_number(value), ParamType(number)


def same_bits(number: int, a: int, b: int) -> bool:
    """Return whether two values of a type, given as bits, are equal: −0 equals 0, NaN equals only itself."""
    if a == b:
        return True
    if number == ParamType.REAL32:
        return a | b == 0x80000000
    return number == ParamType.REAL64 and a | b == 0x8000000000000000


def format_value(value: Value, number: int = ParamType.REAL32) -> str:
    """Return the shortest text that parses to the same value: floats as float32, raw bytes as hexadecimal,
    bytes of a CUSTOM value as `hex:ff00fe`."""
    if isinstance(value, bytes):
        is_custom = number == ParamType.CUSTOM
        return f"{HEX}{value.hex()}" if is_custom else f"0x{int.from_bytes(value, 'little'):08x}"
    if isinstance(value, int | str):
        return str(value)
    return repr(shortest_float(value) if number == ParamType.REAL32 else value)


def shortest_float(value: float) -> float:
    """Return the float with the shortest decimal form among those that round to the same float32."""
    if not abs(value) < _FLOAT32_END:
        return value
    same = _FLOAT32.pack(value)
    value = _FLOAT32.unpack(same)[0]
    # Floats are denser below a power of two: the middle of the rounding interval is slightly above value.
    points = (value, value * (1 + 2**-26)) if abs(math.frexp(value)[0]) == 0.5 else (value,)
    for digits in range(6 if abs(value) >= _FLOAT32_NORMAL else 1, 9):
        for point in points:
            candidate = float(f"{point:.{digits}g}")
            if abs(candidate) < _FLOAT32_END and _FLOAT32.pack(candidate) == same:
                return candidate
    return float(f"{value:.9g}")


_FLOAT32_END = 2.0**128 - 2.0**103
"""Upper bound: smaller floats round to a finite float32."""
_FLOAT32_NORMAL = 2.0**-126
"""Smallest normal float32: from here on, all decimals of up to 6 digits are different floats."""


def _to_float32(value: int | float, kind: ParamType) -> bytes:
    try:
        return _FLOAT32.pack(float(value))
    except OverflowError:
        raise UsageError(f"{value} is beyond the range of a float32, in which {kind.name} is sent") from None


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


def check_ext_value(value: Settable) -> Value:
    """Convert a caller's value to an int, a float, a str or bytes; else raise UsageError."""
    if not isinstance(value, bytes | str):
        return check_number(value, "an extended parameter is a number, text or bytes; a number")
    data = value if isinstance(value, bytes) else value.encode(errors="surrogatepass")
    if len(data) > EXT_VALUE_SIZE:
        raise UsageError(f"the value has {len(data)} bytes; an extended parameter holds {EXT_VALUE_SIZE}")
    if isinstance(value, str) and ("\0" in value or data != value.encode(errors="replace")):
        raise UsageError("text for an extended parameter is UTF-8 without NUL; give bytes for anything else")
    return value


def encode_ext_value(value: Value, number: int) -> bytes:
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


def parse_ext_value(name: str, text: str, number: int) -> Value:
    """Return the value that a text gives in a type: a number, text, or bytes after `hex:`.

    Raises:
        UsageError: the text is no value of this type.
    """
    try:
        value: Value = bytes.fromhex(text.removeprefix(HEX)) if text.startswith(HEX) else text
        if isinstance(value, str) and number in _SIZES:
            value = float(text) if number >= ParamType.REAL32 else int(text, 0)
    except ValueError:
        raise UsageError(f"{name}: {text!r} is not a value of type {ParamType(number).name}") from None
    try:
        encode_ext_value(check_ext_value(value), number)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None
    return value
