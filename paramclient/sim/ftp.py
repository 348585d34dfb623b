"""MAVFTP of a simulated vehicle: files in memory, and param.pck made of what it holds at the moment."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from paramclient.errors import FileErrorCode, PackError, UsageError
from paramclient.protocol import pack
from paramclient.protocol.ftp.packets import MOST_DATA, Opcode, Packet
from paramclient.protocol.pack import PackedParam
from paramclient.values import crc32_px4

__all__ = ["FileServer"]

PARAM_FILE: Final = "@PARAM/param.pck"
IDLE_LIMIT: Final = 3.0
"""Seconds without a word after which ArduPilot gives a session to another (GCS_FTP.cpp)."""
EINVAL: Final = 22

Sender: TypeAlias = tuple[int, int]
"""System and component."""


class _Answer(NamedTuple):
    opcode: Opcode
    data: bytes = b""
    offset: int = 0


@dataclass(slots=True)
class _Session:
    """One open file.

    Attributes:
        read: gives the bytes at an offset, or None where they cannot be read in this size.
        written: what was written, or None while it is open for reading.
    """

    owner: Sender
    path: str
    read: Callable[[int, int], bytes | None] | None
    used_at: float
    written: bytearray | None = None


@dataclass(slots=True)
class _Burst:
    request: Packet
    sender: Sender
    offset: int
    sequence: int
    left: int


@dataclass(slots=True)
class FileServer:
    """The server's side of MAVFTP, one request after the other, as ArduPilot's worker takes them.

    - Up to 5 requests wait for their turn, which comes with the next one of the vehicle's loop; further ones
      are dropped. While a burst runs nothing else is served.
    - A request that comes again, its number the same, gets the same answer, as long as that was the last.
    - param.pck is made anew for every read. All reads through one session ask for one size; its size in the
      answer to the open is an estimate, 12 bytes for each parameter. Written, it sets parameters when it
      is closed.
    - A burst sends a block whenever a third of the link is free again, to the end of the file.

    Attributes:
        files: paths and contents; a path's directories exist with it.

    Args:
        params: all parameters for the file, in order; None where it cannot be made.
        apply: takes the parameters of a file that was written.
        rate: bytes per second of a burst; what is asked for singly goes three times as fast.
        turn: seconds until a request is looked at.
        numbers_sessions: the server gives its own numbers, and a reset closes the sessions of everyone, as
            with PX4; else a session has the number that its open asked for, and a reset only that one.
        sessions: that can be open at once.
        burst_blocks: after which a burst ends and says so.
    """

    params: Callable[[], Sequence[PackedParam] | None]
    apply: Callable[[Sequence[PackedParam]], None]
    rate: float
    turn: float = 0.0058
    numbers_sessions: bool = False
    sessions: int = 1
    burst_blocks: int = 2000
    files: dict[str, bytes] = field(default_factory=dict)
    _open: dict[int, _Session] = field(default_factory=dict)
    _waiting: deque[tuple[float, Packet, Sender]] = field(default_factory=deque)
    _burst: _Burst | None = None
    _free_at: float = -math.inf
    _last: tuple[Sender, Packet] | None = None
    _packed: tuple[object, bytes] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0.0):
            raise UsageError(f"the rate of MAVFTP is a number of bytes per second above 0, not {self.rate}")

    @property
    def open_files(self) -> list[str]:
        """The paths of the files that are open."""
        return [session.path for session in self._open.values()]

    def reset(self) -> None:
        """The vehicle was switched off."""
        self._open.clear()
        self._waiting.clear()
        self._burst = self._last = None
        self._free_at = -math.inf

    def receive(self, payload: bytes, sender: Sender, now: float) -> None:
        """A request has come."""
        if len(self._waiting) < _QUEUE:
            self._waiting.append((now + self.turn, Packet.unpack(payload), sender))

    def next_deadline(self) -> float:
        """When `work` has something to do, or infinity."""
        if self._burst is not None:
            return self._free_at
        return max(self._waiting[0][0], self._free_at) if self._waiting else math.inf

    def work(self, now: float) -> list[tuple[Packet, Sender]]:
        """Do what is due: the answers, and whom they are for."""
        out: list[tuple[Packet, Sender]] = []
        while (due := self.next_deadline()) <= now:
            if self._burst is None:
                _, request, sender = self._waiting.popleft()
                answer = self._answer(request, sender, due)
                rate = 3 * self.rate
            else:
                sender = self._burst.sender
                answer = self._next_block(self._burst, due)
                rate = self.rate
            if answer is not None:
                out.append((answer, sender))
                self._last = (sender, answer)
                self._free_at = due + (_OVERHEAD + len(answer.data)) / rate
        return out

    def _answer(self, request: Packet, sender: Sender, now: float) -> Packet | None:
        """One request; None of a burst, whose blocks follow, and of what is no request."""
        if request.opcode in (Opcode.ACK, Opcode.NAK):
            return None
        if self._last is not None:
            to, last = self._last
            is_same = last.sequence == request.sequence + 1 & 0xFFFF and last.requested == request.opcode
            if to == sender and is_same and (self.numbers_sessions or last.session == request.session):
                return last
        number = request.session
        match request.opcode:
            case Opcode.TERMINATE_SESSION:
                done = self._terminate(number)
            case Opcode.RESET_SESSIONS:
                for each in list(self._open) if self.numbers_sessions else [number]:
                    self._open.pop(each, None)
                done = _Answer(Opcode.ACK)
            case Opcode.OPEN_FILE_RO | Opcode.CREATE_FILE:
                number, done = self._open_file(request, sender, now)
            case Opcode.READ_FILE:
                done = self._read(number, request.offset, request.size, now)
            case Opcode.WRITE_FILE:
                done = self._write(number, request, now)
            case Opcode.BURST_READ_FILE:
                done = self._read(number, request.offset, request.size or MOST_DATA, now)
                if done.opcode is Opcode.ACK:
                    self._burst = _Burst(
                        request, sender, request.offset, request.sequence + 1, self.burst_blocks
                    )
                    self._free_at = max(self._free_at, now)
                    return None
            case Opcode.LIST_DIRECTORY:
                done = self._list(_text(request.data), request.offset)
            case Opcode.CALC_FILE_CRC32:
                content = self.files.get(_text(request.data))
                done = _NOT_FOUND if content is None else _number(crc32_px4(content))
            case _:
                done = _no(FileErrorCode.UNKNOWN_COMMAND)
        return _packet(done, request, number, request.sequence + 1)

    def _next_block(self, burst: _Burst, now: float) -> Packet:
        session = burst.request.session
        done = self._read(session, burst.offset, burst.request.size or MOST_DATA, now)
        sequence = burst.sequence
        burst.sequence += 1
        burst.offset += len(done.data)
        burst.left -= 1
        complete = done.opcode is Opcode.NAK or burst.left == 0
        if complete:
            self._burst = None
        is_last_of_many = burst.left == 0
        return _packet(done, burst.request, session, sequence)._replace(burst_complete=is_last_of_many)

    def _open_file(self, request: Packet, sender: Sender, now: float) -> tuple[int, _Answer]:
        number, path = request.session, _text(request.data)
        for each, session in list(self._open.items()):
            if now - session.used_at >= IDLE_LIMIT:
                del self._open[each]
        if self.numbers_sessions:
            number = next((each for each in range(self.sessions) if each not in self._open), -1)
            if number < 0:
                return request.session, _no(FileErrorCode.NO_SESSIONS_AVAILABLE)
        elif number in self._open:
            return number, _no(FileErrorCode.FAIL)
        elif len(self._open) >= self.sessions:
            return number, _no(FileErrorCode.INVALID_SESSION)
        session = _Session(sender, path, None, now)
        if request.opcode == Opcode.CREATE_FILE:
            session.written = bytearray()
            done = _Answer(Opcode.ACK)
        elif path in self.files:
            content = self.files[path]
            session.read = lambda offset, size: content[offset : offset + size]
            done = _number(len(content))
        elif path.split("?")[0] == PARAM_FILE and (rows := self.params()) is not None:
            query = _query(path)
            if query is None or query["start"] >= len(rows):
                return number, _no(FileErrorCode.FAIL_ERRNO, EINVAL)
            session.read = self._param_file(query)
            done = _number(_ESTIMATE * len(rows))
        else:
            return number, _NOT_FOUND
        self._open[number] = session
        return number, done

    def _read(self, number: int, offset: int, size: int, now: float) -> _Answer:
        session = self._open.get(number)
        if session is None:
            return _no(FileErrorCode.INVALID_SESSION if self._open else FileErrorCode.FILE_NOT_FOUND)
        session.used_at = now
        if session.read is None:
            return _no(FileErrorCode.FAIL)
        data = session.read(offset, size)
        if data is None:
            return _no(FileErrorCode.FAIL_ERRNO, EINVAL)
        if not data:
            return _no(FileErrorCode.EOF)._replace(offset=offset)
        return _Answer(Opcode.ACK, data, offset)

    def _write(self, number: int, request: Packet, now: float) -> _Answer:
        session = self._open.get(number)
        if session is None:
            return _no(FileErrorCode.INVALID_SESSION if self._open else FileErrorCode.FILE_NOT_FOUND)
        session.used_at = now
        if session.written is None or request.offset > _LARGEST:
            return _no(FileErrorCode.FAIL)
        if len(session.written) < request.offset:
            session.written += bytes(request.offset - len(session.written))
        session.written[request.offset : request.offset + len(request.data)] = request.data
        return _Answer(Opcode.ACK, offset=request.offset)

    def _terminate(self, number: int) -> _Answer:
        session = self._open.pop(number, None)
        if session is None and self.numbers_sessions:
            return _no(FileErrorCode.INVALID_SESSION)
        if session is not None and session.written is not None:
            if session.path != PARAM_FILE:
                self.files[session.path] = bytes(session.written)
                return _Answer(Opcode.ACK)
            try:
                self.apply(pack.decode_upload(bytes(session.written)))
            except PackError:
                return _no(FileErrorCode.FAIL_ERRNO, EINVAL)
        return _Answer(Opcode.ACK)

    def _param_file(self, query: dict[str, int]) -> Callable[[int, int], bytes | None]:
        """How a session reads param.pck: as it is at that moment, always by the size of the first read."""
        start, count, with_defaults = query["start"], query["count"] or None, bool(query["withdefaults"])
        first_size: int | None = None

        def read(offset: int, size: int) -> bytes | None:
            nonlocal first_size
            first_size = size if first_size is None else first_size
            rows = self.params()
            if size != first_size or rows is None:
                return None
            key = (start, count, with_defaults, size, rows)
            if self._packed is None or self._packed[0] != key:
                part = rows[start:] if count is None else rows[start : start + count]
                content = pack.encode(
                    part, total=len(rows), with_defaults=with_defaults, read_size=min(size, MOST_DATA)
                )
                self._packed = (key, content)
            return self._packed[1][offset : offset + size]

        return read

    def _list(self, path: str, skip: int) -> _Answer:
        prefix = path.rstrip("/") + "/" if path else ""
        inside = sorted(name[len(prefix) :] for name in self.files if name.startswith(prefix))
        if not inside:
            return _NOT_FOUND
        entries: dict[str, bytes] = {}
        for name in inside:
            first, *rest = name.split("/")
            entries[first] = (
                f"D{first}\0".encode()
                if rest
                else (f"F{first}\t{len(self.files[prefix + first])}\0".encode())
            )
        data = b""
        for entry in list(entries.values())[skip:]:
            if len(data) + len(entry) > MOST_DATA:
                break
            data += entry
        return _Answer(Opcode.ACK, data) if data else _no(FileErrorCode.EOF)


_QUEUE = 5
_OVERHEAD = 27  # bytes of a frame besides the data
_ESTIMATE = 12
_LARGEST = 0xFFFF  # of what is written, in bytes


def _no(code: FileErrorCode, errno: int = 0) -> _Answer:
    return _Answer(Opcode.NAK, bytes((code, errno)) if errno else bytes((code,)))


_NOT_FOUND = _no(FileErrorCode.FILE_NOT_FOUND)


def _number(value: int) -> _Answer:
    return _Answer(Opcode.ACK, value.to_bytes(4, "little"))


def _packet(answer: _Answer, request: Packet, session: int, sequence: int) -> Packet:
    return Packet(
        sequence & 0xFFFF,
        session,
        answer.opcode,
        answer.data,
        offset=answer.offset,
        requested=request.opcode,
    )


def _text(data: bytes) -> str:
    return data.split(b"\0", 1)[0].decode("latin-1")


def _query(path: str) -> dict[str, int] | None:
    """What stands behind the question mark; None where ArduPilot would refuse it."""
    found = {"start": 0, "count": 0, "withdefaults": 0}
    for part in path.partition("?")[2].split("&"):
        name, _, text = part.partition("=")
        if name in found:
            if not (text.isascii() and text.isdigit()) or int(text) >= (
                2 if name == "withdefaults" else 65535
            ):
                return None
            found[name] = int(text)
    return found
