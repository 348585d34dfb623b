"""Downloads by ground stations through the gateway, beside direct ones.

    python bench/gateway.py [--limit SECONDS] [--only TEXT ...] [--skip-direct]

Simulated PX4 and ArduPilot vehicles are behind a link with packet loss and a round trip of 100 ms, or at
57600 baud. Each station of `peers.py` downloads all parameters directly, then through a gateway whose table
is in sync, then all stations at once, and all at once while the gateway itself still fetches. The values are
compared with those of the vehicle. Stations reach the gateway over real UDP, each in its own process.

Prints a Markdown table: seconds, and the parameter datagrams on the vehicle's link meanwhile.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import anyio
from peers import CLIENTS, LIMIT, Case, Outcome, choose, free_port, installed, machine, versions

from paramclient.links import create_link
from paramclient.service import Hub
from paramclient.service.stations import MavlinkEndpoint
from paramclient.sim import Air
from paramclient.wire.frames import Framer

SYNC_TIMEOUT = 120.0
"""Seconds until the gateway's table is in sync."""
BAUD_RATE = 57600 / 10
"""Bytes per second at 57600 baud."""
STATIONS = {"pymavlink, the usual loop": "pymavlink", "MAVSDK": "mavsdk", "MAVProxy": "MAVProxy"}
"""The stations of `peers.py`, and their packages."""
PARAMETERS = frozenset({20, 21, 22, 23, 110, 320, 321, 322, 323, 324, 345})
"""Messages about parameters, and MAVFTP."""
REQUESTS = frozenset({21, 110})
"""Messages with which a station begins a download."""

spawn = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class RadioCase(Case):
    """A vehicle behind a radio.

    Attributes:
        rate: bytes per second; None for no limit.
    """

    rate: float | None = None

    @property
    def link(self) -> str:
        """See `Case.link`."""
        return f"57600 baud, {self.loss:.0%}" if self.rate else super().link

    def air(self, seed: int) -> Air:
        """See `Case.air`."""
        if self.rate is None:
            return super().air(seed)
        return Air.symmetric([self.vehicle()], loss=self.loss, rate=self.rate, delay=0.02, seed=seed)


@dataclass(frozen=True)
class StationCase(RadioCase):
    """The same vehicle, as a station sees it through a running gateway.

    Attributes:
        port: to which the gateway sends.
        requested_at: when the station asked first.
    """

    port: int = 0
    requested_at: Any = None

    @contextmanager
    def flying(self, seed: int) -> Iterator[tuple[int, Any]]:
        """See `Case.flying`: the gateway runs already."""
        self.requested_at.value = math.inf
        yield self.port, self.requested_at


class CountedAir:
    """An endpoint that counts the datagrams about parameters, in both directions."""

    def __init__(self, air: Air, count: Any) -> None:
        self._air = air
        self._count = count
        self._framer = Framer(PARAMETERS, stream=False)
        self.tick = air.tick
        self.next_deadline = air.next_deadline

    def receive(self, data: bytes, now: float) -> None:
        self._note(data)
        self._air.receive(data, now)

    def data_to_send(self) -> list[bytes]:
        sent = self._air.data_to_send()
        for data in sent:
            self._note(data)
        return sent

    def _note(self, data: bytes) -> None:
        self._count.value += bool(self._framer.receive(data))


def serve(
    case: RadioCase, seed: int, ports: Sequence[int], asked: Sequence[Any], count: Any, ready: Any
) -> None:
    """Run a gateway with an endpoint for each port, until the process is ended."""

    async def run() -> None:
        endpoints = [MavlinkEndpoint(WatchedLink(port, at)) for port, at in zip(ports, asked, strict=True)]
        async with Hub([CountedAir(case.air(seed), count)], cache=False, mavlink=endpoints) as hub:
            while not (hub.targets and hub.targets[0].component.sync_state == "synced"):  # noqa: ASYNC110 - no event
                await anyio.sleep(0.02)
            ready.set()
            await anyio.sleep_forever()

    anyio.run(run)


class WatchedLink:
    """A link to a station that notes when it first asks for a list or a file."""

    def __init__(self, port: int, asked_at: Any) -> None:
        self._link: Any = create_link(f"udpout:127.0.0.1:{port}")
        self._asked_at = asked_at
        self._framer = Framer(REQUESTS, stream=False)
        self.name, self.is_stream, self.reconnects = self._link.name, False, True
        self.open, self.send, self.close = self._link.open, self._link.send, self._link.close

    async def receive(self) -> Any:
        chunks = await self._link.receive()
        if self._asked_at.value == math.inf and any(self._framer.receive(data) for _, data in chunks):
            self._asked_at.value = time.monotonic()
        return chunks


@contextmanager
def gateway(
    case: RadioCase, seed: int, stations: Sequence[str]
) -> Iterator[tuple[dict[str, StationCase], Any, Any]]:
    """Run a gateway in its own process.

    Yields the case of each station, the number of datagrams, and the event of its table in sync.
    """
    ports = [free_port() for _ in stations]
    asked = [spawn.Value("d", math.inf) for _ in stations]
    count, ready = spawn.Value("i", 0), spawn.Event()
    process = spawn.Process(target=serve, args=(case, seed, ports, asked, count, ready))
    process.start()
    try:
        yield (
            {
                name: StationCase(case.kind, case.loss, way_of(name, case), case.rate, port, at)
                for name, port, at in zip(stations, ports, asked, strict=True)
            },
            count,
            ready,
        )
    finally:
        process.kill()
        process.join()


def way_of(station: str, case: Case) -> str:
    """Return how a station fetches: by file only if it can."""
    return case.way if case.way in CLIENTS[station].ways else "list"


def all_at_once(cases: dict[str, StationCase], seed: int, limit: float) -> dict[str, Outcome]:
    """Let all stations download at once."""
    with ThreadPoolExecutor(len(cases)) as threads:
        running = {name: threads.submit(CLIENTS[name].run, each, seed, limit) for name, each in cases.items()}
        return {name: each.result() for name, each in running.items()}


def measure(case: RadioCase, stations: Sequence[str], limit: float, *, direct: bool) -> list[list[str]]:
    """Return the cells of each station in one case."""
    seed = 1
    columns: list[dict[str, Outcome]] = []
    if direct:
        runs = {name: replace(case, way=way_of(name, case)) for name in stations}
        columns.append({name: CLIENTS[name].run(each, seed, limit) for name, each in runs.items()})
    with gateway(case, seed, stations) as (cases, count, ready):
        if not ready.wait(SYNC_TIMEOUT):
            raise SystemExit(f"{case.name}: the gateway's table is not in sync after {SYNC_TIMEOUT:.0f} s")
        before = count.value
        columns.append({name: CLIENTS[name].run(each, seed, limit) for name, each in cases.items()})
        datagrams = count.value - before
        columns.append(all_at_once(cases, seed, limit))
    with gateway(case, seed, stations) as (cases, _, _):
        columns.append(all_at_once(cases, seed, limit))
    print(f"{case.name}: {columns}", file=sys.stderr, flush=True)
    return [[name, *(cell(column[name]) for column in columns), str(datagrams)] for name in stations]


def cell(outcome: Outcome) -> str:
    """Return an outcome in words."""
    wrong = f", {outcome.wrong} wrong" if outcome.wrong else ""
    return f"{outcome.problem or f'{outcome.seconds:.2f}'}{wrong}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds that one download may take")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="cases whose names hold one")
    parser.add_argument("--skip-direct", action="store_true", help="no direct downloads")
    arguments = parser.parse_args()
    kinds = (("PX4", "list"), ("ArduPilot", "list"), ("ArduPilot", "file"))
    cases = [RadioCase(kind, loss, way) for kind, way in kinds for loss in (0.0, 0.05, 0.20)]
    cases += [RadioCase(kind, 0.05, way, BAUD_RATE) for kind, way in kinds]
    names = choose([case.name for case in cases], arguments.only)
    stations = [name for name, package in STATIONS.items() if installed(package) != "not installed"]
    heads = ["vehicle, link", "station", *([] if arguments.skip_direct else ["direct"]), "in sync"]
    heads += ["in sync, all at once", "cold, all at once", "parameter datagrams on the radio, in sync"]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    loads = []
    for case in cases:
        if case.name in names:
            for cells in measure(case, stations, arguments.limit, direct=not arguments.skip_direct):
                print(f"| {case.name} | {' | '.join(cells)} |", flush=True)
            loads.append(os.getloadavg()[0])
    print(
        f"\nSeconds. {time.strftime('%Y-%m-%d')}, {machine()}, load {min(loads):.1f} to {max(loads):.1f}. "
        f"{versions()}."
    )


if __name__ == "__main__":
    main()
