"""Fetches of several components at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import anyio

from paramclient.client.component import Component
from paramclient.errors import CacheError, NoReply, ParamClientError
from paramclient.protocol.addresses import Address
from paramclient.protocol.fetch import FetchResult, Progress

__all__ = ["FetchedAll", "fetch_components"]


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
    components: Mapping[Address, Component],
    *,
    refresh: bool,
    timeout: float | None,
    progress: Callable[[Mapping[Address, Progress]], None] | None,
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
    states: dict[Address, Progress] = {}

    def report(address: Address, state: Progress) -> None:
        states[address] = state
        if progress is not None:
            progress(dict(states))

    async def fetch(address: Address, component: Component) -> None:
        try:
            results[address] = await component.fetch_all(
                refresh=refresh, timeout=timeout, progress=partial(report, address)
            )
        except (NoReply, CacheError) as error:
            silent[address] = error
        except ParamClientError as error:
            failures.append(error)
            tasks.cancel_scope.cancel()

    async with anyio.create_task_group() as tasks:
        for address, component in components.items():
            tasks.start_soon(fetch, address, component)
    if failures:
        raise failures[0]
    if silent and not results:
        raise next(iter(silent.values()))
    return FetchedAll(results, silent)
