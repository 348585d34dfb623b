"""Attacks on the service and its clients: each attack with its limit and the measured value.

    python bench/attack.py [--quick] [--only TEXT] [--slack N] [--json]

Each group of attacks has its own service (`paramclient serve`, with and without TLS, on loopback), and each
attack prints what it measures and the limit. 127.0.0.1 counts as this computer; other addresses of the
loopback network act as remote clients, because the process is started with a changed test for loopback
addresses. The only other change is that the event loop records the processor time of its longest callback,
and the latency of a timer of 5 ms.

`--quick` runs the attacks that take about a second each. The exit code is 1 if a limit was exceeded. Linux
only: memory is read from /proc.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import json
import os
import re
import resource
import shutil
import signal
import socket
import sqlite3
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlencode

from pymavlink.dialects.v20 import common

from paramclient.cache import ParamCache, StoredParam, TableState, TableUpdate
from paramclient.links import create_link, serve_endpoint
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType
from paramclient.sim import Camera, Endpoint, GenericVehicle

ROOT: Final = Path(__file__).parent.parent
CERT: Final = ROOT / "tests" / "data" / "tls_station.pem"
KEY: Final = ROOT / "tests" / "data" / "tls_station.key"
HERE, ELSEWHERE, FAR = "127.0.0.1", "127.0.0.2", "127.0.0.3"
"""Addresses of this computer, of a remote attacker, and of another remote client."""
WRITER, READER = "writer-0123456789abcdef", "reader-0123456789abcdef"
C: Final = "/api/v1/components/1/1"
UPGRADE: Final = (
    "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
)
MEGABYTE: Final = 1_000_000
TIMEOUT: Final = 60.0
"""Seconds to wait for the start of a process, and for a response."""

REACHED: Final = 1.0
"""Limit in seconds for a response to `/health`."""
BLOCKED: Final = 50.0
"""Limit in milliseconds for the processor time of the longest callback of the event loop."""
LATE: Final = 50.0
"""Limit in milliseconds for the event-loop latency by wall clock, which includes the time in which another
thread holds the interpreter. Other processes of the machine, such as the attacker, add to it."""
MEMORY: Final = 64.0
"""Limit in megabytes for the growth of the service's memory."""
MEMORY_OF_COMPONENTS: Final = 80.0
"""Limit in megabytes with the maximum number of components."""
LOG: Final = 10.0
"""Limit in kilobytes for the log."""
ENDED: Final = 3.0
"""Limit in seconds from SIGTERM to the end of the process."""

LAUNCH: Final = """
import asyncio.base_events, asyncio.events, json, os, signal, sys, time
from paramclient.service import connection_slots
connection_slots.is_loopback = lambda address: address == "127.0.0.1"
longest, late, reports, run = 0.0, 0.0, 0, asyncio.events.Handle._run
def timed(handle):
    global longest
    began, period = time.thread_time(), reports
    run(handle)
    if period == reports:  # otherwise it began before the attack: the start of the service takes 0.2 s
        longest = max(longest, time.thread_time() - began)
asyncio.events.Handle._run = timed
run_forever = asyncio.base_events.BaseEventLoop.run_forever
def beating(loop):
    def beat(due):
        global late
        late = max(late, time.monotonic() - due)
        loop.call_later(0.005, beat, time.monotonic() + 0.005)
    loop.call_later(0.005, beat, time.monotonic() + 0.005)
    return run_forever(loop)
asyncio.base_events.BaseEventLoop.run_forever = beating
def tell(*_):
    global longest, late, reports
    reports += 1
    with open(told + ".new", "w") as file:
        json.dump([longest, late], file)
    os.replace(told + ".new", told)
    longest = late = 0.0
signal.signal(signal.SIGUSR1, tell)
told = sys.argv.pop(1)
from paramclient.__main__ import main
sys.exit(main())
"""


@dataclass
class Row:
    """One line of the table."""

    attack: str
    what: str
    limit: float
    measured: float
    unit: str

    @property
    def is_held(self) -> bool:
        """Whether the measured value is within the limit."""
        return self.measured <= self.limit


@dataclass
class Service:
    """A running service."""

    process: subprocess.Popen[bytes]
    port: int
    folder: Path
    tls: ssl.SSLContext | None
    rows: list[Row] = field(default_factory=list)
    attack: str = ""
    cpu: int = -10

    def note(self, what: str, limit: float, measured: float, unit: str) -> None:
        """Add a line to the table."""
        self.rows.append(Row(self.attack, what, limit, round(measured, 3), unit))

    @property
    def log(self) -> str:
        """Everything that the service has written on stderr."""
        return (self.folder / "log").read_text(errors="replace")

    def memory(self, name: str = "VmHWM") -> float:
        """Return the memory in megabytes: the maximum since `forget`, or with VmRSS the present one."""
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        found = re.search(rf"{name}:\s+(\d+) kB", text)
        assert found is not None
        return int(found[1]) / 1024

    def forget(self) -> None:
        """Start new measurements of memory and event loop."""
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")
        self.blocked()

    def blocked(self) -> tuple[float, float]:
        """Return the milliseconds of the longest callback of the event loop since the last call, and the
        event-loop latency.
        """
        reported = self.folder / "loop"
        reported.unlink(missing_ok=True)
        self.process.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + TIMEOUT
        while not reported.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        longest, late = json.loads(reported.read_text())
        return float(longest) * 1_000, float(late) * 1_000

    @contextmanager
    def watched(
        self,
        *,
        memory: float | None = MEMORY,
        blocked: float | None = BLOCKED,
        late: float | None = None,
    ) -> Iterator[None]:
        """Measure memory and event loop during the block, and add the lines to the table."""
        self.forget()
        before, log = self.memory("VmRSS"), len(self.log)
        yield
        if memory is not None:
            self.note("memory grows", memory, self.memory() - before, "MB")
        held, came_late = self.blocked()
        if blocked is not None:
            self.note("event loop held", blocked, held, "ms")
        if late is not None:
            self.note("event loop late", late, came_late, "ms")
        self.note("log grows", LOG, (len(self.log) - log) / 1_000, "kB")

    async def ask(
        self,
        method: str = "GET",
        path: str = "/health",
        body: bytes = b"",
        *headers: str,
        source: str = HERE,
        kind: str = "application/json",
    ) -> tuple[int, bytes]:
        """Send one request on a new connection; return the status, or 0 without a response, and the body."""
        lines = [f"{method} {path} HTTP/1.1", f"Host: 127.0.0.1:{self.port}", "Connection: close", *headers]
        lines += [f"Content-Type: {kind}", f"Content-Length: {len(body)}"] if body else []
        data = b""
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            reader, writer = await asyncio.open_connection(
                "127.0.0.1", self.port, ssl=self.tls, local_addr=(source, 0)
            )
            try:
                writer.write("\r\n".join([*lines, "", ""]).encode() + body)
                data = await asyncio.wait_for(reader.read(), TIMEOUT)
            finally:
                writer.transport.abort()
        head, _, content = data.partition(b"\r\n\r\n")
        return (int(head.split()[1]) if head else 0), content

    async def reached(self, what: str, source: str = HERE, times: int = 3) -> None:
        """Add the longest response time of `/health` to the table."""
        longest = 0.0
        for _ in range(times):
            began = time.monotonic()
            status, _ = await self.ask(source=source)
            longest = max(longest, time.monotonic() - began if status == 200 else TIMEOUT)
        self.note(what, REACHED, longest, "s")

    def is_busy(self) -> bool:
        """Return whether the service has used processor time since the last call."""
        before, self.cpu = (
            self.cpu,
            sum(map(int, Path(f"/proc/{self.process.pid}/stat").read_text().split()[13:15])),
        )
        return self.cpu > before + 2

    def end(self) -> float:
        """Send SIGTERM; return the seconds until the process ended."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            self.process.kill()
        return time.monotonic() - began


@asynccontextmanager
async def serving(
    rows: list[Row], *words: str, tls: bool = False, tokens: bool = True, folder: Path | None = None
) -> AsyncIterator[Service]:
    """Run a new service."""
    own = Path(tempfile.mkdtemp()) if folder is None else folder
    words = (*words, "--listen", "127.0.0.1:0")
    if tls:
        words = (*words, "--tls-cert", str(CERT), "--tls-key", str(KEY))
    if tokens:
        path = own / "tokens"
        path.write_text(f"writer write {WRITER}\nreader read {READER}\n")
        path.chmod(0o600)
        words = (*words, "--token-file", str(path))
    command = [sys.executable, "-c", LAUNCH, str(own / "loop"), "serve", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(own)}
    with (own / "log").open("ab") as log:
        process = subprocess.Popen(  # noqa: ASYNC220 - it takes a millisecond
            command, stdout=subprocess.PIPE, stderr=log, env=environment, cwd=own
        )
    try:
        assert process.stdout is not None
        line = await asyncio.to_thread(process.stdout.readline)
        if not line:
            raise SystemExit((own / "log").read_text())
        context = ssl.create_default_context(cafile=str(CERT)) if tls else None
        yield Service(process, int(line.split(b":")[-1]), own, context, rows)
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
        if folder is None:
            shutil.rmtree(own, ignore_errors=True)


@asynccontextmanager
async def serving_vehicle(
    rows: list[Row], vehicle: Endpoint, component: int, *fetches: str
) -> AsyncIterator[Service]:
    """Run a new service and a vehicle on its UDP link. Find its component, and fetch its parameters."""
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind((HERE, 0))
        port = free.getsockname()[1]
    far_end = asyncio.create_task(serve_endpoint(vehicle, create_link(f"udpout:{HERE}:{port}")))
    try:
        async with serving(rows, f"udpin:{HERE}:{port}", "--no-cache", "--no-fetch") as service:
            found = as_json({"component": component, "timeout_s": 60})
            for path, body in (("/api/v1/find", found), *((each, b'{"timeout_s": 60}') for each in fetches)):
                status, answer = await service.ask("POST", path, body, token(READER))
                assert status == 200, answer
            yield service
    finally:
        far_end.cancel()


@contextmanager
def connections(
    service: Service, count: int, source: str, data: bytes = b""
) -> Iterator[list[socket.socket]]:
    """Open plain TCP connections that send these bytes and nothing else."""
    held = []
    try:
        for _ in range(count):
            one = socket.socket()
            one.bind((source, 0))
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", service.port))
            held.append(one)
            if data:
                with contextlib.suppress(OSError):
                    one.send(data)
        yield held
    finally:
        for one in held:
            one.close()


def token(text: str) -> str:
    """Return the header with a token."""
    return f"Authorization: Bearer {text}"


# The attacks


async def handshakes(service: Service, quick: bool) -> None:
    """Clause 6."""
    count = 300 if quick else 2_000
    for source, data, who in (
        (ELSEWHERE, b"", "silent, from one address"),
        (HERE, b"", "silent, from this computer"),
        (ELSEWHERE, b"\x16\x03\x01", "of 3 bytes, from one address"),
    ):
        service.attack = f"{count:,} connections, {who}, {'TLS' if service.tls else 'plain'}"
        with service.watched(blocked=None), connections(service, count, source, data):
            await asyncio.sleep(0.2)
            await service.reached("/health, this computer")
            await service.reached("/health, another address", FAR)
    if service.tls is not None:
        service.attack = f"{count:,} failed handshakes"
        with service.watched(blocked=None):
            for _ in range(count):
                with connections(service, 1, ELSEWHERE, b"GET / HTTP/1.1\r\n\r\n") as [one]:
                    one.setblocking(True)
                    one.settimeout(5)
                    with contextlib.suppress(OSError):
                        one.sendall(b"GET / HTTP/1.1\r\n\r\n")
                        one.recv(100)
            await service.reached("/health, this computer")


async def requests(service: Service, quick: bool) -> None:
    """Clause 7, with a read-only token."""
    for path in ("/api/v1/find", f"{C}/fetch"):
        status, answer = await service.ask("POST", path, b'{"timeout_s": 60}', token(READER))
        assert status == 200, answer
    names = [f"X{number:05}" for number in range(60_000)]
    sets_json = b"[" + b"{}," * (2 * MEGABYTE // 3 - 1) + b"{}]"
    octets = "application/octet-stream"
    diff = {"wanted": {"defaults": True}, "known": True, "timeout_s": 60}
    unknown = b"{" + b",".join(b'"a%06d":1' % number for number in range(8 * MEGABYTE // 12)) + b"}"
    posts: list[tuple[str, str, bytes, str]] = [
        (
            "/diff with 10,000 patterns",
            f"{C}/diff",
            as_json(diff, only=[f"*{n}*" for n in names[:10_000]]),
            "",
        ),
        ("/diff with 10,000 names", f"{C}/diff", as_json(diff, only=names[:10_000]), ""),
        ("8 MB of unknown members", f"{C}/diff", unknown, ""),
        ("2 MB of unknown members", f"{C}/diff", unknown[: 2 * MEGABYTE].rpartition(b",")[0] + b"}", ""),
        ("2 MB of empty sets, JSON", "/api/v1/files?name=a.json", sets_json, octets),
        (
            "a plan with 60,000 names",
            f"{C}/plan",
            as_json({"wanted": {"values": dict.fromkeys(names, 1)}}),
            "",
        ),
        ("a deep body", f"{C}/diff", b"[" * 60_000, ""),
    ]
    for attack, path, body, kind in posts:
        service.attack = attack
        with service.watched():
            asking = asyncio.create_task(
                service.ask("POST", path, body, token(READER), kind=kind or "application/json")
            )
            await asyncio.sleep(0.05)
            await service.reached("/health meanwhile", times=1)
            status, _ = await asking
            service.note("answered with 5xx", 0, status >= 500, "times")
    service.attack = "256 jobs of one token"
    with service.watched():
        statuses = [
            (await service.ask("POST", f"{C}/fetch", b'{"wait": false, "refresh": true}', token(READER)))[0]
            for _ in range(40 if quick else 256)
        ]
        service.note("answered with 5xx", 0, sum(s >= 500 for s in statuses), "times")
        began = time.monotonic()
        status, _ = await service.ask("GET", f"{C}/params", b"", token(WRITER))
        service.note(
            "a read of another token", 2.0, time.monotonic() - began if status == 200 else TIMEOUT, "s"
        )
    service.attack = "60 open bodies of 1 MB"
    head = [f"POST {C}/diff HTTP/1.1", f"Host: 127.0.0.1:{service.port}", token(READER)]
    head += ["Content-Type: application/json", f"Content-Length: {3 * MEGABYTE}", "", ""]
    with service.watched(), connections(service, 60, ELSEWHERE) as held:
        data = "\r\n".join(head).encode() + b" " * MEGABYTE
        loop = asyncio.get_running_loop()

        async def send(one: socket.socket) -> None:
            with contextlib.suppress(OSError, TimeoutError):
                await asyncio.wait_for(loop.sock_sendall(one, data), 2.0)

        await asyncio.gather(*map(send, held))
        await service.reached("/health meanwhile", times=1)


async def large_table(rows: list[Row], quick: bool) -> None:
    """Clause 7: requests of a reader for a vehicle with as many parameters as one request may name."""
    table = {f"A{number % 97}_P{number:05}": float(number) for number in range(300 if quick else 10_000)}
    values = {"wanted": {"values": {name: value + 1 for name, value in table.items()}}, "timeout_s": 60}
    requested: list[tuple[str, str, bytes]] = [
        ("GET", f"{C}/params", b""),
        ("GET", f"{C}/params?names=A1*", b""),
        ("GET", f"{C}/file?from=known&format=parm", b""),
        ("GET", f"{C}/file?format=parm", b""),
        ("POST", f"{C}/diff", as_json(values, known=True)),
        ("POST", f"{C}/diff", as_json(values, partial=True)),
        ("POST", f"{C}/plan", as_json(values)),
        ("POST", f"{C}/verify", as_json(values)),
    ]
    vehicle = GenericVehicle(table=table, burst=100)
    async with serving_vehicle(rows, vehicle, 1, f"{C}/fetch") as service:
        for method, path, body in requested:
            service.attack = f"{len(table):,} parameters: {path.removeprefix(C)}"
            with service.watched():
                status, answer = await service.ask(method, path, body, token(READER))
                assert status == 200, answer
        service.attack = f"{len(table):,} parameters: 6 diff at once"
        with service.watched(late=LATE):
            parallel_requests = [
                service.ask("POST", f"{C}/diff", as_json(values, known=True), token(READER)) for _ in range(6)
            ]
            statuses = [status for status, _ in await asyncio.gather(*parallel_requests)]
            service.note("not answered", 0, sum(status != 200 for status in statuses), "times")
        await many_answers(service, len(table))


async def similar_names(rows: list[Row], quick: bool) -> None:
    """Clause 7: unknown names that are similar to many of a vehicle, whose search is a comparison with
    each."""
    count = 1_500 if quick else 10_000
    vehicle = GenericVehicle(table={f"MISSION_{n:04}_XYZ": float(n) for n in range(count)}, burst=100)
    async with serving_vehicle(rows, vehicle, 1, f"{C}/fetch") as service:
        for at_once, method, what in ((1, "GET", ""), (60, "POST", "/read")):
            service.attack = f"{count:,} parameters: {at_once} {method} of an unknown similar name{what}"
            with service.watched():
                requested = [
                    service.ask(
                        method,
                        f"{C}/params/MISSION_{number:04}_X{what}",
                        b"" if method == "GET" else b'{"timeout_s": 60}',
                        token(READER),
                    )
                    for number in range(at_once)
                ]
                statuses = [status for status, _ in await asyncio.gather(*requested)]
                service.note("not refused with 404", 0, sum(status != 404 for status in statuses), "times")


async def many_answers(service: Service, size: int) -> None:
    """Clause 7: large answers at once, taken and not taken, and all events again."""
    for count, path in ((16, f"{C}/params"), (120, f"{C}/file?from=known")):
        service.attack = f"{size:,} parameters: {count} GET {path.removeprefix(C)} at once"
        with service.watched():
            requested = [service.ask("GET", path, b"", token(READER), source=ELSEWHERE) for _ in range(count)]
            statuses = [status for status, _ in await asyncio.gather(*requested)]
            service.note("not answered", 0, sum(status != 200 for status in statuses), "times")
    run = json.loads((await service.ask("GET", "/api/v1/components", b"", token(READER)))[1])["run"]
    for count, path in ((1, "/api/v1/events"), (1, f"/api/v1/events?after={run}-0"), (128, f"{C}/params")):
        await unread(service, count, path, f"{size:,} parameters", 1.5 if count == 1 else 4)


async def unread(service: Service, count: int, path: str, of: str, seconds: float) -> None:
    """Request a path on many connections, and take none of the responses."""
    service.attack = f"{of}: {count} GET {path.removeprefix(C)[-20:]}, and no client reads"
    lines = [f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{service.port}", token(READER), "", ""]
    with service.watched(), connections(service, 0, ELSEWHERE) as held:
        for _ in range(count):
            one = socket.socket()
            held.append(one)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_096 if count > 1 else 4_000_000)
            one.bind((ELSEWHERE, 0))
            one.connect((HERE, service.port))
            one.sendall("\r\n".join(lines).encode())
        await asyncio.sleep(seconds)


async def extended_params(rows: list[Row], quick: bool) -> None:
    """Clause 7: requests of a reader for many extended parameters of 128 bytes each."""
    count, extended = 300 if quick else 10_000, "/api/v1/components/1/100/extended"
    camera = Camera({f"P{number:05}": "\U0001f6f0" * 32 for number in range(count)}, burst=50)
    patterns = urlencode([("names", f"[a-\uffff][a-\uffff]{number}") for number in range(64)])
    requested = [
        *((1, path) for path in ("params", f"params?{patterns}", "params/P0000X")),
        (16, "params"),
    ]
    async with serving_vehicle(rows, camera, 100, f"{extended}/fetch") as service:
        for at_once, path in requested:
            service.attack = f"{count:,} extended parameters: {at_once} GET {path[:15]}"
            with service.watched():
                answers = [
                    service.ask("GET", f"{extended}/{path}", b"", token(READER)) for _ in range(at_once)
                ]
                statuses = [status for status, _ in await asyncio.gather(*answers)]
                service.note("answered with 5xx or not", 0, sum(s >= 500 or not s for s in statuses), "times")
        fetches = 4 if quick else 64
        service.attack = f"{count:,} extended parameters: {fetches} fetches that end together"
        with service.watched(late=LATE):
            fetched = [
                service.ask("POST", f"{extended}/fetch", b'{"timeout_s": 60}', token(READER))
                for _ in range(fetches)
            ]
            await asyncio.gather(*fetched)
        await unread(service, 120, f"{extended}/params", f"{count:,} extended parameters", 4)


async def descriptions(rows: list[Row], quick: bool) -> None:
    """Clause 7: requests of a reader for a group of parameters whose description is as long as allowed."""
    count = 300 if quick else 1_500
    vehicle = GenericVehicle(table={f"ABC_P{number:05}": 1.0 for number in range(count)}, burst=100)
    values = [{"value": number, "description": "v" * 4} for number in range(5_000)]
    group = {"name": "ABC_P{n}", "longDesc": "x" * 40_000, "units": "m" * 2_000, "values": values}
    given = {"wanted": {"values": {f"ABC_P{number:05}": 2 for number in range(count)}}, "known": True}
    requested: list[tuple[int, str, str, bytes]] = [
        *((at_once, "GET", path, b"") for at_once in (1, 4) for path in ("params?metadata=true", "metadata")),
        (1, "POST", "diff", as_json(given)),
    ]
    async with serving_vehicle(rows, vehicle, 1, f"{C}/fetch") as service:
        document = as_json({"version": 1, "parameters": [group]})
        kind = "application/octet-stream"
        status, answer = await service.ask("PUT", f"{C}/metadata", document, token(WRITER), kind=kind)
        assert status == 200, answer
        for at_once, method, path, body in requested:
            service.attack = f"{count:,} long descriptions: {at_once} {method} {path}"
            with service.watched():
                answers = [service.ask(method, f"{C}/{path}", body, token(READER)) for _ in range(at_once)]
                statuses = [status for status, _ in await asyncio.gather(*answers)]
                service.note("not answered", 0, sum(status != 200 for status in statuses), "times")


async def hostile_metadata(service: Service, quick: bool) -> None:
    """Clause 7: metadata within the limits that takes long to parse."""
    await service.ask("POST", "/api/v1/find", b'{"timeout_s": 60}', token(READER))
    members = b",".join(b'"%06d":1' % number for number in range(198_000))
    px4, copter = b'{"version":1,"parameters":[{"name":"A","x":%s}]}', b'{"json":{},"G":%s}'
    attributes = b" ".join(b"a%d=''" % number for number in range(500_000))
    files = {
        "198,000 members": px4 % (b"{" + members + b"}"),
        "198,000 strings": px4 % (b"[" + members.replace(b":1", b"") + b"]"),
        "99,000 empty objects": px4 % (b"[" + b"{}," * 99_000 + b"1]"),
        "198,000 lists in lists": px4 % (b"[" + (b"[" * 150 + b"]" * 150 + b",") * 1_300 + b"1]"),
        "4,000,000 escapes": px4 % (b"[" + (b'"' + b"\\n" * 262_000 + b'",') * 15 + b"1]"),
        "65,000 parameters": copter % (b"{" + b",".join(b'"A%05d":{}' % n for n in range(65_000)) + b"}"),
        "500,000 attributes in XML": b"<paramfile><param name='A' %s/></paramfile>" % attributes,
    }
    for what, content in list(files.items())[: 3 if quick else None]:
        service.attack = f"metadata with {what}"
        with service.watched(late=LATE):
            kind = "application/octet-stream"
            status, _ = await service.ask("PUT", f"{C}/metadata", content, token(WRITER), kind=kind)
            service.note("answered with 5xx or not", 0, status >= 500 or not status, "times")


async def many_components(rows: list[Row], quick: bool) -> None:
    """Clause 7: requests of a reader for the maximum number of components, which one sender makes up."""
    count = 100 if quick else 1_000
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind((HERE, 0))
        port = free.getsockname()[1]
    async with serving(rows, f"udpin:{HERE}:{port}", "--no-cache", "--no-fetch") as service:
        beating = asyncio.create_task(beat(port, count))
        try:
            deadline = time.monotonic() + TIMEOUT
            known = 0
            while known < count and time.monotonic() < deadline:
                await asyncio.sleep(0.5)
                _, answer = await service.ask("GET", "/api/v1/components", b"", token(READER))
                known = len(json.loads(answer)["components"])
            assert known == count, known
            for path in ("/api/v1/components", "/api/v1/links", "/metrics"):
                service.attack = f"{count:,} components: GET {path}"
                with service.watched(late=LATE):
                    status, answer = await service.ask("GET", path, b"", token(READER))
                    service.note("not answered", 0, status != 200, "times")
            for at_once in (1, 4):
                service.attack = f"{count:,} components: 5 times {at_once} POST /api/v1/fetch"
                with service.watched():
                    for _ in range(5):
                        requested = [
                            service.ask("POST", "/api/v1/fetch", b'{"timeout_s": 1}', token(READER))
                            for _ in range(at_once)
                        ]
                        statuses = [status for status, _ in await asyncio.gather(*requested)]
                        unexpected = sum(status != 504 for status in statuses)
                        assert not unexpected, statuses
        finally:
            beating.cancel()


async def large_fleet(rows: list[Row], quick: bool) -> None:
    """Clause 7: comparisons of many vehicles in the cache, whose values all differ."""
    vehicles, names = (50, 20) if quick else (999, 160)
    folder = Path(tempfile.mkdtemp())
    place = folder / "fleet.sqlite3"
    everything = [f"P{number:03}" for number in range(names)]
    too_many = [f"P{number:03}*" for number in range(64)]
    posts: list[tuple[str, dict[str, Any], int]] = [
        (f"{names} names", {"names": everything}, 200),
        (f"{names} wanted values", {"values": dict.fromkeys(everything, -1)}, 200),
        ("more than the maximum, by pattern", {"names": ["*", *too_many[1:]]}, 200 if quick else 413),
    ]
    try:
        fill_fleet(place, vehicles, names + 50)
        words = ("sim:px4", "--cache", str(place), "--no-fetch")
        async with serving(rows, *words, folder=folder) as service:
            for what, body, expected in posts:
                service.attack = f"{vehicles:,} vehicles: fleet/diff of {what}"
                with service.watched(late=LATE):
                    status, answer = await service.ask(
                        "POST", "/api/v1/fleet/diff", as_json(body), token(READER)
                    )
                    assert status == expected, answer[:500]
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def fill_fleet(place: Path, vehicles: int, names: int) -> None:
    """Write a cache with the tables of many vehicles; each value is of one vehicle alone, and has changed."""
    at = time.time() - 1_000
    with ParamCache(place) as cache:
        for vehicle in range(vehicles):
            identity = Identity(1 + vehicle % 250, "a", f"{vehicle:036x}", 12, 2, 17_891_392, "a70a5583")
            for add in (0, 1_000_000):
                params = [
                    StoredParam.of(
                        Param(f"P{number:03}", value, ParamType.INT32, number, value), at + add / 1e6
                    )
                    for number in range(names)
                    for value in (add + vehicle * names + number,)
                ]
                state = TableState(1, names, complete=True, volatile_known=True, synced_at=at)
                cache.save(
                    TableUpdate(
                        identity=identity, component=1, autopilot=12, at=at + add / 1e6, table=state,
                        params=params, replace=True,
                    )
                )  # fmt: skip


async def beat(port: int, count: int) -> None:
    """Send the heartbeats of many components to a UDP port, each once a second; until cancelled."""
    frames = []
    for number in range(count):
        mav = common.MAVLink(None, 1 + number % 250, 1 + number // 250)
        frames.append(mav.heartbeat_encode(2, 12, 81, 0, 4).pack(mav))
    with socket.socket(type=socket.SOCK_DGRAM) as peer:
        while True:
            for number, frame in enumerate(frames):
                peer.sendto(frame, (HERE, port))
                if not number % 25:
                    await asyncio.sleep(25 / count)


async def slices(service: Service, quick: bool) -> None:
    """Clause 7: many small things in what one connection sends, and responses that no client reads."""
    for method, path in (("POST", "/api/v1/find"), ("POST", f"{C}/fetch"), ("GET", "/api/v1/ws")):
        await service.ask(method, path, b'{"timeout_s": 60}' if method == "POST" else b"", token(READER))
    chunked = ["Content-Type: application/json", "Transfer-Encoding: chunked"]
    pongs = 1 if quick else 300
    sent = [
        ("2 MB of empty pings", f"GET /api/v1/ws?{UPGRADE}", b"\x89\x80\0\0\0\0" * 350_000, 2),
        ("chunks of 1 byte, a reader", f"POST {C}/diff", b"1\r\n \r\n" * 500_000, 3),
        ("chunks of 1 byte, no token", "POST /api/v1/session", b"1\r\n \r\n" * 500_000, 3),
        (f"{pongs} MB of pings, no pong is read", f"GET /api/v1/ws?{UPGRADE}",
         (b"\x89\xfd\0\0\0\0" + b"p" * 125) * (pongs * MEGABYTE // 131), 25),
    ]  # fmt: skip
    for attack, requested, data, seconds in sent:
        service.attack = attack
        request, _, more = requested.partition("?")
        lines = [f"{request} HTTP/1.1", f"Host: 127.0.0.1:{service.port}"]
        lines += [more] if more else chunked
        lines += [] if "session" in request else [token(READER)]
        with socket.socket() as one:
            one.connect((HERE, service.port))
            one.sendall("\r\n".join([*lines, "", ""]).encode())
            await asyncio.sleep(0.3)
            with service.watched():
                await asyncio.to_thread(
                    push, one, data[: MEGABYTE if quick else None], 1 if quick else seconds
                )
                await asyncio.sleep(0.1 if quick else 0.5)
                await service.reached("/health meanwhile", times=1)


def push(one: socket.socket, data: bytes, seconds: float) -> None:
    """Send as much as is taken in this time."""
    deadline = time.monotonic() + seconds
    rest = memoryview(data)
    one.setblocking(False)
    while rest and time.monotonic() < deadline:
        try:
            rest = rest[one.send(rest[:MEGABYTE]) :]
        except BlockingIOError:
            time.sleep(0.005)
        except OSError:
            return


async def waiting(service: Service, quick: bool) -> None:
    """Clause 7: requests of a reader that wait, each resumed by what another client receives."""
    for path in ("/api/v1/find", f"{C}/fetch"):
        status, answer = await service.ask("POST", path, b'{"timeout_s": 60}', token(READER))
        assert status == 200, answer
    count = 100 if quick else 460
    absent = {"system": 77, "timeout_s": 60}
    for what, path, body in (
        ("find", "/api/v1/find", as_json(absent)),
        ("find with only", "/api/v1/find", as_json(absent, only=True)),
        ("successor", f"{C}/successor", as_json(absent)),
        ("read", f"{C}/params/NO_SUCH_NAME/read", b'{"timeout_s": 60}'),
    ):
        service.attack = f"{count} waiting requests: {what}"
        lines = [f"POST {path} HTTP/1.1", f"Host: 127.0.0.1:{service.port}", token(READER)]
        lines += ["Content-Type: application/json", f"Content-Length: {len(body)}", "", ""]
        data = "\r\n".join(lines).encode() + body
        with service.watched(late=None if quick else LATE), connections(service, 0, HERE) as held:
            for _ in range(count):
                one = socket.create_connection((HERE, service.port))
                held.append(one)
                one.sendall(data)
            await asyncio.sleep(0.5)
            status, answer = await service.ask(
                "POST", f"{C}/fetch", b'{"refresh": true, "timeout_s": 60}', token(WRITER)
            )
            service.note("a fetch of another token fails", 0, status != 200, "times")


async def parsing(service: Service, quick: bool) -> None:
    """Clause 7: calls that hold the interpreter, in whichever thread they run; and the end meanwhile."""
    for path in ("/api/v1/find", f"{C}/fetch", f"{C}/diff"):
        await service.ask("POST", path, b'{"timeout_s": 60}', token(READER))
    numbers = b'{"x":[' + b",".join([b"9" * 4_300] * 730) + b"]}"
    values = b",".join(b'"A%05d":%s' % (number, b"9" * 1_000) for number in range(3_000))
    strings = b",".join(b'"a%05d":"%s"' % (number, b"y" * 20) for number in range(58_000))
    posts = [
        ("730 numbers of 4,300 digits", f"{C}/diff", numbers),
        ("3,000 numbers of 1,000 digits", f"{C}/diff", b'{"wanted":{"values":{' + values + b"}}}"),
        ("a line of 1.9 million digits", "/api/v1/files?name=a.parm", b"P1 " + b"1" * 1_900_000),
        ("58,000 strings in JSON", "/api/v1/files?name=a.json", b"{" + strings + b"}"),
    ]
    for attack, path, body in posts:
        service.attack = attack
        kind = "application/octet-stream" if "/files" in path else "application/json"
        with service.watched(late=LATE):
            status, _ = await service.ask("POST", path, body, token(READER), kind=kind)
            service.note("answered with 5xx or not", 0, status >= 500 or not status, "times")
    service.attack = "SIGTERM with 7 uploads of 58,000 lines"
    rows = b"".join(b"1\t1\tP%05d\t1.5\t9\n" % number for number in range(58_000))
    upload = "/api/v1/files?name=c.params"
    uploads = [
        asyncio.create_task(service.ask("POST", upload, rows, token(READER), kind="application/octet-stream"))
        for _ in range(7)
    ]
    await asyncio.sleep(0.6)
    service.note("it ends", ENDED, await asyncio.to_thread(service.end), "s")
    service.note("exit code", 0, abs(service.process.returncode or 0), "")
    service.note("tracebacks", 0, service.log.count("Traceback"), "")
    await asyncio.gather(*uploads)


async def guesses(service: Service, quick: bool) -> None:
    """Clause 8, with 127.0.0.2 as a trusted proxy."""
    service.attack = "30 wrong tokens, then a right one"
    for sources, shown, limit in (
        ([HERE, HERE], ["", ""], 2.5),
        ([ELSEWHERE, ELSEWHERE], ["X-Forwarded-For: 198.51.100.1", "X-Forwarded-For: 198.51.100.2"], 0.5),
    ):
        proxy = "behind a trusted proxy, another client" if shown[0] else "same address"
        wrong = [service.ask("GET", "/api/v1/me", b"", token(f"wrong-{n:020}"), *filter(None, [shown[0]]),
                             source=sources[0]) for n in range(30)]  # fmt: skip
        await asyncio.gather(*wrong)
        began = time.monotonic()
        status, _ = await service.ask(
            "GET", "/api/v1/me", b"", token(READER), *filter(None, [shown[1]]), source=sources[1]
        )
        took = time.monotonic() - began if status == 200 else TIMEOUT
        service.note(f"right token, {proxy}", limit, took, "s")


async def origins(service: Service, quick: bool) -> None:
    """Clause 8, without tokens."""
    service.attack = "a page of --allow-origin, no tokens"
    writes = 0
    for method, path in (("PUT", f"{C}/params/A"), ("PATCH", f"{C}/params"), ("POST", f"{C}/apply")):
        status, _ = await service.ask(method, path, b"{}", "Origin: https://station.example")
        writes += status != 403
    service.note("writes that are let in", 0, writes, "")


async def stuck_readers(service: Service, quick: bool) -> None:
    """Clause 8."""
    for path in ("/api/v1/find", f"{C}/fetch"):
        await service.ask("POST", path, b'{"timeout_s": 60}', token(READER))
    upgrade = ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13"]
    upgrade.append("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==")
    run = json.loads((await service.ask("GET", "/api/v1/components", b"", token(READER)))[1])["run"]
    wanted = [(f"/api/v1/events?after={run}-0", [], 1), (f"/api/v1/ws?after={run}-0", upgrade, 1)]
    wanted.append(("/openapi.json", [], 90))
    service.attack = "SIGTERM with 12 readers that are stuck"
    held = []
    for path, more, repeats in wanted * 4:
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_096)
        one.connect(("127.0.0.1", service.port))
        lines = [f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{service.port}", token(READER), *more, "", ""]
        one.sendall("\r\n".join(lines).encode() * repeats)
        held.append(one)
    while service.is_busy():  # noqa: ASYNC110 - until the buffers of the system are full
        await asyncio.sleep(0.25)
    took = await asyncio.to_thread(service.end)
    service.note("it ends", ENDED, took, "s")
    service.note("exit code", 0, abs(service.process.returncode or 0), "")
    service.note("tracebacks", 0, service.log.count("Traceback"), "")
    for one in held:
        one.close()


async def locked_cache(rows: list[Row], quick: bool) -> None:
    """Clause 8: another program holds the lock of the cache."""
    folder = Path(tempfile.mkdtemp())
    place = folder / "cache.sqlite3"
    try:
        async with serving(rows, "sim:px4", "--cache", str(place), tokens=False, folder=folder) as service:
            service.attack = "SIGTERM with a locked cache"
            for path in ("/api/v1/find", f"{C}/fetch"):
                await service.ask("POST", path, b'{"timeout_s": 60}')
            await service.ask("GET", f"{C}/history")  # writes what was received
            with contextlib.closing(sqlite3.connect(place, isolation_level=None)) as other:
                other.execute("BEGIN IMMEDIATE")
                await service.ask("PATCH", f"{C}/params", b'{"values": {"MC_ROLL_P": 4.5}}')
                service.note("it ends", ENDED, await asyncio.to_thread(service.end), "s")
            service.note("exit code", 0, abs(service.process.returncode or 0), "")
            service.note("tracebacks", 0, service.log.count("Traceback"), "")
            service.note("lost values are not reported", 0, "and lost: " not in service.log, "")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


async def killed_apply(rows: list[Row], quick: bool) -> None:
    """Clause 8: `kill -9` during an apply, and the report of the next start."""
    folder = Path(tempfile.mkdtemp())
    link = ["sim:px4", "--cache", str(folder / "cache.sqlite3")]
    try:
        async with serving(rows, *link, tokens=False, folder=folder) as service:
            for path in ("/api/v1/find", f"{C}/fetch"):
                await service.ask("POST", path, b'{"timeout_s": 60}')
            table = json.loads((await service.ask("GET", f"{C}/params"))[1])["params"]
            floats = [name for name, each in table.items() if each["type"] == "REAL32"][:300]
            body = as_json({"wanted": {"values": dict.fromkeys(floats, 0.123)}, "wait": False})
            status, answer = await service.ask("POST", f"{C}/apply", body)
            assert status == 202, answer
            name = json.loads(answer)["id"]
            deadline = time.monotonic() + TIMEOUT
            while time.monotonic() < deadline:
                job = json.loads((await service.ask("GET", f"/api/v1/jobs/{name}"))[1])
                if (job["progress"] or {}).get("done") or job["state"] != "running":
                    break
            service.process.kill()
        async with serving(rows, *link, tokens=False, folder=folder) as service:
            service.attack = "kill -9 in an apply"
            jobs = json.loads((await service.ask("GET", "/api/v1/jobs"))[1])["jobs"]
            is_reported = any(job["id"] == name and job["state"] == "cut-off" for job in jobs)
            service.note("missing in the job list", 0, not is_reported, "")
            service.note("missing in the log", 0, "was cut off" not in service.log, "")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


async def udp(rows: list[Row], quick: bool) -> None:
    """Clause 10."""
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind((HERE, 0))
        port = free.getsockname()[1]
    async with serving(rows, f"udpin:{HERE}:{port}", "--no-cache", tokens=False) as service:
        service.attack = "garbage from 100 UDP peers"
        peers = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(100)]
        with service.watched():
            for _ in range(20):
                for peer in peers:
                    peer.sendto(os.urandom(200), (HERE, port))
            await asyncio.sleep(1.0 if quick else 3.0)
        received = 0
        for peer in peers:
            peer.setblocking(False)
            with contextlib.suppress(BlockingIOError, ConnectionError):
                while peer.recv(2_000):
                    received += 1
            peer.close()
        service.note("datagrams back to them", 0, received, "")
        if quick:
            return
        service.attack = "heartbeats of 65,025 systems on UDP"
        watched = service.watched(memory=MEMORY_OF_COMPONENTS, blocked=None)
        with watched, socket.socket(type=socket.SOCK_DGRAM) as peer:
            for number in range(255 * 255):
                mav = common.MAVLink(None, 1 + number % 255, 1 + number // 255)
                beat = mav.heartbeat_encode(2, 12, 81, 0, 4)
                peer.sendto(beat.pack(mav), (HERE, port))
                if not number % 200:
                    await asyncio.sleep(0.02)
            await service.reached("/health, this computer")


def as_json(document: dict[str, Any], **more: Any) -> bytes:
    """Return a document as JSON bytes."""
    return json.dumps({**document, **more}).encode()


# The run


async def attack(quick: bool, only: str) -> list[Row]:
    """Run the groups of attacks whose name contains a text."""
    rows: list[Row] = []

    async def on_service(
        group: Callable[[Service, bool], Awaitable[None]], *words: str, **options: Any
    ) -> None:
        async with serving(rows, *words, **options) as service:
            await group(service, quick)

    sim, bare = ("sim:px4", "--no-cache"), ("sim:px4", "--no-cache", "--no-fetch")
    groups: dict[str, Callable[[], Awaitable[None]]] = {
        "handshakes over TLS": lambda: on_service(handshakes, *bare, tls=True),
        "handshakes without TLS": lambda: on_service(handshakes, *bare),
        "requests": lambda: on_service(requests, *sim),
        "large table": lambda: large_table(rows, quick),
        "extended parameters": lambda: extended_params(rows, quick),
        "long descriptions": lambda: descriptions(rows, quick),
        "hostile metadata": lambda: on_service(hostile_metadata, *bare),
        "similar names": lambda: similar_names(rows, quick),
        "many components": lambda: many_components(rows, quick),
        "large fleet": lambda: large_fleet(rows, quick),
        "slices": lambda: on_service(slices, *sim),
        "waiting": lambda: on_service(waiting, *sim),
        "parsing": lambda: on_service(parsing, *sim),
        "guesses": lambda: on_service(guesses, *bare, "--trusted-proxy", ELSEWHERE),
        "origins": lambda: on_service(
            origins, *bare, "--allow-origin", "https://station.example", tokens=False
        ),
        "stuck readers": lambda: on_service(stuck_readers, *sim),
        "locked cache": lambda: locked_cache(rows, quick),
        "killed apply": lambda: killed_apply(rows, quick),
        "udp": lambda: udp(rows, quick),
    }
    for name, run in groups.items():
        if only in name:
            await run()
    return rows


def table(rows: Iterable[Row]) -> str:
    """Return the rows as text."""
    cells = [("attack", "what", "limit", "measured", "", "held")]
    cells += [
        (
            row.attack,
            row.what,
            f"{row.limit:g}",
            f"{row.measured:.4g}",
            row.unit,
            "yes" if row.is_held else "NO",
        )
        for row in rows
    ]
    widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]
    lines = []
    for line in cells:
        left = [text.ljust(width) for text, width in zip(line[:2], widths[:2], strict=True)]
        right = [text.rjust(width) for text, width in zip(line[2:], widths[2:], strict=True)]
        lines.append("  ".join([*left, *right]).rstrip())
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Attack the service and its clients.")
    parser.add_argument("--quick", action="store_true", help="only what takes about a second each")
    parser.add_argument("--only", default="", help="only the groups whose name holds this text")
    parser.add_argument("--json", action="store_true", help="the table as JSON")
    parser.add_argument("--slack", type=float, default=1.0, help="multiply limits of time, on a busy machine")
    arguments = parser.parse_args()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 4_096)), hard))
    rows = asyncio.run(attack(arguments.quick, arguments.only))
    for row in rows:
        row.limit *= arguments.slack if row.unit in ("s", "ms") else 1
    if arguments.json:
        print(json.dumps([{**dataclasses.asdict(row), "held": row.is_held} for row in rows], indent=1))
    else:
        print(table(rows))
    return int(not all(row.is_held for row in rows))


if __name__ == "__main__":
    sys.exit(main())
