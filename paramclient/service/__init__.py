"""The service: links and cache of this computer over HTTP, with a web page. Needs the extra `service`.

- `access`: tokens, and checks of each request: token and role, origin, headers of responses.
- `bodies`: models of request bodies.
- `documents`: JSON of vehicles, stations and events, and metrics; all other is as the command prints it.
- `event_feed`: events for any number of listeners, with resume.
- `gateway`: passes frames between vehicles and ground stations; `kept_table`: answers for one component from
  its table; `kept_file`: from its parameter file; `stations`: endpoints, queues and sequence numbers.
- `hub`: opens the links, follows the parameters of their components, and reads the cache.
- `problems`: errors as problem documents (RFC 9457).
- `routes`: all routes.
- `server`: the application and the page; uvicorn with its limits, start and shutdown.
"""

from __future__ import annotations

from paramclient.service.access import Tokens, add_token
from paramclient.service.hub import Hub
from paramclient.service.server import Listening, create_app, serve

__all__ = ["Hub", "Listening", "Tokens", "add_token", "create_app", "serve"]
