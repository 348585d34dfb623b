"""Earlier states of a table: snapshots, and the state by history at any other moment, compared with a
model."""

from __future__ import annotations

import os
import signal
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient.cache import ParamCache, SnapshotSummary, StoredParam, TableState, history_columns, snapshots
from paramclient.errors import CacheError, UnknownVehicle, UsageError
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, ParamType
from tests.caches import CACHE_ALONE, NOW, PX4, full_disk, start, stored, update, values, whole_table

REAL32 = ParamType.REAL32
DONE = TableState(complete=True)
PAGE = 4096


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.sqlite3"


def numbers(state: ParamSet) -> dict[str, Any]:
    return {name: each.value for name, each in state.items()}


# Snapshots


def test_a_snapshot_keeps_the_table_of_its_time(path: Path) -> None:
    kept = [
        Param("INT", -5, ParamType.INT16, 1, 0xFFFB, default=-1),
        Param("FLOAT", struct.unpack("<f", b"\xcd\xcc\xcc=")[0], REAL32, 0, 0x3DCCCCCD, default=-0.25),
        Param("RAW", b"\1\2\3\4", ParamType.INT64, None, 0x04030201),
    ]
    with ParamCache(path) as cache:
        cache.save(
            update(*(StoredParam(each, NOW) for each in kept), table=TableState(0xABC, 2, complete=True))
        )
        made = cache.snapshot("uid:000200", 1, reason="before apply plane.parm", at=NOW + 1.23456)
        cache.save(update(stored("INT", 7), removed=["FLOAT", "RAW"], at=NOW + 2))
    with ParamCache(path) as cache:
        state = cache.state_at(PX4.key, 1, made.id)
        summary = SnapshotSummary(1, PX4.key, 1, NOW + 1.235, "before apply plane.parm", 3, 0xABC, True)
        assert cache.snapshots("uid:000200") == [summary]
        assert cache.state_at(PX4.key, 1, NOW + 1.235) == state == made.params
        assert numbers(cache.state_at(PX4.key, 1, NOW + 2)) == {"INT": 7}
    assert state.params == {
        "FLOAT": WrittenParam("FLOAT", kept[1].value, REAL32, -0.25),
        "INT": WrittenParam("INT", -5, ParamType.INT16, -1),
        "RAW": WrittenParam("RAW", b"\1\2\3\4", ParamType.INT64),
    }
    assert list(state) == ["FLOAT", "INT", "RAW"], "as the vehicle orders them"
    assert (state.identity, state.system, state.component, state.at) == (PX4, 1, 1, summary.at)
    assert state.source == f"snapshot 1 of {PX4.key}"
    assert repr(made) == (
        f"<Snapshot 1 of {PX4.key}/1: 3 params, 2026-11-18 11:06Z, 'before apply plane.parm'>"
    )


def test_store_snapshot_stores_the_table_of_the_caller(path: Path) -> None:
    vehicle = {"A": WrittenParam("A", 9, ParamType.INT32, comment="words", line=3)}
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        made = cache.store_snapshot(
            PX4.key, 1, ParamSet(vehicle, 1), reason="r\udcff", at=NOW, hash=5, complete=False
        )
        assert (made.size, made.hash, made.complete, made.reason) == (1, 5, False, "r\\udcff")
        assert made.params.params == {"A": WrittenParam("A", 9, ParamType.INT32)}
        assert made.params.identity == PX4
        assert len(values(cache)) == 3
        assert cache.history(PX4.key) == []
        assert cache.store_snapshot(PX4, 1, ParamSet({}), reason="", at=NOW).id == made.id + 1
        assert cache.component().updated_at == NOW


def test_a_vehicle_that_the_cache_does_not_know_is_written_down_with_its_snapshot(path: Path) -> None:
    with ParamCache(path) as cache:
        for component in (1, 154):
            cache.store_snapshot(PX4, component, ParamSet({}), reason="first", at=NOW)
        assert [(each.component, each.autopilot, each.size) for each in cache.components(PX4.key)] == [
            (1, 12, 0),
            (154, 0, 0),
        ]
        assert [each.component for each in cache.snapshots(PX4.key)] == [1, 154]
        assert [each.component for each in cache.snapshots(PX4.key, 154)] == [154]
        with pytest.raises(
            CacheError, match="was never complete; there is snapshot 1 of 2026-11-18T11:06:40Z"
        ):
            cache.state_at(PX4.key, 1, NOW + 9.0)


def test_without_a_time_it_is_now(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(1))
        first = cache.snapshot(PX4.key, 1, reason="")
        second = cache.store_snapshot(PX4, 1, first.params, reason="")
        assert first.at <= second.at
        assert first.at == pytest.approx(second.at, abs=600)
        assert first.at > 1.7e9
        assert first.at == round(first.at, 3)


VALUES = st.one_of(
    st.integers(-(1 << 63), (1 << 64) - 1),
    st.floats(),
    st.integers(0, 0xFFFFFFFF).map(lambda bits: struct.unpack("<f", struct.pack("<I", bits))[0]),
    st.binary(min_size=4, max_size=4),
)
WRITTEN = st.builds(
    WrittenParam,
    st.text(st.characters(max_codepoint=255), min_size=1, max_size=16),
    VALUES,
    st.one_of(st.none(), st.sampled_from(ParamType), st.integers(11, 255)),
    st.one_of(st.none(), VALUES),
)


@given(st.lists(WRITTEN, max_size=5))
@settings(max_examples=200, deadline=None)
def test_every_value_is_restored_to_the_last_bit(params: list[WrittenParam]) -> None:
    identity, found = snapshots._unpacked(snapshots._packed(PX4, {each.name: each for each in params}))
    assert identity == PX4
    assert list(found) == list({each.name: each for each in params})

    def exact(value: object) -> object:
        return struct.pack("<d", value) if isinstance(value, float) else value

    for each in {each.name: each for each in params}.values():
        back = found[each.name]
        assert (exact(back.value), exact(back.default)) == (exact(each.value), exact(each.default))
        assert (type(back.value), type(back.type), back.type) == (
            type(each.value),
            type(each.type),
            each.type,
        )


def test_snapshots_are_bounded_for_each_table_and_keep_their_numbers(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "SNAPSHOTS", 3)
    with ParamCache(path) as cache:
        cache.save([whole_table(1), whole_table(1, component=2)])
        made = [cache.snapshot(PX4.key, 1 + count % 2, reason=str(count), at=NOW) for count in range(10)]
        assert [each.id for each in made] == list(range(1, 11))
        assert [each.id for each in cache.snapshots(PX4.key)] == [5, 6, 7, 8, 9, 10]
        with pytest.raises(CacheError, match=r"no snapshot 1 of uid:.*, component 1: those kept are 5, 7, 9"):
            cache.state_at(PX4.key, 1, 1)
        with pytest.raises(CacheError, match=r"no snapshot 6 of uid:.*, component 1"):
            cache.state_at(PX4.key, 1, 6)
        assert cache.remove(PX4.key, 2) == 1
        assert [each.id for each in cache.snapshots(PX4.key)] == [5, 7, 9]
        assert cache.remove(PX4.key) == 1
        cache.save(whole_table(1))
        assert cache.snapshots(PX4.key) == []
        with pytest.raises(CacheError, match=r"no snapshot 9 .*: none is kept"):
            cache.state_at(PX4.key, 1, 9)
        assert cache.snapshot(PX4.key, 1, reason="").id == 11


def test_snapshots_of_an_unknown_vehicle_are_an_error_that_creates_nothing(path: Path) -> None:
    with ParamCache(path) as cache:
        for ask in (
            lambda: cache.snapshot(PX4.key, 1, reason=""),
            lambda: cache.store_snapshot(PX4.key, 1, ParamSet({}), reason=""),
            lambda: cache.state_at(PX4.key, 1, NOW),
            lambda: cache.snapshots(PX4.key),
        ):
            with pytest.raises(UnknownVehicle, match="holds no vehicle"):
                ask()
        assert not path.exists()
        with pytest.raises(UsageError, match="unix seconds"):
            cache.store_snapshot(PX4, 1, ParamSet({}), reason="", at=-1)
        assert cache.vehicles() == []
        cache.save(whole_table(1))
        for when in (float("nan"), float("inf"), -1.0):
            with pytest.raises(UsageError, match="unix seconds"):
                cache.state_at(PX4.key, 1, when)


def test_a_snapshot_that_is_damaged_is_an_error_and_costs_nothing_else(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(300))
        for reason in ("one", "two", "three", "four"):
            cache.snapshot(PX4.key, 1, reason=reason, at=NOW)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        [(blob,)] = other.execute("SELECT params FROM snapshot WHERE id = 1")
        flipped = bytes([*blob[:100], blob[100] ^ 1, *blob[101:]])
        other.execute("UPDATE snapshot SET params = ? WHERE id = 1", (flipped,))
        other.execute("UPDATE snapshot SET params = 'text' WHERE id = 2")
        other.execute("UPDATE snapshot SET at = at + 1 WHERE id = 3")
    with ParamCache(path) as cache:
        for number in (1, 2, 3):
            with pytest.raises(
                CacheError, match=f"snapshot {number} of .* is damaged: it is not what was written"
            ):
                cache.state_at(PX4.key, 1, number)
        assert len(cache.state_at(PX4.key, 1, 4)) == 300
        assert [each.id for each in cache.snapshots(PX4.key)] == [1, 2, 3, 4]
        assert len(values(cache)) == 300
        assert not cache.notes


@pytest.mark.parametrize("content", [b"no zlib", b"[", b"[[], []]", b'[[], [["A", 6, "f00"]]]', b"7"])
def test_a_snapshot_of_another_form_is_an_error(
    path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    blob = content if content == b"no zlib" else zlib.compress(content)
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        monkeypatch.setattr(snapshots, "_packed", lambda *_: blob)
        with pytest.raises(CacheError, match=r"snapshot 1 of .* is damaged"):
            cache.snapshot(PX4.key, 1, reason="", at=NOW)
        assert cache.snapshots(PX4.key) == [], "what cannot be read back is not kept"


# Any other moment


def test_a_state_is_worked_backwards_over_changes_new_names_and_removals(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), stored("B", 1), table=DONE))
        cache.save(update(stored("A", 2, at=NOW + 10), at=NOW + 10))
        cache.save(update(stored("C", 5, at=NOW + 20), at=NOW + 20))
        cache.save(update(stored("C", 6, at=NOW + 30), removed=["B"], at=NOW + 30))
        cache.save(update(stored("B", 9, at=NOW + 40), removed=["C"], at=NOW + 40))
        cache.save(update(stored("C", 7, at=NOW + 50), at=NOW + 50))
        states = {
            after: cache.state_at(PX4.key, 1, NOW + after) for after in (0, 9.9, 10, 20, 30, 40, 50, 1e6)
        }
    assert {after: numbers(state) for after, state in states.items()} == {
        0: {"A": 1, "B": 1},
        9.9: {"A": 1, "B": 1},
        10: {"A": 2, "B": 1},
        20: {"A": 2, "B": 1, "C": 5},
        30: {"A": 2, "C": 6},
        40: {"A": 2, "B": 9},
        50: {"A": 2, "B": 9, "C": 7},
        1e6: {"A": 2, "B": 9, "C": 7},
    }
    state = states[10]
    assert (state.at, state.component, state.source) == (NOW + 10, 1, f"history of {PX4.key}")
    assert state.identity == replace(PX4, firmware=0, git_hash="", capabilities=0), "of that time, unknown"
    assert {each.type for each in state.values()} == {ParamType.INT32}


def test_before_a_table_was_first_complete_nothing_is_claimed(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), at=NOW))
        with pytest.raises(CacheError, match="was never complete; there is no snapshot"):
            cache.state_at(PX4.key, 1, NOW)
        cache.save(update(stored("B", 1, at=NOW + 5), table=DONE, at=NOW + 5))
        cache.save(update(stored("C", 1, at=NOW + 9), table=TableState(), at=NOW + 9))
        cache.save(update(stored("D", 1, at=NOW + 10), table=DONE, at=NOW + 10))
        with pytest.raises(CacheError, match="its history begins at 2026-11-18T11:06:45Z"):
            cache.state_at(PX4.key, 1, NOW + 4.9)
        assert set(cache.state_at(PX4.key, 1, NOW + 5.0)) == {"A", "B"}
        assert set(cache.state_at(PX4.key, 1, NOW + 9.0)) == {"A", "B", "C"}


def test_the_error_of_state_at_says_how_far_the_history_reaches(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_columns, "HISTORY_ENTRIES_MAX", 3)
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 0), stored("B", 0), table=DONE))
        cache.snapshot(PX4.key, 1, reason="", at=NOW + 1)
        for after in range(10, 70, 10):
            cache.save(update(stored("A", after, at=NOW + after), at=NOW + after))
        cache.snapshot(PX4.key, 1, reason="", at=NOW + 65)
        assert numbers(cache.state_at(PX4.key, 1, NOW + 30)) == {"A": 30, "B": 0}
        with pytest.raises(
            CacheError,
            match=(
                r"at 2026-11-18T11:07:09Z is not known: what is kept of its history begins at "
                r"2026-11-18T11:07:10Z; there is snapshot 1 of 2026-11-18T11:06:41Z and snapshot 2 of "
                r"2026-11-18T11:07:45Z"
            ),
        ):
            cache.state_at(PX4.key, 1, NOW + 29.9)


def test_added_names_and_clock_rollbacks_are_trimmed_with_the_history(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle whose parameters appear and disappear all the time cannot fill the disk."""
    monkeypatch.setattr(history_columns, "HISTORY_ENTRIES_MAX", 4)
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 0), table=DONE))
        for after in range(0, 3000, 100):
            cache.save(update(stored("B", 0, at=NOW + after), at=NOW + after))
            cache.save(update(removed=["B"], at=NOW + after + 50))
            cache.save(update(at=NOW + after + 20))
    with closing(sqlite3.connect(path)) as other:
        for table in ("history", "birth", "setback"):
            [(rows,)] = other.execute(f"SELECT count(*) FROM {table}")
            assert 4 <= rows <= 6, table


def test_a_time_that_the_clock_went_through_twice_is_refused(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), stored("B", 1), table=DONE))
        cache.save(update(stored("A", 2, at=NOW + 500), at=NOW + 500))
        cache.save(update(stored("B", 2, at=NOW + 100), at=NOW + 100))
        cache.save(update(stored("B", 3, at=NOW + 600), at=NOW + 600))
        for after in (100.0, 300.0, 499.0):
            with pytest.raises(
                CacheError, match=r"set back from 2026-11-18T11:15:00Z to 2026-11-18T11:08:20Z"
            ):
                cache.state_at(PX4.key, 1, NOW + after)
        assert numbers(cache.state_at(PX4.key, 1, NOW + 99.0)) == {"A": 1, "B": 1}
        assert numbers(cache.state_at(PX4.key, 1, NOW + 500.0)) == {"A": 2, "B": 2}


def test_two_programs_that_write_a_moment_apart_are_no_clock_set_back(path: Path) -> None:
    late = NOW + snapshots.CLOCK_SLACK
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), table=DONE))
        cache.save(update(stored("A", 3, at=late), at=late))
        cache.save(update(stored("A", 2, at=NOW + 1), at=NOW + 1))
        assert numbers(cache.state_at(PX4.key, 1, NOW + 2)) == {"A": 2}
        assert numbers(cache.state_at(PX4.key, 1, late)) == {"A": 3}, "it was observed later"


def same(state: ParamSet, table: dict[str, Param]) -> bool:
    return state.keys() == table.keys() and all(
        state[name].is_held_by(param) for name, param in table.items()
    )


NAMES = st.sampled_from("ABC")
KINDS = st.sampled_from([REAL32, ParamType.UINT32])
STEPS = st.lists(
    st.tuples(
        st.sampled_from([10, 10, 10, 60, 0, -10, -90]),
        st.lists(st.tuples(NAMES, st.sampled_from([0, 1, 0x80000000]), KINDS), max_size=3),
        st.lists(NAMES, max_size=2),
        st.booleans(),
        st.sampled_from([None, None, DONE, TableState()]),
    ),
    min_size=1,
    max_size=12,
)  # fmt: skip


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ParamCache]:
    """A cache for all examples, each of which begins by emptying it: to make a file takes long."""
    with ParamCache(tmp_path_factory.mktemp("shared") / "cache") as cache:
        yield cache


@given(steps=STEPS, lines=st.sampled_from([2, 4, 1000]), backwards=st.booleans())
@settings(max_examples=80, deadline=None)
def test_state_at_agrees_with_a_model_that_keeps_every_state(
    shared: ParamCache, steps: list[Any], lines: int, backwards: bool
) -> None:
    """A model that keeps every state. Where the clock went through a moment twice, there are two of them."""
    states: list[tuple[float, dict[str, Param]]] = []
    complete_at: float | None = None
    now = NOW
    for left in shared.vehicles():
        shared.remove(left.key)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(history_columns, "HISTORY_ENTRIES_MAX", lines)
        for wait, params, removed, whole, state in steps:
            now += wait if backwards else abs(wait)
            items = [stored(name, bits, kind, at=now) for name, bits, kind in params]
            shared.save(update(*items, removed=removed, replace=whole, table=state, at=now))
            new = {item.param.name: item.param for item in items}
            old = states[-1][1] if states and not whole else {}
            kept = {name: param for name, param in old.items() if name not in removed}
            states.append((now, kept | new))
            if state is DONE and complete_at is None:
                complete_at = now
    for when in sorted({at + after for at, _ in states for after in (-5.0, 0.0, 5.0)}):
        ends = [at for at, _ in states[1:]] + [float("inf")]
        so = [table for (at, table), end in zip(states, ends, strict=True) if at <= when < end]
        try:
            claimed = shared.state_at(PX4.key, 1, when)
        except CacheError:
            never = complete_at is None or when < complete_at
            assert never or lines < 1000 or backwards, "there is no reason not to know it"
        else:
            assert len(so) == 1
            assert same(claimed, so[0])
    assert not shared.notes


# Bad days


WRITERS = f"""{CACHE_ALONE}
import os
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam

def write(path):
    cache = ParamCache(path)
    while True:
        params = {{f"P{{i}}": WrittenParam(f"P{{i}}", i * 1.1, 9) for i in range(300)}}
        made = cache.store_snapshot(Identity(1, "x"), 1, ParamSet(params), reason="r", at=1e9)
        os.write(1, b"%d\\n" % made.id)

while path := sys.stdin.readline().strip():
    child = os.fork()
    if not child:
        write(path)
    os.write(1, b"%d\\n" % child)
    os.waitpid(child, 0)
    os.write(1, b"dead\\n")
"""


def test_a_snapshot_that_was_made_survives_a_kill_at_any_moment(path: Path) -> None:
    with start(WRITERS) as writers:
        assert writers.stdin is not None
        assert writers.stdout is not None
        last = 0
        for round_ in range(12):
            writers.stdin.write(f"{path}\n")
            writers.stdin.flush()
            child = int(writers.stdout.readline())
            said = [writers.stdout.readline() for _ in range(round_ % 4)]
            os.kill(child, signal.SIGKILL)
            said += iter(writers.stdout.readline, "dead\n")
            acknowledged = int(said[-1]) if said else last
            with ParamCache(path) as cache:
                kept = cache.snapshots("system:1@x") if cache.vehicles() else []
                last = kept[-1].id if kept else 0
                assert last in (acknowledged, acknowledged + 1)
                assert [each.id for each in kept] == list(range(1, last + 1))[-snapshots.SNAPSHOTS :]
                assert all(len(cache.state_at("system:1@x", 1, each.id)) == 300 for each in kept)
                assert not cache.notes
        writers.stdin.close()


def test_two_programs_set_down_the_same_table_at_once(path: Path) -> None:
    program = f"""{CACHE_ALONE}
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
sys.stdin.readline()
cache = ParamCache(sys.argv[1])
made = [cache.store_snapshot(Identity(1, "x"), 1, ParamSet({{}}), reason=sys.argv[2]) for _ in range(40)]
print(*(each.id for each in made))
"""
    with start(program, path, "a") as first, start(program, path, "b") as second:
        for each in (first, second):
            assert each.stdin is not None
            each.stdin.write("go\n")
            each.stdin.flush()
        ids = [number for each in (first, second) for number in map(int, each.communicate()[0].split())]
    assert sorted(ids) == list(range(1, 81))
    with ParamCache(path) as cache:
        assert [each.id for each in cache.snapshots("system:1@x")] == list(range(31, 81))
        assert not cache.notes


def test_a_full_disk_is_an_error_and_keeps_the_snapshots_there_are(path: Path) -> None:
    rich = ParamSet({f"P{each}": WrittenParam(f"P{each}", each**0.5, REAL32) for each in range(3000)})
    with ParamCache(path) as cache:
        cache.save(whole_table(10))
        first = cache.snapshot(PX4.key, 1, reason="", at=NOW)
        with full_disk(at=2 * PAGE):
            for _ in range(2):
                with pytest.raises(CacheError, match=str(path)):
                    cache.store_snapshot(PX4.key, 1, rich, reason="", at=NOW)
                assert [each.id for each in cache.snapshots(PX4.key)] == [first.id]
            with pytest.raises(CacheError, match=str(path)):
                cache.store_snapshot(Identity(7, "y"), 1, rich, reason="", at=NOW)
            assert len(cache.vehicles()) == 1
        assert cache.store_snapshot(PX4.key, 1, rich, reason="", at=NOW).params == replace(
            rich, component=1, system=1, identity=PX4, at=NOW, source=f"snapshot 2 of {PX4.key}"
        )
        assert not cache.notes
