"""A vehicle that lies: what it may cost, and what it cannot do."""

from __future__ import annotations

import gc
import tracemalloc
from typing import Any
from unittest import mock

import anyio
import pytest
from paramclient.protocol.ftp.blocks import Blocks
from paramclient.protocol.params import change_origin as authors_room
from paramclient.protocol.params import list_download as download_room
from paramclient.protocol.params import table as table_room
from paramclient.protocol.params import value_check
from paramclient.protocol.params.change_origin import Authors
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.retry import INITIAL_TIMEOUT
from paramclient.protocol.stats import traffic as traffic_room

from paramclient import FileTransferError, NoReply, ParamClient
from paramclient.cli import run as run_command
from paramclient.cli import session as session_room
from paramclient.client import subscription as subscription_room
from paramclient.client.streams import Changes
from paramclient.links import SimLink
from paramclient.protocol import component as component_room
from paramclient.protocol import station as station_room
from paramclient.protocol.events import Change, ComponentForgotten
from paramclient.protocol.ftp import DATA_SIZE_MAX
from paramclient.protocol.ftp import blocks as blocks_room
from paramclient.protocol.ftp import file_read as reading_room
from paramclient.protocol.ftp import transfers as transfers_room
from paramclient.protocol.station import Station
from paramclient.sim import Air
from paramclient.wire.messages import (
    NO_INDEX,
    PARAMETERS_MAX,
    TEXTS_MAX,
    Heartbeat,
    Message,
    ParamRequestRead,
    ParamValue,
    encode,
    text_of,
)
from tests.hostile_vehicle import ESCAPE, LIES, HostileVehicle
from tests.shell import generic, in_simulated_time
from tests.simulation import PEER, Simulation, known, listing_ardupilot, param_value


def say(session: Simulation, message: Message, *, system: int = 1, component: int = 1) -> None:
    """Let a vehicle say something, without a vehicle."""
    data = encode(message, system=system, component=component, sequence=0)
    session.station.receive(data, PEER, session.now)


def beat(session: Simulation, *, system: int = 1, component: int = 1, autopilot: int = 0) -> None:
    say(session, Heartbeat(2, autopilot), system=system, component=component)


# Numbers that cannot be


@pytest.mark.parametrize("count", [PARAMETERS_MAX + 1, NO_INDEX - 1, NO_INDEX])
def test_a_count_above_the_highest_index_is_none(count: int) -> None:
    """PARAM_REQUEST_READ has a signed index: one above 32767 cannot even be written down."""
    session = Simulation()
    beat(session)
    say(session, param_value("A", 1.0, index=PARAMETERS_MAX, count=count))
    table = session.machine.table
    assert (table.count, table.params["A"].index) == (None, None)
    fetch = session.machine.begin_fetch(session.now)
    say(session, param_value("B", 1.0, index=count - 1, count=count))
    read = session.machine.read("NOT_THERE", session.now)
    session.run(60)  # with the question for an index that is known to be there
    assert isinstance(read.error, NoReply)
    assert isinstance(fetch.error, NoReply)
    assert all(request.param_index < 10 for request in session.sent_of(ParamRequestRead))


def test_the_largest_count_is_one() -> None:
    session = Simulation()
    beat(session)
    say(session, param_value("A", 1.0, index=PARAMETERS_MAX - 1, count=PARAMETERS_MAX))
    assert session.machine.table.count == PARAMETERS_MAX
    assert session.machine.table.params["A"].index == PARAMETERS_MAX - 1
    session.machine.read(PARAMETERS_MAX - 1, session.now)
    session.exchange()
    assert PARAMETERS_MAX - 1 in [request.param_index for request in session.sent_of(ParamRequestRead)]


def test_a_cached_count_above_the_highest_index_is_none() -> None:
    session = Simulation()
    beat(session)
    session.machine.use_cached(
        {"A": known("A", 1.0, index=40_000)},
        session.now,
        count=NO_INDEX - 1,
        confirmed=None,
        complete=True,
        volatile=frozenset(),
        volatile_known=False,
    )
    assert (session.machine.table.count, session.machine.table.complete) == (None, False)
    assert session.machine.table.params["A"].index is None


# More than there can be


def receive(table: Table, name: str) -> None:
    table.store_value(ParamValue(name, bytes(4), 9, 10, NO_INDEX), "vehicle")


def test_a_table_holds_so_many_names_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_room, "NAMES_MAX", 3)
    table = Table()
    for name in "ABCD":
        receive(table, name)
    assert [*table.params] == ["A", "B", "C"]
    assert table.store_file_entry("E", 9, 0, 0, None, is_older=False) is None
    assert table.fill({"F": known("F")}) == []
    assert [*table.params] == ["A", "B", "C"]
    assert table.store_file_entry("C", 9, 1, 0, None, is_older=False) is not None
    table.remove(lambda param: param.name == "A")
    receive(table, "D")
    assert [*table.params] == ["B", "C", "D"]


def test_a_link_has_so_many_components_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that are there keep their place; a lost one without a parameter gives it up."""
    monkeypatch.setattr(station_room, "COMPONENTS_MAX", 3)
    session = Simulation()
    for system in (1, 2, 3, 4):
        beat(session, system=system)
    say(session, param_value("A", 1.0), system=2)
    session.events.clear()
    assert [*session.station.components] == [(1, 1), (2, 1), (3, 1)]
    for _ in range(20):  # the first is received, the others are lost, and the second has sent a parameter
        session.run(1)
        beat(session, system=1)
    beat(session, system=4)
    beat(session, system=5)
    session.exchange()
    assert [*session.station.components] == [(1, 1), (2, 1), (4, 1)]
    forgotten = [event for event in session.events if isinstance(event, ComponentForgotten)]
    assert [(event.machine.system, event.machine.component) for event in forgotten] == [(3, 1)]


@pytest.mark.slow
def test_a_flood_of_random_systems_from_random_peers_stays_within_the_page_of_the_bounds() -> None:
    session = Simulation()
    tracemalloc.start()
    for number in range(12_000):
        data = encode(Heartbeat(2, 12), system=1 + number % 250, component=1 + number // 250, sequence=0)
        for peer in range(1 + number % 3):
            session.station.receive(data, ("10.0.0.1", 10_000 * peer + number % 5_000), session.now)
        session.station.events()
        session.station.data_to_send()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(session.station.components) == station_room.COMPONENTS_MAX
    assert held < station_room.COMPONENTS_MAX * 28_000


def test_the_number_of_unread_changes_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscription_room, "QUEUED_CHANGES_MAX", 3)
    changes = Changes()
    for name in "ABCDE":
        changes.push(Change(name, None, known(name)))
    assert [*changes._waiting] == ["C", "D", "E"]


def test_a_directory_has_so_many_entries_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfers_room, "ENTRIES_MAX", 100)
    session = Simulation(HostileVehicle("endless file", system=1))
    job = session.meet().files.list("/endless", session.now)
    assert len(session.outcome(job)) == 100


# Others on the same link


@pytest.fixture(scope="module")
def usual() -> float:
    """Seconds that a vehicle's list takes that is alone on its link."""
    return Simulation(listing_ardupilot()).fetch().elapsed


@pytest.mark.parametrize("lie", LIES)
def test_no_lie_keeps_another_vehicle_from_being_fetched(
    lie: str, usual: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the liar is fetched as well: its list is waited for once, and its values count for it alone."""
    monkeypatch.setattr(station_room, "COMPONENTS_MAX", 50)
    honest, liar = listing_ardupilot(), HostileVehicle(lie)
    station = Station(link="sim:test", is_stream=False, sync_settings=SyncSettings(30.0))
    session = Simulation(honest, liar, station=station)
    session.meet()
    session.until(lambda: (66, 1) in session.station.components)
    liars = session.station.components[66, 1]
    fetch = liars.begin_fetch(session.now)
    session.run(0.2)
    result = session.fetch(limit=60)
    assert result.elapsed < usual + 2 * INITIAL_TIMEOUT
    assert result.complete
    truth = {name: entry.bits for name, entry in honest.params.items()}
    assert {name: param.bits for name, param in result.params.items()} == truth
    assert all(len(machine.table.params) <= 4_000 for machine in session.station.components.values())
    liars.end_fetch(fetch, session.now)


GROWTH_MAX = 300_000
"""Bytes by which the memory may differ between two moments of one session, without anything that stays."""


@pytest.mark.slow
def test_memory_is_bounded_under_all_kinds_of_lies_at_once() -> None:
    """When all that has a bound has reached it, nothing grows any more."""
    names, components = 100, 10
    with (
        mock.patch.object(table_room, "NAMES_MAX", names),
        mock.patch.object(station_room, "COMPONENTS_MAX", components),
        mock.patch.object(authors_room, "RECENT_CHANGES_MAX", 100),
        mock.patch.object(traffic_room, "COUNTED_COMPONENTS_MAX", components),
        mock.patch.object(component_room, "PARAMETERS_MAX", 1_000),
        mock.patch.object(table_room, "PARAMETERS_MAX", 1_000),
        mock.patch.object(download_room, "PARAMETERS_MAX", 1_000),
    ):
        tracemalloc.start()
        text_of.cache_clear()  # what it holds from before is not traced, and its next growth would be
        for number in range(TEXTS_MAX):
            text_of(b"%d" % number)  # what remembers names is full
        liars = [HostileVehicle(*list(LIES)[start::3], system=66 + start, rate=150) for start in range(3)]
        station = Station(
            link="sim:test", is_stream=False, sync_settings=SyncSettings(30.0), counts_traffic=True
        )
        held: list[int] = []
        for now in range(4):
            for liar in liars:
                liar.tick(float(now))
                for data in liar.data_to_send():
                    station.receive(data, PEER, float(now))
            station.tick(float(now))
            for data, _ in station.data_to_send():
                for liar in liars:
                    liar.receive(data, float(now))
            station.events()
            gc.collect()  # what is in a circle and wanted by nobody does not count
            held.append(tracemalloc.get_traced_memory()[0])
            for machine in [*station.components.values()][:3]:
                if machine.fetch is None:
                    machine.begin_fetch(float(now))
        tracemalloc.stop()
        assert len(station.components) == components
        assert max(len(machine.table.params) for machine in station.components.values()) <= names
    assert held[-1] - held[-2] < GROWTH_MAX, held


# The client, the cache, the terminal


@in_simulated_time
async def test_a_component_that_is_forgotten_ends_what_listens_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(station_room, "COMPONENTS_MAX", 2)
    liar = HostileVehicle("obedient")
    async with ParamClient(Air([generic(), liar]), cache=False) as client:
        await client.component(1, 1)
        other = await client.component(66, 1)
        changes = other.changes()
        await anyio.sleep(10)
        other.core.machine.presence.is_lost = True
        liar.say(Heartbeat(2, 12), 77)
        with pytest.raises(NoReply, match=r"66/1 \(lost\)"):
            await anext(changes)
        assert [*client.components] == [*client.core.station.components] == [(1, 1), (77, 1)]
        with pytest.raises(NoReply):
            await other.get("A")


@pytest.mark.parametrize(
    "words",
    [pytest.param(("fetch",), marks=pytest.mark.slow), ("link", "--duration", "1"), ("get",)],
    ids=str,
)
def test_no_escape_code_reaches_the_terminal(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def client(url: str, **options: Any) -> ParamClient:
        return ParamClient(SimLink(HostileVehicle("escape codes"), url), **options)

    monkeypatch.setattr(session_room, "ParamClient", client)
    verb, *options = words
    named = ["--no-cache"] if verb != "get" else [ESCAPE]
    run_command([verb, "sim:custom", *named, *options])
    printed = capsys.readouterr()
    assert printed.out + printed.err
    assert "\x1b" not in printed.out + printed.err
    assert "\x07" not in printed.out + printed.err
