"""The station on one link: which components are found, routing, our heartbeat, and several vehicles."""

from __future__ import annotations

import math

import pytest

from paramclient.errors import LinkError
from paramclient.model.values import Encoding, ParamType
from paramclient.protocol import station as room
from paramclient.protocol.events import ComponentDiscovered
from paramclient.protocol.fetch import FetchResult
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam
from paramclient.wire import frames, messages
from paramclient.wire.frames import Framer
from paramclient.wire.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_TYPE_GCS,
    AutopilotVersion,
    CommandLong,
    Heartbeat,
    Message,
    ParamRequestList,
    ParamRequestRead,
    StatusText,
)
from tests.simulation import Simulation, param_value

PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
GCS = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID)
CAMERA = Heartbeat(30, MAV_AUTOPILOT_INVALID)


def frame(message: Message, system: int = 1, component: int = 1, *, version: int = 2) -> bytes:
    return messages.encode(message, system=system, component=component, sequence=0, version=version)


def sent(station: Station) -> list[tuple[Message, int, object]]:
    """The sent messages: message, MAVLink version, and addressee."""
    framer = Framer(messages.DECODED_IDS, stream=False)
    out = []
    for data, peer in station.data_to_send():
        for each in framer.receive(data):
            assert (each.system, each.component) == station.own_address
            message = messages.decode(each)
            assert message is not None
            out.append((message, each.version, peer))
    return out


def a_station(*, is_stream: bool = False, encoding: Encoding | None = None) -> Station:
    return Station(link="x", is_stream=is_stream, encoding=encoding)


def hear(
    station: Station, message: Message, system: int = 1, component: int = 1, *, now: float = 0.0
) -> None:
    station.receive(frame(message, system, component), "peer", now)


# our heartbeat


def test_our_heartbeat_is_sent_once_a_second() -> None:
    station = a_station()
    beats = []
    now = 0.0
    while now < 9.9:
        station.tick(now)
        beats += [now for _ in sent(station)]
        now = station.next_deadline()
    assert beats == [float(second) for second in range(10)]


# Which components are found


def test_a_component_is_met_by_its_heartbeat_or_a_value() -> None:
    station = a_station()
    hear(station, StatusText(4, "hello"), 1, 1)
    hear(station, AutopilotVersion(0), 1, 2)
    assert station.components == {}
    hear(station, PX4, 1, 1)
    hear(station, param_value("A"), 3, 4)
    assert list(station.components) == [(1, 1), (3, 4)]
    events = [event for event in station.events() if isinstance(event, ComponentDiscovered)]
    assert events == [ComponentDiscovered(machine) for machine in station.components.values()]
    assert station.events() == []
    assert station.components[3, 4].table.params["A"].value == 0.0


ATTITUDE = 30


def telemetry(system: int = 1, component: int = 1, *, version: int = 2) -> bytes:
    payload = bytes(range(1, 29))
    return frames.build_frame(
        ATTITUDE, payload, system=system, component=component, sequence=0, version=version
    )


def heartbeat_requests(station: Station) -> list[tuple[int, int, object]]:
    """The components whose heartbeat was requested, and the peers of the requests."""
    return [
        (message.target_system, message.target_component, peer)
        for message, _, peer in sent(station)
        if isinstance(message, CommandLong)
        and (message.command, message.params[0])
        == (messages.MAV_CMD_REQUEST_MESSAGE, messages.message_id(messages.Heartbeat))
    ]


@pytest.mark.parametrize("is_stream", [False, True])
def test_the_heartbeat_of_a_vehicle_that_sends_telemetry_is_requested(is_stream: bool) -> None:
    station = a_station(is_stream=is_stream)
    assert station.receive(telemetry(4), "there", 0.0)
    assert heartbeat_requests(station) == [(4, 1, "there")]
    assert not station.components  # telemetry alone makes no component
    station.receive(telemetry(4), "there", 0.2)
    assert heartbeat_requests(station) == []
    station.receive(telemetry(4), "there", 0.25)
    assert heartbeat_requests(station) == [(4, 1, "there")]
    hear(station, PX4, 4, now=0.3)
    sent(station)
    station.receive(telemetry(4), "there", 1.0)
    station.receive(telemetry(5), "there", 2.0)
    assert heartbeat_requests(station) == []


def test_our_own_frames_and_those_without_a_sender_are_ignored() -> None:
    station = a_station()
    hear(station, GCS, 255, 190)
    hear(station, PX4, 0, 1)
    assert station.components == {}
    hear(station, GCS, 255, 191)
    assert list(station.components) == [(255, 191)]


def test_nothing_is_requested_from_a_ground_station() -> None:
    station = a_station()
    hear(station, GCS, 254, 190)
    assert sent(station) == []
    assert station.identity_of(station.components[254, 190]) is None


def test_components_have_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "COMPONENTS_MAX", 5)
    station = a_station()
    for component in range(1, 50):
        hear(station, PX4, 1, component)
    assert len(station.components) == 5
    hear(station, param_value("A"), 1, 3)  # known components are processed
    assert "A" in station.components[1, 3].table.params


# streams and datagrams, peers


def test_a_stream_may_cut_frames_anywhere() -> None:
    station = a_station(is_stream=True)
    data = frame(PX4)
    station.receive(data[:5], "a", 0.0)
    station.receive(frame(PX4, 2, 1)[:3], "b", 0.0)
    station.receive(data[5:], "a", 0.0)
    assert list(station.components) == [(1, 1)]


def test_datagrams_are_not_joined() -> None:
    station = a_station()
    data = frame(PX4)
    station.receive(data[:5], "a", 0.0)
    station.receive(data[5:], "a", 0.0)
    assert station.components == {}


def test_the_end_of_a_stream_forgets_its_rest_and_its_peer() -> None:
    station = a_station(is_stream=True)
    station.receive(frame(PX4), "a", 0.0)
    station.receive(frame(PX4, 2, 1), "b", 0.0)
    station.data_to_send()
    station.receive(frame(PX4)[:5], "a", 0.0)
    station.receive(b"", "a", 0.0)
    station.receive(frame(PX4)[5:], "a", 0.0)
    for system in (1, 2):
        station.components[system, 1].read("A", 0.0)
    requests = [peer for message, _, peer in sent(station) if isinstance(message, ParamRequestRead)]
    assert requests == ["b"], "nothing is requested from another peer"


def test_requests_go_to_the_first_peer_until_it_is_silent() -> None:
    station = a_station()
    station.receive(frame(PX4), "here", 0.0)
    station.receive(frame(PX4, 2, 1), "there", 0.0)
    peers = [peer for message, _, peer in sent(station) if isinstance(message, CommandLong)]
    assert peers == ["here", "there"]
    station.receive(frame(PX4), "there", 1.0)
    sent(station)
    station.components[1, 1].read("A", 1.0)
    assert [peer for _, _, peer in sent(station)] == ["here"]
    station.receive(frame(PX4), "there", 3.0)
    sent(station)
    station.components[1, 1].read("B", 3.0)
    assert [peer for _, _, peer in sent(station)] == ["there"]


# MAVLink 1


def test_a_peer_that_speaks_mavlink_1_gets_it_until_it_speaks_2() -> None:
    station = a_station()
    station.receive(frame(PX4, version=1), "a", 0.0)
    assert [version for _, version, _ in sent(station)] == [1]
    station.receive(frame(PX4, 2, 1), "a", 0.0)
    assert [version for _, version, _ in sent(station)] == [2]
    station.components[1, 1].read("A", 0.0)
    assert [version for _, version, _ in sent(station)] == [1]
    station.receive(frame(PX4), "a", 0.0)
    station.receive(frame(PX4, version=1), "a", 0.0)
    station.components[1, 1].read("B", 0.0)
    assert [version for _, version, _ in sent(station)] == [2]


@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle])
def test_a_whole_session_in_mavlink_1(make: type[PX4Vehicle] | type[ArduPilotVehicle]) -> None:
    vehicle = make(mavlink_version=1)
    world = Simulation(vehicle)
    result = world.fetch()
    assert result.complete
    assert {name: param.value for name, param in result.params.items()} == vehicle.values


# other stations


# pause and resume


def test_timeouts_pause_while_the_link_is_disconnected() -> None:
    station = a_station(is_stream=True)
    station.receive(frame(PX4), "a", 0.0)
    station.receive(frame(PX4)[:5], "a", 0.0)
    read = station.components[1, 1].read("A", 0.0)
    station.pause()
    assert station.data_to_send() == []
    assert station.next_deadline() == math.inf
    station.tick(500.0)
    assert station.data_to_send() == []
    assert not read.done
    station.resume(500.0)
    assert station.next_deadline() <= 500.0
    station.tick(500.0)
    messages = sent(station)
    assert any(isinstance(message, Heartbeat) for message, _, _ in messages)
    assert [peer for message, _, peer in messages if isinstance(message, ParamRequestRead)] == [None]
    station.receive(frame(PX4)[5:], "a", 500.0)  # the rest of what was cut off
    station.receive(frame(param_value("A")), "a", 500.0)
    assert read.done


def test_every_waiting_call_ends_with_the_link() -> None:
    station = a_station()
    for system in (1, 2):
        hear(station, PX4, system, 1)
    reads = [machine.read("A", 0.0) for machine in station.components.values()]
    error = LinkError("gone", link="x")
    station.fail_all(error, 1.0)
    assert [read.error for read in reads] == [error, error]


# whose is what


def test_the_autopilot_of_a_system() -> None:
    station = a_station()
    assert station.autopilot_of(1) is None
    hear(station, CAMERA, 1, 100)
    assert station.autopilot_of(1) is None
    hear(station, PX4, 1, 5)
    assert station.autopilot_of(1) is station.components[1, 5]
    hear(station, CAMERA, 1, 1)
    assert station.autopilot_of(1) is station.components[1, 5]
    hear(station, PX4, 1, 1)
    assert station.autopilot_of(1) is station.components[1, 1]
    assert station.autopilot_of(2) is None


def test_a_component_belongs_to_the_vehicle_that_its_autopilot_names() -> None:
    station = a_station()
    hear(station, CAMERA, 1, 100)
    hear(station, PX4, 1, 1)
    camera = station.components[1, 100]
    assert station.identity_of(camera) is None
    hear(station, AutopilotVersion(0, uid=7), 1, 1)
    identity = station.identity_of(camera)
    assert identity is not None
    assert identity.uid == "0000000000000007"


# several at once


def rows(prefix: str, size: int) -> list[SimParam]:
    return [SimParam(f"{prefix}{number:03d}", ParamType.INT32, number) for number in range(size)]


def fetch_of(world: Simulation, *addresses: tuple[int, int], refresh: bool = False) -> list[FetchResult]:
    machines = [world.station.components[address] for address in addresses]
    fetches = world.station.begin_fetches(machines, world.now, refresh=refresh)
    return [world.outcome(fetch) for fetch in fetches]


def lists(world: Simulation) -> list[tuple[int, int]]:
    return [(each.target_system, each.target_component) for each in world.sent_of(ParamRequestList)]


def settle(world: Simulation, count: int) -> None:
    world.until(
        lambda: (
            len(world.station.components) == count
            and all(machine.identification.settled for machine in world.station.components.values())
        )
    )
    world.sent.clear()


def test_one_list_request_reaches_all_components_of_a_system() -> None:
    vehicles = [GenericVehicle(rows("A", 30)), GenericVehicle(rows("B", 20), component=100)]
    world = Simulation(*vehicles)
    settle(world, 2)
    results = fetch_of(world, (1, 1), (1, 100))
    assert [result.count for result in results] == [30, 20]
    assert all(result.complete for result in results)
    assert next(iter(results[1].params)) == "B000"
    assert lists(world) == [(1, 0)]


def test_components_with_a_hash_get_a_request_each() -> None:
    vehicles = [PX4Vehicle(table=rows("A", 5)), GenericVehicle(rows("B", 5), component=2)]
    world = Simulation(*vehicles)
    settle(world, 2)
    fetch_of(world, (1, 1), (1, 2))
    world.sent.clear()
    results = fetch_of(world, (1, 1), (1, 2))
    assert [result.source for result in results] == ["cache", "stream"]
    assert lists(world) == [(1, 2)]
    world.sent.clear()
    fetch_of(world, (1, 1), (1, 2), refresh=True)
    assert lists(world) == [(1, 0)]


def test_a_silent_component_delays_no_other() -> None:
    silent = GenericVehicle({}, component=50)
    world = Simulation(GenericVehicle(rows("A", 50)), silent)
    settle(world, 2)
    machines = list(world.station.components.values())
    first, second = world.station.begin_fetches(machines, world.now)
    begun_at = world.now
    world.until(lambda: first.done, 2.0)
    assert first.result is not None
    assert first.result.complete
    assert world.now - begun_at < 1.0
    world.run(2.0)
    assert second.is_silent
    assert not second.done


def test_several_vehicles_side_by_side() -> None:
    vehicles = [PX4Vehicle(system=1), ArduPilotVehicle(system=2), PX4Vehicle(system=3, table=rows("C", 100))]
    world = Simulation(air=Air.symmetric(vehicles, loss=0.02, delay=0.02, seed=5))
    settle(world, 3)
    machines = list(world.station.components.values())
    fetches = [machine.begin_fetch(world.now) for machine in machines]
    for vehicle, fetch in zip(vehicles, fetches, strict=True):
        result = world.outcome(fetch)
        assert result.complete
        listed = {name: param.value for name, param in result.params.items() if param.index is not None}
        assert listed == vehicle.values
    assert world.now < 15.0


def test_a_write_reaches_the_one_it_is_for() -> None:
    vehicles = [PX4Vehicle(table={"SAME": 1}), GenericVehicle({"SAME": 2}, component=2)]
    world = Simulation(*vehicles)
    settle(world, 2)
    write = world.station.components[1, 2].write("SAME", 7, world.now)
    assert world.outcome(write).status == "accepted"
    assert [vehicle.param("SAME").value for vehicle in vehicles] == [1, 7]
