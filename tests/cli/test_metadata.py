"""Metadata in the command line: names of values, units, meanings, descriptions."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient.metadata import MetadataStore
from paramclient.model.values import ParamType
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, SimParam
from tests.commands import Command, Put

DATA = Path(__file__).parents[1] / "data"
XML = DATA / "apm.pdef.xml"

URL = "sim:custom"


def quad(*, metadata: bool = True, ftp: bool = False) -> PX4Vehicle:
    """Return a vehicle with few parameters, some of which have metadata."""
    table = [
        SimParam("COM_FLTMODE1", ParamType.INT32, -1),
        SimParam("EKF2_GPS_CTRL", ParamType.INT32, 7),
        SimParam("MAV_SYS_ID", ParamType.INT32, 1),
        SimParam("MC_ROLL_P", ParamType.REAL32, 6.5),
    ]
    return PX4Vehicle(table=table, metadata=metadata, ftp=ftp)


def copter(system: int = 1) -> ArduPilotVehicle:
    table = [
        SimParam("FLTMODE1", ParamType.INT8, 0),
        SimParam("TST_ALT", ParamType.REAL32, 100.0),
        SimParam("TST_LOG", ParamType.INT32, 1),
    ]
    return ArduPilotVehicle(table=table, system=system, live_period=0)


# set


def test_set_accepts_value_names_of_the_vehicle(command: Command, put: Put) -> None:
    vehicle = quad()
    words = ("COM_FLTMODE1=return", "EKF2_GPS_CTRL=Position|Heading", "--json", "--no-cache")
    done = command("set", put(vehicle), *words)
    assert (done.code, done.err) == (0, "")
    assert [vehicle.values[name] for name in ("COM_FLTMODE1", "EKF2_GPS_CTRL")] == [5, 9]
    assert [each["text"] for each in done.json["results"]] == ["Return", "Position|Heading"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["FLTMODE1=Loitr"],
            r"FLTMODE1: 'Loitr' is not a number, nor one of its values: Stabilize (0), Loiter (5)",
        ),
        (["TST_LOG=7", "FLTMODE1=x", "TST_ALT=1"], "FLTMODE1: 'x' is not a number"),
        (["TST_ALT=high"], "and its values have no names"),
        (["FLTMODE1=5", "FLTMODE1=6"], "FLTMODE1: set takes names, no patterns, and each once"),
        (["FLTMODE1=5", "fltmode1=6"], "FLTMODE1, fltmode1: set takes each parameter once"),
        (["FLTMODE*=5"], "FLTMODE*: set takes names, no patterns"),
        (["FLTMODE1", "5", "--expected", "4"], "Unknown option: --expected"),
        (["=5"], "a parameter name has at least one character"),
    ],
)
def test_nothing_is_sent_with_a_wrong_name(command: Command, put: Put, words: list[str], said: str) -> None:
    vehicle = copter()
    done = command("set", put(vehicle), *words, "--metadata", XML, "--no-cache")
    assert (done.code, done.out) == (2, "")
    assert said in done.err
    assert done.err.count("\n") == 1
    assert not vehicle.requests["PARAM_SET"]


# get


def test_downloaded_metadata_is_stored(command: Command, put: Put) -> None:
    """The stored metadata is used for its firmware without a request, also without a link."""
    assert "units" not in command("get", put(quad()), "MC_ROLL_P", "--json").out
    assert "1/s" in command("get", put(quad()), "MC_ROLL_P", "--metadata", "vehicle").out
    vehicle = quad()
    assert "1/s" in command("get", put(vehicle), "MC_ROLL_P").out
    assert not vehicle.requests["FILE_TRANSFER_PROTOCOL"]
    assert "units" not in command("get", put(copter(system=2)), "TST_LOG").out
    assert "above the maximum of 12" in command("set", put(quad()), "MC_ROLL_P", 13).err
    assert "Gain from the error of the roll angle" in command("show", "1", "MC_ROLL_P").out


def test_the_vehicle_must_confirm_stored_value_names(command: Command, put: Put, cache: Path) -> None:
    """The vehicle confirms it by its checksum: a firmware may have been built from other sources."""
    assert command("get", put(quad()), "MC_ROLL_P", "--metadata", "vehicle").code == 0
    assert MetadataStore.beside(cache).has_notes
    silent = quad(metadata=False)
    assert command("set", put(silent), "COM_FLTMODE1=Return").code == 2
    assert not silent.requests["PARAM_SET"]
    vehicle = quad()
    assert command("set", put(vehicle), "COM_FLTMODE1=Return").code == 0
    assert not vehicle.requests["FILE_TRANSFER_PROTOCOL"]


# diff


def test_diff_prints_meaning_and_units(command: Command, tmp_path: Path) -> None:
    left, right = tmp_path / "left.param", tmp_path / "right.param"
    left.write_text("FLTMODE1,5\nTST_ALT,100\n")
    right.write_text("FLTMODE1,6\nTST_ALT,120\n")
    done = command("diff", left, right, "--metadata", XML)
    assert done.code == 1
    assert [line.split() for line in done.out.splitlines()][:3] == [
        ["name", "left", "right", "units", "is"],
        ["FLTMODE1", "5", "(Loiter)", "6", "(RTL)", "different"],
        ["TST_ALT", "100", "120", "cm", "different"],
    ]


@pytest.mark.parametrize("words", [["get", "sim:px4", "A"], ["set", "sim:px4", "A=1"], ["show"]])
def test_an_invalid_metadata_file_is_exit_code_2(command: Command, tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "a.xml").write_text("<html/>")
    for file, said in (("none.xml", "cannot be read"), ("a.xml", "begins with <html>")):
        done = command(*words, "--metadata", tmp_path / file)
        assert (done.code, done.out) == (2, "")
        assert said in done.err
        assert done.err.count("\n") == 1


# show


def test_show_prints_the_metadata_of_a_parameter(command: Command, put: Put) -> None:
    assert command("fetch", put(copter())).code == 0
    done = command("show", "1", "FLTMODE1", "TST_ALT", "--metadata", XML)
    assert done.code == 0
    lines = done.out.splitlines()
    assert lines[0].split()[-2:] == ["meaning", "units"]
    assert [line.split()[0] for line in lines[1:3]] == ["FLTMODE1", "TST_ALT"]
    assert lines[1].endswith("Stabilize")
    assert lines[3:] == [
        "",
        "FLTMODE1: First flight mode",
        '  The mode at the "lowest" position',
        "  0: Stabilize",
        "  5: Loiter",
        "  6: RTL",
        "",
        "TST_ALT: Return height",
        "  How high to return",
        "  range: 30 to 3000.5 cm",
        "  increment: 1 cm",
        "  reboot: a change takes effect after a reboot",
    ]
