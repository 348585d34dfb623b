"""The subcommand reset: only known defaults are written, after a question, and each is verified."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamType
from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam, Vehicle
from paramclient.wire import frames, messages
from tests.commands import Command, Put
from tests.shell import Tap

URL = "sim:custom"
TABLE = [
    SimParam("MC_ENABLE", ParamType.INT8, 1, default=0),
    SimParam("MC_ROLL_P", ParamType.REAL32, 7.0, default=0.1),
    SimParam("MC_PITCH_P", ParamType.REAL32, 0.1, default=0.1),
    SimParam("COUNT", ParamType.INT16, 300, default=12),
    SimParam("FIXED", ParamType.INT8, 3, default=1),
]
RECEIVER = "1/1 ArduPilot quadrotor, firmware 4.6.0-dev"
CHANGED = {"MC_ENABLE": 0, "MC_ROLL_P": pytest.approx(0.1), "COUNT": 12}


def copter(**others: Any) -> ArduPilotVehicle:
    """An ArduPilot whose parameter file has defaults."""
    options: dict[str, Any] = {"table": TABLE, "live": (), "read_only": ["FIXED"], "param_error": True}
    return ArduPilotVehicle(**options | others)


def written(tap: Tap) -> list[str]:
    """The names of the values that were sent to the vehicles, in their order."""
    return [each.param_id for each in tap.messages(messages.ParamSet)]


def values(vehicle: Vehicle, *names: str) -> dict[str, Any]:
    return {name: vehicle.values[name] for name in names}


def test_named_parameters_are_set_to_the_defaults_of_the_vehicle(command: Command, put: Put) -> None:
    vehicle = copter()
    done = command("reset", put(vehicle), "COUNT", "mc_*")
    assert done.code == 0, done.err
    assert done.rows == [
        ["name", "before", "requested", "actual", "status"],
        ["COUNT", "300", "12", "12", "accepted"],
        ["MC_ROLL_P", "7.0", "0.1", "0.1", "accepted"],
        ["MC_ENABLE", "1", "0", "0", "accepted"],
    ]
    announced, line, others = done.err.splitlines()
    assert announced == f"writing to {RECEIVER} on sim:custom"
    assert line.startswith(f"3 of 3 set on {RECEIVER} in ")
    assert others == "1 with their default, 0 without a known default"
    assert values(vehicle, *CHANGED) == CHANGED
    assert vehicle.values["FIXED"] == 3


def test_a_parameter_without_a_known_default_is_listed_and_not_written(command: Command, put: Put) -> None:
    tap = Tap(GenericVehicle(table={"A": 5.0, "B": 6.0}))
    done = command("reset", put(tap), "A", "B")
    assert (done.code, written(tap)) == (1, [])
    assert done.err.endswith("paramclient: not written, as their default is not known: A, B\n")
    assert command("reset", put(tap), "--all", "--json").json == {
        "vehicle": {
            "system": 1,
            "component": 1,
            "autopilot": "generic",
            "kind": "generic",
            "firmware": None,
            "uid": "000000005eed0001",
        },
        "results": [],
        "unchanged": [],
        "without_default": ["A", "B"],
        "read_only": [],
    }
    only = command("reset", put(tap), "--changed")
    assert (only.code, only.out) == (0, ""), "only parameters that are known to differ"
    assert "0 of 0 set on 1/1 generic" in only.err


def test_defaults_of_metadata_are_used_where_the_vehicle_gives_none(
    command: Command, put: Put, tmp_path: Path
) -> None:
    described = tmp_path / "parameters.json"
    described.write_text(
        '{"version": 1, "parameters": [{"name": "A", "type": "Float", "default": 2.5}, '
        '{"name": "C", "type": "Int32", "default": 7}]}'
    )
    vehicle = GenericVehicle(table={"A": 5.0, "B": 6.0, "C": 7})
    words = ["reset", put(vehicle), "--all", "--metadata", described]
    planned = command(*words, "--dry-run")
    assert planned.code == 1, "the default of B is not known"
    assert planned.rows[1:] == [["A", "5.0", "2.5", "default of metadata"], ["B", "6.0", "no known default"]]
    done = command(*words, "--json")
    assert [each["name"] for each in done.json["results"]] == ["A"]
    assert (done.json["unchanged"], done.json["without_default"]) == (["C"], ["B"])
    assert values(vehicle, *"ABC") == {"A": 2.5, "B": 6.0, "C": 7}


def test_the_metadata_of_the_vehicle_is_downloaded_where_it_gives_no_defaults(
    command: Command, put: Put
) -> None:
    vehicle = PX4Vehicle(table={"MC_ROLL_P": 4.0}, metadata=True)
    vehicle.set_param("MC_ROLL_P", 6.5)
    said = "1/1 px4: 1 of 1 default from the metadata of the firmware, which does not have the defaults of an"
    planned = command("reset", put(vehicle), "MC_ROLL_P", "--dry-run")
    assert said in planned.err
    done = command("reset", put(vehicle), "MC_ROLL_P")
    assert (done.code, vehicle.values["MC_ROLL_P"]) == (0, 4.0), done.err
    assert said in done.err


def test_dry_run_sends_no_value(command: Command, put: Put) -> None:
    tap = Tap(copter())
    planned = command("reset", put(tap), "--changed", "--dry-run")
    assert (planned.code, written(tap)) == (0, [])
    assert planned.rows[1:] == [
        ["MC_ROLL_P", "7.0", "0.1", "default of vehicle"],
        ["COUNT", "300", "12", "default of vehicle"],
        ["FIXED", "3", "1", "default of vehicle"],
        ["MC_ENABLE", "1", "0", "default of vehicle"],
    ]
    assert planned.err == (
        f"{RECEIVER}: 4 to reset, 1 with their default, 0 without a known default; nothing was sent\n"
    )
    document = command("reset", put(tap), "COUNT", "MC_PITCH_P", "--dry-run", "--json").json
    vehicle = document.pop("vehicle")
    assert (vehicle["kind"], vehicle["firmware"]) == ("ArduPilot quadrotor", "4.6.0-dev")
    assert document == {
        "dry_run": True,
        "values": [{"name": "COUNT", "value": 300, "default": 12, "source": "vehicle"}],
        "unchanged": ["MC_PITCH_P"],
        "without_default": [],
        "read_only": [],
    }


@pytest.mark.parametrize("choice", ["--all", "--changed"])
def test_what_the_vehicle_lets_no_client_write_is_left_out_unless_it_is_named(
    command: Command, put: Put, choice: str
) -> None:
    rows = [
        SimParam("BARO1_GND_PRESS", ParamType.REAL32, 101325.0, default=0.0),
        SimParam("RTL_ALT", ParamType.INT32, 1500, default=1500),
    ]
    vehicle = copter(table=rows, read_only=["BARO1_GND_PRESS"])
    vehicle.set_param("RTL_ALT", 2000)
    tap = Tap(vehicle)
    done = command("reset", put(tap), choice)
    assert (done.code, written(tap)) == (0, ["RTL_ALT"]), done.err
    assert done.err.endswith("left out, as they can only be read: BARO1_GND_PRESS\n")
    assert command("reset", put(vehicle), choice, "--json").json["read_only"] == ["BARO1_GND_PRESS"]
    named = command("reset", put(vehicle), "BARO1_GND_PRESS")
    assert named.code == 1
    assert "1/1 refused BARO1_GND_PRESS" in named.err


@pytest.mark.parametrize("names", [["COUNT", "MC_ROLLP"], ["COUNT", "NOT_*"]])
def test_with_an_unknown_name_nothing_is_written(command: Command, put: Put, names: list[str]) -> None:
    tap = Tap(copter())
    done = command("reset", put(tap), *names)
    assert (done.code, done.out, written(tap)) == (2, "", [])
    expected = "no parameter that matches NOT_*" if "NOT_*" in names else "; did you mean MC_ROLL_P?"
    assert expected in done.err
    assert done.err.endswith("paramclient: nothing was written\n")


@pytest.mark.parametrize("words", [[], ["A", "--all"], ["--all", "--changed"]])
def test_names_all_and_changed_exclude_each_other(command: Command, put: Put, words: list[str]) -> None:
    done = command("reset", put(copter()), *words)
    assert (done.code, done.out) == (2, "")
    assert done.err == "paramclient: reset takes names, or --all, or --changed\n"


@pytest.mark.parametrize(("answer", "is_written"), [("y", True), ("n", False), ("", False)])
def test_the_user_of_a_terminal_confirms(
    command: Command, put: Put, at_terminal: Callable[[str], None], answer: str, is_written: bool
) -> None:
    tap = Tap(copter())
    at_terminal(answer)
    done = command("reset", put(tap), "COUNT")
    assert done.code == (0 if is_written else 1)
    assert "go on? [y/N]" in done.err
    assert ["COUNT", "300", "12", "default of vehicle"] in done.rows
    assert written(tap) == ["COUNT"] * is_written
    again = Tap(copter())
    for words in (["COUNT", "--yes"], ["COUNT", "--json"], ["MC_PITCH_P"]):
        done = command("reset", put(again), *words)
        assert (done.code, "go on?" in done.err) == (0, False)


def test_a_vehicle_that_falls_silent_has_an_outcome_for_each_value(command: Command, put: Put) -> None:
    class Ending(ArduPilotVehicle):
        """A vehicle that answers nothing after its first set."""

        def respond(self, message: messages.Message, sender: frames.Frame) -> None:
            if self.requests["PARAM_SET"] <= isinstance(message, messages.ParamSet):
                super().respond(message, sender)

    table = [SimParam(f"P_{number}", ParamType.INT16, 3, default=1) for number in range(6)]
    done = command("reset", put(Ending(table=table, live=())), "P_*", "--json")
    assert done.code == 3
    assert {each["status"] for each in done.json["results"]} <= {"accepted", "unknown", "not tried"}
    assert [each["name"] for each in done.json["results"]] == [each.name for each in table]
