"""The compact form of parameters in tables, and the read-only mapping."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.model.params import (
    ParamMap,
    Params,
    as_params,
    is_listed,
)
from paramclient.model.values import Encoding, Param, ParamType, Trust, decode_value, known_type


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
