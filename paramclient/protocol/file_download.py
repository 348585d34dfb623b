"""Download all parameters as the packed file of the component, `@PARAM/param.pck`."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

import anyio

from paramclient.errors import FileErrorCode, FileTransferError, NoReply, PackError, VehicleError
from paramclient.protocol.channel import task_group
from paramclient.protocol.ftp import BUSY, FTP_SILENT_TIME, FileCutOff, is_free, read_file
from paramclient.protocol.param_pck import PACK_SIZE_MAX, PARAM_FILE, Pack, decode, decode_prefix, encode
from paramclient.protocol.reads import read
from paramclient.protocol.session import UNANSWERED, FileUnavailable, Session

WITH_DEFAULTS: Final = "?withdefaults=1"
"""Requests the defaults too; a server that does not know it may report that there is no such file."""
ARDUPILOT_WITH_DEFAULTS: Final = 0x04040000
"""flight_sw_version of the first ArduPilot of which every build adds the defaults: 4.4."""
DOWNLOADS_MAX: Final = 2
"""Downloads of the file: one can be a mixture, if the table changes meanwhile."""


async def download_file(session: Session) -> int:
    """Download the file into the table, and return the number of its parameters.

    Accepts only a whole and valid file that has all parameters of the vehicle. Cancellation closes the
    file on board.

    Raises:
        FileUnavailable: there is no such file, it is not valid, or the list is quicker.
        LinkError: the link is closed for good.
    """
    if session.serves_file is None and session.channel.timing.timeout(0) > FTP_SILENT_TIME:
        raise FileUnavailable("the round trip is too long to find out whether MAVFTP is served")
    if not await is_free(session.channel):
        raise FileUnavailable(BUSY)
    vehicle, query, reason, attempts = session.identification, WITH_DEFAULTS, "", 0
    while attempts < DOWNLOADS_MAX:
        requested_at = anyio.current_time()
        try:
            data, count = await _read(session, PARAM_FILE + query, requested_at)
            pack = decode(data)
        except FileTransferError as error:
            is_missing = error.code == FileErrorCode.FILE_NOT_FOUND
            has_defaults = vehicle.is_ardupilot and vehicle.identity.firmware >= ARDUPILOT_WITH_DEFAULTS
            if is_missing and query and not has_defaults:
                query = ""
                continue
            if (is_missing and not session.serves_file) or error.code == FileErrorCode.UNKNOWN_COMMAND:
                session.serves_file = False  # else another station has closed it
            raise FileUnavailable(f"the parameter file was refused: {error.reason}") from None
        except FileCutOff as error:
            _store_beginning(session, error.prefix, requested_at, session.table.count)
            raise FileUnavailable(UNANSWERED) from None
        except NoReply as error:
            session.ftp_unanswered += error.attempts
            raise FileUnavailable(UNANSWERED, is_silent=True) from None
        except PackError as error:
            reason = f"is not valid: {error}"
        else:
            reason = await _contradiction(session, pack, data, count)
        if not reason:
            session.serves_file, session.ftp_unanswered = True, 0
            _store(session, pack, requested_at)
            return pack.total
        attempts += 1
    raise FileUnavailable(f"the parameter file {reason}")


async def _contradiction(session: Session, pack: Pack, data: bytes, count: int | None) -> str:
    """Return why a file cannot be the vehicle's whole table, or "".

    `data` is the file, and `count` that of the vehicle, as read beside it; None where it was not.
    """
    if not pack.entries or len(pack.entries) != pack.total:
        return f"has {len(pack.entries)} of {pack.total} parameters"
    known = session.table.count
    if pack.total not in (known or pack.total, count) and await _count(session) != pack.total:
        return f"has {pack.total} parameters, and the cached table {known}"
    # others may pad it in another way
    if session.identification.is_ardupilot and data != encode(pack.entries, with_defaults=pack.with_defaults):
        return "is a mixture of two tables"
    return ""


async def _count(session: Session) -> int | None:
    """Return the number of parameters by another message than the file; None if it is not answered.

    It reads a parameter of the table by its name: indices may begin at 1.
    """
    names = (param.name for param in session.table.params.values() if param.index is not None)
    with suppress(NoReply, VehicleError):
        return (await read(session, next(names, 0))).param_count
    return None


async def _read(session: Session, path: str, requested_at: float) -> tuple[bytes, int | None]:
    """Read the file; beside it also the vehicle's number of parameters, if the table has another."""
    channel, known = session.channel, session.table.count
    total, count = known, None

    async def read_count() -> None:
        nonlocal count
        count = await _count(session)

    def begun(head: bytes) -> None:
        nonlocal total
        total = _store_beginning(session, head, requested_at, None) or total  # others have first values
        session.serves_file = True
        if known not in (None, total):
            tasks.start_soon(read_count)

    def report(received: int, size: int | None) -> None:
        if size and total:
            session.report(min(received * total // size, total), total)

    attempts = session.ftp_attempts()
    async with task_group() as tasks:
        data = await read_file(
            channel, path, size_max=PACK_SIZE_MAX, open_attempts=attempts, progress=report, begun=begun
        )
    return data, count


def _store_beginning(session: Session, prefix: bytes, requested_at: float, count: int | None) -> int | None:
    """Store the whole entries at the beginning of a file, and return the number of all parameters in it.

    A table with another count than `count` keeps its values: the file may be damaged.
    """
    try:
        pack, number = decode_prefix(prefix)
    except PackError:
        return None
    if pack.entries and number == pack.total and session.table.count == count in (None, number):
        _store(session, pack, requested_at)
    return pack.total


def _store(session: Session, pack: Pack, requested_at: float) -> None:
    session.table.recount(pack.total)
    for index, entry in enumerate(pack.entries):
        session.table.store_entry(entry, index, requested_at, with_defaults=pack.with_defaults)
