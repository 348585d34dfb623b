"""A client that never sends a byte: its table fills by what others on the link ask for."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from pathlib import Path

import anyio
import pytest

from paramclient import NoReply, ParamType, Policy, SyncState, Trust, UsageError
from paramclient.cli.app import run
from paramclient.client.component import PASSIVE_TIMEOUT
from paramclient.model.values import Encoding, encode_value
from paramclient.wire import messages
from tests.client.conftest import connected, table_in
from tests.shell import Radio, a_client, bits, generic, residue, small_px4

LIST = messages.ParamRequestList(1, 1)
HASH = messages.ParamRequestRead(1, 1, messages.HASH_CHECK, -1)


class Channel(Radio):
    """A channel on which another station asks the vehicle."""

    def ask(self, *said: messages.Message, system: int = 254) -> None:
        for message in said:
            self.other.append(messages.encode(message, system=system, component=190, sequence=0))


async def test_not_a_byte_is_sent() -> None:
    channel = Channel(small_px4())
    async with connected(channel, listen_only=True) as (client, component):
        assert (component.autopilot, component.state) == ("px4", "new")
        assert component.identity.uid is None
        with pytest.raises(NoReply):
            await component.fetch_all(timeout=10.0)
        channel.is_mute = True
        await anyio.sleep(30.0)
        assert component.state == "lost"
        channel.is_mute = False
        await anyio.sleep(60.0)
        assert component.state == "new"
        assert not client.core.station.is_waiting
        assert residue(component) == []
        assert client.bytes_sent == 0
    assert channel.received == []


async def test_the_list_that_another_station_requests_fills_the_table() -> None:
    vehicle = small_px4()
    channel = Channel(vehicle)
    async with connected(channel, listen_only=True) as (client, component):
        channel.ask(LIST)
        result = await component.fetch_all()
        assert bits(result.params) == bits(vehicle.params)
        assert (result.source, result.missing, result.count) == ("stream", (), 25)
        assert result.hash == component.hash == vehicle.announced_hash()
        assert component.sync_state is SyncState.SYNCED
        assert {param.trust for param in component.params.values()} == {Trust.LIVE}
        with anyio.fail_after(0.01):
            again = await component.fetch_all()
        assert again.params == result.params
        assert again.hash == vehicle.announced_hash()
        assert (await client.fetch_all()).results[1, 1].hash == vehicle.announced_hash()
    assert channel.received == []


async def test_a_write_of_another_station_is_a_change_with_its_author() -> None:
    channel = Channel(generic())
    async with connected(channel, listen_only=True) as (_, component):
        channel.ask(LIST)
        await component.fetch_all()
        changes = component.changes()
        raw = encode_value(7, ParamType.INT32, Encoding.BYTEWISE)
        # also of a station with the ids that a client has
        channel.ask(messages.ParamSet(1, 1, "PARAM_01", raw, ParamType.INT32), system=255)
        change = await anext(changes)
        assert (change.name, change.by) == ("PARAM_01", "station 255/190")
        assert component.params["PARAM_01"].value == 7
        assert component.sync_state is SyncState.SYNCED


async def test_calls_that_send_are_refused_at_once() -> None:
    channel = Channel(small_px4())
    async with connected(channel, listen_only=True) as (client, component):
        calls: list[Callable[[], Awaitable[object]]] = [
            lambda: component.get("PARAM_01"),
            lambda: component.get(0),
            lambda: component.set("PARAM_01", 1),
            lambda: component.read_file("@PARAM/param.pck"),
            lambda: component.fetch_all(refresh=True),
            lambda: client.fetch_all(refresh=True),
        ]
        with anyio.fail_after(0.01):
            for call in calls:
                with pytest.raises(UsageError, match="the client only listens"):
                    await call()
        assert residue(component) == []
    assert channel.received == []


def test_policy_and_watch_interval_are_refused_with_listen_only() -> None:
    for options in ({"policy": Policy.HASH_ONLY}, {"watch_interval": 5.0}):
        with pytest.raises(UsageError, match="the client only listens"):
            a_client(small_px4(), listen_only=True, **options)
    a_client(small_px4(), listen_only=True, watch_interval=0, policy="auto")


@pytest.mark.parametrize("timeout", [None, 3.0])
async def test_fetch_all_without_any_request_of_others_ends_with_no_reply(timeout: float | None) -> None:
    async with connected(Channel(generic()), listen_only=True) as (client, component):
        for fetch_all in (component.fetch_all, client.fetch_all):
            began = anyio.current_time()
            with pytest.raises(NoReply) as error:
                await fetch_all(timeout=timeout)
            assert anyio.current_time() - began == pytest.approx(timeout or PASSIVE_TIMEOUT, abs=0.1)
            assert error.value.attempts == 0
        assert residue(component) == []


async def test_a_cached_table_is_confirmed_by_a_hash_that_others_ask_for(tmp_path: Path) -> None:
    vehicle = small_px4()
    path = tmp_path / "cache"
    channel = Channel(vehicle)
    version = messages.CommandLong(1, 1, messages.MAV_CMD_REQUEST_MESSAGE, 148.0)
    async with connected(channel, cache=path, listen_only=True) as (_, component):
        channel.ask(version, LIST)
        assert (await component.fetch_all()).source == "stream"
    kept = table_in(path, system=1)
    assert (kept.hash, kept.complete, kept.volatile_known) == (vehicle.announced_hash(), True, True)
    async with connected(channel, cache=path, listen_only=True) as (_, component):
        channel.ask(version)
        await anyio.sleep(2.0)
        assert (component.state, len(component.params)) == ("cached", 25)
        channel.ask(HASH)
        result = await component.fetch_all()
        assert (result.source, result.hash) == ("cache", vehicle.announced_hash())
        trusts = {param.name: param.trust for param in component.params.values()}
        assert trusts["PARAM_01"] is Trust.VERIFIED
        assert trusts["PARAM_03"] is Trust.CACHED  # which no hash covers, and must not be requested
        # it changes without a message, and the next hash shows it
        channel.is_mute = True
        channel.endpoint.set_param("PARAM_01", 77)  # type: ignore[attr-defined]  # of a simulated vehicle
        await anyio.sleep(2.0)
        channel.is_mute = False
        channel.ask(HASH)
        await anyio.sleep(2.0)
        assert component.sync_state is SyncState.UNSYNCED
        assert component.params["PARAM_01"].trust is Trust.CACHED
        channel.ask(LIST)
        result = await component.fetch_all()
        assert (result.source, result.hash) == ("stream", vehicle.announced_hash())
        assert component.params["PARAM_01"].value == 77
    assert channel.received == []


def test_the_command_listens_too(capsys: pytest.CaptureFixture[str]) -> None:
    patience = ("--timeout", "0.3", "--no-cache", "--listen-only")
    assert run(["fetch", "sim:px4", *patience]) == 3
    assert "which no other station has requested" in capsys.readouterr().err
    for command in ("get", "reset"):
        assert run([command, "sim:px4", "MC_ROLL_P", *patience]) == 2
        assert "the client only listens" in capsys.readouterr().err
    assert run(["link", "sim:px4", "--listen-only", "--json", "--seconds", "0.3"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] > 0
    assert report["bytes_sent"] == 0
