"""The cache file, damaged in any way: only CacheError comes, nothing is lost, and nothing wrong is believed.

The input says what is changed in a file that was written before; a whole file would leave the fuzzer with
nothing but bytes that SQLite refuses at once.
"""

from __future__ import annotations

import logging
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final
from unittest import mock

from fuzz.draw import Draw
from paramclient.cache import ParamCache, StoredParam, TableState, TableUpdate
from paramclient.errors import CacheError
from paramclient.identity import Identity
from paramclient.values import Param, ParamType, Trust

__all__ = ["LONGEST", "run"]

LONGEST: Final = 256
"""Bytes of an input: longer ones take their time and say nothing new."""

NAMES: Final = tuple(f"PARAM_{number}" for number in range(12))
VEHICLE: Final = Identity(1, "fuzz", uid="a1b2c3", autopilot=12)
OTHER: Final = Identity(2, "fuzz", uid="d4e5f6", autopilot=3)
AT: Final = 1_700_000_000.0

logger = logging.getLogger("paramclient.cache")


def run(data: bytes) -> None:
    """Damage a file, then read and write it as a client would."""
    draw = Draw(data)
    content = _damaged(_good_file(), draw)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite3"
        path.write_bytes(content)
        # each damaged file is worth a warning
        with suppress(CacheError), mock.patch.object(logger, "disabled", True):
            _use(path)
        files = [
            each for each in Path(folder).iterdir() if not each.name.endswith(("-wal", "-shm", "-journal"))
        ]
        # the damaged file is set aside under another name, or stands where it was; nothing of it is cut off
        assert any(each.stat().st_size >= len(content) for each in files), [each.name for each in files]


def _use(path: Path) -> None:
    with ParamCache(path) as kept:
        for summary in kept.components():
            table = kept.load(summary.key, summary.component)
            if table is not None:
                assert len(table.params) == summary.size
                assert all(name in NAMES and param.value == 3.0 for name, param in table.params.items())
            kept.history(summary.key)
            for each in kept.snapshots(summary.key):
                told = kept.state_at(summary.key, each.component, each.id)
                assert all(name in NAMES and param.value == 3.0 for name, param in told.items())
        kept.vehicles()
        kept.save([_update(VEHICLE, 3.0), _update(OTHER, 4.0)])
        held = kept.load(VEHICLE.key, 1)
        assert held is not None
        assert {name: held.params[name].value for name in NAMES} == dict.fromkeys(NAMES, 3.0)
        kept.snapshot(VEHICLE.key, 1, reason="fuzz", at=AT + 10)


def _update(identity: Identity, value: float) -> TableUpdate:
    bits = int.from_bytes(bytes((0, 0, 0x40 if value == 3.0 else 0x80, 0x40)), "little")
    return TableUpdate(
        identity=identity,
        component=1,
        autopilot=identity.autopilot,
        at=AT + value,
        table=TableState(hash=7, count=len(NAMES), complete=True, synced_at=AT + value),
        params=[
            StoredParam(Param(name, value, ParamType.REAL32, index, bits, Trust.LIVE), AT + value)
            for index, name in enumerate(NAMES)
        ],
    )


@cache
def _good_file() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite3"
        with ParamCache(path) as kept:
            kept.save([_update(VEHICLE, 4.0)])
            kept.save([_update(VEHICLE, 3.0)])
            kept.snapshot(VEHICLE.key, 1, reason="before", at=AT + 5)
        return path.read_bytes()


def _damaged(content: bytes, draw: Draw) -> bytes:
    damaged = bytearray(content)
    for _ in range(draw.number() % 6):
        at = draw.number(3) % max(len(damaged), 1)
        match draw.number() % 5:
            case 0:
                del damaged[at:]
            case 1:
                damaged[at:at] = draw.take(draw.number() % 32)
            case 2:
                size = draw.number() % 32
                damaged[at : at + size] = draw.take(size)
            case 3:
                at %= 200  # the header, and the first page behind it
                damaged[at : at + 1] = draw.take(1)
            case _:
                del damaged[at : at + draw.number(2)]
    return bytes(damaged)
