"""--vehicle: a vehicle of a link by address or hardware id, all of them, and vehicles of the cache."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest

from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from tests.commands import Command, Put, strict

URL = "sim:custom"
TABLE: dict[str, Any] = {"A": 1.0, "B": 2.0}
UID = "0a" * 18


def px4(system: int = 1, **options: Any) -> PX4Vehicle:
    return PX4Vehicle(system=system, **{"table": TABLE} | options)


def copter(system: int = 4, **options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(system=system, live=(), **{"table": TABLE} | options)


@pytest.mark.parametrize("name", ["4", "4/1", f"uid:{UID}", "UID:0A0A0A"])
def test_one_of_two_vehicles_is_written_to(command: Command, put: Put, name: str) -> None:
    one, two = px4(), copter(uid2=bytes.fromhex(UID))
    done = command("set", put(Air([one, two])), "A", 7, "--vehicle", name)
    assert done.code == 0, done.err
    assert (one.values["A"], two.values["A"]) == (1.0, 7.0)


def test_another_vehicle_under_the_system_id_is_not_written_to(command: Command, put: Put) -> None:
    other = copter(uid2=bytes.fromhex("0b" * 18))
    done = command("set", put(other), "A", 7, "--vehicle", f"uid:{UID}", "--timeout", 5)
    assert (done.code, done.out, other.requests["PARAM_SET"]) == (3, "", 0)
    assert f"a vehicle with hardware id {UID}" in done.err
    assert "Heard on sim:custom so far: 4/1 ArduPilot quadrotor." in done.err


def test_two_vehicles_with_the_same_beginning_of_the_hardware_id(command: Command, put: Put) -> None:
    one, two = (copter(number, uid2=bytes.fromhex("0a" * 17 + end)) for number, end in ((4, "01"), (5, "02")))
    done = command("set", put(Air([one, two])), "A", 7, "--vehicle", "uid:0a0a0a")
    assert (done.code, done.out) == (2, "")
    assert "2 vehicles on this link have hardware ids that begin with 0a0a0a: 4/1 " in done.err
    assert (one.requests["PARAM_SET"], two.requests["PARAM_SET"]) == (0, 0)


def test_a_component_of_a_vehicle(command: Command, put: Put) -> None:
    camera = GenericVehicle({"A": 5}, system=4, component=100)
    done = command("get", put(Air([px4(), copter(), camera])), "A", "--json", "--vehicle", "4/100")
    assert done.json["params"]["A"]["value"] == 5


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("4/300", "ids are 1 to 255, component ids 0 to 255"),
        ("0", "ids are 1 to 255, component ids 0 to 255"),
        ("tractor", "a vehicle is written as 4, as 4/1"),
        ("px4", "a vehicle is written as 4, as 4/1"),
        ("uid:0a0a", "a vehicle is written as 4, as 4/1"),
        ("", "a vehicle is written as 4, as 4/1"),
    ],
)
def test_names_that_name_nothing(command: Command, put: Put, name: str, reason: str) -> None:
    tried = command("get", put(copter()), "A", "--vehicle", name)
    assert (tried.code, tried.out) == (2, "")
    assert reason in tried.err


def test_subcommands_for_one_vehicle_refuse_all(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = px4()
    url = put(vehicle)
    assert command("check", url, "--vehicle", "all").code == 2
    assert not vehicle.requests


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


def test_reset_writes_to_every_vehicle(command: Command, put: Put, tmp_path: Path) -> None:
    described = tmp_path / "parameters.json"
    described.write_text('{"version": 1, "parameters": [{"name": "A", "type": "Float", "default": 2.5}]}')
    vehicles = (px4(), px4(4))
    words = ["reset", put(Air(vehicles)), "A", "--metadata", described, "--vehicle", "all"]
    done = command(*words)
    assert done.code == 0, done.err
    assert [row[:5] for row in done.rows] == [
        ["vehicle", "name", "before", "wanted", "now"],
        *([address, "A", "1.0", "2.5", "2.5"] for address in ("1/1", "4/1")),
    ]
    assert [each.values["A"] for each in vehicles] == [2.5, 2.5]
    again = command(*words, "--json").json
    assert [(each["system"], each["counts"]) for each in again["vehicles"]] == [
        (number, {"unchanged": 1}) for number in (1, 4)
    ]


def test_watch_prints_the_changes_of_every_vehicle(command: Command, put: Put) -> None:
    class Changing(PX4Vehicle):
        """A vehicle that changes a value on its own, 6 s after its first heartbeat."""

        changes_at: float | None = None

        def tick(self, now: float) -> None:
            super().tick(now)
            self.changes_at = self.changes_at or now + 6.0
            if now >= self.changes_at:
                self.changes_at = math.inf
                self.set_param("A", 3.0)

    url = put(Air([Changing(table=TABLE), Changing(system=2, table=TABLE)]))
    watched = command("watch", url, "A", "--vehicle", "all", "--timeout", 20)
    assert watched.code == 0, watched.err
    assert sorted(re.sub(r"^\S+  ", "", line) for line in watched.out.splitlines()) == [
        "1/1 px4: A  1.0 -> 3.0  (vehicle)",
        "2/1 px4: A  1.0 -> 3.0  (vehicle)",
    ]
    url = put(Air([Changing(table=TABLE), Changing(system=2, table=TABLE)]))
    lines = command("watch", url, "A", "--vehicle", "all", "--timeout", 20, "--json").out.splitlines()
    assert {(strict(line)["system"], strict(line)["name"]) for line in lines} == {(1, "A"), (2, "A")}


def test_a_read_says_which_vehicle_it_shows(command: Command, put: Put) -> None:
    url = put(Air([px4(), copter()]))
    several = command("fetch", url)
    assert several.words[0][:2] == ["vehicle", "name"]
    assert {row[0] for row in several.words[1:]} <= {"1/1", "4/1"}
    assert command("fetch", url, "--vehicle", 1).words[0][0] == "name"
