"""Comparison of full downloads by this library, pymavlink, MAVSDK and MAVProxy.

    python bench/peers.py [--repeat N] [--limit SECONDS] [--only TEXT ...] [--live LINK]

Simulated PX4 and ArduPilot vehicles communicate over real UDP on loopback, each in its own process, over a
link with packet loss in both directions. Every client starts without a cache and first receives a heartbeat;
its time is measured from the request to the last value. The values are compared with those of the vehicle. An
ArduPilot "by file" also serves its table over MAVFTP, and clients that support it download the file. "By
list", it does not. "Warm", the client has just cached the table in a session before.

With `--live`, the vehicle is the one on this link, real or in its firmware's own simulation; the relay of
`tests/live/relay.py` drops the datagrams and, in the rows "by list", refuses MAVFTP. Nothing is changed on
the vehicle.

Prints a Markdown table of the median seconds, each with its ratio to this library, and below it the date, the
machine and its load, ready to be pasted; the progress is printed on stderr. A whole run takes about 25
minutes.

MAVSDK and MAVProxy are in the dependency group `peers`; the table names programs that are not installed.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import platform
import re
import shutil
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import anyio

from paramclient import Identity, ParamClient
from paramclient.links import create_link, serve_endpoint
from paramclient.model.identity import autopilot_name
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.version import __version__
from paramclient.wire.frames import Framer
from paramclient.wire.messages import MAV_AUTOPILOT_ARDUPILOTMEGA
from tests.live.journal import Journal
from tests.live.relay import Conditions, Relay

REPEAT = 3
LIMIT = 120.0
"""Timeout of one download in seconds."""
SET_BY_STATIONS = re.compile(r"SR\d_\w+")
"""Parameters in which ArduPilot keeps the streams that a station requests, as MAVProxy does at its start."""
START_TIMEOUT = 30.0
"""Further seconds for the start of a client and its first heartbeat."""
ROUND_TRIP = 0.1
"""Round-trip time in seconds of the cases with packet loss."""
LOSSES = (0.0, 0.05, 0.20)
"""Shares of lost datagrams in each direction. With packet loss, the round trip is `ROUND_TRIP` seconds."""
SILENCE = 1.0
"""Seconds of silence after which the usual loop over pymavlink requests missing indices."""
MISSING_AT_ONCE = 10
"""Missing indices that the usual loop over pymavlink requests after each silence."""
TOLERANCE = 1e-6
"""Difference up to which values count as equal: the file that MAVProxy writes has six decimals."""

SESSION_PAUSE = 3.5
"""Seconds before each download of a real vehicle: ArduPilot keeps a file that was not closed open for 3 s."""
TITLES = {"px4": "PX4", "ardupilot": "ArduPilot"}
WAYS = ("list", "file", "warm")

Values = Mapping[str, float]
Fetch = Callable[[int, float], tuple[float, Values]]
spawn = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Outcome:
    """The outcome of one download.

    Attributes:
        seconds: its duration; infinite if it is incomplete.
        problem: the error, or "".
        wrong: number of values that differ from the vehicle's.
    """

    seconds: float
    problem: str = ""
    wrong: int = 0


@dataclass(frozen=True)
class Case:
    """One simulated vehicle on one link.

    Attributes:
        kind: the kind of vehicle.
        loss: the share of lost datagrams in each direction.
        way: "list"; or "file" or "warm", where the vehicle also serves its table as a file.
    """

    kind: str
    loss: float
    way: str = "list"

    @property
    def name(self) -> str:
        return f"{self.title} {self.link}"

    @property
    def title(self) -> str:
        """The kind of vehicle, and for one that may serve a file, how its table is fetched."""
        ways = {"list": " by list", "file": " by file", "warm": " warm"}
        return f"{self.kind}{ways[self.way] if self.kind.endswith('ArduPilot') else ''}"

    @property
    def link(self) -> str:
        return f"{self.loss:.0%}" if self.loss else "clean"

    @property
    def truth(self) -> Mapping[str, float]:
        """The vehicle's values by name."""
        return {name: float(v) for name, v in self.vehicle().values.items() if not isinstance(v, bytes)}

    def is_settled(self, name: str) -> bool:
        """Return whether the value stays the same unless it is set."""
        return True

    def vehicle(self) -> Vehicle:
        return (
            PX4Vehicle() if self.kind == "PX4" else ArduPilotVehicle(live_period=0.0, ftp=self.way != "list")
        )

    def air(self, seed: int) -> Air:
        return Air.symmetric(
            [self.vehicle()], loss=self.loss, delay=ROUND_TRIP / 2 if self.loss else 0.0, seed=seed
        )

    @contextmanager
    def flying(self, seed: int) -> Iterator[tuple[int, Any]]:
        """Run the vehicle in a new process.

        Yields the port that it sends to, and a shared number: the time of the first request for list or file.
        """
        port = free_port()
        requested_at = spawn.Value("d", math.inf)
        process = spawn.Process(target=fly, args=(self, seed, port, requested_at))
        process.start()
        try:
            yield port, requested_at
        finally:
            process.kill()
            process.join()


@dataclass(frozen=True)
class LiveCase(Case):
    """A real vehicle on one link.

    Attributes:
        field: the relay to it, and its values.
    """

    field: LiveField | None = None

    @property
    def truth(self) -> Mapping[str, float]:
        """See `Case.truth`."""
        return self._field.values

    def is_settled(self, name: str) -> bool:
        """See `Case.is_settled`."""
        return not (self._field.journal.moves_by_itself(name) or SET_BY_STATIONS.fullmatch(name))

    @contextmanager
    def flying(self, seed: int) -> Iterator[tuple[int, Any]]:
        """See `Case.flying`; the vehicle runs already, and hears a new client over another link."""
        time.sleep(SESSION_PAUSE)
        conditions = Conditions(
            loss=self.loss,
            round_trip=ROUND_TRIP if self.loss else 0.0,
            seed=seed,
            refuses_files=self.way == "list",
        )
        self._field.relay.change(conditions)
        yield self._field.port, self._field

    @property
    def _field(self) -> LiveField:
        assert self.field is not None
        return self.field


class LiveField:
    """A real vehicle and the relay to it.

    Attributes:
        relay: the relay, which drops datagrams.
        port: the port on which every client listens.
        journal: the vehicle's state at the beginning, and the parameters that it changes itself.
        values: the values of that state.
        kind: the kind of autopilot, as the table names it.
        vehicle: the vehicle in words.
    """

    def __init__(self, relay: Relay, port: int, folder: Path) -> None:
        self.relay = relay
        self.port = port
        self.journal = Journal(folder)
        self.values: dict[str, float] = {}
        self.kind = ""
        self.vehicle = ""
        anyio.run(self._look)

    @property
    def value(self) -> float:
        """The time of the first request for list or file; infinite before."""
        requested_at = self.relay.first_request_at()
        return math.inf if requested_at is None else requested_at

    def cases(self) -> list[Case]:
        """Return the rows for this vehicle."""
        ways = WAYS if self.kind == "real ArduPilot" else WAYS[:1]
        return [LiveCase(self.kind, loss, way, self) for way in ways for loss in LOSSES]

    async def _look(self) -> None:
        async with ParamClient(self.relay.link, cache=False) as client:
            component = await client.component(timeout=START_TIMEOUT)
            result = await component.fetch_all(timeout=LIMIT)
            listed = {name: param for name, param in result.params.items() if param.index is not None}
            self.journal.begin(component, listed)
            self.kind = f"real {TITLES.get(component.autopilot, component.autopilot)}"
            self.vehicle = firmware(component.identity)
        self.values = {name: float(param.value) for name, param in listed.items() if not param.is_raw}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeat", type=int, default=REPEAT, help="downloads of which the median counts")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds that one may take")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[""],
        metavar="TEXT",
        help="clients and cases whose names hold one of these",
    )
    parser.add_argument(
        "--live", metavar="LINK", help="the link to a real vehicle, in place of simulated ones"
    )
    arguments = parser.parse_args()
    with ExitStack() as stack:
        field: LiveField | None = None
        if arguments.live is None:
            kinds = (("PX4", "list"), *(("ArduPilot", way) for way in WAYS))
            cases = [Case(kind, loss, way) for kind, way in kinds for loss in LOSSES]
        else:
            port = free_port()
            relay = stack.enter_context(Relay(arguments.live, listeners=[port]))
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            field = LiveField(relay, port, Path(folder))
            cases = field.cases()
        compare(cases, arguments, "" if field is None else f" {field.vehicle}.")


def compare(cases: list[Case], arguments: argparse.Namespace, vehicle: str) -> None:
    """Run every client on every case, and print the table, which ends with `vehicle`."""
    clients = choose(list(CLIENTS), arguments.only)
    chosen = [case for case in cases if case.name in choose([case.name for case in cases], arguments.only)]
    results: dict[tuple[str, Case], list[Outcome]] = {}
    began = time.monotonic()
    loads = [os.getloadavg()[0]]
    for seed in range(arguments.repeat):
        for case in chosen:
            for client in clients:
                if case.way not in CLIENTS[client].ways:
                    continue
                outcome = CLIENTS[client].run(case, seed, arguments.limit)
                results.setdefault((client, case), []).append(outcome)
                loads.append(os.getloadavg()[0])
                said = outcome.problem or f"{outcome.seconds:.2f} s"
                print(f"{case.name}, {client}: {said}", file=sys.stderr, flush=True)
    print_table(clients, chosen, results)
    print(
        f"\nMedian of {arguments.repeat}, in seconds; in brackets the ratio to paramclient. Datagrams are "
        f"lost in both directions, and where they are, the round trip is {ROUND_TRIP * 1000:.0f} ms. "
        f"{time.strftime('%Y-%m-%d')}, {machine()}, load {min(loads):.1f} to {max(loads):.1f}, "
        f"{(time.monotonic() - began) / 60:.0f} minutes. {versions(MAVPROXY)}.{vehicle}"
    )


def choose(names: list[str], texts: list[str]) -> list[str]:
    """Return the names that contain one of the texts; all names if none does."""
    return [name for name in names if any(text in name for text in texts)] or names


# Output


def print_table(
    clients: list[str], cases: list[Case], results: Mapping[tuple[str, Case], list[Outcome]]
) -> None:
    notes: list[str] = []
    print(f"| vehicle, parameters, loss | {' | '.join(clients)} |")
    print(f"|---|{'---|' * len(clients)}")
    for case in cases:
        cells = []
        ours = results.get(("paramclient", case))
        for client in clients:
            outcomes = results.get((client, case))
            if outcomes is None:
                cells.append("not supported")
            else:
                cells.append(cell(outcomes, ours) + "".join(mark(notes, note) for note in remarks(outcomes)))
        count = len(case.truth)
        print(f"| {case.title}, {count}, {case.link} | {' | '.join(cells)} |")
    if notes:
        print()
    for number, note in enumerate(notes, 1):
        print(f"{number}. {note}")


def cell(outcomes: list[Outcome], ours: list[Outcome] | None) -> str:
    seconds = middle(outcomes)
    if seconds == math.inf:
        problems = [outcome.problem for outcome in outcomes if outcome.problem]
        return statistics.mode(problems)
    ratio = f" ({seconds / middle(ours):.1f})" if ours and middle(ours) < math.inf else ""
    return f"{seconds:.2f}{ratio}"


def middle(outcomes: list[Outcome]) -> float:
    return statistics.median_high([outcome.seconds for outcome in outcomes])


def remarks(outcomes: list[Outcome]) -> Iterator[str]:
    """Yield the remarks that accompany the median."""
    if middle(outcomes) < math.inf:
        for problem in sorted({outcome.problem for outcome in outcomes if outcome.problem}):
            times = sum(outcome.problem == problem for outcome in outcomes)
            yield f"{times} of {len(outcomes)} downloads: {problem}"
    wrong = max(outcome.wrong for outcome in outcomes)
    if wrong:
        yield f"{wrong} values were not the vehicle's"


def mark(notes: list[str], note: str) -> str:
    if note not in notes:
        notes.append(note)
    return f" [{notes.index(note) + 1}]"


def machine() -> str:
    return f"{os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def versions(mavproxy: MavProxy) -> str:
    packages = [f"{package} {installed(package)}" for package in ("paramclient", "pymavlink", "mavsdk")]
    return ", ".join([*packages, f"MAVProxy {mavproxy.version or 'not installed'}"])


def firmware(identity: Identity) -> str:
    """Return the firmware in words, from a vehicle's heartbeat and AUTOPILOT_VERSION."""
    major, minor, patch, stage = identity.firmware.to_bytes(4, "big")
    release = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}.get(stage, f"-{stage}")
    commit = f" ({identity.git_hash[:8]})" if identity.git_hash else ""
    autopilot = autopilot_name(identity.autopilot)
    kinds = {1: "plane", 2: "quadrotor", 10: "rover", 11: "boat", 12: "submarine"}
    kind = kinds.get(identity.vehicle_type, f"vehicle type {identity.vehicle_type}")
    return f"{TITLES.get(autopilot, autopilot)} {kind} {major}.{minor}.{patch}{release}{commit}"


def installed(package: str) -> str:
    if package == "paramclient":
        return __version__  # also without an installation
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


# Vehicles


def free_port() -> int:
    """Return a free port on loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def fly(case: Case, seed: int, port: int, requested_at: Any) -> None:
    """Run the vehicle, sending to a port, until the process is ended."""
    anyio.run(serve_endpoint, Watched(case.air(seed), requested_at), create_link(f"udpout:127.0.0.1:{port}"))


class Watched:
    """An endpoint that records the time of the first request for list or file, before any packet loss."""

    def __init__(self, air: Air, requested_at: Any) -> None:
        self._air = air
        self._requested_at = requested_at
        self._framer = Framer({21, 110}, stream=False)
        self.tick = air.tick
        self.next_deadline = air.next_deadline
        self.data_to_send = air.data_to_send

    def receive(self, data: bytes, now: float) -> None:
        if self._requested_at.value == math.inf and self._framer.receive(data):
            self._requested_at.value = time.monotonic()
        self._air.receive(data, now)


# Clients


class PythonClient:
    """A client that is called from Python, each time in a new process.

    Args:
        package: the package that must be installed.
        fetches: by the ways that the client supports, a function that takes the port and the timeout in
            seconds, and returns the seconds used, and the values.
    """

    def __init__(self, package: str, fetches: Mapping[str, Fetch]) -> None:
        self.ways = tuple(fetches)
        self._package = package
        self._fetches = fetches

    def run(self, case: Case, seed: int, limit: float) -> Outcome:
        if installed(self._package) == "not installed":
            return Outcome(math.inf, "not installed")
        receiver, sender = spawn.Pipe(duplex=False)
        with case.flying(seed) as (port, _):
            process = spawn.Process(target=call, args=(self._fetches[case.way], port, limit, sender))
            process.start()
            sender.close()
            try:
                if not receiver.poll(limit + START_TIMEOUT):
                    return Outcome(math.inf, f"> {limit:.0f}")
                seconds, values, problem = receiver.recv()
            except EOFError:
                return Outcome(math.inf, "ended without a result")
            finally:
                process.kill()
                process.join()
        return Outcome(math.inf, problem) if problem else judge(case, seconds, values, limit)


def call(fetch: Fetch, port: int, limit: float, result: Connection) -> None:
    try:
        seconds, values = fetch(port, limit)
    except Exception as error:
        result.send((math.inf, {}, f"failed: {type(error).__name__}: {error}"))
    else:
        result.send((seconds, values, ""))


def judge(case: Case, seconds: float, values: Values, limit: float) -> Outcome:
    """Compare the downloaded values with those of the vehicle."""
    truth = case.truth
    got = truth.keys() & values.keys()
    if len(got) < len(truth):
        return Outcome(math.inf, f"incomplete ({len(got)} of {len(truth)})")
    if seconds > limit:
        return Outcome(math.inf, f"> {limit:.0f}")
    wrong = sum(
        not math.isclose(values[name], value, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
        for name, value in truth.items()
        if case.is_settled(name)
    )
    return Outcome(seconds, wrong=wrong)


def fetch_with_paramclient(
    port: int, limit: float, cache: Path | Literal[False] = False
) -> tuple[float, Values]:
    async def fetch() -> tuple[float, Values]:
        async with ParamClient(f"udpin:127.0.0.1:{port}", cache=cache) as client:
            component = await client.component(timeout=START_TIMEOUT)
            began = time.monotonic()
            result = await component.fetch_all(timeout=limit)
            seconds = time.monotonic() - began
            return seconds, {name: float(param.value) for name, param in result.params.items()}

    return anyio.run(fetch)


def start_paramclient_warm(port: int, limit: float) -> tuple[float, Values]:
    """Fetch twice with one cache, each time with a new client; return the second time."""
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache.sqlite3"
        fetch_with_paramclient(port, limit, cache)
        return fetch_with_paramclient(port, limit, cache)


def fetch_with_pymavlink(port: int, limit: float) -> tuple[float, Values]:
    """Download with the usual loop: the list, then after each silence reads of some missing indices."""
    from pymavlink import mavutil

    master = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    master.wait_heartbeat(timeout=START_TIMEOUT)
    is_cast = master.messages["HEARTBEAT"].autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA
    values: dict[str, float] = {}
    missing: set[int] | None = None
    began = received = time.monotonic()
    master.param_fetch_all()
    while missing is None or missing:
        now = time.monotonic()
        if now - began > limit:
            break
        if now - received >= SILENCE:
            received = now
            if missing is None:
                master.param_fetch_all()
            else:
                for index in sorted(missing)[:MISSING_AT_ONCE]:
                    master.param_fetch_one(index)
        message = master.recv_match(type="PARAM_VALUE", blocking=True, timeout=received + SILENCE - now)
        if message is not None and message.param_index < message.param_count:
            received = time.monotonic()
            if missing is None:
                missing = set(range(message.param_count))
            missing.discard(message.param_index)
            values[message.param_id] = number_in(message, is_cast=is_cast)
    return time.monotonic() - began, values


def number_in(message: Any, *, is_cast: bool) -> float:
    """Return the number that a float of pymavlink encodes."""
    layout = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i"}.get(message.param_type)
    if is_cast or layout is None:
        return float(message.param_value)
    return float(struct.unpack_from(f"<{layout}", struct.pack("<f", message.param_value))[0])


def fetch_with_mavsdk(port: int, limit: float) -> tuple[float, Values]:
    from mavsdk import ComponentType, Configuration, Mavsdk, log_subscribe
    from mavsdk.plugins.param import Param

    log_subscribe(lambda *_: True)  # MAVSDK would log on stdout
    with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = mavsdk.first_autopilot(timeout_s=START_TIMEOUT)
        if system is None:
            raise RuntimeError("no autopilot was received")
        param = Param(system)
        began = time.monotonic()
        found = param.get_all_params()
        seconds = time.monotonic() - began
        return seconds, {each.name: float(each.value) for each in (*found.int_params, *found.float_params)}


class MavProxy:
    """MAVProxy as a program. It requests the parameters itself after the first heartbeat.

    Args:
        command: the program; None: the one beside Python, or on the PATH.
    """

    ways = ("list", "file")

    def __init__(self, command: str | None = None) -> None:
        beside = shutil.which("mavproxy.py", path=Path(sys.executable).parent)
        self._command = command or beside or shutil.which("mavproxy.py")

    @property
    def version(self) -> str:
        """Its version; "" if it is not installed."""
        if self._command is None:
            return ""
        output = subprocess.run([self._command, "--version"], capture_output=True, text=True, check=True)
        return output.stdout.rpartition("Version: ")[2].strip()

    def run(self, case: Case, seed: int, limit: float) -> Outcome:
        if self._command is None:
            return Outcome(math.inf, "not installed")
        with tempfile.TemporaryDirectory() as folder, case.flying(seed) as (port, requested_at):
            # with its module for MAVFTP it always tries the file first, without it downloads by list
            modules = "ftp,param" if case.way == "file" else "param"
            command = [self._command, f"--master=udpin:127.0.0.1:{port}"]
            command += [
                "--non-interactive",
                f"--default-modules={modules}",
                f"--state-basedir={folder}",
                "--aircraft=bench",
            ]
            environment = os.environ | {"PYTHONUNBUFFERED": "1", "HOME": folder}
            with subprocess.Popen(
                command,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            ) as process:
                watchdog = threading.Timer(limit + START_TIMEOUT, process.kill)
                watchdog.start()
                try:
                    return self._follow(process, case, requested_at, limit)
                finally:
                    watchdog.cancel()
                    process.kill()

    def _follow(self, process: subprocess.Popen[str], case: Case, requested_at: Any, limit: float) -> Outcome:
        assert process.stdout is not None
        seconds = math.inf
        for line in process.stdout:
            if re.search(r"Received \d+ parameters", line):
                seconds = time.monotonic() - requested_at.value
            saved = re.search(r"Saved \d+ parameters to (.+)", line)
            if saved:
                text = Path(saved[1].strip()).read_text(encoding="utf-8")
                values = {
                    name: float(value) for name, value in re.findall(r"^(\w+)\s+(\S+)$", text, re.MULTILINE)
                }
                return judge(case, seconds, values, limit)
        return Outcome(
            math.inf, f"> {limit:.0f}" if requested_at.value < math.inf else "ended without a result"
        )


MAVPROXY = MavProxy()
CLIENTS: dict[str, PythonClient | MavProxy] = {
    "paramclient": PythonClient(
        "paramclient",
        {
            "list": fetch_with_paramclient,
            "file": fetch_with_paramclient,
            "warm": start_paramclient_warm,
        },
    ),
    "pymavlink, the usual loop": PythonClient("pymavlink", {"list": fetch_with_pymavlink}),
    "MAVSDK": PythonClient("mavsdk", {"list": fetch_with_mavsdk}),
    "MAVProxy": MAVPROXY,
}


if __name__ == "__main__":
    main()
