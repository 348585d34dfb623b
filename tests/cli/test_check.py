"""check: what a vehicle serves, how fast, and what is slow or unusual."""

from __future__ import annotations

from typing import Any

from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from tests.commands import Command, Put


def texts(document: dict[str, Any]) -> str:
    return " ".join(each["text"] for each in document["findings"])


def test_a_vehicle_on_a_good_link_has_no_findings(command: Command, put: Put) -> None:
    for vehicle in (PX4Vehicle(), ArduPilotVehicle()):
        done = command("check", put(vehicle), "--json")
        assert (done.code, done.json["findings"]) == (0, [])
        assert done.json["list"]["received"] == done.json["list"]["count"]
        assert 0 <= done.json["link"]["round_trip"]["median_s"] < 0.1
        assert not vehicle.requests["PARAM_SET"]
    assert (done.json["files"]["parameters"], done.json["files"]["defaults"]) == (1382, True)


def test_the_cost_of_proving_a_cached_table_is_measured(command: Command, put: Put) -> None:
    others = [GenericVehicle({"A": 1}, system=number) for number in range(2, 20)]  # with heartbeats
    for vehicle, limit in ((PX4Vehicle(), 100), (ArduPilotVehicle(), 150)):
        air = Air.symmetric([vehicle, *others], delay=0.65)
        found = command("check", put(air), "--vehicle", "1", "--json").json["hash"]
        assert (len(found["before"]), found["error"]) == (8, None)
        assert 1.3 <= found["elapsed_s"] < 1.4
        assert 50 < found["bytes"] < limit
    rows = [row for row in command("check", put(ArduPilotVehicle(ftp=False))).rows if len(row) == 2]
    assert dict(rows)["checksum"].startswith("none: ")
    assert any(text.startswith("Without a checksum, sessions download. ") for _, text in rows)


def test_the_output_is_a_table(command: Command, put: Put) -> None:
    done = command("check", put(Air([PX4Vehicle(), ArduPilotVehicle(system=2)])), "--vehicle", "1")
    rows = dict(row for row in done.rows if len(row) == 2)
    assert rows["vehicle"] == "1/1 PX4 quadrotor, disarmed"
    assert rows["list"].startswith("903 of 903 in ")
    assert rows["other autopilots"] == "2/1"
    assert done.out.endswith("Nothing slow or unusual.\n")


def test_a_lossy_link_is_a_finding(command: Command, put: Put) -> None:
    air = Air.symmetric([ArduPilotVehicle(ftp=False)], loss=0.2, delay=0.3, seed=1)
    found = command("check", put(air), "--json").json
    assert found["link"]["loss"] > 0.1
    assert "of the vehicle's frames were lost" in texts(found)
    assert "The packed parameter file cannot be read" in texts(found)


def test_missing_parameters_are_a_problem(command: Command, put: Put) -> None:
    done = command("check", put(GenericVehicle({"A": 1, "B": 2, "C": 3}, dead=["B"])), "--json")
    assert (done.code, done.json["list"]["missing"]) == (1, 1)
    assert "1 of 3 parameters stayed missing" in texts(done.json)


def test_without_time_a_list_is_cut_short(command: Command, put: Put) -> None:
    done = command("check", put(PX4Vehicle(burst=1, period=0.05)), "--json", "--timeout", 15)
    assert (done.code, "time limit" in done.json["list"]["error"]) == (1, True)
    assert "The list is received at 20 values per second" in texts(done.json)
    at_once = command("check", put(PX4Vehicle()), "--json", "--timeout", 2.3)
    assert (at_once.code, "the time limit ended it" in texts(at_once.json)) == (1, True)


def test_only_a_link_to_a_vehicle_can_be_measured(command: Command, put: Put) -> None:
    log = command("check", "replay:tests/data/px4_get_set.tlog")
    assert (log.code, "is a log: check needs a link to a vehicle" in log.err) == (2, True)
    assert command("check", put(PX4Vehicle()), "--vehicle", "9", "--timeout", 3).code == 3
