"""Values that were just replaced: what may be older than a change is no observation of the present."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import pytest
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.reads import Read
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.params.value_check import AMBIGUITY_WINDOW
from paramclient.protocol.params.writes import Write
from paramclient.protocol.requests.retry import BATCH_INTERVAL

from paramclient.model.values import ParamType
from paramclient.protocol.events import Change, Event, EventMaker, ParamChanged
from paramclient.protocol.station import Station
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.wire.messages import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    AutopilotVersion,
    Heartbeat,
    Message,
    ParamRequestRead,
    ParamSet,
)
from tests.simulation import Simulation, is_so, param_value

NAMES = ("ATC_RAT_RLL_P", "ATC_RAT_PIT_P", "ATC_RAT_YAW_P", "PSC_ACCZ_P")


def changed_in(events: list[Event], *names: str) -> list[Change]:
    """The changes of values that were known before."""
    changes = [each.change for each in events if isinstance(each, ParamChanged)]
    return [each for each in changes if each.name in names and each.old is not None]


def are_done(operations: Sequence[Read] | Sequence[Write]) -> bool:
    return all(each.done for each in operations)


class Desk:
    """An ArduPilot 1/1 with A = 1 and B = 1, received long ago, and all that is sent to it."""

    def __init__(
        self, autopilot: int = MAV_AUTOPILOT_ARDUPILOTMEGA, sync_settings: SyncSettings | None = None
    ) -> None:
        self.now = 0.0
        self.sent: list[Message] = []
        self.events: list[Event] = []
        self.machine = ComponentMachine(
            1,
            1,
            own_address=(255, 190),
            link="x",
            send=self.sent.append,
            observer=EventMaker(self.events.append),
            sync_settings=sync_settings,
        )
        self.machine.reads.is_idle = False
        self.machine.receive(Heartbeat(2, autopilot), self.now)
        self.machine.receive(AutopilotVersion(0, uid=7), self.now)
        self.hear("A", 1.0, index=0)
        self.hear("B", 1.0, index=1)
        self.now = 4.0
        self.machine.receive(Heartbeat(2, autopilot), self.now)
        self.take()
        self.events.clear()

    def hear(self, name: str, value: float, *, index: int = 65535) -> None:
        self.machine.receive(param_value(name, value, index=index, count=2), self.now)

    def pass_time(self, seconds: float) -> None:
        end = self.now + seconds
        while (deadline := self.machine.next_deadline()) <= end:
            self.now = max(deadline, self.now)
            self.machine.receive(Heartbeat(2, self.machine.identification.autopilot or 0), self.now)
            self.machine.tick(self.now)
        self.now = end
        self.machine.receive(Heartbeat(2, self.machine.identification.autopilot or 0), self.now)

    def take(self) -> list[Message]:
        sent, self.sent[:] = list(self.sent), []
        return sent

    def reads(self) -> list[str]:
        messages = [each for each in self.take() if isinstance(each, ParamRequestRead)]
        return [each.param_id or str(each.param_index) for each in messages]

    def set(self, value: float) -> None:
        """Set A, and have it acknowledged at once."""
        write = self.machine.write("A", value, self.now)
        self.hear("A", value)
        assert write.done
        assert write.error is None

    @property
    def value(self) -> object:
        return self.machine.table.params["A"].value

    @property
    def values(self) -> list[object]:
        """What A has become, one change after the other."""
        return [each.new.value for each in changed_in(self.events, "A") if each.new is not None]


def test_a_late_answer_with_the_old_value_ends_no_read_and_makes_no_change() -> None:
    desk = Desk()
    first = desk.machine.read("A", desk.now)
    desk.now += 0.02
    desk.set(2.0)
    assert first.done  # the acknowledgement has answered it; its own answer is on its way
    read = desk.machine.read("A", desk.now)
    desk.take()
    desk.now += 0.08
    desk.hear("A", 1.0)
    assert not is_so(read.done)
    assert desk.value == 2.0
    desk.pass_time(AMBIGUITY_WINDOW - 0.09)
    assert desk.reads() == []
    desk.pass_time(0.02)
    assert desk.reads() == ["A"]
    desk.hear("A", 2.0)
    assert read.done
    assert desk.values == [2.0]


def test_another_value_counts_at_once() -> None:
    desk = Desk()
    desk.set(2.0)
    desk.hear("A", 3.0)
    assert desk.values == [2.0, 3.0]


def test_of_two_changes_in_a_row_both_old_values_are_distrusted_and_the_present_one_is_not() -> None:
    desk = Desk()
    desk.set(2.0)
    desk.now += 0.1
    desk.set(3.0)
    for late in (1.0, 2.0, 3.0):
        desk.hear("A", late)
    assert desk.values == [2.0, 3.0]
    desk.now += AMBIGUITY_WINDOW - 0.05
    desk.hear("A", 1.0)  # so long after the first change it is no late answer
    assert desk.values == [2.0, 3.0, 1.0]


def test_a_change_back_by_another_station_is_learnt_when_the_doubt_is_over() -> None:
    desk = Desk()
    desk.set(2.0)
    desk.now += 0.1
    desk.hear("A", 1.0)
    assert desk.value == 2.0
    desk.pass_time(AMBIGUITY_WINDOW)
    assert desk.reads() == ["A"]
    desk.hear("A", 1.0)
    assert desk.values == [2.0, 1.0]


def test_px4_has_no_old_values_on_the_way() -> None:
    desk = Desk(MAV_AUTOPILOT_PX4)
    desk.set(2.0)
    desk.now += 0.025
    desk.hear("A", 1.0)  # one of its modules has clamped it
    assert desk.values == [2.0, 1.0]


def test_a_set_back_is_not_proven_by_a_late_answer() -> None:
    desk = Desk()
    read = desk.machine.read("A", desk.now)
    desk.set(2.0)
    assert read.done
    desk.now += 0.05
    write = desk.machine.write("A", 1.0, desk.now)  # lost
    desk.take()
    desk.hear("A", 1.0)  # the answer to a repeat of the read
    assert not is_so(write.done)
    assert desk.value == 2.0
    desk.pass_time(AMBIGUITY_WINDOW)
    assert desk.reads() == ["A"]
    desk.hear("A", 2.0)
    assert [each.param_id for each in desk.take() if isinstance(each, ParamSet)] == ["A"]
    desk.hear("A", 1.0)
    assert write.done
    assert desk.values == [2.0, 1.0]


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("ftp", [True, False], ids=["file", "list"])
def test_a_fetch_beside_reads_and_sets_brings_no_old_values(ftp: bool, loss: float) -> None:
    for seed in range(2):
        vehicle = ArduPilotVehicle(ftp=ftp, live_period=0.0)
        session = Simulation(vehicle, air=Air.symmetric([vehicle], delay=0.005, loss=loss, seed=seed))
        machine = session.meet()
        session.run(1.0)
        for name in NAMES:
            session.get(name)
        session.events.clear()
        fetch = machine.begin_fetch(session.now, refresh=True)
        for step in range(8):
            reads = [machine.read(name, session.now) for name in NAMES]
            session.run(0.013 * seed)
            writes = [machine.write(name, 0.1 + step / 100, session.now) for name in NAMES]
            session.until(partial(are_done, writes))
            session.until(partial(are_done, reads))
        session.outcome(fetch)
        session.run(1.0)
        for name in NAMES:
            assert machine.table.params[name].value == vehicle.params[name].value
        changes = changed_in(session.events, *NAMES)
        assert {each.by for each in changes} == {"us"}
        assert len(changes) == 8 * len(NAMES)


def test_a_simulated_ardupilot_takes_the_value_of_a_read_when_it_is_queued() -> None:
    vehicle = ArduPilotVehicle(live_period=0.0)
    session = Simulation(vehicle)
    machine = session.meet()
    session.run(1.0)
    name = NAMES[0]
    first = session.get(name).value
    received: list[tuple[float, object]] = []
    receive = machine.table.hear_index
    machine.table.hear_index = lambda message: (received.append((session.now, message)), receive(message))[1]  # type: ignore[method-assign, func-returns-value]  # to see what is not believed
    read = machine.read(name, session.now)
    session.run(0.001)
    acknowledged = session.set(name, 0.2)
    at = session.now
    assert read.done
    session.run(BATCH_INTERVAL)
    assert acknowledged.actual == pytest.approx(0.2)
    assert len(received) == 1
    assert 0.0 < received[0][0] - at <= BATCH_INTERVAL
    assert first != acknowledged.actual


# what PX4's modules change afterwards


@pytest.mark.parametrize("fetched", [True, False], ids=["whole", "unfetched"])
def test_an_unreported_change_after_the_acknowledgement_is_found(fetched: bool) -> None:
    vehicle = PX4Vehicle()
    sync_settings = SyncSettings.chosen(None, "auto")
    station = Station(link="sim:test", is_stream=False, sync_settings=sync_settings)
    session = Simulation(vehicle, station=station)
    session.meet()
    if fetched:
        session.fetch()
    session.run(3.0)
    name = "MPC_XY_CRUISE"
    assert session.set(name, 18.0).status == "accepted"
    session.run(0.1)
    session.events.clear()
    session.sent.clear()
    vehicle._send_value = lambda entry, **more: None  # type: ignore[method-assign]  # its push is lost
    session.run(0.5)
    del vehicle._send_value
    assert session.machine.table.params[name].value == 18.0
    assert vehicle.params[name].value == 12.0
    session.run(2.5)
    assert session.machine.table.params[name].value == 12.0
    assert [(each.new and each.new.value, each.by) for each in changed_in(session.events, name)] == [
        (12.0, "vehicle")
    ]


def test_after_many_writes_the_hash_alone_proves_that_they_have_lasted() -> None:
    vehicle = PX4Vehicle()
    station = Station(link="sim:test", is_stream=False, sync_settings=SyncSettings.chosen(None, "auto"))
    session = Simulation(vehicle, station=station)
    machine = session.meet()
    session.fetch()
    session.run(3.0)
    names = [name for name, param in machine.table.params.items() if param.type is ParamType.REAL32]
    names = [name for name in names if name not in machine.table.volatile and not name.startswith("MPC_")]
    writes = [machine.write(name, 0.75, session.now) for name in names[:40]]
    session.until(partial(are_done, writes))
    session.run(0.5)
    session.sent.clear()
    session.run(2.0)
    assert [each.param_id for each in session.sent_of(ParamRequestRead)] == ["_HASH_CHECK"]
    assert machine.sync.synced
