"""Memory of a gateway, and its answers, beside stations that misbehave and with many stations.

    python bench/flood.py [--seconds 60] [--requests 10000]

`paramclient serve` runs with ten simulated vehicles on a link. While one station sends 10,000 requests a
second, one random bytes and one asks for lists that it never reads, a further one fetches all parameters of
a vehicle again and again. Then 20 stations fetch those of all vehicles at once. Each value is compared with
that of its vehicle.

Prints a Markdown table: megabytes of resident memory, seconds of one fetch, and values.
"""

from __future__ import annotations

import argparse
import multiprocessing
import random
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.process import BaseProcess
from typing import TypeAlias

import anyio
from peers import free_port, machine

from paramclient import Param, ParamClient
from paramclient.links import create_link, serve_endpoint
from paramclient.protocol.fetch import differing
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.wire.messages import Message, ParamRequestList, ParamRequestRead, encode

VEHICLES = 10
STATIONS = 20
SETTLING_TIME = 5.0
"""Seconds after which the memory in sync is measured."""
TIMEOUT = 60.0
"""Seconds until the vehicles are heard, and until a fetch has ended."""
REQUESTS: list[Message] = [
    ParamRequestRead(1, 1, "MC_YAW_P", -1),
    ParamRequestRead(2, 1, "", 500),
    ParamRequestRead(1, 1, "NO_SUCH", -1),
    ParamRequestList(1, 1),
    ParamRequestList(0, 0),
]
"""What the flood consists of."""

Vehicles: TypeAlias = Mapping[int, Mapping[str, Param]]
"""The parameters of vehicles, by system id."""

spawn = multiprocessing.get_context("spawn")


@dataclass
class Row:
    """What was measured while one thing happened."""

    name: str
    megabytes: list[float] = field(default_factory=list)
    seconds: float = 0.0  # of the slowest fetch
    values: int = 0
    wrong: int = 0

    def __str__(self) -> str:
        first, most, last = self.megabytes[0], max(self.megabytes), self.megabytes[-1]
        memory = f"{first:.0f} | {most:.0f} | {last:.0f}"
        return f"| {self.name} | {memory} | {self.seconds:.2f} | {self.values:,} | {self.wrong} |"


def fleet() -> list[PX4Vehicle | ArduPilotVehicle]:
    """Return the vehicles, which change nothing themselves."""
    kinds = (PX4Vehicle, partial(ArduPilotVehicle, live=()))
    return [kinds[number % 2](system=number + 1) for number in range(VEHICLES)]


def fly(port: int) -> None:
    """Run the vehicles, sending to a port, until the process is ended."""
    anyio.run(serve_endpoint, Air(fleet()), create_link(f"udpout:127.0.0.1:{port}"))


def flood(port: int, per_second: int) -> None:
    """Send requests and read no answer, until the process is ended."""
    frames = [encode(each, system=251, component=190, sequence=0) for each in REQUESTS]
    station, began, sent = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), time.monotonic(), 0
    while True:
        for number in range(sent, sent + 100):
            station.sendto(frames[number % len(frames)], ("127.0.0.1", port))
        sent += 100
        time.sleep(max(0.0, began + sent / per_second - time.monotonic()))


def babble(port: int) -> None:
    """Send random bytes, until the process is ended."""
    with socket.create_connection(("127.0.0.1", port)) as station:
        while True:
            station.sendall(random.randbytes(4096))
            time.sleep(0.002)


def stare(port: int) -> None:
    """Ask for lists and read none, until the process is ended; the gateway ends the connection sometimes."""
    while True:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port)) as station:
            while True:
                station.sendall(encode(ParamRequestList(1, 1), system=252, component=190, sequence=0))
                time.sleep(0.05)


@contextmanager
def running(*processes: BaseProcess) -> Iterator[None]:
    """Run processes until the end of the block."""
    for each in processes:
        each.start()
    try:
        yield
    finally:
        for each in processes:
            each.kill()
            each.join()


def megabytes(process: int) -> float:
    """Return the resident memory of a process."""
    shown = subprocess.run(["ps", "-o", "rss=", "-p", str(process)], capture_output=True, check=True)
    return int(shown.stdout) / 1024


async def fetch(link: str, system: int, vehicles: Vehicles, row: Row) -> None:
    """Fetch all parameters of these vehicles, and add to the row what it took and gave."""
    async with ParamClient(link, cache=False, system=system) as client:
        components = [await client.component(each, 1, timeout=TIMEOUT) for each in vehicles]
        began = time.monotonic()
        async with anyio.create_task_group() as tasks:
            for each in components:
                tasks.start_soon(each.fetch_all)
        row.seconds = max(row.seconds, time.monotonic() - began)
        row.values += sum(len(each.params) for each in components)
        row.wrong += sum(len(differing(vehicles[each.system], each.params)) for each in components)


@asynccontextmanager
async def watched(process: int, row: Row) -> AsyncIterator[None]:
    """Note the memory of a process at the begin, twice a second, and at the end."""

    async def watch() -> None:
        while True:
            row.megabytes.append(megabytes(process))
            await anyio.sleep(0.5)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(watch)
        yield
        tasks.cancel_scope.cancel()
    row.megabytes.append(megabytes(process))


async def measure(process: int, udp: int, tcp: int, options: argparse.Namespace) -> list[Row]:
    """Return the rows of the table."""
    vehicles: Vehicles = {each.system: each.params for each in fleet()}
    links = [f"udpout:127.0.0.1:{udp}", f"tcp:127.0.0.1:{tcp}"]
    one = Row(f"{VEHICLES} vehicles, 1 station")
    bad = Row(f"{options.requests:,} requests a second, random bytes, and lists that are not read")
    many = Row(f"{STATIONS} stations at once, in one process")
    await fetch(links[0], 200, vehicles, one)
    await anyio.sleep(SETTLING_TIME)
    one.megabytes.append(megabytes(process))
    stations = (
        spawn.Process(target=flood, args=(udp, options.requests)),
        spawn.Process(target=babble, args=(tcp,)),
        spawn.Process(target=stare, args=(tcp,)),
    )
    async with watched(process, bad):
        with running(*stations):
            ends_at = time.monotonic() + options.seconds
            while time.monotonic() < ends_at:
                await fetch(links[0], 201, {1: vehicles[1]}, bad)
    async with watched(process, many), anyio.create_task_group() as tasks:
        for number in range(STATIONS):
            tasks.start_soon(fetch, links[number % 2], 200 + number, vehicles, many)
    return [one, bad, many]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of the flood")
    parser.add_argument("--requests", type=int, default=10_000, help="of the flood, each second")
    options = parser.parse_args()
    radio, udp, tcp = free_port(), free_port(), free_port()
    endpoints = ["--mavlink", f"udpin:127.0.0.1:{udp}", "--mavlink", f"tcpin:127.0.0.1:{tcp}"]
    command = [sys.executable, "-m", "paramclient", "serve", f"udpin:127.0.0.1:{radio}", *endpoints]
    with ExitStack() as stack:
        gateway = stack.enter_context(subprocess.Popen([*command, "--no-cache", "--listen", "127.0.0.1:0"]))
        stack.callback(gateway.terminate)
        stack.enter_context(running(spawn.Process(target=fly, args=(radio,))))
        rows = anyio.run(measure, gateway.pid, udp, tcp, options)
    print("| through the gateway | MB at first | at most | at last | slowest fetch, s | values | wrong |")
    print("|---|---|---|---|---|---|---|")
    print(*rows, sep="\n")
    print(f"\n{time.strftime('%Y-%m-%d')}, {machine()}.")
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
