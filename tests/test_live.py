"""The suite of `tests/live` on simulated vehicles: it must be right before it meets a real one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import anyio
import anyio.from_thread
import anyio.lowlevel
import pytest

from paramclient.model.values import Param, ParamType, WireValue
from paramclient.protocol import wire
from paramclient.protocol.ftp.packets import Opcode, Packet
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, Vehicle
from tests.live import __main__ as suite
from tests.live.checks import checks
from tests.live.choice import choose
from tests.live.journal import Journal
from tests.live.relay import Conditions, RealVehicle
from tests.live.session import Check, Measured, Session
from tests.simulated_on_udp import flying

pytestmark = pytest.mark.slow

CHANNELS: dict[str, WireValue] = {
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
GROUP: dict[str, dict[str, WireValue | tuple[ParamType, WireValue]]]
GROUP = {"GRIP_ENABLE": {"GRIP_GRAB": (ParamType.INT16, 1900), "GRIP_REGRAB": 1.5}}


def px4(*, armed: bool = False) -> PX4Vehicle:
    return PX4Vehicle(table=PX4_TABLE, armed=armed)


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
    *(
        "fetch, nothing known",
        "fetch, 20% loss, 20 ms",
        "get by name",
        "set, REAL32",
        "set, rounded to float32",
    ),
    *("30 sets at once", "two sessions, a change in one"),
)


SET_UPS = ("verify, 15 unknown names", "restore, the state before", "apply with a restart")


def test_the_live_checks_pass_on_a_simulated_px4(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle = px4()
    before = vehicle.values
    having(
        monkeypatch,
        *EVERYWHERE,
        *SET_UPS,
        "fetch in a new session, cached",
        "a group shown and hidden",
        "set, a change too small to save",
    )
    with flying(vehicle) as link:
        code = suite.main([link, "--kind", "px4"])
    printed = capsys.readouterr().out
    found = results(printed)
    assert found.pop("a group shown and hidden") == "skipped"
    assert set(found.values()) <= {"ok", "slower"}, printed
    assert code == 0
    assert "from the cache" in printed
    assert vehicle.requests["PARAM_SET"] > 28
    assert vehicle.values == before


def test_the_live_checks_pass_on_a_simulated_ardupilot(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle = ardupilot()
    before = vehicle.values
    having(
        monkeypatch,
        *EVERYWHERE,
        *SET_UPS,
        "set, a fraction for an integer",
        "a group shown and hidden",
        "a group shown and hidden, no fetch",
        "apply, a group that is hidden",
        "fetch by list, 5% loss, 100 ms",
    )
    with flying(vehicle) as link:
        code = suite.main([link, "--kind", "ardupilot"])
    printed = capsys.readouterr().out
    found = results(printed)
    assert set(found.values()) <= {"ok", "slower"}, printed
    assert len(found) == len(EVERYWHERE) + len(SET_UPS) + 6
    assert code == 0
    assert f"GRIP_ENABLE: {len(before)}, {len(before) + 2}, {len(before)} parameters" in printed
    assert vehicle.values == before


async def set_and_fail(session: Session) -> Measured:
    async with session.client() as vehicle:
        await session.journal.set(vehicle, "SDLOG_DIRS_MAX", 3)
        assert (await vehicle.get("SDLOG_DIRS_MAX")).value == 3
    raise RuntimeError("the check is broken")


async def set_and_be_interrupted(session: Session) -> Measured:
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


async def change_behind_its_back(session: Session) -> Measured:
    async with session.client() as vehicle:
        await vehicle.set("SDLOG_DIRS_MAX", 3)
    return Measured("done")


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


@pytest.mark.parametrize(
    ("endpoint", "arguments", "words"),
    [
        (px4(armed=True), [], "is armed"),
        (px4(), ["--kind", "ardupilot"], "the vehicle is px4, not ardupilot"),
        (Air([px4(), ArduPilotVehicle(table=ARDUPILOT_TABLE, system=2)]), [], "2 vehicles on this link"),
    ],
)
def test_the_live_checks_refuse_to_begin(
    endpoint: Vehicle | Air, arguments: Sequence[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicles = endpoint.vehicles if isinstance(endpoint, Air) else (endpoint,)
    with flying(endpoint) as link:
        assert suite.main([link, *arguments]) == 2
    assert words in capsys.readouterr().err
    for vehicle in vehicles:
        assert isinstance(vehicle, Vehicle)
        assert vehicle.requests["PARAM_SET"] == 0


def test_read_only_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle = px4(armed=True)
    having(monkeypatch, "set, INT32", "get by index")
    with flying(vehicle) as link:
        assert suite.main([link, "--read-only"]) == 0
    assert results(capsys.readouterr().out)["set, INT32"] == "skipped"
    assert vehicle.requests["PARAM_SET"] == 0


def test_without_a_link_it_says_how_to_call_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert suite.main([]) == 2
    assert "make live LINK=" in capsys.readouterr().err


def test_plain_pytest_collects_none_of_it() -> None:
    assert [*(Path(__file__).parent / "live").glob("*.py")]
    assert not [*(Path(__file__).parent / "live").glob("test_*.py")]


def test_only_what_nothing_uses_is_chosen() -> None:
    for vehicle, kind, many in ((px4(), "px4", 28), (ardupilot(), "ardupilot", 28)):
        choice = choose(kind, vehicle.params)
        assert len(choice.many) == many  # four of each channel from 9 to 15
        used = {
            name
            for name in choice.names
            for channel in (16, *range(1, 9))
            if name.startswith(f"RC{channel}_")
        }
        assert not used  # mapped or with an option, and those of pilots
    assert choose("generic", px4().params).names == ()
    assert choose("ardupilot", {}).names == ()


def test_values_that_a_vehicle_changes_itself_are_no_difference(tmp_path: Path) -> None:
    def param(name: str, value: int) -> Param:
        return Param(name, value, ParamType.INT32, 0, value)

    journal = Journal(tmp_path)
    journal.kind = "px4"
    journal.before = {
        "CAL_BARO1_ID": param("CAL_BARO1_ID", 0),
        "LND_FLIGHT_T_LO": param("LND_FLIGHT_T_LO", 1),
        "MAV_TYPE": param("MAV_TYPE", 2),
        "SYS_HITL": param("SYS_HITL", 0),
    }
    after = {
        "LND_FLIGHT_T_LO": param("LND_FLIGHT_T_LO", 5),
        "MAV_TYPE": param("MAV_TYPE", 1),
    }
    wrong, changed = journal.differences(after)
    assert wrong == ["MAV_TYPE was 2, is 1", "SYS_HITL was 0, is absent"]
    assert changed == ["CAL_BARO1_ID", "LND_FLIGHT_T_LO"]
    journal.kind = "ardupilot"
    assert not journal.appears_and_disappears("CAL_BARO1_ID")


# The relay's end towards the vehicle


def frame(message: wire.Message, *, system: int = 1, component: int = 1) -> bytes:
    return wire.encode(message, system=system, component=component, sequence=0)


HEARTBEAT = frame(wire.Heartbeat(2, wire.MAV_AUTOPILOT_PX4, 0, 0, 3))
ATTITUDE_ID = 30
LIST_REQUEST = frame(wire.ParamRequestList(1, 1), system=255, component=190)


def through(vehicle: RealVehicle, now: float = 1.0) -> list[bytes]:
    """What a perfect link delivers of what the vehicle has sent by now."""
    air = Air([vehicle], uplink=FaultyLink(), downlink=FaultyLink())
    air.tick(now)
    return air.data_to_send()


def test_a_stream_is_cut_into_frames() -> None:
    vehicle = RealVehicle(is_stream=True)
    data = HEARTBEAT * 3
    vehicle.take_data(data[:30], "peer", 0.5)
    vehicle.take_data(data[30:], "peer", 0.6)
    assert through(vehicle) == [HEARTBEAT] * 3


def test_a_datagram_stays_one() -> None:
    vehicle = RealVehicle(is_stream=False)
    vehicle.take_data(HEARTBEAT * 2, "peer", 0.5)
    assert through(vehicle) == [HEARTBEAT * 2]


def test_telemetry_is_left_out_on_request() -> None:
    attitude = bytearray(HEARTBEAT)
    attitude[7] = ATTITUDE_ID
    vehicle = RealVehicle(is_stream=False)
    vehicle.change(Conditions(drops_telemetry=True))
    vehicle.take_data(bytes(attitude), "peer", 0.5)
    vehicle.take_data(HEARTBEAT, "peer", 0.5)
    assert through(vehicle) == [HEARTBEAT]


def test_only_the_first_of_a_kind_is_lost() -> None:
    vehicle = RealVehicle(is_stream=False)
    vehicle.change(Conditions(loses_first=frozenset({21, wire.AUTOPILOT_VERSION_ID})))
    for _ in range(2):
        vehicle.receive(LIST_REQUEST, 0.5)
    assert vehicle.outgoing == [LIST_REQUEST]


def test_a_file_is_refused_in_the_place_of_the_vehicle() -> None:
    vehicle = RealVehicle(is_stream=False)
    vehicle.change(Conditions(refuses_files=True))
    for opcode in (Opcode.OPEN_FILE_RO, Opcode.TERMINATE_SESSION):
        request = wire.FileTransfer(0, 1, 1, Packet(7, 0, opcode, b"@PARAM/param.pck").pack())
        vehicle.receive(frame(request, system=255, component=190), 0.5)
    assert vehicle.outgoing == []
    answers = [
        wire.decode(each)
        for data in through(vehicle)
        for each in wire.Framer({110}, stream=False).receive(data)
    ]
    nak, ack = [Packet.unpack(each.payload) for each in answers if isinstance(each, wire.FileTransfer)]
    assert (nak.opcode, nak.requested, nak.sequence, nak.data) == (
        Opcode.NAK,
        Opcode.OPEN_FILE_RO,
        8,
        b"\x0a",
    )
    assert (ack.opcode, ack.requested) == (Opcode.ACK, Opcode.TERMINATE_SESSION)


def test_the_first_request_is_noted() -> None:
    vehicle = RealVehicle(is_stream=False)
    vehicle.take_request(HEARTBEAT, 0.5)
    assert vehicle.first_request_at is None
    vehicle.take_request(LIST_REQUEST, 0.7)
    vehicle.take_request(LIST_REQUEST, 0.9)
    assert vehicle.first_request_at == 0.7
