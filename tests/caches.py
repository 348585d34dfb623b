"""Makings of the cache's tests: records, places that cannot be written to, programs beside ours."""

from __future__ import annotations

import ctypes
import os
import random
import resource
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import paramclient
from paramclient.cache import BY_VEHICLE, ParamCache, StoredParam, TableState, TableUpdate
from paramclient.cache.database import APPLICATION_ID
from paramclient.model.identity import Identity
from paramclient.model.values import Param, ParamType, from_bits

NOW = 1_795_000_000.0
"""20 November 2026, a time when nothing else happens."""
PX4 = Identity(
    system=1,
    link="udpin:0.0.0.0:14550",
    uid="0002000000003331383300012345678901bc",
    autopilot=12,
    vehicle_type=2,
    firmware=17891392,
    git_hash="a70a558393000000",
    board=1,
    vendor_id=0x26AC,
    product_id=50,
    capabilities=(1 << 64) - 2,
)


CACHE_ALONE = f"""import sys, types
package = sys.modules["paramclient"] = types.ModuleType("paramclient")
package.__path__ = {list(paramclient.__path__)!r}
from paramclient.cache import *"""
"""Imports the cache and what it needs, not the rest of the package: a program that starts quickly."""


def stored(
    name: str,
    bits: int,
    type: int = ParamType.INT32,  # noqa: A002  # the attribute's name
    *,
    index: int | None = None,
    at: float = NOW,
    volatile: bool | None = None,
    by: str = BY_VEHICLE,
    is_raw: bool = False,
) -> StoredParam:
    """One parameter to keep, given by its bits."""
    number = ParamType(type) if 1 <= type <= 10 else type
    param = Param(name, from_bits(bits, number, is_raw=is_raw), number, index, bits)
    return StoredParam.of(param, at, volatile, by)


def update(
    *params: StoredParam,
    identity: Identity = PX4,
    component: int = 1,
    removed: Mapping[str, float] = MappingProxyType({}),
    **more: Any,
) -> TableUpdate:
    """What was learnt at NOW."""
    more = {"autopilot": 12, "at": NOW} | more
    gone = [StoredParam.gone(name, at) for name, at in removed.items()]
    return TableUpdate(identity=identity, component=component, params=[*params, *gone], **more)


def whole_table(count: int, identity: Identity = PX4, component: int = 1, first: int = 0) -> TableUpdate:
    """A table of so many parameters, synchronised under hash 0xCF579589."""
    return update(
        *(stored(f"PARAM_{number}", first + number, index=number) for number in range(count)),
        identity=identity,
        component=component,
        replace=True,
        table=TableState(0xCF579589, count, complete=True, synced_at=NOW),
    )


def values(cache: ParamCache, identity: Identity = PX4, component: int = 1) -> dict[str, Any]:
    """The values of one table; none where there is no table."""
    found = cache.load(identity.key, component)
    return {} if found is None else {name: param.value for name, param in found.params.items()}


def rubbish(size: int, seed: int = 1) -> bytes:
    """What begins as one of our files does, and is none any more."""
    content = bytearray(random.Random(seed).randbytes(size))
    content[:16] = b"SQLite format 3\0"
    content[68:72] = APPLICATION_ID.to_bytes(4, "big")
    return bytes(content)


def set_aside(path: Path) -> list[Path]:
    """The main files that were set aside."""
    kept = path.parent.glob(f"{path.name}.*-*-*")
    return sorted(each for each in kept if not each.name.endswith(("-wal", "-shm", "-journal")))


@contextmanager
def without_root_powers() -> Iterator[None]:
    """Make file permissions count for this thread, also when the tests run as root."""
    if os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # capabilities of version 3, of this thread
    powers = (ctypes.c_uint32 * 6)()
    assert libc.capget(header, powers) == 0
    before = powers[0]
    powers[0] &= ~0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    assert libc.capset(header, powers) == 0
    try:
        yield
    finally:
        powers[0] = before
        assert libc.capset(header, powers) == 0


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder in which nothing can be written, created or renamed."""
    modes = {path: path.stat().st_mode for path in (folder, *folder.iterdir())}
    for path in modes:
        path.chmod(0o500 if path.is_dir() else 0o400)
    try:
        with without_root_powers():
            yield
    finally:
        for path, mode in modes.items():
            path.chmod(mode)


@contextmanager
def full_disk(at: int) -> Iterator[None]:
    """No file of this process can grow beyond so many bytes: every write there fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (at, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
