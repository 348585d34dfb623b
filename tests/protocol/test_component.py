"""One component: its messages in, its requests out, and what is known in between."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import pytest
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params import table as table_room
from paramclient.protocol.params.change_origin import DOUBT_TIME, FOREIGN_SET_MEMORY
from paramclient.protocol.params.value_check import AMBIGUITY_WINDOW

from paramclient.errors import (
    LinkError,
    NoReply,
    UnknownParameter,
    UsageError,
)
from paramclient.model.px4_hash import hash_params
from paramclient.model.values import Encoding, Param, ParamType, Trust, WireValue
from paramclient.protocol.events import (
    Change,
    ComponentIdentified,
    Event,
    EventMaker,
    Fetched,
    ParamChanged,
)
from paramclient.sim import GenericVehicle, PX4Vehicle, Vehicle
from paramclient.wire.messages import (
    HASH_CHECK,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    NO_INDEX,
    AutopilotVersion,
    CommandLong,
    Heartbeat,
    Message,
    ParamError,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    StatusText,
)
from tests.simulation import Simulation, is_so, known, listed, param_value

OWN = (255, 190)
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
ARDUPILOT = Heartbeat(2, MAV_AUTOPILOT_ARDUPILOTMEGA)
SOMETHING = Heartbeat(2, 0)


class Desk:
    """The component 1/1 with all that it sends and its events."""

    def __init__(self, heartbeat: Heartbeat | None = PX4, *, encoding: Encoding | None = None) -> None:
        self.now = 0.0
        self.sent: list[Message] = []
        self.events: list[Event] = []
        self.machine = ComponentMachine(
            1,
            1,
            own_address=OWN,
            link="x",
            send=self.sent.append,
            observer=EventMaker(self.events.append),
            encoding=encoding,
        )
        self.machine.reads.is_idle = False
        if heartbeat is not None:
            self.receive(heartbeat)
            self.receive(AutopilotVersion(0, uid=7))
        self.take()

    def receive(self, message: Message, *, at: float | None = None) -> None:
        self.now = self.now if at is None else at
        self.machine.receive(message, self.now)

    def hear(
        self,
        name: str,
        value: WireValue = 0.0,
        kind: int = ParamType.REAL32,
        *,
        index: int = NO_INDEX,
        count: int = 3,
    ) -> None:
        encoding = self.machine.table.encoding
        self.receive(param_value(name, value, index=index, count=count, kind=kind, encoding=encoding))

    def hash(self, value: int, *, count: int = 3) -> None:
        self.receive(ParamValue(HASH_CHECK, value.to_bytes(4, "little"), ParamType.UINT32, count, NO_INDEX))

    def send_list(self, *names: str, count: int = 3) -> None:
        for index, name in enumerate(names):
            self.hear(name, float(index), index=index, count=count)

    def cached(self, *params: Param, **more: object) -> None:
        arguments: dict[str, object] = {
            "count": len(params),
            "confirmed": None,
            "complete": True,
            "volatile": frozenset(),
            "volatile_known": False,
        }
        self.machine.use_cached({each.name: each for each in params}, self.now, **{**arguments, **more})  # type: ignore[arg-type]  # as it says

    def pass_time(self, seconds: float = math.inf) -> None:
        end = self.now + seconds
        for _ in range(10_000):
            deadline = self.machine.next_deadline()
            if deadline > end or deadline == math.inf:
                self.now = end if end < math.inf else self.now
                return
            self.now = max(deadline, self.now)
            self.machine.tick(self.now)
        raise AssertionError("it does not end")

    def take(self) -> list[Message]:
        sent, self.sent[:] = list(self.sent), []
        return sent

    def reads(self) -> list[str]:
        return [
            each.param_id or str(each.param_index)
            for each in self.take()
            if isinstance(each, ParamRequestRead)
        ]

    @property
    def changes(self) -> list[Change]:
        return [event.change for event in self.events if isinstance(event, ParamChanged)]


def fetched(desk: Desk, *, announce: bool = True) -> None:
    """Let a table of three be fetched, under its hash."""
    fetch = desk.machine.begin_fetch(desk.now)
    if announce:
        desk.hash(hash_params([known(name, float(at), index=at) for at, name in enumerate("ABC")]))
    desk.send_list("A", "B", "C")
    desk.machine.end_fetch(fetch, desk.now)
    desk.take()


# values


def test_a_value_goes_into_the_table_and_is_reported() -> None:
    desk = Desk()
    desk.hear("A", 1.5, index=2)
    assert desk.machine.table.params["A"].value == 1.5
    assert desk.machine.table.count == 3
    assert [(change.name, change.by) for change in desk.changes] == [("A", "vehicle")]
    desk.hear("A", 1.5, index=2)
    assert len(desk.changes) == 1


def test_a_table_that_is_full_takes_no_more_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_room, "NAMES_MAX", 1)
    desk = Desk()
    desk.hear("A")
    write = desk.machine.write("B", 1.0, desk.now)
    desk.hear("B", 5.0)
    assert not write.done
    desk.pass_time()
    assert isinstance(write.error, NoReply | UnknownParameter)


@pytest.mark.parametrize("index", [NO_INDEX, 32767])
def test_a_hash_is_no_parameter(index: int) -> None:
    desk = Desk()
    desk.receive(ParamValue(HASH_CHECK, b"\x01\x02\x03\x04", ParamType.UINT32, 3, index), at=2.0)
    assert desk.machine.table.params == {}
    announced = desk.machine.sync.announced
    assert announced is not None
    assert (announced.hash, announced.count, announced.at) == (0x04030201, 3, 2.0)


def test_values_are_read_again_when_the_encoding_becomes_known() -> None:
    desk = Desk(None)
    desk.receive(param_value("A", 1234.0, kind=ParamType.INT32, encoding=Encoding.C_CAST))
    assert desk.machine.table.params["A"].value == 0x449A4000
    desk.receive(ARDUPILOT)
    assert desk.machine.table.params["A"].value == 1234
    assert desk.changes[-1].new == desk.machine.table.params["A"]


def test_a_chosen_encoding_overrides_the_detected_one() -> None:
    desk = Desk(ARDUPILOT, encoding=Encoding.BYTEWISE)
    desk.hear("A", 5, ParamType.INT32)
    assert desk.machine.table.params["A"].value == 5
    assert desk.machine.identification.encoding_reason == "chosen by the user"


def test_ardupilot_answers_in_the_requested_spelling() -> None:
    desk = Desk(ARDUPILOT)
    read = desk.machine.read("wpnav_speed", desk.now)
    assert desk.reads() == ["WPNAV_SPEED"]
    desk.hear("Wpnav_Speed", 500.0)
    assert read.done
    assert list(desk.machine.table.params) == ["WPNAV_SPEED"]
    write = desk.machine.write("wpnav_speed", 400.0, desk.now)
    assert [each.param_id for each in desk.take() if isinstance(each, ParamSet)] == ["WPNAV_SPEED"]
    desk.hear("wpnav_speed", 400.0)
    assert write.done


def types_of(desk: Desk) -> dict[str, ParamType | int]:
    return {name: param.type for name, param in desk.machine.table.params.items()}


def test_ardupilots_answer_to_a_set_does_not_change_an_integers_type() -> None:
    """It says REAL32 if the set changes nothing and the value was never stored."""
    desk = Desk(ARDUPILOT)
    desk.hear("A", 3, ParamType.INT8, index=0)
    desk.hear("B", 7, ParamType.INT32, index=1)
    write = desk.machine.write("A", 3, desk.now)
    desk.take()
    before = len(desk.changes)
    desk.hear("A", 3.0)
    assert write.result is not None
    assert (write.result.param.value, write.result.param.type) == (3, ParamType.INT8)
    desk.hear("B", 7.0)  # another station's set
    assert types_of(desk) == {"A": ParamType.INT8, "B": ParamType.INT32}
    assert len(desk.changes) == before
    desk.hear("B", 8.0)
    assert [change.new for change in desk.changes[before:]] == [known("B", 8, index=1).with_trust(Trust.LIVE)]


def test_other_autopilots_mean_the_type_that_they_say() -> None:
    desk = Desk(SOMETHING)
    desk.hear("A", 3, ParamType.INT8, index=0)
    desk.hear("A", 3.0)
    assert types_of(desk) == {"A": ParamType.REAL32}


def test_a_changed_count_marks_the_table_unsynced() -> None:
    desk = Desk()
    fetched(desk)
    assert is_so(desk.machine.sync.synced)
    desk.hear("A", 0.0, index=0, count=NO_INDEX)
    assert is_so(desk.machine.sync.synced)
    desk.hear("A", 0.0, index=0, count=4)
    assert not desk.machine.sync.synced
    assert not desk.machine.can_hit
    assert desk.machine.table.count == 4


def test_a_value_that_changes_twice_quickly_is_read_again() -> None:
    desk = Desk(ARDUPILOT)
    desk.hear("A", 1.0)
    desk.now += 2 * DOUBT_TIME
    desk.hear("A", 2.0)
    desk.now += AMBIGUITY_WINDOW
    desk.hear("A", 1.0)  # an answer from before the change, it may be
    desk.hear("B", 1.0)
    assert desk.reads() == []
    desk.pass_time(DOUBT_TIME / 2 + 0.05)
    assert desk.reads() == ["A"]
    desk.hear("A", 2.0)
    desk.pass_time(DOUBT_TIME / 2 + 0.05)
    assert desk.reads() == ["A"]
    desk.hear("A", 2.0)
    desk.pass_time(3 * DOUBT_TIME)
    assert desk.reads() == []
    assert len(desk.machine.reads) == 0


# who did it


def test_a_change_by_our_own_write() -> None:
    desk = Desk()
    desk.hear("A", 1.0)
    desk.machine.write("A", 2.0, desk.now)
    desk.hear("A", 2.0)
    assert [change.by for change in desk.changes] == ["vehicle", "us"]


def test_a_change_by_another_station() -> None:
    desk = Desk(ARDUPILOT)
    desk.hear("A", 1.0)
    desk.machine.foreign_set("a", struct.pack("<f", 2.0), "station 254/190", desk.now)
    desk.hear("A", 2.0)
    desk.hear("B", 2.0)
    assert [change.by for change in desk.changes] == ["vehicle", "station 254/190", "vehicle"]
    desk.now += FOREIGN_SET_MEMORY + 0.1
    desk.hear("A", 3.0)
    assert desk.changes[-1].by == "vehicle"


# refusals


@pytest.mark.parametrize("target", [OWN, (0, 0)])
def test_a_refusal_for_us(target: tuple[int, int]) -> None:
    desk = Desk()
    read = desk.machine.read("A", desk.now)
    desk.receive(ParamError(*target, "A", -1, 1))
    assert isinstance(read.error, UnknownParameter)


@pytest.mark.parametrize("target", [(254, 190), (255, 191), (255, 0), (0, 190)])
def test_a_refusal_for_another_station(target: tuple[int, int]) -> None:
    desk = Desk()
    desk.hear("A", 1.0)
    read, write = desk.machine.read("B", desk.now), desk.machine.write("A", 2.0, desk.now)
    desk.receive(ParamError(*target, "A", -1, 5))
    desk.receive(ParamError(*target, "B", -1, 1))
    assert not read.done
    assert not write.done


@pytest.mark.parametrize(
    ("text", "is_refusal"),
    [
        ("Param write denied (A)", True),
        ("ArduCopter: Param write denied (A)", True),
        ("Param write denied (B)", False),
        ("Param write allowed (A)", False),
    ],
)
def test_ardupilots_text(text: str, is_refusal: bool) -> None:
    desk = Desk(ARDUPILOT)
    desk.hear("A", 1.0)
    write = desk.machine.write("A", 2.0, desk.now)
    desk.receive(StatusText(4, text))
    assert write.done is is_refusal


# writes and what they need


def test_a_value_that_does_not_fit_is_refused_before_anything_is_sent() -> None:
    desk = Desk()
    desk.hear("A", 3, ParamType.UINT8)
    for value in (300, 1.5, math.nan):
        with pytest.raises(UsageError):
            desk.machine.write("A", value, desk.now)
    assert desk.take() == []
    assert len(desk.machine.writes) == 0


def test_before_it_is_certain_how_values_are_written_nothing_is_judged_or_sent() -> None:
    desk = Desk(None)
    desk.receive(param_value("A", 5.0, kind=ParamType.INT32, encoding=Encoding.C_CAST))
    write = desk.machine.write("A", 1234.7, desk.now)
    assert not any(isinstance(each, ParamSet) for each in desk.take())
    desk.receive(ARDUPILOT)
    [message] = [each for each in desk.take() if isinstance(each, ParamSet)]
    assert message.raw == param_value("A", 1234.7).raw
    desk.hear("A", 1234, ParamType.INT32)
    assert write.result is not None
    assert write.result.status == "adjusted"


# hashes


def test_after_our_write_the_hash_is_requested_once_things_have_settled() -> None:
    desk = Desk()
    fetched(desk)
    desk.machine.write("A", 7.0, desk.now)
    desk.hear("A", 7.0, index=0)
    assert is_so(desk.machine.is_settling)
    desk.pass_time(0.05)
    assert HASH_CHECK not in desk.reads()
    desk.pass_time(0.02)
    assert desk.reads() == [HASH_CHECK]
    assert is_so(desk.machine.is_settling)
    expected = desk.machine.table.hash
    assert expected is not None
    desk.hash(expected)
    assert not desk.machine.is_settling
    assert desk.machine.sync.synced


def test_no_hash_is_requested_from_a_vehicle_without_one() -> None:
    for heartbeat in (ARDUPILOT, SOMETHING):
        desk = Desk(heartbeat)
        desk.hear("A", 1.0)
        desk.machine.write("A", 2.0, desk.now)
        desk.hear("A", 2.0)
        desk.pass_time(1.0)
        assert HASH_CHECK not in desk.reads()


# the cache


def test_values_received_before_the_cache_was_read_are_kept() -> None:
    desk = Desk()
    desk.hear("A", 9, ParamType.INT32, index=0, count=2)
    params = [known("A", 1, index=0), known("B", 2, index=1)]
    desk.cached(*params, confirmed=hash_params(params), volatile_known=True)
    table = desk.machine.table
    assert (table.params["A"].value, table.params["B"].value) == (9, 2)
    assert table.hash == hash_params(listed(table)) != hash_params(params)


# its state


def test_the_states_of_a_table() -> None:
    desk = Desk()
    assert desk.machine.state == "new"
    assert repr(desk.machine) == "<ComponentMachine 1/1 px4 new>"
    desk.hear("X")
    assert desk.machine.state == "partial"
    fetch = desk.machine.begin_fetch(desk.now)
    assert desk.machine.state == "fetching"
    desk.hash(5)
    desk.send_list("A", "B", "C")
    desk.hash(5)
    assert fetch.done
    assert desk.machine.state == "synced"
    assert any(isinstance(event, Fetched) for event in desk.events)
    assert repr(Desk(None).machine) == "<ComponentMachine 1/1 unknown new>"


# identity


def test_another_vehicle_in_the_same_place() -> None:
    desk = Desk()
    fetched(desk)
    desk.machine.table.volatile = frozenset("C")
    desk.events.clear()
    write = desk.machine.write("A", 5.0, desk.now)
    desk.now += 60.0
    desk.receive(PX4)
    assert any(isinstance(each, CommandLong) for each in desk.take())
    desk.receive(AutopilotVersion(0, uid=8))
    table = desk.machine.table
    assert table.params == {}
    assert (table.count, table.complete, table.hash, table.volatile) == (None, False, None, frozenset())
    assert not table.volatile_known
    assert desk.machine.sync.announced is None
    assert not desk.machine.sync.synced
    assert isinstance(write.error, NoReply)
    assert "another vehicle" in str(write.error)
    assert [change.name for change in desk.changes] == ["A", "B", "C"]
    assert all(change.new is None for change in desk.changes)
    assert desk.events[-1] == ComponentIdentified(desk.machine)


def test_another_vehicle_during_a_fetch_begins_it_anew() -> None:
    desk = Desk()
    fetch = desk.machine.begin_fetch(desk.now)
    desk.hear("A", index=0)
    desk.take()
    desk.now += 6.0
    desk.receive(PX4)
    desk.receive(AutopilotVersion(0, uid=8))
    assert any(isinstance(each, ParamRequestList) for each in desk.take())
    desk.hash(5)
    desk.send_list("X", "Y", "Z")
    desk.hash(5)
    assert fetch.result is not None
    assert list(fetch.result.params) == ["X", "Y", "Z"]


@pytest.mark.parametrize("make", [PX4Vehicle, GenericVehicle])
def test_a_vehicle_that_takes_the_place_of_another_at_once_is_distinguished_by_its_table(
    make: Callable[..., Vehicle],
) -> None:
    first, second = make(uid=1, table={"A": 1, "B": 2}), make(uid=2, table={"A": 3, "C": 4})
    second.reboot(0.0, down=math.inf)
    world = Simulation(first, second)
    world.fetch()
    world.run(2.0)
    first.reboot(world.now, down=math.inf)
    second.reboot(world.now, down=0.0)
    result = world.fetch()
    world.until(lambda: world.machine.identity.uid == f"{2:016x}")
    if result.params.keys() != {"A", "C"}:  # the answer arrived after the end
        result = world.fetch()
    assert {name: param.value for name, param in result.params.items()} == {"A": 3, "C": 4}


# the link


def test_when_the_link_is_gone_everything_ends_and_nothing_is_left() -> None:
    desk = Desk()
    fetched(desk)
    desk.hear("V", 1.0)
    error = LinkError("gone", link="x")
    read, write = desk.machine.read("Q", desk.now), desk.machine.write("A", 5.0, desk.now)
    fetch = desk.machine.begin_fetch(desk.now, refresh=True)
    desk.machine.sync.ask(desk.now)
    desk.hear("A", 9.0, index=0)
    desk.hear("B", 9.0, index=1)
    desk.hear("B", 8.0, index=1)  # in doubt
    desk.machine.fail_all(error, desk.now)
    assert read.error is error
    assert write.error is error
    assert fetch.error is error
    assert len(desk.machine.reads) == len(desk.machine.writes) == 0
    assert desk.machine.fetch is None
    assert desk.machine.next_deadline() == desk.machine.presence.lost_at(), "that is all there is left to see"


def test_a_dead_vehicle_is_given_up_by_all_that_waits() -> None:
    desk = Desk()
    desk.hear("A", 1.0)
    read, write = desk.machine.read("B", desk.now), desk.machine.write("A", 2.0, desk.now)
    desk.pass_time(60.0)
    assert isinstance(read.error, NoReply)
    assert isinstance(write.error, NoReply)


# with ArduPilot: answers that were made before a change
