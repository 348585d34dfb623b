"""The pieces of a file: in any order, twice, overlapping, and an end that moves."""

from __future__ import annotations

import tracemalloc

from hypothesis import given
from hypothesis import strategies as st

from paramclient.protocol.ftp.blocks import Blocks
from tests.simulation import is_so

FILE = bytes(range(256)) * 8


def test_in_order() -> None:
    blocks = Blocks()
    assert blocks.take(0, b"abc")
    assert blocks.take(3, b"de")
    assert (blocks.received, blocks.reached, blocks.end) == (5, 5, None)
    assert is_so(not blocks.is_complete)
    blocks.ends_at(5)
    assert blocks.is_complete
    assert blocks.content == b"abcde"


def test_a_gap_is_missing_until_it_is_filled() -> None:
    blocks = Blocks()
    blocks.take(0, b"ab")
    blocks.take(9, b"jk")
    assert list(blocks.missing(3)) == [2, 5, 8]
    assert blocks.is_missing(8)
    assert not blocks.is_missing(9)
    blocks.ends_at(11)
    assert is_so(not blocks.is_complete)
    assert blocks.take(5, b"fgh")
    assert list(blocks.missing(3)) == [2, 8]
    assert blocks.take(2, b"cde")
    assert blocks.take(8, b"i")
    assert blocks.is_complete
    assert blocks.content == b"abcdefghijk"


def test_the_first_bytes_received_for_an_offset_are_kept() -> None:
    blocks = Blocks()
    blocks.take(2, b"cd")
    assert not blocks.take(2, b"XX")
    assert blocks.take(0, b"abXXef")
    blocks.ends_at(6)
    assert blocks.content == b"abcdef"
    assert blocks.received == 6


def test_nothing_behind_the_end_is_taken() -> None:
    blocks = Blocks()
    blocks.ends_at(4)
    assert list(blocks.missing(10)) == [0]
    assert not blocks.take(4, b"x")
    assert blocks.take(2, b"cdX")
    assert blocks.take(0, b"ab")
    assert blocks.content == b"abcd"


def test_the_end_is_never_postponed() -> None:
    blocks = Blocks()
    blocks.take(0, b"ab")
    blocks.ends_at(6)
    assert list(blocks.missing(10)) == [2]
    blocks.ends_at(9)
    assert blocks.end == 6
    blocks.ends_at(2)
    assert blocks.is_complete
    assert blocks.content == b"ab"


def test_a_file_that_has_become_shorter_is_cut() -> None:
    blocks = Blocks()
    blocks.take(0, b"abcd")
    blocks.take(8, b"ij")
    blocks.ends_at(3)
    assert blocks.is_complete
    assert (blocks.content, blocks.received) == (b"abc", 3)


def test_an_empty_file() -> None:
    blocks = Blocks()
    blocks.ends_at(0)
    assert blocks.is_complete
    assert blocks.content == b""


@given(
    st.lists(st.tuples(st.integers(0, len(FILE) - 1), st.integers(1, 300)), max_size=30),
    st.integers(1, 300),
    st.booleans(),
)
def test_any_pieces_and_what_was_missing_make_the_file(
    pieces: list[tuple[int, int]], size: int, end_first: bool
) -> None:
    blocks = Blocks()
    had: set[int] = set()
    if end_first:
        blocks.ends_at(len(FILE))
    for start, length in pieces:
        data = FILE[start : start + length]
        new = set(range(start, start + len(data))) - had
        assert blocks.take(start, data) == bool(new)
        had |= new
        assert blocks.received == len(had)
    blocks.ends_at(len(FILE))
    while (offset := next(blocks.missing(size), None)) is not None:
        assert blocks.is_missing(offset)
        assert blocks.take(offset, FILE[offset : offset + size])
    assert blocks.is_complete
    assert blocks.content == FILE


def test_a_piece_far_ahead_takes_no_memory_for_what_lies_before_it() -> None:
    blocks = Blocks()
    tracemalloc.start()
    try:
        blocks.take(0xFFFF_FF00, b"x")
        assert tracemalloc.get_traced_memory()[1] < 10_000
    finally:
        tracemalloc.stop()
    assert next(blocks.missing(239)) == 0
