"""--vehicle: a vehicle by address, kind or hardware id, on links and in the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from paramclient.sim import Air, ArduPilotVehicle, Endpoint, GenericVehicle, PX4Vehicle
from tests.commands import Command, Put, behind, in_process, leaping

TABLE: dict[str, Any] = {"A": 1.0, "B": 2.0}


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache.sqlite3"


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], cache: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in this process, on simulated time, with a new cache."""
    leaping(monkeypatch)
    return in_process(capsys, "--cache", str(cache))


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    """Connect every URL to a simulated vehicle."""
    return behind(monkeypatch, "sim:custom")


def px4(system: int = 1, **options: Any) -> PX4Vehicle:
    return PX4Vehicle(system=system, **{"table": TABLE} | options)


def copter(system: int = 4, **options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(system=system, live=(), **{"table": TABLE} | options)


@pytest.mark.parametrize("name", ["4", "4/1", "ardupilot", "ArduPilot"])
def test_one_of_two_vehicles_is_written_to(command: Command, put: Put, name: str) -> None:
    one, two = px4(), copter()
    far_end: Endpoint = Air([one, two])
    url = put(far_end)
    done = command("set", url, "A", 7, "--vehicle", name)
    assert done.code == 0, done.err
    assert (one.values["A"], two.values["A"]) == (1.0, 7.0)


def test_a_component_of_a_vehicle(command: Command, put: Put) -> None:
    camera = GenericVehicle({"A": 5}, system=4, component=100)
    url = put(Air([px4(), copter(), camera]))
    for words in (["4/100"], ["4", "--component", "100"]):
        done = command("get", url, "A", "--plain", "--json", "--vehicle", *words)
        assert done.json["params"]["A"]["value"] == 5


@pytest.mark.parametrize("words", [["get"], ["set"]])
def test_a_kind_of_several_vehicles_lists_them(command: Command, put: Put, words: list[str]) -> None:
    one, two = px4(), px4(2)
    done = command(
        words[0], put(Air([one, two, copter()])), "A", *["9"] * (words == ["set"]), "--vehicle", "px4"
    )
    assert (done.code, done.out) == (2, "")
    assert done.err == (
        "paramclient: 2 vehicles on this link are px4: 1/1 px4, 2/1 px4. Choose one with --system.\n"
    )
    assert (one.requests["PARAM_SET"], two.requests["PARAM_SET"]) == (0, 0)


def test_a_kind_that_is_not_there(command: Command, put: Put) -> None:
    done = command("get", put(copter()), "A", "--vehicle", "px4", "--timeout", 3)
    assert (done.code, done.out) == (3, "")
    assert "a vehicle with autopilot px4" in done.err
    assert "Heard on sim:custom so far: 4/1 ArduPilot quadrotor." in done.err


def test_kinds_and_addresses_in_the_cache(command: Command, put: Put) -> None:
    for vehicle in (px4(), copter(), copter(5, uid2=bytes([7] * 18))):
        assert command("fetch", put(vehicle)).code == 0
    assert command("show", "px4", "--json").json["components"][0]["system"] == 1
    assert command("show", "4/1", "--json").json["components"][0]["system"] == 4
    several = command("show", "ardupilot")
    assert (several.code, several.err.count("\n  ")) == (2, 2)
    assert "fits 2 vehicles in the cache" in several.err
    missing = command("show", "4/9")
    assert missing.code == 2
    assert "no vehicle has system id 4 and a table of component 9" in missing.err
    both = command("show", "4/1", "--component", "2")
    assert (both.code, both.out) == (2, "")
    assert "4/1 names component 1, and --component names 2" in both.err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--vehicle", "4", "--system", "4"], "--vehicle and --system exclude each other"),
        (["--vehicle", "4/1", "--component", "2"], "--vehicle 4/1 and --component 2 exclude each other"),
        (["--vehicle", "px4", "--component", "1"], "--vehicle px4 and --component 1 exclude each other"),
        (["--vehicle", "4/300"], "system and component ids are 1 to 255"),
        (["--vehicle", "0"], "system and component ids are 1 to 255"),
        (["--vehicle", "tractor"], "vehicle tractor is not in the cache"),
        (["--vehicle", "tractor", "--no-cache"], "hardware ids are looked up in the cache"),
    ],
)
def test_names_that_name_nothing(command: Command, put: Put, words: list[str], reason: str) -> None:
    tried = command("get", put(copter()), "A", *words)
    assert (tried.code, tried.out) == (2, "")
    assert reason in tried.err


def test_history_needs_a_vehicle(command: Command) -> None:
    failed = command("history")
    assert (failed.code, failed.out) == (2, "")
    assert "VEHICLE is missing: a vehicle in the cache" in failed.err
