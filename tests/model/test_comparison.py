"""Comparison of two parameter sets, with and without a base."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.model.comparison import ChangedSide, DifferenceStatus, compare, defaults_of, same_value
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, from_bits

INT32, REAL32, REAL64 = ParamType.INT32, ParamType.REAL32, ParamType.REAL64
NAN, OTHER_NAN = from_bits(0x7FC00000, REAL32), from_bits(0x7FC00001, REAL32)

# close together, so that two drawn numbers are often equal
NUMBERS = (
    st.integers(-3, 3)
    | st.sampled_from([2**24 - 1, 2**24, 2**24 + 1, 2**31 - 1, 2**31, 2**63, 2**64, 10**400, 300, 44])
    | st.sampled_from([0.0, -0.0, 0.1, 1.0, 1.5, 16777216.0, 16777217.0, 1e300, float("inf"), NAN, OTHER_NAN])
    | st.floats()
    | st.floats(width=32)
)
VALUES = NUMBERS | st.sampled_from([b"\0\0\0\0", b"\1\0\0\0"])
TYPES = st.none() | st.sampled_from([*ParamType, 77])
SETS = st.dictionaries(
    st.sampled_from("ABCDE"), st.builds(WrittenParam, st.just("P"), VALUES, TYPES, st.none() | NUMBERS)
).map(lambda params: ParamSet({name: replace(param, name=name) for name, param in params.items()}))
STATUS_MIRRORED = {
    DifferenceStatus.ONLY_LEFT: DifferenceStatus.ONLY_RIGHT,
    DifferenceStatus.ONLY_RIGHT: DifferenceStatus.ONLY_LEFT,
}
CHANGED_SIDE_MIRRORED = {ChangedSide.LEFT: ChangedSide.RIGHT, ChangedSide.RIGHT: ChangedSide.LEFT}


def written(value: Value, number: int | None = None) -> WrittenParam:
    return WrittenParam("P", value, number)


def float32(value: float) -> float:
    rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return rounded


@pytest.mark.parametrize(
    ("left", "right", "same"),
    [
        (written(0.1), written(float32(0.1), REAL32), True),
        (written(0.1), written(0.10000001), False),
        (written(0.1), written(0.1 + 1e-12), True),
        (written(0.1, REAL32), written(0.1 + 1e-12, REAL64), True),
        (written(0.0), written(-0.0), True),
        (written(NAN, REAL32), written(NAN), True),
        (written(NAN, REAL32), written(OTHER_NAN, REAL32), False),
        (written(1, INT32), written(1.0, REAL32), True),
        (written(1.5), written(1, INT32), False),
        (written(1, ParamType.UINT8), written(1, INT32), True),
        (written(255, ParamType.UINT8), written(-1, ParamType.INT8), False),
        (written(2**24 + 1, INT32), written(2**24, INT32), False),
        (written(2**24 + 1), written(float(2**24), REAL32), True),
        (written(2**24 + 1), written(float(2**24)), True),
        (written(2**24 + 1, INT32), written(float(2**24)), False),
        (written(300, ParamType.UINT8), written(300, ParamType.UINT8), True),
        (written(300, ParamType.UINT8), written(301, ParamType.UINT8), False),
        (written(1e300), written(float("inf")), False),
        (written(b"\1\0\0\0", 77), written(b"\1\0\0\0", 77), True),
        (written(b"\1\0\0\0", 77), written(b"\1\0\0\0"), True),
        (written(b"\1\0\0\0", 77), written(b"\1\0\0\0", 78), False),
        (written(b"\1\0\0\0", 77), written(b"\2\0\0\0", 77), False),
        (written(b"\1\0\0\0", INT32), written(1, INT32), False),
    ],
)
def test_same_value_of_pairs(left: WrittenParam, right: WrittenParam, same: bool) -> None:
    assert same_value(left, right) is same
    assert same_value(right, left) is same


@given(SETS, SETS, st.none() | SETS)
def test_comparison_is_complete_and_symmetric(left: ParamSet, right: ParamSet, base: ParamSet | None) -> None:
    there, back = compare(left, right, base=base), compare(right, left, base=base)
    assert [entry.name for entry in there.entries] == sorted(left.keys() | right.keys())
    for ours, theirs in zip(there.entries, back.entries, strict=True):
        assert (ours.left, ours.right, ours.base) == (theirs.right, theirs.left, theirs.base)
        assert theirs.status == STATUS_MIRRORED.get(ours.status, ours.status)
        assert theirs.changed_side == (
            ours.changed_side and CHANGED_SIDE_MIRRORED.get(ours.changed_side, ours.changed_side)
        )
        assert (ours.types_differ, ours.is_rounding) == (theirs.types_differ, theirs.is_rounding)
        assert (ours.changed_side is None) == (base is None or ours.name not in base)
    assert there.is_same is back.is_same is (not there.differences)
    assert sum(there.counts.values()) == len(there.entries)


def test_plain_values_are_compared_as_sets_are() -> None:
    assert compare({"A": 5, "B": 1}, {"A": 6, "B": 1}, base={"A": 5}).changed_sides == {ChangedSide.RIGHT: 1}


def test_defaults_of_leaves_out_unknown_and_differing_defaults() -> None:
    both = WrittenParam("A", 5, INT32, 1)
    old = ParamSet({"A": both, "B": WrittenParam("B", 2.0, REAL32, 2.0), "C": WrittenParam("C", 3.0, REAL32)})
    new = ParamSet({"A": both, "B": WrittenParam("B", 3.0, REAL32, 3.0), "D": WrittenParam("D", 1, INT32, 0)})
    base = defaults_of(old, new)
    assert dict(base) == {"A": WrittenParam("A", 1, INT32), "D": WrittenParam("D", 0, INT32)}
    changed_side = {entry.name: entry.changed_side for entry in compare(old, new, base=base).entries}
    assert changed_side == {"A": ChangedSide.BOTH, "B": None, "C": None, "D": ChangedSide.RIGHT}
    assert len(defaults_of(ParamSet({"A": WrittenParam("A", 1)}))) == 0
