"""The write of a file, in order."""

from __future__ import annotations

from paramclient.errors import FileErrorCode, UsageError
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.ftp.transfer_job import FileTransferJob, FtpChannel

__all__ = ["FileWrite"]


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
