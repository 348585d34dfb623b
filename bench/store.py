"""Speed of the cache with many vehicles: in a SQLite file and in PostgreSQL.

    python bench/store.py [--vehicles 1000] [--params 1000] [--only sqlite] [--postgres URL] [--check]

Fills a new cache with a table for each vehicle, then measures the time to write a full table, to load one, to
write one change, to compare all vehicles with a file of 200 parameters, and the bytes of a line of history on
the disk. PostgreSQL is a new server, started from pgserver's or Debian's programs, or the one at the URL; its
figures include the local copy. With --check, fails if the comparison of the fleet takes a second or more.
"""

from __future__ import annotations

import argparse
import sqlite3
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from paramclient.cache import ParamCache, StoredParam, TableState, TableUpdate
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, ParamType, bits_of
from tests.postgres import PROGRAMS, database_on, server

NOW = 1_795_000_000.0
WANTED = 200
"""Number of parameters in the file with which all vehicles are compared."""
STRAY_EVERY = 50
"""Every 50th compared value differs from the file."""
TARGET = 1.0
"""The target for the comparison, in seconds."""
CHANGES = 2_000
Size = Callable[[tuple[str, ...]], int]
"""Returns the bytes that these database tables use."""
ROUNDS = 5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--params", type=int, default=1000)
    parser.add_argument("--only", choices=["sqlite", "postgres"])
    parser.add_argument("--postgres", metavar="URL", help="a database, beside which one of ours may be made")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    print(f"{options.vehicles} vehicles of {options.params} parameters")
    slow = []
    for name, cache, size in caches(options.only, options.postgres):
        figures = measure(cache, size, options.vehicles, options.params)
        for what, value, unit in figures:
            print(f"{name:9} {what:34} {value:10.3f} {unit}", flush=True)
            if what.startswith("fleet diff of") and value >= TARGET:
                slow.append(f"{name}: {what} took {value:.2f} s")
    for each in slow:
        print(each, file=sys.stderr)
    return int(bool(slow) and options.check)


def caches(only: str | None, url: str | None) -> Iterator[tuple[str, ParamCache, Size]]:
    """Yield the caches, each with its name and a function that returns its size in bytes."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        if only != "postgres":
            path = Path(folder) / "cache.sqlite3"
            with ParamCache(path) as cache:
                yield "SQLite", cache, lambda _: pages(path)
        if only == "sqlite" or (url is None and PROGRAMS is None):
            return
        import psycopg

        place = stack.enter_context(database_on(url or stack.enter_context(server()).url))

        def size(tables: tuple[str, ...]) -> int:
            with psycopg.connect(place, options="-c search_path=paramclient") as connection:
                found = connection.execute(
                    "SELECT sum(pg_total_relation_size(name::regclass)) FROM unnest(%s::text[]) AS name",
                    (list(tables),),
                )
                return int(found.fetchall()[0][0])

        with ParamCache(place, local=Path(folder) / "copy.sqlite3") as cache:
            yield "PostgreSQL", cache, size


def pages(path: Path) -> int:
    """Return the used bytes of a SQLite file."""
    with closing(sqlite3.connect(path)) as connection:
        figures = [
            connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        ]
    return int((figures[0] - figures[1]) * figures[2])


def measure(cache: ParamCache, size: Size, vehicles: int, params: int) -> Iterator[tuple[str, float, str]]:
    """Fill the cache, and yield name, value and unit of each figure."""
    cache.vehicles()
    everything = ("vehicle", "component", "param", "history", "birth")
    empty = size(everything)
    writes = [timed(cache.save, table(n, params)) for n in range(vehicles)]
    yield "write a full table, median", statistics.median(writes) * 1e3, "ms"
    yield "write a full table, 99 of 100", sorted(writes)[int(len(writes) * 0.99)] * 1e3, "ms"
    yield "size of a table", (size(everything) - empty) / vehicles / 1e3, "kB"
    loads = [timed(cache.load, who(n).key, 1) for n in range(0, vehicles, -(-vehicles // 50))]
    yield "load a table, median", statistics.median(loads) * 1e3, "ms"
    ones = [timed(cache.save, change(n % vehicles, n)) for n in range(1, 101)]
    yield "write one change, median", statistics.median(ones) * 1e3, "ms"
    wanted = ParamSet.of(param(number, number) for number in range(min(WANTED, params)))
    diffs = [timed(cache.fleet_diff, wanted) for _ in range(ROUNDS)]
    yield f"fleet diff of {len(wanted)} parameters, best", min(diffs), "s"
    every = ParamSet.of(param(number, number + 1) for number in range(min(WANTED, params)))
    yield f"the same where all {len(wanted)} differ", timed(cache.fleet_diff, every), "s"
    before = size(("history",))
    many = [param_at(0, 10_000 + n, NOW + 1000 + n) for n in range(CHANGES)]
    spent = sum(timed(cache.save, each) for each in chunks(many, params))
    yield f"write {CHANGES} changes, each", spent / CHANGES * 1e3, "ms"
    yield "growth for a line of history", (size(("history",)) - before) / CHANGES, "bytes"
    yield "read the history of a vehicle", timed(cache.history, who(0).key) * 1e3, "ms"


def timed(work: Callable[..., object], *arguments: object) -> float:
    began = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - began


def who(vehicle: int) -> Identity:
    return Identity(
        1 + vehicle % 250, "udpin:0.0.0.0:14550", f"{vehicle:036x}", 12, 2, 17_891_392, "a70a5583"
    )


def param(number: int, value: float) -> Param:
    kind = ParamType.REAL32 if number % 2 else ParamType.INT32
    given = float(value) if number % 2 else int(value)
    return Param(f"PARAM_{number:04}", given, kind, number, bits_of(given, kind))


def table(vehicle: int, params: int) -> TableUpdate:
    """Return a whole table; some of its values differ from those of most vehicles, see `STRAY_EVERY`."""
    items = [
        StoredParam(param(n, n + 1 if not (n * 7 + vehicle) % STRAY_EVERY else n), NOW, volatile=False)
        for n in range(params)
    ]
    state = TableState(0xCF579589, params, complete=True, volatile_known=True, synced_at=NOW)
    return TableUpdate(
        identity=who(vehicle), component=1, autopilot=12, at=NOW, table=state, params=items, replace=True
    )


def change(vehicle: int, value: int) -> TableUpdate:
    return replace(param_at(1, value, NOW + value), identity=who(vehicle))


def param_at(number: int, value: int, at: float) -> TableUpdate:
    item = StoredParam(replace(param(number, value), index=None), at)
    return TableUpdate(identity=who(0), component=1, autopilot=12, at=at, params=[item])


def chunks(updates: list[TableUpdate], params: int) -> Iterator[list[TableUpdate]]:
    """Yield updates in batches, like a client: a hundred in one call, each of another parameter."""
    for start in range(0, len(updates), 100):
        some = updates[start : start + 100]
        items = [
            StoredParam(replace(param(n % params, 10_000 + start + n), index=None), some[0].at)
            for n in range(len(some))
        ]
        yield [replace(some[0], params=items)]


if __name__ == "__main__":
    sys.exit(main())
