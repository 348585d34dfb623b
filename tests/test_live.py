"""The suite of `tests/live` on simulated vehicles: it must be right before it meets a real one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import anyio
import anyio.from_thread
import anyio.lowlevel
import pytest

from paramclient.model.values import ParamType, Value
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, Vehicle
from tests.live import __main__ as suite
from tests.live.checks import Check, Session, checks
from tests.simulated_on_udp import flying

pytestmark = pytest.mark.slow

CHANNELS: dict[str, Value] = {
    f"RC{channel}_{what}": value
    for channel in range(1, 17)
    for what, value in {"DZ": 0.0, "TRIM": 1500.0, "MIN": 1000.0, "MAX": 2000.0}.items()
}
PX4_TABLE = {**CHANNELS, "SDLOG_DIRS_MAX": 7, "RTL_TIME_FACTOR": 1.1, "RC_MAP_AUX1": 16, "RC_MAP_AUX2": 0}
ARDUPILOT_TABLE = {
    **{name: (ParamType.INT16, int(value)) for name, value in CHANNELS.items() if isinstance(value, float)},
    "BRD_SERIAL_NUM": (ParamType.INT32, 0),
    "RALLY_LIMIT_KM": (ParamType.REAL32, 0.3),
    "LOG_FILE_MB_FREE": (ParamType.INT16, 500),
    "NTF_LED_BRIGHT": (ParamType.INT8, 3),
    "GRIP_ENABLE": (ParamType.INT8, 0),
    "RC16_OPTION": (ParamType.INT16, 300),
    "RC15_OPTION": (ParamType.INT16, 0),
}
GROUP: dict[str, dict[str, Value | tuple[ParamType, Value]]]
GROUP = {"GRIP_ENABLE": {"GRIP_GRAB": (ParamType.INT16, 1900), "GRIP_REGRAB": 1.5}}


def px4() -> PX4Vehicle:
    return PX4Vehicle(table=PX4_TABLE)


def ardupilot() -> ArduPilotVehicle:
    return ArduPilotVehicle(table=ARDUPILOT_TABLE, groups=GROUP)


def having(monkeypatch: pytest.MonkeyPatch, *chosen: Check | str) -> None:
    """Let the suite make these checks, and of its own those with these names."""
    known = {check.name: check for check in checks(reboots=True)}
    made = [known[check] if isinstance(check, str) else check for check in chosen]
    monkeypatch.setattr(suite, "checks", lambda **_: iter(made))


def results(printed: str) -> dict[str, str]:
    """What the table says of each check."""
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in printed.splitlines() if "|" in line]
    return {name: result for name, _, _, result in lines[2:]}


EVERYWHERE = (
    *("fetch, nothing known", "fetch, 20% loss, 20 ms", "get by name", "set, REAL32", "30 sets at once"),
    *("restore, the state before", "two sessions, a change in one", "a group shown and hidden"),
)
OF_A_KIND = {
    "px4": ("fetch in a new session, cached",),
    "ardupilot": (*("set, a fraction for an integer", "fetch by list, 5% loss, 100 ms"),),
}
SEEN = {"px4": "from the cache", "ardupilot": "GRIP_ENABLE: {0}, {1}, {0} parameters"}


@pytest.mark.parametrize("make", [px4, ardupilot])
def test_the_live_checks_pass_on_a_simulated_vehicle(
    make: Callable[[], Vehicle], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle, kind = make(), make.__name__
    before = vehicle.values
    having(monkeypatch, *EVERYWHERE, *OF_A_KIND[kind])
    with flying(vehicle) as link:
        code = suite.main([link, "--kind", kind])
    printed = capsys.readouterr().out
    found = results(printed)
    assert len(found) == len(EVERYWHERE) + len(OF_A_KIND[kind]) + 1
    assert found.pop("a group shown and hidden") == ("skipped" if kind == "px4" else "ok")
    assert (code, {*found.values()}) == (0, {"ok"}), printed
    assert SEEN[kind].format(len(before), len(before) + 2) in printed
    assert vehicle.requests["PARAM_SET"] > 28
    assert vehicle.values == before


async def set_and_fail(session: Session) -> str:
    async with session.client() as vehicle:
        await session.journal.set(vehicle, "SDLOG_DIRS_MAX", 3)
        assert (await vehicle.get("SDLOG_DIRS_MAX")).value == 3
    raise RuntimeError("the check is broken")


async def set_and_be_interrupted(session: Session) -> str:
    async with session.client() as vehicle:
        await session.journal.set(vehicle, "SDLOG_DIRS_MAX", 3)
        for child in multiprocessing.active_children():
            assert child.pid is not None
            os.kill(child.pid, signal.SIGINT)  # as a terminal sends it to every process in it
            os.kill(child.pid, signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        await anyio.sleep_forever()
    raise AssertionError


@pytest.mark.skipif(sys.platform == "win32", reason="signals reach no process there as they do elsewhere")
@pytest.mark.parametrize("fails", [set_and_fail, set_and_be_interrupted])
def test_a_failed_live_check_restores_the_vehicle(
    fails: Callable[[Session], object], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle = px4()
    having(monkeypatch, Check("breaks", fails, writes=True), "get by index")  # type: ignore[arg-type]
    with flying(vehicle) as link:
        assert suite.main([link]) == 1
    printed = capsys.readouterr().out
    found = results(printed)
    assert found["state after"] == "ok", printed
    assert vehicle.values == {name: pytest.approx(value) for name, value in PX4_TABLE.items()}
    if fails is set_and_fail:
        assert found["breaks"] == "FAILED"
        assert found["get by index"] == "ok"  # the checks after it are made
    else:
        assert "get by index" not in found


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [([], 2, "is armed"), (["--kind", "ardupilot"], 2, "not ardupilot"), (["--read-only"], 0, "skipped")],
)
def test_an_armed_or_another_vehicle_is_not_written(
    arguments: list[str],
    code: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    having(monkeypatch, "set, INT32", "get by index")
    with flying(vehicle := PX4Vehicle(table=PX4_TABLE, armed=True)) as link:
        assert suite.main([link, *arguments]) == code
    printed = capsys.readouterr()
    assert words in printed.out + printed.err
    assert vehicle.requests["PARAM_SET"] == 0


async def change_behind_its_back(session: Session) -> str:
    async with session.client() as vehicle:
        await vehicle.set("SDLOG_DIRS_MAX", 3)
    return "done"


def test_a_state_that_is_not_the_one_before_fails_and_stays_on_disk(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    having(monkeypatch, Check("careless", change_behind_its_back, writes=True))
    with flying(px4()) as link:
        assert suite.main([link]) == 1
    printed = capsys.readouterr().out
    assert results(printed)["state after"] == "FAILED"
    assert "SDLOG_DIRS_MAX was 7, is 3" in printed
    (file,) = tmp_path.glob("*/before.json")
    assert f"paramclient restore {link} {file}" in printed
