"""External faults of links: network outages, changed addresses, event loops of other systems."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from paramclient.errors import LinkError
from paramclient.links import Link, create_link, serve_endpoint
from paramclient.wire import messages
from tests.cable import TIMEOUT
from tests.shell import a_client, bits, generic

HEARTBEAT = messages.encode(messages.Heartbeat(6, 8), system=255, component=190, sequence=0)
GONE = [errno.ENETDOWN, errno.ENETUNREACH, errno.EADDRNOTAVAIL, errno.EINVAL]


class Net:
    """A network that can be disconnected; then sending a datagram fails with the given error."""

    reason: int | None = None

    def check(self) -> None:
        if self.reason is not None:
            raise OSError(self.reason, os.strerror(self.reason))


@pytest.fixture
def net(monkeypatch: pytest.MonkeyPatch) -> Net:
    """The network of all sockets."""
    net = Net()

    class Socket(socket.socket):
        def send(self, *arguments: Any) -> int:
            net.check()
            return super().send(*arguments)

        def sendto(self, *arguments: Any) -> int:
            net.check()
            return super().sendto(*arguments)

    monkeypatch.setattr(socket, "socket", Socket)
    return net


def listening(host: str = "127.0.0.1", port: int = 0) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((host, port))
    sock.settimeout(TIMEOUT)
    return sock


async def failure(link: Link) -> LinkError:
    with anyio.fail_after(TIMEOUT), pytest.raises(LinkError) as caught:  # noqa: PT012 - received data precedes it
        while True:
            await link.receive()
    return caught.value


# Network outages


@pytest.mark.parametrize("reason", GONE)
@pytest.mark.asyncio
async def test_a_short_network_outage_loses_only_sent_datagrams(net: Net, reason: int) -> None:
    with listening() as vehicle:
        link: Any = create_link(f"udpout:127.0.0.1:{vehicle.getsockname()[1]}")
        await link.open()
        for number in range(3):
            net.reason = reason
            await link.send(b"lost", None)
            net.reason = None
            await link.send(bytes([number]), None)
            assert vehicle.recv(10) == bytes([number])
        await link.close()


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
@pytest.mark.asyncio
async def test_a_failed_socket_is_reopened(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """For every error of the operating system; delayed errors of earlier datagrams are skipped."""
    script: list[int] = []

    class Faulty(socket.socket):
        def recvfrom_into(self, *arguments: Any) -> Any:
            if script:
                number = script.pop(0)
                raise OSError(number, os.strerror(number))
            return super().recvfrom_into(*arguments)

    with listening() as far, monkeypatch.context() as patch:
        patch.setattr(socket, "socket", Faulty)
        port = far.getsockname()[1]
        link: Any = create_link("udpin:127.0.0.1:0" if kind == "udpin" else f"udpout:127.0.0.1:{port}")
        assert link.reconnects
        await link.open()
        script += [errno.ECONNRESET, errno.ECONNREFUSED, errno.ENETRESET]
        far.sendto(HEARTBEAT, link.address)
        [(_, data)] = await link.receive()
        assert data == HEARTBEAT
        script.append(errno.EIO)
        far.sendto(HEARTBEAT, link.address)
        assert "cannot receive: Input/output error" in str(await failure(link))
        await link.open()
        far.sendto(HEARTBEAT, link.address)
        assert [data for _, data in await link.receive()] == [HEARTBEAT]
        await link.close()


# Event loops without socket readiness, as on Windows


class BlindLoop(asyncio.SelectorEventLoop):
    """A loop without `add_reader`; anyio then waits for sockets in a thread of its own."""


def not_there(*_: object) -> None:
    raise NotImplementedError


for name in ("add_reader", "add_writer", "remove_reader", "remove_writer"):
    setattr(BlindLoop, name, not_there)


@pytest.mark.parametrize(("ours", "theirs"), [("udpin", "udpout"), ("tcpin", "tcp"), ("tcp", "tcpin")])
def test_a_session_on_a_loop_without_socket_readiness(ours: str, theirs: str) -> None:
    async def session() -> None:
        vehicle = generic(stream="tcp" in ours, burst=50, period=0.001)
        with anyio.fail_after(TIMEOUT):
            async with anyio.create_task_group() as tasks:
                client = a_client(f"{ours}:127.0.0.1:0") if ours.endswith("in") else None
                if client is None:
                    far: Any = create_link(f"{theirs}:127.0.0.1:0")
                    await tasks.start(serve_endpoint, vehicle, far)
                    client = a_client(f"{ours}:127.0.0.1:{far.address[1]}")
                async with client:
                    if ours.endswith("in"):
                        link: Any = client.link
                        there = create_link(f"{theirs}:127.0.0.1:{link.address[1]}")
                        tasks.start_soon(serve_endpoint, vehicle, there)
                    component = await client.component()
                    assert (await component.fetch_all()).complete
                    assert bits(component.params) == bits(vehicle.params)
                    tasks.cancel_scope.cancel()

    with asyncio.Runner(loop_factory=BlindLoop) as runner:
        runner.run(session())
