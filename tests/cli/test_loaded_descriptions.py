"""Parameter descriptions that commands load without a request where the link is quick, and what they say."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest

from paramclient.cli import metadata
from paramclient.protocol import wire
from paramclient.sim import ArduPilotVehicle, GenericVehicle, PX4Vehicle
from tests.commands import Command, Put, behind, in_process, leaping
from tests.shell import Tap

URL = "udpin:0.0.0.0:14550"


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in this process, on simulated time, with a new cache."""
    leaping(monkeypatch)
    return in_process(capsys, "--cache", str(tmp_path / "cache.sqlite3"))


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    return behind(monkeypatch, URL)


def quad(**options: Any) -> Tap:
    """A PX4 with metadata, and what it was sent."""
    given: dict[str, Any] = {"table": {"MC_ROLL_P": 4.0, "MC_PITCH_P": 6.5}, "metadata": True}
    return Tap(PX4Vehicle(**given | options))


@pytest.mark.parametrize("words", [("get", "MC_ROLL_P"), ("fetch",)])
def test_descriptions_are_loaded_once_where_the_link_is_open(
    command: Command, put: Put, words: tuple[str, ...]
) -> None:
    name, *rest = words
    first = command(name, put(quad()), *rest)
    assert first.code == 0
    assert "descriptions of 1/1 px4 loaded; `paramclient info NAME` shows one\n" in first.err
    assert "range: 0 to 12 1/s" in command("info", "MC_ROLL_P").out
    assert "MC_ROLL_P" in command("search", "angle", "gain").out
    again = quad()
    second = command(name, put(again), *rest)
    assert "loaded" not in second.err
    assert not again.messages(wire.FileTransfer)
    assert "1/s" in command("get", put(quad()), "MC_ROLL_P").out


def test_get_shows_the_loaded_units(command: Command, put: Put) -> None:
    assert "1/s" in command("get", put(quad()), "MC_ROLL_P").rows[1]


@pytest.mark.parametrize("words", [("get", "MC_ROLL_P"), ("fetch",)])
def test_after_a_slow_transfer_no_other_command_is_delayed(
    command: Command, put: Put, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, *rest = words
    slow = quad(ftp_rate=2_000.0, table=None)
    done = command(name, put(slow), *rest)
    assert done.code == 0
    assert "loaded" not in done.err
    assert slow.messages(wire.FileTransfer)
    again = quad(ftp_rate=2_000.0, table=None)
    assert command(name, put(again), *rest).code == 0
    assert not again.messages(wire.FileTransfer)
    monkeypatch.setattr(metadata, "FAILURE_AGE_MAX", -1.0)  # the next day
    later = quad(table=None)
    assert "loaded" in command(name, put(later), *rest).err


@pytest.mark.parametrize("option", ["--json", "--no-cache", "armed", "--listen-only"])
def test_nothing_is_loaded_for_scripts_or_while_it_would_disturb(
    command: Command, put: Put, option: str
) -> None:
    vehicle = quad(armed=option == "armed")
    options = [option] if option.startswith("--") else []
    done = command(
        "get" if option != "--listen-only" else "fetch",
        put(vehicle),
        *(["MC_ROLL_P"] if option != "--listen-only" else ["--timeout", 3]),
        *options,
    )
    assert "loaded" not in done.err
    assert not vehicle.messages(wire.FileTransfer)


@pytest.mark.parametrize("vehicle", [ArduPilotVehicle, GenericVehicle])
def test_no_metadata_is_requested_from_a_vehicle_without_it(command: Command, put: Put, vehicle: Any) -> None:
    tap = Tap(vehicle(table={"MC_ROLL_P": 4.0}))
    assert command("get", put(tap), "MC_ROLL_P").code == 0
    requested = [
        each for each in tap.messages(wire.CommandLong) if each.params[0] == wire.COMPONENT_METADATA_ID
    ]
    assert not requested


def test_info_and_search_name_the_command_that_loads_descriptions(command: Command, put: Put) -> None:
    assert command("get", put(quad()), "MC_ROLL_P", "--json").code == 0  # loads nothing
    request = f"paramclient get {URL} MC_ROLL_P --system 1 --metadata vehicle"
    for words in (("info", "MC_ROLL_P"), ("search", "roll")):
        said = command(*words).err
        assert f"no metadata is stored for the firmware of px4. `{request}` loads it from 1/1.\n" in said
    put(quad())
    assert command(*shlex.split(request)[1:]).code == 0
    assert "range: 0 to 12 1/s" in command("info", "MC_ROLL_P").out
