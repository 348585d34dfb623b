"""What is acknowledged as durable is on the disk, and what is not is said."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from paramclient import CacheError, NotDurable, ParamCache, ParamClient, UsageError
from paramclient.provision import apply
from tests.shell import in_simulated_time, small_px4

NAME = "PARAM_01"


@contextmanager
def no_disk() -> Iterator[None]:
    """No write of any cache can be made durable."""
    save = ParamCache.save

    def fail(cache: ParamCache, update: Any, *, durable: bool = False) -> None:
        if durable:
            raise CacheError("no room")
        save(cache, update)

    with mock.patch.object(ParamCache, "save", fail):
        yield


@in_simulated_time
async def test_a_durable_set_is_on_the_disk_with_its_line_when_it_returns(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    async with ParamClient(small_px4(), cache=path) as client:
        component = await client.only_component()
        for number, value in enumerate((5.0, 6.0, 6.0)):  # at once, with the vehicle hardly known
            assert (await component.set(NAME, value, durable=True)).status == "accepted"
            with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as other:
                assert other.execute("SELECT count(*) FROM history").fetchone() == (min(number + 1, 2),)
            with ParamCache(path) as cache:
                assert cache.component().params[NAME].value == value


@in_simulated_time
async def test_without_a_disk_nothing_is_sent_or_it_is_said_what_the_vehicle_has(tmp_path: Path) -> None:
    vehicle = small_px4()
    async with ParamClient(vehicle, cache=False) as client:
        component = await client.only_component()
        with pytest.raises(UsageError, match="durable needs a cache"):
            await component.set(NAME, 5.0, durable=True)
        with pytest.raises(UsageError, match="durable needs a cache"):
            await apply(component, {NAME: 5.0}, durable=True)
    assert vehicle.values[NAME] != 5.0
    async with ParamClient(vehicle, cache=tmp_path / "cache") as client:
        component = await client.only_component()
        await component.fetch_all()
        with no_disk(), pytest.raises(NotDurable, match=f"1/1 has accepted {NAME}, but .*: no room"):
            await component.set(NAME, 10.0, durable=True)
        assert vehicle.values[NAME] == component.params[NAME].value == 10.0
        await component.set(NAME, 11.0, durable=True)
        assert client.cache is not None
        assert client.cache.component().params[NAME].value == 11.0


@in_simulated_time
async def test_a_durable_apply_ends_on_the_disk(tmp_path: Path) -> None:
    async with ParamClient(vehicle := small_px4(), cache=tmp_path / "cache") as client:
        component = await client.only_component()
        assert (await apply(component, {NAME: 5.0}, durable=True)).complete
        with no_disk():
            result = await apply(component, {NAME: 6.0}, durable=True)
        assert isinstance(result.error, CacheError)
        assert vehicle.values[NAME] == 6.0
