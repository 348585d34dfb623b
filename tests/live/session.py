"""What every check of the suite works with: the relay, the vehicle, and its state before."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from paramclient import Component, Events, FetchResult, ParamClient
from paramclient.model.values import Param
from tests.live.choice import Choice
from tests.live.journal import Journal
from tests.live.relay import CLEAN, Conditions, Relay

__all__ = ["DISCOVERY_TIMEOUT", "Check", "CheckFailed", "Session", "Skip"]

DISCOVERY_TIMEOUT: Final = 15.0
"""Seconds to wait for the vehicle's heartbeat at the beginning of a check."""
NAMES_SHOWN: Final = 5
"""Names that a failure lists at most."""


class CheckFailed(Exception):
    """The client or the vehicle did something else than the documentation says."""


class Skip(Exception):
    """The check cannot be made on this vehicle or link; the text says why."""


@dataclass(frozen=True)
class Check:
    """One row of the table.

    Attributes:
        name: what is checked.
        run: does it, and returns what it has found, as it stands in the table.
        promise: what the documentation promises, in words.
        writes: whether it changes parameters, which an armed vehicle or `--read-only` forbids.
        kinds: the autopilots for which it has a meaning; None for all.
    """

    name: str
    run: Callable[[Session], Awaitable[str]]
    promise: str = ""
    writes: bool = False
    kinds: tuple[str, ...] | None = None


@dataclass
class Session:
    """One run of the suite on one vehicle.

    Attributes:
        relay: between the clients and the vehicle.
        folder: for the caches of this run.
        journal: the state before, and what was changed.
        system: the vehicle's system id.
        kind: "px4", "ardupilot" or another word of `Component.autopilot`.
        second_link: another link to the same vehicle, for the check of two sessions, or None.
        choice: the parameters that may be changed.
    """

    relay: Relay
    folder: Path
    journal: Journal
    system: int
    kind: str
    second_link: str | None
    choice: Choice

    @asynccontextmanager
    async def client(
        self, *, cache: Path | None = None, link: str = "", component: int = 190
    ) -> AsyncIterator[Component]:
        """Open a client behind the relay, without a cache unless one is given, and find the vehicle."""
        async with self.client_with_events(cache=cache, link=link, component=component) as (vehicle, _):
            yield vehicle

    @asynccontextmanager
    async def client_with_events(
        self, *, cache: Path | None = None, link: str = "", component: int = 190
    ) -> AsyncIterator[tuple[Component, Callable[[], Events]]]:
        """Open a client as `client` does; yield the vehicle, and the call that returns a stream of events."""
        opened = ParamClient(
            link or self.relay.link, cache=False if cache is None else cache, component=component
        )
        async with opened as client:
            yield await client.component(self.system, timeout=DISCOVERY_TIMEOUT), client.events

    @asynccontextmanager
    async def under(self, conditions: Conditions) -> AsyncIterator[None]:
        """Let the relay have these conditions, and none afterwards."""
        self.relay.change(conditions)
        try:
            yield
        finally:
            self.relay.change(CLEAN)

    async def check_fetched(self, vehicle: Component, result: FetchResult) -> None:
        """Raise CheckFailed unless a fetch has brought every parameter with the vehicle's value.

        A value that differs from the state before is read again: it counts if the vehicle confirms it, since
        some values change by themselves.
        """
        if not result.complete:
            missing = ", ".join(map(str, result.missing[:NAMES_SHOWN]))
            raise CheckFailed(f"{len(result.missing)} parameters are missing: {missing}")
        listed = {name: param for name, param in result.params.items() if param.index is not None}
        await self._check_values(vehicle, listed)

    async def _check_values(self, vehicle: Component, listed: Mapping[str, Param]) -> None:
        before = self.journal.before
        unknown = sorted(listed.keys() ^ before.keys())
        if unknown := [name for name in unknown if not self.journal.appears_and_disappears(name)]:
            raise CheckFailed(
                f"{len(unknown)} names appeared or disappeared: {', '.join(unknown[:NAMES_SHOWN])}"
            )
        wrong: list[str] = []
        for name, param in listed.items():
            if name in before and not before[name].same_value(param):
                held = await vehicle.get(name)
                if held.same_value(param):
                    before[name] = param
                elif not self.journal.moves_by_itself(name):
                    wrong.append(f"{param} (the vehicle holds {held.value!r})")
        if wrong:
            raise CheckFailed(f"{len(wrong)} wrong values: {', '.join(wrong[:NAMES_SHOWN])}")
