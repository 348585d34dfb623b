"""Fuzz target: damaged cache files. No data is lost, and no wrong value is accepted.

Only CacheError is raised, or UnknownVehicle if a file that was set aside had the vehicle.

The input describes changes of a valid file: SQLite refuses nearly all random bytes immediately. The rest of
the input changes the bytes of a table under a valid checksum, as an attacker would.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
import tempfile
import zlib
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from typing import Final
from unittest import mock

from fuzz.draw import Draw
from paramclient.cache import ParamCache, StoredParam, TableState, TableUpdate
from paramclient.cache.cells import Damaged
from paramclient.cache.packed_table import pack, row_checksum, unpack
from paramclient.errors import CacheError, UnknownVehicle
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType, Trust

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 256
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

NAMES: Final = tuple(f"PARAM_{number}" for number in range(12))
VEHICLE: Final = Identity(1, "fuzz", uid="a1b2c3", autopilot=12)
OTHER: Final = Identity(2, "fuzz", uid="d4e5f6", autopilot=3)
AT: Final = 1_700_000_000.0
LATER: Final = 20_000_000_000.0
"""Seconds after `AT` of later values: after most times in a damaged file, or long before some of them."""

logger = logging.getLogger("paramclient.cache")


def run(data: bytes) -> None:
    """Damage a file, then read and write it as a client does; then damage a table, alone and in a file."""
    draw = Draw(data)
    _run_file(_damaged(_good_file(), draw))
    if not draw.is_over:
        _run_blob(_damaged(_good_blob(), draw))


def _run_file(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite3"
        path.write_bytes(content)
        # each damaged file causes a warning
        with suppress(CacheError, UnknownVehicle), mock.patch.object(logger, "disabled", True):
            _use(path)
        files = [
            each for each in Path(folder).iterdir() if not each.name.endswith(("-wal", "-shm", "-journal"))
        ]
        # the damaged file is set aside under another name or still in its place, and never truncated
        assert any(each.stat().st_size >= len(content) for each in files), [each.name for each in files]


def _run_blob(changed: bytes) -> None:
    with suppress(Damaged):
        assert unpack(changed) == unpack(_good_blob()), "the checksum reports every change"
    blob = changed[:-4] + struct.pack("<I", zlib.crc32(changed[:-4]))
    rows = None
    with suppress(Damaged):
        rows = unpack(blob)
        assert unpack(pack(rows)) == rows
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite3"
        path.write_bytes(_good_file())
        with closing(sqlite3.connect(path, isolation_level=None)) as file:
            row = (len(rows or ()), AT, blob)
            file.execute("UPDATE packed SET (size, heard_last, params) = (?, ?, ?)", row)
            file.execute("UPDATE component SET checksum = ?", (row_checksum(*row),))
        with mock.patch.object(logger, "disabled", True), ParamCache(path) as kept:
            with suppress(CacheError):
                kept.fleet_diff(["PARAM_*"])
            table = kept.load(VEHICLE.key, 1)
            assert (table is None) == bool(kept.notes)
            assert table is None or (rows is not None and table.params.keys() == rows.keys())
            kept.save(_update(VEHICLE, 3.0, AT + LATER))
            held = kept.load(VEHICLE.key, 1)
            assert held is not None
            assert {name: held.params[name].value for name in NAMES} == dict.fromkeys(NAMES, 3.0)


def _use(path: Path) -> None:
    with ParamCache(path) as kept:
        for summary in kept.components():
            table = kept.load(summary.key, summary.component)
            if table is not None:
                assert len(table.params) == summary.size
                assert all(name in NAMES and param.value == 3.0 for name, param in table.params.items())
            kept.history(summary.key)
            for each in kept.snapshots(summary.key):
                reported = kept.state_at(summary.key, each.component, each.id)
                assert all(name in NAMES and param.value == 3.0 for name, param in reported.items())
        kept.vehicles()
        kept.save([_update(VEHICLE, 3.0, AT + LATER), _update(OTHER, 4.0, AT + LATER)])
        held = kept.load(VEHICLE.key, 1)
        assert held is not None
        assert {name: held.params[name].value for name in NAMES} == dict.fromkeys(NAMES, 3.0)
        kept.snapshot(VEHICLE.key, 1, reason="fuzz", at=AT + 10)


def _update(identity: Identity, value: float, at: float) -> TableUpdate:
    bits = int.from_bytes(bytes((0, 0, 0x40 if value == 3.0 else 0x80, 0x40)), "little")
    return TableUpdate(
        identity=identity,
        component=1,
        autopilot=identity.autopilot,
        at=at,
        table=TableState(hash=7, count=len(NAMES), complete=True, synced_at=at),
        params=[
            StoredParam(Param(name, value, ParamType.REAL32, index, bits, Trust.LIVE), at)
            for index, name in enumerate(NAMES)
        ],
    )


@cache
def _good_blob() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite3"
        path.write_bytes(_good_file())
        with closing(sqlite3.connect(path)) as file:
            [(blob,)] = file.execute("SELECT params FROM packed")
    assert isinstance(blob, bytes)
    return blob


@cache
def _good_file() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite3"
        with ParamCache(path) as kept:
            kept.save([_update(VEHICLE, 4.0, AT)])
            kept.save([_update(VEHICLE, 3.0, AT + 1)])
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
                at %= 200  # the header and the first page
                damaged[at : at + 1] = draw.take(1)
            case _:
                del damaged[at : at + draw.number(2)]
    return bytes(damaged)
