"""RemoteClient: a `ParamClient` for the address of a service only, with a choice of the HTTP transport."""

from __future__ import annotations

from typing import Any

import httpx

from paramclient.client.client import ParamClient
from paramclient.client.link_client import ClientOptions
from paramclient.links import Link
from paramclient.remote.service_client import ServiceClient

__all__ = ["RemoteClient"]


class RemoteClient(ParamClient):
    """A `ParamClient` for the address of a service only. `ParamClient("http://HOST:8765")` is equivalent.

    Differences from a client with its own link: The service has the links and the cache, so the arguments for
    both are refused. `params` of a component mirrors that of the service. While the service cannot be
    reached, every value is *cached*, and calls wait as they wait for the reconnection of a link. A write
    whose connection is lost before the response is not repeated: it raises LinkError, and it is unknown
    whether the vehicle has the value.

    `components` has the components of all links of the service. If two links have a component with equal ids,
    it is only included if the address names the link (`http://HOST:8765?link=udpin:0.0.0.0:14550`).

    `stats` are those of the links at the last request: on opening, with every `fetch_all` of the client, when
    the state of a link changes, and within 0.5 s after each access.

    Args:
        link: `http://HOST:PORT` or `https://HOST:PORT`, with `?link=NAME` for one of its links.
        token: access token of the service; None for PARAMCLIENT_TOKEN of the environment.
        transport: HTTP transport; None for sockets.
        others: other arguments of `ParamClient`, only with their default values.

    Raises:
        UsageError: the address is not valid, or an argument is only for a client with its own link. On
            entering: the service refuses the token, or has no such link.
        LinkError: on entering: the service cannot be reached, or is not a service of paramclient.
    """

    def __init__(
        self,
        link: str | Link | object,
        *,
        token: str | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
        **others: Any,
    ) -> None:
        ClientOptions(**others).check_unset()
        self._implementation = ServiceClient(str(link), token=token, transport=transport)
        self.cache = self._implementation.cache
