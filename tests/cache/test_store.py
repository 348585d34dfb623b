"""Every store keeps a cache in the same way: what `test_cache`, `test_fleet` and `test_snapshots` ask of a
file is tested with PostgreSQL here, by the same tests. Then what only stations that share one can do."""

from __future__ import annotations

import json
import sys
import threading
import time
import traceback
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import anyio
import anyio.to_thread
import psycopg
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient import ParamClient, Trust
from paramclient.cache import CacheChange, CopyResult, ParamCache, StoredParam, TableState, TableUpdate
from paramclient.cache.cells import Damaged
from paramclient.cache.database_url import DatabaseAddress
from paramclient.cache.history_columns import HistoryLine
from paramclient.cache.operations import Save
from paramclient.cache.outbox import LocalCopy, packed, unpacked
from paramclient.cache.postgres import STATEMENT_TIMEOUT, PostgresDatabase, PostgresTransaction, Unavailable
from paramclient.cache.shared import SharedStore, _Connection
from paramclient.cache.transaction import Transaction
from paramclient.cache.transfer import take_whole
from paramclient.errors import CacheError, UsageError
from paramclient.model.values import Param, ParamType
from tests.cache import test_cache, test_ext_tables, test_file_table, test_fleet, test_snapshots
from tests.caches import NOW, PX4, stored, update, values, whole_table
from tests.client.test_observation_times import interleaved
from tests.commands import in_process
from tests.postgres import GIVEN, PROGRAMS, WHY_NONE, Server, database_on, server
from tests.service.test_cut_off import reported_after_a_kill
from tests.service.test_process import served
from tests.shell import Tap, in_simulated_time, small_px4

TIMEOUT = 60.0

OF_A_FILE = {
    # what is said of a file, of its folder, or with SQLite's own words
    "test_a_cache_that_is_deleted_closes_its_file",
    "test_folder_and_file_are_for_the_user_alone",
    "test_the_default_path_is_in_the_users_cache_folder",
    "test_to_import_it_takes_no_other_library",
    "test_to_save_nothing_creates_nothing",
    "test_without_a_file_there_is_nothing_and_to_look_creates_nothing",
    "test_snapshots_of_an_unknown_vehicle_are_an_error_that_creates_nothing",
    "test_damage_during_a_comparison_is_reported_as_elsewhere",
    "test_a_snapshot_that_is_damaged_is_an_error_and_costs_nothing_else",
    "test_added_names_and_clock_rollbacks_are_trimmed_with_the_history",
    "test_a_snapshot_that_was_made_survives_a_kill_at_any_moment",
    "test_two_programs_set_down_the_same_table_at_once",
    "test_a_full_disk_is_an_error_and_keeps_the_snapshots_there_are",
    # a time that lies before another one is another station's, not a clock that was set back
    "test_a_time_that_the_clock_went_through_twice_is_refused",
    "test_two_programs_that_write_a_moment_apart_are_no_clock_set_back",
    "test_a_clock_that_was_set_back_is_distinguished_from_a_program_that_is_late",
    # they have fixtures of their own
    "test_state_at_agrees_with_a_model_that_keeps_every_state",
    "test_every_value_is_restored_to_the_last_bit",
    # damage of a file, and what needs no store
    "test_damage_is_noticed",
    "test_queued_writes_are_restored",
    "test_queued_snapshots_are_restored",
    "test_a_damaged_snapshot_of_extended_parameters_is_an_error",
    "test_a_queued_write_that_is_none_is_damaged",
}


def shared_tests(module: ModuleType) -> dict[str, object]:
    return {
        name: each
        for name, each in vars(module).items()
        if name.startswith("test_") and callable(each) and name not in OF_A_FILE
    }


SHARED = (test_cache, test_file_table, test_fleet, test_snapshots, test_ext_tables)
for module in SHARED:
    globals().update(shared_tests(module))
three = test_cache.three


def test_the_tests_that_are_left_out_exist() -> None:
    assert {name for module in SHARED for name in vars(module)} >= OF_A_FILE


@pytest.fixture(scope="session")
def own_server() -> Iterator[Server]:
    """A server that a test may end; it starts it again."""
    if PROGRAMS is None:
        pytest.skip(WHY_NONE)
    with server() as running:
        yield running


@pytest.fixture(scope="session")
def server_url(request: pytest.FixtureRequest) -> str:
    if GIVEN is not None:
        return GIVEN
    running: Server = request.getfixturevalue("own_server")
    return running.url


@pytest.fixture(scope="session")
def shared_database(server_url: str) -> Iterator[str]:
    with database_on(server_url) as url:
        yield url


@pytest.fixture
def path(shared_database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An empty database, by its URL."""
    monkeypatch.setattr("paramclient.cache.store.default_path", lambda: tmp_path / "parameters.sqlite3")
    emptied(shared_database)
    return shared_database


@pytest.fixture
def cache(path: str) -> Iterator[ParamCache]:
    with ParamCache(path) as cache:
        yield cache


@pytest.fixture
def stations(path: str, tmp_path: Path) -> Iterator[tuple[ParamCache, ParamCache]]:
    """Two stations that share a database."""
    with ParamCache(path, local=tmp_path / "a") as a, ParamCache(path, local=tmp_path / "b") as b:
        yield a, b


@pytest.fixture
def fragile(own_server: Server, tmp_path: Path) -> Iterator[tuple[Server, ParamCache, ParamCache]]:
    """Two stations, and the server of their database, which may be killed and started."""
    with (
        database_on(own_server.url) as url,
        ParamCache(url, local=tmp_path / "a") as a,
        ParamCache(url, local=tmp_path / "b") as b,
    ):
        yield own_server, a, b


def emptied(url: str) -> None:
    tables = "vehicle, component, param, history, birth, setback, snapshot, writer"
    tables += ", ext_table, ext_param, ext_history"
    with psycopg.connect(url, options="-c search_path=paramclient", autocommit=True) as connection:
        [(is_there,)] = connection.execute("SELECT to_regclass('vehicle') IS NOT NULL")
        if is_there:
            connection.execute(f"TRUNCATE {tables} RESTART IDENTITY CASCADE".encode())


def until(condition: Callable[[], object]) -> None:
    """Wait until something is so, however slow the machine is."""
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def a_value(number: int, name: str = "PARAM_1", at: float | None = None, by: str = "vehicle") -> TableUpdate:
    """An observation of a value; the number is also its time in seconds by default."""
    received = NOW + number if at is None else at
    return update(stored(name, number, at=received, by=by), at=received)


def reported(cache: ParamCache, name: str | None = None) -> list[tuple[float, object, object]]:
    """The history of a vehicle: seconds after NOW, old value, new value."""
    found = cache.history(PX4.key, name=name)
    return [(each.at - NOW, each.old.value, each.new and each.new.value) for each in found]


# Stations that share a database


def test_a_change_is_reported_to_the_other_station_only(
    stations: tuple[ParamCache, ParamCache],
) -> None:
    a, b = stations
    at_a: list[CacheChange] = []
    at_b: list[CacheChange] = []
    end = a.subscribe(at_a.append)
    b.subscribe(at_b.append)
    a.save(whole_table(3))
    until(lambda: at_b == [CacheChange(PX4.key, 1)])
    b.save(a_value(7))
    until(lambda: at_a == [CacheChange(PX4.key, 1)])
    end()
    b.remove(PX4.key)
    a.save(whole_table(3, component=2))
    until(lambda: at_b[-1] == CacheChange(PX4.key, 2))
    assert len(at_a) == 1
    assert len(at_b) == 2


def test_the_later_observation_counts_and_both_are_in_the_history(
    stations: tuple[ParamCache, ParamCache],
) -> None:
    a, b = stations
    a.save(whole_table(3))
    b.save(a_value(20))
    a.save(a_value(10))
    assert values(a)["PARAM_1"] == values(b)["PARAM_1"] == 20
    assert reported(a) == reported(b) == [(10, 1, 10), (20, 10, 20)]
    a.save(a_value(10))
    b.save(a_value(20, at=NOW + 15))
    assert reported(a) == [(10, 1, 10), (15, 10, 20)], "it was so earlier than anybody knew"


def test_a_station_that_knows_less_removes_nothing(stations: tuple[ParamCache, ParamCache]) -> None:
    a, b = stations
    a.save(whole_table(3))
    b.save(replace(a_value(10), table=TableState(None, 3)))
    table = a.load(PX4.key, 1)
    assert table is not None
    assert table.complete
    assert table.hash is None, "it is not the hash of this value"
    b.save(replace(a_value(10), table=TableState(None, 4)))
    table = a.load(PX4.key, 1)
    assert table is not None
    assert (table.complete, table.count) == (False, 4), "the vehicle has another number of parameters now"


def test_a_late_whole_table_counts_if_nothing_else_was_received_since(
    stations: tuple[ParamCache, ParamCache],
) -> None:
    a, b = stations
    b.save(a_value(1, at=NOW + 5))
    late = whole_table(3)
    a.save(late)
    table = b.load(PX4.key, 1)
    assert table is not None
    assert (table.complete, table.hash, list(table.params)) == (
        True,
        0xCF579589,
        ["PARAM_0", "PARAM_1", "PARAM_2"],
    )
    b.save(a_value(9))
    a.save(late)
    table = b.load(PX4.key, 1)
    assert table is not None
    assert (table.hash, table.params["PARAM_1"].value) == (None, 9)


NAMES = st.sampled_from(["PARAM_0", "PARAM_1"])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(NAMES, st.booleans()), min_size=1, max_size=8), st.randoms(use_true_random=False))
def test_table_and_history_do_not_depend_on_the_order_of_stations(
    observed: list[tuple[str, bool]], random: Random
) -> None:
    """Each station writes its observations in the order of their times; either may be ahead."""
    received = [
        (of_one, a_value(number, name, at=NOW + 10 * number))
        for number, (name, of_one) in enumerate(observed, start=10)
    ]
    streams = [[each for of_one, each in received if of_one is which] for which in (True, False)]
    mixed = []
    while any(streams):
        mixed.append(random.choice([stream for stream in streams if stream]).pop(0))
    assert kept_of(mixed) == kept_of([each for _, each in received])


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(NAMES, st.integers(0, 2)), min_size=1, max_size=8), st.randoms(use_true_random=False)
)
def test_in_any_order_of_arrival_the_latest_values_are_kept_and_lines_make_a_chain(
    observed: list[tuple[str, int]], random: Random
) -> None:
    updates = [a_value(value, name, at=NOW + 10 * n) for n, (name, value) in enumerate(observed, start=1)]
    mixed = [*updates, *random.sample(updates, len(updates) // 2)]
    random.shuffle(mixed)
    rows, lines = kept_of(mixed)
    assert rows == kept_of(updates)[0]
    for name, first in (("PARAM_0", 0), ("PARAM_1", 1)):
        chain = [line for line in lines if line[1] == name]
        assert [line[0] for line in chain] == sorted(line[0] for line in chain)
        known = [first, *(line[7] for line in chain)]
        assert [line[4] for line in chain] == known[:-1]
        assert known[-1] == rows[name].bits
        assert all(old != new for old, new in pairwise(known))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_of_two_that_fetch_at_different_times_the_later_writer_makes_no_false_line(
    data: st.DataObject,
) -> None:
    """One station sets and writes every value; the other writes all of them, or the latest at each write."""
    moments = [10.0, 20.0, 30.0]  # of the changes to 17, 18 and 19, in seconds behind NOW
    truth = [(0.0, 200), *zip(moments, (17, 18, 19), strict=True)]
    fetched = data.draw(st.sampled_from((0.0, 5.0, 15.0, 25.0, 35.0)), label="when the other fetches")
    received = [each for each in truth if each[0] >= fetched] or truth[-1:]
    current = max(each for each in truth if each[0] <= fetched)
    others = [
        (fetched, current[1]),
        *((moment + 0.5, value) for moment, value in received if moment > fetched),
    ]
    streams: list[list[TableUpdate]] = []
    for observed, has_all in ((truth, True), (others, data.draw(st.booleans()))):
        cuts = data.draw(st.sets(st.integers(1, len(observed))), label="how many each write has seen")
        stream: list[TableUpdate] = []
        begin = 0
        for end in sorted({*cuts, len(observed)}):
            part = observed[begin:end] if has_all else observed[end - 1 : end]
            begin = end
            whole: dict[str, Any] = {}
            if not stream:
                state = TableState(None, 1, complete=True, synced_at=NOW + observed[0][0])
                whole = {"replace": True, "whole_at": NOW + observed[0][0], "table": state}
            items = [stored("PARAM_0", value, index=0, at=NOW + moment) for moment, value in part]
            stream.append(update(*items, at=NOW + part[-1][0] + 1.0, **whole))
        streams.append(stream)
    mixed: list[TableUpdate] = []
    while any(streams):
        mixed.append(data.draw(st.sampled_from([stream for stream in streams if stream])).pop(0))
    with TemporaryDirectory() as folder, ParamCache(Path(folder) / "cache.sqlite3") as cache:
        for each in mixed:
            cache.save(each, clock=lambda: NOW + 60.0)
        lines = [(line.old.value, line.new and line.new.value) for line in cache.history(PX4.key)]
    assert lines == [(200, 17), (17, 18), (18, 19)]


def test_a_database_that_two_programs_write_to_agrees_with_a_model(path: str, tmp_path: Path) -> None:
    interleaved(
        lambda: (ParamCache(path, local=tmp_path / "a"), ParamCache(path, local=tmp_path / "b")), examples=15
    )


def kept_of(updates: Iterable[TableUpdate]) -> tuple[Mapping[str, StoredParam], Sequence[HistoryLine]]:
    """What becomes of a whole table by these."""
    with TemporaryDirectory() as folder:
        copy = LocalCopy(Path(folder) / "copy")
        for each in (whole_table(2), *updates):
            copy.do(Save([each]))
        found = copy.read(lambda session: take_whole(session, PX4.key, 1))
        copy.close()
    assert found is not None
    return found.rows, found.lines


def test_a_commit_whose_answer_was_lost_is_not_done_twice(
    stations: tuple[ParamCache, ParamCache], monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = stations
    a.save(whole_table(3))
    lose_an_answer(monkeypatch)
    a.save(a_value(10))
    until(lambda: a.offline_reason is None)
    a.save(a_value(11))
    assert reported(b) == [(10, 1, 10), (11, 10, 11)]


def test_a_reason_with_a_zero_in_it_does_no_harm(cache: ParamCache) -> None:
    cache.save(whole_table(1))
    made = cache.snapshot(PX4.key, 1, reason="a\0b")
    assert made.reason == cache.snapshots(PX4.key)[0].reason == "a\\x00b"
    assert cache.state_at(PX4.key, 1, made.id) == made.params


def test_an_operation_whose_response_was_lost_returns_its_result(
    stations: tuple[ParamCache, ParamCache], monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = stations
    a.save([whole_table(3), whole_table(2, component=2)])
    lose_an_answer(monkeypatch)
    made = a.snapshot(PX4.key, 1, reason="before")
    assert [each.id for each in b.snapshots(PX4.key)] == [made.id]
    assert b.state_at(PX4.key, 1, made.id) == made.params
    lose_an_answer(monkeypatch)
    assert a.remove(PX4.key) == 2
    assert b.vehicles() == []


def lose_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Break the connection at the next commit: it is done without a confirmation."""
    write = PostgresDatabase.write

    def half(self: PostgresDatabase, *arguments: Any) -> Any:
        monkeypatch.setattr(PostgresDatabase, "write", write)
        write(self, *arguments)
        raise Unavailable("the answer was lost")

    monkeypatch.setattr(PostgresDatabase, "write", half)


def test_two_stations_make_the_schema_at_once(server_url: str, tmp_path: Path) -> None:
    with database_on(server_url) as url, ThreadPoolExecutor(4) as threads:
        caches = [ParamCache(url, local=tmp_path / str(number)) for number in range(4)]
        assert list(threads.map(lambda cache: cache.vehicles(), caches)) == [[]] * 4
        for cache in caches:
            cache.close()


def test_a_database_of_a_later_version_is_left_alone(server_url: str, tmp_path: Path) -> None:
    with database_on(server_url) as url:
        with ParamCache(url, local=tmp_path / "a") as cache:
            cache.save(whole_table(1))
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute("UPDATE paramclient.version SET number = 99")
        with ParamCache(url, local=tmp_path / "a") as cache:
            with pytest.raises(CacheError, match="of a later version of paramclient"):
                cache.vehicles()
            with pytest.raises(CacheError, match="of a later version"):
                cache.save(whole_table(1))


def test_a_damaged_table_is_an_error_and_the_others_are_not(path: str, cache: ParamCache) -> None:
    cache.save(whole_table(2))
    cache.save(whole_table(2, component=2))
    with psycopg.connect(path, autocommit=True) as connection:
        connection.execute("UPDATE paramclient.param SET bits = 77 WHERE owner = 1 AND name = 'PARAM_1'")
    with pytest.raises(CacheError, match="is damaged"):
        cache.load(PX4.key, 1)
    assert values(cache, component=2) == {"PARAM_0": 0, "PARAM_1": 1}


# The database is lost


def test_a_station_works_on_locally_and_catches_up(fragile: tuple[Server, ParamCache, ParamCache]) -> None:
    running, a, b = fragile
    a.save(whole_table(3))
    made = a.snapshot(PX4.key, 1, reason="before")
    assert b.load(PX4.key, 1) is not None
    until(lambda: is_copied(b))
    running.kill()
    assert values(b) == {"PARAM_0": 0, "PARAM_1": 1, "PARAM_2": 2}
    assert b.offline_reason is not None
    assert b.state_at(PX4.key, 1, made.id) == made.params
    b.save(a_value(20))
    a.save([a_value(10), a_value(5, "PARAM_2")])
    assert (values(a)["PARAM_1"], values(b)["PARAM_1"]) == (10, 20)
    own = b.snapshot(PX4.key, 1, reason="offline")
    assert own.id > 1 << 50, "a number that the database will not give"
    with pytest.raises(CacheError, match="repeat the call"):
        b.remove(PX4.key)
    at_a: list[CacheChange] = []
    a.subscribe(at_a.append)
    running.start()
    until(lambda: a.offline_reason is None and b.offline_reason is None)
    until(lambda: at_a)
    for cache in (a, b):
        assert values(cache) == {"PARAM_0": 0, "PARAM_1": 20, "PARAM_2": 5}
        assert reported(cache, "PARAM_1") == [(10, 1, 10), (20, 10, 20)]
        assert reported(cache, "PARAM_2") == [(5, 2, 5)]
        assert [each.id for each in cache.snapshots(PX4.key)] == [made.id, own.id]
        assert cache.state_at(PX4.key, 1, own.id)["PARAM_1"].value == 20
    assert a.snapshot(PX4.key, 1, reason="after").id in range(made.id + 1, 1 << 50)
    until(lambda: is_copied(a))
    running.kill()
    assert reported(a, "PARAM_1") == [(10, 1, 10), (20, 10, 20)], "the copy has what the database had"
    assert a.offline_reason is not None
    running.start()


def test_a_station_keeps_extended_parameters_and_catches_up(
    fragile: tuple[Server, ParamCache, ParamCache],
) -> None:
    running, a, b = fragile
    a.save_ext([test_ext_tables.learnt(CAM_MODE=1, CAM_NAME="Front", complete=True, count=2)])
    assert b.load_ext(PX4.key, 100) is not None
    until(lambda: is_copied(b))
    running.kill()
    assert test_ext_tables.values_in(b) == {"CAM_MODE": 1, "CAM_NAME": "Front"}
    b.save_ext([test_ext_tables.learnt(CAM_MODE=7, at=NOW + 20, by="us")])
    a.save_ext([test_ext_tables.learnt(CAM_MODE=3, CAM_NAME=b"\xff", at=NOW + 10)])
    at_a: list[CacheChange] = []
    a.subscribe(at_a.append)
    running.start()
    until(lambda: a.offline_reason is None and b.offline_reason is None)
    until(lambda: at_a)
    for cache in (a, b):
        assert test_ext_tables.values_in(cache) == {"CAM_MODE": 7, "CAM_NAME": b"\xff"}
        assert {each.at - NOW for each in cache.ext_history(PX4.key, name="CAM_NAME")} == {10.0}
    until(lambda: is_copied(a))
    running.kill()
    assert test_ext_tables.values_in(a) == {"CAM_MODE": 7, "CAM_NAME": b"\xff"}
    running.start()


def test_a_damaged_table_of_extended_parameters_is_an_error(path: str, cache: ParamCache) -> None:
    cache.save_ext([test_ext_tables.learnt(CAM_MODE=1)])
    with psycopg.connect(path, options="-c search_path=paramclient", autocommit=True) as connection:
        connection.execute("UPDATE ext_param SET raw = '\\x05'")
    with pytest.raises(CacheError, match="extended parameters is not what was written"):
        cache.load_ext(PX4.key, 100)


def is_copied(cache: ParamCache) -> bool:
    """Whether the local copy has what the database has."""
    link = link_of(cache)
    return link.local.revisions() == link._database.revisions()


def link_of(cache: ParamCache) -> _Connection:
    store = cache._store
    assert isinstance(store, SharedStore)
    return store._connection


def test_a_table_that_the_local_copy_cannot_store_is_in_the_database(
    cache: ParamCache, caplog: pytest.LogCaptureFixture
) -> None:
    cache.save(update(stored("A", 1, index=(1 << 31) - 1)))
    assert values(cache) == {"A": 1}
    cache.save(update(stored("B", 2), component=2))
    until(lambda: (PX4.key, 2) in link_of(cache).local.revisions())
    until(lambda: not link_of(cache)._stale_keys)
    assert not is_copied(cache)
    [record] = caplog.records
    assert record.message == (
        "the local copy of the cache is not up to date: the table cannot be stored: 2147483647 is not a valid"
        " index"
    )


def test_writes_left_in_the_outbox_are_sent_by_the_next_program(own_server: Server, tmp_path: Path) -> None:
    with database_on(own_server.url) as url:
        dead = ParamCache(url, local=tmp_path / "a")
        dead.save(whole_table(3))
        own_server.kill()
        for number in range(10, 15):
            dead.save(a_value(number))
        dead.close()
        own_server.start()
        with ParamCache(url, local=tmp_path / "a") as cache:
            assert reported(cache) == [(n, 1 if n == 10 else n - 1, n) for n in range(10, 15)]


def test_killed_under_load_nothing_is_lost_and_nothing_doubled(
    fragile: tuple[Server, ParamCache, ParamCache],
) -> None:
    """Two stations write one after the other, without a pause, while the server is killed twice."""
    running, a, b = fragile
    a.save(whole_table(2))
    b.save(a_value(1, "PARAM_1", at=NOW + 1))
    is_over = threading.Event()
    written = {"PARAM_0": 0, "PARAM_1": 0}

    def write(cache: ParamCache, name: str) -> None:
        while not is_over.is_set():
            number = written[name] + 1
            cache.save(a_value(1_000 + number, name, at=NOW + 10 + number))
            written[name] = number

    with ThreadPoolExecutor(2) as threads:
        work = [threads.submit(write, a, "PARAM_0"), threads.submit(write, b, "PARAM_1")]
        try:
            for _ in range(2):
                before = sum(written.values())
                until(lambda before=before: sum(written.values()) > before + 20)  # type: ignore[misc]  # bound now
                running.kill()
                before = sum(written.values())
                until(lambda before=before: sum(written.values()) > before + 20)  # type: ignore[misc]  # bound now
                running.start()
                until(lambda: a.offline_reason is None and b.offline_reason is None)
        finally:
            is_over.set()
        for each in work:
            each.result()
    until(lambda: a.offline_reason is None and b.offline_reason is None)
    for cache in (a, b):
        for name, count in written.items():
            new_values = [new for _, _, new in reported(cache, name)]
            assert new_values == [1_000 + number for number in range(1, count + 1)]


def test_a_database_that_stands_still_is_given_up(
    fragile: tuple[Server, ParamCache, ParamCache], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its connections stay, and nothing is answered: as on a machine that swaps, or whose disk hangs."""
    running, a, b = fragile
    a.save(whole_table(3))
    b.save(a_value(5))
    until(lambda: is_copied(a))
    running.stand_still()
    try:
        with monkeypatch.context() as impatient:
            impatient.setattr("paramclient.cache.postgres.STATEMENT_TIMEOUT", 0.3)
            impatient.setattr("paramclient.cache.postgres.CONNECT_TIMEOUT", 1)
            a.save(a_value(6))
            assert a.offline_reason is not None
            assert reported(a) == [(5, 1, 5), (6, 5, 6)]
    finally:
        running.go_on()
    until(lambda: a.offline_reason is None)
    assert reported(b) == [(5, 1, 5), (6, 5, 6)]


def test_a_program_that_ends_does_not_wait_for_a_database_that_stands_still(
    fragile: tuple[Server, ParamCache, ParamCache],
) -> None:
    """A service manager would kill it, and what is not in the local copy yet would be lost without a word."""
    running, a, b = fragile
    a.save(whole_table(3))
    b.save(a_value(5))
    until(lambda: is_copied(a))
    running.stand_still()
    try:
        with ThreadPoolExecutor(1) as pool:
            saved = pool.submit(a.save, a_value(6))
            began = time.monotonic()
            with pytest.raises(TimeoutError):
                saved.result(0.5)
            a.limit_lock_waits(0.5)
            saved.result(60)
            a.close()
            assert time.monotonic() - began < STATEMENT_TIMEOUT / 2
    finally:
        running.go_on()
    with ParamCache(b.place, local=a.path) as later:
        assert reported(later) == [(5, 1, 5), (6, 5, 6)]


def test_a_statement_that_takes_too_long_is_ended_by_the_database(
    server_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with database_on(server_url) as url:
        database = PostgresDatabase(DatabaseAddress.parse(url))
        database.open().close()
        with monkeypatch.context() as impatient:  # the database, not the station
            impatient.setattr("paramclient.cache.postgres.STATEMENT_TIMEOUT", 0.5)
            database.open().close()
        try:
            with pytest.raises(Unavailable, match="statement timeout"):
                database.read(lambda session: sleeping(session))
            assert database.revisions() == {}
        finally:
            database.close()


def sleeping(session: Transaction) -> None:
    """Have the database work for longer than any statement may."""
    assert isinstance(session, PostgresTransaction)
    session.connection.execute("SELECT pg_sleep(60)")


def test_a_transaction_takes_no_thread(server_url: str) -> None:
    with database_on(server_url) as url:
        database = PostgresDatabase(DatabaseAddress.parse(url))
        database.open().close()
        try:
            database.revisions()  # the threads of the connections are there from now on
            before = set(threading.enumerate())
            assert database.read(lambda _: set(threading.enumerate())) == before
        finally:
            database.close()


def test_the_local_copy_is_made_anew_for_another_database_of_the_same_name(
    server_url: str, tmp_path: Path
) -> None:
    """A backup of some days ago, or another one's database: the local copy is made anew from it."""
    with database_on(server_url) as one, database_on(server_url) as other:
        for url, first in ((one, 0), (other, 100)):
            with ParamCache(url, local=tmp_path / "copy") as cache:
                cache.save(whole_table(3, first=first))
                until(lambda cache=cache: is_copied(cache))  # type: ignore[misc]  # bound now
        with ParamCache(one, local=tmp_path / "copy") as cache:
            cache.save(a_value(7))
            until(lambda: is_copied(cache))
            assert shown_in_copy(cache) == {"PARAM_0": 0, "PARAM_1": 7, "PARAM_2": 2}


def shown_in_copy(cache: ParamCache) -> Mapping[str, int]:
    store = cache._store
    assert isinstance(store, SharedStore)
    whole = store._connection.local.read(lambda session: take_whole(session, PX4.key, 1))
    assert whole is not None
    return {name: row.bits for name, row in whole.rows.items()}


def test_a_write_that_the_database_refuses_is_logged_and_delays_no_other(
    own_server: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with database_on(own_server.url) as url, ParamCache(url, local=tmp_path / "a") as cache:
        cache.save(whole_table(3))
        own_server.kill()
        cache.save(a_value(10))
        cache.save(a_value(11))
        write = PostgresDatabase.write

        def refuse(self: PostgresDatabase, operations: Any) -> Any:
            saved = [each for each, _, _ in operations if isinstance(each, Save)]
            if any(item.param.value == 10 for each in saved for item in each.updates[0].params):
                raise CacheError("not this one")
            return write(self, operations)

        monkeypatch.setattr(PostgresDatabase, "write", refuse)
        own_server.start()
        until(lambda: cache.offline_reason is None)
        assert reported(cache) == [(11, 1, 11)]
        assert "refuses a write that was queued while it was not connected: not this one" in caplog.text


def test_a_database_that_can_only_be_read_for_a_while_costs_no_line(server_url: str, tmp_path: Path) -> None:
    """As a replica before it takes over, or one whose disk is full."""
    with database_on(server_url) as url, ParamCache(url, local=tmp_path / "a") as cache:
        cache.save(whole_table(3))
        make_read_only(url, True)
        for number in (5, 6):
            cache.save(a_value(number))
        assert values(cache)["PARAM_1"] == 6
        until(lambda: "read-only" in str(cache.offline_reason))
        make_read_only(url, False)
        until(lambda: cache.offline_reason is None)
        assert reported(cache) == [(5, 1, 5), (6, 5, 6)]


def make_read_only(url: str, is_so: bool) -> None:
    """Have every session of a database begin anew, as one that may, or may not, only read."""
    with psycopg.connect(url, autocommit=True) as connection:
        name = connection.info.dbname
        connection.execute("SET default_transaction_read_only = off")
        connection.execute(f"ALTER DATABASE {name} SET default_transaction_read_only = {is_so}".encode())
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
            " WHERE datname = %s AND pid != pg_backend_pid()",
            (name,),
        )


def test_a_write_to_a_locked_vehicle_waits_and_is_not_refused(
    server_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("paramclient.cache.postgres.LOCK_TIMEOUT", "50ms")
    with database_on(server_url) as url, ParamCache(url, local=tmp_path / "a") as cache:
        cache.save(whole_table(3))
        with psycopg.connect(url) as other:
            other.execute("SELECT key FROM paramclient.vehicle FOR UPDATE")
            cache.save(a_value(5))
            assert "has locked a vehicle" in str(cache.offline_reason)
        until(lambda: cache.offline_reason is None)
        assert reported(cache) == [(5, 1, 5)]
        assert "refuses" not in caplog.text


def test_without_room_for_the_local_copy_the_database_is_used_all_the_same(
    server_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A full disk, or a folder that can only be read."""
    with database_on(server_url) as url:
        with ParamCache(url, local=tmp_path / "a") as cache:
            cache.save(whole_table(3))
        with ParamCache(url, local=tmp_path / "a") as a, ParamCache(url, local=tmp_path / "b") as b:
            for each in (a, b):
                assert values(each)["PARAM_1"] == 1
            at_a: list[CacheChange] = []
            a.subscribe(at_a.append)
            with monkeypatch.context() as full:
                full.setattr(LocalCopy, "_write", no_room)
                with ParamCache(url, local=tmp_path / "a") as late:
                    late.save(a_value(5))
                    assert reported(late) == [(5, 1, 5)]
                until(lambda: len(at_a) == 1)
                b.save(a_value(6))
                until(lambda: len(at_a) == 2)
            assert "not up to date: no room" in caplog.text
            b.save(a_value(7))
            until(lambda: len(at_a) == 3)
            assert reported(a) == [(5, 1, 5), (6, 5, 6), (7, 6, 7)]


def no_room(*_: object) -> None:
    raise CacheError("no room")


def test_notifications_of_other_programs_are_ignored(
    path: str, stations: tuple[ParamCache, ParamCache]
) -> None:
    a, b = stations
    at_a: list[CacheChange] = []
    a.subscribe(at_a.append)
    with psycopg.connect(path, autocommit=True) as other:
        for text in ("", "hello", "[1]", "7", '["a", {}, 1, 1]', '{"a": 1}'):
            other.execute("SELECT pg_notify('paramclient', %s)", (text,))
    b.save(whole_table(1))
    until(lambda: at_a)
    assert at_a == [CacheChange(PX4.key, 1)]
    assert a.offline_reason is None


# Places and secrets


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://me:se@cret@nowhere.invalid/d",
        "postgresql://me:se/cret@nowhere.invalid/d",
        "postgresql://me:secret@nowhere.invalid:port/d",
        "postgresql://me:se%zzcret@nowhere.invalid/d",
    ],
)
def test_a_url_that_cannot_be_read_is_not_repeated(url: str) -> None:
    with pytest.raises(UsageError, match="is not valid") as caught:
        ParamCache(url)
    assert "cret" not in "".join(traceback.format_exception(caught.value)[-1:])
    assert caught.value.__cause__ is None


def test_a_password_appears_in_no_text(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    url = f"postgresql://me:geheim%21@/d?host={tmp_path}&application_name=geheim%21"
    with ParamCache(url, local=tmp_path / "a") as cache:
        with pytest.raises(CacheError, match="never reached from this computer") as caught:
            cache.vehicles()
        with pytest.raises(CacheError):
            cache.save(whole_table(1))
        assert "local copy" not in caplog.text, "there is none"
        texts = [repr(cache), cache.place, str(cache.offline_reason), str(cache.notes), caplog.text]
        texts += traceback.format_exception(caught.value)[-1:]
        assert all("geheim" not in text for text in texts)
        assert cache.place == f"postgresql://me@/d?host={tmp_path}"
        assert not cache.path.exists()


def test_one_database_has_one_local_copy_for_every_spelling_of_its_address() -> None:
    def copy_of(url: str) -> Path:
        with ParamCache(url) as cache:
            return cache.path

    assert copy_of("postgresql://a:b@h/d") == copy_of("postgres://c@h:5432/d?sslmode=require")
    assert copy_of("postgresql://a@h/d") != copy_of("postgresql://a@h/e") != copy_of("postgresql://a@g/e")


def test_without_its_libraries_it_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    monkeypatch.setitem(sys.modules, "psycopg.conninfo", None)
    with pytest.raises(UsageError, match=r"pip install 'paramclient\[postgres\]'"):
        ParamCache("postgresql://h/d")


# From one store into another


def test_a_copy_has_everything_and_is_not_made_twice(path: str, cache: ParamCache, tmp_path: Path) -> None:
    with ParamCache(tmp_path / "old") as old, ParamCache(tmp_path / "back") as back:
        fill(old)
        assert old.copy_to(cache) == CopyResult(tables=3, unchanged=0, params=7, lines=4, snapshots=2)
        assert old.copy_to(cache) == CopyResult(tables=0, unchanged=3, params=7, lines=4, snapshots=2)
        assert cache.copy_to(back).tables == 3
        for each in (cache, back):
            assert each.vehicles() == old.vehicles()
            assert each.components() == old.components()
            assert each.snapshots(PX4.key) == old.snapshots(PX4.key)
            assert each.history(PX4.key) == old.history(PX4.key)
            assert each.component(PX4.key) == old.component(PX4.key)
            for when in (NOW + 1, NOW + 4, NOW + 6):
                assert each.state_at(PX4.key, 1, when) == old.state_at(PX4.key, 1, when)
        first = old.snapshots(PX4.key)[0]
        assert cache.state_at(PX4.key, 1, first.id) == old.state_at(PX4.key, 1, first.id)
        with pytest.raises(UsageError, match="to itself"):
            cache.copy_to(cache)


def test_a_copy_that_was_ended_goes_on(cache: ParamCache, tmp_path: Path) -> None:
    def stop(key: str, number: int, count: int) -> None:
        if number == 3:
            raise KeyboardInterrupt

    with ParamCache(tmp_path / "old") as old:
        fill(old)
        with pytest.raises(KeyboardInterrupt):
            old.copy_to(cache, progress=stop)
        assert len(cache.components()) == 2
        assert (old.copy_to(cache).tables, old.copy_to(cache).unchanged) == (1, 3)
        assert cache.history(PX4.key) == old.history(PX4.key)


def test_copy_to_merges_the_tables_of_one_vehicle(cache: ParamCache, tmp_path: Path) -> None:
    with ParamCache(tmp_path / "old") as old:
        for each in (old, cache):
            each.save(whole_table(3))
        old.save([a_value(10), a_value(30, "PARAM_2")])
        old.snapshot(PX4.key, 1, reason="theirs", at=NOW)
        cache.save([a_value(20), a_value(25, "PARAM_0")])
        mine = cache.snapshot(PX4.key, 1, reason="ours", at=NOW)
        for _ in range(2):
            old.copy_to(cache)
            assert values(cache) == {"PARAM_0": 25, "PARAM_1": 20, "PARAM_2": 30}
            assert [at for at, _, _ in reported(cache)] == [10, 20, 25, 30]
            assert sorted(each.reason for each in cache.snapshots(PX4.key)) == ["ours", "theirs"]
            assert cache.state_at(PX4.key, 1, mine.id) == mine.params
        with pytest.raises(CacheError, match="history begins at"):
            cache.state_at(PX4.key, 1, NOW + 15)


def test_a_copy_waits_for_an_unreachable_database(own_server: Server, tmp_path: Path) -> None:
    with (
        database_on(own_server.url) as url,
        ParamCache(tmp_path / "old") as old,
        ParamCache(url, local=tmp_path / "a") as cache,
    ):
        fill(old)
        assert cache.vehicles() == []
        own_server.kill()
        with pytest.raises(CacheError, match=r"repeat the call|copy again"):
            old.copy_to(cache)
        own_server.start()
        until(lambda: cache.offline_reason is None)
        assert old.copy_to(cache).tables == 3


def fill(cache: ParamCache) -> None:
    """Two components of one vehicle and one of another, with history, names that appeared, and snapshots."""
    cache.save([whole_table(3), whole_table(2, component=2)])
    cache.save([whole_table(1, replace(PX4, uid="00ff"))])
    cache.save(a_value(2, "NEW"))
    cache.snapshot(PX4.key, 1, reason="first", at=NOW + 2)
    cache.save([a_value(3), a_value(4), update(at=NOW + 5, removed=["NEW"])])
    cache.save(update(stored("PARAM_0", 9, at=NOW + 5), component=2, at=NOW + 5))
    cache.snapshot(PX4.key, 2, reason="second", at=NOW + 5)
    cache.save(a_value(6, "NEW"))


def test_the_command_copies_and_reads_it(
    path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ParamCache(tmp_path / "old") as old:
        fill(old)
    ran = in_process(capsys)("cache", "copy", tmp_path / "old", path, "--json")
    assert (ran.code, ran.json["tables"], ran.json["lines"]) == (0, 3, 4)
    assert "host=" in ran.json["path"]
    ran = in_process(capsys)("cache", "copy", tmp_path / "old", path)
    assert "copied 0 tables to postgresql://" in ran.out
    assert "3 were there already" in ran.out
    listed = in_process(capsys, "--cache", path)("cache", "list", "--json")
    assert [each["size"] for each in listed.json["components"]] == [4, 2, 1]
    ran = in_process(capsys)("cache", "copy", tmp_path / "none", path)
    assert ran.code == 5
    assert "there is no cache" in ran.err


# What a client makes of it


@in_simulated_time
async def test_values_of_another_station_update_cached_values(tmp_path: Path) -> None:
    """Reported by a cache with a database: see above."""
    vehicle = small_px4()
    cache = ReportingCache(tmp_path / "cache")
    with cache:
        async with ParamClient(vehicle, cache=cache) as client:
            await (await client.component()).fetch_all()
        async with ParamClient(vehicle, cache=cache, policy="cache-only") as client:
            component = await client.component()
            await anyio.sleep(2.0)
            live = await component.get("PARAM_01")
            key = component.identity.key
            received = [
                StoredParam(replace(component.params[name], value=77, bits=77), time.time() + 60.0)
                for name in ("PARAM_01", "PARAM_02")
            ]
            cache.save(
                TableUpdate(
                    identity=component.identity, component=1, autopilot=12, at=time.time(), params=received
                )
            )
            await anyio.to_thread.run_sync(cache.report, CacheChange(key, 1))
            await anyio.sleep(2.0)
            assert component.params["PARAM_02"].value == 77
            assert component.params["PARAM_02"].trust is Trust.CACHED
            assert component.params["PARAM_01"] == live
            assert (await component.get("PARAM_02")).value != 77
        assert not cache.listeners


@in_simulated_time
async def test_values_of_another_station_are_announced_while_the_vehicle_is_silent_here(
    tmp_path: Path,
) -> None:
    """The vehicle has flown out of reach of this station: nothing on the link shows the change."""
    vehicle = Tap(small_px4())
    cache = ReportingCache(tmp_path / "cache")
    with cache:
        async with ParamClient(vehicle, cache=cache) as client:
            component = await client.component()
            await component.fetch_all()
            await anyio.sleep(2.0)
            vehicle.is_mute = True
            await anyio.sleep(30.0)
            assert component.sync_state == "lost"
            changes = component.changes()
            for value in range(77, 82):
                await anyio.sleep(0.7)  # at another moment of what goes on once a second
                received = stored("PARAM_02", value, at=time.time() + value)
                cache.save(update(received, identity=component.identity, at=time.time()))
                await anyio.to_thread.run_sync(cache.report, CacheChange(component.identity.key, 1))
                with anyio.fail_after(0.5):
                    change = await anext(changes)
                assert (change.name, change.new and change.new.value) == ("PARAM_02", value)


@pytest.mark.asyncio
async def test_a_service_shares_it_too(
    path: str, cache: ParamCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    async with served("sim:px4", "--cache", path):
        with anyio.fail_after(TIMEOUT):
            while not await anyio.to_thread.run_sync(cache.components):  # noqa: ASYNC110 - it is in a database
                await anyio.sleep(0.05)


class ReportingCache(ParamCache):
    """A cache in a file, with reports of changes by other stations."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.listeners: list[Callable[[CacheChange], None]] = []

    def subscribe(self, reported: Callable[[CacheChange], None]) -> Callable[[], None]:
        self.listeners.append(reported)
        return lambda: self.listeners.remove(reported)

    def report(self, change: CacheChange) -> None:
        for listener in self.listeners:
            listener(change)


@pytest.mark.asyncio
async def test_an_apply_whose_process_is_killed_is_reported_with_a_shared_database_too(
    server_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The notes stand beside the copy on this computer: they are about what it has begun."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with database_on(server_url) as url:
        await reported_after_a_kill(url)
    assert len([*tmp_path.rglob("*.setups")]) == 1  # noqa: ASYNC240 - nothing runs beside


def test_a_write_that_an_earlier_version_has_queued_is_executed() -> None:
    described = [1, "udp", None, 12, 0, 0, "", 0, 0, 0, 0]
    items = [["A", 4, 65531, 0, 3, 7, NOW, True, "us"], ["B", 6, 2, 0, None, None, int(NOW), None, "vehicle"]]
    reported = ["save", [[described, 1, 12, NOW, None, items, [], False, {}, None]]]
    operation = unpacked(zlib.compress(json.dumps(reported).encode()))
    expected = [
        StoredParam(Param("A", -5, ParamType.INT16, 3, 0xFFFB, default=7), NOW, True, "us"),
        StoredParam(Param("B", 2, ParamType.INT32, None, 2), NOW),
    ]
    assert isinstance(operation, Save)
    assert repr(operation.updates[0].params) == repr(expected), "types of the cells too"
    again = unpacked(packed(operation))
    assert isinstance(again, Save)
    assert repr(again.updates[0].params) == repr(expected)


def test_a_queued_write_with_a_value_that_is_none_is_damaged() -> None:
    described = [1, "udp", None, 12, 0, 0, "", 0, 0, 0, 0]
    reported = ["save", [[described, 1, 12, NOW, None, [["A", 300, *(0,) * 7]], [], False]]]
    with pytest.raises(Damaged):
        unpacked(zlib.compress(json.dumps(reported).encode()))
