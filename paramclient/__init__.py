"""The ground-station side of MAVLink's parameter protocol for asyncio programs, with a cache."""

from __future__ import annotations

from paramclient.version import __version__

__all__ = ["__version__"]
