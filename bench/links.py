"""Duration of downloads on good and bad links, compared with an oracle, and of writes, in simulated time.

A run is the session of a program without a cache: it knows nothing of the vehicle until the first heartbeat,
and then begins the fetch. The time from the heartbeat on is measured, identification included.

Run `python bench/links.py` for the table, `--seeds N` for more seeds, `--only TEXT` for the rows whose name
contains a text, `--row NAME` for the row with this name, `--check` to fail if a row exceeds its bound. The
protocol core runs against simulated vehicles over a faulty link without socket and clock: equal seeds give
equal figures on every machine. If several vehicles share a link, the oracle's column has the time of as many
single downloads.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import anyio
from oracle import FILE_FRAME, TellingLink, file_oracle_time, oracle_time
from trio.testing import MockClock

from paramclient.model.values import Param, ParamType
from paramclient.protocol.fetch import FetchResult, fetch_all
from paramclient.protocol.node import Node
from paramclient.protocol.set_results import SetStatus
from paramclient.protocol.station import Station
from paramclient.protocol.writes import write_many
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, Vehicle

LIMIT = 600.0
"""Maximum simulated seconds of a run, after which it counts as endless."""
SET_VALUES = 200
"""Values of a row that sets them."""
SET_TIME_MAX = {"PX4": 1.5, "ArduPilot": 2.0}
"""Seconds for them with a round trip of 100 ms and 5 % loss."""
UDP_FILE_RATE = 48_500.0
"""Bytes per second of a MAVFTP burst of an ArduPilot on UDP (measured)."""
UDP_READ_RATE = 3 * UDP_FILE_RATE
"""Bytes per second of single MAVFTP reads from an ArduPilot on UDP."""


@dataclass(frozen=True)
class Row:
    """One kind of vehicle on one kind of link.

    Attributes:
        name: the name of the row.
        make: creates the vehicle.
        reads_per_second: the read rate of the oracle: that of the vehicle, or of the link.
        faults: keywords of `FaultyLink`, for each direction.
        bound: the highest acceptable ratio to the oracle.
        limit: the highest acceptable time in seconds.
        vehicles: number of vehicles on the link. Several are compared with as many single downloads.
        file_rate: bytes per second of a burst of the vehicle's file, if it serves one.
        sets: whether values are set instead of downloaded; there is no oracle then.
        values: the number of them.
    """

    name: str
    make: Callable[..., Vehicle]
    reads_per_second: float
    faults: dict[str, Any] = field(default_factory=dict)
    bound: float = 1.25
    limit: float = math.inf
    vehicles: int = 1
    file_rate: float | None = None
    sets: bool = False
    values: int = SET_VALUES


@dataclass(frozen=True)
class Run:
    """One download, or several concurrent ones: duration, correctness, bytes and requests."""

    seconds: float
    is_right: bool
    bytes_up: int
    bytes_down: int
    requests: int
    oracle: float

    @property
    def ratio(self) -> float:
        return self.seconds / self.oracle


def rows() -> Iterator[Row]:
    """Yield all rows in the order of the output."""
    kinds: tuple[tuple[str, Callable[..., Vehicle], float], ...] = (
        ("PX4", PX4Vehicle, 5000.0),
        ("ArduPilot", partial(ArduPilotVehicle, ftp=False), 50.0),
    )
    for beside, telemetry in (("", 0.0), (" + telemetry", 50.0)):
        for kind, make, served in kinds:
            plain = partial(make, telemetry=telemetry)
            for loss in (0.0, 0.01, 0.05, 0.20, 0.40):
                for trip in (0.02, 0.1, 0.6, 2.5):
                    name = f"{kind} UDP {trip * 1000:g} ms {loss:.0%}{beside}"
                    faults = {"loss": loss, "delay": trip / 2}
                    yield Row(name, plain, served, faults, 1.5 if loss > 0.2 else 1.25)
            for loss in (0.05, 0.20):
                name = f"{kind} UDP 100 ms {loss:.0%} in bursts of 8{beside}"
                yield Row(name, plain, served, {"loss": loss, "delay": 0.05, "loss_burst": 8.0})
            # on a serial port both limit their rate by the free space of its buffer, and send less telemetry
            burst = 3 if kind == "PX4" else 1
            radio = partial(make, burst=burst, period=0.025, telemetry=telemetry / 5)
            for loss in (0.0, 0.05, 0.15):
                faults = {"loss": loss, "delay": 0.075, "rate": 5760.0, "queue": 1024.0}
                yield Row(f"{kind} radio 57600 {loss:.0%}{beside}", radio, min(served, 5760 / 37), faults)
            slow = partial(make, burst=1, period=1 / 30, telemetry=telemetry / 50)
            faults = {"delay": 0.075, "rate": 1200.0, "queue": 1024.0}
            yield Row(f"{kind} 1200 bytes/s{beside}", slow, min(served, 1200 / 37), faults)
    for kind, make, served in kinds:
        radio = partial(make, burst=3 if kind == "PX4" else 1, period=0.025)
        for loss in (0.0, 0.05):
            faults = {"loss": loss, "delay": 0.075, "rate": 5760.0, "queue": 1024.0}
            yield Row(f"five {kind} on one radio 57600 {loss:.0%}", radio, served, faults, 1.1, vehicles=5)
    yield from file_rows()
    yield from set_rows()


def file_rows() -> Iterator[Row]:
    """Yield the rows of file downloads."""
    limits = {(0.1, 0.0): 0.6, (0.1, 0.05): 0.9, (0.1, 0.2): 1.5}
    for loss, bound in ((0.0, 1.25), (0.01, 1.25), (0.05, 1.25), (0.20, 1.4), (0.40, 1.5)):
        for trip in (0.02, 0.1, 0.6, 2.5):
            # unlike the oracle, a client cannot detect a lost response within 20 ms
            is_unstated = trip == 0.02 and loss == 0.4
            yield Row(
                f"ArduPilot by FTP UDP {trip * 1000:g} ms {loss:.0%}",
                ArduPilotVehicle,
                UDP_READ_RATE / FILE_FRAME,
                {"loss": loss, "delay": trip / 2},
                2.5 if is_unstated else bound,
                limits.get((trip, loss), math.inf),
                file_rate=UDP_FILE_RATE,
            )
    # a real one fills the radio with its file: 3.0 s, and two round trips of 0.15 s to begin and close
    radio = partial(ArduPilotVehicle, burst=1, period=0.025, ftp_rate=5760.0)
    for loss, bound, limit in ((0.0, 1.25, 3.5), (0.05, 1.25, math.inf), (0.15, 1.4, math.inf)):
        faults = {"loss": loss, "delay": 0.075, "rate": 5760.0, "queue": 1024.0}
        name = f"ArduPilot by FTP radio 57600 {loss:.0%}"
        yield Row(name, radio, 5760 / FILE_FRAME, faults, bound, limit, file_rate=5760.0)


def set_rows() -> Iterator[Row]:
    """Yield the rows that set values instead of downloading them.

    Those of ArduPilot are spread over the real table.
    """
    table = {f"VALUE_{number:03}": float(number) for number in range(SET_VALUES)}
    for loss in (0.0, 0.05, 0.2):
        yield Row(
            f"set {SET_VALUES} values of PX4 UDP 100 ms {loss:.0%}",
            partial(PX4Vehicle, table=table),
            0.0,
            {"loss": loss, "delay": 0.05},
            math.inf,
            SET_TIME_MAX["PX4"] if loss <= 0.05 else math.inf,
            sets=True,
        )
    links: list[tuple[str, dict[str, Any], float]] = [
        ("UDP 1 ms 0%", {"delay": 0.0005}, 0.3),
        *(
            (f"UDP 100 ms {loss:.0%}", {"loss": loss, "delay": 0.05}, SET_TIME_MAX["ArduPilot"])
            for loss in (0.0, 0.05)
        ),
        ("UDP 100 ms 20%", {"loss": 0.2, "delay": 0.05}, math.inf),
        ("UDP 600 ms 5%", {"loss": 0.05, "delay": 0.3}, math.inf),
        *(
            (
                f"radio 57600 {loss:.0%}",
                {"loss": loss, "delay": 0.075, "rate": 5760.0, "queue": 1024.0},
                math.inf,
            )
            for loss in (0.0, 0.05)
        ),
        ("1200 bytes/s", {"delay": 0.075, "rate": 1200.0, "queue": 1024.0}, math.inf),
    ]
    for link, faults, limit in links:
        rate = faults.get("rate", math.inf)
        make = partial(ArduPilotVehicle, ftp_rate=rate, burst=1, period=0.025)
        for values in (50, SET_VALUES, 500):
            yield Row(
                f"set {values} values of ArduPilot {link}",
                ArduPilotVehicle if rate == math.inf else make,
                0.0,
                faults,
                math.inf,
                limit if values == SET_VALUES else math.inf,
                sets=True,
                values=values,
            )


@asynccontextmanager
async def station_on(air: Air) -> AsyncIterator[tuple[Station, Traffic]]:
    """Open a station on simulated vehicles, whose time is that of the event loop."""
    traffic = Traffic()
    activity = anyio.Event()

    def send(data: bytes, peer: object) -> None:
        traffic.up += len(data)
        air.receive(data, anyio.current_time())
        activity.set()

    async def run() -> None:
        nonlocal activity
        while True:
            now = anyio.current_time()
            air.tick(now)
            for data in air.data_to_send():
                traffic.down += len(data)
                station.receive(data, None, now)
            due, activity = air.next_deadline(), anyio.Event()
            with anyio.move_on_after(None if due is None else max(due - now, 1e-7)):
                await activity.wait()

    async with anyio.create_task_group() as tasks:
        station = Station(link="bench", is_stream=False, send=send, spawn=tasks.start_soon)
        tasks.start_soon(run)
        tasks.start_soon(station.send_heartbeats)
        yield station, traffic
        tasks.cancel_scope.cancel()


@dataclass
class Traffic:
    """Bytes that were sent and received."""

    up: int = 0
    down: int = 0


def in_simulated_time(work: Callable[[], Awaitable[Run]]) -> Run:
    """Run an async function on a clock that jumps to the next deadline."""

    async def limited() -> Run:
        with anyio.move_on_after(LIMIT):
            return await work()
        return Run(math.inf, False, 0, 0, 0, math.nan)

    clock = MockClock(autojump_threshold=0)
    return anyio.run(limited, backend="trio", backend_options={"clock": clock})


async def appear(station: Station, system: int) -> Node:
    """Wait for the vehicle."""
    while (system, 1) not in station.nodes:  # noqa: ASYNC110 - the next event of the vehicle
        await anyio.sleep(0.0005)
    return station.nodes[system, 1]


async def set_values(row: Row, seed: int) -> Run:
    """Set values of the vehicle of a row, whose table is known."""
    vehicle = row.make()
    links = (FaultyLink(**row.faults, seed=2 * seed), FaultyLink(**row.faults, seed=2 * seed + 1))
    async with station_on(Air([vehicle], uplink=links[0], downlink=links[1])) as (station, traffic):
        session = (await appear(station, 1)).plain
        await fetch_all(session)
        began, up, down = anyio.current_time(), traffic.up, traffic.down
        requests = vehicle.requests.total()
        names = [name for name, param in session.table.params.items() if may_be_set(param)]
        step_size = len(names) / row.values
        chosen = [names[int(number * step_size)] for number in range(row.values)]
        wanted = {name: number + 0.5 for number, name in enumerate(chosen)}
        result = await write_many(session, list(wanted.items()))
        ended = anyio.current_time()
    true = vehicle.params
    is_right = all(outcome.status is SetStatus.ACCEPTED for outcome in result.outcomes) and all(
        true[name].value == value for name, value in wanted.items()
    )
    sent = vehicle.requests.total() - requests
    return Run(ended - began, is_right, traffic.up - up, traffic.down - down, sent, math.nan)


def may_be_set(param: Param) -> bool:
    """Return whether a value may be set to any number: it is a float that nothing else depends on."""
    return param.type == ParamType.REAL32 and not param.name.startswith(("STAT_", "BARO"))


def download(row: Row, seed: int) -> Run:
    """Run a row with this library; return the run with the oracle's time."""
    if row.sets:
        return in_simulated_time(partial(set_values, row, seed))
    if row.vehicles == 1:
        return in_simulated_time(partial(fetch, row, seed, oracle(row, seed)))
    alone = in_simulated_time(partial(fetch, replace(row, vehicles=1), seed, math.nan))
    return in_simulated_time(partial(fetch, row, seed, row.vehicles * alone.seconds))


async def fetch(row: Row, seed: int, measure: float) -> Run:
    """Download from all vehicles of a row concurrently; `measure` is the oracle's time."""
    vehicles = [row.make(system=system) for system in range(1, row.vehicles + 1)]
    uplink = FaultyLink(**row.faults, seed=2 * seed)
    downlink = FaultyLink(**row.faults, seed=2 * seed + 1)
    results: dict[int, FetchResult] = {}
    began = math.inf

    async def fetch_one(system: int) -> None:
        nonlocal began
        node = await appear(station, system)
        began = min(began, node.since)
        results[system] = await fetch_all(node.plain)

    async with station_on(Air(vehicles, uplink=uplink, downlink=downlink)) as (station, traffic):
        async with anyio.create_task_group() as tasks:
            for vehicle in vehicles:
                tasks.start_soon(fetch_one, vehicle.system)
        ended = anyio.current_time()
    return Run(
        ended - began,
        all(is_right(results[vehicle.system], vehicle) for vehicle in vehicles),
        traffic.up,
        traffic.down,
        sum(vehicle.requests.total() for vehicle in vehicles),
        measure,
    )


def is_right(result: FetchResult, vehicle: Vehicle) -> bool:
    """Return whether a result is complete and every value is that of the vehicle."""
    return result.complete and all(
        result.params[name].same_value(param)
        for name, param in vehicle.params.items()
        if name not in ("STAT_RUNTIME", "BARO1_GND_PRESS")  # the vehicle changes them
    )


def oracle(row: Row, seed: int) -> float:
    """Return the oracle's time in seconds: by file, or the fastest list download with 1 to 3 passes."""
    if row.file_rate is not None:
        return file_oracle_time(
            row.make,
            TellingLink(**row.faults, seed=2 * seed),
            TellingLink(**row.faults, seed=2 * seed + 1),
            burst_rate=row.file_rate,
            reads_per_second=row.reads_per_second,
        )
    times = []
    for passes, reads_beside in itertools.product((1, 2, 3), (True, False)):
        vehicle = row.make()
        air = Air(
            [vehicle],
            uplink=TellingLink(**row.faults, seed=2 * seed),
            downlink=TellingLink(**row.faults, seed=2 * seed + 1),
        )
        times.append(
            oracle_time(
                air,
                len(vehicle.params),
                passes=passes,
                reads_per_second=row.reads_per_second,
                reads_beside=reads_beside,
                asks_version=isinstance(vehicle, ArduPilotVehicle),
            )
        )
    return min(times)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", default="", metavar="TEXT")
    parser.add_argument("--row", choices=[row.name for row in rows()], metavar="NAME")
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    head = f"{'seconds':>8} {'worst':>7} {'oracle':>7} {'ratio':>6} {'up B':>7} {'down B':>7} {'req':>5}"
    print(f"{'':54} {head}  right")
    failures = 0
    for row in rows():
        if arguments.only not in row.name or arguments.row not in (None, row.name):
            continue
        runs = [download(row, seed) for seed in range(arguments.seeds)]
        right = sum(run.is_right for run in runs)
        seconds = statistics.median(run.seconds for run in runs)
        ratio = statistics.median(run.ratio for run in runs)
        failed = ratio > row.bound or seconds > row.limit or right < len(runs)
        failures += failed
        print(
            f"{row.name:54} {seconds:8.2f}"
            f" {max(run.seconds for run in runs):7.2f} {statistics.median(run.oracle for run in runs):7.2f}"
            f" {ratio:6.2f} {statistics.median(run.bytes_up for run in runs):7.0f}"
            f" {statistics.median(run.bytes_down for run in runs):7.0f}"
            f" {statistics.median(run.requests for run in runs):5.0f}  {right}/{len(runs)}"
            f"{'  beyond its bound' if failed else ''}",
            flush=True,
        )
        if right < len(runs):
            wrong = [str(seed) for seed, run in enumerate(runs) if not run.is_right]
            print(f"  not right: seed {', '.join(wrong)}", flush=True)
    return 1 if arguments.check and failures else 0


if __name__ == "__main__":
    sys.exit(main())
