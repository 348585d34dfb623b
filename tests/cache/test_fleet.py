"""The same parameters of many vehicles beside each other: who differs, and since when."""

from __future__ import annotations

import math
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient.cache import FleetDiff, FleetVehicle, Holder, NameSpread, ParamCache, TableState, fleet
from paramclient.cache.fleet import Cells, spread
from paramclient.errors import CacheError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, bits_of, same_bits
from tests.caches import NOW, PX4, set_aside, stored, update

REAL32, INT32 = ParamType.REAL32, ParamType.INT32
DONE = TableState(complete=True)
VEHICLES = [replace(PX4, system=number, uid=f"{number:04x}") for number in range(1, 6)]


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[ParamCache]:
    with ParamCache(tmp_path / "cache") as cache:
        yield cache


def wanted(**values: Any) -> ParamSet:
    return ParamSet({name: WrittenParam(name, value) for name, value in values.items()})


def reported(spread: NameSpread) -> list[tuple[Any, list[int], bool]]:
    """Values, the systems that have them, and whether they agree."""
    return [
        (each.param.value, sorted(holder.vehicle.system for holder in each.holders), each.agrees)
        for each in spread.values
    ]


def systems(holders: tuple[Holder, ...]) -> list[int]:
    return [holder.vehicle.system for holder in holders]


def since(spread: NameSpread) -> dict[int, tuple[float | None, bool]]:
    """Of those that stand out, by system: seconds after NOW, and whether it is a change."""
    holders = [holder for each in spread.values if not each.agrees for holder in each.holders]
    return {
        holder.vehicle.system: (None if holder.since is None else holder.since - NOW, holder.changed)
        for holder in (*holders, *spread.lacking)
    }


def names_of(found: FleetDiff) -> list[str]:
    return [each.name for each in found.names]


# Comparing


def test_vehicles_are_compared_with_each_other_by_what_most_of_them_have(cache: ParamCache) -> None:
    for number, identity in enumerate(VEHICLES):
        cache.save(update(stored("A", int(number == 2)), stored("B", 7), identity=identity, table=DONE))
    found = cache.fleet_diff(["A", "B"])
    assert found.differs
    assert [vehicle.system for vehicle in found.vehicles] == [1, 2, 3, 4, 5]
    assert [each.differs for each in found.names] == [True, False]
    assert [reported(each) for each in found.names] == [
        [(0, [1, 2, 4, 5], True), (1, [3], False)],
        [(7, [1, 2, 3, 4, 5], True)],
    ]
    assert not cache.fleet_diff(["B"]).differs


def test_a_vehicle_lacks_only_parameters_of_its_own_autopilot(cache: ParamCache) -> None:
    other = [replace(PX4, autopilot=3, system=number, uid=f"{number:04x}") for number in (7, 8)]
    for identity, name in zip([*VEHICLES[:2], *other], ("P", "Q", "A", "A"), strict=True):
        cache.save(update(stored(name, 1), stored("BOTH", 2), identity=identity, table=DONE))
    found = cache.fleet_diff(["*"])
    assert {each.name: systems(each.lacking) for each in found.names} == {
        "A": [],
        "BOTH": [],
        "P": [2],
        "Q": [1],
    }
    [of_file] = cache.fleet_diff(wanted(A=1)).names
    assert sorted(systems(of_file.lacking)) == [1, 2]


def test_two_equally_common_values_are_both_listed_as_differing(cache: ParamCache) -> None:
    for number, identity in enumerate(VEHICLES[:4]):
        cache.save(update(stored("A", number % 2), identity=identity, table=DONE))
    [each] = cache.fleet_diff(["A"]).names
    assert reported(each) == [(0, [1, 3], False), (1, [2, 4], False)]


def test_vehicles_are_compared_with_wanted_values_in_the_type_that_each_has(cache: ParamCache) -> None:
    tenth = bits_of(0.1, REAL32)
    cache.save(update(stored("F", tenth, REAL32), stored("N", 3), identity=VEHICLES[0], table=DONE))
    cache.save(
        update(stored("F", tenth + 1, REAL32), stored("N", 3, REAL32), identity=VEHICLES[1], table=DONE)
    )
    cache.save(update(stored("F", 0x80000000, REAL32), stored("N", 3, 77), identity=VEHICLES[2], table=DONE))
    found = cache.fleet_diff(wanted(F=0.1, N=3))
    assert names_of(found) == ["F", "N"]
    assert [each.wanted and each.wanted.value for each in found.names] == [0.1, 3]
    assert {tuple(owners): agrees for _, owners, agrees in reported(found.names[0])} == {
        (1,): True, (2,): False, (3,): False,
    }  # fmt: skip
    assert {tuple(owners): agrees for _, owners, agrees in reported(found.names[1])} == {
        (1,): True, (2,): False, (3,): False,
    }  # fmt: skip


def test_a_zero_has_no_sign_here_and_a_nan_is_itself(cache: ParamCache) -> None:
    for identity, zero, nan in zip(
        VEHICLES, [0, 0x80000000, 0], [0x7FC00000, 0x7FC00000, 0x7FC00001], strict=False
    ):
        cache.save(update(stored("Z", zero, REAL32), stored("N", nan, REAL32), identity=identity, table=DONE))
    zeros, nans = cache.fleet_diff(["Z", "N"]).names
    assert reported(zeros) == [(0.0, [1, 2, 3], True)]
    assert [(owners, agrees) for _, owners, agrees in reported(nans)] == [([1, 2], True), ([3], False)]
    assert not cache.fleet_diff(wanted(Z=-0.0)).differs


def test_a_vehicle_without_the_parameter_is_lacking_and_one_with_an_incomplete_table_is_unknown(
    cache: ParamCache,
) -> None:
    cache.save(update(stored("A", 1), identity=VEHICLES[0], table=DONE))
    cache.save(update(stored("B", 1), identity=VEHICLES[1], table=DONE))
    cache.save(update(stored("B", 1), identity=VEHICLES[2]))
    [each] = cache.fleet_diff(["A"]).names
    assert (reported(each), systems(each.lacking), systems(each.unknown)) == ([(1, [1], True)], [2], [3])
    assert each.differs
    cache.remove(VEHICLES[1].key)
    [each] = cache.fleet_diff(["A"]).names
    assert (systems(each.lacking), systems(each.unknown), each.differs) == ([], [3], True)
    [unheld] = cache.fleet_diff(wanted(NONE=1)).names
    assert (unheld.values, systems(unheld.lacking), systems(unheld.unknown)) == ((), [1], [3])


def test_only_the_component_that_is_meant_is_looked_at(cache: ParamCache) -> None:
    cache.save([update(stored("A", 1)), update(stored("A", 2), component=154)])
    assert reported(cache.fleet_diff(["A"]).names[0]) == [(1, [1], True)]
    assert reported(cache.fleet_diff(["A"], component=154).names[0]) == [(2, [1], True)]
    assert cache.fleet_diff(replace(wanted(A=2), component=154)).component == 154
    assert not cache.fleet_diff(replace(wanted(A=2), component=154)).differs
    assert cache.fleet_diff(replace(wanted(A=2), component=154), component=1).differs
    with pytest.raises(CacheError, match="holds no table of component 9"):
        cache.fleet_diff(["A"], component=9)


def test_names_may_be_patterns(cache: ParamCache) -> None:
    names = ["MC_ROLL_P", "MC_PITCH_P", "mc_x", "MC[1]", "MD"]
    cache.save(update(*(stored(name, 1) for name in names[:3]), identity=VEHICLES[0], table=DONE))
    cache.save(update(*(stored(name, 1) for name in names[3:]), identity=VEHICLES[1], table=DONE))

    def fits(*patterns: str) -> list[str]:
        return names_of(cache.fleet_diff(patterns))

    assert fits("MC_*") == ["MC_PITCH_P", "MC_ROLL_P"]
    assert fits("MC*") == ["MC[1]", "MC_PITCH_P", "MC_ROLL_P"]
    assert fits("*_P", "MC_ROLL_P", "MD") == ["MC_PITCH_P", "MC_ROLL_P", "MD"]
    assert fits("M?") == ["MD"]
    assert fits("[m]*") == ["mc_x"]
    assert fits("*") == sorted(names)
    for nothing in ("MC", "MX*", "mc_", "%"):
        with pytest.raises(CacheError, match=r"no vehicle in the cache .* has a parameter "):
            fits("MD", nothing)
    with pytest.raises(CacheError, match="holds no table"):
        cache.fleet_diff(["MC*"], component=2)


def test_more_names_than_a_statement_takes_are_no_matter(
    cache: ParamCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet, "_NAMES_PER_STATEMENT", 3)
    cache.save(update(*(stored(f"P{number}", number) for number in range(10)), table=DONE))
    want = wanted(**{f"P{number}": 0 for number in range(10)})
    assert [each.differs for each in cache.fleet_diff(want).names] == [False, *[True] * 9]


def test_damage_during_a_comparison_is_reported_as_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    with ParamCache(path) as cache:
        cache.save(update(stored("A", 1), table=DONE))
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("UPDATE packed SET params = 'much'")
    with ParamCache(path) as cache:
        with pytest.raises(CacheError, match="holds no table"):
            cache.fleet_diff(wanted(A=1))
        assert "a table is 'much'" in cache.notes[0]
    assert len(set_aside(path)) == 1


# Since when


def test_vehicles_that_differ_have_the_time_of_the_change(cache: ParamCache) -> None:
    for identity in VEHICLES:
        cache.save(update(stored("A", 1), stored("B", 1), identity=identity, table=DONE))
    changed, reborn, gone, new = VEHICLES[1:]

    def later(after: float, identity: Any, *items: tuple[str, int], removed: Any = ()) -> None:
        params = [stored(name, bits, at=NOW + after) for name, bits in items]
        cache.save(update(*params, identity=identity, at=NOW + after, removed=removed))

    later(10, changed, ("A", 2))
    later(20, changed, ("A", 3), ("B", 1))
    later(30, reborn, removed=["A"])
    later(40, reborn, ("A", 4))
    later(50, gone, ("A", 5))
    later(60, gone, removed=["A"])
    later(70, new, ("N", 9))
    a, b = cache.fleet_diff(wanted(A=1, B=2)).names
    assert since(a) == {2: (20, True), 3: (40, True), 4: (60, True)}
    assert since(b) == dict.fromkeys(range(1, 6), (0, False)), "so it was found"
    [n] = cache.fleet_diff(wanted(N=1)).names
    assert since(n) == {5: (70, True), **dict.fromkeys(range(1, 5), (None, False))}
    assert all(holder.since is None for each in a.values if each.agrees for holder in each.holders)


def test_a_change_after_the_return_of_a_name_is_the_latest(cache: ParamCache) -> None:
    cache.save(update(stored("A", 1), table=DONE))
    for after, item in ((10, None), (20, 2), (30, 3)):
        params = [] if item is None else [stored("A", item, at=NOW + after)]
        cache.save(update(*params, at=NOW + after, removed=["A"]))
    assert since(cache.fleet_diff(wanted(A=9)).names[0]) == {1: (30, True)}


def test_a_table_that_was_never_complete_has_the_time_of_its_last_value(cache: ParamCache) -> None:
    cache.save(update(stored("A", 1)))
    cache.save(update(stored("A", 1, at=NOW + 5), at=NOW + 5))
    assert since(cache.fleet_diff(wanted(A=9)).names[0]) == {1: (5, False)}


def test_a_value_that_was_received_before_the_table_was_complete_was_so_then(cache: ParamCache) -> None:
    cache.save(update(stored("A", 1)))
    cache.save(update(stored("B", 1, at=NOW + 5), at=NOW + 5, table=DONE))
    cache.save(update(stored("B", 1, at=NOW + 9), at=NOW + 9))
    found = cache.fleet_diff(wanted(A=9, B=9)).names
    assert [since(each) for each in found] == [{1: (0, False)}, {1: (5, False)}]


# The function


HOLDERS = [Holder(FleetVehicle(f"uid:{number:04x}", number, number % 3 > 0)) for number in range(12)]
VALUES = st.tuples(
    st.sampled_from([int(INT32), int(REAL32), 77]),
    st.sampled_from([0, 1, 0x80000000, 0x7FC00000, 0x3F800000]),
    st.sampled_from([0, 1]),
)


@given(
    st.lists(st.one_of(st.none(), VALUES), min_size=1, max_size=12),
    st.one_of(st.none(), st.sampled_from([0, 1, -0.0, 1.0, math.nan, b"\0\0\0\0"])),
)
@settings(max_examples=200, deadline=None)
def test_every_vehicle_stands_once_beside_those_of_the_same_value(
    held: list[tuple[int, int, int] | None], value: Any
) -> None:
    want = None if value is None else WrittenParam("A", value)
    values: dict[Cells, list[Holder]] = {}
    for holder, each in zip(HOLDERS, held, strict=False):
        if each is not None:
            values.setdefault(each, []).append(holder)
    without = [holder for holder, each in zip(HOLDERS, held, strict=False) if each is None]
    found = spread("A", want, values, without)
    placed = [holder for each in found.values for holder in each.holders]
    placed += [*found.lacking, *found.unknown]
    assert sorted(placed, key=HOLDERS.index) == HOLDERS[: len(held)]
    assert {holder.vehicle.complete for holder in found.lacking} <= {True}
    assert {holder.vehicle.complete for holder in found.unknown} <= {False}
    group = {
        holder.vehicle.system: number for number, each in enumerate(found.values) for holder in each.holders
    }
    for a, first in enumerate(held):
        for b, second in enumerate(held):
            if first is not None and second is not None:
                same = (first[0], bool(first[2]) or first[0] == 77) == (
                    second[0], bool(second[2]) or second[0] == 77
                ) and same_bits(first[0], first[1], second[1])  # fmt: skip
                assert (group[a] == group[b]) == same
    counts = [len(each.holders) for each in found.values]
    assert counts == sorted(counts, reverse=True)
    agreeing = [number for number, each in enumerate(found.values) if each.agrees]
    if want is not None:
        assert agreeing == [number for number, each in enumerate(found.values) if want.is_held_by(each.param)]
    else:
        assert agreeing == ([0] if counts and counts.count(counts[0]) == 1 else [])
    assert found.differs == (len(agreeing) < len(counts) or bool(without))


def test_a_value_is_given_to_the_last_bit() -> None:
    found = spread("A", None, {(int(REAL32), 0x3DCCCCCD, 0): HOLDERS[:1]})
    assert found.values[0].param.value == struct.unpack("<f", b"\xcd\xcc\xcc\x3d")[0]
