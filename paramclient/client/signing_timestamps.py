"""The timestamps of signatures, from one session to the next: none is ever used twice.

Each session has a link id to itself, by a lock on a file, and for each key and link id stands on disk how
far the timestamps may go. That is written ahead, so that neither every frame writes, nor a crash or a clock
that went back leads to one that was used before.
"""

from __future__ import annotations

import logging
import os
from functools import partial
from pathlib import Path
from typing import Final

import anyio
import platformdirs

from paramclient.cache.lock import try_to_lock
from paramclient.client.signing import Signing, timestamp_now
from paramclient.client.worker_thread import Worker
from paramclient.errors import UsageError
from paramclient.protocol.wire import Signer, SigningPolicy, Verifier
from paramclient.protocol.wire.signing import ADOPTED_TIMESTAMP_MAX, UNITS_PER_SECOND

__all__ = ["TimestampFile", "TimestampKeeper"]

RESERVED: Final = 60 * UNITS_PER_SECOND
"""How far ahead of use a timestamp is written down: at most so much is skipped after a crash."""
LEAST_RESERVED: Final = RESERVED // 2
"""When so little of that is left, it is written again."""
LOOK_INTERVAL: Final = 5.0
"""Seconds between two looks at how much is left."""
LINK_IDS: Final = 256

logger = logging.getLogger(__name__)


class TimestampFile:
    """How far the timestamps of one key on one link id have gone. Its methods block.

    Args:
        folder: where it is kept.
        fingerprint: of the key.
        link_id: the link id; None for the lowest that is free.

    Attributes:
        link_id: the link id, once there is one.

    Raises:
        UsageError: on `claim`: another session has this link id, or others have all of them.
        OSError: the folder cannot be used.
    """

    def __init__(self, folder: Path, fingerprint: str, link_id: int | None) -> None:
        self.link_id = link_id
        self._folder = folder
        self._fingerprint = fingerprint
        self._lock: int | None = None

    def claim(self) -> int:
        """Take a link id for this session alone; gives the last timestamp that may have been used, or 0."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for link_id in range(LINK_IDS) if self.link_id is None else (self.link_id,):
            self._lock = _locked(self._path(link_id, "lock"))
            if self._lock is not None:
                self.link_id = link_id
                return self._read()
        which = "every link id" if self.link_id is None else f"link id {self.link_id}"
        raise UsageError(f"{which} of this signing key is in use by other sessions on this machine")

    def write(self, timestamp: int) -> None:
        """Let timestamps up to this one be used."""
        path = self._path(self.link_id, "timestamp")
        fresh = path.with_suffix(".new")
        with open(fresh, "w", encoding="ascii", opener=_private) as file:
            file.write(f"{timestamp}\n")
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)

    def release(self) -> None:
        """Leave the link id to others."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def _read(self) -> int:
        path = self._path(self.link_id, "timestamp")
        try:
            text = path.read_text(encoding="ascii", errors="replace")
        except FileNotFoundError:
            return 0
        if text.strip().isdecimal() and (timestamp := int(text)) <= ADOPTED_TIMESTAMP_MAX + RESERVED:
            return timestamp
        logger.warning("%s: holds no timestamp; the time of day counts", path)
        return 0

    def _path(self, link_id: int | None, kind: str) -> Path:
        return self._folder / f"{self._fingerprint}-{link_id}.{kind}"


class TimestampKeeper:
    """Sees to the timestamps of one client: `open`, then `run` for as long as it lives, then `close`.

    A folder that cannot be used costs a warning; the time of day alone counts then.

    Args:
        signing: what the user has said.
    """

    def __init__(self, signing: Signing) -> None:
        folder = platformdirs.user_state_path("paramclient") if signing.state is None else Path(signing.state)
        self._signing = signing
        self._folder = folder / "signing"
        self._file = TimestampFile(self._folder, signing.key.fingerprint, signing.link_id)
        self._worker = Worker("paramclient signing")
        self._signer: Signer | None = None
        self._written = 0
        self._is_kept = False

    async def open(self) -> tuple[Signer, Verifier]:
        """What signs from here on, and what looks at signatures.

        Raises:
            UsageError: the link id is in use by another session.
        """
        last = 0
        try:
            last = await self._worker.run(self._file.claim)
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
        """Write ahead, for ever."""
        while True:
            await anyio.sleep(LOOK_INTERVAL)
            await self._keep()

    async def close(self) -> None:
        """Write down where it has ended, and leave the link id to others."""
        signer = self._signer
        if signer is not None and self._is_kept:
            await self._write(signer.timestamp)
        await self._worker.close(self._file.release)

    async def _keep(self) -> None:
        signer = self._signer
        assert signer is not None, "open comes first"
        if self._is_kept and self._written - signer.timestamp < LEAST_RESERVED:
            await self._write(signer.timestamp + RESERVED)

    async def _write(self, timestamp: int) -> None:
        try:
            await self._worker.run(partial(self._file.write, timestamp))
        except OSError as error:
            self._warn(error)
            self._is_kept = False
        else:
            self._written = timestamp

    def _warn(self, error: OSError) -> None:
        logger.warning(
            "%s: the timestamps of signatures cannot be kept (%s); if the clock goes back, vehicles refuse "
            "what is signed until they have brought us up to theirs",
            self._folder,
            error.strerror,
        )


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _locked(path: Path) -> int | None:
    """A file's descriptor with the lock on it, or None where somebody else has that."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        if try_to_lock(descriptor):
            return descriptor
    except OSError:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None
