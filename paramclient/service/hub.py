"""The links and the cache that the service holds, and everyone who is heard on them."""

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

from paramclient.cache import SetupNotes
from paramclient.client.arguments import address_in_words
from paramclient.client.cache_writer import choose_cache
from paramclient.client.client import ParamClient, local_client
from paramclient.client.worker_thread import Worker
from paramclient.documents.component import ProgressDoc
from paramclient.documents.job import progress_text
from paramclient.documents.results import FetchResultDoc
from paramclient.errors import NoReply, ParamClientError, UsageError
from paramclient.links import Link, create_link
from paramclient.metadata.metadata_cache import MetadataStore
from paramclient.model.notation import time_text
from paramclient.protocol.vehicle_selection import LOOK_TIME, VehicleChoice
from paramclient.service.event_feed import Feed
from paramclient.service.followed_component import Followed
from paramclient.service.jobs import Job, Jobs
from paramclient.service.link import Line
from paramclient.service.problems import ServiceError
from paramclient.service.quota import LONG_REQUESTS_MAX, LONG_REQUESTS_OF_HOLDER_MAX, Quota

if TYPE_CHECKING:
    from paramclient.cache import CutOff, ParamCache, RunningSetup
    from paramclient.sim import Endpoint

__all__ = ["Hub"]

OURSELVES: Final = "service"
"""Who has asked for what the service does by itself."""
READING_PATIENCE: Final = 1.0
"""Seconds for what is being parsed or compared when the service ends; what has not begun is dropped."""

Result = TypeVar("Result")

logger = logging.getLogger(__name__)


class Hub:
    """All links, one cache for all of them, and who is heard, as an async context manager.

    It begins with no vehicle, and with links that may not be there yet: each is opened when it can be, and
    again when it has failed. At its end every call that waits gets ClientClosed, and the cache is written.

    Args:
        links: each by its name, as an object or as a simulated vehicle, as `ParamClient` takes it; or a pair
            of a name and what gives a new client for it.
        cache: as for `ParamClient`; all links share it.
        fetches: whether the table of everyone who is heard is brought up to date without being asked for.
        options: for each `ParamClient`: `system`, `component`, `signing`, `listen_only`, …

    Attributes:
        cache: where tables are kept, or None.
        feed: what happens.
        jobs: what is under way.
        lines: the links, by name.
        long_requests: how many requests that take long are not answered yet.

    Raises:
        UsageError: no such link, two of one name, or options that cannot be.
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
        self.feed = Feed()
        self.jobs = Jobs(self.feed)
        self.lines: dict[str, Line] = {}
        self._owns_cache = self.cache is not cache
        self._fetches = fetches
        self._began = time.monotonic()
        self._options = options
        self._worker = Worker("paramclient service")
        self._reader = Worker("paramclient files")
        self.long_requests = Quota(
            "long requests", most=LONG_REQUESTS_MAX, most_of_holder=LONG_REQUESTS_OF_HOLDER_MAX
        )
        self._closing = anyio.Event()
        self._setups = None if self.cache is None else SetupNotes.beside(self.cache.path)
        self._tasks: anyio.abc.TaskGroup | None = None
        self._line_tasks: anyio.abc.TaskGroup | None = None
        for link in links:
            self._add(link)

    def __repr__(self) -> str:
        return f"<Hub {', '.join(map(repr, self.lines.values())) or 'without links'}>"

    @property
    def followed(self) -> list[Followed]:
        """Everyone who is heard, link by link."""
        return [followed for line in self.lines.values() for followed in line.followed.values()]

    @property
    def age(self) -> float:
        """Seconds since it was made."""
        return time.monotonic() - self._began

    @property
    def is_closing(self) -> bool:
        """Whether the service is ending."""
        return self._closing.is_set()

    async def __aenter__(self) -> Hub:
        tasks = self._tasks = anyio.create_task_group()
        await tasks.__aenter__()
        self.jobs.open(tasks)
        await self._recall_setups()
        tasks.start_soon(self.feed.run_gathering, name="paramclient feed")
        lines = self._line_tasks = anyio.create_task_group()
        await lines.__aenter__()
        for line in self.lines.values():
            lines.start_soon(line.run, name=f"paramclient link {line.name}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        tasks, lines = self._tasks, self._line_tasks
        assert tasks is not None
        assert lines is not None
        self.feed.end()
        self._closing.set()
        self._reader.drop(_closing)
        try:
            lines.cancel_scope.cancel()
            await lines.__aexit__(None, None, None)
            await anyio.lowlevel.checkpoint()  # whoever waited on a client learns now that it is closed
        finally:
            tasks.cancel_scope.cancel()
            await tasks.__aexit__(None, None, None)
            close = self.cache.close if self._owns_cache and self.cache is not None else _nothing
            with anyio.CancelScope(shield=True):
                await self._worker.close(close)
                await self._reader.abandon(_closing, READING_PATIENCE)

    async def aside(self, work: Callable[[], Result]) -> Result:
        """Do what blocks, such as a look into the cache, in a thread. Cancelled, it is done all the same.

        Raises:
            ServiceError: the service is ending.
        """
        self._check_open()
        return await self._worker.run(work)

    async def note_setup(self, job: Job) -> RunningSetup | None:
        """Note on the disk that a set-up begins, before it does anything; None without a cache.

        Raises:
            CacheError: it cannot be noted.
        """
        notes = self._setups
        if notes is None:
            return None
        (system, component), key = job.followed.address, job.followed.key
        begin = partial(notes.begin, system=system, component=component, asked_by=job.asked_by, key=key)
        return await self.aside(lambda: begin(job.id, job.kind, link=job.followed.line.name))

    async def end_note(self, note: RunningSetup, *, is_cut_off: bool) -> None:
        """A set-up has ended, or is cut off as the service ends. This is done to its end in any case."""
        with anyio.CancelScope(shield=True):
            await self._worker.run(note.cut_off if is_cut_off else note.end)

    async def cut_off(self) -> list[CutOff]:
        """The set-ups that were cut off, as the disk knows them."""
        return [] if self._setups is None else await self.aside(self._setups.cut_off)

    async def read_aside(self, work: Callable[[], Result]) -> Result:
        """Parse or compare what somebody has sent, in a thread of its own: that may take seconds, and others
        look into the cache. `long_requests` bounds how many wait for it.

        Raises:
            ServiceError: the service is ending.
        """
        self._check_open()
        return await self._reader.run(work)

    def find(self, system: int, component: int, link: str | None = None) -> Followed:
        """The component of this address.

        Raises:
            ServiceError: it was not heard, or it is heard on several links and none is named.
        """
        found = [
            followed
            for line in self.lines.values()
            if link in (None, line.name) and (followed := line.followed.get((system, component))) is not None
        ]
        if not found:
            on = "any link" if link is None else link
            raise ServiceError(404, "unknown-component", f"{system}/{component} was not heard on {on}.")
        if len(found) > 1:
            names = [followed.line.name for followed in found]
            what = f"{system}/{component} is heard on {' and '.join(names)}; name one: ?link=…"
            raise ServiceError(409, "ambiguous", what, links=names)
        return found[0]

    def clients(self, link: str | None = None) -> list[tuple[Line, ParamClient]]:
        """The links that are open, or of these the one that is named.

        Raises:
            ServiceError: there is no such link.
        """
        self._check_link(link)
        chosen = [line for line in self.lines.values() if link in (None, line.name)]
        return [(line, line.client) for line in chosen if line.client is not None]

    def begin_fetch(self, followed: Followed, asked_by: str, holder: str = "", **options: Any) -> Job:
        """Begin to bring a component's table up to date; the options are those of `Component.fetch_all`.

        Several at the same time share one download. To cancel the job gives up its own interest.

        Raises:
            ServiceError: too many jobs are under way, of this holder or of all.
        """
        return self.jobs.begin("fetch", followed, partial(_fetch, options), asked_by, holder)

    async def wait_for(
        self, system: int | None, component: int | None, link: str | None, timeout: float | None
    ) -> Followed:
        """The component with this address as soon as it is heard, on any link; see `ParamClient.component`.

        Links that are not open yet are waited for.

        Raises:
            ServiceError: there is no such link.
            NoReply: it was not heard in time.
        """
        self._check_link(link)
        chosen = [line for line in self.lines.values() if link in (None, line.name)]
        found: list[Followed] = []
        is_ending = False
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            async with anyio.create_task_group() as tasks:

                async def look(line: Line) -> None:
                    found.append(await line.wait_for(system, component))
                    tasks.cancel_scope.cancel()

                for line in chosen:
                    tasks.start_soon(look, line)
                await self._closing.wait()
                is_ending = True
                tasks.cancel_scope.cancel()
        if is_ending:
            self._check_open()
        if not found:
            reasons = [f"; {line.error}" for line in chosen if line.state == "failed" and line.error]
            awaited = address_in_words(system, component) + "".join(reasons)
            raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began)
        return found[0]

    async def wait_for_only(
        self, system: int | None, component: int | None, link: str | None, timeout: float | None
    ) -> Followed:
        """Wait for the component with this address if no other vehicle on any of the links can be meant.

        See `ParamClient.only_component`. Vehicles on links that are not open are not there.

        Raises:
            ServiceError: there is no such link.
            AmbiguousVehicle: several vehicles are there.
            NoReply: it was not heard in time.
        """
        self._check_link(link)
        chosen = [line for line in self.lines.values() if link in (None, line.name)]
        choice = VehicleChoice(system, component, spans_links=len(chosen) > 1)
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            while True:
                self._check_open()
                now = anyio.current_time()
                clients = [(line, local_client(line.client)) for line in chosen if line.client is not None]
                news = [line.news for line in chosen] + [client.link_task.news for _, client in clients]
                machines = {
                    machine: line
                    for line, client in clients
                    for machine in client.station.components.values()
                }
                since = max((client.station.listening_since for _, client in clients), default=math.inf)
                machine = choice.look(machines, now, listening_since=since)
                followed = None
                if machine is not None:
                    followed = machines[machine].followed.get((machine.system, machine.component))
                if followed is not None:
                    await followed.component.wait_for_cache()
                    return followed
                with ExitStack() as looking:
                    for _, client in clients:
                        looking.enter_context(client.station.looking_for_others())
                    with anyio.move_on_after(None if choice.due == math.inf else choice.due - now):
                        await _any_of([*news, self._closing])
                for _, client in clients:
                    await client.link_task.read_up(choice.due)
        awaited = address_in_words(system, component)
        if choice.due < math.inf:
            awaited += f", and {LOOK_TIME} s more to see that it is the only one"
        raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began)

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise _closing()

    def _add(self, link: str | Link | Endpoint | tuple[str, Callable[[], ParamClient]]) -> None:
        if isinstance(link, tuple):
            name, make = link
        else:
            name = create_link(link).name
            make = partial(self._client, link)
            make()  # what is wrong with the options shows now
        if name in self.lines:
            raise UsageError(f"the link {name} is named twice")
        self.lines[name] = Line(name, make, self.feed, self._met)

    def _check_link(self, link: str | None) -> None:
        if link is not None and link not in self.lines:
            raise ServiceError(
                404, "unknown-link", f"There is no link {link!r} here.", links=list(self.lines)
            )

    def _client(self, link: str | Link | Endpoint) -> ParamClient:
        cache = False if self.cache is None or _is_log(link) else self.cache
        return ParamClient(link, cache=cache, **self._options)

    def _met(self, followed: Followed) -> None:
        """Somebody was heard for the first time, is back, or has started again."""
        assert self._tasks is not None, "nothing is heard before"
        self._tasks.start_soon(self._welcome, followed)

    async def _welcome(self, followed: Followed) -> None:
        """See what is known of a component already, and bring its table up to date."""
        client = followed.component.client
        with suppress(ParamClientError, ServiceError):
            await followed.component.wait_for_cache()
            await self._recall(followed)
        machine = followed.component.machine
        is_due = machine.who.has_parameters and machine.fetch is None and machine.sync_state == "unsynced"
        if self._fetches and is_due and not client.station.listens_only:
            with suppress(ServiceError):  # as many are under way as may be
                self.begin_fetch(followed, OURSELVES)

    async def _recall_setups(self) -> None:
        """See which set-ups the last run of the service has not brought to their end, and tell of them."""
        notes = self._setups
        if notes is None:
            return
        self.jobs.cut_off = await self._worker.run(lambda: notes.cut_off(tells=True))
        for each in self.jobs.cut_off:
            if not each.is_told:
                logger.warning(
                    "%s of %d/%d on %s, which %s had asked for at %s, was cut off %s, as the service ended",
                    *("a restore" if each.kind == "restore" else "an apply", each.system, each.component),
                    *(each.link, each.asked_by, time_text(each.began), progress_text(each)),
                )

    async def _recall(self, followed: Followed) -> None:
        """What the disk knows: how old cached values are, and how the firmware describes its parameters."""
        cache, key = self.cache, followed.key
        if cache is None or key is None:
            return
        component = followed.component
        cached = await self.aside(lambda: cache.load(key, component.component))
        if cached is not None:
            followed.know_ages(cached.heard_at.items())
        store = MetadataStore.beside(cache.path)
        identity = component.identity
        followed.metadata = await self.aside(lambda: store.known(identity, component.component))


async def _any_of(events: Iterable[anyio.Event]) -> None:
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
    return FetchResultDoc.of(result, link=job.followed.line.name)


def _is_log(link: object) -> bool:
    return isinstance(link, str) and link.lower().startswith("replay:")


def _closing() -> ServiceError:
    return ServiceError(503, "closing", "The service is ending.")


def _nothing() -> None:
    return
