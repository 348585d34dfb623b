"""--renames of the subcommands apply, verify and diff, and the line about firmware versions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamType
from paramclient.model.values import WireValue
from paramclient.sim import ArduPilotVehicle
from tests.commands import Command, Put

TABLE: dict[str, WireValue | tuple[ParamType, WireValue]] = {
    "WP_SPD": 10.0,
    "RTL_ALT_M": (ParamType.INT16, 15),
    "OTHER": 1.0,
}
RULES = """\
[
{"old": "WPNAV_SPEED", "new": "WP_SPD", "factor": 0.01},
{"old": "RTL_ALT", "new": "RTL_ALT_M", "factor": 0.01},
{"old": "GONE", "new": "GONE_TOO"}
]
"""
FILE = "WPNAV_SPEED,750\nRTL_ALT,1500\n"
NOT_HERE = "renamed to GONE_TOO in names.json, which this vehicle does not have either"


@pytest.fixture
def command(command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in a folder with `names.json`."""
    monkeypatch.chdir(tmp_path)
    Path("names.json").write_text(RULES)
    return command


def copter(**options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(table=TABLE, live=(), **options)


def file(text: str = FILE, name: str = "quad.param") -> str:
    Path(name).write_text(text)
    return name


def test_apply_writes_under_the_name_of_the_vehicle(command: Command, put: Put) -> None:
    vehicle = copter()
    outcome = command("apply", put(vehicle), file(), "--renames", "names.json", "--full")
    assert outcome.code == 0
    assert outcome.rows[1:] == [
        ["WPNAV_SPEED", "10.0", "7.5", "7.5", "accepted", "WP_SPD on this vehicle"],
        ["RTL_ALT", "15", "15", "15", "unchanged", "RTL_ALT_M on this vehicle"],
    ]
    assert vehicle.values["WP_SPD"] == 7.5


def test_a_dry_run_shows_the_steps_under_both_names(command: Command, put: Put) -> None:
    vehicle = copter()
    outcome = command("apply", put(vehicle), file(), "--renames", "names.json", "--dry-run")
    reason = "WP_SPD on this vehicle; all other parameters"
    assert outcome.rows[1:] == [["1", "WPNAV_SPEED", "10.0", "7.5", "set", reason]]
    reported = command("apply", put(vehicle), file(), "--renames", "names.json", "--dry-run", "--json").json
    assert [step["name"] for step in reported["stages"][0]["steps"]] == ["WP_SPD"]
    assert reported["params"]["WPNAV_SPEED"]["vehicle_name"] == "WP_SPD"
    assert "firmware" not in reported
    assert vehicle.requests["PARAM_SET"] == 0


def test_a_missing_parameter_names_its_other_name(command: Command, put: Put) -> None:
    vehicle, wanted = copter(), file("GONE,1\n")
    outcome = command("apply", put(vehicle), wanted, "--renames", "names.json", "--partial")
    assert outcome.code == 1
    assert outcome.rows[1:] == [["GONE", "1", "skipped", f"not on this vehicle; {NOT_HERE}"]]


@pytest.mark.parametrize("subcommand", ["apply", "diff"])
def test_a_bad_file_of_names_is_an_error_with_its_line(command: Command, put: Put, subcommand: str) -> None:
    bad = file('[{"old": "A", "new": "B"},\n{"old": "C", "new": "D", "factor": 0}]\n', "bad.json")
    outcome = command(subcommand, put(copter()), file(), "--renames", bad)
    assert outcome.code == 2
    assert "bad.json:2: the factor of C is 0" in outcome.err


def test_diff_compares_parameters_under_their_other_names(command: Command) -> None:
    old = file("WPNAV_SPEED,750\nRTL_ALT,1500\nOTHER,1\n", "old.param")
    new = file("WP_SPD,7.0\nRTL_ALT_M,15\nOTHER,1\nMORE,2\n", "new.param")
    outcome = command("diff", old, new, "--renames", "names.json", "--all")
    assert outcome.code == 1
    assert outcome.rows[1:] == [
        ["MORE", "2", "only right"],
        ["OTHER", "1", "1", "same"],
        ["RTL_ALT", "1500", "15", "same, RTL_ALT_M on the right, where left is 15"],
        ["WPNAV_SPEED", "750", "7.0", "different, WP_SPD on the right, where left is 7.5"],
    ]
    outcome = command("diff", new, old, "--renames", "names.json", "--all", "--partial")
    assert outcome.rows[1:] == [
        ["MORE", "2", "only left"],
        ["OTHER", "1", "1", "same"],
        ["RTL_ALT_M", "15", "1500", "same, RTL_ALT on the right, where left is 1500"],
        ["WP_SPD", "7.0", "750", "different, WPNAV_SPEED on the right, where left is 700"],
    ]
    outcome = command("diff", old, new, "--renames", "names.json", "--partial", "--only", "RTL_ALT_M")
    assert outcome.code == 0
