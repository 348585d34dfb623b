"""Reads, one message at a time: what is requested when, which request gets the response, and when they time
out."""

from __future__ import annotations

import math

import pytest
from paramclient.protocol.params.reads import CONTROL_INDEX, Key, Read, Reads
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.pacing import BURST_MIN, FIRST_RATE
from paramclient.protocol.requests.retry import (
    ATTEMPTS_MAX,
    CONTROLS_CERTAIN,
    FIRST_TIMEOUT,
    SILENCE_MAX,
    RetryPolicy,
)

from paramclient.errors import (
    LinkError,
    NoReply,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
)
from paramclient.sim import Air, ArduPilotVehicle
from paramclient.wire.messages import Message, ParamError, ParamRequestRead, ParamValue
from tests.simulation import Simulation, param_value

BURST = int(BURST_MIN)


class Desk:
    """Reads of component 1/1, with everything they send; `known` are the names that are known."""

    def __init__(self, *known: str, count: int = 100) -> None:
        self.now = 0.0
        self.retry = RetryPolicy()
        self.round_trip = self.retry.round_trip
        self.sent: list[Key] = []
        self.params = set(known)
        self.count = count
        self.live_count: int | None = None
        self.reads = Reads(Context((1, 1), self._send, retry=self.retry), self)

    def _send(self, message: Message) -> None:
        assert isinstance(message, ParamRequestRead)
        assert (message.target_system, message.target_component) == (1, 1)
        assert (message.param_id == "") == (message.param_index >= 0)
        self.sent.append(message.param_id if message.param_index < 0 else message.param_index)

    def ask(self, key: Key, *, urgent: bool = True) -> Read:
        return self.reads.ask(key, self.now, urgent=urgent)

    def hear(self, name: str, *, index: int = 65535) -> ParamValue:
        message = param_value(name, index=index)
        self.reads.receive(message, self.now)
        return message

    def refuse(self, name: str = "", index: int = -1, code: int = 1) -> None:
        self.reads.refused(ParamError(255, 190, name, index, code), self.now)

    def take(self) -> list[Key]:
        sent, self.sent = self.sent, []
        return sent

    def pass_time(self, seconds: float = math.inf) -> None:
        """Go from deadline to deadline, so long or until nothing is left to do."""
        end = self.now + seconds
        for _ in range(100_000):
            deadline = self.reads.next_deadline()
            if deadline > end or deadline == math.inf:
                self.now = max(self.now, min(end, deadline)) if end < math.inf else self.now
                return
            self.now = max(deadline, self.now)
            self.reads.tick(self.now)
        raise AssertionError("it does not end")

    def measure(self, round_trip: float = 0.02, answers: int = 60) -> None:
        """Let the link be known as a good one."""
        for _ in range(answers):
            self.retry.answered(self.now, self.now + round_trip, 1)


def test_a_read_by_name_and_its_answer() -> None:
    desk = Desk()
    read = desk.ask("A")
    assert desk.take() == ["A"]
    desk.now = 0.3
    message = desk.hear("A")
    assert read.done
    assert read.result is message
    assert read.ended_at == 0.3
    assert desk.round_trip.smoothed == pytest.approx(0.3)
    assert len(desk.reads) == 0
    assert desk.reads.next_deadline() == math.inf


def test_a_read_by_index_is_answered_by_its_index_alone() -> None:
    desk = Desk()
    read = desk.ask(7)
    assert desk.take() == [7]
    desk.hear("A", index=8)
    desk.hear("7")
    assert 7 in desk.reads
    desk.hear("B", index=7)
    assert read.done
    assert read.result is not None
    assert read.result.param_id == "B"


def test_one_value_may_answer_two_reads() -> None:
    desk = Desk()
    by_name, by_index = desk.ask("A"), desk.ask(3)
    desk.hear("A", index=3)
    assert by_name.done
    assert by_index.done


def test_equal_reads_share_one_request() -> None:
    desk = Desk()
    first, second = desk.ask("A"), desk.ask("A")
    assert first is second
    assert desk.take() == ["A"]
    desk.reads.release(first)
    assert "A" in desk.reads
    desk.reads.release(second)
    assert "A" not in desk.reads
    desk.hear("A")
    assert not first.done


def test_no_more_go_out_at_once_than_a_vehicle_can_queue() -> None:
    desk = Desk()
    for index in range(50):
        desk.ask(index)
    assert desk.take() == list(range(BURST))
    desk.pass_time(5 / FIRST_RATE + 1e-3)
    assert desk.take() == list(range(BURST, BURST + 5))


def test_a_lost_request_is_sent_again_after_the_time_out() -> None:
    desk = Desk("A")
    desk.reads.is_idle = False
    desk.ask("A")
    assert desk.reads.next_deadline() == FIRST_TIMEOUT
    desk.pass_time(FIRST_TIMEOUT)
    assert desk.take() == ["A", "A"]
    desk.hear("A")
    assert desk.round_trip.smoothed is None  # it may be the answer to either


def test_silence_on_something_known_ends_with_no_reply() -> None:
    desk = Desk("A")
    desk.reads.is_idle = False
    read = desk.ask("A")
    desk.pass_time()
    assert isinstance(read.error, NoReply)
    assert read.error.attempts == read.attempts == desk.sent.count("A") <= ATTEMPTS_MAX
    assert read.error.waited == pytest.approx(desk.now)
    assert "A of 1/1" in str(read.error)
    assert len(desk.reads) == 0


def answering_desk(*known: str, count: int = 100) -> Desk:
    """A desk where index 0, and nothing else, is answered at once."""
    desk = Desk(*known, count=count)
    original = desk.reads._send

    def send(message: Message) -> None:
        original(message)
        if isinstance(message, ParamRequestRead) and message.param_index == CONTROL_INDEX:
            controls.append(desk.now)

    controls: list[float] = []
    desk.reads._send = send
    desk.measure()
    tick = desk.reads.tick

    def tick_and_answer(now: float) -> None:
        tick(now)
        while controls:
            controls.pop()
            desk.hear("ZERO", index=CONTROL_INDEX)

    desk.reads.tick = tick_and_answer  # type: ignore[method-assign]  # the vehicle's part in it
    return desk


@pytest.mark.parametrize("key", ["NOWHERE", 100])
def test_a_vehicle_that_answers_all_else_does_not_have_it(key: Key) -> None:
    desk = answering_desk()
    read = desk.ask(key)
    desk.pass_time()
    assert isinstance(read.error, UnknownParameter)
    assert (read.error.name, read.error.index) == ((key, None) if isinstance(key, str) else (None, key))
    assert read.request.controls >= CONTROLS_CERTAIN
    assert read.attempts < desk.retry.tries
    assert desk.now < 3.0
    assert desk.take().count(CONTROL_INDEX) >= CONTROLS_CERTAIN


@pytest.mark.parametrize("key", ["A", 99])
def test_of_what_is_known_silence_is_silence(key: Key) -> None:
    desk = answering_desk("A")
    read = desk.ask(key)
    desk.pass_time()
    assert isinstance(read.error, NoReply)
    assert desk.sent.count(CONTROL_INDEX) > 0


def test_a_component_that_is_gone_is_given_up_sooner() -> None:
    patient, gone = Desk("A"), Desk("A")
    gone.round_trip.received_at = 0.0
    for desk in (patient, gone):
        read = desk.ask("A")
        desk.pass_time()
        assert isinstance(read.error, NoReply)
    assert SILENCE_MAX <= gone.now < SILENCE_MAX + 5.0
    assert gone.now < patient.now


# refusals


def test_a_refusal_by_name() -> None:
    desk = Desk()
    read = desk.ask("A")
    desk.refuse("B")
    desk.refuse("A", index=5)
    assert not read.done
    desk.refuse("A")
    assert isinstance(read.error, UnknownParameter)
    assert (read.error.system, read.error.component, read.error.name) == (1, 1, "A")


@pytest.mark.parametrize("name", ["", "SOMETHING"])
def test_a_refusal_by_index(name: str) -> None:
    desk = Desk()
    read = desk.ask(700)
    desk.refuse(name, index=700)
    assert isinstance(read.error, UnknownParameter)
    assert read.error.index == 700
    assert read.error.name is None
    assert "700" in str(read.error)


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (ParamErrorCode.DOES_NOT_EXIST, UnknownParameter),
        (ParamErrorCode.TYPE_MISMATCH, TypeMismatch),
        (ParamErrorCode.READ_FAIL, Refused),
        (77, Refused),
    ],
)
def test_the_reason_of_a_refusal(code: int, kind: type[Exception]) -> None:
    desk = Desk()
    read = desk.ask("A")
    desk.refuse("A", code=code)
    assert type(read.error) is kind
    if isinstance(read.error, Refused):
        assert read.error.code == code
        assert read.error.reason == ("read fail" if code == 8 else "error code 77")


# the link is lost and reconnected


def test_when_the_link_is_back_what_was_in_flight_is_requested_again() -> None:
    desk = Desk("A")
    reads = [desk.ask(index) for index in range(BURST + 3)]
    desk.pass_time(1.02)
    desk.take()
    attempts = [read.attempts for read in reads]
    desk.now = 20.0
    desk.reads.resume(20.0)
    sent = desk.take()
    assert len(sent) == BURST  # at the pace of any other time
    desk.pass_time(0.2)
    assert set(sent + desk.take()) >= set(range(BURST + 3))
    assert [read.attempts for read in reads] == attempts


def test_when_the_link_is_gone_all_fail() -> None:
    desk = Desk()
    reads = [desk.ask(index) for index in range(3 * BURST)]
    error = LinkError("gone", link="x")
    desk.reads.fail_all(error, 1.0)
    assert all(read.error is error for read in reads)
    assert len(desk.reads) == 0


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.05, 0.3], ids=lambda delay: f"{2 * delay:g}s")
def test_on_a_clean_link_each_parameter_of_ardupilot_is_requested_once(delay: float) -> None:
    vehicle = ArduPilotVehicle()
    session = Simulation(vehicle, air=Air.symmetric([vehicle], delay=delay))
    machine = session.meet()
    session.run(1.0)
    session.sent.clear()
    began = session.now
    reads = [machine.read(10 * number, session.now) for number in range(120)]
    session.until(lambda: all(read.done for read in reads))
    assert len(session.sent_of(ParamRequestRead)) == 120
    assert all(read.error is None for read in reads)
    assert session.now - began < 2.5 + 2 * delay  # 5 in each 100 ms


def test_sequential_reads_are_as_fast_as_the_vehicle() -> None:
    desk = Desk()
    for number in range(100):
        desk.ask(f"P{number}")
        assert desk.take() == [f"P{number}"]
        desk.now += 0.0003
        desk.hear(f"P{number}")
    assert desk.now < 0.2
    others = [desk.ask(f"Q{number}") for number in range(20)]
    assert len(desk.take()) == 1, "those that wait for no answer keep to the pace"
    desk.pass_time(1.0)
    assert len([each for each in others if each.attempts]) == 20


def test_an_index_beyond_the_count_of_the_cache_may_exist() -> None:
    """The vehicle may have more parameters by now: a dead link does not show it."""
    desk = Desk(count=5)
    read = desk.ask(7)
    desk.pass_time(120.0)
    assert isinstance(read.error, NoReply)
    desk.live_count = 5
    read = desk.ask(7)
    desk.pass_time(120.0)
    assert isinstance(read.error, UnknownParameter)


# the time of a response
