"""Who a component is, and how it writes values: by what evidence."""

from __future__ import annotations

import math

import pytest
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.retry import (
    RetryPolicy,
)
from paramclient.protocol.vehicle.commands import MessageRequests
from paramclient.protocol.vehicle.identification import Identification, judge_encoding

from paramclient.model.values import Encoding
from paramclient.wire.messages import (
    CAPABILITY_PARAM_ENCODE_BYTEWISE,
    CAPABILITY_PARAM_ENCODE_C_CAST,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_GENERIC,
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    MAV_CMD_REQUEST_MESSAGE,
    MAV_RESULT_ACCEPTED,
    MAV_RESULT_UNSUPPORTED,
    MAV_TYPE_GCS,
    AutopilotVersion,
    CommandAck,
    CommandLong,
    Heartbeat,
    Message,
    message_id,
)
from tests.simulation import is_so

OWN = (255, 190)
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
ARDUPILOT = Heartbeat(2, MAV_AUTOPILOT_ARDUPILOTMEGA)
CAMERA = Heartbeat(30, MAV_AUTOPILOT_INVALID)
GCS = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID)
ARDUPILOT_BITS = 64495
"""What ArduPilot 4.6 sets: neither of the encoding bits."""


class Desk:
    """The identification of component 1/1 and what it sends."""

    def __init__(self, chosen: Encoding | None = None) -> None:
        self.sent: list[Message] = []
        self.retry = RetryPolicy()
        self.trip = self.retry.round_trip
        self.context = Context((1, 1), self.sent.append, OWN, self.retry)
        self.messages = MessageRequests(self.context)
        self.who = Identification(self.context, self.messages, "udpin:x", chosen)

    def tick(self, now: float) -> None:
        self.messages.tick(now)
        self.who.tick(now)

    def next_deadline(self) -> float:
        return min(self.messages.next_deadline(), self.who.next_deadline())

    def beat(self, heartbeat: Heartbeat, now: float = 0.0) -> None:
        self.who.heartbeat(heartbeat)
        self.who.receive(now)

    def commands(self) -> list[int]:
        sent, self.sent[:] = list(self.sent), []
        for message in sent:
            assert isinstance(message, CommandLong)
            assert (message.target_system, message.target_component) == (1, 1)
        return [message.command for message in sent if isinstance(message, CommandLong)]

    def request_times(self, heartbeat: Heartbeat, since: int, until: int) -> list[float]:
        """When requests are sent while a heartbeat is received each second and nothing is answered."""
        times = []
        for second in range(since, until):
            self.beat(heartbeat, float(second))
            while (deadline := self.next_deadline()) < second + 1:
                self.tick(max(deadline, float(second)))
                times.extend([max(deadline, float(second))] if self.commands() else [])
        return times

    def let_it_be(self) -> None:
        """Let every request go unanswered."""
        while (deadline := self.next_deadline()) < math.inf:
            self.tick(deadline)


# the chain of evidence


@pytest.mark.parametrize(
    ("chosen", "capabilities", "autopilot", "expected", "reason"),
    [
        (Encoding.C_CAST, CAPABILITY_PARAM_ENCODE_BYTEWISE, 12, Encoding.C_CAST, "user"),
        (Encoding.BYTEWISE, None, 3, Encoding.BYTEWISE, "user"),
        (None, CAPABILITY_PARAM_ENCODE_BYTEWISE, 3, Encoding.BYTEWISE, "PARAM_ENCODE_BYTEWISE"),
        (None, CAPABILITY_PARAM_ENCODE_C_CAST, 12, Encoding.C_CAST, "PARAM_ENCODE_C_CAST"),
        (None, ARDUPILOT_BITS, 3, Encoding.C_CAST, "ArduPilot"),
        (None, None, 3, Encoding.C_CAST, "ArduPilot"),
        (None, 2, 12, Encoding.BYTEWISE, "PX4"),
        (None, 2, 0, Encoding.BYTEWISE, "standard"),
        (None, None, None, Encoding.BYTEWISE, "standard"),
        (None, None, 8, Encoding.BYTEWISE, "standard"),
    ],
)
def test_the_first_evidence_there_is_decides(
    chosen: Encoding | None, capabilities: int | None, autopilot: int | None, expected: Encoding, reason: str
) -> None:
    encoding, why = judge_encoding(chosen, capabilities, autopilot)
    assert encoding is expected
    assert reason in why


def test_when_the_encoding_is_certain() -> None:
    desk = Desk()
    assert not desk.who.encoding_is_certain
    desk.beat(Heartbeat(2, MAV_AUTOPILOT_GENERIC))
    assert not desk.who.encoding_is_certain
    for heartbeat in (ARDUPILOT, PX4, GCS):
        other = Desk()
        other.beat(heartbeat)
        assert other.who.encoding_is_certain
    assert Desk(Encoding.C_CAST).who.encoding_is_certain
    desk.let_it_be()
    assert desk.who.encoding_is_certain


# what kind it is


@pytest.mark.parametrize(
    ("heartbeat", "has_parameters", "is_autopilot"),
    [(PX4, True, True), (Heartbeat(2, 0), True, True), (CAMERA, True, False), (GCS, False, False)],
)
def test_the_heartbeat_has_autopilot_and_type(
    heartbeat: Heartbeat, has_parameters: bool, is_autopilot: bool
) -> None:
    desk = Desk()
    desk.beat(heartbeat)
    assert desk.who.has_parameters is has_parameters
    assert desk.who.is_autopilot is is_autopilot
    assert len(desk.commands()) == has_parameters
    assert (desk.who.autopilot, desk.who.vehicle_type) == (heartbeat.autopilot, heartbeat.type)


def test_before_a_heartbeat_it_is_no_autopilot() -> None:
    desk = Desk()
    assert desk.who.autopilot is None
    assert not desk.who.is_autopilot
    assert desk.who.has_parameters


# asking


def test_autopilot_version_is_requested_once() -> None:
    desk = Desk()
    desk.beat(PX4, 1.0)
    [message] = desk.sent
    assert isinstance(message, CommandLong)
    assert message.command == MAV_CMD_REQUEST_MESSAGE
    assert message.params[0] == message_id(AutopilotVersion)
    desk.beat(PX4, 1.1)
    assert len(desk.sent) == 1
    assert is_so(not desk.who.settled)
    desk.messages.acknowledged(CommandAck(MAV_CMD_REQUEST_MESSAGE, MAV_RESULT_ACCEPTED), 1.2)
    assert desk.next_deadline() > 1.2
    assert desk.who.version(AutopilotVersion(CAPABILITY_PARAM_ENCODE_BYTEWISE, uid=7), 1.2) is False
    assert desk.who.settled
    assert desk.next_deadline() == math.inf
    assert desk.trip.smoothed == pytest.approx(0.2)
    identity = desk.who.identity
    assert (identity.system, identity.link, identity.uid) == (1, "udpin:x", "0000000000000007")
    assert (identity.autopilot, identity.vehicle_type) == (MAV_AUTOPILOT_PX4, 2)


def test_a_refusal_leads_to_the_other_way_at_once() -> None:
    desk = Desk()
    desk.beat(PX4)
    desk.messages.acknowledged(CommandAck(MAV_CMD_REQUEST_MESSAGE, MAV_RESULT_UNSUPPORTED), 0.1)
    assert desk.next_deadline() == 0.1
    desk.tick(0.1)
    assert desk.commands() == [MAV_CMD_REQUEST_MESSAGE, MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES]


def test_a_refusal_to_another_station_means_nothing() -> None:
    desk = Desk()
    desk.beat(PX4)
    before = desk.next_deadline()
    desk.messages.acknowledged(CommandAck(MAV_CMD_REQUEST_MESSAGE, MAV_RESULT_UNSUPPORTED, 254, 190), 0.1)
    assert desk.next_deadline() == before
    desk.messages.acknowledged(CommandAck(MAV_CMD_REQUEST_MESSAGE, MAV_RESULT_UNSUPPORTED, *OWN), 0.1)
    assert desk.next_deadline() == 0.1


def test_a_version_that_others_have_requested_is_taken() -> None:
    desk = Desk()
    desk.who.version(AutopilotVersion(0, uid=7), 0.2)
    assert desk.who.settled
    assert desk.trip.smoothed is None


# another vehicle


def settled(uid: int) -> Desk:
    desk = Desk()
    desk.beat(PX4)
    desk.who.version(AutopilotVersion(CAPABILITY_PARAM_ENCODE_BYTEWISE, uid=uid), 0.1)
    desk.commands()
    return desk


def test_a_version_without_an_encoding_waits_for_a_heartbeat() -> None:
    """ArduPilot's version before its heartbeat: the standard's encoding would write a wrong value."""
    for heartbeat, encoding in ((ARDUPILOT, Encoding.C_CAST), (None, Encoding.BYTEWISE)):
        desk = Desk()
        desk.who.receive(10.0)
        desk.who.version(AutopilotVersion(ARDUPILOT_BITS), 10.1)
        assert is_so(not desk.who.is_certain)
        if heartbeat is None:  # one that never sends any keeps to the standard
            desk.tick(13.0)
            assert is_so(not desk.who.is_certain)
            assert desk.next_deadline() == 13.1
            desk.tick(13.1)
        else:
            desk.who.heartbeat(heartbeat)
        assert is_so(desk.who.is_certain)
        assert desk.who.encoding is encoding
        assert desk.next_deadline() == math.inf


def test_the_identity_is_requested_again_when_it_is_in_doubt() -> None:
    desk = settled(7)
    desk.beat(PX4, 20.0)
    assert desk.commands() == []
    assert is_so(desk.who.is_certain)
    desk.who.doubt(30.0)
    assert not desk.who.is_certain
    assert desk.commands() == [MAV_CMD_REQUEST_MESSAGE]
    assert desk.who.settled
    assert desk.who.version(AutopilotVersion(0, uid=7), 30.1) is False
    assert is_so(desk.who.is_certain)
    assert desk.who.version(AutopilotVersion(0, uid=8), 30.2) is True
    assert desk.who.identity.uid == "0000000000000008"


def test_a_vehicle_that_gave_no_id_before_is_not_another_one() -> None:
    desk = Desk()
    desk.beat(PX4)
    desk.let_it_be()
    assert desk.who.version(AutopilotVersion(0, uid=8), 30.0) is False
    assert desk.who.identity.key == "uid:0000000000000008"


def test_ids_of_no_single_vehicle_do_not_distinguish_vehicles() -> None:
    desk = settled(5283920058631409231)  # every simulated PX4 has it
    assert desk.who.version(AutopilotVersion(0, uid=5283920058631409231), 30.0) is False
    assert desk.who.version(AutopilotVersion(0, uid=9), 31.0) is True


def test_a_missing_response_leaves_what_is_known() -> None:
    desk = settled(7)
    desk.who.doubt(30.0)
    desk.let_it_be()
    assert not desk.who.is_doubted
    assert desk.who.identity.uid == "0000000000000007"
    assert desk.who.settled
