"""The blocking classes, generated from the asynchronous ones: see `make sync`."""

from __future__ import annotations

import builtins
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeAlias

from paramclient.cache import ParamCache, SnapshotSummary
from paramclient.client import events as asynchronous
from paramclient.client.arguments import COMPONENT_TIMEOUT
from paramclient.client.client import ParamClient as AsyncParamClient
from paramclient.client.component import Component as AsyncComponent
from paramclient.client.component import Component as AsyncExtParams
from paramclient.client.component import ComponentState
from paramclient.client.files import Ftp as AsyncFtp
from paramclient.client.fleet_fetch import FetchedAll
from paramclient.client.reset import ResetResult
from paramclient.client.signing import Signing
from paramclient.client.stats import ClientStats
from paramclient.client.traffic import TrafficReport
from paramclient.links import Link
from paramclient.model.ext_params import ExtParam, ExtSettable
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.values import Encoding, Param, Settable, WireValue
from paramclient.protocol.addresses import Address
from paramclient.protocol.events import Change
from paramclient.protocol.fetch import FetchResult, Policy, Progress
from paramclient.protocol.ftp import FILE_SIZE_MAX, DirectoryEntry
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetResult
from paramclient.protocol.vehicle.address_contest import Contest
from paramclient.protocol.watch import SyncState
from paramclient.sync.client_thread import ClientThread
from paramclient.sync.wrappers import (
    BlockingClient,
    BlockingStream,
    LiveMapping,
    Wrapper,
    live_mapping,
    live_params,
    own_values,
    wrapped_by,
)
from paramclient.wire.signing import SigningKey, SigningReport

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

__all__ = [
    "Changes",
    "Component",
    "Contested",
    "Discovered",
    "Event",
    "Events",
    "ExtChanges",
    "Component",
    "Found",
    "Ftp",
    "Lost",
    "ParamClient",
    "Rebooted",
    "Resynced",
    "Uncontested",
]


class ParamClient(BlockingClient):
    """A ground station for the MAVLink parameter protocol on one link, with calls that block.

    The client runs in a thread of its own. Inside the `with`, it sends a heartbeat once a second, follows
    every component on the link, and keeps their tables in the cache. On exit, waiting calls in other threads
    raise ClientClosed, new values are written to the cache, and no socket or thread remains. Exceptions of
    the body propagate unchanged. Before that, open file sessions are closed on board, also after Ctrl-C. If a
    vehicle does not acknowledge, this takes at most `SESSION_CLOSE_TIMEOUT` (2 s).

    Where a `with` does not fit, such as in a REPL, call `open` and `close`. A client that is not closed is
    closed when the last reference to it is dropped, and at the end of the program.

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
        super().__init__(
            partial(
                AsyncParamClient,
                link,
                cache=cache,
                system=system,
                component=component,
                encoding=encoding,
                watch_interval=watch_interval,
                policy=policy,
                traffic=traffic,
                listen_only=listen_only,
                forward=forward,
                tlog=tlog,
                signing=signing,
                split_peers=split_peers,
            )
        )

    @property
    def cache(self) -> ParamCache | None:
        """Cache of the tables, or None."""
        return self._wrapped.cache

    @property
    def components(self) -> Mapping[Address, Component]:
        """All components from which messages have arrived, by (system, component). Read-only and live.

        With `split_peers`, ids may occur several times. The keys are then the values of `Component.address`,
        which include the peer; the ids alone are not keys.
        """
        return _components(self._thread, self._wrapped)

    @property
    def autopilots(self) -> list[Component]:
        """The autopilot of each system, sorted by system id, without cameras, gimbals and the like."""
        found = self._thread.read(lambda: self._wrapped.autopilots)
        return [Component.of(self._thread, each) for each in found]

    @property
    def link(self) -> Link:
        """The link object of the client."""
        return self._thread.read(lambda: self._wrapped.link)

    @property
    def listens_only(self) -> bool:
        """Whether the client sends nothing: because of `listen_only`, or because the link is a log."""
        return self._thread.read(lambda: self._wrapped.listens_only)

    @property
    def bytes_received(self) -> int:
        """Bytes received over the link."""
        return self._thread.read(lambda: self._wrapped.bytes_received)

    @property
    def bytes_sent(self) -> int:
        """Bytes of all sent frames, including heartbeats."""
        return self._thread.read(lambda: self._wrapped.bytes_sent)

    @property
    def stats(self) -> ClientStats:
        """Counters of the client since its creation, also after it is closed."""
        return self._thread.read(lambda: self._wrapped.stats)

    def events(self) -> Events:
        """Return a stream of component events from now on: `for event in client.events()`.

        The events are Discovered, Lost, Found, Rebooted, Resynced, Contested and Uncontested. The stream
        continues across a reconnection of the link. It is released with its last reference, and ends with a
        replayed log. It queues at most 1,000 events for a slow consumer and then drops the oldest. Ctrl-C
        loses no event.

        Raises:
            LinkError: while iterating, after the queued events: the link failed permanently, or the client
                was closed.
        """
        return Events(self._thread, self._wrapped.events)

    def ftp(self, component: Component) -> Ftp:
        """Return the MAVFTP file calls of a component.

        Raises:
            UsageError: the component belongs to a client over a service.
        """
        return Ftp.of(self._thread, self._thread.read(partial(self._wrapped.ftp, wrapped_by(component))))

    def component(
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
        return Component.of(
            self._thread,
            self._thread.call(
                partial(self._wrapped.component, system, component, peer=peer, timeout=timeout)
            ),
        )

    def find_autopilots(
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
            UsageError: `expect` is below 1. Over a service: its links have autopilots with equal ids.
            LinkError: the link failed, or the client was closed.
        """
        found = self._thread.call(partial(self._wrapped.find_autopilots, expect=expect, timeout=timeout))
        return [Component.of(self._thread, each) for each in found]

    def only_component(
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
        return Component.of(
            self._thread,
            self._thread.call(
                partial(self._wrapped.only_component, system, component, peer=peer, timeout=timeout)
            ),
        )

    def successor(
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
        return Component.of(
            self._thread,
            self._thread.call(
                partial(self._wrapped.successor, wrapped_by(component), system, timeout=timeout)
            ),
        )

    def fetch_all(
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

        Ctrl-C keeps the received values in the tables.

        Args:
            system: fetch only this system, with one list request for all of its components; None for all.
            refresh: as in `Component.fetch_all`.
            timeout: seconds after which partial results are returned; None: no limit, except 20 s if the
                client only listens.
            progress: called about ten times a second with the progress by (system, component), in the calling
                thread.

        Returns:
            The results by (system, component), and the errors of the components that did not respond.

        Raises:
            UsageError: `refresh` is given, and the policy allows no download.
            CacheError: nothing is cached for any component, and the policy allows no download.
            NoReply: no component was found, or none responded.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.call_reporting(
            partial(self._wrapped.fetch_all, system, refresh=refresh, timeout=timeout), progress
        )

    def traffic_report(self) -> TrafficReport:
        """Return the traffic statistics of the link: components, message rates, packet loss.

        Raises:
            UsageError: the client was made without `traffic=True`.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.read(self._wrapped.traffic_report)

    def signing_report(self) -> SigningReport | None:
        """Return the signing statistics of the link: signed frames, and refused frames with the reasons.

        None if the client has no key.
        """
        return self._thread.read(self._wrapped.signing_report)


class Component(Wrapper[AsyncComponent]):
    """One component of a vehicle; see `ParamClient.component`.

    Ctrl-C ends a waiting call; later calls are not affected. Several threads may call at the same time. While
    a link reconnects, calls wait for up to `LINK_TIMEOUT` (10 s, in `client.reconnect_delays`). After that,
    and when the client is closed, they raise LinkError. A lost component (see `Lost`) receives no requests:
    waiting calls and new ones raise NoReply immediately, except a running `fetch_all`, which continues for a
    while, as the vehicle may be rebooting. A component whose address several vehicles use (see `Contested`)
    receives no requests either: calls raise ContestedAddress. In both cases the table is kept, and its values
    are *cached* until the vehicle has confirmed them.

    Attributes:
        system, component: MAVLink ids of the component.
        params: the known parameters by name: live, verified or cached, see `Trust`. The mapping is read-only
            and follows the received messages.
    """

    @property
    def system(self) -> int:
        """MAVLink ids of the component."""
        return self._wrapped.system

    @property
    def component(self) -> int:
        """MAVLink ids of the component."""
        return self._wrapped.component

    @cached_property
    def params(self) -> ParamMap:
        """The known parameters by name: live, verified or cached, see `Trust`. The mapping is read-only and
        follows the received messages.
        """
        return live_params(self._thread, self._wrapped.params)

    @property
    def autopilot(self) -> str:
        """Autopilot of its heartbeat: px4, ardupilot, generic, …; "unknown" before the first heartbeat."""
        return self._thread.read(lambda: self._wrapped.autopilot)

    @property
    def identity(self) -> Identity:
        """Identity of the vehicle from AUTOPILOT_VERSION: hardware id, firmware, capabilities, if known."""
        return self._thread.read(lambda: self._wrapped.identity)

    @property
    def encoding(self) -> Encoding:
        """Encoding of its parameter values in messages: bytewise or C cast."""
        return self._thread.read(lambda: self._wrapped.encoding)

    @property
    def encoding_reason(self) -> str:
        """The reason for `encoding`, as text."""
        return self._thread.read(lambda: self._wrapped.encoding_reason)

    @property
    def ext(self) -> Component:
        """The extended parameters of the component (PARAM_EXT_*), with their own calls.

        Raises:
            UsageError: the client is connected to a service of an earlier version without extended
                parameters.
        """
        return Component.of(self._thread, self._thread.read(lambda: self._wrapped.ext))

    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_VALUE."""
        return self._thread.read(lambda: self._wrapped.count)

    @property
    def hash(self) -> int | None:
        """The PX4 hash (`_HASH_CHECK`) of the complete table; None if it is not known."""
        return self._thread.read(lambda: self._wrapped.hash)

    @property
    def state(self) -> ComponentState:
        """State of the table: new, cached, fetching, synced, partial, contested or lost."""
        return self._thread.read(lambda: self._wrapped.state)

    @property
    def sync_state(self) -> SyncState:
        """Whether the table matches the vehicle, and the running check or update."""
        return self._thread.read(lambda: self._wrapped.sync_state)

    @property
    def address(self) -> Address:
        """Its key in `ParamClient.components`: (system, component), with `split_peers` also the peer."""
        return self._thread.read(lambda: self._wrapped.address)

    @property
    def peer(self) -> str:
        """Address and port from which its messages arrive, and to which requests go; empty if unknown."""
        return self._thread.read(lambda: self._wrapped.peer)

    @property
    def contest(self) -> Contest | None:
        """The vehicles that share its address, and their differences; None if there is only one vehicle.

        During a contest, every call raises ContestedAddress, `params` does not change, and the cache receives
        nothing.
        """
        return self._thread.read(lambda: self._wrapped.contest)

    @property
    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed, from `base_mode` of its last heartbeat.

        None if unknown: before the first heartbeat, while the component is lost, and in high-latency mode, in
        which a vehicle sends no heartbeats.
        """
        return self._thread.read(lambda: self._wrapped.is_armed)

    @property
    def silence(self) -> float:
        """Seconds since its last message. After 5 s the component is lost, see `Lost`."""
        return self._thread.read(lambda: self._wrapped.silence)

    @property
    def round_trip(self) -> float | None:
        """Smoothed round-trip time in seconds; None before the first response."""
        return self._thread.read(lambda: self._wrapped.round_trip)

    def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Read one parameter from the vehicle with PARAM_REQUEST_READ.

        Concurrent calls for one parameter share a request. Calls for different parameters run in parallel.
        Ctrl-C ends the request unless another call waits for it.

        Args:
            name: param_id, or an index from 0.
            timeout: seconds; None: the number of attempts, which follows the measured round-trip time and
                packet loss, limits the time.

        Returns:
            The parameter as the vehicle has reported it.

        Raises:
            UsageError: the name or index is not valid, or the client only listens.
            UnknownParameter: the vehicle has no such parameter.
            Refused: the vehicle refused with a reason (PARAM_ERROR).
            NoReply: the vehicle did not respond in time, or it is lost.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.call(partial(self._wrapped.get, name, timeout=timeout))

    def set(
        self,
        name: str,
        value: Settable,
        *,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        author: str | None = None,
    ) -> SetResult:
        """Write one parameter with PARAM_SET and verify the value that the vehicle acknowledges.

        An unknown type is read from the vehicle first. Writes to one name run in the order of the calls,
        writes to different names in parallel. After Ctrl-C it is unknown whether the vehicle has the value.

        Args:
            name: param_id.
            value: a number; or the 4 bytes of the message for a value that is not expressible as a number.
            timeout: as in `get`.
            settle: seconds, 0 to 60, for which the value is watched after its acknowledgement; then it is
                read again, and the result has the final value. 1.2 is enough for PX4, whose modules change
                values up to 1.1 s later. Without it, such a change only appears in `changes`.
            force: send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot,
                which ignores them.
            durable: return only after the value and its history entry are synced to the disk, safe from power
                loss. Otherwise they are written within 0.25 s, and a later power loss may still lose them.
            author: the user of the change, in printable ASCII: the change, and its history entry, then have
                the author "us for AUTHOR".

        Returns:
            Accepted, or adjusted: the vehicle stored another value.

        Raises:
            UsageError: the name, the value or another argument is not valid, the value is NaN or infinite
                and the autopilot cannot store that, or the client only listens. Nothing was written.
            UnknownParameter: the vehicle has no such parameter.
            Refused: the vehicle refused with a reason (PARAM_ERROR).
            TypeMismatch: the parameter has another type on the vehicle.
            ValueNotApplied: the vehicle keeps its previous value and reports no reason.
            NoReply: the vehicle did not respond. It is unknown whether it has the value.
            ContestedAddress: several vehicles use its address.
            NotDurable: the vehicle has accepted the value, but it could not be written to the disk.
            CacheError: with `durable`, the disk cannot be written; nothing was sent.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.call(
            partial(
                self._wrapped.set,
                name,
                value,
                timeout=timeout,
                settle=settle,
                force=force,
                durable=durable,
                author=author,
            )
        )

    def set_many(
        self,
        values: Mapping[str, Settable] | Iterable[tuple[str, Settable]],
        *,
        progress: Callable[[SetOutcome], None] | None = None,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        author: str | None = None,
    ) -> SetManyResult:
        """Write many parameters in one call, and verify each as `set` does.

        Several writes are in flight at a time, as many as the vehicle serves. Writes to one name run in the
        order given. A parameter that reveals or hides others, such as `*_ENABLE`, is written alone: all
        writes before it end first, and those after it begin afterwards. A value that is refused does not stop
        the others.

        If the vehicle is lost, the link fails, three writes in a row get no response or the timeout expires,
        the call returns the outcomes so far: each value that was sent and not acknowledged is *unknown*, each
        value that was not sent is *not tried*, and `error` of the result is the cause. After Ctrl-C it is
        unknown whether the vehicle has the values that were sent.

        Args:
            values: values by name, or pairs of name and value; a name may occur in several pairs. Values are
                as in `set`.
            progress: called with each outcome in the order of their arrival, in the calling thread. Over a
                service, they arrive together.
            timeout: seconds for the whole call; None: no limit besides the number of attempts.
            settle: seconds as in `set`, for which each value is watched; the other writes continue meanwhile.
            force, author: as in `set`.
            durable: return only after all values and history entries are synced to the disk. If that fails,
                the `error` of the result and of each outcome is NotDurable.

        Returns:
            One outcome for each value, in the order given: accepted, adjusted, refused, unknown or not tried.

        Raises:
            UsageError: a name, a value or another argument is not valid, or the client only listens. Nothing
                was written.
            NoReply: the vehicle is lost already. Nothing was written.
            ContestedAddress: several vehicles use its address. Nothing was written.
            CacheError: with `durable`, the disk cannot be written; nothing was sent.
            LinkError: the link had failed already, or the client was closed.
        """
        return self._thread.call_reporting(
            partial(
                self._wrapped.set_many,
                own_values(values),
                timeout=timeout,
                settle=settle,
                force=force,
                durable=durable,
                author=author,
            ),
            progress,
        )

    def reset(
        self,
        *names: str,
        defaults: Mapping[str, WireValue] | None = None,
        progress: Callable[[SetOutcome], None] | None = None,
        timeout: float | None = None,
        settle: float = 0.0,
        durable: bool = False,
        author: str | None = None,
    ) -> ResetResult:
        """Set parameters to the firmware's defaults, and verify each as `set` does.

        The parameters are fetched first: ArduPilot, and PX4 from 1.18 on, give the defaults in the file
        `param.pck`. Parameters without a known default, and those that have it already, are not written. The
        values are written as by `set_many`, in the order of the names.

        Args:
            names: param_ids, at least one.
            defaults: defaults of parameters whose default the vehicle does not give, by name, such as
                `Metadata.defaults_of`.
            progress, settle, durable, author: as in `set_many`.
            timeout: seconds for the whole call; None: no limit besides the number of attempts.

        Returns:
            The outcomes of the written values, and the names that were not written.

        Raises:
            UsageError: no name, or another argument is not valid, or the client only listens.
            UnknownParameter: the vehicle has no parameter with one of the names. Nothing was written.
            NoReply: the vehicle did not respond. Nothing was written.
            ParamClientError: as from `fetch_all` and `set_many`.
        """
        return self._thread.call_reporting(
            partial(
                self._wrapped.reset,
                *names,
                defaults=defaults,
                timeout=timeout,
                settle=settle,
                durable=durable,
                author=author,
            ),
            progress,
        )

    def fetch_all(
        self,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """Fetch all parameters. Uses the cache if the vehicle's hash matches, otherwise downloads.

        If the cache has a table and the vehicle a hash, the client requests the hash first. If it matches,
        nothing is downloaded, and the values outside the hash are read in the background: they stay *cached*
        until then, and `refreshed` waits for them.

        Otherwise the client downloads the packed file `param.pck` over MAVFTP if the component serves it: it
        is faster than the list, exact, and has the firmware's defaults. If not, it downloads the list.
        `source` and `notes` of the result give the source and the reason.

        A client that only listens sends no request: it waits for a list that another station requests. The
        fetch ends when the table is complete, or 5 s after the last new value.

        The fetch always ends: indices without a response after all attempts are in `missing`. Concurrent
        calls share one fetch. Ctrl-C keeps the received values in the table.

        Args:
            refresh: download even if the hash would confirm the cached table.
            timeout: seconds after which the partial table is returned with `missing`; None: no limit, except
                20 s if the client only listens.
            progress: called about ten times a second, in the calling thread.

        Returns:
            The parameters with their source, the missing indices and notes.

        Raises:
            UsageError: `refresh` is given and the policy of the client allows no download, or the client only
                listens.
            CacheError: nothing is cached, and the policy allows no download.
            NoReply: no response arrived, or the component is lost.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.call_reporting(
            partial(
                self._wrapped.fetch_all,
                refresh=refresh,
                timeout=timeout,
            ),
            progress,
        )

    def refreshed(self, *, timeout: float | None = None) -> None:
        """Wait until the values outside the hash have been read after `fetch_all`.

        Returns immediately if there are none. A value that cannot be read stays *cached*. Ctrl-C does not
        stop the reads.

        Args:
            timeout: seconds; None waits without limit.

        Raises:
            NoReply: the reads took longer than `timeout`.
            LinkError: the link failed, or the client was closed.
        """
        self._thread.call(partial(self._wrapped.refreshed, timeout=timeout))

    def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Send a new signing key to the vehicle with SETUP_SIGNING, or with None remove its key.

        The key is sent unencrypted: use a link that no other party can read, such as a USB cable. MAVLink has
        no acknowledgement for SETUP_SIGNING; a session with the new key shows whether the vehicle uses it.
        This session keeps its own key, which must be the vehicle's current key unless the vehicle trusts the
        link (ArduPilot trusts USB). After Ctrl-C the vehicle may have the new key.

        Args:
            key: the new key, or None.
            link_is_safe: confirmation by the user that no other party can read the link.

        Raises:
            UsageError: `link_is_safe` is False, or the component uses MAVLink 1.
            LinkError: the link failed, or the client was closed.
        """
        self._thread.call(partial(self._wrapped.setup_signing, key, link_is_safe=link_is_safe))

    def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """Reboot the vehicle, and wait until the same vehicle is back.

        The command is sent 2.5 s after the last write of this client, so that the vehicle has saved it. The
        client detects the reboot from the vehicle's clock, its heartbeat, its frame sequence numbers or its
        silence, so the acknowledgement may be lost. Then it verifies the hardware id, or without one, the
        autopilot and type of the heartbeat. As after every boot, the table is *cached* until it is confirmed;
        parameters may have changed.

        Concurrent calls share one reboot. After Ctrl-C, the vehicle may still reboot.

        Args:
            system: the new system id, if a changed one takes effect with the reboot (MAV_SYS_ID of PX4,
                SYSID_THISMAV of ArduCopter); the client then finds the vehicle as `ParamClient.successor`
                does.
            timeout: seconds; None for `REBOOT_TIMEOUT` (60 s).

        Returns:
            This component, or the component with the new system id.

        Raises:
            CommandRefused: the vehicle refused, most likely because it is armed.
            AnotherVehicle: another vehicle responds under its system id.
            NoReply: the vehicle did not respond, or was not back in time.
            LinkError: the link failed, or the client was closed.
        """
        return Component.of(
            self._thread, self._thread.call(partial(self._wrapped.reboot, system=system, timeout=timeout))
        )

    def changes(self) -> Changes:
        """Return a stream of parameter changes from now on: `for change in component.changes()`.

        Each change has the name, the old and the new value. The first value of a parameter is a change too. A
        slow consumer receives several changes of one parameter as one, so the queue has at most one change
        for each parameter. The stream continues across a reconnection of the link. It is released with its
        last reference, and ends with a replayed log. Ctrl-C loses no change.

        Raises:
            LinkError: while iterating, after the queued changes: the link failed permanently, or the client
                was closed.
            NoReply: while iterating: the component was lost and is no longer followed.
        """
        return Changes(self._thread, self._wrapped.changes)


class Component(Wrapper[AsyncExtParams]):
    """The extended parameters of a component (PARAM_EXT_*); see `Component.ext`.

    Cameras, gimbals and companion computers have them: values of up to 128 bytes, with text and 64-bit types.
    A component may have plain parameters as well; the two tables are separate, and one name may be in both.

    Ctrl-C, lost components and reconnection are handled as in `Component`.

    Attributes:
        params: the known parameters by name. The mapping is read-only and follows the received messages.
    """

    @cached_property
    def params(self) -> Mapping[str, ExtParam]:
        """The known parameters by name. The mapping is read-only and follows the received messages."""
        return live_mapping(self._thread, self._wrapped.params)

    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_EXT_VALUE."""
        return self._thread.read(lambda: self._wrapped.count)

    @property
    def is_spoken(self) -> bool:
        """Whether the component has sent an extended parameter."""
        return self._thread.read(lambda: self._wrapped.is_spoken)

    @property
    def is_expected(self) -> bool:
        """Whether the component has sent an extended parameter, or is of a kind that usually has them.

        Cameras, gimbals, winches, illuminators and grippers, by MAV_TYPE or component id.
        """
        return self._thread.read(lambda: self._wrapped.is_expected)

    @property
    def is_complete(self) -> bool:
        """Whether `params` has a parameter for every index below `count`."""
        return self._thread.read(lambda: self._wrapped.is_complete)

    def get(self, name: str | int, *, timeout: float | None = None) -> ExtParam:
        """Read one parameter with PARAM_EXT_REQUEST_READ.

        Args:
            name: param_id, or an index from 0.
            timeout: seconds; None: the number of attempts limits the time.

        Returns:
            The parameter as the component has reported it.

        Raises:
            UsageError: the name or index is not valid, or the client only listens.
            UnknownParameter: the component has no such parameter.
            NoReply: the component did not respond in time, or it is lost.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.call(partial(self._wrapped.get, name, timeout=timeout))

    def set(
        self,
        name: str,
        value: ExtSettable,
        *,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> SetResult:
        """Write one parameter with PARAM_EXT_SET, and return when the component has acknowledged the value.

        An unknown type is read from the component first. While the component reports progress, the call
        continues to wait. Writes to one name run in the order of the calls, writes to different names in
        parallel. After Ctrl-C it is unknown whether the component has the value.

        Args:
            name: param_id.
            value: a number for a numeric type; text, or bytes, of up to 128 bytes for CUSTOM.
            timeout: seconds; None: no limit besides the number of unanswered attempts.
            durable, author: as in `Component.set`.

        Returns:
            Accepted, or adjusted: the component stored another value.

        Raises:
            UsageError: the name or the value is not valid, or the client only listens. Nothing was written.
            UnknownParameter: the component has no such parameter.
            ValueUnsupported: the component does not support the value.
            SetFailed: the component could not set the value.
            ExtSetRefused: the component refused with a result that MAVLink does not define.
            ValueNotApplied: the component keeps its previous value and does not acknowledge the write.
            NoReply: the component did not respond. It is unknown whether it has the value.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
            CacheError: with `durable`, the cache cannot store the value. Nothing was written.
            NotDurable: with `durable`, the component has accepted the value, but it could not be written to
                the disk.
        """
        return self._thread.call(
            partial(self._wrapped.set, name, value, timeout=timeout, durable=durable, author=author)
        )

    def set_many(
        self,
        values: Mapping[str, ExtSettable] | Iterable[tuple[str, ExtSettable]],
        *,
        progress: Callable[[SetOutcome], None] | None = None,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> SetManyResult:
        """Write many parameters in one call, each as `set` does.

        Several writes are in flight at a time. A value that is refused does not stop the others. If the
        component is lost, the link fails, three writes in a row get no response or the timeout expires, the
        call returns the outcomes so far, and `error` of the result is the cause.

        Args:
            values: values by name, or pairs of name and value; a name may occur in several pairs.
            progress: called with each outcome in the order of their arrival, in the calling thread.
            timeout: seconds for the whole call; None: no limit besides the number of attempts.
            durable, author: as in `Component.set_many`.

        Returns:
            One outcome for each value, in the order given: accepted, adjusted, refused, unknown or not tried.

        Raises:
            UsageError: a name, a value or another argument is not valid, or the client only listens. Nothing
                was written.
            NoReply: the component is lost already. Nothing was written.
            ContestedAddress: several vehicles use its address. Nothing was written.
            LinkError: the link had failed already, or the client was closed.
            CacheError: with `durable`, the cache cannot store values. Nothing was written.
        """
        return self._thread.call_reporting(
            partial(
                self._wrapped.set_many, own_values(values), timeout=timeout, durable=durable, author=author
            ),
            progress,
        )

    def fetch_all(
        self, *, timeout: float | None = None, progress: Callable[[Progress], None] | None = None
    ) -> FetchResult:
        """Download all parameters with PARAM_EXT_REQUEST_LIST, and read the values that the list lacks.

        The protocol has no hash, so a cached table cannot be confirmed without a download. A client whose
        policy allows no download returns the known table.

        Concurrent calls share one fetch. Ctrl-C keeps the received values in the table.

        Args:
            timeout: seconds after which the partial table is returned with `missing`; None: no limit.
            progress: called about ten times a second, in the calling thread.

        Returns:
            The parameters, and the missing indices.

        Raises:
            UsageError: the client only listens.
            CacheError: nothing is known, and the policy allows no download.
            NoReply: no response arrived: most components have no extended parameters. Or the component is
                lost.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
        """
        return self._thread.call_reporting(partial(self._wrapped.fetch_all, timeout=timeout), progress)

    def store_snapshot(self, *, reason: str) -> int | None:
        """Store a snapshot of the known parameters in the cache, as a restore point.

        All values received before the call are written to the cache and its history first.

        Args:
            reason: the reason, as text.

        Returns:
            The number of the snapshot; None if there is no cache.

        Raises:
            UsageError: no parameter is known.
            CacheError: the cache cannot store it.
            LinkError: the client was closed.
        """
        return self._thread.call(partial(self._wrapped.store_snapshot, reason=reason))

    def snapshots(self) -> list[SnapshotSummary]:
        """Return the snapshots of the component's extended parameters, the newest last.

        Raises:
            UsageError: there is no cache.
            CacheError: the cache cannot be read.
            LinkError: the client was closed.
        """
        return self._thread.call(self._wrapped.snapshots)

    def load_state(self, when: float) -> ExtParamSet:
        """Return an earlier state of the parameters, from the cache.

        Args:
            when: a float is a time, in unix seconds; an int is the number of a snapshot. See
                `ParamCache.ext_state_at`.

        Raises:
            UsageError: there is no cache, or the time is not in unix seconds.
            CacheError: there is no such state, or the cache cannot be read.
            LinkError: the client was closed.
        """
        return self._thread.call(partial(self._wrapped.load_state, when))

    def changes(self) -> ExtChanges:
        """Return a stream of changes from now on, like `Component.changes`.

        Raises:
            LinkError: while iterating, after the queued changes: the link failed permanently, or the client
                was closed.
            NoReply: while iterating: the component was lost and is no longer followed.
        """
        return ExtChanges(self._thread, self._wrapped.changes)


class Ftp(Wrapper[AsyncFtp]):
    """Reads and writes files of one component over MAVFTP; see `ParamClient.ftp`.

    A vehicle serves one file at a time, so calls run in order, including the file download of `fetch_all`.
    After each call, also after an error or Ctrl-C, the client closes the file session on board.

    Raises:
        FileTransferError: the vehicle reports an error.
        NoReply: the vehicle does not respond in time, or it is lost.
        LinkError: the link failed, or the client was closed.
    """

    def read(
        self,
        path: str,
        *,
        timeout: float | None = None,
        progress: Callable[[int, int | None], None] | None = None,
        limit: int = FILE_SIZE_MAX,
    ) -> bytes:
        """Read a file and return its content.

        Args:
            path: path on the vehicle, such as `@PARAM/param.pck` or `/fs/microsd/log.txt`.
            timeout: seconds; None: the number of attempts, which follows the link quality, limits the time.
            progress: called about ten times a second, in the calling thread, with the received bytes and the
                file size that the vehicle reports (None before the report; an estimate for files that
                ArduPilot generates).
            limit: maximum file size in bytes; a larger file is not read.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        return self._thread.call_reporting(
            partial(self._wrapped.read, path, timeout=timeout, limit=limit), progress
        )

    def write(self, path: str, data: bytes, *, timeout: float | None = None) -> None:
        """Write a file, replacing an existing one.

        After an error or Ctrl-C, the data written so far stays on board.

        Args:
            path: path on the vehicle.
            data: content of the file.
            timeout: as in `read`.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        self._thread.call(partial(self._wrapped.write, path, data, timeout=timeout))

    def list(self, path: str = "/", *, timeout: float | None = None) -> builtins.tuple[DirectoryEntry, ...]:
        """Return the entries of a directory.

        Args:
            path: path on the vehicle.
            timeout: as in `read`.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        return self._thread.call(partial(self._wrapped.list, path, timeout=timeout))

    def checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed on board: initial value 0, no final xor, as in PX4's hash.

        Args:
            path: path on the vehicle.
            timeout: as in `read`.

        Raises:
            UsageError: the path is not valid.
            FileTransferError, NoReply, LinkError: as for every call, see `Ftp`.
        """
        return self._thread.call(partial(self._wrapped.checksum, path, timeout=timeout))


@dataclass(frozen=True, slots=True)
class Discovered:
    """The first message of a component has arrived.

    Attributes:
        component: the new component.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Lost:
    """A component is lost: it has sent heartbeats before, and no message for the heartbeat timeout: 5 s,
    longer for slow heartbeats and in high-latency mode.

    Attributes:
        component: the lost component.
        silence: seconds since its last message.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Found:
    """A lost component sends again. The client requests its identity and its hash.

    Attributes:
        component: the component.
        silence: seconds without a message.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Rebooted:
    """A vehicle has rebooted: its clock has jumped back, or its heartbeat reports MAV_STATE_BOOT.

    During `Component.reboot`, silence may indicate the reboot too.

    Attributes:
        component: the component that has rebooted.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Resynced:
    """A table that was stale, or possibly stale, matches the vehicle again.

    Attributes:
        component: the component of the table.
        changed: names of the parameters that had changed; empty if the hash showed that none had.
        hash: the vehicle's hash that confirms the table; None for a vehicle without a hash.
    """

    component: Component
    changed: tuple[str, ...]
    hash: int | None


@dataclass(frozen=True, slots=True)
class Contested:
    """Several vehicles use the address of a component.

    Until `Uncontested`, its calls raise ContestedAddress, and the cache receives nothing from it.

    Attributes:
        component: the component with the shared address.
        contest: the vehicles, and the differences between them.
    """

    component: Component
    contest: Contest


@dataclass(frozen=True, slots=True)
class Uncontested:
    """Only one vehicle uses the address of a component again. The client requests its identity and its hash.

    Attributes:
        component: the component.
    """

    component: Component


Event: TypeAlias = Discovered | Lost | Found | Rebooted | Resynced | Contested | Uncontested

_EVENTS: dict[type[asynchronous.Event], type[Event]] = {
    asynchronous.Discovered: Discovered,
    asynchronous.Lost: Lost,
    asynchronous.Found: Found,
    asynchronous.Rebooted: Rebooted,
    asynchronous.Resynced: Resynced,
    asynchronous.Contested: Contested,
    asynchronous.Uncontested: Uncontested,
}


class Events(BlockingStream[Event]):
    """Stream of the component events since its creation; see `ParamClient.events`.

    It queues at most `EVENTS_MAX` events and then drops the oldest.
    """

    def _made(self, item: asynchronous.Event) -> Event:
        return _event(self._thread, item)


class Changes(BlockingStream[Change]):
    """Stream of the parameter changes of one component since its creation; see `Component.changes`.

    A slow consumer receives several changes of one parameter as one. The queue holds at most
    `QUEUED_CHANGES_MAX` changes and then drops the oldest.
    """


class ExtChanges(BlockingStream[Change]):
    """Stream of the changes of one component's extended parameters since its creation.

    A slow consumer receives several changes of one parameter as one.
    """


def _event(thread: ClientThread, event: asynchronous.Event) -> Event:
    """Return the blocking form of an event."""
    values: dict[str, Any] = {each.name: getattr(event, each.name) for each in fields(event)}
    return _EVENTS[type(event)](**values | {"component": Component.of(thread, event.component)})


def _components(thread: ClientThread, client: AsyncParamClient) -> Mapping[Address, Component]:
    """Return a view of the components of a client."""

    def find(address: Address) -> Component | None:
        found = thread.read(lambda: client.components.get(address))
        return None if found is None else Component.of(thread, found)

    def copy() -> Mapping[Address, Component]:
        found = thread.read(lambda: dict(client.components))
        return {address: Component.of(thread, each) for address, each in found.items()}

    return LiveMapping(find, copy)
