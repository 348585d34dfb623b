"""Base of simulated components: power, framing, signing, heartbeat, telemetry and commands."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import ClassVar, Final

from paramclient.errors import CommandResult
from paramclient.sim.param_table import check_range
from paramclient.wire import frames, messages, signing

OUT_LIMIT: Final = 20_000
"""Frames that an endpoint keeps for `data_to_send`; further ones are dropped to bound the memory."""


@dataclass(kw_only=True, eq=False, repr=False)
class Device:
    """A simulated component that is switched on and off, sends heartbeats, and executes commands.

    `Vehicle` adds the parameters, and documents the arguments and attributes.

    All work is a method with one argument, the time at which it is due. `_due` has them with that time, in
    the order in which work of one time is done; infinity stands for work that is not due.
    """

    vehicle_count: ClassVar = 1
    """See `Air.vehicle_count`."""
    _ack_first: ClassVar = True
    """Whether COMMAND_ACK precedes the requested message."""
    _restart_delay: ClassVar = 0.3
    """Seconds from accepting a reboot command until the vehicle switches off."""
    _armed_result: ClassVar = CommandResult.DENIED
    """MAV_RESULT of a reboot command while armed."""
    _shutdown_result: ClassVar = CommandResult.UNSUPPORTED
    """MAV_RESULT of the command with another value than that of a reboot."""
    _takes_broadcasts: ClassVar = True
    """Whether requests to system 0 are answered."""
    _clock_delay: ClassVar = 0.0
    """Seconds from the first heartbeat until SYSTEM_TIME is sent, also on request."""
    _clock_lead: ClassVar = 0.0
    """Seconds on the boot clock at the first message."""
    _state_after_reboot = (messages.MAV_STATE_ACTIVE, 0.0)
    """The MAV_STATE after a reboot, and its duration in seconds."""

    system: int = 1
    component: int = 1
    armed: bool = False
    boot_time: float = 0.0
    telemetry: float = 0.0
    mavlink_version: int = 2
    stream: bool = False
    signing_key: signing.SigningKey | None = None
    signing_timestamp: int = 0
    usb: bool = False
    reboot_down: float = 1.0

    def _set_up(self, heartbeat: messages.Heartbeat, version: messages.AutopilotVersion) -> None:
        """Check the arguments, and prepare the first start."""
        check_range(1, 255, system=self.system, component=self.component)
        self._heartbeat = heartbeat
        self.version = version
        self.requests: Counter[str] = Counter()
        self._framer = frames.Framer(messages.DECODED_IDS, stream=self.stream)
        self._out: list[bytes] = []
        self._is_first_run = True
        self._now = -math.inf
        self._take_key(self.signing_key, self.signing_timestamp)
        self._switch_on(math.inf)

    @property
    def signing_report(self) -> signing.SigningReport | None:
        """The statistics of received signatures; None without a key."""
        return None if self._verifier is None else self._verifier.report()

    def reboot(self, now: float | None = None, *, down: float = 0.0) -> None:
        """Switch off at `now`, and on again `down` seconds later, never if that is `math.inf`.

        Ends all operations. Data received while switched off is lost, as is data waiting in `data_to_send`.
        The values stay, and those that take effect after a reboot do. Without `now`, reboots at the time of
        the last call.
        """
        if now is not None:
            self._now = now
        self._restart(self._now, down)
        self.tick(self._now)

    def receive(self, data: bytes, now: float) -> None:
        """Take received data at the time `now`."""
        self.tick(now)
        if now >= self._on_at:
            for frame in self._framer.receive(data):
                self._take(frame)
            self._work(now)

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`."""
        is_first, self._now = self._now == -math.inf, now
        if self._signer is not None:
            self._signer.advance(now)
        if is_first:
            self._switch_on(now)
        self._work(now)

    def next_deadline(self) -> float | None:
        """Return the time of the next work; None before the first call, and if switched off permanently."""
        due = self._on_at if self._now < self._on_at else min(self._due.values())
        return None if due == math.inf else due

    def data_to_send(self) -> list[bytes]:
        """Return the frames to send, and clear them."""
        out, self._out = self._out, []
        return out

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        """Respond to a message for this component. A subclass may ignore some, or respond otherwise."""
        if isinstance(message, messages.CommandLong):
            self._on_command(message, sender)
        elif isinstance(message, messages.SetupSigning) and not self.armed:
            self._take_key(message.key, message.initial_timestamp)

    def send(self, message: messages.Message) -> None:
        """Send a message. A subclass may drop some, or send others instead."""
        self._send_frame(messages.encode, message)

    # Time

    def _switch_on(self, at: float) -> None:
        """Reset the state, and switch on at the time `at`; `math.inf` leaves the component off."""
        self._on_at = at
        self._sequence = 0
        self._due: dict[Callable[[float], None], float] = dict.fromkeys(self._tasks(), math.inf)
        self._due[self._send_heartbeat] = at
        if self.telemetry:
            self._due[self._send_telemetry] = at + 1.0 / self.telemetry
        self._forget_streams()

    def _tasks(self) -> list[Callable[[float], None]]:
        """Return all kinds of work, in the order of work that is due at one time."""
        return [self._restart, self._send_system_time, self._send_heartbeat, self._send_telemetry]

    def _work(self, now: float) -> None:
        """Do the due work."""
        while now >= self._on_at:
            task, at = min(self._due.items(), key=itemgetter(1))
            if at > now:
                return
            self._due[task] = math.inf
            task(at)

    def _sooner(self, task: Callable[[float], None], at: float) -> None:
        """Do the work at this time, if it is not due before."""
        self._due[task] = min(self._due[task], at)

    def _again(self, at: float, period: float) -> float:
        """Return when repeated work is due next; a call that is late by more than 1 s skips periods."""
        return at + period if at + period > self._now - 1.0 else self._now + period

    # Implemented by subclasses

    def _end_all(self) -> None:
        """End all operations on switching off, and apply values that take effect after a reboot."""
        self._out.clear()
        self._framer.flush()

    def _send_clock(self, now: float) -> None:
        """Send the message with the time since boot, once a second."""
        self._send_system_time(now)

    def _time_boot_ms(self, now: float) -> int:
        """Return the time since switching on in milliseconds, in 32 bits."""
        return int((now - self._on_at + self._clock_lead) * 1000.0) & 0xFFFFFFFF

    # Internal

    def _take_key(self, key: signing.SigningKey | None, timestamp: int) -> None:
        """Sign with another key from now on, or not at all."""
        self.signing_key = key
        self._signer = None if key is None else signing.Signer(key, timestamp=timestamp)
        self._forget_streams()

    def _forget_streams(self) -> None:
        """Forget the timestamps of all signing streams, as after a start."""
        self._verifier = None
        if self._signer is not None:
            policy = signing.SigningPolicy.ACCEPT_ALL if self.usb else signing.SigningPolicy.UNSIGNED_RADIOS
            self._verifier = signing.Verifier(self._signer, policy, most_streams=_STREAMS_MAX)
        self._framer.guard = None if self._verifier is None else self._verifier.accepts

    def _restart(self, at: float, down: float | None = None) -> None:
        self._is_first_run = False
        self._end_all()
        self._switch_on(at + (self.reboot_down if down is None else down))

    def _send_heartbeat(self, at: float) -> None:
        self._due[self._send_heartbeat] = self._again(at, 1.0)
        self.send(self._beat)
        self._send_clock(self._now)

    def _send_system_time(self, at: float) -> None:
        self.send(messages.SystemTime(0, self._time_boot_ms(self._now)))

    @property
    def _beat(self) -> messages.Heartbeat:
        """The current heartbeat."""
        beat = self._heartbeat
        state, seconds = self._state_after_reboot
        if self._now < self._on_at + self.boot_time:
            beat = replace(beat, system_status=messages.MAV_STATE_BOOT)
        elif not self._is_first_run and self._now < self._on_at + seconds:
            beat = replace(beat, system_status=state)
        if self.armed:
            beat = replace(beat, base_mode=beat.base_mode | messages.MAV_MODE_FLAG_SAFETY_ARMED)
        return beat

    def _send_telemetry(self, at: float) -> None:
        self._due[self._send_telemetry] = self._again(at, 1.0 / self.telemetry)
        self._send_attitude()

    def _send_attitude(self) -> None:
        payload = self._time_boot_ms(self._now).to_bytes(4, "little") + _LEVEL_FLIGHT
        self._send_frame(frames.build_frame, _ATTITUDE, payload)

    def _send_frame(self, build: Callable[..., bytes], *content: object) -> None:
        """Send the frame that a function builds of this content."""
        ids = {"system": self.system, "component": self.component, "version": self.mavlink_version}
        frame = build(*content, **ids, sequence=self._sequence)
        self._sequence = (self._sequence + 1) & 0xFF
        if self._signer is not None:
            frame = frames.sign_frame(frame, self._signer)
        if len(self._out) < OUT_LIMIT:
            self._out.append(frame)

    def _take(self, frame: frames.Frame) -> None:
        message = messages.decode(frame)
        system, component = getattr(message, "target_system", -1), getattr(message, "target_component", -1)
        is_mine = system == self.system or (system == 0 and self._takes_broadcasts)
        if message is not None and is_mine and component in (messages.COMP_ID_ALL, self.component):
            self.requests[frames.message_name(frame.message_id)] += 1
            self.respond(message, frame)

    def _on_command(self, request: messages.CommandLong, sender: frames.Frame) -> None:
        wanted = request.param1 if request.command == messages.MAV_CMD_REQUEST_MESSAGE else math.nan
        if request.command == messages.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            if request.param1 != _REBOOT or self.armed:
                result = self._armed_result if self.armed else self._shutdown_result
                self._acknowledge(request, sender, result)
                return
            self._acknowledge(request, sender)
            self._sooner(self._restart, self._now + self._restart_delay)
        elif wanted == messages.message_id(messages.SystemTime):
            self._acknowledge(request, sender)
            self._due[self._send_system_time] = max(self._now, self._on_at + self._clock_delay)
        elif wanted == messages.message_id(messages.Heartbeat):
            self._acknowledge(request, sender, message=self._beat)
        elif wanted == _VERSION or request.command == messages.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            self._acknowledge(request, sender, message=self.version)
        else:
            self._acknowledge(request, sender, CommandResult.UNSUPPORTED)

    def _acknowledge(
        self,
        request: messages.CommandLong,
        sender: frames.Frame,
        result: CommandResult = CommandResult.ACCEPTED,
        message: messages.Message | None = None,
    ) -> None:
        """Send COMMAND_ACK, with the requested message before or after it."""
        ack = messages.CommandAck(request.command, result, sender.system, sender.component)
        answers = [ack] if message is None else [ack, message]
        for answer in answers if self._ack_first else reversed(answers):
            self.send(answer)


_REBOOT = 1
"""Value of the command that reboots the autopilot; other values shut down, or stay in the bootloader."""
_VERSION = messages.message_id(messages.AutopilotVersion)
_ATTITUDE = 30
_LEVEL_FLIGHT = struct.pack("<6f", 0.0, 0.0, 0.5, 0.0, 0.0, 0.01)
_STREAMS_MAX = 16
"""MAVLINK_MAX_SIGNING_STREAMS of the C library, which both autopilots use."""
