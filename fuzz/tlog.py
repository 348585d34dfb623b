"""Fuzz target: telemetry logs. Read like a simple reference reader does, replayed, and imported correctly."""

from __future__ import annotations

import io
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from string import ascii_lowercase, ascii_uppercase
from typing import Final
from unittest import mock

import anyio

from fuzz.draw import Draw
from paramclient.cache import ParamCache
from paramclient.errors import LinkError
from paramclient.links import tlog
from paramclient.links.names import LinkKind, LinkSpec
from paramclient.links.tlog import Record, ReplayLink, open_log, read_records
from paramclient.logs.imports import ImportedTable, import_log
from paramclient.model.values import Encoding, bits_of, decode_value
from paramclient.wire import messages
from paramclient.wire.frames import Framer
from paramclient.wire.messages import NO_INDEX, Message

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 1024
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

YEAR = 366 * 86400 * 1_000_000
END = 7_258_118_400 * 1_000_000
BLOCKS = (1, 13, 64, 300, 65536)
"""Block sizes in bytes in which a log is read."""
BEGINNINGS = (1_700_000_000_000_000, 1_700_000_000_000_000, 315_964_800_000_000, 20_000_000)
PASSES = (1000, 1000, 20_000, 300_000, 7_000_000, -5_000_000, YEAR - 1, YEAR + 1, -40 * YEAR, 50 * YEAR)
"""Microseconds between two frames of a log."""
NAMES = ("A", "B", "C", "D", "_HASH_CHECK", "\x1b[2J")
KINDS = (9, 6, 1, 5, 10)
VALUES = (0, 1, 2, 0x3F800000, 0x7FC00000, 0xFFFFFFFF)

_CAPITALS = str.maketrans(ascii_lowercase, ascii_uppercase)

logger = logging.getLogger("paramclient")


def run(data: bytes) -> None:
    """Read a log: the first byte chooses between the bytes of a log and pieces from which one is built."""
    draw = Draw(data)
    how = draw.number()
    content = draw.rest() if how & 1 else _log(draw)
    records = _check_reader(content, BLOCKS[(how >> 1) % len(BLOCKS)])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tlog"
        path.write_bytes(content)
        try:
            open_log(str(path), "replay:a").close()
        except LinkError:
            assert not records
        else:
            assert records
            with mock.patch.object(logger, "disabled", True):
                anyio.run(_check_uses, path, records)


def _check_reader(content: bytes, block: int) -> list[Record]:
    with mock.patch.object(tlog, "BLOCK_SIZE", block):
        records = list(read_records(io.BytesIO(content)))
    assert records == _records_of(content)
    return records


async def _check_uses(path: Path, records: Sequence[Record]) -> None:
    link = ReplayLink(LinkSpec(LinkKind.REPLAY, str(path), options=(("speed", 0.0),)))
    await link.open()
    found: list[bytes] = []
    while link._next is not None:
        found += [data for _, data in await link.receive()]
    await link.close()
    assert found == [each.data for each in records]
    if not _said(records):
        return
    with ParamCache(path.with_name("cache.sqlite3")) as kept:
        tables = await import_log(path, kept)
        before = _check_import(kept, tables, records)
        assert await import_log(path, kept) == tables
        assert _check_import(kept, tables, records) == before, "the second time changes something"


def _check_import(kept: ParamCache, tables: Sequence[ImportedTable], records: Sequence[Record]) -> list[str]:
    """Check that all cached values are in the log, from the same component and with a time of the log.

    The system id is not checked: one hardware id under two addresses is one vehicle. Return the content of
    the cache as sorted texts.
    """
    said = _said(records)
    times = {each.at for each in records}
    assert {(each.system, each.component) for each in tables} <= said.keys()
    reported = []
    for summary in kept.components():
        table = kept.load(summary.key, summary.component)
        assert table is not None
        words = {
            (spelt, kind, bits_of(decode_value(raw, kind, encoding)[0], kind))
            for (_, component), each in said.items()
            if component == summary.component
            for name, own, raw in each
            # ArduPilot acknowledges some sets as REAL32, which are stored in the known type
            for kind in {own, *(other for known, other, _ in each if known == name and own == KINDS[0])}
            for spelt in (name, name.translate(_CAPITALS))  # names of ArduPilot are stored in capitals
            for encoding in Encoding
        }
        for name, param in table.params.items():
            kind = param.type
            assert (name, kind, bits_of(param.settable, kind)) in words
        assert set(table.heard_at.values()) <= times
        lines = list(kept.history(summary.key))
        reported.append(repr((summary, sorted(table.params.items()), sorted(table.heard_at.items()), lines)))
    return sorted(reported)


def _said(records: Sequence[Record]) -> dict[tuple[int, int], set[tuple[str, int, bytes]]]:
    """Return the parameters of a log by their sender, from the bytes of each record alone."""
    framer = Framer({22}, stream=False)
    said: dict[tuple[int, int], set[tuple[str, int, bytes]]] = {}
    for record in records:
        for frame in framer.receive(record.data):
            message = messages.decode(frame)
            if (
                isinstance(message, messages.ParamValue)
                and frame.system
                and message.param_id != "_HASH_CHECK"
            ):
                words = said.setdefault((frame.system, frame.component), set())
                words.add((message.param_id, message.param_type, message.raw))
    return said


def _records_of(content: bytes) -> list[Record]:
    """Return the records of a log: at each offset, decided by the record there and the one after it."""
    found: list[Record] = []
    at = 0
    last: int | None = None
    while (here := _record_at(content, at)) is not None:
        time, end = here
        behind = _record_at(content, end)
        is_proven = behind is not None and behind[1] > end and abs(behind[0] - time) <= YEAR
        is_alone = behind is None and last is None
        is_near = last is not None and abs(time - last) <= YEAR
        if end > at and time <= END and (is_near or is_proven or is_alone):
            if end > len(content):
                break
            found.append(Record(time / 1e6, content[at + 8 : end]))
            last, at = time, end
        else:
            at += 1
    return found


def _record_at(content: bytes, at: int) -> tuple[int, int] | None:
    """Return time and end of a record at an offset; the end is `at` without a record; None after the log."""
    head = content[at : at + 11]
    if len(head) < 11:
        return None
    time = int.from_bytes(head[:8], "big")
    if head[8] == 0xFE:
        return time, at + 16 + head[9]
    if head[8] == 0xFD and head[10] < 2:
        return time, at + 20 + head[9] + 13 * head[10]
    return time, at


def _log(draw: Draw) -> bytes:
    at = draw.one_of(BEGINNINGS)
    log = b""
    while not draw.is_over:
        at = min(max(at + draw.one_of(PASSES), 0), 2**63)
        record = at.to_bytes(8, "big") + _frame(draw)
        match draw.number() % 16:
            case 0:
                record = record[: draw.number() % len(record)]
            case 1:
                place = draw.number() % len(record)
                record = record[:place] + draw.take(1) + record[place + 1 :]
            case 2:
                record += draw.take(draw.number() % 24)
        log += record
    return log


def _frame(draw: Draw) -> bytes:
    system, component = draw.one_of((1, 1, 1, 2, 255, 0)), draw.one_of((1, 1, 100))
    return messages.encode(
        _message(draw), system=system, component=component, sequence=0, version=draw.one_of((2, 2, 2, 1))
    )


def _message(draw: Draw) -> Message:
    name, raw = draw.one_of(NAMES), draw.one_of(VALUES).to_bytes(4, "little")
    match draw.number() % 8:
        case 0:
            return messages.Heartbeat(2, draw.one_of((12, 3, 0)))
        case 1:
            return messages.AutopilotVersion(0, 0x01110000, bytes(8), uid=draw.number() % 3)
        case 2:
            return messages.ParamSet(1, 1, name, raw, draw.one_of(KINDS))
        case 3:
            return messages.SystemTime(0, draw.one_of((0, 1000, 1_000_000)))
        case 4:
            return messages.ParamRequestList(1, 1)
    count, index = draw.one_of((4, 4, 3, 0, 65535)), draw.one_of((0, 1, 2, 3, NO_INDEX))
    return messages.ParamValue(name, raw, draw.one_of(KINDS), count, index)
