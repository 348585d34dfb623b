"""The shell around the protocol: a link, a clock, and calls that can be awaited."""

from __future__ import annotations

import logging
import math
import os
import weakref
from collections.abc import Awaitable, Callable, Mapping
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Final

import anyio
import anyio.abc

from paramclient.cache import ParamCache
from paramclient.client.cache_writer import WriteThrough, chosen_cache
from paramclient.client.component import Component, address_in_words, patience_of
from paramclient.client.events import Events, told
from paramclient.client.fetch_all import FetchedAll, FetchTogether
from paramclient.client.files import Ftp
from paramclient.client.link_task import Carrier
from paramclient.client.signing import Signing, refused_in_words
from paramclient.client.signing_timestamps import TimestampKeeper
from paramclient.client.stats import ClientStats
from paramclient.client.taps import Beside
from paramclient.errors import ClientClosed, LinkError, NoReply, UsageError
from paramclient.links import Link, ReplayLink, SimLink, create_link
from paramclient.links.names import names_service
from paramclient.model.identity import Identity
from paramclient.model.values import Encoding
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import (
    ComponentContested,
    ComponentForgotten,
    ComponentFound,
    ComponentHeard,
    ComponentIdentified,
    ComponentLost,
    ComponentReplaced,
    ComponentUncontested,
    Event,
    Fetched,
    ParamChanged,
    ParamsMoved,
    TableResynced,
)
from paramclient.protocol.params.fetch_result import Policy, Progress
from paramclient.protocol.params.sync import Upkeep
from paramclient.protocol.station import Address, Station
from paramclient.protocol.stats.traffic import TrafficReport
from paramclient.protocol.system_id_change import SEARCH_PACE, Succession
from paramclient.protocol.vehicle_selection import LOOK_TIME, VehicleChoice
from paramclient.protocol.wire import SigningKey, SigningReport

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

__all__ = ["FetchedAll", "ParamClient"]

HEARING_PATIENCE: Final = 10.0
"""Seconds to wait for a first component, unless the caller says otherwise."""
LISTENING_TIME: Final = 1.2
"""Seconds from opening in which every component has been heard: each sends a heartbeat once a second."""
CLOSING_PATIENCE: Final = 0.5
"""Seconds that closing waits for the hash after a write, where the next session could not do without it."""
SESSION_PATIENCE: Final = 2.0
"""Seconds that a closing client waits at most for file sessions to be closed on board. The request is on its
way by then: a burst that runs on a radio lets it wait, and it is obeyed after that."""

logger = logging.getLogger(__name__)
protocol_logger = logging.getLogger("paramclient.protocol")


class ParamClient:
    """The ground station's side of the parameter protocol on one link, as an async context manager.

    Inside the `async with`, it sends its heartbeat once a second, follows every component that it hears, and
    keeps their tables in the cache. At its end every call that still waits, in other tasks, raises
    ClientClosed, what is new is written, and neither task nor socket nor thread remains. What the body
    raises comes out as it is. File sessions are closed on board first, also when the body is cancelled: a
    vehicle that does not acknowledge that takes at most `SESSION_PATIENCE` (2 s).

    A TCP connection that drops, a serial port that is unplugged or a UDP socket that fails is opened again
    with back-off for as long as the client lives. Calls that wait meanwhile go on when it is back: what had
    not been answered is asked for again. After `LINK_PATIENCE` seconds without a link they raise LinkError,
    and new ones do so at once. A link that cannot come back (`tcpin`, when nobody can be let in) ends every
    call with its LinkError.

    Args:
        link: a link's name, such as `udpin:0.0.0.0:14550` (`paramclient.links.FORMS` says which there are), a
            link object, or a simulated vehicle. With `http://HOST:8765` a service of `paramclient serve` has
            the links (see `paramclient.remote`); of the other arguments only `token` goes with that.
        cache: where tables are kept: None for the user's cache, a path, a `ParamCache` (which stays open), or
            False for none. A log that is replayed neither reads nor writes one.
        system, component: who we are on the link.
        encoding: how all components lay out values, for those who know better than the evidence.
        watch_interval: seconds after which it is looked again whether a table that was fetched still is the
            vehicle's, while the link is idle. An update is sent once, and lost with its frame: so it is found
            within one interval. None: every 30 seconds where the vehicle has a hash, which costs two small
            messages and what the hash leaves out, or gives its table as a file, less often where that takes
            more than 1.5 s, and never elsewhere. A number goes for every vehicle, the whole table of those
            without a hash. 0 for never. See `Component.sync_state`.
        policy: what may be asked of vehicles to bring tables up to date, see `Policy`: "auto", "hash-only"
            or "cache-only". Anything but "auto" also ends the watch. Single reads and writes go out all the
            same.
        traffic: whether to count everything that is heard, for `traffic_report`. That takes time for each
            frame, also of those that a client otherwise steps over.
        listen_only: never send a byte, not even a heartbeat. Tables fill by what others on the link ask for;
            `fetch_all` waits for their list, and `get`, `set` and the like raise UsageError.
        forward: the link to one other program, by its name or as an object, such as
            `udpout:127.0.0.1:14551`: it gets every frame that comes, and what it sends goes to the vehicles;
            with `listen_only` it is not. A program that is slow or absent holds nothing up.
        tlog: a telemetry log to be made, of every frame on the link, both ways. One that exists is not
            written over; a full disk ends it with a warning, and nothing else.
        signing: the key with which what is sent is signed and what comes is checked, or a `Signing`, which
            says more. None: nothing is signed, and signatures count for nothing.
        token: what a service wants to see; None for PARAMCLIENT_TOKEN of the environment.
        split_peers: whether components with equal ids are different ones where they come from different UDP
            addresses or TCP connections: for vehicles that share a system id. A vehicle with two ways to this
            computer is then two, and so is one that was restarted with another port.

    Attributes:
        cache: where tables are kept, or None.

    Raises:
        UsageError: no such link, ids outside 1 to 255, or an interval or policy that cannot be; on entering:
            for the second time, or the telemetry log exists or cannot be made.
        LinkError: on entering: the link, or the one to the other program, cannot be opened.
    """

    def __new__(cls, link: str | Link | Endpoint, **_: object) -> ParamClient:
        """One of the kind that the link's name asks for."""
        if cls is ParamClient and names_service(link):
            from paramclient.remote import RemoteClient  # brings httpx along

            return object.__new__(RemoteClient)
        return object.__new__(cls)

    def __init__(
        self,
        link: str | Link | Endpoint,
        *,
        cache: ParamCache | str | os.PathLike[str] | bool | None = None,
        system: int = 255,
        component: int = 190,
        encoding: Encoding | None = None,
        watch_interval: float | None = None,
        policy: Policy | str = Policy.AUTO,
        traffic: bool = False,
        listen_only: bool = False,
        forward: str | Link | None = None,
        tlog: str | os.PathLike[str] | None = None,
        signing: Signing | SigningKey | None = None,
        token: str | None = None,
        split_peers: bool = False,
    ) -> None:
        if token is not None:
            raise UsageError("a token is for a service, whose name is http://HOST:PORT; a link takes none")
        for number in (system, component):
            if not 1 <= number <= 255:
                raise UsageError(f"our own system and component ids are 1 to 255, not {number}")
        self._link = create_link(link)
        is_log = isinstance(self._link, ReplayLink)
        self.cache = chosen_cache(cache, is_log=is_log)
        self._station = Station(
            link=self._link.name,
            is_stream=self._link.is_stream,
            system=system,
            component=component,
            encoding=encoding,
            upkeep=Upkeep.chosen(watch_interval, policy, listen_only=listen_only, is_log=is_log),
            split_peers=split_peers,
            counts_traffic=traffic,
            trace=protocol_logger.debug,
        )
        self._writer = WriteThrough(
            self.cache,
            owned=self.cache is not cache,
            identity_of=self._station.identity_of,
            is_doubted=self._station.is_doubted,
            renewed=self._dispatch,
            look=lambda: self._carrier.look_at_the_clock(),
        )
        self._subscriptions: weakref.WeakSet[Events] = weakref.WeakSet()
        self._components: dict[Address, Component] = {}
        self._tasks: anyio.abc.TaskGroup | None = None
        self._outlasting: list[anyio.CancelScope] = []
        self._beside = Beside(tlog, forward, is_stream=self._link.is_stream)
        self._carrier = Carrier(
            self._link,
            self._station,
            dispatch=self._dispatch,
            end=self._end,
            taps=self._beside.taps,
            may_rest=self._beside.forwarder is None,
        )
        if not self.listens_only:
            self._beside.share(self._carrier.send_for_another)
        self._downloads = self._cache_hits = 0
        if isinstance(signing, SigningKey):
            signing = Signing(signing)
        self._keeper = None if signing is None else TimestampKeeper(signing)
        self._splits_peers = split_peers
        self._is_entered = False
        self._opened_at = -math.inf

    @property
    def components(self) -> Mapping[Address, Component]:
        """Every component heard so far, by (system, component).

        With `split_peers`, ids may be there several times, and a key stands for the ids at one peer: it is
        what `Component.address` gives, and the ids alone are none.
        """
        return MappingProxyType(self._components)

    @property
    def autopilots(self) -> list[Component]:
        """The autopilot of each system heard so far, by system id: vehicles, without what they carry."""
        station = self._station
        heard = dict.fromkeys(machine.vehicle for machine in station.components.values())
        vehicles = sorted(heard, key=lambda vehicle: vehicle[0])
        found = [station.autopilot_of(*vehicle) for vehicle in vehicles]
        return [self._components[machine.address] for machine in found if machine is not None]

    @property
    def link(self) -> Link:
        """The link."""
        return self._link

    @property
    def listens_only(self) -> bool:
        """Whether nothing is ever sent: by choice, or as the link is a log."""
        return self._station.listens_only

    @property
    def bytes_received(self) -> int:
        """Bytes that have come over the link."""
        return self._station.bytes_received

    @property
    def bytes_sent(self) -> int:
        """Bytes of the frames that were sent, our heartbeats among them."""
        return self._station.bytes_sent

    @property
    def stats(self) -> ClientStats:
        """What it has done so far, in numbers; also when it is closed."""
        return ClientStats.of(self._station, downloads=self._downloads, cache_hits=self._cache_hits)

    def __repr__(self) -> str:
        state = "away" if self._carrier.is_away else "open"
        state = "closed" if self._tasks is None or self._carrier.ended is not None else state
        heard = len(self._components)
        return f"<ParamClient {self._link.name} {state}, {heard} component{'' if heard == 1 else 's'}>"

    async def __aenter__(self) -> ParamClient:
        if self._is_entered:
            raise UsageError("a ParamClient is opened once; make a new one")
        self._is_entered = True
        try:
            await self._link.open()
            await self._writer.open()
            await self._beside.open()
            if self._keeper is not None:
                self._station.begin_signing(*await self._keeper.open())
        except BaseException:
            await self._release()
            raise
        logger.debug("%s: open", self._link.name)
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        self._tasks = tasks
        self._opened_at = self._station.listening_since = anyio.current_time()
        tasks.start_soon(self._outlast, self._carrier.read, name="paramclient reader")
        tasks.start_soon(self._outlast, self._carrier.send, name="paramclient sender")
        tasks.start_soon(self._writer.run, name="paramclient cache writer")
        self._beside.start(tasks)
        if self._keeper is not None:
            tasks.start_soon(self._keeper.run, name="paramclient timestamp keeper")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        tasks = self._tasks
        assert tasks is not None
        try:
            if kind is None and self._carrier.broken is None:
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
                # not told of the caller's exception: it would come out wrapped in a group
                await tasks.__aexit__(None, None, None)
            finally:
                await self._release()

    async def _release(self) -> None:
        """Give back the link and the cache, also when cancelled."""
        logger.debug("%s: closing", self._link.name)
        with anyio.CancelScope(shield=True):
            try:
                await self._link.close()
                for machine in self._station.components.values():
                    await self._writer.keep_late(machine)
            finally:
                try:
                    await self._writer.close()
                finally:
                    try:
                        if self._keeper is not None:
                            await self._keeper.close()
                    finally:
                        await self._beside.close()

    def events(self) -> Events:
        """What happens to components from now on: `async for event in client.events()`.

        They are Heard, Lost, Found, Rebooted, Resynced, Contested and Uncontested. An absence of the link
        does not end it; it ends when nobody holds it any more. Whoever is very slow to ask misses the oldest
        ones. In a log it ends with that.

        Raises:
            LinkError: while waiting, when the link failed for good or the client was closed. What had come
                before is given first.
        """
        events = Events()
        self._subscriptions.add(events)
        if self._is_over:
            events.end(self._carrier.ended)
        return events

    def ftp(self, component: Component) -> Ftp:
        """The files of a component, over MAVFTP."""
        return Ftp(component)

    async def component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = HEARING_PATIENCE,
    ) -> Component:
        """The component with this address, as soon as it has been heard.

        Without arguments the first autopilot; with a system alone, that system's autopilot; with a component
        alone, the first of that id. Which one is the first is a matter of chance where there are several:
        programs that write use `only_component`. If the cache may have its table, it is in `params` on
        return, unless the vehicle does not say who it is.

        Args:
            system: system id.
            component: component id.
            peer: the peer that its messages come from, as `Component.peer` says it, or its host alone.
            timeout: seconds; None waits for ever.

        Raises:
            NoReply: it was not heard in time.
            LinkError: the link failed, or the client was closed.
        """
        self._check_open()
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            while (found := self._find(system, component, peer)) is None and not self._station.is_over:
                await self._carrier.news.wait()
                self._check_open()
            if found is not None:
                await found._wait_for_cache()
        if found is None:
            waited = anyio.current_time() - began
            wanted = address_in_words(system, component, peer) + refused_in_words(self.signing_report())
            raise NoReply(wanted, attempts=0, waited=waited)
        return found

    async def only_component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = HEARING_PATIENCE,
    ) -> Component:
        """Return the component with this address if no other vehicle can be meant; for programs that write.

        Without arguments it is the only autopilot on the link; with a component alone, the component of that
        id of the only vehicle. For `LOOK_TIME` (1.2 s) from the first autopilot heard on, a second one is
        looked for: every autopilot sends a heartbeat once a second. With a system alone it is that system's
        autopilot: component 1 as soon as it is heard, or another one when it is the only one for as long.
        With both ids it is that component, as soon as it is heard. A vehicle that is lost is not there.
        Nothing is sent but what identifies vehicles.

        The call takes no time where a second autopilot would have been heard already. So a program that did
        something else since can make sure by another call, directly before it writes.

        Args:
            system: system id.
            component: component id.
            peer: as in `component`.
            timeout: seconds for everything; None waits for ever.

        Raises:
            AmbiguousVehicle: several vehicles are on the link, or the only one has several autopilots.
                `vehicles` and the text list them.
            NoReply: it was not heard in time, or not for long enough to see that it is the only one.
            LinkError: the link failed, or the client was closed.
        """
        if self._has_one_vehicle:
            return await self.component(system, component, peer=peer, timeout=timeout)
        self._check_open()
        began = anyio.current_time()
        choice = VehicleChoice(system, component, splits_peers=self._splits_peers)
        station = self._station
        machine = None
        with anyio.move_on_after(timeout), station.looking_for_others():
            while True:
                news, now = self._carrier.news, anyio.current_time()
                since = station.listening_since
                machine = choice.look(station.at_peer(peer), now, listening_since=since)
                if machine is not None or station.is_over:
                    break
                with anyio.move_on_after(None if choice.due == math.inf else choice.due - now):
                    await news.wait()
                await self._carrier.read_up(choice.due)
                self._check_open()
            if machine is not None:
                await self._components[machine.address]._wait_for_cache()
        if machine is not None:
            return self._components[machine.address]
        wanted = address_in_words(system, component, peer) + refused_in_words(self.signing_report())
        if choice.due < math.inf:
            wanted += f", and {LOOK_TIME} s more to see that it is the only one"
        raise NoReply(wanted, attempts=0, waited=anyio.current_time() - began)

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = HEARING_PATIENCE
    ) -> Component:
        """The same component of the same vehicle under another system id, as soon as it speaks under that.

        For a vehicle whose system id was set: ArduPlane and Rover take it at once (SYSID_THISMAV), ArduCopter
        and PX4 (MAV_SYS_ID) when they start again (see `Component.reboot`). That it is the same one is shown
        by its hardware id; where there is none, by its autopilot and type, and by its silence under the id of
        before.

        Args:
            component: what it was before.
            system: its new system id.
            timeout: seconds; None waits for ever.

        Raises:
            AnotherVehicle: another vehicle has this system id.
            NoReply: it was not heard under this id in time, or did not say who it is.
            LinkError: the link failed, or the client was closed.
        """
        self._check_open()
        began = anyio.current_time()
        search = Succession(component._machine, component._machine.address_in(system))
        with anyio.move_on_after(timeout):
            while not search.look(self._station.components, anyio.current_time()):
                self._wake()
                with anyio.move_on_after(SEARCH_PACE):
                    await self._carrier.news.wait()
                self._check_open()
            found = self._components[search.address]
            await found._wait_for_cache()
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
        """Bring the tables of all components of one system, or of every system heard, up to date.

        They are fetched side by side; those that begin to speak meanwhile join in, and so does everyone who
        is heard within `LISTENING_TIME` of opening. A component that stays silent is given up soon after
        another one is done.

        Args:
            system: this system's components only, asked for with one list request to all of them.
            refresh: as in `Component.fetch_all`.
            timeout: seconds, after which what has come is given.
            progress: called about ten times a second with the progress of each, from this task.

        Raises:
            UsageError: `refresh`, and the policy allows no download.
            CacheError: nothing is cached of anybody, and the policy allows no download.
            NoReply: nobody was heard, or nobody answered.
            LinkError: the link failed, or the client was closed.
        """
        self._station.check_refresh(refresh)
        timeout = patience_of(self._station, timeout)
        began = anyio.current_time()
        together = FetchTogether(self._station, self._components, system, refresh=refresh)
        return await together.run(
            self._check_open,
            self._wake,
            self._files_closed,
            until=math.inf if timeout is None else began + timeout,
            hear_until=began + (HEARING_PATIENCE if timeout is None else timeout),
            listen_until=self._opened_at + LISTENING_TIME,
            progress=progress,
        )

    def traffic_report(self) -> TrafficReport:
        """What has gone over the link so far: who was heard, how fast, and what was lost on the way.

        Raises:
            UsageError: the client was made without `traffic=True`.
            LinkError: the link failed, or the client was closed.
        """
        if self._station.traffic is None:
            raise UsageError("nothing is counted; use ParamClient(..., traffic=True)")
        self._check_open()
        return self._station.traffic.report(anyio.current_time())

    def signing_report(self) -> SigningReport | None:
        """How the signatures on the link stand: what came signed, what was refused and why.

        None where the client has no key.
        """
        return None if self._station.verifier is None else self._station.verifier.report()

    # what has happened

    async def _load(self, component: Component, identity: Identity) -> None:
        if await self._writer.bring(component._machine, identity):
            component._cache_is_read.set()
            self._writer.wake()
            self._dispatch()

    def _dispatch(self) -> None:
        """Hand out what has happened."""
        is_to_be_written = False
        for event in self._station.events():
            machine = event.machine
            if isinstance(event, ParamChanged | ParamsMoved):
                self._components[machine.address]._moved(event)
                is_to_be_written = True
                continue
            logger.debug("%s", event)
            if isinstance(event, Fetched):
                self._cache_hits += event.result.source == "cache"
                self._downloads += event.result.source != "cache" and event.result.complete
            if isinstance(event, ComponentForgotten):
                self._components.pop(machine.address)._part()
                continue
            if isinstance(event, ComponentHeard):
                self._meet(machine)
            elif isinstance(event, ComponentLost | ComponentFound) and self._splits_peers:
                self._pass_place_on(machine, is_lost=isinstance(event, ComponentLost))
            elif isinstance(event, ComponentContested):
                self._writer.let_go(machine)
                logger.warning("%s: %s", self._link.name, event.contest.error)
            elif isinstance(event, ComponentUncontested | ComponentReplaced):
                self._writer.let_go(machine)
            elif isinstance(event, ComponentIdentified):
                self._carrier.tell()
                for component in self._components.values():
                    if component._machine.vehicle == machine.vehicle:
                        self._read_cache(component)
            elif isinstance(event, Fetched) and event.result.complete and event.result.is_confirmed:
                is_whole = event.result.source != "cache" and not event.result.resumed
                self._writer.synced(machine, is_whole=is_whole)
                is_to_be_written = True
            elif isinstance(event, TableResynced):
                self._writer.synced(machine, is_whole=False)
                is_to_be_written = True
            if self._subscriptions:
                self._announce(event)
        if is_to_be_written:
            self._writer.wake()
        if self._station.is_over:
            self._end_feeds(None)

    def _announce(self, event: Event) -> None:
        """Tell those who listen, if it is for them."""
        news = told(event, self._components[event.machine.address])
        if news is not None:
            for events in list(self._subscriptions):
                events.push(news)

    def _meet(self, machine: ComponentMachine) -> None:
        address = (machine.system, machine.component)
        now = anyio.current_time()
        component = self._components[machine.address] = Component(self, machine, now)
        self._read_cache(component)
        if self._writer.may_hit(*address):
            machine.sync.ask(now)

    def _read_cache(self, component: Component) -> None:
        """Look for its cached table, once it is known whose it is."""
        machine = component._machine
        if (identity := self._station.identity_of(machine)) is None or self._writer.follow(machine, identity):
            return
        assert self._tasks is not None, "nothing is heard before"
        self._tasks.start_soon(self._load, component, identity)

    def _pass_place_on(self, machine: ComponentMachine, *, is_lost: bool) -> None:
        """A vehicle may have come back at another peer: one of those with equal ids is kept in the cache."""
        if is_lost:
            self._writer.let_go(machine)
        for component in self._components.values():
            other = component._machine
            if (other.system, other.component) == (machine.system, machine.component) and (
                not other.presence.is_lost
            ):
                self._read_cache(component)

    def _wake(self, machine: ComponentMachine | None = None) -> None:
        self._carrier.wake(machine)

    # ends

    def _end(self, error: LinkError) -> None:
        """No call can be answered any more."""
        self._dispatch()
        self._carrier.fail_for_good(error)
        for component in self._components.values():
            component._cache_is_read.set()
        self._end_feeds(error)

    def _end_feeds(self, error: LinkError | None) -> None:
        for component in self._components.values():
            component._end(error)
        for events in list(self._subscriptions):
            events.end(error)

    @property
    def _is_over(self) -> bool:
        """Whether nothing more will happen."""
        return self._station.is_over or self._carrier.ended is not None

    def _check_open(self) -> None:
        if self._carrier.broken is not None:
            raise self._carrier.broken.with_traceback(None)
        if self._tasks is None:
            raise ClientClosed("the client is not open; use it as `async with`", link=self._link.name)

    async def _let_hashes_settle(self) -> None:
        """Wait for the hash after our writes, where it cannot be computed here."""
        with anyio.move_on_after(CLOSING_PATIENCE):
            while any(
                machine.is_settling and machine.table.complete and not machine.table.volatile_known
                for machine in self._station.components.values()
            ):
                await self._carrier.news.wait()

    async def _outlast(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do this until the files are closed, also when a scope around the client is cancelled before."""
        if self._carrier.ended is None:
            with anyio.CancelScope(shield=True) as scope:
                self._outlasting.append(scope)
                await work()

    async def _close_files(self, error: LinkError) -> None:
        """End what still waits, and have the sessions of open files closed on board, also when cancelled.

        ArduPilot has one session for all links: what stays open keeps everyone from its files for 3 s.
        """
        if self._carrier.broken is None:
            self._carrier.fail_calls(error)
            machines = [each for each in self._station.components.values() if each.files.is_closing]
            if not machines:
                return
            with anyio.CancelScope(shield=True), anyio.move_on_after(SESSION_PATIENCE):
                async with anyio.create_task_group() as tasks:
                    # `asyncio.run` cancels each task for itself when its main one has ended: these go on then
                    tasks.start_soon(self._carrier.read)
                    tasks.start_soon(self._carrier.send)
                    for machine in machines:
                        await self._wait_until_closed(machine)
                    tasks.cancel_scope.cancel()

    async def _files_closed(self, machine: ComponentMachine) -> None:
        """Wait until the session of a file that nobody wants any more is closed on board: for one round trip.

        While a burst comes the vehicle does not look at the request.
        """
        if machine.files.is_closing and self._carrier.broken is None:
            with anyio.move_on_after(machine.round_trip.prompt_timeout):
                await self._wait_until_closed(machine)

    async def _wait_until_closed(self, machine: ComponentMachine) -> None:
        carrier, files = self._carrier, machine.files

        def tell(now: float) -> None:
            carrier.tell()

        self._wake(machine)
        while files.is_closing and not (carrier.is_away or carrier.ended or machine.presence.is_lost):
            if tell not in files.on_closed:
                files.on_closed.append(tell)
            await carrier.news.wait()

    @property
    def _has_one_vehicle(self) -> bool:
        """Whether no vehicle can be taken for another: there is one, or none is written to."""
        return self.listens_only or (isinstance(self._link, SimLink) and self._link.has_one_vehicle)

    def _find(self, system: int | None, component: int | None, peer: str | None) -> Component | None:
        found = self._station.find(system, component, peer)
        return None if found is None else self._components[found.address]
