"""Which way a table is downloaded, by file or by list, where sessions are in use and first responses are
lost."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_notes import FILE_IN_USE
from paramclient.protocol.requests.retry import (
    FILE_OPEN_TIMEOUT,
    FILE_OPEN_TIMEOUT_SILENT,
    FIRST_TIMEOUT,
    SESSION_IDLE_TIME,
)

from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle
from paramclient.wire import frames, messages
from paramclient.wire.messages import CommandLong, FileTransfer, Message, ParamRequestList, ParamRequestRead
from tests.shell import Tap, bits
from tests.simulation import Simulation

LEFT_OPEN = FileTransfer(0, 1, 1, Packet(2, 200, Opcode.OPEN_FILE_RO, b"a").pack())
"""The requests of another station that ended without closing its session."""


class Uplink(Tap):
    """A way to a vehicle on which requests of some kind are lost.

    Attributes:
        loses: says of each request whether it is lost.
        arrived: the messages that arrived at the vehicle.
    """

    def __init__(self, vehicle: ArduPilotVehicle | PX4Vehicle) -> None:
        super().__init__(vehicle)
        self.loses: Callable[[Message], bool] = lambda message: False
        self.arrived: list[Message] = []

    def receive(self, data: bytes, now: float) -> None:
        message = messages.decode(frames.Framer(messages.DECODED_IDS, stream=False).receive(data)[0])
        assert message is not None
        if not self.loses(message):
            self.arrived.append(message)
            super().receive(data, now)


class LosesFirst:
    """Loses the first few messages of some kinds."""

    def __init__(self, count: int, *kinds: type[Message]) -> None:
        self.left = count
        self.kinds = kinds

    def __call__(self, message: Message) -> bool:
        if isinstance(message, self.kinds) and self.left:
            self.left -= 1
            return True
        return False


def ardupilot(**options: bool | float) -> ArduPilotVehicle:
    vehicle = ArduPilotVehicle(live_period=0, **options)  # type: ignore[arg-type]
    if options.get("ftp", True):
        vehicle.files["a"] = b"a"
    return vehicle


def begin_at_heartbeat(session: Simulation) -> Fetch:
    """A fetch that begins when the vehicle is heard first, as a user's does."""
    session.until(lambda: (1, 1) in session.station.components)
    return session.machine.begin_fetch(session.now)


def times_of(session: Simulation, *kinds: type[Message]) -> list[float]:
    return [at for at, message in session.sent if isinstance(message, kinds)]


def requests_to_server(session: Simulation) -> list[tuple[float, Opcode]]:
    return [
        (at, Opcode(Packet.unpack(message.payload).opcode))
        for at, message in session.sent
        if isinstance(message, FileTransfer)
    ]


def leave_open(session: Simulation) -> None:
    """Another station opens a file, and is gone."""
    session.other_station(LEFT_OPEN)


# Before the first answer


def test_the_file_is_requested_beside_the_version() -> None:
    vehicle = ardupilot()
    session = Simulation(air=Air.symmetric([vehicle], delay=0.05))
    fetch = begin_at_heartbeat(session)
    session.exchange()
    assert times_of(session, CommandLong) == times_of(session, FileTransfer)[:1] == [session.now]
    result = session.outcome(fetch)
    assert (result.source, result.notes) == ("ftp", ())
    assert result.elapsed < 0.65  # two round trips, one of them for the closing, and the burst
    assert not vehicle.open_files


def test_a_version_that_is_lost_costs_the_file_nothing() -> None:
    uplink = Uplink(ardupilot())
    uplink.loses = LosesFirst(1000, CommandLong)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    result = session.outcome(begin_at_heartbeat(session))
    assert (result.source, result.notes) == ("ftp", ())
    assert result.elapsed < 0.65


def test_an_open_that_is_lost_is_repeated_after_the_first_timeout() -> None:
    uplink = Uplink(ardupilot())
    uplink.loses = LosesFirst(3, FileTransfer, CommandLong)  # both copies, and the version
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    result = session.outcome(begin_at_heartbeat(session))
    assert result.source == "ftp"
    assert result.elapsed < 0.65 + FIRST_TIMEOUT + 0.1


def test_a_version_that_names_no_files_leads_to_the_list_at_once() -> None:
    vehicle = ardupilot(ftp=False)
    session = Simulation(air=Air.symmetric([vehicle], delay=0.05))
    fetch = begin_at_heartbeat(session)
    began = session.now
    result = session.outcome(fetch)
    assert (result.source, result.notes) == ("stream", ())
    assert times_of(session, ParamRequestList)[0] - began < 0.15
    after = [opcode for at, opcode in requests_to_server(session) if at > began]
    assert set(after) == {Opcode.TERMINATE_SESSION}
    assert len(after) == 2


def test_a_repeated_version_request_uses_both_messages() -> None:
    uplink = Uplink(ardupilot(ftp=False))
    uplink.loses = LosesFirst(1, CommandLong)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    fetch = begin_at_heartbeat(session)
    began = session.now
    session.outcome(fetch)
    assert [round(at - began, 3) for at in times_of(session, CommandLong)] == [0.0, 0.25, 0.25]
    assert times_of(session, ParamRequestList)[0] - began < FIRST_TIMEOUT + 0.15


def test_an_open_that_stays_unanswered_brings_the_list_beside_it() -> None:
    vehicle = ardupilot()
    uplink = Uplink(vehicle)
    uplink.loses = LosesFirst(1000, FileTransfer)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    fetch = begin_at_heartbeat(session)
    began = session.now
    result = session.outcome(fetch)
    assert (result.source, bits(result.params)) == ("stream", bits(vehicle.params))
    assert times_of(session, ParamRequestList)[0] - began == pytest.approx(FILE_OPEN_TIMEOUT, abs=0.1)
    assert result.elapsed < FILE_OPEN_TIMEOUT + 1.5


def test_the_list_is_requested_later_if_nothing_is_answered() -> None:
    uplink = Uplink(ardupilot())
    uplink.loses = LosesFirst(1000, FileTransfer, CommandLong)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    fetch = begin_at_heartbeat(session)
    began = session.now
    assert session.outcome(fetch).source == "stream"
    assert times_of(session, ParamRequestList)[0] - began == pytest.approx(FILE_OPEN_TIMEOUT_SILENT, abs=0.1)


def test_a_list_that_has_begun_gives_way_to_a_file_that_is_served() -> None:
    vehicle = ardupilot()
    uplink = Uplink(vehicle)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    fetch = begin_at_heartbeat(session)
    began = session.now
    uplink.loses = lambda message: isinstance(message, FileTransfer) and session.now < began + 1.5
    session.run(1.3)
    session.air.downlink = FaultyLink(delay=0.05, loss=0.2, seed=3)
    session.run(0.4)
    session.air.downlink = FaultyLink(delay=0.05)
    result = session.outcome(fetch)
    assert (result.source, result.notes, bits(result.params)) == ("ftp", (), bits(vehicle.params))
    assert len(set(times_of(session, ParamRequestList))) == 1, "requested once, in copies as files are lost"
    assert times_of(session, ParamRequestRead) == []
    assert not vehicle.open_files


def test_a_late_version_without_file_support_lets_the_list_begin() -> None:
    vehicle = ardupilot()
    assert vehicle._ftp is not None
    vehicle._ftp.params = lambda: None
    uplink = Uplink(vehicle)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    uplink.loses = LosesFirst(1, CommandLong)
    fetch = begin_at_heartbeat(session)
    session.run(0.11)
    uplink.loses = lambda message: isinstance(message, FileTransfer)  # the opening without the defaults
    result = session.outcome(fetch)
    assert (result.source, bits(result.params)) == ("stream", bits(vehicle.params))
    assert "file not found" in result.notes[0].lower()
    version_at = session.machine.identification.known_at
    assert version_at <= times_of(session, ParamRequestList)[0] < version_at + 0.01


def test_a_complete_list_ends_the_fetch_without_the_file() -> None:
    vehicle = ardupilot()
    uplink = Uplink(vehicle)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    fetch = begin_at_heartbeat(session)
    began = session.now
    uplink.loses = lambda message: isinstance(message, FileTransfer) and session.now < began + 1.5
    result = session.outcome(fetch)
    assert (result.source, bits(result.params)) == ("stream", bits(vehicle.params))
    session.run(0.0)
    assert not vehicle.open_files


def test_list_and_hash_of_px4_are_requested_together() -> None:
    uplink = Uplink(PX4Vehicle())
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    fetch = begin_at_heartbeat(session)
    session.exchange()
    assert times_of(session, ParamRequestList) == times_of(session, ParamRequestRead) == [session.now]
    result = session.outcome(fetch)
    assert (result.complete, result.notes) == (True, ())
    assert result.hash is not None
    assert result.elapsed < 1.1


def test_a_list_request_to_px4_that_is_lost_shows_by_the_hash() -> None:
    uplink = Uplink(PX4Vehicle())
    uplink.loses = LosesFirst(1, ParamRequestList)
    session = Simulation(air=Air.symmetric([uplink], delay=0.05))
    result = session.outcome(begin_at_heartbeat(session))
    assert result.hash is not None
    assert len(times_of(session, ParamRequestList)) == 2
    assert result.elapsed < 1.1 + FIRST_TIMEOUT + 0.15


# A session that is in use


def test_beside_a_session_that_was_left_open_a_quick_list_is_taken() -> None:
    vehicle = ardupilot()
    session = Simulation(air=Air.symmetric([vehicle], delay=0.002))
    leave_open(session)
    fetch = begin_at_heartbeat(session)
    began = session.now
    result = session.outcome(fetch)
    assert (result.source, result.notes) == ("stream", (FILE_IN_USE,))
    assert bits(result.params) == bits(vehicle.params)
    assert result.elapsed < 1.3
    assert {at for at, _ in requests_to_server(session)} == {began}
    assert session.machine.fetches.file_works is None
    session.run(SESSION_IDLE_TIME)
    assert session.fetch().source == "ftp"


def test_on_a_radio_the_file_is_opened_when_the_session_ends() -> None:
    vehicle = ArduPilotVehicle(live_period=0, burst=1, period=0.025, ftp_rate=5760.0)
    vehicle.files["a"] = b"a"
    session = Simulation(air=Air.symmetric([vehicle], delay=0.02, rate=5760.0, queue=4096))
    leave_open(session)
    fetch = begin_at_heartbeat(session)
    began = session.now
    result = session.outcome(fetch)
    assert (result.source, result.notes) == ("ftp", ())
    requested = sorted({at for at, opcode in requests_to_server(session) if opcode is Opcode.OPEN_FILE_RO})
    assert len(requested) == 2
    assert requested[0] == began
    assert SESSION_IDLE_TIME < requested[1] - began < SESSION_IDLE_TIME + 0.4
    assert result.elapsed < SESSION_IDLE_TIME + 5.5  # the list takes a third of the link


def test_nothing_is_sent_while_another_station_reads() -> None:
    """On a shared link its replies are received: each one keeps its session open."""
    vehicle = ArduPilotVehicle(live_period=0, burst=1, period=0.025, ftp_rate=5760.0)
    vehicle.files["a"] = b"a" * 40_000
    session = Simulation(air=Air.symmetric([vehicle], delay=0.02, rate=5760.0, queue=4096))
    leave_open(session)
    fetch = begin_at_heartbeat(session)
    session.run(1.0)
    burst = Packet(4, 200, Opcode.BURST_READ_FILE, size=239)
    session.other_station(FileTransfer(0, 1, 1, burst.pack()))
    session.run(1.0)
    sent = len(requests_to_server(session))
    received: list[float] = []
    session.until(lambda: fetch.done or len(requests_to_server(session)) > sent)
    assert not fetch.done
    received.append(session.now)
    assert session.now > SESSION_IDLE_TIME + 6.0  # the other one's file took 7 s
    assert session.outcome(fetch).source == "ftp"
