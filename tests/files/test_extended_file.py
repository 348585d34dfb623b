"""Files of extended parameters: what is written is read back, and invalid files are reported."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import pytest

from paramclient.errors import FileError
from paramclient.files import loads, read_file, write_file
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, ext_param
from paramclient.sim import Camera

KINDS = ParamType
DATA = Path(__file__).parents[1] / "data"
TEXT = {"value": "x", "type": "CUSTOM"}
ODD_NAN = struct.pack("<I", 0x7FC00001)


def written(name: str, raw: bytes, kind: int = KINDS.CUSTOM) -> WrittenParam:
    return WrittenParam.of(ext_param(name, raw, kind))


def every_kind() -> dict[str, WrittenParam]:
    params = {name: WrittenParam.of(param) for name, param in Camera().ext_params.items()}
    more = [
        written("NAN", struct.pack("<f", math.nan), KINDS.REAL32),
        written("ODD_NAN", ODD_NAN, KINDS.REAL32),
        written("INFINITE", struct.pack("<d", -math.inf), KINDS.REAL64),
        written("NO", 'off: "yes"\n\ttab 🚁 grün # 1'.encode()),
        written("EMPTY", b""),
        written("NUMBER", b"0x10"),
        written("BYTES", b"\xff\0\xfe"),
        written("UNKNOWN", b"\1\2", 77),
        written("NULL", b"null"),
        written("HEX", b"hex:12"),
    ]
    return params | {param.name: param for param in more}


def of(fields: object) -> list[object]:
    """The sets of a document with these fields of one extended parameter."""
    return [{"extended": True, "params": {"CAM": fields}}]


def read(path: Path) -> ParamSet:
    (found,) = read_file(path).sets
    return found


def test_a_written_file_reads_back_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    params = every_kind()
    write_file(path, ParamSet(params, 100, 1, at=1_700_000_000.0, source="link sim:camera", is_extended=True))
    assert path.read_bytes() == (DATA / "camera.json").read_bytes()
    found = read(path)
    assert found.is_extended
    assert dict(found.params) == params
    assert list(found.params) == list(params)
    assert (found.system, found.component, found.at, found.source) == (1, 100, 1_700_000_000.0, str(path))


def test_a_file_is_of_one_kind_and_other_formats_cannot_hold_them(tmp_path: Path) -> None:
    for ending in ("param", "parm", "params", "pck"):
        with pytest.raises(FileError, match=r"cannot hold extended parameters; write \.json"):
            write_file(tmp_path / f"camera.{ending}", ParamSet(every_kind(), is_extended=True))
    camera, (plain, *_) = read(DATA / "camera.json"), read_file(DATA / "vehicle.json").sets
    assert (camera.is_extended, plain.is_extended) == (True, False)
    with pytest.raises(FileError, match="either plain or extended parameters, not both"):
        write_file(tmp_path / "both.json", [camera, plain])


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        (of({"value": 1}), "an extended parameter has a type"),
        (of({"value": "one", "type": "UINT8"}), "expected a number"),
        (of({"value": 1, "type": "CUSTOM"}), "should be text, found 1"),
        (of({"value": "x" * 129, "type": "CUSTOM"}), "129 bytes"),
        (of({"value": "hex:0", "type": "CUSTOM"}), "'hex:0' is not a value of type CUSTOM"),
        (of({"value": "hex:" + "00" * 129, "type": "CUSTOM"}), "129 bytes"),
        (of({"value": "0x00000102", "type": "INT32"}), "raw bytes only if MAVLink does not define it"),
        (of({"value": 5, "type": "TYPE_77"}), "TYPE_77 is not a type that MAVLink defines"),
        ([{"extended": 1, "params": {}}], "should be true or false, found 1"),
        ([{"params": {"A": TEXT}}], "a plain parameter is a number"),
        ([{"params": {"Ä": {"value": 1}}}], "json:1: .*only printable ASCII"),  # written as an escape
        ([{"params": {"A": {"value": "0x0000000102", "type": "INT8"}}}], "or four raw bytes"),
        (
            [{"params": {"A": {"value": 1}}}, *of({"value": 1, "type": "INT8"})],
            "either plain or extended parameters, not both",
        ),
    ],
)
def test_an_invalid_document_is_an_error_with_its_name(sets: list[object], words: str) -> None:
    with pytest.raises(FileError, match=words) as caught:
        loads(json.dumps({"paramclient": 1, "sets": sets}).encode(), source="camera.json")
    assert caught.value.source == "camera.json"
