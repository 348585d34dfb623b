"""Who is heard on the links of a service, and the mirrors of their tables, kept in step with its events."""

from __future__ import annotations

import logging
import weakref
from typing import TYPE_CHECKING, Final

import anyio

from paramclient.client.events import Contested, Event, Events, Found, Lost, Rebooted, Resynced, Uncontested
from paramclient.errors import LinkError, NoReply, ParamClientError
from paramclient.remote.component import Key, RemoteComponent
from paramclient.remote.connection import Connection
from paramclient.remote.decoding import Document, hash_of, params_of, understood
from paramclient.remote.http import Answer, Place, Requests, Unreached

if TYPE_CHECKING:
    from paramclient.remote.client import RemoteClient

__all__ = ["Roster", "key_of"]

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
        client: whose components these are.
        requests: how requests travel.
        link: the name of the link that is meant, or None for all.

    Attributes:
        connection: where events come from.
        components: everyone, by link and address, in the order of the service.
        subscriptions: who listens to what happens to them.
        asker: who we are for the service.
        are_links_stale: is set when something has happened to a link.
    """

    def __init__(self, client: RemoteClient, requests: Requests, link: str | None) -> None:
        self.connection = Connection(requests, self)
        self.components: dict[Key, RemoteComponent] = {}
        self.subscriptions: weakref.WeakSet[Events] = weakref.WeakSet()
        self.asker = ""
        self.are_links_stale = anyio.Event()
        self._client = client
        self._requests = requests
        self._link = link
        self._is_list_stale = True
        self._stale: dict[Key, RemoteComponent] = {}
        self._gone: dict[Key, RemoteComponent] = {}

    def take(self, event: Document) -> None:
        """See `Follower`."""
        kind = event["type"]
        if kind == "link":
            self.are_links_stale.set()
        if "component" not in event or self._link not in (None, event["link"]):
            return
        component = self.components.get(key_of(event))
        match kind:
            case "component":
                self._take_component(event, component)
            case _ if component is None:
                self._is_list_stale = True
            case "change":
                component._take_change(event, self.asker)
            case "params":
                self._doubt(component)
            case "resynced":
                told = tuple(event["changed"])
                component._announce(Resynced(component, told, hash_of(event["hash"])))
            case "progress":
                component._take_progress(event)

    def leave(self) -> None:
        """See `Follower`."""
        for component in self.components.values():
            component._mirror.leave()

    def resume(self) -> None:
        """See `Follower`."""
        for component in self.components.values():
            component._mirror.resume()

    def begin_anew(self) -> None:
        """See `Follower`."""
        self._is_list_stale = True
        for component in self.components.values():
            component._seq = -1  # another run of the service counts from the beginning
            component._mirror.resume()
            self._doubt(component)

    def _take_component(self, event: Document, known: RemoteComponent | None) -> None:
        why = event["why"]
        if why == "forgotten":
            if known is not None:
                self._forget(known)
            return
        component = known or self.meet(event["component_doc"], event["seq"])
        state = component.state
        component._take_document(event["component_doc"], event["seq"])
        if component.state != state and component.state in UNSURE:
            self._doubt(component)
        match why:
            case "heard":
                component._announce_first()
            case "lost":
                self._doubt(component)
                component._announce(Lost(component, event["silence_s"]))
            case "found":
                component._announce(Found(component, event["silence_s"]))
            case "contested":
                self._doubt(component)
                if component.contest is not None:
                    component._announce(Contested(component, component.contest))
            case "uncontested":
                self._doubt(component)
                component._announce(Uncontested(component))
            case "rebooted":
                self._doubt(component)
                component._announce(Rebooted(component))

    def publish(self, event: Event) -> None:
        """Tell those who listen."""
        for events in list(self.subscriptions):
            events.push(event)

    def meet(self, document: Document, seq: int) -> RemoteComponent:
        """The component of a document that tells how it stood after this event; it may be new here."""
        key = key_of(document)
        component = self.components.get(key)
        if component is None:
            if len(self.components) >= MOST_COMPONENTS:
                raise ValueError(f"more than {MOST_COMPONENTS} components")
            component = self._gone.pop(key, None) or RemoteComponent(self._client, document, seq)
            component._return(document, seq)
            self.components[key] = component
            self._stale[key] = component
            self.connection.tell()
        return component

    def _doubt(self, component: RemoteComponent) -> None:
        component._mirror.doubt()
        self._stale[component._key] = component

    def _forget(self, component: RemoteComponent) -> None:
        """The service does not know it any more, or not yet again: it may have started anew, or its link."""
        key = component._key
        self._stale.pop(key, None)
        if self.components.pop(key, None) is not None:
            component._leave()
            self._gone[key] = component
            if len(self._gone) > MOST_GONE:
                self._gone.pop(next(iter(self._gone)))._part()

    def same_ids(self, component: RemoteComponent) -> list[RemoteComponent]:
        """All with its ids, on whatever link."""
        return [each for key, each in self.components.items() if key[1:] == component._key[1:]]

    # what is loaded

    async def until_current(
        self, component: RemoteComponent | None, place: Place | None, *, patience: float | None = CATCHING_UP
    ) -> None:
        """Wait until what had happened up to a place is in a table, but not for longer than this.

        Raises:
            LinkError: the service cannot be reached.
        """
        connection = self.connection
        with anyio.move_on_after(patience):
            while component is not None:
                has_come = (
                    place is None
                    or connection.place is None
                    or connection.place.run != place.run
                    or connection.place.seq >= place.seq
                )
                if has_come and component._mirror.is_loaded:
                    return
                if component._key in self._stale:  # it is the next to be loaded
                    self._stale = {component._key: component, **self._stale}
                await connection.news.wait()
                connection.check_open()

    async def given(self, answer: Answer, patience: float | None = CATCHING_UP) -> RemoteComponent:
        """The component that an answer is about, with its table."""
        with understood(self._requests.name):
            found = self.meet(answer.document, -1 if answer.place is None else answer.place.seq)
        await self.until_current(found, answer.place, patience=patience)
        return found

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
                logger.info("%s: a table could not be loaded: %s", self._requests.name, error)
                await anyio.sleep(RETRY_PAUSE)

    async def load_list(self) -> None:
        """Who is heard."""
        self._is_list_stale = False
        try:
            answer = await self._snapshot("/components", None)
            with understood(self._requests.name):
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
            component = self.meet(document, seq)
            component._take_document(document, seq)
            component._announce_first()
        for key, component in before.items():
            if key not in self.components:
                self.components[key] = component
                if component._seq <= seq:  # else it was heard since
                    self._forget(component)

    async def _load(self, component: RemoteComponent) -> None:
        """The table of one."""
        component._mirror.begin()
        try:
            answer = await self._snapshot(f"{component._path}/params", component.link_name)
        except NoReply:
            self._forget(component)
            return
        with understood(self._requests.name):
            changes = component._mirror.load(answer["seq"], params_of(answer["params"]))
        if changes is not None:
            self._stale.pop(component._key, None)
            component._loaded(changes)
            self.connection.tell()

    async def _snapshot(self, path: str, link: str | None) -> Document:
        """What is known on the service at one moment, of the run whose events are heard."""
        asked = await self._requests.ask("GET", path, link=link, patience=ANSWER_PATIENCE)
        answer: Document = asked.document
        place = self.connection.place
        with understood(self._requests.name):
            is_of_run = place is not None and answer["run"] == place.run
        if not is_of_run:
            raise LinkError(f"{self._requests.name}: it has started again", link=self._requests.name)
        return answer


def key_of(document: Document) -> Key:
    """Which component a document is about."""
    return str(document["link"]), int(document["system"]), int(document["component"])
