"""Downloads by ground stations through the gateway, beside direct ones.

    python bench/gateway.py [--only TEXT ...] [--skip-direct] [--mavproxy COMMAND] [--live LINK]

Simulated PX4 and ArduPilot vehicles are behind a link with packet loss and a round trip of 100 ms, or at
57600 baud. pymavlink's usual loop, MAVSDK, and MAVProxy (of an ArduPilot by list and by file) download all
parameters: directly; through a gateway whose table is in sync, one after the other and all at once; all at
once through a gateway that has just heard the vehicle; and through one that is fetching the table. The values
are compared with those of the vehicle. Stations reach the gateway over real UDP, each in its own process.

With `--live`, the vehicle is the one on this link, behind the relay of `tests/live/relay.py`, which at 57600
baud leaves telemetry out; values that it changes itself are not compared. Nothing is changed on the vehicle.

Prints a Markdown table: seconds from the first request to the last value, and the datagrams about parameters
on the vehicle's link while the stations downloaded from the table in sync.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import anyio
from peers import (
    CLIENTS,
    LIMIT,
    LOSSES,
    ROUND_TRIP,
    SESSION_PAUSE,
    Case,
    LiveCase,
    LiveField,
    MavProxy,
    Outcome,
    PythonClient,
    choose,
    free_port,
    machine,
    versions,
)

from paramclient.links import Link, create_link
from paramclient.service import Hub
from paramclient.service.stations import MavlinkEndpoint
from paramclient.sim import Air
from paramclient.wire.frames import Framer
from tests.live.relay import Conditions, Relay

SYNC_TIMEOUT = 120.0
"""Seconds until the gateway's table is in sync."""
BAUD_RATE = 57600 / 10
"""Bytes per second at 57600 baud."""
RADIO_DELAY = 0.02
"""Seconds in one direction of a radio at 57600 baud, besides the time that the bytes take."""
QUIET_TIME = 2.0
"""Seconds without a datagram about parameters after which a fetch is over: a slow radio has a queue."""
START_TIME = 5.0
"""Seconds after which all stations wait for a heartbeat, when the gateway is to begin after them."""
PARAMETERS = frozenset({20, 21, 22, 23, 110, 320, 321, 322, 323, 324, 345})
"""Messages about parameters, and MAVFTP."""
BY_FILE = "MAVProxy by file"
"""The station that downloads the file, which PX4 does not have."""
REQUESTS = frozenset({21, 110})
"""Messages with which a station begins a download."""

spawn = multiprocessing.get_context("spawn")


class Station(NamedTuple):
    """A kind of ground station: a client of `peers.py`, and how it downloads."""

    client: PythonClient | MavProxy
    way: str


@dataclass(frozen=True)
class Radio:
    """A vehicle behind a radio.

    Attributes:
        kind: the kind of vehicle.
        loss: the share of lost datagrams in each direction.
        rate: bytes per second; None for no limit.
        field: the relay to a real vehicle; None for a simulated one.
    """

    kind: str
    loss: float
    rate: float | None = None
    field: LiveField | None = None

    @property
    def name(self) -> str:
        link = f"{self.loss:.0%}" if self.loss else "clean"
        return f"{self.kind} {'57600 baud, ' if self.rate else ''}{link}"

    @property
    def has_file(self) -> bool:
        """Whether the vehicle serves its parameters as a file."""
        return self.kind.endswith("ArduPilot")

    @property
    def conditions(self) -> Conditions:
        delay = RADIO_DELAY if self.rate else ROUND_TRIP / 2 if self.loss else 0.0
        is_slow = self.rate is not None  # and the vehicle is set to send little telemetry
        return Conditions(
            loss=self.loss, round_trip=2 * delay, rate=self.rate, seed=1, drops_telemetry=is_slow
        )

    def case(self, way: str) -> Case:
        """Return the case in which a station is connected to the vehicle."""
        if self.field is None:
            return DirectCase(self.kind, self.loss, way, self)
        return LiveRadioCase(self.kind, self.loss, way, self.field, self)

    @contextmanager
    def link(self) -> Iterator[SimulatedRadio | RelayedRadio]:
        """Yield what makes the gateway's link in its process."""
        if self.field is None:
            yield SimulatedRadio(self)
        else:
            time.sleep(SESSION_PAUSE)
            self.field.relay.change(self.conditions)
            yield RelayedRadio(self.field.port)


class SimulatedRadio(NamedTuple):
    """Makes the link to a simulated vehicle."""

    radio: Radio

    def __call__(self) -> Link:
        return create_link(self.radio.case("file").air(1))


class RelayedRadio(NamedTuple):
    """Makes the link to the relay of a real vehicle."""

    port: int

    def __call__(self) -> Link:
        return create_link(f"udpin:127.0.0.1:{self.port}")


@dataclass(frozen=True)
class DirectCase(Case):
    """A simulated vehicle behind a radio, as `peers.py` has it without a rate."""

    radio: Radio | None = None

    def air(self, seed: int) -> Air:
        """See `Case.air`."""
        assert self.radio is not None
        faults = self.radio.conditions
        return Air.symmetric(
            [self.vehicle()], loss=faults.loss, delay=faults.round_trip / 2, rate=faults.rate, seed=seed
        )


@dataclass(frozen=True)
class LiveRadioCase(LiveCase):
    """A real vehicle behind the relay, which serves its file as well."""

    radio: Radio | None = None

    @contextmanager
    def flying(self, seed: int) -> Iterator[tuple[int, Any]]:
        """See `Case.flying`."""
        assert self.radio is not None
        time.sleep(SESSION_PAUSE)
        self._field.relay.change(self.radio.conditions)
        yield self._field.port, self._field


class ThroughGateway:
    """A vehicle as a station sees it behind a gateway that runs already: a case of `peers.py`.

    Args:
        case: of the vehicle.
        port: to which the gateway sends.
        requested_at: when the station asked first.
    """

    def __init__(self, case: Case, port: int, requested_at: Any) -> None:
        self.truth, self.is_settled, self.way = case.truth, case.is_settled, case.way
        self.port = port
        self.requested_at = requested_at

    @contextmanager
    def flying(self, seed: int) -> Iterator[tuple[int, Any]]:
        """See `Case.flying`."""
        self.requested_at.value = math.inf
        yield self.port, self.requested_at


class CountingLink:
    """A link that counts the datagrams about parameters, in both directions."""

    def __init__(self, link: Any, count: Any) -> None:
        self._link = link
        self._count = count
        self._framer = Framer(PARAMETERS, stream=False)
        self.name, self.is_stream, self.reconnects = link.name, link.is_stream, link.reconnects
        self.open, self.close = link.open, link.close

    async def receive(self) -> Any:
        chunks = await self._link.receive()
        for _, data in chunks:
            self._note(data)
        return chunks

    async def send(self, data: bytes, peer: Any) -> None:
        self._note(data)
        await self._link.send(data, peer)

    def _note(self, data: bytes) -> None:
        self._count.value += bool(self._framer.receive(data))


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


@dataclass
class RunningGateway:
    """A gateway in a process of its own, with an endpoint for each station.

    Attributes:
        cases: of each station, by its name.
        count: datagrams about parameters on the vehicle's link.
        fetch_time: seconds from the vehicle's first message to the table in sync; infinite before.
        synced: set with the table in sync.
    """

    cases: dict[str, Any]
    count: Any
    fetch_time: Any
    synced: Any

    def wait(self) -> None:
        """Wait for the table in sync, and until nothing of its fetch is on its way any more."""
        if not self.synced.wait(SYNC_TIMEOUT):
            raise SystemExit(f"the gateway's table is not in sync after {SYNC_TIMEOUT:.0f} s")
        before = -1
        while self.count.value != before:
            before = self.count.value
            time.sleep(QUIET_TIME)

    @classmethod
    @contextmanager
    def over(
        cls, radio: Radio, stations: dict[str, Station], *, delay: float = 0.0
    ) -> Iterator[RunningGateway]:
        """Run a gateway; it opens the vehicle's link after a delay in seconds."""
        ports = {name: free_port() for name in stations}
        asked = {name: spawn.Value("d", math.inf) for name in stations}
        count, fetch_time, synced = spawn.Value("i", 0), spawn.Value("d", math.inf), spawn.Event()
        with radio.link() as make:
            arguments = (make, [*ports.values()], [*asked.values()], count, fetch_time, synced, delay)
            process = spawn.Process(target=serve, args=arguments)
            process.start()
            try:
                cases = {
                    name: ThroughGateway(radio.case(station.way), ports[name], asked[name])
                    for name, station in stations.items()
                }
                yield cls(cases, count, fetch_time, synced)
            finally:
                process.kill()
                process.join()


def serve(
    make: Callable[[], Link],
    ports: Sequence[int],
    asked: Sequence[Any],
    count: Any,
    fetch_time: Any,
    synced: Any,
    delay: float,
) -> None:
    """Run a gateway until the process is ended."""

    async def run() -> None:
        endpoints = [MavlinkEndpoint(WatchedLink(port, at)) for port, at in zip(ports, asked, strict=True)]
        await anyio.sleep(delay)
        async with Hub([CountingLink(make(), count)], cache=False, mavlink=endpoints) as hub:
            while not hub.targets:  # noqa: ASYNC110 - no event
                await anyio.sleep(0.005)
            began = time.monotonic()
            while hub.targets[0].component.sync_state != "synced":  # noqa: ASYNC110 - no event
                await anyio.sleep(0.01)
            fetch_time.value = time.monotonic() - began
            synced.set()
            await anyio.sleep_forever()

    anyio.run(run)


def one_by_one(stations: dict[str, Station], cases: dict[str, Any], limit: float) -> dict[str, Outcome]:
    """Let each station download alone."""
    return {name: station.client.run(cases[name], 1, limit) for name, station in stations.items()}


def all_at_once(stations: dict[str, Station], cases: dict[str, Any], limit: float) -> dict[str, Outcome]:
    """Let all stations download at once."""
    with ThreadPoolExecutor(len(cases)) as threads:
        running = {
            name: threads.submit(station.client.run, cases[name], 1, limit)
            for name, station in stations.items()
        }
        return {name: each.result() for name, each in running.items()}


def measure(radio: Radio, stations: dict[str, Station], limit: float, *, direct: bool) -> list[list[str]]:
    """Return the cells of each station behind one radio, and a row with those of the gateway itself."""
    columns: list[dict[str, Outcome]] = []
    own: list[str] = []
    if direct:
        cases = {name: radio.case(each.way) for name, each in stations.items()}
        columns.append(one_by_one(stations, cases, limit))
        own.append("")
    with RunningGateway.over(radio, stations) as gateway:
        gateway.wait()
        before = gateway.count.value
        columns.append(one_by_one(stations, gateway.cases, limit))
        columns.append(all_at_once(stations, gateway.cases, limit))
        datagrams = gateway.count.value - before
        own += ["", ""]
    for delay in (START_TIME, 0.0):
        with RunningGateway.over(radio, stations, delay=delay) as gateway:
            columns.append(all_at_once(stations, gateway.cases, limit))
            gateway.wait()
            own.append(f"{gateway.fetch_time.value:.2f}")
    print(f"{radio.name}: {columns} {own}", file=sys.stderr, flush=True)
    rows = [[name, *(cell(column[name]) for column in columns)] for name in stations]
    return [*([*row, ""] for row in rows), ["the gateway itself", *own, str(datagrams)]]


def cell(outcome: Outcome) -> str:
    """Return an outcome in words."""
    wrong = f", {outcome.wrong} wrong" if outcome.wrong else ""
    return f"{outcome.problem or f'{outcome.seconds:.2f}'}{wrong}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds that one download may take")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="rows whose names hold one")
    parser.add_argument("--skip-direct", action="store_true", help="no direct downloads")
    parser.add_argument("--mavproxy", metavar="COMMAND", help="mavproxy.py, if it is not on the PATH")
    parser.add_argument(
        "--live", metavar="LINK", help="the link to a real vehicle, in place of simulated ones"
    )
    arguments = parser.parse_args()
    mavproxy = MavProxy(arguments.mavproxy)
    stations = {name: Station(CLIENTS[name], "list") for name in ("pymavlink, the usual loop", "MAVSDK")}
    if mavproxy.version:
        stations |= {"MAVProxy": Station(mavproxy, "list"), BY_FILE: Station(mavproxy, "file")}
    with ExitStack() as stack:
        fields: dict[str, LiveField | None] = {"PX4": None, "ArduPilot": None}
        vehicle = ""
        if arguments.live is not None:
            port = free_port()
            relay = stack.enter_context(Relay(arguments.live, listeners=[port]))
            field = LiveField(relay, port, Path(stack.enter_context(tempfile.TemporaryDirectory())))
            fields, vehicle = {field.kind: field}, f" {field.vehicle}."
        links: list[tuple[float, float | None]] = [*((loss, None) for loss in LOSSES), (0.05, BAUD_RATE)]
        radios = [Radio(kind, *link, field) for kind, field in fields.items() for link in links]
        names = choose([radio.name for radio in radios], arguments.only)
        heads = ["vehicle, loss", "station", *([] if arguments.skip_direct else ["direct"]), "in sync"]
        heads += ["in sync, all at once", "cold, all at once", "loading, all at once"]
        heads += ["parameter datagrams on the radio, in sync"]
        print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
        loads = []
        for radio in radios:
            if radio.name in names:
                some = {name: each for name, each in stations.items() if name != BY_FILE or radio.has_file}
                for cells in measure(radio, some, arguments.limit, direct=not arguments.skip_direct):
                    print(f"| {radio.name} | {' | '.join(cells)} |", flush=True)
                loads.append(os.getloadavg()[0])
        print(
            f"\nSeconds. {time.strftime('%Y-%m-%d')}, {machine()}, "
            f"load {min(loads):.1f} to {max(loads):.1f}. {versions(mavproxy)}.{vehicle}"
        )


if __name__ == "__main__":
    main()
