"""Identity, kind and parameter encoding of a component, from HEARTBEAT and AUTOPILOT_VERSION."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import anyio

from paramclient.errors import CommandResult, NoReply
from paramclient.model.identity import Identity, commit_text, hardware_id
from paramclient.model.values import Encoding
from paramclient.protocol.channel import FIRST_TIMEOUT, Channel
from paramclient.wire import messages
from paramclient.wire.frames import enum_word
from paramclient.wire.messages import Message, message_id

HEARTBEAT_WAIT: Final = 1.2
"""Seconds in which a component's first heartbeat is awaited: its interval, and a fifth of it for jitter."""
PX4_WITH_FILE: Final = 0x01120000
"""flight_sw_version of the first PX4 that serves the packed parameter file: 1.18."""
VERSION_ATTEMPTS_MAX: Final = 8
"""Requests for AUTOPILOT_VERSION: cameras and radios often have none, and a fetch waits for all of them."""
VERSION_COPIES: Final = 2
"""Copies of each repeated request: without its answer, a cached table cannot be loaded, and is downloaded."""
VERSION_ATTEMPTS_REFUSED: Final = 4
"""Requests after the first refusal, by both commands in turns: a refusal may concern only one of them."""
_AUTOPILOTS: Final = {messages.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot", messages.MAV_AUTOPILOT_PX4: "PX4"}
_VEHICLES: Final = {1: "plane", messages.MAV_TYPE_GCS: "ground station", 10: "rover", 11: "boat", 49: "radio"}
"""Names of MAV_TYPE for users, where they differ from those of the enumeration."""
_EXTENDED_TYPES: Final = frozenset({26, 30, 42, 44, 48})
"""MAV_TYPE of payloads: GIMBAL, CAMERA, WINCH, ILLUMINATOR, GRIPPER (MAVLink common message set)."""
_EXTENDED_COMPONENTS: Final = frozenset({*range(100, 106), 154, 159, 169, *range(171, 176), 243})
"""MAV_COMP_ID of payloads: CAMERA to CAMERA6, GIMBAL, QX1_GIMBAL, WINCH, GIMBAL2 to GIMBAL6, ILLUMINATOR."""


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
    if bits & messages.CAPABILITY_PARAM_ENCODE_BYTEWISE:
        return Encoding.BYTEWISE, "the vehicle's capability PARAM_ENCODE_BYTEWISE"
    if bits & messages.CAPABILITY_PARAM_ENCODE_C_CAST:
        return Encoding.C_CAST, "the vehicle's capability PARAM_ENCODE_C_CAST"
    if autopilot == messages.MAV_AUTOPILOT_ARDUPILOTMEGA:
        return Encoding.C_CAST, "its heartbeat says ArduPilot, which casts values to float"
    if autopilot == messages.MAV_AUTOPILOT_PX4:
        return Encoding.BYTEWISE, "its heartbeat says PX4, which sends values byte by byte"
    return Encoding.BYTEWISE, "the standard's encoding, as nothing says otherwise"


@dataclass(eq=False, repr=False)
class Identification:
    """What a component has said of itself.

    Args:
        identity: system id and link.
        chosen: the encoding that the user has chosen, or None.
        listens_only: whether nothing is requested, so that the heartbeat decides.

    Attributes:
        identity: the vehicle's identity; without a hardware id until AUTOPILOT_VERSION is received.
        chosen: as given.
        autopilot, vehicle_type: of the heartbeat; None before the first.
        capabilities: of AUTOPILOT_VERSION; None before it.
        encoding, encoding_reason: the parameter encoding and its evidence.
        is_settled: whether `identity` is as complete as it gets: the version was received, or never will be.
        is_confirmed: whether the vehicle has said who it is since it was lost, has rebooted or its link was
            interrupted; until then, values may be of another vehicle. One without a hardware id never says.
        vehicles: counts the vehicles of which it is certain that they are not the one before. One that was
            not known before it was lost counts as another one.
        former: the vehicle before; without a hardware id if that was not known.
        derived: called where the encoding, or whether it is certain, may have changed.
    """

    identity: Identity
    chosen: Encoding | None
    listens_only: bool = False
    autopilot: int | None = None
    vehicle_type: int | None = None
    capabilities: int | None = None
    is_settled: bool = False
    is_confirmed: bool = True
    vehicles: int = 0

    def __post_init__(self) -> None:
        self.encoding, self.encoding_reason = judge_encoding(self.chosen, None, None)
        self.former = self.identity
        self.derived: Callable[[], None] = lambda: None
        self._has_no_heartbeat = False
        self._changed = anyio.Event()

    @property
    def is_encoding_known(self) -> bool:
        """Whether the user, or the component's AUTOPILOT_VERSION, names the encoding."""
        bits = messages.CAPABILITY_PARAM_ENCODE_BYTEWISE | messages.CAPABILITY_PARAM_ENCODE_C_CAST
        has_bit = bool((self.capabilities or 0) & bits)
        return self.chosen is not None or has_bit or (self.is_ardupilot and self.capabilities is not None)

    @property
    def is_px4(self) -> bool:
        """Whether the component is a PX4."""
        return self.autopilot == messages.MAV_AUTOPILOT_PX4

    @property
    def is_ardupilot(self) -> bool:
        """Whether the component is an ArduPilot."""
        return self.autopilot == messages.MAV_AUTOPILOT_ARDUPILOTMEGA

    @property
    def is_autopilot(self) -> bool:
        """Whether the heartbeat names an autopilot."""
        return self.autopilot not in (None, messages.MAV_AUTOPILOT_INVALID) and self.has_parameters

    @property
    def has_parameters(self) -> bool:
        """Whether the component may have parameters: it is no ground station."""
        return self.vehicle_type != messages.MAV_TYPE_GCS

    @property
    def may_serve_file(self) -> bool:
        """Whether the component may serve its parameters as a file.

        PX4 has claimed so since long before it had that file: 1.17 responds "file not found" (measured). An
        ArduPilot, which mostly has it, counts as having it until its version says otherwise.
        """
        if self.is_ardupilot and self.capabilities is None:
            return True
        has_none = self.is_px4 and self.identity.firmware < PX4_WITH_FILE
        return bool((self.capabilities or 0) & messages.CAPABILITY_FTP) and not has_none

    @property
    def is_encoding_certain(self) -> bool:
        """Whether no further message can change the encoding."""
        if self.chosen is not None or self.is_px4 or self.is_ardupilot:
            return True
        if self.autopilot is None:  # an ArduPilot shows itself by its heartbeat alone
            return self.is_settled and (self.is_encoding_known or self._has_no_heartbeat)
        return self.is_settled or self.listens_only

    async def settled(self) -> None:
        """Wait until the identity is as complete as it gets."""
        while not self.is_settled:
            await self._changed.wait()

    async def heard(self) -> None:
        """Wait for the first heartbeat."""
        while self.autopilot is None:
            await self._changed.wait()

    async def encoding_certain(self) -> None:
        """Wait until no further message can change the encoding."""
        while not self.is_encoding_certain:
            await self._changed.wait()

    def heartbeat(self, message: messages.Heartbeat | messages.HighLatency2) -> bool:
        """Take a heartbeat, and return whether it is another kind of vehicle than before."""
        kind = (message.autopilot, message.type)
        before = (self.autopilot, self.vehicle_type)
        if kind == before:
            return False
        self.autopilot, self.vehicle_type = kind
        self.identity = replace(self.identity, autopilot=message.autopilot, vehicle_type=message.type)
        self._derive()
        return before != (None, None)

    def miss_heartbeat(self) -> None:
        """Take note that the component sends no heartbeat."""
        self._has_no_heartbeat = True
        self._derive()

    def version(self, message: messages.AutopilotVersion) -> bool:
        """Take an AUTOPILOT_VERSION, and return whether it is another vehicle's than the last one."""
        before = self.identity
        self.identity = replace(
            before,
            uid=hardware_id(message.uid, message.uid2),
            firmware=message.flight_sw_version,
            git_hash=commit_text(message.git_hash),
            board=message.board_version,
            vendor_id=message.vendor_id,
            product_id=message.product_id,
            capabilities=message.capabilities,
        )
        self.capabilities = message.capabilities
        is_another = before.uid is not None and before.key != self.identity.key
        if is_another or not (self.is_confirmed or before.uid):
            self.vehicles += 1
            self.former = before
        self.is_confirmed = True
        self.settle()
        return is_another

    def settle(self) -> None:
        """Take the identity as it is: no more of it will be received."""
        self.is_settled = True
        self.is_confirmed = self.is_confirmed or self.identity.uid is None
        self._derive()

    def doubt(self) -> None:
        """Take note that another vehicle may use the address."""
        self.is_confirmed = self.is_settled and self.identity.uid is None

    async def request(self, channel: Channel) -> None:
        """Request AUTOPILOT_VERSION until it is received, or the component has refused or left it unanswered.

        MAV_CMD_REQUEST_MESSAGE first; older firmware knows only MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES.
        """
        number = float(message_id(messages.AutopilotVersion))
        ways = (
            messages.CommandLong(*channel.target, messages.MAV_CMD_REQUEST_MESSAGE, number),
            messages.CommandLong(*channel.target, messages.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1.0),
        )
        keys = [messages.AutopilotVersion, *((messages.CommandAck, way.command) for way in ways)]
        refused: set[int] = set()

        def accept(message: Message) -> bool | None:
            if not isinstance(message, messages.CommandAck):
                return True
            is_refusal = message.result not in (CommandResult.ACCEPTED, CommandResult.IN_PROGRESS)
            if not is_refusal or message.command in refused:
                return None
            refused.add(message.command)
            return False

        def request_of(attempt: int) -> messages.CommandLong:
            return ways[ways[0].command in refused or (attempt >= 2 and attempt % 2 == 1)]

        with channel.inbox(*keys) as inbox, suppress(NoReply):
            while len(refused) < len(ways):
                if await channel.exchange(
                    request_of,
                    inbox,
                    accept,
                    what="AUTOPILOT_VERSION",
                    attempts=VERSION_ATTEMPTS_REFUSED if refused else VERSION_ATTEMPTS_MAX,
                    copies=lambda attempt: VERSION_COPIES if attempt else 1,
                    timeout_min=FIRST_TIMEOUT,  # for 2 s, as the vehicle may write to its flash
                ):
                    return
        self.settle()

    def _derive(self) -> None:
        self.encoding, self.encoding_reason = judge_encoding(self.chosen, self.capabilities, self.autopilot)
        self.derived()
        self._changed.set()
        self._changed = anyio.Event()


def kind_in_words(autopilot: int | None, kind: int | None) -> str:
    """Return autopilot and vehicle type as text, `PX4 quadrotor`; "" where neither is known or says
    anything.

    Args:
        autopilot: MAV_AUTOPILOT, or None.
        kind: MAV_TYPE, or None.
    """
    words = []
    if autopilot not in (None, messages.MAV_AUTOPILOT_GENERIC, messages.MAV_AUTOPILOT_INVALID):
        words.append(_AUTOPILOTS.get(autopilot) or enum_word("MAV_AUTOPILOT", autopilot))
    if kind is not None and (kind != messages.MAV_TYPE_GENERIC or not words):
        words.append(_VEHICLES.get(kind) or enum_word("MAV_TYPE", kind))
    return " ".join(words)


def expects_extended(vehicle_type: int | None, component: int) -> bool:
    """Return whether a component is of a kind that usually has extended parameters.

    Args:
        vehicle_type: MAV_TYPE of its heartbeat, or None before the first one.
        component: its component id.
    """
    return vehicle_type in _EXTENDED_TYPES or component in _EXTENDED_COMPONENTS
