"""Duration of the main operations on real autopilots, over a link with packet loss; bytes of warm starts.

    python bench/live.py LINK --kind ardupilot|px4 [--seeds N] [--row TEXT ...] [--check] [--json]

LINK is the link to one vehicle, real or in the firmware's own simulation, such as `udpin:127.0.0.1:14550`. It
must be disarmed. Everything goes through the relay of `tests/live/relay.py`, which has one port towards the
vehicle for the whole run. Each run of a row is a new client with a new, empty cache; a warm start has the
cache of the runs before it. Every table is compared with one that was fetched at the beginning.

The rows with `apply` and with two changed values change parameters, and restore them after each run: `apply`
turns on four groups that are off, and changes members of them. The row after a restart reboots the vehicle.

Prints a Markdown table, and below it the date, the machine, its load and the firmware, ready to be pasted.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Final, NamedTuple

import anyio
from peers import TITLES, firmware, machine

from paramclient import Component, FetchResult, ParamClient, ParamSet, WrittenParam
from paramclient.errors import LinkError, NoReply, ParamClientError, UsageError, VehicleArmed
from paramclient.model.values import Param
from paramclient.provision import apply
from paramclient.version import __version__
from paramclient.wire.frames import Framer
from paramclient.wire.messages import AUTOPILOT_COMPONENT, CommandAck, CommandLong, decode, encode
from tests.live.choice import another_value, choose
from tests.live.journal import Journal, check_disarmed
from tests.live.relay import CLEAN, Conditions, Relay

SEEDS: Final = 10
ROUND_TRIP: Final = 0.1
"""Round-trip time in seconds of the rows with packet loss."""
RADIO: Final = Conditions(rate=5760, round_trip=0.05, drops_telemetry=True)
"""A radio at 57600 baud."""
FETCH_TIMEOUT: Final = 120.0
"""Timeout of one run in seconds."""
DISCOVERY_TIMEOUT: Final = 20.0
"""Seconds to wait for the vehicle's heartbeat."""
SESSION_PAUSE: Final = 3.5
"""Seconds before each run, except in the row without a pause: ArduPilot keeps a MAVFTP session that was not
closed for 3 s, which must not delay the next run."""
SWITCHES: Final = (
    *(
        "FENCE_ENABLE",
        "GRIP_ENABLE",
        "SCR_ENABLE",
        "FOLL_ENABLE",
        "BTN_ENABLE",
        "SPRAY_ENABLE",
        "PLND_ENABLED",
    ),
    *("DID_ENABLE", "VTX_ENABLE", "CHUTE_ENABLED", "CUST_ROT_ENABLE", "SOAR_ENABLE", "RALLY_ENABLE"),
)
"""Switches of ArduPilot that reveal a group; the first `GROUPS` that are off and reveal enough are used."""
GROUPS: Final = 4
VALUES: Final = 30
"""Number of values that are applied, switches included."""
NO_LIMITS: Final = (
    "_TYPE",
    "_ACTION",
    "_ENABLE",
    "ENABLE",
    "_OPTIONS",
    "_OPTS",
    "_SYSID",
    "_ID",
    "_CAN_ID",
    "_RETRACT",
    "_PIN",
)
"""Suffixes of names of members that are a choice, not a limit."""
GETS: Final = 100
"""Number of sequential reads."""
RUN_TIME: Final = "STAT_RUNTIME"
RESTART_TIME: Final = 8.0
"""Seconds after a reboot until an ArduPilot has calibrated its sensors."""
COMMAND_TIMEOUT: Final = 30.0
"""Seconds for one call of the command."""
ATTITUDE_ID: Final = 30
TELEMETRY_INTERVAL: Final = 0.1
"""Seconds between two ATTITUDE while the command is timed."""
MAV_CMD_SET_MESSAGE_INTERVAL: Final = 511
ENVIRONMENT: Final = {name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
"""Environment of the command, with bytecode caching: else Python compiles modules at each start."""


class WrongResult(Exception):
    """The result of a run differs from the vehicle's values."""


class Cost(NamedTuple):
    """The seconds of a run, and the bytes in both directions, where they are counted."""

    seconds: float
    bytes: int | None = None


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: the operation that is measured.
        kind: the autopilot of the row.
        measure: executes one run with a seed.
        median, worst: the highest acceptable seconds.
        pause: seconds before each run.
        bytes: the highest acceptable number of bytes in both directions; None if they are not counted.
    """

    name: str
    kind: str
    measure: Callable[[Vehicle, int], Awaitable[Cost]]
    median: float
    worst: float
    pause: float = SESSION_PAUSE
    bytes: int | None = None


@dataclass(frozen=True)
class Timing:
    """The result of a row.

    Attributes:
        row: its name.
        seconds: the seconds of each run.
        problems: sentences on runs with wrong results.
        median, worst: median and maximum seconds of the runs.
        promised_median, promised_worst: the highest acceptable seconds.
        bytes, promised_bytes: the most of a run, and the highest acceptable number; or None.
    """

    row: str
    seconds: tuple[float, ...]
    problems: tuple[str, ...]
    median: float
    worst: float
    promised_median: float
    promised_worst: float
    bytes: int | None
    promised_bytes: int | None

    @property
    def is_met(self) -> bool:
        """Whether every run was right, and seconds and bytes are acceptable."""
        is_quick = self.median <= self.promised_median and self.worst <= self.promised_worst
        return not self.problems and is_quick and (self.bytes or 0) <= (self.promised_bytes or math.inf)


@dataclass
class Vehicle:
    """The vehicle of the run.

    Attributes:
        relay: the relay to it.
        system: its system id.
        journal: its state before, and the changes.
        folder: the folder for caches.
        wanted: the values to apply, switches first; None until they are chosen.
        members: the values of the switches and their members before, to restore them.
        caches: number of caches that were created.
        warm: the cache of the warm starts.
    """

    relay: Relay
    system: int
    journal: Journal
    folder: Path
    wanted: ParamSet | None = None
    members: dict[str, Param] = field(default_factory=dict)
    caches: int = 0
    warm: Path | None = None

    def new_cache(self) -> Path:
        """Return the path of a new cache."""
        self.caches += 1
        return self.folder / f"{self.caches}.sqlite3"

    def check(self, result: FetchResult, changed: Collection[str] = ()) -> None:
        """Raise WrongResult unless the result has every value of the state before, apart from `changed`."""
        if not result.complete:
            raise WrongResult(f"{len(result.missing)} parameters are missing")
        listed = {name: param for name, param in result.params.items() if param.index is not None}
        wrong, _ = self.journal.differences(listed)
        wrong = [each for each in wrong if each.partition(" ")[0] not in changed]
        if wrong:
            raise WrongResult(f"{len(wrong)} differ: {', '.join(wrong[:3])}")


def rows() -> Iterator[Row]:
    """Yield all rows in the order of the output."""
    clean = partial(time_fetch, conditions=CLEAN)
    yield Row("ArduPilot by file, clean, without a pause", "ardupilot", clean, 0.45, 0.6, pause=0.0)
    for refuses, way, bounds in (
        (False, "file", {0.05: (1.0, 1.6), 0.20: (1.5, 3.0)}),
        (True, "list", {0.05: (2.8, 4.0), 0.20: (5.0, 7.0)}),
    ):
        for loss, (median, worst) in bounds.items():
            conditions = Conditions(loss=loss, round_trip=ROUND_TRIP, refuses_files=refuses)
            name = f"ArduPilot by {way}, {loss:.0%} lost"
            yield Row(name, "ardupilot", partial(time_fetch, conditions=conditions), median, worst)
    yield from warm_rows()
    yield Row(f"ArduPilot, apply {VALUES} values in {GROUPS} groups", "ardupilot", time_apply, 3.0, 4.0)
    yield Row("PX4, clean", "px4", clean, 0.95, 1.0, pause=0.0)
    for loss, median, worst in ((0.05, 1.2, 1.5), (0.20, 1.6, 2.8)):
        conditions = Conditions(loss=loss, round_trip=ROUND_TRIP)
        yield Row(
            f"PX4, {loss:.0%} lost", "px4", partial(time_fetch, conditions=conditions), median, worst, 0.0
        )
    yield Row(f"PX4, {GETS} gets in sequence", "px4", time_gets, 0.2, 0.4, 0.0)
    for kind, title in (("ardupilot", "ArduPilot"), ("px4", "PX4")):
        yield Row(f"{title}, command: start to the value of one get", kind, time_command, 0.6, 0.9, 0.0)


def warm_rows() -> Iterator[Row]:
    """Yield the warm starts of ArduPilot, and a download of the file to compare."""
    slow = Conditions(round_trip=ROUND_TRIP)
    measure = partial(time_warm_start, conditions=slow, change=None, refresh=True)
    yield Row("ArduPilot warm, refreshed by file, 100 ms", "ardupilot", measure, 0.9, 0.9, 0.0, 30_000)
    for name, conditions, change, median, worst, most in (
        ("unchanged", CLEAN, None, 0.05, 0.05, 600),
        ("run time passed", CLEAN, pass_run_time, 0.05, 0.05, 600),
        ("two values changed", CLEAN, change_two, 0.3, 0.3, 3000),
        ("unchanged, 100 ms", slow, None, 0.3, 0.3, None),
        ("two values changed, 100 ms", slow, change_two, 0.72, 0.72, None),  # the time of a Copter's file
        ("unchanged, 20% lost", replace(slow, loss=0.2), None, 0.7, 2.0, None),
        ("unchanged, 57600 baud", RADIO, None, 0.8, 0.8, None),
        ("after a restart", CLEAN, restart, 0.4, 0.4, 3000),  # last: it measures its pressure anew later
    ):
        measure = partial(time_warm_start, conditions=conditions, change=change)
        yield Row(f"ArduPilot warm, {name}", "ardupilot", measure, median, worst, 0.0, most)


async def time_fetch(vehicle: Vehicle, seed: int, *, conditions: Conditions) -> Cost:
    """Fetch all parameters once; measure the call, after the first heartbeat."""
    vehicle.relay.change(replace(conditions, seed=seed))
    async with ParamClient(vehicle.relay.link, cache=vehicle.new_cache()) as client:
        component = await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT)
        began = time.monotonic()
        result = await component.fetch_all(timeout=FETCH_TIMEOUT)
        seconds = time.monotonic() - began
    vehicle.check(result)
    return Cost(seconds)


async def time_warm_start(
    vehicle: Vehicle,
    seed: int,
    *,
    conditions: Conditions,
    change: Callable[[Vehicle, int, Component], Awaitable[None]] | None,
    refresh: bool = False,
) -> Cost:
    """Fetch all parameters with the cache of the run before; measure the call, after the identification.

    Args:
        vehicle: the vehicle of the run.
        seed: of the conditions. With 0, a new cache is filled first.
        conditions: of the measured fetch.
        change: changes the vehicle before it, by another client; or None.
        refresh: download all the same.
    """
    vehicle.relay.change(CLEAN)
    if not seed:
        vehicle.warm = vehicle.new_cache()
        async with ParamClient(vehicle.relay.link, cache=vehicle.warm) as client:
            await (await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT)).fetch_all()
    if change is not None:
        async with ParamClient(vehicle.relay.link, cache=False) as client:
            await change(vehicle, seed, await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT))
    vehicle.relay.change(replace(conditions, seed=seed, drops_telemetry=True))  # of which a burst may come
    async with ParamClient(vehicle.relay.link, cache=vehicle.warm) as client:
        component = await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT)
        await component.wait_until_identified(DISCOVERY_TIMEOUT)
        gc.collect()  # what the clients before have left
        before = client.bytes_received + client.bytes_sent
        began = time.monotonic()
        result = await component.fetch_all(timeout=FETCH_TIMEOUT, refresh=refresh)
        cost = Cost(time.monotonic() - began, client.bytes_received + client.bytes_sent - before)
        vehicle.relay.change(CLEAN)
        changed = {name: another_value(vehicle.journal.before[name]) for name in vehicle.journal.changed}
        await put_back(vehicle, component)
    if result.source != "cache":  # counts with the time of the download
        print(f"from {result.source}: {', '.join(result.notes)}", file=sys.stderr)
    elif set(result.changed) != changed.keys():  # a late message of the client before brought a value
        print(f"{', '.join(result.changed)} changed, not {', '.join(changed)}", file=sys.stderr)
    if wrong := [name for name, value in changed.items() if result.params[name].value != value]:
        raise WrongResult(f"{', '.join(wrong)} are as before the change")
    vehicle.check(result, changed)
    return cost


async def change_two(vehicle: Vehicle, seed: int, component: Component) -> None:
    """Change two harmless values that are far apart in the table; others with each seed."""
    choice = choose("ardupilot", vehicle.journal.before)
    single = list(choice.by_type.values())
    for name in (single[seed % len(single)], choice.many[seed % len(choice.many)]):
        await vehicle.journal.set(component, name, another_value(vehicle.journal.before[name]))


async def pass_run_time(_vehicle: Vehicle, _seed: int, component: Component) -> None:
    """Wait until the vehicle stores its run time, which it does every 30 s."""
    before = await component.get(RUN_TIME)
    async for change in component.changes():
        if change.name == RUN_TIME and change.new is not None and change.new.value != before.value:
            return


async def restart(_vehicle: Vehicle, _seed: int, component: Component) -> None:
    """Reboot the vehicle."""
    await check_disarmed(component)
    await component.reboot()
    await anyio.sleep(RESTART_TIME)


async def time_gets(vehicle: Vehicle, seed: int) -> Cost:
    """Read values sequentially in a new session."""
    vehicle.relay.change(replace(CLEAN, seed=seed))
    names = sorted(name for name, param in vehicle.journal.before.items() if isinstance(param.value, int))
    async with ParamClient(vehicle.relay.link, cache=vehicle.new_cache()) as client:
        component = await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT)
        began = time.monotonic()
        read = [await component.get(name) for name in names[:GETS]]
        seconds = time.monotonic() - began
    wrong = [param.name for param in read if param.value != vehicle.journal.before[param.name].value]
    if wrong or len(read) < GETS:
        raise WrongResult(f"of {len(read)} values differ: {', '.join(wrong[:3])}")
    return Cost(seconds)


async def time_command(vehicle: Vehicle, seed: int) -> Cost:
    """Run `paramclient get` once; measure from the start of its process to the printed value.

    The vehicle sends telemetry meanwhile, as to a ground station. A vehicle that sends only heartbeats is
    heard up to a second later.
    """
    vehicle.relay.change(CLEAN)
    set_attitude_interval(vehicle, TELEMETRY_INTERVAL)
    try:
        return await time_one_get(vehicle, seed)
    finally:
        set_attitude_interval(vehicle, 0.0)


def set_attitude_interval(vehicle: Vehicle, seconds: float) -> None:
    """Set the interval of ATTITUDE in seconds by MAV_CMD_SET_MESSAGE_INTERVAL; 0 restores the default."""
    host, port = vehicle.relay.link.removeprefix("udpout:").split(":")
    target = vehicle.system, AUTOPILOT_COMPONENT
    command = CommandLong(*target, MAV_CMD_SET_MESSAGE_INTERVAL, float(ATTITUDE_ID), seconds * 1e6)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.settimeout(COMMAND_TIMEOUT)
        framer = Framer(stream=False)
        station.sendto(encode(command, system=255, component=190, sequence=0), (host, int(port)))
        while True:
            answers = [decode(frame) for frame in framer.receive(station.recv(2048))]
            if any(isinstance(each, CommandAck) and each.command == command.command for each in answers):
                return


async def time_one_get(vehicle: Vehicle, seed: int) -> Cost:
    names = sorted(name for name, param in vehicle.journal.before.items() if isinstance(param.value, int))
    name = names[seed % len(names)]
    command = [sys.executable, "-m", "paramclient", "get", vehicle.relay.link, name]
    command += ["--cache", str(vehicle.new_cache())]
    began = time.monotonic()
    with anyio.fail_after(COMMAND_TIMEOUT):
        async with await anyio.open_process(command, stderr=subprocess.DEVNULL, env=ENVIRONMENT) as process:
            assert process.stdout is not None
            printed = b""
            while name.encode() not in printed or b"\n" not in printed:
                printed += await process.stdout.receive()
            seconds = time.monotonic() - began
    if str(vehicle.journal.before[name].value) not in printed.decode():
        raise WrongResult(f"{name}: printed {printed.decode().strip()!r}")
    return Cost(seconds)


async def time_apply(vehicle: Vehicle, seed: int) -> Cost:
    """Apply the chosen values once, and restore the vehicle; measure the call of `apply`."""
    vehicle.relay.change(CLEAN)
    if vehicle.wanted is None:
        async with ParamClient(vehicle.relay.link, cache=False) as client:
            vehicle.wanted = await choose_values(vehicle, await client.component(vehicle.system))
        await anyio.sleep(SESSION_PAUSE)
    async with ParamClient(vehicle.relay.link, cache=vehicle.new_cache()) as client:
        component = await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT)
        vehicle.journal.note(vehicle.members)
        began = time.monotonic()
        result = await apply(component, vehicle.wanted)
        seconds = time.monotonic() - began
        await put_back(vehicle, component)
    others = [str(row) for row in result.rows.values() if row.status != "accepted"]
    if not result.complete or others:
        raise WrongResult(f"{len(others)} are not set: {'; '.join(others[:3])}")
    return Cost(seconds)


async def choose_values(vehicle: Vehicle, component: Component) -> ParamSet:
    """Inspect the groups that are off, one after another, and choose the values to apply.

    Raises:
        UsageError: the vehicle has too few groups that are off, or they have too few members.
    """
    await check_disarmed(component)
    journal = vehicle.journal
    groups: dict[str, list[Param]] = {}
    for switch in SWITCHES:
        held = journal.before.get(switch)
        if held is None or held.value != 0 or len(groups) == GROUPS:
            continue
        await journal.set(component, switch, 1)
        shown = (await component.fetch_all(refresh=True, timeout=FETCH_TIMEOUT)).params
        await put_back(vehicle, component)
        await component.fetch_all(refresh=True, timeout=FETCH_TIMEOUT)
        members = [param for name, param in shown.items() if name not in journal.before and is_plain(param)]
        if members:
            groups[switch] = sorted(members, key=lambda param: not isinstance(param.value, float))
    wanted = [WrittenParam(switch, 1) for switch in groups]
    members = [param for group in zip_longest(*groups.values()) for param in group if param is not None]
    if len(groups) < GROUPS or len(groups) + len(members) < VALUES:
        raise UsageError(f"{len(groups)} groups that are off, with {len(members)} members: too few")
    chosen = members[: VALUES - len(groups)]
    vehicle.members = {switch: journal.before[switch] for switch in groups}
    vehicle.members |= {param.name: param for param in chosen}
    wanted += [WrittenParam(param.name, another_value(param)) for param in chosen]
    return ParamSet({each.name: each for each in wanted}, source=f"{', '.join(groups)}")


def is_plain(param: Param) -> bool:
    """Whether a member of a group may be changed by one: a limit, not a choice or an address."""
    return not param.is_raw and not param.name.endswith(NO_LIMITS)


async def put_back(vehicle: Vehicle, component: Component) -> None:
    """Restore the changed values.

    Raises:
        WrongResult: a value could not be restored.
    """
    if problems := await vehicle.journal.put_back(component):
        raise WrongResult(f"NOT AS BEFORE: {'; '.join(problems)}")


async def time_row(row: Row, vehicle: Vehicle, seeds: int) -> Timing:
    """Execute all runs of a row."""
    costs: list[Cost] = []
    problems: list[str] = []
    for seed in range(seeds):
        await anyio.sleep(row.pause)
        try:
            costs.append(await row.measure(vehicle, seed))
            outcome = f"{costs[-1].seconds:.3f} s, {costs[-1].bytes or 'uncounted'} bytes"
        except (WrongResult, ParamClientError, TimeoutError) as error:
            outcome = f"run {seed}: {error or type(error).__name__}"
            problems.append(outcome)
            costs.append(Cost(math.inf))
        print(f"{row.name}, run {seed}: {outcome}", file=sys.stderr)
    seconds = [each.seconds for each in costs]
    return Timing(
        row.name,
        tuple(seconds),
        tuple(problems),
        statistics.median(seconds),
        max(seconds),
        row.median,
        row.worst,
        max((each.bytes for each in costs if each.bytes is not None), default=None),
        row.bytes,
    )


async def time_rows(
    chosen: Sequence[Row], relay: Relay, folder: Path, options: argparse.Namespace
) -> tuple[str, list[Timing]]:
    """Run all rows and check that the vehicle is unchanged; return its name and the timings."""
    async with ParamClient(relay.link, cache=False) as client:
        component = await client.only_component(options.system, timeout=DISCOVERY_TIMEOUT)
        if component.autopilot != options.kind:
            raise UsageError(f"the vehicle is {component.autopilot}, not {options.kind}")
        result = await component.fetch_all(timeout=FETCH_TIMEOUT)
        journal = Journal(folder)
        journal.begin(
            component, {name: param for name, param in result.params.items() if param.index is not None}
        )
        vehicle = Vehicle(relay, component.system, journal, folder)
        name = f"{firmware(component.identity)}, {len(journal.before)} parameters"
    try:
        return name, [await time_row(row, vehicle, options.seeds) for row in chosen]
    finally:
        with anyio.CancelScope(shield=True):
            relay.change(CLEAN)
            if journal.changed:
                async with ParamClient(relay.link, cache=False) as client:
                    await put_back(vehicle, await client.component(vehicle.system, timeout=DISCOVERY_TIMEOUT))


def table(timings: Sequence[Timing]) -> Iterator[str]:
    """Yield the lines of the Markdown table, and of the problems."""
    yield "| real autopilot | median | worst | bytes | limit (median / worst / bytes) |"
    yield "|---|---|---|---|---|"
    for each in timings:
        limits = [f"{each.promised_median:g}", f"{each.promised_worst:g}", f"{each.promised_bytes or ''}"]
        promise = f"{' / '.join(filter(None, limits))}{'' if each.is_met else ' missed'}"
        bytes_ = "" if each.bytes is None else f"{each.bytes:,}"
        yield f"| {each.row} | {each.median:.2f} | {each.worst:.2f} | {bytes_} | {promise} |"
    for each in timings:
        for problem in each.problems:
            yield f"{each.row}, {problem}"


def main() -> int:
    """Print the table; return exit code 1 with `--check` if a promise is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("link", help="the link to the vehicle")
    parser.add_argument("--kind", choices=list(TITLES), required=True)
    parser.add_argument("--system", type=int, help="its system id, where several vehicles are on the link")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="runs of each row")
    parser.add_argument(
        "--row",
        action="append",
        default=[],
        metavar="TEXT",
        help="rows whose name holds this; may be given again",
    )
    parser.add_argument("--check", action="store_true", help="exit with 1 when a promise is missed")
    parser.add_argument("--json", action="store_true", help="print every figure as JSON")
    options = parser.parse_args()
    chosen = [
        row
        for row in rows()
        if row.kind == options.kind and (not options.row or any(text in row.name for text in options.row))
    ]
    if not chosen:
        parser.error(f"no row of {options.kind} holds {' or '.join(options.row)}")
    loads = [os.getloadavg()[0]]
    try:
        with tempfile.TemporaryDirectory() as folder, Relay(options.link) as relay:
            name, timings = anyio.run(time_rows, chosen, relay, Path(folder), options)
    except (UsageError, LinkError, NoReply, VehicleArmed) as error:
        parser.exit(2, f"{error}\n")
    loads.append(os.getloadavg()[0])
    footing = {
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
        "load": [min(loads), max(loads)],
        "vehicle": name,
        "paramclient": __version__,
    }
    if options.json:
        print(json.dumps({**footing, "rows": [asdict(each) for each in timings]}))
    else:
        for line in table(timings):
            print(line)
        print(
            f"\nMedian and worst of {options.seeds}, in seconds; most bytes, of both directions. Datagrams "
            "are lost in both directions, and where they are, the round trip is "
            f"{ROUND_TRIP * 1000:.0f} ms. {footing['date']}, {machine()}, load {min(loads):.1f} to "
            f"{max(loads):.1f}. {name}; paramclient {__version__}."
        )
    return 1 if options.check and not all(each.is_met for each in timings) else 0


if __name__ == "__main__":
    sys.exit(main())
