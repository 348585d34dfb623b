"""COMMAND_LONG: retries until COMMAND_ACK reports the result, or until a requested message was received.

Everything that MAV_CMD_REQUEST_MESSAGE requests is requested here.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Container
from typing import Final

from paramclient.errors import CommandRefused, CommandResult, NoReply
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import CommandAttempts, MessageAttempts
from paramclient.protocol.wire import (
    AUTOPILOT_VERSION_ID,
    MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    MAV_CMD_REQUEST_MESSAGE,
    CommandAck,
    CommandLong,
    message_name,
)

__all__ = ["Command", "Commands", "MessageRequest", "MessageRequests", "message_requests"]

CONFIRMATIONS_MAX: Final = 255
"""The largest value of the field that counts repetitions."""
_OTHER_COMMANDS: Final = {AUTOPILOT_VERSION_ID: ((MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1.0),)}
"""Other commands that request a message, each with its first parameter: older firmware knows no
MAV_CMD_REQUEST_MESSAGE."""


def command_long(
    target: tuple[int, int], number: int, params: tuple[float, ...], confirmation: int = 0
) -> CommandLong:
    """Return the message of a command.

    Args:
        target: system and component.
        number: MAV_CMD.
        params: up to seven; the others are 0.
        confirmation: how often it was sent before.
    """
    return CommandLong(*target, number, (*params, *[0.0] * (7 - len(params))), confirmation)


def message_requests(target: tuple[int, int], message_id: int) -> tuple[CommandLong, ...]:
    """Return the commands that request a message, the usual one first.

    For senders without a component, or with a peer of their own; `MessageRequests` sends them to a component.
    """
    ways = ((MAV_CMD_REQUEST_MESSAGE, float(message_id)), *_OTHER_COMMANDS.get(message_id, ()))
    return tuple(command_long(target, number, (first,)) for number, first in ways)


class Command(Operation[None]):
    """One command until it is accepted; see `Commands`.

    Attributes:
        number: MAV_CMD.
        params: up to seven parameters; the others are 0.
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
        self._retry_policy = context.retry
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
        request = CommandAttempts(self._retry_policy, repeats=repeats)
        command = Command(number, params, request, now)
        queue = self._queues.setdefault(number, deque())
        queue.append(command)
        if len(queue) == 1:
            self.repeat(command, now)
        return command

    def repeat(self, command: Command, now: float) -> None:
        """Send a command in progress once more."""
        confirmation = min(command.attempts, CONFIRMATIONS_MAX)
        command.request.sent(now)
        self._send(command_long(self._target, command.number, command.params, confirmation))

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
            if command.request.should_give_up(now):
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


class MessageRequest(Operation[None]):
    """One message that is requested until it is received; see `MessageRequests`.

    Attributes:
        message_id: of the message.
        request: its attempts.
        refusals: results of the command that end the request with CommandRefused.
    """

    def __init__(
        self, message_id: int, request: MessageAttempts, refusals: Container[int], begun_at: float
    ) -> None:
        super().__init__(begun_at)
        self.message_id = message_id
        self.request = request
        self.refusals = refusals


class MessageRequests(Machine):
    """The messages that are requested from one component with MAV_CMD_REQUEST_MESSAGE.

    An acknowledgement names the command and not the message. While several messages are requested, it
    therefore ends none of them.

    Args:
        context: the component's. Acknowledgements to other stations are ignored.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._target = context.target
        self._addressees = (context.own, (0, 0))  # MAVLink 1 and older firmware name no addressee
        self._send = context.send
        self._open: dict[int, MessageRequest] = {}

    def begin(
        self, message_id: int, request: MessageAttempts, now: float, *, refusals: Container[int] = ()
    ) -> MessageRequest:
        """Request a message until it is received, refused or given up; `end` ends that as well.

        A request for this message that is open is replaced.

        Args:
            message_id: of the message.
            request: how it is repeated.
            now: the time.
            refusals: results of the command that end the request with CommandRefused. After other refusals it
                is repeated with another command, where there is one.
        """
        message_request = MessageRequest(message_id, request, refusals, now)
        self._open[message_id] = message_request
        self._context.is_requesting_message = True
        self.repeat(message_request, now)
        return message_request

    def repeat(self, message_request: MessageRequest, now: float) -> None:
        """Send a request in progress once more."""
        ways = message_requests(self._target, message_request.message_id)
        was_denied = message_request.request.is_denied
        message_request.request.sent(now)
        count = message_request.request.count
        if was_denied:
            ways = (ways[(count + 1) % len(ways)],)
        elif count == 1:
            ways = ways[:1]
        for message in ways:  # after silence all: a request or its response may have been lost
            self._send(message)

    def send(self, message_id: int) -> None:
        """Request a message once, with every command for it, without waiting for anything."""
        for message in message_requests(self._target, message_id):
            self._send(message)

    def end(self, message_request: MessageRequest) -> None:
        """Request a message no longer."""
        if self._open.get(message_request.message_id) is message_request:
            del self._open[message_request.message_id]
            self._context.is_requesting_message = bool(self._open)
            self._context.reschedule()  # clock requests wait for it, and no message follows

    def received(self, message_id: int, now: float) -> None:
        """Process the message: its request has succeeded."""
        message_request = self._open.get(message_id)
        if message_request is not None:
            message_request.request.answered(now)
            self.end(message_request)
            message_request.finish(None, now)

    def acknowledged(self, message: CommandAck, now: float) -> None:
        """Process a COMMAND_ACK."""
        if (message.target_system, message.target_component) not in self._addressees:
            return
        is_clear = len(self._open) == 1
        for message_request in list(self._open.values()):
            ways = message_requests(self._target, message_request.message_id)
            if message.command not in [way.command for way in ways]:
                continue
            if message.result in message_request.refusals and is_clear:
                message_request.request.answered(now)
                self.end(message_request)
                message_request.fail(CommandRefused(*self._target, message.command, message.result), now)
            elif message.result == CommandResult.ACCEPTED:
                message_request.request.accepted(now)
            else:
                message_request.request.denied(now)

    def tick(self, now: float) -> None:
        """Repeat or give up requests without a response."""
        for message_request in list(self._open.values()):
            if message_request.request.due_at > now:
                continue
            message_request.request.timed_out()
            if message_request.request.should_give_up(now):
                self.end(message_request)
                system, component = self._target
                what = f"{message_name(message_request.message_id)} of {system}/{component}"
                waited = now - message_request.begun_at
                message_request.fail(
                    NoReply(what, attempts=message_request.request.count, waited=waited), now
                )
            else:
                self.repeat(message_request, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        if not self._open:
            return math.inf
        return min(message_request.request.due_at for message_request in self._open.values())
