"""Names in arguments: patterns, upper and lower case; unknown ones are in `test_mistaken_arguments`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam
from tests.commands import Command, Put
from tests.shell import Eventful

URL = "sim:px4"
TABLE: dict[str, Any] = {"MC_ROLL_P": 4.0, "MC_PITCH_P": 4.5, "MC_YAW_P": 2.5, "SYS_AUTOSTART": 4001}
NAMES = ("mc_*", "sys_autostart")
"""All of these."""


@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle, GenericVehicle])
def test_get_takes_patterns_and_any_case(command: Command, put: Put, make: Any) -> None:
    vehicle = make(table=TABLE)
    got = command("get", put(vehicle), *NAMES, "--json")
    assert got.code == 0, got.err
    assert {name: each["value"] for name, each in got.json["params"].items()} == TABLE
    [row] = command("get", put(vehicle), "Mc_Roll_p").rows[1:]
    assert row[:2] == ["MC_ROLL_P", "4.0"]


def test_a_name_in_lower_case_is_found_without_a_table(command: Command, put: Put) -> None:
    vehicle = PX4Vehicle(table={"lower_name": 5, "UPPER": 1.0})
    assert command("get", put(vehicle), "lower_name").code == 0
    assert command("set", put(vehicle), "lower_name", "6").code == 0
    assert vehicle.values["lower_name"] == 6


def test_a_name_that_fits_two_parameters_in_other_cases_is_not_written(command: Command, put: Put) -> None:
    vehicle = GenericVehicle({"Gain": 1.0, "gain": 2.0}, param_error=True)
    assert command("fetch", put(vehicle)).code == 0
    assert command("set", put(vehicle), "GAIN", "5").code == 2
    assert vehicle.values == {"Gain": 1.0, "gain": 2.0}
    assert command("set", put(vehicle), "gain", "5").code == 0
    assert vehicle.values == {"Gain": 1.0, "gain": 5.0}


def test_fetch_show_history_save_take_names_and_patterns(command: Command, put: Put, tmp_path: Path) -> None:
    url = put(PX4Vehicle(table=TABLE))
    fetched = command("fetch", url, *NAMES, "--json")
    assert (fetched.json["received"], set(fetched.json["params"])) == (4, set(TABLE))
    assert [row[0] for row in command("fetch", url, "mc_[ry]*").rows[1:]] == ["MC_ROLL_P", "MC_YAW_P"]
    [shown] = command("show", 1, *NAMES, "--json").json["components"]
    assert set(shown["params"]) == set(TABLE)
    path = tmp_path / "some.param"
    assert command("save", url, path, "--only", "mc_*").err.startswith("3 parameters of 1/1 written to ")
    assert command("set", url, "MC_ROLL_P", 5, "MC_PITCH_P", 6, "SYS_AUTOSTART", 7).code == 0
    changes = command("history", 1, "mc_*", "--json").json["history"]
    assert {(each["name"], each["new"]) for each in changes} == {("MC_ROLL_P", 5.0), ("MC_PITCH_P", 6.0)}
    assert command("history", 1, "MC_YAW_P", "--json").json["history"] == [], "it is known and never changed"
    for words in (["show", 1], ["history", 1], ["fetch", url]):
        assert command(*words, "MC_ROLL_P", "FOO*").code == 2


def test_watch_follows_groups_that_appear(command: Command, put: Put) -> None:
    """Another program switches a group on, and later off."""

    def switch(on: int) -> None:
        vehicle.set_param("GRP_ENABLE", on)
        vehicle.set_param("MC_ROLL_P", 5.0 + on)

    table = [SimParam("GRP_ENABLE", 2, 0), SimParam("MC_ROLL_P", 9, 4.0)]
    groups: dict[str, Any] = {"GRP_ENABLE": {"GRP_ONE": 1.0, "GRP_TWO": 2.0}}
    vehicle = ArduPilotVehicle(table=table, groups=groups, live=(), ftp=False)
    url = put(Eventful(vehicle, (8.0, lambda: switch(1)), (24.0, lambda: switch(0))))
    watched = command("watch", url, "grp_*", "--timeout", 60, "--vehicle", 1)
    assert (watched.code, watched.err) == (0, "watching grp_* of 1/1 ArduPilot quadrotor\n")
    found = [line.partition("  ")[2] for line in watched.out.splitlines()]
    assert sorted(line for line in found if not line.startswith("1/1 resynced")) == [
        "GRP_ENABLE  0 -> 1  (vehicle)",
        "GRP_ENABLE  1 -> 0  (vehicle)",
        "GRP_ONE  1.0 -> none  (vehicle)",
        "GRP_ONE  none -> 1.0  (vehicle)",
        "GRP_TWO  2.0 -> none  (vehicle)",
        "GRP_TWO  none -> 2.0  (vehicle)",
    ]
