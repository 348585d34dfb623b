"""On-board logs: parameters, defaults, changes, identity and time of dataflash and ULog files."""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient.errors import FileError, UsageError
from paramclient.logs.onboard import is_onboard_log, read_onboard_log
from paramclient.model.values import ParamType
from tests.logs.writers import ULogWriter, dataflash

NAN = math.nan
BOOT = 1_790_000_000
"""Unix time of the boot in these logs."""
GPS_SECONDS = BOOT + 30 - 315_964_800 + 18
"""GPS time 30 s after the boot."""
COMMON = [
    ("MSG", 1_000_000, "ArduCopter V4.6.0-dev (3fc7011a)"),
    ("MSG", 1_000_000, "CubeOrange 00380043 31385115 32383033"),
    ("PARM", 1_000_000, "SYSID_THISMAV", 7.0, 1.0),
    ("PARM", 1_100_000, "ATC_RAT_RLL_P", 0.135, 0.135),
    ("PARM", 1_200_000, "ARMING_CHECK", 1.0, 1.0),
]
VERSION = ("VER", 1_000_000, 3, 140, 4, 5, 1, 192, 0x3FC7011A, "ArduCopter V4.5.1", 0, 2, 0)
FIX = ("GPS", 30_000_000, 0, 3, GPS_SECONDS % 604800 * 1000, GPS_SECONDS // 604800, 12)


def written(folder: Path, data: bytes, name: str = "flight.bin") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def test_a_dataflash_log_has_values_defaults_and_the_vehicle(tmp_path: Path) -> None:
    log = read_onboard_log(written(tmp_path, dataflash([*COMMON, VERSION, FIX])))
    assert log.file_format == "dataflash"
    assert [(param.name, param.value, param.default, param.type) for param in log.initial.values()] == [
        ("SYSID_THISMAV", 7, 1, None),
        ("ATC_RAT_RLL_P", 0.135, 0.135, None),
        ("ARMING_CHECK", 1, 1, None),
    ]
    assert isinstance(log.initial["ARMING_CHECK"].value, int)
    identity = log.identity
    assert (identity.system, identity.autopilot, identity.vehicle_type) == (7, 3, 2)
    assert identity.uid == "430038001551383133303832" + "00" * 6
    assert (identity.firmware, identity.git_hash) == (0x040501C0, "3fc7011a")
    assert log.boot_time == pytest.approx(BOOT)
    assert log.at_start().at == pytest.approx(BOOT + 1)
    assert log.notes == ()


def test_later_values_of_a_dataflash_log_are_changes(tmp_path: Path) -> None:
    later = [
        ("PARM", 60_000_000, "ATC_RAT_RLL_P", 0.2, NAN),
        ("PARM", 61_000_000, "ATC_RAT_RLL_P", 0.2, NAN),
        ("PARM", 70_000_000, "SCR_USER1", 4.0, NAN),
    ]
    log = read_onboard_log(written(tmp_path, dataflash([*COMMON, FIX, *later])))
    changes = [(at, param.name, param.value) for at, param in log.changes]
    assert changes == [(60.0, "ATC_RAT_RLL_P", 0.2), (70.0, "SCR_USER1", 4)]
    assert "SCR_USER1" not in log.at_start()
    assert log.at_start()["ATC_RAT_RLL_P"].value == 0.135
    end = log.at_end()
    assert (end["ATC_RAT_RLL_P"].value, end["ATC_RAT_RLL_P"].default) == (0.2, 0.135)
    assert end["SCR_USER1"].value == 4
    assert end.at == pytest.approx(BOOT + 70)


def test_a_damaged_name_is_left_out_and_noted(tmp_path: Path) -> None:
    log = read_onboard_log(written(tmp_path, dataflash([*COMMON, ("PARM", 2, "A\nB", 1.0, 1.0)])))
    assert len(log.initial) == 3
    assert log.notes == ("1 PARM messages are damaged and left out",)


def flight() -> ULogWriter:
    log = ULogWriter(start=500_000)
    log.info("sys_uuid", "0001" + "00" * 6 + "0123456789abcdef0123")
    log.info("ver_sw", "a70a5583aaaabbbbccccddddeeeeffff00001111")
    log.info("ver_sw_release", 0x011100FF)
    log.param("MAV_SYS_ID", 3)
    log.param("MAV_TYPE", 13)
    log.param("MC_ROLL_P", 7.5)
    log.default("MC_ROLL_P", 6.5)
    log.param("MC_PITCH_P", 6.5)
    log.param("MPC_XY_CRUISE", 9.0)
    log.default("MPC_XY_CRUISE", 5.0, types=1)
    log.default("MPC_XY_CRUISE", 9.0, types=2)
    log.begin_data()
    return log


def test_a_ulog_file_has_types_defaults_changes_and_the_vehicle(tmp_path: Path) -> None:
    writer = flight()
    writer.gps(900_000, 0, 0)
    writer.gps(1_000_000, (BOOT + 1) * 1_000_000, 3)
    writer.status(2_000_000)
    writer.param("MC_ROLL_P", 8.0)
    writer.status(4_000_000)
    log = read_onboard_log(written(tmp_path, bytes(writer.data), "flight.ulg"))
    assert log.file_format == "ulog"
    assert {name: (param.value, param.type, param.default) for name, param in log.initial.items()} == {
        "MAV_SYS_ID": (3, ParamType.INT32, 3),
        "MAV_TYPE": (13, ParamType.INT32, 13),
        "MC_ROLL_P": (7.5, ParamType.REAL32, 6.5),
        "MC_PITCH_P": (6.5, ParamType.REAL32, 6.5),
        "MPC_XY_CRUISE": (9.0, ParamType.REAL32, 9.0),  # the airframe's default counts before the firmware's
    }
    identity = log.identity
    assert (identity.system, identity.autopilot, identity.vehicle_type) == (3, 12, 13)
    assert identity.uid == "0001" + "00" * 6 + "0123456789abcdef0123"
    assert (identity.firmware, identity.git_hash) == (0x011100FF, "a70a5583aaaabbbb")
    assert [(at, param.name, param.value) for at, param in log.changes] == [(2.0, "MC_ROLL_P", 8.0)]
    assert log.boot_time == pytest.approx(BOOT)
    assert log.at_start()["MC_ROLL_P"].value == 7.5
    assert log.at_end()["MC_ROLL_P"].value == 8.0
    assert log.at_end().at == pytest.approx(BOOT + 4)


def test_a_ulog_file_without_the_flag_has_no_defaults(tmp_path: Path) -> None:
    writer = ULogWriter(has_defaults=False)
    writer.param("MC_ROLL_P", 7.5)
    writer.begin_data()
    log = read_onboard_log(written(tmp_path, bytes(writer.data), "flight.ulg"))
    assert log.initial["MC_ROLL_P"].default is None
    assert log.boot_time is None


def test_a_cut_log_keeps_what_it_has(tmp_path: Path) -> None:
    writer = flight()
    writer.status(2_000_000)
    log = read_onboard_log(written(tmp_path, bytes(writer.data[:-3]), "cut.ulg"))
    assert log.initial["MC_ROLL_P"].value == 7.5
    assert len(read_onboard_log(written(tmp_path, dataflash([*COMMON, FIX])[:-20])).initial) == 3


@pytest.mark.parametrize("data", [b"", b"ULog", b"\xa3", b"ROLL_P 1\n", b"\xfd" * 40])
def test_other_files_are_not_on_board_logs(tmp_path: Path, data: bytes) -> None:
    path = written(tmp_path, data)
    assert not is_onboard_log(path)
    with pytest.raises(FileError, match="neither a dataflash log nor a ULog file"):
        read_onboard_log(path)


def test_without_pyulog_the_error_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, bytes(flight().data), "flight.ulg")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    monkeypatch.delitem(sys.modules, "paramclient.logs.onboard", raising=False)
    with pytest.raises(UsageError, match=r"paramclient\[logs\]"):
        read_onboard_log(path)


@settings(deadline=None, max_examples=150)
@given(st.data())
def test_damaged_logs_are_read_or_refused_and_nothing_is_printed(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    whole = data.draw(st.sampled_from([dataflash([*COMMON, VERSION, FIX]), bytes(flight().data)]))
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 12))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = written(tmp_path_factory.mktemp("logs"), bytes(damaged[: data.draw(st.integers(0, len(damaged)))]))
    try:
        log = read_onboard_log(path)
    except FileError:
        return
    for param in [*log.at_end().values(), *log.at_start().values()]:
        assert param.name.isprintable()
        assert struct.pack("<d", param.value)
