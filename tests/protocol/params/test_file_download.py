"""The table as one packed file: fetched, fallen back from, and remembered."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.sync import SyncSettings

from paramclient import FetchResult, NoReply, Trust
from paramclient.errors import LinkError
from paramclient.model.values import ParamType
from paramclient.protocol.events import ParamChanged, TableResynced
from paramclient.protocol.file_download import PARAM_FILE, WITH_DEFAULTS
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, GenericVehicle, PX4Vehicle
from paramclient.wire import frames, messages
from tests.shell import Tap, bits
from tests.simulation import Simulation, is_so, listing_ardupilot

FULL_PATH = PARAM_FILE + WITH_DEFAULTS
EXACT = 2_147_483_001
"""An INT32 that a float32 rounds."""


class Server(Tap):
    """A way to a vehicle on which MAVFTP alone can be held up.

    Attributes:
        swallows: says of each request whether it is lost.
        opened: the paths of the files that were requested, each copy of a request counted once.
    """

    def __init__(self, vehicle: ArduPilotVehicle | PX4Vehicle) -> None:
        super().__init__(vehicle)
        self.swallows: Callable[[Packet], bool] = lambda request: False
        self.opened: list[str] = []
        self._sequence = -1

    def receive(self, data: bytes, now: float) -> None:
        frame = frames.Framer(messages.DECODED_IDS, stream=False).receive(data)[0]
        message = messages.decode(frame)
        if isinstance(message, messages.FileTransfer):
            request = Packet.unpack(message.payload)
            if request.opcode == Opcode.OPEN_FILE_RO and request.sequence != self._sequence:
                self._sequence = request.sequence
                self.opened.append(request.data.split(b"\0")[0].decode())
            if self.swallows(request):
                return
        super().receive(data, now)


def begin(session: Simulation, **options: Any) -> Fetch:
    return session.meet().begin_fetch(session.now, **options)


def in_the_middle(session: Simulation) -> Fetch:
    """A fetch that has received a part of the file."""
    fetch = begin(session)
    session.until(lambda: fetch.progress(session.now).received > 0)
    assert fetch.file is not None
    assert not fetch.done
    return fetch


def is_whole(result: FetchResult, vehicle: ArduPilotVehicle | PX4Vehicle) -> bool:
    return result.complete and bits(result.params) == bits(vehicle.params)


def remembered(session: Simulation) -> bool | None:
    return session.machine.fetches.file_works


def lists(session: Simulation) -> int:
    return len(session.sent_of(messages.ParamRequestList))


# As it should be


@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"delay": 0.05},
        {"loss": 0.2, "delay": 0.02, "seed": 1},
        {"loss": 0.4, "delay": 0.01, "seed": 2},
        {"duplicate": 0.3, "delay": 0.01},
        {"reorder": 0.2, "delay": 0.01, "jitter": 0.01},
    ],
    ids=str,
)
def test_the_file_brings_the_whole_table(faults: dict[str, Any]) -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    seed = faults.pop("seed", 0)
    session = Simulation(vehicle)
    session.meet()
    session.air.uplink = FaultyLink(seed=seed, **faults)
    session.air.downlink = FaultyLink(seed=seed + 10, **faults)
    result = session.fetch()
    assert (result.source, result.notes, result.resumed, lists(session)) == ("ftp", (), 0, 0)
    assert is_whole(result, vehicle)
    assert {param.trust for param in result.params.values()} == {Trust.LIVE}
    assert [param.index for param in result.params.values()] == list(range(1382))
    assert (session.machine.state, session.machine.fetches.file_works) == ("synced", True)
    session.run(20.0)
    assert not vehicle.open_files
    assert session.machine.files.is_idle


def test_every_parameter_has_its_default() -> None:
    session = Simulation(ArduPilotVehicle())
    params = session.fetch().params
    assert all(param.default is not None for param in params.values())
    changed = {name for name, param in params.items() if param.is_changed}
    assert len(changed) == 41, "the vehicle gives 42, and one of them is the same as the value"
    name = min(name for name in changed if not name.startswith("BARO"))  # BARO*_DEVID are read-only
    before = params[name]
    session.set(name, before.default if before.default is not None else 0)
    now = session.machine.table.params[name]
    assert (now.default, now.is_changed) == (before.default, False)


def test_a_hash_is_requested_first_and_proves_the_file() -> None:
    vehicle = PX4Vehicle(ftp=True)
    server = Server(vehicle)
    session = Simulation(server)
    result = session.fetch()
    assert (result.source, result.hash, result.notes) == ("ftp", vehicle.announced_hash(), ())
    assert is_whole(result, vehicle)
    assert session.machine.can_hit
    memory = session.memory()
    server.opened.clear()
    session.next_session()
    session.meet().use_cached(now=session.now, **memory)
    again = session.fetch()
    assert (again.source, again.hash) == ("cache", vehicle.announced_hash())
    assert server.opened == []
    vehicle.set_param("MC_ROLL_P", 3.25)
    vehicle.tick(session.now + 1.0)
    vehicle.data_to_send()  # no station receives it
    session.next_session()
    session.run(1.0)
    session.meet().use_cached(now=session.now, **memory)
    changed = session.fetch()
    assert (changed.source, changed.hash) == ("ftp", vehicle.announced_hash())
    assert changed.params["MC_ROLL_P"].value == 3.25


def test_no_file_is_requested_from_px4_1_17() -> None:
    server = Server(PX4Vehicle())
    session = Simulation(server)
    result = session.fetch()
    assert (result.source, result.notes) == ("stream", ())
    assert server.opened == []


def test_no_file_is_requested_from_a_vehicle_without_the_capability() -> None:
    server = Server(listing_ardupilot())
    assert Simulation(server).fetch().source == "stream"
    assert server.opened == []


# What arrives meanwhile


def test_values_received_during_the_file_read_win() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    session = Simulation(server, air=Air.symmetric([server], delay=0.05))
    fetch = in_the_middle(session)
    session.until(lambda: fetch.progress(session.now).received > 150)
    # already received; it is not the default now nor then, so the size of the file stays
    name = "RELAY1_FUNCTION"
    assert vehicle.param(name).value == 1
    session.set(name, 2)
    result = session.outcome(fetch)
    assert (result.source, len(server.opened)) == ("ftp", 1)
    assert result.params[name].value == 2
    assert (result.params[name].default, result.params[name].index) == (0, 61)
    assert is_whole(result, vehicle)


def test_large_integers_are_exact_and_stay_so() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    name = next(name for name, param in vehicle.params.items() if param.type is ParamType.INT32)
    vehicle.set_param(name, EXACT)
    session = Simulation(vehicle)
    fetch = begin(session)
    session.run(0.1)
    received = session.get(name)  # rounded, while the file is read
    assert received.value not in (EXACT, None)
    assert session.outcome(fetch).params[name].value == EXACT
    assert session.get(name).value == EXACT
    session.machine.fetches.file_works = False
    assert session.fetch(refresh=True).params[name].value == EXACT
    session.machine.table.doubt(Trust.LIVE)
    assert session.fetch(refresh=True).params[name].value == EXACT
    vehicle.set_param(name, EXACT - 2_000_000)
    session.run(1.0)
    assert session.get(name).value != EXACT


def test_a_count_that_changes_makes_it_read_again() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    session = Simulation(server)
    session.fetch()
    fetch = in_the_middle(session)
    vehicle.set_param("EK2_ENABLE", 1)
    result = session.outcome(fetch)
    assert (result.source, result.count) == ("ftp", 1434)
    assert is_whole(result, vehicle)
    fetch = in_the_middle(session)
    vehicle.set_param("EK2_ENABLE", 0)
    result = session.outcome(fetch)
    assert (result.source, result.count, lists(session)) == ("ftp", 1382, 0)
    assert is_whole(result, vehicle), "what is hidden is gone"
    assert session.machine.table.params.keys() == vehicle.params.keys()
    assert session.machine.state == "synced"


def test_a_count_that_changes_each_time_ends_in_a_list() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    session = Simulation(server)
    fetch = in_the_middle(session)
    vehicle.set_param("EK2_ENABLE", 1)
    session.until(lambda: len(server.opened) == 2)
    session.until(lambda: fetch.progress(session.now).received > 0)
    vehicle.set_param("EK2_ENABLE", 0)
    result = session.outcome(fetch)
    assert (result.source, len(server.opened)) == ("stream", 2)
    assert "by now" in result.notes[0]
    assert is_whole(result, vehicle)
    assert remembered(session) is None, "next time it may hold still"


# What is no file


def odd_files() -> dict[str, bytes]:
    whole = Simulation(ArduPilotVehicle())
    read = whole.meet().files.read(FULL_PATH, whole.now)
    data = whole.outcome(read)
    return {
        "no magic": b"\0\0" + data[2:],
        "cut off": data[:-7],
        "left over": data + b"\x11",
        "too few": data[:2] + b"\0\0" + data[4:],
        "a part of it": data[:4] + (2000).to_bytes(2, "little") + data[6:],
        "empty": b"",
    }


@pytest.mark.parametrize("kind", list(odd_files()))
def test_an_invalid_file_is_read_twice_and_then_the_list_follows(kind: str) -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    vehicle.files[FULL_PATH] = odd_files()[kind]
    session = Simulation(server)
    result = session.fetch()
    assert (result.source, server.opened) == ("stream", [FULL_PATH] * 2)
    assert is_whole(result, vehicle)
    assert result.notes[0].startswith("The parameters were downloaded as a list instead of a file: ")
    assert remembered(session) is False
    again = session.fetch()
    assert (again.source, again.notes, len(server.opened)) == ("stream", (), 2)


def test_no_file_is_said_and_remembered() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    assert vehicle._ftp is not None
    vehicle._ftp.params = lambda: None
    server = Server(vehicle)
    session = Simulation(server)
    result = session.fetch()
    assert (result.source, server.opened) == ("stream", [FULL_PATH])
    assert "file not found" in result.notes[0].lower()
    assert is_whole(result, vehicle)
    assert remembered(session) is False
    again = session.fetch()
    assert (again.notes, len(server.opened)) == ((), 1)


def test_a_server_that_keeps_silent_is_remembered_once_the_list_has_arrived() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    server.swallows = lambda request: True
    session = Simulation(server)
    result = session.fetch()
    assert (result.source, is_whole(result, vehicle)) == ("stream", True)
    assert "as a list instead of a file: no reply" in result.notes[0]
    assert remembered(session) is False
    opened = len(server.opened)
    assert session.fetch().source == "stream"
    assert len(server.opened) == opened


def test_the_file_of_another_vehicle_is_requested_again() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    assert vehicle._ftp is not None
    vehicle._ftp.params = lambda: None
    session = Simulation(vehicle)
    fetch = begin(session)
    session.until(lambda: fetch.file_failed is not None)
    other = ArduPilotVehicle(live_period=0, uid2=b"another", boot_time=0.0)
    session.air.vehicles = (other,)
    session.machine.become_another(session.now)
    assert is_so(fetch.file_failed is None)
    result = session.outcome(fetch)
    assert (result.source, result.notes) == ("ftp", ())
    assert remembered(session) is True


def test_the_file_of_another_firmware_is_requested_again_and_has_new_defaults() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    session = Simulation(vehicle)
    session.fetch()
    machine = session.machine
    session.machine.fetches.file_works = False
    vehicle.reboot(session.now, down=1.0)
    session.run(10.0)
    assert remembered(session) is False, "the same firmware"
    assert all(param.default is not None for param in machine.table.params.values())
    vehicle._version = replace(vehicle._version, flight_sw_version=67502081)
    vehicle.reboot(session.now, down=1.0)
    session.run(10.0)
    assert remembered(session) is None
    assert {param.default for param in machine.table.params.values()} == {None}
    assert len(machine.table.params) == 1382
    result = session.fetch()
    assert result.source == "ftp"
    assert all(param.default is not None for param in result.params.values())


# Misfortunes


def test_a_reboot_in_the_middle_begins_anew() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    session = Simulation(vehicle)
    fetch = in_the_middle(session)
    vehicle.reboot(session.now, down=1.0)
    result = session.outcome(fetch)
    assert is_whole(result, vehicle)
    session.run(20.0)
    assert not vehicle.open_files


def test_a_vehicle_that_stays_lost_is_given_up() -> None:
    server = Server(ArduPilotVehicle(live_period=0))
    session = Simulation(server)
    fetch = in_the_middle(session)
    server.is_mute = server.is_deaf = True
    assert isinstance(session.error_of(lambda: session.outcome(fetch, 300.0)), NoReply)
    assert remembered(session) is None


def test_a_link_that_was_disconnected_goes_on() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    session = Simulation(vehicle)
    fetch = in_the_middle(session)
    session.station.pause()
    session.now += 2.0
    vehicle.tick(session.now)
    session.air.data_to_send()
    session.station.resume(session.now)
    result = session.outcome(fetch)
    assert (result.source, is_whole(result, vehicle)) == ("ftp", True)


def test_the_link_s_end_is_the_fetch_s() -> None:
    vehicle = ArduPilotVehicle()
    session = Simulation(vehicle)
    fetch = in_the_middle(session)
    session.station.fail_all(LinkError("gone", link="sim:test"), session.now)
    assert isinstance(fetch.error, LinkError)
    session.until(lambda: session.machine.files.is_idle)
    assert not vehicle.open_files
    assert lists(session) == 0


def test_cancelled_it_closes_the_file_on_board() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    session = Simulation(vehicle)
    fetch = in_the_middle(session)
    assert vehicle.open_files == [FULL_PATH]
    session.machine.end_fetch(fetch, session.now)
    session.run(0.01)
    last = session.sent_of(messages.FileTransfer)[-1]
    assert Packet.unpack(last.payload).opcode == Opcode.TERMINATE_SESSION
    session.run(1.0)
    assert not vehicle.open_files
    assert not fetch.done
    assert session.machine.fetch is None
    result = session.fetch()
    assert (result.source, is_whole(result, vehicle)) == ("ftp", True)


def test_progress_and_partial_result_of_a_file_download() -> None:
    session = Simulation(ArduPilotVehicle(live_period=0))
    fetch = begin(session)
    assert fetch.progress(session.now).total is None
    assert isinstance(session.error_of(lambda: fetch.partial(session.now, "over")), NoReply)
    session.until(lambda: fetch.progress(session.now).received > 0)
    shares = [fetch.progress(session.now)]
    while not fetch.done:
        session.run(0.05)
        if not fetch.done:
            shares.append(fetch.progress(session.now))
    assert {share.total for share in shares} == {1382}
    received = [share.received for share in shares]
    assert received == sorted(received)
    assert received[-1] > 600
    assert all(share.rate > 0 for share in shares[1:])
    lefts = [share.seconds_left for share in shares[1:]]
    assert all(left is not None and math.isfinite(left) for left in lefts)


# Several on one link


def test_no_common_list_is_requested_if_one_component_may_have_the_file() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    camera = GenericVehicle({"A": 1.0, "B": 2}, component=100, autopilot=messages.MAV_AUTOPILOT_INVALID)
    session = Simulation(server, camera)
    session.meet()
    session.until(lambda: len(session.station.components) == 2)
    machines = list(session.station.components.values())
    both = session.station.begin_fetches(machines, session.now)
    results = [session.outcome(fetch) for fetch in both]
    assert sorted(result.source for result in results) == ["ftp", "stream"]
    assert all(result.complete for result in results)
    assert [each.target_component for each in session.sent_of(messages.ParamRequestList)] == [100]
    assert is_whole(next(result for result in results if result.source == "ftp"), vehicle)


# Kept up


def upkept(server: Server) -> Simulation:
    """A session with a vehicle that has run for a while: one that has just started is looked at once more."""
    session = Simulation(server)
    session.run(10.0)
    server.opened.clear()
    session.next_session(
        Station(link="sim:test", is_stream=False, sync_settings=SyncSettings.chosen(None, "auto"))
    )
    return session


def test_a_file_that_arrives_quickly_is_read_again_every_half_minute() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    session = upkept(server)
    session.fetch()
    name = list(vehicle.params)[5]
    value = vehicle.param(name).value
    server.is_mute = True
    vehicle.set_param(name, value + 1)
    session.run(0.1)
    server.is_mute = False
    opened = len(server.opened)
    session.run(27.0)
    assert len(server.opened) == opened
    session.run(3.0)
    assert len(server.opened) == opened + 1
    assert session.machine.table.params[name].value == value + 1
    assert lists(session) == 0


def test_values_that_the_vehicle_changes_and_sends_are_no_finding_of_the_watch() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=11.0))
    session = upkept(server)
    session.fetch()
    session.events.clear()
    session.run(200.0)
    assert len(server.opened) > 5
    changed = {event.change.name for event in session.events if isinstance(event, ParamChanged)}
    assert changed == {"STAT_RUNTIME", "BARO1_GND_PRESS"} & vehicle.params.keys()
    assert not [event for event in session.events if isinstance(event, TableResynced)]


def test_a_value_whose_update_was_lost_is_reported_once() -> None:
    server = Server(vehicle := ArduPilotVehicle(live_period=0))
    session = upkept(server)
    session.fetch()
    server.is_mute = True
    vehicle.set_param("STAT_RUNTIME", 77)
    session.run(0.1)
    server.is_mute = False
    session.run(100.0)
    reported = [event.changed for event in session.events if isinstance(event, TableResynced)]
    assert reported == [("STAT_RUNTIME",)]
