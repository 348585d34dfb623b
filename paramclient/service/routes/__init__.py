"""What the service answers, room by room. A further one is a line here."""

from __future__ import annotations

from typing import Final

from fastapi import APIRouter

from paramclient.service.routes import components, fetching, params, stream, system

__all__ = ["ROUTERS"]

ROUTERS: Final[tuple[APIRouter, ...]] = (
    system.router,
    components.router,
    params.router,
    fetching.router,
    stream.router,
)
