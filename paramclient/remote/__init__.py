"""The same calls over a service: `ParamClient("http://HOST:8765")` (see `paramclient serve`).

The service has the links and the cache. Here stand a mirror of its tables, which follows its events, and
calls that become requests; their errors are the same exceptions that the service's own client raised.
"""

from __future__ import annotations

from importlib.util import find_spec

from paramclient.errors import UsageError

if missing := [name for name in ("httpx", "httpx_sse") if find_spec(name) is None]:
    raise UsageError(
        f"a service in the place of a link needs {' and '.join(missing)}: pip install 'paramclient[remote]'"
    )

from paramclient.remote.client import RemoteClient
from paramclient.remote.component import RemoteComponent

__all__ = ["RemoteClient", "RemoteComponent"]
