"""Kill programs that write the cache at random times, and check which values are lost.

    python bench/kills.py [--kills 1000] [--seed 1] [--only station,service,database] [--slack 0.5]

In each round a victim runs for up to a second and sets parameters of a simulated vehicle, in every second
round some of them with `durable`, and receives SIGKILL at a random time, also during its start:

station   a program with a ParamClient, and a SQLite file
service   the code of `paramclient serve`, with a SQLite file; the parameters are set over HTTP
database  the PostgreSQL of a station, with all of its processes; the station continues, and ends normally

Then the cache is opened. It must not be damaged, and table and history must have every set that was
acknowledged as durable, and every other set that was acknowledged more than 0.25 s plus the slack before the
kill: by then a change should be on the disk. The slack covers a batch in progress at that time, the commit,
and two waits for a core on a busy machine. The table has the age of the oldest lost set. With a killed
database, no acknowledged set may be missing, because its station continues.

Exit code 1: a set was lost.
"""

from __future__ import annotations

import argparse
import http.client
import json
import logging
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

sys.path.insert(0, str(Path(__file__).parent.parent))

import anyio

from paramclient import ParamCache, ParamClient, service
from paramclient.client.cache_writer import CACHE_FLUSH_INTERVAL
from paramclient.sim import PX4Vehicle
from tests.postgres import PROGRAMS, Server, database_on, server

LIFETIME_MAX = 1.0
"""Maximum seconds from the first set to the kill."""
EARLY = 0.1
"""Share of the rounds in which the victim is killed before its first set."""
DURABLE = 0.3
"""Share of durable sets in every second round."""
NAMES = [f"PARAM_{number:02}" for number in range(30)]
FRESH_EVERY = 25
"""Rounds after which a new cache is used, because the history has a maximum length."""
TIMEOUT = 60.0
"""Seconds to wait for the start of a process, and for its responses."""


VEHICLE: Final = "/api/vehicles/1/1"
"""Path of the vehicle of the service."""


@dataclass(frozen=True)
class Acknowledged:
    """A set that the vehicle has acknowledged, with its time on the clock that all processes share."""

    name: str
    value: int
    durable: bool
    at: float


@dataclass
class Figures:
    """The results of the rounds with one kind of victim."""

    kills: int = 0
    sets: int = 0
    durable: int = 0
    lost: list[str] = field(default_factory=list)
    oldest: float = 0.0
    """Seconds between the acknowledgement of the oldest lost set and the kill, of sets that may be lost."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=time.time_ns())
    parser.add_argument("--only", default="station,service,database")
    parser.add_argument("--slack", type=float, default=0.5, help="seconds")
    options = parser.parse_args()
    kinds = [kind for kind in options.only.split(",") if kind != "database" or PROGRAMS is not None]
    if len(kinds) < len(options.only.split(",")):
        print("no PostgreSQL is here: no database is killed", file=sys.stderr)
    print(f"{options.kills} kills, seed {options.seed}", flush=True)
    logging.disable()  # the loss of the database is intended
    dice = random.Random(options.seed)
    figures = {kind: Figures() for kind in kinds}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        os.environ["XDG_CACHE_HOME"] = str(folder / "home")
        rounds = Rounds(folder, dice, options.slack, figures)
        if "database" in kinds:
            rounds.server = stack.enter_context(server())
            rounds.url = stack.enter_context(database_on(rounds.server.url))
        for number in range(options.kills):
            kind = kinds[number] if number < len(kinds) else dice.choice(kinds)
            rounds.play(kind, number)
            if not (number + 1) % 50:
                print(f"{number + 1}: {sum(len(each.lost) for each in figures.values())} lost", flush=True)
    print(f"{'victim':10}{'kills':>7}{'sets':>9}{'durable':>9}{'lost':>6}  oldest that may be lost")
    for kind, found in figures.items():
        counted = f"{kind:10}{found.kills:7}{found.sets:9,}{found.durable:9,}{len(found.lost):6}"
        print(f"{counted}  {found.oldest:.3f} s")
    for text in (text for found in figures.values() for text in found.lost):
        print(text)
    return int(any(found.lost for found in figures.values()))


class Rounds:
    """Runs the rounds one after another.

    Attributes:
        server, url: the PostgreSQL, and a database in it.
    """

    server: Server
    url: str

    def __init__(self, folder: Path, dice: random.Random, slack: float, figures: dict[str, Figures]) -> None:
        self._folder = folder
        self._dice = dice
        self._slack = slack
        self._figures = figures
        self._durable = 0.0
        self._values = iter(range(1, 1 << 24))  # a float32 holds these exactly

    def play(self, kind: str, number: int) -> None:
        """Run a victim, kill it, and check the cache."""
        place = (
            self.url if kind == "database" else str(self._folder / f"{kind}-{number // FRESH_EVERY}.sqlite3")
        )
        first = next(self._values)
        for _ in range(2_000):  # values for the victim
            last = next(self._values)
        found = self._figures[kind]
        found.kills += 1
        is_early = self._dice.random() < EARLY
        life = self._dice.uniform(0.0, LIFETIME_MAX)
        self._durable = self._dice.choice((0.0, DURABLE))
        play = (
            self._play_service
            if kind == "service"
            else partial(self._play_station, is_database=kind == "database")
        )
        acknowledged, killed_at = play(place, first, last, is_early=is_early, life=life)
        found.sets += len(acknowledged)
        found.durable += sum(each.durable for each in acknowledged)
        self._check(kind, number, place, acknowledged, killed_at)

    def _play_station(
        self, place: str, first: int, last: int, *, is_early: bool, life: float, is_database: bool
    ) -> tuple[list[Acknowledged], float]:
        reading, writing = os.pipe()
        values = range(first, last)
        child = forked(partial(station, place, writing, values, self._durable, self._dice.random()))
        os.close(writing)
        with os.fdopen(reading, "rb") as reported:
            if is_early and not is_database:
                time.sleep(life / 2)
                said = b""
            else:
                said = reported.readline()  # waits for the first set
                time.sleep(life)
            killed_at = time.monotonic()
            if is_database:
                self.server.kill()
                time.sleep(self._dice.uniform(0.0, 0.3))
                self.server.start()
                time.sleep(self._dice.uniform(0.0, 0.3))
                os.kill(child, signal.SIGTERM)
                killed_at = float("inf")
            else:
                os.kill(child, signal.SIGKILL)
            said += reported.read()
        os.waitpid(child, 0)
        lines = (line.split() for line in said.decode().splitlines(keepends=True) if line.endswith("\n"))
        return [
            Acknowledged(name, int(value), durable == "True", float(at)) for name, value, durable, at in lines
        ], killed_at

    def _play_service(
        self, place: str, first: int, last: int, *, is_early: bool, life: float
    ) -> tuple[list[Acknowledged], float]:
        reading, writing = os.pipe()
        child = forked(partial(serve, place, writing))
        os.close(writing)
        killed: list[float] = []

        def kill(_: object = None, __: object = None) -> None:
            killed.append(time.monotonic())
            os.kill(child, signal.SIGKILL)

        acknowledged: list[Acknowledged] = []
        before = signal.signal(signal.SIGALRM, kill)
        with os.fdopen(reading, "rb") as reported:
            if is_early:
                signal.setitimer(signal.ITIMER_REAL, max(life, 0.01))
            line = reported.readline()
            if line:
                where = urlsplit(line.decode().strip())
                connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=TIMEOUT)
                with suppress(OSError, http.client.HTTPException):
                    wait_for_table(connection)
                    if not is_early:
                        signal.setitimer(signal.ITIMER_REAL, max(life, 0.01))
                    for value in range(first, last):
                        if killed:
                            break
                        name, durable = self._dice.choice(NAMES), self._dice.random() < self._durable
                        body = {"value": value, "durable": durable}
                        ask(connection, "PUT", f"{VEHICLE}/params/{name}", body)
                        acknowledged.append(Acknowledged(name, value, durable, time.monotonic()))
                connection.close()
            reported.read()
        signal.setitimer(signal.ITIMER_REAL, 0)
        if not killed:
            kill()
        os.waitpid(child, 0)
        signal.signal(signal.SIGALRM, before)
        return acknowledged, killed[0]

    def _check(
        self, kind: str, number: int, place: str, acknowledged: list[Acknowledged], killed_at: float
    ) -> None:
        """Check table and history for every set."""
        found = self._figures[kind]
        with ParamCache(place) as cache:
            tables = cache.components()
            values: dict[str, int] = {}
            lines: set[tuple[str, int]] = set()
            for table in tables:
                loaded = cache.load(table.key, table.component)
                assert loaded is not None
                values |= {name: int(param.value) for name, param in loaded.params.items() if name in NAMES}
                changes = cache.history(table.key)
                lines |= {(line.name, int(line.new.value)) for line in changes if line.new is not None}
            found.lost += [f"{kind} {number}: {note}" for note in cache.notes]
        last = {each.name: each.value for each in acknowledged}
        for each in acknowledged:
            is_there = (each.name, each.value) in lines and (
                each.value < last[each.name] or values.get(each.name, 0) >= each.value
            )
            age = killed_at - each.at
            if is_there:
                continue
            if each.durable or age > CACHE_FLUSH_INTERVAL + self._slack:
                found.lost.append(f"{kind} {number}: {each}, {age:.3f} s before the kill")
            else:
                found.oldest = max(found.oldest, age)


def forked(work: Callable[[], object]) -> int:
    """Run `work` in a forked process; return the process id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        os.setsid()
        work()
        code = 0
    finally:
        os._exit(code)


def station(place: str, reported: int, values: Iterable[int], share: float, seed: float) -> None:
    """Set parameters, and write each acknowledged set to the pipe."""
    anyio.run(_station, place, reported, values, share, seed)


async def _station(place: str, reported: int, values: Iterable[int], share: float, seed: float) -> None:
    dice = random.Random(seed)
    with anyio.open_signal_receiver(signal.SIGTERM) as signals:
        async with anyio.create_task_group() as tasks:

            async def work() -> None:
                vehicle = PX4Vehicle(table=dict.fromkeys(NAMES, 0))
                async with ParamClient(vehicle, cache=place) as client:
                    component = await client.only_component()
                    await component.fetch_all()
                    for value in values:
                        name, durable = dice.choice(NAMES), dice.random() < share
                        await component.set(name, value, durable=durable)
                        report(reported, f"{name} {value} {durable} {time.monotonic()}\n")
                        await anyio.sleep(dice.uniform(0.0, 0.01))
                    await anyio.sleep_forever()

            tasks.start_soon(work)
            async for _ in signals:
                tasks.cancel_scope.cancel()
                break


def serve(place: str, reported: int) -> None:
    """Run the code of `paramclient serve`, and write its address to the pipe."""

    async def work() -> None:
        hub = service.Hub([PX4Vehicle(table=dict.fromkeys(NAMES, 0))], cache=place)
        listening = service.Listening(port=0)
        await service.serve(hub, listening=listening, listens=lambda url: report(reported, f"{url}\n"))

    anyio.run(work)


def report(reported: int, text: str) -> None:
    os.write(reported, text.encode())


def wait_for_table(connection: http.client.HTTPConnection) -> None:
    """Wait until the service has fetched the table of the vehicle.

    Raises:
        OSError, HTTPException: the service has ended.
    """
    state = ""
    while state != "synced":
        time.sleep(0.02)
        connection.request("GET", VEHICLE)
        state = json.loads(connection.getresponse().read()).get("state", "")


def ask(connection: http.client.HTTPConnection, method: str, path: str, body: object) -> None:
    """Send one request, which must succeed.

    Raises:
        OSError, HTTPException: the service has ended.
    """
    connection.request(method, path, json.dumps(body), {"content-type": "application/json"})
    answer = connection.getresponse()
    text = answer.read()
    assert answer.status == 200, text


if __name__ == "__main__":
    sys.exit(main())
