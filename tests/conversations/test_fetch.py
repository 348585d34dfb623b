"""Fetches: complete and right on bad links, from the cache where the hash confirms it, and ended by loss."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import anyio
import pytest

from paramclient.errors import NoReply, ParamErrorCode
from paramclient.model.values import ParamType, Trust
from paramclient.protocol.fetch import FetchResult, Policy, Progress, fetch_all
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, Vehicle, px4_table
from paramclient.wire.messages import HASH_CHECK, FileTransfer, Message, ParamError, ParamRequestRead
from tests.conversations.virtual import Silence, Tap, converse, run

BACKENDS = pytest.mark.parametrize("backend", ["trio", "asyncio"])


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
    wrong = [name for name, param in listed.items() if not result.params[name].same_value(param)]
    assert not wrong


@BACKENDS
@pytest.mark.parametrize("loss", [0.0, 0.05, 0.2, 0.4])
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list", "generic"])
def test_every_value_arrives_on_a_lossy_link(kind: str, loss: float, backend: str) -> None:
    async def main() -> None:
        for seed in range(2):
            vehicle = new_vehicle(kind)
            async with converse(Air.symmetric([vehicle], loss=loss, delay=0.05, seed=seed)) as conversation:
                node = await conversation.node()
                result = await fetch_all(node.plain)
                await node.identification.settled()
                check_right(vehicle, replace(result, params=node.plain.table.params))
                assert result.source == ("ftp" if kind == "ardupilot" else "stream")
                assert result.elapsed < (60 if loss == 0.4 else 15)

    run(main, backend=backend)


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
def test_every_value_arrives_over_a_satellite(kind: str, loss: float) -> None:
    async def main() -> None:
        for seed in range(4 if loss else 1):
            vehicle = new_vehicle(kind)
            air = Air.symmetric([vehicle], delay=1.2, jitter=0.05, loss=loss, seed=seed)
            async with converse(air) as conversation:
                node = await conversation.node()
                result = await fetch_all(node.plain)
                assert not result.missing
                assert result.elapsed < 60
                assert (node.channel.timing.round_trip or 0.0) >= 2.4

    run(main)


@BACKENDS
def test_the_hash_confirms_a_table_without_a_download(backend: str) -> None:
    async def main() -> None:
        vehicle = PX4Vehicle()
        async with converse(Air.symmetric([vehicle], delay=0.05)) as conversation:
            node = await conversation.node()
            first = await fetch_all(node.plain)
            assert first.hash == node.plain.table.hash is not None
            node.plain.table.doubt()
            sent, lists = len(conversation.sent), vehicle.requests["PARAM_REQUEST_LIST"]
            second = await fetch_all(node.plain)
            assert (second.source, second.hash) == ("cache", first.hash)
            assert vehicle.requests["PARAM_REQUEST_LIST"] == lists
            assert len(conversation.sent) - sent < 80  # the hash, and the values outside it
            trusts = Counter(param.trust for param in second.params.values())
            assert trusts[Trust.VERIFIED] == len(second.params) - trusts[Trust.LIVE]
            assert trusts[Trust.LIVE] == len(node.plain.table.volatile)

    run(main, backend=backend)


def test_a_value_changed_meanwhile_is_downloaded() -> None:
    async def main() -> None:
        vehicle = PX4Vehicle()
        async with converse(vehicle) as conversation:
            node = await conversation.node()
            await fetch_all(node.plain)
            vehicle.load({"MC_ROLL_P": 3.0})
            result = await fetch_all(node.plain)
            assert result.source == "stream"
            assert result.params["MC_ROLL_P"].value == 3.0

    run(main)


@BACKENDS
def test_fetches_at_once_share_one_and_a_cancelled_caller_ends_only_its_own(backend: str) -> None:
    async def main() -> None:
        vehicle = PX4Vehicle()
        async with converse(Air.symmetric([vehicle], delay=0.05)) as conversation:
            node = await conversation.node()
            results: list[FetchResult] = []

            async def fetch(after: float, limit: float) -> None:
                await anyio.sleep(after)
                with anyio.move_on_after(limit):
                    results.append(await fetch_all(node.plain))

            async with anyio.create_task_group() as tasks:
                for after, limit in ((0.0, 0.3), (0.1, 60.0), (0.2, 60.0)):
                    tasks.start_soon(fetch, after, limit)
            assert len(results) == 2
            assert results[0] is results[1]
            assert vehicle.requests["PARAM_REQUEST_LIST"] == 1

    run(main, backend=backend)


@BACKENDS
def test_a_refresh_downloads_also_where_the_hash_is_being_asked(backend: str) -> None:
    async def main() -> None:
        vehicle = PX4Vehicle()
        async with converse(Air.symmetric([vehicle], delay=0.05)) as conversation:
            node = await conversation.node()
            await fetch_all(node.plain)
            sources: dict[bool, str] = {}

            async def fetch(refresh: bool) -> None:
                sources[refresh] = (await fetch_all(node.plain, refresh=refresh)).source

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(fetch, False)
                await anyio.sleep(0.02)
                tasks.start_soon(fetch, True)
            assert sources == {False: "cache", True: "stream"}
            assert vehicle.requests["PARAM_REQUEST_LIST"] == 2

    run(main, backend=backend)


@BACKENDS
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
def test_a_lost_vehicle_ends_a_fetch_within_7_s_with_what_came(kind: str, backend: str) -> None:
    async def main() -> None:
        vehicle = new_vehicle(kind)
        endpoint = Silence(Air.symmetric([vehicle], delay=0.05), at=1e9)
        async with converse(endpoint) as conversation:
            node = await conversation.node()
            await node.identification.settled()
            if kind == "list":
                node.plain.serves_file = False
            endpoint.at = anyio.current_time() + 0.45
            result = await fetch_all(node.plain)
            assert anyio.current_time() - endpoint.at < 7.0
            assert 50 < result.received < result.count
            assert len(result.params) == result.received
            assert "The component was lost." in result.notes

    run(main, backend=backend)


@BACKENDS
def test_a_vehicle_that_is_lost_after_its_hash_is_told_as_lost(backend: str) -> None:
    async def main() -> None:
        endpoint = Silence(Air.symmetric([PX4Vehicle()], delay=0.3), at=1e9)
        async with converse(endpoint) as conversation:
            session = (await conversation.node()).plain
            await fetch_all(session)
            session.table.doubt()  # as at the next start
            endpoint.at = anyio.current_time() + 0.65
            result = await fetch_all(session)
            assert anyio.current_time() - endpoint.at < 7.0
            assert "The component was lost." in result.notes
            assert session.table.volatile
            (left,) = [note for note in result.notes if "outside the vehicle's hash" in note]
            assert f"and {len(session.table.volatile) - 5} more" in left

    run(main, backend=backend)


@BACKENDS
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
def test_a_vehicle_that_takes_the_address_during_a_fetch_is_fetched_whole(kind: str, backend: str) -> None:
    async def main() -> None:
        first, other = two_vehicles(kind)
        place = Tap(Air.symmetric([first], delay=0.05))
        async with converse(place) as conversation:
            node = await conversation.node()
            results: list[FetchResult] = []

            async def fetch() -> None:
                results.append(await fetch_all(node.plain))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(fetch)
                await anyio.sleep(0.3)
                conversation.station.interrupt()
                place.endpoint = Air.symmetric([other], delay=0.05)
                conversation.station.resume(anyio.current_time())
            check_right(other, results[0])
            assert results[0].notes[-1].startswith("Another vehicle has taken the address")

    run(main, backend=backend)


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "list"])
@pytest.mark.parametrize("later", [0.0, 0.02, 0.1])
def test_a_vehicle_that_takes_the_address_of_a_fetched_one_is_fetched_whole(kind: str, later: float) -> None:
    async def main() -> None:
        first, other = two_vehicles(kind)
        place = Tap(Air.symmetric([first], delay=0.05))
        async with converse(place) as conversation:
            node = await conversation.node()
            await fetch_all(node.plain)
            await anyio.sleep(5.0)
            conversation.station.interrupt()
            place.endpoint = Air.symmetric([other], delay=0.05)
            conversation.station.resume(anyio.current_time())
            await anyio.sleep(later)
            check_right(other, await fetch_all(node.plain))

    run(main)


def test_a_vehicle_that_never_answers_is_no_reply() -> None:
    async def main() -> None:
        endpoint = Silence(PX4Vehicle(), at=1e9)
        async with converse(endpoint) as conversation:
            node = await conversation.node()
            endpoint.at = anyio.current_time()
            with pytest.raises(NoReply):
                await fetch_all(node.plain)
            assert anyio.current_time() - endpoint.at < 7.0

    run(main)


def test_dead_indices_are_missing() -> None:
    async def main() -> None:
        async with converse(PX4Vehicle(dead=[3, 77])) as conversation:
            result = await fetch_all((await conversation.node()).plain)
            assert result.missing == (3, 77)
            assert not result.complete

    run(main)


def test_a_list_that_stops_is_completed() -> None:
    async def main() -> None:
        for vehicle, count in ((PX4Vehicle(), 500), (ArduPilotVehicle(ftp=False), 700)):
            vehicle.when_listed(count, vehicle.stop_list)
            async with converse(vehicle) as conversation:
                node = await conversation.node()
                node.plain.serves_file = False
                check_right(vehicle, await fetch_all(node.plain))

    run(main)


def is_no_file(message: Message) -> bool:
    """Return whether a link that drops MAVFTP passes a message."""
    return not isinstance(message, FileTransfer)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.15, 0.25, 0.5, 1.25])
def test_silent_mavftp_costs_at_most_one_and_a_half_seconds(delay: float) -> None:
    async def elapsed(*, asks: bool) -> float:
        tap = Tap(ArduPilotVehicle(), up=is_no_file)
        async with converse(Air.symmetric([tap], delay=delay)) as conversation:
            node = await conversation.node()
            await node.identification.settled()
            await anyio.sleep(4 * delay)
            node.plain.serves_file = None if asks else False
            return (await fetch_all(node.plain)).elapsed

    assert run(lambda: elapsed(asks=True)) - run(lambda: elapsed(asks=False)) < 1.5


def test_silent_mavftp_is_learnt_on_a_lossy_link() -> None:
    async def main() -> None:
        tap = Tap(ArduPilotVehicle(), up=is_no_file)
        async with converse(Air.symmetric([tap], loss=0.2, delay=0.05, seed=2)) as conversation:
            node = await conversation.node()
            for _ in range(3):
                assert (await fetch_all(node.plain, refresh=True)).complete
            requests = len(conversation.sent_of(FileTransfer))
            assert (await fetch_all(node.plain)).source == "stream"
            assert len(conversation.sent_of(FileTransfer)) == requests > 0

    run(main)


@pytest.mark.parametrize("code", ParamErrorCode)
def test_a_hash_that_is_refused_for_any_reason_is_no_hash(code: ParamErrorCode) -> None:
    async def main() -> None:
        def up(message: Message) -> bool:
            is_hash = isinstance(message, ParamRequestRead) and message.param_id == HASH_CHECK
            if is_hash:
                conversation.hear(ParamError(255, 190, HASH_CHECK, -1, code))
            return not is_hash

        vehicle = PX4Vehicle(hash_check=False)
        async with converse(Tap(vehicle, up=up)) as conversation:
            node = await conversation.node()
            for _ in range(2):
                check_right(vehicle, await fetch_all(node.plain))

    run(main)


def test_a_value_outside_the_hash_that_is_not_received_is_missing() -> None:
    async def main() -> None:
        vehicle = PX4Vehicle()
        secret = vehicle.param(next(row.name for row in px4_table() if row.volatile))

        def up(message: Message) -> bool:
            return not (isinstance(message, ParamRequestRead) and message.param_id == secret.name)

        async with converse(Tap(vehicle, up=up)) as conversation:
            node = await conversation.node()
            await fetch_all(node.plain)
            node.plain.table.doubt()
            vehicle.load({secret.name: 9.5})
            result = await fetch_all(node.plain)
            assert (result.source, result.complete) == ("cache", False)
            assert (result.missing, result.cached) == ((secret.index,), (secret.name,))
            assert result.params[secret.name].trust is Trust.CACHED
            assert any(secret.name in note for note in result.notes)

    run(main)


def test_policies_limit_what_is_sent() -> None:
    async def main() -> None:
        vehicle = PX4Vehicle()
        async with converse(vehicle) as conversation:
            node = await conversation.node()
            await fetch_all(node.plain)
            vehicle.load({"MC_ROLL_P": 3.0})
            before = Counter(vehicle.requests)
            cached = await fetch_all(node.plain, policy=Policy.CACHE_ONLY)
            assert Counter(vehicle.requests) - before == Counter()
            assert cached.params["MC_ROLL_P"].value != 3.0
            asked = await fetch_all(node.plain, policy=Policy.HASH_ONLY)
            assert (asked.source, vehicle.requests["PARAM_REQUEST_LIST"]) == ("cache", 1)

    run(main)


def test_progress_rises_to_the_count() -> None:
    async def main() -> None:
        async with converse(PX4Vehicle()) as conversation:
            seen: list[Progress] = []
            result = await fetch_all((await conversation.node()).plain, progress=seen.append)
            received = [each.received for each in seen]
            assert received == sorted(received)
            assert (seen[-1].received, seen[-1].total) == (result.count, result.count)

    run(main)


def test_a_group_that_appears_changes_the_count_and_all_is_fetched() -> None:
    async def main() -> None:
        vehicle = ArduPilotVehicle()
        async with converse(vehicle) as conversation:
            node = await conversation.node()
            first = await fetch_all(node.plain)
            vehicle.set_param("EK2_ENABLE", 1)
            second = await fetch_all(node.plain)
            assert second.count > first.count
            check_right(vehicle, second)
            vehicle.set_param("EK2_ENABLE", 0)
            third = await fetch_all(node.plain)
            assert third.count == first.count
            assert set(third.params) == set(first.params)

    run(main)
