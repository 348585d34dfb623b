"""ParamClient: the public client for the components on a link."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Final, Self

import anyio

from paramclient.cache import ParamCache
from paramclient.client.arguments import COMPONENT_TIMEOUT, address_in_words
from paramclient.client.cache_writer import choose_cache
from paramclient.client.client_task import ClientTask
from paramclient.client.component import Component, fetch_timeout, successor_of
from paramclient.client.core import ClientCore
from paramclient.client.event_dispatch import EventDispatch
from paramclient.client.events import Events
from paramclient.client.fetch_all import FetchedAll, FleetFetch
from paramclient.client.files import Ftp
from paramclient.client.signing import Signing, refused_in_words
from paramclient.client.signing_timestamps import TimestampKeeper
from paramclient.client.stats import ClientStats
from paramclient.client.taps import LinkTaps
from paramclient.client.vehicle_search import VEHICLES_LISTENING_TIME, listen_for_vehicles
from paramclient.errors import NoReply, UsageError
from paramclient.links import Link, ReplayLink, SimLink, create_link
from paramclient.model.values import Encoding
from paramclient.model.wording import counted
from paramclient.protocol.addresses import Address
from paramclient.protocol.no_reply_hint import hint_of_link
from paramclient.protocol.params.fetch_result import Policy, Progress
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.station import Station
from paramclient.protocol.stats.traffic import TrafficReport
from paramclient.protocol.vehicle_selection import LOOK_TIME, VehicleChoice
from paramclient.protocol.wire import SigningKey, SigningReport

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

__all__ = ["ParamClient"]

LISTENING_TIME: Final = 1.2
"""Seconds after opening in which every component has sent a message: each sends a heartbeat once a second."""

protocol_logger = logging.getLogger("paramclient.protocol")


class ParamClient:
    """A ground station for the MAVLink parameter protocol on one link, as an async context manager.

    Inside the `async with`, the client sends a heartbeat once a second, follows every component on the link,
    and keeps their tables in the cache. On exit, waiting calls in other tasks raise ClientClosed, new values
    are written to the cache, and no task, socket or thread remains. Exceptions of the body propagate
    unchanged. Before that, open file sessions are closed on board, also if the body is cancelled. If a
    vehicle does not acknowledge, this takes at most `SESSION_CLOSE_TIMEOUT` (2 s).

    Where an `async with` does not fit, such as in `python -m asyncio`, call `open` and `aclose`.

    A dropped TCP connection, an unplugged serial port or a failed UDP socket is reopened with backoff while
    the client is open. Waiting calls continue after the reconnection, and unacknowledged requests are sent
    again. After `LINK_TIMEOUT` seconds (10) without a link, waiting calls and new ones raise LinkError. If a
    link cannot reconnect (`tcpin` when it can no longer accept connections), every call raises its LinkError.

    Args:
        link: name of a link, such as `udpin:0.0.0.0:14550` (all forms are in `paramclient.links.FORMS`), a
            link object, or a simulated vehicle.
        cache: cache of the tables: None for the user's cache, a path, a `ParamCache` (the client does not
            close it), or False for none. A replayed log neither reads nor writes a cache.
        system, component: MAVLink ids of this client, 1 to 255.
        encoding: parameter encoding of all components; None detects it for each component.
        watch_interval: seconds between two checks of each fetched table against the vehicle, while the link
            is idle. A vehicle sends PARAM_VALUE once after a change, without acknowledgement; a check finds a
            lost one within an interval. None: every 30 s for a vehicle with a hash (two small messages, and
            the values outside the hash) or with a parameter file over MAVFTP, less often if that takes more
            than 1.5 s, and never for other vehicles. A number applies to every vehicle, with a full download
            from those without a hash. 0 disables the checks. See `Component.sync_state`.
        policy: which requests may update tables, see `Policy`: "auto", "hash-only" or "cache-only". Any value
            but "auto" also disables the checks of `watch_interval`. Single reads and writes are not affected.
        traffic: whether to count all frames for `traffic_report`. This takes time for each frame, also for
            frames that the client otherwise skips.
        listen_only: send nothing, not even a heartbeat. Tables fill from responses to other stations;
            `fetch_all` waits for a list that another station requests; `get`, `set` and other requests
            raise UsageError.
        forward: link to one other program, by name or as an object, such as `udpout:127.0.0.1:14551`. The
            program receives every received frame, and its frames are sent to the vehicles, except with
            `listen_only`. A slow or absent program does not delay the client.
        tlog: path of a telemetry log to create, with every frame of both directions. An existing file is not
            overwritten. A full disk ends the log with a warning and has no other effect.
        signing: key to sign sent frames and to check received ones, or a `Signing` with more options. None:
            frames are not signed, and signatures are not checked.
        split_peers: whether equal ids at different UDP addresses or TCP connections are different components,
            for vehicles that share a system id. A vehicle with two connections to this computer then appears
            twice, and so does a vehicle that was restarted with another port.

    Attributes:
        cache: cache of the tables, or None.

    Raises:
        UsageError: the link name, an id, the interval or the policy is not valid. On entering: the client was
            entered before, or the telemetry log exists or cannot be created.
        LinkError: on entering: the link, or the link to the other program, cannot be opened.
    """

    _task: ClientTask | None = None
    _is_entered = False

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
        split_peers: bool = False,
    ) -> None:
        for number in (system, component):
            if not 1 <= number <= 255:
                raise UsageError(f"the client's system and component ids must be 1 to 255, not {number}")
        opened = create_link(link)
        is_log = isinstance(opened, ReplayLink)
        self.cache = choose_cache(cache, is_log=is_log)
        station = Station(
            link=opened.name,
            is_stream=opened.is_stream,
            system=system,
            component=component,
            encoding=encoding,
            sync_settings=SyncSettings.chosen(watch_interval, policy, listen_only=listen_only, is_log=is_log),
            split_peers=split_peers,
            counts_traffic=traffic,
            trace=protocol_logger.debug,
        )
        signing = Signing(signing) if isinstance(signing, SigningKey) else signing
        self.core = ClientCore(
            opened,
            station,
            self.cache,
            owns_cache=self.cache is not cache,
            taps=LinkTaps(tlog, forward, is_stream=opened.is_stream),
            keeper=None if signing is None else TimestampKeeper(signing),
        )
        self.dispatch = EventDispatch(self.core, splits_peers=split_peers)
        self._splits_peers = split_peers

    def __repr__(self) -> str:
        count = counted(len(self.dispatch.components), "component")
        return f"<ParamClient {self.link.name} {self.core.state}, {count}>"

    async def __aenter__(self) -> Self:
        await self.core.open()
        self._is_entered = True
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await self.core.close(failed=kind is not None)
        finally:
            self._is_entered = False

    async def open(self) -> Self:
        """Open the client without an `async with`, until `aclose`. Return the client.

        For a REPL, and for frameworks that start and stop their parts in different tasks. The client runs in
        a task of its own, which ends with `aclose`, or with the event loop if `aclose` is not called; if the
        loop does not cancel its tasks, as when `python -m asyncio` is left, values of the last 0.25 s may be
        missing in the cache. An unexpected error in a task of the client ends the client: it is logged,
        waiting calls and new ones raise ClientClosed with the error as the cause, and `aclose` raises it.

        Cancellation closes the client again.

        Raises:
            UsageError: the client was opened before, or the telemetry log exists or cannot be created.
            LinkError: the link, or the link to the other program, cannot be opened.
            ClientClosed: `aclose` was called meanwhile.
        """
        task = ClientTask(self.core)
        if self._task is None and not self._is_entered:
            self._task = task
        await task.open()
        return self

    async def aclose(self) -> None:
        """Close a client that `open` has opened, as on exit from an `async with`.

        Any task may call it, also while `open` or another `aclose` is running. It has no effect on a client
        that is not open, or closed already. Cancellation skips no step except waiting for a hash.

        Raises:
            UsageError: the client was entered with `async with`, which closes it on exit.
        """
        if self._is_entered:
            raise UsageError(
                "the client was opened by `async with`, which closes it: leave its body instead of calling"
                " aclose"
            )
        if self._task is not None:
            await self._task.close()

    @property
    def components(self) -> Mapping[Address, Component]:
        """All components from which messages have arrived, by (system, component). Read-only and live.

        With `split_peers`, ids may occur several times. The keys are then the values of `Component.address`,
        which include the peer; the ids alone are not keys.
        """
        return MappingProxyType(self.dispatch.components)

    @property
    def autopilots(self) -> list[Component]:
        """The autopilot of each system, sorted by system id, without cameras, gimbals and the like."""
        station = self.core.station
        machines = dict.fromkeys(machine.vehicle for machine in station.components.values())
        vehicles = sorted(machines, key=lambda vehicle: vehicle[0])
        found = [station.autopilot_of(*vehicle) for vehicle in vehicles]
        return [self.components[machine.address] for machine in found if machine is not None]

    @property
    def link(self) -> Link:
        """The link object of the client."""
        return self.core.link

    @property
    def listens_only(self) -> bool:
        """Whether the client sends nothing: because of `listen_only`, or because the link is a log."""
        return self.core.station.listens_only

    @property
    def bytes_received(self) -> int:
        """Bytes received over the link."""
        return self.core.station.bytes_received

    @property
    def bytes_sent(self) -> int:
        """Bytes of all sent frames, including heartbeats."""
        return self.core.station.bytes_sent

    @property
    def stats(self) -> ClientStats:
        """Counters of the client since its creation, also after it is closed."""
        counts = self.dispatch
        return ClientStats.of(self.core.station, downloads=counts.downloads, cache_hits=counts.cache_hits)

    def events(self) -> Events:
        """Return a stream of component events from now on: `async for event in client.events()`.

        The events are Discovered, Lost, Found, Rebooted, Resynced, Contested and Uncontested. The stream
        continues across a reconnection of the link. It is released with its last reference, and ends with a
        replayed log. It queues at most 1,000 events for a slow consumer and then drops the oldest.
        Cancelling the iteration loses no event.

        Raises:
            LinkError: while iterating, after the queued events: the link failed permanently, or the client
                was closed.
        """
        self.dispatch.events.add(events := Events())
        return events

    def ftp(self, component: Component) -> Ftp:
        """Return the MAVFTP file calls of a component."""
        return Ftp(component.core)

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
        several vehicles, the result may be a different vehicle at the next start, and the call does not
        report the other vehicles. Use it in programs that only read, or if the link has only one vehicle.
        Programs that write use `only_component`, which raises AmbiguousVehicle instead.

        On return, a cached table is in `params`, unless the vehicle does not report its identity.

        Args:
            system: system id.
            component: component id.
            peer: source address of its messages, as in `Component.peer`, or only the host.
            timeout: seconds; None waits without limit.

        Raises:
            NoReply: no message of the component arrived in time.
            LinkError: the link failed, or the client was closed.
        """
        self.core.check_open()
        began = anyio.current_time()
        with anyio.move_on_after(timeout):
            while (found := self._find(system, component, peer)) is None and not self.core.station.is_over:
                await self.core.link_task.activity.wait()
                self.core.check_open()
            if found is not None:
                await found.core.wait_for_cache()
        if found is None:
            raise self._not_received(address_in_words(system, component, peer), began)
        return found

    async def find_autopilots(
        self, *, expect: int | None = None, timeout: float | None = COMPONENT_TIMEOUT
    ) -> list[Component]:
        """Return the autopilot of every vehicle on the link, sorted by system id; for programs for fleets.

        With `expect`, the call returns as soon as this number of autopilots has been heard, and raises
        NoReply if fewer were heard in time. A program that sets up vehicles names the number, so that no
        vehicle is missing. Without `expect`, the call waits for the first autopilot, then listens for
        further ones for `VEHICLES_LISTENING_TIME` (3 s), and returns all that were heard.

        The result is that of `autopilots`, and includes autopilots that were heard and are lost now.

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
        listening: float | None = VEHICLES_LISTENING_TIME
        if expect is not None:
            listening = None if timeout is None else began + timeout - anyio.current_time()
        found = await listen_for_vehicles(
            lambda: self.autopilots,
            expect=expect,
            timeout=listening,
            began=began,
            check_open=self.core.check_open,
        )
        for each in found:
            await each.core.wait_for_cache()
        return found

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
        that id of the only vehicle. The call waits `LOOK_TIME` (1.2 s) after the first autopilot for a second
        one, as every autopilot sends a heartbeat once a second. With only a system, it is the autopilot of
        that system: component 1 after its first message, or another one if it is the only one for 1.2 s. With
        both ids, it is that component after its first message. Lost vehicles are ignored. The call sends only
        identity requests.

        The call returns immediately if the client has already listened long enough. A program can therefore
        repeat it directly before it writes.

        Args:
            system: system id.
            component: component id.
            peer: as in `component`.
            timeout: seconds for the whole call; None waits without limit.

        Raises:
            AmbiguousVehicle: several vehicles are on the link, or the only one has several autopilots.
                `vehicles` and the message list them.
            NoReply: no message of the component arrived in time, or too late to exclude a second vehicle.
            LinkError: the link failed, or the client was closed.
        """
        if self._has_one_vehicle:
            return await self.component(system, component, peer=peer, timeout=timeout)
        self.core.check_open()
        began = anyio.current_time()
        choice = VehicleChoice(system, component, splits_peers=self._splits_peers)
        station = self.core.station
        machine = None
        with anyio.move_on_after(timeout), station.looking_for_others():
            while True:
                activity, now = self.core.link_task.activity, anyio.current_time()
                since = station.listening_since
                machine = choice.look(station.at_peer(peer), now, listening_since=since)
                if machine is not None or station.is_over:
                    break
                with anyio.move_on_after(None if choice.due == math.inf else choice.due - now):
                    await activity.wait()
                await self.core.link_task.wait_for_reader(choice.due)
                self.core.check_open()
            if machine is not None:
                await self.components[machine.address].core.wait_for_cache()
        if machine is not None:
            return self.components[machine.address]
        awaited = address_in_words(system, component, peer)
        if choice.due < math.inf:
            awaited += f", then {LOOK_TIME} s without another vehicle"
            raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began)
        raise self._not_received(awaited, began)

    def _not_received(self, awaited: str, began: float) -> NoReply:
        """Return the error of a component that was not received, with what was received instead."""
        refused = refused_in_words(self.signing_report())
        hint = "" if refused else hint_of_link(self.core.station, self.link.name)
        waited = anyio.current_time() - began
        return NoReply(f"{awaited}{refused}", attempts=0, waited=waited, hint=hint)

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = COMPONENT_TIMEOUT
    ) -> Component:
        """Return the component of the same vehicle under its new system id, after its first message there.

        For a vehicle whose system id was changed. On ArduPlane and Rover, the new id (SYSID_THISMAV) takes
        effect immediately; on ArduCopter and PX4 (MAV_SYS_ID) after a reboot (see `Component.reboot`). The
        vehicle is recognized by its hardware id, or without one, by its autopilot and type and by its silence
        under the old id.

        Args:
            component: the component under the old system id.
            system: its new system id.
            timeout: seconds; None waits without limit.

        Raises:
            AnotherVehicle: another vehicle has this system id.
            NoReply: no message with this id arrived in time, or the vehicle did not report its identity.
            LinkError: the link failed, or the client was closed.
        """
        return await successor_of(component, system, timeout=timeout)

    async def fetch_all(
        self,
        system: int | None = None,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Mapping[Address, Progress]], None] | None = None,
    ) -> FetchedAll:
        """Update the tables of all components of one system, or of every system on the link.

        The fetches run in parallel. Components that appear during the call are included, and the call waits
        for components until `LISTENING_TIME` (1.2 s) after the client was opened. A component that does not
        respond is given up when another fetch has ended: after 1 s, or 4 times the longest response time of
        another component.

        Cancellation keeps the received values in the tables.

        Args:
            system: fetch only this system, with one list request for all of its components; None for all.
            refresh: as in `Component.fetch_all`.
            timeout: seconds after which partial results are returned; None: no limit, except 20 s if the
                client only listens.
            progress: called about ten times a second with the progress by (system, component), from this
                task.

        Returns:
            The results by (system, component), and the errors of the components that did not respond.

        Raises:
            UsageError: `refresh` is given, and the policy allows no download.
            CacheError: nothing is cached for any component, and the policy allows no download.
            NoReply: no component was found, or none responded.
            LinkError: the link failed, or the client was closed.
        """
        self.core.station.check_refresh(refresh)
        timeout = fetch_timeout(self.core.station, timeout)
        began = anyio.current_time()
        together = FleetFetch(self.core, self.components, system, refresh=refresh)
        return await together.run(
            until=math.inf if timeout is None else began + timeout,
            hear_until=began + (COMPONENT_TIMEOUT if timeout is None else timeout),
            listen_until=self.core.opened_at + LISTENING_TIME,
            progress=progress,
        )

    def traffic_report(self) -> TrafficReport:
        """Return the traffic statistics of the link: components, message rates, packet loss.

        Raises:
            UsageError: the client was made without `traffic=True`.
            LinkError: the link failed, or the client was closed.
        """
        if self.core.station.traffic is None:
            raise UsageError("this client does not count traffic; use ParamClient(..., traffic=True)")
        self.core.check_open()
        return self.core.station.traffic.report(anyio.current_time())

    def signing_report(self) -> SigningReport | None:
        """Return the signing statistics of the link: signed frames, and refused frames with the reasons.

        None if the client has no key.
        """
        return None if self.core.station.verifier is None else self.core.station.verifier.report()

    @property
    def _has_one_vehicle(self) -> bool:
        """Whether the choice of a vehicle cannot be wrong: there is only one, or nothing is sent."""
        return self.listens_only or (isinstance(self.link, SimLink) and self.link.has_one_vehicle)

    def _find(self, system: int | None, component: int | None, peer: str | None) -> Component | None:
        found = self.core.station.find(system, component, peer)
        return None if found is None else self.components[found.address]
