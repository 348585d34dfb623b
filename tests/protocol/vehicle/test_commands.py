"""Commands: COMMAND_LONG until COMMAND_ACK has said what becomes of it."""

from __future__ import annotations

import math

import pytest
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.retry import RetryPolicy
from paramclient.protocol.vehicle.commands import Command, Commands

from paramclient import CommandRefused, LinkError, NoReply, Refused
from paramclient.errors import CommandResult
from paramclient.wire.messages import CommandAck, CommandLong, Message
from tests.simulation import is_so

OWN = (255, 190)
NUMBER = 245
OTHER = 246


class Desk:
    """Commands to 1/1, and what they send, in a time of its own."""

    def __init__(self) -> None:
        self.sent: list[CommandLong] = []
        self.retry = RetryPolicy()
        self.round_trip = self.retry.round_trip
        self.round_trip.received_at = 0.0
        self.commands = Commands(Context((1, 1), self.take, OWN, self.retry))

    def take(self, message: Message) -> None:
        assert isinstance(message, CommandLong)
        self.sent.append(message)

    def acknowledge(self, result: int, now: float, number: int = NUMBER, to: tuple[int, int] = OWN) -> None:
        self.commands.acknowledged(CommandAck(number, result, *to), now)

    def run(self, until: float) -> float:
        """Do what is due; gives the time of the last thing."""
        now = 0.0
        while (due := self.commands.next_deadline()) <= until:
            assert due >= now
            now = due
            self.commands.tick(now)
        return now


def test_an_accepted_command_ends() -> None:
    desk = Desk()
    command = desk.commands.begin(NUMBER, (1.0, 2.0), 0.0)
    assert desk.sent == [CommandLong(1, 1, NUMBER, (1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0)]
    assert not command.done
    desk.acknowledge(CommandResult.ACCEPTED, 0.2)
    assert (command.done, command.error, command.ended_at) == (True, None, 0.2)
    assert len(desk.commands) == 0
    assert desk.commands.next_deadline() == math.inf
    assert desk.round_trip.smoothed == 0.2


@pytest.mark.parametrize(
    "result",
    [each for each in CommandResult if each not in (CommandResult.ACCEPTED, CommandResult.IN_PROGRESS)],
)
def test_a_refusal_says_why(result: CommandResult) -> None:
    desk = Desk()
    command = desk.commands.begin(NUMBER, (), 0.0)
    desk.acknowledge(result, 0.2)
    error = command.error
    assert isinstance(error, CommandRefused)
    assert isinstance(error, Refused)
    assert (error.system, error.component, error.command, error.code) == (1, 1, NUMBER, result)
    assert error.reason == result.name.lower().replace("_", " ")
    assert error.reason in str(error)
    assert error.name is None


def test_an_unanswered_command_is_repeated_with_a_confirmation_count() -> None:
    desk = Desk()
    command = desk.commands.begin(NUMBER, (), 0.0)
    timeout = desk.retry.timeout
    desk.commands.tick(timeout * 0.9)
    assert command.attempts == 1
    desk.run(timeout * 2.5)
    assert [message.confirmation for message in desk.sent] == [0, 1, 2]
    desk.acknowledge(CommandResult.ACCEPTED, timeout * 2.6)
    assert command.done
    assert command.error is None


def test_silence_ends_it() -> None:
    desk = Desk()
    command = desk.commands.begin(NUMBER, (), 0.0)
    ended_at = desk.run(300.0)
    assert isinstance(command.error, NoReply)
    assert command.error.attempts == command.attempts == len(desk.sent) >= 5
    assert command.error.waited == ended_at < 60.0
    assert f"command {NUMBER} from 1/1" in str(command.error)
    assert len(desk.commands) == 0


def test_one_in_progress_is_waited_for_and_not_sent_again() -> None:
    desk = Desk()
    command = desk.commands.begin(NUMBER, (), 0.0)
    for now in (0.1, 8.0, 16.0):
        desk.acknowledge(CommandResult.IN_PROGRESS, now)
        desk.run(now + 7.0)
    assert len(desk.sent) == 1
    assert desk.round_trip.smoothed == pytest.approx(0.1)
    desk.acknowledge(CommandResult.ACCEPTED, 23.0)
    assert command.done
    assert command.error is None
    assert desk.round_trip.smoothed == pytest.approx(0.1)


def test_answers_to_others_are_not_for_us() -> None:
    desk = Desk()
    command = desk.commands.begin(NUMBER, (), 0.0)
    desk.acknowledge(CommandResult.DENIED, 0.1, to=(254, 190))
    desk.acknowledge(CommandResult.DENIED, 0.1, number=OTHER)
    assert is_so(not command.done)
    desk.acknowledge(CommandResult.ACCEPTED, 0.2, to=(0, 0))  # target 0/0 is a broadcast
    assert command.done
    assert command.error is None
    desk.acknowledge(CommandResult.DENIED, 0.3)  # once more, for nothing that is open
    assert command.error is None


@pytest.mark.parametrize("is_lost", [True, False])
def test_commands_end_when_the_component_is_lost_or_the_link_fails(is_lost: bool) -> None:
    desk = Desk()
    commands: list[Command] = [desk.commands.begin(number, (), 0.0) for number in (NUMBER, NUMBER, OTHER)]
    error = LinkError("gone", link="udp")
    if is_lost:
        desk.commands.lose(3.0)
    else:
        desk.commands.fail_all(error, 3.0)
    for command in commands:
        if is_lost:
            assert isinstance(command.error, NoReply)
            assert "lost" in str(command.error)
        else:
            assert command.error is error
    assert len(desk.commands) == 0
