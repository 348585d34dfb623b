"""--all of fetch, get, set and save: every vehicle on a link; and this computer's own ids."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from paramclient import read_file
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from tests.commands import Command, Put
from tests.shell import Tap

SHARED: dict[str, int | float] = {"GAIN": 4.0, "MODE": 2}


@pytest.fixture
def vehicles() -> tuple[PX4Vehicle, ArduPilotVehicle]:
    return (
        PX4Vehicle(system=1, table=SHARED | {"OF_PX4": 1.5}),
        ArduPilotVehicle(system=2, live=(), table=SHARED),
    )


def test_get_reads_from_every_vehicle(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle]
) -> None:
    url = put(Air(vehicles))
    read = command("get", url, "GAIN", "--vehicle", "all")
    assert (read.code, read.err) == (0, "")
    assert read.words[0] == ["vehicle", "name", "value", "type", "index"]
    assert [line[:3] for line in read.words[1:]] == [["1/1", "GAIN", "4.0"], ["2/1", "GAIN", "4.0"]]
    read = command("get", url, "OF_*", "--vehicle", "all", "--json")
    assert read.code == 2
    first, second = read.json["vehicles"]
    assert (first["system"], first["component"]) == (1, 1)
    assert first["params"]["OF_PX4"]["value"] == 1.5
    assert (second["system"], second["params"]) == (2, {})
    assert "OF_*" in second["errors"]
    assert "2/1 ardupilot: " in read.err
    assert read.json["errors"] == []


def test_fetch_prints_the_tables_of_every_vehicle(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle]
) -> None:
    url = put(Air(vehicles))
    fetched = command("fetch", url, "--vehicle", "all", "--json")
    assert fetched.code == 0
    tables = {each["system"]: each for each in fetched.json["vehicles"]}
    assert tables[1]["params"].keys() == vehicles[0].params.keys()
    assert tables[2]["params"].keys() == vehicles[1].params.keys()
    assert tables[2]["autopilot"] == "ardupilot"
    shown = command("fetch", url, "GAIN", "--vehicle", "all")
    assert [line[:3] for line in shown.words[1:]] == [["1/1", "GAIN", "4.0"], ["2/1", "GAIN", "4.0"]]
    assert "parameters of 2/1 ardupilot from" in shown.err
    assert len(re.findall(r" bytes received, [0-9,]+ sent on the whole link", shown.err)) == 2
    alone = command("fetch", put(PX4Vehicle(system=1, table=SHARED)), "GAIN")
    assert "on the whole link" not in alone.err


def test_one_vehicle_that_fails_stops_no_other(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle]
) -> None:
    class Mute(PX4Vehicle):
        """A vehicle that receives nothing."""

        def receive(self, data: bytes, now: float) -> None:
            """Lose what is sent to the vehicle."""

    mute = Mute(system=3, table=SHARED)
    read = command("get", put(Air([vehicles[0], mute])), "GAIN", "--vehicle", "all", "--timeout", "20")
    assert read.code == 3
    assert [line[:2] for line in read.words[1:]] == [["1/1", "GAIN"]]
    assert "3/1 px4: " in read.err


def test_set_writes_to_every_vehicle(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle]
) -> None:
    url = put(Air(vehicles))
    written = command("set", url, "GAIN", "6.5", "--vehicle", "all")
    assert written.code == 0
    assert [line[0] for line in written.words[1:]] == ["1/1", "2/1"]
    assert [each.values["GAIN"] for each in vehicles] == [6.5, 6.5]
    written = command("set", url, "GAIN", "7", "OF_PX4", "2", "--vehicle", "all", "--json")
    assert written.code == 2
    first, second = written.json["vehicles"]
    assert [each["vehicle"]["kind"] for each in (first, second)] == ["PX4 quadrotor", "ArduPilot quadrotor"]
    assert [each["status"] for each in first["results"]] == ["accepted", "accepted"]
    assert [each["status"] for each in second["results"]] == ["accepted", "refused"]
    assert vehicles[0].values["OF_PX4"] == 2.0


def test_save_writes_every_vehicle_into_one_file_or_into_one_each(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle], tmp_path: Path
) -> None:
    url = put(Air(vehicles))
    assert command("save", url, tmp_path / "fleet.json", "--vehicle", "all").code == 0
    assert [each.system for each in read_file(tmp_path / "fleet.json").sets] == [1, 2]
    saved = command("save", url, tmp_path / "quad-{system}.param", "--vehicle", "all", "--json")
    assert saved.code == 0
    assert [each["path"] for each in saved.json["files"]] == [
        str(tmp_path / f"quad-{system}.param") for system in (1, 2)
    ]
    assert "OF_PX4" in read_file(tmp_path / "quad-1.param").choose()
    assert "OF_PX4" not in read_file(tmp_path / "quad-2.param").choose()


def test_own_ids(command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle]) -> None:
    tap = Tap(vehicles[0])
    url = put(tap)
    assert command("get", url, "GAIN", "--source-system", "244").code == 0
    assert {(frame.system, frame.component) for _, frame, _ in tap.received} == {(244, 190)}


def test_a_diff_with_partial_leaves_out_the_rest_of_the_vehicle_on_either_side(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle], tmp_path: Path
) -> None:
    url, file = put(vehicles[0]), tmp_path / "few.param"
    file.write_text("GAIN,4\n")
    for sides in ([file, url], [url, file]):
        assert command("diff", *sides).code == 1
        assert command("diff", *sides, "--partial").code == 0
    file.write_text("GAIN,4\nGIAN,4\n")
    for sides in ([file, url], [url, file]):
        assert command("diff", *sides, "--partial").code == 1, "a name that the vehicle lacks is a difference"


# Values that are probably wrong


@pytest.mark.parametrize(("name", "value"), [("GAIN", "11"), ("MODE", "3.5")], ids=["range", "fraction"])
def test_a_doubtful_value_is_written_only_after_a_question(
    command: Command, put: Put, at_terminal: Callable[[str], None], tmp_path: Path, name: str, value: str
) -> None:
    vehicle = ArduPilotVehicle(table=SHARED)
    described = tmp_path / "parameters.json"
    described.write_text(
        '{"version": 1, "parameters": [{"name": "GAIN", "type": "Float", "min": 0, "max": 10}]}'
    )
    words = ("set", put(vehicle), name, value, "--metadata", described)
    before = dict(vehicle.values)
    refused = command(*words)
    assert (refused.code, vehicle.values) == (2, before)
    assert ("above the maximum of 10" if name == "GAIN" else "not a whole number") in refused.err
    assert "--force" in refused.err
    for answer, is_written in (("n", False), ("y", True)):
        at_terminal(answer)
        asked = command(*words)
        assert "Write these values to 1/1 ArduPilot quadrotor, firmware " in asked.err
        assert (asked.code == 0, vehicle.values != before) == (is_written, is_written)
    assert "[y/N]" not in command(*words, "--force").err


def test_a_read_names_the_other_vehicles_on_the_link(
    command: Command, put: Put, vehicles: tuple[PX4Vehicle, ArduPilotVehicle]
) -> None:
    """Without an option, the first vehicle received is read, which may be another one next time."""
    url = put(Air(vehicles))
    read = command("fetch", url)
    assert read.code == 0
    assert re.search(
        r"[12]/1 \w+ was used, the first vehicle heard\. Also on this link: [12]/1 \w+ quadrotor.*\. "
        r"--vehicle chooses one\n",
        read.err,
    )
    for choice in (["--vehicle", 1], ["--vehicle", "2/1"], ["--vehicle", "all"]):
        assert "Also on this link" not in command("fetch", url, *choice).err
