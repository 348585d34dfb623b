"""External faults of links: network outages, changed addresses, event loops of other systems."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from collections.abc import Callable
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from paramclient.errors import LinkError
from paramclient.links import Link, create_link, serve_endpoint
from tests.cable import TIMEOUT
from tests.links.test_links import HEARTBEAT, udp_socket
from tests.shell import a_client, bits, generic


@pytest.fixture
def errors(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[int]]:
    """The errors that the next calls of sockets raise, by the name of the call."""
    errors: dict[str, list[int]] = {"sendto": [], "recvfrom_into": []}
    real = socket.socket

    def faulty(call: str) -> Callable[..., object]:
        def called(sock: socket.socket, *arguments: Any) -> object:
            if errors[call]:
                number = errors[call].pop(0)
                raise OSError(number, os.strerror(number))
            return getattr(real, call)(sock, *arguments)

        return called

    calls = {call: faulty(call) for call in errors}
    monkeypatch.setattr(socket, "socket", type("Faulty", (socket.socket,), calls))
    return errors


async def failure(link: Link) -> LinkError:
    with anyio.fail_after(TIMEOUT), pytest.raises(LinkError) as caught:  # noqa: PT012 - received data precedes it
        while True:
            await link.receive()
    return caught.value


@pytest.mark.asyncio
async def test_an_outage_loses_only_sent_datagrams(errors: dict[str, list[int]]) -> None:
    with udp_socket() as vehicle:
        link: Any = create_link(f"udpout:127.0.0.1:{vehicle.getsockname()[1]}")
        await link.open()
        errors["sendto"].append(errno.ENETDOWN)
        await link.send(b"lost", None)
        await link.send(b"1", None)
        assert vehicle.recv(10) == b"1"
        await link.close()


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
@pytest.mark.asyncio
async def test_a_failed_socket_is_reopened(kind: str, errors: dict[str, list[int]]) -> None:
    """For every error of the operating system; delayed errors of earlier datagrams are skipped."""
    with udp_socket() as far:
        port = far.getsockname()[1]
        link: Any = create_link("udpin:127.0.0.1:0" if kind == "udpin" else f"udpout:127.0.0.1:{port}")
        await link.open()
        errors["recvfrom_into"] += [errno.ECONNRESET, errno.ECONNREFUSED, errno.ENETRESET]
        far.sendto(HEARTBEAT, link.address)
        assert [data for _, data in await link.receive()] == [HEARTBEAT]
        errors["recvfrom_into"].append(errno.EIO)
        far.sendto(HEARTBEAT, link.address)
        assert "cannot receive: Input/output error" in str(await failure(link))
        assert link.reconnects
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
