"""`apply` and `restore`: write wanted values to a vehicle, or an earlier state of it; `for_each` vehicle."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Generic, TypeVar, Unpack

import anyio

from paramclient.cache import ParamCache
from paramclient.client.component import Component
from paramclient.errors import AlreadyRestored, NotInCache, ParamClientError, UnknownVehicle, UsageError
from paramclient.model.names import age_in_words
from paramclient.model.paramset import AnyParams, ParamSet, RestorePoint, set_of
from paramclient.provision.apply_rules import OUT_OF_RANGE
from paramclient.provision.execution import BEFORE_APPLY, BEFORE_RESTORE, ApplyOptions, ApplyResult, run
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.planning import Rows

Outcome = TypeVar("Outcome", bound=Rows)

OWN_STATE_CATEGORIES: Final = ("identity", "hardware", "calibration", OUT_OF_RANGE)
"""Categories that `restore` includes if the state is the vehicle's own."""
CONTINUATION_MAX: Final = 3600.0
"""Seconds after which an `apply` no longer continues one that was interrupted: values may have been set
otherwise since."""


async def apply(component: Component, wanted: AnyParams, **options: Unpack[ApplyOptions]) -> ApplyResult:
    """Write the wanted values to a vehicle, and verify each of them by reading it back at the end.

    All or nothing: if a value is invalid, or the vehicle does not have a name, nothing is written unless
    `partial` is given.

    The call starts from the vehicle's present values; it uses no record of an earlier run. First it stores
    the vehicle's state: as a snapshot in the cache, and in the file `backup`. Then it writes the values stage
    by stage (see `plan_from`), concurrently within a stage. Where further parameters may have appeared, and
    after a reboot, it reads the vehicle again. At the end it reads all values again: by the vehicle's hash if
    there is one, else as a file or a list.

    A value that the vehicle refuses, adjusts or does not acknowledge is reported in its row; the remaining
    values are still written.

    After the first PARAM_SET, a failure is not raised: `error` of the result holds it, and the rows hold the
    outcome of each value so far. Cancellation, or Ctrl-C in a blocking call, leaves the values that were
    written on the vehicle. The next call continues from there.

    Args:
        component: the vehicle.
        wanted: the wanted parameters, or plain values by name.
        options: as in `ApplyOptions`.

    Raises:
        InvalidParameters: some values are invalid, or names are not on the vehicle, and `partial` is false.
        UsageError: as from `plan_from`; or `durable` without a cache.
        VehicleArmed: the vehicle is armed, and `allow_armed` is false.
        FileError, CacheError: the state before the first write could not be stored.
        NoReply: the vehicle did not answer before the first write.
        LinkError: the link failed, or the client was closed, before the first write.
    """
    return await run(component, set_of(wanted, is_extended=component.is_extended), options, is_restore=False)


async def restore(component: Component, state: AnyParams, **options: Unpack[ApplyOptions]) -> ApplyResult:
    """Restore an earlier state of a vehicle: `apply`, with its own identity and calibration included.

    Parameters that the vehicle measures at each start, counts, or does not let clients write are not changed:
    their rows are skipped with a reason, and the result can be complete without them. Parameters that the
    vehicle has and the state does not have are not changed; `extra` of the result names them.

    Args:
        component: the vehicle.
        state: the earlier state, such as a snapshot or a backup file. Identity and calibration are left out
            unless the state names this vehicle as its own.
        options: as in `ApplyOptions`.

    Raises:
        UsageError: the state is that of another vehicle, or the vehicle lacks most of its parameters.
        ParamClientError: as from `apply`.
    """
    state, include = set_of(state, is_extended=component.is_extended), options.get("include", ())
    given = (include,) if isinstance(include, str) else tuple(include)
    options["include"] = (*await restore_categories(component, state), *given)
    options.setdefault("partial", True)
    return await run(component, state, options, is_restore=True)


def is_own_state(component: Component, state: ParamSet) -> bool:
    """Return whether a state is one of this very vehicle: `restore` then includes `OWN_STATE_CATEGORIES`.

    The hardware id decides, on whatever link; also that of a simulator.
    """
    origin, own = state.identity, component.identity
    return origin is not None and origin.uid == own.uid and (bool(own.uid) or origin.is_same_vehicle(own))


async def restore_categories(component: Component, state: ParamSet) -> tuple[str, ...]:
    """Return the categories that `restore` includes for this state.

    Waits until the vehicle is identified.

    Raises:
        UsageError: the state is that of another vehicle.
    """
    await wait_for_identity(component)
    origin, own = state.identity, component.identity
    if origin is not None and None not in (origin.uid, own.uid) and origin.uid != own.uid:
        raise UsageError(f"the state is that of another vehicle: {origin}; this vehicle is {own}")
    return OWN_STATE_CATEGORIES if is_own_state(component, state) else (OUT_OF_RANGE,)


def load_restore_point(
    cache: ParamCache, key: str, component: int, *, extended: bool = False
) -> RestorePoint:
    """Return the state that the cache stored before the latest `apply`, and what happened after it.

    An `apply` that was interrupted, and the one that follows it within `CONTINUATION_MAX`, count as one.

    A restore stores a snapshot before its first write. If there is one after the `apply`, even of a restore
    that did not end, the state must be named: another restore would also undo later changes.

    Args:
        cache: the cache.
        key: `Identity.key` of the vehicle.
        component: component id.
        extended: that of extended parameters.

    Raises:
        AlreadyRestored: a restore ran since that `apply`.
        NotInCache: there is no snapshot from before an `apply`.
        CacheError: the cache cannot be read.
    """
    missing = NotInCache(
        f"the cache has no snapshot from before an apply to {key}; name the time of the state to restore, "
        "such as '2h ago', or a backup file"
    )
    try:
        snapshots = cache.snapshots(key, component, extended=extended)
        point = next((each for each in snapshots[::-1] if each.reason == BEFORE_APPLY), None)
        if point is None:
            raise missing
        for each in [each for each in snapshots[::-1] if each.id < point.id and each.ended is not None]:
            if (each.reason, each.ended) != (BEFORE_APPLY, False) or point.at - each.at > CONTINUATION_MAX:
                break
            point = each
        restores = [each for each in snapshots if each.reason == BEFORE_RESTORE and each.id > point.id]
        if restores:
            restored, applied = (age_in_words(time.time() - each.at) for each in (restores[-1], point))
            raise AlreadyRestored(
                f"a restore ran {restored} ago, after the last apply ({applied} ago)",
                before_apply=point.id,
                before_restore=restores[-1].id,
                restored_at=restores[-1].at,
            )
        state = cache.state_at(key, component, point.id, extended=extended)
        table = cache.load(key, component, extended=extended)
        latest = {each.name: each.at for each in cache.history(key, component, extended=extended)}
    except UnknownVehicle:
        raise missing from None
    held = {} if table is None else table.params
    changes = {
        name: at
        for name, at in sorted(latest.items(), key=lambda change: change[1])[::-1]
        if name in held and name in state and held[name].settable != state[name].settable
    }
    return RestorePoint(point.id, point.at, state, changes)


# Several vehicles


@dataclass(frozen=True, slots=True)
class FleetResult(Generic[Outcome]):
    """The results of one call for each vehicle.

    Attributes:
        results: by (system, component), the result for each vehicle.
        errors: by (system, component), the error that the call raised for a vehicle.
    """

    results: Mapping[tuple[int, int], Outcome]
    errors: Mapping[tuple[int, int], ParamClientError]

    @property
    def complete(self) -> bool:
        """Whether every call has a result, and every result is complete."""
        return not self.errors and all(result.complete for result in self.results.values())


async def for_each(
    components: Iterable[Component], call: Callable[[Component], Awaitable[Outcome]]
) -> FleetResult[Outcome]:
    """Make a call for each vehicle, concurrently; a failure of one does not stop the others.

    The call is `plan`, `apply` or `restore`::

        fleet = await for_each(vehicles, lambda vehicle: apply(vehicle, {"RTL_ALT": 2500}, reboot=True))
    """
    results: dict[tuple[int, int], Outcome] = {}
    errors: dict[tuple[int, int], ParamClientError] = {}

    async def run(component: Component) -> None:
        try:
            results[component.address] = await call(component)
        except ParamClientError as error:
            errors[component.address] = error

    async with anyio.create_task_group() as running:
        for component in components:
            running.start_soon(run, component)
    return FleetResult(dict(sorted(results.items())), dict(sorted(errors.items())))
