"""Fetches: complete and right on bad links, from the cache where the hash confirms it, and ended by loss."""

from __future__ import annotations

import struct
from dataclasses import replace

import anyio
import pytest

from paramclient.errors import ParamErrorCode
from paramclient.model.values import ParamType, Trust
from paramclient.protocol.fetch import FetchResult, fetch_all
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, Vehicle, px4_table
from paramclient.wire import messages
from tests.conversations.virtual import converse, meanwhile, run, talking, virtual_on_both
from tests.shell import Tap


def new_vehicle(kind: str, **options: object) -> Vehicle:
    """Return a vehicle: px4, ardupilot (with its parameter file), list (ArduPilot without it) or generic."""
    makers = {
        "px4": PX4Vehicle,
        "ardupilot": ArduPilotVehicle,
        "list": lambda **more: ArduPilotVehicle(ftp=False, **more),
        "generic": lambda **more: GenericVehicle(px4_table()[:300], **more),
    }
    vehicle: Vehicle = makers[kind](**options)  # type: ignore[operator]  # classes with different options
    return vehicle


def two_vehicles(kind: str) -> tuple[Vehicle, Vehicle]:
    """Return two vehicles with other hardware ids and five other values."""
    ids = [{"uid": number} if kind == "px4" else {"uid2": bytes([number]) * 12} for number in (1, 2)]
    first, other = (new_vehicle(kind, **each) for each in ids)
    for name in [each.name for each in other.listed if each.type is ParamType.REAL32][:5]:
        other.set_param(name, 0.0625)
    return first, other


def check_right(vehicle: Vehicle, result: FetchResult) -> None:
    """Check that every value of the vehicle's list is there, and right."""
    assert not result.missing
    listed = {param.name: param for param in vehicle.listed}
    assert set(listed) <= set(result.params)
    assert not [name for name, param in listed.items() if not result.params[name].same_value(param)]


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.2, 0.4])
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list", "generic"])
@virtual_on_both
async def test_every_value_arrives_on_a_lossy_link(kind: str, loss: float) -> None:
    for seed in range(2):
        vehicle = new_vehicle(kind)
        async with talking(Air.symmetric([vehicle], loss=loss, delay=0.05, seed=seed)) as (_, session):
            result = await fetch_all(session)
            await session.identification.settled()
            check_right(vehicle, replace(result, params=session.table.params))
            assert result.source == ("ftp" if kind == "ardupilot" else "stream")
            assert result.elapsed < (60 if loss == 0.4 else 15)


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
async def test_every_value_arrives_over_a_satellite(kind: str, loss: float) -> None:
    for seed in range(4 if loss else 1):
        air = Air.symmetric([new_vehicle(kind)], delay=1.2, jitter=0.05, loss=loss, seed=seed)
        async with talking(air) as (_, session):
            result = await fetch_all(session)
            assert not result.missing
            assert result.elapsed < 60
            assert (session.channel.timing.round_trip or 0.0) >= 2.4


@virtual_on_both
async def test_fetches_at_once_share_one_and_a_cancelled_caller_ends_only_its_own() -> None:
    vehicle = PX4Vehicle()
    async with talking(Air.symmetric([vehicle], delay=0.05)) as (_, session):
        async with meanwhile(fetch_all(session), fetch_all(session)) as results:
            with anyio.move_on_after(0.3):
                await fetch_all(session)
        assert results[0] is results[1]
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1


@virtual_on_both
async def test_a_refresh_downloads_also_where_the_hash_is_being_asked() -> None:
    vehicle = PX4Vehicle()
    async with talking(Air.symmetric([vehicle], delay=0.05)) as (_, session):
        await fetch_all(session)
        async with meanwhile(fetch_all(session)) as results:
            await anyio.sleep(0.02)
            results.append(await fetch_all(session, refresh=True))
        assert {each.source for each in results} == {"cache", "stream"}
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 2


@virtual_on_both
async def test_a_vehicle_that_is_lost_after_its_hash_is_told_as_lost() -> None:
    endpoint = Tap(Air.symmetric([PX4Vehicle()], delay=0.3))
    async with talking(endpoint) as (_, session):
        await fetch_all(session)
        session.table.doubt()  # as at the next start
        endpoint.silent_at = anyio.current_time() + 0.65
        result = await fetch_all(session)
        assert anyio.current_time() - endpoint.silent_at < 7.0
        assert "The component was lost." in result.notes
        assert session.table.volatile
        (left,) = [note for note in result.notes if "outside the vehicle's hash" in note]
        assert f"and {len(session.table.volatile) - 5} more" in left


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
@pytest.mark.parametrize("fetched_after", [None, 0.0, 0.02, 0.1])
@virtual_on_both
async def test_another_vehicle_at_an_address_is_fetched_whole(kind: str, fetched_after: float | None) -> None:
    """During the fetch, or some seconds before it."""
    first, other = two_vehicles(kind)
    place = Tap(Air.symmetric([first], delay=0.05))
    async with talking(place) as (conversation, session), anyio.create_task_group() as tasks:

        async def exchange(after: float) -> None:
            await anyio.sleep(after)
            conversation.station.interrupt()
            place.endpoint = Air.symmetric([other], delay=0.05)
            conversation.station.resume(anyio.current_time())

        if fetched_after is None:
            tasks.start_soon(exchange, 0.3)
        else:
            await fetch_all(session)
            await exchange(5.0)
            await anyio.sleep(fetched_after)
        result = await fetch_all(session)
        check_right(other, result)
        assert fetched_after is not None or result.notes[-1].startswith("Another vehicle has taken the")
        assert result.changed == ()


@pytest.mark.parametrize(("known_at", "source"), [(1.0, "ftp"), (2.5, "stream")])
async def test_a_first_fetch_waits_for_the_identity_but_not_for_long(known_at: float, source: str) -> None:
    """A value is received first: only the heartbeat says that there is a file."""
    vehicle = ArduPilotVehicle()

    def down(message: messages.Message) -> bool:
        return anyio.current_time() >= known_at or not isinstance(
            message, messages.Heartbeat | messages.AutopilotVersion
        )

    async with converse(Tap(vehicle, down=down)) as conversation:
        conversation.hear(
            messages.ParamValue("RTL_ALT", struct.pack("<f", 1500), ParamType.INT16, 1382, 65535)
        )
        result = await fetch_all((await conversation.node()).plain)
        check_right(vehicle, result)
        assert result.source == source


async def test_a_list_that_stops_is_completed() -> None:
    for vehicle, count in ((PX4Vehicle(), 500), (ArduPilotVehicle(ftp=False), 700)):
        vehicle.when_listed(count, vehicle.stop_list)
        async with talking(vehicle) as (_, session):
            session.serves_file = False
            check_right(vehicle, await fetch_all(session))


async def test_a_restart_after_a_change_of_the_count_leaves_nothing_missing() -> None:
    vehicle = PX4Vehicle()
    vehicle.when_listed(850, lambda: vehicle.use("WV_EN"))
    vehicle.when_listed(900, vehicle.reboot)
    async with talking(Air.symmetric([vehicle], delay=0.01)) as (_, session):
        check_right(vehicle, await fetch_all(session))


def is_no_file(message: messages.Message) -> bool:
    """Return whether a link that drops MAVFTP passes a message."""
    return not isinstance(message, messages.FileTransfer)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.15, 0.25, 0.5, 1.25])
def test_silent_mavftp_costs_at_most_one_and_a_half_seconds(delay: float) -> None:
    async def elapsed(*, asks: bool) -> float:
        tap = Tap(ArduPilotVehicle(), up=is_no_file)
        async with talking(Air.symmetric([tap], delay=delay)) as (_, session):
            await session.identification.settled()
            await anyio.sleep(4 * delay)
            session.serves_file = None if asks else False
            return (await fetch_all(session)).elapsed

    assert run(lambda: elapsed(asks=True)) - run(lambda: elapsed(asks=False)) < 1.5


async def test_silent_mavftp_is_learnt_on_a_lossy_link() -> None:
    tap = Tap(ArduPilotVehicle(), up=is_no_file)
    async with talking(Air.symmetric([tap], loss=0.2, delay=0.05, seed=2)) as (conversation, session):
        for _ in range(3):
            assert (await fetch_all(session, refresh=True)).complete
        requests = len(conversation.sent_of(messages.FileTransfer))
        assert (await fetch_all(session)).source == "stream"
        assert len(conversation.sent_of(messages.FileTransfer)) == requests > 0


async def test_a_vehicle_that_says_that_it_has_no_mavftp_is_listed_then() -> None:
    async with talking(Air.symmetric([ArduPilotVehicle(ftp=False)], delay=0.05)) as (conversation, session):
        assert (await fetch_all(session)).source == "stream"  # begins before its version is known
        assert len(conversation.sent_of(messages.FileTransfer)) == 1


@pytest.mark.parametrize("code", ParamErrorCode)
async def test_a_hash_that_is_refused_for_any_reason_is_no_hash(code: ParamErrorCode) -> None:
    def up(message: messages.Message) -> bool:
        is_hash = isinstance(message, messages.ParamRequestRead) and message.param_id == messages.HASH_CHECK
        if is_hash:
            conversation.hear(messages.ParamError(255, 190, messages.HASH_CHECK, -1, code))
        return not is_hash

    vehicle = PX4Vehicle(hash_check=False)
    async with talking(Tap(vehicle, up=up)) as (conversation, session):
        for _ in range(2):
            check_right(vehicle, await fetch_all(session))


async def test_a_value_outside_the_hash_is_read_in_each_fetch() -> None:
    vehicle = PX4Vehicle()
    name = next(row.name for row in px4_table() if row.volatile)
    async with talking(vehicle) as (_, session):
        await fetch_all(session)
        vehicle.load({name: 9.5})
        assert (await fetch_all(session)).params[name].value == 9.5


async def test_a_value_outside_the_hash_that_is_not_received_is_missing() -> None:
    vehicle = PX4Vehicle()
    secret = vehicle.param(next(row.name for row in px4_table() if row.volatile))

    def up(message: messages.Message) -> bool:
        return not (isinstance(message, messages.ParamRequestRead) and message.param_id == secret.name)

    async with talking(Tap(vehicle, up=up)) as (_, session):
        await fetch_all(session)
        session.table.doubt()
        vehicle.load({secret.name: 9.5})
        result = await fetch_all(session)
        assert (result.source, result.complete) == ("cache", False)
        assert (result.missing, result.cached) == ((secret.index,), (secret.name,))
        assert result.params[secret.name].trust is Trust.CACHED
        assert any(secret.name in note for note in result.notes)
