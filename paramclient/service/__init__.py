"""The cache service: one process holds the links, and everyone on the network uses them over HTTP.

Needs the extra `service`.

- `app`, `server`, `routes`: the application, the server, the routes.
- `hub`, `link`, `followed_component`, `followed_extended`: links and cache, one link, one component, its
  extended parameters.
- `event_feed`, `jobs`: numbered events, jobs. The members of events are built by `followed_component`,
  `followed_extended`, `link` and `jobs`.
- `access`, `request`, `tokens`, `client_address`, `tls`: access checks of every request.
- `acceptor`, `connection_slots`, `connections`: connections before TLS, their number, their limits.
- `quota`, `body_limits`, `body_memory`, `log_limit`: limits of requests in progress, request bodies and log
  lines.
- `garbage_collection`: when full garbage collections of a serving process run, and what they skip.
- `request_body`, `param_sources`, `route_context`, `responses`, `problems`, `metrics`: request bodies,
  parameter sets named in requests, shared parts of routes, responses, errors, Prometheus.
"""

from __future__ import annotations

from paramclient.service.access import AccessSettings
from paramclient.service.app import Settings, create_app
from paramclient.service.hub import Hub
from paramclient.service.server import Listening, serve
from paramclient.service.tokens import Tokens, tokens_from

__all__ = ["AccessSettings", "Hub", "Listening", "Settings", "Tokens", "create_app", "serve", "tokens_from"]
