"""A vehicle that lies: it answers every request with the most harmful response, and sends more without a
request."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import count
from random import Random
from typing import Final

from paramclient.wire import messages
from paramclient.wire.frames import Framer
from paramclient.wire.messages import (
    CAPABILITY_FTP,
    HASH_CHECK,
    NO_INDEX,
    AutopilotVersion,
    CommandAck,
    CommandLong,
    FileTransfer,
    Heartbeat,
    Message,
    ParamError,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    StatusText,
    SystemTime,
)

__all__ = ["ESCAPE", "LIES", "HostileVehicle"]

STEP: Final = 0.01
"""Seconds between two times at which it sends something without a request."""
ESCAPE: Final = "\x1b]0;\x07\x1b[2J"
"""Sets a terminal's title, and clears it."""
OWN: Final = (255, 190)


class HostileVehicle:
    """An endpoint that sends the given kinds of false messages, `rate` times in a hundredth of a second.

    Attributes:
        sent: messages so far.
    """

    def __init__(self, *lies: str, system: int = 66, autopilot: int = 12, rate: int = 2) -> None:
        self.sent = 0
        self._lies = [LIES[lie] for lie in lies]
        self._system = system
        self._autopilot = autopilot
        self._rate = rate
        self.random = Random(1)
        self.numbers = count()
        self._framer = Framer(messages.DECODED_IDS, stream=False)
        self._outbox: list[bytes] = []
        self._next_at = 0.0
        self._beat_at = 0.0

    def receive(self, data: bytes, now: float) -> None:
        """Hear the ground station; answer everything that is for us."""
        for frame in self._framer.receive(data):
            message = messages.decode(frame)
            if message is not None and getattr(message, "target_system", None) in (0, self._system):
                for lie in self._lies:
                    self.say_all(lie(self, message))

    def tick(self, now: float) -> None:
        """Say what is due."""
        if self._beat_at <= now:
            self._beat_at = now + 1.0
            self.say(Heartbeat(2, self._autopilot))
        if self._next_at <= now:
            self._next_at = now + STEP
            for _ in range(self._rate):
                for lie in self._lies:
                    self.say_all(lie(self, None))

    def next_deadline(self) -> float | None:
        return min(self._next_at, self._beat_at)

    def data_to_send(self) -> list[bytes]:
        outbox, self._outbox = self._outbox, []
        return outbox

    def say_all(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self.say(message)

    def say(self, message: Message, system: int | None = None, component: int = 1) -> None:
        """Say something, in the name of any sender."""
        self.sent += 1
        self._outbox.append(
            messages.encode(
                message,
                system=self._system if system is None else system,
                component=component,
                sequence=self.sent % 256,
            )
        )


Lie = Callable[[HostileVehicle, Message | None], Iterable[Message]]
"""The response to a request, or a message without one if that is None."""


def _value(name: str, number: int, count: int, index: int) -> ParamValue:
    return ParamValue(name, number.to_bytes(4, "little"), 6, count, index)


def _endless_names(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    yield _value(f"N{next(liar.numbers)}", 1, NO_INDEX, NO_INDEX)


def _jumping_counts(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """A list that never ends, each value with another count."""
    number = next(liar.numbers)
    yield _value(f"P{number % 50}", 1, liar.random.choice((50, 51, 900, 32_768, 65_534)), number % 50)


def _flipping_values(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    number = next(liar.numbers)
    yield _value(f"P{number % 50}", liar.random.getrandbits(8), 50, number % 50)


def _giant_indices(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    yield _value(f"P{next(liar.numbers) % 50}", 1, 32_768, liar.random.choice((32_767, 65_534, 40_000, 100)))


def _escape_codes(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    number = next(liar.numbers)
    yield _value(f"{ESCAPE}{number % 4}", 1, 4, number % 4)
    yield StatusText(3, f"Param write denied ({ESCAPE})"[:50])


def _others_answers(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """Answers for system 1, under our own address."""
    if isinstance(requested, ParamRequestRead | ParamSet):
        yield _value(requested.param_id or "P0", 0x7FFFFFFF, 4, NO_INDEX)
        yield ParamError(1, 1, requested.param_id, -1, 1)
    yield FileTransfer(0, *OWN, bytes((next(liar.numbers) % 256, 0, 1, 128, 4, 15, 1, 0)).ljust(251, b"\0"))


def _endless_errors(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    number = next(liar.numbers)
    yield ParamError(*OWN, f"P{number}", liar.random.choice((-1, number % 32_768)), number % 256)


def _restless_identity(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """Another vehicle with each message, and each with a parameter."""
    number = next(liar.numbers)
    yield AutopilotVersion(16, uid=number + 1)
    yield _value(f"V{number}", 1, 1, 0)


def _restless_clock(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    yield SystemTime(0, 1_000_000 if next(liar.numbers) % 2 else 0)
    yield _value(f"P{next(liar.numbers) % 50}", 1, 50, 0)


def _endless_hashes(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    yield ParamValue(HASH_CHECK, liar.random.randbytes(4), 5, liar.random.getrandbits(16), NO_INDEX)


def _dripping_list(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """A list of as many parameters as there can be, a value now and then; each read is answered."""
    number = next(liar.numbers)
    if isinstance(requested, ParamRequestRead) and requested.param_index >= 0:
        yield _value(f"D{requested.param_index}", 1, 32_768, requested.param_index)
    elif requested is None and number % 100 == 0:
        yield _value(f"D{number // 100}", 1, 32_768, number // 100 % 32_768)


def _endless_file(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """Opens every file, and answers each read with bytes from anywhere."""
    yield AutopilotVersion(16 | CAPABILITY_FTP, 0x01120000, uid=5)
    if isinstance(requested, FileTransfer):
        opcode, sequence = requested.payload[3], int.from_bytes(requested.payload[:2], "little") + 1
        offset = int.from_bytes(requested.payload[8:12], "little")
        content = b"\xff" * 4 if opcode == 4 else b"Fa\t1\0" * 40
        for step in range(8 if opcode == 15 else 1):
            there = liar.random.choice((offset + step * 200, offset, 0, 0xFFFFFF00, 1 << 20))
            head = ((sequence + step) & 0xFFFF).to_bytes(2, "little")
            head += bytes((requested.payload[2], 128, len(content), opcode, 0, 0)) + there.to_bytes(
                4, "little"
            )
            yield FileTransfer(0, *OWN, (head + content).ljust(251, b"\0"))


def _crumbs(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """Opens every file, and gives it byte by byte."""
    if isinstance(requested, FileTransfer):
        opcode, sequence = requested.payload[3], int.from_bytes(requested.payload[:2], "little") + 1
        offset = int.from_bytes(requested.payload[8:12], "little")
        content = (1 << 20).to_bytes(4, "little") if opcode == 4 else b"\x00"
        number = 30 if opcode == 15 else 1
        for step in range(number):
            head = ((sequence + step) & 0xFFFF).to_bytes(2, "little")
            head += bytes((requested.payload[2], 128, len(content), opcode, step == number - 1, 0))
            head += (offset + step).to_bytes(4, "little")
            yield FileTransfer(0, *OWN, (head + content).ljust(251, b"\0"))


def _obedient(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """Accepts every command, and does none; its list ends in the middle."""
    if isinstance(requested, CommandLong):
        yield CommandAck(requested.command, 0, *OWN)
    if isinstance(requested, ParamRequestList):
        for index in range(100):
            yield _value(f"P{index}", 1, 1000, index)


def _other_addresses(liar: HostileVehicle, requested: Message | None) -> Iterable[Message]:
    """Heartbeats, and now and then a value, from everywhere but system 1."""
    if requested is None:
        number = next(liar.numbers)
        system, component = 2 + number % 253, 1 + number // 253 % 255
        liar.say(Heartbeat(2, 12), system, component)
        if number % 7 == 0:
            liar.say(_value(f"X{number}", 1, 9, 0), system, component)
    return ()


LIES: Final[dict[str, Lie]] = {
    "endless names": _endless_names,
    "jumping counts": _jumping_counts,
    "flipping values": _flipping_values,
    "giant indices": _giant_indices,
    "escape codes": _escape_codes,
    "answers for others": _others_answers,
    "endless errors": _endless_errors,
    "restless identity": _restless_identity,
    "restless clock": _restless_clock,
    "endless hashes": _endless_hashes,
    "dripping list": _dripping_list,
    "endless file": _endless_file,
    "crumbs": _crumbs,
    "obedient": _obedient,
    "other addresses": _other_addresses,
}
