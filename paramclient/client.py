"""The shell around the protocol: a link, a clock, and calls that can be awaited."""

from __future__ import annotations

import math
import os
import weakref
from collections.abc import Callable, Mapping
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Final

import anyio
import anyio.abc

from paramclient.cache import ParamCache
from paramclient.carrier import Carrier
from paramclient.component import PROGRESS_INTERVAL, Component
from paramclient.errors import ClientClosed, LinkError, NoReply, UsageError
from paramclient.events import Events, told
from paramclient.ftp import Ftp
from paramclient.identity import Identity
from paramclient.links import Link, create_link
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import (
    ComponentHeard,
    ComponentIdentified,
    Event,
    Fetched,
    ParamChanged,
    TableResynced,
)
from paramclient.protocol.result import Policy, Progress
from paramclient.protocol.station import Address, Station
from paramclient.protocol.succession import SEARCH_PACE, Succession
from paramclient.protocol.sync import Upkeep
from paramclient.protocol.traffic import TrafficReport
from paramclient.protocol.wire import SigningKey, SigningReport
from paramclient.signing import Signing
from paramclient.timestamps import TimestampKeeper
from paramclient.together import FetchedAll, FetchTogether
from paramclient.values import Encoding
from paramclient.writethrough import WriteThrough

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

__all__ = ["FetchedAll", "ParamClient"]

HEARING_PATIENCE: Final = 10.0
"""Seconds to wait for a first component, unless the caller says otherwise."""
LISTENING_TIME: Final = 1.2
"""Seconds from opening in which every component has been heard: each sends a heartbeat once a second."""
CLOSING_PATIENCE: Final = 0.5
"""Seconds that closing waits for the hash after a write, where the next session could not do without it."""


class ParamClient:
    """The ground station's side of the parameter protocol on one link, as an async context manager.

    Inside the `async with`, it sends its heartbeat once a second, follows every component that it hears, and
    keeps their tables in the cache. At its end every call that still waits, in other tasks, raises
    ClientClosed, what is new is written, and neither task nor socket nor thread remains. What the body
    raises comes out as it is.

    A TCP connection that drops, or a serial port that is unplugged, is opened again with back-off for as long
    as the client lives. Calls that wait meanwhile go on when it is back: what had not been answered is asked
    for again. After `LINK_PATIENCE` seconds without a link they raise LinkError, and new ones do so at once.
    A link that cannot come back (a UDP socket that fails) ends every call with its LinkError.

    Args:
        link: a link's name, such as `udpin:0.0.0.0:14550` (`paramclient.links.FORMS` says which there are), a
            link object, or a simulated vehicle.
        cache: where tables are kept: None for the user's cache, a path, a `ParamCache` (which stays open), or
            False for none.
        system, component: who we are on the link.
        encoding: how all components lay out values, for those who know better than the evidence.
        watch_interval: seconds after which it is looked again whether a table that was fetched still is the
            vehicle's, while the link is idle. An update is sent once, and lost with its frame: so it is found
            within one interval. None: every 30 seconds where the vehicle has a hash, which costs two small
            messages, or gives its table as a file in at most 1.5 s, and never elsewhere. A number goes for
            every vehicle, the whole table of those without a hash. 0 for never. See `Component.sync_state`.
        policy: what may be asked of vehicles to bring tables up to date, see `Policy`: "auto", "hash-only"
            or "cache-only". Anything but "auto" also ends the watch. Single reads and writes go out all the
            same.
        traffic: whether to count everything that is heard, for `traffic_report`. That takes time for each
            frame, also of those that a client otherwise steps over.
        signing: the key with which what is sent is signed and what comes is checked, or a `Signing`, which
            says more. None: nothing is signed, and signatures count for nothing.

    Attributes:
        cache: where tables are kept, or None.

    Raises:
        UsageError: no such link, ids outside 1 to 255, or an interval or policy that cannot be; on entering:
            for the second time.
        LinkError: on entering: the link cannot be opened.
    """

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
        signing: Signing | SigningKey | None = None,
    ) -> None:
        for number in (system, component):
            if not 1 <= number <= 255:
                raise UsageError(f"our own system and component ids are 1 to 255, not {number}")
        self._link = create_link(link)
        if isinstance(cache, ParamCache):
            self.cache: ParamCache | None = cache
        elif cache is False:
            self.cache = None
        else:
            self.cache = ParamCache(None if cache is None or cache is True else cache)
        self._station = Station(
            link=self._link.name,
            is_stream=self._link.is_stream,
            system=system,
            component=component,
            encoding=encoding,
            upkeep=Upkeep.chosen(watch_interval, policy),
            counts_traffic=traffic,
        )
        self._writer = WriteThrough(
            self.cache,
            owned=self.cache is not cache,
            identity_of=self._station.identity_of,
            is_doubted=self._station.is_doubted,
        )
        self._subscriptions: weakref.WeakSet[Events] = weakref.WeakSet()
        self._components: dict[Address, Component] = {}
        self._tasks: anyio.abc.TaskGroup | None = None
        self._carrier = Carrier(self._link, self._station, dispatch=self._dispatch, end=self._end)
        if isinstance(signing, SigningKey):
            signing = Signing(signing)
        self._keeper = None if signing is None else TimestampKeeper(signing)
        self._is_entered = False
        self._opened_at = -math.inf

    @property
    def components(self) -> Mapping[Address, Component]:
        """Every component heard so far, by (system, component)."""
        return MappingProxyType(self._components)

    @property
    def link(self) -> Link:
        """The link."""
        return self._link

    @property
    def bytes_received(self) -> int:
        """Bytes that have come over the link."""
        return self._station.bytes_received

    @property
    def bytes_sent(self) -> int:
        """Bytes of the frames that were sent, our heartbeats among them."""
        return self._station.bytes_sent

    def __repr__(self) -> str:
        state = "closed" if self._tasks is None or self._carrier.ended is not None else "open"
        if state == "open" and self._carrier.is_away:
            state = "away"
        heard = len(self._components)
        return f"<ParamClient {self._link.name} {state}, {heard} component{'' if heard == 1 else 's'}>"

    async def __aenter__(self) -> ParamClient:
        if self._is_entered:
            raise UsageError("a ParamClient is opened once; make a new one")
        self._is_entered = True
        try:
            await self._link.open()
            await self._writer.open()
            if self._keeper is not None:
                self._station.begin_signing(*await self._keeper.open())
        except BaseException:
            await self._release()
            raise
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        self._tasks = tasks
        self._opened_at = anyio.current_time()
        tasks.start_soon(self._carrier.read, name="paramclient reader")
        tasks.start_soon(self._carrier.send, name="paramclient sender")
        tasks.start_soon(self._writer.run, name="paramclient cache writer")
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
            self._end(ClientClosed("the client was closed", link=self._link.name))
            tasks.cancel_scope.cancel()
            try:
                # not told of the caller's exception: it would come out wrapped in a group
                await tasks.__aexit__(None, None, None)
            finally:
                await self._release()

    async def _release(self) -> None:
        """Give back the link and the cache, also when cancelled."""
        with anyio.CancelScope(shield=True):
            try:
                await self._link.close()
                for machine in self._station.components.values():
                    await self._writer.keep_late(machine)
            finally:
                try:
                    await self._writer.close()
                finally:
                    if self._keeper is not None:
                        await self._keeper.close()

    def events(self) -> Events:
        """What happens to components from now on: `async for event in client.events()`.

        The events are those of `paramclient.events`: Heard, Lost, Found, Rebooted, Resynced. An absence of
        the link does not end it; it ends when nobody holds it any more. Whoever is very slow to ask misses
        the oldest ones.

        Raises:
            LinkError: while waiting, when the link failed for good or the client was closed. What had come
                before is given first.
        """
        events = Events()
        self._subscriptions.add(events)
        if self._carrier.ended is not None:
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
        timeout: float | None = HEARING_PATIENCE,
    ) -> Component:
        """The component with this address, as soon as it has been heard.

        Without arguments the first autopilot; with a system alone, that system's autopilot; with a component
        alone, the first of that id. If the cache may have its table, it is in `params` on return, unless the
        vehicle does not say who it is.

        Args:
            system: system id.
            component: component id.
            timeout: seconds; None waits for ever.

        Raises:
            NoReply: it was not heard in time.
            LinkError: the link failed, or the client was closed.
        """
        self._check_open()
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            while (found := self._find(system, component)) is None:
                await self._carrier.news.wait()
                self._check_open()
            await found._wait_for_cache()
        if found is None:
            waited = anyio.current_time() - began
            wanted = _wanted(system, component) + self._refused_in_words()
            raise NoReply(wanted, attempts=0, waited=waited)
        return found

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = HEARING_PATIENCE
    ) -> Component:
        """The same component of the same vehicle under another system id, as soon as it speaks under that.

        For a vehicle whose system id was set: ArduPilot takes it at once (SYSID_THISMAV), PX4 when it starts
        again (MAV_SYS_ID, see `Component.reboot`). That it is the same one is shown by its hardware id; where
        there is none, by its autopilot and type, and by its silence under the id of before.

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
        search = Succession(component._machine, (system, component.component))
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
        began = anyio.current_time()
        deadline = math.inf if timeout is None else began + timeout
        hear_until = began + HEARING_PATIENCE if timeout is None else deadline
        together = FetchTogether(self._station, self._components, system, refresh=refresh)
        try:
            while True:
                self._check_open()
                now = anyio.current_time()
                if together.join(now):
                    self._wake()
                listen_until = self._opened_at + LISTENING_TIME
                if now >= deadline or not together.is_worth_waiting(
                    now, listen_until=listen_until, hear_until=hear_until
                ):
                    break
                await together.news(min(PROGRESS_INTERVAL, deadline - now))
                if progress is not None:
                    progress(together.progress(anyio.current_time()))
            return together.outcome(now, waited=now - began)
        finally:
            together.end(anyio.current_time())
            self._wake()  # they may have been in the way of others

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
        component._cache_reads += 1
        try:
            is_brought = await self._writer.bring(component._machine, identity)
        finally:
            component._cache_reads -= 1
        if is_brought:
            component._cache_is_read.set()
            self._writer.wake()
            self._dispatch()

    def _dispatch(self) -> None:
        """Hand out what has happened."""
        is_to_be_written = False
        for event in self._station.events():
            machine = event.machine
            if isinstance(event, ParamChanged):
                self._components[machine.system, machine.component]._publish(event.change)
                is_to_be_written = True
                continue
            if isinstance(event, ComponentHeard):
                self._meet(machine)
            elif isinstance(event, ComponentIdentified):
                self._carrier.tell()
                for component in self._components.values():
                    if component.system == machine.system:
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

    def _announce(self, event: Event) -> None:
        """Tell those who listen, if it is for them."""
        news = told(event, self._components[event.machine.system, event.machine.component])
        if news is not None:
            for events in list(self._subscriptions):
                events.push(news)

    def _meet(self, machine: ComponentMachine) -> None:
        address = (machine.system, machine.component)
        now = anyio.current_time()
        component = self._components[address] = Component(self, machine, now)
        self._read_cache(component)
        if self._writer.may_hit(*address):
            machine.sync.ask(now)

    def _read_cache(self, component: Component) -> None:
        """Look for its cached table, once it is known whose it is."""
        machine = component._machine
        identity = self._station.identity_of(machine)
        if identity is None or self._writer.follow(machine, identity):
            return
        assert self._tasks is not None, "nothing is heard before"
        self._tasks.start_soon(self._load, component, identity)

    def _wake(self, machine: ComponentMachine | None = None) -> None:
        self._carrier.wake(machine)

    # ends

    def _end(self, error: LinkError) -> None:
        """No call can be answered any more."""
        self._dispatch()
        self._carrier.fail_for_good(error)
        for component in self._components.values():
            component._end(error)
        for events in list(self._subscriptions):
            events.end(error)

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

    def _refused_in_words(self) -> str:
        """Why somebody may be there and not be heard, for the end of a sentence."""
        report = self.signing_report()
        refused = {} if report is None else report.refused
        reasons = ", ".join(f"{count} for: {reason}" for reason, count in refused.items())
        return f" (frames were refused, {reasons})" if reasons else ""

    def _may_be_cached(self, component: Component) -> bool:
        return self._writer.may_have(component.system, component.component)

    def _identity_of(self, machine: ComponentMachine) -> Identity | None:
        return self._station.identity_of(machine)

    def _find(self, system: int | None, component: int | None) -> Component | None:
        if component is None:
            for machine in self._station.components.values():
                if system in (None, machine.system) and machine.who.is_autopilot:
                    autopilot = self._station.autopilot_of(machine.system) or machine
                    return self._components[autopilot.system, autopilot.component]
            return None
        for address, found in self._components.items():
            if address[1] == component and system in (None, address[0]) and found._machine.who.has_spoken:
                return found
        return None


def _wanted(system: int | None, component: int | None) -> str:
    """What was looked for, in words."""
    if component is None:
        return "an autopilot" if system is None else f"an autopilot with system id {system}"
    return f"component {'*' if system is None else system}/{component}"
