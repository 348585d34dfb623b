"""Every file format: round trips, compatibility with other programs, and rejected files."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.mavparm import MAVParmDict

from paramclient import FileError, Identity, ParamFile, ParamSet, ParamType, WrittenParam
from paramclient.errors import UsageError
from paramclient.files import FileFormat, dumps, loads
from paramclient.model.values import Value, bits_of, from_bits

DATA = Path(__file__).parents[1] / "data"
TYPED = [FileFormat.QGC, FileFormat.JSON]
PAIRS = [FileFormat.PARM, FileFormat.MISSION_PLANNER]

float_bits = st.integers(0, 0xFFFFFFFF).filter(lambda bits: bits & 0x7F800000 != 0x7F800000)
BAD_NAMES = ["SIM_GPS1_BYTELOSS", "MC R", " ", "@FOO"]


def params_of(*params: WrittenParam, system: int | None = 1, component: int | None = 1) -> ParamSet:
    return ParamSet({param.name: param for param in params}, component, system)


def numbered(values: list[Value], kind: ParamType) -> ParamSet:
    return params_of(*(WrittenParam(f"P{at}", value, kind) for at, value in enumerate(values)))


def back(params: ParamSet, form: FileFormat) -> ParamSet:
    """Return a set after writing and reading it in a format."""
    (only,) = loads(dumps(params, file_format=form), file_format=form).sets
    return only


def bits(params: ParamSet, kind: ParamType) -> list[int]:
    return [param.bits_as(kind) for param in params.values()]


def failed(data: bytes | str, **options: object) -> FileError:
    content = data.encode() if isinstance(data, str) else data
    with pytest.raises(FileError) as caught:
        loads(content, source="quad.x", **options)  # type: ignore[arg-type]  # options of several types
    return caught.value


# Round trips


@pytest.mark.parametrize("form", FileFormat)
@example(written=[bits_of(value, ParamType.REAL32) for value in (math.nan, math.inf, -math.inf)])
@given(written=st.lists(float_bits, min_size=1, max_size=60))
@settings(max_examples=25, deadline=None)
def test_floats_round_trip(form: FileFormat, written: list[int]) -> None:
    floats: list[Value] = [from_bits(each, ParamType.REAL32) for each in written]
    assert bits(back(numbered(floats, ParamType.REAL32), form), ParamType.REAL32) == written


@pytest.mark.parametrize("form", FileFormat)
@pytest.mark.parametrize("kind", [kind for kind in ParamType if kind.is_integer])
@given(data=st.data())
@settings(max_examples=8, deadline=None)
def test_integers_round_trip(form: FileFormat, kind: ParamType, data: st.DataObject) -> None:
    if form is FileFormat.PCK and kind not in (ParamType.INT8, ParamType.INT16, ParamType.INT32):
        with pytest.raises(FileError, match=f"P0 has the type {kind.name}"):
            dumps(numbered([1], kind), file_format=form)
        return
    low, high = kind.bounds
    whole: list[int] = data.draw(st.lists(st.integers(low, high), max_size=40))
    values: list[Value] = [low, high, *whole]
    read = back(numbered(values, kind), form)
    assert [param.value for param in read.values()] == values
    assert all(type(param.value) is int for param in read.values())


@pytest.mark.parametrize("form", [*PAIRS, *TYPED[1:]])
@given(value=st.floats(allow_nan=False) | st.integers(-(2**70), 2**70))
@settings(max_examples=40, deadline=None)
def test_a_number_without_a_type_round_trips(form: FileFormat, value: float) -> None:
    read = back(params_of(WrittenParam("A", value)), form)["A"].value
    assert (type(read), repr(read)) == (type(value), repr(value))


@pytest.mark.parametrize("form", [FileFormat.QGC, FileFormat.PCK, *PAIRS])
@pytest.mark.parametrize(
    ("value", "kind"),
    [(b"\x01\0\0\0", ParamType.INT32), (from_bits(0x7FC12345, ParamType.REAL32), ParamType.REAL32)],
)
def test_other_formats_reject_raw_bytes_and_payloads(form: FileFormat, value: Value, kind: ParamType) -> None:
    if form is FileFormat.PCK and kind is ParamType.REAL32:
        assert bits(back(numbered([value], kind), form), kind) == [0x7FC12345]
        return
    with pytest.raises(FileError, match=r"P0 is .*json can keep"):
        dumps(numbered([value], kind), file_format=form)


@pytest.mark.parametrize("form", [FileFormat.QGC, *PAIRS])
def test_header_comments_and_footer_round_trip(form: FileFormat) -> None:
    plain = ParamSet({"A": WrittenParam("A", 1, ParamType.INT8, comment="first"), "B": WrittenParam("B", 2)})
    marked = WrittenParam("B", 2, ParamType.INT8, comment="two\n\n # lines\n#marked")
    params = ParamSet({"A": plain["A"], "B": marked, "C": WrittenParam("C", 3, ParamType.INT8)}, 1, 1)
    around = ParamFile((params,), form, "", ("on top", "", "  indented"), ("the", "end"))
    once = loads(dumps(around), source="x" + form)
    assert [each.comment for each in once.sets[0].values()] == ["first", marked.comment, ""]
    lines = [line for line in once.header if "n" in line and "-Id" not in line]
    assert lines[-2:] == ["on top", "  indented"]
    assert once.footer == ("the", "end")
    assert dumps(loads(dumps(once))) == dumps(once)


def test_comments_of_mission_planner_are_kept() -> None:
    text = "# for the X500\n# by Jo\nA,1\n\n# above B\nB,2 # beside B\n//off,3\nC,3\n; the end\n"
    file = loads(text.encode(), source="quad.param")
    assert file.header == ("for the X500", "by Jo")
    assert [param.comment for param in file.sets[0].values()] == ["", "above B\nbeside B", "off,3"]
    assert [param.line for param in file.sets[0].values()] == [3, 6, 8]
    written = dumps(file).decode()
    assert written == "# for the X500\n# by Jo\nA,1\n# above B\n# beside B\nB,2\n# off,3\nC,3\n# the end\n"
    assert replace(loads(written.encode(), source="quad.param"), sets=()) == replace(file, sets=())
    assert loads(written.encode(), source="quad.param").sets == file.sets


@pytest.mark.parametrize("form", [FileFormat.QGC, *PAIRS, *TYPED[1:]])
def test_a_comment_never_becomes_a_parameter(form: FileFormat) -> None:
    comment = "x\nB,2\r\nB 2\rB,2\x0bB,2\u2028B,2\x00\x1b[31m"
    params = params_of(WrittenParam("A", 1, ParamType.INT8, comment=comment))
    around = ParamFile((params,), form, "", ("a\rB,2",), ("z\nB 2\udc80",))
    assert list(loads(dumps(around), file_format=form).sets[0]) == ["A"]
    assert "\x1b" not in dumps(around).decode()


# Compatibility with other programs


def read_by_pymavlink(data: bytes, folders: pytest.TempPathFactory) -> dict[str, int]:
    path = folders.mktemp("mav") / "x.parm"
    path.write_bytes(data)
    theirs = MAVParmDict()
    assert theirs.load(str(path), use_excludes=False)
    return {name: bits_of(value, ParamType.REAL32) for name, value in theirs.items()}


def test_mavproxy_reads_a_whole_vehicle(
    tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    params = loads((DATA / "ardupilot_param.pck").read_bytes()).choose()
    ours = {name: param.bits_as(ParamType.REAL32) for name, param in params.items()}
    for form in PAIRS:
        assert read_by_pymavlink(dumps(params, file_format=form), tmp_path_factory) == ours
        assert "Invalid" not in capsys.readouterr().out


def test_qgroundcontrol_reads_every_parameter_line() -> None:
    """ParameterManager.cc skips lines that begin with `#`, and splits others at tabs into five parts."""
    pilot = params_of(
        WrittenParam("A", 0.1, ParamType.REAL32, comment="why"),
        WrittenParam("B", -5, ParamType.INT32),
        WrittenParam("C", -math.inf, ParamType.REAL32),
        WrittenParam("D", math.nan, ParamType.REAL32),
        component=None,
    )
    camera = params_of(WrittenParam("A", 255, ParamType.UINT8), component=100)
    lines = dumps([pilot, camera], file_format="qgc").decode().splitlines()
    assert lines[0] == "# Onboard parameters for Vehicle 1"
    assert "# Vehicle-Id Component-Id Name Value Type" in lines
    assert [line.split("\t") for line in lines if line and not line.startswith("#")] == [
        ["1", "1", "A", "0.1", "9"],
        ["1", "1", "B", "-5", "6"],
        ["1", "1", "C", "-inf", "9"],
        ["1", "1", "D", "nan", "9"],
        ["1", "100", "A", "255", "1"],
    ]


QGC_TEXT = """# Onboard parameters for Vehicle 1
#
# Stack: PX4 Pro
#
# Vehicle-Id Component-Id Name Value Type
1\t1\tMC_ROLL_P\t6.500000000000000000\t9
1\t1\tBAT1_CAPACITY\t--.------------------\t9
1\t100\tCAM_MODE\t2\t2
2\t1\tMC_ROLL_P\t7\t9
1\t1\tSYS_AUTOSTART\t4001\t6
"""


def test_a_qgroundcontrol_file_has_a_set_per_component() -> None:
    file = loads(QGC_TEXT.encode(), source="quad.params")
    assert file.file_format is FileFormat.QGC
    assert file.header[0] == "Onboard parameters for Vehicle 1"
    assert [(each.system, each.component, list(each)) for each in file.sets] == [
        (1, 1, ["MC_ROLL_P", "BAT1_CAPACITY", "SYS_AUTOSTART"]),
        (1, 100, ["CAM_MODE"]),
        (2, 1, ["MC_ROLL_P"]),
    ]
    assert file.choose(system=1)["BAT1_CAPACITY"].bits_as(ParamType.REAL32) == 0x7FC00000
    assert (file.choose(100)["CAM_MODE"].value, file.choose(100)["CAM_MODE"].type) == (2, ParamType.INT8)
    assert isinstance(file.choose(1, system=2)["MC_ROLL_P"].value, float)
    with pytest.raises(FileError, match=r"quad.params: several sets match .*contains 1/1, 1/100, 2/1"):
        file.choose()
    with pytest.raises(FileError, match=r"no set matches \(any system, component 7\)"):
        file.choose(7)
    with pytest.raises(FileError, match=r"no set matches \(system 9, the autopilot\)"):
        file.choose(system=9)
    partial = dumps([replace(file.sets[0], lacks="3 of 4"), *file.sets[1:]], file_format="qgc")
    assert [each.lacks for each in loads(partial).sets] == ["3 of 4", "", ""]


@pytest.mark.parametrize("name", ["ardupilot_param.pck", "ardupilot_param_withdefaults.pck"])
def test_packed_files_convert_to_other_formats(name: str) -> None:
    file = loads((DATA / name).read_bytes(), source=name)
    assert (file.file_format, len(file.sets[0]), file.notes) == (FileFormat.PCK, 1382, ())
    with_defaults = "defaults" in name
    assert all((param.default is not None) is with_defaults for param in file.sets[0].values())
    params = replace(file.sets[0], system=1, component=1)
    for form in (FileFormat.QGC, FileFormat.JSON, FileFormat.PARM, FileFormat.PCK):
        assert [param.bits_as(params[name].type or 0) for name, param in back(params, form).items()] == [
            param.bits_as(param.type or 0) for param in params.values()
        ]
    assert loads(dumps(params, file_format="pck"), source=name).sets == file.sets
    assert with_defaults or dumps(params, file_format="pck") == (DATA / name).read_bytes()


def test_an_incomplete_packed_file_has_a_note() -> None:
    from paramclient.protocol import param_pck

    entry = param_pck.PackedParam("A", ParamType.INT8, 1)
    file = loads(param_pck.encode([entry], total=3))
    assert file.notes == ("The file has 1 of the vehicle's 3 parameters.",)
    assert "contains no parameters" in str(failed(param_pck.encode([])))
    assert "invalid packed parameter file: the file is cut off" in str(failed(param_pck.encode([entry])[:-1]))
    odd = param_pck.encode([entry, entry._replace(name="B")]).replace(b"A", b"\xc4")
    assert "only printable ASCII" in str(failed(odd))
    assert [*loads(odd, partial=True).choose()] == ["B"]


# Lines that resemble a parameter


@pytest.mark.parametrize(
    "data",
    [
        b"A 1\r\nB 0x1F\r\n",
        b"\xef\xbb\xbfA,1\nB,31\n",
        "A\t1\nB =\t31\n".encode("utf-16"),
        b"\xfe\xff" + "A 1\nB 31".encode("utf-16-be"),
        b"A   1 # x\n\n\t // y\n;z\nB , 31.0 ; w",
        b"A,1\rB,0X1f\r",
        b"A 1 @READONLY\nB +31e0",
        b"A 1\nA 1.0\nB 31\n",
        b"A,1\n# \x00\nB,31 # \x07\n",
    ],
)
def test_variants_of_a_list_are_parsed(data: bytes) -> None:
    read = loads(data, source="quad.parm").sets[0]
    assert {name: param.value for name, param in read.items()} == {"A": 1, "B": 31}


def test_a_repeated_value_has_a_note() -> None:
    assert loads(b"1\t1\tA\t1\t6\n1\t100\tA\t2\t6\n").notes == ()
    assert loads(b"A 1\nB 2\nA 1\n").notes == ("A occurs twice with the same value, in line 1 and line 3.",)
    assert loads(b"A nan\nA nan\n").notes != ()
    many = loads(b"A 1\n" * 1000).notes
    assert (len(many), many[-1]) == (21, "979 more lines repeat a name.")
    assert loads(b"A 1\n" * 22).notes[-1] == "1 more line repeats a name."


@pytest.mark.parametrize(
    ("text", "value", "note"),
    [
        ("A 1\nB 5\nA 2 # new", 2, "A occurs twice: 2 in line 3 is used, not 1 in line 1."),
        ("A 0.0\nA -0.0\nB 5", -0.0, "A occurs twice: -0.0 in line 2 is used, not 0.0 in line 1."),
        ("1\t1\tA\t1\t6\n1\t1\tB\t5\t6\n1\t1\tA\t2\t6\n", 2, "2 (INT32) in line 3 is used, not 1 (INT32)"),
        ("1\t1\tA\t1\t9\n1\t1\tB\t5\t6\n1\t1\tA\t1\t6\n", 1, "1 (INT32) in line 3 is used, not 1.0 (REAL32)"),
    ],
)
def test_the_last_value_of_a_repeated_name_is_used(text: str, value: float, note: str) -> None:
    file = loads(text.encode())
    params = file.sets[0]
    assert (list(params), repr(params["A"].value)) == (["A", "B"], repr(value))
    (reported,) = file.notes
    assert note in reported


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("A,1,5", "expected NAME,VALUE with a decimal point (1.5, not 1,5) and no third column, found"),
        ("A 1.5 m/s", "and nothing after it (no unit, no further column)"),
        ("A", "expected NAME VALUE, found 'A'"),
        ("A \uff11", "with a number"),
        ("A 1e999", "with a number"),
        (f"A 1{'0' * 350}", "with a number"),
        ("A -0x10", "with a number"),
        ("A,-1.#IND", "with a number"),
        ("1 2", "with a parameter's name"),
        ("AÄ 2", "only printable ASCII"),
        ("A_VERY_LONG_NAME_ 2", "a param_id holds 16"),
        ("@include other.parm", "only a file on disk can include another file"),
        ("@delete A", "an unknown instruction for ArduPilot's tools"),
    ],
)
def test_ambiguous_lines_are_rejected(text: str, problem: str) -> None:
    assert problem in str(failed(text))


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("1\t1\tB\t1,5\t9", "a number with a decimal point in the fourth column"),
        ("1\t1\tB\t300\t1", "300 does not fit UINT8"),
        ("1\t1\tB\t1e39\t9", "beyond the range of a float32"),
        ("1\t1\tB\t1\t11", "a type from 1 to 10"),
        ("1\t1\t2\t1\t9", "a parameter's name"),
        ("1\t1\tB\t1\t9\tx", "vehicle, component, name, value and type, with tabs"),
        ("B,1", "vehicle, component"),
    ],
)
def test_an_invalid_qgroundcontrol_row_is_rejected(row: str, problem: str) -> None:
    error = failed(f"1\t1\tA\t1\t9\n{row}\n")
    assert (error.line, problem in str(error)) == (2, True), str(error)


def test_an_error_lists_at_most_twenty_bad_lines() -> None:
    error = failed("A 1\n" + "bad\n" * 50)
    assert str(error).splitlines()[:2] == [
        "quad.x:2: expected NAME VALUE, found 'bad'",
        "quad.x:3: expected NAME VALUE, found 'bad'",
    ]
    assert str(error).splitlines()[20:] == ["and 30 more"]
    assert (error.source, error.line) == ("quad.x", 2)
    long = "x" * 10_000
    assert len(str(failed(f"A 1\n{long}"))) < 300
    value = f'{{"paramclient": 1, "sets": [{{"params": {{"A": {{"value": "{long}"}}}}}}]}}'
    assert len(str(failed(value))) < 400
    assert len(str(failed(f'{{"{long}": 1, "{long}": 2}}'))) < 300


@pytest.mark.parametrize(
    ("data", "problem", "line"),
    [
        (b"", "contains no parameters", None),
        (b"# only a comment\n", "contains no parameters", None),
        (b"A 1\nB \xff\n", "expected UTF-8 text, found the byte 0xff", 2),
        (b"\x1f\x8b\x08\x00", "not a parameter file: a compressed file", None),
        (b"\x1b\x67\x05", "invalid packed parameter file", None),
        ("A 1\n".encode("utf-16-le"), "found the character 0x00", 1),
    ],
)
def test_other_files_are_rejected(data: bytes, problem: str, line: int | None) -> None:
    error = failed(data)
    assert (problem in str(error), error.line) == (True, line), str(error)


# Files of other programs


KINDS = [
    ("a page of HTML", "<!DOCTYPE html>\n<html><body>404</body></html>\n"),
    ("a page of HTML", "\ufeff<!-- saved -->\n<html>"),
    ("a page of HTML", "<?xml version='1.0'?>\n<!DOCTYPE html>".encode("utf-16")),
    ("the output of PX4's `param show`", "Symbols: x = used, + = saved\nx + CAL_ACC0_ID [1,2] : 1310988\n"),
    ("the output of PX4's `param show` or `bsondump`", "BSON document size 774\nBSON_INT32:  A = 1\n"),
    ("four columns", "# MAV ID  COMPONENT ID\n1\t1\tACC_OFFS_X\t0.5\n1\t1\tARMING\t1\n"),
    ("a plan of QGroundControl", '{"fileType":"Plan","version":1,"mission":{"items":[]}}\n'),
    ("not a parameter file of paramclient (JSON)", '{"parameters":[{"name":"A","value":1}]}'),
    ("metadata of parameters", '{"parameters":[{"name":"A","default":1}]}'),
    ("a start script of PX4", "#!/bin/sh\n. ${R}etc/init.d/rc.mc_defaults\nparam set-default A 6.5\n"),
    ("a script that sets no parameter", "#!/bin/sh\n. ${R}etc/init.d-posix/airframes/4001_gz_x500\n"),
    ("a list with a third column", "A 1 1\nB 2.5 3\n"),
    ("parameter storage of PX4 (BSON)", b"\x14\0\0\0\x10MC_ROLL_P\0\1\0\0\0\0"),
    ("parameter storage of PX4 (BSON)", b"\0\0\0\0\x01MC_ROLL_P" + bytes(10) + b"\xff"),  # before 1.12
]
RECORDED = {
    "parameters.json": "not a parameter file: metadata of parameters",
    "apm.pdef.json": "not a parameter file: metadata of parameters",
    "apm.pdef.xml": "not a parameter file: metadata of parameters",
    "ardupilot_flight.bin": "not a parameter file: an on-board log of ArduPilot",
    "px4_flight.ulg": "not a parameter file: an on-board log of PX4",
    "px4_get_set.tlog": "not a parameter file: a telemetry log",
}


@pytest.mark.parametrize(
    ("data", "kind"),
    [*((data, kind) for kind, data in KINDS), *((DATA / name, kind) for name, kind in RECORDED.items())],
)
def test_a_file_of_another_program_is_named(data: bytes | str | Path, kind: str) -> None:
    error = failed(data.read_bytes() if isinstance(data, Path) else data)
    assert (kind in str(error), error.line, len(str(error).splitlines())) == (True, None, 1), str(error)


def test_a_comment_in_another_encoding_is_read() -> None:
    file = loads("# Höhe\nA,1\nB,2 # für Jo\n".encode("cp1252"), source="quad.param")
    assert (file.header, file.sets[0]["B"].comment) == (("Höhe",), "für Jo")
    assert file.notes == ("Comments that are not UTF-8 were read as Windows-1252: line 1, line 3.",)
    assert "quad.x:2: expected UTF-8 text, found the byte 0xf6" in str(failed("A,1\nHöhe,2".encode("cp1252")))
    text = '{"paramclient": 1, "header": ["", "Höhe"],\n"sets": [{"params": {"A": {"value": 1},\n"ö": {}}}]}'
    file = loads(text.encode("cp1252"), partial=True)
    assert (file.header, [*file.sets[0]], file.notes[0][:8]) == (("", "Höhe"), ["A"], "line 3: ")
    assert "Windows-1252: line 1." in file.notes[1]


ROWS = {
    "A,1\n?\nB,2\n": [*(f"{name},0" for name in BAD_NAMES), "C,one", "C", "C,1,5", "C,1e999", "C,1 m"],
    "1\t1\tA\t1\t6\n1\t1\t?\n1\t1\tB\t2\t6\n": [*(f"{name}\t0\t6" for name in BAD_NAMES), "C\t1e39\t9", "C"],
    '{"paramclient": 1, "sets": [{"params": {"A": {"value": 1},\n?, "B": {"value": 2}}}]}': [
        *('"SIM_GPS1_BYTELOSS": {}', '"C": {"value": 300, "type": "INT8"}', '"C": {"value": "x"}', '"C": 1')
    ],
}


@pytest.mark.parametrize("text", [text.replace("?", row) for text, rows in ROWS.items() for row in rows])
def test_a_parameter_that_cannot_be_taken_is_left_out_on_request(text: str) -> None:
    assert failed(text).line == 2
    file = loads(text.encode(), source="quad.x", partial=True)
    assert {name: param.value for name, param in file.sets[0].items()} == {"A": 1, "B": 2}
    is_overlong = text.startswith(("A,1\nSIM_", "1\t1\tA\t1\t6\n1\t1\tSIM_"))
    assert ([note[:8] for note in file.notes], file.faults) == (["line 2: "], 1 - is_overlong)


def test_a_fault_of_the_whole_file_is_an_error_also_on_request_of_a_part() -> None:
    document = '{"paramclient": 1, "sets": [{"system": 0, "params": {"A": {"value": 1}}}]}'
    for text in ("bad\nbad\n", "A,1\n@include missing.param\n", "<html>\nA = 1\n", document):
        assert failed(text, partial=True)
    more = loads(b"A,1\n" + b"bad\n" * 50, partial=True)
    assert (more.faults, len(more.notes), more.choose().lacks[:15]) == (50, 21, "without 50 para")


# Format detection


@pytest.mark.parametrize(
    ("text", "source", "form"),
    [
        ("A 1", "x.parm", "parm"),
        ("A,1", "x.parm", "parm"),
        ("A 1", "x.param", "mission-planner"),
        ("A,1", "x.params", "mission-planner"),
        ("1 1 A 1 9", "x.param", "qgc"),
        ("#! mine\nA 1", "x.parm", "parm"),
        ('{"paramclient": 1, "sets": [{"params": {"A": {"value": 1}}}]}', "x.param", "json"),
    ],
)
def test_the_content_selects_the_format(text: str, source: str, form: str) -> None:
    file = loads(text.encode(), source=source)
    assert (file.file_format, file.sets[0]["A"].value, file.sets[0].source) == (form, 1, source)


def test_a_given_format_is_not_detected() -> None:
    assert loads(b"A 1", file_format="mission-planner").file_format is FileFormat.MISSION_PLANNER
    assert "vehicle, component" in str(failed("A 1", file_format="qgc"))
    with pytest.raises(UsageError, match=r"unknown file format 'xml'; choose one of qgc, parm"):
        loads(b"A 1", file_format="xml")
    with pytest.raises(UsageError, match="give the format in which to write"):
        dumps(params_of(WrittenParam("A", 1)))


# Content that cannot be written


CAMERA = params_of(WrittenParam("A", 1, ParamType.INT8), component=100)


@pytest.mark.parametrize(
    ("sets", "form", "problem"),
    [
        ([params_of()], "parm", "there are no parameters to write"),
        ([params_of(WrittenParam("A", 1))], "qgc", "A has no type that MAVLink defines"),
        ([replace(CAMERA, system=None)], "qgc", "the set has none: give it one"),
        ([params_of(WrittenParam("A", 1))], "pck", "A has no type, and a packed file holds INT8, INT16"),
        ([params_of(WrittenParam("A B", 1))], "parm", "'A B': not every parameter file can hold it"),
        (
            [params_of(WrittenParam("A#", 1, ParamType.INT8))],
            "qgc",
            "'A#': not every parameter file can hold it",
        ),
        ([params_of(WrittenParam("A", 300, ParamType.INT8))], "json", "300 does not fit INT8"),
        (
            [params_of(WrittenParam("A", from_bits(0x7FC12345, ParamType.REAL32)))],
            "json",
            "A is a NaN with payload bits, and has no type",
        ),
        *(
            ([unreadable], form, problem)
            for unreadable, problem in (
                (params_of(WrittenParam("", 1)), "at least one character"),
                (params_of(WrittenParam("A_VERY_LONG_NAME_", 1)), "a param_id holds 16"),
                (replace(CAMERA, at=math.inf), "inf is not a valid Unix time in seconds"),
            )
            for form in ("parm", "json")
        ),
        *(
            ([replace(CAMERA, component=1), CAMERA], form, f"the format {form} holds one component")
            for form in ("parm", "mission-planner", "pck")
        ),
        (
            [replace(CAMERA, component=1), replace(CAMERA, component=None)],
            "qgc",
            "two sets have the same component, 1/?",
        ),
    ],
)
def test_inexpressible_content_is_rejected(sets: list[ParamSet], form: str, problem: str) -> None:
    with pytest.raises(FileError) as caught:
        dumps(sets, file_format=form, target="out.x")
    assert str(caught.value).startswith("out.x: ")
    assert problem in str(caught.value)


# paramclient's own format


def test_a_document_of_an_earlier_version_reads_and_is_written_unchanged() -> None:
    """vehicle.json has every field, written by the first version of the format."""
    data = (DATA / "vehicle.json").read_bytes()
    file = loads(data, source="vehicle.json")
    assert file.header == ("for Jo", "", "  indented 🚁", "end")
    first, second = file.sets
    assert (first.system, first.component, first.at, first.source) == (3, 1, 1_700_000_000.25, "vehicle.json")
    assert first.identity == Identity(
        3, 'udpin:"x"', "00ff", 12, 2, 0x01110000, "abc123", 5, 6, 7, 1_099_511_627_776
    )
    assert first["NAN_BITS"].bits_as(ParamType.REAL32) == 0x7FC12345
    assert (first["WIDE"].value, first["WIDE"].default) == (-(2**63), 2**63 - 1)
    assert (second.component, second.identity, list(second)) == (100, None, ["yes"])
    written = replace(
        file, sets=(replace(first, source="link udpin:0.0.0.0:14550"), replace(second, source=""))
    )
    assert dumps(written) == data


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ('"value": 1, "type": "INT8", "bits": "00000002"', "value 1 and bits 00000002 (2) contradict"),
        ('"value": 1, "bits": "00000001"', "bits need a type"),
        ('"value": 1, "type": "INT8", "bits": "00000101"', "exceed the size of the type"),
        ('"value": 1, "type": "INT9"', "unknown type 'INT9'"),
        ('"value": 1.5, "type": "INT8"', "1.5 is not a whole number"),
        ('"value": 1, "type": "INT8", "default": 300', "300 does not fit INT8"),
        ('"value": true', "expected a number"),
        ('"value": "nan"', "expected a number"),
        ('"value": 1e999', "beyond the range of a double"),
        *((f'"value": 1{"0" * size}', "beyond the range of a double") for size in (350, 5000)),
        ('"value": NaN', "NaN is not valid JSON"),
        ('"value": 1, "units": "m"', "unknown field"),
        ('"type": "INT8"', "the field is missing"),
        ('"value": 1, "value": 2', "'value' occurs twice"),
    ],
)
def test_an_invalid_field_is_rejected(fields: str, problem: str) -> None:
    text = '{"paramclient": 1, "sets": [{"params": {"OK": {"value": 1}, "A": {?}}}]}'
    error = failed(text.replace("?", fields))
    assert problem in str(error)
    assert error.source == "quad.x"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "expected JSON"),
        ("{}", "not a parameter file of paramclient (JSON)"),
        ('{"paramclient": 2, "units": []}', "a newer paramclient wrote it, in version 2 of"),
        ('{"paramclient": 0, "sets": []}', "it should be 1, the version of the format, found 0"),
        ('{"paramclient": 1, "sets": []}', "contains no parameters"),
        ('{"paramclient": 1, "sets": [{"at": "2026-01-31T12:00:00", "params": {}}]}', "needs its zone"),
        ('{"paramclient": 1, "sets": [{"at": "2026-02-31T12:00:00Z", "params": {}}]}', "found '2026-02-31"),
        ('{"paramclient": 1, "sets": [{"system": 256, "params": {}}]}', "sets.0.system"),
        ('{"paramclient": 1, "sets": [{"params": {"": {"value": 1}}}]}', "at least one character"),
        ('{"paramclient": 1, "sets": [{"params": {"A": {}, "A": {}}}]}', "'A' occurs twice"),
        ('{"a":' * 100_000, "nested too deep"),
        ('{"A": %s}' % ("9" * 5000), "not a parameter file of paramclient"),
        ('{"paramclient": 1, "sets": [{"at": "9999-12-31T23:59:59.9999999Z", "params": {}}]}', "not every"),
        ('{"paramclient": 1, "sets": [{"at": "0001-01-01T00:00:00Z", "params": {}}]}', "not every time zone"),
        (
            '{"paramclient": 1, "sets": [{"params": {"A": {"value": 1}}}, {"component": 1, "params": {}}]}',
            "quad.x: two sets have the same component, ?/1",
        ),
    ],
)
def test_an_invalid_document_is_rejected(text: str, problem: str) -> None:
    assert problem in str(failed(text))
