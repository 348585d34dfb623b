"""Parameters of a vehicle or of the cache as a `ParamSet`, to compare, save or write them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from paramclient.errors import NotInCache, UsageError, VehicleError
from paramclient.model.comparison import defaults_of, non_defaults
from paramclient.model.defaults import add_defaults
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param
from paramclient.model.wording import first_of

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent
    from paramclient.client.component import Component
    from paramclient.protocol.fetch import FetchResult

__all__ = [
    "NAMES_SHOWN_MAX",
    "NO_DEFAULTS",
    "cached_set",
    "collect_defaults",
    "component_set",
    "fetched_set",
    "select_non_defaults",
]

NAMES_SHOWN_MAX: Final = 20
"""Parameters that a message names, so that it stays readable; it gives the number of further ones."""
NO_DEFAULTS: Final = (
    "the firmware's defaults are not known, so the parameters that differ from them cannot be found: they "
    "come with the parameter file over MAVFTP, which ArduPilot and PX4 from 1.18 on serve, or with the "
    "metadata of the firmware"
)
"""The message for a request that needs the firmware's defaults when no parameter has one."""


def component_set(component: Component, params: Iterable[Param], source: str) -> ParamSet:
    """Return parameters of a component as a set of this moment; `source` is their origin in words."""
    return ParamSet(
        {param.name: param for param in params},
        component=component.component,
        system=component.system,
        identity=component.identity,
        at=time.time(),
        source=source,
        is_extended=component.is_extended,
    )


def fetched_set(component: Component, result: FetchResult, *, source: str, partial: bool = False) -> ParamSet:
    """Return a fetched table as a set, without values that are only cached.

    Args:
        component: the component.
        result: the result of its fetch.
        source: the origin of the set, in words; a doubt of the encoding, and with `partial` the missing
            parameters, are added.
        partial: whether some parameters may be missing.

    Raises:
        VehicleError: some parameters were not received; the message names them.
    """
    if doubt := component.session.encoding_doubt:
        source = f"{source} ({doubt})"
    cached = {result.params[name].index: name for name in result.cached}
    indices = sorted({*result.missing, *(index for index in cached if index is not None)})
    missing = [cached.get(index, f"index {index}") for index in indices]
    if missing and not partial:
        vehicle = f"{component.system}/{component.component} {component.autopilot}"
        was = f"{first_of(missing, NAMES_SHOWN_MAX)} {'was' if len(missing) == 1 else 'were'} not received"
        raise VehicleError(
            f"{vehicle} on {component.identity.link} is incomplete: {was}",
            system=component.system,
            component=component.component,
        )
    left_out = [*missing, *map(repr, sorted(component.session.table.left_out))]
    if left_out:
        source = f"{source}, without {first_of(left_out, NAMES_SHOWN_MAX)}"
    known = result.params.keys() - set(result.cached)
    return component_set(component, (each for name, each in result.params.items() if name in known), source)


def cached_set(table: CachedComponent, *, extended: bool = False, partial: bool = False) -> ParamSet:
    """Return a component's cached parameters as a set.

    Raises:
        NotInCache: the cache has not all of them, and `partial` is false.
    """
    source = f"cache {table.key}"
    if not table.complete:
        of = "" if table.count is None else f" of {table.count}"
        are = f"{table.size}{of} parameters are in the cache"
        source = f"{source}: {are}"
        if not partial:
            raise NotInCache(f"{table.system}/{table.component} is incomplete: {are}")
    return ParamSet(
        table.params,
        component=table.component,
        system=table.system,
        identity=table.identity,
        at=table.updated_at if table.synced_at is None else table.synced_at,
        source=source,
        is_extended=extended,
    )


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
