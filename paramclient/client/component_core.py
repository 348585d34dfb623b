"""ComponentCore: the state of a component and its cached table, waiting, streams."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, Final, TypeVar

import anyio

from paramclient.client.arguments import PROGRESS_CALL_INTERVAL, address_in_words
from paramclient.client.core import ClientCore
from paramclient.client.subscription import Changes, Subscribers
from paramclient.errors import CacheError, NoReply, NotDurable, ParamClientError, UsageError
from paramclient.model.identity import Identity
from paramclient.protocol.addresses import Address
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import ParamChanged, TableChanged
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.no_reply_hint import hint_of_component
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.write_batch import SetOutcome
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.system_id_change import SEARCH_INTERVAL, SystemIdSearch

__all__ = ["TIMEOUT_NOTE", "ComponentCore", "Explanations"]

IDENTITY_TIMEOUT: Final = 1.5
"""Timeout in seconds for the identity of a component, without which its cached table cannot be loaded."""
CACHE_TIMEOUT: Final = 5.0
"""Timeout in seconds for loading a cached table: one takes milliseconds, but hundreds may be queued."""
IDENTITY_POLL_INTERVAL: Final = 0.05
"""Seconds between two checks of the identity of a vehicle: no event reports it."""
TIMEOUT_NOTE: Final = "The fetch ended at its timeout."
"""Note of a partial result that a timeout ended."""

Result = TypeVar("Result")


class ComponentCore:
    """The state of one component, and the waiting of its calls.

    Args:
        client: the parts of the client that follows it.
        machine: its protocol state.
        received_at: time of its first message, by the clock of the event loop.

    Attributes:
        client, machine: as given.
        changes: the streams of parameter changes.
        ext_changes: the streams of changes of extended parameters.
    """

    def __init__(self, client: ClientCore, machine: ComponentMachine, received_at: float) -> None:
        self.client = client
        self.machine = machine
        self.changes: Subscribers[Change] = Subscribers()
        self.ext_changes: Subscribers[ExtChange] = Subscribers()
        self._received_at = received_at
        self._cache_is_read = anyio.Event()
        machine.reports_each_change = False  # until the first subscription

    @property
    def label(self) -> str:
        """The ids of the component, for messages."""
        return f"{self.machine.system}/{self.machine.component}"

    @property
    def settled_identity(self) -> Identity | None:
        """The identity of the vehicle, under which its table is cached; None before it is settled."""
        return self.client.station.identity_of(self.machine)

    async def wait_until_identified(self, timeout: float) -> None:
        """Wait at most `timeout` seconds until the vehicle is identified, as its cache key requires."""
        with anyio.move_on_after(timeout):
            while self.settled_identity is None:  # noqa: ASYNC110 - no event
                await anyio.sleep(IDENTITY_POLL_INTERVAL)

    async def wait_for_successor(self, system: int, *, timeout: float | None) -> Address:
        """Wait until the vehicle is heard under its new system id, and return its new address.

        Args:
            system: the new system id.
            timeout: seconds; None waits without limit.

        Raises:
            AnotherVehicle, NoReply, LinkError: as from `ParamClient.successor`.
        """
        client = self.client
        client.check_open()
        began = anyio.current_time()
        search = SystemIdSearch(self.machine, self.machine.address_in(system))
        with anyio.move_on_after(timeout):
            while not search.look(client.station.components, anyio.current_time()):
                client.wake()
                with anyio.move_on_after(SEARCH_INTERVAL):
                    await client.link_task.activity.wait()
                client.check_open()
            return search.address
        raise NoReply(search.awaited, attempts=0, waited=anyio.current_time() - began)

    async def wait_until_files_closed(self) -> None:
        """Wait at most one round trip until a file session that is being closed is closed on board."""
        await self.client.wait_until_files_closed(self.machine)

    # the cached table

    def is_cache_due(self, now: float) -> bool:
        """Return whether the cached table is in the table, or the timeout for it has expired."""
        machine, writer = self.machine, self.client.cache_writer
        timeout = CACHE_TIMEOUT if writer.is_loading(machine) else IDENTITY_TIMEOUT
        return (
            self._cache_is_read.is_set()
            or not writer.may_have(machine.system, machine.component)
            or now >= self._received_at + timeout
        )

    async def wait_for_cache(self) -> None:
        """Wait until the cached table, if there is one, is in the table; a few seconds at most.

        Raises:
            LinkError: the link failed, or the client was closed.
        """
        for timeout in (IDENTITY_TIMEOUT, CACHE_TIMEOUT):
            now = anyio.current_time()
            if not self.is_cache_due(now):
                with anyio.move_on_after(self._received_at + timeout - now):
                    await self._cache_is_read.wait()
                self.client.check_open()

    def cache_was_read(self) -> None:
        """Record that the cached table is in the table, or that there is none."""
        self._cache_is_read.set()

    async def wait_until_kept(self) -> None:
        """Wait until the values of the component are written to the cache, for at most 6.5 s.

        Raises:
            UsageError: the client has no cache.
            CacheError: the values cannot be written, or the timeout expired.
        """
        if self.client.cache is None:
            raise UsageError("durable needs a cache, and the client has none; open it with a cache")
        with anyio.move_on_after(IDENTITY_TIMEOUT + CACHE_TIMEOUT):
            await self._cache_is_read.wait()
        self.client.check_open()
        if (why := self.client.cache_writer.obstacle(self.machine)) is not None:
            raise CacheError(f"nothing was set: {why}, so it could not be written to the disk")

    async def write_durably(self, names: Sequence[str]) -> None:
        """Sync the values of the component, plain and extended, to the disk.

        Args:
            names: names of the parameters whose values the vehicle has accepted, for NotDurable.

        Raises:
            NotDurable: the disk cannot be written.
        """
        try:
            await self.client.cache_writer.write_durably(self.machine)
        except CacheError as error:
            what = f"{names[0]}, but it is" if len(names) == 1 else f"{len(names)} values, but they are"
            raise NotDurable(f"{self.label} has accepted {what} not on the disk: {error}") from error

    # streams

    def listen(self, changes: Changes) -> None:
        """Push all further changes to this stream while it is referenced. Ends it if none can follow."""
        self.changes.add(changes)
        self.machine.reports_each_change = True

    def take_change(self, event: ParamChanged | TableChanged) -> None:
        """Publish a change of a parameter, or reset the state after a change of several."""
        if isinstance(event, ParamChanged):
            self.changes.push(event.change)
        self.machine.reports_each_change, self.machine.has_changed = len(self.changes) > 0, False

    def forget(self) -> None:
        """End all streams with NoReply: the component is lost and no longer followed."""
        machine = self.machine
        self.client.cache_writer.remove_component(machine)
        silence = anyio.current_time() - machine.presence.received_at
        awaited = f"{address_in_words(machine.system, machine.component)} (lost)"
        self.end(NoReply(awaited, attempts=0, waited=silence))

    def end(self, error: ParamClientError | None) -> None:
        """End all streams: with this error, or with None at the end of a log."""
        self.changes.end(error)
        self.ext_changes.end(error)

    # waiting

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Add to a NoReply of the body what was received on the link meanwhile."""
        began = anyio.current_time()
        try:
            yield
        except NoReply as error:
            raise Explanations(self, began).explained(error) from None

    async def wait(
        self,
        operation: Operation[Result],
        timeout: float | None,
        describe: Callable[[], tuple[str, int]],
        progress: Callable[[], None] | None = None,
    ) -> Result:
        """Wait until an operation of `machine` ends. The caller releases the operation afterwards.

        Args:
            operation: begun by a call of `machine`.
            timeout: seconds; None waits until the operation ends.
            describe: returns a description of the operation and the number of attempts, for NoReply.
            progress: called about ten times a second, from this task.

        Raises:
            NoReply: the timeout expired.
            ParamClientError: the error with which the operation has ended.
        """
        began = anyio.current_time()
        with self.explained():
            await self.until_done(operation, None if timeout is None else began + timeout, progress)
            if not operation.done:
                awaited, attempts = describe()
                raise NoReply(awaited, attempts=attempts, waited=anyio.current_time() - began)
            return _outcome(operation)

    async def wait_for_fetch(
        self, fetch: Fetch, deadline: float | None, progress: Callable[[Progress], None] | None
    ) -> FetchResult:
        """Wait until a fetch of `machine` ends, or return its partial result at the deadline.

        The caller ends the fetch afterwards.

        Raises:
            ParamClientError: the error with which the fetch has ended.
        """
        report = None if progress is None else lambda: progress(fetch.progress(anyio.current_time()))
        with self.explained():
            await self.until_done(fetch, deadline, report)
            return _outcome(fetch) if fetch.done else fetch.partial(anyio.current_time(), TIMEOUT_NOTE)

    async def until_done(
        self, operation: Operation[Any], deadline: float | None, progress: Callable[[], None] | None
    ) -> None:
        """Wait until an operation ends, or until the deadline; call `progress` about ten times a second."""
        ended = anyio.Event()
        operation.on_done.append(ended.set)
        self.client.wake()
        try:
            with anyio.move_on_after(None if deadline is None else deadline - anyio.current_time()):
                while not operation.done:
                    with anyio.move_on_after(None if progress is None else PROGRESS_CALL_INTERVAL):
                        await ended.wait()
                    if progress is not None:
                        progress()
        finally:
            with suppress(ValueError):
                operation.on_done.remove(ended.set)


class Explanations:
    """Adds to errors of requests without a response what was received on the link meanwhile.

    Outcomes with one error keep one error.

    Args:
        core: the component.
        since: when the first request was sent.
    """

    def __init__(self, core: ComponentCore, since: float) -> None:
        self._core = core
        self._since = since
        self._done: dict[int, tuple[NoReply, NoReply]] = {}

    def explained(self, error: NoReply) -> NoReply:
        """Return the error with a hint."""
        if id(error) not in self._done:
            core, now = self._core, anyio.current_time()
            hint = hint_of_component(core.client.station, core.machine, self._since, now)
            self._done[id(error)] = (error, error.with_hint(hint))
        return self._done[id(error)][1]

    def error(self, error: ParamClientError | None) -> ParamClientError | None:
        """Return an error, with a hint if it is a NoReply."""
        return self.explained(error) if isinstance(error, NoReply) else error

    def outcome(self, outcome: SetOutcome) -> SetOutcome:
        """Return an outcome with its error explained."""
        error = self.error(outcome.error)
        return outcome if error is outcome.error else replace(outcome, error=error)


def _outcome(operation: Operation[Result]) -> Result:
    """Return the result of an ended operation, or raise its error."""
    if operation.error is not None:
        raise operation.error.with_traceback(None)
    return operation.result  # type: ignore[return-value]  # an Operation[None] ends with None
