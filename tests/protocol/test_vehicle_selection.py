"""The choice of the only vehicle on a link: what counts as another one, and for how long it is looked for."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from paramclient.protocol.component import ComponentMachine

from paramclient.errors import AmbiguousVehicle
from paramclient.protocol.selection import LOOK_TIME, node_in_words, only_vehicle
from paramclient.protocol.station import Station
from paramclient.wire import messages
from paramclient.wire.messages import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_GENERIC,
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_TYPE_GCS,
    Heartbeat,
    Message,
)

PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
ROVER = Heartbeat(10, MAV_AUTOPILOT_ARDUPILOTMEGA)
PLANE = Heartbeat(1, MAV_AUTOPILOT_PX4)
GIMBAL = Heartbeat(26, MAV_AUTOPILOT_INVALID)
MISLABELLED = Heartbeat(26, MAV_AUTOPILOT_GENERIC)
"""The heartbeat of a gimbal that names the generic autopilot."""
GCS = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID)


class Listening:
    """A station that receives the messages of a test from 0 s on, and chooses a component."""

    def __init__(self, link: str = "x") -> None:
        self.station = Station(link=link, is_stream=False)
        self.station.listening_since = 0.0

    def hear(self, message: Message, now: float, system: int = 1, component: int = 1) -> Listening:
        self.station.tick(now)
        frame = messages.encode(message, system=system, component=component, sequence=0, version=2)
        self.station.receive(frame, "peer", now)
        self.station.tick(now)
        return self

    def chosen(
        self, now: float, system: int | None = None, component: int | None = None
    ) -> tuple[int, int] | None:
        """The address of what is chosen."""
        self.station.tick(now)
        return self.look(only_vehicle(system, component), now)

    def look(self, choice: only_vehicle, now: float) -> tuple[int, int] | None:
        machines = self.station.components.values()
        found = choice.look(machines, now, listening_since=self.station.listening_since)
        return None if found is None else (found.system, found.component)

    def refused(self, now: float, system: int | None = None, component: int | None = None) -> str:
        """The text of the error, when nothing is chosen."""
        with pytest.raises(AmbiguousVehicle) as caught:
            self.chosen(now, system, component)
        assert all(each in str(caught.value) for each in caught.value.vehicles)
        return str(caught.value)


@pytest.fixture
def listening() -> Listening:
    return Listening()


# how long


def test_the_only_autopilot_is_chosen_when_a_second_one_would_have_been_heard(listening: Listening) -> None:
    choice = only_vehicle(None, None)
    assert listening.look(choice, 4.0) is None
    assert choice.due == math.inf
    listening.hear(PX4, 5.0)
    assert listening.look(choice, 5.0) is None
    assert choice.due == 5.0 + LOOK_TIME
    assert listening.look(choice, 5.0 + LOOK_TIME - 0.001) is None
    assert listening.look(choice, choice.due) == (1, 1)


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.7, 1.0, LOOK_TIME - 0.001])
def test_a_second_one_is_found_whatever_its_phase(listening: Listening, phase: float) -> None:
    listening.hear(PX4, 5.0)
    listening.hear(ROVER, 5.0 + phase, system=2)
    text = "2 vehicles on this link: 1/1 PX4 quadrotor, 2/1 ArduPilot rover."
    assert listening.refused(5.0 + phase) == f"{text} Choose one with the argument system."
    assert listening.refused(9.0).startswith(text)


def test_the_look_begins_anew_when_the_link_was_disconnected(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(PX4, 6.0)
    listening.station.pause()
    choice = only_vehicle(None, None)
    assert listening.look(choice, 8.0) is None
    assert choice.due == math.inf
    listening.station.resume(9.0)
    listening.hear(PX4, 9.5)
    assert listening.look(choice, 10.1) is None
    assert listening.look(choice, 9.0 + LOOK_TIME) == (1, 1)


# what counts


def test_a_vehicle_that_is_lost_is_not_there(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(ROVER, 5.0, system=2)
    for second in range(6, 12):
        listening.hear(ROVER, float(second), system=2)
    assert listening.chosen(11.5) == (2, 1)


@pytest.mark.parametrize("heartbeat", [GIMBAL, GCS, MISLABELLED])
@pytest.mark.parametrize(("system", "component"), [(1, 154), (2, 1), (9, 190)])
def test_components_that_are_no_autopilots_are_no_vehicles(
    listening: Listening, heartbeat: Heartbeat, system: int, component: int
) -> None:
    listening.hear(heartbeat, 4.9, system, component).hear(PX4, 5.0)
    assert listening.chosen(6.0) is None
    assert listening.chosen(6.2) == (1, 1)


def test_two_autopilots_of_one_system_are_two(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(ROVER, 5.5, component=2)
    assert listening.refused(5.5) == (
        "2 autopilots in system 1 on this link: 1/1 PX4 quadrotor, 1/2 ArduPilot rover. "
        "Choose one with the argument component."
    )


def test_the_list_has_one_line_for_each_vehicle(listening: Listening) -> None:
    listening.hear(ROVER, 5.0, component=2).hear(PX4, 5.1).hear(PLANE, 5.2, system=3).hear(
        GIMBAL, 5.3, 3, 154
    )
    assert listening.refused(5.5).startswith("2 vehicles on this link: 1/1 PX4 quadrotor, 3/1 PX4 plane.")


# what is named


def test_a_full_address_is_chosen_at_once(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(ROVER, 5.0, system=2).hear(GIMBAL, 5.0, 2, 154)
    assert listening.chosen(5.0, 2, 1) == (2, 1)
    assert listening.chosen(5.0, 2, 154) == (2, 154)
    assert listening.chosen(9.0, 3, 1) is None


def test_a_system_that_is_named_means_its_component_1_at_once(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(ROVER, 5.0, system=2).hear(PLANE, 5.0, 2, 2)
    assert listening.chosen(5.0, system=1) == (1, 1)
    assert listening.chosen(5.0, system=2) == (2, 1)


def test_a_system_whose_autopilot_has_another_id_means_that_when_it_is_alone(listening: Listening) -> None:
    listening.hear(ROVER, 5.0, 2, 2).hear(PX4, 5.0)
    assert listening.chosen(6.1, system=2) is None
    assert listening.chosen(6.2, system=2) == (2, 2)
    listening.hear(PLANE, 6.3, 2, 3)
    assert listening.refused(6.3, system=2) == (
        "2 autopilots in system 2 on this link: 2/2 ArduPilot rover, 2/3 PX4 plane. "
        "Choose one with the argument component."
    )


def test_a_component_that_is_named_alone_names_no_vehicle(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(GIMBAL, 5.1, 1, 154)
    assert listening.chosen(6.1, component=154) is None
    assert listening.chosen(6.2, component=154) == (1, 154)
    assert listening.chosen(6.2, component=100) is None
    listening.hear(ROVER, 6.3, system=2)
    for component in (1, 154, 100):
        text = "2 vehicles on this link: 1/1 PX4 quadrotor, 2/1 ArduPilot rover."
        assert listening.refused(6.3, component=component).startswith(text)


def test_a_component_chooses_between_two_autopilots_of_one_system(listening: Listening) -> None:
    listening.hear(PX4, 5.0).hear(ROVER, 5.0, component=2)
    assert listening.chosen(6.2, component=2) == (1, 2)
    assert listening.chosen(6.2, component=1) == (1, 1)


# several links


def of_all(*several: Listening) -> Callable[..., ComponentMachine | None]:
    def chosen(
        now: float, system: int | None = None, component: int | None = None
    ) -> ComponentMachine | None:
        machines = [machine for each in several for machine in each.station.components.values()]
        choice = only_vehicle(system, component, spans_links=True)
        since = max(each.station.listening_since for each in several)
        return choice.look(machines, now, listening_since=since)

    return chosen


def test_vehicles_on_two_links_are_two() -> None:
    one, two = Listening("udpin:1"), Listening("udpin:2")
    chosen = of_all(one.hear(PX4, 5.0), two.hear(ROVER, 5.5, system=2))
    with pytest.raises(AmbiguousVehicle) as caught:
        chosen(5.6)
    assert caught.value.summary == (
        "2 vehicles on the links of this service: "
        "1/1 PX4 quadrotor on udpin:1, 2/1 ArduPilot rover on udpin:2."
    )
    assert caught.value.choose_by == "system"
    assert chosen(5.6, system=2) is None, "the other link may have it too"
    assert chosen(6.7, system=2) is two.station.components[2, 1]


def test_one_address_on_two_links_is_two() -> None:
    one, two = Listening("udpin:1"), Listening("udpin:2")
    chosen = of_all(one.hear(PX4, 5.0), two.hear(ROVER, 5.5))
    for system, component in ((None, None), (1, None), (1, 1), (None, 1)):
        with pytest.raises(AmbiguousVehicle, match="argument link") as caught:
            chosen(5.6, system, component)
        assert caught.value.choose_by == "link"


# words


@pytest.mark.parametrize(
    ("heartbeat", "words"),
    [
        (PX4, "7/1 PX4 quadrotor"),
        (ROVER, "7/1 ArduPilot rover"),
        (PLANE, "7/1 PX4 plane"),
        (Heartbeat(20, MAV_AUTOPILOT_PX4), "7/1 PX4 vtol quadrotor"),
        (Heartbeat(0, MAV_AUTOPILOT_PX4), "7/1 PX4"),
        (Heartbeat(0, MAV_AUTOPILOT_GENERIC), "7/1 generic"),
        (Heartbeat(11, MAV_AUTOPILOT_GENERIC), "7/1 boat"),
        (GIMBAL, "7/1 gimbal"),
        (Heartbeat(2, 15), "7/1 armazila quadrotor"),
        (Heartbeat(250, 250), "7/1 autopilot 250 type 250"),
    ],
)
def test_a_vehicle_in_words(listening: Listening, heartbeat: Heartbeat, words: str) -> None:
    listening.hear(heartbeat, 1.0, system=7)
    assert node_in_words(listening.station.components[7, 1]) == words
