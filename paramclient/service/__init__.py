"""The cache service: one process holds the links, and everyone on the network uses them over HTTP.

Needs the extra `service`.
"""

from __future__ import annotations

from paramclient.service.access import AccessSettings
from paramclient.service.app import Settings, create_app
from paramclient.service.hub import Hub
from paramclient.service.server import Listening, serve
from paramclient.service.tokens import Tokens, tokens_from

__all__ = ["AccessSettings", "Hub", "Listening", "Settings", "Tokens", "create_app", "serve", "tokens_from"]
