"""What stands in the payload of FILE_TRANSFER_PROTOCOL (MAVLink guide, "File Transfer Protocol (FTP)")."""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

__all__ = ["Opcode", "Packet"]

MOST_DATA: Final = 239
"""Bytes of a file that one message can carry."""


class Opcode(IntEnum):
    """MAV_FTP_OPCODE, as far as it is used here."""

    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    ACK = 128
    NAK = 129


class Packet(NamedTuple):
    """A request, or the answer to one.

    Attributes:
        sequence: of a request, any number that rises; of its answer, one more; of a burst, rising from there.
        session: which open file it is about.
        opcode: what to do; ACK or NAK in an answer.
        data: up to 239 bytes.
        size: of a read, the bytes wanted; else the length of `data`.
        offset: in the file; of a list, the entries to pass over.
        requested: in an answer, the opcode of the request.
        burst_complete: whether no more comes of this burst.
    """

    sequence: int
    session: int
    opcode: int
    data: bytes = b""
    size: int = 0
    offset: int = 0
    requested: int = 0
    burst_complete: bool = False

    @classmethod
    def unpack(cls, payload: bytes) -> Packet:
        """From the 251 bytes of a message; `data` is what `size` says, at most what there is."""
        sequence, session, opcode, size, requested, complete, offset = _HEADER.unpack_from(payload)
        data = payload[_HEADER.size : _HEADER.size + size]
        return cls(sequence, session, opcode, data, size, offset, requested, bool(complete))

    def pack(self) -> bytes:
        """To the payload of a message; the message pads it."""
        head = _HEADER.pack(
            self.sequence & 0xFFFF,
            self.session,
            self.opcode,
            self.size or len(self.data),
            self.requested,
            self.burst_complete,
            self.offset,
        )
        return head + self.data


_HEADER = struct.Struct("<HBBBBBxI")
