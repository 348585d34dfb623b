"""KeptFile: the parameter file of a kept table, for the stations that read it over MAVFTP."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Final, NamedTuple, TypeAlias

import anyio

from paramclient.errors import FileErrorCode
from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import Trust, bits_of
from paramclient.protocol.checksum import CHECKED_READ_SIZE
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.param_pck import PACKABLE, PARAM_FILE, PackedParam, encode
from paramclient.protocol.session import Session
from paramclient.service.kept_table import Asker, KeptTable, Pending
from paramclient.wire.messages import FileTransfer

ENTRY_SIZE: Final = 12
"""Bytes of an entry in param.pck, on average: the size in the answer to an open is an estimate."""
FILE_WAIT: Final = 2.5
"""Seconds that the opening of the file waits for a fetch; then there is no such file, and the station asks
for the list, which it gets as it is fetched. QGroundControl asks three times, 1 s apart."""
OPEN_FILES_MAX: Final = 64
"""Files that a station has open, at most; the oldest is closed first."""

SessionKey: TypeAlias = tuple[Hashable, ...]
"""What names a session of a station: what answers it, the ids of the sender, and the number."""
Route: TypeAlias = Callable[[], None]
"""Passes a request to the vehicle."""


class FileQuery(NamedTuple):
    """The part of the parameter file that a path names; `length` 0 for all that follows."""

    start: int = 0
    length: int = 0
    with_defaults: bool = False

    @classmethod
    def of(cls, request: Packet) -> FileQuery | None:
        """Parse the path in a request; None for another file, and for options that a vehicle refuses."""
        name, _, text = request.data.split(b"\0", 1)[0].decode("latin-1").partition("?")
        given = dict(each.partition("=")[::2] for each in text.split("&") if each)
        numbers = [given.pop(each, "0") for each in ("start", "count", "withdefaults")]
        are_numbers = all(each.isascii() and each.isdecimal() and len(each) <= 5 for each in numbers)
        if name != PARAM_FILE or given or not are_numbers:
            return None
        start, length, defaults = map(int, numbers)
        return cls(start, length, bool(defaults)) if defaults < 2 else None


class Rows(NamedTuple):
    """The entries of the file, by index, and whether the default of each one is known."""

    entries: Sequence[PackedParam]
    has_defaults: bool

    def content(self, query: FileQuery, read_size: int) -> bytes:
        """Return the file as the vehicle serves it to a client that reads so many bytes at a time.

        Without the defaults, a file that is asked for with defaults has the magic of one without.
        """
        end = query.start + query.length if query.length else None
        with_defaults = query.with_defaults and self.has_defaults
        rows, total = self.entries[query.start : end], len(self.entries)
        return encode(rows, total=total, with_defaults=with_defaults, read_size=read_size)


def rows_of(session: Session) -> Rows | None:
    """Return the entries of the file of a complete table; None if the table does not have them exactly."""
    table, entries = session.table, []
    if table.rounded:
        return None
    params = [table.params[name] for _, name in sorted(table.names.items())]
    for param in params:
        if param.is_raw or param.type not in PACKABLE or param.trust is Trust.CACHED:
            return None
        own = None if param.default is None or not param.is_changed else bits_of(param.default, param.type)
        entries.append(PackedParam(param.name, param.type, param.bits, own))
    return Rows(entries, all(each.default is not None for each in params))


def reply(
    request: Packet, data: bytes = b"", *, error: FileErrorCode | None = None, offset: int = 0, step: int = 1
) -> Packet:
    """Return the answer to a request: ACK with data, or NAK with an error."""
    sequence = (request.sequence + step) & 0xFFFF
    opcode, data = (Opcode.ACK, data) if error is None else (Opcode.NAK, bytes((error,)))
    return Packet(sequence, request.session, opcode, data, offset=offset, requested=request.opcode)


def answers_of(request: Packet, content: bytes) -> Iterator[Packet]:
    """Return the answers to a read, or to a burst: all that follows, and then the end of the file."""
    size = min(request.size or DATA_SIZE_MAX, DATA_SIZE_MAX)
    offsets = range(request.offset, len(content), size)
    for step, offset in enumerate(offsets, 1):
        yield reply(request, content[offset : offset + size], offset=offset, step=step)
        if request.opcode != Opcode.BURST_READ_FILE:
            return
    yield reply(request, error=FileErrorCode.EOF, offset=len(content), step=len(offsets) + 1)


@dataclass(slots=True)
class _OpenFile:
    """A file that a station has open; `content` from the first read on."""

    opening: Packet
    query: FileQuery
    rows: Rows
    content: bytes | None = None


class KeptFile:
    """Answers requests of MAVFTP about the parameter file of one component.

    A station is told apart from others by its ids and its session, which its answers have too.

    Args:
        table: of the component, plain.
    """

    def __init__(self, table: KeptTable) -> None:
        self._table = table
        self._rows_at = lru_cache(1)(lambda state: rows_of(table.session))
        self._opening = Pending[tuple[Asker, Packet]]()

    def take(self, asker: Asker, payload: bytes, route: Route) -> bool:
        """Answer a request; return False for one that the vehicle has to answer.

        Args:
            asker: the station.
            payload: of the message.
            route: passes the request to the vehicle.
        """
        request, files = Packet.unpack(payload), asker.station.files
        key = (self, asker.system, asker.component, request.session)
        match request.opcode:
            case Opcode.OPEN_FILE_RO | Opcode.CALC_FILE_CRC32:
                return self._begin(asker, request, key, route)
            case Opcode.READ_FILE | Opcode.BURST_READ_FILE if isinstance(files.get(key), _OpenFile):
                self._send(asker, request, files[key])
                return True
            case Opcode.CREATE_FILE | Opcode.OPEN_FILE_WO:
                self._keep(asker, key, FileQuery.of(request))
            case Opcode.TERMINATE_SESSION | Opcode.RESET_SESSIONS:
                same = 3 if request.opcode == Opcode.RESET_SESSIONS else 4  # members of the key
                closed = [files.pop(each) for each in list(files) if each[:same] == key[:same]]
                if any(isinstance(each, FileQuery) for each in closed):
                    self._table.doubt()
                is_aboard = not all(isinstance(each, _OpenFile) for each in closed)
                if not is_aboard and (closed or (self._is_served and self._table.is_loading)):
                    self._say(asker, reply(request))
                    return True
        return False

    def _keep(self, asker: Asker, key: SessionKey, file: _OpenFile | FileQuery | None) -> None:
        """Note what a session has open: a file here, or one on the vehicle; an upload with its query."""
        files = asker.station.files
        files.pop(key, None)
        files[key] = file
        if len(files) > OPEN_FILES_MAX:
            del files[next(iter(files))]

    def _begin(self, asker: Asker, request: Packet, key: SessionKey, route: Route) -> bool:
        """Open the file, or answer its checksum; wait for a fetch that may bring the table."""
        query, file = FileQuery.of(request), asker.station.files.get(key)
        is_checksum = request.opcode == Opcode.CALC_FILE_CRC32
        if isinstance(file, _OpenFile) and file.opening == request:
            self._say(asker, _opened(request, file.rows))
            return True
        # a vehicle may send a default that is the value, which the table does not keep
        is_here = query is not None and self._is_served and not (is_checksum and query.with_defaults)
        if is_here and not self._table.list_if_current:
            if self._opening.begins((asker, request), asker):
                self._table.component.core.spawn(self._begin_later, asker, request, key, route)
            return True
        rows = self._rows_at(self._table.state_key) if is_here else None
        if query is None or rows is None or query.start >= len(rows.entries):
            if not is_checksum:
                self._keep(asker, key, None)
            return False
        self._table.check()
        if is_checksum:
            checksum = crc32_px4(rows.content(query, CHECKED_READ_SIZE))
            self._say(asker, reply(request, checksum.to_bytes(4, "little")))
            return True
        self._keep(asker, key, _OpenFile(request, query, rows))
        self._say(asker, _opened(request, rows))
        return True

    async def _begin_later(self, asker: Asker, request: Packet, key: SessionKey, route: Route) -> None:
        try:
            with anyio.move_on_after(FILE_WAIT):
                await self._table.load().wait()
        finally:
            self._opening.end((asker, request))
        if self._table.list_if_current and self._begin(asker, request, key, route):
            return
        if request.opcode == Opcode.OPEN_FILE_RO:
            self._keep(asker, key, None)  # and not the one that was open before
            if self._table.is_loading:
                route = partial(self._say, asker, reply(request, error=FileErrorCode.FILE_NOT_FOUND))
        route()

    @property
    def _is_served(self) -> bool:
        """Whether the vehicle serves the file, or probably does."""
        session = self._table.session
        is_likely = session.identification.is_ardupilot and session.identification.may_serve_file
        return is_likely if session.serves_file is None else session.serves_file

    def _send(self, asker: Asker, request: Packet, file: _OpenFile) -> None:
        """Send a part of an open file: the first read says in which pieces it is read."""
        if file.content is None:
            size = min(request.size or DATA_SIZE_MAX, DATA_SIZE_MAX)
            is_px4 = self._table.session.identification.is_px4
            file.content = file.rows.content(file.query, DATA_SIZE_MAX if is_px4 else size)
        answers = answers_of(request, file.content)
        if request.opcode == Opcode.READ_FILE:
            self._say(asker, next(answers))
        else:
            messages = (_message(asker, each) for each in answers if not self._table.is_lost)
            asker.station.stream((self, asker, request.session), self._table.source, messages)

    def _say(self, asker: Asker, packet: Packet) -> None:
        asker.station.say(_message(asker, packet), self._table.source)


def _message(asker: Asker, packet: Packet) -> FileTransfer:
    return FileTransfer(0, asker.system, asker.component, packet.pack())


def _opened(request: Packet, rows: Rows) -> Packet:
    return reply(request, (ENTRY_SIZE * len(rows.entries)).to_bytes(4, "little"))
