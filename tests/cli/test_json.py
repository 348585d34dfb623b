"""The JSON of every subcommand, compared with the outputs in `tests/data/json`.

`PARAMCLIENT_RECORD_JSON=1 pytest tests/cli/test_json.py` writes the files anew. Members that differ in each
run, such as times and numbers of bytes, are masked.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest

from paramclient.cli import link as link_command
from paramclient.links import SerialPort
from paramclient.model.values import ParamType
from paramclient.sim import Air, ArduPilotVehicle, Camera, Endpoint, GenericVehicle, PX4Vehicle, SimParam
from tests.commands import Command, Put, strict

DATA: Final = Path(__file__).parents[1] / "data"
RECORDS: Final = "PARAMCLIENT_RECORD_JSON" in os.environ
MASK: Final = "..."
MASKED: Final = frozenset(
    {
        *("time", "at", "synced_at", "updated_at", "heard_at", "since"),
        *("elapsed_s", "round_trip_s", "bytes_received", "bytes_sent", "seconds", "age_s", "heartbeat_age_s"),
        *("received_per_s", "sent_per_s", "bytes", "bytes_per_s", "frames_per_s", "frames", "per_s"),
        *("single_s", "min_s", "median_s", "max_s", "first_s", "longest_pause_s", "requests", "messages"),
        *("path", "versions", "fingerprint"),
    }
)
"""Members whose value differs in each run."""


def masked(item: Any) -> Any:
    """Return JSON with the values of `MASKED` members replaced, where they are not null."""
    if isinstance(item, dict):
        return {
            key: MASK if key in MASKED and value is not None else masked(value) for key, value in item.items()
        }
    return [masked(each) for each in item] if isinstance(item, list) else item


@dataclass(frozen=True)
class Case:
    """Commands that run one after the other with one cache; the outputs of those with --json are compared.

    `URL` stands for a link to the vehicle, `DATA` for the folder of test data, `CAMERA` and `DESCRIBED` for
    the options that choose extended parameters and metadata.
    """

    vehicle: Callable[[], Endpoint] | None
    commands: tuple[str, ...]


def copter(system: int = 1) -> ArduPilotVehicle:
    table = {"RTL_ALT": 1500, "WPNAV_SPEED": 500.0, "WPNAV_ACCEL": 100.0, "COMPASS_OFS_X": 5.0}
    return ArduPilotVehicle(table=table, live=(), system=system)


def quad(system: int = 1) -> PX4Vehicle:
    return PX4Vehicle(table={"MC_ROLL_P": 6.5, "MC_PITCH_P": 6.5, "SYS_AUTOSTART": 4001}, system=system)


def camera() -> Camera:
    return Camera({"CAM_MODE": 1, "CAM_NAME": "Front", "CAM_KEY": b"\xff\0\xfe", "CAM_EV": 0.5})


def odd() -> GenericVehicle:
    return GenericVehicle(
        [
            SimParam("NAN", ParamType.REAL32, float("nan")),
            SimParam("UP", ParamType.REAL32, float("inf")),
            SimParam("DOWN", ParamType.REAL32, float("-inf")),
            SimParam("TENTH", ParamType.REAL32, 0.1),
            SimParam("LONG", ParamType.UINT64, 0x1_0000_0002),
            SimParam("ODD", 77, b"\x01\x02\x03\x04"),
        ]
    )


def both() -> Air:
    return Air([quad(1), copter(2)])


FETCH: Final = "fetch URL"
FETCH_EXTENDED: Final = "fetch URL CAMERA"
CHANGE_EXTENDED: Final = ("save URL TMP/before.json CAMERA", "set URL CAM_NAME Rear CAMERA")
CASES: Final = {
    "fetch_px4": Case(quad, (FETCH + " --json", FETCH + " MC_* --json")),
    "fetch_ardupilot": Case(copter, (FETCH + " --json", FETCH + " --changed --json")),
    "fetch_odd_values": Case(odd, (FETCH + " --json",)),
    "fetch_all": Case(both, (FETCH + " --vehicle all --json",)),
    "fetch_extended": Case(camera, (FETCH_EXTENDED + " --json",)),
    "get": Case(quad, ("get URL MC_ROLL_P MC_P* --json", "get URL MC_ROLL_PP SYS_AUTOSTART --json")),
    "get_described": Case(copter, ("get URL RTL_ALT DESCRIBED --json",)),
    "get_all": Case(both, ("get URL RTL_ALT --vehicle all --json",)),
    "get_extended": Case(camera, ("get URL CAM_NAME CAM_KEY CAMERA --json",)),
    "set": Case(
        quad, ("set URL MC_ROLL_P 7 SYS_AUTOSTART 4002 --json", "set URL NO_SUCH 7 MC_ROLL_P 8 --json")
    ),
    "set_described": Case(copter, ("set URL RTL_ALT=100 DESCRIBED --json",)),
    "set_all": Case(both, ("set URL WPNAV_SPEED 400 --vehicle all --json",)),
    "set_extended": Case(camera, ("set URL CAM_NAME Rear CAM_KEY hex:00 NO_SUCH 1 CAMERA --json",)),
    "reset": Case(
        lambda: ArduPilotVehicle(live=()),
        (
            "reset URL RTL_ALT WPNAV_SPEED --dry-run --json",
            "set URL RTL_ALT 2000 --force",
            "reset URL RTL_ALT --json",
        ),
    ),
    "watch": Case(None, ("watch replay:DATA/px4_20_sets.tlog?speed=0 --no-cache --json",)),
    "show": Case(
        quad,
        (
            FETCH,
            "show --json",
            "show 1 MC_ROLL_P --json",
            "show DATA/json/quad.param --json",
            "show DATA/json/quad.params --json",
        ),
    ),
    "show_described": Case(copter, (FETCH, "show 1 RTL_ALT DESCRIBED --json", "show 1 --changed --json")),
    "show_extended": Case(camera, (FETCH_EXTENDED, "show 1 --extended --json")),
    "diff": Case(
        quad,
        (
            FETCH,
            "diff 1 DATA/json/quad.params --json",
            "diff DATA/json/quad.param DATA/json/quad.params --json",
            "diff DATA/json/quad.params DATA/json/quad.param --base 1 --json",
        ),
    ),
    "diff_defaults": Case(copter, (FETCH, "diff 1 DATA/json/quad.param --base defaults DESCRIBED --json")),
    "diff_extended": Case(camera, (*CHANGE_EXTENDED, "diff URL TMP/before.json CAMERA --json")),
    "search": Case(copter, (FETCH, "search rtl alt DESCRIBED --json", "search nothing_of_this --json")),
    "info": Case(copter, (FETCH, "set URL RTL_ALT 2000 --force", "info rtl_alt DESCRIBED --json")),
    "history": Case(
        quad,
        (
            FETCH,
            "set URL MC_ROLL_P 8",
            "history 1 --json",
            "history 1 --snapshots --json",
            "apply URL DATA/json/quad.params",
            "history 1 --snapshots --json",
        ),
    ),
    "history_extended": Case(
        camera, (FETCH_EXTENDED, "set URL CAM_NAME Rear CAMERA", "history 1 --extended --json")
    ),
    "save": Case(quad, ("save URL TMP/quad.params --json", "save 1 TMP/quad.param --only MC_* --json")),
    "save_all": Case(both, ("save URL TMP/{system}.params --vehicle all --json",)),
    "save_extended": Case(camera, ("save URL TMP/camera.json CAMERA --json",)),
    "apply": Case(
        copter,
        (
            "apply URL DATA/json/copter.param --partial --dry-run --json",
            "apply URL DATA/json/copter.param --partial --json",
        ),
    ),
    "apply_all": Case(both, ("apply URL DATA/json/copter.param --partial --vehicle all --json",)),
    "apply_extended": Case(
        camera,
        (
            *CHANGE_EXTENDED,
            "apply URL TMP/before.json CAMERA --dry-run --json",
            "apply URL TMP/before.json CAMERA --json",
        ),
    ),
    "restore": Case(
        copter,
        (
            FETCH,
            "apply URL DATA/json/copter.param --partial --json",
            "restore URL --dry-run --json",
            "restore URL --json",
        ),
    ),
    "restore_extended": Case(
        camera, (*CHANGE_EXTENDED, "apply URL TMP/before.json CAMERA --json", "restore URL CAMERA --json")
    ),
    "import": Case(None, ("import DATA/px4_full_download.tlog DATA/ardupilot_flight.bin --json",)),
    "cache": Case(quad, (FETCH, "cache list --json", "cache remove 1 --json")),
    "metadata": Case(
        None,
        (
            "metadata add DATA/apm.pdef.xml --vehicle copter --firmware 4.6 --json",
            "metadata list --json",
            "metadata remove copter --firmware 4.6 --json",
        ),
    ),
    "check": Case(quad, ("check URL --json",)),
    "check_ardupilot": Case(copter, ("check URL --json",)),
    "link": Case(both, ("link URL --seconds 3 --json",)),
    "ports": Case(None, ("ports --json",)),
}


def outputs(case: Case, command: Command, put: Put, folder: Path) -> list[Any]:
    """Run the commands of a case; return their names, exit codes and masked JSON lines."""
    url = "" if case.vehicle is None else put(case.vehicle())
    found: list[Any] = []
    places = {"URL": url, "CAMERA": "--vehicle 1/100 --extended", "DESCRIBED": "--metadata DATA/apm.pdef.xml"}
    places |= {"DATA": str(DATA), "TMP": str(folder)}
    for line in case.commands:
        for place, text in places.items():
            line = line.replace(place, text)
        words = line.split()
        done = command(*words)
        if "--json" not in words:
            assert done.code == 0, done.err
            continue
        text = done.out.replace(str(folder), "TMP").replace(str(DATA), "DATA")
        found.append({"code": done.code, "lines": [masked(strict(each)) for each in text.splitlines()]})
    return found


@pytest.mark.parametrize("name", CASES)
def test_json_is_as_recorded(
    name: str, command: Command, put: Put, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = ("3D Robotics", "PX4 FMU v5.x", "0")
    port = SerialPort("/dev/ttyACM0", "/dev/serial/by-id/usb-Pixhawk", 0x26AC, 0x11, *texts)
    monkeypatch.setattr(link_command, "list_ports", lambda: [port])
    found = outputs(CASES[name], command, put, tmp_path)
    path = DATA / "json" / f"{name}.json"
    if RECORDS:
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    assert found == json.loads(path.read_text(encoding="utf-8"))
    assert json.dumps(found) == json.dumps(json.loads(path.read_text(encoding="utf-8")))  # also the order
