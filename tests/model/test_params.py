"""The read-only mapping of parameters."""

from __future__ import annotations

import pytest

from paramclient.model.paramset import ParamMap
from paramclient.model.values import Param, ParamType


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


def test_an_iteration_is_over_the_names_at_its_start() -> None:
    table = {name: Param(name, 1, ParamType.INT32, 0, 1) for name in "AB"}
    names = []
    for name in ParamMap(table):  # the event loop of a blocking client adds names meanwhile
        table[f"{name}2"] = table[name]
        names.append(name)
    assert names == ["A", "B"]


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
