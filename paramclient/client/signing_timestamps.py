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

__all__ = ["TimestampFile", "TimestampKeeper"]

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


class TimestampFile:
    """The file with the timestamp limit of one key and link id. Its methods block.

    Args:
        folder: folder of the files.
        fingerprint: fingerprint of the key.
        link_id: the link id; None for the lowest free one.

    Attributes:
        link_id: the link id; None until `claim` if it was not given.

    Raises:
        UsageError: on `claim`: other sessions use this link id, or all link ids.
        OSError: the folder cannot be read or written.
    """

    def __init__(self, folder: Path, fingerprint: str, link_id: int | None) -> None:
        self.link_id = link_id
        self._folder = folder
        self._fingerprint = fingerprint
        self._lock: int | None = None

    def claim(self) -> int:
        """Lock a link id for this session and return the last timestamp that may have been used, or 0.

        Raises:
            UsageError: other sessions use this link id, or all link ids.
            OSError: the folder cannot be read or written.
        """
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for link_id in range(LINK_IDS) if self.link_id is None else (self.link_id,):
            self._lock = _locked(self._path(link_id, "lock"))
            if self._lock is not None:
                self.link_id = link_id
                return self._read()
        which = "every link id" if self.link_id is None else f"link id {self.link_id}"
        raise UsageError(f"{which} of this signing key is in use by other sessions on this machine")

    def write(self, timestamp: int) -> None:
        """Write the limit up to which timestamps may be used, and flush it to the disk.

        Raises:
            OSError: the file cannot be written.
        """
        path = self._path(self.link_id, "timestamp")
        fresh = path.with_suffix(".new")
        with open(fresh, "w", encoding="ascii", opener=_private) as file:
            file.write(f"{timestamp}\n")
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)

    def release(self) -> None:
        """Unlock the link id for other sessions."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def _read(self) -> int:
        path = self._path(self.link_id, "timestamp")
        try:
            text = path.read_text(encoding="ascii", errors="replace")
        except FileNotFoundError:
            return 0
        if text.strip().isdecimal() and (timestamp := int(text)) <= ADOPTED_TIMESTAMP_MAX + TIMESTAMP_RESERVE:
            return timestamp
        logger.warning("%s: no valid signature timestamp; using the system clock", path)
        return 0

    def _path(self, link_id: int | None, kind: str) -> Path:
        return self._folder / f"{self._fingerprint}-{link_id}.{kind}"


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
        self._file = TimestampFile(self._folder, signing.key.fingerprint, signing.link_id)
        self._signer: Signer | None = None
        self._written = 0
        self._is_kept = False

    async def open(self) -> tuple[Signer, Verifier]:
        """Claim a link id, and return the signer and the verifier of the session.

        Raises:
            UsageError: other sessions use the link id, or all link ids.
        """
        last = 0
        try:
            last = await anyio.to_thread.run_sync(self._file.claim)
            self._is_kept = True
        except OSError as error:
            self._warn(error)
        signer = Signer(
            self._signing.key, link_id=self._file.link_id or 0, timestamp=max(last, timestamp_now())
        )
        self._signer = signer
        await self._keep()
        return signer, Verifier(signer, SigningPolicy(self._signing.policy))

    async def run(self) -> None:
        """Write new limits ahead of use, until cancelled."""
        while True:
            await anyio.sleep(TIMESTAMP_CHECK_INTERVAL)
            await self._keep()

    async def close(self) -> None:
        """Write the last used timestamp and unlock the link id."""
        signer = self._signer
        if signer is not None and self._is_kept:
            await self._write(signer.timestamp)
        await anyio.to_thread.run_sync(self._file.release)

    async def _keep(self) -> None:
        signer = self._signer
        assert signer is not None, "open comes first"
        if self._is_kept and self._written - signer.timestamp < TIMESTAMP_RESERVE_MIN:
            await self._write(signer.timestamp + TIMESTAMP_RESERVE)

    async def _write(self, timestamp: int) -> None:
        try:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(self._file.write, timestamp)
        except OSError as error:
            self._warn(error)
            self._is_kept = False
        else:
            self._written = timestamp

    def _warn(self, error: OSError) -> None:
        logger.warning(
            "%s: cannot store signature timestamps (%s). If the system clock is set back, vehicles refuse "
            "signed frames until one of their signed frames has advanced the timestamp. Check the access "
            "rights of the folder",
            self._folder,
            error.strerror,
        )


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _locked(path: Path) -> int | None:
    """Open a file and lock it. Return its descriptor, or None if another session holds the lock.

    Raises:
        OSError: the file cannot be opened or locked.
    """
    from filelock import lock_descriptor  # only here: it adds 10 ms to the import of paramclient

    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        if lock_descriptor(descriptor, blocking=False):
            return descriptor
    except OSError:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None
