"""The base of all file transfers: one request at a time, retries, sessions, errors."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import TypeVar

from paramclient.errors import FileErrorCode, FileTransferError, NoReply, UsageError
from paramclient.protocol.ftp.packets import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import OPENS_MAX, SESSION_IDLE_TIME, FileAttempts, RetryPolicy
from paramclient.protocol.wire import FileTransfer

__all__ = ["BUSY", "SESSION_LOST", "FileTransferJob", "FtpChannel", "path_bytes"]

Result = TypeVar("Result")

BUSY = frozenset((FileErrorCode.INVALID_SESSION, FileErrorCode.NO_SESSIONS_AVAILABLE))
"""Responses to an open while another station has a file open, or has left one open."""
SESSION_LOST = frozenset((FileErrorCode.INVALID_SESSION, FileErrorCode.FILE_NOT_FOUND))
"""Responses to a request in a session that is not open."""


def path_bytes(path: str) -> bytes:
    """Encode a path for a request.

    Raises:
        UsageError: it is empty, longer than a request can hold, or contains NUL.
    """
    data = path.encode("utf-8", "surrogateescape")
    if not data or b"\0" in data:
        raise UsageError(f"the path of a file has at least one character, and no NUL: {path!r}")
    if len(data) > DATA_SIZE_MAX:
        raise UsageError(f"the path of a file has at most {DATA_SIZE_MAX} bytes, not {len(data)}")
    return data


class FtpChannel:
    """The way to the files of one component, shared by all transfers.

    Attributes:
        target: system and component.
        retry: the component's policy, which decides when to repeat the requests.
        received_at: when the server's last message to us was received.
    """

    def __init__(
        self,
        context: Context,
        now: float,
    ) -> None:
        self.target = context.target
        self.retry: RetryPolicy = context.retry
        self.received_at = -math.inf
        self._context = context
        self._send = context.send
        # The first number differs between runs of the program: a server repeats its last response to a
        # request that has the number of the one before.
        self._sequence = int(now * 1000) & 0xFFFF
        self._session = self._sequence % 255

    @property
    def keeps_session(self) -> bool:
        """Whether the server uses the session number that its open requested, as ArduPilot does."""
        return self._context.is_ardupilot

    def send(self, packet: Packet) -> None:
        self._send(FileTransfer(0, *self.target, packet.pack()))

    def close_session(self, session: int) -> None:
        """Send a request to close one session, without waiting for it; twice, as one may be lost.

        A reset of all sessions would close those of other stations too (measured with PX4).
        """
        packet = Packet(self.next_sequence(), session, Opcode.TERMINATE_SESSION)
        self.send(packet)
        self.send(packet)

    def next_sequence(self, *, answers: int = 1) -> int:
        """Return a number for a request that may have this many responses, each with a number of its own."""
        number = self._sequence
        self._sequence = (number + 1 + answers) & 0xFFFF
        return number

    def next_session(self) -> int:
        """Return a session number for an open; never 0, which a server may replace by another."""
        self._session = self._session % 255 + 1
        return self._session


class FileTransferJob(Operation[Result]):
    """One transfer with one file. Its owner passes responses and time to it.

    A job ends with its result or its error when its session is closed: the server has acknowledged that, or
    was silent for several timeouts. The receiver of the result may thus open the next file at once.

    Attributes:
        path: of the file or directory.
        requested_at: when the opening of the file was requested last, except for repeats; infinity before.
        is_over: whether the job needs the server no longer: nothing was begun, or its session is closed.
        is_of_caller: whether a caller waits that gets an error when the component is lost.
        yields: whether it ends with the server's refusal while another station has a file open, instead of
            waiting, and after few requests to a server that has never responded; to be set before any
            response.
        session: the number of its open session, or None.
        requested_session: the requested session while it is unknown whether that is open, or None.
    """

    def __init__(self, line: FtpChannel, path: str, now: float) -> None:
        super().__init__(now)
        self._line = line
        self.path = path
        self.is_of_caller = False
        self.yields = False
        self.session: int | None = None
        self.requested_session: int | None = None
        self.is_over = False
        self.requested_at = math.inf
        self._path_data = path_bytes(path)
        self._report_end: Callable[[float], None] | None = None  # reports the end, once its session is closed
        self._request: Packet | None = None
        self._on_response: Callable[[Packet, float], None] | None = None
        self._attempts = FileAttempts(line.retry, line)
        self._failures = 0
        self._openings = 1
        self._busy_since = math.inf
        self._open_at = math.inf  # when the file is opened again, while the server's session is in use

    @property
    def attempts(self) -> int:
        """The number of times the present request was sent."""
        return self._attempts.count

    @property
    def _has_request(self) -> bool:
        """Whether a response is awaited."""
        return self._request is not None

    @property
    def blocked_until(self) -> float | None:
        """When the file is opened again, while the server's session is in use; None otherwise."""
        return None if self._open_at == math.inf else self._open_at

    @property
    def is_ended(self) -> bool:
        """Whether the outcome is known; the session may still be open."""
        return self._report_end is not None

    @abstractmethod
    def begin(self, now: float) -> None:
        """Start: the server is free."""

    def finish(self, result: Result, now: float) -> None:
        """End with a result as soon as the session is closed; later ends are ignored."""
        self._close(lambda at: Operation.finish(self, result, at), now)

    def fail(self, error: Exception, now: float) -> None:
        """End with an error as soon as the session is closed; later ends are ignored.

        After silence (`NoReply`) the closing is sent and nothing is awaited.
        """
        if isinstance(error, NoReply) and self._report_end is None:
            self._send_blind_close()
            self.session = self.requested_session = None
        self._close(lambda at: Operation.fail(self, error, at), now)

    def abandon(self, now: float) -> None:
        """End without a report and without waiting: the component has no server."""
        self.on_done.clear()
        self._send_blind_close()
        self.session = self.requested_session = None
        self._close(_ignore, now)

    def stop(self, now: float, error: Exception | None = None) -> None:
        """End without waiting for the closing of the session, which continues until `is_over`.

        Args:
            now: the time.
            error: the error to end with; None without a report.
        """
        if error is None:
            self.on_done.clear()
        else:
            Operation.fail(self, error, now)
        self._close(_ignore, now)

    def _close(self, report_end: Callable[[float], None], now: float) -> None:
        """Close the session, then report the end."""
        if self._report_end is not None:
            return
        self._report_end = report_end
        self._open_at = math.inf
        if self.session is not None:
            self._terminate(self.session, now)
        elif self.requested_session is not None and self._request is not None:
            # An open is in flight. Its response says which session to close, as PX4 uses numbers of its own;
            # ArduPilot uses ours, so this closes the session even without that response.
            self._send_blind_close()
            self._attempts.await_open()
        else:
            self._closed(now)

    def _terminate(self, session: int, now: float) -> None:
        copies = self._attempts.close_copies
        self._ask(
            Opcode.TERMINATE_SESSION, lambda _, now: self._closed(now), now, session=session, copies=copies
        )

    def _closed(self, now: float) -> None:
        self._request = self._on_response = self.session = self.requested_session = None
        self.is_over = True
        assert self._report_end is not None
        self._report_end(now)

    def _send_blind_close(self) -> None:
        """Send requests to close the session, without waiting for it; twice, as one may be lost."""
        session = self.requested_session if self.session is None else self.session
        if session is not None:
            self._line.close_session(session)

    def note_activity(self, now: float) -> None:
        """Note any response of the server to another station: the session in use stays open."""
        if self._open_at < math.inf:
            self._open_at = now + SESSION_IDLE_TIME

    def take(self, packet: Packet, now: float) -> None:
        """Process a response of the server to us."""
        request = self._request
        if request is None or self._on_response is None:
            return
        is_answer = packet.sequence == (request.sequence + 1) & 0xFFFF and packet.requested == request.opcode
        if is_answer and packet.opcode in (Opcode.ACK, Opcode.NAK):
            on_response = self._on_response
            self._attempts.answered(now)
            self._request = self._on_response = None
            on_response(packet, now)

    def tick(self, now: float) -> None:
        """Do what is due."""
        if self._open_at <= now:
            self._open_at = math.inf
            self.begin(now)
        if self._request is not None and self._attempts.due_at <= now:
            self._attempts.timed_out()
            if self.is_ended and self._attempts.is_close_hopeless:
                self._send_blind_close()
                self._closed(now)
            elif self._attempts.should_give_up(now, yields=self.yields):
                self._request = None
                self.fail(self._no_reply(self.attempts, now), now)
            else:
                self._transmit(self._request, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return min(self._open_at, self._attempts.due_at if self._request is not None else math.inf)

    def resume(self, now: float) -> None:
        """Repeat the request: the link is back."""
        if self._request is not None:
            self._attempts.restart()
            self._transmit(self._request, now)

    def _ask(
        self,
        opcode: Opcode,
        on_response: Callable[[Packet, float], None],
        now: float,
        *,
        data: bytes = b"",
        session: int = 0,
        offset: int = 0,
        copies: int = 1,
        is_slow: bool = False,
    ) -> None:
        """Send a request and repeat it until its response, which is passed to `on_response`.

        With `is_slow`, the server works on it for a while, and the response shows nothing about the link.
        """
        sequence = self._line.next_sequence()
        self._request = Packet(sequence, session, opcode, data, offset=offset)
        self._on_response = on_response
        self._attempts = FileAttempts(self._line.retry, self._line, is_slow=is_slow)
        self._transmit(self._request, now, copies=copies)

    def _open_file(
        self, opcode: Opcode, on_response: Callable[[Packet, float], None], now: float, *, copies: int = 1
    ) -> None:
        """Open the file in a session of its own, which `session` names when `on_response` is called.

        If an open is in flight already, its number is used again.
        """

        def opened(packet: Packet, now: float) -> None:
            code = self._code(packet)
            if packet.opcode == Opcode.ACK:
                self.session, self.requested_session = packet.session, None
                if self.is_ended:
                    self._terminate(packet.session, now)
                else:
                    on_response(packet, now)
            elif self.is_ended and code == FileErrorCode.FAIL:
                self._terminate(number, now)  # open already, by an open of ours whose response was lost
            elif self.is_ended:
                self._closed(now)
            elif is_first and code == FileErrorCode.FAIL and self.attempts == 1 and not self._failures:
                # no response was lost, so another station's session has this number
                self._failures = 1
                self.requested_session = None
                self.begin(now)
            elif code == FileErrorCode.FAIL and self._failures < self._attempts.open_failures_max:
                # the open session may be that of an open whose response was lost
                self._failures += 1
                self._line.close_session(number)
                self.begin(now)
            else:
                self._wait_or_refuse(packet, "does not open", now)

        is_first = self.requested_at == math.inf
        self.requested_at = now
        number = self._line.next_session() if self.requested_session is None else self.requested_session
        self.requested_session = number
        self._ask(opcode, opened, now, data=self._path_data, session=number, copies=copies)

    def _take_session(self) -> None:
        """Take the requested session as open: the response to the open was lost, and is awaited no longer."""
        self.session, self.requested_session = self.requested_session, None
        self._request = self._on_response = None

    def _wait_or_refuse(self, packet: Packet, what: str, now: float) -> None:
        """Retry later while the server's session is in use; otherwise end with the error of a NAK."""
        self._busy_since = min(self._busy_since, now)
        is_in_use = self._code(packet) in BUSY and self._attempts.may_wait(self._busy_since, now)
        if is_in_use and not self.yields:
            self._open_at = now + SESSION_IDLE_TIME
        else:
            self.requested_session = None
            self._refused(packet, what, now)

    def _may_reopen(self, packet: Packet) -> bool:
        """Drop a session that the server has lost; return whether its file may be opened again."""
        self._openings += 1
        if self._code(packet) not in SESSION_LOST or self._openings > OPENS_MAX:
            return False
        self.session = None
        return True

    def _refused(self, packet: Packet, what: str, now: float) -> None:
        """End with the error in a NAK."""
        system, component = self._line.target
        code = self._code(packet)
        errno = packet.data[1] if code == FileErrorCode.FAIL_ERRNO and len(packet.data) > 1 else 0
        words = FileErrorCode.name_of(code) + (f" {errno}" if errno else "")
        self.fail(
            FileTransferError(
                f"{system}/{component} {what} {self.path}: {words}",
                system=system,
                component=component,
                path=self.path,
                code=code,
                errno=errno,
            ),
            now,
        )

    def _no_reply(self, attempts: int, now: float) -> NoReply:
        system, component = self._line.target
        return NoReply(f"{self.path} of {system}/{component}", attempts=attempts, waited=now - self.begun_at)

    @staticmethod
    def _code(packet: Packet) -> int:
        return packet.data[0] if packet.data else FileErrorCode.FAIL

    def _transmit(self, request: Packet, now: float, *, copies: int = 1) -> None:
        self._attempts.sent(now)
        for _ in range(max(copies, self._attempts.copies)):
            self._line.send(request)


def _ignore(now: float) -> None:
    """Report nothing: the error was reported before."""
