"""MAVFTP: packets, requests, sessions that are always closed, reads by burst, and checksums.

The format is that of the MAVLink guide, "File Transfer Protocol (FTP)".
"""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from enum import IntEnum
from typing import Final, NamedTuple

import anyio

from paramclient.errors import FileErrorCode, FileTransferError, LinkError, NoReply, UsageError
from paramclient.protocol.channel import Channel, Inbox, task_group
from paramclient.wire.messages import FileTransfer, Message

DATA_SIZE_MAX: Final = 239
"""Bytes of a file in one message, at most."""
FILE_SIZE_MAX: Final = 64 * 1024 * 1024
"""Bytes of a file, by default: more than any flight log, less than memory."""
PATH_SIZE_MAX: Final = DATA_SIZE_MAX - 1
"""Bytes of a path, at most: it fills one message, with a NUL."""
SILENT_LOST: Final = 1e-3
"""Probability that all requests are lost, at which MAVFTP counts as silent where there is another way."""
FTP_SILENT_TIME: Final = 1.4
"""Seconds after which MAVFTP counts as silent where it was never answered and there is another way."""
BUSY: Final = "MAVFTP is in use for another file"
LOCK_TIME: Final = 2.0
"""Seconds to wait for another use of MAVFTP: longer than a checksum takes, shorter than a log."""
BUSY_TIME: Final = 3.3
"""Seconds after which ArduPilot ends the silent session of another station (measured)."""
BUSY_ATTEMPTS: Final = 2
"""Attempts to open a file while the session of another station is in the way."""
CLOSE_TIMEOUT: Final = 2.0
"""Seconds for the closing of a session, also when its reader is cancelled. ArduPilot has one session for all
links: an open one blocks the file access of all stations for 3 s."""
BURST_PAUSE_MIN: Final = 0.3
"""Seconds before the first block after which a burst counts as lost: at 57600 baud, ArduPilot begins one 95
to 170 ms after the request (measured), and another request has it send the whole file again."""
BLOCK_PAUSE_MIN: Final = 0.05
"""Seconds without a further block after which a burst counts as over."""
BLOCK_INTERVALS: Final = 8
"""Mean intervals between two blocks after which a burst counts as over."""
COPIES_TIME: Final = 0.1
"""Seconds of blocks for which reads are sent in several copies, for the last blocks."""
BLOCK_INTERVAL: Final = 0.006
"""Seconds in which a vehicle serves one read: ArduPilot sends a block every 5.9 ms (measured)."""
READS_MAX: Final = 64
"""Reads in flight, at most: what a round trip of 400 ms holds."""


class Opcode(IntEnum):
    """MAV_FTP_OPCODE, as far as it is used here."""

    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    OPEN_FILE_WO = 11
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    ACK = 128
    NAK = 129


_HEADER = struct.Struct("<HBBBBBxI")


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
        size = self.size or len(self.data)
        numbers = (self.session, self.opcode, size, self.requested, self.burst_complete, self.offset)
        return _HEADER.pack(self.sequence & 0xFFFF, *numbers) + self.data

    @property
    def code(self) -> int:
        """The reason in a NAK, comparable with `FileErrorCode`. A missing file is also an error number."""
        code = self.data[0] if self.data else FileErrorCode.FAIL
        if code == FileErrorCode.FAIL_ERRNO and self.data[1:2] == bytes((errno.ENOENT,)):
            return FileErrorCode.FILE_NOT_FOUND
        return code


async def read_file(
    channel: Channel,
    path: str,
    *,
    size_max: int = FILE_SIZE_MAX,
    open_attempts: Callable[[], int] | None = None,
    progress: Callable[[int, int | None], None] | None = None,
    begun: Callable[[bytes], None] = lambda head: None,
) -> bytes:
    """Read a file from the component. Its session on board is closed, whatever happens.

    Args:
        channel: the component's.
        path: of the file, as the component names it.
        size_max: bytes, at most.
        open_attempts: returns those to open the file, where there is another way without it; None for as many
            as loss explains.
        progress: called with the bytes received and the size, which is an estimate for generated files.
        begun: called with the first bytes of the file.

    Raises:
        FileTransferError: the component refused it, or the file is larger than `size_max`.
        NoReply: it does not answer; `FileCutOff` in the middle of the file.
        LinkError: the link is closed for good.
    """
    async with channel.ftp, _opened(channel, path, open_attempts) as (session, size):
        reader = _FileReader(channel, session, path, size_max, begun)
        if progress is not None:
            reader.progress = lambda received: progress(received, size)
        try:
            return await reader.read()
        except NoReply as error:
            raise FileCutOff(error, reader.prefix) from None


async def is_free(channel: Channel) -> bool:
    """Return whether MAVFTP can be used, after waiting for the end of a short use."""
    with anyio.move_on_after(LOCK_TIME):
        async with channel.ftp:
            return True
    return False


async def checksum(channel: Channel, path: str, *, attempts: Callable[[], int] | None = None) -> int:
    """Return the CRC-32 of a file, computed by the component: PX4's, see `crc32_px4`. Opens no session.

    Args:
        channel: the component's.
        path: of the file.
        attempts: returns the number at most; None for as many as loss explains.

    Raises:
        FileTransferError: the component does not compute it, or refused the file.
        NoReply: it does not answer.
        LinkError: the link is closed for good.
    """
    answer = await _request(channel, Opcode.CALC_FILE_CRC32, path, path_bytes(path), attempts=attempts)
    if len(answer.data) < 4:
        raise _error(channel, path, FileErrorCode.INVALID_DATA_SIZE)
    return int.from_bytes(answer.data[:4], "little")


def path_bytes(path: str) -> bytes:
    """Return a path as the data of a request.

    Raises:
        UsageError: the path is empty, has a NUL, or is too long for a message.
    """
    data = path.encode()
    if not data or b"\0" in data or len(data) > PATH_SIZE_MAX:
        raise UsageError(f"the path {path!r:.80} has not 1 to {PATH_SIZE_MAX} bytes without NUL")
    return data


async def _request(
    channel: Channel,
    opcode: Opcode,
    path: str,
    data: bytes = b"",
    *,
    session: int = 0,
    offset: int = 0,
    size: int = 0,
    attempts: Callable[[], int] | None = None,
    copies: Callable[[int], int] | None = None,
    sequence: int | None = None,
) -> Packet:
    """Send one request until its ACK arrives; several copies at once from the second attempt on.

    All attempts have one sequence number, so the server repeats its response and does not act twice.
    """
    if sequence is None:
        sequence = channel.next_ftp_sequence()
    packet = Packet(sequence, session, opcode, data, size, offset)

    def accept(message: Message) -> Packet | None:
        answer = _answer(message)
        if answer is None or answer.requested != opcode:
            return None
        if answer.opcode == Opcode.NAK:
            raise _error(channel, path, answer.code)
        return answer

    with channel.inbox((FileTransfer, (sequence + 1) & 0xFFFF)) as inbox:
        return await channel.exchange(
            FileTransfer(0, *channel.target, packet.pack()),
            inbox,
            accept,
            what=f"MAVFTP {opcode.name} {path} of {channel}",
            attempts=attempts,
            copies=copies or (lambda attempt: channel.timing.copies if attempt else 1),
        )


@asynccontextmanager
async def _opened(
    channel: Channel, path: str, attempts: Callable[[], int] | None
) -> AsyncIterator[tuple[int, int | None]]:
    """Open a file, and close its session at the end, also if opening is cancelled half-way."""
    data = path_bytes(path)
    session: int | None = None
    sequence = 0
    is_requested = False  # and not answered: it may be open
    try:
        for attempt in range(BUSY_ATTEMPTS):
            try:
                is_requested, sequence = True, channel.next_ftp_sequence()
                answer = await _request(
                    channel, Opcode.OPEN_FILE_RO, path, data, attempts=attempts, sequence=sequence
                )
                break
            except (NoReply, FileTransferError) as error:
                is_requested = False
                is_busy = isinstance(error, FileTransferError) and error.code == FileErrorCode.INVALID_SESSION
                if not is_busy or attempt + 1 == BUSY_ATTEMPTS:
                    raise
                await anyio.sleep(BUSY_TIME)
        session = answer.session
        yield session, int.from_bytes(answer.data[:4], "little") if len(answer.data) >= 4 else None
    finally:
        if session is not None or is_requested:
            is_closed = False
            seconds = 0.0 if channel.is_lost else CLOSE_TIMEOUT
            with anyio.CancelScope(shield=True), anyio.move_on_after(seconds), suppress(LinkError):
                await _close(channel, path, session, sequence)
                is_closed = True
            if not is_closed:  # the opening may just have been repeated, or nothing is received any more
                last = Packet(channel.next_ftp_sequence(), session or 0, Opcode.TERMINATE_SESSION)
                channel.send(FileTransfer(0, *channel.target, last.pack()))


async def _close(channel: Channel, path: str, session: int | None, opening: int) -> None:
    """Close a session.

    One whose number never arrived is requested once more, with the sequence number of its opening. ArduPilot
    takes the number of the request, which is 0.
    """
    with suppress(FileTransferError, NoReply):  # closed by the server, which ends silent sessions by itself
        if session is None:
            with suppress(FileTransferError):
                data = path_bytes(path)
                session = (await _request(channel, Opcode.OPEN_FILE_RO, path, data, sequence=opening)).session
        await _request(channel, Opcode.TERMINATE_SESSION, path, session=session or 0)


class FileCutOff(NoReply):
    """The component does not answer any more in the middle of a file.

    Attributes:
        prefix: the bytes from the beginning of the file to its first gap.
    """

    def __init__(self, error: NoReply, prefix: bytes) -> None:
        super().__init__(error.awaited, attempts=error.attempts, waited=error.waited)
        self.prefix = prefix


class _Pieces:
    """The received pieces of a file, by offset."""

    def __init__(self) -> None:
        self.received = 0
        self.reached = 0  # the offset behind the last received byte
        self.end: int | None = None
        self._pieces: dict[int, bytes] = {}

    def take(self, offset: int, data: bytes) -> None:
        """Keep a piece."""
        known = self._pieces.get(offset, b"")
        if len(data) > len(known):
            self._pieces[offset] = data
            self.received += len(data) - len(known)
            self.reached = max(self.reached, offset + len(data))

    def gaps(self) -> list[tuple[int, int]]:
        """Return first byte and end of what is missing before the end, as far as that is known."""
        found, at = [], 0
        for offset in sorted(self._pieces):
            if offset > at:
                found.append((at, offset))
            at = max(at, offset + len(self._pieces[offset]))
        if self.end is not None and at < self.end:
            found.append((at, self.end))
        return found

    def content(self) -> bytes:
        """Return the whole file."""
        data = bytearray()
        for offset in sorted(self._pieces):
            piece = self._pieces[offset]
            data[offset : offset + len(piece)] = piece
        return bytes(data[: self.end])


class _FileReader:
    """The read of one open file: a burst from beginning to end, and single reads of lost blocks."""

    def __init__(
        self, channel: Channel, session: int, path: str, size_max: int, begun: Callable[[bytes], None]
    ) -> None:
        self.progress: Callable[[int], None] = lambda received: None
        self._begun = begun
        self._channel = channel
        self._session = session
        self._path = path
        self._size_max = size_max
        self._pieces = _Pieces()
        self._has_bursts = True
        self._began = self._last = 0.0
        self._interval = BLOCK_INTERVAL  # between two blocks, as the vehicle or the link allows
        self._reads = 0  # in progress
        self._bursts = 0  # that were requested, and have not ended

    async def read(self) -> bytes:
        """Return the content of the file."""
        self._began = anyio.current_time()
        with self._channel.inbox(FileTransfer) as inbox:
            while self._has_bursts and self._pieces.end is None:
                before = self._pieces.reached
                await self._burst(inbox, before)
                if self._pieces.reached == before:
                    break
            await self._take_repeated(inbox)
        await self._read_gaps()
        return self._pieces.content()

    async def _take_repeated(self, inbox: Inbox) -> None:
        """Take the blocks of bursts that were requested once more because the first block was late.

        An ArduPilot serves them one after the other, and nothing else before.
        """
        pause = max(self._channel.timing.timeout(0), BURST_PAUSE_MIN)
        while self._bursts > 0 and self._pieces.gaps() and await self._take_burst(inbox, pause):
            pass

    @property
    def prefix(self) -> bytes:
        """The bytes from the beginning of the file to its first gap."""
        gaps = self._pieces.gaps()
        return self._pieces.content()[: gaps[0][0] if gaps else None]

    async def _burst(self, inbox: Inbox, offset: int) -> None:
        """Request the rest of the file from an offset, and take its blocks until they end or pause."""
        channel = self._channel
        for attempt in range(channel.timing.attempts_max):
            await channel.gate.wait()
            sequence = channel.next_ftp_sequence()
            request = Packet(
                sequence, self._session, Opcode.BURST_READ_FILE, size=DATA_SIZE_MAX, offset=offset
            )
            channel.send(FileTransfer(0, *channel.target, request.pack()))
            self._bursts += 1
            is_over = await self._take_burst(inbox, max(channel.timing.timeout(attempt), BURST_PAUSE_MIN))
            if is_over or self._pieces.reached > offset:
                return
            if channel.is_silent(self._began):
                what = f"{self._path} of {channel} at byte {offset}"
                raise NoReply(what, attempts=attempt + 1, waited=anyio.current_time() - self._began)

    async def _take_burst(self, inbox: Inbox, pause: float) -> bool:
        """Take the blocks of a burst until it is over; return False at a pause."""
        self._last = anyio.current_time()
        first, blocks = math.inf, -1
        while True:
            packet = None
            with self._channel.waiting_until(self._last + pause):
                packet = _answer(await inbox.next())
            if packet is None:
                return False
            if packet.requested != Opcode.BURST_READ_FILE or packet.session != self._session:
                continue
            self._bursts -= packet.opcode == Opcode.NAK or packet.burst_complete
            if packet.opcode == Opcode.NAK:
                self._end_of_burst(packet)
                return True
            self._take(packet.offset, packet.data)
            first, blocks = min(first, self._last), blocks + 1
            if blocks:
                self._interval = max(BLOCK_INTERVAL, (self._last - first) / blocks)
                pause = max(BLOCK_PAUSE_MIN, BLOCK_INTERVALS * self._interval)
            if packet.burst_complete:
                return True

    def _end_of_burst(self, packet: Packet) -> None:
        if packet.code == FileErrorCode.EOF:
            if packet.offset >= self._pieces.reached:  # otherwise the end is unknown, and a read shows it
                self._pieces.end = packet.offset
        elif packet.code != FileErrorCode.UNKNOWN_COMMAND:
            raise _error(self._channel, self._path, packet.code)
        self._has_bursts = False

    async def _read_gaps(self) -> None:
        """Read what is missing, and the end while it is unknown, block by block."""
        pieces, window = self._pieces, anyio.Semaphore(READS_MAX)
        while True:
            wanted = [at for first, end in pieces.gaps() for at in range(first, end, DATA_SIZE_MAX)]
            if pieces.end is None:
                wanted.append(pieces.reached)
            if not wanted:
                return
            async with task_group() as tasks:
                self._reads = len(wanted)
                for at in wanted:
                    await window.acquire()
                    tasks.start_soon(self._read_block, at, window)
                    await anyio.sleep(self._interval)

    async def _read_block(self, offset: int, window: anyio.Semaphore) -> None:
        """Read one block, or find the end of the file there."""
        channel, pieces = self._channel, self._pieces

        def copies(attempt: int) -> int:
            return max(1, min(channel.timing.copies, int(COPIES_TIME / self._interval) // self._reads))

        try:
            answer = await _request(
                channel,
                Opcode.READ_FILE,
                self._path,
                session=self._session,
                offset=offset,
                size=DATA_SIZE_MAX,
                copies=copies,
            )
            data = answer.data
        except FileTransferError as error:
            if error.code != FileErrorCode.EOF:
                raise
            data = b""
        finally:
            self._reads -= 1
            window.release()
        if data:
            self._take(offset, data)
        else:
            pieces.end = offset if pieces.end is None else min(pieces.end, offset)

    def _take(self, offset: int, data: bytes) -> None:
        if offset + len(data) > self._size_max:
            what = f"{self._path} of {self._channel} is longer than {self._size_max} bytes"
            code = FileErrorCode.INVALID_DATA_SIZE
            raise FileTransferError(what, *self._channel.target, path=self._path, code=code)
        if offset == 0:
            self._begun(data)
        self._pieces.take(offset, data)
        self._last = anyio.current_time()
        self.progress(self._pieces.received)


def _answer(message: Message) -> Packet | None:
    assert isinstance(message, FileTransfer)
    packet = Packet.unpack(message.payload)
    return packet if packet.opcode in (Opcode.ACK, Opcode.NAK) else None


def _error(channel: Channel, path: str, code: int) -> FileTransferError:
    what = f"{channel} refused {path}: {FileErrorCode.name_of(code)}"
    return FileTransferError(what, *channel.target, path=path, code=code)
