"""Names in arguments: patterns, upper and lower case, and suggestions for unknown names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam, Vehicle
from tests.commands import Command, Put

URL = "sim:px4"
TABLE: dict[str, Any] = {
    "MC_ROLL_P": 4.0,
    "MC_PITCH_P": 4.5,
    "MC_YAW_P": 2.5,
    "SYS_AUTOSTART": 4001,
}
GROUP = {"GRP_ONE": 1.0, "GRP_TWO": 2.0}


def px4(**options: Any) -> PX4Vehicle:
    return PX4Vehicle(table=TABLE, **options)


def copter() -> ArduPilotVehicle:
    """An ArduPilot that shows two parameters after GRP_ENABLE."""
    table = [SimParam("GRP_ENABLE", 2, 0), *(SimParam(name, 9, value) for name, value in TABLE.items())]
    return ArduPilotVehicle(table=table, groups={"GRP_ENABLE": GROUP}, live=(), ftp=False)


# get


@pytest.mark.parametrize(
    "vehicle", [px4(), copter(), GenericVehicle(TABLE)], ids=["px4", "copter", "generic"]
)
def test_get_takes_patterns_and_any_case(command: Command, put: Put, vehicle: Vehicle) -> None:
    got = command("get", put(vehicle), "mc_*", "sys_autostart", "--json")
    assert got.code == 0, got.err
    assert {name: each["value"] for name, each in got.json["params"].items()} == TABLE
    [row] = command("get", put(vehicle), "Mc_Roll_p").rows[1:]
    assert row[:2] == ["MC_ROLL_P", "4.0"]


@pytest.mark.parametrize("param_error", [False, True])
def test_get_and_set_suggest_names_of_the_vehicle(command: Command, put: Put, param_error: bool) -> None:
    vehicle = px4(param_error=param_error)
    assert command("fetch", put(vehicle)).code == 0
    for words in (["get", put(vehicle), "MC_ROLLP"], ["set", put(vehicle), "MC_ROLLP", "5"]):
        outcome = command(*words)
        assert outcome.code == 2
        assert outcome.err.rstrip().endswith("has no MC_ROLLP; did you mean MC_ROLL_P?")


def test_a_name_that_fits_two_parameters_in_other_cases_is_not_written(command: Command, put: Put) -> None:
    vehicle = GenericVehicle({"Gain": 1.0, "gain": 2.0}, param_error=True)
    assert command("fetch", put(vehicle)).code == 0
    assert command("set", put(vehicle), "GAIN", "5").code == 2
    assert vehicle.values == {"Gain": 1.0, "gain": 2.0}
    assert command("set", put(vehicle), "gain", "5").code == 0
    assert vehicle.values == {"Gain": 1.0, "gain": 5.0}


# fetch, save


def test_fetch_prints_only_what_is_chosen(command: Command, put: Put) -> None:
    fetched = command("fetch", put(px4()), "mc_*", "SYS_AUTOSTART", "--json")
    assert fetched.code == 0
    assert (fetched.json["received"], set(fetched.json["params"])) == (4, set(TABLE))
    some = command("fetch", put(px4()), "mc_[ry]*")
    assert [row[0] for row in some.rows[1:]] == ["MC_ROLL_P", "MC_YAW_P"]
    wrong = command("fetch", put(px4()), "MC_ROLLP")
    assert (wrong.code, wrong.out) == (2, "")
    assert "called MC_ROLLP (did you mean MC_ROLL_P?)" in wrong.err


def test_save_writes_only_what_is_chosen(command: Command, put: Put, tmp_path: Path) -> None:
    path = tmp_path / "some.param"
    saved = command("save", put(px4()), path, "--only", "mc_*")
    assert saved.code == 0, saved.err
    assert saved.err.startswith("3 parameters of 1/1 written to ")
    assert {line.split(",")[0] for line in path.read_text().splitlines() if line[0] != "#"} == {
        "MC_ROLL_P",
        "MC_PITCH_P",
        "MC_YAW_P",
    }
    before = path.read_bytes()
    wrong = command("save", 1, path, "--only", "MC_ROLLP")
    assert (wrong.code, path.read_bytes()) == (2, before)
    assert "MC_ROLLP (did you mean MC_ROLL_P?)" in wrong.err


# show, history


def test_show_takes_patterns_and_suggests_names(command: Command, put: Put) -> None:
    assert command("fetch", put(px4())).code == 0
    [shown] = command("show", 1, "mc_*", "Sys_Autostart", "--json").json["components"]
    assert set(shown["params"]) == set(TABLE)
    wrong = command("show", 1, "MC_ROLLP", "FOO*")
    assert (wrong.code, wrong.out) == (2, "")
    assert wrong.err == ("paramclient: no parameter is called MC_ROLLP (did you mean MC_ROLL_P?) or FOO*\n")


def test_history_takes_patterns_and_an_unknown_name_is_an_error(command: Command, put: Put) -> None:
    vehicle = px4()
    assert command("fetch", put(vehicle)).code == 0
    pairs = ["MC_ROLL_P", 5, "MC_PITCH_P", 6, "SYS_AUTOSTART", 7]
    assert command("set", put(vehicle), *pairs).code == 0
    lines = command("history", 1, "mc_*", "--json").json["history"]
    assert {(each["name"], each["new"]) for each in lines} == {("MC_ROLL_P", 5.0), ("MC_PITCH_P", 6.0)}
    assert command("history", 1, "MC_YAW_P", "--json").json["history"] == [], "it is known and never changed"
    wrong = command("history", 1, "MC_ROLLP")
    assert (wrong.code, wrong.out) == (2, "")
    assert "is called MC_ROLLP (did you mean MC_ROLL_P?)" in wrong.err
    assert command("history", 1, "FOO*").code == 2


# watch


def lines(out: str) -> list[str]:
    """The lines of a watch without their times."""
    return [line.partition("  ")[2] for line in out.splitlines()]


class Growing(ArduPilotVehicle):
    """An ArduPilot on which another program switches a group on, 5 s after the first request."""

    began: float | None = None

    def tick(self, now: float) -> None:
        super().tick(now)
        if self.began is None and self.requests.total():
            self.began = now
        if self.began is not None and now > self.began + 5.0 and not self.param("GRP_ENABLE").value:
            self.set_param("GRP_ENABLE", 1)
            self.set_param("MC_ROLL_P", 9.0)


@pytest.mark.parametrize(
    ("names", "first", "printed"),
    [
        (["grp_*"], "watching grp_*", ["GRP_ENABLE", "GRP_ONE", "GRP_TWO"]),
        (["GRP_ENABLE"], "watching GRP_ENABLE", ["GRP_ENABLE"]),
    ],
)
def test_watch_follows_groups_that_appear(
    command: Command, put: Put, names: list[str], first: str, printed: list[str]
) -> None:
    watched = command("watch", put(growing()), *names, "--timeout", 30)
    assert watched.code == 0, watched.err
    assert watched.err.startswith(first)
    changes = {
        "GRP_ENABLE": "GRP_ENABLE  0 -> 1  (vehicle)",
        "GRP_ONE": "GRP_ONE  added: 1.0  (vehicle)",
        "GRP_TWO": "GRP_TWO  added: 2.0  (vehicle)",
    }
    found = [line for line in lines(watched.out) if not line.startswith("1/1 resynced")]
    assert sorted(found) == [changes[name] for name in printed]


def growing() -> Growing:
    table = [SimParam("GRP_ENABLE", 2, 0), SimParam("MC_ROLL_P", 9, 4.0)]
    return Growing(table=table, groups={"GRP_ENABLE": GROUP}, live=(), ftp=False)
