"""Component: the parameters of one component of a vehicle, and the calls to it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from typing import Final, Protocol

import anyio

from paramclient.cache import check_author
from paramclient.client.core import ClientCore, seconds_of
from paramclient.client.signing import timestamp_now
from paramclient.client.streams import Changes, Subscribers
from paramclient.errors import AmbiguousVehicle, CacheError, NoReply, NotDurable, ParamClientError, UsageError
from paramclient.links.tlog import ReplayLink
from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.paramset import ParamMap
from paramclient.model.values import (
    Encoding,
    Param,
    Settable,
    Trust,
    Value,
    check_ext_value,
    check_portable_name,
    check_value,
)
from paramclient.protocol import commands, ftp
from paramclient.protocol.addresses import Address, peer_in_words
from paramclient.protocol.fetch import FetchResult, FetchSource, Policy, Progress, fetch_all, result_of
from paramclient.protocol.identity import HEARTBEAT_WAIT
from paramclient.protocol.node import Node
from paramclient.protocol.reads import read_param
from paramclient.protocol.selection import hint_of_node, node_in_words, vehicle_of
from paramclient.protocol.session import Session
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetResult
from paramclient.protocol.table import Change
from paramclient.protocol.watch import SyncState, Watch
from paramclient.protocol.writes import write, write_many
from paramclient.wire.messages import HASH_CHECK, MAV_MODE_FLAG_SAFETY_ARMED, PARAMETERS_MAX, SetupSigning
from paramclient.wire.signing import SigningKey

CACHE_TIMEOUT: Final = 5.0
"""Seconds to wait for the identity of a component, without which its cached table cannot be loaded: twice the
longest round trip in use."""
REBOOT_TIMEOUT: Final = 60.0
"""Seconds for a vehicle to reboot and report its identity, by default: small autopilot boards take up to 30
seconds, and boards that calibrate sensors first a little longer."""
SETTLE_MAX: Final = 60.0
"""Maximum `settle` in seconds: further writes to the same name wait for it."""
SETUP_SIGNING_COUNT: Final = 3
"""SETUP_SIGNING messages that are sent: they have no acknowledgement, and a frame may be lost."""
SETUP_SIGNING_INTERVAL: Final = 0.1
"""Seconds after each SETUP_SIGNING message."""
PASSIVE_TIMEOUT: Final = 20.0
"""Seconds of a fetch where nothing is sent, by default: another station may never request a list."""
TIMEOUT_NOTE: Final = "The fetch ended at its timeout."

logger = logging.getLogger(__name__)


class ComponentState(StrEnum):
    """The state of a component's table."""

    NEW = "new"
    """No parameter is known."""
    CACHED = "cached"
    """Complete, from the cache, and not confirmed by the vehicle."""
    FETCHING = "fetching"
    """Being fetched."""
    SYNCED = "synced"
    """Fetched or confirmed, without a sign of change since."""
    PARTIAL = "partial"
    """Some parameters are known."""
    LOST = "lost"
    """The component is lost."""


class Owner(Protocol):
    """What a component and its callers use of its client; see `paramclient.client.client`."""

    core: ClientCore
    policy: Policy
    watch_interval: float | None

    @property
    def components(self) -> Mapping[Address, Component]: ...

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = ...
    ) -> Component: ...


class Component:
    """One component of a vehicle; see `ParamClient.component`.

    All calls may be cancelled at any point; later calls are not affected. While a link reconnects, calls wait
    for up to `LINK_TIMEOUT` (10 s). After that, and when the client is closed, they raise LinkError. The
    table of a lost component (see `Event`) is kept, and its values are *cached* until the vehicle has
    confirmed them.

    Attributes:
        system, component: MAVLink ids of the component.
        is_extended: whether these are the extended parameters: the `ext` of another component.
        params: the known parameters by name: live, verified or cached, see `Trust`. The mapping is read-only
            and follows the received messages.
    """

    def __init__(self, client: Owner, node: Node, session: Session) -> None:
        self.client = client
        self.core = client.core
        self.node = node
        self.session = session
        self.system = node.system
        self.component = node.component
        self.is_extended = session.dialect.has_ack
        self.params = ParamMap(session.table.params)
        self.subscribers: Subscribers[Change] = Subscribers()
        listens_only = self.core.station.listens_only
        self.policy = Policy.CACHE_ONLY if listens_only else client.policy
        self.watch = Watch(
            session, node.presence, self._resynced, interval=client.watch_interval, policy=self.policy
        )
        self.cache_is_read = anyio.Event()
        self._ext = Component(client, node, node.extended) if session is node.plain else None
        self._last: FetchResult | None = None
        session.table.changed = self._changed
        session.table.recounted = self.watch.doubt
        if listens_only:
            session.contradicted = self.watch.doubt
        else:
            self.core.spawn(self.watch.run)

    @property
    def ext(self) -> Component:
        """The extended parameters of the component (PARAM_EXT_*), whose values are also text and bytes."""
        if self._ext is None:
            raise UsageError("extended parameters have no extended parameters")
        return self._ext

    @property
    def autopilot(self) -> str:
        """Autopilot of its heartbeat: px4, ardupilot, generic, …; "unknown" before the first heartbeat."""
        number = self.node.identification.autopilot
        return "unknown" if number is None else autopilot_name(number)

    @property
    def identity(self) -> Identity:
        """Identity of the vehicle from AUTOPILOT_VERSION: hardware id, firmware, capabilities, if known."""
        return self.vehicle.identification.identity

    @property
    def vehicle(self) -> Node:
        """The autopilot of its vehicle, whose identity is the vehicle's; without one, its own node."""
        return vehicle_of(self.core.station.nodes.values(), self.node)

    @property
    def encoding(self) -> Encoding:
        """Encoding of its parameter values in messages: bytewise or C cast."""
        return self.session.table.encoding

    @property
    def encoding_reason(self) -> str:
        """The reason for `encoding`, as text."""
        return self.node.identification.encoding_reason

    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first value."""
        return self.session.table.count

    @property
    def hash(self) -> int | None:
        """PX4's hash or ArduPilot's checksum of the complete table; None if it is not known."""
        return self.session.table.hash if self.session.table.is_complete else None

    @property
    def state(self) -> ComponentState:
        """State of the table."""
        table = self.session.table
        if self.node.presence.is_lost:
            return ComponentState.LOST
        if self.session.fetching.is_running:
            return ComponentState.FETCHING
        if not table.params:
            return ComponentState.NEW
        if not table.is_complete:
            return ComponentState.PARTIAL
        return ComponentState.SYNCED if self.watch.state is SyncState.SYNCED else ComponentState.CACHED

    @property
    def sync_state(self) -> SyncState:
        """Whether the table matches the vehicle, and the running check or update."""
        return self.watch.state

    @property
    def address(self) -> Address:
        """Its key in `ParamClient.components`: (system, component), with `split_peers` also the peer."""
        return self.node.address

    @property
    def peer(self) -> str:
        """Address and port from which its messages arrive, and to which requests go."""
        return peer_in_words(self.node.peer)

    @property
    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed, from `base_mode` of its last heartbeat.

        It is that of its autopilot where the component sends none. None if unknown: before the first one,
        while the component is lost, and in high-latency mode, in which a vehicle sends no heartbeats.
        """
        presence = (self.node if self.node.presence.has_beaten else self.vehicle).presence
        if presence.base_mode is None or presence.is_lost:
            return None
        return bool(presence.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def silence(self) -> float:
        """Seconds since its last message. After 5 s the component is lost, see `Event`."""
        return max(0.0, anyio.current_time() - self.node.presence.received_at)

    @property
    def round_trip(self) -> float | None:
        """Smoothed round-trip time in seconds; None before the first response."""
        return self.node.channel.timing.round_trip

    def __repr__(self) -> str:
        last = self._last
        origin = "" if last is None else f" from {last.source} in {last.elapsed:.2f} s"
        of = f" of {self.count}" if self.count is not None and self.state in ("partial", "fetching") else ""
        whose = f"{self.system}/{self.component} {self.autopilot}"
        return f"<Component {whose} {self.state} {len(self.params)}{of} params{origin}>"

    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Read one parameter from the vehicle.

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
            NoReply: the vehicle did not respond in time.
            LinkError: the link failed, or the client was closed.
        """
        if isinstance(name, str):
            check_portable_name(name)
        elif not isinstance(name, int) or not 0 <= name < PARAMETERS_MAX:
            raise UsageError(f"parameter index {name}: indices are 0 to {PARAMETERS_MAX - 1}")
        with self.limited(timeout, f"parameter {name} of {self.system}/{self.component}"):
            return await read_param(self.session, name)

    async def set(
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
        """Write one parameter, and verify the value that the vehicle acknowledges.

        An unknown type is read from the vehicle first. Writes to one name run in the order of the calls,
        writes to different names in parallel. After cancellation it is unknown whether the vehicle has the
        value.

        Args:
            name: param_id.
            value: a number; the 4 bytes of the message for a value that is not expressible as a number; for
                an extended parameter also text or bytes.
            timeout: as in `get`.
            settle: seconds, 0 to 60, after which the value is read again, and the result has the final value.
                1.2 is enough for PX4, whose modules change values up to 1.1 s later.
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
            Refused: the vehicle refused with a reason.
            TypeMismatch: the parameter has another type on the vehicle.
            ValueNotApplied: the vehicle keeps its previous value and reports no reason.
            NoReply: the vehicle did not respond. It is unknown whether it has the value.
            AnotherVehicle: another vehicle has taken its place meanwhile. Nothing was written to it.
            AmbiguousVehicle: another vehicle uses the same ids. Nothing was written.
            NotDurable: the vehicle has accepted the value, but it could not be written to the disk.
            CacheError: with `durable`, the disk cannot be written; nothing was sent.
            LinkError: the link failed, or the client was closed.
        """
        by = check_author(author)
        ((name, checked),) = await self._check_writes([(name, value)], settle, durable=durable)
        with self.limited(timeout, f"the acknowledgement of {name} by {self.system}/{self.component}"):
            result = await write(self.session, name, checked, settle=settle, force=force, author=by)
        if durable:
            await self._write_durably(name)
        return result

    async def set_many(
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

        Several writes are in flight at a time. A parameter that reveals or hides others, such as `*_ENABLE`,
        is written alone: all writes before it end first, and those after it begin afterwards. A value that is
        refused does not stop the others. If the vehicle does not respond any more, another vehicle takes its
        place, the link fails or the timeout expires, the call returns the outcomes so far.

        Args:
            values: values by name, or pairs of name and value. Values are as in `set`.
            progress: called with each outcome in the order of their arrival.
            timeout: seconds for the whole call; None: no limit besides the number of attempts.
            settle, force, author, durable: as in `set`.

        Returns:
            One outcome for each value, in the order given: accepted, adjusted, refused, unknown or not tried.

        Raises:
            UsageError: a name, a value or another argument is not valid, or the client only listens. Nothing
                was written.
            AmbiguousVehicle: another vehicle uses the same ids. Nothing was written.
            CacheError: with `durable`, the disk cannot be written; nothing was sent.
            LinkError: the link had failed already, or the client was closed.
        """
        by, seconds = check_author(author), seconds_of(timeout)
        pairs = await self._check_writes(values, settle, durable=durable)
        result = await write_many(
            self.session, pairs, progress=progress, timeout=seconds, settle=settle, force=force, author=by
        )
        hint = hint_of_node(self.core.station, self.node, anyio.current_time())
        outcomes = [replace(each, error=_hinted(each.error, hint)) for each in result.outcomes]
        error = _hinted(result.error, hint)
        names = [outcome.name for outcome in outcomes if outcome.is_set]
        if durable and names:
            try:
                await self._write_durably(names[0] if len(names) == 1 else f"{len(names)} values")
            except NotDurable as failure:
                error = error or failure
                outcomes = [replace(each, error=failure) if each.is_set else each for each in outcomes]
        return replace(result, outcomes=tuple(outcomes), error=error)

    async def fetch_all(
        self,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads.

        If the cache has a table, the client first requests PX4's hash or ArduPilot's checksum. If it matches,
        nothing is downloaded but the values outside the hash. Values that ArduPilot has changed are found by
        checksums of ranges, and named in `changed` of the result. Otherwise the client downloads the packed
        file `param.pck` over MAVFTP if the component serves it: it is faster than the list, exact, and has
        the firmware's defaults. If not, it downloads the list. `source` and `notes` of the result tell which.

        The fetch always ends: indices without a response after all attempts are in `missing`, and a vehicle
        that is lost ends it with the values that arrived. Concurrent calls share one fetch. Cancellation
        keeps the received values in the table. A client that only listens waits for a list that another
        station requests.

        Args:
            refresh: download even if the vehicle would confirm the cached table.
            timeout: seconds after which the partial table is returned with `missing`; None: no limit, except
                20 s if the client only listens.
            progress: called as values arrive.

        Returns:
            The parameters with their source, the missing indices and notes.

        Raises:
            UsageError: `refresh` is given, and the client may not download.
            CacheError: nothing is cached, and the policy allows no download.
            NoReply: no response arrived.
            LinkError: the link failed, or the client was closed.
        """
        self.core.station.gate.check()
        if refresh:
            self.core.station.check_may_send()
            if self.policy is not Policy.AUTO:
                raise UsageError(f"refresh needs a download, and the policy is {self.policy}")
            self.session.serves_file = self.session.serves_file or None  # it may by now
        began, generation = anyio.current_time(), self.node.generation
        if timeout is None and self._waits_for_others:
            timeout = PASSIVE_TIMEOUT
        with self.limited(None, "all parameters", sends=False):
            with anyio.move_on_after(seconds_of(timeout)):
                if not refresh:
                    await self.wait_for_cache()
                if self.core.station.listens_only:
                    result = await self._listen(began)
                else:
                    result = await fetch_all(
                        self.session, refresh=refresh, policy=self.policy, progress=progress
                    )
                return self._fetched(replace(result, elapsed=anyio.current_time() - began), generation)
            if self.session.table.count is None:
                raise self._nothing(began)
        source: FetchSource = "cache" if _has(self.params, Trust.VERIFIED) else "stream"
        return result_of(self.session, source, began, [TIMEOUT_NOTE], policy=self.policy)

    async def _listen(self, began: float) -> FetchResult:
        """Wait until the table is complete by what other stations request, or until a log has ended."""
        table = self.session.table
        while not self.core.is_over and not (self._waits_for_others and self._is_heard()):
            await self.core.link_task.wait_for_activity()
        if not table.params:
            raise self._nothing(began)
        is_cached = self._is_heard() and _has(table.params, Trust.CACHED)
        if not is_cached:
            self.session.confirm_announced()
        source: FetchSource = "cache" if is_cached else "stream"
        return result_of(self.session, source, began, [], policy=self.policy)

    def _is_heard(self) -> bool:
        """Return whether all values were received, or the hash of the cached ones was."""
        table = self.session.table
        is_confirmed = table.agrees_with(self.session.announced)
        if is_confirmed:
            table.verify()
        return is_confirmed or (table.is_complete and not _has(table.params, Trust.CACHED))

    @property
    def _waits_for_others(self) -> bool:
        """Whether only other stations request values, on a link that is no log."""
        return self.core.station.listens_only and not isinstance(self.core.link, ReplayLink)

    def _nothing(self, began: float) -> NoReply:
        what = f"the parameters of {self.system}/{self.component}"
        if self._waits_for_others:
            what += ", which no other station has requested"
        return NoReply(what, attempts=0, waited=anyio.current_time() - began)

    def _fetched(self, result: FetchResult, generation: int) -> FetchResult:
        self._last = result
        logger.debug("%s: %r", self.core.link.name, result)
        if self.policy is not Policy.AUTO and not result.params:
            raise CacheError(f"nothing is cached of {self.node.channel}, and nothing may be downloaded")
        if result.source == "cache" and result.hash is None:
            self.watch.unconfirmed()
        elif result.complete:
            self.watch.fetched()
            # or where values were doubted after they had arrived, as a reset passed
            if self.node.generation != generation or (not result.cached and self.session.table.unverified()):
                self.watch.doubt()
            else:
                self.core.cache_writer.fetched(self.node, self.session, is_whole=result.source != "cache")
        return result

    def _changed(self, change: Change) -> None:
        self.subscribers.push(change)
        self.core.cache_writer.changed(self.node, self.session, change)

    def _resynced(self, changed: tuple[str, ...]) -> None:
        self.core.cache_writer.fetched(self.node, self.session, is_whole=True)
        self.node.emit("resynced", changed=changed, hash=self.session.table.hash)

    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Give the vehicle a signing key with SETUP_SIGNING, or with None, disable its signing.

        The message has no acknowledgement; it is sent three times.

        Args:
            key: the key, which is sent unencrypted.
            link_is_safe: that no other party can read the link, such as USB.

        Raises:
            UsageError: `link_is_safe` is not given, the client only listens, or the component uses MAVLink 1,
                which has no signing.
            LinkError: the link failed, or the client was closed.
        """
        if not link_is_safe:
            raise UsageError("the key is sent unencrypted: use a link like USB, and pass link_is_safe=True")
        if self.node.version == 1:
            raise UsageError(f"{self.system}/{self.component} uses MAVLink 1, which has no signing")
        station, node = self.core.station, self.node
        station.check_may_send()
        message = SetupSigning(self.system, self.component, key, 0 if key is None else timestamp_now())
        for _ in range(SETUP_SIGNING_COUNT):
            station.gate.check()
            station.transmit(message, node.peer)
            await anyio.sleep(SETUP_SIGNING_INTERVAL)

    async def reboot(self, *, system: int | None = None, timeout: float | None = REBOOT_TIMEOUT) -> Component:
        """Reboot the vehicle, and wait until it is back and identified. Written values are saved before.

        Args:
            system: the system id with which it returns, if that was changed.
            timeout: seconds for the whole call; None waits without limit.

        Returns:
            The component under its present system id.

        Raises:
            VehicleArmed: the vehicle is armed.
            CommandRefused: it refused.
            NoReply: it did not answer, or did not come back in time.
            LinkError: the link failed, or the client was closed.
        """
        moves = system is not None and system != self.system
        with self.limited(timeout, f"{self.system}/{self.component} to be back after its reboot"):
            await commands.reboot(self.node, returns=not moves)
            if system is None or not moves:
                return self
            return await self.client.successor(self, system, timeout=None)

    async def read_file(
        self,
        path: str,
        *,
        size_max: int = ftp.FILE_SIZE_MAX,
        progress: Callable[[int, int | None], None] | None = None,
        timeout: float | None = None,
    ) -> bytes:
        """Read a file over MAVFTP. Its session on board is closed, also on cancellation.

        A vehicle serves one file at a time: calls run one after the other.

        Args:
            path: of the file, as the component names it.
            size_max: bytes, at most.
            progress: called with the bytes received and the size, which is an estimate for generated files.
            timeout: seconds; None waits as long as the component answers.

        Raises:
            UsageError: the path is not valid, or the client only listens.
            FileTransferError: the component refused it, or the file is larger than `size_max`.
            NoReply: it does not answer.
            LinkError: the link failed, or the client was closed.
        """
        with self.limited(timeout, f"{path} of {self.node.channel}"):
            return await ftp.read_file(self.node.channel, path, size_max=size_max, progress=progress)

    async def file_checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed by the component; see `crc32_px4`.

        Raises:
            UsageError, FileTransferError, NoReply, LinkError: as from `read_file`.
        """
        with self.limited(timeout, f"{path} of {self.node.channel}"):
            return await ftp.checksum(self.node.channel, path)

    def changes(self) -> Changes:
        """Return a stream of parameter changes from now on: `async for change in component.changes()`.

        Each change has the name, the old and the new value. The first value of a parameter is a change too. A
        slow consumer receives several changes of one parameter as one. The stream continues across a
        reconnection of the link, and ends with a replayed log. Cancelling the iteration loses no change.

        Raises:
            LinkError: while iterating, after the queued changes: the link failed permanently, or the client
                was closed.
        """
        self.subscribers.add(changes := Changes())
        return changes

    async def join_vehicle(self) -> None:
        """Load the cached tables of a component whose vehicle is identified already, or never was."""
        await anyio.sleep_until(self.node.since + HEARTBEAT_WAIT)  # for the heartbeat of its autopilot
        if self.core.cache_writer.may_load(self.node, self.vehicle):
            await self.load()

    async def load(self) -> None:
        """Load the cached tables of a component of an identified vehicle."""
        node, vehicle = self.node, self.vehicle
        is_young = anyio.current_time() < node.since + HEARTBEAT_WAIT
        if vehicle is node and is_young and not node.identification.is_autopilot:
            return  # it may have an autopilot: `join_vehicle` waits for its heartbeat
        await self.core.cache_writer.load(node, vehicle)
        self.cache_is_read.set()
        self.ext.cache_is_read.set()

    async def wait_until_identified(self, timeout: float) -> None:
        """Wait at most `timeout` seconds until the vehicle is identified, as its cache key requires."""
        with anyio.move_on_after(timeout):
            await self.vehicle.identification.settled()

    async def wait_for_cache(self) -> None:
        """Wait until the cached table, if there is one, is in the table; 5 s at most.

        Raises:
            LinkError: the client was closed.
        """
        if self.core.cache_writer.may_have(self.node):
            with anyio.CancelScope(deadline=self.node.since + CACHE_TIMEOUT):
                await self.cache_is_read.wait()
            self.core.station.gate.check()

    async def _check_writes(
        self, values: Mapping[str, Settable] | Iterable[tuple[str, Settable]], settle: float, *, durable: bool
    ) -> list[tuple[str, Value]]:
        """Check that values may be written, and return them with their names.

        Raises:
            UsageError, AmbiguousVehicle, CacheError, LinkError: as from `set_many`.
        """
        check = check_ext_value if self.is_extended else check_value
        pairs = values.items() if isinstance(values, Mapping) else values
        checked = [(check_portable_name(name), check(value)) for name, value in pairs]
        if any(name == HASH_CHECK for name, _ in checked):
            raise UsageError(f"{HASH_CHECK} is read-only: it is the hash of the parameters, not a parameter")
        if not 0.0 <= settle <= SETTLE_MAX:
            raise UsageError(f"settle must be 0 to {SETTLE_MAX:g} seconds, not {settle}")
        self.core.station.check_may_send()
        if self.node.has_rival(anyio.current_time()):
            words = node_in_words(self.node)
            what = f"two vehicles use the ids {words}; nothing was written."
            raise AmbiguousVehicle(what, vehicles=[words], choose_by="peer")
        reached = [each for each in self.core.station.nodes.values() if each.system == self.system]
        if self.component == 0 and len(reached) > 1:
            raise UsageError(f"component 0 means all {len(reached)} of its system; nothing was written")
        if durable:
            with anyio.move_on_after(0.0 if self.core.cache is None else CACHE_TIMEOUT):
                await self.cache_is_read.wait()
            self.core.cache_writer.check_kept(self.node, self.session)
        return checked

    async def _write_durably(self, what: str) -> None:
        try:
            await self.core.cache_writer.write_durably(self.node, self.session)
        except CacheError as error:
            where = self.node.channel
            raise NotDurable(f"{where} has accepted {what}, but it is not on the disk: {error}") from error

    @contextmanager
    def limited(self, timeout: float | None, what: str, *, sends: bool = True) -> Iterator[anyio.CancelScope]:
        """Raise NoReply at a timeout, or when the scope is cancelled; add to each what was received.

        Where a call sends, raise UsageError if the client only listens, and LinkError without a link.
        """
        if sends:
            self.core.station.check_may_send()
        began = anyio.current_time()
        try:
            with anyio.move_on_after(seconds_of(timeout)) as scope:
                yield scope
            if scope.cancelled_caught:
                raise NoReply(what, attempts=0, waited=anyio.current_time() - began)
        except NoReply as error:
            raise error.with_hint(hint_of_node(self.core.station, self.node, anyio.current_time())) from None


def _has(params: Mapping[str, Param], trust: Trust) -> bool:
    return any(param.trust is trust for param in params.values())


def _hinted(error: ParamClientError | None, hint: str) -> ParamClientError | None:
    return error.with_hint(hint) if isinstance(error, NoReply) else error
