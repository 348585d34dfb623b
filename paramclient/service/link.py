"""One link of the service: opening, events, polling of its components, reopening."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import anyio
import anyio.lowlevel

from paramclient.client.client import ParamClient
from paramclient.client.events import (
    Contested,
    Discovered,
    Event,
    Found,
    Lost,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.client.reconnect_delays import Backoff
from paramclient.client.streams import Events
from paramclient.documents.link import LinkDoc, StatsDoc
from paramclient.errors import LinkError, ParamClientError, UsageError
from paramclient.model.notation import hash_text, rounded
from paramclient.service.followed_component import FollowedComponent

if TYPE_CHECKING:
    from paramclient.service.event_feed import EventFeed

__all__ = ["COMPONENTS_PER_TURN", "ServiceLink"]

LINK_STATE_CHECK_INTERVAL: Final = 0.2
"""Seconds between two checks for changes without an event: states, progress."""
CHECKS_PER_VALUE_CHECK: Final = 5
"""Number of checks of which one includes all values."""
COMPONENTS_PER_TURN: Final = 16
"""Number of components checked in one turn of the event loop: 3 ms if each publishes an event."""

logger = logging.getLogger(__name__)


class ServiceLink:
    """One link and the components on it.

    Args:
        name: name of the link in the service.
        make: creates a client for it, not yet open.
        feed: the event feed.
        on_found: called with every component that is heard, found again, or restarted.

    Attributes:
        name: name of the link in the service.
        state: opening; open; reconnecting (the connection was lost); failed (reopened after a backoff); ended
            (end of a log).
        error: reason of reconnecting and failed, or None.
        openings: number of opened clients.
        client: the open client, or None.
        followed: its components, by system and component id.
        changed: set and replaced after each new component or change of the state.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], ParamClient],
        feed: EventFeed,
        on_found: Callable[[FollowedComponent], None],
    ) -> None:
        self.name = name
        self.state = "opening"
        self.error: str | None = None
        self.openings = 0
        self.client: ParamClient | None = None
        self.followed: dict[tuple[int, int], FollowedComponent] = {}
        self.changed = anyio.Event()
        self._make = make
        self._feed = feed
        self._on_found = on_found
        self._ended: anyio.Event = anyio.Event()
        self._ending: ParamClientError | None = None

    def __repr__(self) -> str:
        return f"<ServiceLink {self.name} {self.state}>"

    @property
    def document(self) -> LinkDoc:
        """Return its current state."""
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
        """Keep the link open until cancelled."""
        backoff = Backoff()
        while True:
            try:
                async with self._make() as client:
                    self.client = client
                    self._attach(client)
                    backoff = Backoff()
                    await self._check_components()
            except (LinkError, UsageError) as error:  # UsageError: a missing library, an existing log
                self._set_state("failed", str(error))
            finally:
                self.client = None
                for followed in list(self.followed.values()):
                    self.forget(followed)
            await backoff.wait()

    async def wait_for(self, system: int | None, component: int | None) -> FollowedComponent:
        """Wait for the component with this address, also while the link is reopened."""
        while True:
            changed, client = self.changed, self.client
            if client is not None:
                with suppress(LinkError):
                    found = await client.component(system, component, timeout=None)
                    followed = self.followed.get((found.system, found.component))
                    if followed is not None and followed.component is found:
                        return followed
            await changed.wait()

    def handle_event(self, event: Event) -> None:
        """Handle an event of the client immediately."""
        component = event.component
        address = (component.system, component.component)
        match event:
            case Discovered():
                followed = self.followed[address] = FollowedComponent(component, self, self._feed)
                followed.publish_state("discovered")
                self._on_found(followed)
                self._notify()
            case Lost(silence=silence):
                self.followed[address].publish_changes()
                self.followed[address].publish_state("lost", silence_s=rounded(silence))
            case Found(silence=silence):
                self.followed[address].publish_changes()
                self.followed[address].publish_state("found", silence_s=rounded(silence))
                self._on_found(self.followed[address])
            case Rebooted():
                self.followed[address].publish_changes()
                self.followed[address].publish_state("rebooted")
                self._on_found(self.followed[address])
            case Contested():
                self.followed[address].publish_changes()
                self.followed[address].publish_state("contested")
            case Uncontested():
                self.followed[address].publish_changes()
                self.followed[address].publish_state("uncontested")
                self._on_found(self.followed[address])
            case Resynced(changed=changed, hash=crc):
                self.followed[address].publish_changes()
                self.followed[address].publish("resynced", {"changed": list(changed), "hash": hash_text(crc)})

    def handle_end(self, error: ParamClientError | None) -> None:
        """Handle the end of the client's events."""
        self._ending = error
        self._ended.set()

    def forget(self, followed: FollowedComponent) -> None:
        """Stop following a component."""
        followed.close()
        if self.followed.get(followed.address) is followed:
            del self.followed[followed.address]
            followed.publish_state("forgotten")

    def _attach(self, client: ParamClient) -> None:
        self.openings += 1
        self._ended = anyio.Event()
        self._ending = None
        self._forwarder = _EventForwarder(self)
        client.dispatch.events.add(self._forwarder)
        for component in client.components.values():
            self.handle_event(Discovered(component))
        self._set_state("open")

    async def _check_components(self) -> None:
        """Publish changes without an event, until the link has failed permanently."""
        checks = 0
        while not self._ended.is_set():
            with anyio.move_on_after(LINK_STATE_CHECK_INTERVAL):
                await self._ended.wait()
            checks += 1
            self._check_link_state()
            for number, followed in enumerate(list(self.followed.values()), 1):
                if checks % CHECKS_PER_VALUE_CHECK:
                    followed.publish_state_changes()
                else:
                    followed.publish_changes()
                if not number % COMPONENTS_PER_TURN:
                    await anyio.lowlevel.checkpoint()
        if self._ending is not None:
            raise self._ending
        self._set_state("ended")
        await anyio.sleep_forever()

    def _check_link_state(self) -> None:
        client = self.client
        if client is None:
            return
        task = client.core.link_task
        if task.is_disconnected:
            error = self.error if task.broken is None else str(task.broken)
            self._set_state("reconnecting", error or f"{self.name} is disconnected and reconnects")
        elif self.state == "reconnecting":
            self._set_state("open")

    def _set_state(self, state: str, error: str | None = None) -> None:
        if (state, error) == (self.state, self.error):
            return
        (logger.warning if state == "failed" and self.state != "failed" else logger.info)(
            "%s: %s%s", self.name, state, "" if error is None else f": {error}"
        )
        self.state, self.error = state, error
        self._feed.publish("link", {"state": state, "error": error}, link=self.name)
        self._notify()

    def _notify(self) -> None:
        changed, self.changed = self.changed, anyio.Event()
        changed.set()


class _EventForwarder(Events):
    """Forwards events immediately, in place of queueing them for a task, so that no value between a
    component's discovery and its first values is missed."""

    def __init__(self, owner: ServiceLink) -> None:
        super().__init__()
        self._owner = owner

    def push(self, item: Event) -> None:
        self._owner.handle_event(item)

    def end(self, error: ParamClientError | None) -> None:
        self._owner.handle_end(error)
