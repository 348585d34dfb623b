"""The subcommand save: written files, refused tables, messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import ParamCache, ParamSet, ParamType, WrittenParam, read_file, write_file
from paramclient.files.formats import ENDINGS
from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam
from tests.commands import Command, Put
from tests.conversations.partial import TABLE, Partial

URL = "sim:px4"
ODD = [
    SimParam("BIG", ParamType.INT32, 16777217),
    SimParam("TENTH", ParamType.REAL32, 0.1),
    SimParam("NAN", ParamType.REAL32, float("nan")),
]


def test_save_writes_the_parameters_of_the_vehicle(command: Command, put: Put, tmp_path: Path) -> None:
    path = tmp_path / "quad.json"
    saved = command("save", put(GenericVehicle(ODD)), path, "--no-cache")
    assert (saved.code, saved.out) == (0, "")
    assert saved.err == f"3 parameters of 1/1 written to {path} (json)\n"
    params = read_file(path).choose()
    assert [params[row.name].bits_as(row.type) for row in ODD] == [row.bits for row in ODD]
    assert (params.system, params.component) == (1, 1)
    assert '"source": "link sim:px4"' in path.read_text()
    assert None not in (params.identity, params.at)


def test_save_needs_no_link_for_a_vehicle_in_the_cache(command: Command, cache: Path, tmp_path: Path) -> None:
    assert command("fetch", "sim:px4").code == 0
    path, (table,) = tmp_path / "quad.json", ParamCache(cache).components()
    saved = command("save", "1", path)
    assert (saved.code, saved.err) == (0, f"903 parameters of 1/1 written to {path} (json)\n")
    params = read_file(path).choose()
    assert params.identity == table.identity
    assert params.at == pytest.approx(table.synced_at, abs=1e-5), "not the present time"


def test_save_writes_parameters_that_differ_from_the_defaults(command: Command, tmp_path: Path) -> None:
    for where in ("sim:ardupilot", "1"):
        path = tmp_path / "quad.param"
        saved = command("save", where, path, "--changed")
        assert (saved.code, saved.err) == (0, f"41 parameters of 1/1 written to {path} (mission-planner)\n")
        assert read_file(path).choose()["RELAY1_FUNCTION"].value == 1
        path.unlink()


def test_nothing_is_written_if_no_parameter_differs(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = ArduPilotVehicle(table=[SimParam("A", ParamType.INT8, 1, default=1)])
    saved = command("save", put(vehicle), tmp_path / "quad.param", "--changed", "--no-cache")
    assert (saved.code, "1/1: no parameter differs from its default" in saved.err) == (1, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ["params", "pck", "param", "json"])
def test_what_was_received_is_written_with_incomplete_and_the_file_names_the_others(
    command: Command, put: Put, tmp_path: Path, ending: str
) -> None:
    """By default it is not: it would look like the file of a vehicle that does not have the others."""
    table = {**TABLE, "RC MAP": (1.0, ParamType.REAL32)}
    vehicle, path = Partial(table, count=lambda index: len(table) + 1), tmp_path / f"quad.{ending}"
    for where, why in (
        (put(vehicle), "index 9 was not received; save and diff take it with --incomplete"),
        ("1", "1/1 is incomplete: 8 of 10 parameters are in the cache"),
    ):
        refused = command("save", where, path)
        assert (refused.code, refused.out, why in refused.err) == (1, "", True), refused.err
        assert not path.exists()
        assert [command("diff", where, where, *more).code for more in ((), ("--incomplete",))] == [1, 0]
        saved = command("save", where, path, "--incomplete")
        assert (saved.code, saved.out) == (0, "")
        assert set(read_file(path).choose()) == set(TABLE) - ({"NODE_ID"} if ending == "pck" else set())
        lacks = f"8 of 10 parameters{', without index 9, ' if where != '1' else ' are in the cache'}"
        assert (lacks in saved.err, lacks.encode() in path.read_bytes()) == (True, ending != "pck")
        assert lacks in command("save", where, path, "--incomplete", "--only", "ZZ*").err
        again = tmp_path / "again.json"
        for words in ("save quad again", "show again", "diff again again", "diff again again --only ZZ*"):
            files = {"quad": path, "again": again}
            assert lacks in command(*(files.get(word, word) for word in words.split())).err or ending == "pck"
        assert lacks in command("apply", URL, again).err or ending == "pck"
        path.unlink()


def test_a_second_parameter_of_the_same_name_is_told(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = Partial()
    vehicle.sent_as["GAIN_4"] = "GAIN_3"
    saved = command("save", put(vehicle), tmp_path / "quad.json", "--no-cache")
    assert (saved.code, "7 of 8 parameters, without a second GAIN_3" in saved.err) == (0, True), saved.err


def test_cached_parameters_in_no_list_are_counted_apart(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = PX4Vehicle(table=dict.fromkeys("ABCD", 1), not_in_use=["C", "D"])
    assert command("get", put(vehicle), "A", "C", "D").code == 0
    refused = command("save", "1", tmp_path / "quad.json")
    assert "incomplete: 1 of 2 parameters are in the cache, and 2 read by name" in refused.err


def test_a_file_from_the_cache_says_what_it_lacks(command: Command, put: Put, tmp_path: Path) -> None:
    link = put(Partial({**TABLE, **{f"RC {at}": (1.0, ParamType.REAL32) for at in range(12)}}))
    assert "Skipped 'RC 0', 'RC 1', 'RC 10', 'RC 11', 'RC 2' and 7 more: " in command("fetch", link).err
    for source, lacks in {"1": "8 of 20 parameters are in the cache", link: "without 'RC 0', 'RC 1'"}.items():
        command("save", source, path := tmp_path / "quad.json")
        assert lacks in path.read_text()


@pytest.mark.parametrize("ending", ["params", "param", "json"])
def test_what_a_format_cannot_hold_is_named(command: Command, put: Put, tmp_path: Path, ending: str) -> None:
    raw = {"WIDE": (b"\1\0\0\0", ParamType.INT64), "ODD": (b"\2\0\0\0", ParamType(0))}
    path, spaced = tmp_path / f"quad.{ending}", tmp_path / "spaced.json"
    saved = command("save", put(Partial({**TABLE, **raw})), path, "--no-cache")
    assert saved.code == 0
    is_whole = ending == "json"
    assert set(read_file(path).choose()) == ({*TABLE, *raw} if is_whole else {*TABLE})
    left_out = f"1/1: left out, as {ENDINGS[f'.{ending}']} cannot hold them: WIDE, ODD; json can"
    assert (left_out in saved.err, "without WIDE, ODD" in path.read_text()) == (not is_whole, not is_whole)
    if ending == "param":
        write_file(spaced, ParamSet({"A": 1, "A B": 2}, 1, 1))
        saved = command("save", spaced, path)
        assert (saved.code, "left out, as mission-planner cannot hold them: A B" in saved.err) == (0, True)
        assert "line 9: the client ignores a parameter called 'A B'" in saved.err
        write_file(spaced, ParamSet({"A": WrittenParam("A", 1, ParamType.INT8)}))
        assert command("save", spaced, tmp_path / "ids.params", "--vehicle", 3).code == 0
        assert read_file(tmp_path / "ids.params").choose().system == 3


def test_a_vehicle_with_component_0_is_written_and_read(command: Command, put: Put, tmp_path: Path) -> None:
    path = tmp_path / "quad.params"
    for words in ((), ("--vehicle", "1/0")):
        assert command("save", put(Partial(component=0, asked_as=0)), path, "--no-cache", *words).code == 0
    [params] = read_file(path).sets
    assert (params.system, params.component, set(params)) == (1, 0, set(TABLE))


def test_a_value_that_is_only_cached_is_not_written(command: Command, put: Put, tmp_path: Path) -> None:
    """No hash covers a volatile value: unless the vehicle sends it, it is unknown."""
    path = tmp_path / "quad.param"
    rows = [SimParam("A", ParamType.INT32, 1), SimParam("CAL_ACC0_XOFF", ParamType.INT32, 2, volatile=True)]
    assert command("save", put(PX4Vehicle(table=rows)), path).code == 0
    path.unlink()
    saved = command("save", put(PX4Vehicle(table=rows, dead=["CAL_ACC0_XOFF"])), path)
    assert (saved.code, saved.out, path.exists()) == (1, "", False)
    assert "1/1 is incomplete: CAL_ACC0_XOFF " in saved.err
