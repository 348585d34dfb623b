"""The application: middleware, routes, and the files of the page."""

from __future__ import annotations

from importlib import resources
from typing import Final

from fastapi import FastAPI
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.staticfiles import StaticFiles

from paramclient.service import routes, setup_routes
from paramclient.service.access import AccessMiddleware, cancel_on_disconnect
from paramclient.service.hub import Hub
from paramclient.service.problems import ERRORS, RESPONSES, respond
from paramclient.service.tokens import Tokens
from paramclient.version import __version__

__all__ = ["create_app"]

BODY_BYTES_MAX: Final = 4 * 2**20
"""Maximum size of a request body in bytes: a parameter file of 2 MB in base64, and some."""
LOOPBACK_NAMES: Final = ("localhost", "127.0.0.1", "[::1]")
"""Names of this computer in the header Host: without tokens, no other site can point its name at the service
and let its pages read."""


def create_app(hub: Hub, *, tokens: Tokens | None = None) -> FastAPI:
    """Create the application over a hub, which the caller opens and closes.

    Args:
        hub: links and cache.
        tokens: the valid tokens; None lets every program of this computer read and write.
    """
    app = FastAPI(
        title="paramclient",
        version=__version__,
        summary="MAVLink parameters of the vehicles on the links of this service",
        docs_url=None,  # its scripts would come from another site
        redoc_url=None,
        responses=RESPONSES,
        exception_handlers=dict.fromkeys(ERRORS, respond),
    )
    app.state.hub = hub
    app.add_middleware(RequestBodyLimitMiddleware, max_body_size=BODY_BYTES_MAX)
    app.add_middleware(cancel_on_disconnect)
    app.add_middleware(AccessMiddleware, tokens=tokens)
    if tokens is None:
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=LOOPBACK_NAMES, www_redirect=False)
    for router in (*routes.ROUTERS, *setup_routes.ROUTERS):
        app.include_router(router)
    page = resources.files("paramclient.service").joinpath("page")
    app.mount("/", StaticFiles(directory=str(page), html=True))
    return app
