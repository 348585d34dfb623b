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

SILENT_TIME: Final = 2.95
"""Seconds from the begin for a component that has never answered a request, where another one on the link
answers: it costs no more than 3 s."""


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
    components: Mapping[Address, Component], began: float, *, refresh: bool, timeout: float | None
) -> FetchedAll:
    """Fetch the tables of components in parallel; see `ParamClient.fetch_all`, which began at `began`.

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
            with component.limited(None, f"the parameters of {component.node.channel}") as scopes[address]:
                results[address] = await component.fetch_all(refresh=refresh, timeout=timeout)
        except (NoReply, CacheError) as error:
            silent[address] = error
        except ParamClientError as error:
            failures.append(error)
            fetches.cancel_scope.cancel()

    async def give_up_silent() -> None:
        await anyio.sleep_until(began + SILENT_TIME)
        has_answered = {at: each.node.channel.answered.is_set() for at, each in components.items()}
        if any(has_answered.values()):
            for address, each in components.items():
                if not has_answered[address] and each.count is None:
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
