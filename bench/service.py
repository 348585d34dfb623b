"""Cost of the service: its share of a core with many listeners, many reads and a download concurrently.

    python bench/service.py [--listeners N] [--reads N] [--seconds S] [--check]

Uses three processes on loopback: a simulated vehicle (`paramclient sim`), the service (`paramclient serve`,
limited to one core if the system allows it), and this one, which has the clients. First all listeners open
their event streams, then the table is downloaded repeatedly, while single cached values are read at a
constant rate, independent of the responses.

Prints the share of a core that the service used (its CPU time divided by the duration of the reads), the
latency of a read from the time at which it was due, and whether every listener received every event in order.
With `--check`, fails if a target is missed. Other load on the machine increases the latency, and hardly the
share.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

LISTENERS = 200
"""The target for the number of listeners."""
READS = 500
"""The target for the rate of reads, per second."""
LOAD_MAX = 1.0
"""The target for the CPU time, as a share of a core."""
LATENCY_MAX = 0.25
"""The target for the latency of 99 of 100 reads, in seconds."""

NAMES = ("MC_ROLL_P", "BAT1_N_CELLS", "COM_ARM_WO_GPS")
"""The parameters that are read."""
CONNECTIONS = 20
"""Connections for the reads: each sends one request at a time, like one program."""
RESPONSE_TIMEOUT = 30.0
"""Seconds to wait for the start of a process, and for the last event."""

_EVENT = re.compile(rb"^id: [0-9a-f]+-(\d+)\ndata: ", re.MULTILINE)


@dataclass
class Figures:
    """The measured figures."""

    reads: int = 0
    downloads: int = 0
    cpu: float = 0.0
    elapsed: float = 0.0
    latencies: list[float] = field(default_factory=list)


@dataclass
class Listener:
    """One event stream: numbers of the received events, and the last bytes, which may be half an event."""

    first: int | None = None
    last: int = 0
    events: int = 0
    is_whole: bool = True
    rest: bytes = b""

    def take(self, chunk: bytes) -> None:
        """Process received bytes. Chunks of the transfer have whole events, so they are not decoded."""
        text = self.rest + chunk
        end = text.rfind(b"\n\n") + 2
        self.rest = text[end:] if end > 1 else text
        for found in _EVENT.finditer(text, 0, max(end, 0)):
            number = int(found[1])
            if self.first is None:
                self.first = number
            else:
                self.is_whole &= number == self.last + 1
                self.events += 1
            self.last = number


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--listeners", type=int, default=LISTENERS, help="streams of events")
    parser.add_argument("--reads", type=int, default=READS, help="reads a second")
    parser.add_argument("--seconds", type=float, default=10.0, help="for which it is read")
    parser.add_argument("--check", action="store_true", help="fail when a target is missed")
    arguments = parser.parse_args()
    print(f"Python {sys.version.split()[0]}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with started("sim", "px4", "--link", "udpin:127.0.0.1:0") as (_, vehicle):
        link = vehicle.replace("udpin", "udpout")
        with started("serve", link, "--listen", "127.0.0.1:0", "--no-cache", "--no-fetch") as (server, url):
            hold_to_one_core(server)
            figures, listeners = asyncio.run(
                measure(url, server.pid, arguments.listeners, arguments.reads, arguments.seconds)
            )
    return 1 if not show(figures, listeners, arguments.reads) and arguments.check else 0


def show(figures: Figures, listeners: list[Listener], rate: int) -> bool:
    """Print the figures; return whether every target is met."""
    reported = min((each.events for each in listeners), default=0)
    whole = sum(each.is_whole for each in listeners)  # each has received all events up to the last one
    share = figures.cpu / figures.elapsed
    cuts = statistics.quantiles(figures.latencies, n=100)
    are_met = [
        whole == len(listeners),
        share <= LOAD_MAX,
        cuts[98] <= LATENCY_MAX,
    ]
    print(
        f"{len(listeners)} listeners: {whole} received every one of {reported:,} events or more, in order"
        f"{verdict(are_met[0])}\n"
        f"{figures.reads:,} reads at {rate} a second, beside {figures.downloads} downloads: "
        f"{1000 * cuts[49]:.1f} ms each, {1000 * cuts[98]:.1f} ms for the slowest of 100 "
        f"(target {1000 * LATENCY_MAX:.0f} ms){verdict(are_met[2])}\n"
        f"{share:.2f} of a core in {figures.elapsed:.1f} s (target {LOAD_MAX:.2f}){verdict(are_met[1])}"
    )
    return all(are_met)


def verdict(is_met: bool) -> str:
    return ": met" if is_met else ": missed"


async def measure(
    url: str, process: int, count: int, rate: int, seconds: float
) -> tuple[Figures, list[Listener]]:
    """Listen, download and read; return the figures."""
    host, port = url.removeprefix("http://").rsplit(":", 1)
    where = (host, int(port))
    listeners = [Listener() for _ in range(count)]
    figures = Figures()
    async with connection(where) as calls:
        await call(calls, "POST", "/api/v1/find", {"timeout_s": RESPONSE_TIMEOUT})
        following = [asyncio.create_task(listen(where, each)) for each in listeners]
        await until(lambda: all(each.first is not None for each in listeners))
        for name in NAMES:
            await call(calls, "POST", f"/api/v1/components/1/1/params/{name}/read", {})
        cpu = cpu_time(process)
        downloading = asyncio.create_task(download(where, figures))
        await read_evenly(where, rate, seconds, figures)
        figures.elapsed, figures.cpu = seconds, cpu_time(process) - cpu
        downloading.cancel()
        await asyncio.sleep(1.0)  # the end of a download is an event too
        last = await call(calls, "GET", "/api/v1/components")
        await until(lambda: all(each.last >= last["seq"] for each in listeners))
        for each in following:
            each.cancel()
    return figures, listeners


async def until(condition: Callable[[], bool]) -> None:
    """Poll until a condition is true."""
    async with asyncio.timeout(RESPONSE_TIMEOUT):
        while not condition():  # noqa: ASYNC110 - no event
            await asyncio.sleep(0.02)


async def listen(where: tuple[str, int], listener: Listener) -> None:
    """Receive events until cancelled."""
    async with connection(where) as (reader, writer):
        writer.write(head("GET", "/api/v1/events", b""))
        while chunk := await reader.read(1 << 16):
            listener.take(chunk)


async def download(where: tuple[str, int], figures: Figures) -> None:
    """Download the table repeatedly until cancelled."""
    async with connection(where) as calls:
        while True:
            await call(calls, "POST", "/api/v1/components/1/1/fetch", {"refresh": True})
            figures.downloads += 1


async def read_evenly(where: tuple[str, int], rate: int, seconds: float, figures: Figures) -> None:
    """Read cached values at a rate; the latency of a read includes its wait for a free connection."""
    due: asyncio.Queue[float | None] = asyncio.Queue()

    async def read() -> None:
        async with connection(where) as calls:
            while (at := await due.get()) is not None:
                name = NAMES[figures.reads % len(NAMES)]
                figures.reads += 1
                await call(calls, "GET", f"/api/v1/components/1/1/params/{name}")
                figures.latencies.append(time.monotonic() - at)

    async with asyncio.TaskGroup() as tasks:
        for _ in range(CONNECTIONS):
            tasks.create_task(read())
        began = time.monotonic()
        for number in range(int(rate * seconds)):
            at = began + number / rate
            if (wait := at - time.monotonic()) > 0:
                await asyncio.sleep(wait)
            due.put_nowait(at)
        for _ in range(CONNECTIONS):
            due.put_nowait(None)


Calls = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def connection(where: tuple[str, int]) -> AsyncIterator[Calls]:
    reader, writer = await asyncio.open_connection(*where, limit=1 << 24)
    try:
        yield reader, writer
    finally:
        writer.close()


async def call(calls: Calls, method: str, path: str, body: object = None) -> dict[str, int]:
    """Send one request and return its response, with minimal HTTP: the clients are not measured."""
    reader, writer = calls
    content = b"" if body is None else json.dumps(body).encode()
    writer.write(head(method, path, content) + content)
    answer = await reader.readuntil(b"\r\n\r\n")
    length = re.search(rb"content-length: (\d+)", answer)
    assert length is not None, answer
    text = await reader.readexactly(int(length[1]))
    assert answer.split(b" ", 2)[1] == b"200", text
    found: dict[str, int] = json.loads(text)
    return found


def head(method: str, path: str, content: bytes) -> bytes:
    lines = [f"{method} {path} HTTP/1.1", "host: 127.0.0.1", f"content-length: {len(content)}"]
    lines += ["content-type: application/json"] if content else []
    return "\r\n".join([*lines, "", ""]).encode()


@contextmanager
def started(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the command in a new process; yield it with the address that it prints first."""
    process = subprocess.Popen(
        [sys.executable, "-m", "paramclient", *words], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"(?:udpin:|http://)[\d.:]+\d", line)
        assert found, f"{words[0]} says {line!r}"
        yield process, found[0]
    finally:
        process.terminate()
        process.wait(RESPONSE_TIMEOUT)


def hold_to_one_core(process: subprocess.Popen[str]) -> None:
    """Limit the service to one core, if the system allows it."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, {max(os.sched_getaffinity(0))})


def cpu_time(process: int) -> float:
    """Return the CPU seconds of a process (Linux, proc(5): utime and stime)."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
