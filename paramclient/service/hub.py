"""The hub: the links of the service, the parameters of the components on them, and the cache."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Concatenate, Final, TypeAlias, TypeVar

import anyio
import anyio.abc
import anyio.to_thread

from paramclient.cache import ParamCache
from paramclient.cli.json_output import ParamJson, VehicleJson, as_json
from paramclient.client.cache_writer import choose_cache
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.events import Discovered, Event, Found, Rebooted, Resynced
from paramclient.errors import LinkError, ParamClientError, UsageError
from paramclient.links import Link, create_link
from paramclient.metadata import Metadata, MetadataStore, ParamInfo, metadata_of
from paramclient.model.identity import Identity
from paramclient.model.notation import hash_text, rounded
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param
from paramclient.protocol.events import Change
from paramclient.protocol.fetch import FetchResult, Progress
from paramclient.protocol.identity import expects_extended
from paramclient.protocol.watch import SyncState
from paramclient.provision.inspection import wait_for_identity
from paramclient.service.event_feed import EventFeed
from paramclient.service.gateway import Gateway
from paramclient.service.problems import ServiceError
from paramclient.service.stations import MavlinkEndpoint, parse_endpoint

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

__all__ = ["Hub", "ServiceLink", "Target"]

CHECK_INTERVAL: Final = 0.2
"""Seconds between two checks for changes of states, among them the progress of a fetch."""
CHANGING_MEMBERS: Final = ("silence_s", "round_trip_s", "params")
"""Members of a vehicle that change all the time: they cause no event."""
REOPEN_DELAYS: Final = (0.25, 0.5, 1.0, 2.0, 5.0)
"""Seconds before each attempt to reopen a failed link; the last one repeats."""

REFETCH_DELAYS: Final = (5.0, 15.0, 60.0)
"""Seconds before each further fetch of a table that is not complete: some components have no parameters."""

Result = TypeVar("Result")
LinkChoice: TypeAlias = "str | Link | Endpoint"

logger = logging.getLogger(__name__)


@dataclass(eq=False)
class Target:
    """The plain or the extended parameters of one component on a link.

    Attributes:
        link: its link.
        component: the component.
        applying: held by the running apply or restore of plain or extended parameters.
        metadata: the metadata of its parameters, or None: extended ones have none.
        described: the identity to which `metadata` belongs.
        progress: the progress of a running fetch, or None.
        fetches: number of ended fetches: a page loads the table again when it has changed.
        published: the last published state.
    """

    link: ServiceLink
    component: Component
    applying: anyio.Lock
    metadata: Metadata | None = None
    described: Identity | None = None
    progress: Progress | None = None
    fetches: int = 0
    published: object = None

    @property
    def address(self) -> dict[str, Any]:
        """The members that name it in an event."""
        each = self.component
        ids = {"system": each.system, "component": each.component, "extended": each.is_extended}
        return {"link": self.link.name, **ids}

    @property
    def is_listed(self) -> bool:
        """Whether it is in lists: extended parameters are if there are some, or usually."""
        component = self.component
        is_usual = expects_extended(component.identity.vehicle_type, component.component)
        return not component.is_extended or is_usual or bool(component.params)

    def info(self, name: str) -> ParamInfo | None:
        """Return the metadata of a parameter, or None."""
        return None if self.metadata is None else self.metadata.find(name)

    @property
    def state(self) -> dict[str, Any]:
        """The state of the parameters, as JSON.

        `params` is the number of known parameters, `count` the number that the component announces, `fetch`
        the progress of a running fetch, `fetches` the number of ended ones.
        """
        component, now = self.component, self.progress
        return {
            **self.address,
            **as_json(VehicleJson.of(component)),
            "link_state": self.link.state,
            "encoding": component.encoding.value,
            "count": component.count,
            "params": len(component.params),
            "hash": hash_text(component.hash),
            "state": component.state,
            "sync_state": component.sync_state.value,
            "is_armed": component.is_armed,
            "is_lost": component.sync_state == "lost",
            "silence_s": round(component.silence, 3),
            "round_trip_s": rounded(component.round_trip),
            "fetch": None if now is None else {**asdict(now), "rate": round(now.rate, 1)},
            "fetches": self.fetches,
            "has_metadata": self.metadata is not None,
        }

    def change(self, found: Change) -> dict[str, Any]:
        """Return the members of an event about a changed, added or removed parameter."""

        def shown(each: Param | None) -> dict[str, Any] | None:
            return None if each is None else as_json(ParamJson.of_table(each, self.info(each.name)))

        old, new = shown(found.old), shown(found.new)
        return {"name": found.name, "old": old, "new": new, "by": found.by, "kind": found.kind}


@dataclass(eq=False)
class ServiceLink:
    """One link: `opening`, `open`, `failed` (opened again after a delay) or `ended` (of a log).

    Attributes:
        name: its name in the service.
        make: creates a client for it.
        state: its state.
        error: the reason of `failed`, or None.
        client: the open client, or None.
        targets: the parameters on it, by system and component id, and whether they are extended.
    """

    name: str
    make: Callable[[], ParamClient]
    state: str = "opening"
    error: str | None = None
    client: ParamClient | None = None
    targets: dict[tuple[int, int, bool], Target] = field(default_factory=dict)


class Hub:
    """All links with one cache, as an async context manager.

    A link does not have to exist at the start: it is opened as soon as possible, and again after a failure.

    Args:
        links: links by name, object or simulated vehicle, as for `ParamClient`.
        cache: as for `ParamClient`; shared by all links.
        fetches: whether the table of every component is fetched when it is heard.
        mavlink: endpoints to which ground stations connect, see `parse_endpoint`.
        options: options of each `ParamClient`.

    Attributes:
        cache: the cache, or None.
        feed: the event feed.
        gateway: the ground stations.
        links: the links, by name.
        metadata_store: the metadata files beside the cache; None without a cache.
        started: `time.monotonic()` of the start.

    Raises:
        UsageError: a link, endpoint or option is invalid, or two links have one name.
    """

    def __init__(
        self,
        links: Iterable[LinkChoice],
        *,
        cache: ParamCache | str | os.PathLike[str] | bool | None = None,
        fetches: bool = True,
        mavlink: Iterable[str | MavlinkEndpoint] = (),
        **options: Any,
    ) -> None:
        self.cache = choose_cache(cache, is_log=False)
        self._owns_cache = self.cache is not cache
        self._fetches = fetches
        self.feed = EventFeed()
        self.gateway = Gateway(parse_endpoint(each) if isinstance(each, str) else each for each in mavlink)
        if self.gateway.endpoints and options.get("listen_only"):
            raise UsageError("a client that only listens cannot answer ground stations")
        self.metadata_store = None if self.cache is None else MetadataStore.beside(self.cache.path)
        self.started = time.monotonic()
        self.links: dict[str, ServiceLink] = {}
        self._tasks: anyio.abc.TaskGroup | None = None
        self._cache_thread = anyio.CapacityLimiter(1)
        for link in links:
            name = create_link(link).name
            if name in self.links:
                raise UsageError(f"the link {name} is given twice")
            is_log = isinstance(link, str) and link.startswith("replay:")
            make = partial(self._new_client, link, cache=False if is_log else self.cache or False, **options)
            make()  # an invalid option raises here
            self.links[name] = ServiceLink(name, make)

    def _new_client(self, link: LinkChoice, **options: Any) -> ParamClient:
        client = ParamClient(link, **options)
        if self.gateway.endpoints:
            self.gateway.attach(client)
        return client

    async def __aenter__(self) -> Hub:
        await self.gateway.open()
        self._tasks = await anyio.create_task_group().__aenter__()
        for link in self.links.values():
            self._tasks.start_soon(self._run_link, link)
        self._tasks.start_soon(self.gateway.run)
        self._tasks.start_soon(self._check_regularly)
        return self

    async def __aexit__(self, *error: Any) -> None:
        tasks, self._tasks = self._tasks, None
        assert tasks is not None, "the hub is open"
        self.feed.end()
        tasks.cancel_scope.cancel()
        await tasks.__aexit__(None, None, None)
        if self.cache is not None and self._owns_cache:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(self.cache.close)

    @property
    def targets(self) -> list[Target]:
        """All parameters of components, the lowest ids first."""
        pairs = [pair for link in self.links.values() for pair in link.targets.items() if pair[1].is_listed]
        return [target for _, target in sorted(pairs, key=lambda pair: pair[0])]

    def target(
        self, system: int, component: int, link: str | None = None, *, extended: bool = False
    ) -> Target:
        """Return the parameters of the component with this address.

        Raises:
            ServiceError: the component is unknown, or on several links and none is given.
        """
        key = system, component, extended
        links = [each for each in self.links.values() if link in (None, each.name)]
        found = [each.targets[key] for each in links if key in each.targets]
        if not found:
            detail = f"No message of {system}/{component} was received on {link or 'any link'}."
            raise ServiceError(404, "unknown-vehicle", detail)
        if len(found) > 1:
            names = [each.link.name for each in found]
            detail = f"{system}/{component} is on {' and '.join(names)}. Choose one with ?link=NAME."
            raise ServiceError(409, "ambiguous", detail, links=names)
        return found[0]

    async def fetch(self, target: Target, **options: Any) -> FetchResult:
        """Fetch the parameters of a component; see `Component.fetch_all`. The progress is published."""

        def note(progress: Progress) -> None:
            target.progress = progress

        try:
            result = await target.component.fetch_all(**options, progress=note)
        finally:
            target.progress = None
            target.fetches += 1
            self._check(target)
        await self._load_known_metadata(target)
        return result

    async def load_metadata(self, target: Target, *, timeout: float | None = None) -> None:
        """Load the metadata of a component from the vehicle; see `metadata_of`.

        Raises:
            ServiceError: 404, the vehicle provides none.
        """
        identity = target.component.identity
        found = await metadata_of(target.component, store=self.metadata_store or False, timeout=timeout)
        if found is None:
            detail = "The vehicle provides no metadata. Add a file of its firmware: paramclient metadata add."
            raise ServiceError(404, "no-metadata", detail)
        target.metadata, target.described = found, identity
        self._check(target)

    async def read_cache(
        self,
        call: Callable[Concatenate[ParamCache, str, int, ...], Result],
        target: Target,
        *more: Any,
    ) -> Result:
        """Call a function of the cache, in a thread, with the place of these parameters in it.

        Raises:
            ServiceError: the service has no cache, or ends.
            ParamClientError: the cache cannot be read, or does not have what is requested.
        """
        cache = self.cache
        if cache is None:
            detail = "The service runs without a cache and has no earlier states."
            raise ServiceError(409, "no-cache", detail)
        if self._tasks is None:
            raise ServiceError(503, "closing", "The service is shutting down.")
        component = target.component
        await wait_for_identity(component)
        place = component.identity.key, component.component
        work = partial(call, cache, *place, *more, extended=component.is_extended)
        return await anyio.to_thread.run_sync(work, limiter=self._cache_thread)

    async def state_at(self, target: Target, at: int | datetime) -> ParamSet:
        """Return the parameters of a snapshot, or at a time; see `read_cache`."""
        when = at if isinstance(at, int) else at.timestamp()
        return await self.read_cache(ParamCache.state_at, target, when)

    async def _run_link(self, link: ServiceLink) -> None:
        """Keep a link open until cancelled. At the end of a log, its components stay."""
        attempts = 0
        while True:
            try:
                client = link.make()
                events = client.events()
                async with client, anyio.create_task_group() as tasks:
                    link.client, attempts = client, 0
                    self._set_state(link, "open")
                    async for event in events:
                        self._take(link, event, tasks)
                    self._set_state(link, "ended")
                    await anyio.sleep_forever()
            except* (LinkError, UsageError) as group:  # UsageError: a missing library
                self._set_state(link, "failed", str(_first(group)))
            finally:
                link.client = None
                for target in link.targets.values():
                    self.feed.publish("vehicle", **target.address, vehicle=None)
                link.targets.clear()
            await anyio.sleep(REOPEN_DELAYS[min(attempts, len(REOPEN_DELAYS) - 1)])
            attempts += 1

    def _take(self, link: ServiceLink, event: Event, tasks: anyio.abc.TaskGroup) -> None:
        """Handle an event of a client."""
        component = event.component
        key = component.system, component.component, False
        if key not in link.targets or link.targets[key].component is not component:
            applying = anyio.Lock()
            for each in (component, component.ext):
                target = Target(link, each, applying)
                link.targets[component.system, component.component, each.is_extended] = target
                tasks.start_soon(self._publish_changes, target)
        target = link.targets[key]
        if isinstance(event, Resynced):
            target.fetches += 1
        self._check(target)
        may_fetch = self._fetches and not component.core.station.listens_only
        if may_fetch and isinstance(event, Discovered | Found | Rebooted):
            tasks.start_soon(self._load, target)

    async def _load(self, target: Target) -> None:
        """Fetch the table of a component that was heard, again if that ends without all of it."""
        for delay in (0.0, *REFETCH_DELAYS):
            await anyio.sleep(delay)
            if delay and target.component.sync_state in (SyncState.SYNCED, SyncState.LOST):
                return
            with suppress(ParamClientError):
                await self.fetch(target)

    async def _load_known_metadata(self, target: Target) -> None:
        """Load the metadata of the firmware of a component that this computer has, if any."""
        component, store = target.component, self.metadata_store
        identity = component.identity
        if store is None or target.described == identity or component.is_extended:
            return
        target.metadata = await anyio.to_thread.run_sync(store.known, identity, component.component)
        target.described = identity

    async def _publish_changes(self, target: Target) -> None:
        """Publish the changes of parameters until the client is closed.

        First values are not published: a fetch has thousands, and its end is published.
        """
        with suppress(ParamClientError):
            async for change in target.component.changes():
                if change.kind != "first":
                    self.feed.publish("change", **target.address, **target.change(change))

    async def _check_regularly(self) -> None:
        while True:
            await anyio.sleep(CHECK_INTERVAL)
            for target in self.targets:
                self._check(target)

    def _check(self, target: Target) -> None:
        """Publish the state of a component if it has changed."""
        vehicle = target.state
        state = {**vehicle, **dict.fromkeys(CHANGING_MEMBERS)}
        if target.is_listed and state != target.published:
            target.published = state
            self.feed.publish("vehicle", **target.address, vehicle=vehicle)

    def _set_state(self, link: ServiceLink, state: str, error: str | None = None) -> None:
        if (state, error) == (link.state, link.error):
            return
        level = logging.WARNING if state == "failed" and link.state != "failed" else logging.INFO
        logger.log(level, "%s: %s%s", link.name, state, "" if error is None else f": {error}")
        link.state, link.error = state, error
        self.feed.publish("link", link=link.name, state=state, error=error)


def _first(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """Return the first error of a group."""
    error = group.exceptions[0]
    return _first(error) if isinstance(error, BaseExceptionGroup) else error
