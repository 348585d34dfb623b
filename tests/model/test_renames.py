"""Renamed parameters: finding the other name, converting values, rules that contradict each other."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient import FileError, ParamSet, ParamType, UsageError, WrittenParam
from paramclient.model.renames import Rename, Renames
from paramclient.model.values import WireValue

CHAIN = Renames([Rename("A", "B", 0.01), Rename("B", "C", 10)], "names.json")
CENTIMETRES = Renames([Rename("OLD", "NEW", 0.01)])


def written(values: Mapping[str, WireValue]) -> ParamSet:
    return ParamSet({name: WrittenParam(name, value) for name, value in values.items()}, source="a file")


def values(params: Mapping[str, WrittenParam]) -> dict[str, tuple[str, WireValue]]:
    return {name: (param.name, param.value) for name, param in params.items()}


def test_a_name_is_found_under_its_other_name_in_both_directions() -> None:
    assert values(CENTIMETRES.renamed(written({"OLD": 500}), {"NEW"})) == {"OLD": ("NEW", 5)}
    assert values(CENTIMETRES.renamed(written({"NEW": 5}), {"OLD"})) == {"NEW": ("OLD", 500)}
    assert CENTIMETRES.renamed(written({"OLD": 500, "X": 1}), {"Y"}) == {}


def test_a_chain_of_renames_is_followed_with_the_product_of_its_factors() -> None:
    assert values(CHAIN.renamed(written({"A": 500}), {"C"})) == {"A": ("C", 50)}
    assert values(CHAIN.renamed(written({"C": 50}), {"A"})) == {"C": ("A", 500)}
    assert CHAIN.other_names("B") == ("C", "A")
    assert CHAIN.find("B", {"A", "C"}) == "C", "the newer name"
    assert CHAIN.find("C", {"A", "B"}) == "B", "the nearest name"


@pytest.mark.parametrize(
    ("wanted", "held"), [({"OLD": 1, "NEW": 2}, {"NEW"}), ({"NEW": 2, "OLD": 1}, {"OLD"})]
)
def test_two_names_that_would_become_one_are_an_error(wanted: dict[str, WireValue], held: set[str]) -> None:
    (name,) = held
    with pytest.raises(UsageError, match=rf"of a file are both {name} by the renames; remove one of the two"):
        CENTIMETRES.renamed(written(wanted), held)


@pytest.mark.parametrize(
    ("value", "kind", "there", "back"),
    [
        (500, None, 5, 50000),
        (250, ParamType.INT16, 2.5, 25000),
        (0.07, None, 0.0007, 7),
        (0.07000000029802322, ParamType.REAL32, 0.0007, 7),
        (0.07000000029802322, ParamType.REAL64, 0.0007000000029802322, 7.000000029802322),
        (math.inf, None, math.inf, math.inf),
        (1e307, ParamType.REAL64, 10**305, math.inf),
        (10**400, None, math.inf, math.inf),
        (0, None, 0, 0),
    ],
)
def test_values_are_multiplied_as_decimal_numbers(
    value: float, kind: ParamType | None, there: float, back: float
) -> None:
    param = WrittenParam("OLD", value, kind, default=value, comment="why", line=3)
    assert CENTIMETRES.convert(param, "NEW") == WrittenParam("NEW", there, default=there, comment="why")
    assert CENTIMETRES.convert(WrittenParam("NEW", value, kind), "OLD") == WrittenParam("OLD", back)
    assert CENTIMETRES.convert(param, "NEW").line == 3


def test_raw_bytes_cannot_be_multiplied() -> None:
    with pytest.raises(UsageError, match="OLD cannot become NEW: its value is no number"):
        CENTIMETRES.convert(WrittenParam("OLD", b"\1\0\0\0"), "NEW")


@given(
    st.integers(-(10**6), 10**6) | st.floats(-(2.0**20), 2.0**20, width=32, allow_subnormal=False),
    st.sampled_from([1, 10, 0.01, -2, 0.001, 57.29578]),
)
def test_there_and_back_is_the_same_float32(value: int | float, factor: float) -> None:
    renames = Renames([Rename("OLD", "NEW", factor)])
    there = renames.convert(WrittenParam("OLD", value), "NEW")
    back = renames.convert(WrittenParam("NEW", there.value, ParamType.REAL64), "OLD").value
    assert isinstance(back, int | float)
    assert math.isclose(back, value, rel_tol=2**-24)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([("A", "B"), ("A", "C")], "A has two new names: B and C"),
        ([("A", "B"), ("C", "B")], "B has two old names: A and C"),
        ([("A", "A")], "the renames return to A: A to A"),
        ([("A", "B"), ("B", "C"), ("C", "A")], "the renames return to C: C to A to B to C"),
        ([("A", "")], "a parameter name has at least one character"),
        ([("A", "B", 0)], "the factor of A is 0;"),
        ([("A", "B", math.nan)], "the factor of A is nan;"),
        ([("A", "B", -math.inf)], "the factor of A is -inf;"),
        ([("A", "B", True)], "the factor of A is not a number: True"),
        ([("A", "B", 10**400)], "the factor of A is beyond the range of a float"),
        ([("A", "B", -(10**5000))], "the factor of A is beyond the range of a float"),
        ([(f"A{n}", f"A{n + 1}") for n in range(16)], "A15 is one of more than 16 names of one parameter"),
        (
            [("A7", "A8"), *((f"A{n}", f"A{n + 1}") for n in (*range(7), *range(8, 16)))],
            "A15 is one of more than 16 names",
        ),
    ],
)
def test_rules_that_contradict_each_other_are_refused(entries: list[tuple[str, str]], message: str) -> None:
    with pytest.raises(FileError) as error:
        Renames([Rename(*entry) for entry in entries])
    assert str(error.value).startswith(message)


def test_the_note_about_a_missing_parameter_names_its_other_names() -> None:
    end = "in names.json, which this vehicle does not have either"
    assert CHAIN.missing_note("A") == f"renamed to B and C {end}"
    assert CHAIN.missing_note("B") == f"renamed to C and from A {end}"
    assert CHAIN.missing_note("C") == f"renamed from B and A {end}"
    assert CHAIN.missing_note("D") == ""


def test_the_rules_name_their_source() -> None:
    assert repr(CHAIN) == "<Renames 2 from names.json>"
    assert len(CHAIN) == 2
