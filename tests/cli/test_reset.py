"""The subcommand reset: only known defaults are written, after a question, and each is verified."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamType
from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam, Vehicle
from paramclient.wire import messages
from tests.commands import Command, Put, metadata_file
from tests.shell import Tap

URL = "sim:custom"
TABLE = [
    SimParam("MC_ENABLE", ParamType.INT8, 1, default=0),
    SimParam("MC_ROLL_P", ParamType.REAL32, 7.0, default=0.1),
    SimParam("MC_PITCH_P", ParamType.REAL32, 0.1, default=0.1),
    SimParam("COUNT", ParamType.INT16, 300, default=12),
    SimParam("FIXED", ParamType.INT8, 3, default=1),
]
CHANGED = {"MC_ENABLE": 0, "MC_ROLL_P": pytest.approx(0.1), "COUNT": 12}


def copter(**others: Any) -> ArduPilotVehicle:
    """An ArduPilot whose parameter file has defaults."""
    options: dict[str, Any] = {"table": TABLE, "read_only": ["FIXED"], "param_error": True}
    return ArduPilotVehicle(**options | others)


def written(tap: Tap) -> list[str]:
    """The names of the values that were sent to the vehicles, in their order."""
    return [each.param_id for each in tap.messages(messages.ParamSet)]


def values(vehicle: Vehicle, *names: str) -> dict[str, Any]:
    return {name: vehicle.values[name] for name in names}


def test_named_parameters_get_the_vehicles_defaults_and_restore_undoes_it(command: Command, put: Put) -> None:
    vehicle = copter()
    before, tap = dict(vehicle.values), Tap(vehicle)
    done = command("reset", put(tap), "COUNT", "mc_*")
    assert done.code == 0, done.err
    assert sorted(row[:5] for row in done.rows[1:]) == [
        ["COUNT", "300", "12", "12", "accepted"],
        ["MC_ENABLE", "1", "0", "0", "accepted"],
        ["MC_ROLL_P", "7.0", "0.1", "0.1", "accepted"],
    ]
    assert written(tap)[-1] == "MC_ENABLE", "it may hide its group"
    assert values(vehicle, *CHANGED) == CHANGED
    assert vehicle.values["FIXED"] == 3
    assert command("restore", put(vehicle)).code == 0
    assert vehicle.values == before


@pytest.mark.parametrize("words", [["A"], ["--all"]])
def test_without_any_known_default_nothing_is_written(command: Command, put: Put, words: list[str]) -> None:
    tap = Tap(GenericVehicle(table={"A": 5.0, "B": 6.0}))
    done = command("reset", put(tap), *words)
    assert (done.code, written(tap)) == (1, [])
    assert "defaults are not known" in done.err


def test_metadata_gives_defaults_where_no_vehicle_does(command: Command, put: Put, tmp_path: Path) -> None:
    described = metadata_file(tmp_path, A={"default": 2.5}, C={"type": "Int32", "default": 7})
    vehicle = GenericVehicle(table={"A": 5.0, "B": 6.0, "C": 7})
    words = ["reset", put(vehicle), "--all", "--metadata", described]
    planned = command(*words, "--dry-run")
    assert (planned.code, "as their default is not known: B\n" in planned.err) == (1, True)
    assert [row[:3] for row in planned.rows[1:]] == [["A", "5.0", "2.5"]]
    done = command(*words, "--json")
    assert {name: each["status"] for name, each in done.json["params"].items()} == {"A": "accepted"}
    assert values(vehicle, *"ABC") == {"A": 2.5, "B": 6.0, "C": 7}


def test_metadata_of_the_vehicle_is_downloaded_where_it_gives_no_defaults(command: Command, put: Put) -> None:
    vehicle = PX4Vehicle(table={"MC_ROLL_P": 4.0}, metadata=True)
    vehicle.set_param("MC_ROLL_P", 6.5)
    said = "quadrotor: 1 of 1 default from the metadata of the firmware, which does not have the defaults of"
    done = command("reset", put(vehicle), "MC_ROLL_P")
    assert (done.code, vehicle.values["MC_ROLL_P"]) == (0, 4.0), done.err
    assert said in done.err


def test_what_apply_leaves_out_is_left_out_unless_it_is_named(command: Command, put: Put) -> None:
    rows = [
        SimParam("BARO1_GND_PRESS", ParamType.REAL32, 101325.0, default=0.0),
        SimParam("COMPASS_OFS_X", ParamType.REAL32, 5.0, default=0.0),
        SimParam("RTL_ALT", ParamType.INT32, 1500, default=1500),
    ]
    vehicle = copter(table=rows, read_only=["BARO1_GND_PRESS"])
    vehicle.set_param("RTL_ALT", 2000)
    tap = Tap(vehicle)
    done = command("reset", put(tap), "--all")
    assert (done.code, {*written(tap)}) == (0, {"RTL_ALT"}), done.err
    assert "--include" in done.err
    assert command("reset", put(vehicle), "--all", "--include", "calibration").code == 0
    assert vehicle.values["COMPASS_OFS_X"] == 0.0
    named = command("reset", put(vehicle), "baro1_gnd_press")
    assert (named.code, named.rows[1][-2]) == (1, "refused")
