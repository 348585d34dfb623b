"""What the service answers, room by room. A further one is a line here."""

from __future__ import annotations

from typing import Final

from fastapi import APIRouter

from paramclient.service.routes import (
    components,
    described,
    fetching,
    files,
    params,
    past,
    setup,
    stream,
    system,
)

__all__ = ["ROUTERS"]

ROUTERS: Final[tuple[APIRouter, ...]] = (
    system.router,
    components.router,
    params.router,
    described.router,
    fetching.router,
    setup.router,
    files.router,
    past.router,
    stream.router,
)
