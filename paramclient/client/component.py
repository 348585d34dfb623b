"""Component: parameters of one component of a vehicle, and its calls."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import anyio

from paramclient.client.arguments import check_requested_name, check_settle, check_writes
from paramclient.client.batch_wait import wait_for_batch
from paramclient.client.component_core import ComponentCore, Explanations
from paramclient.client.extended_params import ExtParams
from paramclient.client.reset import ResetChoice, ResetResult, read_unconfirmed
from paramclient.client.signing import timestamp_now
from paramclient.client.subscription import Changes
from paramclient.errors import NotDurable, UsageError
from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.params import ParamMap
from paramclient.model.values import Encoding, Param, Settable, WireValue, decode_value, known_type
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.change_origin import check_author
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.passive import PASSIVE_TIMEOUT
from paramclient.protocol.params.sync import ComponentState, SyncState
from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.station import Station
from paramclient.protocol.vehicle.address_contest import Contest
from paramclient.protocol.wire import MAV_MODE_FLAG_SAFETY_ARMED, NO_INDEX, ParamValue, SigningKey

__all__ = ["Component", "fetch_timeout", "successor_of"]

REBOOT_TIMEOUT: Final = 60.0
"""Default timeout in seconds for a vehicle to reboot and report its identity: small autopilot boards take up
to 30 s, and boards that calibrate sensors first a little longer."""
SETUP_SIGNING_COUNT: Final = 3
"""Number of SETUP_SIGNING messages sent: they have no acknowledgement, and a frame may be lost."""
SETUP_SIGNING_INTERVAL: Final = 0.1
"""Seconds after each SETUP_SIGNING message."""


class Component:
    """One component of a vehicle; see `ParamClient.component`.

    All calls may be cancelled at any point; later calls are not affected. While a link reconnects, calls wait
    for up to `LINK_TIMEOUT` (10 s, in `client.reconnect_delays`). After that, and when the client is closed,
    they raise LinkError. A lost component (see `Lost`) receives no requests: waiting calls and new ones raise
    NoReply immediately, except a running `fetch_all`, which continues for a while, as the vehicle may be
    rebooting. A component whose address several vehicles use (see `Contested`) receives no requests either:
    calls raise ContestedAddress. In both cases the table is kept, and its values are *cached* until the
    vehicle has confirmed them.

    Attributes:
        system, component: MAVLink ids of the component.
        params: the known parameters by name: live, verified or cached, see `Trust`. The mapping is read-only
            and follows the received messages.
    """

    def __init__(self, core: ComponentCore, siblings: Mapping[Address, Component]) -> None:
        self.core = core
        self.siblings = siblings  # all components of the client, this one included
        self.system = core.machine.system
        self.component = core.machine.component
        self.params = ParamMap(core.machine.table.params)
        self._ext = ExtParams(core)

    @property
    def autopilot(self) -> str:
        """Autopilot of its heartbeat: px4, ardupilot, generic, …; "unknown" before the first heartbeat."""
        number = self.core.machine.identification.autopilot
        return "unknown" if number is None else autopilot_name(number)

    @property
    def identity(self) -> Identity:
        """Identity of the vehicle from AUTOPILOT_VERSION: hardware id, firmware, capabilities, if known."""
        return self.core.settled_identity or self.core.machine.identity

    @property
    def encoding(self) -> Encoding:
        """Encoding of its parameter values in messages: bytewise or C cast."""
        return self.core.machine.table.encoding

    @property
    def encoding_reason(self) -> str:
        """The reason for `encoding`, as text."""
        return self.core.machine.identification.encoding_reason

    @property
    def ext(self) -> ExtParams:
        """The extended parameters of the component (PARAM_EXT_*), with their own calls."""
        return self._ext

    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_VALUE."""
        return self.core.machine.table.count

    @property
    def hash(self) -> int | None:
        """The PX4 hash (`_HASH_CHECK`) of the complete table; None if it is not known."""
        return self.core.machine.table.hash if self.core.machine.table.complete else None

    @property
    def state(self) -> ComponentState:
        """State of the table: new, cached, fetching, synced, partial, contested or lost."""
        return self.core.machine.state

    @property
    def sync_state(self) -> SyncState:
        """Whether the table matches the vehicle, and the running check or update."""
        return self.core.machine.sync_state

    @property
    def address(self) -> Address:
        """Its key in `ParamClient.components`: (system, component), with `split_peers` also the peer."""
        return self.core.machine.address

    @property
    def peer(self) -> str:
        """Address and port from which its messages arrive, and to which requests go; empty if unknown."""
        return self.core.machine.peer_in_words

    @property
    def contest(self) -> Contest | None:
        """The vehicles that share its address, and their differences; None if there is only one vehicle.

        During a contest, every call raises ContestedAddress, `params` does not change, and the cache receives
        nothing.
        """
        return self.core.machine.peers.contest

    @property
    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed, from `base_mode` of its last heartbeat.

        None if unknown: before the first heartbeat, while the component is lost, and in high-latency mode, in
        which a vehicle sends no heartbeats.
        """
        presence = self.core.machine.presence
        if presence.base_mode is None or presence.is_lost:
            return None
        return bool(presence.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def silence(self) -> float:
        """Seconds since its last message. After 5 s the component is lost, see `Lost`."""
        return max(0.0, anyio.current_time() - self.core.machine.presence.received_at)

    @property
    def round_trip(self) -> float | None:
        """Smoothed round-trip time in seconds; None before the first response."""
        return self.core.machine.round_trip.smoothed

    def __repr__(self) -> str:
        last = self.core.machine.fetches.last
        origin = "" if last is None else f" from {last.source} in {last.elapsed:.2f} s"
        of = f" of {self.count}" if self.count is not None and self.state in ("partial", "fetching") else ""
        whose = f"{self.system}/{self.component} {self.autopilot}"
        return f"<Component {whose} {self.state} {len(self.params)}{of} params{origin}>"

    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Read one parameter from the vehicle with PARAM_REQUEST_READ.

        Concurrent calls for one parameter share a request. Calls for different parameters run in parallel.
        Cancellation ends the request unless another call waits for it.

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
        check_requested_name(name)
        core, machine = self.core, self.core.machine
        core.client.check_open()
        what = f"{name if isinstance(name, str) else f'parameter {name}'} of {core.label}"
        with core.explained():
            read = machine.read(name, anyio.current_time())
        try:
            message = await core.wait(read, timeout, lambda: (what, read.attempts))
        finally:
            machine.reads.release(read)
        known = machine.table.params.get(message.param_id)
        if known is None or (isinstance(name, int) and known.index != name):
            return _param_of(message, machine.table.encoding)
        return known

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
        """Write one parameter with PARAM_SET and verify the value that the vehicle acknowledges.

        An unknown type is read from the vehicle first. Writes to one name run in the order of the calls,
        writes to different names in parallel. After cancellation it is unknown whether the vehicle has the
        value.

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
        ((name, checked),) = check_writes([(name, value)])
        core, machine = self.core, self.core.machine
        core.client.check_open()
        machine.check_uncontested()
        if durable:
            await core.wait_until_kept()
        now, by = anyio.current_time(), check_author(author)
        with core.explained():
            write = machine.write(name, checked, now, by, settle=check_settle(settle), force=force)
        try:
            what = f"PARAM_SET {name} to {core.label}"
            result = await core.wait(write, timeout, lambda: (what, write.attempts))
        finally:
            machine.writes.cancel(write, anyio.current_time())
        if durable:
            await core.write_durably([name])
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

        Several writes are in flight at a time, as many as the vehicle serves. Writes to one name run in the
        order given. A parameter that reveals or hides others, such as `*_ENABLE`, is written alone: all
        writes before it end first, and those after it begin afterwards. A value that is refused does not stop
        the others.

        If the vehicle is lost, the link fails, three writes in a row get no response or the timeout expires,
        the call returns the outcomes so far: each value that was sent and not acknowledged is *unknown*, each
        value that was not sent is *not tried*, and `error` of the result is the cause. After cancellation it
        is unknown whether the vehicle has the values that were sent.

        Args:
            values: values by name, or pairs of name and value; a name may occur in several pairs. Values are
                as in `set`.
            progress: called with each outcome in the order of their arrival, from this task.
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
        pairs = check_writes(values)
        core, machine = self.core, self.core.machine
        core.client.check_open()
        machine.check_uncontested()
        if durable:
            await core.wait_until_kept()
        began, by = anyio.current_time(), check_author(author)
        explain = Explanations(core, began)

        def report(outcome: SetOutcome) -> None:
            if progress is not None:
                progress(explain.outcome(outcome))

        with core.explained():
            batch = machine.write_many(pairs, began, by, settle=check_settle(settle), force=force)
        try:
            core.client.wake()
            outcomes = await wait_for_batch(batch, timeout, report, self._unanswered_sets)
        finally:
            machine.write_batches.end(batch, anyio.current_time())
        failure, outcomes = explain.error(batch.failure), tuple(map(explain.outcome, outcomes))
        if durable and (done := [outcome.name for outcome in outcomes if outcome.is_set]):
            try:
                await core.write_durably(done)
            except NotDurable as error:
                failure = failure or error
                outcomes = tuple(replace(each, error=error) if each.is_set else each for each in outcomes)
        elapsed = anyio.current_time() - began
        return SetManyResult(self.system, self.component, outcomes, failure, elapsed)

    def _unanswered_sets(self, names: Sequence[str]) -> str:
        what = f"PARAM_SET {names[0]}" if len(names) == 1 else f"{len(names)} PARAM_SETs"
        return f"{what} to {self.core.label}"

    async def reset(
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
        if not names:
            raise UsageError("reset needs the name of at least one parameter")
        deadline = math.inf if timeout is None else anyio.current_time() + timeout

        def left() -> float | None:
            return None if timeout is None else max(deadline - anyio.current_time(), 0.0)

        await self.fetch_all(timeout=timeout)
        choice = ResetChoice.of(
            await read_unconfirmed(self.params, self.get, names, timeout=left()), defaults or {}
        )
        written = await self.set_many(
            choice.values, progress=progress, timeout=left(), settle=settle, durable=durable, author=author
        )
        return ResetResult(written, choice.unchanged, choice.without_default)

    async def fetch_all(
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
        calls share one fetch. Cancellation keeps the received values in the table.

        Args:
            refresh: download even if the hash would confirm the cached table.
            timeout: seconds after which the partial table is returned with `missing`; None: no limit, except
                20 s if the client only listens.
            progress: called about ten times a second, from this task.

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
        core, machine = self.core, self.core.machine
        core.client.check_open()
        core.client.station.check_refresh(refresh)
        timeout = fetch_timeout(core.client.station, timeout)
        began = anyio.current_time()
        if not refresh:
            with anyio.move_on_after(timeout):
                await core.wait_for_cache()
        with core.explained():
            fetch = machine.begin_fetch(anyio.current_time(), refresh=refresh)
        try:
            result = await core.wait_for_fetch(fetch, None if timeout is None else began + timeout, progress)
        finally:
            machine.end_fetch(fetch, anyio.current_time())
            core.client.wake()  # requests of other operations may have waited for this fetch
            await core.wait_until_files_closed()
        return replace(result, elapsed=anyio.current_time() - began)

    async def refreshed(self, *, timeout: float | None = None) -> None:
        """Wait until the values outside the hash have been read after `fetch_all`.

        Returns immediately if there are none. A value that cannot be read stays *cached*. Cancellation does
        not stop the reads.

        Args:
            timeout: seconds; None waits without limit.

        Raises:
            NoReply: the reads took longer than `timeout`.
            LinkError: the link failed, or the client was closed.
        """
        self.core.client.check_open()
        refresh = self.core.machine.refresh
        if refresh is not None:
            await self.core.wait(refresh, timeout, lambda: ("the values outside the hash", 0))

    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Send a new signing key to the vehicle with SETUP_SIGNING, or with None remove its key.

        The key is sent unencrypted: use a link that no other party can read, such as a USB cable. MAVLink has
        no acknowledgement for SETUP_SIGNING; a session with the new key shows whether the vehicle uses it.
        This session keeps its own key, which must be the vehicle's current key unless the vehicle trusts the
        link (ArduPilot trusts USB). After cancellation the vehicle may have the new key.

        Args:
            key: the new key, or None.
            link_is_safe: confirmation by the user that no other party can read the link.

        Raises:
            UsageError: `link_is_safe` is False, or the component uses MAVLink 1.
            LinkError: the link failed, or the client was closed.
        """
        if not link_is_safe:
            raise UsageError(
                "SETUP_SIGNING sends the key unencrypted. Use a link that no other party can read, such as"
                " USB, and pass link_is_safe=True"
            )
        if self.core.machine.version == 1:
            raise UsageError(f"{self.system}/{self.component} uses MAVLink 1, which has no signing")
        for _ in range(SETUP_SIGNING_COUNT):
            self.core.client.check_open()
            timestamp = 0 if key is None else timestamp_now()
            self.core.client.station.send_setup_signing(
                self.system, self.component, key, timestamp, peer=self.core.machine.vehicle[1]
            )
            self.core.client.wake()
            await anyio.sleep(SETUP_SIGNING_INTERVAL)

    async def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """Reboot the vehicle, and wait until the same vehicle is back.

        The command is sent 2.5 s after the last write of this client, so that the vehicle has saved it. The
        client detects the reboot from the vehicle's clock, its heartbeat, its frame sequence numbers or its
        silence, so the acknowledgement may be lost. Then it verifies the hardware id, or without one, the
        autopilot and type of the heartbeat. As after every boot, the table is *cached* until it is confirmed;
        parameters may have changed.

        Concurrent calls share one reboot. After cancellation, the vehicle may still reboot.

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
        self.core.client.check_open()
        moves = system is not None and system != self.system
        deadline = anyio.current_time() + (REBOOT_TIMEOUT if timeout is None else timeout)
        machine = self.core.machine
        with self.core.explained():
            restart = machine.begin_reboot(anyio.current_time(), returns=not moves)
        try:
            left = deadline - anyio.current_time()
            await self.core.wait(restart, left, lambda: (restart.stage, restart.attempts))
        finally:
            machine.end_reboot(restart, anyio.current_time())
        if system is None or not moves:
            return self
        left = deadline - anyio.current_time()
        return await successor_of(self, system, timeout=left)

    def changes(self) -> Changes:
        """Return a stream of parameter changes from now on: `async for change in component.changes()`.

        Each change has the name, the old and the new value. The first value of a parameter is a change too. A
        slow consumer receives several changes of one parameter as one, so the queue has at most one change
        for each parameter. The stream continues across a reconnection of the link. It is released with its
        last reference, and ends with a replayed log. Cancelling the iteration loses no change.

        Raises:
            LinkError: while iterating, after the queued changes: the link failed permanently, or the client
                was closed.
            NoReply: while iterating: the component was lost and is no longer followed.
        """
        self.core.listen(changes := Changes())
        return changes


async def successor_of(component: Component, system: int, *, timeout: float | None) -> Component:
    """Return the component of the same vehicle under its new system id; see `ParamClient.successor`."""
    found = component.siblings[await component.core.wait_for_successor(system, timeout=timeout)]
    await found.core.wait_for_cache()
    return found


def fetch_timeout(station: Station, timeout: float | None) -> float | None:
    """Return the timeout of a fetch in seconds, with a default if the client only listens.

    Such a client cannot know whether another station will request a list. A log has an end, so it needs no
    default.
    """
    is_open = timeout is None and station.listens_only and not station.is_log
    return PASSIVE_TIMEOUT if is_open else timeout


def _param_of(message: ParamValue, encoding: Encoding) -> Param:
    """Return the parameter of a PARAM_VALUE outside the table: a hash, or a removed or duplicate name."""
    value, bits = decode_value(message.raw, message.param_type, encoding)
    index = None if message.param_index == NO_INDEX else message.param_index
    return Param(message.param_id, value, known_type(message.param_type), index, bits)
