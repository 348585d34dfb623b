"""ServiceLink: the link object of a client over a service."""

from __future__ import annotations

from typing import NoReturn

from paramclient.client.local import not_given

__all__ = ["ServiceLink"]


class ServiceLink:
    """The link of a client over a service: only a name. The service has the links with their data.

    Attributes:
        name: address of the service.
        is_stream, reconnects: as in `Link`.

    Raises:
        UsageError: on `open`, `receive` and `send`.
    """

    is_stream = False
    reconnects = True

    def __init__(self, name: str) -> None:
        self.name = name

    def __repr__(self) -> str:
        return f"<ServiceLink {self.name}>"

    async def open(self) -> None:
        """Raise UsageError."""
        self._refuse()

    async def receive(self) -> NoReturn:
        """Raise UsageError."""
        self._refuse()

    async def send(self, data: bytes, peer: object) -> None:
        """Raise UsageError."""
        self._refuse()

    async def close(self) -> None:
        """Do nothing."""

    def _refuse(self) -> NoReturn:
        raise not_given("the bytes of its links")
