"""Watches: a table that was fetched once stays that of the vehicle, for few messages."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import pytest

from paramclient.protocol.fetch import Policy, fetch_all
from paramclient.protocol.node import Node
from paramclient.protocol.session import Session
from paramclient.protocol.watch import SyncState, Watch
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from paramclient.wire.messages import ParamRequestList, ParamRequestRead, ParamSet, encode
from tests.conversations.virtual import Conversation, Tap, converse, virtual_on_both

REQUESTS = (ParamRequestList, ParamRequestRead, ParamSet)


class Watched:
    """A component with a watch, as a client sets it up."""

    def __init__(self, conversation: Conversation, node: Node, watch: Watch) -> None:
        self.conversation = conversation
        self.node = node
        self.watch = watch
        self.resynced: list[tuple[str, ...]] = []

    @property
    def session(self) -> Session:
        """The plain parameters."""
        return self.node.plain

    async def fetch(self) -> None:
        """Fetch all parameters, and begin to watch them."""
        await fetch_all(self.session)
        self.watch.fetched()

    @property
    def requests(self) -> int:
        """The requests sent so far."""
        return sum(len(self.conversation.sent_of(kind)) for kind in REQUESTS)


@asynccontextmanager
async def watched(
    endpoint: object, interval: float | None = None, policy: Policy = Policy.AUTO
) -> AsyncIterator[Watched]:
    """Fetch and watch the component 1/1."""
    async with converse(endpoint) as conversation:  # type: ignore[arg-type]  # any endpoint
        node = await conversation.node()
        await node.identification.settled()
        resynced: list[tuple[str, ...]] = []
        watch = Watch(node.plain, node.presence, resynced.append, interval=interval, policy=policy)
        node.plain.table.recounted = watch.doubt
        found = Watched(conversation, node, watch)
        found.resynced = resynced
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch.run)
            await found.fetch()
            yield found
            tasks.cancel_scope.cancel()


async def test_an_armed_vehicle_is_asked_only_after_a_sign_of_change() -> None:
    vehicle = PX4Vehicle()
    async with watched(vehicle, interval=5.0) as found:
        vehicle.armed = True
        await anyio.sleep(6.5)
        before = found.requests
        await anyio.sleep(30.0)
        assert found.requests == before
        vehicle.set_param("CAL_MAG2_ID", 197388)  # brings more into use
        await anyio.sleep(0.1)
        vehicle.set_param("MC_ROLL_P", 3.0)  # its value has the new count
        await anyio.sleep(5.0)
        assert found.requests > before
        assert "CAL_MAG2_ROT" in found.session.table.params


@virtual_on_both
@pytest.mark.parametrize("ftp", [True, False])
async def test_a_group_that_is_shown_or_hidden_is_found_by_the_count(ftp: bool) -> None:
    vehicle = ArduPilotVehicle(ftp=ftp, live_period=0.0)
    async with watched(Air.symmetric([vehicle], delay=0.02), interval=0.0) as found:
        count = found.session.table.count or 0
        for value, change in ((1, 52), (0, 0)):
            vehicle.set_param("EK2_ENABLE", value)
            await anyio.sleep(6.0)
            assert found.session.table.count == count + change
            assert set(found.session.table.params) == set(vehicle.params)
            assert found.watch.state is SyncState.SYNCED
        kinds = [each.kind for each in found.conversation.changes if each.name == "EK2_GPS_TYPE"]
        assert kinds == ["added", "removed"]
        assert len(found.resynced) == 2


async def test_a_vehicle_that_confirms_no_table_is_watched_by_downloads_if_the_user_wants_it() -> None:
    vehicle = GenericVehicle({f"P{number}": float(number) for number in range(30)})
    async with watched(vehicle, interval=30.0) as found:
        vehicle.set_param("P7", 70.5)
        await anyio.sleep(35.0)
        assert found.session.table.params["P7"].value == 70.5
        assert found.resynced == [("P7",)]


async def test_a_check_that_fails_is_repeated_and_none_runs_beside_a_hold() -> None:
    vehicle = PX4Vehicle()
    deaf = [False]
    endpoint = Tap(vehicle, up=lambda message: not deaf[0])
    async with watched(endpoint, interval=10.0) as found:
        deaf[0] = True
        vehicle.load({"MC_ROLL_P": 3.25})
        await anyio.sleep(40.0)
        assert found.session.table.params["MC_ROLL_P"].value == 4.0
        deaf[0] = False
        with found.watch.held():
            before = found.requests
            await anyio.sleep(30.0)
            assert found.requests - before <= 3  # a check in progress goes on
        await anyio.sleep(16.0)
        assert found.session.table.params["MC_ROLL_P"].value == 3.25


async def test_values_outside_px4s_hash_are_read_every_two_minutes() -> None:
    """The vehicle's announcement of the new value was lost."""
    vehicle = PX4Vehicle()
    async with watched(vehicle) as found:
        assert found.session.table.volatile
        vehicle.load({"CAL_MAG0_XOFF": 0.25})
        before = found.requests
        await anyio.sleep(90.0)
        assert found.requests - before <= 10
        await anyio.sleep(70.0)
        assert found.session.table.params["CAL_MAG0_XOFF"].value == 0.25
        assert found.resynced == [("CAL_MAG0_XOFF",)]


async def test_a_table_that_is_known_to_differ_is_not_called_synced_while_it_is_fetched() -> None:
    vehicle = PX4Vehicle()
    async with watched(Air.symmetric([vehicle], delay=0.1), interval=10.0) as found:
        vehicle.load({"MC_ROLL_P": 3.25})
        while found.session.table.params["MC_ROLL_P"].value != 3.25:
            is_fetching = found.session.fetching.is_running
            assert found.watch.state is (SyncState.CHECKING if is_fetching else SyncState.SYNCED)
            await anyio.sleep(0.05)


async def test_a_list_for_another_station_is_taken_and_restarts_nothing() -> None:
    vehicle = PX4Vehicle()
    async with watched(vehicle, interval=0.0) as found:
        vehicle.load({"MC_ROLL_P": 3.25})
        before = found.requests
        request = encode(ParamRequestList(1, 1), system=254, component=190, sequence=0)
        vehicle.receive(request, anyio.current_time())
        await anyio.sleep(100.0)
        assert found.requests == before
        assert found.session.table.params["MC_ROLL_P"].value == 3.25
