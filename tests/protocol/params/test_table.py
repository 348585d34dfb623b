"""The table: what is known of a component's parameters, and how far."""

from __future__ import annotations

import pytest
from paramclient.protocol.params import table as room
from paramclient.protocol.params.table import Table

from paramclient.model.px4_hash import hash_params
from paramclient.model.values import Encoding, Param, ParamType, Trust, as_reported
from paramclient.protocol.events import Change
from paramclient.wire.messages import ParamValue
from tests.simulation import known, listed, param_value


def test_a_first_value() -> None:
    table = Table()
    change = table.store_value(param_value("A", 1.5, index=3), "vehicle")
    param = table.params["A"]
    assert change == Change("A", None, param, "vehicle")
    assert (param.value, param.type, param.index, param.trust) == (1.5, ParamType.REAL32, 3, Trust.LIVE)
    assert table.take_dirty() == {"A": "vehicle"}
    assert table.take_dirty() == {}


def test_minus_zero_is_no_change_of_zero() -> None:
    table = Table()
    table.store_value(param_value("A", 0.0, index=0), "vehicle")
    assert table.store_value(param_value("A", -0.0, index=0), "vehicle") is None


def test_a_change_of_type_is_a_change() -> None:
    table = Table()
    table.store_value(param_value("A", 0.0, index=0), "vehicle")
    change = table.store_value(param_value("A", 0, index=0, kind=ParamType.INT32), "vehicle")
    assert change is not None
    assert table.params["A"].type is ParamType.INT32
    assert table.params["A"].value == 0


def test_another_encoding_uses_the_type_received_last() -> None:
    table = Table()
    table.store_value(param_value("A", 5.0, index=0), "vehicle")
    raw = param_value("A", 5.0, index=0).raw
    table.store_value(ParamValue("A", raw, ParamType.INT16, 1, 0), "vehicle")
    table.store_value(ParamValue("X", raw, 77, 1, 0), "vehicle")
    table.use_encoding(Encoding.C_CAST)
    assert (table.params["A"].value, table.params["A"].type) == (5, ParamType.INT16)
    assert (table.params["X"].settable, table.params["X"].type_number) == (raw, 77)


def test_index_65535_keeps_the_one_that_is_known() -> None:
    table = Table()
    table.store_value(param_value("A", 1.0, index=3), "vehicle")
    table.store_value(param_value("A", 2.0), "vehicle")
    assert table.params["A"].index == 3
    table.store_value(param_value("B", 2.0), "vehicle")
    assert table.params["B"].index is None
    assert [param.name for param in listed(table)] == ["A"]


@pytest.mark.parametrize(("index", "count"), [(10, 10), (900, 10), (3, 65535), (0, 0)])
def test_an_index_that_cannot_be_is_none_but_the_value_counts(index: int, count: int) -> None:
    table = Table()
    table.store_value(param_value("A", 2.0, index=index, count=count), "vehicle")
    assert table.params["A"].index is None
    assert table.params["A"].value == 2.0


def test_a_table_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "NAMES_MAX", 3)
    table = Table()
    for number in range(10):
        table.store_value(param_value(f"N{number}", 1.0), "vehicle")
    assert list(table.params) == ["N0", "N1", "N2"]
    assert set(table.take_dirty()) == {"N0", "N1", "N2"}
    table.store_value(param_value("N1", 5.0), "vehicle")
    assert table.params["N1"].value == 5.0


def test_other_evidence_of_the_encoding_gives_other_values() -> None:
    table = Table()
    for name, value in (("I", 1234.0), ("F", 2.5)):
        kind = ParamType.INT32 if name == "I" else ParamType.REAL32
        table.store_value(param_value(name, value, index=0, kind=kind, encoding=Encoding.C_CAST), "vehicle")
    assert table.params["I"].value == 0x449A4000
    table.take_dirty()
    changes = table.use_encoding(Encoding.C_CAST)
    assert table.encoding is Encoding.C_CAST
    assert [change.name for change in changes] == ["I"]
    assert table.params["I"].value == 1234
    assert table.params["F"].value == 2.5
    assert table.take_dirty() == {"I": "vehicle"}
    assert table.use_encoding(Encoding.C_CAST) == []
    assert table.store_value(param_value("I", 1234.0, index=0, kind=6, encoding=Encoding.C_CAST), "x") is None


# what the cache knows


def test_the_cache_fills_in_what_was_not_received() -> None:
    table = Table()
    table.store_value(param_value("A", 9.0, index=0), "vehicle")
    changes = table.fill({"A": known("A", 1.0), "B": known("B", 2.0, index=1)})
    assert [change.name for change in changes] == ["B"]
    assert table.params["A"].value == 9.0
    assert table.params["B"].trust is Trust.CACHED
    assert "B" not in table.take_dirty()


def test_the_vehicles_hash_makes_cached_values_verified_and_leaves_live_ones() -> None:
    table = Table()
    table.store_value(param_value("A", 9.0, index=0), "vehicle")
    table.fill({name: known(name, 2.0, index=index) for name, index in (("B", 1), ("C", 2), ("D", None))})
    table.confirm(5, frozenset("C"), proven=True)
    table.verify()
    trusts = {name: param.trust for name, param in table.params.items()}
    assert trusts == {"A": Trust.LIVE, "B": Trust.VERIFIED, "C": Trust.CACHED, "D": Trust.CACHED}
    assert table.unhashed() == {"C"}


def test_a_hash_that_may_leave_out_anything_verifies_nothing() -> None:
    table = Table()
    table.fill({name: known(name, 2.0, index=index) for name, index in (("A", 0), ("B", 1), ("C", None))})
    table.confirm(5, frozenset("B"), proven=False)
    table.verify()
    assert {param.trust for param in table.params.values()} == {Trust.CACHED}
    assert table.unhashed() == {"A", "B"}


# the hash


def hashed(*, proven: bool) -> Table:
    table = Table()
    for index, name in enumerate("ABV"):
        table.store_value(param_value(name, 1.0, index=index), "vehicle")
    table.confirm(hash_params(listed(table), leave_out="V"), frozenset("V"), proven=proven)
    return table


def test_a_hash_follows_the_values_once_it_is_known_what_it_covers() -> None:
    table = hashed(proven=True)
    before = table.hash
    table.store_value(param_value("A", 2.0, index=0), "us")
    assert table.hash == hash_params(listed(table), leave_out="V") != before
    table.store_value(param_value("A", 1.0, index=0), "us")
    assert table.hash == before


def test_a_hash_that_cannot_be_computed_ends_with_the_first_change() -> None:
    table = hashed(proven=False)
    before = hash_params(listed(table), leave_out="V")
    table.store_value(param_value("V", 2.0, index=2), "vehicle")
    assert table.hash == before
    table.store_value(param_value("A", 2.0, index=0), "us")
    table.rehash()
    assert table.hash is None


# entries of a packed parameter file


BIG = (1 << 24) + 1
"""An integer that no float32 can hold."""


def test_an_entry_of_a_file_is_exact_and_brings_its_default() -> None:
    table = Table(Encoding.C_CAST)
    change = table.store_file_entry("A", ParamType.INT32, BIG, 3, 7, is_older=False)
    param = table.params["A"]
    assert change == Change("A", None, param)
    assert (param.value, param.type, param.index, param.default) == (BIG, ParamType.INT32, 3, 7)
    assert param.trust is Trust.LIVE
    assert table.take_dirty() == {"A": "vehicle"}
    assert table.store_file_entry("A", ParamType.INT32, BIG, 3, 7, is_older=False) is None
    assert table.take_dirty() == {}
    assert table.store_file_entry("A", ParamType.INT32, BIG, 3, 8, is_older=False) is None
    assert table.take_dirty() == {"A": "vehicle"}, "another default is worth keeping"


@pytest.mark.parametrize("is_doubted", [False, True])
def test_a_message_that_rounds_an_exact_integer_changes_nothing(is_doubted: bool) -> None:
    table = Table(Encoding.C_CAST)
    table.store_file_entry("A", ParamType.INT32, BIG, 3, 7, is_older=False)
    if is_doubted:
        table.doubt()
    rounded = param_value("A", BIG - 1, index=3, kind=ParamType.INT32, encoding=Encoding.C_CAST)
    assert table.store_value(rounded, "vehicle") is None
    param = table.params["A"]
    assert (param.value, param.default, param.trust) == (BIG, 7, Trust.LIVE)
    other = param_value("A", BIG - 3, index=3, kind=ParamType.INT32, encoding=Encoding.C_CAST)
    change = table.store_value(other, "vehicle")
    assert change is not None
    assert table.params["A"].value == BIG - 3
    assert table.params["A"].default == 7


@pytest.mark.parametrize("first", list(Encoding))
def test_file_entries_are_independent_of_the_encoding(first: Encoding) -> None:
    second = Encoding.C_CAST if first is Encoding.BYTEWISE else Encoding.BYTEWISE
    table = Table(first)
    table.store_file_entry("A", ParamType.INT32, BIG, 0, 7, is_older=False)
    table.store_file_entry("B", ParamType.INT16, 5, 1, 7, is_older=False)
    table.store_file_entry("C", ParamType.INT16, 5, 2, 7, is_older=False)
    table.store_value(param_value("C", 6, index=2, kind=ParamType.INT16, encoding=second), "vehicle")
    changes = table.use_encoding(second)
    assert {change.name for change in changes} == {"C"}
    assert [table.params[name].value for name in "ABC"] == [BIG, 5, 6]
    received = ParamValue("A", as_reported(BIG, ParamType.INT32, second), ParamType.INT32, 3, 0)
    assert table.store_value(received, "vehicle") is None
    assert table.params["A"].value == BIG


def test_the_cache_adds_what_an_earlier_message_lacks() -> None:
    cached = {
        "A": Param("A", BIG, ParamType.INT32, 0, BIG, Trust.CACHED, 7),
        "B": Param("B", 5, ParamType.INT32, 1, 5, Trust.CACHED, 5),
        "C": Param("C", 5, ParamType.INT16, 2, 5, Trust.CACHED, 5),
    }
    table = Table(Encoding.C_CAST)
    for index, (name, value) in enumerate({"A": BIG, "B": 6, "C": 5}.items()):
        raw = as_reported(value, ParamType.INT32, Encoding.C_CAST)
        table.store_value(ParamValue(name, raw, ParamType.INT32, 3, index), "vehicle")
    changes = table.fill(cached)
    assert [change.name for change in changes] == ["A"]
    assert [(param.value, param.default) for param in table.params.values()] == [(BIG, 7), (6, 5), (5, None)]
    assert {param.trust for param in table.params.values()} == {Trust.LIVE}


def test_a_value_received_during_the_file_download_wins() -> None:
    table = Table(Encoding.C_CAST)
    table.store_value(
        param_value("A", 5, index=65535, kind=ParamType.INT32, encoding=Encoding.C_CAST), "vehicle"
    )
    assert table.store_file_entry("A", ParamType.INT32, 4, 9, 1, is_older=True) is None
    param = table.params["A"]
    assert (param.value, param.index, param.default) == (5, 9, 1)
    rounded = param_value("B", BIG - 1, index=65535, kind=ParamType.INT32, encoding=Encoding.C_CAST)
    table.store_value(rounded, "vehicle")
    assert table.store_file_entry("B", ParamType.INT32, BIG, 10, None, is_older=True) is not None
    assert table.params["B"].value == BIG, "the message may have rounded it"


def test_a_file_updates_the_hash() -> None:
    table = Table()
    table.store_file_entry("A", ParamType.INT32, 1, 0, None, is_older=False)
    table.confirm(5, frozenset(), proven=False)
    table.store_file_entry("A", ParamType.INT32, 2, 0, None, is_older=False)
    assert table.hash is None
