"""The compact form of parameters in tables, and the read-only mapping."""

from __future__ import annotations

import copy
import gc
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.model.params import (
    CACHED,
    COMPACT_NO_INDEX,
    ParamMap,
    Params,
    as_params,
    compact_param,
    has_index,
    is_listed,
    pack_fields,
    param_of,
    same_compact,
    with_index,
    with_trust_number,
)
from paramclient.model.values import Encoding, Param, ParamType, Trust, decode_value, known_type
from paramclient.protocol.params.change import Change


def test_a_param_map_is_a_live_read_only_view() -> None:
    table = {"B": Param("B", 1, ParamType.INT32, 0, 1)}
    params = ParamMap(table)
    assert repr(params) == "<ParamMap 1 param>"
    table["A"] = Param("A", 2, ParamType.INT32, 1, 2)
    assert list(params) == ["B", "A"]
    assert params == table
    assert params["A"] is table["A"]
    assert "A" in params
    assert "C" not in params
    assert params.get("C") is None
    assert len(params) == 2
    assert repr(params) == "<ParamMap 2 params>"
    with pytest.raises(KeyError):
        params["C"]
    with pytest.raises(TypeError):
        params["C"] = table["A"]  # type: ignore[index]  # must fail
    with pytest.raises(AttributeError):
        params.anything = 1  # type: ignore[attr-defined]


def test_changed_returns_values_that_differ_from_defaults() -> None:
    nan = float("nan")
    table = {
        name: Param(name, value, ParamType.REAL32, 0, 0, default=default)
        for name, value, default in (
            ("SAME", 1.5, 1.5),
            ("OTHER", 1.5, 2.5),
            ("UNKNOWN", 1.5, None),
            ("ZERO", 0.0, -0.0),
            ("NAN", nan, nan),
            ("NOW_NAN", nan, 1.0),
        )
    }
    assert {name: param.is_changed for name, param in table.items()} == {
        "SAME": False,
        "OTHER": True,
        "UNKNOWN": None,
        "ZERO": False,
        "NAN": False,
        "NOW_NAN": True,
    }
    params = ParamMap(table)
    assert params.changed() == {"OTHER": table["OTHER"], "NOW_NAN": table["NOW_NAN"]}


@given(
    wire=st.tuples(st.integers(0, 255), st.binary(min_size=4, max_size=4), st.sampled_from(Encoding)),
    index=st.none() | st.integers(0, 65_534),
    trust=st.sampled_from(Trust),
    default=st.none() | st.floats(width=32, allow_nan=False) | st.integers(-5, 5),
)
def test_the_compact_form_loses_nothing(
    wire: tuple[int, bytes, Encoding], index: int | None, trust: Trust, default: float | None
) -> None:
    number, raw, encoding = wire
    value, bits = decode_value(raw, number, encoding)
    param = Param("NAME", value, known_type(number), index, bits, trust, default)
    params = Params()
    params["NAME"] = param
    found = params["NAME"]
    assert (found, found.default) == (param, default)
    assert repr(found.settable) == repr(value)
    assert (found.type, found.type_number, found.is_raw) == (param.type, number, param.is_raw)
    assert list(params.values()) == [param]
    assert list(params.items()) == [("NAME", param)]
    assert params == {"NAME": param}
    assert repr(params) == f"Params({{'NAME': {param!r}}})"
    assert as_params(ParamMap(params)) is params
    assert as_params({"NAME": param}) == params
    assert is_listed(params.compact["NAME"]) == (index is not None)


def test_params_can_be_changed_and_copied() -> None:
    params = Params()
    for at, name in enumerate("CAB"):
        params[name] = Param(name, at, ParamType.INT32, at, at, default=at)
    copied, some = params.copy(), params.only(["B", "X", "C"])
    del params["A"]
    params["C"] = Param("C", 7, ParamType.INT32, 0, 7)
    assert (list(params), list(copied), list(some)) == (["C", "B"], ["C", "A", "B"], ["B", "C"])
    assert (params["C"].value, params["C"].default) == (7, None)
    assert (copied["C"].value, copied["C"].default, some["C"].default) == (0, 0, 0)
    assert "A" not in params
    assert "A" not in params.defaults
    with pytest.raises(KeyError):
        params["A"]


def test_setting_index_or_trust_changes_nothing_else() -> None:
    param = Param("A", -5, ParamType.INT16, 300, 0xFFFB, Trust.VERIFIED)
    held = compact_param(param)
    assert param_of("A", with_index(held, 7)) == Param("A", -5, ParamType.INT16, 7, 0xFFFB, Trust.VERIFIED)
    assert param_of("A", with_index(held, COMPACT_NO_INDEX)).index is None
    assert has_index(with_index(held, 7), 7)
    assert not has_index(with_index(held, 7), 8)
    assert param_of("A", with_trust_number(held, CACHED)) == param.with_trust(Trust.CACHED)
    assert same_compact(held, with_trust_number(with_index(held, 9), CACHED))


@given(
    number=st.integers(1, 10),
    one=st.integers(0, 2**32 - 1) | st.sampled_from([0, 0x80000000]),
    other=st.integers(0, 2**32 - 1) | st.sampled_from([0, 0x80000000]),
    raw=st.sampled_from([(False, False), (True, False)]),
)
def test_same_held_agrees_with_same_value_of_params(
    number: int, one: int, other: int, raw: tuple[bool, bool]
) -> None:
    one, other = (each & ((1 << 8 * min(ParamType(number).size, 4)) - 1) for each in (one, other))
    first, second = pack_fields(one, number, raw[0], 0, 1), pack_fields(other, number, raw[1], 1, 2)
    assert same_compact(first, second) == param_of("A", first).same_value(param_of("A", second))


def test_the_garbage_collector_does_not_track_compact_params() -> None:
    params = Params()
    for at in range(100):
        params[f"P{at}"] = Param(f"P{at}", 1.5, ParamType.REAL32, at, 0x3FC00000, default=2.5)
    assert not any(map(gc.is_tracked, (*params.compact.values(), *params.defaults.values())))


def test_changes_compare_by_content_and_can_be_copied() -> None:
    old = Param("A", 1, ParamType.INT8, 0, 1, default=3)
    new = Param("A", 2, ParamType.INT8, 0, 2, Trust.CACHED, 4)
    change = Change("A", old, new, "us")
    same = Change("A", Param("A", 1, ParamType.INT8, 0, 1), new, "us")
    assert change == same
    assert not change != same  # noqa: SIM202 - tests __ne__, which tuple defines itself
    assert hash(change) == hash(same)
    assert change != Change("A", old, new, "vehicle")
    for copied in (copy.copy(change), copy.deepcopy(change), pickle.loads(pickle.dumps(change))):
        assert copied == change
        assert copied.old is not None
        assert copied.new is not None
        assert (copied.old.default, copied.new.default) == (3, 4)
