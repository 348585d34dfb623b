"""Lost, repeated and late frames, by the sequence numbers of one sender."""

from __future__ import annotations

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from paramclient.wire.loss import CERTAIN_GAP, GAP_MAX, REORDER_DEPTH, SequenceCheck


def check_of(sequence: Iterable[int], *, period: float = 0.02) -> SequenceCheck:
    check = SequenceCheck()
    for count, number in enumerate(sequence):
        check.receive(number % 256, count * period)
    return check


@given(st.integers(0, 255), st.lists(st.booleans(), max_size=1500))
def test_any_loss_of_few_in_a_row_is_counted_exactly(start: int, arrives: list[bool]) -> None:
    received = [start]
    lost = run = 0
    for offset, has_arrived in enumerate(arrives, start=1):
        if has_arrived or run == CERTAIN_GAP:
            received.append(start + offset)
            lost += run
            run = 0
        else:
            run += 1
    check = check_of(received)
    assert (check.lost, check.repeated, check.late) == (lost, 0, 0)


@given(st.integers(0, 255), st.lists(st.integers(1, 3), min_size=1, max_size=600))
def test_repeated_frames_are_no_loss(start: int, copies: list[int]) -> None:
    check = check_of(start + offset for offset, count in enumerate(copies) for _ in range(count))
    assert (check.lost, check.repeated, check.late) == (0, sum(copies) - len(copies), 0)


@given(st.integers(0, 255), st.lists(st.integers(0, CERTAIN_GAP - 1), min_size=1, max_size=600))
def test_slightly_reordered_frames_are_no_loss(start: int, delays: list[int]) -> None:
    order = sorted(range(1, len(delays) + 1), key=lambda each: (each + delays[each - 1], each))
    check = check_of([start, *(start + each for each in order)])
    behind = sum(each < max(order[:place], default=0) for place, each in enumerate(order))
    assert (check.lost, check.repeated, check.late) == (0, 0, behind)


@given(st.integers(0, 2000), st.integers(0, 255), st.integers(1, 600))
def test_a_sender_that_starts_anew_has_lost_nothing(before: int, first: int, after: int) -> None:
    if GAP_MAX + 1 < (first - before) % 256 < 256 - REORDER_DEPTH:
        check = check_of([*range(before + 1), *range(first, first + after)])
        assert (check.lost, check.repeated, check.late) == (0, 0, 0)
