"""Fuzz target: param.pck. Only PackError is raised, and a file that is read can be written unchanged."""

from __future__ import annotations

from typing import Final

from paramclient.errors import PackError
from paramclient.protocol import param_pck

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 1024
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

READ_SIZE_MAX = 239


def run(data: bytes) -> None:
    """Read and write a file."""
    try:
        held = param_pck.decode(data)
    except PackError as error:
        assert 0 <= error.offset <= len(data)
        return
    assert len(held.entries) == int.from_bytes(data[2:4], "little") <= held.total
    for size in (READ_SIZE_MAX, 1 + len(data) % READ_SIZE_MAX):
        again = param_pck.encode(
            held.entries, total=held.total, with_defaults=held.with_defaults, read_size=size
        )
        assert param_pck.decode(again) == held
