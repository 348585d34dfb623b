"""On-board logs on the command line: show, diff and save."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from paramclient import read_file
from tests.commands import Command, in_process
from tests.logs.writers import ULogWriter, dataflash


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    return in_process(capsys)


@pytest.fixture
def copter(tmp_path: Path) -> Path:
    path = tmp_path / "flight1.bin"
    path.write_bytes(
        dataflash(
            [
                ("PARM", 1_000_000, "SYSID_THISMAV", 7.0, 1.0),
                ("PARM", 1_000_000, "ATC_RAT_RLL_P", 0.135, 0.135),
                ("PARM", 9_000_000, "ATC_RAT_RLL_P", 0.2, math.nan),
            ]
        )
    )
    return path


@pytest.fixture
def quad(tmp_path: Path) -> Path:
    log = ULogWriter()
    log.param("MAV_SYS_ID", 1)
    log.param("MC_ROLL_P", 7.5)
    log.default("MC_ROLL_P", 6.5)
    log.param("SYS_AUTOSTART", 4001)
    log.begin_data()
    path = tmp_path / "flight2.ulg"
    path.write_bytes(log.data)
    return path


def test_show_prints_the_values_at_the_end_of_a_log(command: Command, copter: Path) -> None:
    shown = command("show", copter)
    assert shown.code == 0
    assert shown.out.splitlines() == [
        "name           value  default",
        "SYSID_THISMAV      7        1",
        "ATC_RAT_RLL_P    0.2    0.135",
    ]
    assert shown.err == f"2 parameters of 7/1 ardupilot from {copter}\n"


def test_diff_compares_logs_of_both_formats(command: Command, copter: Path, quad: Path) -> None:
    compared = command("diff", copter, quad, "--json")
    assert compared.code == 1
    assert "MC_ROLL_P" in compared.out
    assert command("diff", quad, quad).code == 0


def test_save_writes_a_log_as_a_parameter_file(command: Command, copter: Path, tmp_path: Path) -> None:
    path = tmp_path / "quad.param"
    saved = command("save", copter, path)
    assert (saved.code, saved.err) == (0, f"2 parameters of 7/1 written to {path} (mission-planner)\n")
    assert read_file(path).choose()["ATC_RAT_RLL_P"].value == 0.2


def test_a_damaged_log_is_an_error_without_a_traceback(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "broken.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + b"\xff" * 50)
    shown = command("show", path)
    assert shown.code == 2
    assert shown.err.startswith(f"paramclient: {path}: ")
    assert "Traceback" not in shown.err


def test_a_telemetry_log_is_a_source(command: Command) -> None:
    log = Path(__file__).parents[1] / "data/px4_full_download.tlog"
    outcome = command("diff", log, log.with_name("px4_flight.ulg"), "--json")
    assert (outcome.code, outcome.json["left"]["count"], outcome.json["right"]["count"]) == (1, 903, 850)
    assert len(command("show", log, "--json").json["components"][0]["params"]) == 903
