"""LinkComponent: the implementation of `Component` over a link of this process."""

from __future__ import annotations

import weakref
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import anyio

from paramclient.client.arguments import (
    PROGRESS_CALL_INTERVAL,
    address_in_words,
    check_requested_name,
    check_settle,
    check_writes,
)
from paramclient.client.batch_wait import wait_for_batch
from paramclient.client.component import Component
from paramclient.client.link_extended_params import LinkExtParams
from paramclient.client.local import LocalClient, LocalComponent
from paramclient.client.short_traceback import shortened
from paramclient.client.signing import timestamp_now
from paramclient.client.subscription import Changes
from paramclient.errors import CacheError, NoReply, NotDurable, ParamClientError, UsageError
from paramclient.model.identity import Identity, autopilot_name
from paramclient.model.params import ParamMap
from paramclient.model.values import Encoding, Param, Settable, decode_value, known_type
from paramclient.protocol.addresses import Address
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import ParamChanged, TableChanged
from paramclient.protocol.no_reply_hint import hint_of_component
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.change_origin import check_author
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.passive import PASSIVE_TIMEOUT
from paramclient.protocol.params.sync import ComponentState, SyncState
from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.station import Station
from paramclient.protocol.vehicle.address_contest import Contest
from paramclient.protocol.wire import (
    MAV_MODE_FLAG_SAFETY_ARMED,
    NO_INDEX,
    ParamValue,
    SigningKey,
)

__all__ = ["LinkComponent", "fetch_timeout"]

Result = TypeVar("Result")
Call = ParamSpec("Call")

REBOOT_TIMEOUT = 60.0
"""Default timeout in seconds for a vehicle to reboot and report its identity: small autopilot boards take up
to 30 s, and boards that calibrate sensors first a little longer."""
IDENTITY_TIMEOUT = 1.5
"""Timeout in seconds for the identity of a component, without which its cached table cannot be loaded."""
CACHE_TIMEOUT = 5.0
"""Timeout in seconds for loading a cached table: one takes milliseconds, but hundreds may be queued."""
SETUP_SIGNING_COUNT = 3
"""Number of SETUP_SIGNING messages sent: they have no acknowledgement, and a frame may be lost."""
SETUP_SIGNING_INTERVAL = 0.1
"""Seconds after each SETUP_SIGNING message."""
TIMEOUT_NOTE = "The fetch ended at its timeout."
"""Note of a partial result that a timeout ended."""


def _explains_errors(
    method: Callable[Concatenate[LinkComponent, Call], Awaitable[Result]],
) -> Callable[Concatenate[LinkComponent, Call], Coroutine[Any, Any, Result]]:
    """Add to a NoReply of a method what was received on the link meanwhile, and shorten tracebacks."""

    @wraps(method)
    async def call(component: LinkComponent, /, *arguments: Call.args, **options: Call.kwargs) -> Result:
        began = anyio.current_time()
        try:
            return await method(component, *arguments, **options)
        except NoReply as error:
            raise _Explanations(component, began).explained(error) from None
        except ParamClientError as error:
            raise shortened(error)  # noqa: B904 - the same error

    return call


class LinkComponent(LocalComponent):
    """A component on a link of this process. See `Component` for its calls.

    Args:
        client: the client that follows it.
        machine: its protocol state.
        received_at: time of its first message, by the clock of the event loop.
    """

    def __init__(self, client: LocalClient, machine: ComponentMachine, received_at: float) -> None:
        self.client = client
        self.machine = machine
        self._received_at = received_at
        self._subscriptions: weakref.WeakSet[Changes] = weakref.WeakSet()
        machine.reports_each_change = False  # until the first subscription
        self.system = machine.system
        self.component = machine.component
        self.params = ParamMap(machine.table.params)
        self._ext = LinkExtParams(self)
        self._cache_is_read = anyio.Event()

    @property
    def autopilot(self) -> str:
        """See `Component.autopilot`."""
        number = self.machine.identification.autopilot
        return "unknown" if number is None else autopilot_name(number)

    @property
    def identity(self) -> Identity:
        """See `Component.identity`."""
        return self.settled_identity or self.machine.identity

    @property
    def encoding(self) -> Encoding:
        """See `Component.encoding`."""
        return self.machine.table.encoding

    @property
    def encoding_reason(self) -> str:
        """See `Component.encoding_reason`."""
        return self.machine.identification.encoding_reason

    @property
    def ext(self) -> LinkExtParams:
        """See `Component.ext`."""
        return self._ext

    @property
    def count(self) -> int | None:
        """See `Component.count`."""
        return self.machine.table.count

    @property
    def hash(self) -> int | None:
        """See `Component.hash`."""
        return self.machine.table.hash if self.machine.table.complete else None

    @property
    def state(self) -> ComponentState:
        """See `Component.state`."""
        return self.machine.state

    @property
    def sync_state(self) -> SyncState:
        """See `Component.sync_state`."""
        return self.machine.sync_state

    @property
    def address(self) -> Address:
        """See `Component.address`."""
        return self.machine.address

    @property
    def peer(self) -> str:
        """See `Component.peer`."""
        return self.machine.peer_in_words

    @property
    def contest(self) -> Contest | None:
        """See `Component.contest`."""
        return self.machine.peers.contest

    @property
    def is_armed(self) -> bool | None:
        """See `Component.is_armed`."""
        presence = self.machine.presence
        if presence.base_mode is None or presence.is_lost:
            return None
        return bool(presence.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def silence(self) -> float:
        """See `Component.silence`."""
        return max(0.0, anyio.current_time() - self.machine.presence.received_at)

    @property
    def round_trip(self) -> float | None:
        """See `Component.round_trip`."""
        return self.machine.round_trip.smoothed

    def __repr__(self) -> str:
        last = self.machine.fetches.last
        origin = "" if last is None else f" from {last.source} in {last.elapsed:.2f} s"
        of = f" of {self.count}" if self.count is not None and self.state in ("partial", "fetching") else ""
        whose = f"{self.system}/{self.component} {self.autopilot}"
        return f"<Component {whose} {self.state} {len(self.params)}{of} params{origin}>"

    @_explains_errors
    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """See `Component.get`."""
        check_requested_name(name)
        machine = self.machine
        self.client.check_open()
        read = machine.read(name, anyio.current_time())
        try:
            message = await self.wait(read, timeout, lambda: (_read_of(machine, name), read.attempts))
        finally:
            machine.reads.release(read)
        known = machine.table.params.get(message.param_id)
        if known is None or (isinstance(name, int) and known.index != name):
            return _param_of(message, machine.table.encoding)
        return known

    @_explains_errors
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
        """See `Component.set`."""
        ((name, checked),) = check_writes([(name, value)])
        machine = self.machine
        self.client.check_open()
        machine.check_uncontested()
        if durable:
            await self.wait_until_kept()
        write = machine.write(
            name,
            checked,
            anyio.current_time(),
            check_author(author),
            settle=check_settle(settle),
            force=force,
        )
        try:
            what = f"PARAM_SET {name} to {self.system}/{self.component}"
            result = await self.wait(write, timeout, lambda: (what, write.attempts))
        finally:
            machine.writes.cancel(write, anyio.current_time())
        if durable:
            await self.write_durably([name])
        return result

    @_explains_errors
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
        """See `Component.set_many`."""
        pairs = check_writes(values)
        machine = self.machine
        self.client.check_open()
        machine.check_uncontested()
        if durable:
            await self.wait_until_kept()
        began = anyio.current_time()
        explain = _Explanations(self, began)

        def report(outcome: SetOutcome) -> None:
            if progress is not None:
                progress(explain.outcome(outcome))

        batch = machine.write_many(
            pairs, began, check_author(author), settle=check_settle(settle), force=force
        )
        try:
            self.wake()
            outcomes = await wait_for_batch(batch, timeout, report, self._unanswered_sets)
        finally:
            machine.write_batches.end(batch, anyio.current_time())
        failure, outcomes = explain.error(batch.failure), tuple(map(explain.outcome, outcomes))
        if durable and (done := [outcome.name for outcome in outcomes if outcome.is_set]):
            try:
                await self.write_durably(done)
            except NotDurable as error:
                failure = failure or error
                outcomes = tuple(replace(each, error=error) if each.is_set else each for each in outcomes)
        elapsed = anyio.current_time() - began
        return SetManyResult(self.system, self.component, outcomes, failure, elapsed)

    def _unanswered_sets(self, names: Sequence[str]) -> str:
        what = f"PARAM_SET {names[0]}" if len(names) == 1 else f"{len(names)} PARAM_SETs"
        return f"{what} to {self.system}/{self.component}"

    @_explains_errors
    async def fetch_all(
        self,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """See `Component.fetch_all`."""
        self.client.check_open()
        self.client.station.check_refresh(refresh)
        timeout = fetch_timeout(self.client.station, timeout)
        began = anyio.current_time()
        if not refresh:
            with anyio.move_on_after(timeout):
                await self.wait_for_cache()
        machine = self.machine
        fetch = machine.begin_fetch(anyio.current_time(), refresh=refresh)
        try:
            result = await self.wait_for_fetch(fetch, None if timeout is None else began + timeout, progress)
        finally:
            machine.end_fetch(fetch, anyio.current_time())
            self.wake()  # requests of other operations may have waited for this fetch
            await self.wait_until_files_closed()
        return replace(result, elapsed=anyio.current_time() - began)

    async def refreshed(self, *, timeout: float | None = None) -> None:
        """See `Component.refreshed`."""
        self.client.check_open()
        refresh = self.machine.refresh
        if refresh is not None:
            await self.wait(refresh, timeout, lambda: ("the values outside the hash", 0))

    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """See `Component.setup_signing`."""
        if not link_is_safe:
            raise UsageError(
                "SETUP_SIGNING sends the key unencrypted. Use a link that no other party can read, such as"
                " USB, and pass link_is_safe=True"
            )
        if self.machine.version == 1:
            raise UsageError(f"{self.system}/{self.component} uses MAVLink 1, which has no signing")
        for _ in range(SETUP_SIGNING_COUNT):
            self.client.check_open()
            timestamp = 0 if key is None else timestamp_now()
            self.client.station.send_setup_signing(
                self.system, self.component, key, timestamp, peer=self.machine.vehicle[1]
            )
            self.client.wake()
            await anyio.sleep(SETUP_SIGNING_INTERVAL)

    @_explains_errors
    async def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """See `Component.reboot`."""
        self.client.check_open()
        moves = system is not None and system != self.system
        deadline = anyio.current_time() + (REBOOT_TIMEOUT if timeout is None else timeout)
        machine = self.machine
        restart = machine.begin_reboot(anyio.current_time(), returns=not moves)
        try:
            left = deadline - anyio.current_time()
            await self.wait(restart, left, lambda: (restart.stage, restart.attempts))
        finally:
            machine.end_reboot(restart, anyio.current_time())
        if system is None or not moves:
            return self
        return await self.client.successor(self, system, timeout=deadline - anyio.current_time())

    def changes(self) -> Changes:
        """See `Component.changes`."""
        self.listen(changes := Changes())
        return changes

    @property
    def settled_identity(self) -> Identity | None:
        """See `LocalComponent.settled_identity`."""
        return self.client.station.identity_of(self.machine)

    def wake(self) -> None:
        """See `LocalComponent.wake`."""
        self.client.wake()

    def is_cache_due(self, now: float) -> bool:
        """See `LocalComponent.is_cache_due`."""
        writer = self.client.cache_writer
        timeout = CACHE_TIMEOUT if writer.is_loading(self.machine) else IDENTITY_TIMEOUT
        return (
            self._cache_is_read.is_set()
            or not writer.may_have(self.system, self.component)
            or now >= self._received_at + timeout
        )

    async def wait_for_cache(self) -> None:
        """See `LocalComponent.wait_for_cache`."""
        for timeout in (IDENTITY_TIMEOUT, CACHE_TIMEOUT):
            now = anyio.current_time()
            if not self.is_cache_due(now):
                with anyio.move_on_after(self._received_at + timeout - now):
                    await self._cache_is_read.wait()
                self.client.check_open()

    async def wait_until_kept(self) -> None:
        """See `LocalComponent.wait_until_kept`."""
        writer = self.client.cache_writer
        if self.client.cache is None:
            raise UsageError("durable needs a cache, and the client has none; open it with a cache")
        with anyio.move_on_after(IDENTITY_TIMEOUT + CACHE_TIMEOUT):
            await self._cache_is_read.wait()
        self.client.check_open()
        if (why := writer.obstacle(self.machine)) is not None:
            raise CacheError(f"nothing was set: {why}, so it could not be written to the disk")

    async def write_durably(self, names: Sequence[str]) -> None:
        """See `LocalComponent.write_durably`."""
        try:
            await self.client.cache_writer.write_durably(self.machine)
        except CacheError as error:
            address = f"{self.system}/{self.component}"
            what = f"{names[0]}, but it is" if len(names) == 1 else f"{len(names)} values, but they are"
            raise NotDurable(f"{address} has accepted {what} not on the disk: {error}") from error

    async def wait_until_files_closed(self) -> None:
        """See `LocalComponent.wait_until_files_closed`."""
        await self.client.wait_until_files_closed(self.machine)

    def listen(self, changes: Changes) -> None:
        """See `LocalComponent.listen`."""
        self._subscriptions.add(changes)
        self.machine.reports_each_change = True
        if self.client.is_over:
            changes.end(self.client.link_task.ended)

    def ignore(self, changes: Changes) -> None:
        """See `LocalComponent.ignore`."""
        self._subscriptions.discard(changes)

    # called by the client

    def cache_was_read(self) -> None:
        """Record that the cached table is in `params`, or that there is none."""
        self._cache_is_read.set()

    def take_change(self, event: ParamChanged | TableChanged) -> None:
        """Publish a change of a parameter, or reset the state after a change of several."""
        if isinstance(event, ParamChanged):
            self._publish(event.change)
        self.machine.reports_each_change, self.machine.has_changed = len(self._subscriptions) > 0, False

    def _publish(self, change: Change) -> None:
        """Push a change to all streams."""
        for changes in list(self._subscriptions):
            changes.push(change)

    def forget(self) -> None:
        """End all streams with NoReply: the component is lost and no longer followed."""
        self.client.cache_writer.remove_component(self.machine)
        silence = anyio.current_time() - self.machine.presence.received_at
        awaited = f"{address_in_words(self.system, self.component)} (lost)"
        self.end(NoReply(awaited, attempts=0, waited=silence))

    def end(self, error: ParamClientError | None) -> None:
        """End all streams of changes: with this error, or with None at the end of a log."""
        for changes in list(self._subscriptions):
            changes.end(error)
        self._ext.end(error)

    # waiting

    @_explains_errors
    async def wait(
        self,
        operation: Operation[Result],
        timeout: float | None,
        describe: Callable[[], tuple[str, int]],
        progress: Callable[[], None] | None = None,
    ) -> Result:
        """See `LocalComponent.wait`."""
        began = anyio.current_time()
        ended = anyio.Event()
        operation.on_done.append(ended.set)
        self.wake()
        try:
            with anyio.move_on_after(timeout):
                while not operation.done:
                    with anyio.move_on_after(None if progress is None else PROGRESS_CALL_INTERVAL):
                        await ended.wait()
                    if progress is not None:
                        progress()
        finally:
            with suppress(ValueError):
                operation.on_done.remove(ended.set)
        if not operation.done:
            awaited, attempts = describe()
            raise NoReply(awaited, attempts=attempts, waited=anyio.current_time() - began)
        return _outcome(operation)

    @_explains_errors
    async def wait_for_fetch(
        self, fetch: Fetch, deadline: float | None, progress: Callable[[Progress], None] | None
    ) -> FetchResult:
        """See `LocalComponent.wait_for_fetch`."""
        ended = anyio.Event()
        fetch.on_done.append(ended.set)
        self.wake()
        try:
            while not fetch.done:
                now = anyio.current_time()
                if deadline is not None and now >= deadline:
                    return fetch.partial(now, TIMEOUT_NOTE)
                until = now + PROGRESS_CALL_INTERVAL if progress is not None else None
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


class _Explanations:
    """Adds to errors of requests without a response what was received on the link meanwhile.

    Outcomes with one error keep one error.

    Args:
        component: the component.
        since: when the first request was sent.
    """

    def __init__(self, component: LinkComponent, since: float) -> None:
        self._component = component
        self._since = since
        self._done: dict[int, tuple[NoReply, NoReply]] = {}

    def explained(self, error: NoReply) -> NoReply:
        """Return the error with a hint."""
        if id(error) not in self._done:
            component = self._component
            station, now = component.client.station, anyio.current_time()
            hint = hint_of_component(station, component.machine, self._since, now)
            self._done[id(error)] = (error, error.with_hint(hint))
        return self._done[id(error)][1]

    def error(self, error: ParamClientError | None) -> ParamClientError | None:
        """Return an error, with a hint if it is a NoReply."""
        return self.explained(error) if isinstance(error, NoReply) else error

    def outcome(self, outcome: SetOutcome) -> SetOutcome:
        """Return an outcome with its error explained."""
        error = self.error(outcome.error)
        return outcome if error is outcome.error else replace(outcome, error=error)


def fetch_timeout(station: Station, timeout: float | None) -> float | None:
    """Return the timeout of a fetch in seconds, with a default if the client only listens.

    Such a client cannot know whether another station will request a list. A log has an end, so it needs no
    default.
    """
    is_open = timeout is None and station.listens_only and not station.is_log
    return PASSIVE_TIMEOUT if is_open else timeout


def _outcome(operation: Operation[Result]) -> Result:
    """Return the result of an ended operation, or raise its error."""
    if operation.error is not None:
        raise operation.error
    assert operation.done
    return operation.result  # type: ignore[return-value]  # an Operation[None] ends with None


def _param_of(message: ParamValue, encoding: Encoding) -> Param:
    """Return the parameter of a PARAM_VALUE outside the table: a hash, or a removed or duplicate name."""
    value, bits = decode_value(message.raw, message.param_type, encoding)
    index = None if message.param_index == NO_INDEX else message.param_index
    return Param(message.param_id, value, known_type(message.param_type), index, bits)


def _read_of(machine: ComponentMachine, name: str | int) -> str:
    """Return the description of a read, for NoReply."""
    what = name if isinstance(name, str) else f"parameter {name}"
    return f"{what} of {machine.system}/{machine.component}"
