"""Reads, one message at a time: what is requested when, which request gets the response, and when they time
out."""

from __future__ import annotations

import math

import pytest

from paramclient.errors import (
    LinkError,
    NoReply,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
)
from paramclient.protocol.params.reads import CONTROL_INDEX, NAMES_GIVEN_UP_MAX, Key, Read, Reads
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.pacing import BURST_MIN, FIRST_RATE
from paramclient.protocol.requests.retry import (
    ATTEMPTS_MAX,
    ATTEMPTS_MIN,
    CONTROLS_CERTAIN,
    FIRST_TIMEOUT,
    INITIAL_TIMEOUT,
    READ_COPIES_MAX,
    SILENCE_MAX,
    RetryPolicy,
)
from paramclient.protocol.wire import Message, ParamError, ParamRequestRead, ParamValue
from paramclient.sim import Air, ArduPilotVehicle
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


def test_a_read_that_is_requested_anew_while_its_answer_is_handed_out_waits_for_another() -> None:
    desk = Desk()
    again: list[Read] = []
    desk.ask("A").on_done.append(lambda: again.extend((desk.ask("A"), desk.ask(3))))
    desk.now = 0.1
    desk.hear("A", index=3)
    assert [read.key for read in again] == ["A", 3]
    assert not any(read.done for read in again)
    assert desk.round_trip.smoothed == pytest.approx(0.1)
    desk.hear("A", index=3)
    assert all(read.done for read in again)


def test_a_released_read_is_not_sent_when_the_pace_allows_it() -> None:
    desk = Desk()
    first, second = desk.ask("A"), desk.ask(3)
    first.on_done.append(lambda: desk.reads.release(second))
    desk.hear("A", index=3)
    assert first.done
    assert not second.done
    assert len(desk.reads) == 0


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


def test_releasing_what_has_ended_does_nothing_to_a_later_one() -> None:
    desk = Desk()
    first = desk.ask("A")
    desk.hear("A")
    second = desk.ask("A")
    desk.reads.release(first)
    assert "A" in desk.reads
    desk.hear("A")
    assert second.done


def test_no_more_go_out_at_once_than_a_vehicle_can_queue() -> None:
    desk = Desk()
    for index in range(50):
        desk.ask(index)
    assert desk.take() == list(range(BURST))
    desk.pass_time(5 / FIRST_RATE + 1e-3)
    assert desk.take() == list(range(BURST, BURST + 5))


def test_the_urgent_ones_go_first() -> None:
    desk = Desk()
    for index in range(30):
        desk.ask(index, urgent=False)
    desk.take()
    desk.ask("A")
    desk.ask("B")
    desk.pass_time(3 / FIRST_RATE + 1e-3)
    assert desk.take() == ["A", "B", BURST]


def test_a_read_of_a_fetch_becomes_urgent_when_a_caller_joins() -> None:
    desk = Desk()
    for index in range(30):
        desk.ask(index, urgent=False)
    desk.take()
    assert desk.ask(25) is desk.ask(25, urgent=False)
    desk.pass_time(2 / FIRST_RATE + 1e-3)
    assert desk.take() == [25, BURST]


def test_a_read_released_while_it_waits_is_not_sent() -> None:
    desk = Desk()
    reads = [desk.ask(index) for index in range(BURST + 5)]
    for read in reads[:-1]:
        desk.reads.release(read)
    desk.take()
    desk.pass_time(FIRST_TIMEOUT - 0.01)
    assert desk.take() == [BURST + 4]


def test_asking_and_releasing_leaves_nothing_behind() -> None:
    desk = Desk()
    for number in range(1000):
        desk.reads.release(desk.ask(f"N{number}", urgent=bool(number % 2)))
    assert len(desk.reads) == 0
    desk.pass_time(30.0)
    assert desk.reads.next_deadline() == math.inf
    desk.take()
    desk.ask("A")
    assert desk.take() == ["A"]


def test_a_lost_request_is_sent_again_after_the_time_out() -> None:
    desk = Desk("A")
    desk.reads.is_idle = False
    desk.ask("A")
    assert desk.reads.next_deadline() == FIRST_TIMEOUT
    desk.pass_time(FIRST_TIMEOUT)
    assert desk.take() == ["A", "A"]
    desk.hear("A")
    assert desk.round_trip.smoothed is None  # it may be the answer to either


def test_a_response_before_the_second_request_is_no_sample() -> None:
    desk = Desk("A")
    desk.reads.is_idle = False
    for index in range(1, BURST + 1):
        desk.ask(index)
    desk.ask("A")
    desk.pass_time(FIRST_TIMEOUT + 0.05)
    assert desk.sent.count(1) == 2
    desk.hear("X", index=10)  # timed out, and is repeated now or later
    assert desk.round_trip.smoothed is None


def test_a_refusal_that_is_late_does_not_spoil_the_round_trip() -> None:
    desk = Desk()
    reads = [desk.ask(index) for index in range(BURST * 3)]
    desk.pass_time(0.5)
    desk.measure(0.2)
    desk.pass_time(0.7)  # now many wait for another turn
    before = desk.round_trip.smoothed
    for index in range(BURST * 3):
        desk.refuse(index=index)
    assert all(isinstance(read.error, UnknownParameter) for read in reads)
    assert desk.round_trip.smoothed is not None
    assert before is not None
    assert 0.0 < desk.round_trip.smoothed < 1.0


def test_on_an_idle_link_that_loses_a_request_is_doubled() -> None:
    desk = Desk("A")
    desk.measure(0.5)
    for _ in range(30):
        desk.retry.timed_out(1)
    desk.ask("A")
    assert desk.take() == ["A"]
    desk.reads.tick(desk.now)  # when everything needed at this moment is requested
    assert 1 <= desk.take().count("A") <= READ_COPIES_MAX
    assert len(desk.reads) == 1


def test_to_a_vehicle_that_is_silent_throughout_nothing_is_doubled_any_more() -> None:
    desk = Desk()
    desk.measure(0.1)
    for index in range(1, 40):
        desk.ask(index, urgent=False)
    desk.pass_time(5.0)
    attempts = sum(read.attempts for read in desk.reads._open.values())
    desk.take()
    desk.pass_time(5.0)
    more = sum(read.attempts for read in desk.reads._open.values()) - attempts
    assert more > 20
    assert len([each for each in desk.take() if each != CONTROL_INDEX]) == more


def test_while_a_list_arrives_nothing_is_doubled() -> None:
    desk = Desk("A")
    desk.measure(0.5)
    for _ in range(30):
        desk.retry.timed_out(1)
    desk.reads.is_idle = False
    desk.ask("A")
    assert desk.take() == ["A"]


def test_the_answer_to_a_list_is_no_sample() -> None:
    desk = Desk()
    desk.reads.list_runs_again = True
    desk.ask(1)
    desk.ask("B")
    desk.now = 0.3
    desk.hear("A", index=1)
    assert desk.round_trip.smoothed is None
    assert desk.reads.answered_at == 0.3
    desk.hear("B")
    assert desk.round_trip.smoothed == pytest.approx(0.3)
    # nor is its silence a loss
    desk.ask(2)
    before = desk.round_trip.seen_loss
    desk.pass_time(0.7)
    assert desk.round_trip.seen_loss == before


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


def test_where_much_is_silent_the_control_reads_measure_the_loss() -> None:
    desk = Desk()
    desk.measure()
    for _ in range(60):  # other reads in vain have made the link look bad
        for _ in range(3):
            desk.retry.timed_out(1)
        desk.retry.answered(desk.now, desk.now + 0.02, 1)
    assert desk.retry.tries > 30
    read = desk.ask(7)
    for _ in range(100):
        desk.pass_time(0.05)
        if CONTROL_INDEX in desk.take():
            desk.hear("P0", index=CONTROL_INDEX)
    assert read.done
    assert 9 < read.attempts < 15  # five answered controls of five are no proof of a link that loses nothing


def test_a_value_that_a_list_may_have_sent_answers_no_control_read() -> None:
    desk = Desk()
    desk.measure()
    desk.reads.list_runs_again = True
    read = desk.ask(7)
    for _ in range(10):
        desk.pass_time(0.05)
        desk.hear("P0", index=CONTROL_INDEX)
    assert read.request.controls == 0


def test_without_answered_controls_nothing_is_called_unknown() -> None:
    desk = Desk()
    read = desk.ask("NOWHERE")
    desk.pass_time()
    assert isinstance(read.error, NoReply)
    assert desk.sent.count(CONTROL_INDEX) > 1  # requested again as well


def test_a_control_that_was_lost_is_not_answered_by_what_passes_by_much_later() -> None:
    desk = Desk()
    desk.reads.is_idle = False
    read = desk.ask("A")
    desk.pass_time(FIRST_TIMEOUT + 0.1)
    assert desk.take() == ["A", "A", CONTROL_INDEX]
    desk.hear("A")
    assert read.done
    desk.now = 300.0
    desk.hear("ZERO", index=CONTROL_INDEX)
    assert desk.retry.timeout == INITIAL_TIMEOUT


@pytest.mark.parametrize(("count", "control"), [(20, 7), (5, CONTROL_INDEX)])
def test_the_index_received_last_is_the_control_as_long_as_there_is_one(count: int, control: int) -> None:
    desk = Desk(count=count)
    desk.reads.is_idle = False
    desk.ask("B", urgent=True)
    desk.hear("B", index=7)
    desk.hear("PUSHED")
    read = desk.ask("A")
    desk.measure()
    desk.take()
    while read.attempts < 8 and not read.done:
        desk.now = desk.reads.next_deadline()
        desk.reads.tick(desk.now)
    assert {key for key in desk.take() if key != "A"} == {control}


def test_index_0_has_the_index_received_last_as_its_control() -> None:
    desk = Desk()
    desk.reads.is_idle = False
    desk.hear("B", index=7)
    desk.measure()
    read = desk.ask(CONTROL_INDEX)
    while not read.done:
        desk.now = desk.reads.next_deadline()
        desk.reads.tick(desk.now)
        if desk.take()[-1:] == [7]:
            desk.hear("B", index=7)
    assert read.request.controls >= CONTROLS_CERTAIN
    assert isinstance(read.error, NoReply)
    assert desk.now < 5.0


def test_answered_controls_end_what_stays_silent_soon() -> None:
    """Many silent indices look like a link that loses half; the other requests show that it does not."""
    desk = answering_desk()
    silent = [desk.ask(index) for index in range(20, 50)]
    desk.pass_time()
    assert all(isinstance(read.error, NoReply) for read in silent)
    assert ATTEMPTS_MIN <= max(read.attempts for read in silent) <= ATTEMPTS_MIN + 1 < desk.retry.tries
    assert desk.now < 10.0


def test_index_0_needs_no_other_control() -> None:
    desk = Desk()
    desk.reads.is_idle = False
    desk.ask(CONTROL_INDEX)
    desk.pass_time(3.5 * FIRST_TIMEOUT)
    assert desk.take() == [CONTROL_INDEX] * 3


def test_earlier_timeouts_do_not_count_against_later_reads() -> None:
    """A vehicle that was lost for long and is found: each read has all its attempts again."""
    desk = Desk("A", count=ATTEMPTS_MAX)
    gone = [desk.ask(index) for index in range(ATTEMPTS_MAX)]
    desk.pass_time()
    assert all(read.done for read in gone)
    desk.now += 60.0
    desk.reads.reset_timeouts()
    desk.reads.is_idle = False
    read = desk.ask("A")
    desk.now = desk.reads.next_deadline()
    desk.reads.tick(desk.now)
    assert not read.done
    assert read.attempts == 2


def test_a_component_that_is_gone_is_given_up_sooner() -> None:
    patient, gone = Desk("A"), Desk("A")
    gone.round_trip.received_at = 0.0
    for desk in (patient, gone):
        read = desk.ask("A")
        desk.pass_time()
        assert isinstance(read.error, NoReply)
    assert SILENCE_MAX <= gone.now < SILENCE_MAX + 5.0
    assert gone.now < patient.now


def test_when_not_one_of_many_is_answered_all_are_given_up() -> None:
    desk = Desk()
    desk.measure(0.1)
    reads = [desk.ask(index, urgent=False) for index in range(1, 200)]
    desk.pass_time(SILENCE_MAX - 0.1)
    assert not any(read.done for read in reads)
    desk.pass_time(8.0)
    assert all(isinstance(read.error, NoReply) for read in reads)


def test_one_answer_is_enough_to_go_on() -> None:
    desk = Desk()
    desk.measure(0.1)
    reads = [desk.ask(index, urgent=False) for index in range(1, 200)]
    desk.pass_time(SILENCE_MAX - 1.0)
    desk.hear("X", index=1)
    desk.pass_time(3.0)
    assert not any(read.done for read in reads[1:])


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


def test_failing_reads_may_take_others_with_them_and_ask_anew() -> None:
    desk = Desk()
    reads = [desk.ask(index) for index in range(3)]
    again: list[Read] = []
    reads[0].on_done.append(lambda: desk.reads.release(reads[1]))
    reads[0].on_done.append(lambda: again.append(desk.ask("B")))
    desk.reads.fail_all(LinkError("gone", link="x"), 1.0)
    assert not reads[1].done
    assert reads[2].done
    assert [read.done for read in again] == [False]
    desk.hear("B")
    assert again[0].done


def test_a_read_that_ends_may_take_others_with_it_while_time_passes() -> None:
    desk = Desk("A", "B")
    desk.round_trip.received_at = -100.0
    reads = [desk.ask("A"), desk.ask("B")]
    reads[0].on_done.append(lambda: desk.reads.release(reads[1]))
    desk.pass_time()
    assert isinstance(reads[0].error, NoReply)
    assert not reads[1].done
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


def test_the_timeout_of_a_read_covers_the_batches_ahead_of_it() -> None:
    desk = Desk()
    desk.measure(0.005)  # of what is answered at once
    desk.reads.pace.is_batched = True
    reads = [desk.ask(index) for index in range(BURST)]
    desk.pass_time(0.19)
    assert [read.attempts for read in reads] == [1] * BURST
    desk.pass_time(0.02)
    assert [read.attempts for read in reads] == [2] * 5 + [1] * 5  # the others are behind the first batch


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


def test_reads_that_are_given_up_at_once_keep_to_the_pace() -> None:
    desk = Desk()
    for number in range(100):
        desk.reads.release(desk.ask(f"P{number}"))
        desk.now += 0.0003
    assert len(desk.take()) <= 12


def test_background_reads_keep_to_the_pace() -> None:
    desk = Desk()
    for number in range(100):
        desk.ask(f"P{number}", urgent=False)
        desk.now += 0.0003
        desk.hear(f"P{number}")
    assert len(desk.take()) <= 12


@pytest.mark.parametrize("seed", range(30))
def test_an_index_beyond_the_count_is_unknown_also_with_late_control_reads(seed: int) -> None:
    """With 0.3 s of delay and of jitter, the attempts may end before enough control reads are answered."""
    vehicle = ArduPilotVehicle(table={f"P_{number}": number for number in range(6)}, live=(), ftp=False)
    world = Simulation(air=Air.symmetric([vehicle], delay=0.3, jitter=0.3, seed=seed))
    error = world.error_of(lambda: world.get(6))
    assert isinstance(error, UnknownParameter), error
    assert error.index == 6


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


def test_a_read_with_copies_measures_the_round_trip() -> None:
    """Which copy was answered is unknown, so that it is no sample of the round trip."""
    desk = Desk("A")
    desk.measure(0.3)
    samples = desk.round_trip.samples
    for _ in range(20):
        desk.retry.timed_out(1)  # a link that loses packets, on which copies are worthwhile
    desk.ask("A")
    desk.reads.tick(desk.now)
    assert len(desk.take()) > 1
    desk.pass_time(0.25)
    desk.hear("A", index=1)
    assert (desk.round_trip.responses, desk.round_trip.samples) == (1, samples)
    assert desk.round_trip.response_time == pytest.approx(0.25)


def test_a_repeated_read_is_no_round_trip_sample() -> None:
    desk = Desk("A")
    desk.ask("A")
    desk.pass_time(FIRST_TIMEOUT + 0.01)
    assert desk.take() == ["A", "A"]
    desk.hear("A", index=1)
    assert desk.round_trip.responses == 0
    desk.ask("A")
    desk.pass_time(0.1)
    desk.hear("A", index=1)
    assert desk.round_trip.responses == 1
    assert desk.round_trip.response_time == pytest.approx(0.1)


def test_of_many_names_that_time_out_at_once_one_tick_gives_up_few() -> None:
    desk = Desk("A")
    reads = [desk.ask(f"NO_{number:02}") for number in range(20)]
    most = 0
    while not all(read.done for read in reads):
        before = sum(read.done for read in reads)
        desk.now += 30.0  # all that are in flight are due
        desk.reads.tick(desk.now)
        most = max(most, sum(read.done for read in reads) - before)
    assert most == NAMES_GIVEN_UP_MAX
