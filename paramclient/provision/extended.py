"""Extended parameters from a file or an earlier state: compare, write, verify, restore."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import anyio
import anyio.to_thread

from paramclient.client.component import Component
from paramclient.errors import NoReply, ParamClientError, UsageError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param
from paramclient.protocol.set_results import SetOutcome
from paramclient.provision.apply_restore import BEFORE_RESTORE
from paramclient.provision.callbacks import call_and_wait
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.restore_point import load_state_before_apply
from paramclient.provision.vehicle_params import BEFORE_APPLY, set_maker

__all__ = [
    "ExtApplyResult",
    "ExtPlan",
    "apply_extended",
    "load_extended_state",
    "restore_extended",
    "verify_extended",
]


@dataclass(frozen=True, slots=True)
class ExtPlan:
    """A comparison of wanted extended parameters with those of a component.

    Attributes:
        system, component: MAVLink ids of the component.
        wanted: the wanted parameters by name.
        current: the parameters of the component, downloaded for this comparison.
        changes: the wanted parameters whose value differs, in order.
        missing: wanted names that the component does not have.
        mistyped: wanted names that the component has in another type.
        elapsed: seconds of the download.
    """

    system: int
    component: int
    wanted: Mapping[str, WrittenParam]
    current: Mapping[str, Param]
    changes: Mapping[str, WrittenParam]
    missing: tuple[str, ...]
    mistyped: tuple[str, ...]
    elapsed: float

    @property
    def is_possible(self) -> bool:
        """Whether the component has every wanted name in the wanted type."""
        return not self.missing and not self.mistyped

    @property
    def is_met(self) -> bool:
        """Whether the component has all wanted values."""
        return self.is_possible and not self.changes


@dataclass(frozen=True, slots=True)
class ExtApplyResult:
    """The result of `apply_extended` or `restore_extended`.

    Attributes:
        plan: the comparison before the first write.
        outcomes: one for each written value, in order.
        before: the state before the first write.
        snapshot: number of the snapshot of `before` in the cache; None without a cache, or if nothing was to
            be written.
        current: the parameters that were downloaded after the writes; None if the download failed.
        error: why values were not written, or not verified; else None.
        elapsed: seconds.
    """

    plan: ExtPlan
    outcomes: tuple[SetOutcome, ...]
    before: ParamSet
    snapshot: int | None
    current: Mapping[str, Param] | None
    error: ParamClientError | None
    elapsed: float

    @property
    def different(self) -> tuple[str, ...]:
        """Names of `plan.changes` that do not have the wanted value, or of which this is unknown."""
        now = {} if self.current is None else self.current
        changes = self.plan.changes.items()
        return tuple(name for name, param in changes if name not in now or not param.is_held_by(now[name]))

    @property
    def complete(self) -> bool:
        """Whether the component has all wanted values, read back."""
        return self.error is None and self.plan.is_possible and not self.different


async def verify_extended(component: Component, wanted: ParamSet, *, timeout: float | None = None) -> ExtPlan:
    """Compare wanted extended parameters with those of a component, after a download. Writes nothing.

    Args:
        component: the component.
        wanted: the wanted parameters. Parameters that it does not have are ignored.
        timeout: seconds for the download; None: no limit.

    Raises:
        UsageError: the wanted parameters are of another component.
        NoReply: the table is not complete.
        ParamClientError: as from `Component.fetch_all`.
    """
    address = f"{component.system}/{component.component}"
    if wanted.component not in (None, component.component):
        whose = f"it has the parameters of component {wanted.component}, and {address} is chosen"
        raise UsageError(f"{wanted.source or 'wanted'}: {whose}")
    result = await component.ext.fetch_all(timeout=timeout)
    if not result.complete:
        raise NoReply(f"all extended parameters of {address}", attempts=0, waited=result.elapsed)
    now = dict(result.params)
    mistyped = tuple(
        name
        for name, each in wanted.params.items()
        if name in now and now[name].type_number != each.type_number
    )
    changes = {
        name: each
        for name, each in wanted.params.items()
        if name in now and name not in mistyped and not each.is_held_by(now[name])
    }
    missing = tuple(name for name in wanted.params if name not in now)
    ids = component.system, component.component
    return ExtPlan(*ids, wanted.params, now, changes, missing, mistyped, result.elapsed)


async def apply_extended(
    component: Component,
    wanted: ParamSet,
    *,
    durable: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[SetOutcome], None] | None = None,
    before_writing: Callable[[], object] | None = None,
) -> ExtApplyResult:
    """Write the wanted values that differ to a component, and verify them by another download.

    The state before is stored as a snapshot in the cache, and in the file `backup`. Names that the component
    does not have, or has in another type, are not written. Values are written in the order of the set. The
    component need not be disarmed.

    After the first write, a failure is not raised: `error` of the result holds it. Cancellation leaves the
    values that were written on the component.

    Args:
        component: the component.
        wanted: the wanted parameters.
        durable: return only when the values and their history are on the disk, see `Component.set`.
        backup: a file for the state before the first write, a JSON file.
        timeout: seconds for the whole call; None: no limit.
        author: the author of the changes, as in `Component.set`.
        progress: called with each outcome.
        before_writing: called once if there is something to write, and awaited if it is asynchronous, before
            the state is stored; its exceptions end the call.

    Raises:
        UsageError: as from `verify_extended`; or `durable` without a cache.
        FileError, CacheError: the state before the first write could not be stored.
        NoReply: the component did not answer before the first write.
        ParamClientError: as from `Component.fetch_all` and `Component.set_many`, before the first write.
    """
    return await _write(
        component,
        wanted,
        reason=BEFORE_APPLY,
        durable=durable,
        backup=backup,
        timeout=timeout,
        author=author,
        progress=progress,
        before_writing=before_writing,
    )


async def restore_extended(
    component: Component,
    state: ParamSet,
    *,
    durable: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[SetOutcome], None] | None = None,
    before_writing: Callable[[], object] | None = None,
) -> ExtApplyResult:
    """Restore an earlier state of a component: `apply_extended` with a snapshot *before restore*.

    Args:
        component: the component.
        state: its earlier state, of `load_extended_state` or a backup file.
        durable, backup, timeout, author, progress, before_writing: as in `apply_extended`.

    Raises:
        ParamClientError: as from `apply_extended`.
    """
    return await _write(
        component,
        state,
        reason=BEFORE_RESTORE,
        durable=durable,
        backup=backup,
        timeout=timeout,
        author=author,
        progress=progress,
        before_writing=before_writing,
    )


async def load_extended_state(component: Component, when: float | None = None) -> ParamSet:
    """Return an earlier state of the extended parameters of a component, from the cache.

    Args:
        component: the component.
        when: an int is the number of a snapshot, a float a time in unix seconds; None: the state before the
            last `apply_extended`, unless a restore ran since then.

    Raises:
        AlreadyRestored: a restore ran since that `apply_extended`, and `when` is None.
        CacheError: there is no such state, see `ParamCache.state_at`; or the cache cannot be read.
        UsageError: the client has no cache.
    """
    cache, key, number = component.core.cache, component.identity.key, component.component
    if cache is None:
        raise UsageError("the client keeps no cache")

    def load() -> ParamSet:
        if when is None:
            return load_state_before_apply(cache, key, number, extended=True)
        return cache.state_at(key, number, when, extended=True)

    await wait_for_identity(component)
    await component.core.cache_writer.write_all()
    return await component.core.cache_writer.run_in_thread(load)


async def _write(
    component: Component,
    wanted: ParamSet,
    *,
    reason: str,
    durable: bool,
    backup: str | os.PathLike[str] | None,
    timeout: float | None,
    author: str | None,
    progress: Callable[[SetOutcome], None] | None,
    before_writing: Callable[[], object] | None,
) -> ExtApplyResult:
    began = anyio.current_time()

    def left() -> float | None:
        return None if timeout is None else max(0.0, began + timeout - anyio.current_time())

    ext = component.ext
    await wait_for_identity(component)
    plan = await verify_extended(component, wanted, timeout=timeout)
    if plan.changes and before_writing is not None:
        await call_and_wait(before_writing)
    source = f"{component.system}/{component.component} {reason}"
    before = set_maker(component, source)(plan.current.values())
    if backup is not None:
        from paramclient.files.disk import write_extended_file

        await anyio.to_thread.run_sync(write_extended_file, backup, before)
    if not plan.changes:
        return ExtApplyResult(plan, (), before, None, plan.current, None, anyio.current_time() - began)
    cache = component.core.cache
    snapshot = None
    if cache is not None:
        await component.core.cache_writer.write_all()
        kept = await component.core.cache_writer.run_in_thread(
            lambda: cache.store_snapshot(
                component.identity, component.component, before, reason=reason, extended=True
            )
        )
        snapshot = kept.id
    values = {name: param.settable for name, param in plan.changes.items()}
    done = await ext.set_many(values, progress=progress, timeout=left(), durable=durable, author=author)
    current: Mapping[str, Param] | None = None
    error = done.error
    try:
        after = await ext.fetch_all(timeout=left())
        current = dict(after.params)
        if not after.complete:
            what = f"all extended parameters of {component.system}/{component.component}"
            error = error or NoReply(what, attempts=0, waited=after.elapsed)
    except ParamClientError as failure:
        error = error or failure
    elapsed = anyio.current_time() - began
    return ExtApplyResult(plan, done.outcomes, before, snapshot, current, error, elapsed)
