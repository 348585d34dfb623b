"""One run of `apply`: store the vehicle's state, write the stages of the plan, reboot, verify."""

from __future__ import annotations

import math
import os
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import anyio

from paramclient.cache import check_author
from paramclient.client.component import Component
from paramclient.errors import (
    AnotherVehicle,
    CacheError,
    InvalidParameters,
    LinkError,
    NoReply,
    ParamClientError,
    ParamErrorCode,
    Refused,
    UsageError,
    VehicleArmed,
)
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.renames import Renames
from paramclient.model.values import WireValue
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.provision.apply_rules import READ_ONLY, rules_for
from paramclient.provision.inspection import (
    POLL_INTERVAL,
    Inspection,
    inspect,
    plan_for,
    read_hidden,
    reread,
    wait_for_identity,
    with_other_names,
)
from paramclient.provision.planning import (
    MISSING,
    WRONG,
    ParamInfo,
    Plan,
    PlanRow,
    PlanStatus,
    Stage,
    Step,
    check_component,
    plan,
)
from paramclient.provision.results import ApplyProgress, ApplyResult, ApplyRow, ApplyStatus

__all__ = ["ApplyOptions", "ApplyRun"]

WRITE_ATTEMPTS_MAX: Final = 2
"""Times that a value is written if the vehicle acknowledges it and later holds another value: a write of
another parameter may have changed it."""
DEFAULT_SYSTEM_ID: Final = 1
"""The system id of a PX4 after SYS_AUTOCONFIG: its start script does not keep MAV_SYS_ID."""
VERIFY_DELAY: Final = 1.2
"""Seconds between the last write and the read that verifies it: modules of PX4 clamp the value, or set other
parameters, up to 1.1 s after the acknowledgement (measured)."""
ARMED_STATE_TIMEOUT: Final = 3.0
"""Seconds to wait for a heartbeat with the armed flag: heartbeats arrive once a second, and some are lost."""
SYSTEM_CHANGE_TIMEOUT: Final = 10.0
"""Seconds to wait for the vehicle under its new system id; ArduPilot sends its next heartbeat under it."""
SYSTEM_CHANGE_DELAY: Final = 2.5
"""Seconds after the acknowledgement of SYSID_THISMAV: a vehicle whose heartbeats still have the old id then
changes it after a reboot, as ArduCopter does. ArduPlane and Rover change it within a second (measured with
4.6-dev)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyOptions:
    """The arguments of `apply` and `restore`, see there.

    Attributes:
        reason: the reason of the snapshot of the state before the first write.
        skips_read_only: skip a parameter that the vehicle refuses as read-only, rather than report it as
            refused.
    """

    include: tuple[str, ...]
    info: Mapping[str, ParamInfo] | None
    reboot: bool
    allow_armed: bool
    skip_invalid: bool
    force: bool
    renames: Renames | None = None
    durable: bool = False
    backup: str | os.PathLike[str] | None
    author: str | None
    progress: Callable[[ApplyProgress], None] | None
    before_writing: Callable[[], object] | None
    reason: str
    skips_read_only: bool = False


class ApplyRun:
    """One run of `apply` or `restore`.

    Args:
        component: the vehicle.
        wanted: the wanted parameters, or a plan.
        options: the other arguments of the call.

    Attributes:
        inspection: the latest inspection of the vehicle.
        plan: the plan that follows from it.
        rows: rows of parameters whose outcome is known before the vehicle is read again, by the vehicle's
            names.
        sent: parameters for which a PARAM_SET may have been sent, as the vehicle names them.
        written: number of acknowledged writes by parameter, as the vehicle names it.
    """

    inspection: Inspection
    plan: Plan
    _first_identity: Identity

    def __init__(self, component: Component, wanted: ParamSet | Plan, options: ApplyOptions) -> None:
        check_author(options.author)
        self._component = component
        self._plan_identity: Identity | None = None
        if isinstance(wanted, Plan):
            self._plan_identity = wanted.identity
            options = replace(
                options,
                include=(*wanted.include, *options.include),
                force=options.force or wanted.force,
                renames=wanted.renames if options.renames is None else options.renames,
            )
            wanted = wanted.wanted
        self._wanted = wanted
        self._options = options
        self._rules = rules_for("")
        self._began = anyio.current_time()
        self.rows: dict[str, ApplyRow] = {}
        self.sent: set[str] = set()
        self.written: dict[str, int] = {}
        self._first: Inspection | None = None
        self._first_plan: Plan | None = None
        self._is_verified = True  # nothing was written since the last inspection
        self._written_at = -math.inf  # when the last write ended
        self._inspected_at = -math.inf  # when the last inspection began
        self._notes: dict[str, str] = {}  # notes of the acknowledged writes
        self._reboot_for: dict[str, None] = {}
        self._reboots = 0
        self._written_before_reboot: set[str] = set()  # values that the last reboot should have kept
        self._next_system_id: int | None = None  # the vehicle's system id after the next reboot
        self._error: ParamClientError | None = None
        self._snapshot: int | None = None  # number of the snapshot of the state before

    async def prepare(self) -> None:
        """Inspect the vehicle, plan, and store its state. A failure is raised before the first write."""
        if self._options.durable and self._component.core.cache is None:
            raise UsageError("durable needs a cache, and the client keeps none")
        component = self._component
        check_component(self._wanted, component.component, is_extended=component.is_extended)
        plan({}, self._wanted, include=self._options.include, autopilot=self._component.autopilot)
        await wait_for_identity(self._component)
        self._rules = rules_for(component.autopilot, is_extended=component.is_extended)
        planned, own = self._plan_identity, self._component.identity
        if planned is not None and not planned.is_same_vehicle(own):
            raise UsageError(f"the plan is for another vehicle: {planned}; this vehicle is {own}")
        with self._component.watch.held():
            await self._check_armed()
            await self._inspect()
            self._first, self._first_plan = self.inspection, self.plan
            self._first_identity = self._component.identity
            self._check_plan()
            if self._options.before_writing is None:
                await self._store_state()
        if self._options.before_writing is not None:
            await _call_and_wait(self._options.before_writing)
            await self._store_state()

    def _check_plan(self) -> None:
        """Raise the error of a plan that must not be carried out."""
        invalid = {row.name: row.reason for row in self.plan.of(PlanStatus.INVALID)}
        if invalid and not self._options.skip_invalid:
            raise InvalidParameters(invalid)
        self._check_resets()

    async def write_and_verify(self) -> None:
        """Write and verify until no stage is pending. `result` reports a failure after the first write."""
        with self._component.watch.held():  # a changed count starts no download besides those of the run
            await self._write_and_verify()
        await self._record_end()

    async def _write_and_verify(self) -> None:
        """Do what `write_and_verify` says, while no check of the table begins."""
        try:
            while True:
                stages = self._pending_stages()
                for stage in stages:
                    await self._check_armed()
                    await self._write_stage(stage)
                if self._must_reboot(stages):
                    await self._reboot_vehicle()
                    await self._inspect()
                    self._record_lost_values()
                elif self._reveals_more(stages):
                    await self._read_revealed(stages[-1])
                elif stages or self._inspected_at < self._written_at + VERIFY_DELAY:
                    await anyio.sleep_until(self._written_at + VERIFY_DELAY)
                    await self._verify()
                else:
                    break
            if self._options.durable and self.sent:
                await self._component.core.cache_writer.write_durably(self._component.node)
        except ParamClientError as error:
            if not self.sent:
                raise
            self._error = error

    def result(self) -> ApplyResult:
        """Return the result of the run."""
        assert self._first is not None
        assert self._first_plan is not None
        return ApplyResult(
            self._component.system,
            self._component.component,
            {name: self._final_row(row) for name, row in self.plan.rows.items()},
            self._first_plan,
            self._first.table,
            self.plan.extra,
            self._reboots,
            tuple(self._reboot_for),
            self._error,
            anyio.current_time() - self._began,
        )

    def timed_out_result(self) -> ApplyResult:
        """Return the result of a run that has reached its timeout.

        Raises:
            NoReply: nothing was sent.
        """
        waited = anyio.current_time() - self._began
        error = NoReply(f"the set-up of {self._address}", attempts=0, waited=waited)
        if not self.sent:
            raise error
        self._error = error
        return self.result()

    # Next stages

    def _pending_stages(self) -> list[Stage]:
        """Return the next stages, up to and including the one after which the vehicle must be inspected."""
        stages = []
        may_appear = bool(self.plan.of(PlanStatus.LATER))
        for stage in self.plan.stages:
            steps = tuple(step for step in stage.steps if self._may_write(step.name))
            if steps:
                stages.append(replace(stage, steps=steps))
                if (stage.reveals and may_appear) or (stage.reboot_first and self._options.reboot):
                    break
        return stages

    def _reveals_more(self, done: list[Stage]) -> bool:
        """Return whether the stages that are done may have revealed wanted parameters."""
        return bool(done) and done[-1].reveals and bool(self.plan.of(PlanStatus.LATER))

    def _must_reboot(self, done: list[Stage]) -> bool:
        """Return whether the vehicle must reboot after the stages that are done."""
        if not self._options.reboot:
            return False
        if done:
            return done[-1].reboot_first and bool(self._reboot_for)
        is_reboot_due = bool(self.plan.awaiting_reboot) or self._pending_system_id() is not None
        return bool(self._reboot_for) or (is_reboot_due and not self._reboots)

    def _pending_system_id(self) -> int | None:
        """Return the system id that is set and takes effect after a reboot, or None."""
        for row in self.plan.rows.values():
            is_set = row.status is PlanStatus.UNCHANGED and self._rules.is_system_id(row.target.name)
            if is_set and isinstance(row.before, int) and row.before != self._component.system:
                return row.before
        return None

    def _may_write(self, name: str) -> bool:
        """Return whether a parameter whose value differs is written, or written again."""
        if name in self.rows:
            return False
        attempts_max = 1 if self._is_action(name) else WRITE_ATTEMPTS_MAX
        return self.written.get(name, 0) < attempts_max

    def _is_action(self, name: str) -> bool:
        rule = self._rules.left_out(name)
        return rule is not None and rule.category == "action"

    # Reads, writes and reboots of the vehicle

    async def _inspect(self) -> None:
        self._report("reading")
        absent = self.inspection.absent if self._first is not None else frozenset[str]()
        self._inspected_at = anyio.current_time()
        self.inspection = await inspect(
            self._component,
            self._wanted,
            absent,
            renames=self._options.renames,
            whole=self._first is None,
        )
        self._check_same_vehicle()
        self._replan()
        self._is_verified = True

    async def _verify(self) -> None:
        """Read the wanted parameters: by name if that is faster than the whole table, else the table.

        Always reads the table if a switch may have revealed parameters whose names are not known.
        """
        rows = [*self.plan.of(PlanStatus.SET), *self.plan.of(PlanStatus.UNCHANGED)]
        names = [row.target.name for row in rows]
        if self.plan.of(PlanStatus.LATER) or not self.inspection.is_reading_faster(len(names)):
            await self._inspect()
            return
        self._report("reading")
        self._inspected_at = anyio.current_time()
        self.inspection = await reread(self._component, self.inspection, names)
        self._check_same_vehicle()
        self._replan()
        self._is_verified = True

    async def _read_revealed(self, done: Stage) -> None:
        """Read by name the parameters that a stage may have revealed. This verifies no write."""
        self._report("reading")
        later = [row.name for row in self.plan.of(PlanStatus.LATER)]
        names = with_other_names(later, (), self._options.renames)
        if self._component.autopilot == "ardupilot":  # a switch reveals the names with its own prefix
            groups = tuple(step.name.rpartition("_")[0] for step in done.steps)
            names = tuple(name for name in names if name.startswith(groups))
        self.inspection = await read_hidden(self._component, self.inspection, names)
        self._check_same_vehicle()
        self._replan()

    def _replan(self) -> None:
        """Plan again from the latest inspection."""
        self.plan = plan_for(
            self._component,
            self.inspection.table,
            self._wanted,
            self._options.include,
            self._options.info,
            force=self._options.force,
            renames=self._options.renames,
        )

    async def _write_stage(self, stage: Stage) -> None:
        """Write the values of a stage: many at a time, or one by one if they may end the connection."""
        if not stage.is_last:
            await self._write(stage.steps)
            return
        for step in stage.steps:
            if self._rules.is_system_id(step.name):
                await self._write_system_id(step)
            else:
                await self._write([step])

    async def _write(self, steps: Sequence[Step]) -> None:
        """Write values in order, many at a time.

        Raises:
            ParamClientError: not all values were tried.
        """
        self._check_same_vehicle()
        self._is_verified = False
        by_name = {step.name: step for step in steps}
        before = frozenset(self.sent)
        self.sent.update(by_name)
        try:
            done = await self._component.set_many(
                [(step.name, step.value) for step in steps],
                force=self._options.force,
                author=self._options.author,
                progress=lambda outcome: self._take(by_name[outcome.name], outcome),
            )
        except ParamClientError:
            self.sent &= before
            raise
        finally:
            self._written_at = anyio.current_time()
        self.sent -= {outcome.name for outcome in done.of(SetStatus.NOT_TRIED)} - before
        if done.error is not None:
            raise done.error
        for outcome in done.of(SetStatus.NOT_TRIED):
            self._record(by_name[outcome.name], ApplyStatus.FAILED, None, str(outcome.error))

    def _take(self, step: Step, outcome: SetOutcome) -> None:
        """Record the outcome of a write."""
        done, error = outcome.result, outcome.error
        if done is not None:
            self._count_write(step)
            self._notes[step.name] = done.note
            if self._is_action(step.name) and self._rules.resets(step.name):
                self._next_system_id = DEFAULT_SYSTEM_ID
            if done.adjusted:
                self._record(step, ApplyStatus.ADJUSTED, done.param.settable, "the vehicle changed the value")
            else:
                self._report("writing", self._make_row(step, ApplyStatus.SET, done.param.settable, done.note))
        elif outcome.status is SetStatus.REFUSED:
            is_read_only = isinstance(error, Refused) and error.code == ParamErrorCode.READ_ONLY
            if is_read_only and self._options.skips_read_only:
                reason = "left out: the vehicle reports that it is read-only"
                self._record(step, ApplyStatus.SKIPPED, step.before, reason, READ_ONLY)
            else:
                self._record(step, ApplyStatus.REFUSED, step.before, str(error))
        elif outcome.status is SetStatus.UNKNOWN:
            self._record(step, ApplyStatus.FAILED, None, str(error))

    async def _write_system_id(self, step: Step) -> None:
        """Set the system id, and continue with the vehicle under its new one."""
        system = int(step.value) if not isinstance(step.value, bytes) else 0
        if any(
            self._is_other_vehicle_with(system, known) for known in self._component.client.components.values()
        ):
            reason = f"another vehicle on this link has system id {system}"
            self._record(step, ApplyStatus.SKIPPED, step.before, reason, WRONG)
            return
        if self._rules.needs_reboot(step.name):
            await self._write([step])
            if step.name in self.written:
                self._next_system_id = system
            return
        self._is_verified = False
        self.sent.add(step.name)
        failure: ParamClientError | None = None
        is_id_kept = False

        async def cancel_if_id_is_kept() -> None:
            nonlocal is_id_kept
            await self._set_and_detect_kept_id(step)
            is_id_kept = True
            sending.cancel_scope.cancel()

        async with anyio.create_task_group() as sending:
            sending.start_soon(cancel_if_id_is_kept)
            try:
                self._component = await self._component.client.successor(
                    self._component, system, timeout=SYSTEM_CHANGE_TIMEOUT
                )
            except ParamClientError as error:  # raised here, the task group would wrap it in a group
                failure = error
            sending.cancel_scope.cancel()
        self._written_at = anyio.current_time()
        step = replace(step, needs_reboot=is_id_kept)
        if is_id_kept:
            self._next_system_id = system
        if failure is None:
            self._count_write(step)
            self._report("writing", self._make_row(step, ApplyStatus.SET, step.value))
            return
        self._record(step, ApplyStatus.FAILED, None, str(failure))
        if isinstance(failure, LinkError):
            raise failure

    def _is_other_vehicle_with(self, system: int, known: Component) -> bool:
        """Return whether `known` is another vehicle with this system id.

        The same vehicle under an earlier id, and a lost vehicle, do not count.
        """
        own = self._component.identity
        is_ours = own.has_own_uid and known.identity.uid == own.uid
        return known.system == system and known.state != "lost" and not is_ours

    async def _set_and_detect_kept_id(self, step: Step) -> None:
        """Set the system id, and return once the vehicle has acknowledged it and still has the old one.

        ArduPlane and Rover may change the id before they acknowledge; then this call does not return until
        it is cancelled.
        """
        component = self._component
        with suppress(ParamClientError):
            await component.set(step.name, step.value, author=self._options.author)
            acknowledged_at = anyio.current_time()
            while component.node.presence.beat_at < acknowledged_at + SYSTEM_CHANGE_DELAY:  # noqa: ASYNC110 - no event
                await anyio.sleep(POLL_INTERVAL)
            return
        await anyio.sleep_forever()

    async def _reboot_vehicle(self) -> None:
        """Reboot the vehicle and continue with it, under its new system id if one is pending."""
        await self._check_armed()
        self._report("rebooting")
        system = self._pending_system_id() if self._next_system_id is None else self._next_system_id
        self._component = await self._component.reboot(system=system)
        self._next_system_id = None
        self._reboots += 1
        # values that a resetting parameter has reverted are written again
        is_reset = any(self._rules.resets(name) for name in self._reboot_for)
        self._written_before_reboot = set() if is_reset else set(self.written)
        self._notes.clear()  # they warn of effects of this reboot
        self._reboot_for.clear()

    def _record_lost_values(self) -> None:
        """Record as adjusted the values that the vehicle had acknowledged and lost with the reboot.

        They are not written again: the next reboot would change them again.
        """
        for step in self.plan.steps:
            if step.name in self._written_before_reboot and step.name not in self.rows:
                reason = "the vehicle acknowledged the value, and has another one after the reboot"
                self._record(step, ApplyStatus.ADJUSTED, step.before, reason)

    def _check_same_vehicle(self) -> None:
        """Raise `AnotherVehicle` if the identity is not that of the first inspection."""
        found = self._component.identity
        if self._first is not None and not self._first_identity.is_same_vehicle(found):
            system, component = self._component.system, self._component.component
            raise AnotherVehicle(system, component, str(self._first_identity), str(found))

    # Checks and storage before a write

    async def _check_armed(self) -> None:
        """Check that every component of the vehicle is disarmed, and that the component to set reports so.

        Raises:
            VehicleArmed: a component is armed, or the armed state is unknown.
        """
        if self._options.allow_armed:
            return
        component = self._component
        with anyio.move_on_after(ARMED_STATE_TIMEOUT):
            while component.is_armed is None and component.state != "lost":  # noqa: ASYNC110 - no event
                await anyio.sleep(POLL_INTERVAL)
        own = [each for each in component.client.components.values() if each.system == component.system]
        if any(each.is_armed for each in own):
            message = f"{self._address} is armed; nothing is set then"
        elif component.is_armed is None and component.state != "lost":
            message = (
                f"{self._address} does not report whether it is armed (no heartbeat within "
                f"{ARMED_STATE_TIMEOUT:g} s); nothing is set then"
            )
        else:
            return
        raise VehicleArmed(message, system=component.system, component=component.component)

    def _check_resets(self) -> None:
        """Check that parameters that reset others at the next start are set only with `reboot`.

        Raises:
            UsageError: one of them is to be set without `reboot`.
        """
        for step in self.plan.steps:
            if self._is_action(step.name) and self._rules.resets(step.name) and not self._options.reboot:
                raise UsageError(
                    f"{step.name} resets other parameters to their defaults at the next start of the "
                    "vehicle; it can only be set with reboot=True"
                )

    async def _store_state(self) -> None:
        """Store the vehicle's state: in the backup file, and in the cache if the plan has steps."""
        client, component, inspection = self._component.core, self._component, self.inspection
        if (path := self._options.backup) is not None:
            from paramclient.files import write_file

            await client.cache_writer.run_in_thread(lambda: write_file(path, inspection.table))
        cache = client.cache
        if cache is not None and self.plan.steps:
            try:
                # the history then has the values from before the change
                await client.cache_writer.write_all()
                snapshot = await client.cache_writer.run_in_thread(
                    lambda: cache.store_snapshot(
                        component.identity,
                        component.component,
                        inspection.table,
                        reason=self._options.reason,
                        hash=inspection.hash,
                        complete=inspection.complete,
                        is_of_operation=True,
                        extended=component.is_extended,
                    )
                )
            except CacheError as error:
                raise CacheError(
                    f"nothing was sent, as the state before cannot be stored: {error}. Without a cache"
                    " (--no-cache, or cache=False), no state is stored"
                ) from error
            self._snapshot = snapshot.id

    async def _record_end(self) -> None:
        """Record in the cache that the run was not interrupted."""
        client, number = self._component.core, self._snapshot
        cache = client.cache
        if cache is not None and number is not None:
            with suppress(CacheError):  # the warning of the cache writer says so
                await client.cache_writer.run_in_thread(lambda: cache.end_operation(number))

    # Progress and rows

    @property
    def _address(self) -> str:
        return f"{self._component.system}/{self._component.component}"

    def _count_write(self, step: Step) -> None:
        self.written[step.name] = self.written.get(step.name, 0) + 1
        if step.needs_reboot:
            self._reboot_for[step.name] = None

    def _record(
        self, step: Step, status: ApplyStatus, actual: WireValue | None, reason: str, category: str = ""
    ) -> None:
        """Record an outcome that only the verification may still change, and report it."""
        row = self._make_row(step, status, actual, reason, category)
        self.rows[step.name] = row
        self._report("writing", row)

    def _make_row(
        self, step: Step, status: ApplyStatus, actual: WireValue | None, reason: str = "", category: str = ""
    ) -> ApplyRow:
        renamed = None if step.name == step.wanted.name else self.plan.rows[step.wanted.name].renamed
        before = self._before(step.name)
        return ApplyRow(step.wanted, status, before, actual, step.type, category, reason, (), renamed)

    def _before(self, name: str) -> WireValue | None:
        current = None if self._first is None else self._first.table.get(name)
        return None if current is None else current.settable

    def _report(self, phase: str, row: ApplyRow | None = None) -> None:
        if self._options.progress is not None:
            done = self.rows.keys() | self.written.keys()
            left = 0 if self._first is None else sum(step.name not in done for step in self.plan.steps)
            self._options.progress(ApplyProgress(phase, len(done), len(done) + left, row))

    def _final_row(self, planned: PlanRow) -> ApplyRow:
        """Return the row of a parameter at the end of the run."""
        name, actual = planned.target.name, planned.before

        def row(status: ApplyStatus, reason: str = "", category: str = "") -> ApplyRow:
            return ApplyRow(
                planned.wanted,
                status,
                self._before(name),
                actual,
                planned.type,
                category,
                reason,
                planned.nearest,
                planned.renamed,
            )

        if planned.status is PlanStatus.UNCHANGED:
            is_set = name in self.sent
            return row(ApplyStatus.SET, self._notes.get(name, "")) if is_set else row(ApplyStatus.UNCHANGED)
        if (settled := self.rows.get(name)) is not None:
            return replace(settled, actual=actual) if self._is_verified else settled
        answered = "acknowledged" if name in self.written else "sent, not acknowledged"
        if name in self.sent and actual is None:
            reason = f"{answered}, and the vehicle no longer reports it"
            return replace(row(ApplyStatus.UNPROVEN, reason), nearest=())
        if planned.status in (PlanStatus.SKIPPED, PlanStatus.INVALID):
            return row(ApplyStatus.SKIPPED, planned.reason, planned.category)
        if planned.status is PlanStatus.LATER:
            return row(ApplyStatus.SKIPPED, planned.reason_missing, MISSING)
        if name not in self.sent:
            return row(ApplyStatus.FAILED, "not reached")
        if not self._is_verified:
            held = self._component.params.get(name) if name in self.written else None
            actual = actual if held is None else held.settable
            return row(ApplyStatus.UNPROVEN, f"{answered}, and not read back")
        if self._is_action(name):
            return row(ApplyStatus.SET, "done by the vehicle")
        return row(ApplyStatus.ADJUSTED, "the vehicle acknowledged it, and changed it afterwards")


async def _call_and_wait(function: Callable[[], object]) -> None:
    """Call a function; if it is asynchronous, wait for its end."""
    result = function()
    if isinstance(result, Awaitable):
        await result
