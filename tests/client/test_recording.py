"""Captures, with every frame of a link both ways, and the steps that a client logs."""

from __future__ import annotations

import io
import json
import logging
import subprocess
import sys
import time
from pathlib import Path

import anyio
import pytest

from paramclient import UsageError
from paramclient.cli.app import run
from paramclient.client import taps
from paramclient.links.tlog import TIME_MAX, TIME_STEP_MAX, Record, packed_time, read_records
from paramclient.sim import ArduPilotVehicle
from paramclient.wire import frames, messages, signing
from tests.caches import full_disk
from tests.client.conftest import connected, fetched
from tests.conversations.virtual import Puppet
from tests.shell import VALUES, FlakyLink, Tap, a_client, in_simulated_time, settled, small_px4

NOW = 1_700_000_000.0


def frame(number: int, *, system: int = 1) -> bytes:
    return messages.encode(
        messages.StatusText(6, f"line {number}"), system=system, component=1, sequence=number % 256
    )


def log_of(*frames: bytes, at: float = NOW) -> bytes:
    return b"".join(packed_time(at + number) + data for number, data in enumerate(frames))


def records(data: bytes) -> list[Record]:
    return list(read_records(io.BytesIO(data)))


def recorded(path: Path) -> list[messages.Message]:
    framer = frames.Framer(messages.DECODED_IDS, stream=False)
    found = [
        messages.decode(each) for record in records(path.read_bytes()) for each in framer.receive(record.data)
    ]
    assert framer.skipped == 0
    return [message for message in found if message is not None]


# reading


FRAMES = [frame(number) for number in range(5)]


@pytest.mark.parametrize("size", [1, 7, 64, 4096])
@pytest.mark.parametrize("place", [0, 2, 4])
def test_damage_costs_one_frame_in_any_blocks(size: int, place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("paramclient.links.tlog.BLOCK_SIZE", size)
    data = bytearray(log_of(*FRAMES))
    assert [each.data for each in records(bytes(data))] == FRAMES
    data[(8 + len(FRAMES[0])) * place + 1] ^= 0x01  # the time, by nine years
    found = records(bytes(data))
    assert [each.data for each in found] == FRAMES[:place] + FRAMES[place + 1 :]
    assert all(each.at < NOW + 5 for each in found)
    torn = log_of(*FRAMES[:2])[:-5] + b"\xfd" * 3 + log_of(*FRAMES[2:])
    assert [each.data for each in (records(torn)[0], records(torn)[-1])] == [FRAMES[0], FRAMES[4]]
    for missing in range(1, 12):
        assert [each.data for each in records(log_of(*FRAMES)[:-missing])] == FRAMES[:4]


@pytest.mark.parametrize(
    ("first", "second"),
    [(20.0, NOW), (315_964_800.0, NOW), (NOW, 315_964_800.0), (NOW, NOW - TIME_STEP_MAX - 10), (20.0, 30.0)],
    ids=["set from 1970", "set from 1980", "lost", "joined", "never set"],
)
@pytest.mark.parametrize("behind", [2, 9])
def test_a_clock_that_is_set_costs_no_frame(first: float, second: float, behind: int) -> None:
    frames = [frame(number) for number in range(3 + behind)]
    found = records(log_of(*frames[:3], at=first) + log_of(*frames[3:], at=second))
    assert [each.data for each in found] == frames
    assert (found[0].at, found[3].at) == (first, second)


def test_no_frame_is_later_than_the_latest_time() -> None:
    """Not in many steps either: dates end with the year 9999."""
    step = TIME_STEP_MAX - 1
    data = b"".join(packed_time(TIME_MAX - step + number * step) + frame(number) for number in range(9))
    assert [each.at for each in records(data)] == [TIME_MAX - step, TIME_MAX]


# writing


async def test_frames_of_both_directions_are_written(tmp_path: Path) -> None:
    vehicle = Tap(small_px4())
    path = tmp_path / "flight.tlog"
    before = time.time()
    async with fetched(vehicle, tlog=path) as (client, component):
        await component.set("PARAM_01", 5)
        received = client.bytes_received
    written = records(path.read_bytes())
    ours = [each for each in written if each.data[5] == 255]
    assert [each.data for each in ours] == [wire_frame(each) for each in vehicle.received]
    assert sum(len(each.data) for each in ours) == client.bytes_sent
    assert sum(len(each.data) for each in written) - sum(len(each.data) for each in ours) == received
    assert [each.at for each in written] == sorted(each.at for each in written)
    assert before - 0.001 <= written[0].at <= written[-1].at <= time.time()
    said = recorded(path)
    assert {each.param_id for each in said if isinstance(each, messages.ParamValue)} >= VALUES.keys()
    assert [each.param_id for each in said if isinstance(each, messages.ParamSet)] == ["PARAM_01"]


def wire_frame(received: tuple[float, frames.Frame, messages.Message]) -> bytes:
    _, each, message = received
    return messages.encode(
        message, system=each.system, component=each.component, sequence=each.sequence, version=each.version
    )


def test_pymavlink_reads_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"

    @in_simulated_time
    async def session() -> None:
        async with a_client(ArduPilotVehicle(ftp=False), tlog=path) as client:
            await (await client.component()).fetch_all()

    session()
    program = f"""
import json
from pymavlink import mavutil
log = mavutil.mavlink_connection({str(path)!r})
found = []
while (message := log.recv_match()) is not None:
    found.append((message.get_type(), message.get_srcSystem(), message._timestamp))
print(json.dumps(found))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, timeout=60)
    theirs = json.loads(done.stdout)
    ours = records(path.read_bytes())
    framer = frames.Framer(stream=False)
    names = [frames.message_name(each.message_id) for record in ours for each in framer.receive(record.data)]
    assert [name for name, _, _ in theirs] == names
    assert names.count("PARAM_VALUE") >= 1382
    # its last two bits of the time are the number of a link
    assert [at for _, _, at in theirs] == pytest.approx([each.at for each in ours], abs=5e-6)


def test_the_command_writes_logs_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.tlog"
    assert run(["get", "sim:px4", "MC_ROLL_P", "--no-cache", "--tlog", str(path)]) == 0
    assert [one.param_id for one in recorded(path) if isinstance(one, messages.ParamValue)] == ["MC_ROLL_P"]
    assert run(["get", "sim:px4", "MC_ROLL_P", "--no-cache", "--tlog", str(path)]) == 2
    assert "flight.tlog exists" in capsys.readouterr().err
    assert run(["link", "sim:px4", "--seconds", "0.5", "--tlog", str(tmp_path / "link.tlog")]) == 0
    assert recorded(tmp_path / "link.tlog")
    assert run(["link", "sim:px4", "--seconds", "1e-9"]) == 3, "nothing was heard in that time"


async def test_no_key_and_no_signature_is_in_the_log(tmp_path: Path) -> None:
    """As the guide to message signing asks: a log is passed on, and a key is not."""
    key = signing.SigningKey(bytes(range(32)))
    path = tmp_path / "signed.tlog"
    vehicle = Tap(small_px4(signing_key=key, usb=True))
    async with connected(vehicle, tlog=path, signing=key) as (_, component):
        await component.get("PARAM_01")
        await component.setup_signing(signing.SigningKey(bytes(range(1, 33))), link_is_safe=True)
    assert any(isinstance(message, messages.SetupSigning) for _, _, message in vehicle.received)
    written = records(path.read_bytes())
    assert {each.data[2] for each in written} == {0}, "no frame says that it is signed"
    framer = frames.Framer(stream=False)
    assert [len(framer.receive(each.data)) for each in written] == [1] * len(written)
    assert not any(isinstance(each, messages.SetupSigning) for each in recorded(path))
    assert any(isinstance(each, messages.ParamValue) for each in recorded(path))
    assert bytes(range(1, 33)) not in path.read_bytes()


async def test_a_log_that_exists_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"precious")
    vehicle = small_px4()
    with pytest.raises(UsageError, match=r"flight\.tlog exists"):
        async with a_client(vehicle, tlog=path):
            raise AssertionError("it was opened")
    assert path.read_bytes() == b"precious"
    with pytest.raises(UsageError, match="cannot be created: No such file or directory"):
        async with a_client(vehicle, tlog=tmp_path / "nowhere" / "flight.tlog"):
            raise AssertionError("it was opened")


async def test_full_disk_ends_log_and_nothing_else(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "flight.tlog"
    with full_disk(300):
        async with connected(small_px4(), tlog=path) as (_, component):
            await anyio.sleep(1.0)
            assert (await component.fetch_all()).complete
            await anyio.sleep(5.0)
            assert (await component.get("PARAM_01")).value == 1
    assert [record.name for record in caplog.records] == ["paramclient.client.taps"], caplog.text
    assert f"the telemetry log {path} ends here: File too large" in caplog.text
    assert recorded(path)  # whole frames, and nothing behind them


async def test_a_slow_disk_ends_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(taps, "UNWRITTEN_BYTES_MAX", 1000)
    path = tmp_path / "flight.tlog"
    async with a_client(small_px4(), tlog=path) as client:
        assert (await (await client.component()).fetch_all()).complete
    assert "the disk is slower than the link" in caplog.text
    assert len(path.read_bytes()) <= 1000


async def test_a_stream_that_drops_is_not_continued(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    vehicle = Puppet(lambda message: (), heartbeat=None)
    vehicle.say_bytes(frame(1)[:9])
    link = FlakyLink(vehicle)
    link.is_stream = True
    async with a_client(link, tlog=path) as client:
        await settled()
        await link.drop()
        vehicle.say_bytes(frame(2))
        await anyio.sleep(2.0)
        assert link.openings == 2
        assert client.bytes_received
    assert [each.text for each in recorded(path) if isinstance(each, messages.StatusText)] == ["line 2"]


def test_the_command_logs_its_steps(capsys: pytest.CaptureFixture[str]) -> None:
    level = logging.getLogger("paramclient").level
    for option, code, name in (("-v", 0, "MC_ROLL_P"), ("--verbose", 2, "BAD\x1b[31m")):
        assert run(["get", "sim:px4", name, "--no-cache", option]) == code
        reported = capsys.readouterr()
        assert "ParamRequestRead" in reported.err or code
        assert "ParamRequestRead" not in reported.out
        assert "\x1b" not in reported.err
        assert logging.getLogger("paramclient").level == level
