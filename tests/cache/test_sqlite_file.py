"""The cache's file: killed writers, several programs, damage, full disks, read-only places."""

from __future__ import annotations

import errno
import fcntl
import gc
import logging
import os
import random
import re
import shutil
import signal
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import cache as cached
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient.cache import HISTORY_ENTRIES_MAX, ParamCache, StoredParam, lock, sqlite_file
from paramclient.cache.cells import Damaged
from paramclient.cache.packed_table import unpack
from paramclient.cache.param_columns import checksum
from paramclient.cache.sqlite_file import APPLICATION_ID, Database
from paramclient.cache.sqlite_schema import MIGRATIONS
from paramclient.errors import CacheError, UnknownVehicle
from paramclient.model.identity import Identity
from paramclient.model.values import ParamType
from tests.caches import (
    CACHE_ALONE,
    NOW,
    PX4,
    full_disk,
    read_only,
    rubbish,
    set_aside,
    start,
    stored,
    update,
    values,
    whole_table,
    without_root_powers,
)

PAGE = 4096
PAGES = 16
"""The sound file has a few more."""
COMPANIONS = ("-wal", "-shm")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.sqlite3"


@pytest.fixture(autouse=True)
def _private() -> Iterator[None]:
    """Files that the tests write are like those of the cache, their owner's alone."""
    before = os.umask(0o077)
    yield
    os.umask(before)


def connect(path: Path) -> closing[sqlite3.Connection]:
    """The file as any other program sees it."""
    return closing(sqlite3.connect(path, isolation_level=None))


def integrity(path: Path) -> str:
    with connect(path) as connection:
        return str(connection.execute("PRAGMA integrity_check").fetchone()[0])


def works(cache: ParamCache) -> None:
    """Reading and writing do what they should, whatever was there before."""
    for vehicle in cache.vehicles():
        str(vehicle)
    for summary in cache.components():
        repr(summary)
        table = cache.load(summary.key, summary.component)
        if table is not None:  # else this was what brought the damage to light
            assert len(table.params) == summary.size
            table.history()
    cache.save(whole_table(300, first=5))
    assert values(cache) == {f"PARAM_{number}": number + 5 for number in range(300)}
    cache.save(update(stored("PARAM_7", 1)))
    assert cache.history(PX4.key, name="PARAM_7", limit=1)[0].old.value == 12


SOUND_TABLES = {
    (PX4, 1): {f"PARAM_{number}": number + 1 for number in range(300)},
    (PX4, 154): {f"PARAM_{number}": number for number in range(100)},
    (replace(PX4, uid="0003"), 1): {f"PARAM_{number}": number for number in range(200)},
}


@cached
def sound_file() -> bytes:
    """A closed cache with `SOUND_TABLES` and some history."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache"
        with ParamCache(path) as cache:
            cache.save([whole_table(300), whole_table(100, component=154)])
            cache.save(whole_table(200, replace(PX4, uid="0003")))
            cache.save(whole_table(300, first=1))
        return path.read_bytes()


def make_older(path: Path, version: int) -> None:
    """Make of the present file what an earlier version would have made."""
    with connect(path) as connection:
        for table in ("ext_param", "ext_history", "ext_table"):
            connection.execute(f"DROP TABLE {table}")
        connection.execute("ALTER TABLE snapshot DROP COLUMN is_extended")
        connection.execute("ALTER TABLE component DROP COLUMN source")
        connection.execute(f"PRAGMA user_version = {version}")
        if version == 4:
            return
        for statement in (MIGRATIONS[0][2], MIGRATIONS[1][0]):
            assert isinstance(statement, str)
            connection.execute(statement)
        for owner, blob in connection.execute("SELECT owner, params FROM packed").fetchall():
            rows = unpack(blob)
            connection.executemany(
                "INSERT INTO param (owner, name, type, bits, is_raw, param_index, volatile, heard_at,"
                " default_bits) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [(owner, *row[:8]) for row in rows.values()],
            )
            connection.execute("UPDATE component SET checksum = ? WHERE id = ?", (checksum(rows), owner))
        connection.execute("DROP TABLE packed")
        if version < 3:
            connection.executescript(
                "DROP TABLE snapshot; DROP TABLE setback; DROP TABLE birth; DROP INDEX history_of_param;"
                "ALTER TABLE component DROP COLUMN known_since"
            )
        if version < 2:
            connection.execute("ALTER TABLE param DROP COLUMN default_bits")
            connection.execute("ALTER TABLE component DROP COLUMN file_works")


# Killed at any moment


WRITERS = f"""{CACHE_ALONE}
import os
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType

def write(path, number):
    cache = ParamCache(path)
    while True:
        number += 1
        params = [StoredParam(Param(f"P{{i}}", number, ParamType.UINT32, i, number), 1e9) for i in range(100)]
        cache.save([
            TableUpdate(identity=Identity(1, "x"), component=component, autopilot=12, at=1e9, params=params)
            for component in (1, 154)
        ])
        os.write(1, b"%d\\n" % number)

while line := sys.stdin.readline():
    path, number = line.split()
    child = os.fork()
    if not child:
        write(path, int(number))
    os.write(1, b"%d\\n" % child)
    os.waitpid(child, 0)
    os.write(1, b"dead\\n")
"""


def whole_batches(path: Path) -> int:
    """How many batches a sound cache holds: no part of one, and history has them all."""
    with ParamCache(path) as cache:
        tables = [values(cache, Identity(1, "x"), component) for component in (1, 154)]
        assert tables[0] == tables[1]
        assert len(tables[0]) in (0, 100)
        number = int(tables[0].get("P7", 0))
        assert set(tables[0].values()) <= {number}
        if number:
            lines = [entry.new and entry.new.value for entry in cache.history("system:1@x", 1, "P7")]
            assert lines == list(range(max(2, number - HISTORY_ENTRIES_MAX // 100 + 1), number + 1))
    assert not cache.notes
    assert not path.exists() or integrity(path) == "ok"
    return number


def test_committed_batches_survive_a_kill_at_any_moment(tmp_path: Path) -> None:
    """A process that has imported everything forks a writer, which is killed; seventy times.

    Some die while they make the file, some while they write, some while they carry the log over into the
    file. A batch is a hundred parameters of two components: all of it is there, or nothing of it.
    """
    chance = random.Random(20261120)
    with start(WRITERS) as writers:
        assert writers.stdin is not None
        assert writers.stdout is not None
        numbers: dict[Path, int] = {}
        for round_ in range(70):
            path = (
                tmp_path / f"cache{round_ // 10}"
            )  # each file is made once and then goes through ten deaths
            before = numbers.get(path, 0)
            writers.stdin.write(f"{path} {before}\n")
            writers.stdin.flush()
            child = int(writers.stdout.readline())
            said = [writers.stdout.readline() for _ in range(chance.choice([0, 0, 1, 5]))]
            time.sleep(chance.uniform(0, 0.03))
            os.kill(child, signal.SIGKILL)
            said += iter(writers.stdout.readline, "dead\n")
            acknowledged = int(said[-1]) if said else before

            number = whole_batches(path)
            assert number in (acknowledged, acknowledged + 1)
            numbers[path] = number
        writers.stdin.close()
    assert not [each for path in numbers for each in set_aside(path)]


# Several programs


COUNTERS = f"""{CACHE_ALONE}
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType

path, component = sys.argv[1], int(sys.argv[2])
print("ready", flush=True)
sys.stdin.readline()
cache = ParamCache(path)
for number in range(1, 41):
    params = [StoredParam(Param("P", number, ParamType.UINT32, None, number), 1e9)]
    cache.save([
        TableUpdate(identity=Identity(1, "x"), component=of, autopilot=12, at=1e9, params=params)
        for of in (component, 200)
    ])
    found = cache.load("system:1@x", component)
    assert found.params["P"].value == number, (found, number)
print("done", *cache.notes)
"""


@pytest.mark.parametrize("begin", [None, b"", rubbish(14_000)], ids=["no file", "empty file", "damaged file"])
def test_several_programs_write_at_once(path: Path, begin: bytes | None) -> None:
    """They also race for making the file, and for setting a damaged one aside, which happens once."""
    if begin is not None:
        path.write_bytes(begin)
    with ExitStack() as running:
        programs = [running.enter_context(start(COUNTERS, path, component)) for component in range(1, 5)]
        for program in programs:
            assert program.stdout is not None
            assert program.stdout.readline() == "ready\n"
        for program in programs:
            assert program.stdin is not None
            program.stdin.write("go\n")
            program.stdin.flush()
        said = [program.communicate()[0] for program in programs]
    assert all(text.startswith("done") for text in said), said
    with ParamCache(path) as cache:
        for component in range(1, 5):
            assert values(cache, Identity(1, "x"), component) == {"P": 40}
            new_values = [entry.new and entry.new.value for entry in cache.history("system:1@x", component)]
            assert new_values == list(range(2, 41))
        shared = [
            (entry.old.value, entry.new and entry.new.value) for entry in cache.history("system:1@x", 200)
        ]
    assert all(old == before for (_, before), (old, _) in pairwise(shared)), (
        "each line begins where the last ends"
    )
    assert integrity(path) == "ok"
    assert [each.read_bytes() for each in set_aside(path)] == ([begin] if begin else [])
    assert sum("damaged" in text for text in said) == len(set_aside(path))


def test_a_writer_locks_the_file_before_it_reads(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.write_bytes(sound_file())
    monkeypatch.setattr(sqlite_file, "LOCK_WAIT_MAX", 0.05)
    ours, theirs = Database(path), Database(path)

    def work(_: sqlite3.Connection) -> None:
        with pytest.raises(CacheError, match="locked"):
            theirs.write(lambda _: None)

    ours.write(work)
    theirs.write(lambda _: None)
    ours.close()
    theirs.close()


def test_a_program_that_holds_the_file_for_too_long_is_an_error_and_no_hindrance_to_reading(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_file, "LOCK_WAIT_MAX", 0.05)
    with ParamCache(path) as cache, connect(path) as other:
        cache.save(whole_table(3))
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(CacheError, match=rf"{path}.*locked") as caught:
            cache.save(update())
        assert isinstance(caught.value.__cause__, sqlite3.OperationalError)
        assert len(values(cache)) == 3
        other.execute("COMMIT")
        works(cache)


def test_the_wait_for_a_lock_can_be_limited_while_it_lasts(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_file, "LOCK_WAIT_MAX", 120.0)
    with ParamCache(path) as cache, connect(path) as other:
        cache.save(whole_table(3))
        other.execute("BEGIN IMMEDIATE")
        with ThreadPoolExecutor(1) as threads:
            saved = threads.submit(cache.save, update())
            wait([saved], timeout=2 * sqlite_file.LOCK_WAIT_PART)
            assert not saved.done()
            cache.limit_lock_waits(0.0)
            with pytest.raises(CacheError, match="locked"):
                saved.result(30)
        with pytest.raises(CacheError, match="locked"):
            cache.save(update())
        other.execute("COMMIT")
        works(cache)


def test_a_new_file_is_created_with_few_statements(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a busy event loop each statement may take 5 ms, and values wait for all of them."""
    statements: list[str] = []

    class Counting(sqlite3.Connection):
        def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
            statements.append(sql)
            return super().execute(sql, *values)

    monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Counting))
    with ParamCache(path) as cache:
        cache.components()  # as a client does when it opens
        statements.clear()
        cache.save(whole_table(3))
        created = len(statements)
        statements.clear()
        cache.save(whole_table(3))
    assert created - len(statements) < 15


def test_many_changes_take_as_many_statements_as_one(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows of `executemany` are statements too: each releases the interpreter lock."""
    counted = 0

    class Counting(sqlite3.Connection):
        def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
            nonlocal counted
            counted += 1
            return super().execute(sql, *values)

        def executemany(self, sql: str, rows: Any) -> sqlite3.Cursor:
            nonlocal counted
            rows = list(rows)
            counted += len(rows)
            return super().executemany(sql, rows)

    monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Counting))
    needed: dict[int, int] = {}
    with ParamCache(path) as cache:
        cache.save(whole_table(100))
        for size in (1, 60):
            counted = 0
            cache.save(
                update(*(stored(f"PARAM_{number}", 1000 + size, index=number) for number in range(size)))
            )
            needed[size] = counted
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert len(table.history()) == 61
    assert needed[60] <= needed[1] + 1


def test_a_new_file_that_another_program_locks_is_an_error(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite's backup would wait for ever."""
    template = Database._template
    monkeypatch.setattr(sqlite_file, "LOCK_WAIT_MAX", 0.05)
    with ParamCache(path) as cache:
        with ExitStack() as locks:

            def locked_first(database: Database) -> sqlite3.Connection:
                locks.enter_context(connect(path)).execute("BEGIN IMMEDIATE")
                return template(database)

            monkeypatch.setattr(Database, "_template", locked_first)
            with pytest.raises(CacheError, match=rf"{path}.*locked"):
                cache.save(whole_table(3))
            monkeypatch.setattr(Database, "_template", template)
        works(cache)
        assert not cache.notes


def test_a_write_begins_as_soon_as_the_lock_is_released(path: Path) -> None:
    with ParamCache(path) as cache, connect(path) as other:
        cache.save(whole_table(3))
        other.execute("BEGIN IMMEDIATE")
        with ThreadPoolExecutor(1) as threads:
            saved = threads.submit(cache.save, update())
            wait([saved], timeout=2 * sqlite_file.LOCK_WAIT_PART)
            assert not saved.done()
            other.execute("COMMIT")
            saved.result(30)


def test_a_folder_that_another_program_holds_is_waited_for_but_not_for_ever(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "LOCK_WAIT_MAX", 0.05)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        with ParamCache(path) as cache:
            with pytest.raises(CacheError, match="another process has locked the folder"):
                cache.save(whole_table(3))
            fcntl.flock(folder, fcntl.LOCK_UN)
            works(cache)
    finally:
        os.close(folder)


# The file is removed


def move(path: Path, to: str) -> None:
    """What another program does when it sets the file aside."""
    for suffix in (*COMPANIONS, ""):
        path.with_name(path.name + suffix).rename(path.with_name(to + suffix))


def test_a_file_that_another_program_set_aside_is_let_go(path: Path) -> None:
    with ParamCache(path) as ours, ParamCache(path) as theirs:
        ours.save(whole_table(3))
        move(path, "aside")
        assert ours.vehicles() == []
        theirs.save(whole_table(2))
        theirs.save(update(stored("A", 1)))
        assert values(ours) == {"PARAM_0": 0, "PARAM_1": 1, "A": 1}
        ours.save(update(stored("B", 1)))
        assert len(values(theirs)) == 4
    assert integrity(path) == "ok"
    with ParamCache(path.with_name("aside")) as kept:
        assert len(values(kept)) == 3


def test_a_write_into_a_file_that_was_moved_meanwhile_is_repeated(path: Path) -> None:
    store = Database(path)
    went: list[bool] = []

    def work(connection: sqlite3.Connection) -> int:
        connection.execute(
            "INSERT INTO vehicle VALUES ('k', 1, 'x', NULL, 0, 0, 0, '', 0, 0, 0, 0, 0.0, 0.0)"
        )
        if not went:
            move(path, "aside")
        went.append(True)
        return len(went)

    assert store.write(work) == 2
    assert store.read(lambda connection: connection.execute("SELECT key FROM vehicle").fetchall()) == [("k",)]
    store.close()


def test_a_deleted_file_and_folder_are_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "cache"
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        shutil.rmtree(path.parent)
        assert cache.vehicles() == []
        works(cache)
    assert integrity(path) == "ok"


def test_a_file_that_vanishes_while_it_is_opened_is_no_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path.write_bytes(sound_file())
    locked = lock.locked

    def late(folder: Path) -> Any:
        path.unlink(missing_ok=True)
        return locked(folder)

    monkeypatch.setattr("paramclient.cache.sqlite_file.locked", late)
    with ParamCache(path) as cache:
        assert cache.vehicles() == []


def test_a_log_without_its_file_is_set_aside_before_sqlite_would_delete_it(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    for main in (None, b""):
        with ParamCache(path) as cache:
            cache.save(whole_table(3))
            log = path.with_name("cache-wal").read_bytes()
            shutil.copy(path.with_name("cache-wal"), tmp_path / "copy")
        path.unlink()
        (tmp_path / "copy").rename(path.with_name("cache-wal"))
        if main is not None:
            path.write_bytes(main)
        with ParamCache(path) as cache:
            assert cache.vehicles() == []
            assert not cache.notes
            works(cache)
            assert "write-ahead log" in cache.notes[0]
        kept = [each for each in tmp_path.iterdir() if each.name.endswith("-wal")]
        assert [each.read_bytes() for each in kept] == [log]
        kept[0].unlink()
        path.unlink()


# Damage


def other_program(path: Path, application_id: int = 0, version: int = 0) -> None:
    with connect(path) as connection:
        connection.execute("CREATE TABLE precious (a)")
        connection.execute(f"PRAGMA application_id = {application_id}")
        connection.execute(f"PRAGMA user_version = {version}")


def sound_but(change: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        path.write_bytes(sound_file())
        with connect(path) as connection:
            connection.executescript(change)

    return make


def older_but(change: str, version: int = 3) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        path.write_bytes(sound_file())
        make_older(path, version)
        with connect(path) as connection:
            connection.executescript(change)

    return make


def sound_with(at: int, byte: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        content = bytearray(sound_file())
        content[at] = byte
        path.write_bytes(content)

    return make


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda path: path.write_bytes(rubbish(3 * PAGE)), "not a database"),
        (lambda path: path.write_bytes(sound_file()[:200]), "malformed|not a database"),
        (sound_with(47, 255), "unsupported file format"),
        (sound_with(sound_file().index(b"first_seen"), 0xCF), "UTF-8 column 'sql'"),
        (sound_with(sound_file().index(b"history_of"), 0xE8), "codec can't decode byte 0xe8"),
        (lambda path: other_program(path, APPLICATION_ID), "tables are not those of version 0"),
        (lambda path: other_program(path, APPLICATION_ID, 1), "tables are not those of version 1"),
        (sound_but("PRAGMA user_version = -1"), "tables are not those of version -1"),
        (sound_but("DROP TABLE history"), f"tables are not those of version {len(MIGRATIONS)}"),
        (sound_but("ALTER TABLE packed RENAME COLUMN params TO rows"), "tables are not those"),
        (sound_but("UPDATE component SET count = 'much'"), "a cell holds 'much'"),
        (sound_but("UPDATE history SET name = CAST(x'ff' || owner AS TEXT)"), "UTF-8"),
        (sound_but("UPDATE packed SET params = 'much'"), "a table is 'much'"),
        (sound_but("UPDATE packed SET params = CAST(substr(params, 9) AS BLOB)"), "not what was written"),
        (sound_but("UPDATE packed SET params = x''"), "not what was written"),
        (sound_but("UPDATE packed SET params = (SELECT params FROM packed WHERE owner = 2)"), "not what was"),
        (sound_but("UPDATE packed SET size = 1"), "not what was written"),
        (sound_but("UPDATE packed SET heard_last = 1e9"), "not what was written"),
        (sound_but("DELETE FROM packed"), "not what was written"),
        (sound_but("UPDATE component SET checksum = 223132457"), "not what was written"),
        (older_but("ALTER TABLE param RENAME COLUMN bits TO bats"), "tables are not those of version 3"),
        (older_but("UPDATE param SET bits = 'much'"), "a cell holds 'much'"),
        (older_but("UPDATE param SET name = CAST(x'ff' || owner AS TEXT) WHERE param_index = 9"), "UTF-8"),
        (older_but("UPDATE param SET bits = bits + 1"), "not what was written"),
        (older_but("UPDATE param SET bits = bits + 1 WHERE owner = 3", 2), "not what was written"),
        (older_but("UPDATE param SET bits = bits + 1 WHERE owner = 3", 1), "not what was written"),
        (older_but("DELETE FROM param WHERE param_index = 9"), "not what was written"),
        (older_but("UPDATE param SET heard_at = 9e999"), "a cell holds inf"),
        (sound_but("UPDATE history SET old_bits = 1 << 40"), "is not a value of type 6"),
        (sound_but("UPDATE history SET new_type = -1"), "-1 is not a type"),
        (sound_but("PRAGMA writable_schema = on;"
                   "UPDATE sqlite_master SET rootpage = 3 WHERE name = 'packed'"), "reference to page 3"),
        (sound_but("UPDATE component SET synced_at = 1e15"), "a cell holds 1"),
        (sound_but("UPDATE vehicle SET first_seen = -1"), "a cell holds -1"),
    ],
)  # fmt: skip
def test_a_damaged_cache_is_renamed_unchanged_and_a_new_one_is_created(
    path: Path, caplog: pytest.LogCaptureFixture, make: Callable[[Path], None], why: str
) -> None:
    make(path)
    content = path.read_bytes()
    with ParamCache(path) as cache:
        works(cache)
        assert len(cache.notes) == 1
        assert cache.notes[0].startswith(f"the cache {path} is damaged (")
        (kept,) = set_aside(path)
        assert cache.notes[0].endswith(f"it is kept as {kept.name}")
    assert [(record.name, record.levelno, record.message) for record in caplog.records] == [
        ("paramclient.cache", logging.WARNING, cache.notes[0])
    ]
    assert re.search(why, cache.notes[0])
    assert kept.read_bytes() == content
    assert kept.name.startswith(f"{path.name}.damaged-20")
    assert integrity(path) == "ok"


@pytest.mark.parametrize(("application_id", "version"), [(0, 0), (0x47504B47, 1)])
@pytest.mark.parametrize("counting", ["", "CREATE TABLE counted (a INTEGER PRIMARY KEY AUTOINCREMENT)"])
def test_another_programs_database_is_left_where_it_is(
    path: Path, application_id: int, version: int, counting: str
) -> None:
    other_program(path, application_id, version)
    with connect(path) as connection:  # SQLite counts in a table of its own, which is in our files too
        connection.execute(counting)
    content = path.read_bytes()
    with ParamCache(path) as cache, pytest.raises(CacheError, match="a database of another program"):
        cache.vehicles()
    with ParamCache(path) as cache, pytest.raises(CacheError, match="a database of another program"):
        cache.save(whole_table(2))
    assert path.read_bytes() == content
    assert set_aside(path) == []


@pytest.mark.parametrize(
    "make",
    [
        lambda path: path.write_bytes(b"A"),
        lambda path: path.write_bytes(random.Random(1).randbytes(3 * PAGE)),
        lambda path: path.write_text("[settings]\n" * 1000),
        lambda path: path.write_bytes(bytes(2 * PAGE)),
        lambda path: path.write_bytes(sound_file()[:50]),
        sound_with(0, 0),
        sound_with(71, 0),
        sound_but("PRAGMA application_id = 1196444487"),
        sound_but("PRAGMA application_id = 0; PRAGMA user_version = 99"),
        sound_but("PRAGMA application_id = 0; DROP TABLE history"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_cache_is_an_error_and_is_not_changed(
    path: Path, caplog: pytest.LogCaptureFixture, make: Callable[[Path], None]
) -> None:
    make(path)
    path.chmod(0o664)
    content = path.read_bytes()
    with ParamCache(path) as cache:
        for use in (cache.vehicles, lambda: cache.save(whole_table(2))):
            with pytest.raises(CacheError, match="was not changed; name another file"):
                use()
        assert cache.notes == ()
    assert (os.listdir(path.parent), path.read_bytes()) == ([path.name], content)  # noqa: PTH208
    assert path.stat().st_mode & 0o777 == 0o664
    assert not caplog.records


def contents(folder: Path) -> dict[str, bytes]:
    return {each.name: each.read_bytes() for each in folder.iterdir()}


def crashed(path: Path) -> dict[str, bytes]:
    """A database of another program that was killed with all of its work in the log; gives what there is."""
    original = path.with_name("original")
    with connect(original) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        connection.execute("CREATE TABLE precious AS SELECT 7 AS a")
        for suffix in ("", "-wal"):
            shutil.copy(f"{original}{suffix}", f"{path}{suffix}")
    for each in path.parent.glob("original*"):
        each.unlink()
    return contents(path.parent)


@pytest.mark.parametrize("text", ["notes", "[settings]\n" * 1000])
def test_companions_of_a_file_that_is_no_cache_are_not_changed(path: Path, text: str) -> None:
    """SQLite itself would delete these before it finds that the file is no database."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(f"{path.name}{suffix}").write_text(f"{text} {suffix}")
    before = contents(path.parent)
    with ParamCache(path) as cache:
        for use in (cache.vehicles, lambda: cache.save(whole_table(2))):
            with pytest.raises(CacheError, match="is not a cache of paramclient"):
                use()
    assert contents(path.parent) == before


def test_the_log_of_another_programs_database_is_left_as_it_is(path: Path) -> None:
    before = crashed(path)
    assert len(before) == 2
    with ParamCache(path) as cache:
        for use in (cache.vehicles, lambda: cache.save(whole_table(2))):
            with pytest.raises(CacheError, match="a database of another program"):
                use()
    assert contents(path.parent) == before


def test_an_empty_file_beside_the_log_of_another_program_is_left_as_it_is(path: Path) -> None:
    before = crashed(path) | {path.name: b""}
    path.write_bytes(b"")
    with ParamCache(path) as cache, pytest.raises(CacheError, match="is not a cache of paramclient"):
        cache.save(whole_table(2))
    assert contents(path.parent) == before


@pytest.mark.parametrize("suffix", ["-journal", "-shm", "-wal"])
@pytest.mark.parametrize("is_empty", [True, False])
def test_files_that_only_are_named_like_those_of_a_cache_are_left(
    path: Path, suffix: str, is_empty: bool
) -> None:
    path.with_name(f"{path.name}{suffix}").write_text("my flight")
    if is_empty:
        path.touch()
    before = contents(path.parent)
    with ParamCache(path) as cache, pytest.raises(CacheError, match="is not a cache of paramclient"):
        cache.save(whole_table(2))
    assert contents(path.parent) == before


@pytest.mark.parametrize("text", [b"my notes", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x82" + bytes(5000)])
def test_a_log_that_is_none_of_sqlite_is_left_as_it_is(path: Path, text: bytes) -> None:
    notes = path.with_name(f"{path.name}-wal")
    notes.write_bytes(text)
    with ParamCache(path) as cache, pytest.raises(CacheError, match="is not a cache of paramclient"):
        cache.save(whole_table(2))
    assert notes.read_bytes() == text


def test_a_cache_of_an_early_version_whose_tables_are_in_its_log_alone_is_one(path: Path) -> None:
    original = path.with_name("original")
    with ParamCache(original) as cache:
        cache.save(whole_table(3))
        with connect(original) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.execute("PRAGMA application_id = 0")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        cache.save(update(stored("PARAM_0", 9)))
        for suffix in ("", "-wal"):
            shutil.copy(f"{original}{suffix}", f"{path}{suffix}")
    with ParamCache(path) as cache:
        assert values(cache)["PARAM_0"] == 9
        assert not cache.notes


def test_a_new_file_says_whose_it_is_before_it_has_a_log(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(1))
        assert path.with_name(f"{path.name}-wal").stat().st_size
        begins = path.read_bytes()[:72]
    assert begins[68:] == APPLICATION_ID.to_bytes(4, "big")


def test_to_open_a_cache_twice_drops_none_of_its_locks(path: Path) -> None:
    """POSIX drops all locks of a process on a file when it closes any descriptor of it."""
    ask = (
        "import sqlite3, sys; print(*sqlite3.connect(sys.argv[1], timeout=0).execute(sys.argv[2]).fetchone())"
    )
    with ParamCache(path) as first:
        first.save(whole_table(3))
        with ParamCache(path) as second:
            assert len(values(second)) == 3
        gc.collect()
        with start(ask, path, "PRAGMA journal_mode = DELETE") as program:
            assert program.communicate()[0].strip() != "delete", "only who is alone may do that"
    with start(ask, path, "PRAGMA journal_mode = DELETE") as program:
        assert program.communicate()[0].strip() == "delete"


def test_a_file_of_ours_without_an_application_id_gets_one(path: Path) -> None:
    sound_but("PRAGMA application_id = 0")(path)
    with ParamCache(path) as cache:
        assert [values(cache, *table) for table in SOUND_TABLES] == list(SOUND_TABLES.values())
        works(cache)
        assert cache.notes == ()
    with connect(path) as connection:
        assert connection.execute("PRAGMA application_id").fetchall() == [(APPLICATION_ID,)]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644])
def test_a_file_that_others_can_read_stays_so(
    path: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    path.write_bytes(sound_file())
    path.chmod(mode)
    with ParamCache(path) as cache:
        works(cache)
    assert path.stat().st_mode & 0o777 == mode
    assert caplog.messages == []


@pytest.mark.parametrize("mode", [0o666, 0o664, 0o602, 0o620])
def test_a_file_that_others_can_write_is_made_its_owners_alone(
    path: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    path.write_bytes(sound_file())
    path.chmod(mode)
    with ParamCache(path) as cache:
        assert len(cache.vehicles()) == 2
        assert path.stat().st_mode & 0o777 == 0o600
        works(cache)
    [reported] = caplog.messages
    assert reported.startswith(f"other users than its owner could write to the cache {path} (mode {mode:o})")
    assert reported.endswith("its mode is now 600")


@pytest.mark.parametrize("may_write", [True, False])
@pytest.mark.parametrize(("mode", "is_refused"), [(0o666, True), (0o620, True), (0o644, False)])
def test_a_file_that_others_can_write_and_that_cannot_be_mended_is_refused(
    path: Path, mode: int, is_refused: bool, may_write: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Database, "_may_write", lambda _: may_write)
    path.write_bytes(sound_file())
    path.chmod(mode)

    def refuse(path: Path) -> int:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(sqlite_file, "make_private", refuse)
    with ParamCache(path) as cache:
        if is_refused:
            with pytest.raises(CacheError, match=rf"other users can write to the cache .* \(mode {mode:o}\)"):
                cache.vehicles()
        else:
            assert len(cache.vehicles()) == 2


def test_a_link_to_a_file_of_another_user_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "target"
    target.write_bytes(sound_file())
    link = tmp_path / "link"
    link.symlink_to(target)
    with ParamCache(link) as cache:
        assert len(cache.vehicles()) == 2
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    for place in (target, tmp_path / "not there"):
        link.unlink()
        link.symlink_to(place)
        with ParamCache(link) as cache, pytest.raises(CacheError, match="leads to a file of another user"):
            cache.save(whole_table(2))
    with ParamCache(target) as cache:
        assert len(cache.vehicles()) == 2


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give links away")
def test_no_cache_is_created_where_a_link_of_another_user_leads(tmp_path: Path) -> None:
    """The user's own link leads to the link of another user, who thus chooses where a file appears."""
    target = tmp_path / "target"
    second, link = tmp_path / "second", tmp_path / "link"
    second.symlink_to("target")
    link.symlink_to(second)
    os.chown(second, 12345, 12345, follow_symlinks=False)
    with ParamCache(link) as cache:
        assert cache.vehicles() == []
        with pytest.raises(CacheError, match=r"over a link of another user to a file that does not exist"):
            cache.save(whole_table(2))
        assert not target.exists()
        os.chown(second, 0, 0, follow_symlinks=False)
        cache.save(whole_table(2))
        assert len(cache.vehicles()) == 1
    assert target.exists()


def test_a_newer_file_is_set_aside_for_the_program_that_wrote_it(path: Path) -> None:
    sound_but("PRAGMA user_version = 99; CREATE TABLE more (a)")(path)
    content = path.read_bytes()
    with ParamCache(path) as cache:
        works(cache)
        assert f"is newer (its schema has version 99, this program knows {len(MIGRATIONS)})" in cache.notes[0]
    (kept,) = set_aside(path)
    assert kept.name.startswith(f"{path.name}.newer-20")
    assert kept.read_bytes() == content


def test_files_set_aside_in_one_second_get_numbers(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "gmtime", lambda: time.struct_time((2026, 11, 20, 10, 0, 0, 4, 324, 0)))
    with ParamCache(path) as cache:
        for number in range(3):
            path.write_bytes(rubbish(100, number))
            assert cache.vehicles() == []
    assert [each.name for each in set_aside(path)] == [
        f"{path.name}.damaged-20261120T100000Z-{number}" for number in (1, 2, 3)
    ]
    assert [each.read_bytes() for each in set_aside(path)] == [rubbish(100, number) for number in range(3)]


def test_an_older_file_is_brought_up_to_date(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.write_bytes(sound_file())
    steps = (*MIGRATIONS, ("CREATE TABLE more (a)", "INSERT INTO more SELECT sum(size) FROM packed"))
    monkeypatch.setattr(sqlite_file, "MIGRATIONS", steps)
    with ParamCache(path) as cache:
        assert len(values(cache)) == 300
        works(cache)
    with connect(path) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (len(steps),)
        assert connection.execute("SELECT a FROM more").fetchall() == [(600,)]
    assert not set_aside(path)
    monkeypatch.setattr(sqlite_file, "MIGRATIONS", MIGRATIONS)
    with ParamCache(path) as cache:
        works(cache)
        assert "is newer" in cache.notes[0]


def test_a_file_from_before_there_were_defaults_keeps_its_tables(path: Path) -> None:
    path.write_bytes(sound_file())
    make_older(path, 1)  # the checksums are those of the later versions
    with ParamCache(path) as cache:
        assert len(values(cache)) == 300
        assert not cache.notes
        works(cache)


def test_a_file_from_before_there_were_snapshots_has_a_past_from_its_last_write_on(path: Path) -> None:
    """The time at which names appeared is unknown for earlier rows."""
    with ParamCache(path) as cache:
        cache.save(whole_table(300))
        cache.save(update(stored("PARAM_1", 5, at=NOW + 50), at=NOW + 50))
        cache.save(update(stored("ALONE", 1), component=154))
    make_older(path, 2)
    with ParamCache(path) as cache:
        cache.save(update(stored("PARAM_1", 6, at=NOW + 99), stored("NEW", 1, at=NOW + 99), at=NOW + 99))
        state = cache.state_at(PX4.key, 1, NOW + 50)
        assert (len(state), state["PARAM_1"].value) == (300, 5)
        assert cache.state_at(PX4.key, 1, NOW + 99)["NEW"].value == 1
        with pytest.raises(CacheError, match="begins at 2026-11-18T11:07:30Z; there is no snapshot"):
            cache.state_at(PX4.key, 1, NOW + 49)
        with pytest.raises(CacheError, match="was never complete"):
            cache.state_at(PX4.key, 154, NOW + 99)
        assert cache.snapshots(PX4.key) == []
        assert not cache.notes
        works(cache)


@pytest.mark.parametrize("version", [2, 3])
def test_a_file_from_before_tables_were_packed_keeps_every_cell(path: Path, version: int) -> None:
    odd = stored("~ODD", 4)
    cells = [
        stored("PLAIN", 1, index=0),
        stored("LAST", (1 << 64) - 1, ParamType.INT64, at=NOW - 0.1, volatile=True),
        stored("NAN", 0x7FA00001, ParamType.REAL32, index=1),
        stored("RAW", 0xFFFFFFFF, 77, index=32767, is_raw=True),
        stored("A", 3, index=1),
        StoredParam(replace(odd.param, default=-5), odd.heard_at),
    ]
    with ParamCache(path) as cache:
        cache.save(update(*cells))
        cache.save(update(component=154))
        before = [cache.load(PX4.key, component) for component in (1, 154)]
        summaries = cache.components()
    assert before[0] is not None
    assert list(before[0].params) == ["PLAIN", "A", "NAN", "RAW", "LAST", "~ODD"]
    make_older(path, version)
    with ParamCache(path) as cache:
        after = [cache.load(PX4.key, component) for component in (1, 154)]
        assert after == before
        assert after[0] is not None
        assert list(after[0].params) == list(before[0].params)
        assert after[0].params["~ODD"].default == -5
        assert cache.components() == summaries
        cache.save(update(stored("PLAIN", 2)))
        assert [entry.old.value for entry in cache.history(PX4.key)] == [1]
        assert not cache.notes
        works(cache)
    with connect(path) as connection:
        assert not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'param'").fetchall()


def test_a_cache_file_of_an_older_version_keeps_its_tables(path: Path) -> None:
    path.write_bytes(sound_file())
    make_older(path, 4)
    with ParamCache(path) as cache:
        assert [values(cache, *table) for table in SOUND_TABLES] == list(SOUND_TABLES.values())
        assert {each.source for each in cache.components()} == {None}
        assert cache.history(PX4.key)
        assert not cache.notes


def test_a_file_that_cannot_be_brought_up_to_date_stays_what_it_was(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path.write_bytes(sound_file())
    make_older(path, 3)
    *steps, last = MIGRATIONS
    monkeypatch.setattr(sqlite_file, "MIGRATIONS", (*steps, (*last, "DROP TABLE nonesuch")))
    with ParamCache(path) as cache, pytest.raises(CacheError, match="no such table: nonesuch"):
        cache.save(whole_table(1))
    with connect(path) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (3,)
        assert connection.execute("SELECT count(*) FROM param").fetchone() == (600,)
    monkeypatch.undo()
    with ParamCache(path) as cache:
        assert [values(cache, *table) for table in SOUND_TABLES] == list(SOUND_TABLES.values())
        assert not cache.notes


def test_a_past_that_the_clock_has_mixed_up_begins_after_all_of_it(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        cache.save(update(stored("PARAM_1", 5, at=NOW + 900), at=NOW + 900))
        cache.save(update(at=NOW + 10))
    make_older(path, 2)
    with ParamCache(path) as cache:
        with pytest.raises(CacheError, match="begins at 2026-11-18T11:21:40Z"):
            cache.state_at(PX4.key, 1, NOW + 899)
        assert cache.state_at(PX4.key, 1, NOW + 900)["PARAM_1"].value == 5


def test_a_file_cut_at_any_page_is_set_aside_as_it_is(path: Path) -> None:
    content = sound_file()
    cuts = range(0, len(content), PAGE)
    assert len(cuts) > PAGES
    for cut in cuts:
        path.write_bytes(content[:cut])
        with ParamCache(path) as cache:
            works(cache)
        assert [each.read_bytes() for each in set_aside(path)] == ([content[:cut]] if cut else [])
        for each in path.parent.iterdir():
            each.unlink()


PLACES = st.one_of(
    st.integers(0, 99),  # the file's header
    st.integers(100, PAGE - 1),  # the schema
    st.builds(
        lambda page, at: page * PAGE + at, st.integers(1, PAGES - 1), st.integers(0, 20)
    ),  # headers of pages
    st.integers(PAGE, PAGES * PAGE - 1),
)


@given(flips=st.lists(st.tuples(PLACES, st.integers(1, 255)), min_size=1, max_size=30))
@settings(max_examples=100, deadline=None)
def test_flipped_bits_never_stop_the_cache_nor_cost_the_file(flips: list[tuple[int, int]]) -> None:
    """What is read is what was written, or the file is set aside, or one that is no cache any more left."""
    content = bytearray(sound_file())
    for at, bits in flips:
        content[at] ^= bits
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache"
        path.write_bytes(content)
        if content[:16] != sound_file()[:16] or content[68:72] != sound_file()[68:72]:
            with ParamCache(path) as cache, pytest.raises(CacheError, match="was not changed"):
                cache.save(whole_table(2))
            assert path.read_bytes() == content
            return
        with ParamCache(path) as cache:
            found = [values(cache, *table) for table in SOUND_TABLES]
            if cache.notes:  # nothing was written so far but, perhaps, the header's mark for WAL
                (kept,) = set_aside(path)
                assert kept.read_bytes()[100:] == content[100:]
            else:
                assert found == list(SOUND_TABLES.values())
            works(cache)
            assert len(set_aside(path)) == len(cache.notes) <= 2
        with ParamCache(path) as again:
            works(again)
            assert not again.notes


def test_damage_that_is_found_later_is_handled_in_the_same_way(path: Path) -> None:
    path.write_bytes(sound_file())
    with connect(path) as connection:
        pages = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name IN ('packed', 'history')"
        ).fetchall()
    with ParamCache(path) as reader, ParamCache(path) as writer:
        assert len(reader.vehicles()) == len(writer.vehicles()) == 2
        with path.open("r+b") as file:
            for (page,) in pages:
                file.seek((page - 1) * PAGE)
                file.write(b"\xff" * PAGE)
        content = path.read_bytes()
        with connect(path) as other:  # whose change makes SQLite forget the pages that it remembers
            other.execute("UPDATE vehicle SET board = 2")
        writer.save(whole_table(3, first=7))
        assert "malformed" in writer.notes[0]
        assert values(reader) == values(writer) == {"PARAM_0": 7, "PARAM_1": 8, "PARAM_2": 9}
        assert not reader.notes
        works(reader)
    (kept,) = set_aside(path)
    assert kept.read_bytes() == content
    assert integrity(path) == "ok"


def test_a_file_set_aside_takes_its_log_along(path: Path) -> None:
    with ParamCache(path) as first:
        first.save(whole_table(3))
        with connect(path) as connection:
            connection.execute("UPDATE packed SET params = 'much'")
        assert path.with_name(f"{path.name}-wal").stat().st_size
        assert values(first) == {}
        works(first)
    (kept,) = set_aside(path)
    with connect(kept) as connection:
        assert connection.execute("SELECT params FROM packed").fetchall() == [("much",)]


def test_a_header_that_forbids_writing_is_damage(path: Path) -> None:
    content = bytearray(sound_file())
    content[18] = 3  # a version of the file format that SQLite may read but not write
    path.write_bytes(content)
    with ParamCache(path) as cache:
        assert len(values(cache)) == 300
        works(cache)
        assert "forbids writing" in cache.notes[0]
    assert [each.read_bytes() for each in set_aside(path)] == [content]


def test_mistakes_of_the_program_are_not_taken_for_damage(path: Path) -> None:
    path.write_bytes(sound_file())
    store = Database(path)

    def half(statement: str, *values: object) -> Callable[[sqlite3.Connection], object]:
        def work(connection: sqlite3.Connection) -> object:
            connection.execute("DELETE FROM vehicle")
            return connection.execute(statement, values)

        return work

    with pytest.raises(CacheError, match="no such table"):
        store.write(half("SELECT * FROM nonesuch"))
    with pytest.raises(CacheError, match="NOT NULL"):
        store.write(half("INSERT INTO vehicle (key) VALUES ('k')"))
    with pytest.raises(sqlite3.ProgrammingError):
        store.write(half("SELECT ?"))
    with pytest.raises(ZeroDivisionError):
        store.write(lambda _: 1 // 0)
    assert store.read(lambda connection: connection.execute("SELECT count(*) FROM vehicle").fetchone()) == (
        2,
    )
    store.close()
    assert not store.notes
    assert not set_aside(path)


def test_a_file_that_another_program_has_just_renamed_is_not_renamed_again(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path.write_bytes(sound_file())
    locked = lock.locked

    def late(folder: Path) -> Any:
        if cache.notes == () and path.with_name("other").exists():
            move(path, "aside")
            path.with_name("other").rename(path)
        return locked(folder)

    with ParamCache(path) as cache:
        assert len(values(cache)) == 300
        with connect(path) as other:
            other.execute("UPDATE packed SET params = 'much'")
        path.with_name("other").write_bytes(sound_file())
        monkeypatch.setattr("paramclient.cache.sqlite_file.locked", late)
        assert len(values(cache)) == 300
        works(cache)
    assert not cache.notes
    assert not set_aside(path)


def test_damage_that_does_not_end_is_an_error(path: Path) -> None:
    def work(_: sqlite3.Connection) -> None:
        raise Damaged("no end")

    store = Database(path)
    with pytest.raises(CacheError, match="damaged or replaced 3 times"):
        store.write(work)
    store.close()


# Places that cannot be written to


def test_a_full_disk_is_an_error_and_nothing_is_lost(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(100))
        with full_disk(at=2 * PAGE):
            for _ in range(3):
                with pytest.raises(CacheError, match=str(path)) as caught:
                    cache.save(whole_table(900, first=1))
                assert isinstance(caught.value.__cause__, sqlite3.OperationalError)
                assert values(cache) == {f"PARAM_{number}": number for number in range(100)}
        assert not cache.notes
        works(cache)
    assert integrity(path) == "ok"


def test_a_disk_that_is_full_from_the_beginning_holds_nothing_up(path: Path) -> None:
    with ParamCache(path) as cache:
        with full_disk(at=100):
            with pytest.raises(CacheError):
                cache.save(whole_table(100))
            assert cache.vehicles() == []
        works(cache)
        assert not cache.notes


@pytest.mark.parametrize("size", [PAGE, 2 * PAGE, 8 * PAGE])
def test_a_file_that_a_full_disk_left_without_tables_is_an_empty_cache(path: Path, size: int) -> None:
    """Not a file of an older version, as it was reported."""
    with full_disk(at=size):
        with ParamCache(path) as cache, pytest.raises(CacheError):
            cache.save(whole_table(100))
        assert path.stat().st_size > 0
        with ParamCache(path) as cache:
            assert cache.vehicles() == []
            with pytest.raises(CacheError, match="cannot be used"):
                cache.save(whole_table(100))
    with ParamCache(path) as cache:
        works(cache)
        assert not cache.notes


def test_a_damaged_file_is_closed_before_it_is_renamed_on_windows(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows."""
    monkeypatch.setattr(sqlite_file, "_CLOSES_TO_RENAME", True)
    rename = Path.rename

    def only_when_closed(self: Path, to: str | Path) -> Path:
        held = {os.path.realpath(each) for each in Path("/proc/self/fd").iterdir()}
        if str(self) in held:
            raise PermissionError(13, "it is open")
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", only_when_closed)
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        with connect(path) as other:
            other.execute("UPDATE component SET checksum = checksum + 1")
        assert not values(cache)
        assert len(set_aside(path)) == 1
        works(cache)


def test_damage_found_on_a_full_disk_is_set_aside_later(path: Path) -> None:
    """Nothing can be locked there, and what is read without locks is no proof."""
    sound_but("UPDATE vehicle SET board = 'much'")(path)
    with ParamCache(path) as cache:
        with full_disk(at=100), pytest.raises(CacheError, match=r"damaged \(.*\) and cannot be set aside"):
            cache.vehicles()
        assert not set_aside(path)
        works(cache)
        assert len(set_aside(path)) == 1


@pytest.mark.parametrize("is_open", [True, False])
def test_a_read_only_folder_can_be_read_and_is_an_error_to_write(tmp_path: Path, is_open: bool) -> None:
    path = tmp_path / "folder" / "cache"
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
    cache = ParamCache(path)
    if is_open:
        assert len(cache.vehicles()) == 1
    with cache:
        with read_only(path.parent):
            for _ in range(2):
                if not is_open:
                    with pytest.raises(CacheError, match=str(path)):
                        cache.save(whole_table(4))
                assert len(values(cache)) == 3
                assert [vehicle.key for vehicle in cache.vehicles()] == [PX4.key]
                assert cache.component().history() == []
        works(cache)
    assert not cache.notes


def test_a_read_only_folder_with_a_killed_programs_log_is_read_with_the_log(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "cache"
    path.parent.mkdir()
    with ParamCache(tmp_path / "cache") as writer:
        writer.save(whole_table(3))
        for suffix in ("", "-wal"):
            shutil.copy(tmp_path / f"cache{suffix}", path.parent)
    with read_only(path.parent), ParamCache(path) as cache:
        assert len(values(cache)) == 3
        with pytest.raises(CacheError):
            cache.save(update())
        assert sorted(file.name for file in path.parent.iterdir()) == ["cache", "cache-wal"]


def test_a_read_only_file_is_read_and_written_as_soon_as_it_may_be(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    path.write_bytes(sound_file())
    path.chmod(0o400)
    with ParamCache(path) as cache, without_root_powers():
        for _ in range(2):
            assert len(values(cache)) == 300
            with pytest.raises(CacheError, match=f"{path} cannot be used: it is read-only"):
                cache.save(update())
        assert [each.name for each in tmp_path.iterdir()] == ["cache"]
        path.chmod(0o600)
        works(cache)
    assert not cache.notes


def test_a_read_only_file_that_its_owner_has_open_is_read_with_his_latest_words(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    with ParamCache(path) as owner, ParamCache(path) as reader:
        owner.save(whole_table(3))
        path.chmod(0o400)
        with without_root_powers():
            for number in range(4, 6):
                assert len(values(reader)) == number - 1
                with pytest.raises(CacheError, match="read-only"):
                    reader.save(update())
                owner.save(whole_table(number))
        path.chmod(0o600)
        works(reader)
    assert not reader.notes


def test_a_log_that_cannot_be_written_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    path.write_bytes(sound_file())
    with ParamCache(path) as first, ParamCache(path) as cache:
        first.save(update(stored("PARAM_0", 9)))
        path.with_name("cache-wal").chmod(0o400)
        with without_root_powers():
            assert values(cache)["PARAM_0"] == 9
            with pytest.raises(CacheError, match="read-only"):
                cache.save(update())
        path.with_name("cache-wal").chmod(0o600)
        works(cache)
    assert not cache.notes


def test_a_read_only_folder_without_a_cache_holds_nothing(tmp_path: Path) -> None:
    with read_only(tmp_path):
        for path in (tmp_path / "cache", tmp_path / "folder" / "cache"):
            with ParamCache(path) as cache:
                assert (cache.vehicles(), cache.components(), cache.load(PX4.key, 1)) == ([], [], None)
                with pytest.raises(CacheError, match=r"cannot be used: .*Permission denied"):
                    cache.save(update())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "make",
    [lambda path: path.write_bytes(rubbish(100)), sound_but("UPDATE vehicle SET board = 'much'")],
    ids=["rubbish", "a cell"],
)
def test_damage_where_nothing_can_be_renamed_is_an_error(
    tmp_path: Path, make: Callable[[Path], None]
) -> None:
    path = tmp_path / "cache"
    make(path)
    content = path.read_bytes()
    with (
        read_only(tmp_path),
        ParamCache(path) as cache,
        pytest.raises(CacheError, match=r"is damaged \(.*\) and cannot be set aside"),
    ):
        cache.vehicles()
    assert [each.name for each in tmp_path.iterdir()] == ["cache"]
    assert path.read_bytes() == content
    assert not cache.notes


def test_an_older_file_where_nothing_can_be_written_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").write_bytes(sound_file())
    monkeypatch.setattr(sqlite_file, "MIGRATIONS", (*MIGRATIONS, ("CREATE TABLE more (a)",)))
    with (
        read_only(tmp_path),
        ParamCache(tmp_path / "cache") as cache,
        pytest.raises(CacheError, match="older version"),
    ):
        cache.vehicles()


def test_a_folder_as_cache_is_an_error_and_a_path_below_a_file_does_not_exist(
    tmp_path: Path,
) -> None:
    file = tmp_path / "file"
    file.write_text("precious")
    with ParamCache(tmp_path) as cache:
        for use in (cache.vehicles, lambda: cache.save(update())):
            with pytest.raises(CacheError, match="not a regular file"):
                use()
    with ParamCache(file / "cache") as cache:
        assert cache.vehicles() == []
        with pytest.raises(CacheError, match="cannot be used"):
            cache.save(update())
    assert file.read_text() == "precious"


def test_no_descriptor_is_left_open(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def descriptors() -> int:
        gc.collect()
        return len(list(Path("/proc/self/fd").iterdir()))

    monkeypatch.setattr(sqlite_file, "LOCK_WAIT_MAX", 0.0)
    before = descriptors()
    for _ in range(3):
        path.write_bytes(rubbish(100))
        with ParamCache(path) as cache:
            works(cache)
            with connect(path) as other:
                other.execute("BEGIN IMMEDIATE")
                with pytest.raises(CacheError):
                    cache.save(update())
            with pytest.raises(UnknownVehicle):
                cache.component("beef")
        ParamCache(path).save(update())
    assert descriptors() == before
