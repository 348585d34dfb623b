"""All vehicles on a link: how long is listened for them, and the error if fewer are heard than expected.

`ParamClient.find_autopilots` and `--all` and `--expect` of the command line find vehicles in this way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

import anyio

from paramclient.client.component import Component
from paramclient.errors import NoReply, UsageError

__all__ = ["VEHICLES_LISTENING_TIME", "find_autopilots", "listen_for_vehicles"]

VEHICLES_LISTENING_TIME: Final = 3.0
"""Seconds in which every vehicle is heard, even on a link that loses two of three heartbeats."""
VEHICLES_POLL_INTERVAL: Final = 0.05
"""Seconds between two checks whether all expected vehicles have been heard."""


class _VehicleSource(Protocol):
    """What the search needs of a client."""

    @property
    def autopilots(self) -> list[Component]:
        """See `ParamClient.autopilots`."""

    def check_open(self) -> None:
        """Raise the error of a client that is not open, or whose link failed."""

    async def component(self, *, timeout: float | None) -> Component:
        """See `ParamClient.component`."""


async def find_autopilots(
    client: _VehicleSource, *, expect: int | None, timeout: float | None
) -> list[Component]:
    """See `ParamClient.find_autopilots`.

    Raises:
        UsageError, NoReply, LinkError: as in `ParamClient.find_autopilots`.
    """
    if expect is not None and expect < 1:
        raise UsageError(f"expect must be a number of vehicles from 1 up, not {expect}")
    began = anyio.current_time()
    await client.component(timeout=timeout)
    if expect is None:
        listening: float | None = VEHICLES_LISTENING_TIME
    else:
        listening = None if timeout is None else began + timeout - anyio.current_time()
    return await listen_for_vehicles(
        lambda: client.autopilots,
        expect=expect,
        timeout=listening,
        began=began,
        check_open=client.check_open,
    )


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
