"""Reading a file: one burst from its beginning to its end, and single reads for what got lost of it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

from paramclient.errors import FileErrorCode, FileTransferError, UsageError
from paramclient.protocol.ftp.blocks import Blocks
from paramclient.protocol.ftp.packets import MOST_DATA, Opcode, Packet
from paramclient.protocol.ftp.transfer_job import Job, Line
from paramclient.protocol.requests.round_trip import LONGEST_SILENCE, MOST_TRIES

__all__ = ["LARGEST_FILE", "FileRead"]

LARGEST_FILE: Final = 64 * 1024 * 1024
"""Bytes that a file may have unless it is said otherwise: more than any log of a flight, less than memory."""
BURST_ANSWERS: Final = 4096
"""Numbers that the answers to one burst may take; ArduPilot ends one after 2000 (GCS_FTP.cpp)."""
MOST_DOUBLINGS: Final = 1
"""How often the time to wait for a burst doubles."""
BURSTS_KEPT: Final = 4
"""Bursts whose late answers are still taken."""
FIRST_BLOCK: Final = 0.7
FIRST_BLOCK_TRIPS: Final = 2.5
"""Seconds, and round trips, by which the first block of a burst may come later than a short answer: on 1,200
bytes a second it takes 0.22 s alone, and 0.67 s where the vehicle keeps to a third of that. After that a read
is sent behind the burst: its answer, and no block before it, tells that the burst was lost."""
BURST_SILENCE: Final = 0.5
"""Seconds without a message of the server after which a burst of which nothing came is asked for again. At
57600 baud its first block comes 0.1 s after the request, behind the banner (measured), and later behind
telemetry. ArduPilot ends no burst for another one: repeated while it comes, the whole file is sent twice."""
SLOWEST_GAP: Final = 2.0
"""Seconds to wait for the second block of a burst, when nothing is known of its pace."""
QUIET_BLOCKS: Final = 6
SHORTEST_QUIET: Final = 0.05
"""A burst in which nothing came for so many times the usual gap, and for so many seconds, is over, or what is
left of it was lost."""
HELD: Final = 4
"""Reads that may wait in the vehicle for the end of its burst: ArduPilot queues 5."""
SMALLEST_WINDOW: Final = 3
LARGEST_WINDOW: Final = 64
"""Reads in flight at once; in between it is what one round trip can hold."""
SEND_BURST: Final = 3.0
"""Reads that may go out at one time, so that they do not overflow ArduPilot's queue."""
UNKNOWN_GAP: Final = 0.01
"""Seconds from one block to the next before any was seen."""
SHORTEST_GAP: Final = 1e-5
"""Seconds from one block to the next that are reckoned with at the least. Two blocks taken in one turn can be
nanoseconds apart, and a pace by them has deadlines that no clock can tell from now."""
OVERTAKEN: Final = 2
"""Later reads that must be answered for one to count as lost."""
COPY_RISK: Final = 0.01
MOST_COPIES: Final = 6
"""The chance of no answer to go below by asking again early, and how often that may be done."""
TAIL_BLOCKS: Final = 4
TAIL_SHARE: Final = 0.15
"""What may be left of a file, in blocks and as a share of an estimated size, for reads to be better than a
new burst. ArduPilot's estimate for param.pck is a tenth too large."""
MADE_AT_READING: Final = b"@"
"""How the paths begin of what a server makes at reading, such as param.pck: their size is an estimate."""
UNKNOWN_SIZE: Final = 1 << 32
"""Bytes that no file has: an offset has 32 bits."""
BURST_DELAY: Final = 0.03
"""Seconds by which the first block of a burst may come later than the answer to a read that was sent behind
it: PX4 answers reads at once, and begins a burst up to 20 ms later (measured)."""
LATE_KEPT: Final = 256
"""Reads that count as lost and whose answers are taken all the same, should they still come."""
MOST_RESTARTS: Final = 2
"""How often a file is opened anew when nobody can tell whether it is open."""
SMALLEST_SHARE: Final = 4
SPARE_PIECES: Final = 1_000
"""A file may come in so many times as many pieces as its largest size has blocks, and some more: each piece
takes memory, however short it is, and some servers give less than was asked for."""


class _Flight(NamedTuple):
    offset: int
    number: int
    sent_at: float
    ahead: int
    is_only: bool
    """Whether it tells of the round trip: nothing of this offset was asked for before, and no burst runs."""


class FileRead(Job[bytes]):
    """The content of a file. See `FileTransfers.read`.

    Attributes:
        size: bytes that the server says the file has; an estimate for what is made at reading, such as
            ArduPilot's param.pck. None at first.
    """

    def __init__(self, line: Line, path: str, now: float, *, read_size: int, limit: int) -> None:
        if not 1 <= read_size <= MOST_DATA:
            raise UsageError(f"a file is read by 1 to {MOST_DATA} bytes, not {read_size}")
        super().__init__(line, path, now)
        self.size: int | None = None
        self._read_size = read_size
        self._limit = limit
        self._restarts = 0
        self._has_bursts = True
        self._start_anew()
        self._gap = UNKNOWN_GAP
        self._came = 0
        self._lost = 0
        self._number = 0
        self._tokens = SEND_BURST
        self._tokens_at = -math.inf

    def _start_anew(self) -> None:
        """Nothing has come, and nothing is asked for."""
        self._blocks = Blocks()
        self._bursts: list[int] = []
        self._burst_runs = False
        self._read_behind_at = -math.inf  # when a read of where the burst begins was sent behind it last
        self._burst_attempts = 0
        self._burst_session = 0
        self._has_early_burst = False
        self._may_burst = False
        self._burst_sent_at = math.inf
        self._opened_at = math.inf
        self._block_at = math.inf  # the last block of the burst that runs
        self._overtaken_at = math.inf  # the first read behind that burst was answered before any block of it
        self._first_block: tuple[float, int] | None = None
        self._flights: dict[int, _Flight] = {}  # by the number of the request
        self._late: dict[int, _Flight] = {}
        self._unheard = 0  # blocks that came before the answer to the open
        self._is_silent = False  # nothing came since what timed out last was sent
        self._asked: dict[int, tuple[int, float]] = {}  # how often each offset was so in vain, and when last

    @property
    def received(self) -> int:
        """Bytes that have come."""
        return self._blocks.received

    @property
    def beginning(self) -> bytes:
        """What stands at the beginning of the file, as much of it as has come in one piece; b"" before."""
        return self._blocks.beginning

    def begin(self, now: float) -> None:
        self._start_anew()
        round_trip = self._line.round_trip
        # where the round trip is not measured, what waits for an answer may wait for several timeouts
        is_worth_it = round_trip.smoothed is None or round_trip.seen_loss < COPY_RISK
        # MAVSDK's server closes the file when a request with another number comes (measured)
        if is_worth_it and self._line.keeps_session:
            self._begin_early(now)
        else:
            self._open_file(Opcode.OPEN_FILE_RO, self._opened, now)

    def _begin_early(self, now: float) -> None:
        """Ask for the burst together with the open: a server that keeps to our number of the session begins.

        What it sends counts when it has said so, which therefore is asked for twice.
        """
        self._open_file(Opcode.OPEN_FILE_RO, self._opened, now, copies=2)
        self._burst(now)

    def _shows_lost_open(self, packet: Packet) -> bool:
        """Whether the server says to our burst that no file is open: the open before it did not arrive."""
        if packet.opcode != Opcode.NAK or packet.requested != Opcode.BURST_READ_FILE:
            return False
        is_open_awaited = self._has_request and self.blocked_until is None and self._restarts < MOST_RESTARTS
        return (
            is_open_awaited
            and self._is_of_a_burst(packet)
            and self._code(packet) == FileErrorCode.FILE_NOT_FOUND
        )

    def _is_unheard(self, packet: Packet) -> bool:
        """Whether this shows that the answer to our open got lost: it comes of the burst behind it."""
        if packet.session != self.asked_session or packet.requested != Opcode.BURST_READ_FILE:
            return False
        self._unheard += packet.opcode == Opcode.ACK and self._is_of_a_burst(packet)
        return self._unheard == OVERTAKEN and self._restarts < MOST_RESTARTS

    def take(self, packet: Packet, now: float) -> None:
        super().take(packet, now)
        if self.is_ended:
            return
        if self.session is None and self._shows_lost_open(packet):
            self._restarts += 1
            self._begin_early(now)
        if self.session is None and self._is_unheard(packet):
            # whether the file is ours nobody can tell any more: close it, and begin anew when the burst ends
            self._restarts += 1
            self._line.close_session(packet.session)
            self._start_anew()
            self._begin_early(now)
        if self.is_ended or self.session is None or packet.session != self.session:
            return
        self._is_silent = False
        if packet.requested == Opcode.BURST_READ_FILE and self._is_of_a_burst(packet):
            self._take_burst(packet, now)
        elif packet.requested == Opcode.READ_FILE:
            sequence = (packet.sequence - 1) & 0xFFFF
            flight = self._flights.pop(sequence, None) or self._late.pop(sequence, None)
            if flight is not None:
                self._take_read(packet, flight, now)
        self._go_on(now)

    def tick(self, now: float) -> None:
        super().tick(now)
        if self.is_ended or self.session is None:
            return
        if self._burst_runs and self._quiet_at() <= now:
            self._burst_is_silent(now)
        if not self._burst_runs:
            for sequence, flight in list(self._flights.items()):
                if self._flight_deadline(flight) <= now:
                    self._give_up(sequence)
                    self._in_vain(flight, now)
        self._go_on(now)

    def next_deadline(self) -> float:
        earliest = super().next_deadline()
        if self.is_ended or self.session is None:
            return earliest
        if self._burst_runs:
            earliest = min(earliest, self._quiet_at())
        elif self._flights:
            earliest = min(earliest, *map(self._flight_deadline, self._flights.values()))
        if self._next_wanted() is not None:
            earliest = min(earliest, self._next_read_at)
        return earliest

    def resume(self, now: float) -> None:
        super().resume(now)
        if self.session is not None and not self.is_ended:
            self._flights.clear()
            self._asked.clear()
            self._burst_attempts = 0
            self._burst_runs = False
            self._go_on(now)

    def _opened(self, packet: Packet, now: float) -> None:
        if len(packet.data) >= 4:
            self.size = int.from_bytes(packet.data[:4], "little")
        self._opened_at = now
        # also where the open was repeated: on a slow link its answer may only be late
        self._has_early_burst = self._burst_runs and packet.session == self._burst_session
        if not self._has_early_burst:
            self._burst_attempts = 0
            self._burst(now)

    # The burst

    def _burst(self, now: float) -> None:
        """Let everything come from where we stand."""
        if self._line.round_trip.is_hopeless(self._burst_attempts, now):
            self.fail(self._no_reply(self._burst_attempts, now), now)
            return
        sequence = self._line.next_sequence(answers=BURST_ANSWERS)
        self._bursts = [*self._bursts[1 - BURSTS_KEPT :], sequence]
        self._burst_runs = True
        self._read_behind_at = -math.inf
        self._has_early_burst = False
        self._may_burst = False
        self._burst_attempts += 1
        self._burst_sent_at = now
        self._block_at = self._overtaken_at = math.inf
        self._first_block = None
        session = self.asked_session if self.session is None else self.session
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
            for _ in range(min(self._most_copies, 2)):
                self._read_behind(now)

    def _is_of_a_burst(self, packet: Packet) -> bool:
        return any(0 < (packet.sequence - first) & 0xFFFF <= BURST_ANSWERS for first in self._bursts)

    def _take_burst(self, packet: Packet, now: float) -> None:
        if self._block_at == math.inf and self._burst_runs:
            first_answer = (self._bursts[-1] + 1) & 0xFFFF
            if packet.sequence == first_answer and self._burst_attempts == 1:
                self._line.round_trip.answered(self._burst_sent_at, now, 1)
        is_latest = 0 < (packet.sequence - self._bursts[-1]) & 0xFFFF <= BURST_ANSWERS
        if packet.opcode == Opcode.NAK:
            self._end_of_burst(packet, is_latest, now)
            return
        skipped = packet.offset - self._blocks.reached
        if skipped > 0:
            self._lost += -(-skipped // self._read_size)
        self._came += 1
        self._measure(packet, now)
        if self._keep(packet, packet.offset, now):
            self._burst_attempts = 0
        if not packet.burst_complete:
            self._burst_runs = True  # also when it was taken for over
        elif is_latest:
            self._may_burst = True
            self._stop_burst(now)

    def _measure(self, packet: Packet, now: float) -> None:
        """How long one block takes."""
        self._block_at = now
        if self._first_block is None:
            self._first_block = (now, packet.offset)
            return
        began_at, offset = self._first_block
        blocks = (packet.offset - offset) / self._read_size
        if blocks > 0 and now > began_at:
            self._gap = max((now - began_at) / blocks, SHORTEST_GAP)

    def _end_of_burst(self, packet: Packet, is_latest: bool, now: float) -> None:
        code = self._code(packet)
        if code == FileErrorCode.EOF:
            if packet.offset >= self._blocks.reached:  # else the server does not say where, and a read will
                self._ends_at(packet.offset)
        elif not is_latest:
            return
        elif code == FileErrorCode.UNKNOWN_COMMAND:
            self._has_bursts = False
        elif self._has_early_burst and self._blocks.reached == 0:
            self._burst(now)  # the first one came there before the open
            return
        else:
            self._does_not_read(packet, now)
        if is_latest:
            self._stop_burst(now)

    def _stop_burst(self, now: float) -> None:
        """It is over: what was asked for meanwhile is answered only now."""
        self._burst_runs = False
        for sequence, flight in self._flights.items():
            self._flights[sequence] = flight._replace(sent_at=now, is_only=False)

    def _quiet_at(self) -> float:
        if self._block_at == math.inf:
            return min(self._next_read_behind_at, self._repeats_at, self._overtaken_at + BURST_DELAY)
        if self._gap == UNKNOWN_GAP:
            return self._block_at + SLOWEST_GAP
        return self._block_at + max(QUIET_BLOCKS * self._gap, SHORTEST_QUIET)

    @property
    def _begins_by(self) -> float:
        """When the first block of the burst is late."""
        round_trip = self._line.round_trip
        longer = min(FIRST_BLOCK, FIRST_BLOCK_TRIPS * (round_trip.smoothed or FIRST_BLOCK))
        if self._has_early_burst:
            return self._opened_at + longer
        backoff = 2.0 ** min(max(self._burst_attempts - 2, 0), MOST_DOUBLINGS)
        return self._burst_sent_at + (round_trip.timeout + longer) * backoff

    @property
    def _repeats_at(self) -> float:
        """When a burst of which nothing has come is asked for again."""
        heard_at = min(self._line.heard_at, self._burst_sent_at + LONGEST_SILENCE)
        return max(self._begins_by, max(self._burst_sent_at, heard_at) + BURST_SILENCE)

    @property
    def _next_read_behind_at(self) -> float:
        """When a read is sent behind a burst of which nothing has come; infinity where enough were sent."""
        if len(self._flights) >= HELD:
            return math.inf
        if self._read_behind_at == -math.inf:
            return self._begins_by
        return self._read_behind_at + self._line.round_trip.prompt_timeout

    def _burst_is_silent(self, now: float) -> None:
        if self._block_at < math.inf:
            self._stop_burst(now)
        elif self._overtaken_at < math.inf:
            self._line.round_trip.timed_out(self._burst_attempts)
            self._may_burst = True
            self._stop_burst(now)
        elif now >= self._repeats_at:
            self._line.round_trip.timed_out(self._burst_attempts)
            self._burst(now)
        else:
            self._read_behind(now)

    def _read_behind(self, now: float) -> None:
        """Send a read behind the burst: its answer, and no block before it, tells that the burst was lost."""
        self._read_behind_at = now
        self._read(self._blocks.reached, now)

    # Single reads

    def _take_read(self, packet: Packet, flight: _Flight, now: float) -> None:
        for sequence, other in list(self._flights.items()):
            if other.number <= flight.number - OVERTAKEN:
                self._give_up(sequence)
                self._line.round_trip.timed_out(1)
        self._line.round_trip.answered(flight.sent_at, now, 1 if flight.is_only else 2)
        self._asked.pop(flight.offset, None)
        if packet.opcode == Opcode.ACK and packet.data:
            is_ahead = flight.offset >= self._blocks.reached
            self._keep(packet, flight.offset, now)
            if is_ahead and self._burst_runs and flight.sent_at >= self._burst_sent_at:
                self._overtaken_at = min(self._overtaken_at, now)
            self._may_burst = self._may_burst or (is_ahead and not self._burst_runs)
        elif packet.opcode == Opcode.ACK or self._code(packet) == FileErrorCode.EOF:
            self._ends_at(flight.offset)
        else:
            self._does_not_read(packet, now)

    def _give_up(self, sequence: int) -> None:
        """Count a read as lost."""
        self._late[sequence] = self._flights.pop(sequence)._replace(is_only=False)
        if len(self._late) > LATE_KEPT:
            del self._late[next(iter(self._late))]

    def _in_vain(self, flight: _Flight, now: float) -> None:
        """A read stayed without an answer; those of one offset that went out meanwhile count as one."""
        attempts, counted_at = self._asked.get(flight.offset, (0, -math.inf))
        if not self._is_wanted(flight.offset) or flight.sent_at < counted_at:
            return
        attempts += 1
        self._asked[flight.offset] = attempts, now
        is_silence = self._line.heard_at < flight.sent_at
        if not (is_silence and self._is_silent):  # of a silence that all share one tells enough
            self._line.round_trip.timed_out(attempts)
        self._is_silent = is_silence
        # a server that answers other requests meanwhile is there, and the link is worse than it looks
        if attempts >= MOST_TRIES or (is_silence and self._line.round_trip.is_hopeless(attempts, now)):
            self.fail(self._no_reply(attempts, now), now)

    def _flight_deadline(self, flight: _Flight) -> float:
        return flight.sent_at + self._line.round_trip.timeout + flight.ahead * self._gap

    def _is_wanted(self, offset: int) -> bool:
        is_behind = self._blocks.end is None and offset >= self._blocks.reached
        return is_behind or self._blocks.is_missing(offset)

    def _is_asked_for(self, offset: int) -> bool:
        return any(flight.offset == offset for flight in self._flights.values())

    @property
    def _window(self) -> int:
        if self._burst_runs:
            return HELD
        if self._is_silent:
            return SMALLEST_WINDOW
        round_trip = self._line.round_trip.smoothed or self._line.round_trip.timeout
        return min(max(math.ceil(round_trip / self._gap) + 2, SMALLEST_WINDOW), LARGEST_WINDOW)

    @property
    def _interval(self) -> float:
        """Seconds from one request to the next: the burst takes a third of the link, reads may take more."""
        return self._gap / 2

    @property
    def _next_read_at(self) -> float:
        """When the pace allows another read."""
        return self._tokens_at + max(1.0 - self._tokens, 0.0) * self._interval

    def _wanted(self) -> Iterator[int]:
        """What to read singly, the most useful first."""
        yield from self._blocks.missing(self._read_size)
        if self._blocks.end is None and not self._burst_runs:
            reached = self._blocks.reached
            ahead = TAIL_BLOCKS if self._has_bursts else LARGEST_WINDOW
            if self.size is not None:
                left = (self.size - reached) // self._read_size
                ahead = 1 if self._has_bursts and self._is_worth_a_burst() else max(min(ahead, left + 1), 1)
            end = reached + ahead * self._read_size
            yield from range(reached, min(end, self._exact_size), self._read_size)

    @property
    def _exact_size(self) -> int:
        """Bytes of the file; `UNKNOWN_SIZE` where the server estimates them, or says 0 of what it makes."""
        is_estimate = self._path_data.startswith(MADE_AT_READING)
        return UNKNOWN_SIZE if is_estimate or not self.size else self.size

    def _next_wanted(self) -> int | None:
        """What to read now: what is not asked for yet, else once more what is, if that is worth it."""
        if len(self._flights) >= self._window:
            return None
        copies: dict[int, int] = {}
        for flight in self._flights.values():
            copies[flight.offset] = copies.get(flight.offset, 0) + 1
        wanted = []
        for offset in self._wanted():
            if offset not in copies:
                return offset
            wanted.append(offset)
        if not wanted or self._burst_runs:
            return None
        fewest = min(wanted, key=copies.__getitem__)
        return fewest if copies[fewest] <= self._most_copies else None

    @property
    def _most_copies(self) -> int:
        passed = self._came / (self._came + self._lost) if self._came else 1.0
        loss = max(self._line.round_trip.seen_loss, 1.0 - passed * passed)
        if loss < COPY_RISK:
            return 0
        return min(math.ceil(math.log(COPY_RISK) / math.log(loss)) - 1, MOST_COPIES)

    def _read(self, offset: int, now: float) -> None:
        sequence = self._line.next_sequence()
        is_only = not (self._burst_runs or offset in self._asked or self._is_asked_for(offset))
        self._number += 1
        self._flights[sequence] = _Flight(offset, self._number, now, len(self._flights), is_only)
        self._tokens -= 1.0
        # MAVSDK's server refuses to read beyond the end; a file that grows has more by now
        left = self._exact_size - offset
        size = min(self._read_size, left) if left > 0 else self._read_size
        self._line.send(Packet(sequence, self.session or 0, Opcode.READ_FILE, size=size, offset=offset))

    # Both

    def _keep(self, packet: Packet, offset: int, now: float) -> bool:
        """Take what has come; whether anything in it is new."""
        if offset + len(packet.data) > self._limit:
            self._is_no_file(f"is longer than {self._limit} bytes", now)
            return False
        if self._blocks.pieces > SMALLEST_SHARE * self._limit // self._read_size + SPARE_PIECES:
            self._is_no_file("comes in too many pieces", now)
            return False
        return self._blocks.take(offset, packet.data)

    def _is_no_file(self, why: str, now: float) -> None:
        """What comes is more than a file can be."""
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

    def _does_not_read(self, packet: Packet, now: float) -> None:
        """The server refuses; where the session is lost, as when another station resets all, begin anew."""
        if self._may_reopen(packet):
            self._start_anew()
            self._open_file(Opcode.OPEN_FILE_RO, self._opened, now)
        else:
            self._refused(packet, "does not read", now)

    def _ends_at(self, offset: int) -> None:
        self._blocks.ends_at(min(offset, self._limit))

    def _go_on(self, now: float) -> None:
        """Ask for what is wanted, as far as the pace allows; end when all is there."""
        if self.is_ended or self.session is None:
            return
        if self._blocks.end is None and not self._burst_runs and self._blocks.reached >= self._exact_size:
            self._ends_at(self._blocks.reached)
        if self._blocks.is_complete:
            self.finish(self._blocks.content, now)
            return
        if self._may_burst and self._has_bursts and not self._burst_runs and self._is_worth_a_burst():
            self._burst(now)
        is_due = now >= self._next_read_at
        if now > self._tokens_at:
            elapsed = now - self._tokens_at
            self._tokens = min(self._tokens + elapsed / self._interval, SEND_BURST)
            self._tokens_at = now
        if is_due:
            self._tokens = max(self._tokens, 1.0)  # else rounding could make it due again and again
        while self._tokens >= 1.0 and (offset := self._next_wanted()) is not None:
            self._read(offset, now)

    def _is_worth_a_burst(self) -> bool:
        """Whether so much is left behind what has come that reads would take longer."""
        if self._blocks.end is not None or self.size is None:
            return False
        left = self.size - self._blocks.reached
        share = 0.0 if self._exact_size == self.size else TAIL_SHARE * self.size
        return left > max(TAIL_BLOCKS * self._read_size, share)
