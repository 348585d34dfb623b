"""Makings of the service's tests: a hub with a client over it, and what its answers are."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx

from paramclient.service import Hub, create_app
from tests.asgi import a_browser

C = "/api/v1/components/1/1"


@asynccontextmanager
async def service(*links: Any, **options: Any) -> AsyncIterator[tuple[Hub, httpx.AsyncClient]]:
    """An open hub and a client of it; without a cache, and without fetches that no test requested."""
    async with (
        Hub(links, **{"cache": False, "fetches": False} | options) as hub,
        a_browser(create_app(hub)) as browser,
    ):
        yield hub, browser


async def met(browser: httpx.AsyncClient, **sought: Any) -> dict[str, Any]:
    """The component that is found first."""
    answer = await browser.post("/api/v1/find", json=sought)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def problem(answer: httpx.Response, status: int, kind: str) -> dict[str, Any]:
    """What an answer says that is a problem of this kind."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    reported: dict[str, Any] = answer.json()
    assert reported["type"] == f"urn:paramclient:{kind}"
    assert reported["status"] == status
    assert reported["title"]
    assert reported["detail"]
    return reported
