"""One link of the service: opened, followed, and opened again for as long as the service runs."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import anyio
import anyio.lowlevel

from paramclient.client.client import ParamClient, local_client
from paramclient.client.events import (
    Contested,
    Event,
    Events,
    Found,
    Heard,
    Lost,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.documents.link import LinkDoc, StatsDoc
from paramclient.errors import LinkError, ParamClientError, UsageError
from paramclient.model.notation import hash_text, rounded
from paramclient.service.followed_component import Followed

if TYPE_CHECKING:
    from paramclient.service.event_feed import Feed

__all__ = ["LOOKED_AT_ONCE", "Line"]

FIRST_BACKOFF: Final = 0.25
LONGEST_BACKOFF: Final = 5.0
"""Seconds between two attempts to open a link: doubled from the first to the longest, as when one drops."""
LOOK_INTERVAL: Final = 0.2
"""Seconds between two looks at what nobody tells of: states, progress."""
LOOKS_AT_VALUES: Final = 5
"""Of so many looks one goes through all values too."""
LOOKED_AT_ONCE: Final = 16
"""Components that are looked at before the event loop comes round: 3 ms where each has something to tell."""

logger = logging.getLogger(__name__)


class Line:
    """One link, and who is heard on it.

    Args:
        name: what the service calls it.
        make: gives a new client for it, not yet opened.
        feed: where to tell of it.
        met: is told of every component that is heard, or has come back.

    Attributes:
        name: as given.
        state: opening, open, away (dropped, and being opened again), failed (to be tried again), ended (a log
            that is over).
        error: why, for away and failed.
        openings: how often it has been opened with a fresh client.
        client: the client, or None while there is none.
        followed: who is heard, by (system, component).
        news: is set, and replaced, when anybody was heard or the state has changed.
    """

    def __init__(
        self, name: str, make: Callable[[], ParamClient], feed: Feed, met: Callable[[Followed], None]
    ) -> None:
        self.name = name
        self.state = "opening"
        self.error: str | None = None
        self.openings = 0
        self.client: ParamClient | None = None
        self.followed: dict[tuple[int, int], Followed] = {}
        self.news = anyio.Event()
        self._make = make
        self._feed = feed
        self._met = met
        self._over: anyio.Event = anyio.Event()
        self._ending: ParamClientError | None = None

    def __repr__(self) -> str:
        return f"<Line {self.name} {self.state}>"

    @property
    def document(self) -> LinkDoc:
        """How it stands now."""
        client = self.client
        return LinkDoc(
            name=self.name,
            state=self.state,
            error=self.error,
            listens_only=client is not None and client.listens_only,
            components=len(self.followed),
            openings=self.openings,
            stats=None if client is None else StatsDoc.of(client.stats),
        )

    async def run(self) -> None:
        """Hold it open, until cancelled."""
        backoff = FIRST_BACKOFF
        while True:
            try:
                async with self._make() as client:
                    self.client = client
                    self._follow(client)
                    backoff = FIRST_BACKOFF
                    await self._watch()
            except (LinkError, UsageError) as error:  # the latter where a library is missing, or a log exists
                self._become("failed", str(error))
            finally:
                self.client = None
                for followed in list(self.followed.values()):
                    self.forget(followed)
            await anyio.sleep(backoff)
            backoff = min(backoff * 2, LONGEST_BACKOFF)

    async def wait_for(self, system: int | None, component: int | None) -> Followed:
        """The component with this address as soon as it is heard, however often the link must be opened."""
        while True:
            news, client = self.news, self.client
            if client is not None:
                with suppress(LinkError):
                    found = await client.component(system, component, timeout=None)
                    followed = self.followed.get((found.system, found.component))
                    if followed is not None and followed.component is found:
                        return followed
            await news.wait()

    def happened(self, event: Event) -> None:
        """The client tells of something, at the moment at which it happens."""
        component = event.component
        address = (component.system, component.component)
        match event:
            case Heard():
                followed = self.followed[address] = Followed(component, self, self._feed)
                followed.tell_of_it("heard")
                self._met(followed)
                self._tell()
            case Lost(silence=silence):
                self.followed[address].look()
                self.followed[address].tell_of_it("lost", silence_s=rounded(silence))
            case Found(silence=silence):
                self.followed[address].look()
                self.followed[address].tell_of_it("found", silence_s=rounded(silence))
                self._met(self.followed[address])
            case Rebooted():
                self.followed[address].look()
                self.followed[address].tell_of_it("rebooted")
                self._met(self.followed[address])
            case Contested():
                self.followed[address].look()
                self.followed[address].tell_of_it("contested")
            case Uncontested():
                self.followed[address].look()
                self.followed[address].tell_of_it("uncontested")
                self._met(self.followed[address])
            case Resynced(changed=changed, hash=crc):
                self.followed[address].look()
                self.followed[address].tell("resynced", {"changed": list(changed), "hash": hash_text(crc)})

    def over(self, error: ParamClientError | None) -> None:
        """Nothing more will come from the client."""
        self._ending = error
        self._over.set()

    def forget(self, followed: Followed) -> None:
        """It is not followed any more."""
        followed.close()
        if self.followed.get(followed.address) is followed:
            del self.followed[followed.address]
            followed.tell_of_it("forgotten")

    def _follow(self, client: ParamClient) -> None:
        self.openings += 1
        self._over = anyio.Event()
        self._ending = None
        self._sink = _Sink(self)
        local_client(client).subscribe(self._sink)
        for component in client.components.values():
            self.happened(Heard(component))
        self._become("open")

    async def _watch(self) -> None:
        """Tell of what nobody tells of, until the link has failed for good."""
        looks = 0
        while not self._over.is_set():
            with anyio.move_on_after(LOOK_INTERVAL):
                await self._over.wait()
            looks += 1
            self._look_at_link()
            for number, followed in enumerate(list(self.followed.values()), 1):
                if looks % LOOKS_AT_VALUES:
                    followed.look_at_state()
                else:
                    followed.look()
                if not number % LOOKED_AT_ONCE:
                    await anyio.lowlevel.checkpoint()
        if self._ending is not None:
            raise self._ending
        self._become("ended")
        await anyio.sleep_forever()

    def _look_at_link(self) -> None:
        client = self.client
        if client is None:
            return
        task = local_client(client).link_task
        if task.is_away:
            error = self.error if task.broken is None else str(task.broken)
            self._become("away", error or f"{self.name} has dropped and is being opened again")
        elif self.state == "away":
            self._become("open")

    def _become(self, state: str, error: str | None = None) -> None:
        if (state, error) == (self.state, self.error):
            return
        (logger.warning if state == "failed" and self.state != "failed" else logger.info)(
            "%s: %s%s", self.name, state, "" if error is None else f": {error}"
        )
        self.state, self.error = state, error
        self._feed.publish("link", {"state": state, "error": error}, link=self.name)
        self._tell()

    def _tell(self) -> None:
        news, self.news = self.news, anyio.Event()
        news.set()


class _Sink(Events):
    """Hands events on at once, in place of keeping them for a task: between a component and its first values
    nothing is missed."""

    def __init__(self, owner: Line) -> None:
        super().__init__()
        self._owner = owner

    def push(self, item: Event) -> None:
        self._owner.happened(item)

    def end(self, error: ParamClientError | None) -> None:
        self._owner.over(error)
