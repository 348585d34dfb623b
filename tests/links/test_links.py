"""Links: sockets on loopback, simulated vehicles in the process."""

from __future__ import annotations

import errno
import os
import selectors
import socket
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from paramclient.errors import LinkError
from paramclient.links import Link, Peer, create_link, link, sockets
from paramclient.wire import messages
from tests.cable import TIMEOUT, Cable

pytestmark = pytest.mark.asyncio
HEARTBEAT = messages.encode(messages.Heartbeat(6, 8), system=255, component=190, sequence=0)


def frame(number: int) -> bytes:
    """Return a PARAM_VALUE with this index."""
    value = messages.ParamValue("SYS_AUTOSTART", bytes(4), 6, 2000, number)
    return messages.encode(value, system=1, component=1, sequence=number % 256)


def open_files() -> int:
    return len(os.listdir("/dev/fd"))  # noqa: PTH208 - numbers, not paths


async def collect(link: Link, count: int) -> list[tuple[Peer, bytes]]:
    """Receive until this many chunks have arrived."""
    found: list[tuple[Peer, bytes]] = []
    with anyio.fail_after(TIMEOUT):
        while len(found) < count:
            found += await link.receive()
    return found


@asynccontextmanager
async def opened(name: str) -> AsyncIterator[Any]:
    """Open a link. `Any`, because tests also use attributes of single kinds."""
    link = create_link(name)
    await link.open()
    try:
        with anyio.fail_after(TIMEOUT):
            yield link
    finally:
        await link.close()


@contextmanager
def udp_socket(to: tuple[str, int] | None = None, *, host: str = "127.0.0.1") -> Iterator[socket.socket]:
    """The remote side on UDP: a blocking socket with its own port, connected if an address is given."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((host, 0))
        sock.settimeout(TIMEOUT)
        if to is not None:
            sock.connect(to)
        yield sock


@contextmanager
def tcp_listener(backlog: int = 8) -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0), backlog=backlog) as listener:
        listener.settimeout(TIMEOUT)
        yield listener


def ipv6_works() -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
            sock.bind(("::1", 0))
    except OSError:
        return False
    return True


@asynccontextmanager
async def connected(kind: str) -> AsyncIterator[tuple[Any, Any]]:
    """Open a link of a kind and its remote side, after both have exchanged data."""
    name = f"{kind}:127.0.0.1:0"
    far: Any = None
    other: Any = None
    with ExitStack() as stack:
        if kind == "serial":
            far = stack.enter_context(Cable(Path(stack.enter_context(TemporaryDirectory()))))
            name = far.link
        elif kind in ("udpout", "tcp"):
            other = stack.enter_context(udp_socket() if kind == "udpout" else tcp_listener())
            name = f"{kind}:127.0.0.1:{other.getsockname()[1]}"
        async with opened(name) as link:
            match kind:
                case "udpin":
                    far = stack.enter_context(udp_socket(link.address))
                case "udpout":
                    (far := other).connect(link.address)
                case "tcp":
                    far = stack.enter_context(other.accept()[0])
                case "tcpin":
                    far = stack.enter_context(socket.create_connection(link.address, timeout=TIMEOUT))
            far.send(HEARTBEAT)
            await collect(link, 1)
            yield link, far


def stream_of(far: Any, size: int) -> bytes:
    """Receive this many bytes, and all data of the last receive; a stream may split them anywhere."""
    received = b""
    while len(received) < size:
        received += far.recv(1000)
    return received


KINDS = ["udpin", "udpout", "tcp", "tcpin", "serial"]


# All kinds of links


@pytest.mark.parametrize("kind", KINDS)
async def test_bytes_in_both_directions(kind: str) -> None:
    async with connected(kind) as (link, far):
        assert repr(link).endswith("open>")
        far.send(frame(1))
        [(peer, data)] = await collect(link, 1)
        assert data == frame(1)
        await link.send(frame(2), peer)
        await link.send(frame(3), "nobody")
        await link.send(frame(4), None)
        if link.is_stream:
            assert stream_of(far, len(frame(2) + frame(4))) == frame(2) + frame(4)
        else:
            assert [far.recv(1000), far.recv(1000)] == [frame(2), frame(4)]


@pytest.mark.parametrize("kind", KINDS)
async def test_closing_wakes_receiver_and_sender_and_frees_the_port(kind: str) -> None:
    files = open_files()
    async with connected(kind) as (link, _), anyio.create_task_group() as tasks:
        failures: list[LinkError] = []
        address: Any = getattr(link, "address", None)

        async def fail(call: Awaitable[object]) -> None:
            with pytest.raises(LinkError, match="closed") as caught:
                await call
            failures.append(caught.value)

        waiting = [link.receive(), *([link.send(bytes(50_000_000), None)] if link.is_stream else [])]
        for each in waiting:
            tasks.start_soon(fail, each)
        for _ in range(10):  # the simulated vehicle keeps tasks running
            await anyio.lowlevel.checkpoint()
        await link.close()
        with anyio.fail_after(TIMEOUT):
            while len(failures) < len(waiting):
                await anyio.lowlevel.checkpoint()
        assert {each.link for each in failures} == {link.name}
        await link.close()
        for call in (link.receive(), link.send(HEARTBEAT, None)):
            with pytest.raises(LinkError, match="not open"):
                await call
        if kind in ("udpin", "tcpin"):
            async with opened(f"{kind}:127.0.0.1:{address[1]}") as again:
                assert again.address == address
    assert open_files() == files


@pytest.mark.parametrize("kind", KINDS)
async def test_a_cancelled_receive_loses_nothing(kind: str) -> None:
    steps = 6
    sent: list[bytes] = []
    got: list[bytes] = []
    async with connected(kind) as (link, far):

        async def receive() -> None:
            got.extend(data for _, data in await link.receive())

        for before in range(steps):
            for after in range(steps):
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(receive)
                    for _ in range(before):
                        await anyio.lowlevel.checkpoint()
                    sent.append(frame(len(sent)))
                    far.send(sent[-1])
                    for _ in range(after):
                        await anyio.lowlevel.checkpoint()
                    tasks.cancel_scope.cancel()
        with anyio.fail_after(TIMEOUT):
            while len(b"".join(got)) < len(b"".join(sent)):
                await receive()
    assert b"".join(got) == b"".join(sent)


# UDP


@pytest.mark.parametrize("host", ["127.0.0.1", *(["::1"] if ipv6_works() else [])])
async def test_udpin_and_udpout_communicate(host: str) -> None:
    shown = f"[{host}]" if ":" in host else host
    async with (
        opened(f"udpin:{shown}:0") as station,
        opened(f"udpout:{shown}:{station.address[1]}") as vehicle,
    ):
        await vehicle.send(HEARTBEAT, None)
        peer: Any
        far: Any
        [(peer, data)] = await collect(station, 1)
        assert (data, peer[:2]) == (HEARTBEAT, (host, vehicle.address[1]))
        await station.send(frame(1), peer)
        [(far, data)] = await collect(vehicle, 1)
        assert (data, far[:2], host) == (frame(1), station.address, station.address[0])
        await vehicle.send(frame(2), far)
        assert await collect(station, 1) == [(peer, frame(2))]


@pytest.mark.parametrize("kind", ["udpin", "udpout", "tcp", "tcpin"])
async def test_an_unknown_host_is_a_link_error(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async def getaddrinfo(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(anyio, "getaddrinfo", getaddrinfo)
    with pytest.raises(LinkError, match="host no-such-host not found: Name or service") as caught:
        await create_link(f"{kind}:no-such-host:14550").open()
    assert isinstance(caught.value.__cause__, socket.gaierror)


async def test_udpin_sends_to_every_known_vehicle() -> None:
    async with opened("udpin:127.0.0.1:0") as link:
        await link.send(HEARTBEAT, None)
        to = link.address
        with udp_socket(to) as one, udp_socket(to) as two, udp_socket(to) as odd:
            sent = {one: frame(1), two: frame(1)[7:] + frame(2), odd: bytes(600) + frame(2)}
            for sock, data in sent.items():
                sock.send(data)
            assert dict(await collect(link, 3)) == {sock.getsockname(): data for sock, data in sent.items()}
            await link.send(frame(3), None)
            await link.send(frame(4), two.getsockname())
            assert [each.recv(1000) for each in (one, two, two)] == [frame(3), frame(3), frame(4)]
            for sock in (one, two, odd):
                sock.setblocking(False)
                with pytest.raises(BlockingIOError):
                    sock.recv(1000)


async def test_udpin_forgets_no_vehicle_for_senders_of_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "PEERS_MAX", 2)
    async with opened("udpin:127.0.0.1:0") as link:
        with udp_socket(link.address) as one, ExitStack() as others:
            one.send(frame(1))
            await collect(link, 1)
            await link.send(frame(2), None)
            for _ in range(3):
                others.enter_context(udp_socket(link.address)).send(b"noise")
            await collect(link, 3)
            await link.send(frame(3), None)
            assert [one.recv(1000), one.recv(1000)] == [frame(2), frame(3)]


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
async def test_a_port_in_use_is_a_link_error_until_it_is_free(kind: str) -> None:
    async with opened(f"{kind}:127.0.0.1:0") as first:
        second = create_link(f"{kind}:127.0.0.1:{first.address[1]}")
        files = open_files()
        with pytest.raises(
            LinkError, match=f"port {first.address[1]} is in use by another link or program"
        ) as caught:
            await second.open()
        assert isinstance(caught.value.__cause__, OSError)
        assert caught.value.__cause__.errno == errno.EADDRINUSE
        assert caught.value.link == second.name
        assert open_files() == files
        await first.close()
        await second.open()
        await second.close()


async def test_udpout_receives_only_from_its_target_and_keeps_its_port() -> None:
    with udp_socket() as vehicle:
        async with opened(f"udpout:127.0.0.1:{vehicle.getsockname()[1]}") as link:
            address = ("127.0.0.1", link.address[1])
            async with opened(link.name) as other:
                assert other.address[1] != link.address[1]
            with udp_socket(address) as stranger:
                await link.send(frame(1), None)
                assert vehicle.recvfrom(1000) == (frame(1), address)
                stranger.send(frame(2))
                vehicle.sendto(frame(3), address)
                assert await collect(link, 1) == [(vehicle.getsockname(), frame(3))]
                await link.send(frame(4), stranger.getsockname())
                await link.send(frame(5), None)
                assert vehicle.recvfrom(1000) == (frame(5), address)


async def test_udpout_may_start_before_its_vehicle() -> None:
    with udp_socket() as free:
        address = free.getsockname()
    async with opened(f"udpout:127.0.0.1:{address[1]}") as link:
        await link.send(frame(1), None)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
            vehicle.bind(address)
            vehicle.settimeout(TIMEOUT)
            await link.send(frame(2), None)  # must not be lost with the error of the first
            assert vehicle.recv(1000) == frame(2)
            vehicle.sendto(frame(3), link.address)
            assert [data for _, data in await collect(link, 1)] == [frame(3)]


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
async def test_a_burst_waits_for_a_late_reader(kind: str) -> None:
    count = 2000
    async with connected(kind) as (link, far):
        got: list[bytes] = []
        async with anyio.create_task_group() as tasks:

            async def receive() -> None:
                while True:
                    got.extend(data for _, data in await link.receive())

            tasks.start_soon(receive)
            await anyio.wait_all_tasks_blocked()
            for number in range(count):
                far.send(frame(number))
            time.sleep(0.1)  # noqa: ASYNC251 - blocks the event loop on purpose
            # If the system grants a smaller buffer, the datagrams that fit must still be received.
            whole = link.receive_buffer >= sockets.RECEIVE_BUFFER
            expected = count if whole else min(count, link.receive_buffer // 1280)
            with anyio.fail_after(TIMEOUT):
                while len(got) < expected:
                    await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()
    assert got[:expected] == [frame(number) for number in range(expected)]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("udpin:192.0.2.1:0", r"192\.0\.2\.1 is not an address of this computer"),
        ("udpout:[fe80::1]:14550", "cannot open: "),
        ("tcp:255.255.255.255:5760", "no route to 255.255.255.255:5760: .* in the network of the vehicle"),
    ],
)
async def test_an_unreachable_address_is_a_link_error(name: str, text: str) -> None:
    files = open_files()
    with pytest.raises(LinkError, match=text) as caught:
        await create_link(name).open()
    assert isinstance(caught.value.__cause__, OSError)
    assert open_files() == files


# TCP


async def test_tcp_opens_after_a_refused_connection() -> None:
    with tcp_listener() as listener:
        port = listener.getsockname()[1]
    link = create_link(f"tcp:127.0.0.1:{port}")
    files = open_files()
    with pytest.raises(LinkError, match=f"connection refused by 127.0.0.1:{port}") as caught:
        await link.open()
    assert isinstance(caught.value.__cause__, ConnectionRefusedError)
    assert open_files() == files
    with socket.create_server(("127.0.0.1", port)):
        await link.open()
        await link.close()


@contextmanager
def deaf_listener() -> Iterator[int]:
    """A port on which connecting never ends: its backlog is full and is never accepted."""
    with tcp_listener(backlog=0) as listener, ExitStack() as stack:
        for _ in range(4):
            sock = stack.enter_context(socket.socket())
            sock.setblocking(False)
            sock.connect_ex(listener.getsockname())
        yield listener.getsockname()[1]


async def test_tcp_connecting_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "OPEN_TIMEOUT", 0.05)
    with deaf_listener() as port:
        files = open_files()
        with pytest.raises(LinkError, match=r"no response from 127\.0\.0\.1"):
            await create_link(f"tcp:127.0.0.1:{port}").open()
        assert open_files() == files


async def test_closing_ends_an_open_in_progress() -> None:
    failures: list[str] = []

    async def open_it(link: Link) -> None:
        with pytest.raises(LinkError) as caught:
            await link.open()
        failures.append(str(caught.value))

    with deaf_listener() as port:
        files = open_files()
        link = create_link(f"tcp:127.0.0.1:{port}")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(open_it, link)
            await anyio.wait_all_tasks_blocked()
            assert open_files() == files + 1
            await link.close()
        assert open_files() == files
    assert ["closed" in failure for failure in failures] == [True]


async def test_each_address_of_a_name_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    async def getaddrinfo(host: str, port: int, **_: object) -> list[Any]:
        return [(socket.AF_INET, 0, 0, "", (each, port)) for each in ("127.0.0.9", "127.0.0.1")]

    monkeypatch.setattr(anyio, "getaddrinfo", getaddrinfo)
    with tcp_listener() as listener:
        async with opened(f"tcp:some-vehicle:{listener.getsockname()[1]}") as link:
            far, _ = listener.accept()
            with far:
                far.send(frame(1))
                assert [data for _, data in await collect(link, 1)] == [frame(1)]


async def test_a_dropped_tcp_connection_can_be_reopened() -> None:
    with tcp_listener() as listener:
        async with opened(f"tcp:127.0.0.1:{listener.getsockname()[1]}") as link:
            peers = []
            for leave in (socket.socket.close, reset):
                far, _ = listener.accept()
                far.send(frame(1))
                [(peer, data)] = await collect(link, 1)
                assert data == frame(1)
                peers.append(peer)
                leave(far)
                with pytest.raises(LinkError, match=r"closed by 127\.0\.0\.1:|to 127\.0\.0\.1:\d+ lost"):
                    await collect(link, 1)
                with pytest.raises(LinkError, match="not open"):
                    await link.send(frame(2), None)
                await link.open()
            await link.send(frame(3), peers[0])  # to a dropped connection: does nothing
            listener.accept()[0].close()
            assert peers[0] != peers[1]


def reset(sock: socket.socket) -> None:
    """Close a connection with a reset, so that the peer gets an error."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.close()


async def test_tcp_drops_a_peer_that_does_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "SEND_TIMEOUT", 0.05)
    problem = r"the peer has not read any data for 0\.05 s"
    async with connected("tcp") as (link, _), anyio.create_task_group() as tasks:

        async def receive() -> None:
            with pytest.raises(LinkError, match=problem) as caught:
                await link.receive()
            assert isinstance(caught.value.__cause__, TimeoutError)

        tasks.start_soon(receive)
        await anyio.wait_all_tasks_blocked()
        with pytest.raises(LinkError, match=problem):
            await link.send(bytes(50_000_000), None)


@pytest.mark.parametrize("leave", [socket.socket.close, reset])
@pytest.mark.parametrize("selector", [selectors.DefaultSelector, selectors.SelectSelector])
async def test_tcpin_continues_when_a_client_disconnects(
    leave: Callable[[socket.socket], None],
    selector: type[selectors.BaseSelector],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(selectors, "DefaultSelector", selector)  # the second one is that of Windows
    async with opened("tcpin:127.0.0.1:0") as link:
        await link.send(HEARTBEAT, None)
        connect = partial(socket.create_connection, link.address, timeout=TIMEOUT)
        with connect() as one, connect() as two:
            one.send(frame(1))
            two.send(frame(2))
            peer_of = {data: peer for peer, data in await collect(link, 2)}
            leave(one)
            assert await collect(link, 1) == [(peer_of[frame(1)], b"")]
            await link.send(frame(3), peer_of[frame(1)])
            await link.send(frame(4), None)
            assert two.recv(1000) == frame(4)
            two.send(frame(5))
            assert await collect(link, 1) == [(peer_of[frame(2)], frame(5))]
            with connect() as three:
                three.send(frame(6))
                [(peer, data)] = await collect(link, 1)
                assert data == frame(6)
                assert peer not in peer_of.values()


async def test_tcpin_limits_its_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "CONNECTIONS_MAX", 1)
    async with connected("tcpin") as (link, far):
        with socket.create_connection(link.address, timeout=TIMEOUT) as second:
            far.send(frame(1))
            assert [data for _, data in await collect(link, 1)] == [frame(1)]
            far.send(frame(2))
            await collect(link, 1)
            assert second.recv(1000) == b""
        far.close()
        assert [data for _, data in await collect(link, 1)] == [b""]
        with socket.create_connection(link.address, timeout=TIMEOUT) as third:
            third.send(frame(3))
            assert [data for _, data in await collect(link, 1)] == [frame(3)]


# Simulated vehicles


async def test_a_sim_link_has_the_faults_of_its_name() -> None:
    async with opened("sim:px4?loss=1&delay=0.03&seed=4&param_error=1") as link:
        for _ in range(5):
            await link.send(HEARTBEAT, None)
        assert (link.endpoint.uplink.lost, link.endpoint.downlink.delay) == (5, 0.03)
        assert link.endpoint.vehicles[0].param_error
