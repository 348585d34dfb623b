"""Scaling to many vehicles in one process: time and memory from one system on a link to 250.

    python bench/scale.py [--systems N ...] [--links N] [--parameters N] [--check]

The vehicles are simulated PX4 autopilots in another process, each with its own UDP socket. A client fetches
all of them concurrently, with an empty cache; then another client fetches them again with the cache of the
first one: a warm start, one hash request for each. Finally, several links are opened in one process.

Every size is measured in a new process, which works like the command `paramclient`: after loading all modules
it calls `gc.freeze()`, so that full collections skip modules and classes. With `--no-freeze` it does not. For
each size it prints, with the targets at 250:

- wall-clock seconds, and CPU seconds of the whole process including the kernel, from the call of `fetch_all`
  to its return, without the time that recording the received bytes takes;
- the ratio of that CPU time to the bare framing of the same bytes: every received datagram is passed again,
  one at a time, through a `Framer` that only builds the same frames;
- the share of it that the cache thread used, and the CPU time that it used afterwards until all is written;
- the highest event-loop latency, measured by a task that is due every 5 ms: the first figure is by the clock,
  which other programs on the machine increase too; the second is the part that the process spent computing;
- the growth of the process in resident memory.
"""

from __future__ import annotations

import argparse
import gc
import heapq
import multiprocessing
import os
import random
import selectors
import socket
import sys
import tempfile
import time
from array import array
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from io import BytesIO
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path

import anyio

from paramclient import FetchedAll, FetchResult, ParamCache, ParamClient
from paramclient.cache import CachedComponent, TableUpdate
from paramclient.links import Peer, parse_link
from paramclient.links.udp import UdpIn
from paramclient.model.values import ParamType
from paramclient.protocol.station import HANDLED_IDS
from paramclient.protocol.wire import Framer
from paramclient.sim import PX4Vehicle, SimParam, px4_table

SYSTEMS = (1, 10, 50, 250)
LINKS = 20
PARAMETERS = 1_000
FRAMINGS_MAX = 4.0
"""The target at the largest size for the ratio to the bare framing."""
MEMORY_MAX = 200
"""The target at the largest size for the memory, in MiB."""
CACHE_SHARE_MAX = 0.1
"""The target at the largest size for the share of the CPU time that the cache uses."""
BLOCKING_TIME_MAX = 0.020
"""The target at the largest size for the event-loop latency, in seconds."""

WATCH_INTERVAL = 0.005
"""Seconds between two measurements of the event-loop latency."""
SETTLING_TIME = 1.0
"""Seconds in which remaining work from before or after a fetch ends."""
RECORDED_BYTES_MAX = 96 * 1024 * 1024
"""Bytes of received data that are recorded for the framing. The memory is allocated before it is measured."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of a measurement: links, systems in total, parameters of each; and `gc.freeze` or not."""

    links: int
    systems: int
    parameters: int
    freeze: bool = True


@dataclass(frozen=True)
class Phase:
    """The cost of one fetch of all vehicles; times in seconds.

    Attributes:
        elapsed: wall-clock time.
        cpu: CPU time of the whole process.
        cache: the part of it in the cache thread.
        later: CPU time of the cache thread after the fetch, until all was written.
        framing: CPU time of the bare framing of the received bytes.
        block: the highest event-loop latency.
        computed: the highest CPU time of the process within one such latency.
        grown: growth of the resident memory since before the clients were opened, in MiB.
        right: number of systems whose table is complete and correct.
        source: the source of the tables.
        requests: number of messages that the vehicles have received, without heartbeats.
    """

    elapsed: float
    cpu: float
    cache: float
    later: float
    framing: float
    block: float
    computed: float
    grown: float
    right: int
    source: str
    requests: int


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--systems", type=int, nargs="+", default=SYSTEMS, help="on one link, from 1 to 250")
    parser.add_argument("--links", type=int, default=LINKS, help="at once, with 12 systems each; 0 for none")
    parser.add_argument("--parameters", type=int, default=PARAMETERS, help="of each system, from 1,000 up")
    parser.add_argument("--no-freeze", action="store_true", help="leave the garbage collector as it is")
    parser.add_argument("--check", action="store_true", help="fail when a target is missed")
    arguments = parser.parse_args()
    print(f"Python {sys.version.split()[0]}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    print(
        f"{'links':>5}{'systems':>8} {'':5}{'seconds':>8}{'CPU':>7}{'framing':>8}{'ratio':>6}"
        f"{'cache':>7}{'later':>7}{'blocked':>14}{'MiB':>6}{'requests':>9}  right"
    )
    are_met = True
    rest = (arguments.parameters, not arguments.no_freeze)
    sizes = [Sizes(1, systems, *rest) for systems in arguments.systems]
    if arguments.links:
        sizes.append(Sizes(arguments.links, 12 * arguments.links, *rest))
    for each in sizes:
        cold, warm = measured(each)
        for name, phase in (("cold", cold), ("warm", warm)):
            blocked = f"{phase.block * 1e3:.0f}, {phase.computed * 1e3:.0f} ms"
            print(
                f"{each.links:5}{each.systems:8} {name:5}{phase.elapsed:8.2f}{phase.cpu:7.2f}"
                f"{phase.framing:8.2f}{phase.cpu / phase.framing:6.1f}{phase.cache / phase.cpu:7.0%}"
                f"{phase.later:7.2f}{blocked:>14}{phase.grown:6.0f}{phase.requests:9}  "
                f"{phase.right}/{each.systems} from {phase.source}",
                flush=True,
            )
        are_met &= cold.right == warm.right == each.systems
        if each.links == 1 and each.systems == max(arguments.systems):
            are_met &= print_verdicts(cold, warm)
    return 1 if arguments.check and not are_met else 0


def print_verdicts(cold: Phase, warm: Phase) -> bool:
    """Print whether each target is met; return whether all are."""
    verdicts = {
        f"at most {FRAMINGS_MAX:g} times the bare framing": cold.cpu <= FRAMINGS_MAX * cold.framing,
        f"at most {CACHE_SHARE_MAX:.0%} of the time in the cache": cold.cache <= CACHE_SHARE_MAX * cold.cpu,
        f"never blocked for more than {BLOCKING_TIME_MAX * 1e3:.0f} ms": (
            max(cold.computed, warm.computed) <= BLOCKING_TIME_MAX
        ),
        f"at most {MEMORY_MAX} MiB": max(cold.grown, warm.grown) <= MEMORY_MAX,
    }
    for target, is_met in verdicts.items():
        print(f"      target: {target}: {'met' if is_met else 'missed'}")
    return all(verdicts.values())


def measured(sizes: Sizes) -> tuple[Phase, Phase]:
    """Measure a cold fetch and a warm one in a new process."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    process = spawn.Process(target=measure, args=(sizes, there))
    process.start()
    there.close()
    try:
        cold, warm = here.recv()
    except EOFError:
        raise SystemExit("the measurement has failed") from None
    finally:
        process.join()
    return cold, warm


def measure(sizes: Sizes, out: Connection) -> None:
    """Start the vehicles, fetch all of them twice, and send the costs; runs in a new process."""
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    here, there = spawn.Pipe()
    vehicles = spawn.Process(target=fly, args=(sizes, stop, there))
    vehicles.start()
    try:
        here.recv()  # the vehicles are ready
        record = Record()
        gc.collect()
        if sizes.freeze:
            gc.freeze()
        before = resident()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "cache.sqlite3"
            phases = [anyio.run(fetch, sizes, path, record, before, here) for _ in range(2)]
        out.send(phases)
    finally:
        stop.set()
        vehicles.join()


class Record:
    """The received datagrams in order, in memory that is allocated in advance.

    Attributes:
        seconds: CPU seconds that recording them took.
    """

    def __init__(self) -> None:
        self._bytes = BytesIO(os.urandom(1024 * 1024) * (RECORDED_BYTES_MAX // (1024 * 1024)))
        self._sizes = array("L", bytes(8 * RECORDED_BYTES_MAX // 32))
        self.begin()

    def begin(self) -> None:
        """Start a new recording."""
        self._bytes.seek(0)
        self.count = 0
        self.seconds = 0.0

    def add(self, batch: list[tuple[Peer, bytes]]) -> None:
        """Record the datagrams of one read."""
        start = time.thread_time()
        datagrams = [data for _, data in batch]
        self._bytes.write(b"".join(datagrams))
        for data in datagrams:
            self._sizes[self.count] = len(data)
            self.count += 1
        self.seconds += time.thread_time() - start

    def framing(self, count: int) -> float:
        """Return the CPU seconds for framing `count` of the datagrams."""
        self._bytes.seek(0)
        datagrams = [self._bytes.read(size) for size in self._sizes[:count]]
        framer = Framer(HANDLED_IDS, stream=False)
        start = time.process_time()
        for data in datagrams:
            framer.receive(data)
        return time.process_time() - start


class Watch:
    """Measures the event-loop latency."""

    def __init__(self) -> None:
        self.block = 0.0
        self.computed = 0.0

    async def run(self) -> None:
        while True:
            due = time.perf_counter() + WATCH_INTERVAL
            before = time.process_time()
            await anyio.sleep(WATCH_INTERVAL)
            late = time.perf_counter() - due
            self.block = max(self.block, late)
            self.computed = max(self.computed, min(late, time.process_time() - before))


class RecordedLink(UdpIn):
    """A link that records the received datagrams."""

    def __init__(self, record: Record) -> None:
        super().__init__(parse_link("udpin:127.0.0.1:0"))
        self._record = record

    async def receive(self) -> list[tuple[Peer, bytes]]:
        batch = await super().receive()
        self._record.add(batch)
        return batch


class TimedCache(ParamCache):
    """A cache that sums up its CPU time in all threads."""

    seconds = 0.0

    def save(
        self, update: TableUpdate | Sequence[TableUpdate], *, clock: Callable[[], float] | None = None
    ) -> None:
        start = time.thread_time()
        super().save(update, clock=clock)
        self.seconds += time.thread_time() - start

    def load(self, key: str, component: int) -> CachedComponent | None:
        start = time.thread_time()
        try:
            return super().load(key, component)
        finally:
            self.seconds += time.thread_time() - start


async def fetch(sizes: Sizes, path: Path, record: Record, before: float, vehicles: Connection) -> Phase:
    """Fetch all vehicles with this cache; return the cost."""
    per_link = sizes.systems // sizes.links
    results: list[FetchedAll] = []
    watch = Watch()

    async def fetch_one(client: ParamClient) -> None:
        results.append(await client.fetch_all())

    async with AsyncExitStack() as stack:
        cache = TimedCache(path)
        stack.callback(cache.close)
        links = [RecordedLink(record) for _ in range(sizes.links)]
        clients = [await stack.enter_async_context(ParamClient(link, cache=cache)) for link in links]
        vehicles.send([link.address for link in links])
        for client in clients:
            with anyio.fail_after(60):
                for system in range(1, per_link + 1):
                    await client.component(system)
        await anyio.sleep(SETTLING_TIME)
        requested = requests_of(vehicles)
        record.begin()
        cache.seconds = 0.0
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch.run)
            began, used = time.perf_counter(), time.process_time()
            async with anyio.create_task_group() as fetches:
                for client in clients:
                    fetches.start_soon(fetch_one, client)
            elapsed, cpu = time.perf_counter() - began, time.process_time() - used
            cpu -= record.seconds
            in_cache, datagrams = cache.seconds, record.count
            await anyio.sleep(SETTLING_TIME)
            tasks.cancel_scope.cancel()
        grown = resident() - before
        requested = requests_of(vehicles) - requested
        later = cache.seconds - in_cache
    whole = [result for fetched in results for result in fetched.results.values()]
    return Phase(
        elapsed=elapsed,
        cpu=cpu,
        cache=in_cache,
        later=later,
        framing=record.framing(datagrams),
        block=watch.block,
        computed=watch.computed,
        grown=grown,
        right=sum(is_right(result, sizes.parameters) for result in whole),
        source="+".join(sorted({result.source for result in whole})),
        requests=requested,
    )


def is_right(result: FetchResult, parameters: int) -> bool:
    """Return whether a result is complete and every value is that of the vehicle."""
    rows = table_of(result.system, parameters)
    return result.complete and all(
        result.params[row.name].bits == (result.system if row.name == "MAV_SYS_ID" else row.bits)
        for row in rows
    )


def resident() -> float:
    """Return the present resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024 / 1024


def requests_of(vehicles: Connection) -> int:
    """Return the number of messages that the vehicles have received, without heartbeats."""
    vehicles.send(None)
    number: int = vehicles.recv()
    return number


def table_of(system: int, parameters: int) -> list[SimParam]:
    """Return the parameters of one vehicle: those of a real quadrotor, and further ones with own values."""
    table = px4_table()
    dice = random.Random(system)
    more = range(parameters - len(table))
    return [*table, *(SimParam(f"XTRA_{i}", ParamType.REAL32, dice.uniform(-9, 9)) for i in more)]


def fly(sizes: Sizes, stop: Event, out: Connection) -> None:
    """Run the vehicles until `stop` is set, in a new process. They send once they receive an address."""
    selector = selectors.DefaultSelector()
    due: list[tuple[float, int]] = []
    wake_at: list[float] = []
    fleet = []
    per_link = sizes.systems // sizes.links
    for number in range(sizes.systems):
        system = number % per_link + 1
        vehicle = PX4Vehicle(system=system, uid=number + 1, table=table_of(system, sizes.parameters))
        vehicle.announced_hash()
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        fleet.append((vehicle, sock))
        selector.register(sock, selectors.EVENT_READ, number)
        wake_at.append(
            time.monotonic() + number / sizes.systems
        )  # the vehicles do not start at the same time
        due.append((wake_at[number], number))
    selector.register(out, selectors.EVENT_READ, None)
    out.send(None)
    heapq.heapify(due)
    while not stop.is_set():
        ready = [key.data for key, _ in selector.select(min(max(0.0, due[0][0] - time.monotonic()), 0.1))]
        now = time.monotonic()
        if None in ready:
            addresses = out.recv()
            for number, (_, sock) in enumerate(fleet if addresses else ()):
                sock.connect(addresses[number // per_link])
            if addresses:
                continue
            every = [vehicle.requests for vehicle, _ in fleet]
            out.send(sum(each.total() - each["HEARTBEAT"] for each in every))
        turn = {number for number in ready if number is not None}
        while due and due[0][0] <= now:
            at, number = heapq.heappop(due)
            if at == wake_at[number]:
                turn.add(number)
        for number in turn:
            vehicle, sock = fleet[number]
            with suppress(OSError):  # the peer is gone, or does not read
                while True:
                    vehicle.receive(sock.recv(65535), now)
            vehicle.tick(now)
            for data in vehicle.data_to_send():
                with suppress(OSError):  # the peer is gone, or does not read
                    sock.send(data)
            wake_at[number] = vehicle.next_deadline() or now
            heapq.heappush(due, (wake_at[number], number))


if __name__ == "__main__":
    sys.exit(main())
