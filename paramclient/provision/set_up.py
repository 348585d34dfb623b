"""Set a vehicle up, or bring an earlier state of it back."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Final

import anyio

from paramclient.client.component import Component
from paramclient.errors import UsageError
from paramclient.model.paramset import ParamSet
from paramclient.provision.cautions import OUT_OF_RANGE
from paramclient.provision.execution import Run
from paramclient.provision.inspection import identified
from paramclient.provision.planning import ParamInfo, Plan
from paramclient.provision.results import ApplyProgress, ApplyResult

__all__ = ["BEFORE_APPLY", "BEFORE_RESTORE", "apply", "restore", "restored"]

BEFORE_APPLY: Final = "before apply"
BEFORE_RESTORE: Final = "before restore"
"""What a snapshot of the state before says it is for."""

RESTORED: Final = ("identity", "hardware", "calibration", OUT_OF_RANGE)
"""What is included when a vehicle gets back a state of its own."""


async def apply(
    component: Component,
    wanted: ParamSet | Plan,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    durable: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    asker: str | None = None,
    progress: Callable[[ApplyProgress], None] | None = None,
    before_writing: Callable[[], Awaitable[object]] | None = None,
) -> ApplyResult:
    """Bring a vehicle to the wanted values, and prove each of them by reading it back at the end.

    It begins with what the vehicle has, whatever happened before: nothing is taken from an earlier run but
    what the vehicle itself has kept. What it has is stored first, as a snapshot in the cache, and in the
    file `backup`. Then stage by stage (see `plan`) the values are written, side by side within a stage. Where
    others may have appeared, and after the vehicle has started again, it is looked at afresh. At the end all
    is read again: by the vehicle's hash where there is one, else as a file or a list.

    What the vehicle refuses, adjusts or does not answer is in its row; the others are set all the same.

    Once something was sent, a failure is no exception but the end of the result: `error` says what it was,
    and the rows what became of each value so far. Cancelled, it leaves the vehicle with what was written. In
    every case the next call goes on from there.

    Args:
        component: the vehicle.
        wanted: what it shall have; or a plan, of which what is wanted and included is taken. It is worked out
            afresh from what the vehicle has now.
        include: as in `plan`; of a plan, what is included besides.
        info: as in `plan`.
        reboot: start the vehicle again where values count only from then on.
        allow_armed: go on although it is armed.
        skip_invalid: set the others although some values cannot be right.
        force: as in `plan`.
        durable: return only when the values and their lines of history are on the disk, past a loss of power;
            where that fails, `error` of the result is a CacheError.
        backup: a file for the state before; its form follows from its name, see `paramclient.files`.
        timeout: seconds, after which the result says how far it came.
        asker: for whom it is done, as in `Component.set`.
        progress: called after each value and when a phase begins; it must not raise.
        before_writing: awaited once, when the vehicle has been read, and before its state is stored and the
            first value is written; what it raises ends the call.

    Raises:
        InvalidParameters: values cannot be right, and `skip_invalid` is not given.
        UsageError: as from `plan`; the plan is one for another vehicle; or SYS_AUTOCONFIG is included, which
            takes the others back at the next start, and `reboot` is not given; or `durable`, and the client
            keeps no cache.
        VehicleArmed: it is armed, and `allow_armed` is not given.
        FileError, CacheError: the state before could not be stored.
        NoReply: the vehicle did not answer before anything was sent.
        LinkError: the link failed, or the client was closed, before anything was sent.
    """
    run = Run(
        component,
        wanted,
        include=(include,) if isinstance(include, str) else tuple(include),
        info=info,
        reboot=reboot,
        allow_armed=allow_armed,
        skip_invalid=skip_invalid,
        force=force,
        durable=durable,
        backup=backup,
        asker=asker,
        progress=progress,
        before_writing=before_writing,
        reason=BEFORE_APPLY,
    )
    return await _done(run, timeout)


async def restore(
    component: Component,
    state: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    asker: str | None = None,
    progress: Callable[[ApplyProgress], None] | None = None,
    before_writing: Callable[[], Awaitable[object]] | None = None,
) -> ApplyResult:
    """Bring an earlier state of a vehicle back: `apply`, with its own identity and calibration included.

    What the vehicle measures at each start, counts, or does not let others set stays as it is: its rows are
    skipped, with the reason, and the result is complete all the same. Parameters that the vehicle has and the
    state does not are left alone; `extra` of the result names them.

    Args:
        component: the vehicle.
        state: what it had, such as a snapshot, or the file of a backup. If it does not say that it is this
            vehicle's own, identity and calibration are left out.
        include, info, reboot, allow_armed, force, backup, timeout, asker, progress, before_writing: as in
            `apply`.

    Raises:
        UsageError: it is the state of another vehicle.
        ParamClientError: as from `apply`.
    """
    given = (include,) if isinstance(include, str) else tuple(include)
    run = Run(
        component,
        state,
        include=(*await restored(component, state), *given),
        info=info,
        reboot=reboot,
        allow_armed=allow_armed,
        skip_invalid=True,
        force=force,
        backup=backup,
        asker=asker,
        progress=progress,
        before_writing=before_writing,
        reason=BEFORE_RESTORE,
        leaves_read_only=True,
    )
    return await _done(run, timeout)


async def restored(component: Component, state: ParamSet) -> tuple[str, ...]:
    """What `restore` includes of this state although the list leaves it out.

    Raises:
        UsageError: it is the state of another vehicle.
    """
    await identified(component)
    whose, own = state.identity, component.identity
    is_own = whose is not None and whose.is_same_vehicle(own)
    if whose is not None and not is_own and None not in (whose.uid, own.uid) and whose.uid != own.uid:
        raise UsageError(f"the state is that of another vehicle: {whose}; this one is {own}")
    return RESTORED if is_own else (OUT_OF_RANGE,)


async def _done(run: Run, timeout: float | None) -> ApplyResult:
    with anyio.move_on_after(timeout):
        await run.prepare()
        await run.work()
        return run.result()
    return run.ended_by_time()
