"""The cache service: one process holds the links, and everyone on the network uses them over HTTP.

Needs the extra `service`.
"""

from __future__ import annotations

from paramclient.service.app import Settings, create_app
from paramclient.service.hub import Hub
from paramclient.service.run import Listening, serve

__all__ = ["Hub", "Listening", "Settings", "create_app", "serve"]
