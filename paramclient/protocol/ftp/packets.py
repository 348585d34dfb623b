"""The payload of FILE_TRANSFER_PROTOCOL (MAVLink guide, "File Transfer Protocol (FTP)")."""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

__all__ = ["Opcode", "Packet"]

DATA_SIZE_MAX: Final = 239
"""Bytes of a file in one message, at most."""


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
    """A request or its response.

    Attributes:
        sequence: of a request, any rising number; of its response, one more; of a burst, rising from there.
        session: the open file.
        opcode: the operation; ACK or NAK in a response.
        data: up to 239 bytes.
        size: of a read, the requested bytes; otherwise the length of `data`.
        offset: in the file; of a list, the entries to skip.
        requested: in a response, the opcode of the request.
        burst_complete: whether this is the last message of the burst.
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
        """Decode the 251 bytes of a message; `data` has `size` bytes, or as many as there are."""
        sequence, session, opcode, size, requested, complete, offset = _HEADER.unpack_from(payload)
        data = payload[_HEADER.size : _HEADER.size + size]
        return cls(sequence, session, opcode, data, size, offset, requested, bool(complete))

    def pack(self) -> bytes:
        """Encode as the payload of a message; the message pads it."""
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
