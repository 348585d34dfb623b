"""What stands in the place of a link where a service has the links."""

from __future__ import annotations

from typing import NoReturn

from paramclient.client.local import not_given

__all__ = ["ServiceLink"]


class ServiceLink:
    """A name, and no bytes: those go over the links of the service.

    Attributes:
        name: the address of the service.
    """

    is_stream = False
    reconnects = True

    def __init__(self, name: str) -> None:
        self.name = name

    def __repr__(self) -> str:
        return f"<ServiceLink {self.name}>"

    async def open(self) -> None:
        """Refused, as all that follow."""
        self._refuse()

    async def receive(self) -> NoReturn:
        """Refused."""
        self._refuse()

    async def send(self, data: bytes, peer: object) -> None:
        """Refused."""
        self._refuse()

    async def close(self) -> None:
        """Nothing is open."""

    def _refuse(self) -> NoReturn:
        raise not_given("the bytes of its links")
