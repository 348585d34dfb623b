"""Persistent signature timestamps: no timestamp is used twice, also across sessions.

Each session locks a file for exclusive use of a link id. A file for each key and link id has an upper limit
of the used timestamps. The limit is written ahead of use, so that not every frame causes a write, and neither
a crash nor a clock that was set back leads to a reused timestamp.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Final

import anyio
import anyio.to_thread
import platformdirs

from paramclient.client.signing import Signing, timestamp_now
from paramclient.errors import UsageError
from paramclient.wire.signing import ADOPTED_TIMESTAMP_MAX, UNITS_PER_SECOND, Signer, SigningPolicy, Verifier

__all__ = ["TimestampKeeper"]

TIMESTAMP_RESERVE: Final = 60 * UNITS_PER_SECOND
"""Timestamp units (60 s) by which the written limit is ahead of the used timestamps. A crash skips at most
this many."""
TIMESTAMP_RESERVE_MIN: Final = TIMESTAMP_RESERVE // 2
"""Remaining timestamp units at which a new limit is written."""
TIMESTAMP_CHECK_INTERVAL: Final = 5.0
"""Seconds between two checks of the remaining timestamps."""
LINK_IDS: Final = 256
"""Number of link ids: a signature has 8 bits for it."""

logger = logging.getLogger(__name__)


class TimestampKeeper:
    """Stores the signature timestamps of one client: `open`, then `run` while it is open, then `close`.

    If the folder cannot be used, it logs a warning, and timestamps start at the system clock.

    Args:
        signing: the signing options of the client.
    """

    def __init__(self, signing: Signing) -> None:
        folder = platformdirs.user_state_path("paramclient") if signing.state is None else Path(signing.state)
        self._signing = signing
        self._folder = folder / "signing"
        self._link_id = signing.link_id
        self._lock: int | None = None
        self._signer: Signer | None = None
        self._limit = 0
        self._is_kept = True

    async def open(self) -> tuple[Signer, Verifier]:
        """Claim a link id, and return the signer and the verifier of the session.

        Raises:
            UsageError: other sessions use the link id, or all link ids.
        """
        last = 0
        try:
            last = await anyio.to_thread.run_sync(self._claim)
        except OSError as error:
            self._fail(error)
        self._signer = Signer(
            self._signing.key, link_id=self._link_id or 0, timestamp=max(last, timestamp_now())
        )
        await self._reserve(self._signer)
        return self._signer, Verifier(self._signer, SigningPolicy(self._signing.policy))

    async def run(self) -> None:
        """Write new limits ahead of use, until cancelled."""
        assert self._signer is not None, "open comes first"
        while True:
            await anyio.sleep(TIMESTAMP_CHECK_INTERVAL)
            await self._reserve(self._signer)

    async def close(self) -> None:
        """Write the last used timestamp and unlock the link id."""
        if self._signer is not None:
            await self._write(self._signer.timestamp)
        if self._lock is not None:
            os.close(self._lock)

    async def _reserve(self, signer: Signer) -> None:
        if self._limit - signer.timestamp < TIMESTAMP_RESERVE_MIN:
            await self._write(signer.timestamp + TIMESTAMP_RESERVE)

    async def _write(self, limit: int) -> None:
        if not self._is_kept:
            return
        try:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(self._save, limit)
            self._limit = limit
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self._is_kept = False
        logger.warning(
            "%s: cannot store signature timestamps (%s). If the system clock is set back, vehicles refuse "
            "signed frames until one of their signed frames has advanced the timestamp. Check the access "
            "rights of the folder",
            self._folder,
            error.strerror,
        )

    # called in a thread

    def _claim(self) -> int:
        """Lock a link id for this session and return the last timestamp that may have been used, or 0.

        Raises:
            UsageError: other sessions use this link id, or all link ids.
            OSError: the folder cannot be read or written.
        """
        from filelock import lock_descriptor  # only here: it adds 10 ms to the import of paramclient

        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        wanted = self._signing.link_id
        for self._link_id in range(LINK_IDS) if wanted is None else (wanted,):
            self._lock = _open_private(self._path("lock"), os.O_RDWR | os.O_CREAT)
            if lock_descriptor(self._lock, blocking=False):
                return self._load()
            os.close(self._lock)
        self._lock = None
        which = "every link id" if wanted is None else f"link id {wanted}"
        raise UsageError(f"{which} of this signing key is in use by other sessions on this machine")

    def _load(self) -> int:
        path = self._path("timestamp")
        try:
            text = path.read_text(encoding="ascii", errors="replace")
        except FileNotFoundError:
            return 0
        if text.strip().isdecimal() and (timestamp := int(text)) <= ADOPTED_TIMESTAMP_MAX + TIMESTAMP_RESERVE:
            return timestamp
        logger.warning("%s: no valid signature timestamp; using the system clock", path)
        return 0

    def _save(self, limit: int) -> None:
        """Write the limit up to which timestamps may be used, and flush it to the disk."""
        path = self._path("timestamp")
        fresh = path.with_suffix(".new")
        with open(fresh, "w", encoding="ascii", opener=_open_private) as file:
            file.write(f"{limit}\n")
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)

    def _path(self, kind: str) -> Path:
        return self._folder / f"{self._signing.key.fingerprint}-{self._link_id}.{kind}"


def _open_private(path: str | Path, flags: int) -> int:
    return os.open(path, flags, 0o600)
