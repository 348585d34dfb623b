"""Kill programs that write the cache at random times, and check which values are lost.

    python bench/kills.py [--kills 1000] [--seed 1] [--only file,database] [--slack 0.5]

In each round a victim runs for up to a second and sets parameters of a simulated vehicle, in every second
round some of them with `durable`, and is killed at a random time, also during its start:

file      a program with a ParamClient, and a cache in a file
database  the PostgreSQL of a station, with all of its processes; the station continues, and ends normally

Then the cache is opened. It must not be damaged, and table and history must have every set that was
acknowledged as durable, all sets before it, and every other set that was acknowledged more than 0.25 s plus
the slack before the kill: by then a change should be on the disk. The slack covers a batch in progress at
that time, the commit, and two waits for a core on a busy machine. With a killed database, no acknowledged
set may be missing, because its station continues.

Exit code 1: a set was lost.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent.parent))

import anyio

from paramclient import NotDurable, ParamCache, ParamClient
from paramclient.client.cache_writer import FLUSH_INTERVAL
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


class Acknowledged(NamedTuple):
    """A set that the vehicle has acknowledged, with its time on the clock that all processes share."""

    name: str
    value: int
    durable: bool
    at: float


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=time.time_ns())
    parser.add_argument("--only", default="file,database")
    parser.add_argument("--slack", type=float, default=0.5, help="seconds")
    options = parser.parse_args()
    kinds = [kind for kind in options.only.split(",") if kind != "database" or PROGRAMS is not None]
    print(f"{options.kills} kills of {', '.join(kinds)}, seed {options.seed}", flush=True)
    logging.disable()  # the loss of the database is intended
    dice = random.Random(options.seed)
    values = iter(range(1, 1 << 24))  # a float32 holds these exactly
    lost = sets = 0
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        running = stack.enter_context(server()) if "database" in kinds else None
        url = "" if running is None else stack.enter_context(database_on(running.url))
        for number in range(options.kills):
            kind = kinds[number % len(kinds)]
            place = str(folder / f"{number // FRESH_EVERY}.sqlite3") if kind == "file" else url
            mine = [next(values) for _ in range(2_000)]
            killed = running if kind == "database" else None
            acknowledged, killed_at = play(place, mine, dice, killed)
            sets += len(acknowledged)
            found = missing(place, acknowledged, killed_at, options.slack)
            for each in found:
                print(f"{kind} {number}, killed at {killed_at:.2f}: {each}", flush=True)
            lost += len(found)
            if not (number + 1) % 50:
                print(f"{number + 1}: {lost} lost", flush=True)
    print(f"{options.kills} kills, {sets:,} sets, {lost} lost")
    return int(lost > 0)


def play(
    place: str, values: Iterable[int], dice: random.Random, database: Server | None
) -> tuple[list[Acknowledged], float]:
    """Run a station, and kill it or its database. Return what was acknowledged, and the time of the kill."""
    reading, writing = os.pipe()
    share, seed = dice.choice((0.0, DURABLE)), dice.random()
    is_early, life = dice.random() < EARLY, dice.uniform(0.0, LIFETIME_MAX)
    child = os.fork()
    if not child:
        with suppress(BaseException):
            anyio.run(station, place, writing, values, share, seed)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as reported:
        said = b"" if is_early and database is None else reported.readline()  # waits for the first set
        time.sleep(life)
        killed_at = time.monotonic()
        if database is None:
            os.kill(child, signal.SIGKILL)
        else:
            database.kill()
            time.sleep(dice.uniform(0.0, 0.3))
            database.start()
            time.sleep(dice.uniform(0.0, 0.3))
            os.kill(child, signal.SIGTERM)
            killed_at = float("inf")
        said += reported.read()
    os.waitpid(child, 0)
    lines = [line.split() for line in said.decode().splitlines(keepends=True) if line.endswith("\n")]
    return [
        Acknowledged(name, int(value), durable == "1", float(at)) for name, value, durable, at in lines
    ], killed_at


async def station(place: str, reported: int, values: Iterable[int], share: float, seed: float) -> None:
    """Set parameters until SIGTERM, and write each acknowledged set to the pipe."""
    dice = random.Random(seed)

    async def work() -> None:
        vehicle = PX4Vehicle(table=dict.fromkeys(NAMES, 0))
        async with ParamClient(vehicle, cache=place) as client:
            component = await client.only_component()
            await component.fetch_all()
            for value in values:
                name, durable = dice.choice(NAMES), dice.random() < share
                with suppress(NotDurable):  # the database is away: the vehicle has the value all the same
                    await component.set(name, value, durable=durable)
                    os.write(reported, f"{name} {value} {durable:d} {time.monotonic()}\n".encode())
                await anyio.sleep(dice.uniform(0.0, 0.01))
            await anyio.sleep_forever()

    with anyio.open_signal_receiver(signal.SIGTERM) as signals:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(work)
            async for _ in signals:
                tasks.cancel_scope.cancel()
                break


def missing(
    place: str, acknowledged: list[Acknowledged], killed_at: float, slack: float
) -> list[str | Acknowledged]:
    """Return the sets that the cache lacks and should have, and what is wrong with its file."""
    values: dict[str, int] = {}
    lines: set[tuple[str, int]] = set()
    with ParamCache(place) as cache:
        for table in cache.components():
            loaded = cache.load(table.key, table.component)
            assert loaded is not None
            values |= {name: int(param.value) for name, param in loaded.params.items() if name in NAMES}
            changes = cache.history(table.key)
            lines |= {(line.name, int(line.new.value)) for line in changes if line.new is not None}
        found: list[str | Acknowledged] = list(cache.notes)
    last = {each.name: each.value for each in acknowledged}
    flushed_at = max((each.at for each in acknowledged if each.durable), default=0.0)
    for each in acknowledged:
        is_there = (each.name, each.value) in lines and (
            each.value < last[each.name] or values.get(each.name, 0) >= each.value
        )
        if not is_there and (each.at <= flushed_at or killed_at - each.at > FLUSH_INTERVAL + slack):
            found.append(each)
    return found


if __name__ == "__main__":
    sys.exit(main())
