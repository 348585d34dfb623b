"""The subcommands apply, verify and restore: output, writes and exit codes."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import pytest

from paramclient import Encoding, FileError, ParamType, read_file
from paramclient.provision import resolve
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle
from paramclient.wire import frames, messages
from tests.commands import Command, Put, metadata_file
from tests.conversations.partial import Partial

TABLE: dict[str, Any] = {
    "RTL_ALT": 1500,
    "WPNAV_SPEED": 500.0,
    "WPNAV_ACCEL": 100.0,
    "COMPASS_OFS_X": 5.0,
    "EK2_ENABLE": (ParamType.INT8, 0),
    "BARO1_GND_PRESS": 94500.0,
}
FILE = "RTL_ALT,2500\nWPNAV_SPEED,750.5\nWPNAV_ACCEL,100\nCOMPASS_OFS_X,12.5\n"
RECEIVER = "1/1 ArduPilot quadrotor, firmware 4.6.0-dev"
File: TypeAlias = Callable[..., Path]
"""Writes a parameter file; returns its path."""


@pytest.fixture
def file(tmp_path: Path) -> File:
    def write(text: str = FILE, name: str = "quad.param") -> Path:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return write


def copter(**options: Any) -> ArduPilotVehicle:
    groups = {"EK2_ENABLE": {"EK2_GPS_TYPE": (ParamType.INT8, 0)}}
    return ArduPilotVehicle(table=TABLE, groups=groups, live=(), **options)


def restarted(vehicle: ArduPilotVehicle) -> ArduPilotVehicle:
    """Return the vehicle with its values and a new clock: the simulated time of each command advances it."""
    new = copter(system=vehicle.system)
    for name, value in vehicle.values.items():
        new.set_param(name, value)
    return new


# apply


def test_apply_sets_and_verifies_values_that_differ(command: Command, put: Put, file: File) -> None:
    vehicle = copter()
    outcome = command("apply", put(vehicle), file())
    assert outcome.code == 0
    left_out = "left out: it was measured on one vehicle, and is right only there"
    assert outcome.rows == [
        ["name", "before", "wanted", "now", "status", "reason"],
        ["RTL_ALT", "1500", "2500", "2500", "accepted"],
        ["WPNAV_SPEED", "500.0", "750.5", "750.5", "accepted"],
        ["COMPASS_OFS_X", "5.0", "12.5", "5.0", "skipped", left_out],
    ]
    announced, line, *notes = outcome.err.splitlines()
    assert announced == f"writing to {RECEIVER} on udpin:0.0.0.0:14550"
    assert re.fullmatch(rf"{RECEIVER}: 2 accepted, 1 unchanged, 1 skipped in \d\.\d s", line)
    assert notes == [
        "1/1 ArduPilot quadrotor: ranges not checked: 2 of 2 have no metadata",
        "1/1 ArduPilot quadrotor: left out: 1 calibration; to write them: --include calibration",
    ]
    assert (vehicle.values["RTL_ALT"], vehicle.values["COMPASS_OFS_X"]) == (2500, 5.0)
    again = command("apply", put(vehicle), file())
    assert again.code == 0
    assert again.rows[1:] == [["COMPASS_OFS_X", "5.0", "12.5", "5.0", "skipped", left_out]]
    assert vehicle.requests["PARAM_SET"] == 2


IMPOSSIBLE = {
    "quad.param": "RTL_ALT,2500\nSIM_GPS1.BYTELOSS,0\n",
    "{system}.param": "RTL_ALT,2500\nWPNAV_SPEED,fast\n",
    "quad.params": "1\t1\tRTL_ALT\t2500\t6\n1\t1\tWPNAV_SPEED\t1e39\t9\n",
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_an_impossible_line_is_skipped_by_partial(command: Command, put: Put, file: File, name: str) -> None:
    vehicle, wrong = copter(), file(IMPOSSIBLE[name], name.format(system=1))
    for options, code, value in (((), 2, 1500), (("--partial",), 2, 2500)):
        outcome = command("apply", put(vehicle), wrong.with_name(name), *options)
        assert (outcome.code, vehicle.values["RTL_ALT"]) == (code, value)
        assert "line 2: " in outcome.err
    with pytest.raises(FileError, match=":2: expected "):  # a program writes all of a file, or nothing
        anyio.run(resolve, str(wrong))


def test_a_name_that_is_too_long_for_any_vehicle_is_skipped(command: Command, put: Put, file: File) -> None:
    outcome = command("apply", put(vehicle := copter()), file("RTL_ALT,2500\nSIM_GPS1_BYTELOSS,0\n"))
    assert (outcome.code, vehicle.values["RTL_ALT"], "line 2: " in outcome.err) == (0, 2500, True)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("EK2_ENABLE,300", "EK2_ENABLE: 300"),
        ("WPNAV_SPEDD,1", "WPNAV_SPEDD: not on this vehicle (did you mean WPNAV_SPEED"),
    ],
)
def test_invalid_values_and_mistyped_names_are_reported_before_anything_is_sent(
    command: Command, put: Put, file: File, line: str, fault: str
) -> None:
    vehicle = copter()
    wrong = file(f"RTL_ALT,2500\n{line}\n")
    outcome = command("apply", put(vehicle), wrong)
    assert (outcome.code, vehicle.requests["PARAM_SET"]) == (2, 0)
    said = [text in outcome.err for text in (fault, " (line 2)\n", "--partial skips these", "writing to")]
    assert said == [True, True, True, False]
    would = command("apply", put(vehicle), wrong, "--dry-run")
    assert (would.code, "nothing would be sent without --partial: " in would.err) == (2, True)
    listed = command("apply", put(vehicle), wrong, "--json")
    assert (listed.code, listed.json["params"]["RTL_ALT"]["status"]) == (2, "set")
    assert command("apply", put(vehicle), wrong, "--partial").code == 2
    assert vehicle.values["RTL_ALT"] == 2500


def test_armed_vehicles_are_refused(command: Command, put: Put, file: File) -> None:
    vehicle = copter(armed=True)
    outcome = command("apply", put(vehicle), file())
    assert (outcome.code, outcome.out, vehicle.requests["PARAM_SET"]) == (1, "", 0)
    assert ("armed" in outcome.err, "writing to" in outcome.err) == (True, False)
    would = command("apply", put(vehicle), file(), "--dry-run")
    assert (would.code, "1/1 ArduPilot quadrotor: armed; nothing would be set now" in would.err) == (1, True)
    assert command("apply", put(vehicle), file(), "--dry-run", "--allow-armed").code == 0
    assert command("apply", put(vehicle), file(), "--allow-armed").code == 0


def test_the_vehicle_reboots_only_with_the_option(command: Command, put: Put, file: File) -> None:
    wanted = file("EK2_ENABLE,1\nEK2_GPS_TYPE,3\n")
    outcome = command("apply", put(vehicle := copter()), wanted)
    assert (outcome.code, vehicle.values["EK2_GPS_TYPE"]) == (0, 3)
    assert "1/1 ArduPilot quadrotor: takes effect after a reboot: EK2_ENABLE\n" in outcome.err
    outcome = command("apply", put(copter()), wanted, "--reboot", "--json")
    assert (outcome.code, outcome.json["reboots"], outcome.json["reboot_required"]) == (0, 1, [])
    assert outcome.err == "", "the object has the summary"


# Dry runs and confirmation


@pytest.mark.parametrize(("answer", "sets"), [("y", 2), ("yes", 2), ("n", 0), ("", 0)])
def test_a_user_at_a_terminal_must_confirm(
    command: Command, put: Put, file: File, at_terminal: Callable[[str], None], answer: str, sets: int
) -> None:
    vehicle = copter()
    at_terminal(answer)
    outcome = command("apply", put(vehicle), file())
    assert outcome.code == (0 if sets else 1)
    assert "go on? [y/N]" in outcome.err
    assert ["RTL_ALT", "1500", "2500", "set", "all other parameters"] in outcome.rows
    assert vehicle.requests["PARAM_SET"] == sets
    _, _, after = outcome.err.partition("go on? [y/N]")
    assert outcome.err.count("writing to 1/1") == after.count("writing to 1/1") == (1 if sets else 0)
    assert "go on?" not in command("apply", put(copter()), file(), "--json").err
    assert "go on?" not in command("apply", put(vehicle), file(), "--yes").err
    assert "go on?" not in command("apply", put(vehicle), file()).err, "there is nothing to ask about"


def test_dry_run_prints_the_stages_in_order(command: Command, put: Put, file: File, tmp_path: Path) -> None:
    vehicle, backup = copter(), tmp_path / "before.json"
    wanted = file(FILE + "EK2_ENABLE,1\nEK2_NO_SUCH,1\n")
    outcome = command("apply", put(vehicle), wanted, "--dry-run", "--reboot", "--backup", backup)
    assert outcome.code == 0
    purpose = "switches that reveal parameters, takes effect after a reboot"
    assert outcome.rows[1] == ["EK2_ENABLE", "0", "1", "set", purpose]
    assert "1/1 ArduPilot quadrotor: takes effect after a reboot: EK2_ENABLE\n" in outcome.err
    assert [row[0] for row in outcome.rows[2:]] == ["RTL_ALT", "WPNAV_SPEED", "COMPASS_OFS_X", "EK2_NO_SUCH"]
    assert "; nothing was sent\n" in outcome.err
    assert (vehicle.requests["PARAM_SET"], backup.exists()) == (0, False)
    assert vehicle.requests["COMMAND_LONG"] <= 2, "its identity may be requested, and no more"

    reported = command("apply", put(vehicle), wanted, "--dry-run", "--json").json
    steps = [name for stage in reported["stages"] for name in stage["steps"]]
    planned = [(name, reported["params"][name]["wanted"]) for name in steps]
    assert planned == [("EK2_ENABLE", 1), ("RTL_ALT", 2500), ("WPNAV_SPEED", 750.5)]
    assert reported["reboot_for"] == ["EK2_ENABLE"]


# backups


def test_the_backup_file_has_the_state_before(command: Command, put: Put, file: File, tmp_path: Path) -> None:
    vehicle, backup = copter(), tmp_path / "{system}-{uid}.json"
    assert command("apply", put(vehicle), file(), "--backup", backup).code == 0
    [kept] = tmp_path.glob("1-*.json")
    assert re.fullmatch(r"1-[0-9a-f]{36}\.json", kept.name)
    assert read_file(kept).sets[0]["RTL_ALT"].value == 1500
    before = kept.read_bytes()
    outcome = command("apply", put(vehicle), file("RTL_ALT,99\n"), "--backup", backup)
    assert (outcome.code, "exists already" in outcome.err) == (2, True)
    assert (kept.read_bytes(), vehicle.values["RTL_ALT"]) == (before, 2500)
    outcome = command("apply", put(vehicle), file("RTL_ALT,99\n"), "--backup", tmp_path / "none" / "x.json")
    assert (outcome.code, "writing to" in outcome.err, vehicle.values["RTL_ALT"]) == (2, False, 2500)
    assert command("restore", put(vehicle), kept).code == 0
    assert vehicle.values == copter().values


def test_a_backup_names_what_the_table_lacks(command: Command, put: Put, file: File, tmp_path: Path) -> None:
    vehicle, backup = Partial({"A": (1, ParamType.INT32)}, count=lambda index: 2), tmp_path / "b.param"
    assert command("apply", put(vehicle), file("A,2\n"), "--backup", backup).code == 0
    assert "vehicle 1/1\n# incomplete: 1 of 2 parameters, without index 1\nA,1\n" in backup.read_text()


# restore


def test_a_backup_restores_the_calibration_of_the_very_same_vehicle(
    command: Command, put: Put, file: File, tmp_path: Path
) -> None:
    vehicle = copter()
    assert command("save", put(vehicle), tmp_path / "{uid}.param").code == 0
    [named] = tmp_path.glob("*.param")
    copied = file(text := named.read_text(), "copied.param")  # the header has the hardware id
    anonymous = file("".join(line for line in text.splitlines(keepends=True) if line[0] != "#"))
    rows = "".join(f"{system}\t1\tCOMPASS_OFS_X\t5\t9\n" for system in (1, 2))
    several = file(f"# {named.stem} and another vehicle\n{rows}", "several.params")
    two = file(f"# {named.stem}\n1\t1\tCOMPASS_OFS_X\t5\t9\n1\t154\tA\t1\t9\n", "two.params")  # components
    vehicle.set_param("COMPASS_OFS_X", 9.0)
    for foreign in (anonymous, several):
        left_out = command("restore", put(vehicle), foreign)
        assert (left_out.code, " of 1/? from" in left_out.err) == (0, False)
        said = "1/1 ArduPilot quadrotor: left out: 1 calibration; to write them: --include calibration\n"
        assert said in left_out.err
        assert vehicle.values["COMPASS_OFS_X"] == 9.0
    for words in ([named], [copied], [two], [anonymous, "--vehicle", f"uid:{named.stem}"]):
        vehicle.set_param("COMPASS_OFS_X", 9.0)
        assert "restore writes this vehicle's own calib" in command("apply", put(vehicle), *words).err
        assert command("restore", put(vehicle), *words).code == 0
        assert vehicle.values["COMPASS_OFS_X"] == 5.0


def test_restore_reverts_the_last_apply_and_names_the_changes(command: Command, put: Put, file: File) -> None:
    vehicle = copter()
    command("apply", put(vehicle), file(), "--include", "calibration")
    assert vehicle.values["COMPASS_OFS_X"] == 12.5
    for value in (150, 100):  # has its old value again
        assert command("set", put(vehicle), "WPNAV_ACCEL", value).code == 0
    would = command("restore", put(vehicle), "--dry-run")
    assert (would.code, vehicle.values["RTL_ALT"]) == (0, 2500)
    assert [row[:3] for row in would.rows[1:]] == [
        ["RTL_ALT", "2500", "1500"],
        ["WPNAV_SPEED", "750.5", "500.0"],
        ["COMPASS_OFS_X", "12.5", "5.0"],
    ]
    said, state, *_ = would.err.splitlines()
    assert re.fullmatch(
        r"the state is that before the last apply, \d+ s ago \(snapshot 1\); changed since then: "
        r"((COMPASS_OFS_X|WPNAV_SPEED|RTL_ALT)(, )?){3}",
        said,
    )
    assert state.startswith("the state: 6 parameters of 1/1 ardupilot from snapshot 1 of uid:")
    back = command("restore", put(restarted(vehicle)), "--json")
    assert back.json["complete"]
    assert said[:40] in back.err
    assert command("restore", put(vehicle)).code == 2
    numbered = command("restore", put(vehicle), 1)
    assert (numbered.code, "last apply" in numbered.err) == (0, False)
    assert vehicle.values == copter().values
    other = file("".join(f"X_{number},1\n" for number in range(50)), "other.param")
    assert command("restore", put(vehicle), other, "--dry-run").code == 2


def test_restore_does_not_undo_an_apply_twice(command: Command, put: Put, file: File) -> None:
    vehicle = copter()
    command("apply", put(vehicle), file("RTL_ALT,2500\n"))
    assert command("restore", put(vehicle)).code == 0
    command("set", put(vehicle), "WPNAV_SPEED", 600)
    sets = vehicle.requests["PARAM_SET"]
    again = command("restore", put(vehicle))
    assert (again.code, vehicle.requests["PARAM_SET"]) == (2, sets)
    assert "a restore ran " in again.err
    assert "snapshot 1 for the state before that apply" in again.err
    assert "snapshot 2 for the state before that restore" in again.err
    vehicle = restarted(vehicle)
    assert command("restore", put(vehicle), 2).code == 0
    assert (vehicle.values["RTL_ALT"], vehicle.values["WPNAV_SPEED"]) == (2500, 500.0)
    command("apply", put(vehicle), file("RTL_ALT,3000\n"))
    assert command("restore", put(vehicle)).code == 0, "an apply since then has a restore point"
    assert vehicle.values["RTL_ALT"] == 2500


@pytest.mark.parametrize(
    ("when", "text"),
    [
        ([], "name the time of the state to restore, such as '2h ago', or a backup file"),
        (["2h ago"], "nothing was sent, as no earlier state can be read: vehicle uid:"),
        (["4"], "nothing was sent, as no earlier state can be read: vehicle uid:"),
    ],
)
def test_restore_needs_a_stored_state(command: Command, put: Put, when: list[str], text: str) -> None:
    outcome = command("restore", put(copter()), *when)
    assert (outcome.code, text in outcome.err, "--no-cache" in outcome.err) == (5, True, False)
    assert command("restore", put(copter()), *when, "--no-cache").code == 2


# several vehicles


def fleet(**options: Any) -> tuple[Air, list[ArduPilotVehicle]]:
    vehicles = [copter(system=system) for system in (1, 2, 3)]
    return Air([*vehicles, GenericVehicle({"CAM_MODE": 1}, system=2, component=100)], **options), vehicles


def test_all_vehicles_are_set_and_restored_each_with_its_own_values(
    command: Command, put: Put, file: File, tmp_path: Path
) -> None:
    air, vehicles = fleet()
    file(f"{FILE}SYSID_THISMAV,7\n", "fleet.param")
    for system in (1, 2, 3):
        file(f"@include ../fleet.param\nWPNAV_SPEED,{system}00\n", f"own/{system}.param")
    own, backup = tmp_path / "own/{system}.param", tmp_path / "{system}.json"
    outcome = command("apply", put(air), own, "--vehicle", "all", "--backup", backup)
    assert outcome.code == 0
    assert [row[:5] for row in outcome.rows if row[1] == "WPNAV_SPEED"] == [
        [f"{system}/1", "WPNAV_SPEED", "500.0", f"{system}00.0", f"{system}00.0"] for system in (1, 2, 3)
    ]
    assert [vehicle.values["WPNAV_SPEED"] for vehicle in vehicles] == [100.0, 200.0, 300.0]
    assert [vehicle.values["RTL_ALT"] for vehicle in vehicles] == [2500, 2500, 2500]
    receivers = [f"{system}{RECEIVER[1:]}" for system in (1, 2, 3)]
    lines = outcome.err.splitlines()
    announced = [f"writing to {each} on udpin:0.0.0.0:14550" for each in receivers]
    assert [line for line in lines if line.startswith("writing")] == announced
    assert [line.split(":")[0] for line in lines if " accepted" in line] == receivers
    back = command("restore", put(air), "--vehicle", "all")
    assert (back.code, back.err.count("quadrotor: the state is that before the last apply, ")) == (0, 3)
    assert [vehicle.values for vehicle in vehicles] == [copter().values] * 3
    vehicles = [restarted(vehicle) for vehicle in vehicles]
    air = Air(vehicles)
    again = command("restore", put(air), "--vehicle", "all")
    assert (again.code, again.err.count("a restore ran ")) == (2, 3)
    vehicles[1].set_param("WPNAV_SPEED", 7)
    files = command("restore", put(air), backup, "--vehicle", "all", "--json")
    assert (files.code, [each["complete"] for each in files.json["vehicles"]]) == (0, [True] * 3)
    assert vehicles[1].values["WPNAV_SPEED"] == 500.0


def test_a_failed_vehicle_does_not_stop_the_others(command: Command, put: Put, file: File) -> None:
    air, vehicles = fleet()
    vehicles[1].armed = True
    outcome = command("apply", put(air), file(), "--vehicle", "all")
    assert (outcome.code, "2/1 ArduPilot quadrotor: " in outcome.err) == (1, True)
    assert [vehicle.values["RTL_ALT"] for vehicle in vehicles] == [2500, 1500, 2500]
    reported = command("apply", put(air), file(), "--vehicle", "all", "--json").json
    assert [each["system"] for each in reported["vehicles"]] == [1, 3]
    assert [each["system"] for each in reported["errors"]] == [2]


def test_one_file_for_all_vehicles_is_refused(command: Command, put: Put, file: File, tmp_path: Path) -> None:
    air, vehicles = fleet()
    every, one_id = ["--vehicle", "all"], file("SYSID_THISMAV,7\n", "id.param")
    file("RTL_ALT,3\n", "1.param")
    for words, why in (
        (["apply", file(), "--backup", "same.param"], "{uid} or {system}"),
        (["apply", tmp_path / "{system}.param"], "2.param: no such file"),
        (["apply", one_id, "--include", "identity"], "the system id 7; a file for each has {system}"),
        (["apply", file(), "--vehicle", 2], "vehicle"),
        (["restore", file()], "{uid} or {system} in its name"),
        (["restore", "--backup", "same.json"], "{uid} or {system}"),
        (["restore", "--no-cache"], "in the cache, which is not used"),
        (["restore", tmp_path / "none-{system}.param"], "no such file"),
    ):
        name, *more = words
        outcome = command(name, put(air), *more, *every)
        assert (outcome.code, why in outcome.err) == (2, True), outcome.err
    assert command("apply", put(air), file()).code == 2
    assert not any(vehicle.requests["PARAM_SET"] for vehicle in vehicles)


def test_a_file_of_several_systems_has_a_set_for_each(command: Command, put: Put, file: File) -> None:
    air, vehicles = fleet()
    text = "".join(f"{system}\t1\tRTL_ALT\t{system}000\t6\n" for system in (1, 2, 3))
    assert command("apply", put(air), file(text, "fleet.params"), "--vehicle", "all").code == 0
    assert [vehicle.values["RTL_ALT"] for vehicle in vehicles] == [1000, 2000, 3000]


# Interruptions


class Interrupting(GenericVehicle):
    """A vehicle at whose message of a kind, such as its twelfth PARAM_SET, the user presses Ctrl-C."""

    at: type[messages.Message] = messages.ParamSet
    left = 12

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        self.left -= (is_such := isinstance(message, self.at))
        if is_such and self.left == 0:
            signal.raise_signal(signal.SIGINT)
        else:
            super().respond(message, sender)


@pytest.mark.parametrize("as_json", [False, True])
@pytest.mark.parametrize("name", ["apply", "set"])
def test_ctrl_c_prints_what_is_done(command: Command, put: Put, file: File, name: str, as_json: bool) -> None:
    names = [f"P{number:02}" for number in range(40)]
    vehicle = Interrupting(dict.fromkeys(names, 1))
    wanted: list[object] = [file("".join(f"{each},2\n" for each in names))]
    if name == "set":
        wanted = [f"{each}=2" for each in names]
    outcome = command(name, put(vehicle), *wanted, *(["--json"] if as_json else []))
    assert outcome.code == 130
    assert re.search("^interrupted: ", outcome.err, re.MULTILINE)
    assert ("; run it again to continue" in outcome.err) == (name == "apply")
    assert any(value == 2 for value in vehicle.values.values())
    if not as_json:
        shown = {row[0]: row[4 if name == "apply" else -1] for row in outcome.rows[1:]}
    elif name == "apply":
        assert (outcome.json["complete"], outcome.json["error"]) == (False, "interrupted")
        shown = {each: row["status"] for each, row in outcome.json["params"].items()}
    else:
        shown = {row["name"]: row["status"] for row in outcome.json["results"]}
    assert {*shown.values()} == ({"unproven"} if name == "apply" else {"accepted", "unknown"})
    assert all(vehicle.values[each] == 2 for each, status in shown.items() if status != "unknown")
    assert command(name, put(vehicle), *wanted).code == 0
    assert set(vehicle.values.values()) == {2}


@pytest.mark.parametrize("at", [messages.ParamRequestList, messages.ParamSet])
@pytest.mark.parametrize("as_json", [False, True])
def test_ctrl_c_before_the_first_outcome_says_whether_something_was_sent(
    command: Command, put: Put, file: File, at: type[messages.Message], as_json: bool
) -> None:
    vehicle = Interrupting({"A": 1})
    vehicle.at, vehicle.left = at, 1
    outcome = command("apply", put(vehicle), file("A,2\n"), *(["--json"] if as_json else []))
    is_sent = at is messages.ParamSet
    end = "values without a proof may be in flight" if is_sent else "nothing was sent"
    assert (outcome.code, outcome.err.endswith(f"interrupted: {end}\n")) == (130, True), outcome.err
    assert ("nothing acknowledged; run it again to continue" in outcome.err) == (is_sent or as_json)
    assert ("writing to" in outcome.err) == (is_sent and not as_json)
    assert not as_json or (outcome.json["complete"], outcome.json["params"]) == (False, {})


def test_an_interrupted_apply_or_restore_is_continued(command: Command, put: Put, file: File) -> None:
    names = [f"P{number:02}" for number in range(40)]
    wanted = file("".join(f"{name},2\n" for name in names))
    url = put(Interrupting(dict.fromkeys(names, 1)))
    assert [command("apply", url, wanted).code for _ in range(2)] == [130, 0]
    vehicle = Interrupting(dict.fromkeys(names, 2))
    outcome = command("restore", put(vehicle))
    next_command = "to continue: paramclient restore udpin:0.0.0.0:14550 1 --vehicle 1/1\n"
    assert (outcome.code, next_command in outcome.err) == (130, True)
    assert set(vehicle.values.values()) == {1, 2}
    again = command("restore", put(vehicle))
    assert again.code == 2
    assert "snapshot 1 for the state before that apply, also to continue" in again.err
    back = command("restore", put(vehicle), 1, "--vehicle", "1/1")
    assert (back.code, set(vehicle.values.values())) == (0, {1})


# Metadata


def test_metadata_gives_ranges_and_reboots(command: Command, put: Put, file: File, tmp_path: Path) -> None:
    vehicle = copter()
    ranges = {"type": "Int32", "min": 30, "max": 2000}
    metadata = metadata_file(tmp_path, RTL_ALT=ranges, WPNAV_SPEED={"rebootRequired": True})
    outcome = command("apply", put(vehicle), file(), "--metadata", metadata)
    assert outcome.code == 2
    assert "RTL_ALT: 2500 is above the maximum of 2000" in outcome.err
    assert vehicle.requests["PARAM_SET"] == 0
    outcome = command("apply", put(vehicle), file(), "--metadata", metadata, "--include", "out-of-range")
    assert outcome.code == 0
    assert "takes effect after a reboot: WPNAV_SPEED" in outcome.err


def test_nothing_is_compared_or_set_in_doubtful_encodings(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = Partial(encoding=Encoding.C_CAST)
    url, saved = put(vehicle), tmp_path / "quad.param"
    refused = command("save", url, saved)
    assert (refused.code, "--encoding c-cast" in refused.err, saved.exists()) == (1, True, False)
    assert "The cache holds no vehicle" in command("show", "1").err
    assert "The encoding of 1/1 is probably wrong: " in command("check", url, "--json").out
    assert command("save", url, saved, "--incomplete").code == 0
    assert "(The encoding of 1/1 is probably wrong: " in saved.read_text()
    before = dict(vehicle.values)
    for words in (["apply", url, saved], ["apply", url, saved, "--dry-run"], ["restore", url, saved]):
        done = command(*words)
        assert (done.code, "--encoding c-cast" in done.err) == (2, True)
    assert command("set", url, "GAIN_1", "7.5").code == 0
    assert command("save", url, saved, "--encoding", "c-cast").code == 0
    restored = command("restore", url, saved, "--encoding", "c-cast")
    assert (restored.code, "8 unchanged" in restored.err) == (0, True)
    assert vehicle.values == before | {"GAIN_1": vehicle.values["GAIN_1"]}
