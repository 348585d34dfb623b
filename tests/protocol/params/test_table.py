"""The table: what is known of a component's parameters, and how far."""

from __future__ import annotations

from dataclasses import replace

import pytest

from paramclient.model.px4_hash import hash_params
from paramclient.model.values import Encoding, Param, ParamType, Trust, as_reported
from paramclient.protocol.params import table as room
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.table import Table
from paramclient.protocol.wire import ParamValue
from tests.simulation import known, listed, param_value


def test_a_first_value() -> None:
    table = Table()
    change = table.store_value(param_value("A", 1.5, index=3), "vehicle")
    param = table.params["A"]
    assert change == Change("A", None, param, "vehicle")
    assert (param.value, param.type, param.index, param.trust) == (1.5, ParamType.REAL32, 3, Trust.LIVE)
    assert table.take_dirty() == {"A": "vehicle"}
    assert table.take_dirty() == {}


def test_names_whose_volatility_changes_are_dirty() -> None:
    table = Table()
    for index, name in enumerate("ABC"):
        table.store_value(param_value(name, 1.5, index=index), "vehicle")
    table.confirm(1, frozenset("A"), proven=False)
    table.take_dirty()
    table.confirm(2, frozenset("B"), proven=True)
    assert set(table.take_dirty()) == {"A", "B"}


def test_the_same_once_more_is_no_change() -> None:
    table = Table()
    table.store_value(param_value("A", 1.5, index=3), "vehicle")
    table.take_dirty()
    assert table.store_value(param_value("A", 1.5, index=3), "us") is None
    assert table.take_dirty() == {}


def test_a_change_has_its_author() -> None:
    table = Table()
    table.store_value(param_value("A", 1.5, index=3), "vehicle")
    old = table.params["A"]
    change = table.store_value(param_value("A", 2.5, index=3), "us")
    assert change is not None
    assert (change.old, change.new, change.by) == (old, table.params["A"], "us")
    assert table.take_dirty() == {"A": "us"}


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


@pytest.mark.parametrize("value", [1.0, 2.0])
def test_an_index_may_move(value: float) -> None:
    table = Table()
    table.store_value(param_value("A", 1.0, index=3), "vehicle")
    table.take_dirty()
    table.store_value(param_value("A", value, index=4), "vehicle")
    assert table.params["A"].index == 4
    assert table.params["A"].value == value
    assert table.take_dirty() == {"A": "vehicle"}


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


def test_a_type_that_mavlink_does_not_define_is_kept() -> None:
    table = Table()
    table.store_value(ParamValue("X", b"\x01\x02\x03\x04", 77, 5, 1), "vehicle")
    param = table.params["X"]
    assert (param.type, param.type_number) == (ParamType.UNKNOWN, 77)
    assert (param.value, param.is_raw, param.settable) == (0x04030201, True, b"\x01\x02\x03\x04")


# what the cache knows


def test_the_cache_fills_in_what_was_not_received() -> None:
    table = Table()
    table.store_value(param_value("A", 9.0, index=0), "vehicle")
    changes = table.fill({"A": known("A", 1.0), "B": known("B", 2.0, index=1)})
    assert [change.name for change in changes] == ["B"]
    assert table.params["A"].value == 9.0
    assert table.params["B"].trust is Trust.CACHED
    assert "B" not in table.take_dirty()


def test_a_cached_value_that_is_received_becomes_live() -> None:
    table = Table()
    table.fill({"A": known("A", 1.0, index=4)})
    assert table.store_value(param_value("A", 1.0, index=4), "vehicle") is None
    assert table.params["A"].trust is Trust.LIVE
    assert table.take_dirty() == {}
    table.fill({"B": known("B", 1.0, index=4)})
    assert table.store_value(param_value("B", 1.0, index=5), "vehicle") is None
    assert table.take_dirty() == {"B": "vehicle"}


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


def test_remove_deletes_names_and_returns_the_changes() -> None:
    table = Table()
    table.store_value(param_value("A", 9.0, index=0), "vehicle")
    table.store_value(param_value("B", 9.0, index=1), "vehicle")
    gone = table.params["B"]
    table.take_dirty()
    assert table.remove(lambda param: param.name == "B") == [Change("B", gone, None)]
    assert list(table.params) == ["A"]
    assert table.take_dirty() == {"B": "vehicle"}
    change = table.store_value(param_value("B", 9.0, index=1), "vehicle")
    assert change is not None
    assert change.old is None


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


def test_a_volatile_value_does_not_change_the_hash() -> None:
    table = hashed(proven=True)
    before = table.hash
    table.store_value(param_value("V", 2.0, index=2), "vehicle")
    assert table.hash == before


def test_a_removed_parameter_changes_the_hash() -> None:
    table = hashed(proven=True)
    table.remove(lambda param: param.name == "A")
    assert table.hash == hash_params(listed(table), leave_out="V")


def test_without_confirmation_there_is_no_hash() -> None:
    table = hashed(proven=True)
    table.store_value(param_value("A", 2.0, index=0), "us")
    table.unconfirm()
    assert table.hash is None
    table.store_value(param_value("A", 3.0, index=0), "us")
    assert table.hash is None


def test_rehash_computes_the_hash_again() -> None:
    table = hashed(proven=True)
    right = table.hash
    table.confirm(0x12345678, frozenset("V"), proven=True)
    assert table.hash == 0x12345678
    table.rehash()
    assert table.hash == right


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


def test_a_message_that_says_what_was_written_rounds_nothing() -> None:
    table = Table(Encoding.C_CAST)
    table.store_file_entry("A", ParamType.INT32, BIG, 3, 7, is_older=False)
    written = param_value("A", BIG - 1, index=3, kind=ParamType.INT32, encoding=Encoding.C_CAST)
    change = table.store_value(written, "us", is_exact=True)
    assert change is not None
    assert (table.params["A"].value, table.params["A"].default) == (BIG - 1, 7)


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


def test_a_byte_wise_integer_is_what_the_message_says() -> None:
    table = Table()
    table.store_file_entry("A", ParamType.INT32, BIG, 3, None, is_older=False)
    change = table.store_value(param_value("A", BIG - 1, index=3, kind=ParamType.INT32), "vehicle")
    assert change is not None
    assert table.params["A"].value == BIG - 1


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


def test_a_default_goes_with_the_type() -> None:
    table = Table()
    table.store_file_entry("A", ParamType.INT32, 1, 0, 7, is_older=False)
    table.store_value(param_value("A", 1.0, index=0), "vehicle")
    assert table.params["A"].default is None


def test_another_place_leaves_value_and_default() -> None:
    table = Table()
    table.store_file_entry("A", ParamType.INT32, 7, 0, 5, is_older=False)
    table.place({3: "A"})
    assert (table.params["A"].index, table.params["A"].value, table.params["A"].default) == (3, 7, 5)
    table.forget_defaults()
    assert (table.params["A"].value, table.params["A"].default) == (7, None)


HALF = 0x3F000000
"""The bits of 0.5."""


def rows_of(table: Table) -> dict[str, float | None]:
    """The defaults of all values that the cache is given of a table, by name and type."""
    params = [each.param for each in table.overwritten] + list(table.params.values())
    return {f"{param.name} {param.type_number}": param.default for param in params}


def test_an_overwritten_value_keeps_the_default_of_its_type() -> None:
    table = Table()
    table.store_value(param_value("A", 5, index=0, kind=ParamType.INT8), "us")
    change = table.store_file_entry("A", ParamType.REAL32, HALF, 0, HALF, is_older=False)
    assert change is not None
    assert change.old is not None
    assert change.new is not None
    assert (change.old.default, change.new.default) == (None, 0.5)
    assert [(each.param.value, each.param.default) for each in table.overwritten] == [(5, None)]
    assert rows_of(table) == {"A 2": None, "A 9": 0.5}
    change = table.store_value(param_value("A", 6, index=0, kind=ParamType.INT8), "us")
    assert change is not None
    assert change.old is not None
    assert change.old.default == 0.5
    table.overwritten = table.overwritten[1:]
    assert rows_of(table) == {"A 9": 0.5, "A 2": None}


def test_a_default_of_an_older_file_with_another_type_is_ignored() -> None:
    table = Table()
    table.store_value(param_value("A", 5, index=0, kind=ParamType.INT8), "vehicle")
    assert table.store_file_entry("A", ParamType.REAL32, HALF, 3, HALF, is_older=True) is None
    assert (table.params["A"].index, table.params["A"].default) == (3, None)
    assert rows_of(table) == {"A 2": None}
    table.store_file_entry("A", ParamType.INT8, 6, 3, 7, is_older=True)
    assert (table.params["A"].value, table.params["A"].default) == (5, 7)


def test_a_renewed_value_of_another_type_has_no_default() -> None:
    table = Table()
    table.fill({"A": replace(known("A", 5), default=7)})
    [change] = table.renew({"A": known("A", 0.5)})
    assert (table.params["A"].value, table.params["A"].default) == (0.5, None)
    assert change.old is not None
    assert change.old.default == 7
    assert rows_of(table) == {"A 9": None}
