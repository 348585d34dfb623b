"""Is the table current? One question, and the answers of the vehicles.

PX4 announces a hash, `_HASH_CHECK`. ArduPilot computes the checksum of its parameter file. Others have no
answer, and their tables are downloaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from paramclient.errors import NoReply, VehicleError
from paramclient.protocol.checksum import TableDiffers, prove
from paramclient.protocol.dialect import Digest
from paramclient.protocol.reads import read
from paramclient.protocol.session import FileUnavailable, Session
from paramclient.wire.messages import HASH_CHECK

CHANGED_MEANWHILE: Final = "The parameters changed during the download: the table may be a mixture."
NO_CHECKSUM: Final = "the vehicle serves no file of its parameters, or no checksum of it"
UNPROVEN: Final = "The vehicle's hash could not be computed from the table; it was equal before and after."


@dataclass(frozen=True, slots=True)
class Answer:
    """What the vehicle says of a table.

    Attributes:
        is_current: whether it confirms the table, as it is now.
        digest: the vehicle's hash now, or None for a vehicle without one.
        reason: why an ArduPilot confirms nothing, as a sentence; or empty.
        is_silent: whether that was because it does not answer to MAVFTP.
        is_other: whether that was because its table is another one.
    """

    is_current: bool = False
    digest: Digest | None = None
    reason: str = ""
    is_silent: bool = False
    is_other: bool = False


def may_confirm(session: Session) -> bool:
    """Return whether the vehicle has confirmed the table, or computes a checksum as far as known."""
    return (session.identification.is_px4 and session.table.hash is not None) or _may_prove(session)


async def ask(session: Session, *, refresh: bool = False) -> Answer:
    """Ask whether the table is current. Confirmed values are verified then.

    With `refresh`, it is none, whatever the vehicle says: only its hash is requested.

    Raises:
        LinkError: the link is closed for good.
    """
    if _may_prove(session) and not refresh:
        try:
            await prove(session)
        except FileUnavailable as error:
            is_other = isinstance(error, TableDiffers)
            return Answer(reason=error.reason, is_silent=error.is_silent, is_other=is_other)
        return Answer(is_current=True)
    digest = await _request(session)
    if refresh or not session.table.agrees_with(digest):
        is_told = session.identification.is_ardupilot and session.table.is_complete and not refresh
        return Answer(digest=digest, reason=NO_CHECKSUM * is_told)
    session.table.verify()
    return Answer(is_current=True, digest=digest)


async def settle(session: Session, before: Digest | None, listed: Digest | None, notes: list[str]) -> bool:
    """Compare a table that was just downloaded with PX4's hash. Return whether it was the same meanwhile, as
    far as known.

    Args:
        session: the component's.
        before: the hash before the download, or None.
        listed: the hash in the downloaded list, or None.
        notes: takes a sentence for the user, if there is one to tell.

    Raises:
        LinkError: the link is closed for good.
    """
    table = session.table
    if listed is not None and listed.count == table.count and table.confirm(listed.hash):
        return True
    if (after := await _request(session)) is None:
        return True
    if after.count == table.count:
        if table.confirm(after.hash):
            return True
        before = listed or before
        if before is not None and before.hash == after.hash:
            notes.append(UNPROVEN)
            return True
    table.unconfirm()
    notes.append(CHANGED_MEANWHILE)
    return False


async def _request(session: Session) -> Digest | None:
    """Return PX4's hash now; None for another vehicle.

    Raises:
        LinkError: the link is closed for good.
    """
    if not session.identification.is_px4 or session.dialect.has_ack:
        return None
    try:
        answer = await read(session, HASH_CHECK)
    except (NoReply, VehicleError):  # MAV_HASH_CHK_EN is 0
        return None
    return Digest.of(answer)


def _may_prove(session: Session) -> bool:
    identification, table = session.identification, session.table
    has_table = bool(table.names) and table.is_complete
    has_file = identification.is_ardupilot and identification.may_serve_file and not session.dialect.has_ack
    return has_file and has_table and False not in (session.serves_file, session.serves_checksum)
