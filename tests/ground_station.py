"""A ground station with simulated time, and its messages, for tests of simulated vehicles."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TypeVar

from paramclient.model.values import Encoding, ParamType, Value, encode_value
from paramclient.sim import Endpoint
from paramclient.wire import frames, messages

SMALL: dict[str, Value | tuple[ParamType | int, Value]] = {
    "A_FLOAT": 1.5,
    "B_INT": 7,
    "C_BYTE": (ParamType.UINT8, 200),
    "D_SHORT": (ParamType.INT16, -3),
}
LIST = messages.ParamRequestList(1, 1)

M = TypeVar("M")


def read(
    name: str = "", index: int = -1, *, system: int = 1, component: int = 1
) -> messages.ParamRequestRead:
    return messages.ParamRequestRead(system, component, name, index)


def write(
    name: str, value: float, kind: int, *, cast: bool = False, system: int = 1, component: int = 1
) -> messages.ParamSet:
    raw = encode_value(value, kind, Encoding.C_CAST if cast else Encoding.BYTEWISE)
    return messages.ParamSet(system, component, name, raw, kind)


def cast(name: str, value: float, kind: int = ParamType.REAL32) -> messages.ParamSet:
    """Return a PARAM_SET in ArduPilot's encoding, for every value."""
    return messages.ParamSet(1, 1, name, struct.pack("<f", value), kind)


class Station:
    """A ground station with simulated time; `log` has the received messages and their times."""

    def __init__(self, endpoint: Endpoint, *, start: float = 0.0) -> None:
        self.endpoint = endpoint
        self.now = start
        self.log: list[tuple[float, frames.Frame, messages.Message]] = []
        endpoint.tick(start)
        self._collect()

    def send(self, *requests: messages.Message) -> Station:
        for message in requests:
            self.send_bytes(messages.encode(message, system=255, component=190, sequence=0))
        return self

    def send_bytes(self, data: bytes) -> None:
        self.endpoint.receive(data, self.now)
        self._collect()

    def wait(self, seconds: float) -> Station:
        """Advance the time, from deadline to deadline."""
        until = self.now + seconds
        while (due := self.endpoint.next_deadline()) is not None and due <= until:
            self.now = max(due, self.now)
            self.endpoint.tick(self.now)
            self._collect()
        self.now = until
        self.endpoint.tick(until)
        self._collect()
        return self

    def receive(self, kind: type[M]) -> list[M]:
        """Return the messages of a kind since the last call, and clear the log."""
        found: list[M] = [message for _, _, message in self.log if isinstance(message, kind)]
        self.log.clear()
        return found

    def values(self) -> list[messages.ParamValue]:
        return self.receive(messages.ParamValue)

    def times(self) -> list[float]:
        """Return the times of the received PARAM_VALUEs."""
        return [time for time, _, message in self.log if isinstance(message, messages.ParamValue)]

    def ask(self, *requests: messages.Message, seconds: float = 0.2) -> list[messages.ParamValue]:
        """Send messages; return the PARAM_VALUEs received within this time."""
        self.log.clear()
        return self.send(*requests).wait(seconds).values()

    def _collect(self) -> None:
        for data in self.endpoint.data_to_send():
            (frame,) = frames.Framer(stream=False).receive(data)
            if (message := messages.decode(frame)) is not None:
                self.log.append((self.now, frame, message))


def names(values: Sequence[messages.ParamValue]) -> list[str]:
    return [value.param_id for value in values]


def indices(values: Sequence[messages.ParamValue]) -> list[int]:
    return [value.param_index for value in values]
