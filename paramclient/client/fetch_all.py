"""Parallel fetches of several components: participants, timeouts, results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, TypeAlias

import anyio
import anyio.lowlevel

from paramclient.client.arguments import PROGRESS_CALL_INTERVAL
from paramclient.client.component import Component
from paramclient.client.component_core import TIMEOUT_NOTE
from paramclient.client.core import ClientCore
from paramclient.errors import CacheError, ContestedAddress, NoReply
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.no_reply_hint import hint_of_component, hint_of_link
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.station import Address, Peer

__all__ = ["FleetFetch", "FetchedAll"]

SILENT_TIMEOUT: Final = 1.0
"""Minimum timeout in seconds for a component without any response, once another fetch has ended."""
SILENT_TIMEOUT_FACTOR: Final = 4.0
"""The same timeout as a multiple of the longest response time of another component. If one process simulates
all vehicles, or this process serves many links, responses may arrive seconds later than from a single
vehicle."""

STARTED_FETCHES_MAX: Final = 32
"""Fetches started in one iteration of the event loop: 32 take 2 ms."""
ENDED_FETCHES_MAX: Final = 64
"""Fetches ended, or results collected, in one iteration of the event loop: 64 take 3 ms."""


Failure: TypeAlias = NoReply | CacheError | ContestedAddress
"""The error of one component."""


@dataclass(frozen=True, slots=True)
class FetchedAll:
    """Result of a fetch of several components.

    Attributes:
        results: results of the components that responded, by (system, component).
        silent: errors of the other components, by (system, component). NoReply if the component did not
            respond or is lost, CacheError if the policy allows no download and nothing is cached,
            ContestedAddress if several vehicles use its address.
    """

    results: Mapping[Address, FetchResult]
    silent: Mapping[Address, NoReply | CacheError | ContestedAddress]

    @property
    def complete(self) -> bool:
        """Whether `results` has every parameter of every component that responded."""
        return all(result.complete for result in self.results.values())


class FleetFetch:
    """The fetches of all components of one system, or of every system.

    Args:
        client: the running parts of the client.
        components: all components of the link, a live mapping.
        system: id of the system to fetch, or None for every system.
        refresh: as in `Component.fetch_all`.
    """

    def __init__(
        self,
        client: ClientCore,
        components: Mapping[Address, Component],
        system: int | None,
        *,
        refresh: bool,
    ) -> None:
        self._client = client
        self._station = client.station
        self._components = components
        self._system = system
        self._refresh = refresh
        self._fetches: dict[Address, Fetch] = {}
        self._is_cache_awaited = False
        self._unanswered: dict[Address, Fetch] = {}
        self._longest_answer = 0.0
        self._overdue_at: dict[Address, float] = {}  # last time at which heartbeats were overdue

    async def run(
        self,
        *,
        until: float,
        hear_until: float,
        listen_until: float,
        progress: Callable[[Mapping[Address, Progress]], None] | None,
    ) -> FetchedAll:
        """Fetch until `is_worth_waiting` returns False, or until the deadline.

        Cancellation ends the fetches and keeps the received values in the tables.

        Args:
            until: deadline; at this time the partial results are returned.
            hear_until, listen_until: as in `is_worth_waiting`.
            progress: called about ten times a second.

        Raises:
            ParamClientError: as from `outcome`.
        """
        began = anyio.current_time()
        try:
            while True:
                self._client.check_open()
                now = anyio.current_time()
                while self.join(now):
                    self._client.wake()
                    await anyio.lowlevel.checkpoint()
                    self._client.check_open()
                    now = anyio.current_time()
                is_worth_it = self.is_worth_waiting(now, listen_until=listen_until, hear_until=hear_until)
                if now >= until or not is_worth_it:
                    return await self.outcome(now, waited=now - began)
                await self.wait_for_change(min(PROGRESS_CALL_INTERVAL, until - now))
                if progress is not None:
                    progress(self.progress(anyio.current_time()))
        finally:
            with anyio.CancelScope(shield=True):
                await self._end()
            for address in self._fetches:
                machine = self._station.components.get(address)
                if machine is not None:  # the station may have forgotten it since
                    await self._client.wait_until_files_closed(machine)

    def join(self, now: float) -> bool:
        """Start the fetches of components whose cached table is loaded. Return whether any was due.

        It starts at most `STARTED_FETCHES_MAX` fetches, but all components of one vehicle together.
        """
        self._is_cache_awaited = False
        ready: dict[tuple[int, Peer], list[ComponentMachine]] = {}
        for address, component in self._components.items():
            machine = component.core.machine
            if address in self._fetches or not machine.identification.has_parameters:
                continue
            if self._system not in (None, machine.system) or (machine.presence.is_lost and not machine.fetch):
                continue
            if machine.peers.contest is not None:
                continue
            if self._refresh or component.core.is_cache_due(now):
                ready.setdefault(machine.vehicle, []).append(machine)
            else:
                self._is_cache_awaited = True
        count = 0
        for machines in ready.values():
            if count >= STARTED_FETCHES_MAX:
                break
            count += len(machines)
            begun = self._station.begin_fetches(machines, now, refresh=self._refresh)
            for machine, fetch in zip(machines, begun, strict=True):
                address = machine.address
                self._fetches[address] = self._unanswered[address] = fetch
        return bool(ready)

    def is_worth_waiting(self, now: float, *, listen_until: float, hear_until: float) -> bool:
        """Return whether further results may arrive.

        Args:
            now: time of the event loop.
            listen_until: time until which further components may appear.
            hear_until: time until which to wait for the first component.
        """
        if now < listen_until or self._is_cache_awaited:
            return True
        if not self._fetches:
            return now < hear_until
        for address, fetch in list(self._unanswered.items()):
            self._look(address, fetch, now)
        timeout = math.inf
        if any(fetch.result is not None for fetch in self._fetches.values()):
            timeout = max(SILENT_TIMEOUT, SILENT_TIMEOUT_FACTOR * self._longest_answer)
        return any(
            not fetch.done and (not fetch.is_silent or not self._is_mute(address, fetch, now, timeout))
            for address, fetch in self._fetches.items()
        )

    async def wait_for_change(self, seconds: float) -> None:
        """Wait until a fetch ends, for at most this many seconds."""
        ended = anyio.Event()
        under_way = [fetch for fetch in self._fetches.values() if not fetch.done]
        for fetch in under_way:
            fetch.on_done.append(ended.set)
        try:
            with anyio.move_on_after(seconds):
                await ended.wait()
        finally:
            for fetch in under_way:
                with suppress(ValueError):
                    fetch.on_done.remove(ended.set)

    def progress(self, now: float) -> dict[Address, Progress]:
        """Return the progress of each fetch, by (system, component)."""
        return {address: fetch.progress(now) for address, fetch in self._fetches.items()}

    async def outcome(self, now: float, *, waited: float) -> FetchedAll:
        """Return the results so far, partial ones for fetches that have not ended.

        Args:
            now: time of the event loop.
            waited: seconds since the start, for NoReply.

        Raises:
            NoReply: no component responded.
            CacheError, ContestedAddress: there is no result, and a component ended with this error.
            LinkError: the link failed, or the client was closed.
        """
        results: dict[Address, FetchResult] = {}
        silent: dict[Address, Failure] = {}
        for number, (address, fetch) in enumerate(self._fetches.items(), 1):
            if not number % ENDED_FETCHES_MAX:
                await anyio.lowlevel.checkpoint()
            try:
                if fetch.error is not None:
                    raise fetch.error
                results[address] = fetch.result or fetch.partial(now, TIMEOUT_NOTE)
            except (NoReply, CacheError, ContestedAddress) as error:
                # a traceback refers to this call, and thus to the error: a cycle
                silent[address] = self._explained(error.with_traceback(None), address, now)
        for address, component in self._components.items():
            is_selected = self._system in (None, address[0])
            contest = component.core.machine.peers.contest
            if is_selected and address not in self._fetches and contest is not None:
                silent[address] = contest.error
            elif is_selected and address not in self._fetches and component.core.machine.presence.is_lost:
                what = f"the parameters of {address[0]}/{address[1]} (lost)"
                silent[address] = NoReply(what, attempts=0, waited=component.silence)
        if not results:
            attempts = 0
            for failure in silent.values():
                if not isinstance(failure, NoReply):
                    raise failure
                attempts = max(attempts, failure.attempts)
            whose = "any component" if self._system is None else f"any component of system {self._system}"
            hint = hint_of_link(self._station, self._station.link)
            raise NoReply(f"the parameters of {whose}", attempts=attempts, waited=waited, hint=hint)
        return FetchedAll(results, silent)

    def _explained(self, error: Failure, address: Address, now: float) -> Failure:
        """Return an error; a NoReply with what was received instead."""
        machine = self._station.components.get(address)
        if not isinstance(error, NoReply) or machine is None:
            return error
        fetch = self._fetches.get(address)
        since = -math.inf if fetch is None else fetch.begun_at
        return error.with_hint(hint_of_component(self._station, machine, since, now))

    async def _end(self) -> None:
        """Release all fetches, the last ones first, so that no waiting fetch starts when another one ends."""
        for number, (address, fetch) in enumerate(reversed(self._fetches.items()), 1):
            machine = self._station.components.get(address)
            if machine is not None:  # the station may have forgotten it since
                machine.end_fetch(fetch, anyio.current_time())
            if not number % ENDED_FETCHES_MAX:
                self._client.wake()
                await anyio.lowlevel.checkpoint()
        self._client.wake()  # requests of other operations may have waited for these fetches

    def _look(self, address: Address, fetch: Fetch, now: float) -> None:
        """Record the response time of a component, or the time at which its heartbeats were overdue."""
        presence = self._station.components[address].presence
        answered_at = fetch.first_value_at
        if fetch.result is not None and fetch.result.source == "cache":
            answered_at = fetch.ended_at
        if fetch.done or answered_at < math.inf:
            del self._unanswered[address]
            if answered_at < math.inf:
                took = answered_at - fetch.begun_at - fetch.queue_wait(now)
                self._longest_answer = max(self._longest_answer, took)
        elif presence.is_overdue(now):
            self._overdue_at[address] = now

    def _is_mute(self, address: Address, fetch: Fetch, now: float, timeout: float) -> bool:
        """Return whether a component sends messages, but no response to its fetch for this many seconds."""
        presence = self._station.components[address].presence
        since = max(fetch.begun_at + fetch.queue_wait(now), self._overdue_at.get(address, -math.inf))
        is_present = presence.received_at >= since or presence.is_lost or not presence.has_beaten
        return is_present and now - since >= timeout
