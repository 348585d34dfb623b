"""What was received instead of an awaited message: the words for each kind of silence."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from paramclient.protocol.no_reply_hint import LISTED_MAX, hint_of_component
from paramclient.protocol.params.sync import SyncSettings

from paramclient.protocol.fetch import Policy
from paramclient.protocol.selection import hint_of_link
from paramclient.protocol.station import SENDERS_MAX, Station
from paramclient.wire import messages
from paramclient.wire.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_TYPE_GCS,
    Heartbeat,
    Message,
    StatusText,
)

LINK = "udpin:0.0.0.0:14550"
ASKS = "Is the vehicle sending to this port?"
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
GCS = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID)
TEXT = StatusText(6, "hello")

Hear = Callable[..., None]


@pytest.fixture
def station() -> Station:
    station = Station(link=LINK, is_stream=False)
    station.listening_since = 0.0
    return station


@pytest.fixture
def hear(station: Station) -> Hear:
    def receive(message: Message, system: int, component: int = 1, now: float = 1.0) -> None:
        frame = messages.encode(message, system=system, component=component, sequence=0, version=2)
        station.receive(frame, "peer", now)

    return receive


# A component that is not there


def test_nothing_at_all(station: Station) -> None:
    assert hint_of_link(station, LINK) == f"Nothing was received on {LINK}. {ASKS}"
    assert hint_of_link(station, "sim:px4") == "Nothing was received on sim:px4."


@pytest.mark.parametrize(
    ("link", "advice"), [("tcp:a:1", ""), ("serial:a:57600", " Check the cable and the baud rate.")]
)
def test_bytes_that_are_no_frames(station: Station, link: str, advice: str) -> None:
    station.receive(bytes(1500), "peer", 1.0)
    expected = f"1,500 bytes were received on {link}, but no valid MAVLink frame.{advice}"
    assert hint_of_link(station, link) == expected


def test_only_a_ground_station(station: Station, hear: Hear) -> None:
    hear(GCS, 252, 190)
    assert hint_of_link(station, LINK) == (
        f"Heard on {LINK} so far: only 252/190 ground station, and no vehicle. {ASKS}"
    )


def test_only_a_ground_station_with_the_ids_of_this_client(station: Station, hear: Hear) -> None:
    """QGroundControl has the same ids by default."""
    hear(GCS, 255, 190)
    assert hint_of_link(station, LINK) == (
        f"Heard on {LINK} so far: only 255/190 with the ids of this client, and no vehicle. {ASKS}"
    )


def test_another_vehicle(station: Station, hear: Hear) -> None:
    hear(PX4, 3)
    hear(GCS, 252, 190)
    expected = f"Heard on {LINK} so far: 3/1 PX4 quadrotor, 252/190 ground station."
    assert hint_of_link(station, LINK) == expected


def test_a_system_without_heartbeats(station: Station, hear: Hear) -> None:
    hear(TEXT, 7)
    assert hint_of_link(station, LINK) == f"Heard on {LINK} so far: 7/1 without heartbeat."


def test_frames_of_unknown_senders() -> None:
    """A client that only listens looks at parameters and heartbeats alone."""
    settings = SyncSettings.chosen(None, Policy.AUTO, listen_only=True, is_log=False)
    listening = Station(link=LINK, is_stream=False, sync_settings=settings)
    frame = messages.encode(TEXT, system=7, component=1, sequence=0, version=2)
    listening.receive(frame, "peer", 1.0)
    expected = f"1 MAVLink frame was received on {LINK}, but no heartbeat."
    assert hint_of_link(listening, LINK) == expected


def test_many_senders_are_counted(station: Station, hear: Hear) -> None:
    for system in range(1, SENDERS_MAX + 20):
        hear(TEXT, system, 190)
    reported = hint_of_link(station, LINK)
    assert reported.endswith(f"5/190 without heartbeat and {SENDERS_MAX - LISTED_MAX} more.")


def test_a_link_that_is_down(station: Station, hear: Hear) -> None:
    hear(PX4, 3)
    station.pause()
    assert hint_of_link(station, LINK) == f"{LINK} is down at present."
    machine = station.components[3, 1]
    assert hint_of_component(station, machine, 1.0, 2.0) == f"{LINK} is down at present."


# A component that does not answer


def answer(station: Station, since: float, now: float) -> str:
    return hint_of_component(station, station.components[3, 1], since, now)


def test_a_vehicle_that_sends_heartbeats_and_does_not_answer(station: Station, hear: Hear) -> None:
    for second in range(6):
        hear(PX4, 3, now=float(second))
    assert answer(station, 1.0, 5.5) == (
        "3/1 sends heartbeats (the last one 0.5 s ago) and answers no request: requests do not reach it, or "
        "it ignores them. Check the link towards the vehicle, and whether the vehicle requires signed "
        "messages."
    )
    station.components[3, 1].round_trip.smoothed = 0.1
    assert answer(station, 1.0, 5.5) == (
        "3/1 sends heartbeats (the last one 0.5 s ago) and answered other requests: the link may lose "
        "packets, or the vehicle is busy."
    )


def test_a_vehicle_that_has_fallen_silent(station: Station, hear: Hear) -> None:
    for second in range(3):
        hear(PX4, 3, now=float(second))
    hear(GCS, 252, 190, now=1.5)
    assert answer(station, 2.5, 9.0) == f"Nothing was received on {LINK} for 7.0 s."
    hear(GCS, 252, 190, now=8.5)
    assert answer(station, 2.5, 9.0) == (
        f"3/1 has sent nothing for 7.0 s; heard meanwhile on {LINK}: only 252/190 ground station."
    )


def test_a_component_without_heartbeats(station: Station, hear: Hear) -> None:
    hear(messages.ParamValue("A", bytes(4), 9, 1, 0), 3, now=2.0)
    assert answer(station, 1.0, 3.0).startswith("3/1 sends messages (the last one 1.0 s ago) and answers no")
    assert answer(station, 2.5, 4.0) == f"Nothing was received on {LINK} for 2.0 s."


def test_a_client_that_only_listens_requests_nothing(station: Station, hear: Hear) -> None:
    hear(PX4, 3)
    station.listens_only = True
    assert answer(station, 1.0, 60.0) == ""
