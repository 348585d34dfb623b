"""Parameter metadata: names and ranges of values, and the files."""

from __future__ import annotations

import json
import lzma
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient import UsageError
from paramclient.errors import FileError
from paramclient.metadata import Metadata, ParamInfo
from paramclient.metadata.store import read_content, read_metadata
from paramclient.model.values import ParamType

DATA = Path(__file__).parents[1] / "data"
PX4, XML, JSON = DATA / "parameters.json", DATA / "apm.pdef.xml", DATA / "apm.pdef.json"

MODE = ParamInfo("MODE", values={0: "Stabilize", 5: "Loiter", 6: "RTL", 9: "Land  now", 0.5: "Half"})
MASK = ParamInfo("MASK", bits={0: "GPS", 1: "Baro", 3: "Optical flow", 7: "4"})
SIGNED = ParamInfo("SIGNED", ParamType.INT32, bits={0: "GPS", 31: "Last"})
GAIN = ParamInfo("GAIN", units="1/s", minimum=0.1, maximum=12)


# Names of values and bits


def test_text_of_a_value() -> None:
    assert MODE.text(5) == MODE.text(5.0) == "Loiter"
    assert MODE.text(0.5) == "Half"
    assert ParamInfo("A", values={0.1: "Low"}).text(0.10000000149011612) == "Low"  # 0.1 as a float32
    assert [MODE.text(value) for value in (1, math.nan, math.inf, b"abcd", 5.5)] == [None] * 5


def test_text_of_a_mask() -> None:
    texts = [MASK.text(value) for value in (0b1011, 1.0, 0b10101)]
    assert texts == ["GPS|Baro|Optical flow", "GPS", "GPS|0x14"]
    assert MASK.text(1 << 7) == "0x80"  # its name looks like a number
    assert [MASK.text(value) for value in (0, -1, 1.5)] == [None] * 3
    assert [SIGNED.text(-(2**31) + first) for first in (0, 1)] == ["Last", "GPS|Last"]


def test_names_and_numbers_are_parsed() -> None:
    assert [MODE.parse(text) for text in ("Loiter", " LOITER ", "5", "0X5", "+5", "005")] == [5] * 6
    assert [MODE.parse(text) for text in ("land now", "half")] == [9, 0.5]
    assert MODE.parse("-16777217") == -16777217
    assert isinstance(MODE.parse("4"), int)
    assert isinstance(MODE.parse("4.0"), float)
    assert MODE.parse("1e-3") == 0.001
    assert math.isnan(MODE.parse("nan"))
    with pytest.raises(UsageError, match="beyond the range"):
        MODE.parse("1e999")


def test_a_number_is_never_parsed_as_a_name() -> None:
    """In ArduPilot, names of values are baud rates: 57 has the name 57600."""
    info = ParamInfo("SERIAL1_BAUD", values={57: "57600", 115: "111100"})
    assert info.parse("57600") == 57600
    assert info.parse("57") == 57
    assert ParamInfo("A", bits={4: "1", 5: "GPS"}).parse("GPS|1") == 0b100001


@pytest.mark.parametrize("text", ["GPS|Baro", "gps+baro", "GPS, Baro", "baro | 1", "0x1|0x2", "0b11"])
def test_parse_joins_names_of_bits(text: str) -> None:
    if text == "0b11":
        with pytest.raises(UsageError, match=r"MASK: '0b11' is not a number, nor one of its bits: GPS \(0\)"):
            MASK.parse(text)
    else:
        assert MASK.parse(text) == 3


def test_names_may_contain_separators() -> None:
    info = ParamInfo("A", bits={0: "Roll, pitch", 1: "Roll", 2: "Pitch", 3: "Yaw"})
    assert info.parse("roll, pitch") == 1
    assert info.parse("Roll, pitch|Yaw") == 0b1001
    assert info.parse("Roll|Pitch") == 0b110
    with pytest.raises(UsageError, match="can mean several things"):
        info.parse("Yaw+Roll, pitch")


MANY: dict[int | float, str] = {**{number: f"Mode {number}" for number in range(40)}, 99: "Loiter"}


@pytest.mark.parametrize(
    ("info", "text", "problem"),
    [
        (ParamInfo("A", values={0: "Off", 2: "off"}), "Off", "A: 'Off' is the name of 0 and 2"),
        (MODE, "Loitr", r"nor one of its values: Stabilize \(0\), Lo"),
        (MASK, "GPS|Barro", r"nor is 'Barro' one of its bits: GPS \(0\)"),
        (GAIN, "high", "and its values have no names"),
        (ParamInfo("MANY", values=MANY), "Loitr", "nor one of its values; similar: Loiter$"),
        (ParamInfo("MANY", values=MANY), "xyzzy", "nor one of its values, of which there are 41$"),
    ],
)
def test_errors_suggest_names(info: ParamInfo, text: str, problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        info.parse(text)


@given(st.integers(0, 2**64 - 1), st.dictionaries(st.integers(0, 63), st.text(max_size=8), max_size=8))
def test_text_of_a_mask_parses_to_the_same_mask(mask: int, bits: dict[int, str]) -> None:
    info = ParamInfo("A", bits={bit: name for bit, name in bits.items() if name})
    if (text := info.text(mask)) is not None:
        try:
            again = info.parse(text)
        except UsageError:
            return  # equal names, or names with separators
        assert again == mask


def test_problem_reports_values_outside_the_range() -> None:
    assert GAIN.problem(6.5) is None
    assert GAIN.problem(0.10000000149011612) is None
    assert GAIN.problem(12.0) is None
    assert GAIN.problem(12.5) == "GAIN: 12.5 is above the maximum of 12 1/s"
    assert GAIN.problem(-1) == "GAIN: -1 is below the minimum of 0.1 1/s"
    assert GAIN.problem(math.nan) == "GAIN: nan is outside every range"
    assert GAIN.problem(math.inf) == "GAIN: inf is above the maximum of 12 1/s"
    assert GAIN.problem(1e300) is not None
    assert GAIN.problem(b"abcd") is None
    assert MODE.problem(math.nan) is None
    assert ParamInfo("A", maximum=16777216).problem(16777217) is not None
    assert ParamInfo("A", maximum=3.1415926535).problem(3.1415927410125732) is None  # pi as a float32


# Files


def test_px4_file() -> None:
    read = read_metadata(PX4)
    assert len(read) == 5
    assert repr(read) == f"<Metadata of 5 params from {PX4}>"
    gain = read["TST_GAIN"]
    assert gain == ParamInfo(
        "TST_GAIN",
        ParamType.REAL32,
        "Gain of the test controller",
        "How strongly the test controller reacts.\n\nToo much makes it swing.",
        "1/s",
        0.1,
        12.0,
        0.1,
        2,
        6.5,
        category="Standard",
        group="Test",
    )
    hash(gain)
    mode = read["TST_MODE"]
    assert dict(mode.values) == {-1: "Nothing", 0: "Hold", 1: "Return home"}
    assert mode.reboot_required
    assert mode.parse("return home") == 1
    sensors = read["TST_SENSORS"]
    assert dict(sensors.bits) == {0: "GPS", 1: "Baro", 31: "Flow"}
    assert sensors.text(-(2**31) + 3) == "GPS|Baro|Flow"
    count = read["TST_COUNT"]
    assert count.is_read_only
    assert count.is_volatile


def test_a_group_is_found_by_the_names_of_its_parameters() -> None:
    read = read_metadata(PX4)
    third = read["TST_OUT3_FUNC"]
    assert third.name == "TST_OUT3_FUNC"
    assert third.short_description == "Function of output 3"
    assert third.long_description == "What output 3 drives."
    assert third.type is ParamType.UINT8
    assert read["TST_OUT12_FUNC"].short_description == "Function of output 12"
    assert "TST_OUT_FUNC" not in read
    assert "TST_OUT3_FUNC2" not in read
    assert read.get("NONE") is None
    assert "TST_OUT{n}_FUNC" in list(read)
    own = Metadata.of([ParamInfo("A{n}"), ParamInfo("A2", units="m")])
    assert (own["A2"].units, own["A3"].units) == ("m", "")


@pytest.mark.parametrize("path", [XML, JSON], ids=["xml", "json"])
def test_ardupilot_files(path: Path) -> None:
    read = read_metadata(path)
    assert list(read) == ["FLTMODE1", "TST_ALT", "TST_EXPO", "TST_LOG", "TST_OLD", "TST_RUNTIME"]
    mode = read["FLTMODE1"]
    assert mode.short_description == "First flight mode"
    assert mode.long_description == 'The mode at the "lowest" position'
    assert (mode.category, mode.group) == ("Standard", "ArduTest")
    assert dict(mode.values) == {0: "Stabilize", 5: "Loiter", 6: "RTL"}
    assert mode.parse("LOITER") == 5
    height = read["TST_ALT"]
    assert (height.minimum, height.maximum, height.increment, height.units) == (30, 3000.5, 1, "cm")
    assert height.reboot_required
    assert not height.is_read_only
    expo = read["TST_EXPO"]
    assert dict(expo.values) == {0: "Disabled", 0.1: "Very low, slow", 0.2: "Low"}
    assert (expo.minimum, expo.maximum) == (None, None)
    assert dict(read["TST_LOG"].bits) == {0: "IMU", 3: "GPS"}
    assert dict(read["TST_OLD"].bits) == {0: "First", 1: "Second"}
    assert read["TST_RUNTIME"].is_read_only
    assert read["TST_RUNTIME"].is_volatile


@pytest.mark.parametrize("path", [PX4, XML, JSON], ids=["px4", "xml", "json"])
def test_the_format_is_detected_from_the_content(path: Path, tmp_path: Path) -> None:
    plain = read_metadata(path)
    for name, content in {
        "a.txt": path.read_bytes(),
        "b": lzma.compress(path.read_bytes()),
        "c.xml": b"\xef\xbb\xbf" + path.read_bytes(),
    }.items():
        other = tmp_path / name
        other.write_bytes(content)
        assert read_metadata(other).params == plain.params


def test_parameters_with_different_descriptions_are_left_out() -> None:
    row = '<param name="{0}:{1}" humanName="{2}"/>'
    vehicles = ""
    for name in ("Copter", "Plane"):
        rows = row.format(name, "SAME", "s") + row.format(name, "OTHER", name)
        vehicles += f'<parameters name="{name}">{rows}</parameters>'
    assert list(read_content(f"<paramfile>{vehicles}</paramfile>".encode(), source="both")) == ["SAME"]


def px4(*rows: dict[str, Any], **more: Any) -> bytes:
    return json.dumps({"version": 1, "parameters": list(rows)} | more).encode()


WRONG = {
    "empty": (b"", "neither JSON nor XML"),
    "text": (b"MC_ROLL_P 6.5", "neither JSON nor XML; expected PX4's parameters.json, ArduPilot's"),
    "cut json": (b'{"parameters": [', "not JSON: EOF"),
    "deep json": (b'{"a":' * 100_000, "not JSON: recursion limit"),
    "no list": (b'{"version": 1, "parameters": {"A": 1}}', r"parameters: Input should be a valid list"),
    "no name": (px4({"type": "Float"}), r"parameters\[0\].name: Field required"),
    "long name": (px4({"name": "A" * 17}), r"parameters\[0\].name: String should have at most 16"),
    "no text": (px4({"name": "A", "units": 7}), r"parameters\[0\].units: Input should be a valid string"),
    "high bit": (px4({"name": "A", "bitmask": [{"index": 64}]}), r"parameters\[0\].bitmask\[0\].index"),
    "ardupilot list": (b'{"json": {}, "A": {"B": {"Values": [1]}}}', r"B.Values"),
    "html": (b"<html><body/></html>", "begins with <html>, not with <paramfile>"),
    "cut xml": (b"<paramfile><vehicles>", "not XML: no element found"),
    "nameless": (b"<paramfile><param/></paramfile>", "a parameter without a name"),
    "cut xz": (lzma.compress(px4())[:-8], "cannot be unpacked: the file is truncated"),
}


@pytest.mark.parametrize(("content", "said"), WRONG.values(), ids=WRONG)
def test_invalid_files_are_rejected_with_the_reason(content: bytes, said: str) -> None:
    with pytest.raises(FileError, match=f"^the file[,:] .*{said}|^the file, {said}") as caught:
        read_content(content, source="the file")
    assert caught.value.source == "the file"
    assert isinstance(caught.value, UsageError)


ENTITIES = [
    '<!DOCTYPE paramfile [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><paramfile>&b;</paramfile>',
    '<!DOCTYPE paramfile [<!ENTITY a SYSTEM "file:///etc/passwd">]><paramfile>&a;</paramfile>',
    '<!DOCTYPE paramfile SYSTEM "http://127.0.0.1/a.dtd"><paramfile/>',
]


@pytest.mark.parametrize("text", ENTITIES, ids=["expansion", "file", "address"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_document_type_is_rejected(text: str, encoding: str) -> None:
    with pytest.raises(FileError, match="document type" if encoding == "utf-8" else "neither JSON nor XML"):
        read_content(text.encode(encoding), source="the file")


def test_a_description_in_another_encoding_is_read() -> None:
    content = px4({"name": "A", "shortDesc": "H?he"}).replace(b"?", b"\xf6")
    assert read_content(content, source="the file")["A"].short_description == "Höhe"
    for head in ("", '<?xml version="1.0" encoding="utf-8"?>', "<?xml version='1.0' encoding='latin1'?>"):
        content = f'{head}<paramfile><param name="A" humanName="Höhe"/></paramfile>'.encode("cp1252")
        assert read_content(content, source="the file")["A"].short_description == "Höhe"


def test_empty_ranges_and_invalid_values_are_left_out() -> None:
    rows = {"name": "A", "min": 2, "max": 1, "values": [{"value": math.nan, "description": "NaN"}]}
    info = read_content(px4(rows), source="the file")["A"]
    assert (info.minimum, info.maximum, dict(info.values)) == (None, None, {})
    text = '<paramfile><param name="A"><field name="Range">2 1</field></param></paramfile>'
    info = read_content(text.encode(), source="the file")["A"]
    assert (info.minimum, info.maximum) == (None, None)
