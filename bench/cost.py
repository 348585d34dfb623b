"""Cost of the library: processor time from bytes to table, idle listening, memory of a table, start.

    python bench/cost.py [--rounds N] [--seconds S] [--check]

Prints a table of figures with their targets; with `--check`, fails if one is missed. Times are CPU times,
which other work on the machine disturbs less than wall-clock times, but that of the start.

- Bytes to table: `Station.receive` processes the list of a simulated PX4 vehicle: framing, checksum,
  decoding, table, events. pymavlink's `parse_buffer` only parses the same bytes in the same run. Both get
  one frame at a time, as in datagrams, and all frames in one call, as from a stream. The last value is left
  out. The proof of the whole table by its hash is timed separately.
- Listening: a client on a real UDP socket receives telemetry that it does not use, and a heartbeat a second.
  The frames arrive one by one at a constant rate, which is the worst case; and in bursts every 10 ms, as from
  the main loop of a vehicle. No request is pending, so that the client sleeps between the frames.
- Memory: the memory of a component after a download.
- Start: from the start of the command's process to its first byte on the link, the quickest of some.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.synchronize import Event
from typing import NamedTuple, TypeVar

import anyio
from parse import build_stream
from pymavlink.dialects.v20 import common

from paramclient import ParamClient
from paramclient.model.values import is_portable_name
from paramclient.protocol.station import Station
from paramclient.sim import PX4Vehicle
from paramclient.wire.frames import Framer
from paramclient.wire.messages import ParamRequestList, encode, text_of

Result = TypeVar("Result")

FRAMES_PER_SECOND = 150_000
"""The target for the rate of PARAM_VALUEs from bytes to table, per second."""
LOAD_MAX = 0.05
"""The target for listening, as a share of a core."""
MEMORY_MAX = 350
"""The target for the memory of 1,000 parameters, in KiB."""
START_MAX = 0.4
"""The target for the start of the command, in seconds."""
STARTS = 10
START_TIMEOUT = 30.0
"""Seconds after which a command has sent nothing."""

TELEMETRY = 2_000
"""Frames per second for the listening client."""
WARM_UP = 9.0
"""Seconds before the first reading of the CPU time: until then the client requests the identity in vain."""


@dataclass(frozen=True)
class Download:
    """The frames that a vehicle sends for a download.

    Attributes:
        heartbeat: one frame.
        announcement: the frame with the hash.
        values: one frame for each parameter.
    """

    heartbeat: bytes
    announcement: bytes
    values: list[bytes]


class Figure(NamedTuple):
    """One row of the table."""

    what: str
    measured: str
    target: str
    is_met: bool = True


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=25, help="of the list through each parser")
    parser.add_argument("--seconds", type=float, default=5.0, help="for which the client listens")
    parser.add_argument("--check", action="store_true", help="fail when a target is missed")
    arguments = parser.parse_args()
    download = record_download()
    figures = [
        *in_event_loop(partial(rates, download, arguments.rounds)),
        *(load(arguments.seconds, burst) for burst in (1, TELEMETRY // 100)),
        in_event_loop(partial(memory, download)),
        start(),
    ]
    print(f"{'Python ' + sys.version.split()[0]:60}{'measured':>20}   target")
    for each in figures:
        print(f"{each.what:60}{each.measured:>20}   {each.target}{'' if each.is_met else ', missed'}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    return 1 if arguments.check and not all(each.is_met for each in figures) else 0


def in_event_loop(work: Callable[[], Result]) -> Result:
    """Run a function in an event loop, which a station needs."""

    async def run() -> Result:
        return work()

    return anyio.run(run)


def rates(download: Download, rounds: int) -> list[Figure]:
    """Measure the frames per second of each way of parsing, and the proof of a table."""
    count = len(download.values) - 1
    ways: dict[str, Callable[[list[bytes]], float]] = {
        "pymavlink, parsing only": parse_with_pymavlink,
        "first values": lambda chunks: receive(download, chunks),
        "values known": lambda chunks: receive(download, chunks, known=True),
    }
    measured: dict[tuple[str, str], list[float]] = {}
    proofs = []
    for _ in range(rounds):
        for how in ("one by one", "at once"):
            chunks = [b"".join(download.values[:-1])] if how == "at once" else download.values[:-1]
            for way, take in ways.items():
                gc.collect()
                measured.setdefault((way, how), []).append(count / take(chunks))
        proofs.append(prove(download))
    figures = []
    for (way, how), each in measured.items():
        rate, theirs = (statistics.median(of) for of in (each, measured["pymavlink, parsing only", how]))
        what, cell = f"PARAM_VALUEs a second, {how}: {way}", f"{rate:,.0f} ({rate / theirs:.1f} x)"
        is_own = way != "pymavlink, parsing only"
        is_met = not is_own or rate >= max(FRAMES_PER_SECOND, theirs)
        figures.append(Figure(what, cell, f"{FRAMES_PER_SECOND:,} (1 x)" if is_own else "", is_met))
    return [*figures, Figure("proof of a table", f"{statistics.median(proofs) * 1e3:.1f} ms", "")]


def parse_with_pymavlink(chunks: list[bytes]) -> float:
    """Return the CPU seconds of pymavlink's parser, set up as in a program without a signing key."""
    parser = common.MAVLink(None)
    parsed = 0
    start = time.process_time()
    for chunk in chunks:
        parsed += len(parser.parse_buffer(chunk) or ())
    elapsed = time.process_time() - start
    check(parsed == sum(map(frames_in, chunks)), "pymavlink has not found every frame")
    return elapsed


def receive(download: Download, chunks: list[bytes], *, known: bool = False) -> float:
    """Return the CPU seconds from bytes to table."""
    station = meet(download)
    if known:
        deliver(station, chunks, 1.0)
    elapsed = deliver(station, chunks, 2.0)
    check(len(station.nodes[1, 1].plain.table.params) == len(download.values) - 1, "values are missing")
    return elapsed


def prove(download: Download) -> float:
    """Return the CPU seconds for the proof of a whole table: its hash is computed and compared."""
    station = meet(download)
    deliver(station, [download.announcement, *download.values], 2.0)
    session = station.nodes[1, 1].plain
    start = time.process_time()
    session.confirm_announced()
    elapsed = time.process_time() - start
    check(session.table.volatile_is_known, "the hash was not proven")
    return elapsed


def deliver(station: Station, chunks: list[bytes], now: float) -> float:
    start = time.process_time()
    for chunk in chunks:
        station.receive(chunk, None, now)
        now += 0.001
    return time.process_time() - start


def meet(download: Download) -> Station:
    """Return a station that has received the vehicle's heartbeat."""
    station = Station(link="bench", is_stream=False, send=ignore, spawn=ignore)
    station.receive(download.heartbeat, None, 0.0)
    return station


def ignore(*_: object) -> None:
    """Send nothing, and start nothing."""


def load(seconds: float, burst: int) -> Figure:
    """Measure the share of a core that a listening client needs."""
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    sender = spawn.Process(target=send_telemetry, args=(port, burst, stop))
    sender.start()
    try:
        share, received = anyio.run(listen, port, seconds)
    finally:
        stop.set()
        sender.join()
    how = "one by one" if burst == 1 else f"{burst} at a time"
    what = f"{received:,.0f} other frames a second, {how}"
    return Figure(what, f"{share:.1%} of a core", f"{LOAD_MAX:.0%} at {TELEMETRY:,}", share < LOAD_MAX)


async def listen(port: int, seconds: float) -> tuple[float, float]:
    """Return the share of a core that a client uses, and the frames per second that it receives."""
    async with ParamClient(f"udpin:127.0.0.1:{port}", cache=False) as client:
        await client.component()
        await anyio.sleep(WARM_UP)
        began, used, received = time.perf_counter(), time.process_time(), client.bytes_received
        await anyio.sleep(seconds)
        wall = time.perf_counter() - began
        load = (time.process_time() - used) / wall
        frames = (client.bytes_received - received) / wall / MEAN_SIZE
    return load, frames


def send_telemetry(port: int, burst: int, stop: Event) -> None:
    """Send a vehicle's telemetry to a port until `stop` is set; runs in another process.

    The time since boot goes on in it, as a vehicle's does: else the client would see several vehicles.
    """
    mav = common.MAVLink(None, 1, 1)
    frames = telemetry()
    messages = [mav.parse_buffer(frame)[0] for frame in frames]
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
                    message = messages[number % len(frames)]
                    if hasattr(message, "time_boot_ms"):
                        message.time_boot_ms = int((time.perf_counter() - began) * 1_000) + 60_000
                        out.send(message.pack(mav))
                    else:
                        out.send(frames[number % len(frames)])
                except ConnectionRefusedError:
                    pass  # the client has not opened the port yet, or has closed it
            sent += burst
            time.sleep(max(0.0, began + sent / TELEMETRY - time.perf_counter()))


def telemetry() -> list[bytes]:
    """Return frames that a client does not use: no PARAM_VALUE, and no heartbeat."""
    stream = build_stream(3_000, random.Random(1))
    frames = []
    while stream:
        size = stream[1] + 12
        frame, stream = stream[:size], stream[size:]
        if frame[7:10] not in (b"\x00\0\0", b"\x16\0\0"):
            frames.append(frame)
    return frames


MEAN_SIZE = statistics.mean(map(len, telemetry()))
"""Mean bytes of a frame."""


def memory(download: Download) -> Figure:
    """Measure the KiB for 1,000 parameters, without the names that are remembered once for all components."""
    station = meet(download)
    forget_names()
    tracemalloc.start()
    try:
        deliver(station, [download.announcement, *download.values], 1.0)
        check(station.nodes[1, 1].plain.table.is_complete, "the download is not complete")
        forget_names()
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    kib = used * 1000 / 1024 / len(download.values)
    return Figure("memory of 1,000 parameters", f"{kib:.0f} KiB", f"{MEMORY_MAX} KiB", kib <= MEMORY_MAX)


def start() -> Figure:
    """Measure the start of the command."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = min(first_byte_after(f"{folder}/cache.sqlite3") for _ in range(STARTS))
    what = "start of the command to its first byte on the link"
    return Figure(what, f"{seconds:.2f} s", f"{START_MAX} s", seconds <= START_MAX)


def first_byte_after(cache: str) -> float:
    """Run `fetch` against a socket that only listens; return the seconds until the first datagram."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(START_TIMEOUT)
        url = f"udpout:127.0.0.1:{listener.getsockname()[1]}"
        command = [sys.executable, "-m", "paramclient", "fetch", url, "--json", "--cache", cache]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                listener.recv(1)
                return time.perf_counter() - began
            finally:
                process.terminate()


def forget_names() -> None:
    """Clear what is remembered of names, once for all components, and the free lists of the interpreter."""
    text_of.cache_clear()
    is_portable_name.cache_clear()
    gc.collect()


def record_download() -> Download:
    """Return the frames that a simulated PX4 vehicle sends for a list request."""
    vehicle = PX4Vehicle()
    vehicle.tick(0.0)
    heartbeat, _system_time = vehicle.data_to_send()
    request = encode(ParamRequestList(1, 1), system=255, component=190, sequence=0)
    vehicle.receive(request, 0.0)
    values: list[bytes] = []
    now = 0.0
    while len(values) <= len(vehicle.params):
        vehicle.tick(now)
        values += [frame for frame in vehicle.data_to_send() if frame[7:10] == b"\x16\0\0"]
        now += 0.01
    return Download(heartbeat, values[0], values[1:])


def frames_in(chunk: bytes) -> int:
    return len(Framer(stream=False).receive(chunk))


def check(condition: bool, otherwise: str) -> None:
    if not condition:
        raise SystemExit(otherwise)


if __name__ == "__main__":
    sys.exit(main())
