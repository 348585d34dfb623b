"""Signing: keys from files and the environment, and the options of a client."""

from __future__ import annotations

import os
import stat
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from paramclient.errors import UsageError
from paramclient.wire.signing import Signer, SigningKey, SigningPolicy, Verifier, timestamp_of

KEY_VARIABLE: Final = "PARAMCLIENT_SIGNING_KEY"
"""Environment variable with the key in 64 hexadecimal digits or base64."""
KEY_FILE_VARIABLE: Final = "PARAMCLIENT_SIGNING_KEY_FILE"
"""Environment variable with the path of a key file."""
PASSPHRASE_VARIABLE: Final = "PARAMCLIENT_SIGNING_PASSPHRASE"
"""Environment variable with a passphrase from which the key is derived."""
KEY_FILE_BYTES_MAX: Final = 1_000
"""Bytes that are read of a key file, at most: a binary or text key with some blank lines."""
CREDENTIALS_VARIABLE: Final = "CREDENTIALS_DIRECTORY"
"""Environment variable with the credentials folder of a systemd unit, which only the unit can access
(systemd.exec, "Credentials")."""


@dataclass(frozen=True, slots=True)
class Signing:
    """MAVLink 2 signing of a client: signatures of sent frames, and checks of received frames.

    Attributes:
        key: the secret key, the same as on the vehicle.
        policy: which frames are accepted, see `SigningPolicy`; or its value, such as `"signed-only"`.
        link_id: link id in the signatures of this client, 0 to 255.

    Raises:
        UsageError: the policy is unknown, or the link id is out of range.
    """

    key: SigningKey
    policy: SigningPolicy | str = SigningPolicy.UNSIGNED_RADIOS
    link_id: int = 0

    def __post_init__(self) -> None:
        SigningPolicy(self.policy)  # raises UsageError for an unknown one
        if not 0 <= self.link_id <= 255:
            raise UsageError(f"a signing link id must be 0 to 255, not {self.link_id}")

    def begin(self) -> tuple[Signer, Verifier]:
        """Return the signer and the verifier of a session, whose timestamps start at the system clock."""
        signer = Signer(self.key, link_id=self.link_id, timestamp=timestamp_now())
        return signer, Verifier(signer, SigningPolicy(self.policy))


def read_key(path: str | os.PathLike[str]) -> SigningKey:
    """Read a signing key from a file with 32 raw bytes, 64 hexadecimal digits, or base64.

    Raises:
        UsageError: the file cannot be read, has no valid key, belongs to another user, or is accessible to
            other users than its owner (on systems with file modes). The message never includes its content.
    """
    data = read_private(path, "signing key", KEY_FILE_BYTES_MAX)
    try:
        if len(data) == 32:
            return SigningKey(data)
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
        UsageError: the file cannot be read, its owner is neither the user of this
            process nor root, or it is accessible to other users than its owner (on systems with file modes).
            A process of root also rejects a file of another user, as the owner of a file can change it.
    """
    try:
        with Path(path).open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(most)
    except OSError as error:
        raise UsageError(f"{os.fspath(path)}: the {what} cannot be read: {error.strerror}") from error
    # Windows has neither such ids nor such modes
    if sys.platform != "win32" and status.st_uid not in (os.geteuid(), 0):
        raise UsageError(
            f"{os.fspath(path)}: this {what} belongs to another user (id {status.st_uid}), who can change it;"
            " `chown` it to the user of this program"
        )
    mode = stat.S_IMODE(status.st_mode)
    # since version 254, a systemd credential shows the group-read bit for the access-list entry of the unit's
    # user, although no group can read it (systemd issue 29435)
    folder = os.environ.get(CREDENTIALS_VARIABLE)
    is_credential = folder and Path(path).resolve().parent == Path(folder).resolve()
    if sys.platform != "win32" and mode & (0o037 if is_credential else 0o077):
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
