"""Service: the interface of a service that its components use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from paramclient.client.component import Component
from paramclient.remote.connection import Connection
from paramclient.remote.http import ServiceResponse
from paramclient.remote.mirrored_component import MirroredComponent

__all__ = ["Service"]


class Service(Protocol):
    """Interface of a service for its components.

    Attributes:
        name: address of the service.
        connection: connection to the service.
    """

    name: str
    connection: Connection

    async def ask(
        self,
        mirrored: MirroredComponent,
        what: str,
        body: Mapping[str, Any] | None,
        timeout: float | None,
        awaited: str,
        *,
        method: str = "POST",
        is_write: bool = False,
    ) -> ServiceResponse:
        """Send a request about a component, and wait until its effect is in the mirror.

        Args:
            mirrored: the component.
            what: the last part of the path.
            body, timeout, awaited, method, is_write: as in `Connection.ask`.

        Raises:
            ParamClientError: as from `Connection.ask`.
        """

    async def component_of_response(self, answer: ServiceResponse) -> Component:
        """Return the component of a response, with its table."""
