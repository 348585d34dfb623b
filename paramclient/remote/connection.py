"""Connection to a service: event stream with reconnection, and requests."""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, Protocol, TypeVar

import anyio

from paramclient.client import reconnect_delays
from paramclient.client.arguments import PROGRESS_CALL_INTERVAL
from paramclient.client.reconnect_delays import Backoff
from paramclient.client.short_traceback import shortened
from paramclient.errors import ClientClosed, LinkError, NoReply, ParamClientError
from paramclient.remote.decoding import decode_errors
from paramclient.remote.http import Requests, ServiceResponse, ServiceUnreachable, StreamPosition

__all__ = ["Connection", "EventSink", "run_with_progress"]

SERVICE_MARGIN: Final = 5.0
"""Seconds after a timeout in which the response still arrives, as the service applies the timeout itself."""

SERVICE_TIMEOUT_MIN: Final = 0.001
"""Minimum timeout in seconds that a service accepts."""
SERVICE_TIMEOUT_MAX: Final = 86_400.0
"""Maximum timeout in seconds that a service accepts."""

T = TypeVar("T")

logger = logging.getLogger(__name__)


class EventSink(Protocol):
    """Receiver of the events of a service. Its calls must neither block nor raise."""

    def take(self, event: Mapping[str, Any]) -> None:
        """Process an event."""

    def leave(self) -> None:
        """Mark all data as stale: the connection is lost."""

    def resume(self) -> None:
        """Continue after a reconnection: all missed events follow."""

    def begin_anew(self) -> None:
        """Start over: earlier events are not available, and the current state has to be requested."""


class Connection:
    """Follows the events of a service, and sends requests to it.

    A lost connection is reopened with backoff, as a link is. Calls wait for it for up to `LINK_TIMEOUT` (10
    s, in `client.reconnect_delays`); then they and new calls raise LinkError until the reconnection.

    Args:
        requests: the HTTP requests.
        follower: receiver of the events.

    Attributes:
        is_offline: whether the service cannot be reached now.
        broken: the error that calls raise now, or None.
        ended: the error that all calls raise permanently, or None.
        failed: the error of the first connection attempt, or None.
        place: position of the last received event, or None.
        changed: set, and replaced, when events have arrived or an attribute has changed.
    """

    def __init__(self, requests: Requests, follower: EventSink) -> None:
        self.is_offline = True
        self.broken: LinkError | None = None
        self.ended: LinkError | None = None
        self.failed: ParamClientError | None = None
        self.place: StreamPosition | None = None
        self.changed = anyio.Event()
        self._requests = requests
        self._follower = follower
        self._was_there = False
        self._scopes: set[anyio.CancelScope] = set()

    async def follow(self) -> None:
        """Receive events and reconnect, until cancelled. Return if the first connection attempt fails."""
        while True:
            try:
                await self._listen()
            except ServiceUnreachable as failure:
                error: ParamClientError = failure.error
            except ParamClientError as refusal:
                error = refusal
            if not self._was_there:
                self.failed = error
                self.notify()
                return
            await self._wait_to_try_again(error)

    async def ask(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        awaited: str,
        timeout: float | None = None,
        waits_for_ever: bool = False,
        link: str | None = None,
        is_write: bool = False,
    ) -> ServiceResponse:
        """Send a request and wait for the response, also across a reconnection.

        Cancellation closes the request.

        Args:
            method, path, body, link: as in `Requests.ask`.
            awaited: description of the request, for NoReply.
            timeout: seconds, also sent to the service; None: the service chooses.
            waits_for_ever: whether a timeout of None means no limit.
            is_write: whether the request must not be sent twice.

        Raises:
            NoReply: the service cannot be reached within the timeout.
            LinkError: the service cannot be reached, or the response to a write was lost.
            ParamClientError: the error that the service reports.
        """
        self.check_open()
        began = anyio.current_time()
        deadline = math.inf if timeout is None else began + timeout
        failing_since = math.inf
        with anyio.CancelScope(deadline=deadline + SERVICE_MARGIN) as scope:
            self._scopes.add(scope)
            try:
                while await self._is_reached(deadline):
                    left: dict[str, Any] = {}
                    if timeout is not None:
                        seconds = deadline - anyio.current_time()
                        left["timeout_s"] = min(max(seconds, SERVICE_TIMEOUT_MIN), SERVICE_TIMEOUT_MAX)
                    elif waits_for_ever:
                        left["timeout_s"] = None
                    sent = body if body is None and not left else {**(body or {}), **left}
                    requested_at = anyio.current_time()
                    try:
                        return await self._requests.ask(method, path, sent, link=link)
                    except ServiceUnreachable as failure:
                        if is_write and failure.may_be_done:
                            raise self._unknown(awaited, failure) from failure.error.__cause__
                        now = anyio.current_time()
                        if (
                            now - requested_at > reconnect_delays.LINK_TIMEOUT
                        ):  # the request had been connected
                            failing_since = now
                        failing_since = min(failing_since, now)
                        if now - failing_since >= reconnect_delays.LINK_TIMEOUT:
                            raise failure.error from failure.error.__cause__
                        await anyio.sleep(reconnect_delays.RECONNECT_BACKOFF_MIN)
                    except ParamClientError as error:
                        raise shortened(error)  # noqa: B904 - the same error
            finally:
                self._scopes.discard(scope)
        self.check_open()
        raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began)

    async def reached(self) -> None:
        """Wait until the service has been reached.

        Raises:
            ParamClientError: the first connection attempt has failed.
        """
        while self.is_offline:
            if self.failed is not None:
                raise self.failed
            await self.changed.wait()

    def check_open(self) -> None:
        """Check that requests can be sent.

        Raises:
            LinkError: the service cannot be reached, or the client is not open.
        """
        if (error := self.ended or self.broken) is not None:
            raise error.with_traceback(None)
        if not self._was_there:
            name = self._requests.name
            raise ClientClosed("the client is not open; use `async with` or `open`", link=name)

    def end(self, error: LinkError) -> None:
        """Fail all calls permanently with this error."""
        self.ended = error
        self._fail_calls()

    def notify(self) -> None:
        """Wake the tasks that wait for `changed`."""
        changed, self.changed = self.changed, anyio.Event()
        changed.set()

    async def _listen(self) -> None:
        """Receive events until the stream ends.

        Raises:
            Unreached, ParamClientError: the reason of its end.
        """
        async with self._requests.events(self.place) as batches:
            async for events in batches:
                for event in events:
                    self._take(event)
                if events:
                    self.notify()

    def _take(self, event: Mapping[str, Any]) -> None:
        with decode_errors(self._requests.name):
            self.place = StreamPosition(str(event["run"]), int(event["seq"]))
            if event["type"] == "hello":
                self._arrive(is_resumed=bool(event["resumed"]))
            elif event["type"] == "gap":
                self._follower.begin_anew()
            else:
                self._follower.take(event)

    def _arrive(self, *, is_resumed: bool) -> None:
        if self._was_there:
            logger.info("%s: reconnected", self._requests.name)
        if is_resumed and self._was_there:
            self._follower.resume()
        else:
            self._follower.begin_anew()
        self._was_there = True
        self.is_offline = False
        self.broken = None

    async def _wait_to_try_again(self, error: ParamClientError) -> None:
        """Wait for the next attempt after the connection was lost, or an attempt has failed."""
        if not self.is_offline:
            logger.warning("%s; reconnecting", error)
            self.is_offline = True
            self._backoff = Backoff()
            self._follower.leave()
            self.notify()
        elif self._backoff.is_timed_out:
            name = self._requests.name
            self.broken = error if isinstance(error, LinkError) else LinkError(str(error), link=name)
            self._fail_calls()
        await self._backoff.wait()

    async def _is_reached(self, deadline: float) -> bool:
        """Wait until the service is connected. Return False at the deadline."""
        while self.is_offline:
            self.check_open()
            with anyio.move_on_after(deadline - anyio.current_time()) as waiting:
                await self.changed.wait()
            if waiting.cancelled_caught:
                return False
        self.check_open()
        return True

    def _unknown(self, what: str, failure: ServiceUnreachable) -> LinkError:
        return LinkError(f"{failure.error}; it is unknown whether {what} was done", link=self._requests.name)

    def _fail_calls(self) -> None:
        for scope in self._scopes:
            scope.cancel()
        self.notify()


async def run_with_progress(work: Callable[[], Awaitable[T]], notify: Callable[[], None] | None) -> T:
    """Run `work`, and call `notify` from this task about ten times a second, and once at the end."""
    if notify is None:
        return await work()
    done = anyio.Event()
    results: list[T] = []
    failures: list[Exception] = []

    async def run() -> None:
        try:
            results.append(await work())
        except Exception as error:  # the task group would wrap it in an ExceptionGroup
            failures.append(error)
        done.set()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        try:
            while not done.is_set():
                with anyio.move_on_after(PROGRESS_CALL_INTERVAL):
                    await done.wait()
                if not failures:
                    notify()
        except Exception as error:
            failures.append(error)
            tasks.cancel_scope.cancel()
    if failures:
        raise failures[0]
    return results[0]
