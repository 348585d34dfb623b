"""What a component's table answers to a ground station: messages from parameters, and a file of them.

Pure functions of a table and a request. The gateway decides whether the table may answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from paramclient.errors import FileErrorCode
from paramclient.model.ext_values import EXT_VALUE_SIZE, ext_bytes
from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import Param, ParamType, Trust, as_reported, bits_of
from paramclient.protocol.checksum import CHECKED_READ_SIZE, may_be_rounded
from paramclient.protocol.dialect import ReportedValue
from paramclient.protocol.ftp import DATA_SIZE_MAX, Opcode, Packet
from paramclient.protocol.param_pck import PACKABLE, PARAM_FILE, PackedParam, encode
from paramclient.protocol.session import Session
from paramclient.wire.messages import HASH_CHECK, NO_INDEX, ParamExtValue, ParamValue

__all__ = [
    "FileQuery",
    "PackedTable",
    "checksum_answer",
    "digest_of",
    "file_answers",
    "is_complete",
    "listed",
    "open_answer",
    "packed",
    "path_of",
    "reply",
    "value_of",
]

ENTRY_SIZE: Final = 12
"""Bytes of an entry in param.pck, on average: the size in the answer to an open is an estimate."""


def value_of(session: Session, param: Param, *, by_name: bool = True) -> ReportedValue:
    """Return a parameter as its component would send it: the same bytes, index and count.

    An ArduPilot answers reads by name, and announces changes, without an index.
    """
    count = session.table.count or 0
    index = param.index
    if index is None or (by_name and session.identification.is_ardupilot):
        index = NO_INDEX
    if session.dialect.has_ack:
        raw = ext_bytes(param).ljust(EXT_VALUE_SIZE, b"\0")
        return ParamExtValue(param.name, raw, param.type_number, count, index)
    raw = (
        param.bits.to_bytes(4, "little")
        if param.is_raw
        else as_reported(param.bits, param.type_number, session.table.encoding)
    )
    return ParamValue(param.name, raw, param.type_number, count, index)


def digest_of(session: Session) -> ParamValue | None:
    """Return the `_HASH_CHECK` of a PX4; None for another vehicle, or while it is unknown."""
    table = session.table
    if not session.identification.is_px4 or table.hash is None or table.count is None:
        return None
    raw = table.hash.to_bytes(4, "little")
    return ParamValue(HASH_CHECK, raw, ParamType.UINT32, table.count, NO_INDEX)


def is_complete(session: Session) -> bool:
    """Return whether every parameter of the list is known, and is the vehicle's."""
    table = session.table
    params = (table.params.get(name) for name in table.names.values())
    return table.is_complete and all(each is not None and each.trust is not Trust.CACHED for each in params)


def listed(session: Session) -> list[ReportedValue]:
    """Return the answers to a request for the list, of a complete table."""
    table = session.table
    values = [
        value_of(session, table.params[name], by_name=False)._replace(param_index=index)
        for index, name in sorted(table.names.items())
    ]
    digest = digest_of(session)
    return values if digest is None else [digest, *values]


class FileQuery(NamedTuple):
    """The part of the parameter file that a path names."""

    start: int = 0
    length: int = 0
    with_defaults: bool = False

    @classmethod
    def of(cls, path: str) -> FileQuery | None:
        """Parse a path; None for that of another file, and for options that a vehicle refuses."""
        name, _, text = path.partition("?")
        pairs = dict(each.partition("=")[::2] for each in text.split("&") if each)
        known = {"start", "count", "withdefaults"}
        are_numbers = all(each.isascii() and each.isdecimal() and len(each) <= 5 for each in pairs.values())
        if name != PARAM_FILE or not (pairs.keys() <= known and are_numbers):
            return None
        start, count, defaults = (int(pairs.get(each, "0")) for each in ("start", "count", "withdefaults"))
        return cls(start, count, bool(defaults)) if defaults < 2 else None


class PackedTable(NamedTuple):
    """The entries of the parameter file of a complete table.

    Attributes:
        rows: the parameters by index.
        has_defaults: whether the default of each one is known.
    """

    rows: Sequence[PackedParam]
    has_defaults: bool

    def file(self, query: FileQuery, read_size: int) -> bytes:
        """Return the file as the vehicle serves it to a client that reads so many bytes at a time.

        Without the defaults, a file that is asked for with defaults has the magic of one without.
        """
        end = query.start + query.length if query.length else None
        return encode(
            self.rows[query.start : end],
            total=len(self.rows),
            with_defaults=query.with_defaults and self.has_defaults,
            read_size=read_size,
        )


def packed(session: Session) -> PackedTable | None:
    """Return the entries of the file of a complete table; None if the table does not have them exactly."""
    table = session.table
    rows, has_defaults = [], True
    for _, name in sorted(table.names.items()):
        param = table.params[name]
        if param.is_raw or param.type_number not in PACKABLE:
            return None
        default = None
        if param.default is None:
            has_defaults = False
        elif param.is_changed:
            default = bits_of(param.default, param.type_number)
        rows.append(PackedParam(name, ParamType(param.type_number), param.bits, default))
    is_proven = table.hash is not None
    if not is_proven and any(may_be_rounded(row) for row in rows):
        return None
    return PackedTable(rows, has_defaults)


def reply(
    request: Packet, data: bytes = b"", *, error: FileErrorCode | None = None, offset: int = 0, step: int = 1
) -> Packet:
    """Return the answer to a request: ACK with data, or NAK with an error."""
    return Packet(
        (request.sequence + step) & 0xFFFF,
        request.session,
        Opcode.ACK if error is None else Opcode.NAK,
        data if error is None else bytes((error,)),
        offset=offset,
        requested=request.opcode,
    )


def open_answer(request: Packet, table: PackedTable) -> Packet:
    """Return the answer to the opening of the file."""
    return reply(request, (ENTRY_SIZE * len(table.rows)).to_bytes(4, "little"))


def checksum_answer(request: Packet, table: PackedTable, query: FileQuery) -> Packet:
    """Return the answer to CalcFileCRC32, for which a vehicle reads the file 64 bytes at a time."""
    return reply(request, crc32_px4(table.file(query, CHECKED_READ_SIZE)).to_bytes(4, "little"))


def file_answers(request: Packet, content: bytes) -> Iterator[Packet]:
    """Return the answers to a read, or to a burst: all that follows, and then the end of the file."""
    size = min(request.size or DATA_SIZE_MAX, DATA_SIZE_MAX)
    step, offset = 1, request.offset
    while offset < len(content):
        data = content[offset : offset + size]
        yield reply(request, data, offset=offset, step=step)
        if request.opcode != Opcode.BURST_READ_FILE:
            return
        step, offset = step + 1, offset + len(data)
    yield reply(request, error=FileErrorCode.EOF, offset=offset, step=step)


def path_of(request: Packet) -> str:
    """Return the path in a request."""
    return request.data.split(b"\0", 1)[0].decode("latin-1")
