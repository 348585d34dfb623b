"""Staying in step, losing and finding vehicles, policies and events, as users of the client see them."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from pathlib import Path

import anyio
import pytest

from paramclient import (
    Component,
    ComponentState,
    Event,
    Events,
    ParamCache,
    ParamClient,
    Policy,
    SetOutcome,
    SetStatus,
    SyncState,
    Trust,
    errors,
)
from paramclient.model.values import Value
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.wire import messages
from tests import shell
from tests.client.conftest import connected, fetched, table_in
from tests.conversations.test_fetch import new_vehicle
from tests.conversations.test_writes import free_names

VOLATILE = {"CAL_ACC0_XOFF", "PARAM_03"}
TIME_MAX = 7.0
MISSES = (messages.ParamRequestRead, messages.ParamRequestList, messages.ParamSet)


async def drained(events: Events) -> list[Event]:
    """Take the events that wait for a listener."""
    taken: list[Event] = []
    while True:
        with anyio.move_on_after(0.001) as waiting:
            taken.append(await anext(events))
        if waiting.cancelled_caught:
            return taken


def resynced(component: Component, changed: tuple[str, ...], vehicle: PX4Vehicle) -> Event:
    return Event(component, "resynced", changed=changed, hash=vehicle.announced_hash())


def requested(tap: shell.Tap) -> int:
    """All requests to the vehicle that concern parameters."""
    return sum(len(tap.messages(kind)) for kind in MISSES)


def hashes(tap: shell.Tap) -> int:
    return sum(each.param_id == messages.HASH_CHECK for each in tap.messages(messages.ParamRequestRead))


async def away(tap: shell.Tap, seconds: float) -> None:
    tap.is_mute = tap.is_deaf = True
    await asyncio.sleep(seconds)
    tap.is_mute = tap.is_deaf = False


# the watch


async def test_an_update_that_was_lost_is_reported_within_one_interval() -> None:
    tap = shell.Tap(vehicle := shell.small_px4())
    async with fetched(tap, watch_interval=10.0) as (client, component):
        await asyncio.sleep(1.0)
        events, changes = client.events(), component.changes()
        vehicle.load({"PARAM_01": 1001, "PARAM_02": 1002})  # without a message
        began = anyio.current_time()
        assert component.params["PARAM_01"].value == 1
        with anyio.fail_after(11.0):
            change = await anext(changes)
            assert change.name == "PARAM_01"
            assert [param and param.value for param in (change.old, change.new)] == [1, 1001]
            assert (await anext(changes)).name == "PARAM_02"
            event = await anext(events)
        assert event == resynced(component, ("PARAM_01", "PARAM_02"), vehicle)
        assert anyio.current_time() - began <= 10.5
        assert (component.sync_state, component.state) == (SyncState.SYNCED, ComponentState.SYNCED)
        assert shell.bits(component.params) == shell.bits(vehicle.params)
        assert not shell.residue(component)


async def test_by_default_a_hash_is_watched_and_a_list_is_not() -> None:
    px4, ardupilot = shell.Tap(shell.small_px4()), shell.Tap(ArduPilotVehicle(table=shell.VALUES, system=2))
    async with shell.a_client(Air([px4, ardupilot])) as client:
        await client.component(2)
        await client.fetch_all()
        await asyncio.sleep(1.0)
        px4.received.clear()
        await asyncio.sleep(100.0)
        assert hashes(px4) == len(px4.messages(messages.ParamRequestRead)) == 3
        assert not px4.messages(messages.ParamRequestList), "nor one for the other vehicle"


@pytest.mark.parametrize("ftp", [True, False])
async def test_parameters_that_appear_and_go_do_so_in_the_cache_too(path: Path, ftp: bool) -> None:
    group = {f"GRIP_{number}": number for number in range(5)}
    table = {**shell.VALUES, "GRIP_ENABLE": 0}
    vehicle = ArduPilotVehicle(table=table, groups={"GRIP_ENABLE": group}, ftp=ftp, live=())
    async with fetched(vehicle, cache=path) as (_, component):
        changes = component.changes()
        for is_enabled in (1, 0):
            await component.set("GRIP_ENABLE", is_enabled)
            if is_enabled:
                assert (await component.set("GRIP_2", 20)).status == "accepted"
            await asyncio.sleep(3.0)
            assert component.sync_state is SyncState.SYNCED
            assert shell.bits(component.params) == shell.bits(vehicle.params)
            reported = [await anext(changes) for _ in range(6)]
            assert ("changed", "GRIP_ENABLE") in {(each.kind, each.name) for each in reported}
            kind = "added" if is_enabled else "removed"
            assert {each.name for each in reported if each.kind == kind} == group.keys()
    kept = table_in(path)
    assert (kept.count, kept.complete) == (len(table), True)
    cached, actual = ({p.name: p.index for p in each.params.values()} for each in (kept, vehicle))
    assert cached == actual


async def test_an_armed_vehicle_is_asked_only_after_a_sign_of_change() -> None:
    tap = shell.Tap(vehicle := PX4Vehicle())
    async with fetched(tap, watch_interval=5.0) as (_, component):
        vehicle.armed = True
        await anyio.sleep(6.5)
        before = requested(tap)
        await anyio.sleep(30.0)
        assert requested(tap) == before
        vehicle.set_param("CAL_MAG2_ID", 197388)  # brings more into use
        await anyio.sleep(0.1)
        vehicle.set_param("MC_ROLL_P", 3.0)  # its value has the new count
        await anyio.sleep(5.0)
        assert requested(tap) > before
        assert "CAL_MAG2_ROT" in component.params


@pytest.mark.parametrize(
    ("make", "name", "seconds", "interval"),
    [(shell.generic, "PARAM_03", 35.0, 30.0), (PX4Vehicle, "CAL_MAG0_XOFF", 160.0, None)],
    ids=["by downloads, if the user wants it", "outside a hash, every two minutes"],
)
async def test_what_no_hash_confirms_is_watched(
    make: Callable[[], Vehicle], name: str, seconds: float, interval: float | None
) -> None:
    """The vehicle's announcement of the new value was lost."""
    tap = shell.Tap(vehicle := make())
    async with fetched(tap, watch_interval=interval) as (client, component):
        events = client.events()
        tap.is_mute = True
        vehicle.set_param(name, 0.0625)
        await anyio.sleep(0.5)
        tap.is_mute = False
        before = requested(tap)
        await anyio.sleep(seconds)
        assert interval or requested(tap) - before <= 80
        assert component.params[name].value == 0.0625
        assert [event.changed for event in await drained(events)] == [(name,)]


async def test_a_table_that_is_known_to_differ_is_not_called_synced_while_it_is_fetched() -> None:
    vehicle = PX4Vehicle()
    async with fetched(Air.symmetric([vehicle], delay=0.1), watch_interval=10.0) as (_, component):
        vehicle.load({"MC_ROLL_P": 3.25})
        while component.params["MC_ROLL_P"].value != 3.25:
            is_fetching = component.session.fetching.is_running
            assert component.sync_state is (SyncState.CHECKING if is_fetching else SyncState.SYNCED)
            await anyio.sleep(0.05)


async def test_a_list_for_another_station_is_taken_and_restarts_nothing() -> None:
    tap = shell.Tap(vehicle := shell.small_px4())
    async with fetched(tap, watch_interval=0) as (_, component):
        vehicle.load({"PARAM_01": 1001})
        before = requested(tap)
        request = messages.encode(messages.ParamRequestList(1, 1), system=254, component=190, sequence=0)
        vehicle.receive(request, anyio.current_time())
        await anyio.sleep(100.0)
        assert requested(tap) == before
        assert component.params["PARAM_01"].value == 1001


def test_intervals_and_policies_that_cannot_be() -> None:
    for options in ({"watch_interval": -1}, {"watch_interval": math.nan}, {"policy": "never"}):
        with pytest.raises(errors.UsageError, match=r"watch_interval|auto, hash-only, cache-only"):
            ParamClient("sim:px4", **options)


# lost and found


async def test_lost_and_found() -> None:
    tap = shell.Tap(vehicle := shell.small_px4())
    async with fetched(tap, watch_interval=5.0) as (client, component):
        events = client.events()
        tap.is_mute = tap.is_deaf = True
        with anyio.fail_after(7.0):
            lost = await anext(events)
        assert (lost.kind, lost.component) == ("lost", component)
        assert [lost.silence, component.silence] == pytest.approx([5.0, 5.0], abs=0.01)
        assert (component.sync_state, component.state) == (SyncState.LOST, "lost")
        assert "lost 25 params" in repr(component)
        assert component.params["PARAM_01"].value == 1
        assert {param.trust for param in component.params.values()} == {Trust.CACHED}
        with anyio.fail_after(3.0), pytest.raises(errors.NoReply):
            await component.get("PARAM_01")
        tap.received.clear()
        await anyio.sleep(60.0)
        assert len(tap.received) == len(tap.messages(messages.Heartbeat)) == 60
        tap.is_mute = tap.is_deaf = False
        with anyio.fail_after(2.0):
            found = await anext(events)
            assert (found.kind, found.component) == ("found", component)
            assert (found.silence or 0.0) > 5.0
            assert await anext(events) == resynced(component, (), vehicle)
        assert component.sync_state is SyncState.SYNCED
        for name, param in component.params.items():
            assert param.trust is (Trust.LIVE if name in VOLATILE else Trust.VERIFIED)


@pytest.mark.parametrize("seconds", [2.0, 8.0])
async def test_a_link_that_was_disconnected_is_checked_like_a_loss(seconds: float) -> None:
    vehicle = shell.small_px4()
    link = shell.FlakyLink(Air.symmetric([vehicle], delay=0.05))
    async with fetched(link) as (client, component):
        events = client.events()
        await link.drop(stays_offline=True)
        vehicle.set_param("PARAM_01", 1001)
        await asyncio.sleep(seconds)
        link.is_offline = False
        await shell.until(lambda: component.state == "cached")
        assert component.sync_state is SyncState.CHECKING
        assert component.params["PARAM_05"].trust is Trust.CACHED
        await asyncio.sleep(5.0)
        *lost, last = await drained(events)
        assert last == resynced(component, ("PARAM_01",), vehicle)
        assert [event.kind for event in lost] == (["lost", "found"] if seconds > 5 else [])
        assert shell.bits(component.params) == shell.bits(vehicle.params)


async def test_a_hash_that_is_lost_several_times_is_no_reason_for_a_download() -> None:
    """The vehicle has confirmed its table by one, and many packets are lost."""
    tap = shell.Tap(PX4Vehicle())
    async with fetched(Air.symmetric([tap], delay=0.02, loss=0.2), watch_interval=5.0) as (_, component):
        tap.received.clear()
        tap.is_deaf = True
        await shell.until(lambda: hashes(tap) == 5, pause=0.01)
        tap.is_deaf = False
        await asyncio.sleep(15.0)
        assert component.sync_state is SyncState.SYNCED
        assert not tap.messages(messages.ParamRequestList)


async def test_a_watch_survives_a_link_that_drops_during_a_check() -> None:
    tap = shell.Tap(vehicle := shell.small_px4())
    link = shell.FlakyLink(tap)
    async with fetched(link, watch_interval=5.0) as (_, component):
        tap.received.clear()
        tap.is_deaf = True
        await shell.until(lambda: hashes(tap), pause=0.01)
        await link.drop(stays_offline=True)
        await asyncio.sleep(15.0)  # requests fail after 10 s
        tap.is_deaf = link.is_offline = False
        await asyncio.sleep(15.0)
        assert component.sync_state is SyncState.SYNCED
        vehicle.load({"PARAM_01": 1001})  # without a message
        await asyncio.sleep(6.0)
        assert component.params["PARAM_01"].value == 1001


# another vehicle in its place, and the cache


def kept(path: Path) -> dict[tuple[str, int], object]:
    """The value of PARAM_01 in the cache, by vehicle and component."""
    with ParamCache(path) as cache:
        tables = [cache.component(each.key, component=each.component) for each in cache.components()]
        return {(each.key, each.component): each.params["PARAM_01"].value for each in tables}


@pytest.mark.parametrize("answers", [True, False], ids=["says who it is late", "never says who it is"])
async def test_a_strangers_values_never_reach_the_other_ones_cache(path: Path, answers: bool) -> None:
    berth, camera = shell.Tap(shell.small_px4(uid=1)), shell.Tap(shell.generic(component=100, uid=1))
    async with connected(Air([berth, camera]), cache=path) as (client, component):
        await client.fetch_all()
        await asyncio.sleep(1.0)
        await asyncio.gather(away(berth, 9.0), away(camera, 9.0))
        stranger = shell.small_px4(uid=2)
        stranger.set_param("PARAM_01", 1001)
        filters = [
            shell.Tap(each, down=lambda message: not isinstance(message, messages.AutopilotVersion))
            for each in (stranger, shell.generic(component=100, uid=2, table={"PARAM_01": 1001}))
        ]
        berth.endpoint, camera.endpoint = filters
        await shell.until(lambda: component.state != "lost")
        with pytest.raises(errors.CacheError, match="which vehicle"):
            await component.set("PARAM_01", 1, durable=True)
        eye = client.components[1, 100]
        assert (await component.get("PARAM_01")).value == 1001
        assert (await eye.get("PARAM_01")).value == 1001
        await asyncio.sleep(1.0)
        assert {*kept(path).values()} == {1}, "it is open whose they are"
        for each in filters if answers else ():
            each.down = lambda message: True
        await asyncio.sleep(10.0)
        if answers:
            assert component.identity.uid == "0000000000000002"
            assert component.params.keys() | eye.params.keys() <= {"PARAM_01"}
            await client.fetch_all()
            await asyncio.sleep(1.0)
    first, second = "uid:0000000000000001", "uid:0000000000000002"
    of_the_second = {(second, 1): 1001, (second, 100): 1001} if answers else {}
    assert kept(path) == {(first, 1): 1, (first, 100): 1} | of_the_second


# policies


async def learn(vehicle: PX4Vehicle, path: Path) -> None:
    async with ParamClient(vehicle, cache=path) as client:
        await (await client.component()).fetch_all()


async def test_cache_only_sends_nothing(path: Path) -> None:
    vehicle = shell.small_px4()
    await learn(vehicle, path)
    tap = shell.Tap(Air([vehicle, shell.generic(component=100)]))
    async with connected(tap, cache=path, policy="cache-only") as (client, component):
        result = await component.fetch_all()
        assert (result.source, result.hash, result.complete) == ("cache", None, True)
        assert "cache-only" in result.notes[0]
        assert shell.bits(result.params) == shell.bits(vehicle.params)
        assert component.sync_state is SyncState.UNSYNCED
        assert component.state == "cached"
        assert {param.trust for param in component.params.values()} == {Trust.CACHED}
        everything = await client.fetch_all()
        assert {at: each.source for at, each in everything.results.items()} == {(1, 1): "cache"}
        assert isinstance(everything.silent[1, 100], errors.CacheError)
        await asyncio.sleep(100.0)
        assert requested(tap) == 0
        assert (await component.get("PARAM_01")).trust is Trust.LIVE, "a name that is requested is read"
    async with connected(tap, policy=Policy.CACHE_ONLY) as (client, component):
        for call in (component.fetch_all, client.fetch_all):
            with pytest.raises(errors.CacheError, match="1/1"):
                await call()
        assert not shell.residue(component)


async def test_hash_only_requests_the_hash_alone(path: Path) -> None:
    vehicle = shell.small_px4()
    await learn(vehicle, path)
    tap = shell.Tap(vehicle)
    async with connected(tap, cache=path, policy="hash-only") as (_, component):
        result = await component.fetch_all()
        assert (result.source, result.hash) == ("cache", vehicle.announced_hash())
        assert component.sync_state is SyncState.SYNCED
        for name, param in component.params.items():
            assert param.trust is (Trust.CACHED if name in VOLATILE else Trust.VERIFIED)
        await asyncio.sleep(100.0)
        assert requested(tap) == hashes(tap) == 1
        vehicle.load({"PARAM_02": 1002})  # without a message
        result = await component.fetch_all()
        assert (result.hash, result.source) == (None, "cache")
        assert "hash-only" in result.notes[0]
        assert str(component.sync_state) == "unsynced"
        assert requested(tap) == hashes(tap) == 2


@pytest.mark.parametrize("policy", [Policy.CACHE_ONLY, Policy.HASH_ONLY])
async def test_refresh_is_refused_with_a_policy_that_forbids_downloads(policy: Policy) -> None:
    tap = shell.Tap(shell.small_px4())
    async with connected(tap, policy=policy) as (client, component):
        for call in (component.fetch_all(refresh=True), client.fetch_all(refresh=True)):
            with pytest.raises(errors.UsageError, match=f"policy is {policy}"):
                await call
        assert requested(tap) == 0


# events


async def test_a_stream_of_events_outlives_a_cancelled_wait_and_has_a_bound_and_an_end() -> None:
    async with connected(shell.small_px4()) as (client, component):
        events, others = client.events(), client.events()
        with anyio.move_on_after(0.01):
            await anext(events)
        waiting = asyncio.ensure_future(shell.outcome(anext(others)))
        await shell.settled()
        for number in range(1010):
            events.push(Event(component, "lost", float(number)))
    assert [(await anext(events)).silence for _ in range(1000)] == [*range(10, 1010)], "the newest"
    assert isinstance(await waiting, errors.ClientClosed)
    for each in (events, client.events()):
        with pytest.raises(errors.ClientClosed):
            await anext(each)


def silent_on(kind: str, delay: float = 0.05) -> tuple[Vehicle, shell.Tap, dict[str, Value]]:
    """A vehicle, its link, on which it can go silent, and new values that no firmware limits."""
    vehicle = new_vehicle(kind)
    endpoint = shell.Tap(Air.symmetric([vehicle], delay=delay))
    return vehicle, endpoint, {name: 0.25 + number for number, name in enumerate(free_names(vehicle))}


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
@pytest.mark.parametrize("known", [False, True], ids=["new", "known"])
async def test_a_vehicle_that_is_lost_ends_a_fetch_with_what_came(kind: str, known: bool, path: Path) -> None:
    vehicle, endpoint, wanted = silent_on(kind)
    synced_at = None
    if known:
        async with fetched(endpoint, cache=path):
            pass
        synced_at = table_in(path, system=1).synced_at
        for name, value in wanted.items():
            vehicle.set_param(name, value)
    async with connected(endpoint, cache=path) as (_, component):
        await anyio.sleep(2.0)
        endpoint.silent_at = anyio.current_time() + 0.45
        result = await component.fetch_all(refresh=known)
        assert anyio.current_time() < endpoint.silent_at + TIME_MAX
        assert (result.complete, result.hash) == (False, None)
        assert "The component was lost." in result.notes
        assert 50 < result.received == len(result.params) - len(result.cached) < result.count
        assert (len(result.params) == result.count) is known
        missing = set(result.missing) if known else set()
        assert {result.params[name].index for name in result.cached} == missing
        live = result.params.keys() - set(result.cached)
        assert all(result.params[name].same_value(vehicle.param(name)) for name in live)
        endpoint.silent_at = math.inf
        await anyio.sleep(2.0)
        assert component.sync_state is SyncState.UNSYNCED
    assert table_in(path, system=1).synced_at == synced_at


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list", "generic"])
@pytest.mark.parametrize("delay", [0.05, 1.25])
async def test_a_vehicle_that_is_lost_ends_set_many(kind: str, delay: float, path: Path) -> None:
    vehicle, endpoint, wanted = silent_on(kind, delay)
    seen: list[SetOutcome] = []

    def fall_silent(outcome: SetOutcome) -> None:
        seen.append(outcome)
        if len(seen) == 20:
            endpoint.silent_at = anyio.current_time()

    async with fetched(endpoint, cache=path) as (_, component):
        result = await component.set_many(wanted, progress=fall_silent)
        assert anyio.current_time() < endpoint.silent_at + TIME_MAX
        assert isinstance(result.error, errors.NoReply)
        assert sorted(each.name for each in seen) == sorted(wanted)
        assert result.counts.keys() == {SetStatus.ACCEPTED, SetStatus.UNKNOWN, SetStatus.NOT_TRIED}
        assert all(each.is_set is (each.error is None) for each in result.outcomes)
        assert delay > 1.0 or 1 <= result.counts[SetStatus.UNKNOWN] <= 20
    params = table_in(path, system=1).params
    for name in (each.name for each in result.outcomes if each.status is SetStatus.ACCEPTED):
        assert wanted[name] == params[name].value == component.params[name].value == vehicle.param(name).value
