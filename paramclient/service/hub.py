"""The hub: links and cache of the service, and the components on them."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, TypeVar

import anyio
import anyio.abc
import anyio.lowlevel

from paramclient.client.arguments import address_in_words
from paramclient.client.cache_writer import choose_cache
from paramclient.client.client import ParamClient
from paramclient.client.worker_thread import Worker
from paramclient.documents.component import ProgressDoc
from paramclient.documents.extended_results import ExtFetchResultDoc
from paramclient.documents.results import FetchResultDoc
from paramclient.errors import NoReply, ParamClientError, UsageError
from paramclient.links import Link, create_link
from paramclient.metadata.metadata_cache import MetadataStore
from paramclient.protocol.selection import LOOK_TIME, hint_of_link, only_vehicle
from paramclient.service.event_feed import EventFeed
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.jobs import Job, Jobs
from paramclient.service.link import ServiceLink
from paramclient.service.problems import ServiceError
from paramclient.service.quota import (
    LONG_REQUESTS_MAX,
    LONG_REQUESTS_OF_HOLDER_MAX,
    WAITING_REQUESTS_MAX,
    WAITING_REQUESTS_OF_HOLDER_MAX,
    Quota,
)

if TYPE_CHECKING:
    from paramclient.cache import ParamCache
    from paramclient.sim import Endpoint

__all__ = ["Hub"]

SERVICE_AUTHOR: Final = "service"
"""Author of fetches that the service starts itself."""
FILE_WORK_TIMEOUT: Final = 1.0
"""Timeout in seconds for running work of the threads for files and responses at shutdown. Queued work is
dropped."""
CLOSING_LOCK_WAIT: Final = 1.5
"""Timeout in seconds for locks of other processes on the cache at shutdown, in all: with `FILE_WORK_TIMEOUT`,
the service ends within 3 s."""

Result = TypeVar("Result")

logger = logging.getLogger(__name__)


class Hub:
    """All links with one cache, as an async context manager.

    A link does not have to exist at the start: it is opened as soon as possible, and again after a failure.
    At the end, waiting calls get ClientClosed, and the cache is written.

    Args:
        links: links by name, object or simulated vehicle, as for `ParamClient`; or pairs of a name and a
            function that creates a client.
        cache: as for `ParamClient`; shared by all links.
        fetches: whether the table of every new component is fetched automatically, and its descriptions where
            the link is quick.
        options: options of each `ParamClient`: `system`, `component`, `signing`, `listen_only`, …

    Attributes:
        cache: the cache, or None.
        feed: the event feed.
        jobs: fetches and set-ups.
        links: the links, by name.
        metadata_store: the metadata files beside the cache, used in the thread for files; None without a
            cache.
        long_requests: quota of long requests.
        waiting_requests: quotas of requests that wait for a vehicle, the cache or a comparison, by whether
            the client may write: no number of readers can keep a writer out.

    Raises:
        UsageError: a link or option is invalid, or two links have one name.
    """

    def __init__(
        self,
        links: Iterable[str | Link | Endpoint | tuple[str, Callable[[], ParamClient]]],
        *,
        cache: ParamCache | str | os.PathLike[str] | bool | None = None,
        fetches: bool = True,
        **options: Any,
    ) -> None:
        self.cache = choose_cache(cache, is_log=False)
        self.feed = EventFeed()
        self.jobs = Jobs(self.feed)
        self.links: dict[str, ServiceLink] = {}
        self._owns_cache = self.cache is not cache
        self._fetches = fetches
        self._began = time.monotonic()
        self._options = options
        self._worker = Worker("paramclient service")
        self._reader = Worker("paramclient files")
        self._encoder = Worker("paramclient responses")
        self.long_requests = Quota(
            "long requests", total_max=LONG_REQUESTS_MAX, holder_max=LONG_REQUESTS_OF_HOLDER_MAX
        )
        self.waiting_requests = {
            may_write: Quota(
                "waiting requests",
                total_max=WAITING_REQUESTS_MAX,
                holder_max=WAITING_REQUESTS_OF_HOLDER_MAX,
                is_fair=True,
            )
            for may_write in (False, True)
        }
        self._closing = anyio.Event()
        self.metadata_store = None if self.cache is None else MetadataStore.beside(self.cache.path)
        self._tasks: anyio.abc.TaskGroup | None = None
        self._link_tasks: anyio.abc.TaskGroup | None = None
        for link in links:
            self._add(link)

    def __repr__(self) -> str:
        return f"<Hub {', '.join(map(repr, self.links.values())) or 'without links'}>"

    @property
    def followed(self) -> list[FollowedComponent]:
        """Return all components, link by link."""
        return [followed for each in self.links.values() for followed in each.followed.values()]

    @property
    def is_busy(self) -> bool:
        """Return whether a request waits or is worked on for long, or a job runs."""
        quotas = (self.long_requests, *self.waiting_requests.values())
        return any(map(len, quotas)) or any(job.state == "running" for job in self.jobs.all)

    @property
    def uptime(self) -> float:
        """Return the seconds since its creation."""
        return time.monotonic() - self._began

    @property
    def is_closing(self) -> bool:
        """Return whether the service ends."""
        return self._closing.is_set()

    async def __aenter__(self) -> Hub:
        tasks = self._tasks = anyio.create_task_group()
        await tasks.__aenter__()
        self.jobs.open(tasks)
        tasks.start_soon(self.feed.wake_listeners, name="paramclient feed")
        link_tasks = self._link_tasks = anyio.create_task_group()
        await link_tasks.__aenter__()
        for each in self.links.values():
            link_tasks.start_soon(each.run, name=f"paramclient link {each.name}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        tasks, link_tasks = self._tasks, self._link_tasks
        assert tasks is not None
        assert link_tasks is not None
        self.feed.end()
        self._closing.set()
        self._reader.drop(_closing)
        self._encoder.drop(_closing)
        try:
            link_tasks.cancel_scope.cancel()
            await link_tasks.__aexit__(None, None, None)
            await anyio.lowlevel.checkpoint()  # calls that wait for a client now raise ClientClosed
        finally:
            tasks.cancel_scope.cancel()
            await tasks.__aexit__(None, None, None)
            close = self.cache.close if self._owns_cache and self.cache is not None else _nothing
            with anyio.CancelScope(shield=True):
                await self._worker.close(close)
                await self._reader.abandon(_closing, FILE_WORK_TIMEOUT)
                await self._encoder.abandon(_closing, FILE_WORK_TIMEOUT)

    async def run_in_thread(self, work: Callable[[], Result]) -> Result:
        """Run blocking work in a thread, such as an access to the cache. It is not interrupted by
        cancellation.

        Raises:
            ServiceError: the service ends.
        """
        self._check_open()
        return await self._worker.run(work)

    async def run_in_file_thread(self, work: Callable[[], Result]) -> Result:
        """Run work on received data in a thread of its own: parsing or comparing can take seconds, and must
        not delay accesses to the cache. `long_requests` limits the waiting work.

        Raises:
            ServiceError: the service ends.
        """
        self._check_open()
        return await self._reader.run(work)

    async def encode_in_thread(self, work: Callable[[], Result]) -> Result:
        """Encode a response in a thread of its own, which neither a locked cache nor a comparison delays.

        Raises:
            ServiceError: the service ends.
        """
        self._check_open()
        return await self._encoder.run(work)

    def find_component(self, system: int, component: int, link: str | None = None) -> FollowedComponent:
        """Return the component with this address.

        Raises:
            ServiceError: the component is unknown, or on several links and none is given.
        """
        found = [
            followed
            for each in self.links.values()
            if link in (None, each.name) and (followed := each.followed.get((system, component))) is not None
        ]
        if not found:
            on = "any link" if link is None else link
            raise ServiceError(
                404, "unknown-component", f"No heartbeat of {system}/{component} was received on {on}."
            )
        if len(found) > 1:
            names = [followed.link.name for followed in found]
            what = f"{system}/{component} is on {' and '.join(names)}. Choose one with ?link=NAME."
            raise ServiceError(409, "ambiguous", what, links=names)
        return found[0]

    def clients(self, link: str | None = None) -> list[tuple[ServiceLink, ParamClient]]:
        """Return the open links with their clients.

        Args:
            link: name of the only link, or None for all.

        Raises:
            ServiceError: the link does not exist.
        """
        self._check_link(link)
        chosen = [each for each in self.links.values() if link in (None, each.name)]
        return [(each, each.client) for each in chosen if each.client is not None]

    def start_fetch(
        self, followed: FollowedComponent, requested_by: str, holder: str = "", **options: Any
    ) -> Job:
        """Start a job that fetches a component's table; the options are those of `Component.fetch_all`.

        Simultaneous jobs share one download. Cancelling one does not affect the others.

        Raises:
            ServiceError: too many jobs are running, of this holder or in total.
        """
        return self.jobs.start("fetch", followed, partial(_fetch, options), requested_by, holder)

    def start_extended_fetch(
        self,
        followed: FollowedComponent,
        requested_by: str,
        holder: str = "",
        *,
        timeout: float | None = None,
    ) -> Job:
        """Start a job that downloads a component's extended parameters; see `ExtParams.fetch_all`.

        Simultaneous jobs share one download. Cancelling one does not affect the others.

        Raises:
            ServiceError: too many jobs are running, of this holder or in total.
        """
        work = partial(_fetch_extended, timeout)
        return self.jobs.start("extended-fetch", followed, work, requested_by, holder)

    async def wait_for_component(
        self, system: int | None, component: int | None, link: str | None, timeout: float | None
    ) -> FollowedComponent:
        """Wait for the component with this address on any link; see `ParamClient.component`.

        Includes links that are not open yet.

        Raises:
            ServiceError: the link does not exist, or the service ends.
            NoReply: the component was not heard before the timeout.
        """
        self._check_link(link)
        chosen = [each for each in self.links.values() if link in (None, each.name)]
        found: list[FollowedComponent] = []
        is_ending = False
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            async with anyio.create_task_group() as tasks:

                async def look(each: ServiceLink) -> None:
                    found.append(await each.wait_for(system, component))
                    tasks.cancel_scope.cancel()

                for each in chosen:
                    tasks.start_soon(look, each)
                await self._closing.wait()
                is_ending = True
                tasks.cancel_scope.cancel()
        if is_ending:
            self._check_open()
        if not found:
            reasons = [f"; {each.error}" for each in chosen if each.state == "failed" and each.error]
            awaited = address_in_words(system, component) + "".join(reasons)
            hint = "" if reasons else _silence_of(chosen)
            raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began, hint=hint)
        return found[0]

    async def wait_for_only_component(
        self, system: int | None, component: int | None, link: str | None, timeout: float | None
    ) -> FollowedComponent:
        """Wait for the component with this address if no other vehicle on the links matches.

        See `ParamClient.only_component`. Links that are not open are ignored.

        Raises:
            ServiceError: the link does not exist, or the service ends.
            AmbiguousVehicle: several vehicles match.
            NoReply: the component was not heard before the timeout.
        """
        self._check_link(link)
        chosen = [each for each in self.links.values() if link in (None, each.name)]
        choice = only_vehicle(system, component, spans_links=len(chosen) > 1)
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            while True:
                self._check_open()
                now = anyio.current_time()
                clients = [(each, each.client.core) for each in chosen if each.client is not None]
                events = [each.changed for each in chosen] + [
                    client.link_task.activity for _, client in clients
                ]
                machines = {
                    machine: each
                    for each, client in clients
                    for machine in client.station.components.values()
                }
                since = max((client.station.listening_since for _, client in clients), default=math.inf)
                machine = choice.look(machines, now, listening_since=since)
                followed = None
                if machine is not None:
                    followed = machines[machine].followed.get((machine.system, machine.component))
                if followed is not None:
                    await followed.component.core.wait_for_cache()
                    return followed
                with ExitStack() as looking:
                    for _, client in clients:
                        looking.enter_context(client.station.looking_for_others())
                    with anyio.move_on_after(None if choice.due == math.inf else choice.due - now):
                        await _wait_for_any([*events, self._closing])
                for _, client in clients:
                    await client.link_task.wait_for_reader(choice.due)
        awaited, hint = address_in_words(system, component), _silence_of(chosen)
        if choice.due < math.inf:
            awaited, hint = f"{awaited}, then {LOOK_TIME} s without another vehicle", ""
        raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began, hint=hint)

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise _closing()

    def _add(self, link: str | Link | Endpoint | tuple[str, Callable[[], ParamClient]]) -> None:
        if isinstance(link, tuple):
            name, make = link
        else:
            name = create_link(link).name
            make = partial(self._client, link)
            make()  # invalid options raise an error here
        if name in self.links:
            raise UsageError(f"the link {name} is given twice")
        self.links[name] = ServiceLink(name, make, self.feed, self._on_found)

    def _check_link(self, link: str | None) -> None:
        if link is not None and link not in self.links:
            raise ServiceError(
                404,
                "unknown-link",
                f"The service has no link {link!r}. Its links: {', '.join(self.links)}.",
                links=list(self.links),
            )

    def _client(self, link: str | Link | Endpoint) -> ParamClient:
        cache = False if self.cache is None or _is_log(link) else self.cache
        return ParamClient(link, cache=cache, **self._options)

    def _on_found(self, followed: FollowedComponent) -> None:
        """Handle a component that is new, found again, or restarted."""
        assert self._tasks is not None, "the hub is open"
        self._tasks.start_soon(self._load_component, followed)

    async def _load_component(self, followed: FollowedComponent) -> None:
        """Load cached data of a component, then fetch its table."""
        client = followed.component.core.client
        with suppress(ParamClientError, ServiceError):
            await followed.component.core.wait_for_cache()
            await self._load_cached(followed)
        machine = followed.component.core.machine
        is_due = (
            machine.identification.has_parameters
            and machine.fetch is None
            and machine.sync_state == "unsynced"
        )
        if self._fetches and is_due and not client.station.listens_only:
            with suppress(ServiceError):  # the maximum number of jobs is running
                self.start_fetch(followed, SERVICE_AUTHOR)

    async def _load_cached(self, followed: FollowedComponent) -> None:
        """Load the times of cached values and the descriptions of the parameters."""
        cache, key = self.cache, followed.key
        if cache is None or key is None:
            return
        component = followed.component
        cached = await self.run_in_thread(lambda: cache.load(key, component.component))
        if cached is not None:
            followed.add_cached_times(cached.heard_at.items())
        store, identity = self.metadata_store, component.identity
        if store is None:
            return
        known = await self.run_in_file_thread(partial(store.known, identity, component.component))
        if known is not None and followed.metadata is None:
            followed.describe(known, identity)


async def _wait_for_any(events: Iterable[anyio.Event]) -> None:
    """Wait until one of the events is set."""
    async with anyio.create_task_group() as tasks:

        async def wait(event: anyio.Event) -> None:
            await event.wait()
            tasks.cancel_scope.cancel()

        for event in events:
            tasks.start_soon(wait, event)


async def _fetch(options: dict[str, Any], job: Job) -> FetchResultDoc:
    def note(progress: Any) -> None:
        job.progress = ProgressDoc.of(progress)

    result = await job.followed.component.fetch_all(progress=note, **options)
    return FetchResultDoc.of(result, link=job.followed.link.name)


async def _fetch_extended(timeout: float | None, job: Job) -> ExtFetchResultDoc:
    def note(progress: Any) -> None:
        job.progress = ProgressDoc.of(progress)

    result = await job.followed.extended.ext.fetch_all(timeout=timeout, progress=note)
    return ExtFetchResultDoc.of(result, link=job.followed.link.name)


def _is_log(link: object) -> bool:
    return isinstance(link, str) and link.lower().startswith("replay:")


def _silence_of(links: Iterable[ServiceLink]) -> str:
    """Return in sentences what was received on links instead of an awaited component."""
    clients = [(each.name, each.client.core) for each in links if each.client is not None]
    return " ".join(hint_of_link(client.station, name) for name, client in clients)


def _closing() -> ServiceError:
    return ServiceError(503, "closing", "The service is shutting down.")


def _nothing() -> None:
    return
