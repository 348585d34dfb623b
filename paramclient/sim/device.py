"""Base of simulated components: power, framing, signing, heartbeat, telemetry and commands."""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import replace
from typing import Final, TypedDict

from paramclient.errors import CommandResult, UsageError
from paramclient.sim.air import OUT_LIMIT
from paramclient.wire import frames, messages, signing

__all__ = ["Device", "DeviceOptions"]


class DeviceOptions(TypedDict, total=False):
    """Arguments of every kind of component; see `Vehicle`."""

    boot_time: float
    telemetry: float
    mavlink_version: int
    stream: bool
    high_latency: bool
    signing_key: signing.SigningKey | None
    signing_timestamp: int
    usb: bool
    armed: bool
    reboot_ack: bool
    reboot_down: float


class Device:
    """A simulated component that is switched on and off, sends heartbeats, and executes commands.

    `Vehicle` adds the parameters, and documents the arguments and attributes.
    """

    vehicle_count: Final = 1
    """See `Air.vehicle_count`."""
    _ack_first = True
    """Whether COMMAND_ACK precedes the requested message."""
    _restart_delay = 0.3
    """Seconds from accepting a reboot command until the vehicle switches off."""
    _armed_result = CommandResult.DENIED
    """MAV_RESULT of a reboot command while armed."""
    _clock_delay = 0.0
    """Seconds from the first heartbeat until SYSTEM_TIME is sent, also on request."""
    _start_state: tuple[int, float] | None = None
    """MAV_STATE after a reboot, and its duration in seconds."""
    _next_telemetry: float

    def __init__(
        self,
        *,
        system: int,
        component: int,
        heartbeat: messages.Heartbeat,
        version: messages.AutopilotVersion,
        boot_time: float = 0.0,
        telemetry: float = 0.0,
        mavlink_version: int = 2,
        stream: bool = False,
        high_latency: bool = False,
        signing_key: signing.SigningKey | None = None,
        signing_timestamp: int = 0,
        usb: bool = False,
        armed: bool = False,
        reboot_ack: bool = True,
        reboot_down: float = 1.0,
    ) -> None:
        for what, number in (("system", system), ("component", component)):
            if not 1 <= number <= 255:
                raise UsageError(f"{what} must be a number from 1 to 255, not {number}")
        if mavlink_version not in (1, 2):
            raise UsageError(f"mavlink_version must be 1 or 2, not {mavlink_version}")
        if not boot_time >= 0.0:
            raise UsageError(f"boot_time must be a number of seconds from 0 up, not {boot_time}")
        if not 0.0 <= telemetry <= 10_000.0:
            raise UsageError(f"telemetry must be 0 to 10000 messages per second, not {telemetry}")
        if not reboot_down >= 0.0:
            raise UsageError(f"reboot_down must be a number of seconds from 0 up, not {reboot_down}")
        self.armed = armed
        self.system = system
        self.component = component
        self.requests: Counter[str] = Counter()
        self._high_latency = high_latency
        self._reboot_ack = reboot_ack
        self._reboot_down = reboot_down
        self._heartbeat = heartbeat
        self.version = version
        self._boot_time = boot_time
        self._telemetry_period = 1.0 / telemetry if telemetry else math.inf
        self._mavlink_version = mavlink_version
        self._framer = frames.Framer(messages.DECODED_IDS, stream=stream)
        self._usb = usb
        self._signer: signing.Signer | None = None
        self._verifier: signing.Verifier | None = None
        self._sequence = 0
        self._out: list[bytes] = []
        self._started = False
        self._is_first_run = True
        self._now = -math.inf
        self._switch_on(math.inf)
        self._take_key(signing_key, signing_timestamp)

    @property
    def signing_key(self) -> signing.SigningKey | None:
        """The current signing key; None without signing."""
        return None if self._signer is None else self._signer.key

    @property
    def signing_report(self) -> signing.SigningReport | None:
        """The statistics of received signatures; None without a key."""
        return None if self._verifier is None else self._verifier.report()

    @property
    def high_latency(self) -> bool:
        """Whether the component is in high-latency mode (PX4's `MAVLINK_MODE_IRIDIUM`); can be changed at any
        time.

        HIGH_LATENCY2 every 5 s then replaces heartbeat and telemetry; lists, files and pushes wait.
        """
        return self._high_latency

    @high_latency.setter
    def high_latency(self, is_on: bool) -> None:
        if is_on != self._high_latency:
            self._high_latency = is_on
            self._next_heartbeat = max(self._now, self._on_at)
            self._skip_suppressed()

    def reboot(self, now: float | None = None, *, down: float = 0.0) -> None:
        """Switch off at `now`, and on again `down` seconds later, never if that is `math.inf`.

        Ends all operations. Data received while switched off is lost, as is data waiting in `data_to_send`.
        The values stay, and those that take effect after a reboot do. Without `now`, reboots at the time of
        the last call.
        """
        if now is None:
            now = self._now
        self._started = True
        self._is_first_run = False
        self._end_all()
        self._switch_on(now + down)
        self.tick(now)

    def receive(self, data: bytes, now: float) -> None:
        """Take received data at the time `now`."""
        self.tick(now)
        if now >= self._on_at:
            for frame in self._framer.receive(data):
                self._take(frame)
            self._work(now)

    def tick(self, now: float) -> None:
        """Do all work that is due by `now`."""
        self._now = now
        if self._signer is not None:
            self._signer.advance(now)
        if not self._started:
            self._started = True
            self._switch_on(now)
        if self._restart_at <= now:
            self.reboot(self._restart_at, down=self._reboot_down)
            self._now = now
        if now >= self._on_at:
            self._work(now)

    def next_deadline(self) -> float | None:
        """Return the time of the next work; None before the first call, and if switched off permanently."""
        if self._now < self._on_at:
            return None if self._on_at == math.inf else self._on_at
        due = [self._next_heartbeat, self._restart_at, self._clock_due, *self._timers()]
        return min(due) if self._high_latency else min(self._next_transmission(), *due)

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
        self._queue(
            messages.encode(
                message,
                system=self.system,
                component=self.component,
                sequence=self._sequence,
                version=self._mavlink_version,
            )
        )

    # Implemented by subclasses

    def _answers_system(self, target: int) -> bool:
        return target in (0, self.system)

    def _timers(self) -> tuple[float, ...]:
        """Return deadlines other than those of heartbeat, telemetry and list."""
        return ()

    def _next_transmission(self) -> float:
        """Return the time of the next transmission that high-latency mode suppresses."""
        return self._next_telemetry

    def _end_all(self) -> None:
        """End all operations on switching off, and apply values that take effect after a reboot."""
        self._out.clear()
        self._framer.flush()

    def _may_restart(self, mode: int) -> int:
        """Return the MAV_RESULT of MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN with this first parameter."""
        if self.armed:
            return self._armed_result
        return CommandResult.ACCEPTED if mode == _REBOOT else CommandResult.UNSUPPORTED

    def _skip_suppressed(self) -> None:
        """Move deadlines that passed in high-latency mode to now, each only once."""
        self._next_telemetry = max(self._now, self._next_telemetry)

    def _switch_on(self, at: float) -> None:
        """Reset the state, and switch on at the time `at`; `math.inf` leaves the component off."""
        self._on_at = at
        self._sequence = 0
        self._restart_at = math.inf
        self._clock_due = math.inf
        self._next_heartbeat = at
        self._next_telemetry = at + self._telemetry_period
        self._forget_streams()

    def _work(self, now: float) -> None:
        """Do the due work, each part with its own period; a late call skips periods of repeated work."""
        if self._clock_due <= now:
            self._clock_due = math.inf
            self._send_system_time(now)
        if self._next_heartbeat <= now:
            pause = _HIGH_LATENCY_PAUSE if self._high_latency else 1.0
            self._send_heartbeat(now)
            self._next_heartbeat += pause
            if self._next_heartbeat <= now:
                self._next_heartbeat = now + pause
        if self._high_latency:
            return
        if self._next_telemetry <= now:
            late = now - self._next_telemetry
            for _ in range(int(min(late, 1.0) / self._telemetry_period) + 1):
                self._send_attitude(now)
            self._next_telemetry += (int(late / self._telemetry_period) + 1) * self._telemetry_period
            if self._next_telemetry <= now:
                self._next_telemetry = now + self._telemetry_period

    # Internal

    def _take_key(self, key: signing.SigningKey | None, timestamp: int) -> None:
        """Sign with another key from now on, or not at all."""
        self._signer = None if key is None else signing.Signer(key, timestamp=timestamp)
        self._forget_streams()

    def _forget_streams(self) -> None:
        """Forget the timestamps of all signing streams, as after a start."""
        self._verifier = None
        if self._signer is not None:
            policy = signing.SigningPolicy.ACCEPT_ALL if self._usb else signing.SigningPolicy.UNSIGNED_RADIOS
            self._verifier = signing.Verifier(self._signer, policy, most_streams=_STREAMS_MAX)
        self._framer.guard = None if self._verifier is None else self._verifier.accepts

    def _send_heartbeat(self, now: float) -> None:
        if self._high_latency:
            self.send(messages.HighLatency2(self._heartbeat.type, self._heartbeat.autopilot))
            return
        self.send(self._beat)
        self._send_clock(now)

    def _send_clock(self, now: float) -> None:
        """Send the message with the time since boot, once a second."""
        self._send_system_time(now)

    def _send_system_time(self, now: float) -> None:
        self.send(messages.SystemTime(0, self._time_boot_ms(now)))

    def _time_boot_ms(self, now: float) -> int:
        """Return the time since switching on in milliseconds, in 32 bits."""
        return int((now - self._on_at) * 1000.0) & 0xFFFFFFFF

    @property
    def _beat(self) -> messages.Heartbeat:
        """The current heartbeat."""
        beat = self._heartbeat
        if self._start_state is not None and not self._is_first_run:
            state, seconds = self._start_state
            if self._now < self._on_at + seconds:
                beat = replace(beat, system_status=state)
        if self._now < self._on_at + self._boot_time:
            beat = replace(beat, system_status=messages.MAV_STATE_BOOT)
        if self.armed:
            beat = replace(beat, base_mode=beat.base_mode | messages.MAV_MODE_FLAG_SAFETY_ARMED)
        return beat

    def _send_attitude(self, now: float) -> None:
        self._queue(
            frames.build_frame(
                _ATTITUDE,
                self._time_boot_ms(now).to_bytes(4, "little") + _LEVEL_FLIGHT,
                system=self.system,
                component=self.component,
                sequence=self._sequence,
                version=self._mavlink_version,
            )
        )

    def _queue(self, frame: bytes) -> None:
        self._sequence = (self._sequence + 1) & 0xFF
        if self._signer is not None:
            frame = frames.sign_frame(frame, self._signer)
        if len(self._out) < OUT_LIMIT:
            self._out.append(frame)

    def _take(self, frame: frames.Frame) -> None:
        message = messages.decode(frame)
        if isinstance(message, messages.Heartbeat):
            self.requests["HEARTBEAT"] += 1
            return
        if not isinstance(
            message,
            messages.ParamRequestRead
            | messages.ParamRequestList
            | messages.ParamSet
            | messages.ParamExtRequestRead
            | messages.ParamExtRequestList
            | messages.ParamExtSet
            | messages.CommandLong
            | messages.FileTransfer
            | messages.SetupSigning,
        ):
            return
        if not self._answers_system(message.target_system):
            return
        if message.target_component not in (messages.COMP_ID_ALL, self.component):
            return
        self.requests[_NAMES[type(message)]] += 1
        self.respond(message, frame)

    def _on_command(self, request: messages.CommandLong, sender: frames.Frame) -> None:
        if request.command == messages.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            self._on_restart_command(int(request.param1), sender)
            return
        requested: messages.Message | None = None
        if request.command == messages.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            requested = self.version
        elif request.command == messages.MAV_CMD_REQUEST_MESSAGE:
            known: dict[float, messages.Message] = {
                messages.message_id(messages.AutopilotVersion): self.version,
                messages.message_id(messages.Heartbeat): self._beat,
            }
            requested = known.get(request.param1)  # a float, possibly NaN
            if request.param1 == messages.message_id(messages.SystemTime):
                self._on_clock_request(sender)
                return
        result = CommandResult.UNSUPPORTED if requested is None else CommandResult.ACCEPTED
        ack = messages.CommandAck(request.command, result, sender.system, sender.component)
        answers: list[messages.Message] = [ack] if requested is None else [ack, requested]
        for answer in answers if self._ack_first else reversed(answers):
            self.send(answer)

    def _on_clock_request(self, sender: frames.Frame) -> None:
        """Acknowledge a request for SYSTEM_TIME, and send the message as soon as the main loop runs."""
        number, result = messages.MAV_CMD_REQUEST_MESSAGE, CommandResult.ACCEPTED
        self.send(messages.CommandAck(number, result, sender.system, sender.component))
        self._clock_due = max(self._now, self._on_at + self._clock_delay)

    def _on_restart_command(self, mode: int, sender: frames.Frame) -> None:
        result = self._may_restart(mode)
        is_obeyed = result == CommandResult.ACCEPTED and mode == _REBOOT
        if is_obeyed:
            self._restart_at = min(self._restart_at, self._now + self._restart_delay)
        if self._reboot_ack or not is_obeyed:
            command = messages.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
            self.send(messages.CommandAck(command, result, sender.system, sender.component))


_NAMES = {
    messages.ParamRequestRead: "PARAM_REQUEST_READ",
    messages.ParamRequestList: "PARAM_REQUEST_LIST",
    messages.ParamSet: "PARAM_SET",
    messages.ParamExtRequestRead: "PARAM_EXT_REQUEST_READ",
    messages.ParamExtRequestList: "PARAM_EXT_REQUEST_LIST",
    messages.ParamExtSet: "PARAM_EXT_SET",
    messages.CommandLong: "COMMAND_LONG",
    messages.FileTransfer: "FILE_TRANSFER_PROTOCOL",
    messages.SetupSigning: "SETUP_SIGNING",
}
_REBOOT = 1
"""Value of the command that reboots the autopilot; other values shut down, or stay in the bootloader."""
_ATTITUDE = 30
_LEVEL_FLIGHT = struct.pack("<6f", 0.0, 0.0, 0.5, 0.0, 0.0, 0.01)
_HIGH_LATENCY_PAUSE = 5.0
"""Seconds between two HIGH_LATENCY2."""
_STREAMS_MAX = 16
"""MAVLINK_MAX_SIGNING_STREAMS of the C library, which both autopilots use."""
