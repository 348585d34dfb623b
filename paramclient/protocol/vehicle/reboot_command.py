"""A reboot on command: the command, the silence, the return, and the proof that it is the same vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from paramclient.errors import AnotherVehicle, NoReply
from paramclient.model.identity import Identity
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import REBOOT_IDENTITY_REQUESTS
from paramclient.protocol.vehicle.boot_time_requests import BootTimeRequests
from paramclient.protocol.vehicle.commands import Command, Commands
from paramclient.protocol.vehicle.identification import Identification
from paramclient.protocol.vehicle.presence import Presence
from paramclient.protocol.wire import MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN

__all__ = ["Reboot", "Reboots"]

SAVING_TIME: Final = 2.5
"""Seconds from a write until the value survives a reboot: PX4 saves changed parameters up to 2 s later (its
`param_autosave` waits 0.3 s, and saves at most every 2 s)."""
CLOCK_TIMEOUT: Final = 2.5
"""Seconds after a silence in which SYSTEM_TIME, where the component sends it, shows the cause of the
silence."""
BOOT_TIME_STEP: Final = 0.15
"""Seconds by which a boot time must be later than the one before to show another boot: the latency of
messages differs."""
DOWN_DELAY: Final = 0.3
"""Seconds from the acknowledgement until a vehicle is certainly off: ArduPilot goes off after 0.2 s, and the
first frame of its new run arrives 0.31 s after the acknowledgement at the earliest (measured)."""
CLOCK_SILENCE: Final = 0.25
"""Seconds without a clock from a vehicle before its frame numbering counts: with telemetry the numbers pass 0
all the time."""
UNOBSERVED_TIMEOUT: Final = 10.0
"""Seconds after which an accepted reboot counts as done where nothing can show it: the component is heard
without a gap, sends no clock, and no MAV_STATE_BOOT."""


class Reboots(Machine):
    """The reboot on command of one component: at most one at a time, shared by all callers.

    Args:
        context, commands, identification, presence, boot_time_requests: the component's.
        restarted: called when the component has rebooted and nothing else has detected it; calls `rebooted`.

    Attributes:
        current: the reboot in progress or just ended, or None.
        saved_at: when the vehicle has saved all written values.
    """

    def __init__(
        self,
        context: Context,
        commands: Commands,
        identification: Identification,
        presence: Presence,
        boot_time_requests: BootTimeRequests,
        restarted: Callable[[float], None],
    ) -> None:
        self.current: Reboot | None = None
        self.saved_at = -math.inf
        self._context = context
        self._commands = commands
        self._identification = identification
        self._presence = presence
        self._boot_time_requests = boot_time_requests
        self._restarted = restarted

    @property
    def is_in_progress(self) -> bool:
        """Whether a reboot was commanded and is awaited."""
        return self.current is not None and not self.current.done

    def begin(self, now: float, *, returns: bool) -> Reboot:
        """Begin a reboot, or join the one in progress; give it back with `end`.

        Args:
            now: the time.
            returns: as in `Reboot`.
        """
        if self.current is None or self.current.done:
            self.current = Reboot(
                self._context,
                self._commands,
                self._identification,
                self._presence,
                self.saved_at,
                self._restarted,
                self._boot_time_requests,
                returns=returns,
                now=now,
            )
        self.current.waiters += 1
        return self.current

    def end(self, reboot: Reboot, now: float) -> None:
        """Give a reboot back. The last holder ends it; whether the command takes effect is then unknown."""
        reboot.waiters -= 1
        if not reboot.waiters:
            reboot.stop(now)
            if self.current is reboot:
                self.current = None

    def write_ended(self, now: float) -> None:
        """Process the end of a write: the vehicle saves the value within `SAVING_TIME`."""
        self.saved_at = now + SAVING_TIME

    def tick(self, now: float) -> None:
        """See `Machine`."""
        if self.current is not None:
            self.current.tick(now)

    def next_deadline(self) -> float:
        """See `Machine`."""
        return math.inf if self.current is None else self.current.next_deadline()

    def fail_all(self, error: Exception, now: float) -> None:
        """See `Machine`."""
        if self.current is not None:
            self.current.fail(error, now)

    def rebooted(self, now: float) -> None:
        """See `Reboot.rebooted`."""
        if self.current is not None:
            self.current.rebooted(now)

    def numbering_began(self, now: float) -> bool:
        """See `Reboot.numbering_began`."""
        return self.current is not None and self.current.numbering_began(now)

    def silence_ended(self, silence: float, now: float) -> None:
        """See `Reboot.silence_ended`."""
        if self.current is not None:
            self.current.silence_ended(silence, now)

    def vehicle_replaced(self, now: float) -> None:
        """See `Reboot.vehicle_replaced`."""
        if self.current is not None:
            self.current.vehicle_replaced(now)


class Reboot(Operation[None]):
    """MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN until the same vehicle is back, or until another one is.

    Before it, the identity must be known, or requested without success, and all written values must be saved.
    The command is repeated only while the component is heard: a component that has executed it and whose
    acknowledgement was lost would boot twice. The reboot is shown by its clock, by its heartbeat, or by a
    silence after which the clock does not continue; also without an acknowledgement. It ends when the
    identity is received (with the heartbeat, for a vehicle without a hardware id) and MAV_STATE_BOOT is over.
    It has no time limit of its own.

    Args:
        context, commands, identification, presence: the component's.
        saved_at: when the vehicle has saved all written values.
        restarted: called when the component has rebooted and nothing else has detected it; calls `rebooted`.
        boot_time_requests: the component's.
        returns: whether it returns under its address. Otherwise it ends with the acknowledgement, or with
            the silence.
        now: the time.

    Attributes:
        waiters: callers that wait for it.
        stage: what is awaited, as text.
    """

    def __init__(
        self,
        context: Context,
        commands: Commands,
        identification: Identification,
        presence: Presence,
        saved_at: float,
        restarted: Callable[[float], None],
        boot_time_requests: BootTimeRequests,
        *,
        returns: bool,
        now: float,
    ) -> None:
        super().__init__(now)
        self._target = context.target
        self._commands = commands
        self._identification = identification
        self._presence = presence
        self._saved_at = saved_at
        self._restarted = restarted
        self._boot_time_requests = boot_time_requests
        self._returns = returns
        self.waiters = 0
        self._command: Command | None = None
        self._before: Identity | None = None
        self._started_before: float | None = None
        self._accepted_at: float | None = None
        self._received_again_at: float | None = None  # after a silence of unknown cause
        self._numbering_began_at = -math.inf  # where that proves nothing
        self._back_at: float | None = None
        self._ask_at = -math.inf

    @property
    def attempts(self) -> int:
        """How often the command was sent."""
        return 0 if self._command is None else self._command.attempts

    @property
    def stage(self) -> str:
        system, component = self._target
        if self._back_at is not None:
            return f"who {system}/{component} is after its restart"
        if self._accepted_at is not None:
            return f"{system}/{component} to be back after its restart"
        return f"the restart of {system}/{component}"

    def rebooted(self, now: float) -> None:
        """Process a reboot that its clock or its heartbeat shows."""
        if self._command is None:
            return
        self._boot_time_requests.stop_following()
        if not self._returns:
            self.finish(None, now)
        self._back_at = now
        self._ask_at = now

    def numbering_began(self, now: float) -> bool:
        """Process a possible new frame numbering; return whether it shows a reboot.

        It does if the component has accepted the command, has had the time to go off, and sends no clock
        meanwhile. ArduPilot sends its clock only 1.4 s after its first heartbeat.
        """
        accepted_at = self._accepted_at
        if self.done or self._back_at is not None:
            return False
        self._numbering_began_at = now
        if accepted_at is None or now < accepted_at + DOWN_DELAY:
            return False
        if now < self._presence.clock_at + CLOCK_SILENCE:
            return False
        self._restarted(now)
        return True

    def silence_ended(self, silence: float, now: float) -> None:
        """Process the end of a long silence."""
        command = self._command
        if command is None or self._back_at is not None:
            return
        if min(silence, now - command.request.sent_at) >= self._presence.gap:
            self._received_again_at = now

    def vehicle_replaced(self, now: float) -> None:
        """End with an error: another vehicle uses the address."""
        if self._before is not None:
            self._fail_for_another(now)

    def stop(self, now: float) -> None:
        """End the reboot for all callers. A sent command cannot be recalled."""
        self._boot_time_requests.stop_following()
        if self._command is not None:
            self._commands.cancel(self._command, now)

    def tick(self, now: float) -> None:
        """Do what is due."""
        if not self.done:
            due, step = self._next_step()
            if due <= now:
                step(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return math.inf if self.done else self._next_step()[0]

    def _next_step(self) -> tuple[float, Callable[[float], None]]:
        command, presence, identification = self._command, self._presence, self._identification
        if command is None:
            return (self._saved_at if identification.settled else math.inf), self._begin
        if self._back_at is not None:
            if presence.is_booting:
                return math.inf, self._ask
            if self._is_identified_since(self._back_at):
                return -math.inf, self._compare
            return (math.inf if identification.is_asking else self._ask_at), self._ask
        if self._clock_shows_it(command.request.sent_at):
            return -math.inf, self._restarted
        if self._received_again_at is not None:
            return self._received_again_at + CLOCK_TIMEOUT, self._judge_silence
        if self._accepted_at is not None:
            due = max(self._accepted_at, presence.clock_at) + UNOBSERVED_TIMEOUT
            return (math.inf if presence.is_lost else due), self._restarted
        due = command.request.reboot_due_at(presence.beat_at)
        if self._numbering_began_at >= max(command.request.sent_at, presence.clock_at):
            due = max(due, self._numbering_began_at + CLOCK_TIMEOUT)  # may have executed it
        return due, self._repeat

    def _begin(self, now: float) -> None:
        self._before = self._identification.identity
        self._started_before = self._presence.started_at
        self._command = command = self._commands.begin(
            MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (1.0,), now, repeats=False
        )
        command.on_done.append(self._answered)
        self._boot_time_requests.follow(now)

    def _answered(self) -> None:
        command = self._command
        assert command is not None
        if command.error is None:
            self._accepted_at = command.ended_at
            if not self._returns:
                self.finish(None, command.ended_at)
        elif not isinstance(command.error, NoReply):
            self.fail(command.error, command.ended_at)
        elif not self._returns:
            self.finish(None, command.ended_at)  # lost, as expected

    def _repeat(self, now: float) -> None:
        command = self._command
        assert command is not None
        if command.done or command.request.is_reboot_hopeless:
            self.fail(NoReply(self.stage, attempts=command.attempts, waited=now - self.begun_at), now)
        else:
            self._commands.repeat(command, now)

    def _judge_silence(self, now: float) -> None:
        """Decide about the silence: the clock has had the time to show its cause."""
        received_again_at, self._received_again_at = self._received_again_at, None
        assert received_again_at is not None
        if (
            self._presence.clock_at < received_again_at
        ):  # a clock that had gone back would have ended the wait
            self._restarted(now)

    def _clock_shows_it(self, sent_at: float) -> bool:
        """Return whether it has booted since the command was sent, also with a young clock before."""
        started_at = self._presence.started_at
        if started_at is None or started_at < sent_at:
            return False
        return self._started_before is None or started_at >= self._started_before + BOOT_TIME_STEP

    def _ask(self, now: float) -> None:
        self._ask_at = now + REBOOT_IDENTITY_REQUESTS.later
        self._identification.doubt(now)

    def _is_identified_since(self, since: float) -> bool:
        assert self._before is not None
        if self._before.uid is None:
            return self._presence.beat_at >= since
        return self._identification.known_at >= since

    def _compare(self, now: float) -> None:
        assert self._before is not None
        if self._before.is_same_vehicle(self._identification.identity):
            self.finish(None, now)
        else:
            self._fail_for_another(now)

    def _fail_for_another(self, now: float) -> None:
        assert self._before is not None
        self.fail(AnotherVehicle(*self._target, str(self._before), str(self._identification.identity)), now)
