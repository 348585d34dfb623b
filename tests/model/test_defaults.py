"""The default of a parameter: of the vehicle, else of the metadata, in the type of the parameter."""

from __future__ import annotations

import pytest

from paramclient.model.paramset import (
    DefaultSource,
    ParamSet,
    WrittenParam,
    add_default,
    add_defaults,
    default_of,
)
from paramclient.model.values import Param, ParamType, Value, bits_of


def param(
    name: str,
    value: Value,
    kind: ParamType | int = ParamType.REAL32,
    default: int | float | None = None,
) -> Param:
    return Param(name, value, kind, 0, bits_of(value, kind), default=default)


def test_the_default_of_the_vehicle_has_priority() -> None:
    default = default_of(param("P", 1.0, default=2.0), 3.0)
    assert default is not None
    assert (default.value, default.source) == (2.0, DefaultSource.VEHICLE)


def test_without_one_the_default_of_the_metadata_counts() -> None:
    default = default_of(param("P", 1.0), 3)
    assert default is not None
    assert (default.value, default.source) == (3.0, DefaultSource.METADATA)
    assert isinstance(default.value, float)
    assert default_of(param("P", 1.0)) is None


def test_a_decimal_default_is_rounded_as_the_vehicle_rounds_it() -> None:
    assert add_default(Param("P", 0.1, 9, 0, bits_of(0.1, 9)), 0.1).default == pytest.approx(0.1)
    held = Param("P", 0.1, ParamType.REAL32, 0, bits_of(0.1, ParamType.REAL32))
    for described in (0.1, 0.10000000149011612):
        assert add_default(held, described).is_changed is False


def test_a_set_keeps_its_own_defaults_and_those_without_one_get_them() -> None:
    params = ParamSet(
        {
            "A": WrittenParam("A", 1, ParamType.INT32, 5),
            "B": WrittenParam("B", 1.5, ParamType.REAL32),
            "C": WrittenParam("C", 7),
            "D": WrittenParam("D", 7),
        }
    )
    filled = add_defaults(params, {"A": 9, "B": 2, "C": 8})
    assert {name: each.default for name, each in filled.items()} == {"A": 5, "B": 2.0, "C": 8, "D": None}
    assert add_defaults(params, {}) is params
