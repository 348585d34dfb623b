"""List download: running lists, gaps, and an end in every case."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import pytest

from paramclient.errors import LinkError, NoReply
from paramclient.protocol.params import list_download as room
from paramclient.protocol.params.list_download import (
    MISSING_WITHOUT_LIST_MAX,
    REQUESTED_INDICES_MAX,
    ListDownload,
)
from paramclient.protocol.params.list_stream import JUMP_MAX
from paramclient.protocol.params.reads import CONTROL_INDEX, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.pacing import REQUEST_SIZE, UPSTREAM_SHARE, VALUE_SIZE
from paramclient.protocol.requests.retry import (
    COUNT_CHANGES_MAX,
    EMPTY_LISTS_MAX,
    FIRST_TIMEOUT,
    LIST_ATTEMPTS_MIN,
    LIST_COPIES_MAX,
    LIST_REORDER_DEPTH,
    LIST_RETRY_INTERVAL_MAX,
    LIST_TIMEOUT,
    RetryPolicy,
)
from paramclient.protocol.scheduler import ListAdmission
from paramclient.protocol.wire import (
    NO_INDEX,
    Message,
    ParamError,
    ParamRequestList,
    ParamRequestRead,
)
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from tests.simulation import Simulation, is_so, listing_ardupilot, param_value

GAP = 0.001
"""Seconds between two values of the streams here."""


class Desk:
    """A download from component 1/1, and the reads that it shares with others."""

    def __init__(self, *, listed: bool = False, round_trip: float | None = 0.02) -> None:
        self.now = 0.0
        self.sent: list[Message] = []
        self.retry = RetryPolicy()
        self.trip = self.retry.round_trip
        for _ in range(100 if round_trip is not None else 0):
            self.retry.answered(0.0, round_trip or 0.0, 1)
        context = Context((1, 1), self.sent.append, retry=self.retry)
        self.reads = Reads(context, Table())
        self.turns = ListAdmission()
        self.download = ListDownload(context, self.reads, self.turns, 0.0, listed=listed)

    def hear(self, index: int, *, count: int = 100, name: str | None = None) -> None:
        message = param_value(f"P{index}" if name is None else name, index=index, count=count)
        self.download.receive(message, self.now)
        self.reads.receive(message, self.now)

    def stream(self, indices: Iterable[int], *, count: int = 100) -> None:
        for index in indices:
            self.now += GAP
            self.hear(index, count=count)

    def pass_time(self, seconds: float = math.inf) -> None:
        """Go from deadline to deadline, so long or until nothing is left to do."""
        end = self.now + seconds
        for _ in range(100_000):
            deadline = min(self.reads.next_deadline(), self.download.next_deadline())
            if deadline > end or deadline == math.inf:
                self.now = end if end < math.inf else self.now
                return
            self.now = max(deadline, self.now)
            self.reads.tick(self.now)
            self.download.tick(self.now)
        raise AssertionError("it does not end")

    def take(self) -> list[int | str]:
        """What was sent, in short: "list", or the index that was requested."""
        sent, self.sent[:] = list(self.sent), []
        return [message.param_index if isinstance(message, ParamRequestRead) else "list" for message in sent]

    def answer(self, *, count: int = 100, silent: Iterable[int] = (), limit: float = 300.0) -> None:
        """Answer reads after 20 ms, and no lists, until it ends."""
        while not self.download.done and self.now < limit:
            requested = [each for each in self.take() if isinstance(each, int) and each not in silent]
            self.pass_time(0.02)
            for index in requested:
                self.hear(index, count=count)
        assert self.download.done


# the list


def test_a_stream_that_loses_nothing() -> None:
    desk = Desk()
    assert desk.sent == [ParamRequestList(1, 1)]
    desk.stream(range(99))
    assert is_so(not desk.download.done)
    assert desk.download.progress == (99, 100)
    desk.stream([99])
    assert desk.download.done
    assert desk.download.error is None
    assert desk.download.missing == ()
    assert desk.download.names == {index: f"P{index}" for index in range(100)}
    assert (desk.download.lists, desk.download.repeated, desk.download.is_settled) == (1, 0, True)
    assert desk.take() == ["list"]
    assert desk.download.next_deadline() == math.inf
    assert desk.reads.is_idle


def test_a_single_parameter() -> None:
    desk = Desk()
    desk.stream([0], count=1)
    assert desk.download.done


def test_the_list_is_requested_again_as_long_as_nothing_arrives() -> None:
    desk = Desk(round_trip=None)
    desk.pass_time(FIRST_TIMEOUT - 0.01)
    assert desk.take() == ["list"]
    desk.pass_time(0.02)
    assert desk.take() == ["list"]
    for doublings in (1, 2):
        desk.pass_time(FIRST_TIMEOUT * 2**doublings)
        assert desk.take() == ["list"]
    desk.pass_time(7.9 * FIRST_TIMEOUT)
    assert desk.take() == []
    desk.pass_time(0.1 * FIRST_TIMEOUT)
    assert desk.take() == ["list"]
    desk.stream(range(40))
    desk.pass_time(0.05)
    assert desk.take() == []


def test_the_head_of_the_list_acknowledges_the_request() -> None:
    desk = Desk(round_trip=None)
    desk.now = 0.2
    desk.download.note_list_head(desk.now)
    desk.pass_time(FIRST_TIMEOUT - 0.01)
    assert desk.take() == ["list"]
    desk.pass_time(0.02)
    assert desk.take() == ["list"]
    desk.stream(range(100))
    desk.download.note_list_head(desk.now)
    assert desk.download.done
    assert desk.trip.smoothed == pytest.approx(0.2)  # at the head, not at the values that followed


def test_a_slow_stream_gets_time_for_its_first_value() -> None:
    desk = Desk(round_trip=0.001)
    desk.now = 0.05
    desk.download.note_list_head(desk.now)
    desk.pass_time(0.2)
    assert desk.take() == ["list"]


def test_silence_ends_with_no_reply() -> None:
    desk = Desk()
    desk.pass_time()
    assert isinstance(desk.download.error, NoReply)
    assert LIST_TIMEOUT <= desk.now <= LIST_TIMEOUT + LIST_RETRY_INTERVAL_MAX
    assert desk.download.error.attempts == desk.download.lists == desk.take().count("list")
    assert LIST_ATTEMPTS_MIN <= desk.download.lists < LIST_ATTEMPTS_MIN + 4
    assert "list of 1/1" in str(desk.download.error)
    assert desk.download.missing == ()
    assert desk.reads.is_idle


def test_a_list_that_is_lost_often_is_requested_often_enough() -> None:
    desk = Desk(round_trip=3.0)
    desk.pass_time(LIST_TIMEOUT + 5.0)
    assert not desk.download.done, "not before it was requested often enough"
    desk.pass_time()
    assert desk.download.lists == LIST_ATTEMPTS_MIN


def test_a_component_that_is_not_heard_either_is_given_up_sooner() -> None:
    desk = Desk(round_trip=3.0)
    desk.trip.received_at = 0.0
    desk.pass_time()
    assert isinstance(desk.download.error, NoReply)
    assert desk.now < LIST_TIMEOUT + 5.0


def test_another_pass_is_requested_twice_on_a_lossy_link() -> None:
    desk = Desk()
    for _ in range(100):
        desk.retry.timed_out(1)
        desk.retry.answered(0.0, 0.02, 1)
    desk.stream(range(50), count=1000)
    assert desk.take() == ["list"]
    desk.pass_time(0.6)
    assert desk.take().count("list") == LIST_COPIES_MAX


def test_on_a_slow_link_the_list_is_not_requested_while_the_answer_is_on_its_way() -> None:
    desk = Desk(round_trip=8.0)
    desk.pass_time(7.9)
    assert desk.take() == ["list"]


def test_a_list_requested_by_another_station_is_awaited_first() -> None:
    desk = Desk(listed=True)
    assert desk.take() == []
    assert desk.download.lists == 1
    desk.pass_time(0.5)
    assert "list" in desk.take()


def test_the_first_response_measures_the_round_trip() -> None:
    desk = Desk(round_trip=None)
    desk.now = 0.3
    desk.hear(0)
    assert desk.trip.smoothed == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("index", "count"), [(NO_INDEX, 100), (5, NO_INDEX), (NO_INDEX, NO_INDEX), (100, 100), (5, 0), (65534, 9)]
)
def test_values_with_an_impossible_index_or_count_are_ignored(index: int, count: int) -> None:
    desk = Desk()
    desk.hear(index, count=count)
    assert is_so(desk.download.count is None)
    desk.stream(range(50))
    desk.hear(index, count=count)
    assert desk.download.count == 100
    assert desk.download.received == 50
    assert desk.take() == ["list"]


# gaps


def test_a_gap_is_requested_while_the_stream_runs() -> None:
    desk = Desk()
    desk.stream([0, 1, 4])
    assert desk.take() == ["list"]
    desk.stream(range(5, 5 + LIST_REORDER_DEPTH - 1))
    assert desk.take() == [2, 3]
    desk.hear(2)
    desk.hear(3)
    desk.stream(range(5 + LIST_REORDER_DEPTH - 1, 100))
    assert desk.download.done
    assert desk.take() == []
    assert desk.download.missing == ()


@pytest.mark.parametrize("lost", [{25}, set(range(90, 100))], ids=["while it runs", "when it is over"])
def test_the_pace_of_the_stream_bounds_that_of_the_reads(lost: set[int]) -> None:
    desk = Desk()
    before = desk.reads.pace.rate
    for index in range(30 if 25 in lost else 100):
        desk.now += 0.1
        if index not in lost:
            desk.hear(index)
    desk.pass_time(0.5)
    assert lost & set(desk.take())
    assert desk.reads.pace.rate == pytest.approx(VALUE_SIZE / 0.1 * UPSTREAM_SHARE / REQUEST_SIZE)
    assert desk.reads.pace.rate < before


def test_reads_of_ardupilot_over_a_radio_have_the_rate_of_its_list() -> None:
    """Its list leaves two thirds of the port free, and its reads are answered from there."""
    desk = Desk()
    desk.reads.pace.is_batched = True
    for index in range(100):
        desk.now += 0.025
        if index % 10:
            desk.hear(index)
    assert desk.reads.pace.rate == pytest.approx(40.0, rel=0.01)


def test_reordered_values_are_not_requested() -> None:
    desk = Desk()
    desk.stream([0, 2, 1, 4, 5, 3])
    desk.stream(range(6, 100))
    assert desk.download.done
    assert desk.take() == ["list"]


def test_duplicates_are_counted_and_nothing_else() -> None:
    desk = Desk()
    for index in range(100):
        desk.stream([index, index] if index < 99 else [index])
    assert desk.download.done
    assert desk.download.repeated == 99
    assert desk.take() == ["list"]


def test_values_missing_at_the_end_are_read_after_a_pause() -> None:
    desk = Desk()
    desk.stream(range(90))
    assert desk.take() == ["list"]
    desk.pass_time(0.3)
    assert set(desk.take()) == set(range(90, 100))
    for index in range(90, 100):
        desk.hear(index)
    assert desk.download.done
    assert desk.download.missing == ()


def test_a_stream_that_goes_on_after_a_pause_answers_what_was_requested_meanwhile() -> None:
    desk = Desk()
    desk.stream(range(90))
    desk.pass_time(0.3)
    desk.stream(range(90, 100))
    assert desk.download.done
    assert len(desk.reads) == 0


def test_with_very_few_values_the_stream_gets_the_time_of_a_round_trip() -> None:
    desk = Desk(round_trip=0.5)
    desk.stream([0, 1])
    desk.pass_time(0.45)
    assert desk.take() == ["list"]
    desk.pass_time(1.0)
    assert desk.take() != []


def test_an_index_that_never_answers_is_named() -> None:
    desk = Desk()
    desk.stream(index for index in range(100) if index not in (7, 42))
    desk.answer(silent=(7, 42))
    assert desk.download.error is None
    assert desk.download.missing == (7, 42)
    assert desk.download.given_up == {7, 42}
    assert desk.now < 30.0
    assert len(desk.reads) == 0


def test_an_index_that_is_refused_is_named() -> None:
    desk = Desk()
    desk.stream(index for index in range(100) if index != 7)
    desk.reads.refused(ParamError(255, 190, "", 7, 1), desk.now)
    assert desk.download.done
    assert desk.download.missing == (7,)


def test_an_index_that_was_given_up_may_still_be_received() -> None:
    desk = Desk()
    desk.stream([*range(7), 8, 9, 10])
    desk.reads.refused(ParamError(255, 190, "", 7, 1), desk.now)
    assert desk.download.given_up == {7}
    desk.stream([7, *range(11, 100)])
    assert desk.download.missing == ()


@pytest.mark.parametrize("count", [NO_INDEX, 3])
def test_an_index_that_is_answered_with_nonsense_is_given_up(count: int) -> None:
    desk = Desk()
    desk.stream(index for index in range(100) if index != 7)
    desk.take()
    desk.hear(7, count=count)
    assert desk.download.done
    assert desk.download.missing == (7,)
    assert desk.download.given_up == {7}


def test_the_number_of_requested_indices_is_bounded() -> None:
    desk = Desk()
    desk.download.resume(0.0)
    desk.stream([0, *range(30_000, 30_100)], count=60_000)
    desk.pass_time(1.0)
    assert len(desk.reads) <= REQUESTED_INDICES_MAX


def test_a_large_table_read_one_by_one_takes_linear_time() -> None:
    desk = Desk()
    count = 20_000
    desk.stream([0], count=count)
    for _ in range(EMPTY_LISTS_MAX + 2):
        desk.pass_time(1.0)
    requested = 0
    while not desk.download.done:
        for each in desk.take():
            if isinstance(each, int):
                requested += 1
                desk.hear(each, count=count)
        desk.pass_time(0.05)
    assert desk.download.missing == ()
    assert requested < 3 * count


# pushes into the stream


def test_a_value_pushed_far_ahead_is_no_gap() -> None:
    desk = Desk()
    desk.stream([*range(10), 90, *range(10, 30), 95, 80])
    assert desk.take() == ["list"]
    desk.stream(range(30, 100))
    assert desk.download.done
    assert desk.take() == []


def test_a_long_gap_is_believed_when_the_stream_goes_on_behind_it() -> None:
    desk = Desk()
    ahead = 10 + JUMP_MAX + 5
    desk.stream([*range(10), ahead])
    assert desk.take() == ["list"]
    desk.stream(range(ahead + 1, ahead + 5))
    assert desk.take()[:3] == [10, 11, 12]


def test_pushes_far_apart_are_not_the_stream() -> None:
    desk = Desk()
    desk.stream([*range(10), *range(300, 900, JUMP_MAX + 1), 10, 11, 12, 13], count=1000)
    assert desk.take() == ["list"]


def test_a_push_at_the_very_start() -> None:
    desk = Desk()
    desk.stream([70, *range(100)])
    assert desk.download.done
    assert desk.take() == ["list"]


def test_lost_counts_each_requested_index_once() -> None:
    desk = Desk()
    desk.stream([0, 2, 1, *range(4, 40), *range(41, 90)])  # 1 arrives late, 3 and 40 do not arrive
    assert desk.download.lost == 2
    desk.pass_time(0.3)
    assert desk.download.lost == 12
    desk.pass_time(2.0)  # requested again and again, they are lost once
    desk.answer()
    assert (desk.download.lost, desk.download.missing) == (12, ())


def test_values_requested_by_another_pass_count_as_lost() -> None:
    desk = Desk()
    desk.stream(range(30), count=1000)
    desk.pass_time(0.6)
    assert desk.take().count("list") == 2
    assert desk.download.lost == 970


def test_losses_under_another_count_are_forgotten() -> None:
    desk = Desk()
    desk.stream([0, *range(5, 20)])
    assert is_so(desk.download.lost == 4)
    desk.stream(range(101), count=101)
    assert (desk.download.done, desk.download.lost) == (True, 0)


# the list starts anew


def test_another_stations_list_starts_it_again() -> None:
    desk = Desk()
    desk.stream([*range(50), *range(100)])
    assert desk.download.done
    assert desk.take() == ["list"]
    assert desk.download.repeated == 50


def test_a_list_that_starts_again_for_ever_does_not_hold_it_up() -> None:
    desk = Desk()
    for _ in range(100):
        desk.stream(range(40))
        for each in desk.take():
            if isinstance(each, int):
                desk.hear(each)
        desk.pass_time(0.01)
    assert desk.download.done
    assert desk.download.missing == ()


def test_a_stream_that_stops_is_requested_once_more_when_that_is_faster() -> None:
    desk = Desk()
    desk.stream(range(30), count=1000)
    desk.take()
    desk.pass_time(0.49)  # ArduPilot's list pauses while reads are served
    assert desk.take() == []
    desk.pass_time(0.1)
    assert desk.take() == ["list"]
    desk.stream(range(1000), count=1000)
    assert desk.download.done
    assert desk.download.missing == ()
    assert desk.take() == []


def test_a_little_is_always_read_one_by_one() -> None:
    desk = Desk()
    desk.stream(range(1000 - MISSING_WITHOUT_LIST_MAX), count=1000)
    desk.take()
    desk.pass_time(0.3)
    assert "list" not in desk.take()


def test_requests_for_lists_that_bring_nothing_end() -> None:
    desk = Desk()
    desk.stream(range(30), count=1000)
    desk.take()
    desk.pass_time(5.0)
    assert desk.take().count("list") == EMPTY_LISTS_MAX
    desk.answer(count=1000)
    assert desk.download.missing == ()


def test_lists_that_bring_something_count_anew() -> None:
    desk = Desk()
    desk.reads.pace.is_batched = True
    desk.take()
    for end in range(30, 600, 60):
        desk.stream(range(end), count=1000)
        desk.pass_time(0.6)
        assert desk.take().count("list") == 1


def test_when_the_vehicle_dies_the_rest_is_given_up_in_bounded_time() -> None:
    desk = Desk()
    desk.stream(range(300), count=1000)
    desk.pass_time()
    assert desk.download.done
    assert desk.download.error is None
    assert desk.download.missing == tuple(range(300, 1000))
    assert desk.now < 60.0
    assert len(desk.reads) == 0


def test_a_vehicle_that_answers_single_reads_is_not_given_up() -> None:
    desk = Desk()
    desk.stream(range(300), count=400)
    desk.answer(count=400, silent=range(350, 360))
    assert desk.download.missing == tuple(range(350, 360))


def test_gaps_that_stay_silent_do_not_end_a_stream_that_runs() -> None:
    desk = Desk()
    desk.stream([0, 1, *range(5, 60)], count=4000)
    at = 60
    while at < 1000:
        desk.stream([at], count=4000)
        desk.pass_time(0.05)
        at += 1
    assert desk.download.given_up == set()  # the link may be the cause
    desk.stream(range(at, 4000), count=4000)
    assert is_so(not desk.download.done)
    desk.answer(count=4000, silent=(2, 3, 4))
    assert desk.download.missing == (2, 3, 4)


def test_a_vehicle_that_answers_hardly_anything_is_not_given_up() -> None:
    desk = Desk()
    desk.stream(range(80))
    requested = 0
    while not desk.download.done and desk.now < 1000.0:
        desk.pass_time(0.05)
        for each in desk.take():
            requested += 1
            if isinstance(each, int) and requested % 40 == 0:
                desk.hear(each)
    assert desk.download.missing == ()


@pytest.mark.parametrize("silent", [(0,), (0, 1, 2), (7, 99)])
def test_dead_indices_are_given_up_soon_even_the_usual_control(silent: tuple[int, ...]) -> None:
    desk = Desk()
    desk.stream(index for index in range(100) if index not in silent)
    desk.answer(silent=silent)
    assert desk.download.missing == silent
    assert desk.now < 3.0


# the count moves


def test_a_count_that_changes_makes_everything_count_again() -> None:
    desk = Desk()
    desk.stream(range(50), count=90)
    desk.stream(range(50, 100), count=100)
    assert desk.download.count == 100
    assert desk.download.received == 50
    desk.take()
    desk.answer()
    assert desk.download.missing == ()
    assert desk.download.is_settled


def test_a_stream_that_starts_again_with_another_count() -> None:
    desk = Desk()
    desk.stream(range(50), count=90)
    desk.stream(range(100), count=100)
    assert desk.download.done
    assert desk.download.missing == ()
    assert desk.take() == ["list"]


def test_an_answer_with_another_count_is_settled_by_another_pass() -> None:
    desk = Desk()
    desk.stream([*range(7), *range(8, 20)])
    assert desk.take() == ["list", 7]
    desk.hear(7, count=104)  # single reads report the count of now, the stream that of its beginning
    assert desk.download.count == 100
    desk.stream(range(20, 100))
    assert desk.download.count == 104
    assert is_so(not desk.download.done)
    assert desk.take() == ["list"]
    desk.stream(range(104), count=104)
    assert desk.download.done
    assert desk.download.missing == ()


def test_two_counts_that_alternate_end() -> None:
    desk = Desk()
    for index in range(100):
        desk.stream([index], count=100 + index % 2)
    assert not desk.download.is_settled
    for _ in range(3 * COUNT_CHANGES_MAX):
        if not desk.download.done:
            desk.pass_time(1.0)
            for each in desk.take():
                if isinstance(each, int):
                    desk.hear(each, count=100 + each % 2)
    desk.pass_time()
    assert desk.download.done
    assert desk.now < 120.0


def test_once_the_count_is_taken_as_it_is_what_lies_beyond_it_is_passed_over() -> None:
    desk = Desk()
    for move in range(COUNT_CHANGES_MAX + 1):
        desk.stream([0], count=100 + move)
    assert not desk.download.is_settled
    desk.hear(150, count=200)
    assert desk.download.count == 100 + COUNT_CHANGES_MAX
    assert 150 not in desk.download.names


def test_after_enough_list_requests_another_count_is_settled_by_reads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(room, "LISTS_MAX", 1)
    desk = Desk()
    desk.stream([*range(7), *range(8, 100)])
    desk.hear(7, count=104)
    assert desk.download.count == 104
    assert "list" not in desk.take()[1:]
    desk.pass_time(0.5)
    desk.answer(count=104)
    assert desk.download.missing == ()


@pytest.mark.parametrize("seed", range(4))  # with the next one no round trip is measured before
def test_another_pass_of_ardupilot_is_requested_so_that_it_follows_the_one_before(seed: int) -> None:
    vehicle = listing_ardupilot()
    session = Simulation(air=Air.symmetric([vehicle], delay=0.05, loss=0.2, seed=seed))
    session.meet()
    session.run(3.0)
    ends: list[float] = []

    def listed() -> None:
        ends.append(session.now)
        vehicle.when_listed(len(vehicle.listed), listed)

    vehicle.when_listed(len(vehicle.listed), listed)
    assert session.fetch().complete
    arrived = [at + 0.05 for at, message in session.sent if isinstance(message, ParamRequestList)]
    assert len(ends) >= 2
    for end in ends[:-1]:
        assert any(end - 0.05 < at < end + 0.06 for at in arrived), "it arrives when the pass before is over"


def test_reads_that_wait_for_their_answers_hold_another_pass_up() -> None:
    """ArduPilot sends nothing of its list until they are served (measured)."""
    for passed_over, sends_again in (((), True), (range(0, 870, 29), False)):
        desk = Desk(round_trip=0.1)
        desk.reads.pace.is_batched = True
        desk.pass_time(0.1)
        desk.stream((index for index in range(930) if index not in passed_over), count=1000)
        desk.pass_time(0.0)
        assert desk.take().count("list") == 1
        desk.stream(range(990, 1000), count=1000)
        desk.pass_time(0.02)
        assert ("list" in desk.take()) is sends_again, len(passed_over)


def test_an_index_whose_read_is_open_is_not_read_again_by_the_next_pass() -> None:
    desk = Desk()
    desk.stream([*range(10), *range(12, 40)], count=1000)
    assert desk.take() == ["list", 10, 11]
    desk.reads.refused(ParamError(255, 190, "", 10, 1), desk.now)
    desk.reads.pace.is_batched = True  # reads are slow from now on
    desk.pass_time(0.6)
    assert "list" in desk.take()
    desk.stream([*range(10), *range(12, 40)], count=1000)
    assert desk.take() == []
    assert desk.reads._open[11].holders == 1


def test_the_fetch_of_a_vehicle_whose_count_never_rests_ends() -> None:
    desk = Desk()
    count = 100
    for _ in range(5000):
        if desk.download.done:
            break
        for each in desk.take():
            if each == "list":
                desk.stream(range(60), count=count)
            elif isinstance(each, int):
                count = 100 + (count - 99) % 7
                desk.hear(each, count=count)
        desk.pass_time(0.05)
    assert desk.download.done
    assert not desk.download.is_settled


# its end from outside


def test_cancelling_gives_everything_back() -> None:
    desk = Desk()
    desk.stream([*range(7), *range(9, 20)])
    assert len(desk.reads) == 2
    desk.download.cancel()
    assert len(desk.reads) == 0
    assert desk.reads.is_idle
    assert not desk.reads.list_runs_again
    assert not desk.download.done


def test_cancelling_keeps_a_read_of_other_holders() -> None:
    desk = Desk()
    desk.stream([*range(7), *range(8, 20)])
    other = desk.reads.ask(7, desk.now)
    desk.download.cancel()
    desk.hear(7)
    assert other.done


def test_the_end_of_the_link_while_a_read_is_open() -> None:
    desk = Desk()
    desk.stream([*range(7), *range(8, 20)])
    desk.download.cancel()
    desk.reads.fail_all(LinkError("gone", link="x"), desk.now)
    assert len(desk.reads) == 0


def test_when_the_link_is_back_the_list_is_requested_at_once_and_anew() -> None:
    desk = Desk()
    desk.pass_time(LIST_TIMEOUT - 1)
    desk.take()
    desk.now = 100.0
    desk.download.resume(100.0)
    desk.pass_time(0.0)
    assert desk.take() == ["list"]
    desk.pass_time(LIST_TIMEOUT - 1)
    assert not desk.download.done


def test_when_the_link_is_back_a_stream_gets_time_to_go_on() -> None:
    desk = Desk()
    desk.stream(range(50))
    desk.now = 100.0
    desk.download.resume(100.0)
    desk.pass_time(0.01)
    assert desk.take() == ["list"]
    desk.stream(range(50, 100))
    assert desk.download.done


def test_after_its_end_nothing_matters_any_more() -> None:
    desk = Desk()
    desk.stream(range(100))
    desk.hear(3, count=500)
    desk.download.tick(50.0)
    assert desk.download.count == 100
    assert desk.take() == ["list"]


# with the vehicles


def test_px4_without_loss_costs_one_list() -> None:
    world = Simulation(PX4Vehicle())
    result = world.fetch()
    assert result.complete
    assert result.count == 903
    assert len(world.sent_of(ParamRequestList)) == 1
    assert [read.param_id for read in world.sent_of(ParamRequestRead)] == ["_HASH_CHECK"]
    assert result.elapsed < 1.5


def test_ardupilot_without_loss_costs_one_list() -> None:
    vehicle = listing_ardupilot()
    world = Simulation(vehicle)
    result = world.fetch()
    assert result.complete
    assert result.count == 1382
    assert len(world.sent_of(ParamRequestList)) == 1
    assert world.sent_of(ParamRequestRead) == []
    assert {name: param.value for name, param in result.params.items()} == vehicle.values
    assert result.elapsed < 2.0


def test_ardupilot_that_has_just_booted() -> None:
    world = Simulation(listing_ardupilot(table={f"P{n}": n for n in range(50)}, boot_time=5.0))
    world.meet()
    result = world.fetch()
    assert result.complete
    assert 4.0 < result.elapsed < 12.0


def test_ardupilot_that_boots_for_longer() -> None:
    vehicle = listing_ardupilot(table={f"P{n}": n for n in range(50)}, boot_time=15.0)
    world = Simulation(air=Air.symmetric([vehicle], delay=0.05))
    assert world.fetch().complete


def test_px4_in_low_bandwidth_mode() -> None:
    vehicle = PX4Vehicle(table={f"P{n:02d}": n for n in range(60)}, burst=1, period=0.125)
    world = Simulation(vehicle)
    assert world.fetch().complete
    assert len(world.sent_of(ParamRequestList)) == 1


def test_a_stream_slower_than_any_known() -> None:
    vehicle = GenericVehicle({f"P{n:02d}": n for n in range(40)}, burst=1, period=0.7)
    world = Simulation(vehicle)
    assert world.fetch().complete


@pytest.mark.parametrize("make", [PX4Vehicle, listing_ardupilot])
@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("seconds", [0.1, 0.45, 0.8])
def test_a_vehicle_that_dies_in_the_middle(
    make: Callable[..., PX4Vehicle | ArduPilotVehicle], loss: float, seconds: float
) -> None:
    vehicle = make()
    world = Simulation(air=Air.symmetric([vehicle], loss=loss, delay=0.02, seed=4))
    fetch = world.meet().begin_fetch(world.now)
    world.run(seconds)
    vehicle.reboot(world.now, down=math.inf)
    world.until(lambda: fetch.done, 45.0)
    if fetch.error is None:
        assert fetch.result is not None
        assert 0 < len(fetch.result.missing) < fetch.result.count
        assert fetch.result.received + len(fetch.result.missing) == fetch.result.count
    else:
        assert isinstance(fetch.error, NoReply)
    assert len(world.machine.reads) == 0


def test_a_vehicle_that_receives_nothing_and_still_sends_heartbeats() -> None:
    vehicle = PX4Vehicle()
    world = Simulation(vehicle)
    fetch = world.meet().begin_fetch(world.now)
    world.run(0.3)
    world.air.uplink._loss = 1.0
    world.until(lambda: fetch.done, 60.0)
    assert fetch.result is not None


def test_a_reboot_in_the_middle() -> None:
    vehicle = PX4Vehicle()
    world = Simulation(vehicle)
    fetch = world.meet().begin_fetch(world.now)
    world.run(0.4)
    vehicle.reboot(world.now, down=3.0)
    result = world.outcome(fetch)
    assert result.complete
    assert result.hash == vehicle.announced_hash()


def test_the_control_index_is_among_what_may_be_missing() -> None:
    desk = Desk()
    desk.stream(range(1, 100))
    assert CONTROL_INDEX in desk.take()
    desk.answer(silent=(CONTROL_INDEX,))
    assert desk.download.missing == (CONTROL_INDEX,)
