"""What a table holds, on its way into the cache: by columns, by rows, and one by one, it is the same."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.cache import ObservedParams, StoredParam, UnixTimes
from paramclient.cache.cells import Damaged
from paramclient.cache.packed_table import Packed, pack
from paramclient.cache.param_columns import StoredTable
from paramclient.model.params import Params
from paramclient.model.values import Encoding, Param, ParamType, Trust, decode_value, from_bits, known_type
from tests.caches import cells

AT = 1_795_000_000.5
TIMES = UnixTimes(AT, AT - 100.0)
"""At AT, where the clock of the observations stands at 100 s."""


@st.composite
def tables(draw: st.DrawFn) -> Params:
    params = Params()
    for place, name in enumerate(draw(st.lists(st.text("AB_é", min_size=1, max_size=3), unique=True))):
        number = draw(st.integers(0, 12))
        raw = draw(st.binary(min_size=4, max_size=4))
        value, bits = decode_value(raw, number, draw(st.sampled_from(Encoding)))
        if number in (ParamType.INT64, ParamType.UINT64) and draw(st.booleans()):
            bits = draw(st.integers(0, 2**64 - 1))
            value = from_bits(bits, number)
        index = draw(st.sampled_from([place, None]))
        default = from_bits(bits, number) if draw(st.booleans()) and not isinstance(value, bytes) else None
        params[name] = Param(name, value, known_type(number), index, bits, Trust.LIVE, default)
        if draw(st.booleans()):
            params.moments[name] = draw(st.floats(0.0, 100.0))
    return params


@given(
    params=tables(),
    volatile=st.none() | st.frozensets(st.sampled_from("AB")),
    by=st.dictionaries(st.just("A"), st.just("us")),
)
def test_a_table_gives_the_same_rows_in_every_way(
    params: Params, volatile: frozenset[str] | None, by: dict[str, str]
) -> None:
    received = ObservedParams(params, TIMES, volatile=volatile, by=by)
    stored = list(received)
    times = {name: AT - 100.0 + params.moments.get(name, 100.0) for name in params}
    assert stored == [
        StoredParam(
            param, times[name], None if volatile is None else name in volatile, by.get(name, "vehicle")
        )
        for name, param in params.items()
    ]
    assert dict(received.heard_at()) == times
    assert [type(cell) for item in received for cell in item] == [
        type(cell) for item in stored for cell in item
    ]
    expected = {item.name: item.stored_over(None, keeps_index=True) for item in stored}
    first = received.first_table()
    if not params:
        assert first is None
        return
    assert first is not None
    assert first == first.rows() == expected
    assert [tuple(cells) for cells in zip(*first.columns, strict=True)] == [
        tuple(row[:-1]) for row in expected.values()
    ]
    assert pack(first) == pack(expected)
    found = Packed(pack(first)).table()
    assert found == expected
    assert dict(found.params()) == dict(StoredTable.of(expected).params())
    one_by_one = {name: row.param for name, row in expected.items()}
    cached = {name: param.with_trust(Trust.CACHED) for name, param in params.items()}
    assert dict(first.params()) == one_by_one == cached
    assert [repr(each.default) for each in first.params().values()] == [
        repr(each.default) for each in one_by_one.values()
    ]


def test_overwritten_values_precede_the_present_ones() -> None:
    params = Params()
    params["A"] = Param("A", 2, ParamType.INT32, 0, 2)
    before = StoredParam(Param("A", 1, ParamType.INT32, 0, 1), AT, None, "us")
    received = ObservedParams(params, TIMES, volatile=None, by={}, overwritten=[before])
    assert (len(received), received[0], [each.param.value for each in received[-1:]]) == (2, before, [2])
    assert list(received.heard_at()) == [("A", AT), ("A", AT)]
    rows = [(item.name, item.bits, item.by) for item in received]
    assert rows == [("A", 1, "us"), ("A", 2, "vehicle")]
    assert received.first_table() is None, "a name is in it twice"


@pytest.mark.parametrize(
    "row",
    [
        cells("A", 300, 1, 0, 0, 0, AT),
        cells("A", -1, 1, 0, 0, 0, AT),
        cells("A", ParamType.INT8, 256, 0, 0, 0, AT),
        cells("A", ParamType.INT64, 1 << 32, 1, 0, 0, AT),
        cells("A", 77, 1 << 32, 1, 0, 0, AT),
        cells("A", ParamType.INT8, 1, 0, 1 << 40, 0, AT),
        cells("A", ParamType.INT8, 1, 0, 0, 0, AT, 1 << 40),
    ],
)
def test_rows_that_hold_no_parameter_are_damage(row: StoredParam) -> None:
    with pytest.raises(Damaged):
        StoredTable.of({"A": row}).params()
