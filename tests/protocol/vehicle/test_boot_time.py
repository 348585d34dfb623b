"""The time since boot: requests for it, samples of it from telemetry, and what follows a restart."""

from __future__ import annotations

import struct

import pytest
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.sync import SyncSettings

from paramclient.errors import CommandResult
from paramclient.model.values import ParamType
from paramclient.protocol.events import ComponentRebooted, Event, EventMaker
from paramclient.protocol.station import Station
from paramclient.wire import frames, messages
from paramclient.wire.messages import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    MAV_CMD_REQUEST_MESSAGE,
    AutopilotVersion,
    CommandAck,
    CommandLong,
    Heartbeat,
    Message,
    ParamRequestRead,
    ParamValue,
    StatusText,
    SystemTime,
    message_id,
)

OWN = (255, 190)
COPTER = Heartbeat(2, MAV_AUTOPILOT_ARDUPILOTMEGA, system_status=3)
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4, system_status=3)
ATTITUDE_ID = 30
CLOCK_REQUEST = CommandLong(1, 1, MAV_CMD_REQUEST_MESSAGE, (float(message_id(SystemTime)), *[0.0] * 6))


# requests


# the component


class Desk:
    """The component 1/1 of a kind, with sync_settings.

    Attributes:
        sent: what goes out to it, with the time.
    """

    def __init__(
        self, heartbeat: Heartbeat = COPTER, *, interval: float = 30.0, uptime: int = 60_000
    ) -> None:
        self.now = 0.0
        self.sent: list[tuple[float, Message]] = []
        self.events: list[Event] = []
        self.machine = ComponentMachine(
            1,
            1,
            own_address=OWN,
            link="x",
            send=lambda message: self.sent.append((self.now, message)),
            observer=EventMaker(self.events.append),
            sync_settings=SyncSettings(interval),
        )
        self.machine.reads.is_idle = False
        self.hear(heartbeat, sequence=100)
        self.hear(AutopilotVersion(0, uid=7))
        self.hear(SystemTime(0, uptime))
        self.sent.clear()

    def hear(self, message: Message, *, sequence: int | None = None) -> None:
        self.machine.receive(message, self.now, sequence=sequence)

    def value(self, name: str, value: float = 1.0) -> None:
        raw = struct.pack("<f", value)
        self.hear(ParamValue(name, raw, ParamType.REAL32, 4, messages.NO_INDEX))

    def run(self, until: float) -> None:
        while self.machine.next_deadline() <= until:
            self.now = max(self.now, self.machine.next_deadline())
            self.machine.tick(self.now)
        self.now = until

    def run_connected(self, until: float) -> None:
        """Let time pass in which it sends a STATUSTEXT a second, so that it is not lost."""
        while self.now < until:
            self.run(min(self.now + 1.0, until))
            self.hear(StatusText(6, "alive"))

    def take(self) -> list[tuple[float, Message]]:
        sent, self.sent = self.sent, []
        return sent

    @property
    def reboots(self) -> int:
        return sum(isinstance(event, ComponentRebooted) for event in self.events)

    def boot_time_requests(self) -> list[float]:
        return [now for now, message in self.take() if message == CLOCK_REQUEST]

    def names_read(self) -> set[str]:
        return {message.param_id for _, message in self.take() if isinstance(message, ParamRequestRead)}


def test_numbers_that_begin_anew_have_the_clock_requested() -> None:
    desk = Desk()
    desk.run_connected(100.0)
    desk.take()
    desk.hear(COPTER, sequence=0)
    desk.run(100.3)
    assert desk.boot_time_requests() == [100.0, 100.25]
    assert desk.reboots == 0
    desk.hear(SystemTime(0, 160_300))  # it has not started again
    desk.run(104.0)
    assert desk.boot_time_requests() == []
    assert desk.reboots == 0
    desk.hear(COPTER, sequence=200)
    desk.hear(COPTER, sequence=2)
    desk.run(104.5)
    desk.hear(SystemTime(0, 2_400))
    assert desk.reboots == 1


def test_a_changed_mav_state_leads_to_a_clock_request() -> None:
    """As ArduCopter says ACTIVE for two seconds after a start, and PX4 UNINIT."""
    desk = Desk()
    desk.run_connected(100.0)
    desk.take()
    desk.hear(COPTER, sequence=101)
    desk.run(100.5)
    assert desk.boot_time_requests() == []
    desk.hear(Heartbeat(2, MAV_AUTOPILOT_ARDUPILOTMEGA, system_status=4), sequence=102)
    desk.run(100.6)
    assert desk.boot_time_requests() == [100.5]


def test_telemetry_that_begins_anew_is_a_restart() -> None:
    desk = Desk(PX4)
    desk.machine.boot_clock(ATTITUDE_ID, 60_100, 0.1)
    desk.machine.boot_clock(ATTITUDE_ID, 316, 2.0)
    desk.machine.boot_clock(ATTITUDE_ID, 340, 2.03)
    assert desk.reboots == 1


ACCEPTED = CommandAck(messages.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, CommandResult.ACCEPTED, *OWN)


def test_an_accepted_restart_shows_in_the_numbers_of_the_frames() -> None:
    """ArduCopter: received 1.2 s after it has accepted, and sends its clock 1.4 s later."""
    desk = Desk()
    desk.run_connected(100.0)
    restart = desk.machine.begin_reboot(desk.now)
    desk.run(100.01)
    desk.hear(ACCEPTED, sequence=31)
    desk.run(101.2)
    desk.hear(COPTER, sequence=0)
    assert desk.reboots == 1
    desk.hear(AutopilotVersion(0, uid=7), sequence=1)
    desk.run(101.21)
    assert restart.done
    assert restart.error is None
    desk.machine.end_reboot(restart, desk.now)
    desk.take()
    desk.run(102.6)
    assert desk.boot_time_requests() != []  # a baseline for the next one
    desk.hear(SystemTime(0, 2_400))
    desk.run(104.0)
    assert desk.reboots == 1


@pytest.mark.parametrize(("after", "sequence"), [(0.2, 0), (1.2, 35), (1.2, 240)])
def test_numbers_that_prove_nothing(after: float, sequence: int) -> None:
    """Before it can have gone off, or in the middle: that waits for the clock."""
    desk = Desk()
    desk.run_connected(100.0)
    restart = desk.machine.begin_reboot(desk.now)
    desk.hear(ACCEPTED, sequence=31)
    desk.run(100.0 + after)
    desk.hear(COPTER, sequence=sequence)
    assert desk.reboots == 0
    desk.hear(SystemTime(0, 200))
    assert desk.reboots == 1
    desk.machine.end_reboot(restart, desk.now)


# telemetry


def attitude(boot_ms: int, system: int = 1, component: int = 1) -> bytes:
    payload = boot_ms.to_bytes(4, "little") + bytes(24)
    return frames.build_frame(ATTITUDE_ID, payload, system=system, component=component, sequence=0)


def beat(system: int = 1, component: int = 1, *, heartbeat: Heartbeat = PX4) -> bytes:
    return messages.encode(heartbeat, system=system, component=component, sequence=0)


@pytest.mark.parametrize("is_stream", [False, True])
def test_a_station_reads_clocks_after_a_heartbeat(is_stream: bool) -> None:
    station = Station(link="x", is_stream=is_stream)
    presence = None
    for second in range(5):
        station.receive(beat(), "peer", float(second))
        presence = station.components[1, 1].presence
        assert not station.receive(attitude(90_000 + 1000 * second), "peer", second + 0.5), "telemetry"
        assert presence.clock_at == second + 0.5
        station.receive(attitude(90_400 + 1000 * second), "peer", second + 0.9)
        assert presence.clock_at == second + 0.5, "the window is closed"
    station.receive(beat(), "peer", 5.0)
    station.receive(attitude(500), "peer", 5.1)
    assert sum(isinstance(event, ComponentRebooted) for event in station.events()) == 1


def test_clocks_of_other_components_are_their_own() -> None:
    station = Station(link="x", is_stream=False)
    gimbal = Heartbeat(26, messages.MAV_AUTOPILOT_INVALID)
    for second in range(20):
        now = float(second)
        station.receive(beat() + beat(1, 154, heartbeat=gimbal), "peer", now)
        station.receive(attitude(90_000 + 1000 * second) + attitude(1 + 1000 * second, 1, 154), "peer", now)
        station.receive(attitude(1, 7, 7), "peer", now)
    assert not any(isinstance(event, ComponentRebooted) for event in station.events())


def test_clocks_are_read_all_the_time_while_a_restart_is_awaited() -> None:
    station = Station(link="x", is_stream=False)
    station.receive(beat(), "peer", 0.0)
    station.receive(
        messages.encode(AutopilotVersion(0, uid=7), system=1, component=1, sequence=1), "peer", 0.0
    )
    station.receive(attitude(90_000), "peer", 0.5)
    machine = station.components[1, 1]
    restart = machine.begin_reboot(0.9)
    for tenth in range(10, 20):
        station.receive(attitude(90_000 + 100 * tenth), "peer", tenth / 10)
        assert machine.presence.clock_at == tenth / 10
    machine.end_reboot(restart, 2.0)
    station.receive(attitude(92_000), "peer", 2.0)
    station.receive(attitude(92_100), "peer", 2.1)
    assert machine.presence.clock_at == 2.0


def test_a_station_passes_on_the_numbers_of_frames() -> None:
    station = Station(link="x", is_stream=False)
    station.receive(messages.encode(COPTER, system=1, component=1, sequence=100), "peer", 0.0)
    station.receive(
        messages.encode(AutopilotVersion(0, uid=7), system=1, component=1, sequence=101), "peer", 0.0
    )
    station.receive(messages.encode(SystemTime(0, 5_000), system=1, component=1, sequence=102), "peer", 0.0)
    station.data_to_send()
    station.receive(messages.encode(COPTER, system=1, component=1, sequence=0), "peer", 1.0)
    station.tick(1.0)
    framer = frames.Framer(messages.DECODED_IDS, stream=False)
    sent = [messages.decode(frame) for data, _ in station.data_to_send() for frame in framer.receive(data)]
    assert CLOCK_REQUEST in sent
