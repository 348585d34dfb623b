"""The order of a table after additions or removals, as single reads show it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.protocol.params.table_shift import (
    CONTROL_READS,
    NEIGHBOURS,
    READS_AROUND,
    CountChange,
    ShiftedOrder,
    reads_expected,
)

ORDER = [f"P{number:04d}" for number in range(1400)]
READS_MAX = 2000
"""Reads after which a search counts as endless."""


def shown(
    order: Sequence[str], truth: Sequence[str], *changes: CountChange
) -> tuple[dict[int, str] | None, int]:
    """Return the names by index that reads of a vehicle with this table show, and the number of reads."""
    shifted = ShiftedOrder(order, len(truth))
    wanted: list[int] | None = shifted.first_indices(changes)
    read: set[int] = set()
    while wanted:
        assert read.isdisjoint(wanted), "no index is read twice"
        read.update(wanted)
        assert len(read) <= READS_MAX
        for index in wanted:
            shifted.add(index, truth[index])
        wanted = shifted.next_indices()
    return (None if wanted is None else shifted.names()), len(read)


def with_group(order: Sequence[str], switch: str, size: int, prefix: str = "NEW") -> list[str]:
    """Return a table with a group behind a switch."""
    at = order.index(switch) + 1
    return [*order[:at], *(f"{prefix}_{number}" for number in range(size)), *order[at:]]


@st.composite
def tables(draw: st.DrawFn) -> tuple[list[str], list[str], list[CountChange]]:
    """Draw a table, the larger one with some groups, and changes that may name the wrong switches."""
    order = ORDER[: draw(st.integers(1, 300))]
    larger = list(order)
    changes = []
    for number in range(draw(st.integers(1, 4))):
        behind, size = draw(st.sampled_from(["", *larger])), draw(st.integers(1, 12))
        at = 0 if not behind else larger.index(behind) + 1
        larger[at:at] = [f"G{number}_{member}" for member in range(size)]
        named = draw(st.sampled_from([behind, behind, draw(st.sampled_from(order)), ""]))
        changes.append(CountChange(named, size))
    return order, larger, changes


@given(tables())
def test_additions_are_found_wherever_they_are(
    case: tuple[list[str], list[str], list[CountChange]],
) -> None:
    order, larger, changes = case
    names, _ = shown(order, larger, *changes)
    assert names == dict(enumerate(larger))


@given(tables())
def test_removals_are_found_wherever_they_are(
    case: tuple[list[str], list[str], list[CountChange]],
) -> None:
    order, larger, changes = case
    names, _ = shown(larger, order, *(change._replace(added=-change.added) for change in changes))
    assert names == dict(enumerate(order))


@pytest.mark.parametrize("switch", [ORDER[0], ORDER[700], ORDER[-1]], ids=["first", "middle", "last"])
def test_a_group_behind_its_switch_takes_its_own_reads_and_a_few(switch: str) -> None:
    change = CountChange(switch, 7)
    larger = with_group(ORDER, switch, 7)
    names, reads = shown(ORDER, larger, change)
    assert names == dict(enumerate(larger))
    assert reads <= reads_expected([change]) == 7 + READS_AROUND + CONTROL_READS + 1
    gone = CountChange(switch, -7)
    names, reads = shown(larger, ORDER, gone)
    assert names == dict(enumerate(ORDER))
    assert reads <= reads_expected([gone]) == READS_AROUND + CONTROL_READS + 1


def test_a_group_of_an_unknown_place_takes_some_tens_of_reads() -> None:
    larger = with_group(ORDER, ORDER[333], 7)
    for changes in ((), (CountChange("", 7),), (CountChange(ORDER[900], 7),)):
        names, reads = shown(ORDER, larger, *changes)
        assert names == dict(enumerate(larger))
        assert reads < 7 + 60
        names, reads = shown(larger, ORDER, *(change._replace(added=-7) for change in changes))
        assert names == dict(enumerate(ORDER))
        assert reads < 40


def test_a_part_of_a_group_may_appear_elsewhere() -> None:
    larger = with_group(with_group(ORDER, ORDER[100], 4), ORDER[1200], 3, "OTHER")
    names, reads = shown(ORDER, larger, CountChange(ORDER[100], 7))
    assert names == dict(enumerate(larger))
    assert reads < 70


def test_the_switch_of_a_group_in_a_group_need_not_be_known() -> None:
    outer = with_group(ORDER, ORDER[500], 6, "OUTER")
    larger = with_group(outer, "OUTER_2", 3, "INNER")
    names, reads = shown(ORDER, larger, CountChange(ORDER[500], 6), CountChange("OUTER_2", 3))
    assert names == dict(enumerate(larger))
    assert reads <= 6 + 3 + READS_AROUND * 2 + CONTROL_READS + 1 + 2 * NEIGHBOURS


@pytest.mark.parametrize(
    "truth",
    [
        pytest.param([*ORDER[:100], "NEW", *ORDER[101:]], id="replaced"),
        pytest.param([*with_group(ORDER, ORDER[100], 9)[:1200], *ORDER[1193:]], id="added and removed"),
        pytest.param([*with_group(ORDER, ORDER[100], 7)[:-2], ORDER[-1], ORDER[-2]], id="in another order"),
        pytest.param([*with_group(ORDER, ORDER[100], 7)[:-1], "NEW_0"], id="twice"),
        pytest.param([f"Q{number}" for number in range(1407)], id="another table"),
    ],
)
def test_names_that_contradict_the_premise_show_no_table(truth: Sequence[str]) -> None:
    change = CountChange(ORDER[100], len(truth) - len(ORDER) or 1)
    assert shown(ORDER, truth, change)[0] is None
