"""Who gets a connection to the service, who loses one, and how many lines the log has of those who do not."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Iterator

import anyio
import pytest

from paramclient.service import Listening, acceptor, connection_slots
from paramclient.service.client_address import client_network, is_loopback
from paramclient.service.connection_slots import (
    ADDRESS_CONNECTIONS_MAX,
    LOOPBACK_RESERVED,
    ConnectionSlot,
    ConnectionSlots,
    ConnectionStage,
)
from paramclient.service.log_limit import LOG_INTERVAL, LOG_KINDS_MAX, LogLimit
from tests.service.test_attacks import Answer, Served, over_tls, served, taken, trusting
from tests.shell import TIMEOUT, Clock, until

# Connection slots


def take(slots: ConnectionSlots, address: str) -> ConnectionSlot:
    slot = slots.take(address)
    assert slot is not None
    return slot


def held(slots: ConnectionSlots, address: str) -> ConnectionSlot:
    """A slot of a connection that is being answered."""
    slot = take(slots, address)
    slot.stage = ConnectionStage.ACTIVE
    return slot


@pytest.mark.parametrize(
    ("one", "other", "are_one"),
    [
        ("192.0.2.1", "192.0.2.1", True),
        ("192.0.2.1", "192.0.2.2", False),
        ("::ffff:192.0.2.1", "192.0.2.1", True),
        ("2001:db8::1", "2001:db8::ffff:0:0:1", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("fe80::1%eth0", "fe80::2%eth1", True),
    ],
)
def test_which_addresses_are_one_client(one: str, other: str, are_one: bool) -> None:
    assert (client_network(one) == client_network(other)) is are_one
    seats = ConnectionSlots(1_000)
    for _ in range(ADDRESS_CONNECTIONS_MAX):
        held(seats, one)
    assert (seats.take(other) is None) is are_one
    assert seats.take("127.0.0.1") is not None


@pytest.mark.parametrize("address", ["127.0.0.1", "127.9.9.9", "::1", "::ffff:127.0.0.1"])
def test_loopback_has_slots_of_its_own_and_no_limit_for_one_address(address: str) -> None:
    assert is_loopback(address)
    seats = ConnectionSlots(512)
    beyond = 0
    while seats.take(f"192.0.2.{beyond % 200}") is not None and beyond < 512 - LOOPBACK_RESERVED:
        beyond += 1
    for slot in list(seats.at[ConnectionStage.SILENT]):
        slot.stage = ConnectionStage.ACTIVE
    assert len(seats) == 512 - LOOPBACK_RESERVED
    assert seats.take("192.0.2.250") is None
    for _ in range(LOOPBACK_RESERVED):
        held(seats, address)
    assert seats.take(address) is None


def test_a_proxy_that_is_trusted_is_many_clients() -> None:
    seats = ConnectionSlots(512, is_proxy=lambda address: address == "192.0.2.1")
    for _ in range(512 - LOOPBACK_RESERVED):
        held(seats, "192.0.2.1")
    assert seats.take("192.0.2.1") is None
    assert seats.take("127.0.0.1") is not None


def test_the_least_active_connection_is_closed_first() -> None:
    seats = ConnectionSlots(4, is_local=lambda _: True)
    ended: list[str] = []
    for name, stage in (
        ("idle", ConnectionStage.IDLE),
        ("begun", ConnectionStage.STARTED),
        ("old", ConnectionStage.SILENT),
    ):
        slot = take(seats, "127.0.0.1")
        slot.stage = stage
        slot.close = lambda name=name: ended.append(name)  # type: ignore[misc]
    held(seats, "127.0.0.1")
    for expected in ("old", "begun", "idle"):
        held(seats, "127.0.0.1")
        assert ended.pop() == expected
        assert len(seats) == 4
    assert seats.take("127.0.0.1") is None


def test_a_client_that_has_too_many_takes_no_place_of_another_one() -> None:
    seats = ConnectionSlots(1_000)
    other = take(seats, "192.0.2.2")
    own = [take(seats, "192.0.2.1") for _ in range(ADDRESS_CONNECTIONS_MAX)]
    take(seats, "192.0.2.1")
    assert own[0] not in seats.at[ConnectionStage.SILENT]
    assert other in seats.at[ConnectionStage.SILENT]


def test_those_beyond_this_computer_end_no_connection_of_it() -> None:
    seats = ConnectionSlots(8, is_local=lambda address: address == "127.0.0.1")
    for _ in range(8):
        take(seats, "127.0.0.1")
    assert seats.take("192.0.2.1") is None
    take(seats, "127.0.0.1")
    assert len(seats) == 8


def test_a_place_is_released_once() -> None:
    seats = ConnectionSlots(8)
    slot = take(seats, "192.0.2.1")
    slot.release()
    slot.release()
    slot.stage = ConnectionStage.ACTIVE
    assert len(seats) == 0
    assert not any(seats.at.values())


# Lines of the log


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def limit(clock: Clock) -> LogLimit:
    return LogLimit(clock)


LOG = logging.getLogger("paramclient.test")


def test_of_each_kind_there_is_one_line_in_a_minute(
    limit: LogLimit, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(1_000):
        clock.now = number * 0.1
        limit.log(LOG, "full", f"refused {number}")
        limit.log(LOG, "tls", f"failed {number}")
        limit.flush()
    assert caplog.messages == [
        *("refused 0", "failed 0"),
        *("refused 0 (and 599 more such lines in 60 s)", "failed 0 (and 599 more such lines in 60 s)"),
    ]
    caplog.clear()
    clock.now += LOG_INTERVAL
    limit.flush()
    assert caplog.messages[0] == "refused 0 (and 400 more such lines in 100 s)"
    clock.now += LOG_INTERVAL
    limit.flush()
    limit.log(LOG, "full", "refused again")
    assert caplog.messages[2:] == ["refused again"]


def test_at_the_end_the_number_is_reported(limit: LogLimit, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(3):
        limit.log(LOG, "full", "refused")
    limit.flush(ends=True)
    limit.flush(ends=True)
    assert caplog.messages == ["refused", "refused (and 2 more such lines in 0 s)"]


def test_kinds_are_bounded(limit: LogLimit, caplog: pytest.LogCaptureFixture) -> None:
    for number in range(LOG_KINDS_MAX * 10):
        limit.log(LOG, f"kind {number}", "text")
    assert len(caplog.messages) == LOG_KINDS_MAX + 1


def test_lines_of_libraries_are_held_to_the_same(limit: LogLimit, caplog: pytest.LogCaptureFixture) -> None:
    uvicorn, aio = logging.getLogger("uvicorn.error"), logging.getLogger("asyncio")
    with limit.limit_libraries():
        for number in range(5):
            uvicorn.warning("Invalid HTTP request received.")
            aio.error("socket.accept() out of system resource\nsocket: <%d>", number)
            aio.error("Task exception was never retrieved")
    limit.flush(ends=True)
    said = [message.partition("\n")[0] for message in caplog.messages]
    assert said.count("Task exception was never retrieved") == 5, "no external client causes these"
    assert said.count("Invalid HTTP request received.") == 1
    assert said.count("socket.accept() out of system resource") == 1
    assert said[-2:] == [
        "Invalid HTTP request received. (and 4 more such lines in 0 s)",
        "socket.accept() out of system resource (and 4 more such lines in 0 s)",
    ]
    uvicorn.warning("Invalid HTTP request received.")
    uvicorn.warning("Invalid HTTP request received.")
    assert caplog.messages[-2:] == ["Invalid HTTP request received."] * 2


# Real sockets


@contextlib.contextmanager
def silent(port: int, count: int, source: str = "127.0.0.1", data: bytes = b"") -> Iterator[None]:
    """Connections that send these bytes and nothing else, until the end."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            one = stack.enter_context(socket.socket())
            one.bind((source, 0))
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))
            if data:
                with contextlib.suppress(BlockingIOError, OSError):
                    one.send(data)
        yield


async def request_over_tls(service: Served) -> Answer:
    async with service.connection(ssl=trusting()) as (reader, writer):
        writer.write(service.head("GET", "/health", "Connection: close"))
        return Answer.of(await taken(reader))


@contextlib.asynccontextmanager
async def narrow(
    monkeypatch: pytest.MonkeyPatch, listening: Listening | None = None
) -> AsyncIterator[Served]:
    """A service with 40 connection slots, for which only 127.0.0.1 is this computer."""
    monkeypatch.setattr(connection_slots, "SERVICE_CONNECTIONS_MAX", 40)
    monkeypatch.setattr(connection_slots, "ADDRESS_CONNECTIONS_MAX", 10)
    monkeypatch.setattr(connection_slots, "is_loopback", lambda address: address == "127.0.0.1")
    async with served(listening=listening) as service:
        yield service


@pytest.mark.asyncio
@pytest.mark.parametrize("source", ["127.0.0.1", "127.0.0.2"])
@pytest.mark.parametrize("data", [b"", b"\x16\x03\x01"])
async def test_silent_connections_block_no_other_client(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, source: str, data: bytes
) -> None:
    """From this computer, where there is no limit for one address, and from beyond it."""
    monkeypatch.setattr(acceptor, "HANDSHAKE_TIMEOUT", 600.0)  # so no slot becomes free by waiting
    caplog.set_level(logging.INFO, "paramclient")
    async with narrow(monkeypatch, over_tls()) as service:
        with silent(service.port, 200, source, data):
            for _ in range(3):
                with anyio.fail_after(TIMEOUT):
                    assert (await request_over_tls(service)).status == 200
    assert len([record for record in caplog.records if record.name != "asyncio"]) < 10


@pytest.mark.asyncio
@pytest.mark.parametrize("data", [b"", b"\x16"])
async def test_a_missing_handshake_is_not_waited_for(monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    monkeypatch.setattr(acceptor, "HANDSHAKE_TIMEOUT", 0.2)
    async with served(listening=over_tls()) as service, service.connection() as (reader, writer):
        writer.write(data)
        assert await asyncio.wait_for(taken(reader), 5) == b""


@pytest.mark.asyncio
async def test_failed_handshakes_make_one_line(caplog: pytest.LogCaptureFixture) -> None:
    async with served(listening=over_tls()) as service:
        for _ in range(20):
            await service.send(b"GET /health HTTP/1.1\r\n\r\n")
    said = [each for each in caplog.messages if "TLS handshake" in each]
    assert len(said) == 2, caplog.messages
    assert "TLS handshake with 127.0.0.1 failed: http request" in said[0]
    assert "(and 19 more such lines in" in said[1]
    assert len(caplog.messages) == 2


@pytest.mark.asyncio
async def test_an_address_beyond_this_computer_has_its_share_and_no_more(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with narrow(monkeypatch) as service, contextlib.AsyncExitStack() as stack:
        for _ in range(10):
            options = {"local_addr": ("127.0.0.2", 0)}
            reader, writer = await stack.enter_async_context(service.connection(**options))
            writer.write(service.head("GET", "/api/v1/events"))
            await reader.readuntil(b'"hello"')
        for _ in range(2):
            async with service.connection(**options) as (reader, writer):
                assert await taken(reader) == b""
        async with service.connection(local_addr=("127.0.0.3", 0)) as (reader, writer):
            writer.write(service.head("GET", "/health", "Connection: close"))
            assert Answer.of(await taken(reader)).status == 200
    [first, rest] = [each for each in caplog.messages if "refused" in each]
    assert first == "refused a connection from 127.0.0.2: the maximum number of connections is reached"
    assert "(and 1 more such lines" in rest


@pytest.mark.asyncio
async def test_without_files_it_waits_and_goes_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with served() as service:
        monkeypatch.setattr(socket.socket, "accept", _no_files)
        pending = asyncio.create_task(service.ask())
        await until(lambda: bool(caplog.messages))
        await asyncio.sleep(3 * acceptor.ACCEPT_RETRY)
        monkeypatch.undo()
        assert (await pending).status == 200
    assert caplog.messages[0] == "cannot accept a connection: Too many open files"
    assert len(caplog.messages) == 2


def _no_files(_: socket.socket) -> tuple[socket.socket, object]:
    raise OSError(24, "Too many open files")


def test_there_are_no_more_connections_than_half_of_the_files(monkeypatch: pytest.MonkeyPatch) -> None:
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 256))
    assert connection_slots.connection_limit() == 128
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY,) * 2)
    assert connection_slots.connection_limit() == connection_slots.SERVICE_CONNECTIONS_MAX
