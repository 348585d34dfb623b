"""One run of `apply`: store the vehicle's state, write the stages of the plan, reboot, verify."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import anyio

from paramclient.cache import check_author
from paramclient.client.component import Component
from paramclient.client.core import seconds_of
from paramclient.errors import (
    AnotherVehicle,
    CacheError,
    FileError,
    InvalidParameters,
    NoReply,
    ParamClientError,
    ParamErrorCode,
    Refused,
    UsageError,
    VehicleArmed,
)
from paramclient.files import write_file
from paramclient.model.paramset import ParamSet
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.provision.apply_rules import READ_ONLY, ApplyRules, rules_for
from paramclient.provision.inspection import Inspection, claims, inspect, plan_for, reread, wait_for_identity
from paramclient.provision.planning import ApplyRow, ApplyStatus, Plan, PlanOptions, Rows, Stage, check_keys

BEFORE_APPLY: Final = "before apply"
"""The reason of the snapshot that `apply` stores before its first write."""
BEFORE_RESTORE: Final = "before restore"
"""The reason of the snapshot that `restore` stores before its first write."""
WRITE_ATTEMPTS_MAX: Final = 2
"""Times that a value is written if the vehicle acknowledges it and later holds another value: a write of
another parameter may have changed it."""
VERIFY_DELAY: Final = 1.2
"""Seconds between the last write and the read that verifies it: modules of PX4 clamp the value, or set other
parameters, up to 1.1 s after the acknowledgement (measured)."""
OUTCOMES_TIME: Final = 0.1
"""Seconds after the timeout of a run in which its writes, which end at that, still give their outcomes."""
POLL_INTERVAL: Final = 0.05
"""Seconds between two looks at the armed state, for which there is no event."""
ARMED_STATE_TIMEOUT: Final = 3.0
"""Seconds to wait for a heartbeat with the armed flag: heartbeats arrive once a second, and some are lost."""
SYSTEM_CHANGE_TIMEOUT: Final = 5.0
"""Seconds to wait for the acknowledgement of a system id, and for the vehicle under it: ArduPlane and Rover
change it within a second (measured with 4.6-dev), and send their next heartbeat under it."""


@dataclass(frozen=True, slots=True)
class ApplyProgress:
    """The progress of `apply`.

    Attributes:
        phase: "reading", "writing" or "rebooting".
        done: number of values written in this run so far.
        total: number of values to write, as far as known.
        row: the latest outcome for one parameter; the read-back at the end may change it.
    """

    phase: str
    done: int
    total: int
    row: ApplyRow | None = None


@dataclass(frozen=True, slots=True)
class ApplyResult(Rows):
    """The result of `apply` or `restore` for one vehicle.

    Attributes:
        system: system id of the vehicle at the end; it differs from the first one if the system id was set.
        component: component id of the vehicle.
        plan: the first plan.
        before: the state that was stored before the first write.
        extra: names that the vehicle had when its whole table was last read, and that are not wanted; they
            were not changed.
        reboots: number of reboots.
        reboot_required: names that were written and take effect after a reboot.
        error: the error that ended the run early, or None. The rows are valid in both cases.
        elapsed: seconds.
    """

    system: int
    component: int
    plan: Plan
    before: ParamSet
    extra: tuple[str, ...]
    reboots: int
    reboot_required: tuple[str, ...]
    error: ParamClientError | None
    elapsed: float

    @property
    def complete(self) -> bool:
        """Whether the vehicle has all wanted values, read back, except those left out on purpose."""
        return self.error is None and all(row.is_as_wanted for row in self.rows.values())

    def __repr__(self) -> str:
        end = f", ended by {self.error}" if self.error is not None else ""
        return f"<ApplyResult {self.system}/{self.component} {self.summary} in {self.elapsed:.2f} s{end}>"


class ApplyOptions(PlanOptions, total=False):
    """Options of `apply` and `restore`, besides those of `PlanOptions`.

    Attributes:
        partial: skip invalid values and names that the vehicle does not have, and write the remaining values;
            `restore` does so by default.
        reboot: reboot the vehicle if values take effect after a reboot.
        allow_armed: continue if the vehicle is armed.
        durable: return only when the values and their history are on the disk and survive a power loss; if
            that fails, `error` of the result is a CacheError.
        backup: a new file for the state before the first write; its name determines the file format, see
            `paramclient.files`.
        timeout: seconds, after which the result reports the progress of the run.
        author: the author of the changes, as in `Component.set`.
        progress: called after each value and at the start of a phase; it must not raise.
        before_writing: called once after the vehicle was read, before its state is stored and the first value
            is written, and only if there is something to write; awaited if it is asynchronous. Its exceptions
            end the call.
    """

    partial: bool
    reboot: bool
    allow_armed: bool
    durable: bool
    backup: str | os.PathLike[str] | None
    timeout: float | None
    author: str | None
    progress: Callable[[ApplyProgress], None] | None
    before_writing: Callable[[], object] | None


async def run(
    component: Component, wanted: ParamSet, options: ApplyOptions, *, is_restore: bool
) -> ApplyResult:
    """Apply wanted parameters to a vehicle; see `apply`.

    Args:
        component, wanted, options: as in `apply`.
        is_restore: whether they are an earlier state of the vehicle. A parameter that it refuses as read-only
            is then skipped, and not reported as refused.
    """
    check_keys(options, ApplyOptions)
    began = anyio.current_time()
    error: ParamClientError | None = None
    one = _Run(component, wanted, options, is_restore=is_restore)
    try:
        with anyio.CancelScope(deadline=one.writes_until + OUTCOMES_TIME) as scope:
            await one.begin()
            with component.watch.held():  # a changed count starts no download besides those of the run
                await one.store_state()
                await one.write_and_verify()
    except ParamClientError as failure:
        error = failure
    finally:
        claims.pop(component, None)
    waited = anyio.current_time() - began
    is_late = anyio.current_time() >= one.writes_until
    if scope.cancelled_caught or (is_late and isinstance(error, NoReply)):
        error = NoReply(f"the apply to {component.system}/{component.component}", attempts=0, waited=waited)
    if error is not None and not one.sent:
        raise error
    return one.result(error, waited)


class _Run:
    """One run of `apply` or `restore`; the arguments are those of `run`.

    Attributes:
        component: the vehicle under its present system id.
        sent: parameters for which a PARAM_SET may have been sent, as the vehicle names them.
        writes_until: when the timeout ends the writes.
    """

    def __init__(
        self, component: Component, wanted: ParamSet, options: ApplyOptions, *, is_restore: bool
    ) -> None:
        check_author(options.get("author"))
        if (backup := options.get("backup")) and Path(backup).exists():
            raise UsageError(f"nothing was sent: the backup file {backup} exists already")
        self.component, self.wanted, self.options = component, wanted, options
        self.is_restore, self._reboots_allowed = is_restore, options.get("reboot", False)
        self.sent: set[str] = set()
        self.writes_until = anyio.current_time() + seconds_of(options.get("timeout"))
        self._before: ParamSet | None = None  # the state before the first write
        self._end_operation: Callable[[], None] | None = None  # records in the cache that the run has ended
        self._settled: dict[str, ApplyRow] = {}  # outcomes before the last read
        self._written: Counter[str] = Counter()  # acknowledged writes
        self._notes: dict[str, str] = {}  # of the acknowledged writes
        self._written_at = self._inspected_at = -math.inf  # end of the last write, begin of the last read
        self._reboot_for: dict[str, None] = {}
        self._reboots = 0

    @property
    def _rules(self) -> ApplyRules:
        return rules_for(self.component.autopilot, is_extended=self.component.is_extended)

    async def begin(self) -> None:
        """Inspect the vehicle, and plan."""
        component = self.component
        if self.options.get("durable") and component.core.cache is None:
            raise UsageError("durable needs a cache, and the client keeps none")
        plan_for(component, self.wanted, None, self.options)  # errors before the vehicle is read
        await wait_for_identity(component)
        self._identity = component.identity
        with component.watch.held():
            await self._check_armed()
            await self._inspect()
        self._first_plan, claims[component] = self._plan, self._plan.system_id
        if self._plan.problems and not self.options.get("partial"):
            raise InvalidParameters(self._plan.problems)
        if self.is_restore:
            self._plan.check_state()
        before_writing = self.options.get("before_writing")
        if before_writing is not None and (self._plan.to_write or self._must_reboot([])):
            result = before_writing()
            if isinstance(result, Awaitable):
                await result

    async def store_state(self) -> None:
        """Store the vehicle's state in the backup file, and in the cache if the plan has values to write."""
        component, inspection, path = self.component, self._inspection, self.options.get("backup")
        writer, cache = component.core.cache_writer, component.core.cache
        if path is not None:
            try:
                await writer.run_in_thread(lambda: write_file(path, inspection.table))
            except FileError as error:
                raise FileError(f"nothing was sent: {error.reason}", source=error.source) from error
        self._before = inspection.table
        if cache is None or not self._plan.to_write:
            return
        try:
            # the history then has the values from before the change
            await writer.write_all()
            snapshot = await writer.call(
                lambda: cache.store_snapshot(
                    component.identity,
                    component.component,
                    inspection.table,
                    reason=BEFORE_RESTORE if self.is_restore else BEFORE_APPLY,
                    hash=inspection.hash,
                    complete=inspection.complete,
                    is_of_operation=True,
                    extended=component.is_extended,
                )
            )
        except CacheError as error:
            hint = "Without a cache (--no-cache, or cache=False), none is stored"
            why = f"nothing was sent, as the state before cannot be stored: {error}. {hint}"
            raise CacheError(why) from error
        self._end_operation = partial(cache.end_operation, snapshot.id)

    async def write_and_verify(self) -> None:
        """Write and verify until no stage is pending; record in the cache that the run was not interrupted.

        Raises:
            ParamClientError: the run ended early; `result` has the outcomes so far.
        """
        while True:
            stages = self._pending_stages()
            for stage in stages:
                await self._check_armed()
                self._report("writing")
                await self._write_stage(stage)
            if self._must_reboot(stages):
                await self._reboot()
            elif stages and stages[-1].reveals and self._plan.of(ApplyStatus.LATER):
                await self._read_revealed(stages[-1])
            elif stages or self._inspected_at < self._written_at + VERIFY_DELAY:
                await anyio.sleep_until(self._written_at + VERIFY_DELAY)
                await self._verify()
            else:
                break
        if self.options.get("durable") and self.sent:
            await self.component.core.cache_writer.write_durably(self.component.node, self.component.session)
        if self._end_operation is not None:
            await self.component.core.cache_writer.attempt(self._end_operation)

    def result(self, error: ParamClientError | None, elapsed: float) -> ApplyResult:
        """Return the result of the run."""
        assert self._before is not None
        rows = {name: self._final_row(row) for name, row in self._plan.rows.items()}
        address, extra, reboot_for = self.component.address, self._plan.extra, tuple(self._reboot_for)
        return ApplyResult(
            rows, *address, self._first_plan, self._before, extra, self._reboots, reboot_for, error, elapsed
        )

    # Next stages

    def _pending_stages(self) -> list[Stage]:
        """Return the next stages, up to and including the one after which the vehicle must be inspected."""
        stages = []
        may_appear = bool(self._plan.of(ApplyStatus.LATER))
        for stage in self._plan.stages:
            if rows := tuple(row for row in stage.rows if self._may_write(row.name)):
                stages.append(replace(stage, rows=rows))
                if (stage.reveals and may_appear) or (stage.reboot_first and self._reboots_allowed):
                    break
        return stages

    def _may_write(self, name: str) -> bool:
        """Return whether a parameter whose value differs is written, or written again."""
        return name not in self._settled and self._written[name] < WRITE_ATTEMPTS_MAX

    def _must_reboot(self, done: Sequence[Stage]) -> bool:
        """Return whether the vehicle must reboot after the stages that are done."""
        if done:
            return self._reboots_allowed and done[-1].reboot_first and bool(self._reboot_for)
        is_due = self._reboot_for or (self._plan.awaiting_reboot and not self._reboots)
        return self._reboots_allowed and bool(is_due)

    def _pending_system_id(self) -> int | None:
        """Return the system id that is set and takes effect after a reboot, or None."""
        wanted, awaiting = self._plan.system_id, self._plan.awaiting_reboot
        is_pending = any(self._rules.has("system_id", each) for each in awaiting)
        return wanted if is_pending and isinstance(wanted, int) else None

    # Reads

    async def _inspect(self) -> None:
        absent = frozenset[str]() if self._before is None else self._inspection.absent
        await self._read(partial(inspect, self.component, self.wanted, absent), verifies=True)

    async def _verify(self) -> None:
        """Read the wanted parameters: by name if that is faster than the whole table, else the table.

        Always reads the table if a switch may have revealed parameters whose names are not known.
        """
        names = [row.name for row in self._plan.of(ApplyStatus.SET, ApplyStatus.UNCHANGED)]
        if self._plan.of(ApplyStatus.LATER) or not self._inspection.is_reading_faster(len(names)):
            await self._inspect()
        else:
            await self._read(partial(reread, self.component, self._inspection, names, names), verifies=True)

    async def _read_revealed(self, done: Stage) -> None:
        """Read by name the parameters that a stage may have revealed. This verifies no write."""
        names = [row.name for row in self._plan.of(ApplyStatus.LATER)]
        if self.component.autopilot == "ardupilot":  # a switch reveals the names with its own prefix
            groups = tuple(row.name.rpartition("_")[0] for row in done.rows)
            names = [name for name in names if name.startswith(groups)]
        await self._read(partial(reread, self.component, self._inspection, names))

    async def _read(self, read: Callable[[], Awaitable[Inspection]], *, verifies: bool = False) -> None:
        """Read the vehicle, and plan again from that."""
        self._report("reading")
        began = anyio.current_time()
        self._inspection = await read()
        self._check_same_vehicle()
        self._plan = plan_for(self.component, self.wanted, self._inspection, self.options)
        if verifies:
            self._inspected_at = began

    def _check_same_vehicle(self) -> None:
        """Raise `AnotherVehicle` if the identity is not that of the first inspection."""
        component, found = self.component, self.component.identity
        if not self._identity.is_same_vehicle(found):
            raise AnotherVehicle(component.system, component.component, str(self._identity), str(found))

    # Writes and reboots

    async def _write_stage(self, stage: Stage) -> None:
        """Write the values of a stage: many at a time, or one by one if they may end the connection."""
        is_last = self._rules.has("last", stage.rows[0].name)
        for rows in [[row] for row in stage.rows] if is_last else [stage.rows]:
            if self._rules.has("system_id", rows[0].name):
                await self._write_system_id(rows[0])
            else:
                await self._write(rows)

    async def _write(self, rows: Sequence[ApplyRow]) -> None:
        """Write values in order, many at a time.

        Raises:
            ParamClientError: not all values were tried.
        """
        self._check_same_vehicle()
        by_name = {row.name: row for row in rows}
        before = frozenset(self.sent)
        self.sent.update(by_name)
        self._written_at = math.inf
        try:
            done = await self.component.set_many(
                [(name, row.wanted.settable) for name, row in by_name.items()],
                force=self.options.get("force", False),
                author=self.options.get("author"),
                progress=lambda outcome: self._take(by_name[outcome.name], outcome),
                timeout=max(self.writes_until - anyio.current_time(), 0.0),
            )
        except ParamClientError:
            self.sent &= before
            raise
        finally:
            self._written_at = anyio.current_time()
        self.sent -= {each.name for each in done.outcomes if each.status is SetStatus.NOT_TRIED} - before
        if done.error is not None:
            raise done.error

    def _take(self, row: ApplyRow, outcome: SetOutcome) -> None:
        """Record the outcome of a write."""
        done, error, status = outcome.result, outcome.error, ApplyStatus(outcome.status)
        if status is ApplyStatus.ACCEPTED and done is not None:
            self._accept(row, done.note)
        elif status is ApplyStatus.ADJUSTED:
            self._count_write(row)
            self._settle(row, status, "the vehicle changed the value")
        elif self.is_restore and isinstance(error, Refused) and error.code == ParamErrorCode.READ_ONLY:
            reason = "left out: the vehicle reports that it is read-only"
            self._settle(row, ApplyStatus.SKIPPED, reason, READ_ONLY)
        elif status is not ApplyStatus.NOT_TRIED:
            self._settle(row, status, str(error))

    async def _write_system_id(self, row: ApplyRow) -> None:
        """Set the system id, and continue with the vehicle under its new one."""
        component, system, author = self.component, int(row.wanted.value), self.options.get("author")
        now = plan_for(component, self.wanted, self._inspection, self.options).rows[row.name]
        if now.status is ApplyStatus.REFUSED:  # another vehicle has appeared
            self._settle(row, now.status, now.reason, now.category)
            return
        if row.needs_reboot:
            await self._write([row])
            return
        self.sent.add(row.name)
        self._written_at, is_acknowledged = math.inf, False
        try:
            with suppress(NoReply):  # it may have its new id before it acknowledges
                await component.set(row.name, system, timeout=SYSTEM_CHANGE_TIMEOUT, author=author)
                is_acknowledged = True
            self.component = await component.client.successor(
                component, system, timeout=SYSTEM_CHANGE_TIMEOUT
            )
        except Refused as error:
            self._settle(row, ApplyStatus.REFUSED, str(error))
            return
        except NoReply as error:
            if not is_acknowledged:
                self._settle(row, ApplyStatus.UNKNOWN, str(error))
                return
        finally:
            self._written_at = anyio.current_time()
        self._accept(replace(row, needs_reboot=self.component is component))

    async def _reboot(self) -> None:
        """Reboot the vehicle, continue with it under its new system id if one is pending, and inspect it.

        Values that the vehicle had acknowledged and lost with the reboot are adjusted: they are not written
        again, as the next reboot would change them again.
        """
        await self._check_armed()
        self._report("rebooting")
        self.component = await self.component.reboot(system=self._pending_system_id())
        self._reboots += 1
        # values that a resetting parameter has reverted are written again
        is_reset = any(self._rules.has("resets", name) for name in self._reboot_for)
        kept = set() if is_reset else set(self._written)
        self._notes.clear()  # they warn of effects of this reboot
        self._reboot_for.clear()
        await self._inspect()
        for row in self._plan.to_write:
            if row.name in kept and row.name not in self._settled:
                reason = "the vehicle acknowledged the value, and has another one after the reboot"
                self._settle(row, ApplyStatus.ADJUSTED, reason)

    async def _check_armed(self) -> None:
        """Check that every component of the vehicle is disarmed, and that the component to set reports so.

        Raises:
            VehicleArmed: a component is armed, or the armed state is unknown.
        """
        component = self.component
        if self.options.get("allow_armed"):
            return
        with anyio.move_on_after(ARMED_STATE_TIMEOUT):
            while component.is_armed is None and component.state != "lost":  # noqa: ASYNC110 - no event
                await anyio.sleep(POLL_INTERVAL)
        own = [each for each in component.client.components.values() if each.system == component.system]
        if any(each.is_armed for each in own):
            problem = "is armed"
        elif component.is_armed is None and component.state != "lost":
            problem = f"does not report whether it is armed (no heartbeat within {ARMED_STATE_TIMEOUT:g} s)"
        else:
            return
        what = f"{component.system}/{component.component} {problem}; nothing is set then"
        raise VehicleArmed(what, *component.address)

    # Outcomes

    def _count_write(self, row: ApplyRow) -> None:
        self._written[row.name] += 1
        if row.needs_reboot:
            self._reboot_for[row.name] = None

    def _accept(self, row: ApplyRow, note: str = "") -> None:
        self._count_write(row)
        self._notes[row.name] = note
        self._report("writing", self._outcome(row, ApplyStatus.UNPROVEN, "acknowledged, and not read back"))

    def _settle(self, row: ApplyRow, status: ApplyStatus, reason: str, category: str = "") -> None:
        """Record an outcome that only the verification may still change, and report it."""
        self._settled[row.name] = settled = self._outcome(row, status, reason, category)
        self._report("writing", settled)

    def _outcome(self, row: ApplyRow, status: ApplyStatus, reason: str = "", category: str = "") -> ApplyRow:
        """Return a row of the plan with its outcome, and with the values before and as last sent."""
        before = None if self._before is None else self._before.get(row.name)
        held = self.component.params.get(row.name)
        return replace(
            row,
            status=status,
            before=None if before is None else before.settable,
            actual=None if held is None else held.settable,
            reason=reason,
            category=category,
        )

    def _report(self, phase: str, row: ApplyRow | None = None) -> None:
        if (progress := self.options.get("progress")) is not None:
            done = self._settled.keys() | self._written.keys()
            to_write = [] if self._before is None else self._plan.to_write
            left = sum(each.name not in done for each in to_write)
            progress(ApplyProgress(phase, len(done), len(done) + left, row))

    def _final_row(self, planned: ApplyRow) -> ApplyRow:
        """Return the row of a parameter at the end of the run."""
        name, is_sent = planned.name, planned.name in self.sent
        row = partial(self._outcome, planned)
        if planned.status is ApplyStatus.UNCHANGED:
            return row(ApplyStatus.ACCEPTED, self._notes.get(name, "")) if is_sent else row(planned.status)
        if (settled := self._settled.get(name)) is not None:
            return row(settled.status, settled.reason, settled.category)
        unread, answered = ApplyStatus.UNKNOWN, "sent, not acknowledged"
        if self._written[name]:
            unread, answered = ApplyStatus.UNPROVEN, "acknowledged"
        if is_sent and planned.before is None:
            return replace(row(unread, f"{answered}, and the vehicle no longer reports it"), nearest=())
        if planned.status is ApplyStatus.LATER:
            return row(ApplyStatus.NOT_TRIED, planned.reason, planned.category)
        if planned.status is not ApplyStatus.SET:
            return row(planned.status, planned.reason, planned.category)
        if not is_sent:
            return row(ApplyStatus.NOT_TRIED, "not reached")
        if self._inspected_at < self._written_at:
            return row(unread, f"{answered}, and not read back")
        return row(ApplyStatus.ADJUSTED, "the vehicle acknowledged it, and changed it afterwards")
