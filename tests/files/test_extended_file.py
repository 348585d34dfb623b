"""Files of extended parameters: what is written is read back, and invalid files are reported."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.errors import FileError
from paramclient.files import read_file, write_file
from paramclient.model.ext_values import ext_param
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType
from paramclient.sim import Camera

KINDS = ParamType
DATA = Path(__file__).parents[1] / "data"
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
    ]
    return params | {param.name: param for param in more}


def read(path: Path) -> ParamSet:
    (found,) = read_file(path).sets
    return found


def test_a_written_file_reads_back_unchanged(tmp_path: Path) -> None:
    """The written file is the one that the first version of the format wrote."""
    path = tmp_path / "camera.json"
    params = every_kind()
    content = ParamSet(params, 100, 1, at=1_700_000_000.0, source="link sim:camera", is_extended=True)
    write_file(path, content)
    assert path.read_bytes() == (DATA / "camera.json").read_bytes()
    found = read(path)
    assert found.is_extended
    assert dict(found.params) == params
    assert list(found.params) == list(params)
    assert (found.system, found.component, found.at, found.source) == (1, 100, 1_700_000_000.0, str(path))


@given(raw=st.binary(max_size=128) | st.text(max_size=30).map(str.encode))
def test_any_custom_value_is_restored(tmp_path_factory: pytest.TempPathFactory, raw: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.json"
    param = written("A", raw[:128])
    write_file(path, ParamSet({"A": param}, is_extended=True))
    assert read(path).params["A"] == param


@pytest.mark.parametrize("ending", ["param", "parm", "params", "pck"])
def test_formats_that_cannot_hold_them(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"camera.{ending}"
    with pytest.raises(FileError, match=r"cannot hold extended parameters; write \.json"):
        write_file(path, ParamSet(every_kind(), is_extended=True))
    assert not path.exists()


def test_a_file_is_for_one_component(tmp_path: Path) -> None:
    camera, (plain, *_) = read(DATA / "camera.json"), read_file(DATA / "vehicle.json").sets
    assert (camera.is_extended, plain.is_extended) == (True, False)
    with pytest.raises(FileError, match="holds one component, and no plain parameters"):
        write_file(tmp_path / "both.json", [camera, plain])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"value": 1}, "expected value or hex, and type"),
        ({"value": 1, "type": "TYPE_5"}, "unknown type"),
        ({"value": 1, "type": "EXT_TYPE_999"}, "unknown type"),
        ({"type": "CUSTOM"}, "either value or hex"),
        ({"value": 1, "hex": "00", "type": "INT32"}, "either value or hex"),
        ({"value": 1, "type": "INT32", "more": 1}, "expected value or hex, and type"),
        ({"value": True, "type": "INT32"}, "must be a number or text"),
        ({"value": None, "type": "INT32"}, "must be a number or text"),
        ({"value": 300, "type": "UINT8"}, "does not fit UINT8"),
        ({"value": "one", "type": "UINT8"}, "'one' is not a number"),
        ({"value": 1, "type": "CUSTOM"}, "1 is not text"),
        ({"value": "x" * 129, "type": "CUSTOM"}, "129 bytes"),
        ({"hex": "0", "type": "CUSTOM"}, "non-hexadecimal"),
        ({"hex": 5, "type": "CUSTOM"}, "should be text, found 5"),
        ({"hex": "0102", "type": "INT32"}, "hex is not a value of type INT32"),
        ({"hex": "00" * 129, "type": "CUSTOM"}, "hex is not a value of type CUSTOM"),
        (5, "expected value or hex, and type"),
    ],
)
def test_an_invalid_file_is_an_error_with_its_path(tmp_path: Path, fields: object, words: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"paramclient_extended": 1, "params": {"CAM": fields}}))
    with pytest.raises(FileError, match=words) as caught:
        read_file(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"paramclient_extended": 2, "params": {}}', "should be 1, the version of the format, found 2"),
        ('{"paramclient_extended": 1}', "params: the field is missing"),
        ('{"paramclient_extended": 1, "params": []}', "params: it should be an object"),
        ('{"paramclient_extended": 1, "params": {}}', "contains no parameters"),
        (
            '{"paramclient_extended": 1, "system": 0, "params": {"A": {"hex": "", "type": "CUSTOM"}}}',
            "1 to 255",
        ),
        ('{"paramclient_extended": 1, "params": {"": {}}}', "at least one character"),
        ('{"paramclient_extended": 1, "params": {"A": {}, "A": {}}}', "occurs twice"),
    ],
)
def test_documents_that_are_none(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(content)
    with pytest.raises(FileError, match=words):
        read_file(path)
