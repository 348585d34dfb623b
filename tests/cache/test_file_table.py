"""A parameter file as the cached table of a vehicle. `test_store` runs these tests with PostgreSQL too."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamCache, ParamType, Trust, UnknownVehicle, UsageError
from paramclient.cache import TableState
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.px4_hash import hash_params
from tests.caches import NOW, PX4, stored, update, values, whole_table

OTHER = replace(PX4, uid="0002000000003331383300012345679999ff", system=2)
"""Another vehicle with the same firmware."""
COPTER = replace(PX4, uid="0003ab", autopilot=3, system=3)


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[ParamCache]:
    with ParamCache(tmp_path / "cache") as cache:
        yield cache


def file(
    typed: bool = True, *, at: float | None = NOW + 60, source: str = "quad.params", **given: Any
) -> ParamSet:
    """The parameters of a file, as INT32 or without types."""
    kind = ParamType.INT32 if typed else None
    params = {name: WrittenParam(name, value, kind) for name, value in given.items()}
    return ParamSet(params, at=at, source=source)


THREE: dict[str, Any] = {"PARAM_2": 5, "PARAM_0": 6, "PARAM_1": 7}


def test_a_file_becomes_the_table_and_is_marked(cache: ParamCache) -> None:
    cache.save(whole_table(3))
    added = cache.add(file(**THREE), PX4.key)
    assert (added.key, added.component, added.size, added.complete) == (PX4.key, 1, 3, True)
    assert added.at == NOW + 60
    table = cache.component()
    assert values(cache) == THREE
    assert (table.source, table.complete, table.count, table.synced_at) == ("quad.params", True, 3, None)
    assert {param.trust for param in table.params.values()} == {Trust.CACHED}
    assert table.heard_at["PARAM_2"] == NOW + 60
    assert table.hash == added.hash == hash_params(table.params.values())
    assert [param.index for param in table.params.values()] == [0, 1, 2]
    assert [each.source for each in cache.components()] == ["quad.params"]
    lines = cache.history(PX4.key)
    assert {(each.name, each.new and each.new.value, each.by) for each in lines} == {
        (name, value, "file quad.params") for name, value in THREE.items()
    }


def test_the_mark_goes_when_the_vehicle_has_confirmed_or_replaced_the_table(cache: ParamCache) -> None:
    cache.save(whole_table(3))
    cache.add(file(**THREE), PX4.key)
    cache.save(update(stored("PARAM_0", 8, at=NOW + 70), at=NOW + 70))
    partial = TableState(count=3, complete=True)
    cache.save(update(stored("PARAM_1", 8, at=NOW + 71), at=NOW + 71, table=partial))
    assert cache.component().source == "quad.params", "one value was read, not the table"
    cache.save(update(at=NOW + 80, table=replace(partial, synced_at=NOW + 80)))
    assert cache.component().source is None
    assert cache.component().params["PARAM_0"].value == 8


def test_a_table_that_was_received_later_is_replaced_only_with_force(cache: ParamCache) -> None:
    cache.save(whole_table(3))
    with pytest.raises(UsageError, match=r"was received at .*, later than the values of the file"):
        cache.add(file(at=NOW - 60, **THREE), PX4.key)
    assert values(cache) == {"PARAM_0": 0, "PARAM_1": 1, "PARAM_2": 2}
    added = cache.add(file(at=NOW - 60, **THREE), PX4.key, force=True)
    assert added.at > NOW - 60
    assert values(cache) == THREE
    # a table that is itself from a file has no observation to lose
    cache.add(file(at=NOW - 90, source="second.params", **{**THREE, "PARAM_0": 9}), PX4.key)
    assert values(cache)["PARAM_0"] == 9
    assert cache.component().source == "second.params"


def test_types_and_volatile_names_are_from_the_previous_table(cache: ParamCache) -> None:
    whole = [
        stored("PARAM_0", 0, index=0, volatile=False),
        stored("PARAM_1", 0, ParamType.REAL32, index=1, volatile=False),
        stored("PARAM_2", 2, index=2, volatile=True),
    ]
    state = TableState(0x1234, 3, complete=True, volatile_known=True, synced_at=NOW)
    cache.save(update(*whole, replace=True, table=state))
    cache.add(file(typed=False, PARAM_0=1, PARAM_1=2.5, PARAM_2=3), "1")
    table = cache.component()
    assert [param.type for param in table.params.values()] == [
        ParamType.INT32,
        ParamType.REAL32,
        ParamType.INT32,
    ]
    assert table.hash == hash_params(table.params.values(), leave_out=["PARAM_2"])
    assert table.volatile == {"PARAM_2"}


def test_types_are_from_another_table_of_the_same_firmware(cache: ParamCache) -> None:
    cache.save(whole_table(3, OTHER))
    added = cache.add(file(typed=False, **THREE), PX4)
    assert added.complete
    assert values(cache) == THREE
    assert cache.component(PX4.key).hash == hash_params(cache.component(PX4.key).params.values())
    with pytest.raises(UsageError, match=r"quad.params has no types .* no cached table of its"):
        cache.add(file(typed=False, **THREE), replace(PX4, uid="0002ff", firmware=1, git_hash="b0"))


def test_files_without_types_or_with_invalid_values_are_refused(cache: ParamCache) -> None:
    cache.save(whole_table(3))
    with pytest.raises(UsageError, match=r"lacks them: NO_SUCH\. Fetch the vehicle"):
        cache.add(file(typed=False, **THREE, NO_SUCH=1), PX4.key)
    wrong = ParamSet({"PARAM_0": WrittenParam("PARAM_0", 300, ParamType.UINT8)}, at=NOW + 60)
    with pytest.raises(UsageError, match="300"):
        cache.add(wrong, PX4.key)
    with pytest.raises(UsageError, match="has no parameters"):
        cache.add(file(), PX4.key)
    with pytest.raises(UsageError, match="does not name its vehicle"):
        cache.add(file(**THREE))
    with pytest.raises(UnknownVehicle):
        cache.add(file(**THREE), "77")
    assert values(cache) == {"PARAM_0": 0, "PARAM_1": 1, "PARAM_2": 2}
    assert cache.component().source is None


def test_a_file_that_lacks_parameters_makes_an_incomplete_table(cache: ParamCache) -> None:
    cache.save(whole_table(3))
    added = cache.add(file(PARAM_0=7), PX4.key)
    assert (added.complete, added.hash) == (False, None)
    assert "lacks 2 parameters of the cached table of 1/1" in added.notes[0]
    table = cache.component()
    assert (table.complete, table.hash, table.source) == (False, None, "quad.params")


def test_the_vehicle_may_be_that_of_the_file(cache: ParamCache) -> None:
    own = replace(file(**THREE), identity=PX4)
    assert cache.add(own).key == PX4.key
    assert cache.add(own, "1").key == PX4.key
    with pytest.raises(UnknownVehicle):
        cache.add(own, "2")
    other = cache.add(own, OTHER)
    assert (other.key, other.notes[0]) == (OTHER.key, f"the file is of another vehicle: {PX4.key}")


def test_a_vehicle_without_a_hash_gets_none(cache: ParamCache) -> None:
    added = cache.add(file(**THREE), COPTER)
    assert (added.hash, added.complete) == (None, True)
    assert added.notes[-1] == "the next fetch downloads the table and replaces these values"
    assert [each.index for each in cache.component().params.values()] == [0, 1, 2]


def test_the_mark_is_copied_with_the_table(cache: ParamCache, tmp_path: Path) -> None:
    cache.save(whole_table(3))
    cache.add(file(**THREE), PX4.key)
    with ParamCache(tmp_path / "copy") as copy:
        cache.copy_to(copy)
        assert copy.component().source == "quad.params"
        assert values(copy) == THREE
