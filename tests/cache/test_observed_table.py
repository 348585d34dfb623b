"""What a table holds, on its way into the cache: by columns, by rows, and one by one, it is the same."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.cache import HeardParams, StoredParam, UnixTimes
from paramclient.cache.observed_table import FirstRows
from paramclient.cache.packed_table import Packed, pack
from paramclient.cache.rows import Damaged, Row, read_param, read_params
from paramclient.model.params import Params
from paramclient.model.values import Encoding, Param, ParamType, Trust, decode, from_bits, known_type

AT = 1_795_000_000.5
TIMES = UnixTimes(AT, AT - 100.0)
"""At AT, where the clock of the observations stands at 100 s."""


@st.composite
def tables(draw: st.DrawFn) -> Params:
    params = Params()
    for place, name in enumerate(draw(st.lists(st.text("AB_é", min_size=1, max_size=3), unique=True))):
        number = draw(st.integers(0, 12))
        raw = draw(st.binary(min_size=4, max_size=4))
        value, bits = decode(raw, number, draw(st.sampled_from(Encoding)))
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
    heard = HeardParams(params, TIMES, volatile=volatile, by=by)
    stored = list(heard)
    times = {name: AT - 100.0 + params.moments.get(name, 100.0) for name in params}
    assert stored == [
        StoredParam(
            param, times[name], None if volatile is None else name in volatile, by.get(name, "vehicle")
        )
        for name, param in params.items()
    ]
    assert dict(heard.heard_at()) == times
    expected = {
        each.param.name: Row.of(each.param, each.param.index, bool(each.volatile), each.heard_at)
        for each in stored
    }
    rows = list(heard.rows())
    assert rows == [
        (name, row, each.volatile, each.by)
        for (name, row), each in zip(expected.items(), stored, strict=True)
    ]
    assert [type(cell) for _, row, *_ in rows for cell in row if cell is not None] == [
        type(cell) for row in expected.values() for cell in row if cell is not None
    ]
    first = heard.first_rows()
    if not params:
        assert first is None
        return
    assert isinstance(first, FirstRows)
    assert first == expected
    names, columns = first.columns()
    assert list(names) == list(expected)
    assert [tuple(cells) for cells in zip(*columns, strict=True)] == [tuple(row) for row in expected.values()]
    assert pack(first) == pack(expected)
    kept, left_out, heard_at = Packed(pack(first)).params()
    assert kept == read_params(expected)
    assert left_out == frozenset(name for name, row in expected.items() if row.volatile)
    assert heard_at == times
    again = read_params(expected)
    one_by_one = {
        name: read_param(name, *row.value, row.param_index, row.default_bits)
        for name, row in expected.items()
    }
    assert dict(again) == one_by_one
    assert [repr(each.default) for each in again.values()] == [
        repr(each.default) for each in one_by_one.values()
    ]


def test_what_was_overwritten_comes_first_and_by_itself() -> None:
    params = Params()
    params["A"] = Param("A", 2, ParamType.INT32, 0, 2)
    before = StoredParam(Param("A", 1, ParamType.INT32, 0, 1), AT, None, "us")
    heard = HeardParams(params, TIMES, volatile=None, by={}, overwritten=[before])
    assert (len(heard), heard[0], [each.param.value for each in heard[-1:]]) == (2, before, [2])
    assert list(heard.heard_at()) == [("A", AT), ("A", AT)]
    rows = [(name, row.bits, by) for name, row, _, by in heard.rows()]
    assert rows == [("A", 1, "us"), ("A", 2, "vehicle")]
    assert heard.first_rows() is None, "a name is in it twice"


@pytest.mark.parametrize(
    "row",
    [
        Row(300, 1, 0, 0, 0, AT),
        Row(-1, 1, 0, 0, 0, AT),
        Row(ParamType.INT8, 256, 0, 0, 0, AT),
        Row(ParamType.INT64, 1 << 32, 1, 0, 0, AT),
        Row(77, 1 << 32, 1, 0, 0, AT),
        Row(ParamType.INT8, 1, 0, 1 << 40, 0, AT),
        Row(ParamType.INT8, 1, 0, 0, 0, AT, 1 << 40),
    ],
)
def test_rows_that_hold_no_parameter_are_damage(row: Row) -> None:
    with pytest.raises(Damaged):
        read_params({"A": row})
