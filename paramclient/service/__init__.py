"""The service: links and cache of this computer over HTTP, with a web page. Needs the extra `service`.

- `access`: checks of each request: token and role, origin, headers of responses.
- `app`: the FastAPI application: middleware, routes, the page.
- `documents`: JSON of vehicles, stations and events; all other is as the command prints it.
- `event_feed`: events for any number of listeners, with resume.
- `gateway`: passes frames between vehicles and ground stations; `kept_table`: answers for one component from
  its table; `kept_file`: from its parameter file; `stations`: endpoints, queues and sequence numbers.
- `hub`: opens the links, follows their components, and reads the cache.
- `metrics`: metrics in the text format of Prometheus.
- `problems`: errors as problem documents (RFC 9457).
- `request_bodies`: models of request bodies.
- `routes`: vehicles, parameters, fetches, events, health; `setup_routes`: files, plan, apply, restore,
  snapshots, history.
- `server`: uvicorn with its limits, start and shutdown.
- `targets`: the links, and the parameters of components on them.
- `tokens`: the token file.
"""

from __future__ import annotations

from paramclient.service.app import create_app
from paramclient.service.hub import Hub
from paramclient.service.server import Listening, serve
from paramclient.service.tokens import Tokens, add_token

__all__ = ["Hub", "Listening", "Tokens", "add_token", "create_app", "serve"]
