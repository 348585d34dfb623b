"""TLS by files: a certificate and its key, looked at before anybody connects."""

from __future__ import annotations

import os
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

from paramclient.cache.file_ownership import OTHERS_WRITE, has_trusted_owner, mode_of
from paramclient.errors import UsageError

__all__ = ["Tls", "tls_of"]

LONGEST_FILE: Final = 1_000_000
"""Bytes of a file that are looked at: a chain of certificates has some thousands."""


@dataclass(frozen=True, slots=True)
class Tls:
    """Two files that belong together.

    Attributes:
        cert: the certificate in PEM, and those between it and the authority.
        key: its private key in PEM, not encrypted.
    """

    cert: Path
    key: Path


def tls_of(cert: str | os.PathLike[str] | None, key: str | os.PathLike[str] | None) -> Tls | None:
    """What a server needs for TLS; None where neither file is named.

    Raises:
        UsageError: one is missing, cannot be read, holds something else, or the key belongs to another
            certificate. The text names the file.
    """
    if cert is None and key is None:
        return None
    if cert is None or key is None:
        raise UsageError(
            "TLS needs both: --tls-cert FILE, the certificate, and --tls-key FILE, its private key"
        )
    tls = Tls(Path(cert), Path(key))
    _check_pem(tls.cert, "certificate", b"CERTIFICATE-----")
    _check_pem(tls.key, "private key", b"PRIVATE KEY-----")

    def encrypted() -> NoReturn:
        raise UsageError(
            f"{tls.key}: the private key is encrypted, and nobody is there to be asked for its password"
        )

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(tls.cert, tls.key, password=encrypted)
    except ssl.SSLError as error:
        if error.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
            raise UsageError(
                f"{tls.key}: this private key does not belong to the certificate {tls.cert}"
            ) from None
        raise UsageError(f"{tls.cert} with {tls.key}: no certificate with its key: {error.reason}") from None
    return tls


def _check_pem(path: Path, what: str, mark: bytes) -> None:
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(LONGEST_FILE)
    except OSError as error:
        raise UsageError(f"{path}: the {what} cannot be read: {error.strerror}") from error
    if not has_trusted_owner(status) or mode_of(status) & OTHERS_WRITE:
        raise UsageError(
            f"{path}: others than the user of this program can change this {what} (owner {status.st_uid},"
            f" mode {mode_of(status):o})"
        )
    if mark not in data:
        raise UsageError(f"{path}: there is no {what} in PEM in this file")
