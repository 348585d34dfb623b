"""The line to a service: its events, for as long as it lasts and again when it is back, and calls over it."""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, Protocol, TypeVar

import anyio

from paramclient.client import link_task
from paramclient.client.arguments import PROGRESS_INTERVAL
from paramclient.errors import ClientClosed, LinkError, NoReply, ParamClientError
from paramclient.remote.decoding import understood
from paramclient.remote.http import Answer, Place, Requests, Unreached

__all__ = ["Connection", "Follower", "telling"]

ANSWERING_TIME: Final = 5.0
"""Seconds beyond a time limit in which the service, which keeps to that limit itself, has answered."""

SHORTEST_LIMIT: Final = 0.001
LONGEST_LIMIT: Final = 86_400.0
"""Seconds that a service takes for a time limit."""

T = TypeVar("T")

logger = logging.getLogger(__name__)


class Follower(Protocol):
    """Who is told what happens on the service. None of the calls may block or raise."""

    def take(self, event: Mapping[str, Any]) -> None:
        """This has happened."""

    def leave(self) -> None:
        """The service cannot be reached: what is known of it may be old."""

    def resume(self) -> None:
        """It is reached again, and all that happened meanwhile will be told."""

    def begin_anew(self) -> None:
        """What happens is told from now on; what was before is to be asked for."""


class Connection:
    """Follows the events of a service, and carries calls to it.

    Like a link that drops, it is made again with back-off; calls wait for that up to `LINK_TIMEOUT` seconds
    (in `client.link_task`), then they and new ones raise LinkError until it is back.

    Args:
        requests: how requests travel.
        follower: who is told of events.

    Attributes:
        is_away: whether the service cannot be reached now.
        broken: what calls raise now, or None.
        ended: the same, for good.
        failed: why it could not be reached at first, or None.
        place: the last event that has come.
        news: is set, and replaced, when anything has come, or has changed of the above.
    """

    def __init__(self, requests: Requests, follower: Follower) -> None:
        self.is_away = True
        self.broken: LinkError | None = None
        self.ended: LinkError | None = None
        self.failed: ParamClientError | None = None
        self.place: Place | None = None
        self.news = anyio.Event()
        self._requests = requests
        self._follower = follower
        self._was_there = False
        self._scopes: set[anyio.CancelScope] = set()

    async def follow(self) -> None:
        """Take events until cancelled; or until it fails, where the service was never reached."""
        while True:
            try:
                await self._listen()
            except Unreached as failure:
                error: ParamClientError = failure.error
            except ParamClientError as refusal:
                error = refusal
            if not self._was_there:
                self.failed = error
                self.tell()
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
    ) -> Answer:
        """Ask the service, and wait for the answer, also while it cannot be reached for a while.

        Cancelled, the request is withdrawn.

        Args:
            method, path, body, link: as in `Requests.ask`.
            awaited: what, in words, for NoReply.
            timeout: the caller's, in seconds, which the service is told too; None where it shall choose one.
            waits_for_ever: whether None means to wait for ever.
            is_write: whether it must not be sent twice.

        Raises:
            NoReply: it cannot be reached, and the time is over.
            LinkError: it cannot be reached; or the answer to a write was lost.
            ParamClientError: what the service says.
        """
        self.check_open()
        began = anyio.current_time()
        deadline = math.inf if timeout is None else began + timeout
        failing_since = math.inf
        with anyio.CancelScope(deadline=deadline + ANSWERING_TIME) as scope:
            self._scopes.add(scope)
            try:
                while await self._is_reached(deadline):
                    left: dict[str, Any] = {}
                    if timeout is not None:
                        seconds = deadline - anyio.current_time()
                        left["timeout_s"] = min(max(seconds, SHORTEST_LIMIT), LONGEST_LIMIT)
                    elif waits_for_ever:
                        left["timeout_s"] = None
                    sent = body if body is None and not left else {**(body or {}), **left}
                    asked_at = anyio.current_time()
                    try:
                        return await self._requests.ask(method, path, sent, link=link)
                    except Unreached as failure:
                        if is_write and failure.may_be_done:
                            raise self._unknown(awaited, failure) from failure.error.__cause__
                        now = anyio.current_time()
                        if now - asked_at > link_task.LINK_TIMEOUT:  # it had been reached
                            failing_since = now
                        failing_since = min(failing_since, now)
                        if now - failing_since >= link_task.LINK_TIMEOUT:
                            raise failure.error from failure.error.__cause__
                        await anyio.sleep(link_task.BACKOFF_MIN)
            finally:
                self._scopes.discard(scope)
        self.check_open()
        raise NoReply(awaited, attempts=0, waited=anyio.current_time() - began)

    async def reached(self) -> None:
        """Wait until the service has been reached.

        Raises:
            ParamClientError: why it cannot be.
        """
        while self.is_away:
            if self.failed is not None:
                raise self.failed
            await self.news.wait()

    def check_open(self) -> None:
        """See that calls can be made.

        Raises:
            LinkError: why not.
        """
        if (error := self.ended or self.broken) is not None:
            raise error.with_traceback(None)
        if not self._was_there:
            name = self._requests.name
            raise ClientClosed("the client is not open; use it as `async with`", link=name)

    def end(self, error: LinkError) -> None:
        """No call can be answered any more."""
        self.ended = error
        self._fail_calls()

    def tell(self) -> None:
        """There is news for those who wait for `news`."""
        news, self.news = self.news, anyio.Event()
        news.set()

    async def _listen(self) -> None:
        """Take events until there are no more.

        Raises:
            Unreached, ParamClientError: why.
        """
        async with self._requests.events(self.place) as batches:
            async for events in batches:
                for event in events:
                    self._take(event)
                if events:
                    self.tell()

    def _take(self, event: Mapping[str, Any]) -> None:
        with understood(self._requests.name):
            self.place = Place(str(event["run"]), int(event["seq"]))
            if event["type"] == "hello":
                self._arrive(is_resumed=bool(event["resumed"]))
            elif event["type"] == "gap":
                self._follower.begin_anew()
            else:
                self._follower.take(event)

    def _arrive(self, *, is_resumed: bool) -> None:
        if self._was_there:
            logger.info("%s: reached again", self._requests.name)
        if is_resumed and self._was_there:
            self._follower.resume()
        else:
            self._follower.begin_anew()
        self._was_there = True
        self.is_away = False
        self.broken = None

    async def _wait_to_try_again(self, error: ParamClientError) -> None:
        """After it was lost, or could not be reached again."""
        now = anyio.current_time()
        if not self.is_away:
            logger.warning("%s; trying to reach it again", error)
            self.is_away = True
            self._patience_ends = now + link_task.LINK_TIMEOUT
            self._backoff = link_task.BACKOFF_MIN
            self._follower.leave()
            self.tell()
        elif now >= self._patience_ends:
            name = self._requests.name
            self.broken = error if isinstance(error, LinkError) else LinkError(str(error), link=name)
            self._fail_calls()
        patience = self._patience_ends - now
        await anyio.sleep(min(self._backoff, patience) if patience > 0 else self._backoff)
        self._backoff = min(self._backoff * 2, link_task.BACKOFF_MAX)

    async def _is_reached(self, deadline: float) -> bool:
        """Wait until it is; false when the time is over."""
        while self.is_away:
            self.check_open()
            with anyio.move_on_after(deadline - anyio.current_time()) as waiting:
                await self.news.wait()
            if waiting.cancelled_caught:
                return False
        self.check_open()
        return True

    def _unknown(self, what: str, failure: Unreached) -> LinkError:
        return LinkError(f"{failure.error}; whether {what} was done is not known", link=self._requests.name)

    def _fail_calls(self) -> None:
        for scope in self._scopes:
            scope.cancel()
        self.tell()


async def telling(work: Callable[[], Awaitable[T]], tell: Callable[[], None] | None) -> T:
    """Do this, and meanwhile call `tell` from this task about ten times a second, and once at the end."""
    if tell is None:
        return await work()
    done = anyio.Event()
    results: list[T] = []
    failures: list[Exception] = []

    async def run() -> None:
        try:
            results.append(await work())
        except Exception as error:  # raised in here, it would come out in a group
            failures.append(error)
        done.set()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        try:
            while not done.is_set():
                with anyio.move_on_after(PROGRESS_INTERVAL):
                    await done.wait()
                if not failures:
                    tell()
        except Exception as error:
            failures.append(error)
            tasks.cancel_scope.cancel()
    if failures:
        raise failures[0]
    return results[0]
