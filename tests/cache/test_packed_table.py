"""A table's parameters as bytes: every cell is restored, and damaged bytes are refused."""

from __future__ import annotations

import copy
import math
import pickle
import struct
import tracemalloc
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient.cache import ParamCache, StoredParam, packed_table, sqlite
from paramclient.cache.cells import Damaged
from paramclient.cache.packed_table import Packed, pack, packed_row, row_checksum, unpack
from paramclient.cache.param_columns import COLUMN_NAMES, COLUMNS, Column, StoredTable
from paramclient.cache.transaction import Transaction
from paramclient.errors import UsageError
from paramclient.model.values import ParamType
from tests.caches import NOW, PX4, cells, stored, update, values, whole_table

INT64 = st.integers(-(1 << 63), (1 << 63) - 1)
NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=20) | st.sampled_from("A \0")
ROWS = st.builds(
    cells,
    NAMES,
    st.integers(0, 255),
    INT64 | st.integers(0, 9),
    st.integers(0, 1),
    st.none() | st.integers(0, 9) | st.integers(-(1 << 31), (1 << 31) - 2),
    st.integers(0, 1),
    st.floats(0, 253402300800.0, exclude_max=True),
    st.none() | INT64,
)
TABLES = st.lists(ROWS, max_size=12).map(lambda rows: {row.name: row for row in rows})
TABLE = {
    name: cells(name, 9, number << 20, 0, number, number % 2, NOW + number)
    for number, name in enumerate(f"PARAM_{each}" for each in range(30))
}
EVERY = {
    "B": cells("B", 6, -1, 0, 1, 0, 1.5),
    "A": cells("A", 9, 7, 1, None, 1, 2.5, -2),
}
BEFORE = pack(EVERY)


def sealed(whole: bytes) -> bytes:
    """With a checksum that is right: made on purpose, not by chance."""
    return whole + struct.pack("<I", zlib.crc32(whole))


def order(item: tuple[str, StoredParam]) -> tuple[bool, int, str]:
    name, row = item
    return row.param_index is None, row.param_index or 0, name


@given(TABLES)
def test_every_cell_is_restored_in_the_order_of_a_table(rows: dict[str, StoredParam]) -> None:
    found = unpack(pack(rows))
    assert list(found.items()) == sorted(rows.items(), key=order)
    assert all(type(row) is StoredParam for row in found.values())
    assert [list(map(type, found[name])) for name in rows] == [list(map(type, row)) for row in rows.values()]


@given(TABLES, st.randoms())
def test_the_bytes_do_not_depend_on_the_order_of_the_rows(rows: dict[str, StoredParam], chance: Any) -> None:
    items = list(rows.items())
    chance.shuffle(items)
    assert pack(dict(items)) == pack(rows)


def test_the_bytes_are_these_on_every_machine() -> None:
    """Files go from one machine to another, and from one version to the next."""
    assert pack({}).hex() == "0100000000000000000000000000b198b44c"
    assert pack(EVERY).hex() == (
        "0101000000000200000003000000"  # version, defaults, between names, parameters, bytes of names
        "420041"
        "0609000100010001"  # types, is_raw, volatile, whether there is a default
        "ffffffffffffffff0700000000000000"
        "000000000000f83f0000000000000440"  # heard at
        "01000000ffffff7f"  # indices
        "0000000000000000feffffffffffffff"  # defaults
        "cadc9b10"
    )  # fmt: skip


@given(TABLES)
def test_only_some_columns_are_the_same_as_in_all_of_it(rows: dict[str, StoredParam]) -> None:
    packed = Packed(pack(rows))
    places = packed.places()
    assert packed.size == len(rows)
    assert list(places) == list(packed.table())
    some = list(rows)[::2]
    assert packed.heard_at(places[name] for name in some) == [rows[name].heard_at for name in some]
    values_of = packed.values((name, places[name]) for name in some)
    assert values_of == [(name, *rows[name].value) for name in some]


def test_tables_of_the_same_names_are_distinguished_by_their_bytes() -> None:
    other = {name: row._replace(bits=5, heard_at=NOW) for name, row in TABLE.items()}
    assert Packed(pack(other)).named == Packed(pack(TABLE)).named
    assert (
        Packed(pack({**other, "MORE": other["PARAM_0"]._replace(name="MORE")})).named
        != Packed(pack(TABLE)).named
    )


# What is not the work of `pack`


def believed(blob: bytes) -> dict[str, StoredParam] | None:
    """The table in some bytes, or None if they are reported as damaged."""
    try:
        rows = unpack(blob)
    except Damaged:
        return None
    assert unpack(pack(rows)) == rows, "what is believed can be kept again"
    for row in rows.values():
        assert 0 <= row.type <= 255
        assert row.is_raw in (0, 1)
        assert row.volatile in (0, 1)
        assert 0 <= row.heard_at < 253402300800.0
    return rows


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_damage(data: bytes) -> None:
    believed(data)
    believed(sealed(data))
    believed(sealed(b"\1" + data))


@given(TABLES, st.data())
@settings(max_examples=300)
def test_changed_bytes_are_damage_or_a_table(rows: dict[str, StoredParam], data: st.DataObject) -> None:
    blob = pack(rows)
    changed = bytearray(blob)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(changed)))
        size = data.draw(st.integers(0, 4))
        changed[at : at + size] = data.draw(st.binary(max_size=4))
    if changed != blob:
        assert believed(bytes(changed)) is None
    believed(sealed(bytes(changed[:-4])))


def test_each_flipped_bit_is_damage() -> None:
    blob = pack(EVERY)
    for at in range(8 * len(blob)):
        flipped = bytearray(blob)
        flipped[at // 8] ^= 1 << at % 8
        with pytest.raises(Damaged, match="not what was written"):
            unpack(bytes(flipped))


def with_bytes(at: int, data: bytes) -> bytes:
    whole = pack(EVERY)[:-4]
    return sealed(whole[:at] + data + whole[at + len(data) :])


NAMES_AT = 14
TYPES_AT = NAMES_AT + len("B\0A")
BITS_AT = TYPES_AT + 4 * 2


@pytest.mark.parametrize(
    ("blob", "why"),
    [
        (b"", "has 0 bytes"),
        (sealed(pack(EVERY)[:10]), "has 14 bytes"),
        (with_bytes(0, b"\2"), "begins with 02"),
        (with_bytes(1, b"\2"), "begins with 0102"),
        (with_bytes(2, struct.pack("<I", 0x110000)), "begins with"),
        (with_bytes(6, b"\1"), "a table of 1 parameters has"),
        (with_bytes(6, b"\xff\xff\xff\xff"), "a table of 4294967295 parameters"),
        (with_bytes(10, b"\xff\xff\xff\xff"), "a table of 2 parameters has"),
        (sealed(pack(EVERY)[:-5]), "a table of 2 parameters has"),
        (sealed(pack(EVERY)[:-4] + b"\0"), "a table of 2 parameters has"),
        (sealed(struct.pack("<BBIII", 1, 0, 0, 0, 1) + b"A"), "a table of 0 parameters has"),
        (with_bytes(NAMES_AT, b"\xff"), "'utf-8' codec"),
        (with_bytes(NAMES_AT, b"\xed\xa0\x80"), "'utf-8' codec"),
        (with_bytes(NAMES_AT, b"B+A"), "another number of names"),
        (with_bytes(NAMES_AT, b"\0\0A"), "another number of names"),
        (with_bytes(NAMES_AT, b"A\0A"), "a name twice"),
        (with_bytes(TYPES_AT + 2, b"\2"), "neither 0 nor 1"),
        (with_bytes(TYPES_AT + 4, b"\2"), "neither 0 nor 1"),
        (with_bytes(TYPES_AT + 6, b"\2"), "neither 0 nor 1"),
        (with_bytes(BITS_AT + 16, struct.pack("<d", math.nan)), "a cell holds nan"),
        (with_bytes(BITS_AT + 16, struct.pack("<dd", 1.0, math.nan)), "a cell holds nan"),
        (with_bytes(BITS_AT + 16, struct.pack("<d", math.inf)), "a cell holds inf"),
        (with_bytes(BITS_AT + 16, struct.pack("<d", -1.0)), "a cell holds -1.0"),
        (with_bytes(BITS_AT + 16, struct.pack("<d", 253402300800.0)), "a cell holds 253402300800.0"),
    ],
)  # fmt: skip
def test_bytes_that_pack_cannot_produce_are_damaged(blob: bytes, why: str) -> None:
    assert unpack(with_bytes(0, b"\1")) == EVERY
    with pytest.raises(Damaged, match=why):
        unpack(blob)


def test_a_read_of_some_columns_checks_these_columns() -> None:
    with pytest.raises(Damaged, match="a cell holds nan"):
        Packed(with_bytes(BITS_AT + 16, struct.pack("<d", math.nan))).heard_at([0, 1])
    with pytest.raises(Damaged, match="neither 0 nor 1"):
        Packed(with_bytes(TYPES_AT + 2, b"\2")).values([("B", 0)])
    with pytest.raises(Damaged, match="a name twice"):
        Packed(with_bytes(NAMES_AT, b"A\0A")).places()


def test_a_claim_takes_no_memory() -> None:
    claims = [
        sealed(struct.pack("<BBIII", 1, defaults, 0, size, length) + bytes(100))
        for defaults in (0, 1)
        for size in (0, 1, 0xFFFFFFFF, 0x0B21642C)
        for length in (0, 100, 0xFFFFFFFF)
    ]
    tracemalloc.start()
    try:
        for claim in claims:
            assert believed(claim) is None
        assert tracemalloc.get_traced_memory()[1] < 20_000
    finally:
        tracemalloc.stop()


# A column of a later version


@pytest.fixture
def later_columns(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Two more columns than now."""
    columns = (
        *COLUMNS,
        Column("source", "text", "s", is_optional=True),
        Column("age", "integer", "i", is_optional=True),
    )
    monkeypatch.setattr(packed_table, "COLUMNS", columns)
    monkeypatch.setattr(packed_table, "COLUMN_NAMES", tuple(column.name for column in columns))
    monkeypatch.setattr(packed_table, "_COLUMNS", {column.name: column for column in columns})
    monkeypatch.setattr(packed_table, "_OPTIONAL", tuple(each for each in columns if each.is_optional))
    packed_table._layout.cache_clear()
    yield
    packed_table._layout.cache_clear()


@pytest.mark.parametrize("sources", [("log", None), ("", "a file"), (None, None)])
@pytest.mark.parametrize("ages", [(5, None), (None, None), (0, -1)])
def test_a_later_column_is_kept_beside_the_others(later_columns: None, sources: Any, ages: Any) -> None:
    table = StoredTable([*StoredTable.of(EVERY).columns, sources, ages])
    found = Packed(pack(table)).table().columns
    assert list(map(tuple, zip(*found, strict=True))) == list(zip(*table.columns, strict=True))


def test_a_table_from_before_a_column_has_none_of_it(later_columns: None) -> None:
    [*columns, sources, ages] = Packed(BEFORE).table().columns
    assert list(zip(*columns, strict=True)) == [row[:-1] for row in EVERY.values()]
    assert list(sources) == list(ages) == [None, None]
    assert pack(StoredTable([*columns, sources, ages])) == BEFORE


def test_the_fields_of_a_stored_parameter_are_its_columns_and_the_author() -> None:
    assert StoredParam._fields == (*COLUMN_NAMES, "by")
    assert tuple(column.name for column in COLUMNS) == COLUMN_NAMES
    item = stored("A", 7, volatile=True, by="us", index=3)
    assert copy.copy(item) == item == pickle.loads(pickle.dumps(item))


# What cannot be kept


@pytest.mark.parametrize(
    "rows",
    [
        {"\udcff": EVERY["A"]._replace(name="\udcff")},
        {"A": EVERY["A"]._replace(type=256)},
        {"A": EVERY["A"]._replace(type=-1)},
        {"A": EVERY["A"]._replace(is_raw=2)},
        {"A": EVERY["A"]._replace(volatile=2)},
        {"A": EVERY["A"]._replace(bits=1 << 63)},
        {"A": EVERY["A"]._replace(param_index=(1 << 31) - 1)},
        {"A": EVERY["A"]._replace(param_index=1 << 31)},
        {"A": EVERY["A"]._replace(default_bits=1 << 63)},
    ],
)
def test_rows_that_do_not_fit_the_format_are_refused(rows: dict[str, StoredParam]) -> None:
    with pytest.raises(UsageError, match="the table cannot be stored"):
        pack(rows)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.sqlite3"


@pytest.mark.parametrize(
    "item", [stored("\udcff", 1), stored("A", 1, 256), stored("A", 1, index=1 << 40)], ids=repr
)
def test_an_update_with_a_row_that_does_not_fit_writes_nothing(path: Path, item: Any) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        with pytest.raises(UsageError, match="the table cannot be stored"):
            cache.save(update(stored("PARAM_1", 9), item))
        assert values(cache) == {"PARAM_0": 0, "PARAM_1": 1, "PARAM_2": 2}
        assert cache.history(PX4.key) == []


# In the file


def test_the_checksum_covers_the_columns_beside_the_blob() -> None:
    size, heard_last, blob = packed_row(TABLE)
    assert (size, heard_last, blob) == (30, NOW + 29, pack(TABLE))
    right = row_checksum(size, heard_last, blob)
    assert right != row_checksum(size + 1, heard_last, blob)
    assert right != row_checksum(size, heard_last + 1, blob)
    assert right != row_checksum(size, heard_last, pack(EVERY))


def test_a_table_of_which_nothing_has_changed_is_not_written(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Mapping[str, StoredParam]] = []

    def noted(rows: Mapping[str, StoredParam]) -> tuple[int, float, bytes]:
        written.append(rows)
        return packed_row(rows)

    monkeypatch.setattr(sqlite, "packed_row", noted)
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        assert len(written) == 1
        cache.save(whole_table(3))
        cache.save(update(identity=PX4, at=NOW + 1))
        cache.save(update(identity=replace(PX4, firmware=1), at=NOW + 2))
        assert len(written) == 1
        cache.save(update(stored("PARAM_1", 1, at=NOW + 1)))
        assert len(written) == 2, "it was received again"


def test_a_table_can_become_empty_and_have_parameters_again(path: Path) -> None:
    with ParamCache(path) as cache:
        cache.save(whole_table(3))
        cache.save(update(removed=["PARAM_0", "PARAM_1", "PARAM_2"], at=NOW + 1))
        assert values(cache) == {}
        assert [summary.size for summary in cache.components()] == [0]
        cache.save(update(stored("A", 1, ParamType.UINT8)))
        assert values(cache) == {"A": 1}
    with ParamCache(path) as cache:
        assert values(cache) == {"A": 1}
        assert not cache.notes


def test_name_positions_are_cached_for_a_few_firmwares(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite, "_NAME_SETS_MAX", 2)
    with ParamCache(path) as cache:
        for number in range(5):
            cache.save(update(stored("A", number), stored(f"B{number}", 1), component=number + 1))

        def work(session: Transaction) -> None:
            assert isinstance(session, sqlite.SqliteTransaction)
            owners = [session.owner_of(PX4.key, number + 1) or 0 for number in range(5)]
            found = session.holders([*owners, *owners], ["A", "B3", "C"])
            own = {("A", 6, number, 0): [owner] * 2 for number, owner in enumerate(owners)}
            assert found == own | {("B3", 6, 1, 0): [owners[3]] * 2}
            assert len(session._places_of) == 2

        cache._store.read(work)
