"""RemoteClient: a `ParamClient` for the address of a service only, with a choice of how requests travel."""

from __future__ import annotations

from typing import Any

import httpx

from paramclient.client.client import ParamClient
from paramclient.client.link_client import LinkOptions
from paramclient.links import Link
from paramclient.remote.service_client import ServiceClient

__all__ = ["RemoteClient"]


class RemoteClient(ParamClient):
    """A `ParamClient` for the address of a service only. `ParamClient("http://HOST:8765")` works the same.

    A client over a service differs from one over a link of its own: The service has the links and keeps the
    cache, so the arguments for both are refused. `params` of a component is a mirror of the service's; while
    the service cannot be reached, every value in it is *cached*, and calls wait for it as they wait for a
    link that is away. A write that was under way when the connection broke is not sent again: it raises
    LinkError, and whether it was done is not known.

    With several links on the service, the components of all of them are there. Where two links have
    one with the same ids, it is in `components` only when the address names the link
    (`http://HOST:8765?link=udpin:0.0.0.0:14550`).

    `stats` are those of the links, as they were when they were asked for last: on opening, with every
    `fetch_all` of the client, when a link's state changes, and soon after each look at them.

    Args:
        link: `http://HOST:PORT` or `https://HOST:PORT`, and `?link=NAME` for one of its links.
        token: what the service wants to see; None for PARAMCLIENT_TOKEN of the environment.
        transport: how requests travel; None for sockets.
        others: those of `ParamClient`, as long as they say nothing.

    Raises:
        UsageError: no such address, or an argument that only a client with a link of its own takes; on
            entering: the service does not take the token, or has no such link.
        LinkError: on entering: it cannot be reached, or is no service of paramclient.
    """

    def __init__(
        self,
        link: str | Link | object,
        *,
        token: str | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
        **others: Any,
    ) -> None:
        LinkOptions(**others).check_unset()
        self._implementation = ServiceClient(str(link), token=token, transport=transport)
        self.cache = self._implementation.cache
