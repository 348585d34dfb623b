"""--vehicle: a vehicle of a link by address or hardware id, or all of them; and vehicles of the cache."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamType, read_file
from paramclient.sim import Air, ArduPilotVehicle, Camera, PX4Vehicle
from tests.cli.test_no_reply import Deaf
from tests.commands import Command, Put, metadata_file, strict
from tests.conversations.partial import Partial
from tests.shell import Eventful, Tap

TABLE: dict[str, Any] = {"A": 1.0, "B": 2}
UID = "0a" * 18


def px4(system: int = 1, **options: Any) -> PX4Vehicle:
    return PX4Vehicle(system=system, **{"table": TABLE} | options)


def copter(system: int = 4, **options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(system=system, live=(), **{"table": TABLE} | options)


# One vehicle


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
    assert "Heard on udpin:0.0.0.0:14550 so far: 4/1 ArduPilot quadrotor." in done.err


def test_two_vehicles_with_the_same_beginning_of_the_hardware_id(command: Command, put: Put) -> None:
    one, two = (copter(number, uid2=bytes.fromhex("0a" * 17 + end)) for number, end in ((4, "01"), (5, "02")))
    done = command("set", put(Air([one, two])), "A", 7, "--vehicle", "uid:0a0a0a")
    assert (done.code, done.out) == (2, "")
    assert "2 vehicles on this link have hardware ids that begin with 0a0a0a: 4/1 " in done.err
    assert (one.requests["PARAM_SET"], two.requests["PARAM_SET"]) == (0, 0)


def test_a_read_says_which_vehicle_it_shows(command: Command, put: Put) -> None:
    """Without an option, the first vehicle received is read, which may be another one next time.

    Also if the command ends before the other one is heard.
    """
    url = put(Air([px4(), copter()]))
    for words, choosing in ((("fetch", url), ""), (("show", url, "A"), "fetch ")):
        several = command(*words)
        assert several.rows[0][0] == "vehicle"
        assert re.search(
            r"[14]/1 \w+ quadrotor was used, the first vehicle heard\. Also on this link: [14]/1 \w+ "
            rf"quadrotor\. {choosing}--vehicle chooses one\n",
            several.err,
        )
    assert command("get", url, "A", "--json").json["system"] in (1, 4)
    named = command("fetch", url, "--vehicle", 1)
    assert (named.rows[0][0], "Also on this link" in named.err) == ("name", False)
    assert [row[0] for row in command("get", put(Tap(px4(3))), "A", "--no-cache").rows] == ["vehicle", "3/1"]


def test_own_system_id(command: Command, put: Put) -> None:
    tap = Tap(px4())
    assert command("get", put(tap), "A", "--source-system", "244").code == 0
    assert {(frame.system, frame.component) for _, frame, _ in tap.received} == {(244, 190)}


# All vehicles


def test_get_and_fetch_read_every_vehicle(command: Command, put: Put) -> None:
    url = put(Air([px4(table=TABLE | {"OF_PX4": 1.5}), copter()]))
    read = command("get", url, "A", "--vehicle", "all")
    assert (read.code, read.err) == (0, "")
    assert read.words[0] == ["vehicle", "name", "value", "type", "index"]
    assert [line[:3] for line in read.words[1:]] == [["1/1", "A", "1.0"], ["4/1", "A", "1.0"]]
    read = command("get", url, "OF_*", "--vehicle", "all", "--json")
    first, second = read.json["vehicles"]
    assert first["params"]["OF_PX4"]["value"] == 1.5
    assert (read.code, second["params"], [*second["errors"]]) == (2, {}, ["OF_*"])
    assert "4/1 ArduPilot quadrotor: " in read.err
    fetched = command("fetch", url, "A", "--vehicle", "all")
    assert [line[:3] for line in fetched.words[1:]] == [["1/1", "A", "1.0"], ["4/1", "A", "1.0"]]
    assert len(re.findall(r" bytes received, [0-9,]+ sent on the whole link", fetched.err)) == 2
    some = command("fetch", url, "A", "OF_PX4", "--vehicle", "all", "--json")
    assert [[*each["params"]] for each in some.json["vehicles"]] == [["A", "OF_PX4"], ["A"]]
    assert (some.code, [*some.json["vehicles"][1]["errors"]]) == (2, ["OF_PX4"])


def test_all_reads_other_components_that_have_parameters_and_names_those_without(
    command: Command, put: Put, tmp_path: Path
) -> None:
    cameras = [Camera(component=100), Camera(component=101, plain={"ZOOM": 2})]
    gimbal = Partial({"PAN": (3, ParamType.INT8)}, serves=("indices",), first=1, component=154)
    lister = Partial({"TILT": (3, ParamType.INT8)}, serves=("list",), component=155)
    url = put(Air.symmetric([px4(), *cameras, gimbal, lister], delay=0.1))
    fetched = command("fetch", url, "--vehicle", "all")
    assert fetched.code == 0, fetched.err
    found = [" ".join(line[:2]) for line in fetched.words[1:]]
    assert found == ["1/1 A", "1/1 B", "1/154 PAN", "1/155 TILT", "1/101 ZOOM"]
    command("save", url, path := tmp_path / "gimbal.params", "--vehicle", "1/155")
    assert "# 1 parameter of 1/155\n" in path.read_text(), "it is no px4"
    assert "1/100 camera has no parameters, or none in 2.5 s" in fetched.err
    assert command("set", url, "ZOOM", 3, "--vehicle", "all").code == 2
    assert not cameras[1].requests["PARAM_SET"]


def test_one_vehicle_that_fails_stops_no_other(command: Command, put: Put) -> None:
    url = put(Air([px4(), Deaf(system=3, table=TABLE)]))
    read = command("get", url, "A", "--vehicle", "all", "--timeout", "20")
    assert read.code == 3
    assert [line[:2] for line in read.words[1:]] == [["1/1", "A"]]
    assert "3/1 PX4 quadrotor: " in read.err
    watched = command("watch", url, "A", "--vehicle", "all", "--timeout", "20")
    assert (watched.code, "paramclient: 3/1 PX4 quadrotor: " in watched.err) == (3, True)


def test_a_value_without_a_meaning_on_one_vehicle_is_set_on_the_others(command: Command, put: Put) -> None:
    vehicles = PX4Vehicle(metadata=True), copter()
    done = command("set", put(Air(vehicles)), "COM_FLTMODE1=Return", "--vehicle", "all", "--json")
    assert (done.code, vehicles[0].values["COM_FLTMODE1"]) == (2, 5)
    assert [each["system"] for each in done.json["vehicles"]] == [1]
    assert "paramclient: 4/1 ArduPilot quadrotor: COM_FLTMODE1: 'Return' is not a number." in done.err


def test_set_and_reset_write_to_every_vehicle(command: Command, put: Put, tmp_path: Path) -> None:
    vehicles = px4(table=TABLE | {"OF_PX4": 1.5}), copter(ftp=False)
    url = put(Air(vehicles))
    written = command("set", url, "A", "7", "OF_PX4", "2", "--vehicle", "all", "--json")
    assert written.code == 2
    first, second = written.json["vehicles"]
    assert [each["vehicle"]["kind"] for each in (first, second)] == ["PX4 quadrotor", "ArduPilot quadrotor"]
    assert [each["status"] for each in first["results"]] == ["accepted", "accepted"]
    assert [each["status"] for each in second["results"]] == ["accepted", "refused"]
    described = metadata_file(tmp_path, A={"default": 2.5})
    done = command("reset", url, "A", "--metadata", described, "--vehicle", "all")
    assert [row[:5] for row in done.rows] == [
        ["vehicle", "name", "before", "wanted", "now"],
        *([address, "A", "7.0", "2.5", "2.5"] for address in ("1/1", "4/1")),
    ]
    assert [each.values["A"] for each in vehicles] == [2.5, 2.5]


def test_save_writes_vehicles_into_one_file_or_one_each(command: Command, put: Put, tmp_path: Path) -> None:
    url = put(Air([px4(), copter()]))
    assert command("save", url, tmp_path / "fleet.json", "--vehicle", "all").code == 0
    assert {row[0] for row in command("show", tmp_path / "fleet.json").rows} == {"vehicle", "1/1", "4/1"}
    saved = command("save", url, tmp_path / "quad-{system}.param", "--vehicle", "all", "--json")
    paths = [tmp_path / f"quad-{system}.param" for system in (1, 4)]
    assert [each["path"] for each in saved.json["files"]] == [*map(str, paths)]
    assert all("A" in read_file(path).choose() for path in paths)


def test_watch_prints_of_which_vehicle_a_change_is(command: Command, put: Put) -> None:
    def watch(*words: str) -> list[str]:
        url = put(Air([Eventful(each, (6.0, partial(each.set_param, "A", 3.0))) for each in (px4(), px4(2))]))
        watched = command("watch", url, "A", "--timeout", 20, *words)
        assert watched.code == 0, watched.err
        return watched.out.splitlines()

    assert sorted(line.partition("  ")[2] for line in watch("--vehicle", "all")) == [
        "1/1 PX4 quadrotor: A  1.0 -> 3.0  (vehicle)",
        "2/1 PX4 quadrotor: A  1.0 -> 3.0  (vehicle)",
    ]
    assert {strict(line)["system"] for line in watch("--vehicle", "all", "--json")} == {1, 2}
    assert re.fullmatch(r"[12]/1 PX4 quadrotor: A  1\.0 -> 3\.0  \(vehicle\)", watch()[-1].partition("  ")[2])


# Vehicles of the cache


def test_kinds_and_addresses_in_the_cache(command: Command, put: Put) -> None:
    for vehicle in (px4(), copter(), copter(5, uid2=bytes([7] * 18))):
        assert command("fetch", put(vehicle)).code == 0
    assert [row[0] for row in command("show").rows] == ["component", "5/1", "4/1", "1/1"]
    assert command("show", "px4", "--json").json["components"][0]["system"] == 1
    assert command("show", "4/1", "--json").json["components"][0]["system"] == 4
    several = command("show", "ardupilot")
    assert (several.code, several.err.count("\n  ")) == (2, 2)
    assert "fits 2 vehicles in the cache" in several.err
    assert re.search(r"Choose one by its key, as uid:[0-9a-f]+\.", several.err)
    missing = command("show", "4/9")
    assert missing.code == 2
    assert "no vehicle has system id 4 and a table of component 9" in missing.err


# Values that are probably wrong


@pytest.mark.parametrize(("name", "value"), [("A", "11"), ("B", "3.5")], ids=["range", "fraction"])
def test_a_doubtful_value_is_written_only_after_a_question(
    command: Command, put: Put, at_terminal: Callable[[str], None], tmp_path: Path, name: str, value: str
) -> None:
    vehicle = copter()
    words = ("set", put(vehicle), name, value, "--metadata", metadata_file(tmp_path, A={"min": 0, "max": 10}))
    before = dict(vehicle.values)
    refused = command(*words)
    assert (refused.code, vehicle.values) == (2, before)
    assert ("above the maximum of 10" if name == "A" else "not a whole number") in refused.err
    assert "--force" in refused.err
    for answer, is_written in (("n", False), ("y", True)):
        at_terminal(answer)
        asked = command(*words)
        assert "Write these values to 4/1 ArduPilot quadrotor, firmware " in asked.err
        assert (asked.code == 0, vehicle.values != before) == (is_written, is_written)
    assert "[y/N]" not in command(*words, "--force").err
