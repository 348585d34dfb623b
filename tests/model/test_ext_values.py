"""Values of extended parameters: encoding by type, text and bytes, equality."""

from __future__ import annotations

import decimal
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.errors import UsageError
from paramclient.model.values import (
    EXT_VALUE_SIZE,
    Param,
    ParamType,
    Settable,
    Value,
    check_ext_value,
    encode_ext_value,
    ext_bytes,
    ext_param,
)

KINDS = ParamType
NAN = struct.pack("<f", math.nan)


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
    assert encode_ext_value(value, number) == raw
    in_message = raw.ljust(EXT_VALUE_SIZE, b"\0")
    param = ext_param("A", in_message, number, 3)
    assert (param.name, param.type, param.index) == ("A", number, 3)
    assert ext_bytes(param) == encode_ext_value(param.settable, number) == raw
    assert type(param.settable) is type(value)
    assert param.is_raw == (ParamType(number).name == f"TYPE_{number}")
    assert param.is_raw or param.value == value
    assert ext_param("A", raw, number, 3) == param


@given(st.binary(max_size=128))
def test_every_custom_value_can_be_set_again(data: bytes) -> None:
    param = ext_param("A", data.ljust(128, b"\0"), KINDS.CUSTOM)
    assert encode_ext_value(param.value, KINDS.CUSTOM) == ext_bytes(param) == data.rstrip(b"\0")
    if isinstance(param.value, str):
        assert check_ext_value(param.value) == param.value


@pytest.mark.parametrize(
    ("value", "number", "words"),
    [
        (256, KINDS.UINT8, "does not fit UINT8, which holds 0 to 255"),
        (1.5, KINDS.INT32, "not a whole number"),
        (1e39, KINDS.REAL32, "beyond the range of a float32"),
        ("5", KINDS.INT32, "'5' is not a number, and the parameter is INT32"),
        (b"5", KINDS.REAL32, "is not a number"),
        (5, KINDS.CUSTOM, "5 is not text or bytes, and the parameter is CUSTOM"),
        ("5", 77, "'5' is not bytes, and the parameter is TYPE_77"),
        (5, 77, "is not bytes"),
    ],
)
def test_values_that_do_not_fit(value: Value, number: int, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        encode_ext_value(value, number)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("x" * 129, "129 bytes; an extended parameter holds 128"),
        ("a\0b", "without NUL"),
        ("\ud800", "UTF-8"),
        (None, "not NoneType"),
        (decimal.Decimal("sNaN"), "number in the range of a float"),
    ],
)
def test_invalid_extended_values_are_refused(value: Settable, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        check_ext_value(value)


def test_equality_is_that_of_values() -> None:
    def real(value: float) -> Param:
        return ext_param("A", struct.pack("<f", value), KINDS.REAL32)

    assert real(0.0).same_value(real(-0.0))
    assert not real(0.0).same_value(real(1.0))
    assert ext_param("A", NAN, KINDS.REAL32).same_value(ext_param("A", NAN, KINDS.REAL32))
    assert not ext_param("A", b"", KINDS.CUSTOM).same_value(ext_param("A", b"\x80", KINDS.CUSTOM))
    assert not ext_param("A", b"\1", KINDS.UINT8).same_value(ext_param("A", b"\1", KINDS.INT8))
    wide = [struct.pack("<d", value) for value in (0.0, -0.0)]
    assert ext_param("A", wide[0], KINDS.REAL64).same_value(ext_param("A", wide[1], KINDS.REAL64))
