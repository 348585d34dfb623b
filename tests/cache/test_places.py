"""A file that cannot be used or is set aside, several processes, and a database that cannot be reached."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from paramclient.cache import ParamCache
from paramclient.errors import CacheError, UsageError
from tests.cache.conftest import Open
from tests.caches import CACHE_ALONE, NOW, read_only, rubbish, set_aside, stored, update, values, whole_table


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "parameters.sqlite3"


def filled(path: Path) -> Path:
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
    return path


def test_only_a_write_creates_a_file_and_only_for_the_user(path: Path) -> None:
    with ParamCache(path) as cache:
        assert cache.components() == []
        assert not path.parent.exists()
        cache.save(whole_table(1))
        assert {each.stat().st_mode & 0o777 for each in path.parent.iterdir()} == {0o600}
        assert path.parent.stat().st_mode & 0o777 == 0o700


# what is set aside


def newer(path: Path, version: int = 999) -> None:
    with closing(sqlite3.connect(filled(path))) as file:
        file.execute(f"PRAGMA user_version = {version}")


def foreign(path: Path) -> None:
    path.parent.mkdir()
    with closing(sqlite3.connect(path)) as file:
        file.execute("CREATE TABLE notes (text)")


def damaged(path: Path) -> None:
    path.parent.mkdir()
    path.write_bytes(rubbish(20_000))


def damaged_inside(path: Path) -> None:
    content = bytearray(filled(path).read_bytes())
    content[4096:] = os.urandom(len(content) - 4096)
    path.write_bytes(content)


@pytest.mark.parametrize("spoil", [newer, lambda at: newer(at, 8), foreign, damaged, damaged_inside])
@pytest.mark.parametrize("writes_first", [False, True])
def test_a_file_that_is_no_cache_is_renamed_with_one_warning(
    spoil: object, writes_first: bool, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert callable(spoil)
    spoil(path)
    content = path.read_bytes()
    with ParamCache(path) as cache:
        if writes_first:
            cache.save(whole_table(2))
        assert len(cache.components()) == writes_first
        cache.save(whole_table(2))
        assert values(cache) == {"PARAM_0": 0, "PARAM_1": 1}
        [note] = cache.notes
    [kept] = set_aside(path)
    assert kept.read_bytes() == content
    assert kept.name in note
    assert [record.getMessage() for record in caplog.records] == [note]


# what cannot be written


def test_a_place_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with ParamCache(tmp_path / "file" / "cache") as cache:
        for use in (cache.vehicles, lambda: cache.save(whole_table(1))):
            with pytest.raises(CacheError, match="cannot be used"):
                use()
    os.mkfifo(tmp_path / "pipe")
    problems = {"postgresql://a b": "not valid", str(tmp_path / "file"): "another file"}
    problems |= dict.fromkeys([str(tmp_path / "pipe"), os.devnull], "not a regular file")
    for name, problem in problems.items():
        with pytest.raises(UsageError, match=problem):
            ParamCache(name)
    assert {each.name for each in tmp_path.iterdir()} == {"file", "pipe"}


def test_a_reader_that_may_not_write_sees_what_is_written_later_or_says_that_it_may_not(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    copy = tmp_path / "copy"
    with ParamCache(filled(path)) as reader:
        with read_only(path.parent):
            assert values(reader)["PARAM_0"] == 0
        with ParamCache(path) as other:
            other.save(update(stored("PARAM_0", 5, at=NOW + 1), at=NOW + 1))
            shutil.copytree(path.parent, copy, ignore=shutil.ignore_patterns("*-shm"))
        assert values(reader)["PARAM_0"] == 5
    assert not caplog.records
    with read_only(copy), ParamCache(copy / path.name) as reader:
        assert [values(reader)["PARAM_0"] for _ in range(2)] == [0, 0]
    [note] = reader.notes
    assert [record.getMessage() for record in caplog.records] == [note]


# several processes


WRITER = f"""{CACHE_ALONE}
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType
number, path = int(sys.argv[1]), sys.argv[2]
print(flush=True)
with ParamCache(path) as cache:
    for step in range(40):
        at = 1e9 + step + number / 10
        identity = Identity(number % 2 + 1, "x")
        items = [StoredParam.of(Param(f"P_{{number}}", step, ParamType.INT32, None, step), at)]
        cache.save(TableUpdate(identity=identity, component=1, autopilot=12, at=at, params=items))
"""


def test_several_processes_write_to_one_new_place(place: str) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    program = [sys.executable, "-c", WRITER]
    running = [subprocess.Popen([*program, str(number), place], env=environment) for number in range(4)]
    assert [process.wait(60) for process in running] == [0, 0, 0, 0]
    with ParamCache(place) as cache:
        assert len(cache.components()) == 2
        assert {len(cache.history(each.key)) for each in cache.vehicles()} == {2 * 39}
        assert cache.notes == ()


# a database


def test_an_unreachable_database_is_an_error_without_the_password(tmp_path: Path) -> None:
    with ParamCache(f"postgresql://me:se%20cret@/fleet?host={tmp_path}") as cache:
        assert "cret" not in cache.place
        for _ in range(2):  # the second call fails at once
            with pytest.raises(CacheError, match="cannot be used") as caught:
                cache.components()
            assert "cret" not in str(caught.value)


def test_a_lost_connection_is_opened_again(place: str, open_cache: Open) -> None:
    if not place.startswith("postgresql"):
        pytest.skip("a file has no connection")
    import psycopg

    cache = open_cache()
    cache.save(whole_table(1))
    with psycopg.connect(place, autocommit=True) as other:
        other.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
            " WHERE pid != pg_backend_pid() AND datname = current_database()"
        )
    cache.save(whole_table(2))
    assert len(values(cache)) == 2
