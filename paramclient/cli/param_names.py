"""Parameter names in arguments: patterns, upper and lower case, and suggestions for unknown names."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import anyio.to_thread

from paramclient.cache import ParamCache
from paramclient.cli.session import CommandSession
from paramclient.client.component import Component
from paramclient.errors import CacheError, ParamClientError, UnknownParameter, UsageError
from paramclient.model.identity import autopilot_name
from paramclient.model.names import NameChoice, did_you_mean, is_pattern, nearest_names
from paramclient.model.values import check_name

CACHED_TABLES_MAX: Final = 20
"""Tables of the cache whose names are suggested, those of the vehicles received last: few firmwares
differ."""
_CAPITALS: Final = ("px4", "ardupilot")
"""Autopilots whose parameters all have names in capitals."""


def choose_names(component: Component, given: Iterable[str]) -> tuple[list[str], dict[str, ParamClientError]]:
    """Choose among the known parameters of a component by names and patterns.

    Returns:
        The names in the vehicle's spelling, among them those that the vehicle may not have; and errors by
        pattern for the patterns without a match.
    """
    names: dict[str, None] = {}
    errors: dict[str, ParamClientError] = {}
    for text in given:
        if not is_pattern(text):
            names[spelling(text, component)] = None
            continue
        chosen, _ = NameChoice([text]).divide(component.params)
        names |= dict.fromkeys(sorted(chosen))
        if not chosen:
            system, number = component.address
            what = f"{system}/{number} has no parameter that matches {text}"
            errors[text] = UnknownParameter(what, system, number, name=text)
    return list(names), errors


def check_given(given: Iterable[str]) -> list[str]:
    """Return names and patterns without repetitions.

    Raises:
        UsageError: a name is not a valid param_id, or a pattern has other than printable ASCII characters.
    """
    chosen = list(dict.fromkeys(given))
    for text in chosen:
        if not is_pattern(text):
            check_name(text)
        elif not (text.isascii() and text.isprintable()):
            raise UsageError(f"pattern {text!r}: only printable ASCII characters are allowed")
    return chosen


async def suggest(
    session: CommandSession, errors: dict[str, ParamClientError]
) -> dict[str, ParamClientError]:
    """Return the errors with suggestions from the cache for names to which the vehicle has no similar one."""
    cache = session.client.cache
    lacking = {
        name: error
        for name, error in errors.items()
        if isinstance(error, UnknownParameter) and not (error.nearest or is_pattern(name))
    }
    if cache is None or not lacking:
        return errors
    known = await anyio.to_thread.run_sync(_cached_names, cache, session.component.autopilot)
    better: dict[str, ParamClientError] = {}
    for name, error in lacking.items():
        if nearest := nearest_names(name, known):
            system, component = error.system, error.component
            text = f"{system}/{component} has no {name}{did_you_mean(nearest)}"
            better[name] = UnknownParameter(text, system, component, name=name, nearest=nearest)
    return errors | better


def _cached_names(cache: ParamCache, autopilot: str | None = None) -> frozenset[str]:
    """Return the names of the parameters in the cache; none if the cache cannot be read.

    Args:
        cache: the cache.
        autopilot: only those of this autopilot; None for all.
    """
    names: set[str] = set()
    try:
        summaries = [
            each
            for each in cache.components()
            if autopilot in (None, autopilot_name(each.autopilot), autopilot_name(each.identity.autopilot))
        ]
        for each in summaries[:CACHED_TABLES_MAX]:
            table = cache.load(each.key, each.component)
            names.update(() if table is None else table.params)
    except CacheError:
        return frozenset()
    return frozenset(names)


def spelling(name: str, component: Component) -> str:
    """Return the vehicle's spelling of a name in upper or lower case.

    A name that fits several parameters in upper and lower case, and is none of them, is returned unchanged:
    the vehicle has no such parameter.
    """
    if name in component.params:
        return name
    upper = name.upper()
    known = [each for each in component.params if each.upper() == upper]
    if known:
        return known[0] if len(known) == 1 else name
    return upper if component.autopilot in _CAPITALS else name
