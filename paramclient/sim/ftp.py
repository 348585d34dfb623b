"""MAVFTP server of a simulated vehicle: files in memory, and param.pck generated from its parameters."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from paramclient.errors import FileErrorCode, UsageError
from paramclient.model.px4_hash import crc32_px4
from paramclient.protocol import param_pck
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.param_pck import PARAM_FILE, PackedParam

__all__ = ["Address", "FileServer"]

IDLE_LIMIT: Final = 3.0
"""Seconds without a response after which ArduPilot reassigns the session; each response restarts the time."""
PX4_IDLE_LIMIT: Final = 11.0
"""Seconds without a request after which PX4 closes a session (measured: between 10.5 and 12)."""
PX4_BURST_BLOCKS: Final = 168
"""Blocks after which PX4 ends a burst with burst_complete: 40,152 bytes."""
PX4_STEP: Final = 0.010
"""Period of PX4's MAVLink loop in seconds; bursts start and continue with it."""
EINVAL: Final = 22
"""Linux' error number for invalid arguments, as in NAKs."""

Address: TypeAlias = tuple[int, int]
"""System and component."""


class _Answer(NamedTuple):
    opcode: Opcode
    data: bytes = b""
    offset: int = 0


@dataclass(slots=True)
class _Session:
    """One open file.

    Attributes:
        read: returns the bytes at an offset, or None if they cannot be read in this size.
        written: the written bytes, or None if the file is open for reading.
    """

    owner: Address
    path: str
    read: Callable[[int, int], bytes | None] | None
    used_at: float
    written: bytearray | None = None


@dataclass(slots=True)
class _Burst:
    """A burst in progress; for PX4 with the time of its next step and the bytes that it may send then."""

    request: Packet
    sender: Address
    offset: int
    sequence: int
    left: float
    at: float = 0.0
    budget: float = 0.0


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
    - Unlike on real vehicles, a param.pck that is written sets no parameters.
    - The checksum of a param.pck is that of the file as it is read 64 bytes at a time.
    - A burst of ArduPilot sends a block whenever a third of the link is free again, to the end of the file.
    - PX4 has one session for each link, closes it after 11 s without a request, and a reset from any sender
      closes it. A burst starts up to 10 ms after its request, has blocks of 239 bytes independent of the
      requested size, and ends after 168 blocks with burst_complete; other requests are answered meanwhile,
      and another burst replaces it.

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
    _open: dict[int, _Session] = field(default_factory=dict)
    _waiting: deque[tuple[float, Packet, Address]] = field(default_factory=deque)
    _burst: _Burst | None = None
    _free_at: float = -math.inf
    _now: float = 0.0
    _answered_at: float = -math.inf
    _last: tuple[Address, Packet] | None = None
    _packed: tuple[object, bytes] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0.0):
            raise UsageError(f"the rate of MAVFTP must be above 0 bytes per second, not {self.rate}")

    @property
    def open_files(self) -> list[str]:
        """The paths of the open files that are in the way of other stations."""
        if not self.is_px4 and self._now - self._answered_at > IDLE_LIMIT:
            return []
        return [session.path for session in self._open.values()]

    def reset(self) -> None:
        """Close all sessions, as after switching off."""
        self._open.clear()
        self._waiting.clear()
        self._burst = self._last = None
        self._free_at = self._answered_at = -math.inf

    def receive(self, payload: bytes, sender: Address, now: float) -> None:
        """Queue a request."""
        if len(self._waiting) < _QUEUE:
            turn = _PX4_TURN if self.is_px4 else _LOOP
            self._waiting.append((now + turn, Packet.unpack(payload), sender))

    def next_deadline(self) -> float:
        """Return the time of the next work, or infinity."""
        request_at = max(self._waiting[0][0], self._free_at) if self._waiting else math.inf
        if self._burst is None:
            return request_at
        return min(request_at, self._burst.at) if self.is_px4 else self._free_at

    def work(self, now: float, packets_max: int | None = None) -> list[tuple[Packet, Address]]:
        """Do the due work, limited to `packets_max` responses; return the responses with their receivers."""
        out: list[tuple[Packet, Address]] = []
        answer: Packet | None
        self._now = now
        while (due := self.next_deadline()) <= now:
            if packets_max is not None and len(out) >= packets_max:
                self._free_at = now
                break
            burst = self._burst
            if burst is None or (self.is_px4 and due < burst.at):
                _, request, sender = self._waiting.popleft()
                answer = self._answer(request, sender, due)
                if answer is not None:
                    self._free_at = due + _size(answer) / (3 * self.rate)
            else:
                sender = burst.sender
                answer = self._next_block(burst, due)
                if self.is_px4:
                    burst.budget -= _size(answer)
                    while burst.budget <= 0.0:
                        burst.at += PX4_STEP
                        burst.budget += PX4_STEP * self.rate
                else:
                    self._free_at = due + _size(answer) / self.rate
            if answer is not None:
                out.append((answer, sender))
                self._last = (sender, answer)
                self._answered_at = due
        return out

    def _answer(self, request: Packet, sender: Address, now: float) -> Packet | None:
        """Return the response to one request; None for a burst, whose blocks follow, and for non-requests."""
        if request.opcode in (Opcode.ACK, Opcode.NAK):
            return None
        if self._last is not None:
            to, last = self._last
            is_same = last.sequence == request.sequence + 1 & 0xFFFF and last.requested == request.opcode
            if to == sender and is_same and (self.is_px4 or last.session == request.session):
                return last
        number = request.session
        closes = request.opcode in (Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS)
        if not self.is_px4 and self._open and number not in self._open:
            if closes:
                return _packet(_Answer(Opcode.ACK), request, number, request.sequence + 1)
            if now - self._answered_at < IDLE_LIMIT:
                return _packet(_no(FileErrorCode.INVALID_SESSION), request, number, request.sequence + 1)
            (left_open,) = self._open
            self._terminate(left_open, now)
        if self.is_px4 and self._open and now - self._open[0].used_at >= PX4_IDLE_LIMIT:
            self._terminate(0, now)
        match request.opcode:
            case Opcode.TERMINATE_SESSION:
                done = self._terminate(number, now)
            case Opcode.RESET_SESSIONS if self.is_px4:
                self._open.clear()
                done = _Answer(Opcode.ACK)
            case Opcode.RESET_SESSIONS:
                done = self._terminate(number, now)
            case Opcode.OPEN_FILE_RO | Opcode.CREATE_FILE:
                number, done = self._open_file(request, sender, now)
            case Opcode.READ_FILE:
                done = self._read(number, request.offset, request.size, now)
                if done.opcode is Opcode.NAK:
                    done = done._replace(offset=0)
            case Opcode.WRITE_FILE:
                done = self._write(number, request, now)
            case Opcode.BURST_READ_FILE:
                done = self._read(number, request.offset, self._block_size(request), now)
                if done.opcode is Opcode.ACK:
                    self._begin_burst(request, sender, now)
                    return None
            case Opcode.LIST_DIRECTORY:
                done = self._list(_text(request.data), request.offset)
            case Opcode.CALC_FILE_CRC32:
                done = self._checksum(_text(request.data))
            case _:
                done = _no(FileErrorCode.UNKNOWN_COMMAND)
        return _packet(done, request, number, request.sequence + 1)

    def _begin_burst(self, request: Packet, sender: Address, now: float) -> None:
        burst = self._burst = _Burst(request, sender, request.offset, request.sequence + 1, math.inf)
        if self.is_px4:
            burst.left = PX4_BURST_BLOCKS
            burst.at = (math.floor(now / PX4_STEP) + 1) * PX4_STEP
            burst.budget = PX4_STEP * self.rate
        else:
            self._free_at = max(self._free_at, now)

    def _block_size(self, request: Packet) -> int:
        return DATA_SIZE_MAX if self.is_px4 else request.size or DATA_SIZE_MAX

    def _next_block(self, burst: _Burst, now: float) -> Packet:
        session = burst.request.session
        done = self._read(session, burst.offset, self._block_size(burst.request), now)
        sequence = burst.sequence
        burst.sequence += 1
        burst.offset += len(done.data)
        burst.left -= 1
        complete = done.opcode is Opcode.NAK or burst.left == 0
        if complete:
            self._burst = None
        is_last_of_many = burst.left == 0
        return _packet(done, burst.request, session, sequence)._replace(burst_complete=is_last_of_many)

    def _open_file(self, request: Packet, sender: Address, now: float) -> tuple[int, _Answer]:
        number, path = request.session, _text(request.data)
        if self.is_px4:
            if self._open:
                return request.session, _no(FileErrorCode.NO_SESSIONS_AVAILABLE)
            number = 0
        elif number in self._open:
            if now - self._answered_at <= IDLE_LIMIT:
                return number, _no(FileErrorCode.FAIL)
            self._terminate(number, now)
        session = _Session(sender, path, None, now)
        if request.opcode == Opcode.CREATE_FILE:
            session.written = bytearray()
            done = _Answer(Opcode.ACK)
        elif path in self.files:
            content = self.files[path]
            session.read = lambda offset, size: content[offset : offset + size]
            done = _number(len(content))
        elif _is_param_file(path) and (rows := self.params()) is not None:
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
            return self._not_open()
        session.used_at = now
        if session.read is None:
            return _no(FileErrorCode.FAIL)
        data = session.read(offset, size)
        if data is None:
            return _no(FileErrorCode.FAIL_ERRNO, EINVAL)
        if not data:
            return _no(FileErrorCode.EOF)._replace(offset=offset)
        return _Answer(Opcode.ACK, data, offset)

    def _not_open(self) -> _Answer:
        """Return the refusal of a read or write in a session without an open file."""
        return _no(FileErrorCode.INVALID_SESSION if self.is_px4 else FileErrorCode.FILE_NOT_FOUND)

    def _write(self, number: int, request: Packet, now: float) -> _Answer:
        session = self._open.get(number)
        if session is None:
            return self._not_open()
        session.used_at = now
        if session.written is None or request.offset > _LARGEST:
            return _no(FileErrorCode.FAIL)
        if len(session.written) < request.offset:
            session.written += bytes(request.offset - len(session.written))
        session.written[request.offset : request.offset + len(request.data)] = request.data
        return _Answer(Opcode.ACK, offset=request.offset)

    def _checksum(self, path: str) -> _Answer:
        """Return the checksum of a file; ArduPilot reads a param.pck for it 64 bytes at a time."""
        content = self.files.get(path)
        if content is None and _is_param_file(path) and (rows := self.params()) is not None:
            query = _query(path)
            if query is None or query["start"] >= len(rows):
                return _no(FileErrorCode.FAIL_ERRNO, EINVAL)
            content = param_pck.encode(
                _part(rows, query),
                total=len(rows),
                with_defaults=bool(query["withdefaults"]),
                read_size=_CHECKSUM_READ,
            )
        return _NOT_FOUND if content is None else _number(crc32_px4(content))

    def _terminate(self, number: int, now: float) -> _Answer:
        session = self._open.pop(number, None)
        if session is None and self.is_px4:
            return _no(FileErrorCode.INVALID_SESSION)
        if session is None or session.written is None:
            return _Answer(Opcode.ACK)
        if not _is_param_file(session.path):
            self.files[session.path] = bytes(session.written)
        return _Answer(Opcode.ACK)

    def _param_file(self, query: dict[str, int]) -> Callable[[int, int], bytes | None]:
        """Return a function that reads the current param.pck, always with the first read's size."""
        start, count, with_defaults = query["start"], query["count"], bool(query["withdefaults"])
        first_size: int | None = None

        def read(offset: int, size: int) -> bytes | None:
            nonlocal first_size
            first_size = size if first_size is None else first_size
            rows = self.params()
            if rows is None or (size != first_size and not self.is_px4):
                return None
            aligned = DATA_SIZE_MAX if self.is_px4 else min(size, DATA_SIZE_MAX)
            key = (start, count, with_defaults, aligned, rows)
            if self._packed is None or self._packed[0] != key:
                content = param_pck.encode(
                    _part(rows, query), total=len(rows), with_defaults=with_defaults, read_size=aligned
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
            if len(data) + len(entry) > DATA_SIZE_MAX:
                break
            data += entry
        return _Answer(Opcode.ACK, data) if data else _no(FileErrorCode.EOF)


_QUEUE = 5
"""Requests that wait; further ones are dropped."""
_LOOP = 0.0058
"""Seconds until ArduPilot processes a request."""
_PX4_TURN = 0.0001
"""Seconds until PX4 processes a request."""
_OVERHEAD = 27
"""Bytes of a frame besides the data."""
_ESTIMATE = 12
"""Estimated bytes per parameter in param.pck."""
_LARGEST = 0xFFFF
"""Largest offset of a write, in bytes."""
_CHECKSUM_READ = 64
"""Bytes that ArduPilot reads at a time for a checksum."""


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


def _size(packet: Packet) -> int:
    """Return the size of a packet on the wire, in bytes."""
    return _OVERHEAD + len(packet.data)


def _text(data: bytes) -> str:
    return data.split(b"\0", 1)[0].decode("latin-1")


def _is_param_file(path: str) -> bool:
    return path.split("?")[0] == PARAM_FILE


def _part(rows: Sequence[PackedParam], query: dict[str, int]) -> Sequence[PackedParam]:
    """Return the rows that a query asks for."""
    start, count = query["start"], query["count"]
    return rows[start : start + count] if count else rows[start:]


def _query(path: str) -> dict[str, int] | None:
    """Return the options after the question mark of a path; None for options that ArduPilot refuses."""
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
