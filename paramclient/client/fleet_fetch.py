"""Fetches of several components at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import anyio

from paramclient.client.component import Component
from paramclient.errors import CacheError, NoReply, ParamClientError
from paramclient.protocol.addresses import Address
from paramclient.protocol.fetch import FetchResult

__all__ = ["FetchedAll", "fetch_components"]


SILENT_TIME: Final = 1.75
"""Seconds for a component that has never answered a request, where another one on the link answers."""


@dataclass(frozen=True, slots=True)
class FetchedAll:
    """Result of a fetch of several components.

    Attributes:
        results: results of the components that responded, by (system, component).
        silent: errors of the other components, by (system, component). NoReply if the component did not
            respond or is lost, CacheError if the policy allows no download and nothing is cached.
    """

    results: Mapping[Address, FetchResult]
    silent: Mapping[Address, NoReply | CacheError]

    @property
    def complete(self) -> bool:
        """Whether `results` has every parameter of every component that responded."""
        return all(result.complete for result in self.results.values())


async def fetch_components(
    components: Mapping[Address, Component], *, refresh: bool, timeout: float | None
) -> FetchedAll:
    """Fetch the tables of components in parallel; see `ParamClient.fetch_all`.

    Raises:
        NoReply: none responded.
        UsageError: `refresh` is given, and the client may not download.
        LinkError: the link failed, or the client was closed.
    """
    results: dict[Address, FetchResult] = {}
    silent: dict[Address, NoReply | CacheError] = {}
    failures: list[ParamClientError] = []
    scopes: dict[Address, anyio.CancelScope] = {}

    async def fetch(address: Address, component: Component) -> None:
        try:
            what = f"the parameters of {component.system}/{component.component}"
            with component.limited(None, what) as scopes[address]:
                results[address] = await component.fetch_all(refresh=refresh, timeout=timeout)
        except (NoReply, CacheError) as error:
            silent[address] = error
        except ParamClientError as error:
            failures.append(error)
            fetches.cancel_scope.cancel()

    async def give_up_silent() -> None:
        await anyio.sleep(SILENT_TIME)
        if any(each.round_trip is not None for each in components.values()):
            for address, each in components.items():
                if each.round_trip is None and each.count is None:
                    scopes[address].cancel()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(give_up_silent)
        async with anyio.create_task_group() as fetches:
            for address, component in components.items():
                fetches.start_soon(fetch, address, component)
        tasks.cancel_scope.cancel()
    if failures:
        raise failures[0]
    if silent and not results:
        raise next(iter(silent.values()))
    return FetchedAll(results, silent)
