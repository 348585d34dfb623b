"""The subcommand cache add: a file before the first contact, and what that contact makes of it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from paramclient import ParamCache
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from tests.commands import Command, Put, behind, in_process, leaping


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
    return behind(monkeypatch, "sim:px4")


def value_of(command: Command) -> object:
    [table] = command("show", 1, "MC_ROLL_P", "--json").json["components"]
    return table["params"]["MC_ROLL_P"]["value"]


def handed_over(command: Command, url: str, form: str, tmp_path: Path, cache: Path) -> Path:
    """Save a vehicle to a file as the first station does, and return the file; the cache is empty then."""
    path = tmp_path / f"quad.{form}"
    assert command("save", url, path).code == 0
    for each in tmp_path.glob("cache.sqlite3*"):
        each.unlink()
    assert not cache.exists()
    return path


@pytest.mark.parametrize("form", ["json", "yaml"])
def test_after_a_handover_a_px4_needs_no_download(
    command: Command, put: Put, tmp_path: Path, cache: Path, form: str
) -> None:
    """The file of the first station is all that the second one has."""
    px4 = PX4Vehicle()
    file = handed_over(command, put(px4), form, tmp_path, cache)
    added = command("cache", "add", 1, file)
    assert added.code == 0, added.err
    assert "903 parameters of " in added.out
    assert added.out.endswith("; hash cf579589\n")
    listed = command("cache", "list").rows[1]
    assert listed[:5] == ["1/1", "px4", "903", "cf579589", f"file {file}"]
    assert f"added from the file {file}, not confirmed by the vehicle" in command("show", 1).err
    assert command("cache", "list", "--json").json["components"][0]["source"] == str(file)
    before = px4.requests["PARAM_REQUEST_LIST"]
    fetched = command("fetch", put(Air.symmetric([px4], delay=0.5)), "--json")
    assert fetched.code == 0, fetched.err
    assert (fetched.json["source"], fetched.json["received"]) == ("cache", 903)
    assert px4.requests["PARAM_REQUEST_LIST"] == before
    assert command("cache", "list").rows[1][4] != f"file {file}", "the vehicle has confirmed it"


def test_a_px4_with_other_values_is_downloaded(
    command: Command, put: Put, tmp_path: Path, cache: Path
) -> None:
    px4 = PX4Vehicle()
    file = handed_over(command, put(px4), "json", tmp_path, cache)
    assert command("cache", "add", 1, file).code == 0
    px4.load({"MC_ROLL_P": 7.25})
    fetched = command("fetch", put(px4), "--json")
    assert (fetched.code, fetched.json["source"]) == (0, "stream")
    assert fetched.json["params"]["MC_ROLL_P"]["value"] == 7.25
    with ParamCache(cache) as kept:
        assert kept.component().source is None


@pytest.mark.parametrize("form", ["params", "param"])
@pytest.mark.parametrize("kind", [PX4Vehicle, ArduPilotVehicle])
def test_a_file_for_a_vehicle_that_is_known(
    command: Command, put: Put, tmp_path: Path, kind: Callable[[], Vehicle], form: str
) -> None:
    """A `.param` has no types: those of the previous table count."""
    vehicle = kind()
    file = tmp_path / f"quad.{form}"
    assert command("fetch", put(vehicle)).code == 0
    assert command("save", put(vehicle), file).code == 0
    later = time.time() + 60
    os.utime(file, (later, later))
    added = command("cache", "add", 1, file, "--json")
    assert added.code == 0, added.err
    assert added.json["complete"]
    assert (added.json["hash"] is not None) == (kind is PX4Vehicle)
    before = vehicle.requests.total()
    fetched = command("fetch", put(vehicle), "--json")
    assert fetched.json["source"] == ("cache" if kind is PX4Vehicle else "ftp")
    assert vehicle.requests.total() > before


def test_a_newer_table_is_not_replaced_without_force(command: Command, put: Put, tmp_path: Path) -> None:
    px4 = PX4Vehicle()
    file = tmp_path / "quad.params"
    assert command("save", put(px4), file, "--no-cache").code == 0
    os.utime(file, (1.7e9, 1.7e9))
    assert command("set", put(px4), "MC_ROLL_P", 7.25, "--no-cache").code == 0
    assert command("fetch", put(px4)).code == 0
    refused = command("cache", "add", 1, file)
    assert refused.code == 2
    assert "later than the values of the file" in refused.err
    assert "--force" in refused.err
    assert value_of(command) == 7.25
    assert command("cache", "add", 1, file, "--force").code == 0
    assert value_of(command) == 4.0


def test_a_vehicle_that_neither_cache_nor_file_has_is_refused(
    command: Command, put: Put, tmp_path: Path
) -> None:
    file = tmp_path / "quad.params"
    assert command("save", put(PX4Vehicle()), file, "--no-cache").code == 0
    refused = command("cache", "add", 1, file)
    assert (refused.code, refused.out) == (2, "")
    assert "1 is not in the cache" in refused.err
    assert command("cache", "add", 1, tmp_path / "nothing.params").code == 2
