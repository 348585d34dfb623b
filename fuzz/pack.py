"""param.pck: what can be read says the same when it is written again, and only PackError comes."""

from __future__ import annotations

from typing import Final

from paramclient.errors import PackError
from paramclient.protocol.ftp import param_pck

__all__ = ["LONGEST", "run"]

LONGEST: Final = 1024
"""Bytes of an input: longer ones take their time and say nothing new."""

MOST_READ = 239


def run(data: bytes) -> None:
    """The bytes of a file, as a vehicle gives it and as it is written to one."""
    assert param_pck.total_of(data) in (None, int.from_bytes(data[4:6], "little"))
    _check_table(data)
    _check_upload(data)


def _check_table(data: bytes) -> None:
    try:
        held = param_pck.decode(data)
    except PackError as error:
        assert 0 <= error.offset <= len(data)
        return
    assert len(held.entries) == int.from_bytes(data[2:4], "little") <= held.total
    for size in (MOST_READ, 1 + len(data) % MOST_READ):
        again = param_pck.encode(
            held.entries, total=held.total, with_defaults=held.with_defaults, read_size=size
        )
        assert param_pck.decode(again) == held


def _check_upload(data: bytes) -> None:
    try:
        entries = param_pck.decode_upload(data)
    except PackError as error:
        assert 0 <= error.offset <= len(data)
        return
    assert param_pck.decode_upload(param_pck.encode_upload(entries)) == entries
