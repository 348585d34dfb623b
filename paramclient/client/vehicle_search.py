"""The search for all vehicles on a link, or for an expected number of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import anyio

from paramclient.client.component import Component
from paramclient.errors import NoReply

__all__ = ["VEHICLES_LISTENING_TIME", "listen_for_vehicles"]

VEHICLES_LISTENING_TIME: Final = 3.0
"""Seconds in which every vehicle is heard, even on a link that loses two of three heartbeats."""
VEHICLES_POLL_INTERVAL: Final = 0.05
"""Seconds between two checks whether all expected vehicles have been heard."""


async def listen_for_vehicles(
    heard: Callable[[], list[Component]],
    *,
    expect: int | None,
    timeout: float | None,
    began: float,
    check_open: Callable[[], None],
) -> list[Component]:
    """Return the vehicles that were heard after `timeout`, or as soon as `expect` were heard.

    Args:
        heard: returns the vehicles that were heard so far.
        expect: the number of vehicles to wait for; None for all that are heard within `timeout`.
        timeout: seconds; None waits for the expected vehicles without limit.
        began: the time since which the caller has waited, for the error.
        check_open: raises the error of a client that is not open.

    Raises:
        NoReply: fewer than expected were heard; the message names them.
        LinkError: as from `check_open`.
    """
    with anyio.move_on_after(timeout):
        while expect is None or len(heard()) < expect:
            check_open()
            await anyio.sleep(VEHICLES_POLL_INTERVAL)
    found = heard()
    if expect is not None and len(found) < expect:
        labels = ", ".join(f"{each.system}/{each.component} {each.autopilot}" for each in found) or "none"
        waited = anyio.current_time() - began
        raise NoReply(f"{expect} vehicles (heard: {labels})", attempts=0, waited=waited)
    return found
