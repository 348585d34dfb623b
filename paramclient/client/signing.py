"""Signing keys as users have them, and what a client is told of signing."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from paramclient.cache.file_ownership import GROUP_READS, OF_OTHERS, has_trusted_owner, mode_of
from paramclient.errors import UsageError
from paramclient.protocol.wire import SigningKey, SigningPolicy, SigningReport, timestamp_of

__all__ = ["Signing", "key_from_environment", "read_key", "read_private", "refused_in_words", "timestamp_now"]

KEY_VARIABLE: Final = "PARAMCLIENT_SIGNING_KEY"
FILE_VARIABLE: Final = "PARAMCLIENT_SIGNING_KEY_FILE"
PASSPHRASE_VARIABLE: Final = "PARAMCLIENT_SIGNING_PASSPHRASE"
LONGEST_FILE: Final = 1_000
"""Bytes of a key file that are looked at: a key, in text or not, with some blank lines."""
CREDENTIALS_VARIABLE: Final = "CREDENTIALS_DIRECTORY"
"""The folder of the credentials of a unit, which nobody else can enter (systemd.exec, "Credentials")."""


@dataclass(frozen=True, slots=True)
class Signing:
    """How a client signs what it sends, and what it takes of what comes.

    Attributes:
        key: the key, which the vehicle has too.
        policy: what is accepted, see `SigningPolicy`; also its value, such as `"signed-only"`.
        link_id: the id of this link in our signatures, 0 to 255. None: the lowest that no other session on
            this machine uses with this key, so that the timestamps of two sessions never get into each
            other's way.
        state: the folder in which the timestamps are kept; None for the user's own.

    Raises:
        UsageError: there is no such policy or link id.
    """

    key: SigningKey
    policy: SigningPolicy | str = SigningPolicy.UNSIGNED_RADIOS
    link_id: int | None = None
    state: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        if self.policy not in list(SigningPolicy):
            known = ", ".join(SigningPolicy)
            raise UsageError(f"there is no signing policy {self.policy!r}, only {known}")
        if self.link_id is not None and not 0 <= self.link_id <= 255:
            raise UsageError(f"a link id is a number from 0 to 255, not {self.link_id}")


def read_key(path: str | os.PathLike[str]) -> SigningKey:
    """The key in a file: its 32 bytes as they are, 64 hexadecimal digits, or base64.

    Raises:
        UsageError: the file cannot be read, is open to others than its owner (where there are such modes),
            or holds no key. The text never tells what it holds.
    """
    data = read_private(path, "signing key", LONGEST_FILE + 1)
    try:
        if len(data) == 32:
            return SigningKey(data)
        if len(data) > LONGEST_FILE:
            raise UsageError(f"a signing key is no file of more than {LONGEST_FILE} bytes")
        return SigningKey.from_text(data.decode("ascii", "replace"))
    except UsageError as error:
        raise UsageError(f"{os.fspath(path)}: {error}") from None


def read_private(path: str | os.PathLike[str], what: str, most: int) -> bytes:
    """The first so many bytes of a file that is its owner's alone.

    Args:
        path: the file.
        what: what it holds, for errors.
        most: bytes that are read.

    Raises:
        UsageError: it cannot be read, belongs to another user than that of this process or root, or is open
            to others than its owner (where there are such modes). Also root does not take another user's: who
            owns a file can change it.
    """
    try:
        with Path(path).open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(most)
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the {what} cannot be read: {error.strerror}") from error
    if not has_trusted_owner(status):
        raise UsageError(
            f"{os.fspath(path)}: this {what} belongs to another user (id {status.st_uid}), who can change it;"
            " `chown` it to the user of this program"
        )
    mode = mode_of(status)
    # a credential of systemd has it since version 254 in the place of an entry of the access list, which lets
    # the user of the unit read it, and for no group (systemd's issue 29435)
    of_others = OF_OTHERS & ~GROUP_READS if _is_credential(path) else OF_OTHERS
    if mode & of_others:
        raise UsageError(
            f"{os.fspath(path)}: others than its owner can get at this {what} (mode {mode:o}); "
            "`chmod 600` ends that, and what others may have read is better replaced"
        )
    return data


def key_from_environment(environment: Mapping[str, str] = os.environ) -> SigningKey | None:
    """The key that the environment names, or None.

    `PARAMCLIENT_SIGNING_KEY` has it in 64 hexadecimal digits or base64, `PARAMCLIENT_SIGNING_KEY_FILE` names
    a file for `read_key`, `PARAMCLIENT_SIGNING_PASSPHRASE` has the passphrase of which it is made.

    Raises:
        UsageError: there are several of them, or what one of them has is no key.
    """
    makers = {
        KEY_VARIABLE: SigningKey.from_text,
        FILE_VARIABLE: read_key,
        PASSPHRASE_VARIABLE: SigningKey.from_passphrase,
    }
    given = [name for name in makers if environment.get(name)]
    if not given:
        return None
    if len(given) > 1:
        raise UsageError(f"one signing key is enough; the environment has {' and '.join(given)}")
    try:
        return makers[given[0]](environment[given[0]])
    except UsageError as error:
        raise UsageError(f"{given[0]}: {error}") from None


def timestamp_now() -> int:
    """The timestamp of this moment, by the system's clock."""
    return timestamp_of(time.time())


def refused_in_words(report: SigningReport | None) -> str:
    """Why somebody may be there and not be heard, for the end of a sentence."""
    refused = {} if report is None else report.refused
    reasons = ", ".join(f"{count} for: {reason}" for reason, count in refused.items())
    return f" (frames were refused, {reasons})" if reasons else ""


def _is_credential(path: str | os.PathLike[str]) -> bool:
    """Whether systemd has given this file to the unit that we are."""
    folder = os.environ.get(CREDENTIALS_VARIABLE, "")
    return folder != "" and Path(path).resolve().parent == Path(folder).resolve()
