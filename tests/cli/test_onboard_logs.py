"""Logs on the command line: show, diff and save."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import read_file
from tests.commands import Command

DATA = Path(__file__).parents[1] / "data"
LOGS = {"ardupilot_flight.bin": (1382, 41), "px4_flight.ulg": (850, 49)}
"""Parameters of each log, and those that differ from their default."""


@pytest.mark.parametrize("name", LOGS)
def test_an_onboard_log_is_shown_and_saved(command: Command, tmp_path: Path, name: str) -> None:
    log, path, (count, changed) = DATA / name, tmp_path / "quad.param", LOGS[name]
    assert len(command("show", log).rows) == count + 1
    assert len(command("show", log, "--changed").rows) == changed + 1
    saved = command("save", log, path)
    assert (saved.code, f"{count} parameters of " in saved.err) == (0, True)
    assert len(read_file(path).choose()) == count


def test_logs_of_every_format_are_compared(command: Command, tmp_path: Path) -> None:
    telemetry = DATA / "px4_full_download.tlog"
    outcome = command("diff", telemetry, DATA / "px4_flight.ulg", "--json")
    assert (outcome.code, outcome.json["left"]["count"], outcome.json["right"]["count"]) == (1, 903, 850)
    assert outcome.json["left"]["at"].startswith("2026-11-20"), "when the values were received"
    assert len(command("show", telemetry, "--json").json["components"][0]["params"]) == 903
    for name, words in (("px4_20_sets", "23 of 908"), ("ardupilot_30_sets", "30 of 1382")):
        assert f"(incomplete: {words} parameters, " in command("show", DATA / f"{name}.tlog").err
    changed = command("show", DATA / "ardupilot_enable_groups.tlog").err
    assert "(incomplete: 1402 parameters; of the list of 1382 without index 0, " in changed
    assert "the state: 903 parameters of " in command("restore", "sim:px4", telemetry, "--dry-run").err
    saved = command("save", telemetry, tmp_path / "quad.param")
    assert (saved.code, saved.err[:16]) == (0, "903 parameters o")


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("show", b"ULog\x01\x12\x35\x01" + bytes(8) + b"\xff" * 50, "broken.log: "),
        ("import", b"", "neither a telemetry log"),
        ("import", b"SQLite format 3\0" + bytes(100), "an SQLite database"),
    ],
)
def test_a_damaged_log_is_named(command: Command, tmp_path: Path, name: str, data: bytes, kind: str) -> None:
    (path := tmp_path / "broken.log").write_bytes(data)
    done = command(name, path)
    assert (done.code, done.out, kind in done.err, done.err.count("\n")) == (2, "", True, 1)
