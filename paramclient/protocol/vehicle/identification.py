"""Identity and parameter encoding of a component, from HEARTBEAT and AUTOPILOT_VERSION."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from paramclient.model.identity import Identity
from paramclient.model.values import Encoding
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.retry import VersionAttempts
from paramclient.protocol.vehicle.commands import MessageRequest, MessageRequests
from paramclient.protocol.wire import (
    AUTOPILOT_VERSION_ID,
    CAPABILITY_FTP,
    CAPABILITY_PARAM_ENCODE_BYTEWISE,
    CAPABILITY_PARAM_ENCODE_C_CAST,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_TYPE_GCS,
    AutopilotVersion,
    Heartbeat,
    HighLatency2,
)

__all__ = ["Identification", "judge_encoding"]

PX4_WITH_FILE: Final = 0x01120000
"""flight_sw_version of the first PX4 that serves the packed parameter file: 1.18."""
ARDUPILOT_WITH_DEFAULTS: Final = 0x04040000
"""flight_sw_version of the first ArduPilot of which every build adds the defaults to that file: 4.4. They
were added during the development of 4.3."""
HEARTBEAT_WAIT: Final = 3.0
"""Seconds for which the encoding stays open after a version without encoding bits and before a heartbeat:
autopilots send one every second."""
ENCODING_CAPABILITIES: Final = CAPABILITY_PARAM_ENCODE_BYTEWISE | CAPABILITY_PARAM_ENCODE_C_CAST
"""The capability bits that show the encoding."""


def judge_encoding(
    chosen: Encoding | None, capabilities: int | None, autopilot: int | None
) -> tuple[Encoding, str]:
    """Return the encoding of a component and the reason, by the first available evidence.

    The user's choice; the capability bits of AUTOPILOT_VERSION; the autopilot in its own heartbeat; the
    standard. ArduPilot sets neither capability bit, PX4 before 1.12 neither, and MAV_PROTOCOL_CAPABILITY_
    PARAM_FLOAT is set by both, so it proves nothing (measured).

    Args:
        chosen: the user's choice, or None.
        capabilities: the bits of AUTOPILOT_VERSION, or None while unknown.
        autopilot: MAV_AUTOPILOT, or None before a heartbeat.
    """
    if chosen is not None:
        return chosen, "chosen by the user"
    bits = capabilities or 0
    if bits & CAPABILITY_PARAM_ENCODE_BYTEWISE:
        return Encoding.BYTEWISE, "the vehicle's capability PARAM_ENCODE_BYTEWISE"
    if bits & CAPABILITY_PARAM_ENCODE_C_CAST:
        return Encoding.C_CAST, "the vehicle's capability PARAM_ENCODE_C_CAST"
    if autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
        return Encoding.C_CAST, "its heartbeat says ArduPilot, which casts values to float"
    if autopilot == MAV_AUTOPILOT_PX4:
        return Encoding.BYTEWISE, "its heartbeat says PX4, which sends values byte by byte"
    return Encoding.BYTEWISE, "the standard's encoding, as nothing says otherwise"


class Identification(Machine):
    """Follows a component's heartbeat, requests its AUTOPILOT_VERSION, and derives identity and encoding.

    Args:
        context, messages: the component's.
        link: the link's name.
        chosen: the encoding that the user has chosen, or None.

    Attributes:
        identity: the vehicle's identity; without a hardware id until AUTOPILOT_VERSION is received.
        known_at: when the version was received; minus infinity before.
        doubted_at: since when the identity is in doubt; minus infinity before the first doubt.
        settled: whether `identity` is as complete as it gets: the version was received, or never will be.
        autopilot, vehicle_type: of the heartbeat; None before the first.
        encoding, encoding_reason: the parameter encoding and its evidence.
    """

    def __init__(
        self,
        context: Context,
        messages: MessageRequests,
        link: str,
        chosen: Encoding | None,
    ) -> None:
        self._context = context
        self._target = context.target
        self._messages = messages
        self._attempts = VersionAttempts(context.retry)
        self._request: MessageRequest | None = None
        self._chosen = chosen
        self._may_ask = context.may_send
        self.identity = Identity(context.target[0], link)
        self.settled = False
        self.known_at = -math.inf
        self.autopilot: int | None = None
        self.vehicle_type: int | None = None
        self.capabilities: int | None = None
        self.doubted_at = -math.inf
        self._beat_awaited_until = math.inf  # while a heartbeat may still show the encoding
        self._received_at = -math.inf
        self._was_doubted = False  # since the last version
        self._is_high_latency = False
        self.encoding, self.encoding_reason = judge_encoding(chosen, None, None)
        self._derive()

    @property
    def attempts(self) -> int:
        """Requests since the identity was open."""
        return self._attempts.count

    @property
    def has_parameters(self) -> bool:
        """Whether it may have parameters: it is not a ground station."""
        return self.vehicle_type != MAV_TYPE_GCS

    @property
    def claims_parameter_file(self) -> bool:
        """Whether it claims to serve files, including the packed parameter file.

        PX4 has claimed so since long before it had that file: 1.17 responds "file not found" (measured). An
        ArduPilot, which mostly has it, counts as having it until its version says otherwise.
        """
        if self.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA and self.capabilities is None:
            return True
        has_none = self.autopilot == MAV_AUTOPILOT_PX4 and self.identity.firmware < PX4_WITH_FILE
        return bool((self.capabilities or 0) & CAPABILITY_FTP) and not has_none

    @property
    def adds_defaults(self) -> bool:
        """Whether it is known to serve that file with defaults, if it serves it."""
        is_ardupilot = self.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA
        return is_ardupilot and self.identity.firmware >= ARDUPILOT_WITH_DEFAULTS

    @property
    def firmware(self) -> tuple[int, str] | None:
        """Its version and git hash; None before they are received."""
        return None if self.known_at == -math.inf else (self.identity.firmware, self.identity.git_hash)

    @property
    def encoding_is_certain(self) -> bool:
        """Whether no further message can change the encoding."""
        has_said = self.autopilot in (MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4)
        is_known = self.settled and self._beat_awaited_until == math.inf
        return self._chosen is not None or has_said or is_known or not self.has_parameters

    @property
    def is_doubted(self) -> bool:
        """Whether another vehicle may have taken its place, and the response is awaited."""
        return self._context.is_doubted

    @property
    def is_unconfirmed(self) -> bool:
        """Whether another vehicle may have taken its place, and its identity was requested without
        success."""
        return self._context.may_be_another and not self._context.is_identifying and self._may_ask

    @property
    def is_certain(self) -> bool:
        """Whether its encoding is known and no other vehicle may have taken its place.

        Writes also need a certain recipient, see `ComponentMachine.may_be_written`.
        """
        return self.encoding_is_certain and not self._context.may_be_another

    @property
    def has_response(self) -> bool:
        """Whether it has sent a heartbeat or its version, or its version was requested without success."""
        return self.vehicle_type is not None or self.settled

    @property
    def is_autopilot(self) -> bool:
        """Whether its heartbeat names an autopilot."""
        return self.autopilot not in (None, MAV_AUTOPILOT_INVALID) and self.has_parameters

    @property
    def is_asking(self) -> bool:
        """Whether its AUTOPILOT_VERSION is awaited."""
        return self._context.is_identifying

    def heartbeat(self, message: Heartbeat | HighLatency2) -> bool:
        """Process a heartbeat or HIGH_LATENCY2, and return whether the autopilot or vehicle type has
        changed."""
        self._beat_awaited_until = math.inf
        self._is_high_latency = isinstance(message, HighLatency2)
        is_another_kind = False
        if (message.autopilot, message.type) != (self.autopilot, self.vehicle_type):
            is_another_kind = self.vehicle_type is not None
            self.autopilot = message.autopilot
            self.vehicle_type = message.type
            self.identity = replace(self.identity, autopilot=message.autopilot, vehicle_type=message.type)
            self._derive()
        return is_another_kind

    def receive(self, now: float) -> None:
        """Process any message: request the identity unless that was done."""
        self._received_at = now
        if not self.attempts and self.has_parameters:
            self._ask(now)

    def doubt(self, now: float) -> None:
        """Request the identity again: the component was lost, or has rebooted."""
        if self.has_parameters:
            is_open = self._may_ask and (self.settled or self._context.may_be_another)
            self._context.may_be_another = self.identity.uid is not None or is_open
            self._was_doubted = self._was_doubted or self.settled
            self.doubted_at = now
            if self.identity.uid is not None:
                self._attempts.extend_requests(now)
            self._ask(now)

    def forget(self, now: float) -> None:
        """Forget the identity and request it again: another vehicle uses the address."""
        system, link = self.identity.system, self.identity.link
        self.identity = Identity(system, link)
        self.settled = False
        self.known_at = -math.inf
        self.autopilot = self.vehicle_type = self.capabilities = None
        self._beat_awaited_until = math.inf
        self._derive()
        self._context.may_be_another = True
        self._was_doubted = False
        self.doubted_at = now
        self._attempts.extend_requests(now)
        self._ask(now)

    def version(self, message: AutopilotVersion, now: float) -> bool:
        """Process an AUTOPILOT_VERSION, and return whether the known state may be that of another vehicle.

        That is the case with a changed hardware id, with the first one where the vehicle may have been
        replaced, and with any after a time in which the identity was in doubt.
        """
        was_unconfirmed = self.is_unconfirmed
        self._messages.received(AUTOPILOT_VERSION_ID, now)
        self._context.is_identifying = self._context.may_be_another = False
        system, _ = self._target
        before = self.identity
        self.identity = Identity.from_version(
            system=system,
            link=before.link,
            autopilot=self.autopilot or 0,
            vehicle_type=self.vehicle_type or 0,
            uid=message.uid,
            uid2=message.uid2,
            firmware=message.flight_sw_version,
            git_hash=message.git_hash,
            board=message.board_version,
            vendor_id=message.vendor_id,
            product_id=message.product_id,
            capabilities=message.capabilities,
        )
        self.capabilities = message.capabilities
        self._derive()
        if self.autopilot is None and not message.capabilities & ENCODING_CAPABILITIES:
            self._beat_awaited_until = now + HEARTBEAT_WAIT
        is_known = before.uid is not None or self._was_doubted
        is_another = self.settled and is_known and before.key != self.identity.key
        self._was_doubted = False
        self.settled = True
        self.known_at = now
        return is_another or was_unconfirmed

    def ask_again(self, now: float) -> None:
        """Request the identity again, if it was ever received: another vehicle may have taken the address."""
        if self.identity.uid is not None and not self._context.is_identifying:
            self._ask(now)

    def lose(self, now: float) -> None:
        """Stop requests to an identified component until it is heard again; other requests continue."""
        if self.settled and self._request is not None:
            self._messages.end(self._request)
            self._context.is_identifying = False

    def tick(self, now: float) -> None:
        """Request the identity later once more, and stop waiting for a heartbeat."""
        if self._beat_awaited_until <= now:
            self._beat_awaited_until = math.inf
        if self._later_at <= now:
            self._attempts.sent_later(now)
            self._messages.send(AUTOPILOT_VERSION_ID)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return min(self._later_at, self._beat_awaited_until)

    @property
    def _later_at(self) -> float:
        """When to request the identity after it was requested without success, or infinity."""
        if self._received_at <= self._attempts.sent_at:
            return math.inf
        if self.is_unconfirmed:
            return self._attempts.later_at
        return self._attempts.first_later_at if self._was_never_answered else math.inf

    @property
    def _was_never_answered(self) -> bool:
        """Whether an autopilot was sent requests without any response, as where the link was dead in one
        direction.

        Cameras and radios often have no version. Requests over a satellite link cost money.
        """
        is_requested = self.settled and self.known_at == -math.inf and not self._context.is_identifying
        may_ask = self._may_ask and not self._is_high_latency and not self._attempts.is_denied
        return is_requested and may_ask and self.is_autopilot

    def _ask(self, now: float) -> None:
        """Begin to request the identity, or begin again."""
        self._attempts.restart()
        if self._may_ask:
            self._context.is_identifying = True
            request = self._request = self._messages.begin(AUTOPILOT_VERSION_ID, self._attempts, now)
            request.on_done.append(self._ended)

    def _ended(self) -> None:
        """Process the end of the request: the version was received, or never will be."""
        self._context.is_identifying = False
        if self._request is not None and self._request.error is not None:
            self.settled = True
            self._context.may_be_another = self._context.may_be_another and self.identity.uid is not None

    def _derive(self) -> None:
        """Derive encoding and identity from what the component has sent."""
        context = self._context
        context.autopilot = self.autopilot
        context.serves_file = self.claims_parameter_file
        context.adds_defaults = self.adds_defaults
        self.encoding, self.encoding_reason = judge_encoding(self._chosen, self.capabilities, self.autopilot)
