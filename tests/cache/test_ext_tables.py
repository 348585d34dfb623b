"""Extended parameters in the cache: apart from the plain ones, with a history of their own.

`test_store` asks the same of PostgreSQL.
"""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamCache, Trust
from paramclient.cache import ExtTableUpdate, StoredExtParam
from paramclient.cache.cells import Damaged
from paramclient.cache.history_columns import HISTORY_ENTRIES_MAX
from paramclient.cache.operations import SaveExt, StoreExtSnapshot
from paramclient.cache.outbox import packed, unpacked
from paramclient.errors import NotInCache, UnknownVehicle, UsageError
from paramclient.model.ext_params import ExtParam, ExtParamType, ExtValue, encode_ext_value
from paramclient.model.ext_paramset import ExtParamSet
from tests.caches import NOW, PX4, stored, update, values, whole_table

KINDS = ExtParamType
EVERY_TYPE: dict[str, tuple[int, ExtValue]] = {
    "U8": (KINDS.UINT8, 255),
    "I64": (KINDS.INT64, -(2**63)),
    "U64": (KINDS.UINT64, 2**64 - 1),
    "R32": (KINDS.REAL32, 0.5),
    "R64": (KINDS.REAL64, 1 / 3),
    "TEXT": (KINDS.CUSTOM, "grün"),
    "BYTES": (KINDS.CUSTOM, b"\xff\0\xfe"),
    "LONG": (KINDS.CUSTOM, "x" * 128),
    "EMPTY": (KINDS.CUSTOM, ""),
    "ODD": (77, b"\1\2"),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made" / "parameters.sqlite3"


def kept(name: str, value: ExtValue, index: int | None = None, kind: int | None = None) -> ExtParam:
    if kind is None:
        kind = KINDS.CUSTOM if isinstance(value, str | bytes) else KINDS.INT32
    return ExtParam.of(name, encode_ext_value(value, kind), kind, index, Trust.CACHED)


def learnt(*, at: float = NOW, by: str = "vehicle", **more: Any) -> ExtTableUpdate:
    """An update with these values, in capitals, and these attributes."""
    pairs = [(name, value) for name, value in more.items() if name.isupper()]
    described: dict[str, Any] = {"identity": PX4, "component": 100, "autopilot": 8}
    described |= {name: value for name, value in more.items() if not name.isupper()}
    return ExtTableUpdate(
        **described,
        at=at,
        params=[
            StoredExtParam.of(kept(name, value, index), at, by) for index, (name, value) in enumerate(pairs)
        ],
    )


def values_in(cache: ParamCache, component: int = 100) -> dict[str, ExtValue]:
    found = cache.load_ext(PX4.key, component)
    return {} if found is None else {name: param.value for name, param in found.params.items()}


def lines_in(cache: ParamCache, name: str | None = None) -> list[tuple[float, str, object, object, str]]:
    """The history: seconds after NOW, name, old value, new value, author."""
    return [
        (each.at - NOW, each.name, each.old.value, each.new and each.new.value, each.by)
        for each in cache.ext_history(PX4.key, 100, name)
    ]


def test_values_of_every_type_are_restored_in_the_next_session(path: Path) -> None:
    params = [
        kept(name, value, index, kind) for index, (name, (kind, value)) in enumerate(EVERY_TYPE.items())
    ]
    rows = [StoredExtParam.of(param, NOW + 1) for param in params]
    with ParamCache(path) as cache:
        cache.save_ext([replace(learnt(count=10, complete=True), params=rows)])
    with ParamCache(path) as cache:
        found = cache.load_ext(PX4.key, 100)
        assert found is not None
        assert list(found.params.values()) == params
        assert [param.value for param in found.params.values()] == [value for _, value in EVERY_TYPE.values()]
        assert set(found.heard_at.values()) == {NOW + 1}
        assert (found.key, found.component, found.count, found.complete) == (PX4.key, 100, 10, True)
        assert lines_in(cache) == []
        assert cache.load_ext(PX4.key, 1) is None
        assert cache.load_ext("nothing", 100) is None


def test_plain_and_extended_tables_of_a_component_are_separate(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), stored("B", 2), component=100))
        cache.save_ext([learnt(A="text", C=3)])
        cache.save(update(stored("A", 5), component=100, at=NOW + 1))
        cache.save_ext([learnt(A="other", at=NOW + 2, by="us")])
        assert values(cache, component=100) == {"A": 5, "B": 2}
        assert values_in(cache) == {"A": "other", "C": 3}
        assert [(each.name, each.new and each.new.value) for each in cache.history(PX4.key)] == [("A", 5)]
        assert lines_in(cache) == [(2.0, "A", "text", "other", "us")]
        [summary] = cache.components()
        assert summary.size == 2


def test_changes_and_removals_are_in_the_history(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save_ext([learnt(A=1, B="x", count=2, complete=True)])
        cache.save_ext([learnt(A=1, at=NOW + 1), learnt(A=2, at=NOW + 2, by="us for anna")])
        cache.save_ext([learnt(at=NOW + 3, removed={"B": NOW + 3, "NO_SUCH": NOW + 3}, count=1)])
        assert lines_in(cache) == [
            (2.0, "A", 1, 2, "us for anna"),
            (3.0, "B", "x", None, "vehicle"),
        ]
        assert lines_in(cache, "B") == [(3.0, "B", "x", None, "vehicle")]
        assert len(cache.ext_history(PX4.key, limit=1)) == 1
        assert len(cache.ext_history(PX4.key, since=NOW + 2.5)) == 1
        found = cache.load_ext(PX4.key, 100)
        assert found is not None
        assert (found.count, found.complete) == (1, True), "what is not received stays"


def test_an_older_observation_never_replaces_a_newer_one(path: Path) -> None:
    with ParamCache(path) as cache:
        for at in (2.0, 1.0, 3.0, 2.5):
            cache.save_ext([learnt(A=int(10 * at), at=NOW + at)], clock=lambda: NOW + 9)
        assert values_in(cache) == {"A": 30}
        assert lines_in(cache) == [(3.0, "A", 20, 30, "vehicle")]
        cache.save_ext([learnt(at=NOW + 4, removed={"A": NOW + 2.9})])
        assert values_in(cache) == {"A": 30}, "it was received after that"


def test_an_index_stays_until_another_one_is_received(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save_ext([learnt(B=1, A=2)])
        row = StoredExtParam.of(kept("A", 5), NOW + 1)
        cache.save_ext([replace(learnt(at=NOW + 1), params=[row])])
        found = cache.load_ext(PX4.key, 100)
        assert found is not None
        assert [(param.name, param.index) for param in found.params.values()] == [("B", 0), ("A", 1)]


def test_the_history_is_bounded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("paramclient.cache.ext_tables.HISTORY_ENTRIES_MAX", 5)
    assert HISTORY_ENTRIES_MAX > 5
    with ParamCache(path) as cache:
        for number in range(10):
            cache.save_ext([learnt(A=number, at=NOW + number)])
        assert [line[3] for line in lines_in(cache)] == [5, 6, 7, 8, 9]


def test_offline_reading(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        cache.save_ext([learnt(A=1)])
        assert cache.extended(system=1).params["A"].value == 1
        assert cache.extended(PX4.key, component=100).params["A"].trust is Trust.CACHED
        with pytest.raises(NotInCache, match="no extended parameters in the cache"):
            cache.extended(system=1, component=1)
        with pytest.raises(UnknownVehicle):
            cache.extended(system=9)
        with pytest.raises(UnknownVehicle):
            cache.ext_history("uid:123456")


def test_to_remove_a_table_removes_both(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        cache.save_ext([learnt(A=1), learnt(A=2, at=NOW + 1)])
        assert cache.remove(PX4.key, 100) == 1
        assert cache.load_ext(PX4.key, 100) is None
        assert values(cache) == {"PARAM_0": 0, "PARAM_1": 1, "PARAM_2": 2}
        cache.save_ext([learnt(A=5, at=NOW + 2)])
        assert lines_in(cache) == []


def test_a_time_that_is_none_writes_nothing(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save_ext([learnt(A=1)])
        with pytest.raises(UsageError, match="not a time"):
            cache.save_ext([learnt(A=2, at=NOW + 1), learnt(A=3, at=-1.0)])
        assert values_in(cache) == {"A": 1}
        cache.save_ext([])


@pytest.mark.parametrize("seed", range(5))
def test_the_latest_values_are_kept_in_any_order_of_arrival(path: Path, seed: int) -> None:
    moments = list(range(20))
    random.Random(seed).shuffle(moments)
    with ParamCache(path) as cache:
        for moment in moments:
            cache.save_ext([learnt(A=moment, at=NOW + moment)], clock=lambda: NOW + 30)
        assert values_in(cache) == {"A": 19}
        lines = lines_in(cache)
        assert [line[3] for line in lines] == sorted(line[0] for line in lines)


def test_a_copy_has_extended_parameters_too(path: Path, tmp_path: Path) -> None:
    with ParamCache(path) as cache, ParamCache(tmp_path / "copy") as copy:
        cache.save(whole_table(3))
        cache.save_ext([learnt(A=1, B="x", count=2, complete=True), learnt(A=2, at=NOW + 1)])
        assert (cache.copy_to(copy).tables, cache.copy_to(copy).unchanged) == (2, 2)
        assert copy.load_ext(PX4.key, 100) == cache.load_ext(PX4.key, 100)
        assert lines_in(copy) == lines_in(cache)
        copy.save_ext([learnt(A=7, at=NOW + 5)])
        cache.save_ext([learnt(B="y", at=NOW + 4)])
        cache.copy_to(copy)
        assert values_in(copy) == {"A": 7, "B": "y"}
        assert [line[:2] for line in lines_in(copy)] == [(1.0, "A"), (4.0, "B"), (5.0, "A")]
        assert cache.copy_to(copy).unchanged == 2


def state_of(cache: ParamCache, when: float) -> dict[str, ExtValue]:
    return {name: each.value for name, each in cache.ext_state_at(PX4.key, 100, when).params.items()}


def test_snapshots_of_extended_parameters_are_apart_from_those_of_plain_ones(path: Path) -> None:
    params = {
        name: kept(name, value, index, kind) for index, (name, (kind, value)) in enumerate(EVERY_TYPE.items())
    }
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), component=100))
        plain = cache.snapshot(PX4.key, 100, reason="plain")
        made = cache.store_ext_snapshot(PX4, 100, ExtParamSet(params), reason="before apply", at=NOW + 1)
        assert (made.component, made.size, made.hash, made.complete) == (100, len(params), None, True)
        assert list(made.params.params.values()) == list(params.values())
        assert made.params.identity == PX4
        assert [each.id for each in cache.snapshots(PX4.key)] == [plain.id]
        [summary] = cache.ext_snapshots(PX4.key)
        assert (summary.id, summary.reason, summary.at) == (made.id, "before apply", NOW + 1)
        assert cache.ext_snapshots(PX4.key, 1) == []
        assert cache.ext_state_at(PX4.key, 100, made.id) == made.params
        assert cache.ext_state_at(PX4.key, 100, NOW + 1) == made.params
        with pytest.raises(NotInCache, match=f"no snapshot {plain.id} .*those kept are {made.id}$"):
            cache.ext_state_at(PX4.key, 100, plain.id)
        with pytest.raises(NotInCache, match=f"no snapshot {made.id} .*those kept are {plain.id}$"):
            cache.state_at(PX4.key, 100, made.id)


def test_a_snapshot_of_the_cached_extended_parameters(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), component=1))
        with pytest.raises(NotInCache, match="no extended parameters in the cache"):
            cache.ext_snapshot(PX4.key, 1, reason="by hand")
        cache.save_ext([learnt(A=1, B="x", complete=False)])
        made = cache.ext_snapshot(PX4.key, 100, reason="by hand", at=NOW + 5)
        cache.save_ext([learnt(A=2, at=NOW + 6)])
        assert not made.complete
        assert state_of(cache, made.id) == {"A": 1, "B": "x"}


def test_extended_snapshots_are_bounded_apart_from_plain_ones(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("paramclient.cache.snapshots.SNAPSHOTS", 3)
    monkeypatch.setattr("paramclient.cache.ext_snapshots.SNAPSHOTS", 3)
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), component=100))
        cache.save_ext([learnt(A=1)])
        for number in range(5):
            cache.snapshot(PX4.key, 100, reason="plain", at=NOW + number)
            cache.ext_snapshot(PX4.key, 100, reason="extended", at=NOW + number)
        assert [each.at - NOW for each in cache.snapshots(PX4.key)] == [2, 3, 4]
        assert [each.at - NOW for each in cache.ext_snapshots(PX4.key)] == [2, 3, 4]


def test_extended_parameters_at_an_earlier_time(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save_ext([learnt(A=1)])
        with pytest.raises(NotInCache, match="never complete; there is no snapshot"):
            state_of(cache, NOW)
        cache.save_ext([learnt(A=1, B="x", at=NOW + 1, count=2, complete=True)])
        cache.save_ext([learnt(A=2, at=NOW + 2), learnt(A=3, at=NOW + 3)])
        cache.save_ext([learnt(at=NOW + 4, removed={"B": NOW + 4})])
        cache.ext_snapshot(PX4.key, 100, reason="by hand", at=NOW + 5)
        with pytest.raises(NotInCache, match=r"the history begins at .*; there is snapshot 1 of"):
            state_of(cache, NOW + 0.5)
        assert state_of(cache, NOW + 1) == {"A": 1, "B": "x"}
        assert state_of(cache, NOW + 2.5) == {"A": 2, "B": "x"}
        assert state_of(cache, NOW + 3) == {"A": 3, "B": "x"}
        assert state_of(cache, NOW + 9) == {"A": 3}


def test_earlier_states_end_with_the_dropped_history(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("paramclient.cache.ext_tables.HISTORY_ENTRIES_MAX", 3)
    with ParamCache(path) as cache:
        for number in range(6):
            cache.save_ext([learnt(A=number, at=NOW + number, complete=True)])
        assert [state_of(cache, NOW + number)["A"] for number in (2, 3, 4, 5)] == [2, 3, 4, 5]
        with pytest.raises(NotInCache, match="the history begins at"):
            state_of(cache, NOW + 1)


def test_a_copy_has_the_snapshots_of_extended_parameters_too(path: Path, tmp_path: Path) -> None:
    with ParamCache(path) as cache, ParamCache(tmp_path / "copy") as copy:
        cache.save_ext([learnt(A=1, complete=True), learnt(A=2, at=NOW + 1)])
        made = cache.ext_snapshot(PX4.key, 100, reason="by hand", at=NOW + 2)
        assert cache.copy_to(copy).snapshots == 1
        assert [each.reason for each in copy.ext_snapshots(PX4.key)] == ["by hand"]
        assert copy.snapshots(PX4.key) == []
        assert copy.ext_state_at(PX4.key, 100, NOW + 2).params == made.params.params
        assert state_of(copy, NOW) == {"A": 1}
        assert cache.copy_to(copy).unchanged == 1


def test_queued_snapshots_are_restored() -> None:
    params = {name: kept(name, value, 3, kind) for name, (kind, value) in EVERY_TYPE.items()}
    for operation in (
        StoreExtSnapshot(PX4, 100, ExtParamSet(params), NOW, "before apply", False, 7),
        StoreExtSnapshot(PX4.key, 100, None, NOW, "by hand"),
    ):
        assert unpacked(packed(operation)) == operation


def test_a_damaged_snapshot_of_extended_parameters_is_an_error(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save_ext([learnt(A=1)])
        made = cache.ext_snapshot(PX4.key, 100, reason="by hand")
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE snapshot SET params = x'00'")
        connection.commit()
    with ParamCache(path) as cache, pytest.raises(NotInCache, match="is damaged: it is not what was written"):
        cache.ext_state_at(PX4.key, 100, made.id)


def test_queued_writes_are_restored() -> None:
    operation = SaveExt([learnt(A=1, B=b"\xff\0", at=NOW, removed={"C": NOW}, count=2, complete=False)])
    again = unpacked(packed(operation))
    assert isinstance(again, SaveExt)
    assert list(again.updates) == list(operation.updates)


def test_damage_is_noticed(tmp_path: Path) -> None:
    for number, (statement, why) in enumerate(
        [
            ("UPDATE ext_param SET raw = 'text'", "an extended parameter is"),
            ("UPDATE ext_param SET type = 300", "an extended parameter is"),
            ("UPDATE ext_param SET heard_at = 9e999", "an extended parameter is"),
            ("UPDATE ext_param SET raw = x'ff'", "extended parameters is not what was written"),
            ("DELETE FROM ext_table", "extended parameters is not what was written"),
            ("UPDATE ext_table SET count = 'much'", "a cell holds 'much'"),
            ("UPDATE ext_history SET old_raw = 1", "a change of an extended parameter is"),
        ]
    ):
        path = tmp_path / f"cache{number}"
        with ParamCache(path) as cache:
            cache.save_ext([learnt(A=1), learnt(A=2, at=NOW + 1)])
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(statement)
            connection.commit()
        with ParamCache(path) as cache:
            if "ext_table" in statement and "DELETE" in statement:
                cache.save_ext([learnt(A=3, at=NOW + 2)])
            else:
                cache.load_ext(PX4.key, 100)
                with suppress(UnknownVehicle):  # the file was renamed before
                    cache.ext_history(PX4.key)
            assert why in cache.notes[0]


def test_a_queued_write_that_is_none_is_damaged() -> None:
    data = packed(SaveExt([learnt(A=1)]))
    with pytest.raises(Damaged):
        unpacked(data[:-5])
