"""The firmware's defaults in every command: of the vehicle, else of its metadata, each with its source."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from paramclient.files import read_file
from paramclient.sim import PX4Vehicle
from paramclient.wire import messages
from tests.commands import Command, Put, metadata_file
from tests.shell import Tap

TABLE = {"COM_FLTMODE1": 0, "EKF2_GPS_CTRL": 7, "MC_PITCH_P": 6.5, "MC_ROLL_P": 4.0}
"""The defaults in the metadata of the simulated PX4."""


def quad(*, metadata: bool = True, **options: Any) -> PX4Vehicle:
    """A PX4 with MC_ROLL_P changed from its default."""
    vehicle = PX4Vehicle(table=TABLE, metadata=metadata, **options)
    vehicle.set_param("MC_ROLL_P", 6.25)
    return vehicle


# fetch


def test_fetch_compares_with_the_metadata_of_the_vehicle(command: Command, put: Put) -> None:
    done = command("fetch", put(quad()), "--changed", "--metadata", "vehicle")
    assert (done.code, done.rows[1:]) == (0, [["MC_ROLL_P", "6.25", "REAL32", "3", "live", "4.0"]]), done.err
    assert "1/1 PX4 quadrotor: 1 of 1 default from the metadata of the firmware" in done.err


def test_without_changed_nothing_is_requested_for_defaults(command: Command, put: Put) -> None:
    tap = Tap(quad())
    assert "default" not in command("fetch", put(tap), "--json").json["params"]["MC_ROLL_P"]
    assert not tap.messages(messages.FileTransfer)


def test_unknown_defaults_are_an_error_that_says_what_to_do(command: Command, put: Put) -> None:
    done = command("fetch", put(quad()), "--changed")
    assert (done.code, done.out) == (1, "")
    assert "--metadata vehicle` and `paramclient metadata add FILE` store" in done.err


# without a link, and files


def test_a_cached_table_is_compared_with_the_remembered_metadata(command: Command, put: Put) -> None:
    assert command("fetch", put(quad()), "--json").code == 0  # loads no metadata
    unknown = command("show", "1", "--changed")
    assert (unknown.code, unknown.err.split(" are ")[0]) == (1, "paramclient: the firmware's defaults")
    assert command("fetch", put(quad()), "--changed", "--metadata", "vehicle").code == 0
    shown = command("show", "1", "--changed")
    assert shown.code == 0, shown.err
    assert [row[:3] for row in shown.rows[1:]] == [["MC_ROLL_P", "6.25", "4.0"]]
    assert "1 of 1 default from the metadata" in shown.err
    assert command("info", "MC_ROLL_P").rows[-1][3:5] == ["4.0", "metadata"]
    (vehicle,) = command("info", "MC_ROLL_P", "--json").json["vehicles"]
    assert (vehicle["param"]["default_source"], vehicle["param"]["is_default"]) == ("metadata", False)


def test_save_writes_what_differs(command: Command, put: Put, tmp_path: Path) -> None:
    file = tmp_path / "changed.json"
    assert command("save", put(quad()), file, "--changed", "--metadata", "vehicle").code == 2
    assert command("fetch", put(quad()), "--changed", "--metadata", "vehicle").code == 0
    done = command("save", put(quad()), file, "--changed")
    assert done.code == 0, done.err
    written = read_file(file).choose(None)
    assert list(written) == ["MC_ROLL_P"]
    assert written["MC_ROLL_P"].default is None, "a file has only what the vehicle gives"
    whole = tmp_path / "whole.parm"
    assert command("save", "1", whole).code == 0
    given = metadata_file(tmp_path, MC_ROLL_P={"default": 6.25}, MC_PITCH_P={"default": 1.0})
    converted = command("save", whole, tmp_path / "part.parm", "--changed", "--metadata", given)
    assert (converted.code, "1 parameter of an unknown vehicle written" in converted.err) == (0, True)
    assert list(read_file(tmp_path / "part.parm").choose(None)) == ["MC_PITCH_P"]


def test_defaults_in_a_comparison_are_of_the_metadata(command: Command, put: Put, tmp_path: Path) -> None:
    file = tmp_path / "tuned.parm"
    file.write_text("MC_ROLL_P,4\nMC_PITCH_P,7\n")
    assert command("fetch", put(quad()), "--json").code == 0  # loads no metadata
    words = ("diff", "1", file, "--partial", "--base", "defaults")
    unknown = command(*words)
    assert unknown.code == 2
    assert "`paramclient fetch LINK --metadata vehicle`" in unknown.err
    assert command("fetch", put(quad()), "--metadata", "vehicle").code == 0
    found = command(*words, "--json").json
    sides = {name: (each["changed_side"], each["default_source"]) for name, each in found["params"].items()}
    assert sides == {"MC_PITCH_P": ("right", "metadata"), "MC_ROLL_P": ("left", "metadata")}
    assert "2 of 2 from the metadata" in found["base"]["source"]
