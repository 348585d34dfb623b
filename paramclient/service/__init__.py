"""The service: links and cache of this computer over HTTP, with a web page. Needs the extra `service`.

- `gateway`: passes frames between vehicles and ground stations; `kept_table`: answers for one component from
  its table; `kept_file`: from its parameter file; `stations`: endpoints, queues and sequence numbers.
- `hub`: opens the links, follows the parameters of their components, reads the cache, and keeps the events.
- `problems`: errors as problem documents (RFC 9457).
- `routes`: all routes, their request bodies, and the metrics. JSON is as the command prints it.
- `server`: tokens, and the checks of each request; the application and the page; uvicorn, start and shutdown.
"""

from __future__ import annotations

from paramclient.service.hub import Hub
from paramclient.service.server import Tokens, add_token, create_app, read_tokens, serve

__all__ = ["Hub", "Tokens", "add_token", "create_app", "read_tokens", "serve"]
