"""The components on the links of a service, and the mirrors of their tables, kept in step with its events."""

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
from paramclient.remote.decoding import Document, hash_of, params_of, understood
from paramclient.remote.http import Answer, Place, Requests, Unreached
from paramclient.remote.mirrored_component import Key, MirroredComponent, key_of
from paramclient.remote.problems import NotHeard

__all__ = ["Roster"]

COMPONENT_TIMEOUT: Final = 2.5
"""Seconds for a component to be heard by a service that has started again: it sends a heartbeat a second."""
CATCHING_UP: Final = 2.0
"""Seconds for which an answer waits for the events of what it tells; they mostly came before it."""
UNSURE: Final = ("cached", "contested", "lost")
"""States that a table comes into when its values are trusted no longer."""
MOST_GONE: Final = 1_000
"""Components that the service knows no more and that are the same when it hears them again; of older ones
nobody is told any more."""
ANSWER_PATIENCE: Final = 30.0
"""Seconds until the service begins to give a list or a table, which it has at hand."""
MOST_COMPONENTS: Final = 4_096
"""Components that a service may have on all its links."""
RETRY_PAUSE: Final = 1.0
"""Seconds until a table is asked for again that could not be loaded."""

logger = logging.getLogger(__name__)


class Roster:
    """Follows the events of a service; see `Follower`.

    Who is heard and each table are loaded once events come, and again when some of them were lost.

    Args:
        requests: how requests travel.
        link: the name of the link that is meant, or None for all.

    Attributes:
        name: the address of the service.
        connection: where events come from.
        components: all components, by link and address, in the order of the service.
        subscriptions: who listens to what happens to them.
        asker: who we are for the service.
        are_links_stale: is set when something has happened to a link.
    """

    def __init__(self, requests: Requests, link: str | None) -> None:
        self.name = requests.name
        self.connection = Connection(requests, self)
        self.components: dict[Key, MirroredComponent] = {}
        self.subscriptions: weakref.WeakSet[Events] = weakref.WeakSet()
        self.asker = ""
        self.are_links_stale = anyio.Event()
        self._requests = requests
        self._link = link
        self._is_list_stale = True
        self._stale: dict[Key, MirroredComponent] = {}
        self._gone: dict[Key, MirroredComponent] = {}

    def take(self, event: Document) -> None:
        """See `Follower`."""
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
                mirrored.take_change(event, self.asker)
            case "params":
                self._doubt(mirrored)
            case "resynced":
                told = tuple(event["changed"])
                mirrored.announce(Resynced(mirrored.component, told, hash_of(event["hash"])))
            case "progress":
                mirrored.take_progress(event)

    def leave(self) -> None:
        """See `Follower`."""
        for mirrored in self.components.values():
            mirrored.mirror.leave()

    def resume(self) -> None:
        """See `Follower`."""
        for mirrored in self.components.values():
            mirrored.mirror.resume()

    def begin_anew(self) -> None:
        """See `Follower`."""
        self._is_list_stale = True
        for mirrored in self.components.values():
            mirrored.seq = -1  # another run of the service counts from the beginning
            mirrored.mirror.resume()
            self._doubt(mirrored)

    def _take_component(self, event: Document, known: MirroredComponent | None) -> None:
        why = event["why"]
        if why == "forgotten":
            if known is not None:
                self._forget(known)
            return
        mirrored = known or self.meet(event["component_doc"], event["seq"])
        state = mirrored.component.state
        mirrored.take_document(event["component_doc"], event["seq"])
        if mirrored.component.state != state and mirrored.component.state in UNSURE:
            self._doubt(mirrored)
        match why:
            case "heard":
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
        """Tell those who listen."""
        for events in list(self.subscriptions):
            events.push(event)

    def meet(self, document: Document, seq: int) -> MirroredComponent:
        """Return the component of a document that tells how it stood after this event; it may be new here."""
        key = key_of(document)
        mirrored = self.components.get(key)
        if mirrored is None:
            if len(self.components) >= MOST_COMPONENTS:
                raise ValueError(f"more than {MOST_COMPONENTS} components")
            mirrored = self._gone.pop(key, None) or MirroredComponent(
                document, seq, partial(RemoteComponent, self), self.publish
            )
            mirrored.come_back(document, seq)
            self.components[key] = mirrored
            self._stale[key] = mirrored
            self.connection.tell()
        return mirrored

    def _doubt(self, mirrored: MirroredComponent) -> None:
        mirrored.mirror.doubt()
        self._stale[mirrored.key] = mirrored

    def _forget(self, mirrored: MirroredComponent) -> None:
        """The service does not know it any more, or not yet again: it may have started anew, or its link."""
        key = mirrored.key
        self._stale.pop(key, None)
        if self.components.pop(key, None) is not None:
            mirrored.leave()
            self._gone[key] = mirrored
            if len(self._gone) > MOST_GONE:
                self._gone.pop(next(iter(self._gone))).forget()

    def same_ids(self, mirrored: MirroredComponent) -> list[MirroredComponent]:
        """All with its ids, on whatever link."""
        return [each for key, each in self.components.items() if key[1:] == mirrored.key[1:]]

    # what is loaded

    async def until_current(
        self, mirrored: MirroredComponent | None, place: Place | None, *, patience: float | None = CATCHING_UP
    ) -> None:
        """Wait until what had happened up to a place is in a table, but not for longer than this.

        Raises:
            LinkError: the service cannot be reached.
        """
        connection = self.connection
        with anyio.move_on_after(patience):
            while mirrored is not None:
                has_come = (
                    place is None
                    or connection.place is None
                    or connection.place.run != place.run
                    or connection.place.seq >= place.seq
                )
                if has_come and mirrored.mirror.is_loaded:
                    return
                if mirrored.key in self._stale:  # it is the next to be loaded
                    self._stale = {mirrored.key: mirrored, **self._stale}
                await connection.news.wait()
                connection.check_open()

    async def given(self, answer: Answer) -> Component:
        """Return the component that an answer is about, with its table."""
        return (await self.mirror_for(answer)).component

    async def mirror_for(self, answer: Answer, patience: float | None = CATCHING_UP) -> MirroredComponent:
        """Return what is known of the component that an answer is about, with its table.

        Args:
            answer: its document is that of a component.
            patience: seconds to wait for the table; None waits until it has come.
        """
        with understood(self.name):
            found = self.meet(answer.document, -1 if answer.place is None else answer.place.seq)
        await self.until_current(found, answer.place, patience=patience)
        return found

    async def ask(
        self,
        mirrored: MirroredComponent,
        what: str,
        body: Mapping[str, Any],
        timeout: float | None,
        awaited: str,
        *,
        method: str = "POST",
        is_write: bool = False,
        waits_for_ever: bool = False,
    ) -> Answer:
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
            patience = min(COMPONENT_TIMEOUT, COMPONENT_TIMEOUT if left is None else left)
            await self._until_heard(mirrored, patience)
            left = None if timeout is None else began + timeout - anyio.current_time()
            answer = await request(timeout=left)
        await self.until_current(mirrored, answer.place)
        return answer

    async def _until_heard(self, mirrored: MirroredComponent, patience: float) -> None:
        """Wait until the service knows a component again."""
        link, system, component = mirrored.key
        body = {"system": system, "component": component}
        awaited = f"{system}/{component} (lost)"
        await self.connection.ask("POST", "/find", body, awaited=awaited, timeout=patience, link=link)

    async def run(self) -> None:
        """Load what is not known to be the service's, for as long as the client is open."""
        while True:
            news = self.connection.news
            if self.connection.is_away or not (self._stale or self._is_list_stale):
                await news.wait()
                continue
            try:
                if self._is_list_stale:
                    await self.load_list()
                else:
                    await self._load(next(iter(self._stale.values())))
            except (Unreached, ParamClientError) as error:
                logger.info("%s: a table could not be loaded: %s", self.name, error)
                await anyio.sleep(RETRY_PAUSE)

    async def load_list(self) -> None:
        """Who is heard."""
        self._is_list_stale = False
        try:
            answer = await self._snapshot("/components", None)
            with understood(self.name):
                self._take_list(answer["components"], answer["seq"])
        except BaseException:
            self._is_list_stale = True
            raise
        self.connection.tell()

    def _take_list(self, documents: list[Document], seq: int) -> None:
        before, self.components = self.components, {}
        listed = [document for document in documents if self._link in (None, document["link"])]
        self.components = {key: before[key] for document in listed if (key := key_of(document)) in before}
        for document in listed:
            mirrored = self.meet(document, seq)
            mirrored.take_document(document, seq)
            mirrored.announce_first()
        for key, mirrored in before.items():
            if key not in self.components:
                self.components[key] = mirrored
                if mirrored.seq <= seq:  # else it was heard since
                    self._forget(mirrored)

    async def _load(self, mirrored: MirroredComponent) -> None:
        """The table of one."""
        mirrored.mirror.begin()
        try:
            answer = await self._snapshot(f"{mirrored.path}/params", mirrored.link_name)
        except NoReply:
            self._forget(mirrored)
            return
        with understood(self.name):
            changes = mirrored.mirror.load(answer["seq"], params_of(answer["params"]))
        if changes is not None:
            self._stale.pop(mirrored.key, None)
            mirrored.table_was_loaded(changes)
            self.connection.tell()

    async def _snapshot(self, path: str, link: str | None) -> Document:
        """What is known on the service at one moment, of the run whose events are heard."""
        asked = await self._requests.ask("GET", path, link=link, patience=ANSWER_PATIENCE)
        answer: Document = asked.document
        place = self.connection.place
        with understood(self.name):
            is_of_run = place is not None and answer["run"] == place.run
        if not is_of_run:
            raise LinkError(f"{self.name}: it has started again", link=self.name)
        return answer
