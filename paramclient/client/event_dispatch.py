"""EventDispatch: passes the events of the protocol core to components, streams and the cache."""

from __future__ import annotations

import logging
from functools import partial

import anyio

from paramclient.client.component import Component
from paramclient.client.component_core import ComponentCore
from paramclient.client.core import ClientCore
from paramclient.client.events import Event, public_event
from paramclient.client.subscription import Subscribers
from paramclient.errors import LinkError
from paramclient.model.identity import Identity
from paramclient.protocol import events as protocol
from paramclient.protocol.addresses import Address
from paramclient.protocol.component import ComponentMachine

__all__ = ["EventDispatch"]

logger = logging.getLogger("paramclient.client")


class EventDispatch:
    """The components of a client, and what the events of the protocol core change in them.

    Args:
        core: the running parts of the client.
        splits_peers: whether equal ids at different peers are different components.

    Attributes:
        components: the components by address.
        events: the streams of component events.
        downloads: number of complete downloads.
        cache_hits: number of fetches served from the cache.
    """

    def __init__(self, core: ClientCore, *, splits_peers: bool) -> None:
        self.components: dict[Address, Component] = {}
        self.events: Subscribers[Event] = Subscribers()
        self.downloads = self.cache_hits = 0
        self._core = core
        self._splits_peers = splits_peers
        core.dispatch, core.end_streams = self.dispatch, self._end_streams

    def dispatch(self) -> None:
        """Process the events of the protocol core: components, streams and cache."""
        writer, is_to_be_written = self._core.cache_writer, False
        for event in self._core.station.events():
            machine = event.machine
            if isinstance(event, protocol.ParamChanged | protocol.TableChanged):
                self.components[machine.address].core.take_change(event)
                is_to_be_written = True
                continue
            if isinstance(event, protocol.ExtParamChanged):
                self.components[machine.address].core.ext_changes.push(event.change)
                is_to_be_written = True
                continue
            logger.debug("%s", event)
            if isinstance(event, protocol.Fetched):
                self.cache_hits += event.result.source == "cache"
                self.downloads += event.result.source != "cache" and event.result.complete
            if isinstance(event, protocol.ComponentForgotten):
                self.components.pop(machine.address).core.forget()
                continue
            if isinstance(event, protocol.ComponentDiscovered):
                self._meet(machine)
            elif isinstance(event, protocol.ComponentLost | protocol.ComponentFound) and self._splits_peers:
                self._transfer_cache_entry(machine, is_lost=isinstance(event, protocol.ComponentLost))
            elif isinstance(event, protocol.ComponentContested):
                writer.discard_queued(machine)
                logger.warning("%s: %s", self._core.link.name, event.contest.error)
            elif isinstance(event, protocol.ComponentUncontested | protocol.ComponentReplaced):
                writer.discard_queued(machine)
            elif isinstance(event, protocol.ComponentIdentified):
                self._core.link_task.notify()
                for component in self.components.values():
                    if component.core.machine.vehicle == machine.vehicle:
                        self._read_cache(component.core)
            elif isinstance(event, protocol.Fetched) and event.result.complete and event.result.is_confirmed:
                is_whole = event.result.source != "cache" and not event.result.resumed
                writer.synced(machine, is_whole=is_whole)
                is_to_be_written = True
            elif isinstance(event, protocol.TableResynced):
                if event.hash is not None:  # otherwise single reads have followed it, and verified no value
                    writer.synced(machine, is_whole=False)
                is_to_be_written = True
            if len(self.events):
                self._announce(event)
        if is_to_be_written:
            writer.wake()
        if self._core.station.is_over:
            self._end_streams(None)

    def _announce(self, event: protocol.Event) -> None:
        """Push an event to all streams, if it has a public form."""
        public = public_event(event, self.components[event.machine.address])
        if public is not None:
            self.events.push(public)

    def _meet(self, machine: ComponentMachine) -> None:
        """Add a new component, load its cached table, and request its hash if that may confirm the table."""
        address = (machine.system, machine.component)
        now = anyio.current_time()
        component = Component(ComponentCore(self._core, machine, now), self.components)
        self.components[machine.address] = component
        self._read_cache(component.core)
        if self._core.cache_writer.may_hit(*address):
            machine.sync.ask(now)

    def _read_cache(self, component: ComponentCore) -> None:
        """Load the cached table of a component, if its identity is known."""
        identity = component.settled_identity
        if identity is not None and not self._core.cache_writer.follow(component.machine, identity):
            self._core.start(partial(self._load, component, identity))

    async def _load(self, component: ComponentCore, identity: Identity) -> None:
        if await self._core.cache_writer.load_cached(component.machine, identity):
            component.cache_was_read()
            self._core.cache_writer.wake()
            self.dispatch()

    def _transfer_cache_entry(self, machine: ComponentMachine, *, is_lost: bool) -> None:
        """Pass the cache entry of a lost component to one with equal ids at another peer.

        The vehicle may have returned at another peer. The cache has one table for equal ids.
        """
        if is_lost:
            self._core.cache_writer.discard_queued(machine)
        for component in self.components.values():
            other = component.core.machine
            if (other.system, other.component) == (machine.system, machine.component) and (
                not other.presence.is_lost
            ):
                self._read_cache(component.core)

    def _end_streams(self, error: LinkError | None) -> None:
        for component in self.components.values():
            component.core.cache_was_read()
            component.core.end(error)
        self.events.end(error)
