"""Attacks on the service: real sockets, arbitrary bytes."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import re
import socket
import ssl
import struct
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import anyio.abc
import pytest

from paramclient.errors import UsageError
from paramclient.service import (
    AccessSettings,
    Hub,
    Listening,
    Settings,
    Tokens,
    access,
    connection_slots,
    connections,
    serve,
)
from paramclient.service.tokens import WRONG_TOKENS_MAX
from paramclient.sim import GenericVehicle
from tests.shell import shorten_feed, until

ANNA = "anna-may-write-0123456789"
BEN = "ben-may-read-0123456789ab"
TOKENS = Tokens.of_text(f"anna write {ANNA}\nben read {BEN}")
DATA = Path(__file__).parents[1] / "data"
EVIL = "<img/src/onerr>"
"""As much of a program as fits into the name of a parameter."""
C = "/api/v1/components/1/1"
KERNEL = 16_000_000
"""Bytes: more than a kernel keeps of what no client reads, on both sides together."""

pytestmark = pytest.mark.asyncio


@dataclass
class Served:
    """A service that listens."""

    hub: Hub
    port: int

    def head(self, method: str = "GET", path: str = "/health", *more: str, host: str | None = None) -> bytes:
        lines = [f"{method} {path} HTTP/1.1", f"Host: {host or f'127.0.0.1:{self.port}'}", *more]
        return "\r\n".join([*lines, "", ""]).encode("latin-1")

    async def ask(self, method: str = "GET", path: str = "/health", *more: str, **options: Any) -> Answer:
        """One request, one answer, and the end."""
        return Answer.of(await self.send(self.head(method, path, "Connection: close", *more, **options)))

    async def send(self, data: bytes) -> bytes:
        """The response to these bytes, until the service closes."""
        async with self.connection() as (reader, writer):
            writer.write(data)
            return await taken(reader)

    @contextlib.asynccontextmanager
    async def connection(
        self, **options: Any
    ) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
        """A connection that is ended at the end, whatever became of it."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port, **options)
        try:
            yield reader, writer
        finally:
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


@dataclass
class Answer:
    """The responses."""

    status: int
    headers: dict[str, str]
    body: bytes

    @classmethod
    def of(cls, data: bytes) -> Answer:
        head, _, body = data.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
        return cls(int(first.split()[1]), headers, body)

    @property
    def problem(self) -> str:
        assert self.headers["content-type"] == "application/problem+json"
        assert self.headers["x-content-type-options"] == "nosniff"
        document = json.loads(self.body)
        assert document["status"] == self.status
        return str(document["type"]).removeprefix("urn:paramclient:")


@contextlib.asynccontextmanager
async def served(*links: Any, listening: Listening | None = None, **access: Any) -> AsyncIterator[Served]:
    hub = Hub(links, cache=False, fetches=False)
    stop = anyio.Event()
    settings = Settings(access=AccessSettings(**access))

    async def run(*, task_status: anyio.abc.TaskStatus[str]) -> None:
        where = Listening(port=0) if listening is None else listening
        await serve(hub, settings, listening=where, stop=stop, listens=task_status.started)

    async with anyio.create_task_group() as tasks:
        url = await tasks.start(run)
        try:
            yield Served(hub, int(url.rpartition(":")[2]))
        finally:
            stop.set()


async def taken(reader: asyncio.StreamReader) -> bytes:
    """The data up to the end, which may be a reset."""
    data = b""
    with contextlib.suppress(ConnectionError):
        while piece := await asyncio.wait_for(reader.read(65_536), 30):
            data += piece
    return data


def bearer(token: str) -> str:
    return f"Authorization: Bearer {token}"


def a_vehicle(**options: Any) -> GenericVehicle:
    return GenericVehicle(table={"A": 1.0, EVIL: 2.0}, **options)


async def met(service: Served, *more: str) -> None:
    """Check that the vehicle is present, with all its parameters."""
    body = b'{"timeout_s": 30}'
    for path in ("/api/v1/find", f"{C}/fetch"):
        head = service.head(
            "POST",
            path,
            "Connection: close",
            "Content-Type: application/json",
            f"Content-Length: {len(body)}",
            *more,
        )
        answer = Answer.of(await service.send(head + body))
        assert answer.status == 200, answer.body


# Unknown clients


async def test_an_unknown_client_learns_nothing_and_changes_nothing() -> None:
    vehicle = a_vehicle()
    async with served(vehicle, tokens=TOKENS) as service:
        await met(service, bearer(BEN))
        body = b'{"value": 7.0}'
        for method, path in (
            *(("GET", f"{C}/params"), ("GET", "/api/v1/components"), ("GET", "/metrics"), ("GET", "/docs")),
            *(("GET", "/openapi.json"), ("GET", "/api/v1/events"), ("PUT", f"{C}/params/A")),
            *(("POST", f"{C}/reboot"), ("PATCH", f"{C}/params"), ("DELETE", "/api/v1/jobs/1")),
        ):
            for more in ((), (bearer("wrong"),), ("Cookie: paramclient=x; session=y",), ("X-Author: anna",)):
                head = service.head(
                    method, path, "Content-Type: application/json", f"Content-Length: {len(body)}", *more
                )
                answer = Answer.of(await service.send(head + body))
                assert (answer.status, answer.problem) == (401, "unauthenticated"), (method, path)
                assert b"img" not in answer.body
        health = json.loads((await service.ask()).body)
        assert health["status"] == "ok"
        assert "sim" not in json.dumps(health), "nor which links there are"
        refused = await service.ask("DELETE", "/api/v1/components", bearer(BEN))
        assert (refused.status, refused.problem) == (403, "forbidden")
        me = json.loads((await service.ask("GET", "/api/v1/me", bearer(BEN))).body)
        assert me == {"name": "ben", "author": "ben@127.0.0.1", "role": "read", "read_only": False}
    assert vehicle.params["A"].value == 1.0


async def test_a_write_names_its_author_and_a_reader_cannot_write() -> None:
    async with served(a_vehicle(), tokens=TOKENS) as service:
        await met(service, bearer(BEN))
        changes = service.hub.find_component(1, 1, None).component.changes()
        body = b'{"value": 7.0}'
        more = ("Connection: close", "Content-Type: application/json", f"Content-Length: {len(body)}")
        head = service.head("PUT", f"{C}/params/A", *more, bearer(BEN))
        assert Answer.of(await service.send(head + body)).problem == "forbidden"
        head = service.head("PUT", f"{C}/params/A", *more, bearer(ANNA), "X-Author: calibrate.py")
        assert Answer.of(await service.send(head + body)).status == 200
        change = await anext(changes)
        assert (change.name, change.by) == ("A", "us for anna@127.0.0.1 (calibrate.py)")


async def test_beyond_this_machine_nothing_is_served_without_a_token() -> None:
    hub = Hub((), cache=False)
    with pytest.raises(UsageError, match="needs a token"):
        await serve(hub, listening=Listening("0.0.0.0", 0))


async def test_guessing_is_slow_and_leaves_no_trace_of_tokens(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "WRONG_TOKEN_DELAY", 0.05)
    caplog.set_level(logging.DEBUG)
    async with served(tokens=TOKENS) as service:
        statuses = [
            (await service.ask("GET", "/api/v1/me", bearer(f"guess-{number}"))).status
            for number in range(WRONG_TOKENS_MAX + 2)
        ]
        assert statuses == [401] * WRONG_TOKENS_MAX + [429] * 2
        answer = await service.ask("GET", f"/api/v1/me?token={ANNA}")
        assert answer.status == 401, "a token in an address is none"
        assert ANNA.encode() not in answer.body
        body = json.dumps({"token": ANNA}).encode()
        head = service.head(
            "POST", "/api/v1/session", "Content-Type: text/plain", f"Content-Length: {len(body)}"
        )
        await service.send(head + body)
    assert "guess-" not in caplog.text
    assert ANNA not in caplog.text


def over_tls() -> Listening:
    return Listening(port=0, tls_cert=DATA / "tls_station.pem", tls_key=DATA / "tls_station.key")


def trusting() -> ssl.SSLContext:
    return ssl.create_default_context(cafile=str(DATA / "tls_station.pem"))


# Requests by way of a browser


FOREIGN: list[tuple[str, tuple[str, ...], str]] = [
    ("evil.example", (), "foreign-host"),
    ("evil.example:{port}", ("Origin: http://evil.example:{port}",), "foreign-host"),
    ("10.0.0.1:{port}", (), "foreign-host"),
    ("127.0.0.1:{port}", ("Origin: http://evil.example",), "foreign-origin"),
    ("127.0.0.1:{port}", ("Origin: null",), "foreign-origin"),
    ("127.0.0.1:{port}", ("Origin: http://127.0.0.1:1",), "foreign-origin"),
    ("127.0.0.1:{port}", ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"), "foreign-origin"),
]
UPGRADE = (
    *("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13"),
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)


async def test_a_page_from_elsewhere_gets_nowhere() -> None:
    async with served() as service:
        for host_form, more, problem in FOREIGN:
            host = host_form.format(port=service.port)
            lines = [line.format(port=service.port) for line in more]
            for method in ("GET", "POST", "PUT", "OPTIONS"):
                answer = await service.ask(method, "/api/v1/components", *lines, host=host)
                assert answer.problem == problem
                assert "access-control-allow-origin" not in answer.headers
            head = service.head("GET", "/api/v1/ws", *lines, *UPGRADE, host=host)
            assert Answer.of(await service.send(head)).problem == problem
        async with service.connection() as (reader, writer):
            own = f"Origin: http://127.0.0.1:{service.port}"
            writer.write(service.head("GET", "/api/v1/ws", own, *UPGRADE))
            assert (await reader.readline()).startswith(b"HTTP/1.1 101")


async def test_a_websocket_without_a_token_is_none() -> None:
    async with served(tokens=TOKENS) as service:
        answer = Answer.of(await service.send(service.head("GET", "/api/v1/ws", *UPGRADE)))
        assert (answer.status, answer.problem) == (401, "unauthenticated")
        async with service.connection() as (reader, writer):
            writer.write(service.head("GET", "/api/v1/ws", bearer(BEN), *UPGRADE))
            assert (await reader.readline()).startswith(b"HTTP/1.1 101")


# Those who write what means two things


PATHS = [
    *("/page/../../../../etc/passwd", "/page/%2e%2e/%2e%2e/access.py", "/page/..%2f..%2faccess.py"),
    *(
        "/page/%252e%252e/access.py",
        "//etc/passwd",
        "/page//etc/passwd",
        "/docs/%00",
        "/page/%5c..%5caccess.py",
    ),
    *("/page/.%00./access.py", "/docs/%ff", "/docs/..;/access.py", "/page/access.py", "/%2e/health", "*"),
    *("http://evil.example/health", "http://127.0.0.1/health", "health"),
]


async def test_no_path_leads_elsewhere() -> None:
    async with served() as service:
        for path, method in itertools.product(PATHS, ("GET", "OPTIONS")):
            answer = await service.ask(method, path)
            if method == "OPTIONS" and answer.status == 204:  # which methods there are, of a kind of address
                assert answer.body == b""
                continue
            assert answer.status in (400, 404, 405), path
            assert answer.problem
            assert b"root:" not in answer.body
            assert b"import" not in answer.body


HEADERS: list[list[str]] = [
    ["Host: 127.0.0.1", "Host: evil.example"],
    [],
    ["Host: 127.0.0.1", "Content-Length: 2", "Transfer-Encoding: chunked"],
    ["Host: 127.0.0.1", "Content-Length: 2", "Content-Length: 5"],
    ["Host: 127.0.0.1", "Content-Length: +2"],
    ["Host: 127.0.0.1", "Transfer-Encoding: chunked, identity"],
    ["Host : 127.0.0.1"],
    ["Host: 127.0.0.1", "X\x00: y"],
    ["Host: 127.0.0.1", "X: \x00"],
    ["Host: 127.0.0.1\r\n evil.example"],
]


async def test_headers_that_mean_two_things_mean_none() -> None:
    """And what follows, as the request of another client might, is none."""
    smuggled = f"GET {C}/params HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    first = ["POST /api/v1/find HTTP/1.1", "Content-Type: application/json"]
    async with served() as service:
        for lines in HEADERS:
            head = "\r\n".join([*first, *lines, "", "0", "", ""])
            data = await service.send((head + smuggled).encode("latin-1"))
            answer = Answer.of(data)
            assert answer.status in (400, 501), lines
            if answer.status == 400:
                assert answer.problem == "bad-request"
            assert data.count(b"HTTP/1.1 ") == 1


async def test_bytes_that_are_no_http_get_status_400() -> None:
    async with served() as service:
        for data in (
            b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
            b"hello\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
        ):
            answer = Answer.of(await service.send(data))
            assert (answer.status, answer.problem) == (400, "bad-request")


async def test_a_head_that_is_too_long_is_refused() -> None:
    async with served() as service:
        for more in (b"X: " + b"x" * 100_000, b"\r\n".join(b"X-%d: y" % number for number in range(1_000))):
            answer = Answer.of(await service.send(service.head()[:-2] + more + b"\r\n\r\n"))
            assert answer.status in (400, 431)
            assert answer.problem


async def test_a_head_without_an_end_is_not_kept() -> None:
    async with served() as service, service.connection() as (reader, writer):
        sent = 0
        writer.write(b"GET /health HTTP/1.1\r\nX: ")
        with contextlib.suppress(ConnectionError):
            while sent < KERNEL and not writer.is_closing() and not reader.at_eof():
                writer.write(b"x" * 65_536)
                sent += 65_536
                await writer.drain()
                await asyncio.sleep(0)
        assert sent < KERNEL


# Those who send too much, too slowly, or not at all


async def send_endless(service: Served, head: bytes, most: int) -> Answer:
    """Chunks without an end, until the service has had enough."""
    async with service.connection() as (reader, writer):
        writer.write(head)
        answer = asyncio.create_task(taken(reader))
        sent = 0
        with contextlib.suppress(ConnectionError):
            while not answer.done() and sent < most:
                writer.write(b"1000\r\n" + b"x" * 4096 + b"\r\n")
                sent += 4096
                await writer.drain()
                await asyncio.sleep(0)
        assert sent < most, "it was read for ever"
        return Answer.of(await answer)


async def test_bodies_without_an_end_are_not_read() -> None:
    async with served(tokens=TOKENS, max_body=100_000) as service:
        kind = ("Content-Type: application/json", "Transfer-Encoding: chunked")
        known = service.head("POST", "/api/v1/find", *kind, bearer(BEN))
        assert (await send_endless(service, known, KERNEL)).problem == "too-large"
        unknown = service.head("POST", "/api/v1/find", *kind)
        assert (await send_endless(service, unknown, KERNEL)).problem == "unauthenticated"
        session = service.head("POST", "/api/v1/session", *kind)
        assert (await send_endless(service, session, KERNEL)).problem == "too-large"
        page = service.head("GET", "/", *kind)
        assert (await send_endless(service, page, KERNEL)).problem == "bad-request"
        said = service.head("POST", "/api/v1/find", kind[0], "Content-Length: 100001", bearer(BEN))
        assert Answer.of(await service.send(said)).problem == "too-large"
        assert (await service.ask()).status == 200


async def test_a_deep_body_is_a_problem_and_no_more() -> None:
    async with served() as service:
        body = b"[" * 60_000
        head = service.head(
            "POST",
            "/api/v1/find",
            "Connection: close",
            "Content-Type: application/json",
            f"Content-Length: {len(body)}",
        )
        answer = Answer.of(await service.send(head + body))
        assert answer.status in (400, 422)
        assert answer.problem
        assert (await service.ask()).status == 200


async def test_connections_without_a_request_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "REQUEST_HEAD_TIMEOUT", 0.2)
    async with served() as service:
        for data in (b"", b"GET /health HT"):
            async with service.connection() as (reader, writer):
                writer.write(data)
                assert await taken(reader) == b""
        async with service.connection() as (reader, writer):
            writer.write(service.head())
            await reader.readuntil(b'"ok"')
            writer.write(b"GET /health HT")
            await taken(reader)
        async with service.connection() as (reader, writer):
            writer.write(service.head("GET", "/api/v1/events"))
            await reader.readuntil(b'"hello"')
            await asyncio.sleep(0.5)
            service.hub.feed.publish("note", {})
            await reader.readuntil(b'"note"')


async def test_a_missing_request_body_does_not_delay_the_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with contextlib.AsyncExitStack() as stack:
        async with served() as service:
            reader, writer = await stack.enter_async_context(service.connection())
            length = "Content-Length: 100"
            head = service.head("POST", "/api/v1/find", "Content-Type: application/json", length)
            writer.write(head + b"{")
            await service.ask()  # by then it has arrived
        assert await taken(reader) == b""
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


async def test_connections_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_slots, "SERVICE_CONNECTIONS_MAX", 3)
    async with served() as service, contextlib.AsyncExitStack() as stack:
        held = [await stack.enter_async_context(service.connection()) for _ in range(3)]
        for reader, writer in held:
            writer.write(service.head("GET", "/api/v1/events"))
            await reader.readuntil(b'"hello"')
        assert await service.send(service.head()) == b""
        held[0][1].transport.abort()
        await until(lambda: service.hub.feed.listeners == 2)
        assert (await service.ask()).status == 200


async def test_of_one_address_beyond_this_machine_there_are_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_slots, "ADDRESS_CONNECTIONS_MAX", 2)
    monkeypatch.setattr(connection_slots, "is_loopback", lambda _: False)
    async with served() as service, contextlib.AsyncExitStack() as stack:
        for _ in range(2):
            reader, writer = await stack.enter_async_context(service.connection())
            writer.write(service.head("GET", "/api/v1/events"))
            await reader.readuntil(b'"hello"')
        assert await service.send(service.head()) == b""


# Those who do not read


async def overwhelm(service: Served) -> None:
    """Let more happen than everything between the service and a reader can hold."""
    feed = service.hub.feed
    text = "x" * 20_000
    for _ in range(KERNEL // 20_000 // 16):
        for _ in range(16):
            feed.publish("note", {"text": text})
        await asyncio.sleep(0.005)


def a_narrow_socket(port: int) -> socket.socket:
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_096)
    narrow.connect(("127.0.0.1", port))
    narrow.setblocking(False)
    return narrow


async def test_a_slow_listener_is_informed_of_lost_events_and_continues() -> None:
    async with served() as service:
        feed = service.hub.feed
        shorten_feed(feed, 64)
        reader, writer = await asyncio.open_connection(sock=a_narrow_socket(service.port), limit=4_096)
        try:
            writer.write(service.head("GET", "/api/v1/events"))
            await reader.readuntil(b'"hello"')
            await overwhelm(service)
            assert len(feed._texts) == 64, "what it has not read is not kept for it"
            assert feed.listeners == 1
            kinds: list[str] = []
            last = 0
            data = b""
            while not kinds or kinds[-1] != "end":
                data += await asyncio.wait_for(reader.read(65_536), 30)
                *whole, data = data.split(b"\n\n")
                for event in whole:
                    found = re.search(rb"^data: (.*)$", event, re.MULTILINE)
                    if found is None:
                        continue
                    reported = json.loads(found[1])
                    if reported["type"] == "gap":
                        assert reported["missed"] > 64
                        assert reported["seq"] == last + reported["missed"]
                        feed.publish("end", {})
                    elif kinds:
                        assert reported["seq"] == last + 1
                    kinds.append(reported["type"])
                    last = reported["seq"]
            assert kinds.count("gap") == 1
        finally:
            writer.transport.abort()


async def test_a_listener_who_never_reads_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "CLIENT_STALL_TIMEOUT", 0.2)
    async with served() as service:
        shorten_feed(service.hub.feed, 64)
        with a_narrow_socket(service.port) as narrow:
            narrow.send(service.head("GET", "/api/v1/events"))
            await until(lambda: service.hub.feed.listeners == 1)
            await overwhelm(service)
            await until(lambda: service.hub.feed.listeners == 0)


@pytest.mark.parametrize("is_secure", [False, True])
async def test_data_of_one_connection_is_parsed_in_slices(
    is_secure: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    slices: list[int] = []

    def watched(original: Callable[[Any, bytes], None]) -> Callable[[Any, bytes], None]:
        def data_received(self: Any, data: bytes) -> None:
            slices.append(len(data))
            original(self, data)

        return data_received

    for kind in (connections.ServiceConnection, connections.WebSocketConnection):
        monkeypatch.setattr(kind, "data_received", watched(kind.data_received))
    options = {"ssl": trusting(), "server_hostname": "127.0.0.1"} if is_secure else {}
    async with served(listening=over_tls() if is_secure else None) as service:
        async with service.connection(**options) as (reader, writer):
            writer.write(service.head("GET", "/api/v1/ws", *UPGRADE))
            await reader.readuntil(b'"resumed":false}')
            pings = [b"\x89\x82\0\0\0\0" + struct.pack("!H", number) for number in range(20_000)]
            writer.write(b"".join(pings))
            pongs = [b"\x8a\x02" + struct.pack("!H", number) for number in range(20_000)]
            assert await reader.readexactly(4 * 20_000) == b"".join(pongs)
        async with service.connection(**options) as (reader, writer):
            body = b'{"system": 1, "timeout_s": 0.01' + b" " * 60_000 + b"}"
            more = ("Connection: close", "Content-Type: application/json", f"Content-Length: {len(body)}")
            writer.write(service.head("POST", "/api/v1/find", *more) + body)
            assert Answer.of(await taken(reader)).problem == "no-reply"
    assert max(slices) <= connections.BYTES_PER_TURN
    assert sum(slices) > 160_000 + 60_000


async def test_of_a_websocket_that_is_not_read_nothing_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "CLIENT_STALL_TIMEOUT", 0.5)
    made: list[Any] = []
    original = connections.WebSocketConnection.connection_made

    def connection_made(self: Any, transport: Any) -> None:
        made.append(transport)
        original(self, transport)

    monkeypatch.setattr(connections.WebSocketConnection, "connection_made", connection_made)
    ping = b"\x89\xfd\0\0\0\0" + b"p" * 125
    async with served() as service:
        with a_narrow_socket(service.port) as narrow:
            narrow.send(service.head("GET", "/api/v1/ws", *UPGRADE))
            await until(lambda: service.hub.feed.listeners == 1)
            data, sent, largest = (ping * 8 + b"\x81\x80\0\0\0\0") * 600, 0, 0
            with contextlib.suppress(ConnectionError):
                while sent < 2 * KERNEL and service.hub.feed.listeners:
                    with contextlib.suppress(BlockingIOError):
                        sent += narrow.send(data[sent % len(data) :])
                    largest = max(largest, made[0].get_write_buffer_size())
                    await asyncio.sleep(0)
            assert sent < 2 * KERNEL
            assert largest < 150_000
            await until(lambda: service.hub.feed.listeners == 0)


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        (b"\x81\x84\0\0\0\0\xff\xfe\xff\xff", 1007),
        (b"\x81\x81\0\0\0\0\xff" * 2 + b"\x88\x82\0\0\0\0\x03\xe8", None),
        (b"\x01\x80\0\0\0\0" + b"\0\x80\0\0\0\0" * 1_000, 1009),
    ],
)
async def test_a_websocket_message_that_is_none_closes_it_without_a_traceback(
    frames: bytes, code: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    async with served() as service, service.connection() as (reader, writer):
        writer.write(service.head("GET", "/api/v1/ws", *UPGRADE))
        await reader.readuntil(b'"resumed":false}')
        writer.write(frames)
        reported = await taken(reader)
        assert code is None or reported[2:4] == struct.pack("!H", code)
        assert (await service.ask()).status == 200
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.mark.parametrize("is_secure", [False, True])
async def test_clients_that_read_nothing_do_not_delay_the_end(
    is_secure: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Streams of events, WebSockets and downloads, each with more on its way than the systems hold."""
    listening = over_tls() if is_secure else None
    streams = [("/api/v1/events", ()), ("/api/v1/ws", UPGRADE), ("/openapi.json", ())]
    async with contextlib.AsyncExitStack() as stack:
        async with served(listening=listening) as service:
            shorten_feed(service.hub.feed, 64)
            held = []
            for path, more in streams:
                narrow = stack.enter_context(a_narrow_socket(service.port))
                secure = trusting() if is_secure else None
                name = "127.0.0.1" if is_secure else None
                reader, writer = await asyncio.open_connection(
                    sock=narrow, limit=1, ssl=secure, server_hostname=name
                )
                stack.callback(writer.transport.abort)
                held.append((reader, writer))
                writer.write(service.head("GET", path, *more) * (100 if path == "/openapi.json" else 1))
                await reader.read(1)
            await until(lambda: service.hub.feed.listeners == 2)
            await overwhelm(service)
            assert service.hub.feed.listeners == 2
            ending = time.monotonic()
        assert time.monotonic() - ending < 3.0
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


# Those who speak through a vehicle


async def test_a_name_that_tries_to_be_html_is_a_text_everywhere() -> None:
    async with served(a_vehicle()) as service:
        await met(service)
        name = quote(EVIL, safe="")
        reported = {
            path: await service.ask("GET", path) for path in (f"{C}/params", f"{C}/params/{name}", "/metrics")
        }
        reported |= {
            path: await service.ask("GET", path) for path in ("/api/v1/components", f"{C}/params/{name}x")
        }
        reported |= {
            path: await service.ask("GET", path)
            for path in (f"/{name}", f"/page/{name}", f"/api/v1/jobs/{name}")
        }
        reported["?"] = await service.ask("GET", f"{C}/params?names={name}&{name}={name}")
        assert EVIL in json.loads(reported[f"{C}/params"].body)["params"]
        assert json.loads(reported[f"{C}/params/{name}"].body)["name"] == EVIL
        for path, answer in reported.items():
            kind = answer.headers["content-type"]
            assert kind.startswith(
                ("application/json", "application/problem+json", "text/plain; version=0.0.4")
            ), path
            assert answer.headers["x-content-type-options"] == "nosniff"
            policy = answer.headers["content-security-policy"]
            assert "default-src 'none'" in policy
            assert ("sandbox" in policy) or path.startswith("/page/")
        async with service.connection() as (reader, writer):
            writer.write(service.head("GET", "/api/v1/events"))
            head = await reader.readuntil(b"\r\n\r\n")
            assert b"content-type: text/event-stream" in head
            assert b"nosniff" in head
            body = json.dumps({"values": {EVIL: 3.0}}).encode()
            sent = service.head(
                *("PATCH", f"{C}/params", "Connection: close", "Content-Type: application/json"),
                f"Content-Length: {len(body)}",
            )
            assert Answer.of(await service.send(sent + body)).status == 200
            event = await reader.readuntil(b'"name":"<img/src/onerr>"')
            assert b'"change"' in event


# Those who listen on the way


async def test_over_tls_nothing_is_sent_in_clear() -> None:
    async with served(tokens=TOKENS, listening=over_tls()) as service:
        body = json.dumps({"token": ANNA}).encode()
        head = service.head(
            *("POST", "/api/v1/session", "Connection: close", "Content-Type: application/json"),
            *(f"Content-Length: {len(body)}", f"Origin: https://127.0.0.1:{service.port}"),
        )
        async with service.connection(ssl=trusting()) as (reader, writer):
            writer.write(head + body)
            answer = Answer.of(await taken(reader))
        assert answer.status == 200
        assert answer.headers["set-cookie"].endswith("; HttpOnly; SameSite=Strict; Secure")
        assert b"200" not in await service.send(service.head())
        with pytest.raises(ssl.SSLError):
            async with service.connection(ssl=ssl.create_default_context()):
                pass


async def test_a_certificate_with_another_key_is_reported_before_a_connection() -> None:
    listening = Listening(port=0, tls_cert=DATA / "tls_station.pem", tls_key=DATA / "tls_other.key")
    with pytest.raises(UsageError, match=r"tls_other\.key: this private key does not belong"):
        await serve(Hub((), cache=False), listening=listening)
