"""COMMAND_LONG: retries until COMMAND_ACK reports the result."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Final

from paramclient.errors import CommandRefused, CommandResult, NoReply
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import CommandAttempts
from paramclient.protocol.wire import CommandAck, CommandLong

__all__ = ["Command", "Commands"]

CONFIRMATIONS_MAX: Final = 255
"""The largest value of the field that counts repetitions."""


class Command(Operation[None]):
    """One command until it is accepted; see `Commands`.

    Attributes:
        number: MAV_CMD.
        params: its seven parameters.
        request: its attempts.
    """

    def __init__(
        self, number: int, params: tuple[float, ...], request: CommandAttempts, begun_at: float
    ) -> None:
        super().__init__(begun_at)
        self.number = number
        self.params = params
        self.request = request

    @property
    def attempts(self) -> int:
        """How often it was sent."""
        return self.request.count


class Commands(Machine):
    """The commands to one component.

    An acknowledgement names only the command, so commands of one number run one after the other, and those of
    different numbers in parallel. Without an acknowledgement, a command is repeated after the measured
    timeout, with `confirmation` counted up, as often as a read would be.

    Args:
        context: the component's. Acknowledgements to other stations are ignored.
    """

    def __init__(self, context: Context) -> None:
        self._target = context.target
        self._addressees = (context.own, (0, 0))  # MAVLink 1 and older firmware name no addressee
        self._policy = context.retry
        self._send = context.send
        self._queues: dict[int, deque[Command]] = {}

    def __len__(self) -> int:
        return len(self._queues)

    def begin(self, number: int, params: tuple[float, ...], now: float, *, repeats: bool = True) -> Command:
        """Send a command, or queue it behind those of the same number.

        Args:
            number: MAV_CMD.
            params: up to seven; the others are 0.
            now: the time.
            repeats: whether to repeat it automatically while it is not acknowledged; otherwise only `repeat`
                does.
        """
        request = CommandAttempts(self._policy, repeats=repeats)
        command = Command(number, (*params, *[0.0] * (7 - len(params))), request, now)
        queue = self._queues.setdefault(number, deque())
        queue.append(command)
        if len(queue) == 1:
            self.repeat(command, now)
        return command

    def repeat(self, command: Command, now: float) -> None:
        """Send a command in progress once more."""
        confirmation = min(command.attempts, CONFIRMATIONS_MAX)
        command.request.sent(now)
        self._send(CommandLong(*self._target, command.number, command.params, confirmation))

    def cancel(self, command: Command, now: float) -> None:
        """Cancel a command. A sent one cannot be recalled."""
        queue = self._queues.get(command.number)
        if queue is not None and command in queue:
            self._leave(command, now)

    def acknowledged(self, message: CommandAck, now: float) -> None:
        """Process a COMMAND_ACK."""
        queue = self._queues.get(message.command)
        if queue is None or (message.target_system, message.target_component) not in self._addressees:
            return
        command = queue[0]
        command.request.answered(now)
        if message.result == CommandResult.IN_PROGRESS:
            command.request.progress_at = now
            return
        self._leave(command, now)
        if message.result == CommandResult.ACCEPTED:
            command.finish(None, now)
        else:
            command.fail(CommandRefused(*self._target, command.number, message.result), now)

    def tick(self, now: float) -> None:
        """Repeat or give up unacknowledged commands."""
        for queue in list(self._queues.values()):
            command = queue[0]
            if command.request.due_at > now:
                continue
            command.request.timed_out()
            if command.request.is_hopeless(now):
                self._leave(command, now)
                command.fail(self._no_reply(command, now), now)
            else:
                self.repeat(command, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return min((queue[0].request.due_at for queue in self._queues.values()), default=math.inf)

    def resume(self, now: float) -> None:
        """Repeat commands in progress: the link is back."""
        for queue in self._queues.values():
            if queue[0].request.repeats:
                queue[0].request.uncount()
                self.repeat(queue[0], now)

    def lose(self, now: float, why: str = " (lost)") -> None:
        """End all commands: the component is lost. Whether it has executed any is unknown."""
        self._end_all(lambda command: self._no_reply(command, now, why), now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End all commands with the error."""
        self._end_all(lambda command: error, now)

    def _leave(self, command: Command, now: float) -> None:
        queue = self._queues[command.number]
        was_first = queue[0] is command
        queue.remove(command)
        if not queue:
            del self._queues[command.number]
        elif was_first:
            self.repeat(queue[0], now)

    def _end_all(self, error_of: Callable[[Command], Exception], now: float) -> None:
        queues, self._queues = self._queues, {}
        for queue in queues.values():
            for command in queue:
                command.fail(error_of(command), now)

    def _no_reply(self, command: Command, now: float, why: str = "") -> NoReply:
        system, component = self._target
        awaited = f"COMMAND_ACK for command {command.number} from {system}/{component}{why}"
        return NoReply(awaited, attempts=command.attempts, waited=now - command.begun_at)
