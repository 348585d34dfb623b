"""Two vehicles under one address, and two paths to one: what is taken, where requests go, what is refused."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import pytest
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.requests.retry import PEER_REQUESTS
from paramclient.protocol.vehicle import address_contest as room
from paramclient.protocol.vehicle.presence import LOST_AFTER

from paramclient.errors import ContestedAddress, NoReply
from paramclient.protocol.events import ComponentContested, ComponentReplaced, ComponentUncontested, Event
from paramclient.protocol.station import Station
from paramclient.sim import ArduPilotVehicle, Endpoint, PX4Vehicle
from paramclient.wire import messages
from paramclient.wire.frames import Framer
from paramclient.wire.messages import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    MAV_CMD_REQUEST_MESSAGE,
    AutopilotVersion,
    CommandLong,
    Heartbeat,
    Message,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    SystemTime,
)
from tests.simulation import param_value

STEP = 0.05
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
ARDUPILOT = Heartbeat(2, MAV_AUTOPILOT_ARDUPILOTMEGA)


class Speaker:
    """One that sends heartbeats from a peer, and answers what is requested of it, under the address 1/1.

    Args:
        heartbeats: what it sends, in turn.
        every: seconds from one to the next.
        uid: its hardware id; None where it does not answer AUTOPILOT_VERSION, 0 where it has none.
        booted_at: when it has started; None where it sends no clock.
        value: of the parameter P.
        obeys: whether it answers a PARAM_SET.
        start, end: when it speaks.
    """

    def __init__(
        self,
        *heartbeats: Heartbeat,
        every: float = 1.0,
        uid: int | None = 1,
        booted_at: float | None = -100.0,
        value: float = 1.0,
        obeys: bool = True,
        start: float = 0.0,
        end: float = 1e9,
        system: int = 1,
    ) -> None:
        self.received: list[Message] = []
        self.uid, self.booted_at, self.value = uid, booted_at, value
        self.start, self.end = start, end
        self._heartbeats = heartbeats or (PX4,)
        self._every = every
        self._obeys = obeys
        self._system = system
        self._beats = 0
        self._framer = Framer(messages.DECODED_IDS, stream=False)
        self._out: list[bytes] = []

    def say(self, message: Message) -> None:
        self._out.append(messages.encode(message, system=self._system, component=1, sequence=0))

    def tick(self, now: float) -> None:
        while self._beats * self._every <= now - self.start + 1e-9:
            if now < self.end:
                self.say(self._heartbeats[self._beats % len(self._heartbeats)])
            self._beats += 1

    def receive(self, data: bytes, now: float) -> None:
        if not self.start <= now + 1e-9 < self.end:
            return
        for frame in self._framer.receive(data):
            message = messages.decode(frame)
            assert message is not None
            self.received.append(message)
            if isinstance(message, CommandLong) and message.command == MAV_CMD_REQUEST_MESSAGE:
                if (
                    message.params[0] == messages.message_id(messages.AutopilotVersion)
                    and self.uid is not None
                ):
                    self.say(AutopilotVersion(0, uid=self.uid))
                if (
                    message.params[0] == messages.message_id(messages.SystemTime)
                    and self.booted_at is not None
                ):
                    self.say(SystemTime(0, int(1000 * (now - self.booted_at))))
            elif isinstance(message, ParamSet) and self._obeys:
                self.say(ParamValue(message.param_id, message.raw, message.param_type, 1, 0))
            elif isinstance(message, ParamRequestRead):
                self.say(param_value("P", self.value, index=0, count=1))

    def data_to_send(self) -> list[bytes]:
        out, self._out = self._out, []
        return out


class Net:
    """Speakers at peers of one link, in a time that passes in steps."""

    def __init__(self, *, station: Station | None = None, **speakers: Speaker) -> None:
        self.station = Station(link="udpin:test", is_stream=False) if station is None else station
        self.peers: dict[Hashable, Speaker] = {}
        self.peers.update(speakers)
        self.events: list[Event] = []
        self.now = 0.0

    @property
    def machine(self) -> ComponentMachine:
        return self.station.components[1, 1]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            for peer, speaker in self.peers.items():
                speaker.tick(self.now)
                for data in speaker.data_to_send():
                    self.station.receive(data, peer, self.now)
            self.station.tick(self.now)
            for data, peer in self.station.data_to_send():
                for each, speaker in self.peers.items():
                    if peer in (None, each):
                        speaker.receive(data, self.now)
            self.events += self.station.events()

    def kinds(self) -> list[str]:
        reported = [
            each for each in self.events if isinstance(each, ComponentContested | ComponentUncontested)
        ]
        return [type(each).__name__.removeprefix("Component") for each in reported]


def silent_after(at: float, **how: object) -> Speaker:
    return Speaker(end=at, **how)  # type: ignore[arg-type]


# Two vehicles


def test_two_autopilots_under_one_address_are_contested_at_once() -> None:
    net = Net(a=Speaker(PX4, uid=1), b=Speaker(ARDUPILOT, uid=2, start=0.5, value=7.0))
    net.run(2.5)
    assert net.kinds() == ["Contested"]
    contest = net.machine.peers.contest
    assert contest is not None
    assert contest.claimants[0] == "PX4 quadrotor with the id 0000000000000001 from a"
    assert contest.claimants[1].startswith("ArduPilot quadrotor")
    assert contest.difference == "the autopilot or vehicle type"
    assert net.station.is_doubted(net.machine)
    assert net.machine.state == "contested"
    for call in (
        lambda: net.machine.write("P", 1.0, net.now),
        lambda: net.machine.read("P", net.now),
        lambda: net.machine.begin_fetch(net.now),
        lambda: net.machine.begin_reboot(net.now),
        lambda: net.machine.check_present("a file", net.now),
    ):
        with pytest.raises(ContestedAddress, match="is contested"):
            call()


def test_values_of_the_second_vehicle_never_reach_the_table() -> None:
    other = Speaker(ARDUPILOT, uid=2, start=0.3)
    net = Net(a=Speaker(PX4, uid=1), b=other)
    net.run(0.2)
    for step in range(60):
        other.say(param_value(f"B{step}", 3.0, index=step, count=60))
        net.run(STEP)
    assert [*net.machine.table.params] == []
    assert net.station.foreign >= 60


def test_waiting_callers_get_the_error() -> None:
    net = Net(a=Speaker(PX4, uid=1, obeys=False), b=Speaker(ARDUPILOT, uid=2, start=2.0))
    net.run(1.5)
    write = net.machine.write("P", 2.0, net.now, settle=5.0)
    read = net.machine.read("P", net.now)
    fetch = net.machine.begin_fetch(net.now)
    net.run(2.0)
    assert net.kinds() == ["Contested"]
    assert isinstance(write.error, ContestedAddress)
    assert read.done
    assert isinstance(fetch.error, ContestedAddress)
    assert fetch.error.system == 1


@pytest.mark.parametrize("other", [{"uid": 2}, {"uid": None}, {"booted_at": -40.0}, {"uid": 0}])
def test_two_of_one_kind_are_distinguished_by_id_and_clock(other: dict[str, object]) -> None:
    net = Net(a=Speaker(PX4), b=Speaker(PX4, start=0.5, **other))  # type: ignore[arg-type]
    net.run(PEER_REQUESTS.duration + 2.0)
    assert net.kinds() == ["Contested"]
    net.run(20.0)
    assert net.kinds() == ["Contested"], "reported once"


def test_requests_go_to_the_peer_that_gives_the_hardware_id() -> None:
    """Also if the forger was received first."""
    vehicle = Speaker(PX4, start=0.4)
    net = Net(forger=Speaker(PX4, uid=None, booted_at=None, every=0.05), vehicle=vehicle)
    net.run(1.0)
    assert net.machine.peers.home == "vehicle"
    assert net.machine.identification.identity.uid == f"{1:016x}"
    net.run(PEER_REQUESTS.duration + 2.0)
    assert net.kinds() == ["Contested"]


def test_a_contest_ends_when_one_vehicle_was_silent_for_the_heartbeat_timeout() -> None:
    net = Net(a=Speaker(PX4, uid=1), b=silent_after(4.0, uid=2, start=0.5))
    net.run(0.4)
    net.machine.read("P", net.now)
    net.run(3.5)
    assert net.kinds() == ["Contested"]
    net.run(LOST_AFTER - 1.0)
    assert net.kinds() == ["Contested"]
    net.run(2.0)
    assert net.kinds() == ["Contested", "Uncontested"]
    assert net.machine.peers.home == "a"
    assert net.machine.table.params["P"].trust == "cached", "until the vehicle has confirmed it"
    net.run(1.0)
    assert not net.station.is_doubted(net.machine)
    net.machine.write("P", 1.0, net.now)


# Several vehicles through one peer


# Two paths to one vehicle


def test_two_paths_to_one_vehicle_stay_as_they_were() -> None:
    first, second = Speaker(), Speaker(start=0.4, value=2.0, end=20.0)
    net = Net(a=first, b=second)
    net.run(3.0)
    assert net.kinds() == []
    second.say(param_value("Q", 3.0, index=1, count=2))
    net.run(0.1)
    assert net.machine.table.params["Q"].value == 3.0, "what arrives over the second path counts"
    first.end = net.now
    net.run(room.PATH_SILENCE + 1.5)
    assert net.machine.peers.home == "b"
    read = net.machine.read("P", net.now)
    net.run(0.1)
    assert read.result is not None
    first.end = 1e9
    net.run(10.0)
    assert net.kinds() == []


def test_a_vehicle_that_starts_again_behind_two_paths_is_no_contest() -> None:
    first, second = Speaker(), Speaker(start=0.4)
    net = Net(a=first, b=second)
    net.run(5.0)
    for at, speaker in ((5.5, first), (7.0, second)):  # the second path reports it later
        net.run(at - net.now)
        speaker.booted_at = 5.3
        speaker.say(SystemTime(0, int(1000 * (net.now - 5.3))))
    net.run(20.0)
    assert net.kinds() == []


def test_components_of_one_system_may_have_several_peers() -> None:
    net = Net(a=Speaker())
    net.run(2.0)
    camera = messages.encode(Heartbeat(30, 8), system=1, component=100, sequence=0)
    net.station.receive(camera, "camera", net.now)
    net.station.data_to_send()
    net.station.components[1, 100].read("C", net.now)
    net.machine.read("P", net.now)
    targets = {peer for _, peer in net.station.data_to_send()}
    assert targets == {"a", "camera"}


# A peer in place of another


def test_a_vehicle_that_returns_from_another_port_takes_its_address() -> None:
    net = Net(a=silent_after(3.0), b=Speaker(start=3.6, booted_at=3.3))
    net.run(3.0 + room.RESTART_SILENCE + 0.5)
    assert net.machine.peers.home == "b"
    net.run(10.0)
    assert net.kinds() == []
    assert net.machine.presence.started_at == pytest.approx(3.3, abs=0.1)


def test_another_vehicle_in_place_of_one_that_is_gone_is_identified_anew() -> None:
    net = Net(a=silent_after(3.0, uid=1), b=Speaker(ARDUPILOT, uid=2, start=3.5))
    net.run(2.5)
    net.machine.read("P", net.now)
    net.run(0.2)
    assert "P" in net.machine.table.params
    net.run(4.0)
    assert net.kinds() == []
    assert net.machine.peers.home == "b"
    assert net.machine.identification.identity.uid == f"{2:016x}"
    assert dict(net.machine.table.params) == {}


def test_split_peers_are_never_contested() -> None:
    station = Station(link="tcpin:test", is_stream=False, split_peers=True)
    net = Net(a=Speaker(PX4), b=Speaker(ARDUPILOT, uid=2, start=0.4, value=7.0), station=station)
    net.run(8.0)
    assert net.kinds() == []
    assert len(station.components) == 2
    assert len({*station.components, (1, 1)}) == 3, "the ids alone are no key"
    for machine in station.components.values():
        machine.read("P", net.now)
    net.run(0.2)
    values = {
        machine.peer_in_words: machine.table.params["P"].value for machine in station.components.values()
    }
    assert values == {"a": 1.0, "b": 7.0}
    assert [each.peer_in_words for each in station.at_peer("b")] == ["b"]
    assert {repr(address) for address in station.components} == {"1/1 at a", "1/1 at b"}


@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle])
def test_simulated_vehicles_behind_two_paths(make: Callable[[], Endpoint]) -> None:
    """Each message arrives twice, as from a router with two ways to one vehicle."""
    vehicle = make()
    station = Station(link="udpin:test", is_stream=False)
    now = 0.0
    events: list[Event] = []
    while now < 12.0:
        now += STEP
        vehicle.tick(now)
        for data in vehicle.data_to_send():
            for peer in ("a", "b"):
                station.receive(data, peer, now)
        station.tick(now)
        for data, _ in station.data_to_send():
            vehicle.receive(data, now)
        events += station.events()
    assert not any(isinstance(each, ComponentContested) for each in events)


# One that is not the vehicle of before


def hold(net: Net, *names: str) -> None:
    """Have the vehicle at the first peer give these, of a table of two."""
    speaker = next(iter(net.peers.values()))
    for name in names:
        speaker.say(param_value(name, 1.0, index=ord(name) - ord("P"), count=2))
    net.run(STEP)


def test_a_second_vehicle_that_gives_its_id_first_takes_nothing_over() -> None:
    """Two of one kind: the id of the first and one of its values were lost, and the table is gone on with."""
    net = Net(a=Speaker(uid=None), b=Speaker(uid=9, start=0.6, value=9.0))
    net.run(0.4)
    fetch = net.machine.begin_fetch(net.now)
    hold(net, "P")
    assert [*net.machine.table.params] == ["P"]
    net.run(1.0)
    assert net.machine.peers.home == "b"
    assert net.machine.identification.identity.uid == f"{9:016x}"
    assert dict(net.machine.table.params) == {}
    assert any(isinstance(each, ComponentReplaced) for each in net.events)
    net.peers["b"].say(param_value("Q", 9.0, index=1, count=2))
    net.run(STEP)
    assert not fetch.done, "P is wanted of this one as well"
    assert not net.machine.table.complete


def test_nothing_is_taken_from_one_that_does_not_show_to_be_the_vehicle_that_is_silent() -> None:
    net = Net(a=silent_after(3.0), b=Speaker(uid=None, booted_at=None, start=3.5, value=99.0))
    net.run(2.0)
    hold(net, "P", "Q")
    net.run(1.8)
    for _ in range(40):
        net.peers["b"].say(param_value("P", 99.0, index=0, count=2))
        net.run(STEP)
        assert net.machine.table.params["P"].value == 1.0
    net.peers["b"].end = net.now
    net.peers["a"].end = 1e9
    net.run(10.0)
    assert net.machine.table.params["P"].value == 1.0
    assert net.machine.peers.home == "a"
    assert not net.station.is_doubted(net.machine)


def test_a_peer_that_replaces_a_silent_one_without_an_id_is_another_vehicle() -> None:
    net = Net(a=silent_after(3.0), b=Speaker(uid=None, booted_at=None, start=3.5, value=99.0))
    net.run(2.0)
    hold(net, "P", "Q")
    net.run(1.2)
    write = net.machine.write("P", 5.0, net.now)
    net.run(3.5 + PEER_REQUESTS.duration + 1.0 - net.now)
    assert isinstance(write.error, NoReply)
    assert not any(isinstance(each, ParamSet) for each in net.peers["b"].received)
    assert net.machine.peers.home == "b"
    assert not net.machine.identification.identity.uid
    assert dict(net.machine.table.params) == {}
    write = net.machine.write("P", 6.0, net.now)
    net.run(8.0)
    assert write.result is not None, "it is written to as the vehicle that it is"
    assert not net.station.is_doubted(net.machine)
    net.peers["a"].end = 1e9
    net.peers["b"].end = net.now
    net.run(10.0)
    assert net.machine.identification.identity.uid == f"{1:016x}"
    assert {param.value for param in net.machine.table.params.values()} <= {1.0}, "nothing of the other one"


def test_nothing_is_written_to_a_peer_without_an_id_while_another_may_be_the_vehicle() -> None:
    """The first one pretends to be the vehicle, and never sends its hardware id."""
    net = Net(a=Speaker(every=0.05, uid=None, booted_at=None), b=Speaker(uid=7, start=15.0))
    net.run(14.9)
    hold(net, "P", "Q")
    assert net.machine.identification.settled
    assert net.machine.may_be_written
    net.run(0.5)
    write = net.machine.write("P", 5.0, net.now)
    assert net.station.is_doubted(net.machine)
    net.run(PEER_REQUESTS.duration + 1.0)
    assert isinstance(write.error, ContestedAddress)
    for peer in net.peers.values():
        assert not any(isinstance(each, ParamSet) for each in peer.received)


def test_a_component_that_no_longer_identifies_itself_is_not_written_to() -> None:
    """At a serial port only the id shows whether it is the vehicle that was there before."""
    speaker = Speaker(end=3.0)
    net = Net(port=speaker)
    net.run(2.0)
    hold(net, "P", "Q")
    net.run(9.0)
    speaker.end, speaker.uid = 1e9, None
    net.run(2.0)
    write = net.machine.write("P", 5.0, net.now)
    net.run(6.0)
    assert isinstance(write.error, NoReply)
    assert "has not identified itself since it was silent" in str(write.error)
    again = net.machine.write("P", 5.0, net.now)
    net.run(0.5)
    assert not again.done
    speaker.uid = 1
    net.run(2.0)
    assert again.result is not None
    assert len([each for each in speaker.received if isinstance(each, ParamSet)]) == 1


def camera(net: Net, peer: str, value: float) -> ComponentMachine:
    """One of the same system, which has reported a value."""
    for message in (Heartbeat(30, 8), param_value("CAM", value, index=0, count=1)):
        net.station.receive(messages.encode(message, system=1, component=100, sequence=0), peer, net.now)
    net.run(STEP)
    return net.station.components[1, 100]


def test_the_other_components_go_with_the_autopilot_that_loses_a_contest() -> None:
    net = Net(a=silent_after(5.0, uid=1), b=Speaker(uid=2, start=1.0))
    net.run(0.5)
    other = camera(net, "a", 7.0)
    assert [*other.table.params] == ["CAM"]
    net.run(15.0)
    assert net.kinds() == ["Contested", "Uncontested"]
    assert net.machine.identification.identity.uid == f"{2:016x}"
    assert dict(other.table.params) == {}


def test_the_components_of_an_unidentified_autopilot_are_not_written_to() -> None:
    port = Speaker(end=3.0)
    net = Net(port=port)
    net.run(2.0)
    other = camera(net, "port", 9.0)
    net.run(9.0)
    port.end, port.uid = 1e9, None
    net.run(10.0)
    camera(net, "port", 9.0)
    write = other.write("CAM", 5.0, net.now)
    net.run(15.0)
    assert isinstance(write.error, NoReply)
    assert not any(isinstance(each, ParamSet) for each in port.received)
