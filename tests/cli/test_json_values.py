"""Values in JSON: exact numbers, words for what JSON lacks, and no empty members."""

from __future__ import annotations

import json
import math
import struct

import pytest

from paramclient.cli.json_output import info_json, param_json, table_param_json
from paramclient.metadata import ParamInfo
from paramclient.model.notation import bits_written, value_json
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Param, ParamType, Trust, Value, bits_of

THIRD = struct.unpack("<f", struct.pack("<f", 1 / 3))[0]


def param(value: Value, kind: ParamType | int = ParamType.REAL32) -> Param:
    bits = int.from_bytes(value, "little") if isinstance(value, bytes) else bits_of(value, kind)
    return Param("P", value, kind, None, bits)


@pytest.mark.parametrize(
    ("value", "kind", "shown"),
    [
        (THIRD, ParamType.REAL32, 0.33333334),
        (1 / 3, ParamType.REAL64, 1 / 3),
        (16777217, ParamType.INT32, 16777217),
        (2**64 - 1, ParamType.UINT64, 2**64 - 1),
        (math.nan, ParamType.REAL32, "NaN"),
        (math.inf, ParamType.REAL32, "Infinity"),
        (-math.inf, ParamType.REAL64, "-Infinity"),
        (-0.0, ParamType.REAL32, -0.0),
        (b"\x01\x02\x03\x04", ParamType.INT64, "0x04030201"),
        (b"\x01\x02\x03\x04", 99, "0x04030201"),
    ],
)
def test_values_are_exact(value: Value, kind: ParamType | int, shown: object) -> None:
    member = value_json(value, kind)
    assert (type(member), repr(member)) == (type(shown), repr(shown))
    text = json.dumps(param_json(param(value, kind)), allow_nan=False)
    assert repr(json.loads(text)["value"]) == repr(shown)


def test_bits_have_the_width_of_the_type() -> None:
    assert param_json(param(1, ParamType.UINT64))["bits"] == "0000000000000001"
    assert param_json(param(1, ParamType.INT8))["bits"] == "00000001"
    assert bits_written(WrittenParam("P", 1.0, ParamType.REAL32)) == "3f800000"
    assert bits_written(WrittenParam("P", 1.0)) is None
    assert bits_written(WrittenParam("P", 300, ParamType.INT8)) is None


def test_a_parameter_of_a_table_has_its_default_its_trust_and_its_meaning() -> None:
    info = ParamInfo("P", units="m", values={1.5: "half"}, minimum=0, maximum=math.inf, default=2)
    known = Param("P", 1.5, ParamType.REAL32, 4, bits_of(1.5, ParamType.REAL32), Trust.VERIFIED, 1.25)
    more = {"default": 1.25, "default_source": "vehicle", "text": "half", "units": "m"}
    found = table_param_json(known, info)
    assert found == {"name": "P", **param_json(known), **more, "is_default": False, "trust": "verified"}
    assert table_param_json(param(2.0), info)["default_source"] == "metadata"
    assert info_json(ParamInfo("P")) == {}
