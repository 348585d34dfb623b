"""The file transfers of one component over MAVFTP: reads, writes, lists and checksums, one after the other.

Servers have few sessions, ArduPilot 4.6 and PX4 one, so a transfer waits until the one before it has ended
and its session is closed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeVar

from paramclient.errors import FileErrorCode, NoReply
from paramclient.protocol.ftp.file_read import FILE_SIZE_MAX, FileRead
from paramclient.protocol.ftp.file_write import FileWrite
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.ftp.transfer_job import FileTransferJob, FtpChannel
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.wire import FileTransfer

__all__ = ["DirectoryEntry", "FileChecksum", "FileList", "FileTransfers"]

AnyJob = TypeVar("AnyJob", bound=FileTransferJob[Any])

ENTRIES_MAX: Final = 65_536
"""Entries of a directory: more than a FAT card can hold in one."""
SESSION_TIMEOUT: Final = 3.3
"""Seconds after the last message to another station for which its session may still be open: ArduPilot ends
one 3 s after its last response (measured)."""


class DirectoryEntry(NamedTuple):
    """One entry of a directory; `size` is None for a directory."""

    name: str
    size: int | None

    @property
    def is_directory(self) -> bool:
        return self.size is None


class FileList(FileTransferJob[tuple[DirectoryEntry, ...]]):
    """One list of a directory. See `FileTransfers.list`."""

    def __init__(self, line: FtpChannel, path: str, now: float) -> None:
        super().__init__(line, path, now)
        self._entries: list[DirectoryEntry] = []
        self._passed = 0

    def begin(self, now: float) -> None:
        self._ask(Opcode.LIST_DIRECTORY, self._answered, now, data=self._path_data, offset=self._passed)

    def _answered(self, packet: Packet, now: float) -> None:
        is_end = packet.opcode == Opcode.NAK and self._code(packet) == FileErrorCode.EOF
        if packet.opcode == Opcode.NAK and not is_end:
            self._wait_or_refuse(packet, "does not list", now)
            return
        items = [] if is_end else [item for item in packet.data.split(b"\0") if item]
        for item in items:
            kind, text = item[:1], item[1:].decode("utf-8", "surrogateescape")
            if kind == b"F":
                name, _, size = text.rpartition("\t")
                is_number = size.isascii() and size.isdigit()
                self._entries.append(
                    DirectoryEntry(name, int(size)) if is_number else DirectoryEntry(text, 0)
                )
            elif kind == b"D":
                self._entries.append(DirectoryEntry(text, None))
        self._passed += len(items)
        if items and self._passed < ENTRIES_MAX:
            self.begin(now)
        else:
            self.finish(tuple(self._entries[:ENTRIES_MAX]), now)


class FileChecksum(FileTransferJob[int]):
    """One checksum of a file. See `FileTransfers.checksum`."""

    def begin(self, now: float) -> None:
        self._ask(Opcode.CALC_FILE_CRC32, self._answered, now, data=self._path_data, is_slow=True)

    def _answered(self, packet: Packet, now: float) -> None:
        if packet.opcode == Opcode.NAK:
            self._wait_or_refuse(packet, "gives no checksum of", now)
        else:
            self.finish(int.from_bytes(packet.data[:4], "little"), now)


class FileTransfers(Machine):
    """The transfers with the files of one component, in the order of the calls.

    Every call returns an `Operation` at once; it begins at the end of the one before it, and ends with its
    result, with a `FileTransferError` that has the server's reason, or with `NoReply`. Give it back with
    `release` to cancel it. At any end, its session on board is closed.

    Args:
        context: the component's. The server's messages to other stations are ignored.

    Attributes:
        on_closed: called once, in order, with the time, when the session of an ended job is closed.
        foreign_at: when the last message between the server and another station was received.
    """

    def __init__(
        self,
        context: Context,
    ) -> None:
        self._context = context
        self._target = context.target
        self._own = context.own
        self._line: FtpChannel | None = None
        self._job: FileTransferJob[Any] | None = None
        self._waiting: deque[FileTransferJob[Any]] = deque()
        self.on_closed: list[Callable[[float], None]] = []
        self.foreign_at = -math.inf

    def is_in_use(self, now: float) -> bool:
        """Return whether another station was seen to read or write files, so that its session may be open."""
        return now < self.foreign_at + SESSION_TIMEOUT

    @property
    def is_idle(self) -> bool:
        """Whether nothing is in progress, not even the closing of a session."""
        return self._job is None

    @property
    def is_closing(self) -> bool:
        """Whether the transfer in progress was released, and its session is still to be closed."""
        return self._job is not None and self._job.is_ended

    @property
    def has_idle_session(self) -> bool:
        """Whether a session of a released transfer is open on board."""
        return self._job is not None and self._job.is_ended and self._job.session is not None

    def read(
        self,
        path: str,
        now: float,
        *,
        read_size: int = DATA_SIZE_MAX,
        limit: int = FILE_SIZE_MAX,
        magics: tuple[bytes, ...] = (),
    ) -> FileRead:
        """Read a whole file; `size` and `received` of the result are the progress.

        Args:
            path: as the server names it, with a query where it takes one.
            now: seconds.
            read_size: bytes of one read, 1 to 239: one size for all, as ArduPilot requires for param.pck.
                Less than 239 is better on a radio that loses long frames.
            limit: bytes above which the file is rejected.
            magics: the first bytes that the file may have; none where they are not known. They show that a
                burst is of this file although the response to its open was lost.

        Raises:
            UsageError: the path or a size is invalid.
        """
        job = FileRead(self._line_at(now), path, now, read_size=read_size, limit=limit, magics=magics)
        return self._begin(job, now)

    def write(
        self, path: str, data: bytes, now: float, *, write_size: int = DATA_SIZE_MAX
    ) -> FileTransferJob[None]:
        """Write a whole file, and replace an existing one.

        If it fails or is released, the part written so far stays on board; PX4 and ArduPilot then refuse a
        param.pck as a whole. ArduPilot does not report what it does with a param.pck.

        Raises:
            UsageError: the path or the size of one piece is invalid.
        """
        return self._begin(FileWrite(self._line_at(now), path, data, now, write_size=write_size), now)

    def list(self, path: str, now: float) -> FileList:
        """List a directory.

        Raises:
            UsageError: the path is invalid.
        """
        return self._begin(FileList(self._line_at(now), path, now), now)

    def checksum(self, path: str, now: float) -> FileChecksum:
        """Let the server compute the CRC-32 of a file; see `paramclient.model.px4_hash.crc32_px4`.

        Raises:
            UsageError: the path is invalid.
        """
        return self._begin(FileChecksum(self._line_at(now), path, now), now)

    def release(self, job: FileTransferJob[Any], now: float, *, is_served: bool = True) -> None:
        """Cancel a transfer: its end is not reported, and its session is closed.

        Args:
            job: the transfer.
            now: the time.
            is_served: whether the component may have a server; otherwise no response is awaited.
        """
        self._context.reschedule()
        if job in self._waiting:
            self._waiting.remove(job)
        elif job is self._job and not job.done:
            (job.stop if is_served else job.abandon)(now)
            self._go_on(now)

    def receive(self, message: FileTransfer, now: float) -> None:
        """Process a FILE_TRANSFER_PROTOCOL of the component."""
        system, component = self._own
        if self._job is not None:
            self._job.note_activity(now)
        if message.target_system not in (0, system) or message.target_component not in (0, component):
            self.foreign_at = now
            return
        if self._job is not None and self._line is not None:
            self._line.received_at = now
            self._job.take(Packet.unpack(message.payload), now)
            self._go_on(now)

    def tick(self, now: float) -> None:
        """Repeat or give up unanswered requests."""
        if self._job is not None:
            self._job.tick(now)
            self._go_on(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return math.inf if self._job is None else self._job.next_deadline()

    def resume(self, now: float) -> None:
        """Repeat the request in flight: the link is back."""
        if self._job is not None:
            self._job.resume(now)
            self._go_on(now)

    def lose(self, now: float) -> None:
        """End the transfers of callers: the component is lost. The reads of a fetch go on for a while."""
        system, component = self._target
        jobs = [*([] if self._job is None else [self._job]), *self._waiting]
        for job in jobs:
            if job.is_of_caller and not job.done:
                what = f"{job.path} of {system}/{component} (lost)"
                error = NoReply(what, attempts=job.attempts, waited=now - job.begun_at)
                if job is not self._job:
                    self._waiting.remove(job)
                job.stop(now, error)
        self._go_on(now)

    def fail_all(self, error: Exception, now: float) -> None:
        """End all transfers with the error. The closing of an open session goes on; later transfers are not
        affected."""
        jobs = [*([] if self._job is None else [self._job]), *self._waiting]
        self._waiting.clear()
        for job in jobs:
            job.stop(now, error)
        self._go_on(now)

    def _line_at(self, now: float) -> FtpChannel:
        if self._line is None:
            self._line = FtpChannel(self._context, now)
        return self._line

    def _begin(self, job: AnyJob, now: float) -> AnyJob:
        self._waiting.append(job)
        if self._job is None:
            self._next(now)
        return job

    def _go_on(self, now: float) -> None:
        """Begin the next transfer when the one before has ended and its session is closed."""
        if self._job is not None and self._job.is_over:
            self._job = None
            self._next(now)
            callbacks, self.on_closed = self.on_closed, []
            for callback in callbacks:
                callback(now)

    def _next(self, now: float) -> None:
        while self._job is None and self._waiting:
            self._job = self._waiting.popleft()
            self._job.begin(now)
