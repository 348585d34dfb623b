"""Tables in a file and in a database: what is stored, which of two observations counts, when a hash holds."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from paramclient.cache import ParamCache, StoredParam, TableState, TableUpdate
from paramclient.errors import UsageError
from paramclient.model.px4_hash import hash_bits
from paramclient.model.values import Param, ParamType, Trust, ext_param, from_bits
from tests.cache.conftest import Open
from tests.caches import NOW, PX4, stored, update, values, whole_table

CAMERA = replace(PX4, uid="ca", system=3)


def params_of(*bits: int) -> list[Param]:
    return [
        Param(f"P_{index}", from_bits(each, 6), ParamType.INT32, index, each)
        for index, each in enumerate(bits)
    ]


def hashed_table(*bits: int, at: float = NOW) -> TableUpdate:
    """A whole table with the hash that a PX4 announces of it."""
    params = params_of(*bits)
    digest = hash_bits({each.name: each.bits for each in params})
    state = TableState(digest, len(params), complete=True, volatile_known=True, synced_at=at)
    return update(*(StoredParam.of(each, at, False) for each in params), at=at, table=state, replace=True)


# what is stored


def test_a_table_is_read_as_it_was_written(cache: ParamCache, open_cache: Open) -> None:
    kinds = {
        "NAN": (ParamType.REAL32, 0x7FC00001),
        "NEGATIVE": (ParamType.INT32, 0xFFFFFFFF),
        "BYTE": (ParamType.UINT8, 0xFF),
        "LARGE": (ParamType.UINT64, (1 << 64) - 1),
        "DOUBLE": (ParamType.REAL64, 0x8000000000000000),
        "UNKNOWN": (77, 0xDEADBEEF),
    }
    params = [
        Param(name, from_bits(bits, kind), kind, index, bits, Trust.CACHED)
        for index, (name, (kind, bits)) in enumerate(kinds.items())
    ]
    raw = Param("RAW", b"\1\2\3\4", ParamType.INT64, None, 0x04030201, Trust.CACHED)
    table = [*params, raw, replace(params[1], name="WITH_DEFAULT", index=6, default=-5)]
    cache.save(update(*(StoredParam.of(each, NOW) for each in table), table=TableState(None, 7)))
    found = open_cache().component(PX4.key)
    kept = {name: (param, param.default) for name, param in found.params.items()}
    assert kept == {each.name: (each, each.default) for each in table}
    assert list(found.params) == [*kinds, "WITH_DEFAULT", "RAW"]
    assert (found.size, found.count, found.complete, found.hash) == (8, 7, False, None)
    assert found.heard_at["NAN"] == NOW


def test_a_vehicle_and_its_components(cache: ParamCache) -> None:
    cache.save([whole_table(2), whole_table(1, component=100), whole_table(3, CAMERA)])
    cache.save(update(at=NOW + 60))
    first, second = cache.vehicles()
    assert (first.key, first.identity, first.components) == (PX4.key, PX4, (1, 100))
    assert (first.first_seen, first.last_seen) == (NOW, NOW + 60)
    assert (second.identity, second.components) == (CAMERA, (1,))
    assert [(each.key, each.component, each.size) for each in cache.components()] == [
        (PX4.key, 1, 2),
        (PX4.key, 100, 1),
        (CAMERA.key, 1, 3),
    ]
    assert cache.component(system=3).size == 3
    assert cache.remove("1", 100) == 1
    assert cache.remove(PX4.key) == 1
    assert [each.key for each in cache.vehicles()] == [CAMERA.key]


def test_extended_parameters_are_apart(cache: ParamCache) -> None:
    text = ext_param("P_0", b"caf\xc3\xa9", ParamType.CUSTOM, 0, Trust.CACHED)
    number = ext_param("P_1", b"\7\0", ParamType.UINT16, 1, Trust.CACHED)
    rows = [StoredParam.of(each, NOW) for each in (text, number)]
    cache.save(update(*rows, table=TableState(count=2, complete=True), component=100, extended=True))
    found = cache.component(PX4.key, component=100, extended=True)
    assert dict(found.params) == {"P_0": text, "P_1": number}
    assert (found.count, found.complete) == (2, True)
    assert found.params["P_0"].value == "café"
    cameras = [(each.key, each.component, each.size) for each in cache.components(extended=True)]
    assert cameras == [(PX4.key, 100, 2)]
    assert [(each.component, each.size) for each in cache.components()] == [(100, 0)]
    other = ext_param("P_0", b"tea", ParamType.CUSTOM, 0)
    cache.save(update(StoredParam.of(other, NOW + 1, by="us"), at=NOW + 1, component=100, extended=True))
    [entry] = cache.history("1", extended=True)
    assert (entry.old.value, entry.new and entry.new.value, entry.by) == ("café", "tea", "us")
    assert cache.history("1") == []
    assert cache.remove("1") == 1
    assert cache.load(PX4.key, 100, extended=True) is None


def test_an_update_with_an_invalid_time_writes_nothing(cache: ParamCache) -> None:
    for at in (-1.0, 1e12, float("nan")):
        with pytest.raises(UsageError, match="unix seconds"):
            cache.save([whole_table(1), update(stored("A", 1, at=at))])
    assert cache.vehicles() == []


def test_defaults_stay_until_the_firmware_is_another(cache: ParamCache) -> None:
    param = Param("A", 2, ParamType.INT32, 0, 2, default=3)
    cache.save(update(StoredParam.of(param, NOW), table=TableState(None, 1, complete=True, file_works=True)))
    cache.save(update(stored("A", 1, at=NOW + 0.5)))  # of a program that does not know it
    assert cache.component("1").params["A"].default == 3
    cache.save(update(at=NOW + 1, identity=replace(PX4, firmware=5)))
    table = cache.component("1")
    assert (table.params["A"].default, table.file_works) == (None, None)
    assert table.params["A"].value == 1


def test_a_durable_write_is_on_the_disk(cache: ParamCache, open_cache: Open) -> None:
    cache.save(whole_table(2))
    cache.save((), durable=True)
    cache.save(update(stored("PARAM_0", 5, at=NOW + 1), at=NOW + 1), durable=True)
    assert values(open_cache()) == {"PARAM_0": 5, "PARAM_1": 1}


# which observation counts


def test_an_older_identity_does_not_replace_a_newer_one(cache: ParamCache) -> None:
    cache.save(update(at=NOW + 10, identity=replace(PX4, firmware=2)))
    cache.save(update(at=NOW, identity=replace(PX4, firmware=1)))
    [vehicle] = cache.vehicles()
    assert (vehicle.identity.firmware, vehicle.first_seen, vehicle.last_seen) == (2, NOW, NOW + 10)


def test_a_whole_table_removes_other_names(cache: ParamCache) -> None:
    cache.save(whole_table(3))
    cache.save(update(stored("PARAM_0", 0, index=0, at=NOW + 2), at=NOW + 2, replace=True))
    assert values(cache) == {"PARAM_0": 0}
    lines = [(line.at, line.name, line.new) for line in cache.history("1")]
    assert lines == [(NOW + 2, "PARAM_1", None), (NOW + 2, "PARAM_2", None)]


def test_an_older_table_or_removal_keeps_names_that_were_observed_later(cache: ParamCache) -> None:
    cache.save(update(stored("NEW", 1, at=NOW + 5), at=NOW + 5))
    cache.save([whole_table(2), update(removed={"NEW": NOW + 4}, at=NOW + 6)])
    table = cache.component("1")
    assert set(table.params) == {"NEW", "PARAM_0", "PARAM_1"}
    assert (table.hash, table.complete) == (None, False)


Event = tuple[int, int, int]
"""Name, time and value of an observation."""


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 30), st.integers(0, 2)),
        max_size=25,
        unique_by=lambda event: event[:2],
    ),
    st.randoms(use_true_random=False),
)
def test_two_writers_in_any_order(place: str, events: list[Event], random: Random) -> None:
    """The newest values are stored, and each line of history connects two observations in their order."""
    batches = [events[at : at + 3] for at in range(0, len(events), 3)]
    random.shuffle(batches)
    with ParamCache(place) as one, ParamCache(place) as other:
        if one.vehicles():
            one.remove(PX4.key)
        for number, batch in enumerate(batches):
            batch.sort(key=lambda event: event[1])
            items = [stored(f"P_{name}", value, at=NOW + at) for name, at, value in batch]
            (one, other)[number % 2].save(update(*items, at=max(item.heard_at for item in items)))
        kept = values(one)
        lines = other.history(PX4.key) if events else []
    newest = {name: value for name, _, value in sorted(events, key=lambda event: event[1])}
    assert kept == {f"P_{name}": value for name, value in newest.items()}
    seen = {(f"P_{name}", NOW + at): value for name, at, value in events}
    last: dict[str, object] = {}
    for line in lines:
        assert line.new is not None
        assert seen[line.name, line.at] == line.new.value != line.old.value
        assert any(
            name == line.name and at < line.at and value == line.old.value
            for (name, at), value in seen.items()
        )
        assert last.get(line.name, line.old.value) == line.old.value
        last[line.name] = line.new.value
    assert all(kept[name] == value for name, value in last.items())


# when a hash holds


def later(name: str, bits: int, seconds: float = 1, **more: Any) -> TableUpdate:
    """One value that is received later than the table."""
    index, volatile = more.pop("index", None), more.pop("volatile", None)
    row = stored(name, bits, index=index, volatile=volatile, at=NOW + seconds)
    return update(row, at=NOW + seconds, **more)


@pytest.mark.parametrize(
    ("updates", "is_kept"),
    [
        ([], True),
        ([later("P_0", 9)], False),
        ([later("V", 1, index=3, volatile=True), later("V", 2, 2)], True),
        ([later("P_0", 9, 5), hashed_table(1, 2, 3, at=NOW + 4)], False),
        ([later("P_0", 9), later("P_1", 8, 2, table=hashed_table(1, 8, 3).table)], False),
        ([later("P_0", 1, table=TableState(None, 3))], True),
        ([later("P_0", 1, table=TableState(None, 4))], False),
    ],
    ids=["nothing", "a change", "volatile", "overtaken", "by others", "received less", "another count"],
)
def test_a_hash_stays_while_it_holds(cache: ParamCache, updates: list[TableUpdate], is_kept: bool) -> None:
    """Two programs may write the changes that each has received, and the hash of what each holds."""
    cache.save(hashed_table(1, 2, 3))
    for each in updates:
        cache.save(each)
    table, digest = cache.component("1"), hash_bits({each.name: each.bits for each in params_of(1, 2, 3)})
    assert table.hash == (digest if is_kept else None)
    assert not is_kept or (table.complete, table.volatile_known, table.synced_at) == (True, True, NOW)


def test_the_time_of_a_later_proof_by_another_program_stays(cache: ParamCache) -> None:
    cache.save(hashed_table(1, 2, 3, at=NOW + 5))
    cache.save(later("P_0", 9, 6, table=hashed_table(9, 2, 3).table))
    assert cache.component("1").synced_at == NOW + 5


def test_a_part_of_a_table_is_not_complete(cache: ParamCache) -> None:
    """The table was removed while a program still used it, which writes a single change of it."""
    cache.save(update(stored("PARAM_0", 1, index=0), table=TableState(0xCF579589, 3, complete=True)))
    assert (cache.component("1").complete, cache.component("1").hash) == (False, None)
