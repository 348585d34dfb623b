"""List download: running lists, gaps, and an end in every case."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import pytest
from paramclient.protocol.params.list_download import (
    ListDownload,
)
from paramclient.protocol.params.reads import Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.retry import (
    COUNT_CHANGES_MAX,
    FIRST_TIMEOUT,
    LIST_ATTEMPTS_MIN,
    LIST_REORDER_DEPTH,
    LIST_RETRY_INTERVAL_MAX,
    LIST_TIMEOUT,
    RetryPolicy,
)
from paramclient.protocol.scheduler import ListAdmission

from paramclient.errors import NoReply
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.wire.messages import NO_INDEX, Message, ParamError, ParamRequestList, ParamRequestRead
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


def test_reordered_values_are_not_requested() -> None:
    desk = Desk()
    desk.stream([0, 2, 1, 4, 5, 3])
    desk.stream(range(6, 100))
    assert desk.download.done
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


# pushes into the stream


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


def test_when_the_vehicle_dies_the_rest_is_given_up_in_bounded_time() -> None:
    desk = Desk()
    desk.stream(range(300), count=1000)
    desk.pass_time()
    assert desk.download.done
    assert desk.download.error is None
    assert desk.download.missing == tuple(range(300, 1000))
    assert desk.now < 60.0
    assert len(desk.reads) == 0


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


def test_px4_in_low_bandwidth_mode() -> None:
    vehicle = PX4Vehicle(table={f"P{n:02d}": n for n in range(60)}, burst=1, period=0.125)
    world = Simulation(vehicle)
    assert world.fetch().complete
    assert len(world.sent_of(ParamRequestList)) == 1


@pytest.mark.parametrize("make", [PX4Vehicle, listing_ardupilot])
@pytest.mark.parametrize(("loss", "seconds"), [(0.0, 0.45), (0.2, 0.8)])
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


def test_a_reboot_in_the_middle() -> None:
    vehicle = PX4Vehicle()
    world = Simulation(vehicle)
    fetch = world.meet().begin_fetch(world.now)
    world.run(0.4)
    vehicle.reboot(world.now, down=3.0)
    result = world.outcome(fetch)
    assert result.complete
    assert result.hash == vehicle.announced_hash()
