"""Descriptions that the service loads without a request, and the defaults that they give."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import httpx
import pytest

from paramclient import ParamCache
from paramclient.links import SimLink
from paramclient.metadata import download
from paramclient.protocol.wire import COMPONENT_METADATA_ID, CommandLong, FileTransfer
from paramclient.service import Hub, create_app
from paramclient.sim import ArduPilotVehicle, Endpoint, PX4Vehicle
from tests.asgi import a_browser
from tests.service_hub import C
from tests.shell import FlakyLink, Tap, in_simulated_time, simulated_time_loop, until

CHANGED = "MC_ROLL_P"
"""A parameter whose default in the metadata of the simulated PX4 is 4."""

SMALL = {f"P_{number:02}": number for number in range(40)}


@pytest.fixture(autouse=True)
def _threads_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the clock of a `SimulatedTimeLoop` while a worker thread reads files."""
    in_thread = download._in_thread

    async def counted(*args: Any, **kwargs: Any) -> Any:
        simulated_time_loop().threads += 1
        try:
            return await in_thread(*args, **kwargs)
        finally:
            simulated_time_loop().threads -= 1

    monkeypatch.setattr(download, "_in_thread", counted)


@asynccontextmanager
async def serving(
    link: Endpoint | SimLink, place: Path | None = None, **options: Any
) -> AsyncIterator[tuple[Hub, httpx.AsyncClient]]:
    """A service with this vehicle that has fetched its table."""
    cache = None if place is None else ParamCache(place / "cache.sqlite3")
    named = SimLink(link, "sim:one") if not isinstance(link, SimLink) else link
    async with Hub([named], cache=cache or False, **options) as hub, a_browser(create_app(hub)) as browser:
        await until(lambda: any(each.component.state == "synced" for each in hub.followed), pause=0.1)
        yield hub, browser
    if cache is not None:
        cache.close()


async def described(hub: Hub, seconds: float = 10.0) -> bool:
    """Whether the only component has descriptions after this time."""
    await anyio.sleep(seconds)
    return hub.followed[0].metadata is not None


def requests_of(tap: Tap) -> int:
    """The number of MAVFTP messages that were sent to a vehicle."""
    return len(tap.messages(FileTransfer))


def locations_requested(tap: Tap) -> int:
    """The number of requests for COMPONENT_METADATA, without which no file is read."""
    return sum(each.params[0] == COMPONENT_METADATA_ID for each in tap.messages(CommandLong))


def changed(vehicle: PX4Vehicle, value: float = 6.5) -> PX4Vehicle:
    vehicle.set_param(CHANGED, value)
    return vehicle


# Loading


@in_simulated_time
async def test_descriptions_are_loaded_after_the_table_and_give_the_defaults() -> None:
    async with serving(changed(PX4Vehicle(metadata=True))) as (hub, browser):
        assert await described(hub)
        infos = (await browser.get(f"{C}/metadata")).json()
        assert infos["params"][CHANGED]["units"] == "1/s"
        reported = (await browser.get(f"{C}/params")).json()["params"]
        param = reported[CHANGED]
        assert (param["value"], param["default"], param["default_source"]) == (6.5, 4, "metadata")
        assert param["is_default"] is False
        assert reported["MC_PITCH_P"]["is_default"] is True
        assert (await browser.get(f"{C}/params/{CHANGED}")).json()["default_source"] == "metadata"
        assert "metadata_note" not in (await browser.get(C)).json()


@in_simulated_time
async def test_defaults_of_the_metadata_count_in_filters_files_and_comparisons() -> None:
    async with serving(changed(PX4Vehicle(metadata=True))) as (hub, browser):
        assert await described(hub)
        differing = (await browser.get(f"{C}/params", params={"changed": "true"})).json()["params"]
        assert CHANGED in differing
        assert "MC_PITCH_P" not in differing
        query = {"changed": "true", "format": "parm", "from": "known"}
        file = await browser.get(f"{C}/file", params=query)
        assert {line.split(",")[0].split()[0] for line in file.text.splitlines() if line[:1] != "#"} == set(
            differing
        )
        body = {
            "wanted": {"values": {CHANGED: 4.0}},
            "base": {"defaults": True},
            "known": True,
            "partial": True,
        }
        compared = (await browser.post(f"{C}/diff", json=body)).json()
        assert compared["params"][CHANGED]["default_source"] == "metadata"
        assert compared["params"][CHANGED]["changed_side"] == "right"
        assert "from the metadata" in compared["base"]["source"]


@in_simulated_time
async def test_an_event_of_a_change_has_the_default_too() -> None:
    async with serving(PX4Vehicle(metadata=True)) as (hub, browser):
        assert await described(hub)
        answer = await browser.put(f"{C}/params/{CHANGED}", json={"value": 7.0})
        assert answer.status_code == 200
        param = (await browser.get(f"{C}/params/{CHANGED}")).json()
        assert (param["default"], param["is_default"]) == (4, False)


@in_simulated_time
async def test_they_are_remembered_for_the_firmware(tmp_path: Path) -> None:
    for is_first in (True, False):
        tap = Tap(PX4Vehicle(metadata=True))
        async with serving(tap, tmp_path) as (hub, _):
            assert await described(hub)
            assert (requests_of(tap) > 0) is is_first


# Where they are not loaded


@in_simulated_time
async def test_a_slow_transfer_is_given_up_once_with_a_note(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "paramclient.service")
    vehicle = PX4Vehicle(metadata=True, ftp_rate=2_000.0)
    tap = Tap(vehicle)
    async with serving(tap) as (hub, browser):
        assert not await described(hub)
        note = "the transfer did not end within 2 s"
        assert (await browser.get(C)).json()["metadata_note"] == note
        assert not vehicle.open_files
        sent = requests_of(tap)
        assert not await described(hub, 300.0)
        assert requests_of(tap) == sent, "it is not repeated"
        notes = [
            each.getMessage() for each in caplog.records if "descriptions not loaded" in each.getMessage()
        ]
        assert notes == [f"1/1 on sim:one: descriptions not loaded: {note}"]
        answer = await browser.post(f"{C}/metadata", json={})
        assert answer.status_code == 200, "a user may wait longer"
        assert "metadata_note" not in (await browser.get(C)).json()


@in_simulated_time
async def test_they_are_loaded_when_the_vehicle_is_disarmed() -> None:
    vehicle = PX4Vehicle(metadata=True, armed=True)
    tap = Tap(vehicle)
    async with serving(tap) as (hub, browser):
        assert not await described(hub)
        assert not requests_of(tap)
        assert (await browser.get(C)).json()["metadata_note"] == "the vehicle is armed"
        vehicle.armed = False
        assert await described(hub)


@pytest.mark.parametrize(
    ("vehicle", "options"),
    [
        (PX4Vehicle(metadata=True, burst=1, period=0.125, table=SMALL), {}),
        (PX4Vehicle(metadata=True), {"policy": "hash-only"}),
        (ArduPilotVehicle(ftp=False, live=()), {}),
    ],
)
@in_simulated_time
async def test_where_it_cannot_be_quick_nothing_is_requested(vehicle: Any, options: dict[str, Any]) -> None:
    tap = Tap(vehicle)
    async with Hub([SimLink(tap, "sim:one")], cache=False, **options) as hub:
        await until(lambda: hub.followed, pause=0.1)
        assert not await described(hub, 60.0)
    assert not locations_requested(tap)


@in_simulated_time
async def test_a_listening_service_and_one_without_fetches_request_nothing() -> None:
    for options in ({"listen_only": True}, {"fetches": False}):
        tap = Tap(PX4Vehicle(metadata=True))
        async with Hub([SimLink(tap, "sim:one")], cache=False, **options) as hub:
            await until(lambda: hub.followed, pause=0.1)
            if options.get("fetches") is False:
                await hub.followed[0].component.fetch_all()
            assert not await described(hub, 30.0)
            assert not requests_of(tap)


@in_simulated_time
async def test_descriptions_of_a_vehicle_without_them_are_requested_once() -> None:
    tap = Tap(PX4Vehicle())
    async with serving(tap) as (hub, browser):
        assert not await described(hub, 120.0)
        assert (await browser.get(C)).json()["metadata_note"] == "the vehicle serves no metadata"
        assert locations_requested(tap) == 1


@in_simulated_time
async def test_a_link_that_drops_meanwhile_does_not_prevent_it_later() -> None:
    link = FlakyLink(PX4Vehicle(metadata=True, ftp_rate=8_000.0))
    async with serving(link) as (hub, _):
        await until(lambda: hub._descriptions._loading, pause=0.05)
        await link.drop(stays_offline=False)
        assert await described(hub, 60.0)


@in_simulated_time
async def test_a_file_of_a_user_stays_when_the_vehicle_is_found_again() -> None:
    content = b'{"version": 1, "parameters": [{"name": "MC_ROLL_P", "type": "Float", "default": 2.0}]}'
    tap = Tap(PX4Vehicle())
    async with serving(tap) as (hub, browser):
        await anyio.sleep(5.0)
        headers = {"content-type": "application/octet-stream"}
        answer = await browser.put(f"{C}/metadata", content=content, headers=headers)
        assert answer.status_code == 200
        tap.is_mute = True
        await anyio.sleep(10.0)
        tap.is_mute = False
        await anyio.sleep(10.0)
        assert hub.followed[0].component.state == "synced"
        assert (await browser.get(f"{C}/params/{CHANGED}")).json()["default"] == 2


@in_simulated_time
async def test_another_firmware_has_descriptions_of_its_own(tmp_path: Path) -> None:
    vehicle = PX4Vehicle(metadata=True)
    tap = Tap(vehicle)
    async with serving(tap, tmp_path) as (hub, browser):
        assert await described(hub)
        first, requested = hub.followed[0].metadata, locations_requested(tap)
        vehicle._version = replace(vehicle._version, git_hash=bytes(range(1, 9)))
        vehicle.reboot(down=8.0)
        await anyio.sleep(60.0)
        assert hub.followed[0].component.identity.git_hash == bytes(range(1, 9))[::-1].hex()
        assert hub.followed[0].metadata is not first
        assert locations_requested(tap) == requested + 1
        assert (await browser.get(f"{C}/params/{CHANGED}")).json()["default_source"] == "metadata"


@in_simulated_time
async def test_a_vehicle_in_the_cache_has_its_defaults_and_descriptions(tmp_path: Path) -> None:
    async with serving(changed(PX4Vehicle(metadata=True)), tmp_path) as (hub, browser):
        assert await described(hub)
        place = f"/api/v1/vehicles/{quote(str(hub.followed[0].key), safe='')}/1/params"
        param = (await browser.get(place)).json()["params"][CHANGED]
        assert (param["default_source"], param["is_default"], "metadata" in param) == (
            "metadata",
            False,
            False,
        )
        whole = (await browser.get(place, params={"metadata": "true"})).json()["params"][CHANGED]
        assert whole["metadata"]["units"] == "1/s"
