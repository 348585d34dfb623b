"""Client over a service: `ParamClient("http://HOST:8765")` (see `paramclient serve`).

The service has the links and the cache. The client has a mirror of its tables, which follows its events, and
sends calls as HTTP requests. Errors are the exceptions that the client of the service has raised.

- `bounded`: size and time limits of received data.
- `client`: `RemoteClient`, a `ParamClient` for services only.
- `component`: `RemoteComponent`, the implementation of `Component`.
- `connection`: event stream with reconnection, and requests.
- `decoding`: JSON documents of a service as records.
- `http`: HTTP requests and the event stream.
- `link`: `ServiceLink`, the link object of such a client.
- `mirror`: copies of one table, plain or extended.
- `mirrored_component`: state and table of one component.
- `problems`: problem documents as exceptions.
- `remote_extended_params`: `RemoteExtParams`, the implementation of `ExtParams`.
- `roster`: all components of a service.
- `service`: interface of a service for its components.
- `service_address`: address and token of a service.
- `service_client`: `ServiceClient`, the implementation of `ParamClient`.
- `write_parts`: writes of many values in several requests.
"""

from __future__ import annotations

from importlib.util import find_spec

from paramclient.errors import UsageError

if missing := [name for name in ("httpx", "httpx_sse") if find_spec(name) is None]:
    raise UsageError(
        f"a client over a service needs {' and '.join(missing)}: pip install 'paramclient[remote]'"
    )

from paramclient.remote.client import RemoteClient
from paramclient.remote.component import RemoteComponent

__all__ = ["RemoteClient", "RemoteComponent"]
