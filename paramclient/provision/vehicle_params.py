"""Parameters of a vehicle or of the cache as a `ParamSet`, to compare, save or write them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

from paramclient.errors import NotInCache, UsageError, VehicleError
from paramclient.model.comparison import defaults_of, non_defaults
from paramclient.model.defaults import add_defaults
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param
from paramclient.model.wording import first_of

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent, ParamCache
    from paramclient.client.component import Component
    from paramclient.protocol.fetch import FetchResult, Progress

__all__ = [
    "NAMES_SHOWN_MAX",
    "NO_DEFAULTS",
    "FetchedSet",
    "set_maker",
    "load_cached_set",
    "collect_defaults",
    "select_non_defaults",
    "incomplete_error",
    "cached_param_set",
    "collect_set",
    "fetch_set",
]

NAMES_SHOWN_MAX: Final = 20
"""Parameters that a message names, so that it stays readable; it gives the number of further ones."""
NO_DEFAULTS: Final = (
    "the firmware's defaults are not known, so the parameters that differ from them cannot be found: they "
    "come with the parameter file over MAVFTP, which ArduPilot and PX4 from 1.18 on serve, or with the "
    "metadata of the firmware"
)
"""The message for a request that needs the firmware's defaults when no parameter has one."""


@dataclass(frozen=True, slots=True)
class FetchedSet:
    """The parameters of a fetched table that were received or confirmed in this session.

    Attributes:
        set: the parameters as a set.
        params: the same parameters as `Param` objects of the table.
        missing: the names (or `index 12`) of parameters that were not received.
    """

    set: ParamSet
    params: Sequence[Param]
    missing: Sequence[str]


def set_maker(component: Component, source: str) -> Callable[[Iterable[Param]], ParamSet]:
    """Return a function that turns parameters of a component into a set.

    The set has the identity and the time of this call. The function may be called in a worker thread.

    Args:
        component: the component.
        source: the origin of the set, in words.
    """
    return partial(
        ParamSet.of,
        component=component.component,
        system=component.system,
        identity=component.identity,
        at=time.time(),
        source=source,
        is_extended=component.is_extended,
    )


async def collect_set(
    component: Component,
    result: FetchResult,
    *,
    source: str,
) -> FetchedSet:
    """Return the parameters of a fetched table as a set, without values that are only cached.

    Args:
        component: the component.
        result: the result of its fetch.
        source: the origin of the set, in words; a doubt of the encoding is added.

    Raises:
        LinkError: the link failed.
    """
    if doubt := component.session.encoding_doubt:
        source = f"{source} ({doubt})"
    cached = set(result.cached)
    known = [param for name, param in result.params.items() if name not in cached]
    indices = {name: result.params[name].index for name in cached}
    stale = {index: name for name, index in indices.items() if index is not None}
    missing = [stale.get(index, f"index {index}") for index in sorted({*result.missing, *stale})]
    return FetchedSet(set_maker(component, source)(known), known, missing)


async def fetch_set(
    component: Component,
    *,
    source: str,
    timeout: float | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> FetchedSet:
    """Fetch all parameters of a component and return them as a set.

    Args:
        component, source: as in `collect_set`.
        timeout, progress: as in `Component.fetch_all`.

    Raises:
        VehicleError: some parameters were not received; the message names them.
        ParamClientError: as from `Component.fetch_all`.
    """
    result = await component.fetch_all(timeout=timeout, progress=progress)
    found = await collect_set(component, result, source=source)
    if found.missing:
        raise incomplete_error(component, found.missing)
    return found


def incomplete_error(component: Component, missing: Sequence[str]) -> VehicleError:
    """Return the error for a component some of whose parameters were not received."""
    vehicle = f"{component.system}/{component.component} {component.autopilot}"
    names = first_of(missing, NAMES_SHOWN_MAX)
    was = "was" if len(missing) == 1 else "were"
    return VehicleError(
        f"{vehicle} on {component.identity.link} is incomplete: {names} {was} not received",
        system=component.system,
        component=component.component,
    )


def cached_param_set(table: CachedComponent, *, extended: bool = False) -> ParamSet:
    """Return a component's cached parameters as a set."""
    return ParamSet.of(
        table.params.values(),
        component=table.component,
        system=table.system,
        identity=table.identity,
        at=table.updated_at if table.synced_at is None else table.synced_at,
        source=f"cache {table.key}",
        is_extended=extended,
    )


def load_cached_set(cache: ParamCache, key: str, component: int, *, extended: bool = False) -> ParamSet:
    """Return the complete cached table of a component as a set.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.
        extended: its extended parameters.

    Raises:
        CacheError: the cache has no table of this component, or an incomplete one.
    """
    table = cache.load(key, component, extended=extended)
    if table is None:
        raise NotInCache(f"the cache has no table of component {component} of {key}")
    if not table.complete:
        vehicle = f"{table.system}/{component} ({key})"
        of = "" if table.count is None else f" of {table.count}"
        raise NotInCache(f"the cache has {table.size}{of} parameters of {vehicle}, not all; fetch them first")
    return cached_param_set(table, extended=extended)


def select_non_defaults(whole: ParamSet, described: Mapping[str, int | float]) -> ParamSet:
    """Return the parameters of a set that differ from the firmware's defaults.

    Args:
        whole: the set.
        described: defaults in the metadata by name, for parameters of the set without a default.

    Raises:
        UsageError: the defaults are not known, or no parameter differs.
    """
    known = add_defaults(whole, described)
    if not any(param.default is not None for param in known.values()):
        raise UsageError(NO_DEFAULTS)
    found = {name: whole[name] for name in non_defaults(known)}
    if not found:
        raise UsageError("no parameter differs from its default")
    return replace(whole, params=found)


def collect_defaults(sets: Sequence[ParamSet], described: Sequence[Mapping[str, int | float]]) -> ParamSet:
    """Return the firmware's defaults of the parameters of sets: a base for `compare`.

    Args:
        sets: the sets.
        described: defaults in the metadata of each set by name, for parameters without a default in the set.

    Raises:
        UsageError: the defaults are not known.
    """
    base = defaults_of(*(add_defaults(each, more) for each, more in zip(sets, described, strict=True)))
    if not base:
        raise UsageError(NO_DEFAULTS)
    given = {name for each in sets for name, param in each.items() if param.default is not None}
    if count := len(base.keys() - given):
        base = replace(base, source=f"{base.source}, {count} of {len(base)} from the metadata")
    return base
