"""Values: both encodings, names and text."""

from __future__ import annotations

import math
import struct
from dataclasses import FrozenInstanceError, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from pymavlink.mavparm import MAVParmDict

from paramclient.errors import UsageError
from paramclient.model.comparison import same_value
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Trust,
    WireValue,
    bits_of,
    check_name,
    check_value,
    decode_value,
    encode_value,
    format_value,
    from_bits,
    known_type,
    same_bits,
    shortest_float,
    type_name,
    type_of_name,
)

BYTEWISE, C_CAST = Encoding.BYTEWISE, Encoding.C_CAST
KNOWN = [kind for kind in ParamType if kind is not ParamType.UNKNOWN]
INTEGERS = [kind for kind in ParamType if kind.is_integer]
SMALL = [kind for kind in INTEGERS if kind.size <= 4]
WIDE = [ParamType.UINT64, ParamType.INT64, ParamType.REAL64]
UNDEFINED = [0, 11, 77, 255]

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


def param(bits: int = 0x3F800000, value: WireValue = 1.0, kind: int = ParamType.REAL32, **more: Any) -> Param:
    return Param(**{"name": "P", "value": value, "type": kind, "index": 0, "bits": bits, **more})


# Types


def test_types_have_mavlinks_numbers_and_names() -> None:
    for kind in KNOWN:
        assert getattr(dialect, f"MAV_PARAM_TYPE_{kind.name}") == kind
        assert known_type(int(kind)) is kind
        assert type_name(kind) == kind.name
        assert type_of_name(kind.name) is kind
    assert len(KNOWN) == dialect.MAV_PARAM_TYPE_ENUM_END - 1


def test_sizes_and_bounds() -> None:
    assert [kind.size for kind in KNOWN] == [1, 1, 2, 2, 4, 4, 8, 8, 4, 8]
    assert [kind.bounds for kind in INTEGERS] == [
        (0, 255),
        (-128, 127),
        (0, 65535),
        (-32768, 32767),
        (0, 4294967295),
        (-2147483648, 2147483647),
        (0, 18446744073709551615),
        (-9223372036854775808, 9223372036854775807),
    ]


@pytest.mark.parametrize("number", UNDEFINED)
def test_an_unknown_type_keeps_its_number(number: int) -> None:
    assert known_type(number) == number
    assert not isinstance(known_type(number), ParamType)
    assert type_name(number) == f"TYPE_{number}"
    assert type_of_name(f"TYPE_{number}") == number


@pytest.mark.parametrize("number", UNDEFINED)
def test_a_param_of_an_unknown_type_has_a_number_and_is_raw(number: int) -> None:
    param = Param("X", b"\x01\x02\x03\x84", number, None, 0x84030201)
    assert (param.type, param.type_number) == (ParamType.UNKNOWN, number)
    assert (param.value, param.is_raw, param.settable) == (0x84030201, True, b"\x01\x02\x03\x84")
    assert str(param) == "X = 0x84030201"
    assert param == Param("X", 0x84030201, number, None, 0x84030201)
    assert param != Param("X", b"\x01\x02\x03\x84", 200, None, 0x84030201)


def test_copies_of_a_param_keep_its_type_and_whether_it_is_raw() -> None:
    unknown = Param("X", b"abcd", 77, None, 0x64636261)
    misfit = Param("Y", b"\0\0\x80\x7f", ParamType.INT32, None, 0x7F800000)
    for param in (unknown, misfit):
        assert (copy := param.with_trust(Trust.CACHED)) == replace(param, trust=Trust.CACHED) != param
        assert (copy.type_number, copy.value, copy.settable, copy.is_raw) == (
            *(param.type_number, param.value, param.settable),
            True,
        )
    assert (misfit.type, misfit.value) == (ParamType.INT32, 0x7F800000)
    assert replace(unknown, type=ParamType.INT32).type_number == ParamType.INT32
    assert not misfit.same_value(Param("Y", 0x7F800000, ParamType.INT32, None, 0x7F800000))


def test_the_number_of_a_raw_value_is_written_nowhere_as_a_number() -> None:
    raw = WrittenParam.of(Param("X", b"\0\0\x80\x7f", ParamType.INT32, None, 0x7F800000))
    assert (raw.value, raw.is_raw, raw.settable) == (0x7F800000, True, b"\0\0\x80\x7f")
    assert str(raw) == "X = 0x7f800000"
    assert not raw.is_held_by(Param("X", 0x7F800000, ParamType.INT32, None, 0x7F800000))
    assert not same_value(raw, WrittenParam("X", 0x7F800000, ParamType.INT32))
    assert replace(raw, comment="c") == WrittenParam("X", b"\0\0\x80\x7f", ParamType.INT32, comment="c")


# Byte-wise


def check_four_bytes(pattern: int) -> None:
    """Assert that decoding loses no bit of a 4-byte value, nor does encoding a value that is not raw."""
    raw = pattern.to_bytes(4, "little")
    for kind, layout in ((ParamType.UINT32, "<I"), (ParamType.INT32, "<i")):
        value, bits = decode_value(raw, kind, BYTEWISE)
        assert (value, bits) == (struct.unpack(layout, raw)[0], pattern)
        assert encode_value(value, kind, BYTEWISE) == raw
        assert from_bits(bits, kind) == value
    for encoding in Encoding:
        value, bits = decode_value(raw, ParamType.REAL32, encoding)
        assert isinstance(value, float)
        assert bits == pattern
        if math.isnan(value):
            assert math.isnan(from_bits(bits, ParamType.REAL32))  # type: ignore[arg-type]  # float, as the type is REAL32
            assert encode_value(raw, ParamType.REAL32, encoding) == raw
        else:
            assert encode_value(value, ParamType.REAL32, encoding) == raw
            assert from_bits(bits, ParamType.REAL32) == value


def test_four_bytes_round_trip_at_edge_values() -> None:
    for pattern in EDGES:
        check_four_bytes(pattern)


@thorough
@given(patterns)
def test_four_bytes_round_trip(pattern: int) -> None:
    check_four_bytes(pattern)


def test_signalling_nan_bytes_are_not_decoded_through_a_float() -> None:
    raw = (-5000000).to_bytes(4, "little", signed=True)
    through_a_float = struct.pack("<f", struct.unpack("<f", raw)[0])
    assert int.from_bytes(through_a_float, "little", signed=True) == -805696
    assert decode_value(raw, ParamType.INT32, BYTEWISE)[0] == -5000000
    assert encode_value(-5000000, ParamType.INT32, BYTEWISE) == raw


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
def test_bytewise_encodes_the_value_in_the_first_bytes(
    kind: ParamType, raw: str, value: float, bits: int
) -> None:
    assert decode_value(bytes.fromhex(raw), kind, BYTEWISE) == (value, bits)
    assert encode_value(value, kind, BYTEWISE) == bytes.fromhex(raw)


@thorough
@given(st.sampled_from(SMALL), patterns)
def test_bytewise_ignores_bytes_after_a_small_type(kind: ParamType, pattern: int) -> None:
    raw = pattern.to_bytes(4, "little")
    own = raw[: kind.size]
    value, bits = decode_value(raw, kind, BYTEWISE)
    assert value == int.from_bytes(own, "little", signed=kind.bounds[0] < 0)
    assert bits == int.from_bytes(own, "little")
    assert encode_value(value, kind, BYTEWISE) == own.ljust(4, b"\0")
    assert from_bits(bits, kind) == value


@thorough
@given(st.sampled_from(SMALL), st.data())
def test_bytewise_integers_are_packed_as_pymavlink_packs_them(kind: ParamType, data: st.DataObject) -> None:
    value = data.draw(st.integers(*kind.bounds))
    raw = encode_value(value, kind, BYTEWISE)
    if any(low <= int.from_bytes(raw, "little") <= high for low, high in SIGNALLING):
        return  # pymavlink converts the bytes through a float, which changes these
    sent: list[bytes] = []

    def param_set_send(name: str, number: float, parm_type: int) -> None:
        message = dialect.MAVLink_param_set_message(1, 1, name.encode(), number, parm_type)
        sent.append(message.pack(dialect.MAVLink(None), force_mavlink1=True)[6:10])

    vehicle = SimpleNamespace(
        param_set_send=param_set_send, recv_match=lambda **_: SimpleNamespace(param_id="P")
    )
    MAVParmDict().mavset(vehicle, "P", value, parm_type=int(kind))
    assert sent == [raw]


@pytest.mark.parametrize("kind", [*WIDE, *UNDEFINED])
@pytest.mark.parametrize("pattern", [0, 1, 0x7F800001, 0xFFFFFFFF])
def test_bytewise_keeps_wide_and_unknown_types_raw(kind: int, pattern: int) -> None:
    raw = pattern.to_bytes(4, "little")
    assert decode_value(raw, kind, BYTEWISE) == (raw, pattern)
    assert encode_value(raw, kind, BYTEWISE) == raw
    assert from_bits(pattern, kind, is_raw=True) == raw
    assert format_value(raw, kind) == f"0x{pattern:08x}"
    with pytest.raises(UsageError, match=r"8 bytes|not a type"):
        encode_value(1, kind, BYTEWISE)


@pytest.mark.parametrize("number", UNDEFINED)
def test_an_unknown_type_is_kept_raw_in_c_cast_too(number: int) -> None:
    raw = b"\x01\x02\x03\x04"
    assert decode_value(raw, number, C_CAST) == (raw, 0x04030201)
    assert encode_value(raw, number, C_CAST) == raw
    assert from_bits(0x04030201, number) == raw
    with pytest.raises(UsageError, match=f"TYPE_{number}"):
        encode_value(1.0, number, C_CAST)


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("encoding", Encoding)
def test_encode_rejects_an_integer_outside_the_type(kind: ParamType, encoding: Encoding) -> None:
    low, high = kind.bounds
    for value in (low - 1, high + 1, float(low) - 1, float(high) + 1, 10**400):
        with pytest.raises(UsageError, match=kind.name):
            encode_value(value, kind, encoding)


@pytest.mark.parametrize("kind", INTEGERS)
@pytest.mark.parametrize("encoding", Encoding)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_encode_rejects_non_finite_integers(kind: ParamType, encoding: Encoding, value: float) -> None:
    with pytest.raises(UsageError, match="not a whole number"):
        encode_value(value, kind, encoding)


@pytest.mark.parametrize("kind", SMALL)
def test_bytewise_accepts_whole_floats_and_rejects_fractions(kind: ParamType) -> None:
    assert encode_value(6.0, kind, BYTEWISE) == b"\x06\0\0\0"
    assert encode_value(-0.0, kind, BYTEWISE) == bytes(4)
    with pytest.raises(UsageError, match=r"1\.5 is not a whole number"):
        encode_value(1.5, kind, BYTEWISE)


# C-cast


@pytest.mark.parametrize(
    ("kind", "number", "value"),
    [
        (ParamType.UINT8, 255.0, 255),
        (ParamType.UINT8, 255.99, 255),
        (ParamType.UINT8, 256.0, None),
        (ParamType.UINT8, -0.99, 0),
        (ParamType.UINT8, -1.0, None),
        (ParamType.INT8, -128.0, -128),
        (ParamType.INT8, -129.0, None),
        (ParamType.INT8, 128.0, None),
        (ParamType.UINT16, 65535.0, 65535),
        (ParamType.UINT16, 65536.0, None),
        (ParamType.INT16, -32768.0, -32768),
        (ParamType.INT16, 32768.0, None),
        (ParamType.INT16, 1234.7, 1234),
        (ParamType.UINT32, 4294967040.0, 4294967040),
        (ParamType.UINT32, 4294967296.0, None),
        (ParamType.INT32, 2147483520.0, 2147483520),
        (ParamType.INT32, 2147483648.0, None),
        (ParamType.INT32, -2147483648.0, -2147483648),
        (ParamType.INT32, -2147483904.0, None),
        (ParamType.UINT64, float(2**63), 2**63),
        (ParamType.UINT64, float(2**64), None),
        (ParamType.INT64, -float(2**63), -(2**63)),
        (ParamType.INT64, float(2**63), None),
        *((kind, number, None) for kind in INTEGERS for number in (math.nan, math.inf, -math.inf)),
    ],
)
def test_c_cast_decodes_to_the_integer_or_stays_raw(
    kind: ParamType, number: float, value: int | None
) -> None:
    raw = struct.pack("<f", number)
    read, bits = decode_value(raw, kind, C_CAST)
    if value is None:
        assert (read, bits) == (raw, int.from_bytes(raw, "little"))
        assert from_bits(bits, kind, is_raw=True) == raw
    else:
        assert type(read) is int
        assert read == value
        assert bits == value % 2 ** (8 * kind.size)
        assert from_bits(bits, kind) == value


@thorough
@given(st.sampled_from(INTEGERS), st.data())
def test_c_cast_encodes_an_integer_exactly_or_rejects_it(kind: ParamType, data: st.DataObject) -> None:
    low, high = kind.bounds
    near = st.sampled_from([sign * 2**n + step for n in range(65) for sign in (-1, 1) for step in (-1, 0, 1)])
    value = data.draw(st.integers(low, high) | near.filter(lambda v: low <= v <= high))
    if as_float32(value) == value:
        raw = encode_value(value, kind, C_CAST)
        assert raw == struct.pack("<f", value)
        assert decode_value(raw, kind, C_CAST)[0] == value
        assert encode_value(float(value), kind, C_CAST) == raw
    else:
        assert abs(value) > 2**24
        with pytest.raises(UsageError, match=f"nearest is {int(as_float32(value))}"):
            encode_value(value, kind, C_CAST)


def test_c_cast_is_exact_up_to_24_bits() -> None:
    for value in (2**24, -(2**24), 2**24 + 2):
        assert decode_value(encode_value(value, ParamType.INT32, C_CAST), ParamType.INT32, C_CAST)[0] == value
    for wrong in (2**24 + 1, -(2**24) - 1, 16777217.0):
        with pytest.raises(UsageError, match="exactly"):
            encode_value(wrong, ParamType.INT32, C_CAST)


@pytest.mark.parametrize("kind", INTEGERS)
def test_c_cast_sends_a_fraction_unchanged(kind: ParamType) -> None:
    assert encode_value(12.7, kind, C_CAST) == struct.pack("<f", 12.7)
    assert decode_value(encode_value(12.7, kind, C_CAST), kind, C_CAST) == (12, 12)


@pytest.mark.parametrize(
    ("value", "kind"),
    [(255.9999999, ParamType.UINT8), (-128.9999999, ParamType.INT8), (-0.99999999, ParamType.UINT16)],
)
def test_encode_rejects_a_fraction_that_rounds_out_of_the_type(value: float, kind: ParamType) -> None:
    with pytest.raises(UsageError, match="rounds to"):
        encode_value(value, kind, C_CAST)


def test_c_cast_encodes_real64_as_float32() -> None:
    raw = struct.pack("<f", 0.1)
    value, bits = decode_value(raw, ParamType.REAL64, C_CAST)
    assert value == as_float32(0.1)
    assert bits == int.from_bytes(struct.pack("<d", as_float32(0.1)), "little")
    assert from_bits(bits, ParamType.REAL64) == value
    assert encode_value(0.1, ParamType.REAL64, C_CAST) == raw


@thorough
@given(st.floats(width=32, allow_nan=False), st.sampled_from(Encoding))
def test_real32_is_packed_as_pymavlink_packs_it(value: float, encoding: Encoding) -> None:
    message = dialect.MAVLink_param_value_message(b"P", value, ParamType.REAL32, 1, 0)
    raw = message.pack(dialect.MAVLink(None), force_mavlink1=True)[6:10]
    assert encode_value(value, ParamType.REAL32, encoding) == raw
    assert decode_value(raw, ParamType.REAL32, encoding)[0] == value


@pytest.mark.parametrize("encoding", Encoding)
def test_real32_rounds_keeps_infinities_and_rejects_overflow(encoding: Encoding) -> None:
    assert encode_value(0.1, ParamType.REAL32, encoding) == bytes.fromhex("cdcccc3d")
    assert encode_value(1, ParamType.REAL32, encoding) == struct.pack("<f", 1.0)
    assert encode_value(-math.inf, ParamType.REAL32, encoding) == bytes.fromhex("000080ff")
    assert math.isnan(struct.unpack("<f", encode_value(math.nan, ParamType.REAL32, encoding))[0])
    for value in (3.5e38, -3.5e38, 10**400):
        with pytest.raises(UsageError, match="float32"):
            encode_value(value, ParamType.REAL32, encoding)


# Arguments of callers


@pytest.mark.parametrize("name", ["A", "MC_ROLL_P", "_HASH_CHECK", "SIXTEEN_LETTERS_", "lower", "A B"])
def test_check_name_accepts(name: str) -> None:
    assert check_name(name) == name


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("", "at least one"),
        ("SEVENTEEN_LETTERS", "17 bytes"),
        ("GRÖSSE", "ASCII"),
        ("A\0B", "ASCII"),
        ("A\n", "ASCII"),
        ("\x7f", "ASCII"),
        (b"BYTES", "not bytes"),
        (None, "not NoneType"),
    ],
)
def test_check_name_rejects(name: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        check_name(name)


class Indexable:
    def __index__(self) -> int:
        return 7


@pytest.mark.parametrize(
    ("given_value", "value"),
    [
        (3, 3),
        (True, 1),
        (ParamType.INT32, 6),
        (Indexable(), 7),
        (2.5, 2.5),
        (Decimal("2.5"), 2.5),
        (Fraction(5, 2), 2.5),
        (b"\x01\x02\x03\x04", b"\x01\x02\x03\x04"),
    ],
)
def test_check_value_accepts_numbers_of_other_libraries(given_value: Any, value: WireValue) -> None:
    checked = check_value(given_value)
    assert checked == value
    assert type(checked) is type(value)


@pytest.mark.parametrize(
    "given_value",
    [b"", b"\0\0\0", b"\0\0\0\0\0", "6", None, [1], 1j, Decimal("sNaN"), Fraction(10**400), bytearray(4)],
)
def test_check_value_rejects(given_value: Any) -> None:
    with pytest.raises(UsageError, match="parameter"):
        check_value(given_value)


# Param


def test_a_param_is_immutable() -> None:
    with pytest.raises(FrozenInstanceError):
        param().value = 2.0  # type: ignore[misc]  # must fail
    assert not hasattr(param(), "__dict__")


def test_equality_compares_bits_so_nan_equals_itself() -> None:
    one, other = param(0x7FC00000, math.nan), param(0x7FC00000, float("nan"))
    assert one == other
    assert hash(one) == hash(other)
    assert one != param(0x7FC00001, math.nan)
    for difference in ({"name": "Q"}, {"index": 1}, {"index": None}, {"trust": Trust.CACHED}):
        assert param() != param(**difference)


def test_with_trust() -> None:
    live = param()
    assert live.trust is Trust.LIVE
    assert live.with_trust(Trust.LIVE) is live
    cached = live.with_trust(Trust.CACHED)
    assert cached.trust is Trust.CACHED
    assert cached.with_trust(Trust.LIVE) == live
    assert live.same_value(cached)


def test_same_value() -> None:
    assert param(0, 0.0).same_value(param(0x80000000, -0.0, name="Q", index=None))
    assert not param(0, 0, ParamType.INT32).same_value(param(0x80000000, -(2**31), ParamType.INT32))
    assert not param(1, 1, ParamType.UINT8).same_value(param(1, 1, ParamType.INT8))
    raw = decode_value(struct.pack("<f", 2.0**32), ParamType.UINT32, C_CAST)
    number = decode_value(struct.pack("<f", float(raw[1])), ParamType.UINT32, C_CAST)
    assert raw[1] == number[1]
    assert not param(raw[1], raw[0], ParamType.UINT32).same_value(
        param(number[1], number[0], ParamType.UINT32)
    )


def test_is_raw_and_text_of_raw_values() -> None:
    raw = param(0x04030201, b"\x01\x02\x03\x04", 77)
    assert raw.is_raw
    assert str(raw) == "P = 0x04030201"
    assert not param().is_raw
    assert str(param(bits=0x3DCCCCCD, value=as_float32(0.1))) == "P = 0.1"
    assert str(param(bits=6, value=6, kind=ParamType.INT32)) == "P = 6"


@thorough
@given(patterns, patterns)
def test_same_bits_compares_numbers_by_value_and_nans_by_bits(a: int, b: int) -> None:
    for one, other in ((a, b), (a, a), (a, a ^ 0x80000000)):
        first, second = float32(one), float32(other)
        equal = one == other if math.isnan(first) or math.isnan(second) else first == second
        assert same_bits(ParamType.REAL32, one, other) == equal
        assert same_bits(ParamType.INT32, one, other) == (one == other)


def test_same_bits_of_real64_zeros() -> None:
    assert same_bits(ParamType.REAL64, 0, 1 << 63)
    assert not same_bits(ParamType.REAL64, 0, 0x80000000)
    assert not same_bits(ParamType.REAL32, 0, 1 << 63)


@pytest.mark.parametrize("number", KNOWN)
def test_bits_of_rejects_a_number_beyond_the_type(number: ParamType) -> None:
    with pytest.raises(UsageError, match=number.name):
        bits_of(10**400, number)


@pytest.mark.parametrize("number", INTEGERS)
def test_bits_of_a_whole_float_are_those_of_the_integer(number: ParamType) -> None:
    assert bits_of(44.0, number) == bits_of(44, number) == 44
    for value in (1.5, math.inf, math.nan):
        with pytest.raises(UsageError, match="not a whole number"):
            bits_of(value, number)


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


def check_text(pattern: int) -> None:
    value = float32(pattern)
    text = format_value(value)
    if math.isfinite(value):
        assert struct.pack("<f", float(text)) == struct.pack("<f", value)
        digits = Decimal(text).as_tuple().digits
        assert len("".join(map(str, digits)).strip("0")) <= fewest_digits(value)
    else:
        assert text == repr(value)


@thorough
@given(patterns)
def test_format_value_is_the_shortest_round_trip(pattern: int) -> None:
    check_text(pattern)


def test_format_value_at_powers_of_two_and_subnormals() -> None:
    for pattern in (*(exponent << 23 for exponent in range(256)), *range(64), 0x7F7FFFFF, 0x007FFFFF):
        check_text(pattern)
        check_text(pattern | 0x80000000)


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (as_float32(0.1), ParamType.REAL32, "0.1"),
        (6.0, ParamType.REAL32, "6.0"),
        (-0.0, ParamType.REAL32, "-0.0"),
        (16777216.0, ParamType.REAL32, "16777216.0"),
        (float32(0x7F7FFFFF), ParamType.REAL32, "3.4028235e+38"),
        (float32(1), ParamType.REAL32, "1e-45"),
        (float32(0x6C800000), ParamType.REAL32, "1.2379401e+27"),
        (math.inf, ParamType.REAL32, "inf"),
        (math.nan, ParamType.REAL32, "nan"),
        (1e300, ParamType.REAL32, "1e+300"),
        (0.1, ParamType.REAL64, "0.1"),
        (as_float32(0.1), ParamType.REAL64, "0.10000000149011612"),
        (-5000000, ParamType.INT32, "-5000000"),
        (b"\x01\x00\x80\x7f", ParamType.INT64, "0x7f800001"),
    ],
)
def test_format_value(value: WireValue, kind: ParamType, text: str) -> None:
    assert format_value(value, kind) == text


def test_format_value_rounds_a_float_to_float32() -> None:
    assert shortest_float(0.1) == 0.1
    assert shortest_float(0.10000000149) == 0.1
    assert shortest_float(1 / 3) == 0.33333334


def test_repr_has_the_number_of_the_type_only_where_the_type_is_unknown() -> None:
    known = Param("A", 1.5, ParamType.REAL32, 3, 0x3FC00000)
    assert repr(known) == (
        "Param(name='A', value=1.5, type=<ParamType.REAL32: 9>, index=3, bits=1069547520, "
        "trust=<Trust.LIVE: 'live'>, default=None, is_raw=False)"
    )
    assert repr(Param("A", b"\1\0\0\0", 77, 3, 1)).endswith("is_raw=True, type_number=77)")
    written = WrittenParam("A", 1, ParamType.INT32)
    assert repr(written) == (
        "WrittenParam(name='A', value=1, type=<ParamType.INT32: 6>, default=None, comment='', line=None, "
        "is_raw=False)"
    )
    assert "type=None" in repr(WrittenParam("A", 1))
    assert repr(WrittenParam("A", b"\1\0\0\0", 77)).endswith("type_number=77)")
