"""TLS certificate and private key files, checked before the service starts."""

from __future__ import annotations

import os
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

from paramclient.client.file_ownership import OTHERS_WRITE, has_trusted_owner, mode_of, open_regular
from paramclient.errors import UsageError

__all__ = ["Tls", "tls_of"]

PEM_FILE_BYTES_MAX: Final = 1_000_000
"""Maximum number of bytes read from a file: a chain of certificates has some thousands."""


@dataclass(frozen=True, slots=True)
class Tls:
    """A certificate and its private key.

    Attributes:
        cert: path of the certificate and its intermediate certificates, in PEM.
        key: path of the private key in PEM, not encrypted.
    """

    cert: Path
    key: Path


def tls_of(cert: str | os.PathLike[str] | None, key: str | os.PathLike[str] | None) -> Tls | None:
    """Return the checked files, or None if neither is given.

    Raises:
        UsageError: a file is missing, unreadable, not PEM, writable by other users, or the key belongs to
            another certificate. The message names the file.
    """
    if cert is None and key is None:
        return None
    if cert is None or key is None:
        raise UsageError(
            "TLS needs both --tls-cert FILE, the certificate, and --tls-key FILE, its private key"
        )
    tls = Tls(Path(cert), Path(key))
    _check_pem(tls.cert, "certificate", b"CERTIFICATE-----")
    _check_pem(tls.key, "private key", b"PRIVATE KEY-----")

    def encrypted() -> NoReturn:
        raise UsageError(
            f"{tls.key}: the private key is encrypted. Decrypt it: the service cannot ask for a password"
        )

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(tls.cert, tls.key, password=encrypted)
    except ssl.SSLError as error:
        if error.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
            raise UsageError(
                f"{tls.key}: this private key does not belong to the certificate {tls.cert}"
            ) from None
        raise UsageError(
            f"{tls.cert} with {tls.key}: not a certificate with its private key: {error.reason or error}"
        ) from None
    return tls


def _check_pem(path: Path, what: str, mark: bytes) -> None:
    try:
        with open_regular(path) as file:
            status = os.fstat(file.fileno())
            data = file.read(PEM_FILE_BYTES_MAX)
    except OSError as error:
        raise UsageError(f"{path}: the {what} cannot be read: {error.strerror}") from error
    if not has_trusted_owner(status) or mode_of(status) & OTHERS_WRITE:
        raise UsageError(
            f"{path}: other users can change this {what} (owner {status.st_uid}, mode {mode_of(status):o})."
            " Change its owner or mode"
        )
    if mark not in data:
        raise UsageError(f"{path}: the file contains no {what} in PEM format")
