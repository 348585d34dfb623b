"""LinkExtParams: the implementation of `ExtParams` over a link of this process."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Final

import anyio

from paramclient.cache import ParamCache, SnapshotSummary
from paramclient.client.arguments import PROGRESS_CALL_INTERVAL, check_portable_name, check_requested_name
from paramclient.client.batch_wait import wait_for_batch
from paramclient.client.extended_params import ExtChanges
from paramclient.client.local import LocalComponent, LocalExtParams, wait_until_identified
from paramclient.errors import (
    CacheError,
    NoReply,
    NotDurable,
    NotInCache,
    ParamClientError,
    UnknownVehicle,
    UsageError,
)
from paramclient.model.ext_params import ExtParam, ExtSettable, check_ext_value
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.fetch import ExtFetch, ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.params.change_origin import check_author
from paramclient.protocol.params.fetch_result import Policy, Progress

__all__ = ["LinkExtParams"]

EXT_IDENTITY_TIMEOUT: Final = 10.0
"""Seconds to wait for the identity of a vehicle: longer than all attempts to request it."""
EXT_TIMEOUT_NOTE = "The fetch of extended parameters ended at its timeout."
"""Note of a partial result that a timeout ended."""


class LinkExtParams(LocalExtParams):
    """The extended parameters of a component on a link of this process. See `ExtParams` for the calls.

    Args:
        component: the component.
    """

    def __init__(self, component: LocalComponent) -> None:
        self._component = component
        self._machine = component.machine
        self._subscriptions: weakref.WeakSet[ExtChanges] = weakref.WeakSet()
        self.params = MappingProxyType(component.machine.ext.table.params)

    def __repr__(self) -> str:
        machine = self._machine
        of = "" if self.count is None or self.is_complete else f" of {self.count}"
        return f"<ExtParams {machine.system}/{machine.component} {len(self.params)}{of} extended params>"

    @property
    def count(self) -> int | None:
        """See `ExtParams.count`."""
        return self._machine.ext.table.count

    @property
    def is_spoken(self) -> bool:
        """See `ExtParams.is_spoken`."""
        return self._machine.ext.is_spoken

    @property
    def is_expected(self) -> bool:
        """See `ExtParams.is_expected`."""
        return self._machine.expects_extended

    @property
    def is_complete(self) -> bool:
        """See `ExtParams.is_complete`."""
        return self._machine.ext.table.complete

    async def get(self, name: str | int, *, timeout: float | None = None) -> ExtParam:
        """See `ExtParams.get`."""
        check_requested_name(name)
        machine = self._machine
        self._component.client.check_open()
        read = machine.read_ext(name, anyio.current_time())
        what = f"{name if isinstance(name, str) else f'extended parameter {name}'} of {self._whose}"
        try:
            message = await self._component.wait(read, timeout, lambda: (what, read.attempts))
        finally:
            machine.ext.reads.release(read)
        known = machine.ext.table.params.get(message.param_id)
        if known is None or (isinstance(name, int) and known.index != name):
            return ExtParam.of(message.param_id, message.raw, message.param_type)
        return known

    async def set(
        self,
        name: str,
        value: ExtSettable,
        *,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetResult:
        """See `ExtParams.set`."""
        machine = self._machine
        check_portable_name(name)
        checked = check_ext_value(value)
        self._component.client.check_open()
        machine.check_uncontested()
        if durable:
            await self._component.wait_until_kept()
        write = machine.write_ext(name, checked, anyio.current_time(), check_author(author))
        what = f"PARAM_EXT_SET {name} to {self._whose}"
        try:
            result = await self._component.wait(write, timeout, lambda: (what, write.attempts))
        finally:
            machine.ext.writes.cancel(write, anyio.current_time())
        if durable:
            await self._component.write_durably([name])
        return result

    async def set_many(
        self,
        values: Mapping[str, ExtSettable] | Iterable[tuple[str, ExtSettable]],
        *,
        progress: Callable[[ExtSetOutcome], None] | None = None,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetManyResult:
        """See `ExtParams.set_many`."""
        given = values.items() if isinstance(values, Mapping) else values
        pairs = [(check_portable_name(name), check_ext_value(value)) for name, value in given]
        machine = self._machine
        self._component.client.check_open()
        machine.check_uncontested()
        if durable:
            await self._component.wait_until_kept()
        began = anyio.current_time()
        batch = machine.write_many_ext(pairs, began, check_author(author))
        try:
            self._component.wake()
            outcomes = await wait_for_batch(
                batch,
                timeout,
                progress,
                lambda names: f"PARAM_EXT_SET {', '.join(names)} to {self._whose}",
            )
        finally:
            machine.ext.batches.end(batch, anyio.current_time())
        failure = batch.failure
        if durable and (done := [outcome.name for outcome in outcomes if outcome.is_set]):
            try:
                await self._component.write_durably(done)
            except NotDurable as error:
                failure = failure or error
                outcomes = tuple(replace(each, error=error) if each.is_set else each for each in outcomes)
        elapsed = anyio.current_time() - began
        return ExtSetManyResult(machine.system, machine.component, outcomes, failure, elapsed)

    async def fetch_all(
        self,
        *,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> ExtFetchResult:
        """See `ExtParams.fetch_all`."""
        component, machine = self._component, self._machine
        component.client.check_open()
        began = anyio.current_time()
        deadline = None if timeout is None else began + timeout
        station = component.client.station
        if station.policy is not Policy.AUTO and not station.listens_only:
            return self._known(station.policy)
        fetch = machine.begin_ext_fetch(anyio.current_time())
        try:
            return await self._wait_for_fetch(fetch, deadline, progress)
        finally:
            machine.ext.fetches.end(fetch)
            component.wake()

    async def store_snapshot(self, *, reason: str) -> int | None:
        """See `ExtParams.store_snapshot`."""
        client = self._component.client
        client.check_open()
        cache = client.cache
        if cache is None:
            return None
        if not self.params:
            raise UsageError(f"no extended parameter of {self._whose} is known; fetch them first")
        identity = await self._written_identity()
        params, number = ExtParamSet(dict(self.params)), self._machine.component
        store = partial(cache.store_ext_snapshot, identity, number, params, reason=reason)
        return (await client.cache_writer.run_in_thread(partial(store, complete=self.is_complete))).id

    async def snapshots(self) -> list[SnapshotSummary]:
        """See `ExtParams.snapshots`."""
        cache = self._require_cache()
        key, number = (await self._written_identity()).key, self._machine.component

        def read() -> list[SnapshotSummary]:
            try:
                return cache.ext_snapshots(key, number)
            except UnknownVehicle:  # no vehicle that was named, but one on the link
                return []

        return await self._component.client.cache_writer.run_in_thread(read)

    async def load_state(self, when: float) -> ExtParamSet:
        """See `ExtParams.load_state`."""
        cache = self._require_cache()
        key, number = (await self._written_identity()).key, self._machine.component

        def read() -> ExtParamSet:
            try:
                return cache.ext_state_at(key, number, when)
            except UnknownVehicle:  # no vehicle that was named, but one on the link
                what = f"the cache {cache.place} has no earlier state of {key}, component {number}"
                raise NotInCache(what) from None

        return await self._component.client.cache_writer.run_in_thread(read)

    def changes(self) -> ExtChanges:
        """See `ExtParams.changes`."""
        self.listen(changes := ExtChanges())
        return changes

    def listen(self, changes: ExtChanges) -> None:
        """See `LocalExtParams.listen`."""
        self._subscriptions.add(changes)
        client = self._component.client
        if client.is_over:
            changes.end(client.link_task.ended)

    def ignore(self, changes: ExtChanges) -> None:
        """See `LocalExtParams.ignore`."""
        self._subscriptions.discard(changes)

    # called by the component

    def take_change(self, change: ExtChange) -> None:
        """Push a change to all streams."""
        for changes in list(self._subscriptions):
            changes.push(change)

    def end(self, error: ParamClientError | None) -> None:
        """End all streams: with this error, or with None at the end of a log."""
        for changes in list(self._subscriptions):
            changes.end(error)

    def _require_cache(self) -> ParamCache:
        self._component.client.check_open()
        cache = self._component.client.cache
        if cache is None:
            raise UsageError("earlier states are in the cache, and the client has none; open it with a cache")
        return cache

    async def _written_identity(self) -> Identity:
        """Return the identity of the vehicle, after all received values are in the cache."""
        await wait_until_identified(self._component, EXT_IDENTITY_TIMEOUT)
        await self._component.client.cache_writer.write_all()
        return self._component.identity

    @property
    def _whose(self) -> str:
        return f"{self._machine.system}/{self._machine.component}"

    def _known(self, policy: Policy) -> ExtFetchResult:
        """Return the known table where the policy allows no download."""
        if not self.params:
            raise CacheError(
                f"no extended parameter of {self._whose} is known, and the policy is {policy}: nothing may be"
                " downloaded"
            )
        machine = self._machine
        params = dict(self.params)
        return ExtFetchResult(machine.system, machine.component, params, self.count, (), "cache", 0.0)

    async def _wait_for_fetch(
        self, fetch: ExtFetch, deadline: float | None, progress: Callable[[Progress], None] | None
    ) -> ExtFetchResult:
        """Wait until a fetch ends, or return its partial result at the deadline."""
        fetches = self._machine.ext.fetches
        ended = anyio.Event()
        fetch.on_done.append(ended.set)
        self._component.wake()
        try:
            while not fetch.done:
                now = anyio.current_time()
                if deadline is not None and now >= deadline:
                    if not fetch.has_begun:
                        what = f"extended parameters of {self._whose}"
                        attempts = fetch.request.count
                        raise NoReply(what, attempts=attempts, waited=now - fetch.begun_at)
                    return fetches.partial(fetch, now, EXT_TIMEOUT_NOTE)
                until = now + PROGRESS_CALL_INTERVAL if progress is not None else None
                if deadline is not None:
                    until = deadline if until is None else min(until, deadline)
                with anyio.move_on_after(None if until is None else until - now):
                    await ended.wait()
                if progress is not None:
                    progress(fetches.progress(fetch, anyio.current_time()))
        finally:
            with suppress(ValueError):
                fetch.on_done.remove(ended.set)
        if fetch.error is not None:
            raise fetch.error
        assert fetch.result is not None
        return fetch.result
