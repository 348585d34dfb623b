"""Is the table current? The vehicle's digest of its parameters, compared with the table's.

PX4 announces a hash, `_HASH_CHECK`. Other vehicles have no answer, and their tables are downloaded.
"""

from __future__ import annotations

from paramclient.errors import NoReply, UnknownParameter
from paramclient.protocol.dialect import Digest
from paramclient.protocol.reads import read
from paramclient.protocol.session import Session
from paramclient.wire.messages import HASH_CHECK

__all__ = ["is_current", "request_digest"]


async def request_digest(session: Session) -> Digest | None:
    """Return the digest of the vehicle's table now; None for a vehicle without one.

    Raises:
        LinkError: the link is closed for good.
    """
    if not session.identification.is_px4 or session.dialect.has_ack:
        return None
    try:
        answer = await read(session, HASH_CHECK)
    except (NoReply, UnknownParameter):  # MAV_HASH_CHK_EN is 0
        return None
    return Digest.of(answer)


def is_current(session: Session, digest: Digest | None) -> bool:
    """Return whether a digest confirms the table as it is."""
    table = session.table
    return (
        digest is not None and table.is_complete and (table.hash, table.count) == (digest.hash, digest.count)
    )
