"""`apply` and `restore`: write wanted values to a vehicle, or an earlier state of that vehicle."""

from __future__ import annotations

from typing import Final, Unpack

from paramclient.client.component import Component
from paramclient.errors import UsageError
from paramclient.model.paramset import ParamSet
from paramclient.provision.apply_rules import OUT_OF_RANGE
from paramclient.provision.execution import ApplyOptions, ApplyResult, run
from paramclient.provision.inspection import Wanted, wait_for_identity, wanted_set

__all__ = ["BEFORE_APPLY", "BEFORE_RESTORE", "apply", "restore", "restore_categories"]

BEFORE_APPLY: Final = "before apply"
"""The reason of the snapshot that `apply` stores before its first write."""
BEFORE_RESTORE: Final = "before restore"
"""The reason of the snapshot that `restore` stores before its first write."""

OWN_STATE_CATEGORIES: Final = ("identity", "hardware", "calibration", OUT_OF_RANGE)
"""Categories that `restore` includes if the state is the vehicle's own."""


async def apply(component: Component, wanted: Wanted, **options: Unpack[ApplyOptions]) -> ApplyResult:
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
        UsageError: as from `plan_from`; SYS_AUTOCONFIG, which resets other parameters at the next start, is
            included without `reboot`; or `durable` without a cache.
        VehicleArmed: the vehicle is armed, and `allow_armed` is false.
        FileError, CacheError: the state before the first write could not be stored.
        NoReply: the vehicle did not answer before the first write.
        LinkError: the link failed, or the client was closed, before the first write.
    """
    return await run(component, wanted_set(component, wanted), BEFORE_APPLY, **options)


async def restore(component: Component, state: Wanted, **options: Unpack[ApplyOptions]) -> ApplyResult:
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
        UsageError: the state is that of another vehicle.
        ParamClientError: as from `apply`.
    """
    state, include = wanted_set(component, state), options.get("include", ())
    given = (include,) if isinstance(include, str) else tuple(include)
    options["include"] = (*await restore_categories(component, state), *given)
    options.setdefault("partial", True)
    return await run(component, state, BEFORE_RESTORE, skips_read_only=True, **options)


async def restore_categories(component: Component, state: ParamSet) -> tuple[str, ...]:
    """Return the categories that `restore` includes for this state.

    Waits until the vehicle is identified.

    Raises:
        UsageError: the state is that of another vehicle.
    """
    await wait_for_identity(component)
    origin, own = state.identity, component.identity
    is_own = origin is not None and origin.is_same_vehicle(own)
    if origin is not None and not is_own and None not in (origin.uid, own.uid) and origin.uid != own.uid:
        raise UsageError(f"the state is that of another vehicle: {origin}; this vehicle is {own}")
    return OWN_STATE_CATEGORIES if is_own else (OUT_OF_RANGE,)
