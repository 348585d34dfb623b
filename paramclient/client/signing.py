"""Signing: keys from files and the environment, the options of a client, and its persistent timestamps.

No timestamp is used twice, also across sessions. Each session locks a file for exclusive use of a link id. A
file for each key and link id has an upper limit of the used timestamps. The limit is written ahead of use, so
that not every frame causes a write, and neither a crash nor a clock that was set back leads to a reused
timestamp.
"""

from __future__ import annotations

import errno
import logging
import os
import stat
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import anyio
import anyio.to_thread
import platformdirs

from paramclient.errors import UsageError
from paramclient.wire.signing import (
    ADOPTED_TIMESTAMP_MAX,
    UNITS_PER_SECOND,
    Signer,
    SigningKey,
    SigningPolicy,
    SigningReport,
    Verifier,
    timestamp_of,
)

__all__ = [
    "Signing",
    "TimestampKeeper",
    "key_from_environment",
    "read_key",
    "read_private",
    "refused_in_words",
    "timestamp_now",
]

KEY_VARIABLE: Final = "PARAMCLIENT_SIGNING_KEY"
"""Environment variable with the key in 64 hexadecimal digits or base64."""
KEY_FILE_VARIABLE: Final = "PARAMCLIENT_SIGNING_KEY_FILE"
"""Environment variable with the path of a key file."""
PASSPHRASE_VARIABLE: Final = "PARAMCLIENT_SIGNING_PASSPHRASE"
"""Environment variable with a passphrase from which the key is derived."""
KEY_FILE_BYTES_MAX: Final = 1_000
"""Maximum size of a key file in bytes: a binary or text key with some blank lines."""
CREDENTIALS_VARIABLE: Final = "CREDENTIALS_DIRECTORY"
"""Environment variable with the credentials folder of a systemd unit, which only the unit can access
(systemd.exec, "Credentials")."""
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


@dataclass(frozen=True, slots=True)
class Signing:
    """MAVLink 2 signing of a client: signatures of sent frames, and checks of received frames.

    Attributes:
        key: the secret key, the same as on the vehicle.
        policy: which frames are accepted, see `SigningPolicy`; or its value, such as `"signed-only"`.
        link_id: link id in the signatures of this client, 0 to 255. None: the lowest that no other session on
            this machine uses with this key, so that the timestamps of two sessions do not conflict.
        state: folder for the signature timestamps; None for the user's state folder.

    Raises:
        UsageError: the policy is unknown, or the link id is out of range.
    """

    key: SigningKey
    policy: SigningPolicy | str = SigningPolicy.UNSIGNED_RADIOS
    link_id: int | None = None
    state: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        if self.policy not in list(SigningPolicy):
            known = ", ".join(SigningPolicy)
            raise UsageError(f"unknown signing policy {self.policy!r}; choose one of {known}")
        if self.link_id is not None and not 0 <= self.link_id <= 255:
            raise UsageError(f"a signing link id must be 0 to 255, not {self.link_id}")


def read_key(path: str | os.PathLike[str]) -> SigningKey:
    """Read a signing key from a file with 32 raw bytes, 64 hexadecimal digits, or base64.

    Raises:
        UsageError: the file cannot be read, has no valid key, belongs to another user, or is accessible to
            other users than its owner (on systems with file modes). The message never includes its content.
    """
    data = read_private(path, "signing key", KEY_FILE_BYTES_MAX + 1)
    try:
        if len(data) == 32:
            return SigningKey(data)
        if len(data) > KEY_FILE_BYTES_MAX:
            raise UsageError(f"a signing key file has at most {KEY_FILE_BYTES_MAX} bytes; this one is larger")
        return SigningKey.from_text(data.decode("ascii", "replace"))
    except UsageError as error:
        raise UsageError(f"{os.fspath(path)}: {error}") from None


def read_private(path: str | os.PathLike[str], what: str, most: int) -> bytes:
    """Read the start of a file that only its owner can access.

    Args:
        path: the file.
        what: kind of its content, for errors.
        most: maximum number of bytes to read.

    Raises:
        UsageError: the file cannot be read or is not a regular file, its owner is neither the user of this
            process nor root, or it is accessible to other users than its owner (on systems with file modes).
            A process of root also rejects a file of another user, as the owner of a file can change it.
    """
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise OSError(errno.EINVAL, "Not a regular file")
            data = file.read(most)
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the {what} cannot be read: {error.strerror}") from error
    if sys.platform == "win32":  # it has neither such ids nor such modes
        return data
    if status.st_uid not in (os.geteuid(), 0):
        raise UsageError(
            f"{os.fspath(path)}: this {what} belongs to another user (id {status.st_uid}), who can change it;"
            " `chown` it to the user of this program"
        )
    mode = stat.S_IMODE(status.st_mode)
    # since version 254, a systemd credential shows the group-read bit for the access-list entry of the unit's
    # user, although no group can read it (systemd issue 29435)
    folder = os.environ.get(CREDENTIALS_VARIABLE)
    is_credential = folder and Path(path).resolve().parent == Path(folder).resolve()
    if mode & (0o037 if is_credential else 0o077):
        raise UsageError(
            f"{os.fspath(path)}: other users than its owner can access this {what} (mode {mode:o}); "
            "run `chmod 600` on it, and replace it if another user may have read it"
        )
    return data


def key_from_environment(environment: Mapping[str, str] = os.environ) -> SigningKey | None:
    """Return the signing key of the environment, or None.

    `PARAMCLIENT_SIGNING_KEY` has the key in 64 hexadecimal digits or base64, `PARAMCLIENT_SIGNING_KEY_FILE`
    the path of a file for `read_key`, `PARAMCLIENT_SIGNING_PASSPHRASE` a passphrase from which the key is
    derived.

    Raises:
        UsageError: several of these variables are set, or the value of one is not valid.
    """
    makers = {
        KEY_VARIABLE: SigningKey.from_text,
        KEY_FILE_VARIABLE: read_key,
        PASSPHRASE_VARIABLE: SigningKey.from_passphrase,
    }
    given = [name for name in makers if environment.get(name)]
    if not given:
        return None
    if len(given) > 1:
        raise UsageError(f"several signing keys in the environment: {' and '.join(given)}; set only one")
    try:
        return makers[given[0]](environment[given[0]])
    except UsageError as error:
        raise UsageError(f"{given[0]}: {error}") from None


def timestamp_now() -> int:
    """Return the current time of the system clock as a signature timestamp."""
    return timestamp_of(time.time())


def refused_in_words(report: SigningReport | None) -> str:
    """Return the numbers of refused frames with reasons, as the end of a message; "" if there are none."""
    refused = {} if report is None else report.refused
    reasons = ", ".join(f"{count} for: {reason}" for reason, count in refused.items())
    return f" (frames were refused, {reasons})" if reasons else ""


def _without_waiting(path: str, flags: int) -> int:
    """Open a file, without waiting for a writer of a named pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


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
