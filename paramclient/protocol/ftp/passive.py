"""Files that other stations read over MAVFTP, assembled from their requests and the server's responses."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Final

from paramclient.errors import FileErrorCode
from paramclient.protocol.ftp.blocks import Blocks
from paramclient.protocol.ftp.packets import Opcode, Packet
from paramclient.protocol.ftp.transfer_job import SESSION_LOST

__all__ = ["ObservedRead", "ObservedReads", "path_of"]

IDLE_TIMEOUT: Final = 10.0
"""Seconds without a response after which a read ends: PX4 frees a session after 10 s, ArduPilot after 3 s."""
OPENINGS_MAX: Final = 64
"""Open requests that wait for their response. Above it, the oldest is dropped."""
READS_MAX: Final = 4
"""Parallel reads of one server; servers have one session, or a few."""
OFFSETS_MAX: Final = 512
"""Single read requests with a remembered offset; clients have up to 64 in flight."""
PIECES_MAX: Final = 65_536
"""Pieces of a file: each takes memory, however short it is."""

_OPEN_FILE_WO: Final = 11
_OPENINGS: Final = frozenset({Opcode.OPEN_FILE_RO, Opcode.CREATE_FILE, _OPEN_FILE_WO})
"""Requests that begin a session."""
_DATA: Final = frozenset({Opcode.READ_FILE, Opcode.BURST_READ_FILE})

Address = tuple[int, int]


class ObservedRead:
    """One read of one file by another station.

    Attributes:
        station: system and component of the station.
        path: of the file, with its query.
        session: number of the session.
        opened_by: sequence number of the response that has opened it.
        began_at: when that response was received, in seconds.
        received_at: when the last response was received.
        blocks: the received pieces of the file.
    """

    def __init__(self, station: Address, path: str, session: int, opened_by: int, now: float) -> None:
        self.station = station
        self.path = path
        self.session = session
        self.opened_by = opened_by
        self.began_at = now
        self.received_at = now
        self.blocks = Blocks()
        self.offsets: dict[int, int] = {}

    def __repr__(self) -> str:
        system, component = self.station
        return f"<ObservedRead {self.path} by {system}/{component}, {self.blocks.received} bytes>"


class ObservedReads:
    """The reads of files of one component by other stations, each from its open request to its end.

    Requests and responses are matched by station and session, so sessions may be interleaved. Duplicate
    responses count once. A read ends when the whole file was received, when its session is closed, reused or
    lost on board, and after `IDLE_TIMEOUT` without a response.

    Args:
        is_needed: whether the file of this path is to be assembled.
        size_max: bytes above which a file is given up.
        ended: called with each ended read and the time, also where nothing was received.
    """

    def __init__(
        self,
        is_needed: Callable[[str], bool],
        *,
        size_max: int,
        ended: Callable[[ObservedRead, float], None],
    ) -> None:
        self._is_needed = is_needed
        self._size_max = size_max
        self._ended = ended
        self._openings: dict[tuple[Address, int], str | None] = {}
        self._reads: dict[tuple[Address, int], ObservedRead] = {}

    @property
    def running(self) -> Collection[ObservedRead]:
        """The reads in progress."""
        return self._reads.values()

    def receive_request(self, packet: Packet, station: Address, now: float) -> None:
        """Process a request of a station to the server."""
        sequence = (packet.sequence + 1) & 0xFFFF
        if packet.opcode in _OPENINGS:
            self._openings.pop((station, sequence), None)
            is_read = packet.opcode == Opcode.OPEN_FILE_RO  # no data follows otherwise
            self._openings[station, sequence] = path_of(packet) if is_read else None
            if len(self._openings) > OPENINGS_MAX:
                del self._openings[next(iter(self._openings))]
        elif packet.opcode == Opcode.TERMINATE_SESSION:
            self._close((station, packet.session), now)
        elif packet.opcode == Opcode.RESET_SESSIONS:
            for key in [key for key in self._reads if key[0] == station]:
                self._close(key, now)
        elif packet.opcode == Opcode.READ_FILE:
            read = self._reads.get((station, packet.session))
            if read is not None:
                read.offsets[sequence] = packet.offset
                if len(read.offsets) > OFFSETS_MAX:
                    del read.offsets[next(iter(read.offsets))]

    def receive_reply(self, packet: Packet, addressee: Address, now: float) -> None:
        """Process a response of the server to a station; an id of 0 in the address means any."""
        if packet.opcode not in (Opcode.ACK, Opcode.NAK):
            return
        self.tick(now)
        if packet.requested in _OPENINGS:
            self._open_replied(packet, addressee, now)
        elif packet.requested in _DATA:
            for key, read in list(self._reads.items()):
                if key[1] == packet.session and _is_for(addressee, key[0]):
                    read.received_at = now
                    self._take(key, read, packet, now)

    def tick(self, now: float) -> None:
        """End the reads without a response for `IDLE_TIMEOUT` seconds."""
        for key, read in list(self._reads.items()):
            if read.received_at + IDLE_TIMEOUT <= now:
                self._close(key, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return min((read.received_at + IDLE_TIMEOUT for read in self._reads.values()), default=math.inf)

    def close_all(self, now: float) -> None:
        """End every read: nothing more is received."""
        for key in list(self._reads):
            self._close(key, now)
        self._openings.clear()

    def forget(self) -> None:
        """Drop every read without calling `ended`: the server is another one now."""
        self._reads.clear()
        self._openings.clear()

    def _open_replied(self, packet: Packet, addressee: Address, now: float) -> None:
        stations = (each for each, sequence in self._openings if sequence == packet.sequence)
        station = next((each for each in stations if _is_for(addressee, each)), None)
        if station is None or packet.opcode == Opcode.NAK:
            return
        key = (station, packet.session)
        read = self._reads.get(key)
        if read is not None and read.opened_by == packet.sequence:
            return  # the response to a repeated request
        self._close(key, now)
        path = self._openings[station, packet.sequence]
        if path is None or not self._is_needed(path):
            return
        self._reads[key] = ObservedRead(station, path, packet.session, packet.sequence, now)
        if len(self._reads) > READS_MAX:
            self._close(next(iter(self._reads)), now)

    def _take(self, key: tuple[Address, int], read: ObservedRead, packet: Packet, now: float) -> None:
        blocks = read.blocks
        offset = read.offsets.get(packet.sequence) if packet.requested == Opcode.READ_FILE else None
        is_known = offset is not None
        offset = packet.offset if offset is None else offset
        if packet.opcode == Opcode.ACK and packet.data:
            if offset + len(packet.data) > self._size_max or blocks.pieces >= PIECES_MAX:
                self._close(key, now)
                return
            blocks.take(offset, packet.data)
        elif packet.opcode == Opcode.ACK or packet.data[:1] == bytes([FileErrorCode.EOF]):
            if (is_known or offset >= blocks.reached) and offset <= self._size_max:
                blocks.ends_at(offset)  # otherwise the end is unknown
        elif packet.data[:1] and packet.data[0] in SESSION_LOST:
            self._close(key, now)
            return
        if blocks.is_complete:
            self._close(key, now)

    def _close(self, key: tuple[Address, int], now: float) -> None:
        read = self._reads.pop(key, None)
        if read is not None:
            self._ended(read, now)


def path_of(packet: Packet) -> str:
    """Return the path in an open request."""
    return packet.data.partition(b"\0")[0].decode("latin-1")


def _is_for(addressee: Address, station: Address) -> bool:
    return all(target in (0, own) for target, own in zip(addressee, station, strict=True))
