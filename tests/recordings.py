"""Reads the telemetry logs in tests/data: both directions of real sessions, frame by frame."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from paramclient.protocol import wire

DATA = Path(__file__).parent / "data"
NAMES = tuple(sorted(path.stem for path in DATA.glob("*.tlog")))
GROUND_STATION = 255


class Record(NamedTuple):
    """One frame of a log.

    Attributes:
        time: seconds since the first frame of the log.
        data: the frame as it stood on the wire.
        system: who sent it.
        frame: the same, checked; None for a message that the dialect does not know.
    """

    time: float
    data: bytes
    system: int
    frame: wire.Frame | None

    @property
    def message(self) -> wire.Message | None:
        return None if self.frame is None else wire.decode(self.frame)


@cache
def read(name: str) -> tuple[Record, ...]:
    """All frames of `tests/data/{name}.tlog`: eight bytes of time (big-endian µs) before each frame."""
    content = (DATA / f"{name}.tlog").read_bytes()
    framer = wire.Framer(stream=False)
    records: list[Record] = []
    at = 0
    start = None
    while at < len(content):
        (time,) = struct.unpack_from(">Q", content, at)
        at += 8
        start = time if start is None else start
        if content[at] == 0xFD:
            length = 12 + content[at + 1] + (13 if content[at + 2] & 1 else 0)
            system = content[at + 5]
        else:
            length = 8 + content[at + 1]
            system = content[at + 3]
        data = content[at : at + length]
        at += length
        frames = framer.receive(data)
        records.append(Record((time - start) / 1e6, data, system, frames[0] if frames else None))
    return tuple(records)


def from_ground(name: str) -> list[Record]:
    """What the ground station sent."""
    return [record for record in read(name) if record.system == GROUND_STATION]


def from_vehicle(name: str) -> list[tuple[float, wire.Message]]:
    """What the vehicle sent, as far as `wire` decodes it: the time, and the message."""
    return [
        (record.time, message)
        for record in read(name)
        if record.system != GROUND_STATION and (message := record.message) is not None
    ]


def param_values(messages: Iterable[tuple[float, wire.Message]]) -> list[wire.ParamValue]:
    """The PARAM_VALUEs among them, in order."""
    return [message for _, message in messages if isinstance(message, wire.ParamValue)]
