"""A component as users see it: its parameters, and the calls that can be awaited."""

from __future__ import annotations

import random
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, SupportsFloat, SupportsIndex, TypeVar

import anyio

from paramclient.client.arguments import check_accepted, check_asked, check_asked_name, check_settle
from paramclient.client.events import Changes
from paramclient.client.signing import timestamp_now
from paramclient.errors import CacheError, NoReply, NotDurable, ParamClientError, UsageError
from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.params import ParamMap
from paramclient.model.values import Encoding, Param, check_value, decode, known_type
from paramclient.protocol.addresses import Address
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import ParamChanged, ParamsMoved
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.change_origin import check_asker
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import FetchResult, Progress, Sampled
from paramclient.protocol.params.passive import OVERHEARING_PATIENCE
from paramclient.protocol.params.sampling import SAMPLE_SIZE
from paramclient.protocol.params.sync import SyncState
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.station import Station
from paramclient.protocol.vehicle.peers import Contest
from paramclient.protocol.wire import (
    HASH_CHECK,
    MAV_MODE_FLAG_SAFETY_ARMED,
    NO_INDEX,
    ParamValue,
    SigningKey,
)

if TYPE_CHECKING:
    from paramclient.client.client import ParamClient

__all__ = ["Component", "address_in_words", "patience_of"]

Result = TypeVar("Result")

REBOOT_PATIENCE = 60.0
"""Seconds for a vehicle to start again and say who it is, unless the caller says otherwise: autopilots on
small boards take up to half a minute, and those that calibrate sensors first a little longer."""
PROGRESS_INTERVAL = 0.1
"""Seconds between two calls of a progress callback."""
IDENTITY_PATIENCE = 1.5
"""Seconds to wait for a component to say who it is before its cached table is done without."""
CACHE_PATIENCE = 5.0
"""The same while its cached table is being read: for milliseconds, but hundreds may be wanted at once."""
SETUP_TRIES = 3
SETUP_PAUSE = 0.1
"""How often SETUP_SIGNING is sent, and the seconds after each: nothing answers it, and frames get lost."""
TIME_IS_OVER = "The time given for the fetch was over."
"""Why a result is partial that a time limit ended."""


class Component:
    """One component of a vehicle, as `ParamClient.component` gives it.

    All of its calls may be cancelled at any point, and the next call works. All of them wait on while a link
    that comes back by itself is away, up to `LINK_PATIENCE` (in `client.link_task`); then, and when the
    client is closed, they raise LinkError. A component that is lost (see `Lost`) is not asked: calls that
    wait for an answer and new ones raise NoReply at once, but for a `fetch_all` under way, which goes on for
    a while, as the vehicle may only be starting again. A component whose address several vehicles have (see
    `Contested`) is not asked either: calls raise ContestedAddress. The table stays, and what is in it is
    *cached* until the vehicle is back and has confirmed it.

    Attributes:
        system, component: its address.
        params: all that is known of its parameters now, by name: live, verified or cached, see `Trust`. The
            mapping is read-only and follows what is heard.
    """

    def __init__(self, client: ParamClient, machine: ComponentMachine, heard_at: float) -> None:
        self._client = client
        self._machine = machine
        self._heard_at = heard_at
        self._subscriptions: weakref.WeakSet[Changes] = weakref.WeakSet()
        machine.tells_changes = False  # until somebody listens
        self.system = machine.system
        self.component = machine.component
        self.params = ParamMap(machine.table.params)
        self._cache_is_read = anyio.Event()

    @property
    def autopilot(self) -> str:
        """What its heartbeat says it runs: px4, ardupilot, generic, …; "unknown" before a heartbeat came."""
        number = self._machine.who.autopilot
        return "unknown" if number is None else autopilot_name(number)

    @property
    def identity(self) -> Identity:
        """Who the vehicle is: hardware id, firmware, capabilities, as far as known."""
        return self._client._station.identity_of(self._machine) or self._machine.identity

    @property
    def encoding(self) -> Encoding:
        """How it lays values into messages."""
        return self._machine.table.encoding

    @property
    def encoding_reason(self) -> str:
        """Why that is believed, in words."""
        return self._machine.who.encoding_reason

    @property
    def count(self) -> int | None:
        """The number of parameters that it says it has, or None before it said so."""
        return self._machine.table.count

    @property
    def hash(self) -> int | None:
        """The PX4 hash under which the vehicle would confirm the table as it stands here, or None."""
        return self._machine.table.hash if self._machine.table.complete else None

    @property
    def state(self) -> str:
        """The table's state in a word: new, cached, fetching, synced, partial, contested, lost."""
        return self._machine.state

    @property
    def sync_state(self) -> SyncState:
        """How the table stands to the vehicle's: up to date, or what is done about it."""
        return self._machine.sync_state

    @property
    def address(self) -> Address:
        """System and component: its key in `ParamClient.components`; with `split_peers` of this peer."""
        return self._machine.address

    @property
    def peer(self) -> str:
        """The address and port that its messages come from and requests go to; empty while not known."""
        return self._machine.peer_in_words

    @property
    def contest(self) -> Contest | None:
        """Why it is open which vehicle this is, where several have its address; else None.

        Meanwhile every call raises ContestedAddress, `params` stays as it was, and nothing goes to the cache.
        """
        return self._machine.peers.contest

    @property
    def is_armed(self) -> bool | None:
        """Whether its motors may turn, by its last heartbeat.

        None where that is not known: before a heartbeat, while it is lost, and in high-latency mode, in which
        it sends none.
        """
        presence = self._machine.presence
        if presence.base_mode is None or presence.is_lost:
            return None
        return bool(presence.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def silence(self) -> float:
        """Seconds since it was heard last. After five without a word it is lost, see `Lost`."""
        return max(0.0, anyio.current_time() - self._machine.presence.heard_at)

    @property
    def round_trip(self) -> float | None:
        """The measured round trip in seconds, smoothed, or None before anything was answered."""
        return self._machine.round_trip.smoothed

    def __repr__(self) -> str:
        last = self._machine.fetches.last
        origin = "" if last is None else f" from {last.source} in {last.elapsed:.2f} s"
        of = f" of {self.count}" if self.count is not None and self.state in ("partial", "fetching") else ""
        whose = f"{self.system}/{self.component} {self.autopilot}"
        return f"<Component {whose} {self.state} {len(self.params)}{of} params{origin}>"

    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Ask the vehicle for one parameter.

        Equal calls at the same time share one request. Different ones run side by side.

        Args:
            name: param_id, or an index from 0.
            timeout: seconds until giving up; None leaves it to the number of tries, which follows the
                measured round trip and loss.

        Raises:
            UsageError: no such name or index can exist, or the client only listens.
            UnknownParameter: the vehicle does not have it.
            Refused: it gave a reason not to tell.
            NoReply: it did not answer.
            LinkError: the link failed, or the client was closed.
        """
        check_asked(name)
        machine = self._machine
        self._client._check_open()
        read = machine.read(name, anyio.current_time())
        try:
            message = await self._wait(read, timeout, lambda: (_read_of(machine, name), read.attempts))
        finally:
            machine.reads.release(read)
        known = machine.table.params.get(message.param_id)
        if known is None or (isinstance(name, int) and known.index != name):
            return _param_of(message, machine.table.encoding)
        return known

    async def set(
        self,
        name: str,
        value: SupportsIndex | SupportsFloat | bytes,
        *,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        asker: str | None = None,
    ) -> SetResult:
        """Write one parameter and prove by its value that the vehicle has taken it.

        The type is learnt first when it is not known. Writes to one name are done in the order of the calls,
        those to different names side by side.

        Args:
            name: param_id.
            value: a number; or the 4 bytes of the message for what cannot be said as a number.
            timeout: as in `get`.
            settle: seconds, up to 60, for which the value is watched after its acknowledgement; then it is
                read once more, and the result tells what has become of it. 1.2 is enough for PX4, whose
                modules clamp values within a second. Without it such a change only comes as one of
                `changes`.
            force: send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot,
                which ignores them.
            durable: return only when the value and its line of history are on the disk, past a loss of power.
                Without it they are written within 0.25 s, and a loss of power may cost them later too.
            asker: for whom it is done, in printable ASCII: the change, and its line of history, are then by
                "us for ASKER".

        Returns:
            Accepted, or adjusted: the vehicle made another value of it.

        Raises:
            UsageError: the name, the value or another argument cannot be right, the value is NaN or infinite
                and the autopilot cannot store that, or the client only listens. Nothing was written.
            UnknownParameter: the vehicle does not have it.
            Refused: it gave a reason.
            TypeMismatch: it holds the parameter in another type.
            ValueNotApplied: it keeps the value it had and gives no reason.
            NoReply: it did not answer. Whether it has taken the value is not known, as after cancellation.
            ContestedAddress: several vehicles have its address.
            NotDurable: the vehicle has taken the value, and it could not be written to the disk.
            CacheError: with `durable`, nothing can be written to the disk; nothing was sent.
            LinkError: the link failed, or the client was closed.
        """
        if check_asked_name(name) == HASH_CHECK:
            raise UsageError(f"{HASH_CHECK} is no parameter: it can be read, and not written")
        machine = self._machine
        self._client._check_open()
        machine.check_uncontested()
        if durable:
            await self._wait_until_kept()
        write = machine.write(
            name,
            check_value(value),
            anyio.current_time(),
            check_asker(asker),
            settle=check_settle(settle),
            force=force,
        )
        try:
            what = f"PARAM_SET {name} to {self.system}/{self.component}"
            result = await self._wait(write, timeout, lambda: (what, write.attempts))
        finally:
            machine.writes.cancel(write, anyio.current_time())
        if durable:
            try:
                await self._client._writer.write_durably(machine)
            except CacheError as error:
                what = f"{self.system}/{self.component} has taken {name}, but it is not on the disk: {error}"
                raise NotDurable(what) from error
        return result

    async def fetch_all(
        self,
        *,
        refresh: bool = False,
        accept: str = "verified",
        sample: int = SAMPLE_SIZE,
        seed: int | None = None,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """Bring the whole table up to date.

        Where the cache has a table and the vehicle a hash, the hash is asked for first; when it confirms the
        table, nothing is downloaded. Then the values that the hash does not cover are read afresh in the
        background: they stay *cached* until they have come, and `refreshed` waits for them.

        Otherwise the table comes as one packed file over MAVFTP where the component serves that: quicker than
        the list, exact, and with the firmware's defaults. Else it comes by list. `source` and `notes` of the
        result say what was done, and why.

        Where the client only listens, nothing is asked for: it waits for a list that others ask for, and then
        ends when the table is whole, or 5 seconds after the last new value.

        It ends by itself in every case: indices that never answer are given up and named in `missing`.
        Calls at the same time share one fetch. Cancelling it leaves what has come in the table.

        Args:
            refresh: download even when the hash would confirm the cached table.
            accept: "sampled" where a vehicle without a hash may be believed to have the cached table when a
                sample of it agrees (name, value, index and count), of the same hardware id, firmware version
                and git hash. `sample` of the result then says how far that can be trusted, and nothing counts
                as verified. Else "verified".
            sample: how many parameters are read for that.
            seed: of their draw; None for another one each time.
            timeout: seconds, after which what has come is given with `missing`; None is 20 where the client
                only listens.
            progress: called about ten times a second, from this task.

        Raises:
            UsageError: there is no such `accept`, the sample is empty, or `refresh` is given where the policy
                of the client allows no download, or it only listens.
            CacheError: nothing is cached, and the policy allows no download.
            NoReply: nothing came at all, or it is lost.
            LinkError: the link failed, or the client was closed.
        """
        self._client._check_open()
        self._client._station.check_refresh(refresh)
        check_accepted(accept, sample)
        sampled = None
        if accept == "sampled" and not refresh:
            sampled = Sampled(sample, random.getrandbits(32) if seed is None else seed)
        timeout = patience_of(self._client._station, timeout)
        began = anyio.current_time()
        if not refresh:
            with anyio.move_on_after(timeout):
                await self._wait_for_cache()
        machine = self._machine
        fetch = machine.begin_fetch(anyio.current_time(), refresh=refresh, sampled=sampled)
        try:
            result = await self._wait_for_fetch(fetch, None if timeout is None else began + timeout, progress)
        finally:
            machine.end_fetch(fetch, anyio.current_time())
            self._client._wake(machine)  # it may have been in the way of others
            await self._client._files_closed(machine)
        return replace(result, elapsed=anyio.current_time() - began)

    async def refreshed(self, *, timeout: float | None = None) -> None:
        """Wait until the values that a hash does not cover have been read afresh after `fetch_all`.

        Returns at once where there are none. A value that cannot be read stays *cached*.

        Raises:
            NoReply: that took longer than `timeout`.
            LinkError: the link failed, or the client was closed.
        """
        self._client._check_open()
        refresh = self._machine.refresh
        if refresh is not None:
            await self._wait(refresh, timeout, lambda: ("the values that no hash covers", 0))

    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Give a vehicle its signing key, or with None take it away, by SETUP_SIGNING.

        The key goes over the link in clear, so only where nobody listens: over a USB cable, a wire. Nothing
        answers it; whether the vehicle has obeyed shows in a session with the new key. This one goes on with
        its own, which must be the vehicle's until then, unless that trusts the link (ArduPilot trusts USB).

        Args:
            key: its new key.
            link_is_safe: that the user has said so.

        Raises:
            UsageError: nobody has said that the link is safe, or the component speaks MAVLink 1.
            LinkError: the link failed, or the client was closed.
        """
        if not link_is_safe:
            raise UsageError(
                "SETUP_SIGNING carries the key in clear: only over a link on which nobody else can listen, "
                "and with link_is_safe=True"
            )
        if self._machine.version == 1:
            raise UsageError(f"{self.system}/{self.component} speaks MAVLink 1, which knows no signatures")
        for _ in range(SETUP_TRIES):
            self._client._check_open()
            timestamp = 0 if key is None else timestamp_now()
            self._client._station.send_setup_signing(
                self.system, self.component, key, timestamp, peer=self._machine.vehicle[1]
            )
            self._client._wake()
            await anyio.sleep(SETUP_PAUSE)

    async def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """Let the vehicle start again, and wait until the same one is back.

        It is told to when what was written through this client has had the time to be saved (2.5 s after the
        last write). That it has started again is seen by its clock, its heartbeat, the sequence numbers of
        its frames or its silence, so an acknowledgement may be lost. Then its hardware id is asked for, or
        where it has none, its heartbeat must name the same autopilot and type. Its table is *cached*
        afterwards until it is confirmed, as after any start; parameters may be others now.

        Calls at the same time share one restart. When the call is cancelled, the vehicle may start again all
        the same.

        Args:
            system: the system id that it takes with the start, where another one was set (MAV_SYS_ID of PX4,
                SYSID_THISMAV of ArduCopter); then `ParamClient.successor` finds it there.
            timeout: seconds until giving up; None for `REBOOT_PATIENCE`.

        Returns:
            The component that it is now: this one, or the one with the other system id.

        Raises:
            CommandRefused: it does not want to, most likely because it is armed.
            AnotherVehicle: another vehicle answers under its system id.
            NoReply: it does not answer, or did not come back in time.
            LinkError: the link failed, or the client was closed.
        """
        self._client._check_open()
        moves = system is not None and system != self.system
        deadline = anyio.current_time() + (REBOOT_PATIENCE if timeout is None else timeout)
        machine = self._machine
        restart = machine.begin_restart(anyio.current_time(), returns=not moves)
        try:
            left = deadline - anyio.current_time()
            await self._wait(restart, left, lambda: (restart.stage, restart.attempts))
        finally:
            machine.end_restart(restart, anyio.current_time())
        if system is None or not moves:
            return self
        return await self._client.successor(self, system, timeout=deadline - anyio.current_time())

    def changes(self) -> Changes:
        """What changes from now on: `async for change in component.changes()`.

        Each change names the parameter, what was known before and what is known now. A value that is heard
        for the first time is one too. Whoever is slow to ask gets several changes of one parameter as one,
        so what waits is never more than one change for each parameter. An absence of the link does not end
        it; it ends when nobody holds it any more. In a log it ends with that.

        Raises:
            LinkError: while waiting, when the link failed for good or the client was closed. What had come
                before is given first.
        """
        self._listen(changes := Changes())
        if self._client._is_over:
            changes.end(self._client._carrier.ended)
        return changes

    def _cache_is_due(self, now: float) -> bool:
        """Whether the cached table is in `params`, or is not worth waiting for."""
        writer = self._client._writer
        patience = CACHE_PATIENCE if writer.is_bringing(self._machine) else IDENTITY_PATIENCE
        return (
            self._cache_is_read.is_set()
            or not writer.may_have(self.system, self.component)
            or now >= self._heard_at + patience
        )

    async def _wait_for_cache(self) -> None:
        """Wait until the cached table, if the cache may have one, is in `params`; but not for long."""
        for patience in (IDENTITY_PATIENCE, CACHE_PATIENCE):
            now = anyio.current_time()
            if not self._cache_is_due(now):
                with anyio.move_on_after(self._heard_at + patience - now):
                    await self._cache_is_read.wait()
                self._client._check_open()

    async def _wait_until_kept(self) -> None:
        """Wait until what is heard of it goes to the cache, as long as that may take.

        Raises:
            UsageError: the client keeps no cache.
            CacheError: that is not so in time.
        """
        writer = self._client._writer
        if self._client.cache is None:
            raise UsageError("durable needs a cache, and the client keeps none")
        with anyio.move_on_after(IDENTITY_PATIENCE + CACHE_PATIENCE):
            await self._cache_is_read.wait()
        self._client._check_open()
        if (why := writer.obstacle(self._machine)) is not None:
            raise CacheError(f"nothing was set: {why}, so it could not be written to the disk")

    def _listen(self, changes: Changes) -> None:
        """Tell of what changes from now on, for as long as this is held."""
        self._subscriptions.add(changes)
        self._machine.tells_changes = True

    def _moved(self, event: ParamChanged | ParamsMoved) -> None:
        """Something has changed."""
        if isinstance(event, ParamChanged):
            self._publish(event.change)
        self._machine.tells_changes, self._machine.has_moved = len(self._subscriptions) > 0, False

    def _publish(self, change: Change) -> None:
        """Hand a change to everyone who listens."""
        for changes in list(self._subscriptions):
            changes.push(change)

    def _part(self) -> None:
        """It is lost, and not followed any more."""
        self._client._writer.part_with(self._machine)
        silence = anyio.current_time() - self._machine.presence.heard_at
        awaited = f"{address_in_words(self.system, self.component)} (lost)"
        self._end(NoReply(awaited, attempts=0, waited=silence))

    def _end(self, error: ParamClientError | None) -> None:
        """Nothing will come any more."""
        for changes in list(self._subscriptions):
            changes.end(error)

    async def _wait(
        self,
        operation: Operation[Result],
        patience: float | None,
        describe: Callable[[], tuple[str, int]],
        tell: Callable[[], None] | None = None,
    ) -> Result:
        """Wait until an operation ends; `describe` tells for NoReply what was awaited and asked how often.

        Meanwhile `tell` is called about ten times a second.
        """
        began = anyio.current_time()
        ended = anyio.Event()
        operation.on_done.append(ended.set)
        self._client._wake(self._machine)
        try:
            with anyio.move_on_after(patience):
                while not operation.done:
                    with anyio.move_on_after(None if tell is None else PROGRESS_INTERVAL):
                        await ended.wait()
                    if tell is not None:
                        tell()
        finally:
            with suppress(ValueError):
                operation.on_done.remove(ended.set)
        if not operation.done:
            awaited, attempts = describe()
            raise NoReply(awaited, attempts=attempts, waited=anyio.current_time() - began)
        return _outcome(operation)

    async def _wait_for_fetch(
        self, fetch: Fetch, deadline: float | None, progress: Callable[[Progress], None] | None
    ) -> FetchResult:
        ended = anyio.Event()
        fetch.on_done.append(ended.set)
        self._client._wake(self._machine)
        try:
            while not fetch.done:
                now = anyio.current_time()
                if deadline is not None and now >= deadline:
                    return fetch.partial(now, TIME_IS_OVER)
                until = now + PROGRESS_INTERVAL if progress is not None else None
                if deadline is not None:
                    until = deadline if until is None else min(until, deadline)
                with anyio.move_on_after(None if until is None else until - now):
                    await ended.wait()
                if progress is not None:
                    progress(fetch.progress(anyio.current_time()))
        finally:
            with suppress(ValueError):
                fetch.on_done.remove(ended.set)
        return _outcome(fetch)


def patience_of(station: Station, timeout: float | None) -> float | None:
    """For how long a fetch waits: nothing tells whether others will ever ask, unless there is an end."""
    is_open = timeout is None and station.listens_only and not station.is_log
    return OVERHEARING_PATIENCE if is_open else timeout


def _outcome(operation: Operation[Result]) -> Result:
    if operation.error is not None:
        raise operation.error
    assert operation.done
    return operation.result  # type: ignore[return-value]  # an Operation[None] ends with None


def _param_of(message: ParamValue, encoding: Encoding) -> Param:
    """What a message says of what is not in the table: a hash, what has left it, what shares its name."""
    value, bits = decode(message.raw, message.param_type, encoding)
    index = None if message.param_index == NO_INDEX else message.param_index
    return Param(message.param_id, value, known_type(message.param_type), index, bits)


def _read_of(machine: ComponentMachine, name: str | int) -> str:
    what = name if isinstance(name, str) else f"parameter {name}"
    return f"{what} of {machine.system}/{machine.component}"


def address_in_words(system: int | None, component: int | None, peer: str | None = None) -> str:
    """What is looked for on a link, in words."""
    at = "" if peer is None else f" at {peer}"
    if component is None:
        return f"an autopilot{at}" if system is None else f"an autopilot with system id {system}{at}"
    return f"component {'*' if system is None else system}/{component}{at}"
