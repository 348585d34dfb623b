"""Parameter sets without a vehicle."""

from __future__ import annotations

import struct

import pytest

from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Param, ParamType, Value, bits_of


def held(value: Value, number: int, name: str = "P") -> Param:
    return Param(name, value, number, 0, bits_of(value, number))


@pytest.mark.parametrize(
    ("written", "value", "number", "same"),
    [
        (0.1, struct.unpack("<f", struct.pack("<f", 0.1))[0], ParamType.REAL32, True),
        (1, 1.0, ParamType.REAL32, True),
        (1.0, 1, ParamType.INT32, True),
        (1.5, 1, ParamType.INT32, False),
        (-0.0, 0.0, ParamType.REAL32, True),
        (float("nan"), float("nan"), ParamType.REAL32, True),
        (300, 44, ParamType.UINT8, False),
        (16777217, 16777217, ParamType.INT32, True),
        (16777217, 16777216, ParamType.INT32, False),
    ],
)
def test_a_written_value_is_compared_in_the_vehicles_type(
    written: Value, value: Value, number: int, same: bool
) -> None:
    assert WrittenParam("P", written).is_held_by(held(value, number)) is same


def test_raw_bytes_equal_only_raw_bytes() -> None:
    raw = Param("P", b"\x01\0\0\0", ParamType.UINT64, 0, 1)
    number = Param("P", 1, ParamType.INT32, 0, 1)
    assert WrittenParam("P", b"\x01\0\0\0").is_held_by(raw)
    assert not WrittenParam("P", b"\x01\0\0\0").is_held_by(number)
    assert not WrittenParam("P", 1).is_held_by(raw)  # the other four bytes are unknown


def test_raw_bytes_of_a_small_type_have_four_bytes() -> None:
    """ArduPilot can send a float that its own integer type cannot hold."""
    raw = struct.pack("<f", 1e20)
    param = Param("P", raw, ParamType.INT8, 0, int.from_bytes(raw, "little"))
    assert WrittenParam.of(param).is_held_by(param)
    assert not WrittenParam("P", struct.pack("<f", 2e20)).is_held_by(param)
