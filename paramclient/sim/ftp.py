"""MAVFTP server of a simulated vehicle: files in memory, and param.pck generated from its parameters."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from paramclient.errors import FileErrorCode
from paramclient.model.px4_hash import crc32_px4
from paramclient.protocol import param_pck
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.param_pck import PARAM_FILE, PackedParam

IDLE_LIMIT: Final = 3.0
"""Seconds without a response after which ArduPilot reassigns the session; each response restarts the time."""
PX4_IDLE_LIMIT: Final = 11.0
"""Seconds without a request after which PX4 closes a session (measured: between 10.5 and 12)."""
PX4_BURST_BLOCKS: Final = 168
"""Blocks after which PX4 ends a burst with burst_complete: 40,152 bytes."""
EINVAL: Final = 22
"""Linux' error number for invalid arguments, as in NAKs."""
QUEUE: Final = 5
"""Requests that wait; further ones are dropped."""
LOOP: Final = 0.0058
"""Seconds until ArduPilot processes a request."""
PX4_TURN: Final = 0.0001
"""Seconds until PX4 processes a request."""
OVERHEAD: Final = 27
"""Bytes of a frame besides the data."""
ENTRY_SIZE: Final = 12
"""Estimated bytes per parameter in param.pck."""
CHECKSUM_READ: Final = 64
"""Bytes that ArduPilot reads at a time for a checksum."""

Address: TypeAlias = tuple[int, int]
"""System and component."""


class _Refusal(Exception):
    """A NAK: an error code, with FAIL_ERRNO an error number, and the offset of a failed read."""

    def __init__(self, code: FileErrorCode, errno: int = 0, *, offset: int = 0) -> None:
        self.data = bytes((code, errno)) if errno else bytes((code,))
        self.offset = offset


@dataclass(slots=True)
class _Session:
    number: int
    path: str
    used_at: float
    read_size: int = 0


@dataclass(slots=True)
class _Burst:
    """A burst in progress: the request for its next block, and the blocks until its end."""

    request: Packet
    sender: Address
    left: float


@dataclass(slots=True)
class FileServer:
    """The server side of MAVFTP; processes one request after the other, like ArduPilot's worker.

    - Up to 5 requests wait for the next period of the vehicle's loop; further ones are dropped. While a burst
      of ArduPilot runs, no other request is served.
    - A repeated request with the same sequence number gets the same response, if it was the last request.
    - ArduPilot has one session for all stations and links. While its file is open, requests of another
      session are refused with InvalidSession; closing another session is acknowledged and closes nothing. The
      session ends after 3 s without any response, with the next file that is opened; refusals count as
      responses.
    - param.pck is generated for every read. With ArduPilot, all reads of a session request the same size, and
      the file size in the response to the open is an estimate, 12 bytes per parameter.
    - Unlike on real vehicles, files cannot be written.
    - The checksum of a param.pck is that of the file as it is read 64 bytes at a time.
    - A burst of ArduPilot sends a block whenever a third of the link is free again, to the end of the file.
    - PX4 has one session for each link, closes it after 11 s without a request, and a reset from any sender
      closes it. A burst has blocks of 239 bytes independent of the requested size, and ends after 168 blocks
      with burst_complete; other requests are answered meanwhile, and another burst replaces it.

    Attributes:
        files: contents by path; a path's directories exist implicitly.

    Args:
        params: returns all parameters for param.pck, in order; None if it cannot be generated.
        rate: bytes per second of a burst; single reads are three times as fast.
        is_px4: whether the server behaves like PX4, which assigns session numbers; else like ArduPilot,
            which uses the session number of the open request.
    """

    params: Callable[[], Sequence[PackedParam] | None]
    rate: float
    is_px4: bool = False
    files: dict[str, bytes] = field(default_factory=dict)
    _session: _Session | None = None
    _waiting: deque[tuple[float, Packet, Address]] = field(default_factory=deque)
    """The requests, each with the time when it is served."""
    _burst: _Burst | None = None
    _free_at: float = -math.inf
    _answered_at: float = -math.inf
    _last: tuple[Address, Packet] | None = None
    _packed: tuple[object, bytes] | None = None

    def open_files(self, now: float) -> list[str]:
        """Return the paths of the open files that are in the way of other stations."""
        is_over = not self.is_px4 and now - self._answered_at > IDLE_LIMIT
        return [] if self._session is None or is_over else [self._session.path]

    def reset(self) -> None:
        """Close all sessions, as after switching off."""
        self._waiting.clear()
        self._session = self._burst = self._last = None
        self._free_at = self._answered_at = -math.inf

    def receive(self, payload: bytes, sender: Address, now: float) -> None:
        """Queue a request."""
        if len(self._waiting) < QUEUE:
            self._waiting.append((now + (PX4_TURN if self.is_px4 else LOOP), Packet.unpack(payload), sender))

    def next_deadline(self) -> float:
        """Return the time of the next work, or infinity."""
        request_at = max(self._waiting[0][0], self._free_at) if self._waiting else math.inf
        return request_at if self._burst is None else self._free_at

    def work(self, now: float, packets_max: float = math.inf) -> list[tuple[Packet, Address]]:
        """Do the due work, limited to `packets_max` responses; return the responses with their receivers."""
        out: list[tuple[Packet, Address]] = []
        while (due := self.next_deadline()) <= now:
            if len(out) >= packets_max:
                self._free_at = now
                break
            burst = self._burst
            if burst is None or (self.is_px4 and self._waiting and self._waiting[0][0] <= due):
                _, request, sender = self._waiting.popleft()
                answer, rate = self._answer(request, sender, due), 3 * self.rate
            else:
                answer, sender, rate = self._next_block(burst, due), burst.sender, self.rate
            if answer is not None:
                self._free_at = max(self._free_at, due + (OVERHEAD + len(answer.data)) / rate)
                self._answered_at = due
                self._last = (sender, answer)
                out.append((answer, sender))
        return out

    def _answer(self, request: Packet, sender: Address, now: float) -> Packet | None:
        """Return the response to a request; None where none follows, or a later one."""
        if request.opcode in (Opcode.ACK, Opcode.NAK):
            return None
        if self._last is not None:
            to, last = self._last
            is_same = last.sequence == request.sequence + 1 & 0xFFFF and last.requested == request.opcode
            if to == sender and is_same and (self.is_px4 or last.session == request.session):
                return last
        answer = Packet(request.sequence + 1 & 0xFFFF, request.session, Opcode.ACK, requested=request.opcode)
        try:
            self._reassign(request, now)
            match request.opcode:
                case Opcode.TERMINATE_SESSION | Opcode.RESET_SESSIONS:
                    self._close(request)
                case Opcode.OPEN_FILE_RO:
                    size = self._open(request, now)
                    number = 0 if self.is_px4 else request.session
                    return answer._replace(session=number, data=size.to_bytes(4, "little"))
                case Opcode.READ_FILE:
                    data = self._read(request.session, request.offset, request.size, now)
                    return answer._replace(data=data, offset=request.offset)
                case Opcode.BURST_READ_FILE:
                    size = DATA_SIZE_MAX if self.is_px4 else request.size or DATA_SIZE_MAX
                    self._read(request.session, request.offset, size, now)
                    blocks = PX4_BURST_BLOCKS if self.is_px4 else math.inf
                    self._burst = _Burst(request._replace(size=size), sender, blocks)
                    self._free_at = max(self._free_at, now)
                    return None
                case Opcode.CALC_FILE_CRC32:
                    content = self._content(_text(request.data), CHECKSUM_READ)
                    return answer._replace(data=crc32_px4(content).to_bytes(4, "little"))
                case _:
                    raise _Refusal(FileErrorCode.UNKNOWN_COMMAND)
        except _Refusal as refusal:
            offset = refusal.offset if request.opcode == Opcode.BURST_READ_FILE else 0
            return answer._replace(opcode=Opcode.NAK, data=refusal.data, offset=offset)
        return answer

    def _reassign(self, request: Packet, now: float) -> None:
        """End the session after its time; refuse another one before."""
        session = self._session
        if session is None:
            return
        if self.is_px4:
            if now - session.used_at >= PX4_IDLE_LIMIT:
                self._session = None
        elif request.session != session.number and request.opcode not in _CLOSING:
            if now - self._answered_at < IDLE_LIMIT:
                raise _Refusal(FileErrorCode.INVALID_SESSION)
            self._session = None

    def _close(self, request: Packet) -> None:
        is_own = self._session is not None and request.session == self._session.number
        is_reset = self.is_px4 and request.opcode == Opcode.RESET_SESSIONS
        if self.is_px4 and not is_own and not is_reset:
            raise _Refusal(FileErrorCode.INVALID_SESSION)
        if is_own or is_reset:
            self._session = None

    def _open(self, request: Packet, now: float) -> int:
        """Open a file; return its size."""
        if self._session is not None and self.is_px4:
            raise _Refusal(FileErrorCode.NO_SESSIONS_AVAILABLE)
        if self._session is not None and now - self._answered_at <= IDLE_LIMIT:
            raise _Refusal(FileErrorCode.FAIL)
        path = _text(request.data)
        self._session = None
        content = self._content(path, DATA_SIZE_MAX)
        self._session = _Session(0 if self.is_px4 else request.session, path, now)
        return len(content) if path in self.files else ENTRY_SIZE * len(self.params() or ())

    def _content(self, path: str, read_size: int) -> bytes:
        """Return a file; of the current param.pck, the part that the path names, for reads of this size."""
        if path in self.files:
            return self.files[path]
        name, _, options = path.partition("?")
        rows = self.params() if name == PARAM_FILE else None
        if rows is None:
            raise _Refusal(FileErrorCode.FILE_NOT_FOUND)
        key = (options, read_size, rows)
        if self._packed is None or self._packed[0] != key:
            given = {"start": 0, "count": 0, "withdefaults": 0}
            for option, _, text in (each.partition("=") for each in options.split("&")):
                if option in given:
                    limit = 2 if option == "withdefaults" else 65535
                    if not (text.isascii() and text.isdigit()) or int(text) >= limit:
                        raise _Refusal(FileErrorCode.FAIL_ERRNO, EINVAL)
                    given[option] = int(text)
            start, count, with_defaults = given.values()
            if start >= len(rows):
                raise _Refusal(FileErrorCode.FAIL_ERRNO, EINVAL)
            part, has_defaults = rows[start : start + count if count else None], bool(with_defaults)
            content = param_pck.encode(part, total=len(rows), with_defaults=has_defaults, read_size=read_size)
            self._packed = (key, content)
        return self._packed[1]

    def _read(self, number: int, offset: int, size: int, now: float) -> bytes:
        session = self._session
        if session is None or session.number != number:
            raise _Refusal(FileErrorCode.INVALID_SESSION if self.is_px4 else FileErrorCode.FILE_NOT_FOUND)
        session.used_at = now
        session.read_size = session.read_size or size
        if size != session.read_size and not self.is_px4 and session.path not in self.files:
            raise _Refusal(FileErrorCode.FAIL_ERRNO, EINVAL)
        read_size = DATA_SIZE_MAX if self.is_px4 else min(size, DATA_SIZE_MAX)
        data = self._content(session.path, read_size)[offset : offset + size] if size else b""
        if not data:
            raise _Refusal(FileErrorCode.EOF, offset=offset)
        return data

    def _next_block(self, burst: _Burst, now: float) -> Packet:
        request, sequence = burst.request, burst.request.sequence + 1 & 0xFFFF
        block = Packet(sequence, request.session, Opcode.ACK, requested=request.opcode)
        burst.left -= 1
        try:
            data = self._read(request.session, request.offset, request.size, now)
        except _Refusal as refusal:
            self._burst = None
            return block._replace(opcode=Opcode.NAK, data=refusal.data, offset=refusal.offset)
        burst.request = request._replace(sequence=sequence, offset=request.offset + len(data))
        if not burst.left:
            self._burst = None
        return block._replace(data=data, offset=request.offset, burst_complete=not burst.left)


_CLOSING = (Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS)


def _text(data: bytes) -> str:
    return data.split(b"\0", 1)[0].decode("latin-1")
