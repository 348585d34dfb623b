"""ServiceAddress: address of a service, and its access token."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, urlsplit, urlunsplit

from paramclient.errors import UsageError
from paramclient.links import parse_link

__all__ = ["CLIENT_TOKEN_VARIABLE", "ServiceAddress", "chosen_token"]

CLIENT_TOKEN_VARIABLE: Final = "PARAMCLIENT_TOKEN"
"""Environment variable with the access token, for all clients of services."""


@dataclass(frozen=True, slots=True)
class ServiceAddress:
    """Address of a service, optionally with one of its links.

    Attributes:
        base: `http://HOST:PORT`, with the path behind a proxy, and without a trailing slash.
        link: name of one of its links, or None for all.
    """

    base: str
    link: str | None = None

    @classmethod
    def read(cls, text: str) -> ServiceAddress:
        """Parse `http://HOST:8765` or `https://HOST/path?link=NAME`.

        Raises:
            UsageError: the address is not valid.
        """
        shown = text.strip()
        try:
            parts = urlsplit(shown)
            port = parts.port
        except ValueError as error:
            raise UsageError(f"address {shown!r}: {error}") from None
        if parts.username is not None or parts.password is not None:
            # the message does not include the address: its password may be the token
            raise UsageError("the address of a service has no password; pass the token with token=")
        if parts.scheme.lower() not in ("http", "https") or not parts.hostname or port == 0:
            raise UsageError(f"address {shown!r}: a service is named http://HOST:PORT")
        if parts.fragment:
            raise UsageError(f"address {shown!r}: the address of a service has no part after #; remove it")
        base = urlunsplit((parts.scheme.lower(), parts.netloc.lower(), parts.path.rstrip("/"), "", ""))
        return cls(base, _chosen_link(parts.query, shown))

    @property
    def name(self) -> str:
        """The canonical spelling, as the name of a link."""
        return self.base if self.link is None else f"{self.base}?link={self.link}"


def chosen_token(token: str | None) -> str | None:
    """Return the given token, or that of the environment; None if there is none.

    Raises:
        UsageError: the token is not printable ASCII without spaces.
    """
    chosen = os.environ.get(CLIENT_TOKEN_VARIABLE) if token is None else token
    if not chosen:
        return None
    if not (chosen.isascii() and chosen.isprintable() and " " not in chosen):
        raise UsageError("a token is printable ASCII without spaces")
    return chosen


def _chosen_link(query: str, shown: str) -> str | None:
    if not query:
        return None
    pairs = parse_qsl(query, keep_blank_values=True)
    if [key for key, _ in pairs] != ["link"] or not pairs[0][1]:
        raise UsageError(f"address {shown!r}: only one link=NAME may follow the ?, with %26 for an & in it")
    name = pairs[0][1]
    try:
        return parse_link(name).name
    except UsageError:
        return name  # a link type of another program, whose name only the service knows
