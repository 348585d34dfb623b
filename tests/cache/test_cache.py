"""The cache as its callers see it: what is kept, the history of it, and a model that it must equal."""

from __future__ import annotations

import os
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from paramclient.cache import (
    BY_US,
    BY_VEHICLE,
    CachedVehicle,
    HistoryEntry,
    ParamCache,
    StoredParam,
    TableState,
    by_station,
    default_path,
    history_columns,
)
from paramclient.cache.transaction import Transaction
from paramclient.errors import AmbiguousVehicle, CacheError, UnknownVehicle, UsageError
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType, Trust, same_bits
from tests.caches import CACHE_ALONE, NOW, PX4, set_aside, start, stored, update, values, whole_table

PLAIN = Identity(system=1, link="udpin:0.0.0.0:14550", autopilot=3)
REAL32, REAL64 = ParamType.REAL32, ParamType.REAL64


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made" / "parameters.sqlite3"


# What is kept


def test_a_table_is_restored_unchanged_in_the_next_session(path: Path) -> None:
    state = TableState(0xFFFFFFFF, 4, complete=True, volatile_known=True, synced_at=NOW + 1)
    with ParamCache(path) as cache:
        cache.save(
            update(
                stored("SECOND", 7, index=1),
                stored("FIRST", 0x3F800000, REAL32, index=0, volatile=True, at=NOW - 5),
                stored("NO_INDEX", 1),
                stored("ALSO_NONE", 2),
                table=state,
            )
        )
    with ParamCache(path) as cache:
        table = cache.load(PX4.key, 1)
    assert table is not None
    assert table.key == PX4.key
    assert table.identity == PX4
    assert (table.system, table.component, table.autopilot, table.size) == (1, 1, 12, 4)
    assert (table.hash, table.count, table.complete, table.volatile_known, table.synced_at) == (
        state.hash, state.count, state.complete, state.volatile_known, state.synced_at,
    )  # fmt: skip
    assert table.updated_at == NOW
    assert list(table.params) == ["FIRST", "SECOND", "ALSO_NONE", "NO_INDEX"]
    assert table.params["FIRST"].value == 1.0
    assert {param.trust for param in table.params.values()} == {Trust.CACHED}
    assert table.volatile == {"FIRST"}
    assert (table.heard_at["FIRST"], table.heard_at["SECOND"]) == (NOW - 5, NOW)
    with pytest.raises(TypeError):
        table.heard_at["FIRST"] = 0  # type: ignore[index]  # that it is refused is the point


EDGES = [
    (ParamType.UINT8, 255),
    (ParamType.INT8, 0x80),
    (ParamType.UINT32, 0xFFFFFFFF),
    (ParamType.INT32, 0xFFB3B4C0),  # as a float32 this is a signalling NaN
    (ParamType.UINT64, 0),
    (ParamType.UINT64, (1 << 63) - 1),
    (ParamType.UINT64, 1 << 63),
    (ParamType.UINT64, (1 << 64) - 1),
    (ParamType.INT64, 1 << 63),
    (ParamType.INT64, (1 << 64) - 1),
    (REAL32, 0x7FA00001),
    (REAL64, 0xFFF0000000000001),
    (REAL64, 1 << 63),
    (0, 5),
    (77, 0xFFFFFFFF),
    (255, 1),
]


def test_every_type_keeps_its_bits_to_the_last_one(path: Path) -> None:
    params = [stored(f"P{number}", bits, kind) for number, (kind, bits) in enumerate(EDGES)]
    params.append(stored("RAW_64", 0xFFFFFFFF, ParamType.INT64, is_raw=True))
    params.append(stored("RAW_8", 0x7FC00000, ParamType.UINT8, is_raw=True))
    params.append(stored("~^1!\"$%'()*+-.Az", 1))
    with ParamCache(path) as cache:
        cache.save(update(*params))
        table = cache.load(PX4.key, 1)
    assert table is not None
    for item in params:
        found = table.params[item.param.name]
        assert found == item.param.with_trust(Trust.CACHED)
        assert type(found.type) is type(item.param.type)
        assert (found.is_raw, repr(found.value)) == (item.param.is_raw, repr(item.param.value))


def test_two_vehicles_with_one_system_id_keep_two_tables(path: Path) -> None:
    other = replace(PX4, uid="ffff")
    elsewhere = replace(PLAIN, link="tcp:127.0.0.1:5760")
    with ParamCache(path) as cache:
        for value, identity in enumerate((PX4, other, PLAIN, elsewhere)):
            cache.save(update(stored("A", value), identity=identity))
        cache.save(update(stored("A", 9), component=154))
        assert [values(cache, each)["A"] for each in (PX4, other, PLAIN, elsewhere)] == [0, 1, 2, 3]
        assert values(cache, component=154) == {"A": 9}
        assert cache.load(PX4.key, 2) is None
        assert cache.load("uid:00", 1) is None


def test_a_known_vehicle_is_known_again_under_another_system_id_and_link(path: Path) -> None:
    changed = replace(PX4, system=7, link="serial:/dev/ttyACM0:57600", firmware=1)
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1)))
        cache.save(update(identity=changed, at=NOW + 60))
        assert cache.vehicles() == [CachedVehicle(PX4.key, changed, NOW, NOW + 60, (1,))]
        assert values(cache) == {"A": 1}


def test_an_update_leaves_what_it_does_not_name(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(
            update(stored("A", 1, index=4, volatile=True), stored("B", 2, index=5), table=TableState(1, 2))
        )
        cache.save(update(stored("A", 3), autopilot=8))
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert (table.params["A"].index, table.volatile, table.autopilot) == (4, frozenset("A"), 8)
        assert (table.hash, table.count) == (1, 2)
        cache.save(update(stored("A", 3, index=6, volatile=False)))
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert (table.params["A"].index, len(table.volatile)) == (6, 0)


def test_a_whole_table_replaces_the_old_one_and_names_can_be_removed(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1, index=0, volatile=True), stored("B", 2, index=1), stored("C", 3)))
        cache.save(update(stored("A", 1), stored("D", 4), replace=True))
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert set(table.params) == {"A", "D"}
        assert (table.params["A"].index, table.volatile) == (None, frozenset("A"))
        cache.save(update(stored("D", 5), removed=["A", "D", "NEVER_THERE", "A"]))
        assert values(cache) == {"D": 5}
        assert [(entry.name, entry.new is None) for entry in cache.history(PX4.key)] == [
            ("B", True), ("C", True), ("A", True), ("D", False),
        ]  # fmt: skip


def test_all_updates_of_a_call_are_written_or_none(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save([update(stored("A", 1)), update(stored("A", 2), component=2)])
        with pytest.raises(UsageError, match="unix seconds"):
            cache.save([update(stored("A", 3)), update(stored("A", 4), component=2, at=float("nan"))])
        assert (values(cache), values(cache, component=2)) == ({"A": 1}, {"A": 2})


@pytest.mark.parametrize("at", [-1.0, float("nan"), float("inf"), 1e12])
def test_an_update_with_an_invalid_time_is_refused(path: Path, at: float) -> None:
    with ParamCache(path) as cache:
        for bad in (update(at=at), update(stored("A", 1, at=at)), update(table=TableState(synced_at=at))):
            with pytest.raises(UsageError):
                cache.save(bad)
        assert cache.vehicles() == []


def test_to_save_nothing_creates_nothing(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save([])
    assert not path.parent.exists()


# The hash


COVERED = update(
    stored("A", 1, index=0),
    stored("VOLATILE", 1, index=1, volatile=True),
    stored("UNUSED", 1),
    stored("ZERO", 0, REAL32, index=2),
    table=TableState(0xABC, 3, complete=True, volatile_known=True, synced_at=NOW),
)


@pytest.mark.parametrize(
    ("change", "keeps"),
    [
        (update(), True),
        (update(stored("A", 1, at=NOW + 9)), True),
        (update(stored("VOLATILE", 2)), True),
        (update(stored("UNUSED", 2)), True),
        (update(stored("NEW", 2)), True),
        (update(removed=["UNUSED", "VOLATILE"]), True),
        (update(stored("A", 1, volatile=True)), False),
        (update(stored("A", 2)), False),
        (update(stored("A", 1, ParamType.UINT32)), False),
        (update(stored("ZERO", 0x80000000, REAL32)), False),
        (update(stored("A", 2), stored("A", 1)), True),
        (update(stored("NEW", 2, index=3)), False),
        (update(stored("UNUSED", 1, index=3)), False),
        (update(stored("VOLATILE", 1, volatile=False)), False),
        (update(removed=["A"]), False),
        (update(stored("A", 1, index=0), replace=True), False),
    ],
)
def test_a_change_of_what_the_hash_covers_removes_the_hash(path: Path, change: Any, keeps: bool) -> None:
    with ParamCache(path) as cache:
        cache.save(COVERED)
        cache.save(change)
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert table.hash == (0xABC if keeps else None)
        assert (table.count, table.complete, table.volatile_known, table.synced_at) == (3, True, True, NOW)
        cache.save(replace(change, table=TableState(0xDEF, 7)))
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert (table.hash, table.count, table.complete, table.synced_at) == (0xDEF, 7, False, None)


# History


def test_each_change_of_a_value_leaves_a_line_and_nothing_else_does(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), stored("F", 0, REAL32), stored("N", 0x7FC00000, REAL32)))
        cache.save(
            update(
                stored("A", 1, at=NOW + 1), stored("F", 0x80000000, REAL32), stored("N", 0x7FC00000, REAL32)
            )
        )
        assert cache.history(PX4.key) == []
        cache.save(
            update(
                stored("A", 2, at=NOW + 2, by=BY_US),
                stored("A", 3, at=NOW + 3, by=by_station(254, 190)),
                stored("N", 0x7FC00001, REAL32, at=NOW + 4),
            )
        )
        cache.save(update(stored("A", 3, ParamType.UINT32, at=NOW + 5), stored("NEW", 1)))
        cache.save(update(removed=["A"], at=NOW + 6))
        lines = cache.history(PX4.key)
        table = cache.load(PX4.key, 1)
    assert [(line.at - NOW, line.component, line.name, line.by) for line in lines] == [
        (2, 1, "A", "us"),
        (3, 1, "A", "station 254/190"),
        (4, 1, "N", "vehicle"),
        (5, 1, "A", "vehicle"),
        (6, 1, "A", "vehicle"),
    ]
    a = [line for line in lines if line.name == "A"]
    assert [(line.old.value, line.new and line.new.value) for line in a] == [
        (1, 2),
        (2, 3),
        (3, 3),
        (3, None),
    ]
    assert (a[2].old.type, a[2].new and a[2].new.type) == (ParamType.INT32, ParamType.UINT32)
    assert table is not None
    assert table.params["F"].bits == 0x80000000


def test_history_can_be_requested_by_component_name_and_number(path: Path) -> None:
    with ParamCache(path) as cache:
        for value in range(4):
            cache.save(
                [update(stored("A", value), stored("B", value)), update(stored("A", value), component=2)]
            )
        assert len(cache.history(PX4.key)) == 9
        assert [line.component for line in cache.history(PX4.uid or "", component=2)] == [2, 2, 2]
        assert [line.name for line in cache.history(PX4.key, 1, "B")] == ["B"] * 3
        newest = cache.history(PX4.key, component=1, name="A", limit=2)
        assert [line.old.value for line in newest] == [1, 2]
        table = cache.component()
        assert table.history("A", 2) == newest
        assert table.history(limit=0) == []
        assert len(table.history()) == 6


def test_history_is_bounded_for_each_table(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_columns, "HISTORY_ENTRIES_MAX", 5)
    with ParamCache(path) as cache:
        cache.save(update(*(stored("A", value) for value in range(3))))
        for component in (2, 3):
            cache.save(update(*(stored("A", value) for value in range(9)), component=component))
        assert len(cache.history(PX4.key, 1)) == 2
        assert [line.old.value for line in cache.history(PX4.key, 2)] == [3, 4, 5, 6, 7]
        assert len(cache.history(PX4.key, 3)) == 5


def test_a_change_that_two_programs_hear_leaves_one_line(path: Path) -> None:
    with ParamCache(path) as ours, ParamCache(path) as theirs:
        ours.save(update(stored("A", 1)))
        theirs.save(update(stored("A", 2, by=BY_US)))
        ours.save(update(stored("A", 2)))
        assert [line.by for line in ours.history(PX4.key)] == [BY_US]


# Finding


@pytest.fixture
def three(path: Path) -> ParamCache:
    """PX4 with components 1 and 154, another vehicle with the same system id, one without a hardware id."""
    cache = ParamCache(path)
    cache.save([whole_table(3), update(stored("A", 1), component=154, autopilot=8, at=NOW + 3)])
    cache.save(whole_table(2, replace(PX4, uid="0003ab")))
    cache.save(update(identity=replace(PLAIN, system=2), table=TableState(count=900), at=NOW + 1))
    return cache


def test_vehicles_and_components_are_listed_the_last_seen_first(three: ParamCache) -> None:
    with three as cache:
        assert [(vehicle.key, vehicle.components) for vehicle in cache.vehicles()] == [
            (PX4.key, (1, 154)),
            ("system:2@udpin:0.0.0.0:14550", (1,)),
            ("uid:0003ab", (1,)),
        ]
        assert (cache.vehicles()[0].first_seen, cache.vehicles()[0].last_seen) == (NOW, NOW + 3)
        assert [repr(summary) for summary in cache.components()] == [
            "<CachedSummary 1/1 px4 3 params synced 2026-11-18 11:06Z>",
            "<CachedSummary 1/154 no autopilot 1 params not synced>",
            "<CachedSummary 2/1 px4 0 of 900 params not synced>",
            "<CachedSummary 1/1 px4 2 params synced 2026-11-18 11:06Z>",
        ]
        assert [summary.component for summary in cache.components(PX4.key)] == [1, 154]
        assert [summary.size for summary in cache.components("uid:0003AB")] == [2]


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ({"vehicle": PX4.key}, PX4.key),
        ({"vehicle": "uid:000200"}, PX4.key),
        ({"vehicle": PX4.key.removeprefix("uid:").upper()}, PX4.key),
        ({"vehicle": "2"}, "system:2@udpin:0.0.0.0:14550"),
        ({"vehicle": "1", "component": 154}, PX4.key),
        ({"vehicle": "uid:0003AB"}, "uid:0003ab"),
        ({"system": 2}, "system:2@udpin:0.0.0.0:14550"),
        ({"vehicle": "system:2@udpin:0.0.0.0:14550"}, "system:2@udpin:0.0.0.0:14550"),
        ({"component": 154}, PX4.key),
        ({"vehicle": "0003ab", "system": 1}, "uid:0003ab"),
    ],
)
def test_a_table_is_found_by_key_hardware_id_or_system(
    three: ParamCache, wanted: dict[str, Any], found: str
) -> None:
    with three as cache:
        table = cache.component(**wanted)
        assert (table.key, table.component) == (found, wanted.get("component", 1))
        assert table.size == len(table.params)


def test_an_exact_key_is_preferred_to_the_beginning_of_another(path: Path) -> None:
    with ParamCache(path) as cache:
        for uid in ("abcdef01", "abcdef0123"):
            cache.save(update(identity=replace(PX4, uid=uid)))
        assert cache.component("uid:abcdef01").key == "uid:abcdef01"
        assert cache.component("ABCDEF01").key == "uid:abcdef01"
        with pytest.raises(AmbiguousVehicle, match="vehicle uid:abcdef, component 1 fits 2 vehicles"):
            cache.component("uid:abcdef")


@pytest.mark.parametrize(
    ("wanted", "text"),
    [
        (
            {},
            r"component 1 fits 3 vehicles .*:\n  uid:0002.*\n  system:2@.*\n  uid:0003ab \(.*components 1, ",
        ),
        (
            {"system": 1},
            r"system 1, component 1 fits 2 vehicles .*:\n  uid:0002.*components 1, 154, .*\)\n  uid:0003",
        ),
        ({"vehicle": "1"}, "vehicle 1, component 1 fits 2 vehicles"),
        (
            {"vehicle": "beef"},
            r"vehicle beef, component 1 is not in the cache .* holds 3 vehicles:\n  uid:0002.*\n  system:2",
        ),
        ({"system": 9}, "system 9, component 1 is not in the cache"),
        ({"component": 7}, "component 7 is not in the cache"),
    ],
)
def test_an_unknown_or_ambiguous_vehicle_is_an_error_that_lists_the_vehicles(
    three: ParamCache, wanted: dict[str, Any], text: str
) -> None:
    with three as cache, pytest.raises((UnknownVehicle, AmbiguousVehicle), match=text) as caught:
        cache.component(**wanted)
    error = caught.value
    assert isinstance(error, UnknownVehicle | AmbiguousVehicle)
    assert all(each in str(error) for each in error.vehicles)
    assert len(error.vehicles) == (2 if "fits 2" in text else 3)


def test_lists_of_a_vehicle_that_is_not_there_are_errors_too(three: ParamCache) -> None:
    with three as cache:
        for ask in (cache.components, cache.history, cache.remove):
            with pytest.raises(UnknownVehicle, match="vehicle beef is not in the cache"):
                ask("beef")


def test_tables_and_vehicles_are_removed_with_their_history(three: ParamCache) -> None:
    with three as cache:
        cache.save(update(stored("A", 2), component=154))
        table = cache.component(component=154)
        assert len(table.history()) == 1
        assert cache.remove(PX4.key, 99) == 0
        assert cache.remove("uid:000200", 154) == 1
        assert table.history() == []
        assert (cache.load(PX4.key, 154), cache.history(PX4.key)) == (None, [])
        assert len(values(cache)) == 3
        assert cache.remove(PX4.key) == 1
        assert [vehicle.key for vehicle in cache.vehicles()] == ["system:2@udpin:0.0.0.0:14550", "uid:0003ab"]
        cache.save(update(stored("A", 3), component=154))
        assert cache.history(PX4.key) == []


def test_reprs_show_the_state(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(903))
        assert repr(cache.component()) == "<CachedComponent 1/1 px4 903 params synced 2026-11-18 11:06Z>"
        assert repr(cache.component().params) == "<ParamMap 903 params>"
        assert repr(cache) == f"<ParamCache {path}>"


# Life


def test_without_a_file_there_is_nothing_and_to_look_creates_nothing(path: Path) -> None:
    with ParamCache(path) as cache:
        assert (cache.vehicles(), cache.components(), cache.load(PX4.key, 1)) == ([], [], None)
        with pytest.raises(UnknownVehicle, match=r"component 1 is not in the cache .* holds no vehicle\."):
            cache.component()
        with pytest.raises(UnknownVehicle, match="holds no vehicle"):
            cache.remove(PX4.key)
    assert not path.parent.exists()


def test_a_table_outlives_its_link_but_a_closed_cache_answers_no_more(path: Path) -> None:
    cache = ParamCache(path)
    cache.save(whole_table(2))
    table = cache.component()
    cache.close()
    cache.close()
    assert len(table.params) == 2
    for ask in (table.history, cache.vehicles, lambda: cache.save(update())):
        with pytest.raises(CacheError, match="is closed"):
            ask()


def test_a_cache_that_is_deleted_closes_its_file(path: Path) -> None:
    ParamCache(path).save(whole_table(2))
    table = ParamCache(path).component()
    assert table.history() == []
    del table
    assert [file.name for file in path.parent.iterdir()] == [path.name], "-wal and -shm go with the last one"


def test_threads_may_share_a_cache(path: Path) -> None:
    with ParamCache(path) as cache, ThreadPoolExecutor(8) as threads:
        starting = threading.Barrier(8)

        def work(component: int) -> int:
            starting.wait()
            for value in range(20):
                cache.save(update(stored("A", value), component=component))
                assert values(cache, component=component) == {"A": value}
            return len(cache.history(PX4.key, component))

        assert list(threads.map(work, range(1, 9))) == [19] * 8


def test_folder_and_file_are_for_the_user_alone(path: Path) -> None:
    before = os.umask(0o022)
    try:
        with ParamCache(path) as cache:
            cache.save(update())
            assert {file.stat().st_mode & 0o777 for file in path.parent.iterdir()} == {0o600}
    finally:
        os.umask(before)
    assert path.parent.stat().st_mode & 0o777 == 0o700


def test_the_default_path_is_in_the_users_cache_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert ParamCache().path == default_path() == tmp_path / "paramclient" / "parameters.sqlite3"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("real file%20?x#y")
    with ParamCache("link") as cache:
        cache.save(update())
        assert cache.path == tmp_path / "real file%20?x#y"
        assert cache.path.exists()


def test_to_import_it_takes_no_other_library() -> None:
    with start(f"{CACHE_ALONE}; print(*sys.modules)") as program:
        loaded = program.communicate()[0].split()
    assert "paramclient.cache.store" in loaded
    assert not {"pydantic", "pymavlink", "anyio", "asyncio"} & set(loaded)


# Observations that arrive late


def lines_of(cache: ParamCache) -> list[tuple[float, str, Any, Any]]:
    """The history: seconds after NOW, name, old and new value."""
    return [
        (line.at - NOW, line.name, line.old.value, line.new and line.new.value)
        for line in cache.history(PX4.key)
    ]


def test_an_older_observation_never_replaces_a_newer_one(path: Path) -> None:
    with ParamCache(path) as one, ParamCache(path) as other:
        one.save(whole_table(2, first=200))
        other.save(update(stored("PARAM_0", 19, at=NOW + 2), at=NOW + 2.2))
        late = [stored("PARAM_0", 200, at=NOW + 0.5), stored("PARAM_0", 17, at=NOW + 1, by=BY_US)]
        one.save(update(*late, at=NOW + 2.4))
        assert values(other) == {"PARAM_0": 19, "PARAM_1": 201}
        assert lines_of(one) == [(1, "PARAM_0", 200, 17), (2, "PARAM_0", 17, 19)]
        one.save(update(stored("PARAM_0", 19, at=NOW + 2.1), at=NOW + 2.6))
        assert len(lines_of(one)) == 2, "it was reported already"


def test_an_observation_older_than_a_whole_table_keeps_it_complete(path: Path) -> None:
    """And what was observed after a part of it stays."""
    with ParamCache(path) as one, ParamCache(path) as other:
        one.save(whole_table(2))
        other.save(update(stored("PARAM_0", 19, at=NOW + 3), at=NOW + 3))
        whole = [stored("PARAM_0", 17, index=0, at=NOW + 1), stored("PARAM_1", 5, index=1, at=NOW + 2)]
        state = TableState(7, 2, complete=True, synced_at=NOW + 2.5)
        one.save(update(*whole, at=NOW + 4, replace=True, whole_at=NOW + 2.5, table=state))
        table = one.load(PX4.key, 1)
        assert table is not None
        assert values(one) == {"PARAM_0": 19, "PARAM_1": 5}
        assert (table.complete, table.hash) == (True, None), "the hash is of another value"
        assert lines_of(one) == [
            (1, "PARAM_0", 0, 17),
            (2, "PARAM_1", 1, 5),
            (3, "PARAM_0", 17, 19),
        ]


@pytest.mark.parametrize("is_first", [True, False])
def test_an_unlisted_value_from_before_a_whole_table_goes_with_it(path: Path, is_first: bool) -> None:
    """In either order of writing, and the whole table keeps its state and its hash."""
    unlisted = update(stored("HIDDEN", 1, at=NOW + 1), at=NOW + 3)
    state = TableState(7, 1, complete=True, synced_at=NOW + 2)
    whole = [stored("PARAM_0", 0, index=0, at=NOW + 2), stored("HIDDEN_TOO", 2, at=NOW + 1)]
    listed = update(*whole, at=NOW + 2, replace=True, whole_at=NOW + 2, table=state)
    with ParamCache(path) as one, ParamCache(path) as other:
        one.save(whole_table(1))
        for each in (unlisted, listed) if is_first else (listed, unlisted):
            other.save(each)
        assert values(one) == {"PARAM_0": 0, "HIDDEN_TOO": 2}
        later = TableState(8, 1, complete=True, synced_at=NOW + 4)
        params = [stored("PARAM_0", 5, index=0, at=NOW + 4), stored("HIDDEN", 1, at=NOW + 1)]
        one.save(update(*params, at=NOW + 4, replace=True, whole_at=NOW + 4, table=later))
        table = one.load(PX4.key, 1)
        assert table is not None
        assert (values(one)["PARAM_0"], table.hash, table.complete) == (5, 8, True)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_value_that_was_read_by_name_has_the_index_of_the_whole_table(path: Path, is_first: bool) -> None:
    """In either order of writing: a response to a read by name may have no index."""
    read = update(stored("PARAM_0", 19, at=NOW + 3), at=NOW + 3)
    state = TableState(7, 1, complete=True, synced_at=NOW + 2)
    whole = [stored("PARAM_0", 17, index=0, at=NOW + 2)]
    listed = update(*whole, at=NOW + 4, replace=True, whole_at=NOW + 2, table=state)
    with ParamCache(path) as one, ParamCache(path) as other:
        for each in (read, listed) if is_first else (listed, read):
            one.save(each)
        table = other.load(PX4.key, 1)
        assert table is not None
        assert (table.params["PARAM_0"].value, table.params["PARAM_0"].index) == (19, 0)


def test_a_name_that_was_found_missing_before_it_was_heard_is_not_gone(path: Path) -> None:
    with ParamCache(path) as one, ParamCache(path) as other:
        one.save(whole_table(3))
        other.save(update(stored("PARAM_0", 0, at=NOW + 3), at=NOW + 3))
        gone = {"PARAM_0": NOW + 2, "PARAM_1": NOW + 2.5}
        one.save(update(removed=list(gone), removed_at=gone, at=NOW + 4))
        assert values(one).keys() == {"PARAM_0", "PARAM_2"}
        assert lines_of(one) == [(2.5, "PARAM_1", 1, None)]
        other.save(update(stored("PARAM_1", 1, at=NOW + 2.2), at=NOW + 5))
        assert values(one).keys() == {"PARAM_0", "PARAM_2"}
        other.save(update(stored("PARAM_3", 3, at=NOW + 4.5), at=NOW + 5))
        whole = [stored("PARAM_0", 0, index=0, at=NOW + 4)]
        one.save(update(*whole, replace=True, whole_at=NOW + 4, at=NOW + 6))
        assert values(one).keys() == {"PARAM_0", "PARAM_3"}, "it appeared after the whole table"


@pytest.mark.parametrize("seen_before", [True, False])
def test_a_late_observation_of_a_name_that_was_removed_and_added_is_no_change_of_its_earlier_value(
    path: Path, seen_before: bool
) -> None:
    with ParamCache(path) as one, ParamCache(path) as other:
        one.save(whole_table(2))
        one.save(update(removed=["PARAM_0"], removed_at={"PARAM_0": NOW + 1}, at=NOW + 1))
        late = update(stored("PARAM_0", 5, at=NOW + 2), at=NOW + 6)
        if seen_before:
            other.save(late)
        one.save(update(stored("PARAM_0", 7, index=0, at=NOW + 3), at=NOW + 3))
        if not seen_before:
            other.save(late)
        assert lines_of(one) == [(1, "PARAM_0", 0, None), (3, "PARAM_0", 5, 7)]
        one.save(update(stored("PARAM_0", 8, index=0, at=NOW + 7), at=NOW + 7))
        other.save(update(stored("PARAM_0", 6, at=NOW + 2.5), at=NOW + 8))
        reported = [(at, new) for at, _, _, new in lines_of(one)]
        assert {(1, None), (3, 7), (7, 8)} <= set(reported), "each was so at its time"
        assert values(one) == {"PARAM_0": 8, "PARAM_1": 1}


def test_a_part_that_a_fresh_file_has_of_a_whole_table_takes_the_rest(path: Path) -> None:
    with ParamCache(path) as cache:
        state = TableState(7, 2, complete=True, synced_at=NOW + 3)
        cache.save(update(stored("PARAM_1", 1, index=1, at=NOW + 3), table=state, at=NOW + 3))
        cache.save(update(stored("PARAM_0", 0, index=0, at=NOW + 1), at=NOW + 4))
        assert values(cache) == {"PARAM_0": 0, "PARAM_1": 1}


def test_a_clock_that_was_set_back_is_distinguished_from_a_program_that_is_late(path: Path) -> None:
    """In a file, where one clock counts: by the present at which the late one comes to write."""
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), at=NOW))
        cache.save(update(stored("A", 2, at=NOW + 600), at=NOW + 600))
        cache.save(update(stored("A", 3, at=NOW + 5), at=NOW + 6), clock=lambda: NOW + 601.0)
        assert values(cache) == {"A": 2}
        assert [line[0] for line in lines_of(cache)] == [5, 600]
        cache.save(update(stored("A", 4, at=NOW + 7), at=NOW + 8), clock=lambda: NOW + 9.0)
        cache.save(update(stored("A", 5, at=NOW + 11), at=NOW + 12), clock=lambda: NOW + 13.0)
        assert values(cache) == {"A": 5}
        assert [line[2:] for line in lines_of(cache)] == [(1, 3), (3, 2), (2, 4), (4, 5)]
        cache.save(update(stored("A", 9, at=NOW + 10), at=NOW + 14), clock=lambda: NOW + 14.0)
        assert [line[3] for line in lines_of(cache)] == [3, 2, 4, 9, 5], "also among what arrived since"


# The model


class Model:
    """One table, kept in a plain dictionary."""

    def __init__(self) -> None:
        self.params: dict[str, StoredParam] = {}
        self.state = TableState()
        self.lines: list[tuple[str, int, int | None, str]] = []

    def covered(self) -> dict[str, tuple[int, int]]:
        return {
            name: (item.param.type, item.param.bits)
            for name, item in self.params.items()
            if item.param.index is not None and not item.volatile
        }

    def by_index(self) -> list[str]:
        index = {name: item.param.index for name, item in self.params.items()}
        return sorted(index, key=lambda name: (index[name] is None, index[name] or 0, name))

    def apply(
        self, params: list[StoredParam], removed: list[str], whole: bool, state: TableState | None
    ) -> None:
        covered = self.covered()
        named = {item.param.name for item in params}
        gone = {
            name: self.params.pop(name)
            for name in (self.by_index() if whole else removed)
            if name in self.params and name not in named
        }
        for item in params:
            name, param = item.param.name, item.param
            old = self.params.get(name)
            if old is not None:
                if param.index is None and not whole:
                    param = replace(param, index=old.param.index)
                if not (old.param.type == param.type and same_bits(param.type, old.param.bits, param.bits)):
                    self.lines.append((name, old.param.bits, param.bits, item.by))
            volatile = bool(old and old.volatile if item.volatile is None else item.volatile)
            self.params[name] = StoredParam(param, item.heard_at, volatile, item.by)
        self.lines += [(name, item.param.bits, None, BY_VEHICLE) for name, item in gone.items()]
        is_less = state is not None and not state.complete and self.state.complete and not whole
        counts: tuple[int | None, ...] = (self.state.count,) if params else (self.state.count, None)
        if is_less and state is not None and state.count in counts:
            state = None  # a program that knows less of a table removes nothing from it
        if state is not None:
            self.state = state
        elif covered != self.covered():
            self.state = replace(self.state, hash=None)


NAMES = st.sampled_from("ABCD")
PARAMS = st.builds(
    stored,
    NAMES,
    st.sampled_from([0, 1, 2, 0x80000000, 0xFFFFFFFF]),
    st.sampled_from([ParamType.UINT32, ParamType.INT32, REAL32, 99]),
    index=st.one_of(st.none(), st.integers(0, 3)),
    at=st.floats(0.0, 0.9),
    volatile=st.sampled_from([None, True, False]),
    by=st.sampled_from([BY_US, BY_VEHICLE, by_station(1, 2)]),
)
STATES = st.builds(
    TableState,
    hash=st.one_of(st.none(), st.integers(0, 0xFFFFFFFF)),
    count=st.one_of(st.none(), st.integers(0, 65535)),
    complete=st.booleans(),
    volatile_known=st.booleans(),
    synced_at=st.one_of(st.none(), st.floats(0, NOW)),
)
TABLES = st.sampled_from([(PX4, 1), (PX4, 154), (PLAIN, 1)])


class CacheMachine(RuleBasedStateMachine):
    """Two caches on one file, and the dictionary that both must equal after every step."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name) / "cache"
        self.caches = [ParamCache(self.path), ParamCache(self.path)]
        self.model: dict[tuple[Identity, int], Model] = {}
        self.now = NOW

    def teardown(self) -> None:
        for cache in self.caches:
            cache.close()
        self.folder.cleanup()

    @rule(
        by=st.integers(0, 1),
        updates=st.lists(
            st.tuples(
                TABLES,
                st.lists(PARAMS, max_size=4),
                st.lists(NAMES, max_size=2),
                st.booleans(),
                st.one_of(st.none(), STATES),
            ),
            min_size=1,
            max_size=2,
        ),
    )
    def save(self, by: int, updates: list[Any]) -> None:
        batch = []
        for (identity, component), drawn, removed, whole, state in updates:
            params = [item._replace(heard_at=self.now + item.heard_at) for item in drawn]
            params.sort(key=lambda item: item.heard_at)
            self.now += 1.0
            batch.append(
                update(
                    *params,
                    identity=identity,
                    component=component,
                    at=self.now,
                    removed=removed,
                    replace=whole,
                    table=state,
                )
            )
            model = self.model.setdefault((identity, component), Model())
            model.apply(params, removed, whole, state)
        self.caches[by].save(batch)

    @rule(by=st.integers(0, 1))
    def reopen(self, by: int) -> None:
        self.caches[by].close()
        self.caches[by] = ParamCache(self.path)

    @precondition(lambda self: self.model)
    @rule(by=st.integers(0, 1), data=st.data(), whole=st.booleans())
    def remove(self, by: int, data: st.DataObject, whole: bool) -> None:
        identity, component = data.draw(st.sampled_from(list(self.model)))
        gone = [
            (of, number) for of, number in self.model if of == identity and (whole or number == component)
        ]
        assert self.caches[by].remove(identity.key, None if whole else component) == len(gone)
        for each in gone:
            del self.model[each]

    @invariant()
    def equal(self) -> None:
        for cache in self.caches:
            kept = {(summary.identity, summary.component): summary.size for summary in cache.components()}
            assert kept == {key: len(model.params) for key, model in self.model.items()}
            for (identity, component), model in self.model.items():
                table = cache.load(identity.key, component)
                assert table is not None
                assert list(table.params.values()) == [
                    model.params[name].param.with_trust(Trust.CACHED) for name in model.by_index()
                ]
                assert table.heard_at == {name: item.heard_at for name, item in model.params.items()}
                assert table.volatile == {name for name, item in model.params.items() if item.volatile}
                state = TableState(
                    table.hash, table.count, table.complete, table.volatile_known, table.synced_at
                )
                assert state == model.state
                assert [self.line(entry) for entry in table.history()] == model.lines
            assert not cache.notes
        assert not set_aside(self.path)

    @staticmethod
    def line(entry: HistoryEntry) -> tuple[str, int, int | None, str]:
        return entry.name, entry.old.bits, entry.new.bits if entry.new else None, entry.by


TestCacheMachine = CacheMachine.TestCase
TestCacheMachine.settings = settings(max_examples=40, stateful_step_count=15, deadline=None)


def test_defaults_are_kept_beside_the_values(path: Path) -> None:
    kept = {
        "INT": Param("INT", -5, ParamType.INT16, 0, 0xFFFB, default=-1),
        "FLOAT": Param("FLOAT", 0.5, ParamType.REAL32, 1, 0x3F000000, default=-0.25),
        "NONE": Param("NONE", 1, ParamType.INT8, 2, 1),
    }
    with ParamCache(path) as cache:
        cache.save(update(*(StoredParam(param, NOW) for param in kept.values())))
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert {name: param.default for name, param in table.params.items()} == {
            "INT": -1,
            "FLOAT": -0.25,
            "NONE": None,
        }
        assert table.params.changed().keys() == {"INT", "FLOAT"}
        cache.save(update(StoredParam(replace(kept["INT"], default=-5), NOW)))
        table = cache.load(PX4.key, 1)
        assert table is not None
        assert table.params.changed().keys() == {"FLOAT"}
        assert not table.history(), "a default is no change of the value"


def test_the_time_of_the_last_observation_of_a_table(path: Path) -> None:
    with ParamCache(path) as cache:

        def heard_last(component: int) -> float:
            def work(session: Transaction) -> float:
                owner = session.owner_of(PX4.key, component)
                assert owner is not None
                return session.heard_last(owner)

            return cache._store.read(work)

        cache.save(update(*(stored(name, 1, at=NOW - ago) for name, ago in (("A", 5), ("B", 2), ("C", 9)))))
        cache.save(update(component=2))
        assert heard_last(1) == NOW - 2
        assert heard_last(2) == float("-inf")
        cache.save(update(at=NOW + 1, removed=["B"]))
        assert heard_last(1) == NOW - 5
