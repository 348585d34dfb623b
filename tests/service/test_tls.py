"""Certificates: errors are reported before the first connection, with the name of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient.errors import UsageError
from paramclient.service.tls import Tls, tls_of

DATA = Path(__file__).parents[1] / "data"
CERT, KEY = DATA / "tls_station.pem", DATA / "tls_station.key"
"""Made for `localhost` and 127.0.0.1, by itself, for a hundred years; the key guards nothing."""


def test_two_files_that_belong_together() -> None:
    assert tls_of(CERT, KEY) == tls_of(str(CERT), str(KEY)) == Tls(CERT, KEY)
    assert tls_of(None, None) is None


@pytest.mark.parametrize(
    ("cert", "key", "words"),
    [
        (CERT, None, "TLS needs both --tls-cert FILE, the certificate, and --tls-key FILE, its private key"),
        (None, KEY, "TLS needs both"),
        ("nowhere.pem", KEY, "nowhere.pem: the certificate cannot be read: No such file or directory"),
        (CERT, "nowhere.key", "nowhere.key: the private key cannot be read: No such file or directory"),
        (CERT, DATA, f"{DATA}: the private key cannot be read: Is a directory"),
        (KEY, CERT, f"{KEY}: the file contains no certificate in PEM format"),
        (CERT, CERT, f"{CERT}: the file contains no private key in PEM format"),
        (
            CERT,
            DATA / "tls_other.key",
            f"tls_other.key: this private key does not belong to the certificate {CERT}",
        ),
        (CERT, DATA / "tls_locked.key", "tls_locked.key: the private key is encrypted"),
    ],
)
def test_an_invalid_certificate_or_key_is_reported_with_its_file(
    cert: Path | None, key: Path | None, words: str
) -> None:
    with pytest.raises(UsageError) as caught:
        tls_of(cert, key)
    assert words in str(caught.value)


def test_a_file_that_is_damaged_is_named(tmp_path: Path) -> None:
    cert = tmp_path / "cert.pem"
    cert.write_text("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n")
    with pytest.raises(UsageError, match=r"cert\.pem with .*tls_station\.key: not a certificate with its"):
        tls_of(cert, KEY)
