"""A service over simulated vehicles in this process, and a client of it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import httpx

from paramclient.service import Hub, create_app
from tests.service.asgi import a_browser

V = "/api/vehicles/1/1"


@asynccontextmanager
async def service(
    *links: Any, app: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[Hub, httpx.AsyncClient]]:
    """An open hub and a client of it; without a cache, unless one is given. `app`: for `create_app`."""
    async with (
        Hub(links, **{"cache": False} | options) as hub,
        a_browser(create_app(hub, **(app or {}))) as browser,
    ):
        yield hub, browser


@asynccontextmanager
async def browsing(*links: Any, **options: Any) -> AsyncIterator[httpx.AsyncClient]:
    """A client of a service whose first table is in sync; see `service`."""
    async with service(*links, **options) as (_, browser):
        await synced(browser)
        yield browser


async def synced(browser: httpx.AsyncClient, address: str = V) -> dict[str, Any]:
    """The vehicle, as soon as its table is complete."""
    return await until(browser, address, lambda found: found["state"] == "synced")


async def until(
    browser: httpx.AsyncClient, address: str, is_so: Callable[[dict[str, Any]], bool]
) -> dict[str, Any]:
    """The vehicle at an address, as soon as it is so; without ids, the whole list."""
    for _ in range(1000):
        if (found := await vehicle(browser, address)) is not None and is_so(found):
            return found
        await asyncio.sleep(0.1)
    raise AssertionError(f"{address}: {found}")


async def vehicle(browser: httpx.AsyncClient, address: str = V) -> dict[str, Any] | None:
    """The vehicle at an address, as the list has it."""
    url = httpx.URL(address)
    listed: dict[str, Any] = (await browser.get("/api/vehicles")).json()
    if url.path == "/api/vehicles":
        return listed
    system, component = map(int, url.path.split("/")[3:5])
    wanted: dict[str, Any] = {"system": system, "component": component, "extended": "ext" in url.params}
    wanted |= {"link": url.params["link"]} if "link" in url.params else {}
    return next((each for each in listed["vehicles"] if wanted.items() <= each.items()), None)


def problem(answer: httpx.Response, status: int, kind: str) -> dict[str, Any]:
    """The members of a problem document, which has to be of this kind."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    reported: dict[str, Any] = answer.json()
    assert (reported["type"], reported["status"]) == (f"urn:paramclient:{kind}", status)
    assert reported["title"]
    assert reported["detail"]
    return reported


def value(answer: httpx.Response) -> Any:
    """The value of a parameter."""
    assert answer.status_code == 200, answer.text
    return answer.json()["value"]
