"""The read of a file: one burst from beginning to end, and single reads of lost blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

from paramclient.errors import FileErrorCode, FileTransferError, UsageError
from paramclient.protocol.ftp.blocks import Blocks
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.ftp.transfer_job import FileTransferJob, FtpChannel
from paramclient.protocol.requests.retry import (
    OVERTAKING_READS,
    READS_BEHIND_BURST_COPIES_MAX,
    REOPENS_MAX,
    BlockRetries,
    BurstAttempts,
)

__all__ = ["FILE_SIZE_MAX", "FileRead"]

FILE_SIZE_MAX: Final = 64 * 1024 * 1024
"""Bytes of a file, by default: more than any flight log, less than memory."""
BURST_RESPONSES_MAX: Final = 4096
"""Sequence numbers of the responses to one burst; ArduPilot ends one after 2000 (GCS_FTP.cpp)."""
BURSTS_MAX: Final = 4
"""Bursts whose late responses are still accepted."""
READS_BEHIND_BURST_MAX: Final = 4
"""Reads that may wait in the vehicle for the end of its burst: ArduPilot queues 5."""
WINDOW_MIN: Final = 3
"""Reads in flight, at least; above that, as many as one round trip can hold."""
WINDOW_MAX: Final = 64
"""Reads in flight, at most."""
SEND_BURST: Final = 3.0
"""Reads that may be sent at once without an overflow of ArduPilot's queue."""
BLOCK_GAP_DEFAULT: Final = 0.01
"""Seconds between two blocks before any measurement."""
BLOCK_GAP_MIN: Final = 1e-5
"""Seconds between two blocks that calculations assume, at least. Two blocks processed together can be
nanoseconds apart, and deadlines from such a pace are too close for any clock."""
TAIL_BLOCKS: Final = 4
"""Missing blocks at the end of a file up to which single reads are better than a new burst."""
TAIL_SHARE: Final = 0.15
"""The same as a share of an estimated size. ArduPilot's estimate for param.pck is a tenth too large."""
GENERATED_PREFIX: Final = b"@"
"""The beginning of the paths of files that a server generates at reading, such as param.pck: their size is an
estimate."""
UNKNOWN_SIZE: Final = 1 << 32
"""Bytes that no file has: an offset has 32 bits."""
LATE_READS_MAX: Final = 256
"""Lost reads whose late responses are still accepted."""
PIECES_PER_BLOCK: Final = 4
"""Pieces of a file for each block of its largest size: each piece takes memory, however short it is, and some
servers send less than requested."""
SPARE_PIECES: Final = 1_000
"""Further pieces of a file."""


class _PendingRead(NamedTuple):
    offset: int
    number: int
    sent_at: float
    ahead: int
    is_only: bool
    """Whether it measures the round trip: no earlier request for this offset, and no burst running."""


class FileRead(FileTransferJob[bytes]):
    """One read of a file. See `FileTransfers.read`.

    Attributes:
        size: the file size in bytes by the server; an estimate for generated files, such as ArduPilot's
            param.pck. None at first.
    """

    def __init__(
        self,
        line: FtpChannel,
        path: str,
        now: float,
        *,
        read_size: int,
        limit: int,
        magics: tuple[bytes, ...] = (),
    ) -> None:
        if not 1 <= read_size <= DATA_SIZE_MAX:
            raise UsageError(f"a file is read by 1 to {DATA_SIZE_MAX} bytes, not {read_size}")
        super().__init__(line, path, now)
        self.size: int | None = None
        self._read_size = read_size
        self._limit = limit
        self._magics = magics
        self._restarts = 0
        self._retries = BlockRetries(line.retry)
        self._has_bursts = True
        self._start_anew()
        self._gap = BLOCK_GAP_DEFAULT
        self._blocks_received = 0
        self._lost = 0
        self._number = 0
        self._tokens = SEND_BURST
        self._tokens_at = -math.inf

    def _start_anew(self) -> None:
        """Reset all state: nothing is received, and nothing requested."""
        self._blocks = Blocks()
        self._bursts: list[int] = []
        self._burst_runs = False
        self._read_behind_at = -math.inf  # when a read of the burst's first offset was sent behind it last
        self._burst_attempts = BurstAttempts(self._line.retry, self._line)
        self._burst_session = 0
        self._has_early_burst = False
        self._may_burst = False
        self._opened_at = math.inf
        self._block_at = math.inf  # the last block of the running burst
        self._overtaken_at = math.inf  # the first read behind that burst was answered before any block of it
        self._first_block: tuple[float, int] | None = None
        self._pending_reads: dict[int, _PendingRead] = {}  # by sequence number of the request
        self._late: dict[int, _PendingRead] = {}
        self._early_blocks: list[Packet] = []  # received before the response to the open
        self._is_unproven = False  # whether that response was lost, so that the file may be another one
        self._is_silent = False  # silence since the last timed-out request was sent
        self._unanswered: dict[int, tuple[int, float]] = {}  # reads by offset: how often, and when last

    @property
    def received(self) -> int:
        """Bytes received."""
        return self._blocks.received

    @property
    def beginning(self) -> bytes:
        """The beginning of the file, as far as it was received in one piece; b"" before."""
        return self._blocks.beginning

    def begin(self, now: float) -> None:
        self._start_anew()
        # MAVSDK's server closes the file on a request with another number (measured)
        if self._retries.may_burst_early and self._line.keeps_session:
            self._begin_early(now)
        else:
            self._open_file(Opcode.OPEN_FILE_RO, self._opened, now)

    def _begin_early(self, now: float) -> None:
        """Request the burst together with the open: a server that uses our session number begins at once.

        Its blocks count once the response to the open is received, which therefore is requested twice.
        """
        self._open_file(Opcode.OPEN_FILE_RO, self._opened, now, copies=2)
        self._burst(now)

    def _shows_lost_open(self, packet: Packet) -> bool:
        """Return whether the server responds to our burst that no file is open: the open was lost."""
        if packet.opcode != Opcode.NAK or packet.requested != Opcode.BURST_READ_FILE:
            return False
        is_open_awaited = self._has_request and self.blocked_until is None and self._restarts < REOPENS_MAX
        return (
            is_open_awaited
            and self._is_of_a_burst(packet)
            and self._code(packet) == FileErrorCode.FILE_NOT_FOUND
        )

    def _shows_lost_open_reply(self, packet: Packet) -> bool:
        """Return whether this shows that the response to our open was lost: it belongs to the burst behind
        it."""
        if packet.session != self.requested_session or packet.requested != Opcode.BURST_READ_FILE:
            return False
        if self._restarts < REOPENS_MAX and packet.opcode == Opcode.ACK and self._is_of_a_burst(packet):
            self._early_blocks.append(packet)
        return len(self._early_blocks) >= OVERTAKING_READS

    def _replace_lost_open_reply(self, session: int, now: float) -> None:
        """Go on without the response to the open.

        The burst may be of another station's file, whose session has our number: the refusal of our open may
        be lost too. The first bytes of the file show that in the end. Where they are not known, the session
        is closed, and the read starts again behind the burst: ArduPilot ends none early.
        """
        self._restarts += 1
        early_blocks = self._early_blocks
        self._early_blocks = []
        if not self._magics:
            self._line.close_session(session)
            self._start_anew()
            self._begin_early(now)
            return
        self._take_session()
        self._is_unproven = True
        self._opened_at = now
        self._has_early_burst = True
        for packet in early_blocks[:-1]:  # the last one is being processed
            self._take_burst(packet, now)

    def take(self, packet: Packet, now: float) -> None:
        super().take(packet, now)
        if self.is_ended:
            return
        if self.session is None and self._shows_lost_open(packet):
            self._restarts += 1
            self._begin_early(now)
        if self.session is None and self._shows_lost_open_reply(packet):
            self._replace_lost_open_reply(packet.session, now)
        if self.is_ended or self.session is None or packet.session != self.session:
            return
        self._is_silent = False
        if packet.requested == Opcode.BURST_READ_FILE and self._is_of_a_burst(packet):
            self._take_burst(packet, now)
        elif packet.requested == Opcode.READ_FILE:
            sequence = (packet.sequence - 1) & 0xFFFF
            pending = self._pending_reads.pop(sequence, None) or self._late.pop(sequence, None)
            if pending is not None:
                self._take_read(packet, pending, now)
        self._request_next(now)

    def tick(self, now: float) -> None:
        super().tick(now)
        if self.is_ended or self.session is None:
            return
        if self._burst_runs and self._quiet_at() <= now:
            self._burst_is_silent(now)
        if not self._burst_runs:
            for sequence, pending in list(self._pending_reads.items()):
                if self._pending_deadline(pending) <= now:
                    self._give_up(sequence)
                    self._record_timeout(pending, now)
        self._request_next(now)

    def next_deadline(self) -> float:
        earliest = super().next_deadline()
        if self.is_ended or self.session is None:
            return earliest
        if self._burst_runs:
            earliest = min(earliest, self._quiet_at())
        elif self._pending_reads:
            earliest = min(earliest, *map(self._pending_deadline, self._pending_reads.values()))
        if self._next_needed() is not None:
            earliest = min(earliest, self._next_read_at)
        return earliest

    def resume(self, now: float) -> None:
        super().resume(now)
        if self.session is not None and not self.is_ended:
            self._pending_reads.clear()
            self._unanswered.clear()
            self._burst_attempts.restart()
            self._burst_runs = False
            self._request_next(now)

    def _opened(self, packet: Packet, now: float) -> None:
        if len(packet.data) >= 4:
            self.size = int.from_bytes(packet.data[:4], "little")
        self._opened_at = now
        # also after a repeated open: on a slow link its response may only be late
        self._has_early_burst = self._burst_runs and packet.session == self._burst_session
        if not self._has_early_burst:
            self._burst_attempts.restart()
            self._burst(now)

    # the burst

    def _burst(self, now: float) -> None:
        """Request everything from the present offset as a burst."""
        if self._burst_attempts.should_give_up(now):
            self.fail(self._no_reply(self._burst_attempts.count, now), now)
            return
        sequence = self._line.next_sequence(answers=BURST_RESPONSES_MAX)
        self._bursts = [*self._bursts[1 - BURSTS_MAX :], sequence]
        self._burst_runs = True
        self._read_behind_at = -math.inf
        self._has_early_burst = False
        self._may_burst = False
        self._burst_attempts.sent(now)
        self._block_at = self._overtaken_at = math.inf
        self._first_block = None
        session = self.requested_session if self.session is None else self.session
        self._burst_session = session or 0
        self._line.send(
            Packet(
                sequence,
                self._burst_session,
                Opcode.BURST_READ_FILE,
                size=self._read_size,
                offset=self._blocks.reached,
            )
        )
        if self.session is not None:
            for _ in range(min(self._most_copies, READS_BEHIND_BURST_COPIES_MAX)):
                self._send_probe_read(now)

    def _is_of_a_burst(self, packet: Packet) -> bool:
        return any(0 < (packet.sequence - first) & 0xFFFF <= BURST_RESPONSES_MAX for first in self._bursts)

    def _take_burst(self, packet: Packet, now: float) -> None:
        if self._block_at == math.inf and self._burst_runs:
            first_answer = (self._bursts[-1] + 1) & 0xFFFF
            if packet.sequence == first_answer:
                self._burst_attempts.answered(now)
        is_latest = 0 < (packet.sequence - self._bursts[-1]) & 0xFFFF <= BURST_RESPONSES_MAX
        if packet.opcode == Opcode.NAK:
            self._end_of_burst(packet, is_latest, now)
            return
        skipped = packet.offset - self._blocks.reached
        if skipped > 0:
            self._lost += -(-skipped // self._read_size)
        self._blocks_received += 1
        self._measure(packet, now)
        if self._keep(packet, packet.offset, now):
            self._burst_attempts.restart()
        if not packet.burst_complete:
            self._burst_runs = True  # also after it was taken to be over
        elif is_latest:
            self._may_burst = True
            self._stop_burst(now)

    def _measure(self, packet: Packet, now: float) -> None:
        """Measure the time between two blocks."""
        self._block_at = now
        if self._first_block is None:
            self._first_block = (now, packet.offset)
            return
        began_at, offset = self._first_block
        blocks = (packet.offset - offset) / self._read_size
        if blocks > 0 and now > began_at:
            self._gap = max((now - began_at) / blocks, BLOCK_GAP_MIN)

    def _end_of_burst(self, packet: Packet, is_latest: bool, now: float) -> None:
        code = self._code(packet)
        if code == FileErrorCode.EOF:
            if packet.offset >= self._blocks.reached:  # otherwise the end is unknown, and a read shows it
                self._ends_at(packet.offset)
        elif not is_latest:
            return
        elif code == FileErrorCode.UNKNOWN_COMMAND:
            self._has_bursts = False
        elif self._has_early_burst and self._blocks.reached == 0:
            self._burst(now)  # the first one arrived before the open
            return
        else:
            self._read_refused(packet, now)
        if is_latest:
            self._stop_burst(now)

    def _stop_burst(self, now: float) -> None:
        """End the burst: reads sent meanwhile are answered only now."""
        self._burst_runs = False
        for sequence, pending in self._pending_reads.items():
            self._pending_reads[sequence] = pending._replace(sent_at=now, is_only=False)

    def _quiet_at(self) -> float:
        burst = self._burst_attempts
        if self._block_at == math.inf:
            return min(self._next_read_behind_at, self._repeats_at, burst.overtaken_at(self._overtaken_at))
        return burst.over_at(self._block_at, None if self._gap == BLOCK_GAP_DEFAULT else self._gap)

    @property
    def _begins_by(self) -> float:
        """When the first block of the burst is late."""
        return self._burst_attempts.begins_by(self._opened_at if self._has_early_burst else None)

    @property
    def _repeats_at(self) -> float:
        """When a burst without a block is requested again."""
        return self._burst_attempts.repeats_at(self._begins_by)

    @property
    def _next_read_behind_at(self) -> float:
        """When a read is sent behind a burst without a block; infinity after enough of them."""
        if len(self._pending_reads) >= READS_BEHIND_BURST_MAX:
            return math.inf
        if self._read_behind_at == -math.inf:
            return self._begins_by
        return self._burst_attempts.next_read_behind_at(self._read_behind_at)

    def _burst_is_silent(self, now: float) -> None:
        if self._block_at < math.inf:
            self._stop_burst(now)
        elif self._overtaken_at < math.inf:
            self._burst_attempts.timed_out()
            self._may_burst = True
            self._stop_burst(now)
        elif now >= self._repeats_at:
            self._burst_attempts.timed_out()
            self._burst(now)
        else:
            self._send_probe_read(now)

    def _send_probe_read(self, now: float) -> None:
        """Send a read behind the burst: its response, without a block before it, shows that the burst was
        lost."""
        self._read_behind_at = now
        self._read(self._blocks.reached, now)

    # single reads

    def _take_read(self, packet: Packet, pending: _PendingRead, now: float) -> None:
        for sequence, other in list(self._pending_reads.items()):
            if other.number <= pending.number - OVERTAKING_READS:
                self._give_up(sequence)
                self._retries.timed_out(1)
        self._retries.answered(pending.sent_at, now, is_sure=pending.is_only)
        self._unanswered.pop(pending.offset, None)
        if packet.opcode == Opcode.ACK and packet.data:
            is_ahead = pending.offset >= self._blocks.reached
            self._keep(packet, pending.offset, now)
            if is_ahead and self._burst_runs and pending.sent_at >= self._burst_attempts.sent_at:
                self._overtaken_at = min(self._overtaken_at, now)
            self._may_burst = self._may_burst or (is_ahead and not self._burst_runs)
        elif packet.opcode == Opcode.ACK or self._code(packet) == FileErrorCode.EOF:
            self._ends_at(pending.offset)
        else:
            self._read_refused(packet, now)

    def _give_up(self, sequence: int) -> None:
        """Count a read as lost."""
        self._late[sequence] = self._pending_reads.pop(sequence)._replace(is_only=False)
        if len(self._late) > LATE_READS_MAX:
            del self._late[next(iter(self._late))]

    def _record_timeout(self, pending: _PendingRead, now: float) -> None:
        """Record an unanswered read; those of one offset that were sent meanwhile count as one."""
        attempts, counted_at = self._unanswered.get(pending.offset, (0, -math.inf))
        if not self._is_needed(pending.offset) or pending.sent_at < counted_at:
            return
        attempts += 1
        self._unanswered[pending.offset] = attempts, now
        is_silence = self._line.received_at < pending.sent_at
        if not (is_silence and self._is_silent):  # a silence that all reads share counts once
            self._retries.timed_out(attempts)
        self._is_silent = is_silence
        if self._retries.should_give_up(attempts, now, is_silence=is_silence):
            self.fail(self._no_reply(attempts, now), now)

    def _pending_deadline(self, pending: _PendingRead) -> float:
        return self._retries.due_at(pending.sent_at, pending.ahead, self._gap)

    def _is_needed(self, offset: int) -> bool:
        is_behind = self._blocks.end is None and offset >= self._blocks.reached
        return is_behind or self._blocks.is_missing(offset)

    def _is_requested(self, offset: int) -> bool:
        return any(pending.offset == offset for pending in self._pending_reads.values())

    @property
    def _window(self) -> int:
        if self._burst_runs:
            return READS_BEHIND_BURST_MAX
        if self._is_silent:
            return WINDOW_MIN
        round_trip = self._line.retry.round_trip.smoothed or self._line.retry.timeout
        return min(max(math.ceil(round_trip / self._gap) + 2, WINDOW_MIN), WINDOW_MAX)

    @property
    def _interval(self) -> float:
        """Seconds between two requests: the burst uses a third of the link, reads may use more."""
        return self._gap / 2

    @property
    def _next_read_at(self) -> float:
        """When the pace allows another read."""
        return self._tokens_at + max(1.0 - self._tokens, 0.0) * self._interval

    def _needed_offsets(self) -> Iterator[int]:
        """Yield the offsets of useful single reads, the most useful first."""
        yield from self._blocks.missing(self._read_size)
        if self._blocks.end is None and not self._burst_runs:
            reached = self._blocks.reached
            ahead = TAIL_BLOCKS if self._has_bursts else WINDOW_MAX
            if self.size is not None:
                left = (self.size - reached) // self._read_size
                ahead = 1 if self._has_bursts and self._is_worth_a_burst() else max(min(ahead, left + 1), 1)
            end = reached + ahead * self._read_size
            yield from range(reached, min(end, self._exact_size), self._read_size)

    @property
    def _exact_size(self) -> int:
        """Bytes of the file; `UNKNOWN_SIZE` for an estimate, or for the 0 of a generated file."""
        is_estimate = self._path_data.startswith(GENERATED_PREFIX)
        return UNKNOWN_SIZE if is_estimate or not self.size else self.size

    def _next_needed(self) -> int | None:
        """Return the next offset: an unrequested one, otherwise a copy, if that is worthwhile."""
        if len(self._pending_reads) >= self._window:
            return None
        copies: dict[int, int] = {}
        for pending in self._pending_reads.values():
            copies[pending.offset] = copies.get(pending.offset, 0) + 1
        candidates = []
        for offset in self._needed_offsets():
            if offset not in copies:
                return offset
            candidates.append(offset)
        if not candidates or self._burst_runs:
            return None
        fewest = min(candidates, key=copies.__getitem__)
        return fewest if copies[fewest] <= self._most_copies else None

    @property
    def _most_copies(self) -> int:
        return self._retries.copies(self._blocks_received, self._lost)

    def _read(self, offset: int, now: float) -> None:
        sequence = self._line.next_sequence()
        is_only = not (self._burst_runs or offset in self._unanswered or self._is_requested(offset))
        self._number += 1
        self._pending_reads[sequence] = _PendingRead(
            offset, self._number, now, len(self._pending_reads), is_only
        )
        self._tokens -= 1.0
        # MAVSDK's server refuses to read beyond the end; a growing file is longer by now
        left = self._exact_size - offset
        size = min(self._read_size, left) if left > 0 else self._read_size
        self._line.send(Packet(sequence, self.session or 0, Opcode.READ_FILE, size=size, offset=offset))

    # both

    def _keep(self, packet: Packet, offset: int, now: float) -> bool:
        """Store received data and return whether it has new bytes."""
        if offset + len(packet.data) > self._limit:
            self._is_no_file(f"is longer than {self._limit} bytes", now)
            return False
        if self._blocks.pieces > PIECES_PER_BLOCK * self._limit // self._read_size + SPARE_PIECES:
            self._is_no_file("arrives in too many pieces", now)
            return False
        return self._blocks.take(offset, packet.data)

    def _is_no_file(self, why: str, now: float) -> None:
        """End with an error: the received data exceeds any file."""
        system, component = self._line.target
        self.fail(
            FileTransferError(
                f"{self.path} of {system}/{component} {why}",
                system=system,
                component=component,
                path=self.path,
                code=FileErrorCode.INVALID_DATA_SIZE,
            ),
            now,
        )

    def _read_refused(self, packet: Packet, now: float) -> None:
        """Process a refusal; start again if the session is lost, as when another station resets all."""
        if self._may_reopen(packet):
            self._start_anew()
            self._open_file(Opcode.OPEN_FILE_RO, self._opened, now)
        else:
            self._refused(packet, "does not read", now)

    def _ends_at(self, offset: int) -> None:
        self._blocks.ends_at(min(offset, self._limit))

    def _request_next(self, now: float) -> None:
        """Request what is missing, as far as the pace allows; end when all is received."""
        if self.is_ended or self.session is None:
            return
        if self._blocks.end is None and not self._burst_runs and self._blocks.reached >= self._exact_size:
            self._ends_at(self._blocks.reached)
        if self._blocks.is_complete:
            content = self._blocks.content
            if self._is_unproven and not content.startswith(self._magics):
                self._line.close_session(self.session)
                self.session = None
                self._start_anew()
                self._begin_early(now)
            else:
                self.finish(content, now)
            return
        if self._may_burst and self._has_bursts and not self._burst_runs and self._is_worth_a_burst():
            self._burst(now)
        is_due = now >= self._next_read_at
        if now > self._tokens_at:
            elapsed = now - self._tokens_at
            self._tokens = min(self._tokens + elapsed / self._interval, SEND_BURST)
            self._tokens_at = now
        if is_due:
            self._tokens = max(self._tokens, 1.0)  # otherwise rounding could make it due again and again
        while self._tokens >= 1.0 and (offset := self._next_needed()) is not None:
            self._read(offset, now)

    def _is_worth_a_burst(self) -> bool:
        """Return whether single reads of the missing end would take longer than a burst."""
        if self._blocks.end is not None or self.size is None:
            return False
        left = self.size - self._blocks.reached
        share = 0.0 if self._exact_size == self.size else TAIL_SHARE * self.size
        return left > max(TAIL_BLOCKS * self._read_size, share)
