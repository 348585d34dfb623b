"""What the library costs: bytes to table, a client that only listens, and the memory of a table.

    python bench/cost.py [--rounds N] [--seconds S] [--check]

Prints each figure beside its target; with `--check` it fails when one is missed. Times are those of the CPU,
which other work on the machine disturbs less than those of the clock on the wall.

- Bytes to table: the list of a simulated PX4 vehicle goes through `Station.receive`: framing, checksum,
  decoding, table, events. pymavlink's `parse_buffer` takes the same bytes in the same run and only parses
  them. Both are given one frame at a time, as in datagrams, and all at once, as from a stream. The last
  value is left out: with it a fetch ends and proves the hash, which is timed on its own.
- Listening: a client on a real UDP socket hears telemetry that it has no use for, and a heartbeat a second.
  The frames come one by one, evenly, which is the worst case; and in bursts every 10 ms, as from the loop
  of a vehicle. Nothing is awaited of the vehicle meanwhile, so the client rests between the frames.
- Memory: what a component holds after a download.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import random
import socket
import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.synchronize import Event

import anyio
from parse import build_stream
from pymavlink.dialects.v20 import common

from paramclient import ParamClient
from paramclient.protocol import wire
from paramclient.protocol.station import Station
from paramclient.sim import PX4Vehicle

FRAMES_PER_SECOND = 150_000
MOST_LOAD = 0.05
MOST_MEMORY = 300
"""The targets: PARAM_VALUEs to the table, the share of a core, KiB for 1,000 parameters."""

TELEMETRY = 2_000
"""Frames a second for the client that listens."""
WARM_UP = 9.0
"""Seconds before its CPU time is read first: until then it asks the component, in vain, who it is."""


@dataclass(frozen=True)
class Download:
    """What a vehicle sends.

    Attributes:
        heartbeat: one frame.
        announcement: the frame with the hash.
        values: one frame for each parameter.
    """

    heartbeat: bytes
    announcement: bytes
    values: list[bytes]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=25, help="of the list through each parser")
    parser.add_argument("--seconds", type=float, default=5.0, help="for which the client listens")
    parser.add_argument("--check", action="store_true", help="fail when a target is missed")
    arguments = parser.parse_args()
    print(f"Python {sys.version.split()[0]}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    download = record_download()
    are_met = [
        print_rates(download, arguments.rounds),
        *(print_load(arguments.seconds, burst) for burst in (1, TELEMETRY // 100)),
        print_memory(download),
    ]
    return 1 if arguments.check and not all(are_met) else 0


def print_rates(download: Download, rounds: int) -> bool:
    """Frames a second in each way of taking them, in the median; whether the targets are met."""
    count = len(download.values) - 1
    ways: dict[str, Callable[[list[bytes]], float]] = {
        "pymavlink, parsing only": parse_with_pymavlink,
        "paramclient, in a fetch": lambda chunks: receive(download, chunks, fetching=True),
        "paramclient, first values": lambda chunks: receive(download, chunks),
        "paramclient, values known": lambda chunks: receive(download, chunks, known=True),
    }
    rates: dict[tuple[str, bool], list[float]] = {}
    proofs = []
    for _ in range(rounds):
        for at_once in (False, True):
            chunks = [b"".join(download.values[:-1])] if at_once else download.values[:-1]
            for way, take in ways.items():
                gc.collect()
                rates.setdefault((way, at_once), []).append(count / take(chunks))
        proofs.append(prove(download))
    medians = {key: statistics.median(each) for key, each in rates.items()}
    theirs = {at_once: medians["pymavlink, parsing only", at_once] for at_once in (False, True)}
    print(f"{'PARAM_VALUEs a second':28}{'one by one':>12}{'ratio':>7}{'at once':>12}{'ratio':>7}")
    for way in ways:
        cells = [f"{medians[way, each]:12,.0f}{medians[way, each] / theirs[each]:7.2f}" for each in theirs]
        print(f"{way:28}{''.join(cells)}")
    is_met = all(
        rate >= max(FRAMES_PER_SECOND, theirs[at_once])
        for (way, at_once), rate in medians.items()
        if way.startswith("paramclient")
    )
    print(f"target: {FRAMES_PER_SECOND:,} and ratio 1: {verdict(is_met)}")
    print(f"the end of a fetch, with its proof: {statistics.median(proofs) * 1e3:.1f} ms, once\n")
    return is_met


def parse_with_pymavlink(chunks: list[bytes]) -> float:
    """Seconds of the CPU that pymavlink's parser takes, as a program without a signing key sets it up."""
    parser = common.MAVLink(None)
    parsed = 0
    start = time.process_time()
    for chunk in chunks:
        parsed += len(parser.parse_buffer(chunk) or ())
    elapsed = time.process_time() - start
    check(parsed == sum(map(frames_in, chunks)), "pymavlink has not found every frame")
    return elapsed


def receive(download: Download, chunks: list[bytes], *, fetching: bool = False, known: bool = False) -> float:
    """Seconds of the CPU from bytes to table."""
    station = meet(download)
    if fetching:
        station.components[1, 1].begin_fetch(1.0)
        station.receive(download.announcement, None, 1.0)
    if known:
        deliver(station, chunks, 1.0)
        station.events()
    elapsed = deliver(station, chunks, 2.0)
    check(len(station.components[1, 1].table.params) == len(download.values) - 1, "values are missing")
    return elapsed


def prove(download: Download) -> float:
    """Seconds of the CPU for the last value of a fetch, with which the hash is computed and compared."""
    station = meet(download)
    fetch = station.components[1, 1].begin_fetch(1.0)
    station.receive(download.announcement, None, 1.0)
    deliver(station, download.values[:-1], 2.0)
    elapsed = deliver(station, download.values[-1:], 3.0)
    check(fetch.result is not None and fetch.result.hash is not None, "the hash was not proven")
    return elapsed


def deliver(station: Station, chunks: list[bytes], now: float) -> float:
    start = time.process_time()
    for chunk in chunks:
        station.receive(chunk, None, now)
        now += 0.001
    return time.process_time() - start


def meet(download: Download) -> Station:
    """A station that has heard the vehicle's heartbeat."""
    station = Station(link="bench", is_stream=False)
    station.receive(download.heartbeat, None, 0.0)
    return station


def print_load(seconds: float, burst: int) -> bool:
    """The share of a core that a client needs to hear telemetry; whether the target is met."""
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    sender = spawn.Process(target=send_telemetry, args=(port, burst, stop))
    sender.start()
    try:
        load, heard = anyio.run(listen, port, seconds)
    finally:
        stop.set()
        sender.join()
    is_met = load < MOST_LOAD
    how = "one by one" if burst == 1 else f"{burst} at a time"
    print(f"hearing {heard:,.0f} other frames a second, {how}: {load:.1%} of a core", end="")
    print(f" (target: under {MOST_LOAD:.0%} at {TELEMETRY:,}: {verdict(is_met)})")
    return is_met


async def listen(port: int, seconds: float) -> tuple[float, float]:
    """The share of a core that a client takes, and the frames a second that it hears."""
    async with ParamClient(f"udpin:127.0.0.1:{port}", cache=False) as client:
        await client.component()
        await anyio.sleep(WARM_UP)
        began, used, heard = time.perf_counter(), time.process_time(), client.bytes_received
        await anyio.sleep(seconds)
        wall = time.perf_counter() - began
        load = (time.process_time() - used) / wall
        frames = (client.bytes_received - heard) / wall / MEAN_SIZE
    return load, frames


def send_telemetry(port: int, burst: int, stop: Event) -> None:
    """Send a vehicle's telemetry to a port until told to stop; runs in a process of its own."""
    frames = telemetry()
    heartbeat = record_download().heartbeat
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(("127.0.0.1", port))
        began = time.perf_counter()
        sent = 0
        while not stop.is_set():
            for number in range(sent, sent + burst):
                try:
                    if number % TELEMETRY == 0:
                        out.send(heartbeat)
                    out.send(frames[number % len(frames)])
                except ConnectionRefusedError:
                    pass  # the client is not there yet, or not any more
            sent += burst
            time.sleep(max(0.0, began + sent / TELEMETRY - time.perf_counter()))


def telemetry() -> list[bytes]:
    """Frames of which a client makes nothing: without PARAM_VALUE, and without heartbeats of nobody."""
    stream = build_stream(3_000, random.Random(1))
    frames = []
    while stream:
        size = stream[1] + 12
        frame, stream = stream[:size], stream[size:]
        if frame[7:10] not in (b"\x00\0\0", b"\x16\0\0"):
            frames.append(frame)
    return frames


MEAN_SIZE = statistics.mean(map(len, telemetry()))
"""Bytes of a frame."""


def print_memory(download: Download) -> bool:
    """KiB for 1,000 parameters; whether the target is met."""
    station = meet(download)
    machine = station.components[1, 1]
    gc.collect()
    wire.text_of.cache_clear()
    tracemalloc.start()
    try:
        fetch = machine.begin_fetch(1.0)
        deliver(station, [download.announcement, *download.values], 1.0)
        check(fetch.result is not None and fetch.result.complete, "the download is not complete")
        machine.end_fetch(fetch, 1.0)
        del fetch
        # what the client takes over, and what the next heartbeats clear
        station.events()
        station.data_to_send()
        machine.table.take_dirty()
        machine.fetches.last = None
        for now in (10.0, 11.0):
            station.receive(download.heartbeat, None, now)
        gc.collect()
        with_memo, _ = tracemalloc.get_traced_memory()
        wire.text_of.cache_clear()
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    kib = 1000 / 1024 / len(download.values)
    is_met = used * kib <= MOST_MEMORY
    print(f"\nmemory of 1,000 parameters: {used * kib:.0f} KiB (target: {MOST_MEMORY}: {verdict(is_met)})")
    memo = (with_memo - used) * kib
    print(f"names that the decoder remembers, once for all components: {memo:.0f} KiB more")
    return is_met


def record_download() -> Download:
    """What a simulated PX4 vehicle sends when it is asked for its list."""
    vehicle = PX4Vehicle()
    vehicle.tick(0.0)
    heartbeat, _system_time = vehicle.data_to_send()
    request = wire.encode(wire.ParamRequestList(1, 1), system=255, component=190, sequence=0)
    vehicle.receive(request, 0.0)
    values: list[bytes] = []
    now = 0.0
    while len(values) <= len(vehicle.params):
        vehicle.tick(now)
        values += [frame for frame in vehicle.data_to_send() if frame[7:10] == b"\x16\0\0"]
        now += 0.01
    return Download(heartbeat, values[0], values[1:])


def frames_in(chunk: bytes) -> int:
    return len(wire.Framer(stream=False).receive(chunk))


def check(condition: bool, otherwise: str) -> None:
    if not condition:
        raise SystemExit(otherwise)


def verdict(is_met: bool) -> str:
    return "met" if is_met else "missed"


if __name__ == "__main__":
    sys.exit(main())
