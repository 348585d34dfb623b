"""DatabaseAddress: the URL of a PostgreSQL database. Its text forms never include the password."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final
from urllib.parse import quote

from paramclient.errors import UsageError

__all__ = ["DatabaseAddress", "is_address"]

_SCHEMES: Final = ("postgresql://", "postgres://")
"""Beginnings of a database URL; any other place is a file."""


def is_address(place: object) -> bool:
    """Return whether a place is the URL of a database. Otherwise it is a file."""
    return isinstance(place, str) and place.lower().startswith(_SCHEMES)


@dataclass(frozen=True, repr=False)
class DatabaseAddress:
    """A PostgreSQL database.

    Attributes:
        place: the URL for messages, without password and options.
        name: file name of its local copy, independent of user and password.
        options: connection options of libpq.
    """

    place: str
    name: str
    options: Mapping[str, Any]

    @classmethod
    def parse(cls, url: str) -> DatabaseAddress:
        """Parse a URL.

        Raises:
            UsageError: the URL is not valid, or psycopg is not installed.
        """
        try:
            from psycopg.conninfo import conninfo_to_dict
        except ImportError as error:
            raise UsageError(
                f"a cache in PostgreSQL needs psycopg ({error}): pip install 'paramclient[postgres]'"
            ) from error
        try:
            given = conninfo_to_dict(url)
        except Exception:  # the text of any error may include the password
            given = None
        authority = url.partition("://")[2].partition("/")[0].partition("?")[0]
        if given is None or authority.count("@") > 1 or not _are_ports(given.get("port")):
            raise UsageError(
                "the URL of the database is not valid; its form is postgresql://USER@HOST:PORT/DATABASE, and"
                " characters of a password other than letters and digits are percent-encoded"
            ) from None
        host = given.get("host") or given.get("hostaddr") or given.get("service") or ""
        where = f"{host}:{given['port']}" if given.get("port") else str(host)
        user = f"{given['user']}@" if given.get("user") else ""
        database = given.get("dbname") or given.get("user") or ""
        name = sha256("\0".join(str(each) for each in (host, given.get("port") or 5432, database)).encode())
        if str(host).startswith("/"):  # the folder of a socket
            where, socket = "", f"?host={quote(str(host))}"
        else:
            socket = ""
        place = (
            f"postgresql://{quote(user, safe='@')}{quote(where, safe=':,[]')}/{quote(str(database))}{socket}"
        )
        return cls(place, f"shared-{name.hexdigest()[:16]}.sqlite3", given)

    def __repr__(self) -> str:
        return f"<DatabaseAddress {self.place}>"

    def without_password(self, text: str) -> str:
        """Return a text with `***` in place of the password."""
        for name in ("password", "sslpassword"):
            secret = self.options.get(name)
            for each in {secret, quote(secret), quote(secret, safe="")} if secret else ():
                text = text.replace(each, "***")
        return text


def _are_ports(ports: object) -> bool:
    return not ports or all(each.isdigit() or not each for each in str(ports).split(","))
