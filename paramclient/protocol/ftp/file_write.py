"""The write of a file: in order, or with its header last, so that it counts as a whole."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from paramclient.errors import FileErrorCode, UsageError
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX, FRAME_OVERHEAD, Opcode, Packet
from paramclient.protocol.ftp.transfer_job import SESSION_LOST, FileTransferJob, FtpChannel
from paramclient.protocol.requests.retry import COMMIT_COPIES, BlockRetries

__all__ = ["CommittedWrite", "FileWrite"]

HEADER_SIZE: Final = 6
"""Bytes at the beginning of a param.pck without which ArduPilot drops it: its header."""
BLOCKS_IN_FLIGHT_MAX: Final = 4
"""Blocks in flight: ArduPilot queues 5 requests of all stations and drops further ones (GCS_FTP.cpp)."""


class FileWrite(FileTransferJob[None]):
    """One write of a file; ends when the server has closed it. See `FileTransfers.write`.

    Attributes:
        written: bytes that the server has acknowledged.
    """

    def __init__(self, line: FtpChannel, path: str, data: bytes, now: float, *, write_size: int) -> None:
        if not 1 <= write_size <= DATA_SIZE_MAX:
            raise UsageError(f"a file is written by 1 to {DATA_SIZE_MAX} bytes, not {write_size}")
        super().__init__(line, path, now)
        self.written = 0
        self._data = data
        self._write_size = write_size

    def begin(self, now: float) -> None:
        self.written = 0
        self._open_file(Opcode.CREATE_FILE, lambda _, now: self._write(now), now)

    def _write(self, now: float) -> None:
        """Send the next piece, or close. One at a time: PX4 accepts a param.pck in order only."""
        session = self.session or 0
        piece = self._data[self.written : self.written + self._write_size]
        if not piece:
            self._ask(Opcode.TERMINATE_SESSION, self._taken, now, session=session)
            return

        def answered(packet: Packet, now: float) -> None:
            if packet.opcode == Opcode.NAK:
                self._refused_or_lost(packet, "does not write", now)
            else:
                self.written += len(piece)
                self._write(now)

        self._ask(Opcode.WRITE_FILE, answered, now, data=piece, session=session, offset=self.written)

    def _refused_or_lost(self, packet: Packet, what: str, now: float) -> None:
        """Process a refusal; start again if the server has lost the session, as after a long silence."""
        if self._may_reopen(packet):
            self.begin(now)
        else:
            self._refused(packet, what, now)

    def _taken(self, packet: Packet, now: float) -> None:
        was_closed_before = self._code(packet) == FileErrorCode.INVALID_SESSION and self.attempts > 1
        self.session = None
        if packet.opcode == Opcode.NAK and not was_closed_before:
            self._refused_or_lost(packet, "does not take", now)
        else:
            self.finish(None, now)


class _PendingRead(NamedTuple):
    offset: int
    number: int
    sent_at: float
    ahead: int
    is_only: bool
    """Whether it measures the round trip: the first request for this block, with no other one in flight."""


class CommittedWrite(FileTransferJob[None]):
    """One write of a file of which the server takes all or nothing. See `FileTransfers.write_whole`.

    All but the header is written first, several blocks at a time. When the server has acknowledged each, the
    header is sent together with the request to close the file: the commit. A write that ends before its
    commit changes nothing on board. ArduPilot keeps an uploaded param.pck in memory and parses it when it is
    closed, also when another station's request closes it after 3 s of silence; bytes that were not written
    are zero, and a file that begins with zeros is dropped. A hole behind the header would be parsed, and its
    zeros taken for values (AP_Filesystem_Param.cpp, `param_upload_parse`; recorded).

    ArduPilot acknowledges the closing also of a file that it has dropped (GCS_FTP.cpp): the end of this job
    proves nothing.

    Args:
        line, path, now: as for every transfer.
        data: the file.
        write_size: bytes of one block.
        may_commit: called with the time directly before the commit; the write ends with an error if it
            returns false.

    Attributes:
        is_committed: whether the commit was sent: from then on the server may have taken the file.
    """

    def __init__(
        self,
        line: FtpChannel,
        path: str,
        data: bytes,
        now: float,
        *,
        write_size: int,
        may_commit: Callable[[float], bool],
    ) -> None:
        if not 1 <= write_size <= DATA_SIZE_MAX:
            raise UsageError(f"a file is written by 1 to {DATA_SIZE_MAX} bytes, not {write_size}")
        super().__init__(line, path, now)
        self.is_committed = False
        self._data = data
        self._write_size = write_size
        self._may_commit = may_commit
        self._retries = BlockRetries(line.retry)
        self._number = 0
        self._start_anew()

    def _start_anew(self) -> None:
        """Reset all state: nothing is written."""
        self._waiting = [*range(HEADER_SIZE, len(self._data), self._write_size)]
        self._waiting.reverse()  # the next one last
        self._pending_reads: dict[int, _PendingRead] = {}  # by sequence number of the request
        self._lost: dict[int, int] = {}  # unanswered requests by offset
        self._is_beginning_written = False

    def begin(self, now: float) -> None:
        self._start_anew()
        self._open_file(Opcode.CREATE_FILE, lambda _, now: self._go_on(now), now)

    def take(self, packet: Packet, now: float) -> None:
        super().take(packet, now)
        if self.is_ended or self.session is None or packet.requested != Opcode.WRITE_FILE:
            return
        flight = self._pending_reads.pop((packet.sequence - 1) & 0xFFFF, None)
        if flight is None:
            is_beginning = self.is_committed and packet.offset == 0 and packet.session == self.session
            self._is_beginning_written = self._is_beginning_written or (
                is_beginning and packet.opcode == Opcode.ACK
            )
            return
        if packet.opcode == Opcode.NAK:
            if self._may_reopen(packet):
                self.begin(now)
            else:
                self._refused(packet, "does not write", now)
            return
        self._retries.answered(flight.sent_at, now, is_sure=flight.is_only)
        self._lost.pop(flight.offset, None)
        if flight.offset in self._waiting:  # a copy was to be sent
            self._waiting.remove(flight.offset)
        # the server answers in order, so the requests before this one, or their responses, were lost
        for sequence, other in list(self._pending_reads.items()):
            if other.offset == flight.offset:
                del self._pending_reads[sequence]
            elif other.number < flight.number:
                self._give_up(sequence, now)
        self._go_on(now)

    def tick(self, now: float) -> None:
        super().tick(now)
        if self.is_ended or self.session is None:
            return
        for sequence, flight in list(self._pending_reads.items()):
            if self._due_at(flight) <= now:
                self._give_up(sequence, now)
        self._go_on(now)

    def next_deadline(self) -> float:
        return min(super().next_deadline(), *map(self._due_at, self._pending_reads.values()), float("inf"))

    def resume(self, now: float) -> None:
        super().resume(now)
        if self.session is not None and not self.is_ended:
            self._waiting += [flight.offset for flight in self._pending_reads.values()]
            self._pending_reads.clear()
            self._go_on(now)

    def _go_on(self, now: float) -> None:
        """Send what may be sent; commit when all other blocks are written."""
        if self.is_ended or self.session is None or self._has_request:
            return
        while self._waiting and len(self._pending_reads) < BLOCKS_IN_FLIGHT_MAX:
            self._write(self._waiting.pop(), now)
        if not self._pending_reads:
            self._commit(now)

    def _write(self, offset: int, now: float) -> None:
        sequence = self._line.next_sequence()
        self._number += 1
        is_only = not self._pending_reads and offset not in self._lost
        self._pending_reads[sequence] = _PendingRead(
            offset, self._number, now, len(self._pending_reads), is_only
        )
        self._send_block(sequence, offset)

    def _send_block(self, sequence: int, offset: int) -> None:
        piece = self._data[offset : offset + self._write_size] if offset else self._data[:HEADER_SIZE]
        self._line.send(Packet(sequence, self.session or 0, Opcode.WRITE_FILE, piece, offset=offset))

    def _due_at(self, flight: _PendingRead) -> float:
        rate = self._line.byte_rate
        gap = (self._write_size + FRAME_OVERHEAD) / rate if rate else 0.0
        return self._retries.due_at(flight.sent_at, flight.ahead + 1, gap)

    def _give_up(self, sequence: int, now: float) -> None:
        """Count a request as lost, and send its block again."""
        flight = self._pending_reads.pop(sequence)
        lost = self._lost[flight.offset] = self._lost.get(flight.offset, 0) + 1
        self._retries.timed_out(lost)
        is_silence = self._line.received_at < flight.sent_at
        if self._retries.should_give_up(lost, now, is_silence=is_silence):
            self.fail(self._no_reply(lost, now), now)
        elif flight.offset not in self._waiting:
            self._waiting.append(flight.offset)

    def _commit(self, now: float) -> None:
        """Send the header and the request to close, which the server serves in this order.

        If the header is lost, the file is dropped, and closed with an acknowledgement all the same.
        """
        if not self._may_commit(now):
            self.fail(UsageError(f"{self.path} was not written: the vehicle may be another one"), now)
            return
        self.is_committed = True
        self._ask(Opcode.TERMINATE_SESSION, self._taken, now, session=self.session or 0, is_slow=True)

    def _transmit(self, request: Packet, now: float, *, copies: int = 1) -> None:
        is_commit = request.opcode == Opcode.TERMINATE_SESSION and self.is_committed
        if is_commit and not self._is_beginning_written and not self.is_ended:
            sequence = self._line.next_sequence()
            for _ in range(COMMIT_COPIES):
                self._send_block(sequence, 0)
        super()._transmit(request, now, copies=COMMIT_COPIES if is_commit else copies)

    def _taken(self, packet: Packet, now: float) -> None:
        is_closed = packet.opcode == Opcode.ACK or self._code(packet) in SESSION_LOST
        self.session = None
        if is_closed:
            self.finish(None, now)
        else:
            self._refused(packet, "does not take", now)
