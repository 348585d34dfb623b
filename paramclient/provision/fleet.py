"""Set up and verify several vehicles, side by side."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Iterable, Mapping
from functools import partial
from typing import TypeAlias, TypeVar

import anyio

from paramclient.client.component import Component
from paramclient.errors import ParamClientError, UsageError
from paramclient.model.paramset import ParamSet
from paramclient.provision.inspection import verify
from paramclient.provision.planning import ParamInfo, Plan
from paramclient.provision.results import ApplyProgress, ApplyResult, FleetApplied, FleetVerified
from paramclient.provision.set_up import apply

__all__ = ["apply_all", "verify_all"]

Wanted: TypeAlias = ParamSet | Mapping[tuple[int, int], ParamSet] | Callable[[Component], ParamSet]
"""What several vehicles shall have: all the same, or each its own, by address or by a call."""

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
    durable: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    asker: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], Awaitable[object]] | None = None,
) -> FleetApplied:
    """`apply` to several vehicles side by side. What becomes of one does not stop the others.

    Args:
        components: the vehicles.
        wanted: what they shall have: all the same; or each its own, by (system, component) or by a call.
            `overlay` puts what is one vehicle's own over what all share.
        include, reboot, allow_armed, skip_invalid, force, durable, timeout, asker: as in `apply`.
        info: gives the metadata for a vehicle.
        backup: gives the name of the file for the state before of a vehicle.
        progress, before_writing: as in `apply`, with the vehicle.

    Raises:
        UsageError: there is nothing in `wanted` for one of them; then nothing was sent to any.
    """
    given = (include,) if isinstance(include, str) else tuple(include)

    async def one(component: Component, own: ParamSet) -> ApplyResult:
        def tell(how_far: ApplyProgress) -> None:
            if progress is not None:
                progress(component, how_far)

        return await apply(
            component,
            own,
            include=given,
            info=None if info is None else info(component),
            reboot=reboot,
            allow_armed=allow_armed,
            skip_invalid=skip_invalid,
            force=force,
            durable=durable,
            backup=None if backup is None else backup(component),
            timeout=timeout,
            asker=asker,
            progress=tell,
            before_writing=None if before_writing is None else partial(before_writing, component),
        )

    return FleetApplied(*await _side_by_side(components, wanted, one))


async def verify_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    force: bool = False,
) -> FleetVerified:
    """`verify` several vehicles side by side.

    Args and errors as in `apply_all`.
    """
    given = (include,) if isinstance(include, str) else tuple(include)

    async def one(component: Component, own: ParamSet) -> Plan:
        described = None if info is None else info(component)
        return await verify(component, own, include=given, info=described, force=force)

    return FleetVerified(*await _side_by_side(components, wanted, one))


async def _side_by_side(
    components: Iterable[Component],
    wanted: Wanted,
    one: Callable[[Component, ParamSet], Awaitable[Result]],
) -> tuple[dict[tuple[int, int], Result], dict[tuple[int, int], ParamClientError]]:
    """Do it for each; results and errors by address, in the order of the components."""
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
            f"there is nothing that component {component.system}/{component.component} shall have"
        ) from None
