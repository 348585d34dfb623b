"""JSON documents: exact values, order of members, agreement with their schema, lazy loading of pydantic."""

from __future__ import annotations

import ast
import importlib
import json
import math
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from paramclient.cache import (
    HistoryEntry,
    SnapshotSummary,
)
from paramclient.documents.diff import DiffDoc
from paramclient.documents.document import Document
from paramclient.documents.history import HistoryDoc, HistoryEntryDoc, SnapshotDoc
from paramclient.documents.param import InfoDoc, InfosDoc, ParamDoc, ReadOutputDoc, WrittenParamDoc
from paramclient.documents.paramset import FileDoc, FormatDoc, SetDoc, UploadedDoc
from paramclient.documents.setup import ApplyResultDoc, InterruptedDoc, PlanDoc, VerifiedDoc
from paramclient.errors import NoReply, UnknownParameter
from paramclient.files import FileFormat, loads
from paramclient.metadata import Metadata, ParamInfo
from paramclient.model.comparison import compare, defaults_of
from paramclient.model.notation import bits_written, typed, value_json
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, ParamType, Trust, WireValue, bits_of
from paramclient.provision import ApplyResult, ApplyRow, ApplyStatus, plan
from tests.caches import PX4
from tests.commands import strict
from tests.openapi_schema import Published

ROOT = Path(__file__).parents[2]
THIRD = struct.unpack("<f", struct.pack("<f", 1 / 3))[0]


def param(name: str, value: WireValue, kind: ParamType | int = ParamType.REAL32, **more: object) -> Param:
    bits = int.from_bytes(value, "little") if isinstance(value, bytes) else bits_of(value, kind)
    return Param(name, value, kind, None, bits, **more)  # type: ignore[arg-type]  # the further members


# values


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
def test_values_are_exact(value: WireValue, kind: ParamType | int, shown: object) -> None:
    member = value_json(value, kind)
    assert (type(member), repr(member)) == (type(shown), repr(shown))
    document = ParamDoc.of(param("P", value, kind))
    assert repr(strict(json.dumps(document.as_json(), allow_nan=False))["value"]) == repr(shown)


def test_bits_have_the_width_of_the_type() -> None:
    assert ParamDoc.of(param("P", 1, ParamType.UINT64)).bits == "0000000000000001"
    assert ParamDoc.of(param("P", 1, ParamType.INT8)).bits == "00000001"
    assert bits_written(WrittenParam("P", 1.0, ParamType.REAL32)) == "3f800000"
    assert bits_written(WrittenParam("P", 1.0)) is None
    assert bits_written(WrittenParam("P", 300, ParamType.INT8)) is None


def test_an_integer_written_for_a_float_becomes_a_float() -> None:
    assert typed(5, ParamType.REAL32) == (5.0, ParamType.REAL32)
    assert isinstance(typed(5, ParamType.REAL32)[0], float)
    assert typed(5, ParamType.INT32) == (5, ParamType.INT32)
    assert typed(0.5, None) == (0.5, ParamType.REAL32)


# members


def test_a_parameter_has_its_members_in_order_and_no_empty_ones() -> None:
    bare = ParamDoc.of(param("P", 1.5))
    assert list(bare.as_json()) == ["value", "type", "index", "bits"]
    info = ParamInfo("P", units="m", values={1.5: "half"}, minimum=0, maximum=math.inf, reboot_required=True)
    known = Param("P", 1.5, ParamType.REAL32, 4, bits_of(1.5, ParamType.REAL32), Trust.VERIFIED, 1.25)
    assert ParamDoc.kept(known, info, heard_at=5.5, whole=True).as_json() == {
        "name": "P",
        "value": 1.5,
        "type": "REAL32",
        "index": 4,
        "bits": "3fc00000",
        "default": 1.25,
        "default_source": "vehicle",
        "is_default": False,
        "trust": "verified",
        "heard_at": 5.5,
        "text": "half",
        "units": "m",
        "metadata": {
            "units": "m",
            "minimum": 0,
            "maximum": "Infinity",
            "values": {"1.5": "half"},
            "reboot_required": True,
        },
    }
    assert InfoDoc.of(ParamInfo("P")).as_json() == {}


def test_the_default_of_metadata_is_marked_and_is_none_of_the_vehicle() -> None:
    document = ParamDoc.kept(param("P", 1.5), described=2)
    assert (document.default, document.default_source, document.is_default) == (2, "metadata", False)
    assert document.param("P").default is None
    given = ParamDoc.kept(Param("P", 1.5, ParamType.REAL32, 4, 0x3FC00000, Trust.LIVE, 1.5), described=2)
    assert (given.default, given.default_source, given.is_default) == (1.5, "vehicle", True)
    assert given.param("P").default == 1.5


def test_metadata_goes_over_a_service_without_loss_but_for_types() -> None:
    info = ParamInfo(
        "P{n}",
        short_description="short",
        long_description="long",
        units="m",
        minimum=-1,
        maximum=math.inf,
        increment=0.1,
        decimals=2,
        default=0.5,
        values={0: "off", 1.5: "half"},
        bits={3: "three"},
        reboot_required=True,
        is_read_only=True,
        is_volatile=True,
        category="c",
        group="g",
    )
    reported = InfosDoc.of(Metadata.of([info], source="the file"), ["P7"])
    metadata = InfosDoc.model_validate_json(reported.model_dump_json()).metadata()
    assert metadata.source == "the file"
    assert dict(metadata) == {"P7": info.instance("P7", "7")}


def test_errors_are_a_member_only_if_a_parameter_was_not_received() -> None:
    error = UnknownParameter("no such", system=1, component=1, name="Q")
    assert ReadOutputDoc.of([], None, {"Q": error}).as_json() == {"params": {}, "errors": {"Q": "no such"}}
    metadata = Metadata.of([ParamInfo("P{n}", units="s")])
    assert ReadOutputDoc.of([param("P7", 1.0)], metadata, {}).as_json()["params"]["P7"]["units"] == "s"


def test_exact_history_has_times_and_bits() -> None:
    entry = HistoryEntry(0.25, 1, "P", param("P", math.nan), None, "us for <b>")
    assert HistoryEntryDoc.of(entry).as_json() == {
        "time": "1970-01-01T00:00:00.250Z",
        "component": 1,
        "name": "P",
        "old": "NaN",
        "new": None,
        "by": "us for <b>",
    }
    exact = HistoryDoc.of([entry], exact=True, before=0.25).as_json()
    assert exact["before"] == 0.25
    assert exact["history"][0]["at"] == 0.25
    assert exact["history"][0]["old_exact"] == {"type": "REAL32", "bits": "7fc00000"}
    assert "new_exact" not in exact["history"][0]


# every document


def documents() -> Iterator[Document]:
    """Yield one document of each kind that can be built from plain data."""
    info = ParamInfo("A", type=ParamType.REAL32, short_description="\x1b[31m<script>", bits={0: "GPS"})
    left = ParamSet(
        {"A": WrittenParam("A", 1, ParamType.REAL32, 0.5, "of old"), "B": WrittenParam("B", math.nan)},
        system=1,
        component=1,
        identity=PX4,
        at=1e9,
        source="a.param",
    )
    right = ParamSet({"A": WrittenParam("A", 2.5, ParamType.REAL32), "C": WrittenParam("C", b"\0\0\0\1", 99)})
    metadata = Metadata.of([info])
    yield ParamDoc.kept(param("A", 1.0), info, heard_at=1.0, whole=True)
    yield WrittenParamDoc.of(left["A"])
    yield SetDoc.of(left)
    yield DiffDoc.of(compare(left, right), metadata, None, everything=True)
    yield DiffDoc.of(compare(left, right, base=defaults_of(left)), None, metadata, metadata)
    file = loads(b"A,1\nA,1\nB,2\n", source="a.param")
    yield FileDoc.of(file)
    yield UploadedDoc.of(file, file.choose())
    yield from map(FormatDoc.of, FileFormat)
    yield SnapshotDoc.of(SnapshotSummary(1, PX4.key, 1, 1.5, "<b>", 3, 0xABC, True), exact=True)
    yield HistoryDoc.of(
        [HistoryEntry(1.5, 1, "A", param("A", 1.0), param("A", b"\0\0\0\1", 99), "us")], exact=True
    )
    planned = plan(
        {"A": param("A", 1.0), "M": param("M", 3, ParamType.INT8)},
        ParamSet({each.name: each for each in (left["A"], left["B"], WrittenParam("M", 4.5))}),
        info={"A": info},
    )
    yield PlanDoc.of(planned, system=1, component=1, full=True)
    yield VerifiedDoc.of(planned, system=1, component=1, full=True)
    rows = {"A": ApplyRow(left["A"], ApplyStatus.SET, 1.0, 1.0, ParamType.REAL32)}
    error = NoReply("anything", attempts=1, waited=2.0)
    result = ApplyResult(7, 1, rows, planned, left, ("X",), 1, ("A",), error, 1.23456)
    yield ApplyResultDoc.of(result, system=1, component=1, full=True)
    yield InterruptedDoc.of([each.so_far for each in rows.values()], system=1, component=1)


@pytest.mark.parametrize("document", [*documents()], ids=lambda document: type(document).__name__)
def test_a_document_matches_its_schema_and_can_be_parsed_again(document: Document) -> None:
    content = strict(json.dumps(document.as_json(), allow_nan=False))
    schema = type(document).model_json_schema(mode="serialization")
    answer = {"application/json": {"schema": schema}}
    published = {
        "paths": {"/": {"get": {"responses": {"200": {"content": answer}, "default": {}}}}},
        **schema,
    }
    Published(published).check("GET", "/", 200, content)
    again = type(document).model_validate(content)
    assert again.as_json() == content
    with pytest.raises(ValueError, match="frozen"):
        setattr(document, next(iter(type(document).model_fields)), None)


def test_every_document_has_a_docstring() -> None:
    for path in (ROOT / "paramclient" / "documents").glob("*.py"):
        module = importlib.import_module(f"paramclient.documents.{path.stem}")
        classes = [
            node
            for node in ast.parse(path.read_text(encoding="utf-8")).body
            if isinstance(node, ast.ClassDef)
        ]
        for each in classes:
            assert ast.get_docstring(each), each.name
            assert each.name in module.__all__


def test_the_command_line_loads_pydantic_only_for_json(tmp_path: Path) -> None:
    words = ["cache", "list", "--cache", str(tmp_path / "none.sqlite3")]
    program = (
        "import sys; from paramclient.cli import run\n"
        "code = run(sys.argv[1:]); print(code, 'pydantic' in sys.modules, file=sys.stderr)"
    )
    for more, expected in ([], "0 False"), (["--json"], "0 True"):
        done = subprocess.run(
            [sys.executable, "-c", program, *words, *more],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
        )
        assert done.stderr.splitlines()[-1] == expected
