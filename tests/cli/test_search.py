"""The subcommands search and info: cached parameters by words, and all that is known of one."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient.sim import ArduPilotVehicle, PX4Vehicle
from tests.commands import Command, Put
from tests.metadata.test_added_files import described

URL = "sim:px4"


@pytest.fixture
def tables(command: Command, put: Put) -> None:
    """Cache the tables of two vehicles."""
    px4 = PX4Vehicle(metadata=True)
    assert command("fetch", put(px4)).code == 0
    for value in (6.5, 7.5):
        assert command("set", put(px4), "MC_ROLL_P", value).code == 0
    assert command("get", put(px4), "MC_ROLL_P", "--metadata", "vehicle").code == 0
    assert command("fetch", put(ArduPilotVehicle(system=2))).code == 0


@pytest.mark.usefixtures("tables")
def test_search_finds_names_descriptions_and_value_names(command: Command) -> None:
    found = command("search", "ROLL", "gain", "--json")
    assert found.code == 0
    first = found.json["results"][0]
    assert (first["name"], len(first["vehicles"])) == ("MC_ROLL_P", 1)
    assert "roll" in first["description"].lower()
    assert command("search", "mc_roll_p").rows[1][:3] == ["MC_ROLL_P", "7.5", "1/1"]
    assert command("search", "ROLL gain", "--json").json == found.json  # words in quotes
    assert command("search", " ").code == 2
    assert any("EKF2_GPS_CTRL" in row for row in command("search", "heading", "gps").rows)
    of_one = command("search", "rtl_alt", "--vehicle", 2, "--json").json["results"]
    assert "RTL_ALT" in [each["name"] for each in of_one]
    assert command("search", "rtl_alt", "--vehicle", 1).code == 1


@pytest.mark.usefixtures("tables")
def test_search_reports_that_nothing_was_found(command: Command) -> None:
    nothing = command("search", "xyzzy")
    assert (nothing.code, nothing.out) == (1, "")
    assert nothing.err.startswith("paramclient: nothing found; ")
    assert "only names of 2/1 ardupilot were searched: `paramclient fetch LINK --metadata " in nothing.err
    of_described = command("search", "xyzzy", "--vehicle", 1)
    assert of_described.err == "paramclient: nothing found; 903 parameters searched\n"


def test_search_prints_a_value_of_all_vehicles_and_the_number_of_others(command: Command, put: Put) -> None:
    for system in (1, 2, 3):
        table = {"GAIN_P": 4.0, "GAIN_I": system / 2, "GAIN_D": min(system, 2)}
        assert command("fetch", put(PX4Vehicle(system=system, table=table))).code == 0
    assert command("search", "gain").rows[1:] == [
        ["GAIN_D", "2 values", "1/1, 2/1, 3/1"],
        ["GAIN_I", "3 values", "1/1, 2/1, 3/1"],
        ["GAIN_P", "4.0", "1/1, 2/1, 3/1"],
    ]


def test_a_camera_needs_no_metadata(command: Command) -> None:
    assert command("fetch", "sim:camera", "--vehicle", "1/100", "--extended").code == 0
    assert command("get", "sim:px4?metadata=1", "MC_ROLL_P", "--metadata", "vehicle").code == 0
    found = command("search", "roll")
    assert (found.code, found.err) == (0, "")


@pytest.mark.usefixtures("tables")
def test_info_prints_the_description_and_the_values(command: Command) -> None:
    known = command("info", "mc_roll_p")
    assert known.code == 0
    lines = [line.strip() for line in known.out.splitlines()]
    assert lines[1].startswith("MC_ROLL_P: ")
    assert "range: 0 to 12 1/s" in lines
    assert known.rows[-1][:5] == ["1/1", "7.5", "REAL32", "4.0", "metadata"]
    document = command("info", "MC_ROLL_P", "--json").json
    assert (document["name"], document["metadata"]["units"]) == ("MC_ROLL_P", "1/s")
    [vehicle] = document["vehicles"]
    assert (vehicle["system"], vehicle["param"]["value"]) == (1, 7.5)
    assert vehicle["heard_at"].endswith("Z")


def test_each_vehicle_has_the_meaning_of_its_own_firmware(command: Command, put: Put, tmp_path: Path) -> None:
    copter = ArduPilotVehicle(table={"MODE": 2})
    rover = ArduPilotVehicle(table={"MODE": 2}, system=2, kind="rover")
    for vehicle, name in ((copter, "ArduCopter"), (rover, "Rover")):
        assert command("fetch", put(vehicle)).code == 0
        file = described(tmp_path, name)
        file.write_text(file.read_text().replace("Loiter", f"{name} 2"))
        assert command("metadata", "add", file).code == 0
    shown = command("info", "MODE")
    assert [row[:3] for row in shown.rows[-2:]] == [["1/1", "2", "ArduCopter 2"], ["2/1", "2", "Rover 2"]]
    assert "\nMODE of 2/1: Mode\n" in shown.out
    assert command("search", "rover").rows[1][0] == "MODE"


@pytest.mark.usefixtures("tables")
def test_info_of_an_undescribed_name_says_so(command: Command) -> None:
    assert command("info", "RTL_ALT", "--vehicle", 1).code == 2
    undescribed = command("info", "RTL_ALT")
    assert undescribed.rows[-1][:2] == ["2/1", "1500"]
    assert "no metadata of 2/1 ardupilot is known: " in undescribed.err
