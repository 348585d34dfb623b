"""ExtParams: the extended parameters of one component, and their calls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Final

import anyio

from paramclient.cache import ParamCache, SnapshotSummary
from paramclient.client.arguments import check_portable_name, check_requested_name
from paramclient.client.batch_wait import wait_for_batch
from paramclient.client.component_core import ComponentCore
from paramclient.client.subscription import ExtChanges
from paramclient.errors import (
    CacheError,
    NoReply,
    NotDurable,
    NotInCache,
    UnknownVehicle,
    UsageError,
)
from paramclient.model.ext_params import ExtParam, ExtSettable, check_ext_value
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.protocol.ext.fetch import ExtFetch, ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.params.change_origin import check_author
from paramclient.protocol.params.fetch_result import Policy, Progress

__all__ = ["ExtParams"]

EXT_IDENTITY_TIMEOUT: Final = 10.0
"""Seconds to wait for the identity of a vehicle: longer than all attempts to request it."""
EXT_TIMEOUT_NOTE = "The fetch of extended parameters ended at its timeout."
"""Note of a partial result that a timeout ended."""


class ExtParams:
    """The extended parameters of a component (PARAM_EXT_*); see `Component.ext`.

    Cameras, gimbals and companion computers have them: values of up to 128 bytes, with text and 64-bit types.
    A component may have plain parameters as well; the two tables are separate, and one name may be in both.

    Cancellation, lost components and reconnection are handled as in `Component`.

    Attributes:
        params: the known parameters by name. The mapping is read-only and follows the received messages.
    """

    def __init__(self, core: ComponentCore) -> None:
        self._core = core
        self._machine = core.machine
        self.params: Mapping[str, ExtParam] = MappingProxyType(core.machine.ext.table.params)

    def __repr__(self) -> str:
        machine = self._machine
        of = "" if self.count is None or self.is_complete else f" of {self.count}"
        return f"<ExtParams {machine.system}/{machine.component} {len(self.params)}{of} extended params>"

    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_EXT_VALUE."""
        return self._machine.ext.table.count

    @property
    def is_spoken(self) -> bool:
        """Whether the component has sent an extended parameter."""
        return self._machine.ext.is_spoken

    @property
    def is_expected(self) -> bool:
        """Whether the component has sent an extended parameter, or is of a kind that usually has them.

        Cameras, gimbals, winches, illuminators and grippers, by MAV_TYPE or component id.
        """
        return self._machine.expects_extended

    @property
    def is_complete(self) -> bool:
        """Whether `params` has a parameter for every index below `count`."""
        return self._machine.ext.table.complete

    async def get(self, name: str | int, *, timeout: float | None = None) -> ExtParam:
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
        check_requested_name(name)
        machine = self._machine
        self._core.client.check_open()
        read = machine.read_ext(name, anyio.current_time())
        what = f"{name if isinstance(name, str) else f'extended parameter {name}'} of {self._core.label}"
        try:
            message = await self._core.wait(read, timeout, lambda: (what, read.attempts))
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
        """Write one parameter with PARAM_EXT_SET; return when the component has acknowledged the value.

        An unknown type is read from the component first. While the component reports progress, the call
        continues to wait. Writes to one name run in the order of the calls, writes to different names in
        parallel. After cancellation it is unknown whether the component has the value.

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
        machine = self._machine
        check_portable_name(name)
        checked = check_ext_value(value)
        self._core.client.check_open()
        machine.check_uncontested()
        if durable:
            await self._core.wait_until_kept()
        write = machine.write_ext(name, checked, anyio.current_time(), check_author(author))
        what = f"PARAM_EXT_SET {name} to {self._core.label}"
        try:
            result = await self._core.wait(write, timeout, lambda: (what, write.attempts))
        finally:
            machine.ext.writes.cancel(write, anyio.current_time())
        if durable:
            await self._core.write_durably([name])
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
        """Write many parameters in one call, each as `set` does.

        Several writes are in flight at a time. A value that is refused does not stop the others. If the
        component is lost, the link fails, three writes in a row get no response or the timeout expires, the
        call returns the outcomes so far, and `error` of the result is the cause.

        Args:
            values: values by name, or pairs of name and value; a name may occur in several pairs.
            progress: called with each outcome in the order of their arrival, from this task.
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
        given = values.items() if isinstance(values, Mapping) else values
        pairs = [(check_portable_name(name), check_ext_value(value)) for name, value in given]
        machine = self._machine
        self._core.client.check_open()
        machine.check_uncontested()
        if durable:
            await self._core.wait_until_kept()
        began = anyio.current_time()
        batch = machine.write_many_ext(pairs, began, check_author(author))
        try:
            self._core.client.wake()
            outcomes = await wait_for_batch(
                batch,
                timeout,
                progress,
                lambda names: f"PARAM_EXT_SET {', '.join(names)} to {self._core.label}",
            )
        finally:
            machine.ext.batches.end(batch, anyio.current_time())
        failure = batch.failure
        if durable and (done := [outcome.name for outcome in outcomes if outcome.is_set]):
            try:
                await self._core.write_durably(done)
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
        """Download all parameters with PARAM_EXT_REQUEST_LIST, and read the values that the list lacks.

        The protocol has no hash, so a cached table cannot be confirmed without a download. A client whose
        policy allows no download returns the known table.

        Concurrent calls share one fetch. Cancellation keeps the received values in the table.

        Args:
            timeout: seconds after which the partial table is returned with `missing`; None: no limit.
            progress: called about ten times a second, from this task.

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
        client, machine = self._core.client, self._machine
        client.check_open()
        began = anyio.current_time()
        deadline = None if timeout is None else began + timeout
        station = client.station
        if station.policy is not Policy.AUTO and not station.listens_only:
            return self._known(station.policy)
        fetch = machine.begin_ext_fetch(anyio.current_time())
        try:
            return await self._wait_for_fetch(fetch, deadline, progress)
        finally:
            machine.ext.fetches.end(fetch)
            client.wake()

    async def store_snapshot(self, *, reason: str) -> int | None:
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
        client = self._core.client
        client.check_open()
        cache = client.cache
        if cache is None:
            return None
        if not self.params:
            raise UsageError(f"no extended parameter of {self._core.label} is known; fetch them first")
        identity = await self._written_identity()
        params, number = ExtParamSet(dict(self.params)), self._machine.component
        store = partial(cache.store_snapshot, identity, number, params, reason=reason)
        return (await client.cache_writer.run_in_thread(partial(store, complete=self.is_complete))).id

    async def snapshots(self) -> list[SnapshotSummary]:
        """Return the snapshots of the component's extended parameters, the newest last.

        Raises:
            UsageError: there is no cache.
            CacheError: the cache cannot be read.
            LinkError: the client was closed.
        """
        cache = self._require_cache()
        key, number = (await self._written_identity()).key, self._machine.component

        def read() -> list[SnapshotSummary]:
            try:
                return cache.snapshots(key, number, extended=True)
            except UnknownVehicle:  # no vehicle that was named, but one on the link
                return []

        return await self._core.client.cache_writer.run_in_thread(read)

    async def load_state(self, when: float) -> ExtParamSet:
        """Return an earlier state of the parameters, from the cache.

        Args:
            when: a float is a time, in unix seconds; an int is the number of a snapshot. See
                `ParamCache.ext_state_at`.

        Raises:
            UsageError: there is no cache, or the time is not in unix seconds.
            CacheError: there is no such state, or the cache cannot be read.
            LinkError: the client was closed.
        """
        cache = self._require_cache()
        key, number = (await self._written_identity()).key, self._machine.component

        def read() -> ExtParamSet:
            try:
                return cache.ext_state_at(key, number, when)
            except UnknownVehicle:  # no vehicle that was named, but one on the link
                what = f"the cache {cache.place} has no earlier state of {key}, component {number}"
                raise NotInCache(what) from None

        return await self._core.client.cache_writer.run_in_thread(read)

    def changes(self) -> ExtChanges:
        """Return a stream of changes from now on, like `Component.changes`.

        Raises:
            LinkError: while iterating, after the queued changes: the link failed permanently, or the client
                was closed.
            NoReply: while iterating: the component was lost and is no longer followed.
        """
        self._core.ext_changes.add(changes := ExtChanges())
        return changes

    def _require_cache(self) -> ParamCache:
        self._core.client.check_open()
        cache = self._core.client.cache
        if cache is None:
            raise UsageError("earlier states are in the cache, and the client has none; open it with a cache")
        return cache

    async def _written_identity(self) -> Identity:
        """Return the identity of the vehicle, after all received values are in the cache."""
        await self._core.wait_until_identified(EXT_IDENTITY_TIMEOUT)
        await self._core.client.cache_writer.write_all()
        return self._core.settled_identity or self._machine.identity

    def _known(self, policy: Policy) -> ExtFetchResult:
        """Return the known table where the policy allows no download."""
        if not self.params:
            raise CacheError(
                f"no extended parameter of {self._core.label} is known, and the policy is {policy}: nothing"
                " may be downloaded"
            )
        machine = self._machine
        params = dict(self.params)
        return ExtFetchResult(machine.system, machine.component, params, self.count, (), "cache", 0.0)

    async def _wait_for_fetch(
        self, fetch: ExtFetch, deadline: float | None, progress: Callable[[Progress], None] | None
    ) -> ExtFetchResult:
        """Wait until a fetch ends, or return its partial result at the deadline."""
        fetches = self._machine.ext.fetches
        report = None if progress is None else lambda: progress(fetches.progress(fetch, anyio.current_time()))
        await self._core.until_done(fetch, deadline, report)
        if not fetch.done:
            now = anyio.current_time()
            if not fetch.has_begun:
                what = f"extended parameters of {self._core.label}"
                raise NoReply(what, attempts=fetch.request.count, waited=now - fetch.begun_at)
            return fetches.partial(fetch, now, EXT_TIMEOUT_NOTE)
        if fetch.error is not None:
            raise fetch.error
        assert fetch.result is not None
        return fetch.result
