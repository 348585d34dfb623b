"""History, earlier states, snapshots, and logs that are inserted by time, in a file and in a database."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from paramclient.cache import SNAPSHOTS, ParamCache, StoredParam, TableState, history
from paramclient.errors import CacheError, UnknownVehicle, UsageError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, ParamType, ext_param
from tests.cache.conftest import Open
from tests.caches import NOW, PX4, stored, update, values, whole_table


def change(cache: ParamCache, value: int, at: float, name: str = "PARAM_0", by: str = "vehicle") -> None:
    cache.save(update(stored(name, value, at=NOW + at, by=by), at=NOW + at))


def lines(cache: ParamCache, name: str | None = None) -> list[tuple[float, str, object, object, str]]:
    return [
        (each.at - NOW, each.name, each.old.value, each.new and each.new.value, each.by)
        for each in cache.history(PX4.key, name=name)
    ]


def test_each_change_has_one_line(cache: ParamCache, open_cache: Open) -> None:
    cache.save(whole_table(2))
    change(cache, 5, 1, by="us for Ann")
    change(open_cache(), 5, 2)  # another program has received the same
    change(open_cache(), 6, 3)  # another one has not heard who has set it
    change(cache, 6, 3.1, by="station 254/190")
    cache.save(update(removed={"PARAM_1": NOW + 4}, at=NOW + 4))
    assert lines(cache) == [
        (1, "PARAM_0", 0, 5, "us for Ann"),
        (3, "PARAM_0", 5, 6, "station 254/190"),
        (4, "PARAM_1", 1, None, "vehicle"),
    ]
    assert [each.at - NOW for each in cache.history("1", limit=2)] == [3, 4]
    assert [each.at - NOW for each in cache.history("1", since=NOW + 2)] == [3, 4]
    assert cache.history("1", 100) == []
    with pytest.raises(UnknownVehicle):
        cache.history("2")


def test_a_program_that_reads_late_repeats_no_change(cache: ParamCache, open_cache: Open) -> None:
    late = open_cache()

    def observe(program: ParamCache, at: float, *values: int) -> None:
        for step, value in enumerate(values):  # which may be written late too
            program.save(update(stored("PARAM_0", value, at=NOW + at + step / 10), at=NOW + 5 * at))

    cache.save(whole_table(1))
    observe(cache, 0.0, 1, 2, 0, 1, 0)
    observe(late, 0.5, 1, 2, 0, 1, 0, 2)
    observe(cache, 1.2, 2, 0)
    starting = [stored("PARAM_0", value, at=NOW + 2.95) for value in (1, 2, 0)]
    program = open_cache()
    program.load(whole_table(1).identity.key, 1)  # later than it has heard these
    program.save(update(*starting, at=NOW + 6))
    assert [line[2:4] for line in lines(cache)] == [(0, 1), (1, 2), (2, 0), (0, 1), (1, 0), (0, 2), (2, 0)]
    assert values(cache) == {"PARAM_0": 0}


def test_programs_one_after_the_other_may_set_a_value_back(cache: ParamCache, open_cache: Open) -> None:
    table = whole_table(1)
    cache.save(table)
    for value in (1, 0, 1):
        program = open_cache()
        program.load(table.identity.key, 1)
        program.save(update(stored("PARAM_0", value, at=(now := time.time()), by="us"), at=now))
        assert values(cache) == {"PARAM_0": value}
    assert [line[2:4] for line in lines(cache)] == [(0, 1), (1, 0), (0, 1)]


def test_zero_and_negative_zero_are_one_value(cache: ParamCache) -> None:
    for at, bits in enumerate((0, 0x80000000, 0x3F800000)):
        cache.save(update(stored("A", bits, ParamType.REAL32, at=NOW + at), at=NOW + at))
    assert lines(cache) == [(2, "A", 0.0, 1.0, "vehicle")]


def test_every_observation_of_one_update_counts(cache: ParamCache) -> None:
    cache.save(update(*(stored("A", value, at=NOW + value, by="us") for value in (1, 2, 3)), at=NOW + 3))
    assert lines(cache) == [(2, "A", 1, 2, "us"), (3, "A", 2, 3, "us")]


def test_the_newest_lines_are_kept(cache: ParamCache, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "HISTORY_ENTRIES_MAX", 3)
    cache.save(whole_table(1))
    for value in range(1, 6):
        change(cache, value, value)
    assert [line[3] for line in lines(cache)] == [3, 4, 5]
    assert cache.state_at("1", 1, NOW + 3)["PARAM_0"].value == 3
    with pytest.raises(CacheError, match="the history begins at"):
        cache.state_at("1", 1, NOW + 1)


# earlier states


def test_the_state_at_a_time(cache: ParamCache) -> None:
    change(cache, 9, -5)
    with pytest.raises(CacheError, match="never complete; snapshots: none"):
        cache.state_at("1", 1, NOW)
    cache.save(whole_table(2))
    change(cache, 5, 10)
    cache.save(update(stored("NEW", 1, at=NOW + 20), at=NOW + 20))
    cache.save(update(removed={"PARAM_1": NOW + 30}, at=NOW + 30))
    states = {
        at: {name: each.value for name, each in cache.state_at("1", 1, NOW + at).items()}
        for at in (0.0, 10.0, 20.0, 30.0)
    }
    assert states == {
        0.0: {"PARAM_0": 0, "PARAM_1": 1},
        10.0: {"PARAM_0": 5, "PARAM_1": 1},
        20.0: {"PARAM_0": 5, "PARAM_1": 1, "NEW": 1},
        30.0: {"PARAM_0": 5, "NEW": 1},
    }
    with pytest.raises(CacheError, match="the history begins at"):
        cache.state_at("1", 1, NOW - 1)
    with pytest.raises(UsageError):
        cache.state_at("1", 1, -1.0)


def test_the_state_of_extended_parameters(cache: ParamCache) -> None:
    def save(at: float, text: bytes) -> None:
        param = ext_param("A", text, ParamType.CUSTOM, 0)
        state = TableState(count=1, complete=True)
        rows = [StoredParam.of(param, NOW + at)]
        cache.save(update(*rows, at=NOW + at, table=state, component=100, extended=True))

    save(0, b"tea")
    save(10, b"milk")
    assert cache.state_at("1", 100, NOW + 5, extended=True)["A"].value == "tea"
    rum = ParamSet({"A": WrittenParam("A", "rum", ParamType.CUSTOM)})
    made = cache.store_snapshot(PX4, 100, rum, reason="by hand", extended=True)
    assert cache.state_at("1", 100, made.id, extended=True)["A"].value == "rum"
    assert cache.snapshots("1", extended=True) == [made]
    assert cache.snapshots("1") == []


# snapshots


def test_a_snapshot_keeps_types_defaults_and_firmware(cache: ParamCache, open_cache: Open) -> None:
    params = ParamSet(
        {
            "B": WrittenParam("B", 1.5, ParamType.REAL32, 2.5),
            "A": WrittenParam("A", -7, ParamType.INT8),
            "RAW": WrittenParam("RAW", b"\1\2\3\4", ParamType.INT64),
        }
    )
    made = cache.store_snapshot(PX4, 1, params, reason="before\0apply", at=NOW + 0.0004, hash=7)
    assert (made.at, made.reason, made.size, made.hash) == (NOW, "before\\x00apply", 3, 7)
    assert made.complete
    assert made.ended is None
    cache.save(update(at=NOW + 9, identity=replace(PX4, firmware=5)))
    found = open_cache().state_at(PX4.key, 1, made.id)
    assert dict(found) == dict(params)
    assert list(found) == ["B", "A", "RAW"]
    assert found.identity == PX4
    assert cache.state_at(PX4.key, 1, made.at) == found
    with pytest.raises(UsageError, match="type"):
        cache.store_snapshot(PX4, 1, ParamSet({"A": WrittenParam("A", 1)}), reason="untyped")


def test_a_snapshot_of_the_cached_table(cache: ParamCache) -> None:
    default = Param("A", 1, ParamType.INT32, 0, 1, default=3)
    cache.save(update(StoredParam.of(default, NOW), table=TableState(5, 1, complete=True)))
    made = cache.store_snapshot("1", 1, reason="test")
    change(cache, 2, 1, "A")
    assert (made.hash, made.complete, made.size) == (5, True, 1)
    assert cache.state_at("1", 1, made.id)["A"] == WrittenParam("A", 1, ParamType.INT32, 3)
    with pytest.raises(UnknownVehicle):
        cache.store_snapshot("2", 1, reason="test")


def test_the_newest_snapshots_are_kept_and_numbers_are_never_used_again(cache: ParamCache) -> None:
    cache.save(whole_table(1))
    made = [cache.store_snapshot("1", 1, reason=str(number)).id for number in range(SNAPSHOTS + 2)]
    assert [each.id for each in cache.snapshots("1")] == made[2:]
    with pytest.raises(CacheError, match=rf"there is no snapshot {made[0]} of .* those kept are {made[2]}, "):
        cache.state_at("1", 1, made[0])
    cache.remove("1")
    cache.save(whole_table(1))
    assert cache.store_snapshot("1", 1, reason="new").id > made[-1]


def test_an_interrupted_apply_is_told_from_one_that_has_ended(cache: ParamCache) -> None:
    cache.save(whole_table(1))
    params = cache.state_at("1", 1, cache.store_snapshot("1", 1, reason="by hand").id)
    made = [cache.store_snapshot(PX4, 1, params, reason="apply", is_of_operation=True) for _ in range(2)]
    cache.end_operation(made[0].id)
    assert [each.ended for each in cache.snapshots("1")] == [None, True, False]


# logs


def test_earlier_observations_are_inserted_by_time(cache: ParamCache) -> None:
    """A change that was received live too has one line, and a name that a later table lacks is left out."""
    cache.save(whole_table(2))
    change(cache, 5, 100, by="us")
    logged = (("OLD", -50, 1), ("PARAM_0", 50, 3), ("PARAM_0", 60, 0), ("PARAM_0", 99, 5))
    for _ in range(2):  # repeating it changes nothing
        cache.merge([update(stored(name, value, at=NOW + at), at=NOW + at) for name, at, value in logged])
        assert values(cache) == {"PARAM_0": 5, "PARAM_1": 1}
        assert lines(cache) == [
            (50, "PARAM_0", 0, 3, "vehicle"),
            (60, "PARAM_0", 3, 0, "vehicle"),
            (100, "PARAM_0", 0, 5, "us"),
        ]
    assert cache.state_at("1", 1, NOW + 55)["PARAM_0"].value == 3


def test_a_later_log_continues_the_table_without_its_hash(cache: ParamCache) -> None:
    cache.save(whole_table(1))
    state = TableState(0xABC, 1, complete=True)
    cache.merge([update(stored("PARAM_0", 7, at=NOW + 50), at=NOW + 50, table=state)])
    assert values(cache) == {"PARAM_0": 7}
    assert cache.component("1").hash is None
