"""The routes of the API.

- `components`, `params`, `extended`, `fetches`, `param_files`, `metadata`: components, parameters, extended
  parameters, fetches and jobs, parameter files, metadata.
- `history`, `apply`, `events`, `system`: earlier states, set-ups, the event stream, the service itself.
"""

from __future__ import annotations

from typing import Final

from fastapi import APIRouter

from paramclient.service.routes import (
    apply,
    components,
    events,
    extended,
    fetches,
    history,
    metadata,
    param_files,
    params,
    system,
)

__all__ = ["ROUTERS"]

ROUTERS: Final[tuple[APIRouter, ...]] = (
    system.router,
    components.router,
    params.router,
    extended.router,
    metadata.router,
    fetches.router,
    apply.router,
    param_files.router,
    history.router,
    events.router,
)
"""All routers of the application."""
