"""Values: both encodings, names and text; values of extended parameters."""

from __future__ import annotations

import math
import struct
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient.errors import UsageError
from paramclient.model import values
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Encoding, Param, ParamType, Trust, Value
from paramclient.protocol.dialect import PLAIN

BYTEWISE, C_CAST = Encoding.BYTEWISE, Encoding.C_CAST
INTEGERS = [kind for kind in ParamType if kind.is_integer]

SIGNALLING = [(0xFF800001, 0xFFBFFFFF), (0x7F800001, 0x7FBFFFFF)]
"""Bit patterns of signalling NaNs. As INT32: −8388607 to −4194305 and 2139095041 to 2143289343."""

EDGES = sorted(
    {
        (base + step) % 2**32
        for base in [*(edge for pair in SIGNALLING for edge in pair), 0, *(2**n for n in range(32))]
        for step in (-2, -1, 0, 1, 2)
    }
)

patterns = (
    st.integers(0, 2**32 - 1)
    | st.sampled_from(EDGES)
    | st.integers(*SIGNALLING[0])
    | st.integers(*SIGNALLING[1])
)
thorough = settings(max_examples=500, deadline=None)


def float32(pattern: int) -> float:
    number: float = struct.unpack("<f", pattern.to_bytes(4, "little"))[0]
    return number


def as_float32(value: float) -> float:
    number: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return number


def param(bits: int = 0x3F800000, value: Value = 1.0, kind: int = ParamType.REAL32, **more: Any) -> Param:
    return Param(**{"name": "P", "value": value, "type": kind, "index": 0, "bits": bits, **more})


# Types


@pytest.mark.parametrize("number", [0, 77, 255])
def test_a_param_of_an_unknown_type_has_a_number_and_is_raw(number: int) -> None:
    param = Param("X", b"\x01\x02\x03\x84", number, None, 0x84030201)
    assert (param.type, param.type.name) == (number, f"TYPE_{number}")
    assert (param.value, param.is_raw, param.settable) == (0x84030201, True, b"\x01\x02\x03\x84")
    assert str(param) == "X = 0x84030201"
    assert param == Param("X", 0x84030201, number, None, 0x84030201)
    assert param != Param("X", b"\x01\x02\x03\x84", 200, None, 0x84030201)


def test_a_plain_param_of_the_type_custom_is_raw() -> None:
    param = PLAIN.param("X", b"abc\n", 11, None, Encoding.BYTEWISE)
    assert (param.type, param.is_raw) == (11, True)
    assert (param.settable, str(param)) == (b"abc\n", "X = 0x0a636261")
    written = WrittenParam.of(param.with_trust(Trust.CACHED))
    assert (written.type, written.is_raw, written.settable) == (11, True, b"abc\n")


# Byte-wise


@thorough
@given(patterns)
def test_four_bytes_round_trip(pattern: int) -> None:
    """Decoding loses no bit of a 4-byte value, nor does encoding a value that is not raw."""
    raw = pattern.to_bytes(4, "little")
    for kind, layout in ((ParamType.UINT32, "<I"), (ParamType.INT32, "<i")):
        value, bits = values.decode_value(raw, kind, BYTEWISE)
        assert (value, bits) == (struct.unpack(layout, raw)[0], pattern)
        assert values.encode_value(value, kind, BYTEWISE) == raw
        assert values.from_bits(bits, kind) == value
    for encoding in Encoding:
        value, bits = values.decode_value(raw, ParamType.REAL32, encoding)
        assert isinstance(value, float)
        assert bits == pattern
        if math.isnan(value):
            assert math.isnan(values.from_bits(bits, ParamType.REAL32))  # type: ignore[arg-type]  # float, as the type is REAL32
            assert values.encode_value(raw, ParamType.REAL32, encoding) == raw
        else:
            assert values.encode_value(value, ParamType.REAL32, encoding) == raw
            assert values.from_bits(bits, ParamType.REAL32) == value


@pytest.mark.parametrize(
    ("kind", "raw", "value", "bits"),
    [
        (ParamType.UINT8, "c8000000", 200, 0xC8),
        (ParamType.INT8, "c8000000", -56, 0xC8),
        (ParamType.UINT16, "50c30000", 50000, 0xC350),
        (ParamType.INT16, "50c30000", -15536, 0xC350),
        (ParamType.UINT32, "006cdc02", 48000000, 0x02DC6C00),
        (ParamType.INT32, "c0b4b3ff", -5000000, 0xFFB3B4C0),
        (ParamType.REAL32, "0000c040", 6.0, 0x40C00000),
    ],
)
def test_bytewise_encodes_in_the_first_bytes(kind: ParamType, raw: str, value: float, bits: int) -> None:
    assert values.decode_value(bytes.fromhex(raw), kind, BYTEWISE) == (value, bits)
    assert values.encode_value(value, kind, BYTEWISE) == bytes.fromhex(raw)


# C-cast


@pytest.mark.parametrize(
    ("kind", "number", "value"),
    [
        (ParamType.UINT8, 255.99, 255),
        (ParamType.UINT8, -0.99, 0),
        (ParamType.INT8, -129.0, None),
        (ParamType.INT16, 1234.7, 1234),
        (ParamType.UINT32, 4294967040.0, 4294967040),
        (ParamType.UINT32, 4294967296.0, None),
        (ParamType.INT32, 2147483520.0, 2147483520),
        (ParamType.INT32, -2147483648.0, -2147483648),
        (ParamType.UINT64, float(2**64), None),
        (ParamType.INT64, -float(2**63), -(2**63)),
        *((kind, number, None) for kind in INTEGERS for number in (math.nan, math.inf, -math.inf)),
    ],
)
def test_c_cast_decodes_to_an_integer_or_stays_raw(kind: ParamType, number: float, value: int | None) -> None:
    raw = struct.pack("<f", number)
    read, bits = values.decode_value(raw, kind, C_CAST)
    if value is None:
        assert (read, bits) == (raw, int.from_bytes(raw, "little"))
        assert values.from_bits(bits, kind, is_raw=True) == raw
    else:
        assert type(read) is int
        assert read == value
        assert bits == value % 2 ** (8 * kind.size)
        assert values.from_bits(bits, kind) == value


@thorough
@given(st.sampled_from(INTEGERS), st.data())
def test_c_cast_encodes_an_integer_exactly_or_rejects_it(kind: ParamType, data: st.DataObject) -> None:
    low, high = kind.bounds
    near = st.sampled_from([sign * 2**n + step for n in range(65) for sign in (-1, 1) for step in (-1, 0, 1)])
    value = data.draw(st.integers(low, high) | near.filter(lambda v: low <= v <= high))
    if as_float32(value) == value:
        raw = values.encode_value(value, kind, C_CAST)
        assert raw == struct.pack("<f", value)
        assert values.decode_value(raw, kind, C_CAST)[0] == value
        assert values.encode_value(float(value), kind, C_CAST) == raw
    else:
        assert abs(value) > 2**24
        with pytest.raises(UsageError, match=f"nearest is {int(as_float32(value))}"):
            values.encode_value(value, kind, C_CAST)


@pytest.mark.parametrize("kind", INTEGERS)
def test_c_cast_sends_a_fraction_unchanged(kind: ParamType) -> None:
    assert kind.size > 2 or values.encoding_of(struct.pack("<f", -1e6), kind) is C_CAST  # it does not fit
    assert kind.size > 4 or values.encoding_of(b"\x01UUU", kind) is BYTEWISE  # unused bytes may be any
    assert values.encode_value(12.7, kind, C_CAST) == struct.pack("<f", 12.7)
    assert values.decode_value(values.encode_value(12.7, kind, C_CAST), kind, C_CAST) == (12, 12)


def test_a_real64_is_sent_as_float32_only_by_a_c_cast() -> None:
    raw = struct.pack("<f", 0.1)
    value, bits = values.decode_value(raw, ParamType.REAL64, C_CAST)
    assert (value, values.from_bits(bits, ParamType.REAL64)) == (as_float32(0.1), value)
    assert values.encode_value(0.1, ParamType.REAL64, C_CAST) == raw
    assert values.decode_value(raw, ParamType.REAL64, BYTEWISE) == (raw, int.from_bytes(raw, "little"))


@pytest.mark.parametrize("encoding", Encoding)
def test_real32_rounds_keeps_infinities_and_rejects_overflow(encoding: Encoding) -> None:
    assert values.encode_value(0.1, ParamType.REAL32, encoding) == bytes.fromhex("cdcccc3d")
    assert values.encode_value(1, ParamType.REAL32, encoding) == struct.pack("<f", 1.0)
    assert values.encode_value(-math.inf, ParamType.REAL32, encoding) == bytes.fromhex("000080ff")
    assert math.isnan(struct.unpack("<f", values.encode_value(math.nan, ParamType.REAL32, encoding))[0])
    for value in (3.5e38, -3.5e38, 10**400):
        with pytest.raises(UsageError, match="float32"):
            values.encode_value(value, ParamType.REAL32, encoding)


# Arguments of callers


NO_VALUES = (b"", b"\0\0\0", bytes(5), "6", None, [1], 1j, Decimal("sNaN"), Fraction(10**400), 10**400)


@pytest.mark.parametrize(
    ("check", "argument", "words"),
    [
        (values.check_name, "", "at least one"),
        (values.check_name, "SEVENTEEN_LETTERS", "17 bytes"),
        *((values.check_name, name, "ASCII") for name in ("GRÖSSE", "A\0B", "A\n", "\x7f")),
        (values.check_name, b"BYTES", "not bytes"),
        (values.check_name, None, "not NoneType"),
        *((values.check_value, each, "parameter") for each in NO_VALUES),
        (values.check_ext_value, "x" * 129, "129 bytes; an extended parameter holds 128"),
        (values.check_ext_value, "a\0b", "without NUL"),
        (values.check_ext_value, "\ud800", "UTF-8"),
        (values.check_ext_value, None, "not NoneType"),
        (values.check_ext_value, Decimal("sNaN"), "number in the range of a float"),
        (lambda value: values.encode_value(value, ParamType.REAL64, BYTEWISE), 0.5, "takes 8 bytes"),
        (
            lambda value: values.encode_value(value, ParamType.UINT8, C_CAST),
            256,
            "UINT8, which holds 0 to 255",
        ),
        (lambda value: values.encode_value(value, 77, C_CAST), 5, "not a type that MAVLink defines"),
        (lambda value: values.encode_ext_value(value, ParamType.UINT8), "tea", "'tea' is not a number"),
        (lambda value: values.encode_ext_value(value, ParamType.CUSTOM), 5, "5 is not text or bytes"),
        (lambda value: values.encode_ext_value(value, 77), "tea", "'tea' is not bytes"),
    ],
)
def test_invalid_names_and_values_are_refused(check: Any, argument: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        check(argument)


# Param


@thorough
@given(patterns, patterns)
def test_same_bits_compares_numbers_by_value_and_nans_by_bits(a: int, b: int) -> None:
    for one, other in ((a, b), (a, a), (a, a ^ 0x80000000)):
        first, second = float32(one), float32(other)
        equal = one == other if math.isnan(first) or math.isnan(second) else first == second
        assert values.same_bits(ParamType.REAL32, one, other) == equal
        assert values.same_bits(ParamType.INT32, one, other) == (one == other)


# Text


def fewest_digits(value: float) -> int:
    """Return the fewest decimal digits that identify a float32, by trying the decimals on both sides."""
    wanted = struct.pack("<f", value)
    for digits in range(1, 10):
        for rounding in (ROUND_FLOOR, ROUND_CEILING):
            decimal = Context(digits, rounding).create_decimal(Decimal(value))
            if abs(decimal) < Decimal(2**128 - 2**103) and struct.pack("<f", float(decimal)) == wanted:
                return digits
    raise AssertionError(f"{value!r} needs more than 9 digits")


@thorough
@given(patterns)
def test_format_value_is_the_shortest_round_trip(pattern: int) -> None:
    value = float32(pattern)
    text = values.format_value(value)
    if math.isfinite(value):
        assert struct.pack("<f", float(text)) == struct.pack("<f", value)
        assert len("".join(map(str, Decimal(text).as_tuple().digits)).strip("0")) <= fewest_digits(value)
    else:
        assert text == repr(value)


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (as_float32(0.1), ParamType.REAL32, "0.1"),
        (-0.0, ParamType.REAL32, "-0.0"),
        (float32(0x7F7FFFFF), ParamType.REAL32, "3.4028235e+38"),
        (float32(1), ParamType.REAL32, "1e-45"),
        (math.nan, ParamType.REAL32, "nan"),
        (1e300, ParamType.REAL32, "1e+300"),
        (0.1, ParamType.REAL64, "0.1"),
        (as_float32(0.1), ParamType.REAL64, "0.10000000149011612"),
        (-5000000, ParamType.INT32, "-5000000"),
        (b"\x01\x00\x80\x7f", ParamType.INT64, "0x7f800001"),
    ],
)
def test_format_value(value: Value, kind: ParamType, text: str) -> None:
    assert values.format_value(value, kind) == text


KINDS = ParamType


@pytest.mark.parametrize(
    ("number", "value", "raw"),
    [
        (KINDS.UINT8, 255, b"\xff"),
        (KINDS.INT16, -2, b"\xfe\xff"),
        (KINDS.INT32, -5_000_000, struct.pack("<i", -5_000_000)),
        (KINDS.UINT64, 2**64 - 1, b"\xff" * 8),
        (KINDS.INT64, -(2**63), bytes(7) + b"\x80"),
        (KINDS.REAL32, 0.5, struct.pack("<f", 0.5)),
        (KINDS.REAL64, 0.1, struct.pack("<d", 0.1)),
        (KINDS.CUSTOM, "", b""),
        (KINDS.CUSTOM, "Kamera für vorn", "Kamera für vorn".encode()),
        (KINDS.CUSTOM, "two\nlines\t", b"two\nlines\t"),
        (KINDS.CUSTOM, b"a\0b", b"a\0b"),
        (77, b"\x01\x02", b"\x01\x02"),
        (0, b"", b""),
    ],
)
def test_values_of_every_type(number: int, value: Value, raw: bytes) -> None:
    assert values.encode_ext_value(value, number) == raw
    param = values.ext_param("A", raw.ljust(values.EXT_VALUE_SIZE, b"\0"), number, 3)
    assert (param.name, param.type, param.index) == ("A", number, 3)
    assert values.ext_bytes(param) == values.encode_ext_value(param.settable, number) == raw
    assert type(param.settable) is type(value)
    assert param.is_raw == (ParamType(number).name == f"TYPE_{number}")
    assert param.is_raw or param.value == value
    assert values.ext_param("A", raw, number, 3) == param


@given(st.binary(max_size=128))
def test_every_custom_value_can_be_set_again(data: bytes) -> None:
    param = values.ext_param("A", data.ljust(128, b"\0"), KINDS.CUSTOM)
    assert values.encode_ext_value(param.value, KINDS.CUSTOM) == values.ext_bytes(param) == data.rstrip(b"\0")
    if isinstance(param.value, str):
        assert values.check_ext_value(param.value) == param.value
