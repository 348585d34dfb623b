"""COMMAND_LONG: acknowledged commands, requested messages, and the reboot of a vehicle."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import anyio

from paramclient.errors import CommandRefused, CommandResult, NoReply, VehicleArmed
from paramclient.protocol.channel import Channel
from paramclient.protocol.node import Node
from paramclient.wire import messages
from paramclient.wire.messages import Message, message_id

M = TypeVar("M")

REBOOT_SILENCE = 0.2
"""Seconds without a message that a rebooting vehicle is off, at least: an ArduPilot is off 0.2 to 0.3 s after
its acknowledgement (measured)."""
OFF_SILENCE = 1.0
"""Seconds without a message after which a vehicle that did not acknowledge is off: a running one sends a
heartbeat in each."""
PRESENCE_INTERVAL = 0.02
"""Seconds between two looks at the presence of a vehicle that reboots."""
SAVING_TIME = 2.5
"""Seconds from a write until a PX4 has saved it: 0.3 s after it, and at most every 2 s (measured)."""


async def send_command(channel: Channel, command: messages.CommandLong) -> None:
    """Send a command until it is acknowledged.

    Raises:
        CommandRefused: the vehicle refused it.
        NoReply: it did not answer. The command may have been executed.
        LinkError: the link is closed for good.
    """

    def accept(message: Message) -> bool | None:
        assert isinstance(message, messages.CommandAck)
        if message.result == CommandResult.IN_PROGRESS:
            return None
        if message.result != CommandResult.ACCEPTED:
            raise CommandRefused(*channel.target, command.command, message.result)
        return True

    what = f"the acknowledgement of command {command.command} by {channel}"
    with channel.inbox((messages.CommandAck, command.command)) as inbox:
        await channel.exchange(command, inbox, accept, what=what)


async def request_message(channel: Channel, kind: type[M]) -> M | None:
    """Request a message with MAV_CMD_REQUEST_MESSAGE; return None if the vehicle refuses it.

    Raises:
        NoReply: the vehicle did not answer.
        LinkError: the link is closed for good.
    """
    number = float(message_id(kind))  # type: ignore[arg-type]  # one of the message classes
    request = messages.CommandLong(*channel.target, messages.MAV_CMD_REQUEST_MESSAGE, number)

    def accept(message: Message) -> M | bool | None:
        if isinstance(message, kind):
            return message
        assert isinstance(message, messages.CommandAck)
        return None if message.result in (CommandResult.ACCEPTED, CommandResult.IN_PROGRESS) else False

    with channel.inbox(kind, (messages.CommandAck, messages.MAV_CMD_REQUEST_MESSAGE)) as inbox:
        answer = await channel.exchange(request, inbox, accept, what=f"message {number:.0f} of {channel}")
    return answer if isinstance(answer, kind) else None


async def reboot(node: Node, *, returns: bool = True) -> None:
    """Reboot the vehicle, and wait until it is back and identified.

    The reboot is shown by the clock that goes back, by the state in the heartbeat, or by silence after the
    acknowledgement. The command is not repeated in silence: a vehicle whose acknowledgement was lost would
    reboot twice.

    Args:
        node: the vehicle's autopilot.
        returns: whether it returns under its ids; otherwise the call ends when it has gone off.

    Raises:
        VehicleArmed: the vehicle is armed.
        CommandRefused: it refused.
        NoReply: it did not answer, or did not come back.
        LinkError: the link is closed for good.
    """
    presence, channel = node.presence, node.channel
    if (presence.base_mode or 0) & messages.MAV_MODE_FLAG_SAFETY_ARMED:
        raise VehicleArmed(f"{channel} is armed: it was not rebooted", *channel.target)
    generation = node.generation

    def has_rebooted() -> bool:
        return node.generation != generation

    with channel.gate.until_closed():
        await anyio.sleep_until(node.plain.written_at + SAVING_TIME)
    command = messages.CommandLong(*channel.target, messages.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0)
    try:
        await send_command(channel, command)
    except NoReply:  # if the vehicle is silent too, it is off, and the acknowledgement was lost
        if not has_rebooted() and anyio.current_time() - presence.received_at < OFF_SILENCE:
            raise
    with channel.gate.until_closed():
        await _until(lambda: has_rebooted() or anyio.current_time() - presence.received_at >= REBOOT_SILENCE)
        if not returns:
            return
        silent_since = presence.received_at
        await _until(lambda: has_rebooted() or presence.received_at != silent_since)
        await _until(lambda: not (presence.is_booting or presence.is_lost))
    if not has_rebooted():
        node.rebooted(anyio.current_time())
    await node.identified()


async def _until(condition: Callable[[], bool]) -> None:
    while not condition():  # noqa: ASYNC110 - states, without an event
        await anyio.sleep(PRESENCE_INTERVAL)
