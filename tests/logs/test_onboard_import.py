"""Import of on-board logs into a cache: identity, types, times, history, order."""

from __future__ import annotations

import math
from pathlib import Path

import anyio
import pytest

from paramclient import ParamCache, ParamType, read_file
from paramclient.cache import StoredParam, TableUpdate
from paramclient.errors import FileError
from paramclient.logs.imports import import_onboard_log
from paramclient.logs.onboard import read_onboard_log
from paramclient.model.identity import Identity
from paramclient.model.values import Param
from tests.logs.test_onboard import BOOT, COMMON, FIX, written
from tests.logs.writers import dataflash

DATA = Path(__file__).parent.parent / "data"
KEY = "uid:430038001551383133303832" + "00" * 6
LATER = [("PARM", 60_000_000, "ATC_RAT_RLL_P", 0.2, math.nan)]


@pytest.fixture
def cache(tmp_path: Path) -> ParamCache:
    return ParamCache(tmp_path / "cache.sqlite3")


def hold(cache: ParamCache, param: Param, at: float, key: str = KEY) -> None:
    identity = Identity(7, "udpin:x", key.removeprefix("uid:"), autopilot=3, vehicle_type=2)
    cache.save(
        [TableUpdate(identity=identity, component=1, autopilot=3, at=at, params=[StoredParam.of(param, at)])]
    )


def test_values_and_changes_have_the_times_of_the_log(cache: ParamCache, tmp_path: Path) -> None:
    anyio.run(import_onboard_log, written(tmp_path, dataflash([*COMMON, FIX, *LATER])), cache)
    table = cache.component(KEY)
    assert (table.system, table.autopilot, table.complete) == (7, 3, False)
    assert table.params["ATC_RAT_RLL_P"].value == pytest.approx(0.2)
    assert table.params["ATC_RAT_RLL_P"].default == pytest.approx(0.135)
    assert table.heard_at["ATC_RAT_RLL_P"] == pytest.approx(BOOT + 60, abs=0.01)
    assert table.heard_at["ARMING_CHECK"] == pytest.approx(BOOT + 1, abs=0.01)
    (line,) = cache.history(KEY)
    assert line.name == "ATC_RAT_RLL_P"
    assert line.old.value == pytest.approx(0.135)
    assert line.at == pytest.approx(BOOT + 60, abs=0.01)


def test_types_are_from_the_cached_table_then_from_other_vehicles(cache: ParamCache, tmp_path: Path) -> None:
    hold(cache, Param("ARMING_CHECK", 1, ParamType.INT32, 2, 1), BOOT - 1000)
    hold(cache, Param("SYSID_THISMAV", 3, ParamType.INT16, 1, 3), BOOT - 1000, "uid:aabbccddeeff")
    result = anyio.run(import_onboard_log, written(tmp_path, dataflash([*COMMON, FIX])), cache)
    table = cache.component(KEY)
    assert {name: param.type for name, param in table.params.items()} == {
        "ARMING_CHECK": ParamType.INT32,
        "SYSID_THISMAV": ParamType.INT16,
        "ATC_RAT_RLL_P": ParamType.REAL32,
    }
    assert isinstance(table.params["SYSID_THISMAV"].value, int)
    assert cache.history(KEY) == []
    assert result.notes == ("the log has no types: 1 parameters that no cached table has are REAL32",)


def test_a_log_without_time_or_system_is_refused(cache: ParamCache, tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no UTC time"):
        anyio.run(import_onboard_log, written(tmp_path, dataflash(COMMON)), cache)
    nameless = [each for each in COMMON if each[2] != "SYSID_THISMAV"]
    with pytest.raises(FileError, match="no system id"):
        anyio.run(import_onboard_log, written(tmp_path, dataflash([*nameless, FIX])), cache)
    assert cache.components() == []


def test_a_log_of_a_real_copter() -> None:
    log = read_onboard_log(DATA / "ardupilot_flight.bin")
    assert (len(log.initial), log.notes) == (1382, ())
    assert all(param.default is not None for param in log.initial.values())
    identity = log.identity
    assert (identity.system, identity.vehicle_type, identity.git_hash) == (1, 2, "fbb78585")
    assert identity.firmware == 0x04060000
    assert log.boot_time == pytest.approx(1795415873.79, abs=0.01)
    assert [each.name for _, each in log.changes if each.name.startswith("ATC")] == ["ATC_RAT_RLL_P"]
    packed = read_file(DATA / "ardupilot_param_withdefaults.pck").choose()
    assert len(log.initial.keys() & packed.keys()) > 1300


def test_a_log_of_a_real_px4() -> None:
    log = read_onboard_log(DATA / "px4_flight.ulg")
    assert (len(log.initial), log.notes) == (850, ())
    identity = log.identity
    assert (identity.system, identity.vehicle_type, identity.git_hash) == (4, 2, "a70a5583931d3294")
    assert log.initial["MAV_SYS_ID"].type == ParamType.INT32
    changed = [name for name, param in log.initial.items() if param.default != param.value]
    assert len(changed) == 49
    assert {"MAV_SYS_ID", "SYS_AUTOSTART"} <= set(changed)
