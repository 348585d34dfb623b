"""The search for names that may not exist: who is found, who is unknown, how soon, and what a loss does."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import pytest

from paramclient.errors import LinkError, NoReply
from paramclient.protocol.params.foreign_list import ForeignList
from paramclient.protocol.params.name_search import WINDOW_SIZE, NameSearches
from paramclient.protocol.params.reads import Reads
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.retry import (
    CONTROL_RISK,
    CONTROLS_LOST_MAX,
    CONTROLS_MAX,
    NAME_LOSS_RISK,
    PASSES_MIN,
    RetryPolicy,
)
from paramclient.protocol.wire import Message, ParamError, ParamRequestRead
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle
from paramclient.sim.param_table import ek2_group
from tests.simulation import Simulation, param_value

COUNT = 100


class Desk:
    """The searches of component 1/1, which has a list of 100, on a link that has lost nothing so far."""

    def __init__(self) -> None:
        self.now = 0.0
        self.sent: list[str | int] = []
        self.count: int | None = COUNT
        self.live_count: int | None = COUNT
        self.retry = RetryPolicy()
        self.round_trip = self.retry.round_trip
        for _ in range(60):
            self.retry.answered(0.0, 0.02, 1)
        self.params: set[str] = set()
        context = Context((1, 1), self._send, retry=self.retry)
        self.reads = Reads(context, self)
        self.searches = NameSearches(context, self.reads, self, ForeignList())

    def _send(self, message: Message) -> None:
        assert isinstance(message, ParamRequestRead)
        self.sent.append(message.param_id if message.param_index < 0 else message.param_index)

    def take(self) -> list[str | int]:
        sent, self.sent = self.sent, []
        return sent

    def hear(self, name: str, index: int = 65535) -> None:
        self.searches.receive(param_value(name, index=index), self.now)

    def answer(self, *names: str) -> list[str | int]:
        """The vehicle answers what was requested, of names only these; what was requested is returned."""
        requested = self.take()
        for key in requested:
            if isinstance(key, int):
                self.hear(f"P{key}", key)
            elif key in names:
                self.hear(key)
        return requested

    def wait(self) -> None:
        self.now = self.searches.next_deadline()
        assert self.now < math.inf
        self.searches.tick(self.now)


def test_a_silent_name_is_requested_with_each_control_and_then_unknown() -> None:
    desk = Desk()
    search = desk.searches.begin(["A", "B", "C"], 0.0)
    controls = set()
    for number in range(PASSES_MIN):
        assert not search.done
        desk.now = number * 0.02
        *names, control = desk.answer("B")
        assert names == (["A", "B", "C"] if number == 0 else ["A", "C"])
        controls.add(control)
    assert search.done
    assert search.ended_at == pytest.approx(0.02 * (PASSES_MIN - 1))  # without a timeout
    assert search.unknown == {"A", "C"}
    assert search.open == frozenset()
    assert len(controls) == PASSES_MIN  # a late answer to one is none to the next
    assert desk.take() == []
    assert desk.searches.next_deadline() == math.inf


def test_the_more_is_lost_the_more_often_a_name_is_requested() -> None:
    desk = Desk()
    for _ in range(30):
        desk.retry.timed_out(1)
        desk.retry.answered(0.0, 0.02, 1)
    search = desk.searches.begin(["A"], 0.0)
    passes = 0
    while not search.done:
        desk.answer()
        passes += 1
    assert passes == math.ceil(math.log(NAME_LOSS_RISK) / math.log(desk.round_trip.feared_loss)) > PASSES_MIN
    desk.searches.begin(["A"], 0.0)
    assert len(set(desk.take())) == 1 + desk.retry.copies(CONTROL_RISK, CONTROLS_MAX) > 2


def test_a_name_that_was_lost_is_found() -> None:
    desk = Desk()
    search = desk.searches.begin(["A"], 0.0)
    for _ in range(PASSES_MIN - 1):
        desk.answer()
    assert desk.round_trip.seen_loss == 0.0
    assert desk.answer("A")[0] == "A"
    assert desk.round_trip.seen_loss > 0.0  # which makes it stricter with the others
    assert search.done
    assert search.unknown == set()


def test_no_more_is_in_flight_than_the_vehicle_queues() -> None:
    desk = Desk()
    names = [f"N{number:02}" for number in range(40)]
    search = desk.searches.begin(names, 0.0)
    sizes, controls = [], []
    while not search.done:
        sizes.append(len(desk.sent))
        controls.append(desk.answer(*names[:10])[-1])
    assert sizes == [WINDOW_SIZE + 1, WINDOW_SIZE + 1, 4 + 1, WINDOW_SIZE + 1, 12 + 1]
    assert controls == [99, 98, 97, 96, 95]  # rising ones would look like a list
    assert search.unknown == set(names[10:])


def test_a_window_that_is_answered_whole_waits_for_no_control() -> None:
    desk = Desk()
    names = [f"N{number:02}" for number in range(WINDOW_SIZE + 1)]
    search = desk.searches.begin(names, 0.0)
    *first, control = desk.take()
    for name in first:
        desk.hear(str(name))
    assert desk.take()[:-1] == [names[-1]]
    assert isinstance(control, int)
    desk.hear("P", control)  # the control of the first window says nothing of the second one
    assert desk.take() == []
    desk.hear(names[-1])
    assert search.done
    assert search.unknown == set()


def test_without_its_control_a_window_is_sent_again_and_given_up_in_the_end() -> None:
    desk = Desk()
    search = desk.searches.begin(["A", "B"], 0.0)
    for _ in range(CONTROLS_LOST_MAX):
        assert desk.take()[:2] == ["A", "B"]
        desk.wait()
    assert search.done
    assert search.error is None
    assert search.unknown == set()
    assert search.open == {"A", "B"}
    assert desk.now < 2.0


def test_while_a_list_arrives_an_index_is_no_answer_to_a_control() -> None:
    desk = Desk()
    desk.reads.is_idle = False
    search = desk.searches.begin(["A"], 0.0)
    for _ in range(PASSES_MIN):
        desk.answer()
    assert not search.done
    desk.reads.is_idle = True
    desk.wait()
    for _ in range(10 * PASSES_MIN):
        desk.answer()
    assert search.unknown == {"A"}


def test_newer_firmware_says_that_it_has_no_such_parameter() -> None:
    desk = Desk()
    search = desk.searches.begin(["A", "B"], 0.0)
    desk.searches.refused(ParamError(255, 190, "A", -1, 1), 0.01)
    desk.searches.refused(ParamError(255, 190, "", 5, 1), 0.01)
    assert search.unknown == {"A"}
    desk.searches.refused(ParamError(255, 190, "B", -1, 1), 0.02)
    assert search.done
    assert search.ended_at == 0.02


def test_searches_are_done_one_after_the_other_and_can_be_cancelled() -> None:
    desk = Desk()
    first, second, third = (desk.searches.begin([name], 0.0) for name in "ABC")
    assert len(desk.searches) == 3
    assert desk.take()[:-1] == ["A"]
    desk.searches.cancel(second, 0.0)
    desk.hear("A")
    assert first.done
    assert desk.take()[:-1] == ["C"]
    desk.searches.cancel(third, 0.0)
    assert len(desk.searches) == 0
    desk.hear("C")
    desk.searches.refused(ParamError(255, 190, "C", -1, 1), 0.0)
    desk.searches.tick(1e9)
    desk.searches.cancel(third, 0.0)
    assert desk.take() == []
    assert desk.searches.begin([], 0.0).done


def test_a_search_ends_when_the_component_is_lost_or_the_link_fails() -> None:
    desk = Desk()
    lost = desk.searches.begin(["A"], 0.0)
    desk.searches.lose(3.0)
    assert isinstance(lost.error, NoReply)
    failed = desk.searches.begin(["A"], 0.0)
    desk.take()
    desk.searches.resume(1.0)
    assert desk.take()[:-1] == ["A"]
    error = LinkError("gone", link="a link")
    desk.searches.fail_all(error, 3.0)
    assert failed.error is error
    assert desk.searches.next_deadline() == math.inf


def test_without_a_count_the_index_received_last_is_the_control() -> None:
    desk = Desk()
    desk.count = None
    search = desk.searches.begin(["A"], 0.0)
    for _ in range(PASSES_MIN):
        assert desk.answer() == ["A", desk.reads.control]
    assert search.unknown == {"A"}


HIDDEN = [row.name for row in ek2_group()][:8]
UNUSED = ["MC_ROLL_P", "MC_PITCH_P", "RTL_RETURN_ALT"]


@pytest.mark.parametrize(
    ("make", "hidden"), [(ArduPilotVehicle, HIDDEN), (partial(PX4Vehicle, not_in_use=UNUSED), UNUSED)]
)
@pytest.mark.parametrize(("loss", "most"), [(0.0, 0.5), (0.1, 5.0)])
def test_vehicles_distinguish_the_hidden_from_the_unknown(
    make: Callable[[], ArduPilotVehicle | PX4Vehicle], hidden: list[str], loss: float, most: float
) -> None:
    unknown = {f"NO_SUCH_{number}" for number in range(10)}
    for seed in range(5):
        vehicle = make()
        air = Air(
            [vehicle],
            uplink=FaultyLink(loss=loss, delay=0.005, seed=seed),
            downlink=FaultyLink(loss=loss, delay=0.005, seed=seed + 99),
        )
        simulation = Simulation(vehicle, air=air)
        simulation.fetch()
        assert not simulation.machine.table.params.keys() & hidden
        search = simulation.machine.search([*hidden, *unknown], simulation.now)
        simulation.until(partial(getattr, search, "done"))
        assert search.unknown | search.open == unknown
        assert set(hidden) <= simulation.machine.table.params.keys()
        assert search.ended_at - search.begun_at < most
