"""ParamClient: the ground station for the components on one link."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import anyio

from paramclient.cache import ParamCache
from paramclient.client.cache_writer import CacheWriter, choose_cache
from paramclient.client.component import Component
from paramclient.client.core import ClientCore, seconds_of
from paramclient.client.signing import Signing
from paramclient.client.streams import Stream, Subscribers
from paramclient.client.taps import Capture, Traffic, TrafficReport
from paramclient.errors import AnotherVehicle, CacheError, ClientClosed, NoReply, ParamClientError, UsageError
from paramclient.links import Link, ReplayLink, SimLink, create_link
from paramclient.model.identity import check_ids
from paramclient.model.names import counted
from paramclient.model.values import Encoding
from paramclient.protocol import selection
from paramclient.protocol.addresses import Address
from paramclient.protocol.channel import task_group
from paramclient.protocol.fetch import FetchResult, Policy
from paramclient.protocol.identity import HEARTBEAT_WAIT, expects_extended
from paramclient.protocol.node import Node
from paramclient.protocol.station import Station
from paramclient.protocol.watch import INTERVAL_MIN
from paramclient.wire.signing import SigningKey, SigningReport

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

COMPONENT_TIMEOUT: Final = 10.0
"""Default timeout in seconds for the first component on a link."""
VEHICLES_LISTENING_TIME: Final = 3.0
"""Seconds after the first autopilot in which further ones are looked for: three heartbeats, two of which may
be lost."""
PROBE_INTERVAL: Final = 0.5
"""Seconds between two requests to a component that is named in full and was not heard; the first one after
`HEARTBEAT_WAIT`, in which a component with heartbeats is heard."""
LISTENING_TIME: Final = HEARTBEAT_WAIT
"""Seconds after the client was opened in which components are waited for, by a fetch of all."""
SILENT_TIME: Final = 2.95
"""Seconds from the begin for a component that has never answered a request, or of a kind that usually has
extended parameters, where another one on the link answers: it costs no more than 3 s. An ArduPilot or PX4 has
parameters, and may still be starting."""
EVENTS_MAX: Final = 1_000
"""Queued events for a consumer, at most."""


@dataclass(frozen=True, slots=True)
class Event:
    """What has happened to a component.

    Attributes:
        component: the component.
        kind: "discovered": its first message has arrived. "lost": it has sent heartbeats before, and no
            message for the heartbeat timeout: 5 s, longer for slow heartbeats and in high-latency mode.
            "found": a lost component sends again; the client requests its identity and checks its table.
            "rebooted": its clock has jumped back, or its heartbeat reports MAV_STATE_BOOT. "resynced": a
            table that was stale, or possibly stale, matches the vehicle again.
        silence: seconds without a message, of "lost" and "found"; None of others.
        changed: of "resynced", the names of the parameters that had changed.
        hash: of "resynced", PX4's hash or ArduPilot's checksum that confirms the table; None without one.
    """

    component: Component
    kind: Literal["discovered", "lost", "found", "rebooted", "resynced"]
    silence: float | None = None
    changed: tuple[str, ...] = ()
    hash: int | None = None


class Events(Stream[Event]):
    """Stream of the component events since its creation; see `ParamClient.events`."""

    most = EVENTS_MAX


class ParamClient:
    """A ground station for the MAVLink parameter protocol on one link, as an async context manager.

    Inside the `async with`, the client sends a heartbeat once a second, follows every component on the link,
    and keeps their tables in the cache. On exit, waiting calls in other tasks raise ClientClosed, new values
    are written to the cache, open file sessions are closed on board, and no task, socket or thread remains.

    Where an `async with` does not fit, such as in `python -m asyncio`, call `open` and `aclose`.

    A dropped TCP connection, an unplugged serial port or a failed UDP socket is reopened with backoff while
    the client is open. Waiting calls continue after the reconnection. After `LINK_TIMEOUT` (10 s) without a
    link, waiting calls and new ones raise LinkError.

    Args:
        link: name of a link, such as `udpin:0.0.0.0:14550` (all forms are in `paramclient.links.FORMS`), a
            link object, or a simulated vehicle.
        cache: cache of the tables: None for the user's cache, a path, a `ParamCache` (the client does not
            close it), or False for none. A replayed log neither reads nor writes a cache.
        system, component: MAVLink ids of this client, 1 to 255.
        encoding: parameter encoding of all components; None detects it for each component.
        watch_interval: seconds between two checks of each fetched table against the vehicle, at least 1.
            None: every 30 s for a vehicle with a hash or checksum (PX4, ArduPilot), never for others.
            0 disables the checks. See `Component.sync_state`.
        policy: which requests may update tables, see `Policy`: "auto", "hash-only" or "cache-only". Any value
            but "auto" also disables the checks of `watch_interval`.
        traffic: whether to count all frames for `traffic_report`. This takes time for each frame.
        listen_only: send nothing, not even a heartbeat. Tables fill from responses to other stations.
        tlog: path of a telemetry log to create, with every frame of both directions.
        signing: key to sign sent frames and to check received ones, or a `Signing` with more options. None:
            frames are not signed, and signatures are not checked.
        split_peers: whether equal ids at different UDP addresses or TCP connections are different components,
            for vehicles that share a system id.

    Attributes:
        link: the link object.
        cache: cache of the tables, or None.
        listens_only: whether the client sends nothing: by `listen_only`, or because the link is a log.

    Raises:
        UsageError: the link name, an id, the interval or the policy is not valid, or one of the latter two is
            given with `listen_only`. On entering: the client was
            entered before, or the telemetry log exists or cannot be created.
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
        listen_only: bool = False,
        tlog: str | os.PathLike[str] | None = None,
        signing: Signing | SigningKey | None = None,
        split_peers: bool = False,
    ) -> None:
        check_ids(system, component, least=1)
        if watch_interval is not None and watch_interval != 0 and not watch_interval >= INTERVAL_MIN:
            raise UsageError(f"watch_interval must be 0 or at least {INTERVAL_MIN:g} s, not {watch_interval}")
        self.policy = Policy(policy)
        if listen_only and (watch_interval or self.policy is not Policy.AUTO):
            raise UsageError("the client only listens: it takes no policy, and no watch_interval but 0")
        self.link = opened = create_link(link)
        is_log = isinstance(opened, ReplayLink)
        self.listens_only = listen_only or is_log
        self.cache = choose_cache(cache, is_log=is_log)
        self.watch_interval = watch_interval
        self._components: dict[Address, Component] = {}
        self._events: Subscribers[Event] = Subscribers()
        self._probe_at: defaultdict[object, float] = defaultdict(float)  # of components that were not heard
        capture = None if tlog is None else Capture(tlog)
        self._traffic = Traffic() if traffic else None
        self.core = core = ClientCore(
            opened,
            CacheWriter(self.cache, owned=self.cache is not cache),
            [tap for tap in (capture, self._traffic) if tap is not None],
            Signing(signing) if isinstance(signing, SigningKey) else signing,
            self._end_streams,
        )
        core.station = core.link_task.station = Station(
            link=opened.name,
            is_stream=opened.is_stream,
            send=core.link_task.queue,
            spawn=core.spawn,
            own_address=(system, component),
            encoding=encoding,
            listens_only=self.listens_only,
            split_peers=split_peers,
            discovered=self._meet,
        )
        core.station.gate.fail(
            ClientClosed("the client is not open; use `async with` or `open`", link=opened.name)
        )

    def __repr__(self) -> str:
        count = counted(len(self._components), "component")
        return f"<ParamClient {self.link.name} {self.core.state}, {count}>"

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(self, *error: object) -> None:
        await self.aclose()

    async def open(self) -> Self:
        """Open the client without an `async with`, until `aclose`. Return the client.

        For a REPL, and for frameworks that start and stop their parts in different tasks. The client runs in
        a task of its own, which ends with `aclose`, or with the event loop. Cancellation closes the client
        again.

        Raises:
            UsageError: the client was opened before, or the telemetry log exists or cannot be created.
            LinkError: the link, or the link to the other program, cannot be opened.
            ClientClosed: `aclose` was called meanwhile.
        """
        await self.core.open()
        return self

    async def aclose(self) -> None:
        """Close the client, as on exit from an `async with`. Any task may call it."""
        await self.core.close()

    @property
    def components(self) -> Mapping[Address, Component]:
        """All components from which messages have arrived, by (system, component). Read-only and live.

        With `split_peers`, ids may occur several times. The keys are then the values of `Component.address`,
        which include the peer; the ids alone are not keys.
        """
        return MappingProxyType(self._components)

    @property
    def autopilots(self) -> list[Component]:
        """The autopilot of each system, sorted by system id, without cameras, gimbals and the like."""
        found = selection.autopilots_of(self.core.station.nodes.values())
        return [self._components[each.address] for each in sorted(found, key=lambda node: node.system)]

    @property
    def bytes_received(self) -> int:
        """Bytes received over the link."""
        return self.core.link_task.bytes_received

    @property
    def bytes_sent(self) -> int:
        """Bytes of all sent frames, including heartbeats."""
        return self.core.link_task.bytes_sent

    def events(self) -> Events:
        """Return a stream of component events from now on: `async for event in client.events()`.

        The stream continues across a reconnection of the link, and ends with a replayed log. It queues at
        most 1,000 events for a slow consumer and then drops the oldest. Cancelling the iteration loses no
        event.

        Raises:
            LinkError: while iterating, after the queued events: the link failed permanently, or the client
                was closed.
        """
        self._events.add(stream := Events())
        return stream

    async def component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """Return the component with this address, after its first message.

        Without arguments, this is the autopilot whose heartbeat was received first; with only a system, the
        autopilot of that system; with only a component, the first component with that id. On a link with
        several vehicles, the result may be a different vehicle at the next start. Use it in programs that
        only read, or if the link has only one vehicle. Programs that write use `only_component`.

        A component that is named in full and was not heard is asked for a value: DroneCAN nodes and WiFi
        bridges send no heartbeat, and some routers pass none on.

        On return, a cached table is in `params`, unless the vehicle does not report its identity.

        Args:
            system: system id.
            component: component id.
            peer: source address of its messages, as in `Component.peer`, or only the host.
            timeout: seconds; None waits without limit.

        Raises:
            UsageError: an id that no component can have.
            NoReply: no message of the component arrived in time.
            LinkError: the link failed, or the client was closed.
        """
        return await self._wait_for(
            lambda: selection.find(self.core.station.nodes.values(), system, component, peer),
            selection.address_in_words(system, component, peer),
            timeout,
            asked=(system, component),
        )

    async def find_autopilots(
        self, *, expect: int | None = None, timeout: float | None = COMPONENT_TIMEOUT
    ) -> list[Component]:
        """Return the autopilot of every vehicle on the link, sorted by system id; for programs for fleets.

        With `expect`, the call returns as soon as this number of autopilots has been heard, so that no
        vehicle is missing. Without it, the call waits for the first autopilot, then listens for further ones
        for 3 s.

        Args:
            expect: the number of autopilots to wait for.
            timeout: seconds until `expect` autopilots are heard, or without `expect` the first one; None
                waits without limit.

        Raises:
            NoReply: no autopilot was heard in time, or fewer than expected; the message names those heard.
            UsageError: `expect` is below 1.
            LinkError: the link failed, or the client was closed.
        """
        if expect is not None and expect < 1:
            raise UsageError(f"expect must be a number of vehicles from 1 up, not {expect}")
        began = anyio.current_time()
        await self.component(timeout=timeout)
        if expect is None:
            timeout = anyio.current_time() - began + VEHICLES_LISTENING_TIME
        with anyio.CancelScope(deadline=began + seconds_of(timeout)):
            while expect is None or len(self.autopilots) < expect:
                await self.core.link_task.wait_for_activity()
        if expect is not None and len(self.autopilots) < expect:
            heard = ", ".join(selection.node_in_words(each.node) for each in self.autopilots)
            waited = anyio.current_time() - began
            raise NoReply(f"{expect} vehicles; heard only {heard}", attempts=0, waited=waited)
        for each in self.autopilots:
            await each.wait_for_cache()
        return self.autopilots

    async def only_component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """Return the component with this address if the choice is unambiguous; for programs that write.

        Without arguments, this is the only autopilot on the link; with only a component, the component with
        that id of the only vehicle. The call waits 1.2 s after the first autopilot for a second one, as every
        autopilot sends a heartbeat once a second. With a system, component 1 of that system is certain after
        its first message. Lost vehicles are ignored.

        Args:
            system: system id.
            component: component id.
            peer: as in `component`.
            timeout: seconds for the whole call; None waits without limit.

        Raises:
            UsageError: an id that no component can have.
            AmbiguousVehicle: several vehicles are on the link, or the only one has several autopilots.
                `vehicles` and the message list them.
            NoReply: no message of the component arrived in time, or too late to exclude a second vehicle.
            LinkError: the link failed, or the client was closed.
        """
        link = self.link
        if self.listens_only or (isinstance(link, SimLink) and link.has_one_vehicle) or peer is not None:
            return await self.component(system, component, peer=peer, timeout=timeout)
        station, awaited = self.core.station, selection.address_in_words(system, component)

        def choose() -> Node | float | None:
            nodes, now, since = station.nodes.values(), anyio.current_time(), station.listening_since
            return selection.only_vehicle(nodes, system, component, now, listening_since=since)

        return await self._wait_for(choose, awaited, timeout, asked=(system, component))

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = COMPONENT_TIMEOUT
    ) -> Component:
        """Return the component of the same vehicle under its new system id, after its first message there.

        For a vehicle whose system id was changed. On ArduPlane and Rover, the new id (SYSID_THISMAV) takes
        effect immediately; on ArduCopter and PX4 (MAV_SYS_ID) after a reboot. The vehicle is recognized by
        its hardware id, or without one, by its autopilot and type.

        Args:
            component: the component under the old system id.
            system: its new system id.
            timeout: seconds; None waits without limit.

        Raises:
            AnotherVehicle: another vehicle has this system id.
            NoReply: no message with this id arrived in time, or no hardware id to recognize it by.
            LinkError: the link failed, or the client was closed.
        """
        before, began = component.identity, anyio.current_time()

        def choose() -> Node | None:
            node = selection.find(self.core.station.nodes.values(), system, component.component, None)
            return node if node is not None and node.presence.received_at > began else None

        found = await self._wait_for(choose, selection.address_in_words(system, component.component), timeout)
        with anyio.move_on_after(seconds_of(timeout)), self.core.station.gate.until_closed():
            await found.node.identification.settled()
        if before.uid is not None and found.identity.uid is None:
            subject = f"the hardware id of {found.node.channel}"
            raise NoReply(subject, attempts=0, waited=anyio.current_time() - began)
        if not before.is_same_vehicle(found.identity):
            raise AnotherVehicle(system, found.component, str(before), str(found.identity))
        return found

    async def fetch_all(
        self, system: int | None = None, *, refresh: bool = False, timeout: float | None = None
    ) -> FetchedAll:
        """Update the tables of all components of one system, or of every system on the link.

        The fetches run in parallel. Components that appear within 1.2 s after the client was opened are
        included. A component that does not respond is given up; it may have no parameters. Where another
        component responds, that takes 3 s, but not of an ArduPilot or PX4, which may be starting.

        Args:
            system: fetch only this system; None for all.
            refresh: as in `Component.fetch_all`.
            timeout: seconds after which partial results are returned; None: no limit.

        Returns:
            The results by (system, component), and the errors of the components that did not respond.

        Raises:
            NoReply: no component was found, or none responded.
            LinkError: the link failed, or the client was closed.
        """
        if refresh:
            self.core.station.check_may_send()
        nodes = self.core.station.nodes
        deadline = anyio.current_time() + seconds_of(timeout)
        await self._wait_for(
            lambda: next((each for each in nodes.values() if system in (None, each.system)), None),
            "a component" if system is None else f"a component of system {system}",
            COMPONENT_TIMEOUT if timeout is None else timeout,
        )
        began = anyio.current_time()
        await anyio.sleep_until(self.core.station.listening_since + LISTENING_TIME)
        chosen = {
            address: each
            for address, each in self._components.items()
            if system in (None, each.system) and each.node.identification.has_parameters
        }
        left = None if timeout is None else max(0.0, deadline - anyio.current_time())
        results: dict[Address, FetchResult] = {}
        silent: dict[Address, NoReply | CacheError] = {}
        scopes: dict[Address, anyio.CancelScope] = {}

        async def fetch(address: Address, component: Component) -> None:
            awaited = f"the parameters of {component.node.channel}"
            try:
                with component.limited(None, awaited, sends=False) as scopes[address]:
                    results[address] = await component.fetch_all(refresh=refresh, timeout=left)
            except (NoReply, CacheError) as error:
                silent[address] = error

        async def give_up_silent() -> None:
            await anyio.sleep_until(began + SILENT_TIME)
            if any(each.node.channel.answered.is_set() for each in chosen.values()):
                for address, each in chosen.items():
                    is_likely = each in self.autopilots and each.autopilot in ("ardupilot", "px4")
                    has_extended = expects_extended(each.identity.vehicle_type, each.component)
                    is_likely |= each.node.channel.answered.is_set() and not has_extended
                    if each.count is None and not is_likely:
                        scopes[address].cancel()

        async with task_group() as tasks:
            tasks.start_soon(give_up_silent)
            async with task_group() as fetches:
                for address, component in chosen.items():
                    fetches.start_soon(fetch, address, component)
            tasks.cancel_scope.cancel()
        if silent and not results:
            raise next(iter(silent.values()))
        return FetchedAll(results, silent)

    def traffic_report(self, *, is_recent: bool = False) -> TrafficReport:
        """Return the traffic statistics of the link: components, message rates, packet loss.

        Args:
            is_recent: whether rates and loss are of the last 5 s, and not of all the time.

        Raises:
            UsageError: the client was made without `traffic=True`.
            LinkError: the link failed, or the client was closed.
        """
        if self._traffic is None:
            raise UsageError("this client does not count traffic; use ParamClient(..., traffic=True)")
        self.core.station.gate.check()
        return self._traffic.report(anyio.current_time(), self.core.link_task.cutter, is_recent=is_recent)

    def signing_report(self) -> SigningReport | None:
        """Return the signing statistics of the link: signed frames, and refused frames with the reasons.

        None if the client has no key.
        """
        verifier = self.core.station.verifier
        return None if verifier is None else verifier.report()

    # what happens on the link

    def _meet(self, node: Node) -> None:
        """Follow a new component."""
        component = self._components[node.address] = Component(self, node, node.plain)
        node.emit = partial(self._emit, component)
        self._events.push(Event(component, "discovered"))
        self.core.spawn(component.join_vehicle)

    def _emit(self, component: Component, kind: Any, **facts: Any) -> None:
        """Tell the subscribers and the cache what has happened to a component."""
        match kind:
            case "identified":
                for each in self._components.values():
                    if each.vehicle is component.node:
                        self.core.spawn(each.load)
                return
            case "replaced":
                self.core.cache_writer.forget(component.node)
                return
            case "found" | "rebooted":
                component.watch.doubt()
                component.ext.watch.doubt()
        self._events.push(Event(component, kind, **facts))
        self.core.link_task.notify()

    def _end_streams(self) -> None:
        error: ParamClientError | None = None if self.core.is_over else self.core.station.gate.error
        for component in self._components.values():
            for each in (component, component.ext):
                each.subscribers.end(error)
                each.cache_is_read.set()
        self._events.end(error)

    async def _wait_for(
        self,
        choose: Callable[[], Node | float | None],
        awaited: str,
        timeout: float | None,
        *,
        asked: tuple[int | None, int | None] = (None, None),
    ) -> Component:
        """Wait until a choice is made, and its cached table is loaded.

        Args:
            choose: called after each message; returns the choice, or when one may be made without a message.
            awaited: for the error.
            timeout: seconds; None waits without limit.
            asked: system and component to which requests are sent; nothing is, without both.
        """
        self.core.station.gate.check()
        began = anyio.current_time()
        station = self.core.station
        system, component = asked
        check_ids(system, component)
        found = choose()
        with anyio.move_on_after(seconds_of(timeout)):
            while not (isinstance(found, Node) or self.core.is_over):
                now, probe_at = anyio.current_time(), math.inf
                if system and component:  # other callers may await it too
                    probe_at = max(self._probe_at[asked], station.listening_since + HEARTBEAT_WAIT)
                    if now >= probe_at:
                        station.probe(system, component)
                        probe_at = self._probe_at[asked] = now + PROBE_INTERVAL
                with anyio.move_on_after(min(probe_at, math.inf if found is None else found) - now):
                    await self.core.link_task.wait_for_activity()
                found = choose()
            if isinstance(found, Node):
                await self._components[found.address].wait_for_cache()
        if isinstance(found, Node):
            return self._components[found.address]
        report = self.signing_report()
        reasons = [] if report is None else [f"{count} for: {why}" for why, count in report.refused.items()]
        refused = f" (frames were refused, {', '.join(reasons)})" if reasons else ""
        hint = "" if refused else selection.hint_of_link(station, self.bytes_received)
        if found is not None:
            hint, awaited = "", f"{awaited}, then {HEARTBEAT_WAIT} s without another vehicle"
        raise NoReply(f"{awaited}{refused}", attempts=0, waited=anyio.current_time() - began, hint=hint)


@dataclass(frozen=True, slots=True)
class FetchedAll:
    """Result of a fetch of several components.

    Attributes:
        results: results of the components that responded, by (system, component).
        silent: errors of the other components, by (system, component). NoReply if the component did not
            respond or is lost, CacheError if the policy allows no download and nothing is cached.
    """

    results: Mapping[Address, FetchResult]
    silent: Mapping[Address, NoReply | CacheError]

    @property
    def complete(self) -> bool:
        """Whether `results` has every parameter of every component that responded."""
        return all(result.complete for result in self.results.values())
