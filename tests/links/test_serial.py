"""Serial links over pseudo-terminals: sessions, unplugging, stalled ports, ports that cannot be opened."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import struct
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import anyio
import anyio.lowlevel
import pytest
import serialx

from paramclient.errors import LinkError, UsageError
from paramclient.links import Link, Peer, create_link, link, serial
from paramclient.links.serial import open_asyncio
from tests.cable import TIMEOUT, Cable
from tests.links.test_links import HEARTBEAT, opened
from tests.shell import a_client, bits, generic, until

pytestmark = pytest.mark.asyncio
RATE = 40_000.0
"""Bytes per second in each direction. With 57600 baud (5,760 bytes per second), tests would take seconds."""


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[Cable]:
    with Cable(tmp_path) as cable:
        yield cable


@pytest.fixture(params=["descriptor", "asyncio"])
def port(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both implementations; the second is that of Windows, which also works here."""
    if request.param == "asyncio":
        monkeypatch.setattr(serial, "open_port", open_asyncio)
    return str(request.param)


async def refusal(link: Link) -> LinkError:
    with pytest.raises(LinkError) as caught:
        await link.open()
    assert "closed" in repr(link)
    return caught.value


# Complete sessions


async def test_unplugged_during_a_download(cable: Cable, port: str, caplog: pytest.LogCaptureFixture) -> None:
    vehicle = generic(burst=1, period=0.03, stream=True)
    async with asyncio.timeout(TIMEOUT), a_client(cable.link) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(partial(cable.carry, vehicle, rate=RATE))
        component = await client.component()
        changes = component.changes()
        fetch = asyncio.create_task(component.fetch_all())
        await anext(changes)
        cable.pull_out()
        await until(lambda: " reconnecting, " in repr(client))
        assert not fetch.done()
        cable.plug_in()
        tasks.start_soon(partial(cable.carry, vehicle, rate=RATE))
        result = await fetch
        assert result.complete
        assert bits(result.params) == bits(vehicle.params)
        assert (await component.set("PARAM_01", 77)).status == "accepted"
        tasks.cancel_scope.cancel()
    name = "paramclient.client.link_task"
    [warning] = [record.getMessage() for record in caplog.records if record.name == name]
    assert warning.startswith(f"{cable.link}: lost {cable.device}: unplugged, or ")


# The link


async def test_a_stalled_device_is_lost(cable: Cable, port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "STALL_TIMEOUT", 0.0)  # leaves the time for a full buffer at the baud rate
    async with opened(cable.link) as link, anyio.create_task_group() as tasks:
        got: list[tuple[Peer, bytes]] = []
        failures: list[LinkError] = []

        async def receive() -> None:
            try:
                while True:
                    got.extend(await link.receive())
            except LinkError as error:
                failures.append(error)

        tasks.start_soon(receive)
        sent = 0
        with pytest.raises(LinkError, match=f"{cable.device} has accepted no data for 0 s") as caught:  # noqa: PT012
            while True:  # until the operating system's buffer is full
                await link.send(bytes(1000), None)
                sent += 1000
                if sent == 5000:
                    cable.send(b"still here")
        assert 5000 < sent < 60_000  # Linux' buffer for a pseudo-terminal, and no queue in the link
        await until(lambda: failures)
        assert str(failures[0]) == str(caught.value)
        assert b"".join(data for _, data in got) == b"still here"
        cable.drain()
        await link.open()
        await link.send(HEARTBEAT, None)
        assert cable.recv(100_000) == HEARTBEAT


# Ports that cannot be opened


async def test_an_open_port_is_exclusive_and_closing_frees_it(cable: Cable) -> None:
    def is_exclusive() -> bool:
        try:
            file = os.open(cable.device, os.O_RDWR | os.O_NOCTTY)
        except OSError as error:
            return error.errno == errno.EBUSY
        try:  # privileged programs can open and inspect it
            # TIOCGEXCL of Linux, asm-generic/ioctls.h; termios has no name for it
            (flag,) = struct.unpack("i", fcntl.ioctl(file, 0x80045440, bytes(4)))
        finally:
            os.close(file)
        return bool(flag)

    async with opened(cable.link) as link:
        assert is_exclusive()
        error = await refusal(create_link(cable.link))
        assert f"{cable.link}: {cable.device} is in use by another link or program" in str(error)
        await link.send(HEARTBEAT, None)
        assert cable.recv(100) == HEARTBEAT
    assert not is_exclusive()
    async with opened(cable.link):
        pass


@pytest.mark.parametrize("name", ["", "file", "missing"])
async def test_files_that_are_not_ports(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / name
    expected = f"{path} does not exist." if name == "missing" else f"{path} is not a serial port."
    assert expected in str(await refusal(create_link(f"serial:{path}")))


async def test_an_unsupported_baud_rate(cable: Cable, port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise serialx.UnsupportedSetting("Unsupported baudrate")

    monkeypatch.setattr(serialx.Serial, "_reconfigure_port", refuse)
    with pytest.raises(UsageError, match="this system does not support 115200 baud"):
        await create_link(cable.link).open()


async def test_opening_a_stalled_driver_times_out(cable: Cable, monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that opens later is closed again."""
    monkeypatch.setattr(link, "OPEN_TIMEOUT", 0.5)  # in which a busy computer starts a thread
    may_go_on, is_closed = threading.Event(), threading.Event()
    open_it, close_it = serialx.Serial.open, serialx.Serial.close

    def stalled(port: serialx.Serial) -> None:
        assert may_go_on.wait(TIMEOUT)
        open_it(port)

    def closing(port: serialx.Serial) -> None:
        close_it(port)
        is_closed.set()

    monkeypatch.setattr(serialx.Serial, "open", stalled)
    monkeypatch.setattr(serialx.Serial, "close", closing)
    assert f"{cable.device} did not open within " in str(await refusal(create_link(cable.link)))
    may_go_on.set()
    assert await anyio.to_thread.run_sync(is_closed.wait, TIMEOUT)
