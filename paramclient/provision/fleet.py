"""`apply_all`, `verify_all` and `restore_all`: set up, verify and restore several vehicles concurrently."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Iterable, Mapping
from functools import partial
from typing import TypeAlias, TypeVar

import anyio

from paramclient.client.component import Component
from paramclient.errors import ParamClientError, UsageError
from paramclient.model.paramset import ParamSet
from paramclient.model.renames import Renames
from paramclient.provision.apply_restore import apply, restore, restore_categories
from paramclient.provision.inspection import verify
from paramclient.provision.planning import ParamInfo, Plan
from paramclient.provision.results import ApplyProgress, ApplyResult, FleetApplied, FleetVerified

__all__ = ["apply_all", "compare_states", "restore_all", "verify_all"]

Wanted: TypeAlias = ParamSet | Mapping[tuple[int, int], ParamSet] | Callable[[Component], ParamSet]
"""The wanted parameters of several vehicles: one set for all, or a set for each by address or by a call."""

Result = TypeVar("Result")


async def apply_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    renames: Renames | None = None,
    durable: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], object] | None = None,
) -> FleetApplied:
    """`apply` to several vehicles concurrently. A failure of one vehicle does not stop the others.

    Args:
        components: the vehicles.
        wanted: one set for all vehicles, or a set for each by (system, component) or by a call. `overlay`
            combines a shared set with one of a single vehicle.
        include, reboot, allow_armed, skip_invalid, force, renames, durable, timeout, author: as in `apply`.
        info: returns the metadata for a vehicle.
        backup: returns the name of a vehicle's backup file.
        progress, before_writing: as in `apply`, with the vehicle as first argument.

    Raises:
        UsageError: `wanted` has no set for one of the vehicles; nothing was sent to any vehicle.
    """
    given = (include,) if isinstance(include, str) else tuple(include)

    async def one(component: Component, own: ParamSet) -> ApplyResult:
        return await apply(
            component,
            own,
            include=given,
            info=None if info is None else info(component),
            reboot=reboot,
            allow_armed=allow_armed,
            skip_invalid=skip_invalid,
            force=force,
            renames=renames,
            durable=durable,
            backup=None if backup is None else backup(component),
            timeout=timeout,
            author=author,
            progress=None if progress is None else partial(progress, component),
            before_writing=None if before_writing is None else partial(before_writing, component),
        )

    return FleetApplied(*await _run_concurrently(components, wanted, one))


async def verify_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    force: bool = False,
    renames: Renames | None = None,
) -> FleetVerified:
    """`verify` several vehicles concurrently.

    Arguments and errors as in `apply_all`.
    """
    return await _compare(components, wanted, include=include, info=info, force=force, renames=renames)


async def restore_all(
    components: Iterable[Component],
    states: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], object] | None = None,
) -> FleetApplied:
    """`restore` several vehicles concurrently. A failure of one vehicle does not stop the others.

    Args:
        components: the vehicles.
        states: the earlier state of each vehicle, by (system, component) or by a call; or one set for all.
        include, reboot, allow_armed, force, timeout, author: as in `restore`.
        info, backup, progress, before_writing: as in `apply_all`.

    Returns:
        The results. The state of another vehicle is an error of the vehicle that it was given for.

    Raises:
        UsageError: `states` has no set for one of the vehicles; nothing was sent to any vehicle.
    """
    given = (include,) if isinstance(include, str) else tuple(include)

    async def one(component: Component, own: ParamSet) -> ApplyResult:
        return await restore(
            component,
            own,
            include=given,
            info=None if info is None else info(component),
            reboot=reboot,
            allow_armed=allow_armed,
            force=force,
            backup=None if backup is None else backup(component),
            timeout=timeout,
            author=author,
            progress=None if progress is None else partial(progress, component),
            before_writing=None if before_writing is None else partial(before_writing, component),
        )

    return FleetApplied(*await _run_concurrently(components, states, one))


async def compare_states(
    components: Iterable[Component],
    states: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    force: bool = False,
) -> FleetVerified:
    """`verify` several vehicles concurrently, with the categories that `restore_all` includes.

    Arguments and errors as in `restore_all`.
    """
    return await _compare(
        components, states, restore_categories, include=include, info=info, force=force, renames=None
    )


async def _compare(
    components: Iterable[Component],
    wanted: Wanted,
    categories: Callable[[Component, ParamSet], Awaitable[tuple[str, ...]]] | None = None,
    *,
    include: str | Iterable[str],
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None,
    force: bool,
    renames: Renames | None,
) -> FleetVerified:
    """`verify` several vehicles concurrently; `categories` returns those to include besides `include`."""
    given = (include,) if isinstance(include, str) else tuple(include)

    async def one(component: Component, own: ParamSet) -> Plan:
        more = () if categories is None else await categories(component, own)
        described = None if info is None else info(component)
        return await verify(
            component, own, include=(*more, *given), info=described, force=force, renames=renames
        )

    return FleetVerified(*await _run_concurrently(components, wanted, one))


async def _run_concurrently(
    components: Iterable[Component],
    wanted: Wanted,
    one: Callable[[Component, ParamSet], Awaitable[Result]],
) -> tuple[dict[tuple[int, int], Result], dict[tuple[int, int], ParamClientError]]:
    """Call `one` for each component; return results and errors by address, in the order of the components."""
    jobs = {
        (component.system, component.component): (component, _wanted_for(component, wanted))
        for component in components
    }
    results: dict[tuple[int, int], Result] = {}
    errors: dict[tuple[int, int], ParamClientError] = {}

    async def run(address: tuple[int, int], component: Component, own: ParamSet) -> None:
        try:
            results[address] = await one(component, own)
        except ParamClientError as error:
            errors[address] = error

    async with anyio.create_task_group() as running:
        for address, (component, own) in jobs.items():
            running.start_soon(run, address, component, own)
    return (
        {address: results[address] for address in jobs if address in results},
        {address: errors[address] for address in jobs if address in errors},
    )


def _wanted_for(component: Component, wanted: Wanted) -> ParamSet:
    if isinstance(wanted, ParamSet):
        return wanted
    if callable(wanted):
        return wanted(component)
    try:
        return wanted[component.system, component.component]
    except KeyError:
        raise UsageError(
            f"no wanted parameters are given for vehicle {component.system}/{component.component}"
        ) from None
