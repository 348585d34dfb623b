"""Parameter sets, the mapping of parameters, and defaults of the firmware."""

from __future__ import annotations

from typing import Any

import pytest

from paramclient.errors import UsageError
from paramclient.model import paramset
from paramclient.model.values import Param, ParamType, Value, bits_of


def param(name: str, value: Value, kind: int = ParamType.REAL32, default: Value | None = None) -> Param:
    return Param(name, value, kind, 0, bits_of(value, kind), default=default)


def test_plain_values_have_names_that_a_parameter_can_have() -> None:
    wrong: tuple[Any, ...] = (5, *({"A": 1, name: 1} for name in (1, None, "", "SEVENTEEN_LETTERS", "ÄÖÜ")))
    for each in wrong:
        with pytest.raises((UsageError, TypeError), match=r"parameter name|not iterable"):
            paramset.ParamSet(each)
    with pytest.raises(UsageError, match="component ids 0 to 255, not 300"):
        paramset.ParamSet({}, component=300)
    with pytest.raises(UsageError, match="A is given as the parameter B"):
        paramset.ParamSet({"A": paramset.WrittenParam("B", 1)})


@pytest.mark.parametrize(
    ("own", "described", "default"),
    [
        (2.0, 3.0, paramset.Default(2.0, paramset.DefaultSource.VEHICLE)),
        (None, 3, paramset.Default(3.0, paramset.DefaultSource.METADATA)),
        (None, None, None),
    ],
)
def test_the_default_of_the_vehicle_counts_before_that_of_the_metadata(
    own: float | None, described: float | None, default: paramset.Default | None
) -> None:
    assert repr(paramset.default_of(param("P", 1.0, default=own), described)) == repr(default)


def test_a_decimal_default_is_rounded_as_the_vehicle_rounds_it() -> None:
    assert paramset.add_default(Param("P", 0.1, 9, 0, bits_of(0.1, 9)), 0.1).default == pytest.approx(0.1)
    held = Param("P", 0.1, ParamType.REAL32, 0, bits_of(0.1, ParamType.REAL32))
    for described in (0.1, 0.10000000149011612):
        assert paramset.add_default(held, described).is_changed is False


def test_a_set_keeps_its_own_defaults_and_those_without_one_get_them() -> None:
    params = paramset.ParamSet(
        {
            "A": paramset.WrittenParam("A", 1, ParamType.INT32, 5),
            "B": paramset.WrittenParam("B", 1.5, ParamType.REAL32),
            "C": paramset.WrittenParam("C", 7),
            "D": paramset.WrittenParam("D", 7),
        }
    )
    filled = paramset.add_defaults(params, {"A": 9, "B": 2, "C": 8})
    assert {name: each.default for name, each in filled.items()} == {"A": 5, "B": 2.0, "C": 8, "D": None}
    assert paramset.add_defaults(params, {}) is params


def test_a_param_map_is_a_live_read_only_view() -> None:
    table = {"B": Param("B", 1, ParamType.INT32, 0, 1)}
    params = paramset.ParamMap(table)
    table["A"] = Param("A", 2, ParamType.INT32, 1, 2)
    assert params == table
    assert (params["A"], params.get("C")) == (table["A"], None)
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
    for name in paramset.ParamMap(table):  # the event loop of a blocking client adds names meanwhile
        table[f"{name}2"] = table[name]
        names.append(name)
    assert names == ["A", "B"]


def test_changed_returns_values_that_differ_from_defaults() -> None:
    nan = float("nan")
    rows = (
        ("SAME", 1.5, 1.5, False),
        ("OTHER", 1.5, 2.5, True),
        ("UNKNOWN", 1.5, None, None),
        ("ZERO", 0.0, -0.0, False),
        ("NAN", nan, nan, False),
        ("NOW_NAN", nan, 1.0, True),
    )
    table = {name: Param(name, value, 9, 0, 0, default=default) for name, value, default, _ in rows}
    assert [table[name].is_changed for name, *_ in rows] == [is_changed for *_, is_changed in rows]
    assert [*paramset.ParamMap(table).changed()] == ["OTHER", "NOW_NAN"]
