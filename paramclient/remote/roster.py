"""Roster: all components of a service with mirrors of their tables, updated by its events."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import anyio

from paramclient.client.component import Component
from paramclient.client.events import Contested, Event, Events, Found, Lost, Rebooted, Resynced, Uncontested
from paramclient.errors import LinkError, NoReply, ParamClientError
from paramclient.remote.component import RemoteComponent
from paramclient.remote.connection import Connection
from paramclient.remote.decoding import Document, decode_errors, ext_params_of, hash_of, params_of
from paramclient.remote.http import Requests, ServiceResponse, ServiceUnreachable, StreamPosition
from paramclient.remote.mirrored_component import Key, MirroredComponent, key_of
from paramclient.remote.problems import NotHeard

__all__ = ["ServiceComponents"]

REDISCOVERY_TIMEOUT: Final = 2.5
"""Timeout in seconds for a component at a restarted service: a component sends a heartbeat once a second."""
MIRROR_TIMEOUT: Final = 2.0
"""Timeout in seconds of a response for the events that it includes, which usually arrive before it."""
UNTRUSTED_STATES: Final = ("cached", "contested", "lost")
"""States of a table whose values are no longer trusted."""
REMOVED_COMPONENTS_MAX: Final = 1_000
"""Maximum number of removed components that are kept for their return. The streams of older ones end."""
SNAPSHOT_TIMEOUT: Final = 30.0
"""Timeout in seconds for the start of a list or table, which the service has in memory."""
SERVICE_COMPONENTS_MAX: Final = 4_096
"""Maximum number of components of a service on all its links."""
LOAD_RETRY_INTERVAL: Final = 1.0
"""Seconds until the next attempt to load a table."""

logger = logging.getLogger(__name__)


class ServiceComponents:
    """Follows the events of a service; see `EventSink`.

    The list of components and each table are loaded after the event stream has opened, and again after lost
    events.

    Args:
        requests: the HTTP requests.
        link: name of the only link to follow, or None for all.

    Attributes:
        name: address of the service.
        connection: connection with the event stream.
        components: all components, by link and ids, in the order of the service.
        subscriptions: event streams of the client.
        author: name of this client at the service.
        are_links_stale: set after a change of a link.
    """

    def __init__(self, requests: Requests, link: str | None) -> None:
        self.name = requests.name
        self.connection = Connection(requests, self)
        self.components: dict[Key, MirroredComponent] = {}
        self.subscriptions: weakref.WeakSet[Events] = weakref.WeakSet()
        self.author = ""
        self.are_links_stale = anyio.Event()
        self._requests = requests
        self._link = link
        self._is_list_stale = True
        self._stale: dict[Key, MirroredComponent] = {}
        self._gone: dict[Key, MirroredComponent] = {}

    def take(self, event: Document) -> None:
        """See `EventSink`."""
        kind = event["type"]
        if kind == "link":
            self.are_links_stale.set()
        if "component" not in event or self._link not in (None, event["link"]):
            return
        mirrored = self.components.get(key_of(event))
        match kind:
            case "component":
                self._take_component(event, mirrored)
            case _ if mirrored is None:
                self._is_list_stale = True
            case "change":
                mirrored.take_change(event, self.author)
            case "params":
                mirrored.mirror.doubt()
                self._stale[mirrored.key] = mirrored
            case "resynced":
                names = tuple(event["changed"])
                mirrored.announce(Resynced(mirrored.component, names, hash_of(event["hash"])))
            case "progress":
                mirrored.progress.take(event)
            case "extended_change":
                mirrored.take_ext_change(event, self.author)
            case "extended_params":
                mirrored.ext_mirror.doubt()
                self._stale[mirrored.key] = mirrored
            case "extended_progress":
                mirrored.ext_progress.take(event)

    def leave(self) -> None:
        """See `EventSink`."""
        for mirrored in self.components.values():
            mirrored.mirror.leave()
            mirrored.ext_mirror.leave()

    def resume(self) -> None:
        """See `EventSink`."""
        for mirrored in self.components.values():
            mirrored.mirror.resume()
            mirrored.ext_mirror.resume()

    def begin_anew(self) -> None:
        """See `EventSink`."""
        self._is_list_stale = True
        for mirrored in self.components.values():
            mirrored.seq = -1  # another run of the service has new event numbers
            mirrored.mirror.resume()
            mirrored.ext_mirror.resume()
            self._doubt(mirrored)

    def _take_component(self, event: Document, known: MirroredComponent | None) -> None:
        why = event["why"]
        if why == "forgotten":
            if known is not None:
                self._forget(known)
            return
        mirrored = known or self.add_component(event["component_doc"], event["seq"])
        state = mirrored.component.state
        mirrored.take_document(event["component_doc"], event["seq"])
        if mirrored.component.state != state and mirrored.component.state in UNTRUSTED_STATES:
            self._doubt(mirrored)
        match why:
            case "discovered":
                mirrored.announce_first()
            case "lost":
                self._doubt(mirrored)
                mirrored.announce(Lost(mirrored.component, event["silence_s"]))
            case "found":
                mirrored.announce(Found(mirrored.component, event["silence_s"]))
            case "contested":
                self._doubt(mirrored)
                contest = mirrored.component.contest
                if contest is not None:
                    mirrored.announce(Contested(mirrored.component, contest))
            case "uncontested":
                self._doubt(mirrored)
                mirrored.announce(Uncontested(mirrored.component))
            case "rebooted":
                self._doubt(mirrored)
                mirrored.announce(Rebooted(mirrored.component))

    def publish(self, event: Event) -> None:
        """Push an event to all streams."""
        for events in list(self.subscriptions):
            events.push(event)

    def add_component(self, document: Document, seq: int) -> MirroredComponent:
        """Return the component of a document, which is created if it is new.

        Args:
            document: its state.
            seq: number of the last event included in the document.

        Raises:
            ValueError: there are more than `SERVICE_COMPONENTS_MAX` components.
        """
        key = key_of(document)
        mirrored = self.components.get(key)
        if mirrored is None:
            if len(self.components) >= SERVICE_COMPONENTS_MAX:
                raise ValueError(f"more than {SERVICE_COMPONENTS_MAX} components")
            mirrored = self._gone.pop(key, None) or MirroredComponent(
                document, seq, partial(RemoteComponent, self), self.publish
            )
            mirrored.mark_found(document, seq)
            self.components[key] = mirrored
            self._stale[key] = mirrored
            self.connection.notify()
        return mirrored

    def _doubt(self, mirrored: MirroredComponent) -> None:
        mirrored.doubt()
        self._stale[mirrored.key] = mirrored

    def _forget(self, mirrored: MirroredComponent) -> None:
        """Remove a component that the service does not know, for example after a restart of the service."""
        key = mirrored.key
        self._stale.pop(key, None)
        if self.components.pop(key, None) is not None:
            mirrored.leave()
            self._gone[key] = mirrored
            if len(self._gone) > REMOVED_COMPONENTS_MAX:
                self._gone.pop(next(iter(self._gone))).forget()

    def same_ids(self, mirrored: MirroredComponent) -> list[MirroredComponent]:
        """Return all components with its ids, on any link."""
        return [each for key, each in self.components.items() if key[1:] == mirrored.key[1:]]

    # loading of lists and tables
    async def until_current(
        self,
        mirrored: MirroredComponent | None,
        place: StreamPosition | None,
        *,
        timeout: float | None = MIRROR_TIMEOUT,
    ) -> None:
        """Wait until a table includes the events up to a position.

        Args:
            mirrored: the component; None returns immediately.
            place: the position, or None for any.
            timeout: maximum seconds; the call then returns without an error.

        Raises:
            LinkError: the service cannot be reached.
        """
        connection = self.connection
        with anyio.move_on_after(timeout):
            while mirrored is not None:
                has_arrived = (
                    place is None
                    or connection.place is None
                    or connection.place.run != place.run
                    or connection.place.seq >= place.seq
                )
                if has_arrived and mirrored.is_loaded:
                    return
                if mirrored.key in self._stale:  # load this table next
                    self._stale = {mirrored.key: mirrored, **self._stale}
                await connection.changed.wait()
                connection.check_open()

    async def component_of_response(self, answer: ServiceResponse) -> Component:
        """Return the component of a response, with its table."""
        return (await self.mirror_for(answer)).component

    async def mirror_for(
        self, answer: ServiceResponse, timeout: float | None = MIRROR_TIMEOUT
    ) -> MirroredComponent:
        """Return the mirrored component of a response, with its table.

        Args:
            answer: a response with the document of a component.
            timeout: seconds to wait for the table; None waits without limit.
        """
        with decode_errors(self.name):
            found = self.add_component(answer.document, -1 if answer.place is None else answer.place.seq)
        await self.until_current(found, answer.place, timeout=timeout)
        return found

    async def ask(
        self,
        mirrored: MirroredComponent,
        what: str,
        body: Mapping[str, Any] | None,
        timeout: float | None,
        awaited: str,
        *,
        method: str = "POST",
        is_write: bool = False,
        waits_for_ever: bool = False,
    ) -> ServiceResponse:
        """See `Service.ask` and `Connection.ask`."""
        began = anyio.current_time()
        request = partial(
            self.connection.ask,
            method,
            f"{mirrored.path}/{what}",
            body,
            awaited=awaited,
            waits_for_ever=waits_for_ever,
            link=mirrored.link_name,
            is_write=is_write,
        )
        try:
            answer = await request(timeout=timeout)
        except NotHeard:
            left = None if timeout is None else began + timeout - anyio.current_time()
            wait = min(REDISCOVERY_TIMEOUT, REDISCOVERY_TIMEOUT if left is None else left)
            await self._until_heard(mirrored, wait)
            left = None if timeout is None else began + timeout - anyio.current_time()
            answer = await request(timeout=left)
        await self.until_current(mirrored, answer.place)
        return answer

    async def _until_heard(self, mirrored: MirroredComponent, timeout: float) -> None:
        """Wait until the service knows a component again."""
        link, system, component = mirrored.key
        body = {"system": system, "component": component}
        awaited = f"{system}/{component} (lost)"
        await self.connection.ask("POST", "/find", body, awaited=awaited, timeout=timeout, link=link)

    async def run(self) -> None:
        """Load stale lists and tables, until cancelled."""
        while True:
            changed = self.connection.changed
            if self.connection.is_offline or not (self._stale or self._is_list_stale):
                await changed.wait()
                continue
            try:
                if self._is_list_stale:
                    await self.load_list()
                else:
                    await self._load(next(iter(self._stale.values())))
            except (ServiceUnreachable, ParamClientError) as error:
                logger.info("%s: a table could not be loaded, retrying in 1 s: %s", self.name, error)
                await anyio.sleep(LOAD_RETRY_INTERVAL)

    async def load_list(self) -> None:
        """Load the list of components.

        Raises:
            Unreached, ParamClientError: the list cannot be loaded.
        """
        self._is_list_stale = False
        try:
            answer = await self._snapshot("/components", None)
            with decode_errors(self.name):
                self._take_list(answer["components"], answer["seq"])
        except BaseException:
            self._is_list_stale = True
            raise
        self.connection.notify()

    def _take_list(self, documents: list[Document], seq: int) -> None:
        before, self.components = self.components, {}
        listed = [document for document in documents if self._link in (None, document["link"])]
        self.components = {key: before[key] for document in listed if (key := key_of(document)) in before}
        for document in listed:
            mirrored = self.add_component(document, seq)
            mirrored.take_document(document, seq)
            mirrored.announce_first()
        for key, mirrored in before.items():
            if key not in self.components:
                self.components[key] = mirrored
                if mirrored.seq <= seq:  # otherwise it has appeared since
                    self._forget(mirrored)

    async def _load(self, mirrored: MirroredComponent) -> None:
        """Load the stale tables of a component."""
        try:
            if not mirrored.mirror.is_loaded:
                mirrored.mirror.begin()
                answer = await self._snapshot(f"{mirrored.path}/params", mirrored.link_name)
                with decode_errors(self.name):
                    changes = mirrored.mirror.load(answer["seq"], params_of(answer["params"]))
                mirrored.publish(changes or ())
            if mirrored.has_extended and not mirrored.ext_mirror.is_loaded:
                mirrored.ext_mirror.begin()
                answer = await self._snapshot(f"{mirrored.path}/extended/params", mirrored.link_name)
                with decode_errors(self.name):
                    ext_changes = mirrored.ext_mirror.load(answer["seq"], ext_params_of(answer["params"]))
                mirrored.publish_ext(ext_changes or ())
        except NoReply:
            self._forget(mirrored)
            return
        if mirrored.is_loaded:
            self._stale.pop(mirrored.key, None)
            mirrored.tables_were_loaded()
            self.connection.notify()

    async def _snapshot(self, path: str, link: str | None) -> Document:
        """Request a list or table from the run of the service whose events are followed.

        Raises:
            Unreached, ParamClientError: the request failed, or the service has restarted.
        """
        response = await self._requests.ask("GET", path, link=link, timeout=SNAPSHOT_TIMEOUT)
        answer: Document = response.document
        place = self.connection.place
        with decode_errors(self.name):
            is_of_run = place is not None and answer["run"] == place.run
        if not is_of_run:
            raise LinkError(f"{self.name}: the service has restarted", link=self.name)
        return answer
