"""LinkClient: the implementation of `ParamClient` over a link of this process."""

from __future__ import annotations

import logging
import math
import os
import weakref
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import anyio
import anyio.abc

from paramclient.cache import ParamCache
from paramclient.client.arguments import COMPONENT_TIMEOUT, address_in_words
from paramclient.client.cache_writer import CacheWriter, choose_cache
from paramclient.client.component import Component
from paramclient.client.events import Events, public_event
from paramclient.client.fetch_all import FetchedAll, FleetFetch
from paramclient.client.files import Ftp
from paramclient.client.link_component import LinkComponent, fetch_timeout
from paramclient.client.link_task import LinkTask
from paramclient.client.local import LocalClient, local
from paramclient.client.signing import Signing, refused_in_words
from paramclient.client.signing_timestamps import TimestampKeeper
from paramclient.client.stats import ClientStats
from paramclient.client.taps import LinkTaps
from paramclient.client.vehicle_search import find_autopilots
from paramclient.errors import ClientClosed, LinkError, NoReply, UsageError
from paramclient.links import Link, ReplayLink, SimLink, create_link
from paramclient.model.identity import Identity
from paramclient.model.values import Encoding
from paramclient.protocol.addresses import Address
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import (
    ComponentContested,
    ComponentDiscovered,
    ComponentForgotten,
    ComponentFound,
    ComponentIdentified,
    ComponentLost,
    ComponentReplaced,
    ComponentUncontested,
    Event,
    ExtParamChanged,
    Fetched,
    ParamChanged,
    TableChanged,
    TableResynced,
)
from paramclient.protocol.no_reply_hint import hint_of_link
from paramclient.protocol.params.fetch_result import Policy, Progress
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.station import Station
from paramclient.protocol.stats.traffic import TrafficReport
from paramclient.protocol.system_id_change import SEARCH_INTERVAL, SystemIdSearch
from paramclient.protocol.vehicle_selection import LOOK_TIME, VehicleChoice
from paramclient.protocol.wire import SigningKey, SigningReport

if TYPE_CHECKING:
    from paramclient.sim import Endpoint
from paramclient.model.wording import counted

__all__ = ["LinkClient", "ClientOptions"]

LISTENING_TIME: Final = 1.2
"""Seconds after opening in which every component has sent a message: each sends a heartbeat once a second."""
CLOSING_HASH_TIMEOUT: Final = 0.5
"""Seconds for which closing waits for the hash after a write, if the next session needs it for the cache."""
SESSION_CLOSE_TIMEOUT: Final = 2.0
"""Seconds for which closing waits for the end of file sessions on board. The request has been sent by then; a
running burst on a radio delays it, and the vehicle executes it after the burst."""

logger = logging.getLogger(__name__)
protocol_logger = logging.getLogger("paramclient.protocol")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientOptions:
    """The arguments of `ParamClient` for a link of its own, with their defaults."""

    cache: ParamCache | str | os.PathLike[str] | bool | None = None
    system: int = 255
    component: int = 190
    encoding: Encoding | None = None
    watch_interval: float | None = None
    policy: Policy | str = Policy.AUTO
    traffic: bool = False
    listen_only: bool = False
    forward: str | Link | None = None
    tlog: str | os.PathLike[str] | None = None
    signing: Signing | SigningKey | None = None
    split_peers: bool = False


class LinkClient(LocalClient):
    """A client over a link of this process: the link, the protocol core, the cache and their tasks.

    Args:
        link: as in `ParamClient`.
        options: the other arguments of `ParamClient`.

    Raises:
        UsageError: as from `ParamClient`.
    """

    def __init__(self, link: str | Link | Endpoint, options: ClientOptions) -> None:
        for number in (options.system, options.component):
            if not 1 <= number <= 255:
                raise UsageError(f"the client's system and component ids must be 1 to 255, not {number}")
        self._link = create_link(link)
        is_log = isinstance(self._link, ReplayLink)
        self.cache = choose_cache(options.cache, is_log=is_log)
        self.station = Station(
            link=self._link.name,
            is_stream=self._link.is_stream,
            system=options.system,
            component=options.component,
            encoding=options.encoding,
            sync_settings=SyncSettings.chosen(
                options.watch_interval, options.policy, listen_only=options.listen_only, is_log=is_log
            ),
            split_peers=options.split_peers,
            counts_traffic=options.traffic,
            trace=protocol_logger.debug,
        )
        self.cache_writer = CacheWriter(
            self.cache,
            owned=self.cache is not options.cache,
            identity_of=self.station.identity_of,
            is_doubted=self.station.is_doubted,
            detect_suspend=lambda: self.link_task.detect_suspend(),
        )
        self._subscriptions: weakref.WeakSet[Events] = weakref.WeakSet()
        self._components: dict[Address, LinkComponent] = {}
        self._tasks: anyio.abc.TaskGroup | None = None
        self._outlasting: list[anyio.CancelScope] = []
        self._link_taps = LinkTaps(options.tlog, options.forward, is_stream=self._link.is_stream)
        self.link_task = LinkTask(
            self._link,
            self.station,
            dispatch=self._dispatch,
            end=self._end,
            taps=self._link_taps.taps,
            may_rest=self._link_taps.forwarder is None,
        )
        if not self.listens_only:
            self._link_taps.share(self.link_task.send_for_another)
        self._downloads = self._cache_hits = 0
        signing = options.signing
        if isinstance(signing, SigningKey):
            signing = Signing(signing)
        self._keeper = None if signing is None else TimestampKeeper(signing)
        self._splits_peers = options.split_peers
        self._is_entered = False
        self.opened_at = -math.inf

    @property
    def components(self) -> Mapping[Address, Component]:
        """See `ParamClient.components`."""
        return MappingProxyType(self._components)

    @property
    def autopilots(self) -> list[Component]:
        """See `ParamClient.autopilots`."""
        station = self.station
        machines = dict.fromkeys(machine.vehicle for machine in station.components.values())
        vehicles = sorted(machines, key=lambda vehicle: vehicle[0])
        found = [station.autopilot_of(*vehicle) for vehicle in vehicles]
        return [self._components[machine.address] for machine in found if machine is not None]

    @property
    def link(self) -> Link:
        """See `ParamClient.link`."""
        return self._link

    @property
    def listens_only(self) -> bool:
        """See `ParamClient.listens_only`."""
        return self.station.listens_only

    @property
    def bytes_received(self) -> int:
        """See `ParamClient.bytes_received`."""
        return self.station.bytes_received

    @property
    def bytes_sent(self) -> int:
        """See `ParamClient.bytes_sent`."""
        return self.station.bytes_sent

    @property
    def stats(self) -> ClientStats:
        """See `ParamClient.stats`."""
        return ClientStats.of(self.station, downloads=self._downloads, cache_hits=self._cache_hits)

    def __repr__(self) -> str:
        state = "reconnecting" if self.link_task.is_disconnected else "open"
        state = "closed" if self._tasks is None or self.link_task.ended is not None else state
        return f"<ParamClient {self._link.name} {state}, {counted(len(self._components), 'component')}>"

    async def open(self) -> None:
        """Open the link and the cache, and start the tasks.

        Raises:
            UsageError, LinkError: as from entering a `ParamClient`.
        """
        if self._is_entered:
            raise UsageError("a ParamClient can be opened only once; create a new one")
        self._is_entered = True
        try:
            await self._link.open()
            await self.cache_writer.open()
            await self._link_taps.open()
            if self._keeper is not None:
                self.station.begin_signing(*await self._keeper.open())
        except BaseException:
            await self._release()
            raise
        logger.debug("%s: open", self._link.name)
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        self._tasks = tasks
        self.opened_at = self.station.listening_since = anyio.current_time()
        tasks.start_soon(self._run_until_files_closed, self.link_task.read, name="paramclient reader")
        tasks.start_soon(self._run_until_files_closed, self.link_task.send, name="paramclient sender")
        tasks.start_soon(self.cache_writer.run, name="paramclient cache writer")
        self._link_taps.start(tasks)
        if self._keeper is not None:
            tasks.start_soon(self._keeper.run, name="paramclient timestamp keeper")

    async def close(self, *, failed: bool) -> None:
        """End waiting calls, write new values, and release the link and the cache.

        Cancellation does not skip these steps.

        Args:
            failed: whether the body of the `async with` has raised; then closing does not wait for a hash.
        """
        tasks = self._tasks
        assert tasks is not None
        try:
            if not failed and self.link_task.broken is None:
                await self._let_hashes_settle()
        finally:
            closed = ClientClosed("the client was closed", link=self._link.name)
            try:
                await self._close_files(closed)
            finally:
                self._end(closed)
                for scope in (*self._outlasting, tasks.cancel_scope):
                    scope.cancel()
            try:
                # without the caller's exception, which the task group would wrap in an ExceptionGroup
                await tasks.__aexit__(None, None, None)
            finally:
                await self._release()

    async def _release(self) -> None:
        """Close the link, the cache and the taps, also when cancelled."""
        logger.debug("%s: closing", self._link.name)
        with anyio.CancelScope(shield=True):
            try:
                await self._link.close()
                for machine in self.station.components.values():
                    await self.cache_writer.save_on_close(machine)
            finally:
                try:
                    await self.cache_writer.close()
                finally:
                    try:
                        if self._keeper is not None:
                            await self._keeper.close()
                    finally:
                        await self._link_taps.close()

    def events(self) -> Events:
        """See `ParamClient.events`."""
        events = Events()
        self.subscribe(events)
        return events

    def subscribe(self, events: Events) -> None:
        """See `LocalClient.subscribe`."""
        self._subscriptions.add(events)
        if self.is_over:
            events.end(self.link_task.ended)

    def ftp(self, component: Component) -> Ftp:
        """See `ParamClient.ftp`."""
        return Ftp(component)

    async def component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """See `ParamClient.component`."""
        self.check_open()
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            while (found := self._find(system, component, peer)) is None and not self.station.is_over:
                await self.link_task.activity.wait()
                self.check_open()
            if found is not None:
                await found.wait_for_cache()
        if found is None:
            raise self._not_received(address_in_words(system, component, peer), began)
        return found

    async def find_autopilots(
        self, *, expect: int | None = None, timeout: float | None = COMPONENT_TIMEOUT
    ) -> list[Component]:
        """See `ParamClient.find_autopilots`."""
        found = await find_autopilots(self, expect=expect, timeout=timeout)
        for each in found:
            await local(each).wait_for_cache()
        return found

    async def only_component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """See `ParamClient.only_component`."""
        if self._has_one_vehicle:
            return await self.component(system, component, peer=peer, timeout=timeout)
        self.check_open()
        began = anyio.current_time()
        choice = VehicleChoice(system, component, splits_peers=self._splits_peers)
        station = self.station
        machine = None
        with anyio.move_on_after(timeout), station.looking_for_others():
            while True:
                activity, now = self.link_task.activity, anyio.current_time()
                since = station.listening_since
                machine = choice.look(station.at_peer(peer), now, listening_since=since)
                if machine is not None or station.is_over:
                    break
                with anyio.move_on_after(None if choice.due == math.inf else choice.due - now):
                    await activity.wait()
                await self.link_task.wait_for_reader(choice.due)
                self.check_open()
            if machine is not None:
                await self._components[machine.address].wait_for_cache()
        if machine is not None:
            return self._components[machine.address]
        awaited = address_in_words(system, component, peer)
        if choice.due < math.inf:
            awaited += f", then {LOOK_TIME} s without another vehicle"
            raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began)
        raise self._not_received(awaited, began)

    def _not_received(self, awaited: str, began: float) -> NoReply:
        """Return the error of a component that was not received, with what was received instead."""
        refused = refused_in_words(self.signing_report())
        hint = "" if refused else hint_of_link(self.station, self._link.name)
        waited = anyio.current_time() - began
        return NoReply(f"{awaited}{refused}", attempts=0, waited=waited, hint=hint)

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = COMPONENT_TIMEOUT
    ) -> Component:
        """See `ParamClient.successor`."""
        self.check_open()
        began = anyio.current_time()
        machine = local(component).machine
        search = SystemIdSearch(machine, machine.address_in(system))
        with anyio.move_on_after(timeout):
            while not search.look(self.station.components, anyio.current_time()):
                self.wake()
                with anyio.move_on_after(SEARCH_INTERVAL):
                    await self.link_task.activity.wait()
                self.check_open()
            found = self._components[search.address]
            await found.wait_for_cache()
            return found
        raise NoReply(search.awaited, attempts=0, waited=anyio.current_time() - began)

    async def fetch_all(
        self,
        system: int | None = None,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Mapping[Address, Progress]], None] | None = None,
    ) -> FetchedAll:
        """See `ParamClient.fetch_all`."""
        self.station.check_refresh(refresh)
        timeout = fetch_timeout(self.station, timeout)
        began = anyio.current_time()
        together = FleetFetch(self.station, self._components, system, refresh=refresh)
        return await together.run(
            self.check_open,
            self.wake,
            self.wait_until_files_closed,
            until=math.inf if timeout is None else began + timeout,
            hear_until=began + (COMPONENT_TIMEOUT if timeout is None else timeout),
            listen_until=self.opened_at + LISTENING_TIME,
            progress=progress,
        )

    def traffic_report(self) -> TrafficReport:
        """See `ParamClient.traffic_report`."""
        if self.station.traffic is None:
            raise UsageError("this client does not count traffic; use ParamClient(..., traffic=True)")
        self.check_open()
        return self.station.traffic.report(anyio.current_time())

    def signing_report(self) -> SigningReport | None:
        """See `ParamClient.signing_report`."""
        return None if self.station.verifier is None else self.station.verifier.report()

    # events of the protocol core
    async def _load(self, component: LinkComponent, identity: Identity) -> None:
        if await self.cache_writer.load_cached(component.machine, identity):
            component.cache_was_read()
            self.cache_writer.wake()
            self._dispatch()

    def _dispatch(self) -> None:
        """Process the events of the protocol core: components, streams and cache."""
        is_to_be_written = False
        for event in self.station.events():
            machine = event.machine
            if isinstance(event, ParamChanged | TableChanged):
                self._components[machine.address].take_change(event)
                is_to_be_written = True
                continue
            if isinstance(event, ExtParamChanged):
                self._components[machine.address].ext.take_change(event.change)
                is_to_be_written = True
                continue
            logger.debug("%s", event)
            if isinstance(event, Fetched):
                self._cache_hits += event.result.source == "cache"
                self._downloads += event.result.source != "cache" and event.result.complete
            if isinstance(event, ComponentForgotten):
                self._components.pop(machine.address).forget()
                continue
            if isinstance(event, ComponentDiscovered):
                self._meet(machine)
            elif isinstance(event, ComponentLost | ComponentFound) and self._splits_peers:
                self._transfer_cache_entry(machine, is_lost=isinstance(event, ComponentLost))
            elif isinstance(event, ComponentContested):
                self.cache_writer.discard_queued(machine)
                logger.warning("%s: %s", self._link.name, event.contest.error)
            elif isinstance(event, ComponentUncontested | ComponentReplaced):
                self.cache_writer.discard_queued(machine)
            elif isinstance(event, ComponentIdentified):
                self.link_task.notify()
                for component in self._components.values():
                    if component.machine.vehicle == machine.vehicle:
                        self._read_cache(component)
            elif isinstance(event, Fetched) and event.result.complete and event.result.is_confirmed:
                is_whole = event.result.source != "cache" and not event.result.resumed
                self.cache_writer.synced(machine, is_whole=is_whole)
                is_to_be_written = True
            elif isinstance(event, TableResynced):
                if event.hash is not None:  # otherwise single reads have followed it, and verified no value
                    self.cache_writer.synced(machine, is_whole=False)
                is_to_be_written = True
            if self._subscriptions:
                self._announce(event)
        if is_to_be_written:
            self.cache_writer.wake()
        if self.station.is_over:
            self._end_feeds(None)

    def _announce(self, event: Event) -> None:
        """Push an event to all streams, if it has a public form."""
        public = public_event(event, self._components[event.machine.address])
        if public is not None:
            for events in list(self._subscriptions):
                events.push(public)

    def _meet(self, machine: ComponentMachine) -> None:
        """Add a new component, load its cached table, and request its hash if that may confirm the table."""
        address = (machine.system, machine.component)
        now = anyio.current_time()
        component = self._components[machine.address] = LinkComponent(self, machine, now)
        self._read_cache(component)
        if self.cache_writer.may_hit(*address):
            machine.sync.ask(now)

    def _read_cache(self, component: LinkComponent) -> None:
        """Load the cached table of a component, if its identity is known."""
        machine = component.machine
        identity = component.settled_identity
        if identity is None or self.cache_writer.follow(machine, identity):
            return
        assert self._tasks is not None, "no message arrives before"
        self._tasks.start_soon(self._load, component, identity)

    def _transfer_cache_entry(self, machine: ComponentMachine, *, is_lost: bool) -> None:
        """Pass the cache entry of a lost component to one with equal ids at another peer.

        The vehicle may have returned at another peer. The cache has one table for equal ids.
        """
        if is_lost:
            self.cache_writer.discard_queued(machine)
        for component in self._components.values():
            other = component.machine
            if (other.system, other.component) == (machine.system, machine.component) and (
                not other.presence.is_lost
            ):
                self._read_cache(component)

    def wake(self) -> None:
        """See `LocalClient.wake`."""
        self.link_task.wake()

    # end of the link

    def _end(self, error: LinkError) -> None:
        """End all calls and streams permanently with this error."""
        self._dispatch()
        self.link_task.fail_for_good(error)
        for component in self._components.values():
            component.cache_was_read()
        self._end_feeds(error)

    def _end_feeds(self, error: LinkError | None) -> None:
        for component in self._components.values():
            component.end(error)
        for events in list(self._subscriptions):
            events.end(error)

    @property
    def is_over(self) -> bool:
        """See `LocalClient.is_over`."""
        return self.station.is_over or self.link_task.ended is not None

    def check_open(self) -> None:
        """See `LocalClient.check_open`."""
        if self.link_task.broken is not None:
            raise self.link_task.broken.with_traceback(None)
        if self._tasks is None:
            raise ClientClosed("the client is not open; use `async with` or `open`", link=self._link.name)

    async def _let_hashes_settle(self) -> None:
        """Wait for the hash after writes of this client, if it cannot be computed locally."""
        with anyio.move_on_after(CLOSING_HASH_TIMEOUT):
            while any(
                machine.is_settling and machine.table.complete and not machine.table.volatile_known
                for machine in self.station.components.values()
            ):
                await self.link_task.activity.wait()

    async def _run_until_files_closed(self, work: Callable[[], Awaitable[None]]) -> None:
        """Run a task until file sessions are closed, also if a scope around the client is cancelled."""
        if self.link_task.ended is None:
            with anyio.CancelScope(shield=True) as scope:
                self._outlasting.append(scope)
                await work()

    async def _close_files(self, error: LinkError) -> None:
        """End waiting calls, and close open file sessions on board, also when cancelled.

        ArduPilot has one session for all links: an open session blocks file access of all stations for 3 s.
        """
        if self.link_task.broken is None:
            self.link_task.fail_calls(error)
            machines = [each for each in self.station.components.values() if each.files.is_closing]
            if not machines:
                return
            with anyio.CancelScope(shield=True), anyio.move_on_after(SESSION_CLOSE_TIMEOUT):
                async with anyio.create_task_group() as tasks:
                    # `asyncio.run` cancels the other tasks one by one when its main task has ended: these
                    # replace the reader and the sender
                    tasks.start_soon(self.link_task.read)
                    tasks.start_soon(self.link_task.send)
                    for machine in machines:
                        await self._wait_until_closed(machine)
                    tasks.cancel_scope.cancel()

    async def wait_until_files_closed(self, machine: ComponentMachine) -> None:
        """See `LocalClient.wait_until_files_closed`. During a burst, vehicles ignore the request."""
        if machine.files.is_closing and self.link_task.broken is None:
            with anyio.move_on_after(machine.retry.prompt_timeout):
                await self._wait_until_closed(machine)

    async def _wait_until_closed(self, machine: ComponentMachine) -> None:
        carrier, files = self.link_task, machine.files

        def wake_waiter(now: float) -> None:
            carrier.notify()

        self.wake()
        while files.is_closing and not (carrier.is_disconnected or carrier.ended or machine.presence.is_lost):
            if wake_waiter not in files.on_closed:
                files.on_closed.append(wake_waiter)
            await carrier.activity.wait()

    @property
    def _has_one_vehicle(self) -> bool:
        """Whether the choice of a vehicle cannot be wrong: there is only one, or nothing is sent."""
        return self.listens_only or (isinstance(self._link, SimLink) and self._link.has_one_vehicle)

    def _find(self, system: int | None, component: int | None, peer: str | None) -> LinkComponent | None:
        found = self.station.find(system, component, peer)
        return None if found is None else self._components[found.address]
