"""Documents of the traffic on a link: components, message rates, packet loss, signatures, radios."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING

from pydantic import Field

from paramclient.documents.document import Document
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import rounded
from paramclient.wire.frames import enum_word
from paramclient.wire.messages import MAV_TYPE_GCS

if TYPE_CHECKING:
    from paramclient.client.traffic import ComponentTraffic, TrafficReport
    from paramclient.wire.signing import SigningReport

__all__ = ["ComponentTrafficDoc", "MessageTrafficDoc", "RadioDoc", "SigningDoc", "TrafficDoc"]


class SigningDoc(Document):
    """The state of signing on a link; see `SigningReport`."""

    fingerprint: str
    policy: str
    link_id: int
    signed: int
    unsigned: int
    unproven: dict[str, int]
    refused: dict[str, int]

    @classmethod
    def of(cls, report: SigningReport) -> SigningDoc:
        """Return the document of a `SigningReport`."""
        return cls(
            fingerprint=report.fingerprint,
            policy=report.policy,
            link_id=report.link_id,
            signed=report.signed,
            unsigned=report.unsigned,
            unproven={str(why): count for why, count in report.unproven.items()},
            refused={str(why): count for why, count in report.refused.items()},
        )


class MessageTrafficDoc(Document):
    """One kind of message from one component; see `MessageTraffic`."""

    id: int
    count: int
    per_s: float


class RadioDoc(Document):
    """The state that a telemetry radio reports; see `RadioStatus`."""

    rssi: int
    noise: int
    remote_rssi: int
    remote_noise: int
    free: int
    errors: int
    fixed: int


class ComponentTrafficDoc(Document):
    """The traffic of one component; see `ComponentTraffic`."""

    system: int
    component: int
    mavlink: int
    autopilot: str | None
    type: str | None
    state: str | None
    heartbeat_age_s: float | None
    age_s: float
    frames: int
    octets: int = Field(validation_alias="bytes", serialization_alias="bytes")
    frames_per_s: float
    bytes_per_s: float
    lost: int
    loss: float | None
    repeated: int
    late: int
    signed: int
    round_trip_s: float | None
    messages: dict[str, MessageTrafficDoc]
    radio: RadioDoc | None

    @classmethod
    def of(cls, each: ComponentTraffic, round_trip: float | None = None) -> ComponentTrafficDoc:
        """Return the document of a `ComponentTraffic`; `round_trip` in seconds, None if not measured."""
        beat = each.heartbeat
        return cls(
            system=each.system,
            component=each.component,
            mavlink=each.version,
            autopilot=None if beat is None else autopilot_name(beat.autopilot),
            type=None if beat is None else _type(beat.type),
            state=None if beat is None else enum_word("MAV_STATE", beat.system_status),
            heartbeat_age_s=rounded(each.heartbeat_age),
            age_s=round(each.age, 4),
            frames=each.frames,
            octets=each.bytes,
            frames_per_s=round(each.frame_rate, 2),
            bytes_per_s=round(each.byte_rate, 1),
            lost=each.lost,
            loss=None if each.loss is None else round(each.loss, 4),
            repeated=each.repeated,
            late=each.late,
            signed=each.signed,
            round_trip_s=rounded(round_trip),
            messages={
                message.name: MessageTrafficDoc(
                    id=message.message_id, count=message.count, per_s=round(message.rate, 2)
                )
                for message in each.messages
            },
            radio=None if each.radio is None else RadioDoc(**asdict(each.radio)),
        )


class TrafficDoc(Document):
    """The traffic of a link; see `TrafficReport`."""

    link: str
    seconds: float
    bytes_received: int
    bytes_sent: int
    received_per_s: float
    sent_per_s: float
    frames: int
    unknown: int
    damaged: int
    other_bytes: int
    signing: SigningDoc | None
    components: list[ComponentTrafficDoc]

    @classmethod
    def of(
        cls,
        link: str,
        report: TrafficReport,
        signing: SigningReport | None,
        round_trips: Mapping[tuple[int, int], float | None],
    ) -> TrafficDoc:
        """Return the document of a report.

        Args:
            link: the name of the link.
            report: its traffic.
            signing: the state of signing on the link, or None without a key.
            round_trips: round-trip times in seconds by (system, component).
        """
        return cls(
            link=link,
            seconds=round(report.seconds, 3),
            bytes_received=report.bytes_received,
            bytes_sent=report.bytes_sent,
            received_per_s=round(report.received_rate, 1),
            sent_per_s=round(report.sent_rate, 1),
            frames=report.frames,
            unknown=report.unknown,
            damaged=report.damaged,
            other_bytes=report.other_bytes,
            signing=None if signing is None else SigningDoc.of(signing),
            components=[
                ComponentTrafficDoc.of(each, round_trips.get((each.system, each.component)))
                for each in report.components
            ],
        )


def _type(number: int) -> str:
    """Return a MAV_TYPE in words."""
    return "ground station" if number == MAV_TYPE_GCS else enum_word("MAV_TYPE", number)
