"""The hub: the links of the service, the parameters of the components on them, the cache, and the events."""

from __future__ import annotations

import json
import logging
import os
import secrets
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Concatenate, Final, TypeAlias, TypeVar

import anyio
import anyio.abc
import anyio.to_thread
from fastapi.sse import ServerSentEvent

from paramclient.cache import ParamCache
from paramclient.cli.json_output import JsonObject, info_of, table_param_json, taken, vehicle_json
from paramclient.client.cache_writer import choose_cache
from paramclient.client.client import Event, ParamClient
from paramclient.client.component import Component
from paramclient.errors import ParamClientError, UsageError
from paramclient.links import Link, create_link
from paramclient.metadata import Metadata, MetadataStore, ParamInfo, metadata_of
from paramclient.model.identity import Identity
from paramclient.model.notation import Scalar, hash_text, rounded
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, Value, parse_ext_value
from paramclient.protocol.channel import task_group
from paramclient.protocol.fetch import FetchResult, Progress
from paramclient.protocol.identity import expects_extended
from paramclient.protocol.watch import SyncState
from paramclient.provision.inspection import wait_for_identity
from paramclient.service.gateway import Gateway
from paramclient.service.problems import ServiceError
from paramclient.service.stations import MavlinkEndpoint, parse_endpoint

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

EVENTS_KEPT: Final = 4_096
"""Number of kept events, 0.5 kB each: more than two whole tables."""
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


class EventFeed:
    """The events of one run of the service: numbered, and kept in one ring for all listeners.

    A listener is a position in the ring. A slow listener therefore delays no other and needs no memory of its
    own, and a listener that reconnects continues at its position. When the ring has overwritten the next
    event of a listener, its stream ends: after it has reconnected, it loads everything again.

    Args:
        kept: number of kept events.

    Attributes:
        run: id of the run; numbers of other runs are not comparable.
        seq: number of the newest event.
    """

    def __init__(self, *, kept: int = EVENTS_KEPT) -> None:
        self.run = secrets.token_hex(8)
        self.seq = 0
        self._is_ended = False
        self._texts: deque[str] = deque(maxlen=kept)
        self._arrived = anyio.Event()

    @property
    def position(self) -> dict[str, Any]:
        """The members of a document that includes the effects of all events so far."""
        return {"run": self.run, "seq": self.seq}

    def publish(self, kind: str, /, **members: Any) -> None:
        """Add an event.

        Args:
            kind: its `type`.
            members: further members, as JSON.
        """
        self.seq += 1
        event = {**self.position, "at": round(time.time(), 3), "type": kind, **members}
        self._texts.append(json.dumps(event, allow_nan=False, separators=(",", ":")))
        self._wake()

    def end(self) -> None:
        """End all streams after the events so far."""
        self._is_ended = True
        self._wake()

    async def follow(self, last_id: str | None = None) -> AsyncIterator[ServerSentEvent]:
        """Yield `hello`, then all events after the one with this id, or after now.

        Ends with the feed, or when the listener was too slow and its next event is lost.
        """
        run, _, seq = (last_id or "").partition("-")
        resumed = run == self.run and seq.isascii() and seq.isdecimal() and self._has_after(int(seq))
        position = int(seq) if resumed else self.seq
        hello = {"run": self.run, "seq": position, "type": "hello", "resumed": resumed}
        yield ServerSentEvent(raw_data=json.dumps(hello), id=f"{self.run}-{position}")
        while self._has_after(position):
            if position < self.seq:
                text = self._texts[position - self.seq]
                position += 1
                yield ServerSentEvent(raw_data=text, id=f"{self.run}-{position}")
            elif self._is_ended:
                return
            else:
                await self._arrived.wait()

    def _has_after(self, position: int) -> bool:
        """Return whether the event after this position, if there is one, is still kept."""
        return self.seq - len(self._texts) <= position <= self.seq

    def _wake(self) -> None:
        arrived, self._arrived = self._arrived, anyio.Event()
        arrived.set()


@dataclass(eq=False)
class Target:
    """The plain or the extended parameters of one component on a link.

    Attributes:
        hub: the hub.
        link: its link.
        component: the component.
        applying: held by the running apply or restore of plain or extended parameters.
        metadata: the metadata of its parameters, or None: extended ones have none.
        described: the identity to which `metadata` belongs.
        progress: the progress of a running fetch, or None.
        fetches: number of ended fetches: a page loads the table again when it has changed.
        published: the last published state.
    """

    hub: Hub
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
        ids = taken(self.component, "system", "component")
        return {"link": self.link.name, **ids, "extended": self.component.is_extended}

    @property
    def is_listed(self) -> bool:
        """Whether it is in lists: extended parameters are if there are some, or usually."""
        each = self.component
        is_found = not each.is_extended or bool(each.params)
        return is_found or expects_extended(each.identity.vehicle_type, each.component)

    @property
    def state(self) -> dict[str, Any]:
        """The state of the parameters, as JSON.

        `params` is the number of known parameters, `count` the number that the component announces, `fetch`
        the progress of a running fetch, `fetches` the number of ended ones.
        """
        component, now = self.component, self.progress
        return {
            **self.address,
            **vehicle_json(component),
            "link_state": self.link.state,
            **taken(component, "encoding", "count", "state", "is_armed"),
            "params": len(component.params),
            "hash": hash_text(component.hash),
            "silence_s": round(component.silence, 3),
            "round_trip_s": rounded(component.round_trip),
            "fetch": None if now is None else {**asdict(now), "rate": round(now.rate, 1)},
            "fetches": self.fetches,
            "has_metadata": self.metadata is not None,
        }

    def publish(self, kind: str, /, **members: Any) -> None:
        """Publish an event about the component."""
        self.hub.feed.publish(kind, **self.address, **members)

    def check(self) -> None:
        """Publish the state if it has changed."""
        vehicle = self.state
        state = {**vehicle, **dict.fromkeys(CHANGING_MEMBERS)}
        if self.is_listed and state != self.published:
            self.published = state
            self.publish("vehicle", vehicle=vehicle)

    async def publish_changes(self) -> None:
        """Publish the changes of parameters until the client is closed.

        First values are not published: a fetch has thousands, and its end is published.
        """
        with suppress(ParamClientError):
            async for found in self.component.changes():
                if found.kind != "first":
                    old, new = (each and self.shown(each) for each in (found.old, found.new))
                    self.publish("change", name=found.name, old=old, new=new, by=found.by, kind=found.kind)

    # fetches and metadata

    async def fetch(self, **options: Any) -> FetchResult:
        """Fetch the parameters; see `Component.fetch_all`. The progress is published."""
        try:
            result = await self.component.fetch_all(**options, progress=partial(setattr, self, "progress"))
        finally:
            self.progress = None
            self.fetches += 1
            self.check()
        await self._describe()
        return result

    async def _describe(self) -> None:
        """Load the metadata of this firmware, where the service has it."""
        store, identity = self.hub.metadata_store, self.component.identity
        if store is not None and self.described != identity and not self.component.is_extended:
            self.metadata = await anyio.to_thread.run_sync(store.known, identity, self.component.component)
            self.described = identity

    async def fetch_complete(self) -> None:
        """Fetch the table of a component that was heard, again if that ends without all of it."""
        for delay in (0.0, *REFETCH_DELAYS):
            await anyio.sleep(delay)
            if delay and self.component.sync_state in (SyncState.SYNCED, SyncState.LOST):
                return
            with suppress(ParamClientError):
                await self.fetch()

    async def load_metadata(self, *, timeout: float | None = None) -> None:
        """Load the metadata from the vehicle; see `metadata_of`.

        Raises:
            ServiceError: 404, the vehicle provides none.
        """
        identity, store = self.component.identity, self.hub.metadata_store
        if (found := await metadata_of(self.component, store=store or False, timeout=timeout)) is None:
            detail = "The vehicle provides no metadata. Add a file of its firmware: paramclient metadata add."
            raise ServiceError(404, "no-metadata", detail)
        self.metadata, self.described = found, identity
        self.check()

    # values

    def shown(self, param: Param, *, whole: bool = False) -> JsonObject:
        """Return a parameter of the table as JSON; with `whole`, with all its metadata."""
        return table_param_json(param, info_of(self.metadata, param.name), whole=whole)

    async def values(self, given: Mapping[str, Scalar], *, force: bool = True) -> dict[str, Value]:
        """Return the values of a request; with `force`, they may be outside the range in the metadata.

        Text for a number is the number: JavaScript rounds 64-bit integers.

        Raises:
            UsageError: no value has this name.
            ServiceError: 422, values are out of range.
            ParamClientError: the component did not send the type of an extended parameter.
        """
        await wait_for_identity(self.component)
        await self._describe()
        found: dict[str, Value] = {}
        faults: dict[str, str] = {}
        for name, each in given.items():
            info = info_of(self.metadata, name) or ParamInfo(name)
            if isinstance(each, str) and self.component.is_extended:
                known = self.component.params.get(name) or await self.component.get(name)
                found[name] = parse_ext_value(name, each, known.type)
            else:
                found[name] = info.parse(each) if isinstance(each, str) else each
            if not force and (fault := info.problem(found[name])):
                faults[name] = fault
        if faults:
            detail = f"{'; '.join(list(faults.values())[:5])}. Nothing was written; `force` writes it anyway."
            raise ServiceError(422, "out-of-range", detail, names=list(faults))
        return found

    # the cache

    async def cached(
        self, call: Callable[Concatenate[ParamCache, str, int, ...], Result], *more: Any
    ) -> Result:
        """Call a function of the cache, in a thread, with the place of these parameters in it.

        Raises:
            ServiceError: the service has no cache.
            ParamClientError: the cache cannot be read, or does not have what is requested.
        """
        component, cache = self.component, self.hub.cache
        if cache is None:
            raise ServiceError(409, "no-cache", "The service runs without a cache: it has no earlier states.")
        await wait_for_identity(component)
        place = component.identity.key, component.component
        work = partial(call, cache, *place, *more, extended=component.is_extended)
        return await anyio.to_thread.run_sync(work, limiter=self.hub.cache_thread)

    async def state_at(self, at: int | datetime) -> ParamSet:
        """Return the parameters of a snapshot, or at a time; see `cached`."""
        return await self.cached(ParamCache.state_at, at if isinstance(at, int) else at.timestamp())


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
        cache_thread: limits the work on the cache to one thread.
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
        self.cache_thread = anyio.CapacityLimiter(1)
        for link in links:
            name = create_link(link).name
            if name in self.links:
                raise UsageError(f"the link {name} is given twice")
            is_log = isinstance(link, str) and link.startswith("replay:")
            make = partial(ParamClient, link, cache=False if is_log else self.cache or False, **options)
            make()  # an invalid option raises here
            self.links[name] = ServiceLink(name, make)

    async def __aenter__(self) -> Hub:
        await self.gateway.open()
        self._tasks = await anyio.create_task_group().__aenter__()
        for link in self.links.values():
            self._tasks.start_soon(self._run_link, link)
        self._tasks.start_soon(self.gateway.run)
        self._tasks.start_soon(self._check_regularly)
        return self

    async def __aexit__(self, *error: Any) -> None:
        self.feed.end()
        self._tasks.cancel_scope.cancel()
        await self._tasks.__aexit__(None, None, None)
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

    async def _run_link(self, link: ServiceLink) -> None:
        """Keep a link open until cancelled. At the end of a log, its components stay."""
        attempts = 0
        while True:
            try:
                client = self.gateway.attach(link.make())
                events = client.events()
                async with client, task_group() as tasks:
                    link.client, attempts = client, 0
                    self._set_state(link, "open")
                    async for event in events:
                        self._take(link, event, tasks)
                    self._set_state(link, "ended")
                    await anyio.sleep_forever()
            except Exception as error:
                if not isinstance(error, ParamClientError):
                    logger.exception("%s: an error of the program, which ends no other link", link.name)
                self._set_state(link, "failed", str(error))
            finally:
                link.client = None
                for target in link.targets.values():
                    target.publish("vehicle", vehicle=None)
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
                target = Target(self, link, each, applying)
                link.targets[component.system, component.component, each.is_extended] = target
                tasks.start_soon(target.publish_changes)
        target = link.targets[key]
        if event.kind == "resynced":
            target.fetches += 1
        target.check()
        may_fetch = self._fetches and not component.core.station.listens_only
        if may_fetch and event.kind in ("discovered", "found", "rebooted"):
            tasks.start_soon(target.fetch_complete)

    async def _check_regularly(self) -> None:
        while True:
            await anyio.sleep(CHECK_INTERVAL)
            for target in self.targets:
                target.check()

    def _set_state(self, link: ServiceLink, state: str, error: str | None = None) -> None:
        if (state, error) == (link.state, link.error):
            return
        level = logging.WARNING if state == "failed" and link.state != "failed" else logging.INFO
        logger.log(level, "%s: %s%s", link.name, state, "" if error is None else f": {error}")
        link.state, link.error = state, error
        self.feed.publish("link", link=link.name, state=state, error=error)
