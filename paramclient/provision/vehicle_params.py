"""Parameters taken down as a set, so that they can be compared, saved or set: of a vehicle, of the cache."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Final

from paramclient.errors import NoReply, NotInCache, UnknownVehicle, UsageError, VehicleError
from paramclient.model.params import copy_params
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, Trust
from paramclient.provision.runner import Runner, run_here
from paramclient.provision.set_up import BEFORE_APPLY

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent, ParamCache
    from paramclient.client.component import Component
    from paramclient.protocol.params.fetch_result import FetchResult, Progress

__all__ = [
    "NO_DEFAULTS",
    "Taken",
    "before_last_apply",
    "cached_set",
    "differing",
    "incomplete",
    "left_out_note",
    "set_of",
    "taken",
    "whole_set",
]

REFRESH_PATIENCE: Final = 10.0
"""Seconds for the values that no hash covers."""
MOST_NAMED: Final = 20
"""Missing parameters that are named to people."""
NO_DEFAULTS: Final = (
    "the firmware's defaults are not known, so nor is what differs from them: they come with the parameter "
    "file over MAVFTP, which ArduPilot and PX4 from 1.18 on serve"
)


@dataclass(frozen=True, slots=True)
class Taken:
    """What of a fetched table was given or confirmed in this session.

    Attributes:
        set: the parameters.
        params: the same as the table has them.
        missing: the names (or `index 12`) of those that did not come.
    """

    set: ParamSet
    params: Sequence[Param]
    missing: Sequence[str]


async def taken(
    component: Component,
    result: FetchResult,
    *,
    source: str,
    timeout: float | None = None,
    run: Runner = run_here,
) -> Taken:
    """Take down what a fetch has brought.

    The values that no hash covers are waited for. Parameters that the vehicle does not list, and that are
    only last known, cannot be confirmed, and are left out.

    Args:
        component: the component.
        result: what its fetch has brought.
        source: where it comes from, in words.
        timeout: seconds for the values that no hash covers, `REFRESH_PATIENCE` at most; what has not come
            then is missing.
        run: runs what takes long for a large table.

    Raises:
        LinkError: the link failed.
    """
    with suppress(NoReply):  # what was not read afresh is missing below
        await component.refreshed(timeout=min(REFRESH_PATIENCE, math.inf if timeout is None else timeout))
    table = copy_params(component.params)
    system, number, identity, at = component.system, component.component, component.identity, time.time()

    def take() -> Taken:
        params = list(table.values())
        known = [param for param in params if param.trust is not Trust.CACHED]
        stale = {
            param.index: param.name
            for param in params
            if param.trust is Trust.CACHED and param.index is not None
        }
        missing = [stale.get(index, f"index {index}") for index in sorted({*result.missing, *stale})]
        found = ParamSet.of(known, component=number, system=system, identity=identity, at=at, source=source)
        return Taken(found, known, missing)

    return await run(take)


async def whole_set(
    component: Component,
    *,
    source: str,
    timeout: float | None = None,
    progress: Callable[[Progress], None] | None = None,
    run: Runner = run_here,
) -> Taken:
    """Bring a component's table up to date and take all of it down.

    Args:
        component, source, run: as in `taken`.
        timeout, progress: as in `Component.fetch_all`.

    Raises:
        VehicleError: some parameters did not come; the text names them.
        ParamClientError: as from `Component.fetch_all`.
    """
    result = await component.fetch_all(timeout=timeout, progress=progress)
    found = await taken(component, result, source=source, run=run)
    if found.missing:
        raise incomplete(component, found.missing)
    return found


def incomplete(component: Component, missing: Sequence[str]) -> VehicleError:
    """What says that some parameters did not come."""
    shown = ", ".join(islice(missing, MOST_NAMED))
    more = len(missing) - MOST_NAMED
    who = f"{component.system}/{component.component} {component.autopilot}"
    rest = f" and {more} more" if more > 0 else ""
    return VehicleError(
        f"{who} on {component.identity.link} is incomplete: {shown}{rest} did not come",
        system=component.system,
        component=component.component,
    )


def set_of(table: CachedComponent) -> ParamSet:
    """What the cache has of a component."""
    return ParamSet.of(
        table.params.values(),
        component=table.component,
        system=table.system,
        identity=table.identity,
        at=table.updated_at if table.synced_at is None else table.synced_at,
        source=f"cache {table.key}",
    )


def cached_set(
    cache: ParamCache, key: str, component: int, *, note: Callable[[str], None] | None = None
) -> ParamSet:
    """All that the cache has of a component.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.
        note: is told of names that are left out, in a sentence.

    Raises:
        CacheError: it has no such table, or not all of it.
    """
    table = cache.load(key, component)
    if table is None:
        raise NotInCache(f"the cache has no table of component {component} of {key}")
    if not table.complete:
        who = f"{table.system}/{component} ({key})"
        of = "" if table.count is None else f" of {table.count}"
        raise NotInCache(f"the cache has {table.size}{of} parameters of {who}, not all; fetch them first")
    if table.left_out and note is not None:
        note(left_out_note(table))
    return set_of(table)


def left_out_note(table: CachedComponent) -> str:
    """Return what says that names of a cached table are left out."""
    shown = ", ".join(map(repr, table.left_out[:MOST_NAMED]))
    more = len(table.left_out) - MOST_NAMED
    rest = f" and {more} more" if more > 0 else ""
    return (
        f"{table.system}/{table.component} ({table.key}): left out, as no parameter file can hold the name: "
        f"{shown}{rest}; the next full fetch takes it out of the cache"
    )


def before_last_apply(cache: ParamCache, key: str, component: int) -> ParamSet:
    """The state of a component before anything was last applied to it.

    Raises:
        CacheError: nothing is known of that.
    """
    try:
        kept = [each for each in cache.snapshots(key, component) if each.reason == BEFORE_APPLY]
    except UnknownVehicle:
        kept = []
    if not kept:
        raise NotInCache(f"the cache knows of no apply to {key}; name the moment whose state is to come back")
    return cache.state_at(key, component, kept[-1].id)


def differing(whole: ParamSet, params: Iterable[Param]) -> ParamSet:
    """Of a set, what differs from the firmware's defaults.

    Args:
        whole: the set.
        params: the same parameters as their table has them.

    Raises:
        UsageError: the defaults are not known, or nothing differs.
    """
    if not any(param.default is not None for param in whole.values()):
        raise UsageError(NO_DEFAULTS)
    names = [param.name for param in params if param.is_changed]
    if not names:
        raise UsageError("no parameter differs from its default")
    return replace(whole, params={name: whole[name] for name in names})
