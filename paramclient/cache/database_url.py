"""Which database a URL means. What it says of secrets never comes out again as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final
from urllib.parse import quote

from paramclient.errors import UsageError

__all__ = ["Address", "is_address"]

_SCHEMES: Final = ("postgresql://", "postgres://")


def is_address(place: object) -> bool:
    """Whether a place is the URL of a database rather than a file."""
    return isinstance(place, str) and place.lower().startswith(_SCHEMES)


@dataclass(frozen=True, repr=False)
class Address:
    """A database.

    Attributes:
        place: the URL for people: without password and options.
        name: a file name for it: the same for every user and password.
        options: as libpq takes them.
    """

    place: str
    name: str
    options: Mapping[str, Any]

    @classmethod
    def parse(cls, url: str) -> Address:
        """Read a URL.

        Raises:
            UsageError: it is none, or psycopg is missing.
        """
        try:
            from psycopg.conninfo import conninfo_to_dict
        except ImportError as error:
            raise UsageError(
                f"a cache in PostgreSQL needs psycopg ({error}): pip install 'paramclient[postgres]'"
            ) from error
        try:
            given = conninfo_to_dict(url)
        except Exception:  # whatever it is, its text may hold the password
            given = None
        authority = url.partition("://")[2].partition("/")[0].partition("?")[0]
        if given is None or authority.count("@") > 1 or not _are_ports(given.get("port")):
            raise UsageError(
                "the URL of the database cannot be read; it has the form postgresql://USER@HOST:PORT/DATABASE,"
                " and each sign of a password that is neither letter nor digit is written as % and its number"
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
        return f"<Address {self.place}>"

    def without_password(self, text: str) -> str:
        """The same text, with signs in the place of the password."""
        for name in ("password", "sslpassword"):
            secret = self.options.get(name)
            for each in {secret, quote(secret), quote(secret, safe="")} if secret else ():
                text = text.replace(each, "***")
        return text


def _are_ports(ports: object) -> bool:
    return not ports or all(each.isdigit() or not each for each in str(ports).split(","))
