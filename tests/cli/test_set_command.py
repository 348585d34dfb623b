"""The subcommand set with many pairs: one outcome for each, also when the vehicle or the user ends it."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest

from paramclient import ParamType
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from tests.commands import Command, Put

URL = "sim:custom"
NAMES = [f"P_{number:02}" for number in range(60)]
PAIRS = [word for name in NAMES for word in (name, "7")]
TABLE: dict[str, Any] = dict.fromkeys(NAMES, 1)


@pytest.fixture
def command(command: Command) -> Command:
    """Run the command line without a cache."""
    return lambda *words: command(*words, "--no-cache")


@pytest.mark.parametrize("kind", [PX4Vehicle, ArduPilotVehicle])
def test_many_pairs_are_in_flight_at_a_time(command: Command, put: Put, kind: Any) -> None:
    """One after the other, 60 writes would take 12 s on this link."""
    vehicle = kind(table=TABLE)
    began = time.time()
    done = command("set", put(Air.symmetric([vehicle], delay=0.1)), *PAIRS)
    assert time.time() - began < 6.0, "in simulated time"
    assert done.code == 0
    assert set(vehicle.values.values()) == {7}
    receiver = rf"1/1 {'PX4' if kind is PX4Vehicle else 'ArduPilot'} quadrotor, firmware [\d.]+[-\w]*"
    assert re.fullmatch(rf"{receiver}: 60 accepted\n", done.err)
    assert [row[0] for row in done.rows[1:]] == NAMES


def test_every_value_has_an_outcome_of_its_own(command: Command, put: Put, at_terminal: Any) -> None:
    table: dict[str, Any] = {"A": 1.0, "COUNT": 3, "FIXED": 2.0, "SMALL": (ParamType.INT8, 0)}
    vehicle = ArduPilotVehicle(table=table, read_only=["FIXED"], live=(), ftp=False, param_error=True)
    words = ["NO_SUCH=1", "A", 6, "COUNT", 7.6, "SMALL=300", "FIXED", 9]
    refused = command("set", put(vehicle), *words)
    assert (refused.code, refused.out, vehicle.requests["PARAM_SET"]) == (2, "", 0)
    assert "nothing was sent; --force writes what can be written" in refused.err
    done = command("set", put(vehicle), *words, "--force")
    assert done.code == 2
    assert [[row[0], *row[2:]] for row in done.rows[1:]] == [
        ["NO_SUCH", "refused", "1/1 has no NO_SUCH"],
        ["A", "6.0", "accepted"],
        ["COUNT", "7", "adjusted"],
        ["SMALL", "refused", "300 does not fit INT8, which holds -128 to 127"],
        ["FIXED", "refused", "1/1 refused FIXED: read only"],
    ]
    fraction, wide, line = done.err.splitlines()
    assert fraction == "paramclient: COUNT: 7.6 is not a whole number, and the parameter is INT32"
    assert wide == "paramclient: SMALL: 300 does not fit INT8, which holds -128 to 127"
    assert line == "1/1 ArduPilot quadrotor, firmware 4.6.0-dev: 1 accepted, 1 adjusted, 3 refused"
    assert vehicle.values["A"] == 6
    as_json = command("set", put(vehicle), *words, "--force", "--json")
    failed = dict.fromkeys(["NO_SUCH", "SMALL", "FIXED"], "refused")
    found = {each["name"]: each["status"] for each in as_json.json["results"]}
    assert found == failed | {"A": "accepted", "COUNT": "adjusted"}
    at_terminal("n")
    assert command("set", put(vehicle), *words).code == 1
