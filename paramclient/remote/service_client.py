"""ServiceClient: the implementation of `ParamClient` over a service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Final, NoReturn

import anyio
import anyio.abc
import httpx

from paramclient.cache import ParamCache
from paramclient.client.arguments import COMPONENT_TIMEOUT, address_in_words
from paramclient.client.component import Component
from paramclient.client.events import Events
from paramclient.client.fetch_all import FetchedAll
from paramclient.client.files import Ftp
from paramclient.client.local import not_given
from paramclient.client.stats import ClientStats
from paramclient.client.vehicle_search import find_autopilots
from paramclient.errors import (
    CacheError,
    ClientClosed,
    ContestedAddress,
    LinkError,
    NoReply,
    ParamClientError,
    UsageError,
)
from paramclient.links import Link
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.wire import AUTOPILOT_COMPONENT
from paramclient.remote.component import mirrored_of
from paramclient.remote.connection import run_with_progress
from paramclient.remote.decoding import Document, decode_errors, fetch_result_of, stats_of
from paramclient.remote.http import Requests, ServiceResponse, ServiceUnreachable
from paramclient.remote.link import ServiceLink
from paramclient.remote.mirrored_component import Key, MirroredComponent, key_of
from paramclient.remote.problems import error_of
from paramclient.remote.roster import ServiceComponents
from paramclient.remote.service_address import ServiceAddress, chosen_token

__all__ = ["ServiceClient"]

OPENING_TIMEOUT: Final = 10.0
"""Timeout in seconds for connecting to a service and loading its lists."""
STATS_INTERVAL: Final = 0.5
"""Minimum seconds between two requests for the counters of the links, however often they are read."""


class ServiceClient:
    """A client with the links and the cache of a service. See `RemoteClient` for the differences.

    Args:
        link: as in `RemoteClient`.
        token: as in `RemoteClient`.
        transport: as in `RemoteClient`.

    Attributes:
        cache: None; the service has the cache.

    Raises:
        UsageError: the address or the token is not valid.
    """

    def __init__(
        self, link: str, *, token: str | None = None, transport: httpx.AsyncBaseTransport | None = None
    ) -> None:
        address = ServiceAddress.read(link)
        self.cache: ParamCache | None = None
        self._service = ServiceLink(address.name)
        self._chosen = address.link
        self._requests = Requests(address, chosen_token(token), transport)
        self._roster = ServiceComponents(self._requests, address.link)
        self._connection = self._roster.connection
        self._subscriptions = self._roster.subscriptions
        self._tasks: anyio.abc.TaskGroup | None = None
        self._is_entered = False
        self._links: list[Document] = []

    # state

    @property
    def components(self) -> Mapping[Address, Component]:
        """See `ParamClient.components`; without components whose ids are on several links."""
        return MappingProxyType({at: each.component for at, each in self._unambiguous().items()})

    @property
    def autopilots(self) -> list[Component]:
        """See `ParamClient.autopilots`."""
        return _autopilots(self._unambiguous().values())

    @property
    def autopilots_on_links(self) -> list[Component]:
        """The autopilots of every link, also those with equal ids on several links."""
        return _autopilots(self._roster.components.values())

    def _unambiguous(self) -> dict[Address, MirroredComponent]:
        """Return the components whose ids are on one link only."""
        keys: dict[Address, list[Key]] = {}
        for key in self._roster.components:
            keys.setdefault(key[1:], []).append(key)
        return {at: self._roster.components[several[0]] for at, several in keys.items() if len(several) == 1}

    @property
    def link(self) -> Link:
        """The address of the service, as a link object without data."""
        return self._service

    @property
    def listens_only(self) -> bool:
        """Whether the service sends nothing on any of its links."""
        return bool(self._links) and all(each["listens_only"] for each in self._links)

    @property
    def bytes_received(self) -> int:
        """As in `stats`."""
        return self.stats.bytes_received

    @property
    def bytes_sent(self) -> int:
        """As in `stats`."""
        return self.stats.bytes_sent

    @property
    def stats(self) -> ClientStats:
        """Counters of the links of the service at the last request. An access triggers a new request."""
        self._roster.are_links_stale.set()
        return stats_of([each["stats"] for each in self._links if each["stats"] is not None])

    def __repr__(self) -> str:
        connection = self._connection
        state = "closed" if self._tasks is None or connection.ended is not None else "open"
        if state == "open" and connection.is_offline:
            state = "reconnecting"
        count = len(self._roster.components)
        return f"<RemoteClient {self._service.name} {state}, {count} component{'' if count == 1 else 's'}>"

    # opening and closing

    async def open(self) -> None:
        """Connect to the service, and load its links and components.

        Raises:
            UsageError, LinkError: as from entering a `RemoteClient`.
        """
        if self._is_entered:
            raise UsageError("a ParamClient can be opened only once; create a new one")
        self._is_entered = True
        await self._requests.open()
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        try:
            tasks.start_soon(self._connection.follow, name="paramclient follower of a service")
            with anyio.fail_after(OPENING_TIMEOUT):
                await self._connection.reached()
                await self._load_links()
                await self._learn_who_we_are()
                await self._roster.load_list()
            tasks.start_soon(self._roster.run, name="paramclient loader")
            tasks.start_soon(self._load_stats_when_needed, name="paramclient statistics")
        except BaseException as error:
            await self._leave(tasks)
            if isinstance(error, ServiceUnreachable):
                raise error.error from error.error.__cause__
            if isinstance(error, TimeoutError) and not isinstance(error, ParamClientError):
                name = self._service.name
                raise LinkError(f"{name}: the service does not respond", link=name) from None
            raise
        self._tasks = tasks

    async def close(self, *, failed: bool) -> None:
        """End waiting calls and streams, and close the connections.

        Args:
            failed: whether the body of the `async with` has raised; it makes no difference.
        """
        tasks = self._tasks
        assert tasks is not None
        closed = ClientClosed("the client was closed", link=self._service.name)
        self._connection.end(closed)
        for mirrored in self._roster.components.values():
            mirrored.end(closed)
        for events in list(self._subscriptions):
            events.end(closed)
        await self._leave(tasks)

    async def _leave(self, tasks: anyio.abc.TaskGroup) -> None:
        """End the tasks and the connections, also when cancelled."""
        tasks.cancel_scope.cancel()
        try:
            # without the caller's exception, which the task group would wrap in an ExceptionGroup
            await tasks.__aexit__(None, None, None)
        finally:
            with anyio.CancelScope(shield=True):
                await self._requests.close()

    # calls

    def events(self) -> Events:
        """See `ParamClient.events`. When an event is delivered, `params` includes its effect."""
        events = Events()
        self._subscriptions.add(events)
        if self._connection.ended is not None:
            events.end(self._connection.ended)
        return events

    def ftp(self, component: Component) -> Ftp:
        """Raise UsageError: MAVFTP needs the link itself."""
        raise not_given("files over MAVFTP")

    async def component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """See `ParamClient.component`. The call also waits for links that the service cannot open yet.

        Raises:
            UsageError: the component is on several links, and the address of the service names no link; or a
                peer is given.
            NoReply, LinkError: as in `ParamClient.component`.
        """
        return await self._find(system, component, peer, timeout)

    async def find_autopilots(
        self, *, expect: int | None = None, timeout: float | None = COMPONENT_TIMEOUT
    ) -> list[Component]:
        """See `ParamClient.find_autopilots`, for the vehicles on all links or on the link in the address.

        Raises:
            UsageError: autopilots on several links have equal ids, and the address of the service names no
                link.
            NoReply, LinkError: as in `ParamClient.find_autopilots`.
        """
        found = await find_autopilots(self, expect=expect, timeout=timeout)
        for each in found:
            self._check_one_link(mirrored_of(each))
        return found

    def _check_one_link(self, found: MirroredComponent) -> None:
        """Check that the ids of a component are on one link only.

        Raises:
            UsageError: they are not.
        """
        if len(same := self._roster.same_ids(found)) > 1:
            links = " and ".join(each.link_name for each in same)
            ids = f"{found.key[1]}/{found.key[2]}"
            raise UsageError(f"{ids} is on {links} of the service; choose one with http://…?link=NAME")

    async def only_component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """See `ParamClient.only_component`, for the vehicles on all links or on the link in the address.

        Raises:
            AmbiguousVehicle: as in `ParamClient.only_component`.
            UsageError, NoReply, LinkError: as in `component`.
        """
        return await self._find(system, component, peer, timeout, only=True)

    async def _find(
        self, system: int | None, component: int | None, peer: str | None, timeout: float | None, **how: bool
    ) -> Component:
        """Return the component that the service finds; `how` has further members of the request."""
        if peer is not None:
            raise UsageError(
                "peer is only for a client with its own link; a service does not distinguish peers"
            )
        began = anyio.current_time()
        answer = await self._connection.ask(
            "POST",
            "/find",
            {"system": system, "component": component, **how},
            awaited=address_in_words(system, component),
            timeout=timeout,
            waits_for_ever=True,
            link=self._chosen,
        )
        left = None if timeout is None else began + timeout - anyio.current_time()
        found = await self._roster.mirror_for(answer, left)
        self._check_one_link(found)
        return found.component

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = COMPONENT_TIMEOUT
    ) -> Component:
        """See `ParamClient.successor`."""
        mirrored = mirrored_of(component)
        awaited = f"{component.system}/{component.component} as system {system}"
        answer = await self._roster.ask(
            mirrored, "successor", {"system": system}, timeout, awaited, waits_for_ever=True
        )
        return await self._roster.component_of_response(answer)

    async def fetch_all(
        self,
        system: int | None = None,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Mapping[Address, Progress]], None] | None = None,
    ) -> FetchedAll:
        """See `ParamClient.fetch_all`. If two links have equal ids, the result has one of them."""
        began = anyio.current_time()
        before = {key: each.progress.count for key, each in self._roster.components.items()}

        def report() -> None:
            components = self._roster.components.items()
            assert progress is not None
            progress({key[1:]: each.progress.since(before.get(key, 0)) for key, each in components})

        async def fetch() -> ServiceResponse:
            whose = "any component" if system is None else f"any component of system {system}"
            answer = await self._connection.ask(
                "POST",
                "/fetch",
                {"refresh": refresh} | ({} if system is None else {"system": system}),
                awaited=f"the parameters of {whose}",
                timeout=timeout,
                link=self._chosen,
            )
            with decode_errors(self._service.name):
                ended = [
                    (key_of(each), each["received"], each["count"]) for each in answer.document["results"]
                ]
            for key, received, count in ended:
                mirrored = self._roster.components.get(key)
                await self._roster.until_current(mirrored, answer.place)
                if mirrored is not None:
                    mirrored.progress.end(received, count)
            await self._look_at_links()
            return answer

        answer = await run_with_progress(fetch, None if progress is None else report)
        elapsed = anyio.current_time() - began
        with decode_errors(self._service.name):
            known = self._roster.components
            results = {
                key[1:]: fetch_result_of(each, known[key].component.params, elapsed)
                for each in answer.document["results"]
                if (key := key_of(each)) in known
            }
            silent: dict[Address, NoReply | CacheError | ContestedAddress] = {}
            for each in answer.document["silent"]:
                problem = each["problem"]
                error = error_of(problem, status=problem["status"], link=self._service.name)
                if isinstance(error, NoReply | CacheError | ContestedAddress):
                    silent[each["system"], each["component"]] = error
        return FetchedAll(results, silent)

    def traffic_report(self) -> NoReturn:
        """Raise UsageError: only the service sees the traffic of its links."""
        raise not_given("a report of the traffic")

    def signing_report(self) -> NoReturn:
        """Raise UsageError: only the service has keys and signatures."""
        raise not_given("a report of signatures")

    async def _learn_who_we_are(self) -> None:
        with suppress(LinkError):  # an older service has no such resource
            answer = await self._requests.ask("GET", "/me")
            with decode_errors(self._service.name):
                self._roster.author = str(answer.document.get("author", ""))

    async def _load_links(self) -> None:
        """Load the links and their counters.

        Raises:
            UsageError: the link in the address does not exist.
        """
        answer = await self._requests.ask("GET", "/links")
        with decode_errors(self._service.name):
            links = [each for each in answer.document["links"] if self._chosen in (None, each["name"])]
            stats_of([each["stats"] for each in links if each["stats"] is not None])
            names = ", ".join(str(each["name"]) for each in answer.document["links"])
        if not links and self._chosen is not None:
            raise UsageError(f"the service has no link {self._chosen}; it has {names or 'none'}")
        self._links = links

    async def _look_at_links(self) -> None:
        """Load the links and their counters, and ignore errors."""
        with suppress(ServiceUnreachable, ParamClientError):
            await self._load_links()

    async def _load_stats_when_needed(self) -> None:
        while True:
            await self._roster.are_links_stale.wait()
            self._roster.are_links_stale = anyio.Event()
            await self._look_at_links()
            await anyio.sleep(STATS_INTERVAL)

    def check_open(self) -> None:
        """Check that requests can be sent.

        Raises:
            LinkError: the service cannot be reached, or the client is not open.
        """
        self._connection.check_open()


def _autopilots(components: Iterable[MirroredComponent]) -> list[Component]:
    """Return the autopilot of each system on each link, component 1 before others, by system id."""
    found: dict[tuple[int, str], MirroredComponent] = {}
    for each in components:
        link, system, number = each.key
        if each.is_autopilot and (number == AUTOPILOT_COMPONENT or (system, link) not in found):
            found[system, link] = each
    return [found[place].component for place in sorted(found)]
