"""One set-up: store what the vehicle has, write what is wanted in an order that works, prove it."""

from __future__ import annotations

import math
import os
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Final

import anyio

from paramclient.client.component import Component
from paramclient.client.local import local
from paramclient.errors import (
    AnotherVehicle,
    InvalidParameters,
    LinkError,
    NoReply,
    ParamClientError,
    ParamErrorCode,
    Refused,
    UsageError,
    VehicleArmed,
    VehicleError,
)
from paramclient.model.identity import SHARED_UIDS, Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Value
from paramclient.protocol.params.change_origin import check_asker
from paramclient.provision.cautions import READ_ONLY, cautions_for
from paramclient.provision.inspection import (
    LOOKING_PACE,
    Seen,
    identified,
    look,
    look_again,
    look_for,
    plan_for,
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

__all__ = ["Run"]

WRITES_AT_ONCE: Final = 10
"""Writes that are under way side by side: what ArduPilot's queue takes of reads without dropping any."""
MOST_WRITES: Final = 2
"""Times that a value is written which the vehicle has taken, and does not have any more when it is looked at:
another one that was set may have changed it."""
MOST_SILENT: Final = 3
"""Writes without an answer, and none with one between them, after which no further is begun."""
RESET_SYSTEM: Final = 1
"""The system id that a PX4 has after SYS_AUTOCONFIG: MAV_SYS_ID is not among what its start script keeps."""
LASTING_TIME: Final = 1.2
"""Seconds after the last write before the vehicle is looked at for proof: modules of PX4 clamp values up to
815 ms after the acknowledgement, and set others up to 1 s after it (measured)."""
HEARTBEAT_PATIENCE: Final = 3.0
"""Seconds for a heartbeat to say whether the vehicle is armed; there is one a second, and some are lost."""
FOLLOW_PATIENCE: Final = 10.0
"""Seconds for a vehicle to be heard under its new system id; ArduPilot sends its next heartbeat under it."""

ID_CHANGE_TIME: Final = 2.5
"""Seconds after the acknowledgement of SYSID_THISMAV: a vehicle whose heartbeats have the old id then takes
the new one with the next start, as ArduCopter does. ArduPlane and Rover take it within a second (measured
with 4.6-dev)."""


class Run:
    """One `apply`.

    Attributes:
        seen: the vehicle as it was looked at last.
        plan: what is to be done then.
        rows: what became of those on which the last word is spoken before the proof.
        sent: to which a PARAM_SET may have gone out.
        written: what has taken the value, and how often.
    """

    seen: Seen
    plan: Plan
    _first_identity: Identity

    def __init__(
        self,
        component: Component,
        wanted: ParamSet | Plan,
        *,
        include: tuple[str, ...],
        info: Mapping[str, ParamInfo] | None,
        reboot: bool,
        allow_armed: bool,
        skip_invalid: bool,
        force: bool,
        durable: bool = False,
        backup: str | os.PathLike[str] | None,
        asker: str | None,
        progress: Callable[[ApplyProgress], None] | None,
        before_writing: Callable[[], Awaitable[object]] | None,
        reason: str,
        leaves_read_only: bool = False,
    ) -> None:
        self._component = component
        self._planned_for: Identity | None = None
        if isinstance(wanted, Plan):
            self._planned_for = wanted.identity
            include = (*wanted.include, *include)
            force = force or wanted.force
            wanted = wanted.wanted
        self._wanted = wanted
        self._include = include
        self._info = info
        self._reboot = reboot
        self._allow_armed = allow_armed
        self._skip_invalid = skip_invalid
        self._force = force
        self._durable = durable
        self._backup = backup
        self._asker = check_asker(asker)
        self._progress = progress
        self._before_writing = before_writing
        self._reason = reason
        self._leaves_read_only = leaves_read_only
        self._cautions = cautions_for("")
        self._began = anyio.current_time()
        self.rows: dict[str, ApplyRow] = {}
        self.sent: set[str] = set()
        self.written: dict[str, int] = {}
        self._first: Seen | None = None
        self._first_plan: Plan | None = None
        self._is_proven = True  # nothing was written since it was looked at
        self._written_at = -math.inf  # when the last write ended
        self._looked_at = -math.inf  # when the vehicle began to be looked at
        self._notes: dict[str, str] = {}  # of what was written, what else is to be known
        self._reboot_for: dict[str, None] = {}
        self._reboots = 0
        self._kept_over: set[str] = set()  # what was written before the last start, and should be there
        self._new_system: int | None = None  # its id from the next start on
        self._silent = 0
        self._error: ParamClientError | None = None

    async def prepare(self) -> None:
        """Look at the vehicle, plan, and store what it has. Nothing is written if that fails."""
        if self._durable and local(self._component).client.cache is None:
            raise UsageError("durable needs a cache, and the client keeps none")
        check_component(self._wanted, self._component.component)
        plan({}, self._wanted, include=self._include, autopilot=self._component.autopilot)
        await identified(self._component)
        self._cautions = cautions_for(self._component.autopilot)
        whose, own = self._planned_for, self._component.identity
        if whose is not None and not whose.is_same_vehicle(own):
            raise UsageError(f"the plan is one for another vehicle: {whose}; this one is {own}")
        await self._check_armed()
        await self._look()
        self._first, self._first_plan = self.seen, self.plan
        self._first_identity = self._component.identity
        invalid = {row.name: row.reason for row in self.plan.of(PlanStatus.INVALID)}
        if invalid and not self._skip_invalid:
            raise InvalidParameters(invalid)
        self._check_resets()
        if self._before_writing is not None:
            await self._before_writing()
        await self._store()

    async def work(self) -> None:
        """Write and prove until there is nothing left to do. Failures end it; see `result`."""
        sync = local(self._component).machine.sync
        sync.holds += 1  # a moved count leads to no download beside those of the run
        try:
            while True:
                stages = self._to_do()
                for stage in stages:
                    await self._check_armed()
                    await self._write_stage(stage)
                if self._has_to_start(stages):
                    await self._restart()
                    await self._look()
                    self._settle_lost()
                elif self._may_reveal(stages):
                    await self._look_for_more(stages[-1])
                elif stages or self._looked_at < self._written_at + LASTING_TIME:
                    await anyio.sleep_until(self._written_at + LASTING_TIME)
                    await self._prove()
                else:
                    break
            if self._durable and self.sent:
                vehicle = local(self._component)
                await vehicle.client.cache_writer.write_durably(vehicle.machine)
        except ParamClientError as error:
            if not self.sent:
                raise
            self._error = error
        finally:
            sync.holds -= 1

    def result(self) -> ApplyResult:
        """What came of it."""
        assert self._first is not None
        assert self._first_plan is not None
        return ApplyResult(
            self._component.system,
            self._component.component,
            {name: self._row(row) for name, row in self.plan.rows.items()},
            self._first_plan,
            self._first.table,
            self.plan.extra,
            self._reboots,
            tuple(self._reboot_for),
            self._error,
            anyio.current_time() - self._began,
        )

    def ended_by_time(self) -> ApplyResult:
        """What came of it so far."""
        waited = anyio.current_time() - self._began
        error = NoReply(f"the set-up of {self._address}", attempts=0, waited=waited)
        if not self.sent:
            raise error
        self._error = error
        return self.result()

    # What is to be done

    def _to_do(self) -> list[Stage]:
        """The stages up to and with the one after which the vehicle has to be looked at."""
        stages = []
        may_appear = bool(self.plan.of(PlanStatus.LATER))
        for stage in self.plan.stages:
            steps = tuple(step for step in stage.steps if self._is_open(step.name))
            if steps:
                stages.append(replace(stage, steps=steps))
                if (stage.reveals and may_appear) or (stage.reboot_first and self._reboot):
                    break
        return stages

    def _may_reveal(self, done: list[Stage]) -> bool:
        """Whether more is to be written as soon as the vehicle has been looked at, now that this is done."""
        return bool(done) and done[-1].reveals and bool(self.plan.of(PlanStatus.LATER))

    def _has_to_start(self, done: list[Stage]) -> bool:
        """Whether the vehicle has to start again, now that these stages are done."""
        if not self._reboot:
            return False
        if done:
            return done[-1].reboot_first and bool(self._reboot_for)
        has_not_started = bool(self.plan.unstarted) or self._system_to_come() is not None
        return bool(self._reboot_for) or (has_not_started and not self._reboots)

    def _system_to_come(self) -> int | None:
        """The system id that the vehicle has been given, and will only have from its next start on."""
        for name, row in self.plan.rows.items():
            is_set = row.status is PlanStatus.UNCHANGED and self._cautions.is_system_id(name)
            if is_set and isinstance(row.before, int) and row.before != self._component.system:
                return row.before
        return None

    def _is_open(self, name: str) -> bool:
        """Whether it is to be written, now that the vehicle does not have the value."""
        if name in self.rows:
            return False
        most = 1 if self._is_action(name) else MOST_WRITES
        return self.written.get(name, 0) < most

    def _is_action(self, name: str) -> bool:
        caution = self._cautions.left_out(name)
        return caution is not None and caution.category == "action"

    # What is asked of the vehicle

    async def _look(self) -> None:
        self._tell("reading")
        absent = self.seen.absent if self._first is not None else frozenset[str]()
        self._looked_at = anyio.current_time()
        self.seen = await look(self._component, self._wanted, absent, whole=self._first is None)
        self._check_it_is_the_same()
        self._plan_again()
        self._is_proven = True

    async def _prove(self) -> None:
        """Look at what is wanted, by name where that takes less time than the whole table.

        Not where a switch may have shown more than is known by name.
        """
        rows = [*self.plan.of(PlanStatus.SET), *self.plan.of(PlanStatus.UNCHANGED)]
        names = [row.name for row in rows]
        if self.plan.of(PlanStatus.LATER) or not self.seen.reads_are_quicker(len(names)):
            await self._look()
            return
        self._tell("reading")
        self._looked_at = anyio.current_time()
        self.seen = await look_again(self._component, self.seen, names)
        self._check_it_is_the_same()
        self._plan_again()
        self._is_proven = True

    async def _look_for_more(self, done: Stage) -> None:
        """See by name what may have appeared after a stage. Nothing that was written is proven by that."""
        self._tell("reading")
        names = [row.name for row in self.plan.of(PlanStatus.LATER)]
        if self._component.autopilot == "ardupilot":  # a switch shows its own group, and all begin alike
            groups = tuple(step.name.rpartition("_")[0] for step in done.steps)
            names = [name for name in names if name.startswith(groups)]
        self.seen = await look_for(self._component, self.seen, names)
        self._check_it_is_the_same()
        self._plan_again()

    def _plan_again(self) -> None:
        """Work out what is to be done, now that the vehicle has been looked at."""
        self.plan = plan_for(
            self._component, self.seen.table, self._wanted, self._include, self._info, force=self._force
        )

    async def _write_stage(self, stage: Stage) -> None:
        """Write its values, side by side but for what may end the conversation."""
        steps = iter(stage.steps)
        if stage.is_last:
            await self._write_each(steps)
        else:
            async with anyio.create_task_group() as writing:
                for _ in range(WRITES_AT_ONCE):
                    writing.start_soon(self._write_each, steps)
        if self._error is not None:
            raise self._error

    async def _write_each(self, steps: Iterator[Step]) -> None:
        """Write what nobody else has taken, until it is the end."""
        for step in steps:
            if self._error is not None:
                return
            try:
                if self._cautions.is_system_id(step.name):
                    await self._write_system_id(step)
                else:
                    await self._write(step)
            except (NoReply, LinkError) as error:
                self._error = error

    async def _write(self, step: Step) -> None:
        self._is_proven = False
        self.sent.add(step.name)
        try:
            done = await self._component.set(step.name, step.value, force=self._force, asker=self._asker)
        except (VehicleError, UsageError) as error:
            self._silent = 0
            is_read_only = isinstance(error, Refused) and error.code == ParamErrorCode.READ_ONLY
            if is_read_only and self._leaves_read_only:
                reason = "left out: the vehicle says that it can only be read"
                self._settle(step, ApplyStatus.SKIPPED, step.before, reason, READ_ONLY)
            else:
                self._settle(step, ApplyStatus.REFUSED, step.before, str(error))
            return
        except NoReply as error:
            self._silent += 1
            self._settle(step, ApplyStatus.FAILED, None, str(error))
            if self._silent >= MOST_SILENT:
                raise
            return
        except LinkError as error:
            self._settle(step, ApplyStatus.FAILED, None, str(error))
            raise
        finally:
            self._written_at = anyio.current_time()
        self._silent = 0
        self._note_written(step)
        self._notes[step.name] = done.note
        if self._is_action(step.name) and self._cautions.resets(step.name):
            self._new_system = RESET_SYSTEM
        if done.adjusted:
            self._settle(step, ApplyStatus.ADJUSTED, done.actual, "the vehicle made another value of it")
        else:
            self._tell("writing", self._row_of(step, ApplyStatus.SET, done.actual, done.note))

    async def _write_system_id(self, step: Step) -> None:
        """Set the system id, and go on with the vehicle under its new one."""
        system = int(step.value) if not isinstance(step.value, bytes) else 0
        client = local(self._component).client
        if any(self._is_another_with(system, known) for known in client.components.values()):
            reason = f"another one on this link is system {system}"
            self._settle(step, ApplyStatus.SKIPPED, step.before, reason, WRONG)
            return
        if self._cautions.needs_reboot(step.name):
            await self._write(step)
            if step.name in self.written:
                self._new_system = system
            return
        self._is_proven = False
        self.sent.add(step.name)
        failure: ParamClientError | None = None
        keeps_id = False

        async def stop_if_it_keeps_its_id() -> None:
            nonlocal keeps_id
            await self._set_and_see_it_keep_its_id(step)
            keeps_id = True
            sending.cancel_scope.cancel()

        async with anyio.create_task_group() as sending:
            sending.start_soon(stop_if_it_keeps_its_id)
            try:
                self._component = await client.successor(self._component, system, timeout=FOLLOW_PATIENCE)
            except ParamClientError as error:  # raised in here, it would come out in a group
                failure = error
            sending.cancel_scope.cancel()
        self._written_at = anyio.current_time()
        step = replace(step, needs_reboot=keeps_id)
        if keeps_id:
            self._new_system = system
        if failure is None:
            self._note_written(step)
            self._tell("writing", self._row_of(step, ApplyStatus.SET, step.value))
            return
        self._settle(step, ApplyStatus.FAILED, None, str(failure))
        if isinstance(failure, LinkError):
            raise failure

    def _is_another_with(self, system: int, known: Component) -> bool:
        """Whether another vehicle has this system id: not ours under an earlier one, nor one that is gone."""
        uid = self._component.identity.uid
        is_ours = uid is not None and uid not in SHARED_UIDS and known.identity.uid == uid
        return known.system == system and known.state != "lost" and not is_ours

    async def _set_and_see_it_keep_its_id(self, step: Step) -> None:
        """Set the system id, and return when the vehicle has acknowledged that and still has the old one.

        ArduPlane and Rover may take the new one before they have answered. This then never returns.
        """
        component = self._component
        with suppress(ParamClientError):
            await component.set(step.name, step.value, asker=self._asker)
            acknowledged_at = anyio.current_time()
            while local(component).machine.presence.beat_at < acknowledged_at + ID_CHANGE_TIME:  # noqa: ASYNC110 - nobody tells
                await anyio.sleep(LOOKING_PACE)
            return
        await anyio.sleep_forever()

    async def _restart(self) -> None:
        """Start the vehicle again, and go on with it; under its new system id if it has been given one."""
        await self._check_armed()
        self._tell("rebooting")
        system = self._system_to_come() if self._new_system is None else self._new_system
        self._component = await self._component.reboot(system=system)
        self._new_system = None
        self._reboots += 1
        # what such a start takes back is set again
        takes_back = any(self._cautions.resets(name) for name in self._reboot_for)
        self._kept_over = set() if takes_back else set(self.written)
        self._notes.clear()  # what they say has happened, or has not
        self._reboot_for.clear()

    def _settle_lost(self) -> None:
        """Tell of what the vehicle had taken, and has another value of since it has started again.

        It is not set again: the next start would do the same to it.
        """
        for step in self.plan.steps:
            if step.name in self._kept_over and step.name not in self.rows:
                reason = "the vehicle acknowledged it, and has another value since it has started again"
                self._settle(step, ApplyStatus.ADJUSTED, step.before, reason)

    def _check_it_is_the_same(self) -> None:
        found = self._component.identity
        if self._first is not None and not self._first_identity.is_same_vehicle(found):
            system, component = self._component.system, self._component.component
            raise AnotherVehicle(system, component, str(self._first_identity), str(found))

    # Before anything is sent

    async def _check_armed(self) -> None:
        """See that no part of the vehicle says that it is armed, and that the one that is set says so."""
        if self._allow_armed:
            return
        component = self._component
        with anyio.move_on_after(HEARTBEAT_PATIENCE):
            while component.is_armed is None and component.state != "lost":  # noqa: ASYNC110 - nobody tells
                await anyio.sleep(LOOKING_PACE)
        heard = local(component).client.components.values()
        parts = [each for each in heard if each.system == component.system]
        if any(each.is_armed for each in parts):
            words = f"{self._address} is armed; nothing is set then"
        elif component.is_armed is None and component.state != "lost":
            words = f"{self._address} does not say whether it is armed; nothing is set then"
        else:
            return
        raise VehicleArmed(words, system=component.system, component=component.component)

    def _check_resets(self) -> None:
        """What takes others back at the next start may only be set where that start follows at once."""
        for step in self.plan.steps:
            if self._is_action(step.name) and self._cautions.resets(step.name) and not self._reboot:
                raise UsageError(
                    f"{step.name} gives others their defaults back at the next start of the vehicle; "
                    "it can only be set with reboot=True"
                )

    async def _store(self) -> None:
        """Keep what the vehicle has: in the file, and in the cache if anything is to be written."""
        client, component, seen = local(self._component).client, self._component, self.seen
        if (path := self._backup) is not None:
            from paramclient.files import write_file

            await client.cache_writer.aside(lambda: write_file(path, seen.table))
        cache = client.cache
        if cache is not None and self.plan.steps:
            await client.cache_writer.write_all()  # so that history knows what is changed from
            await client.cache_writer.aside(
                lambda: cache.store_snapshot(
                    component.identity,
                    component.component,
                    seen.table,
                    reason=self._reason,
                    hash=seen.hash,
                    complete=seen.complete,
                )
            )

    # What is told

    @property
    def _address(self) -> str:
        return f"{self._component.system}/{self._component.component}"

    def _note_written(self, step: Step) -> None:
        self.written[step.name] = self.written.get(step.name, 0) + 1
        if step.needs_reboot:
            self._reboot_for[step.name] = None

    def _settle(
        self, step: Step, status: ApplyStatus, actual: Value | None, reason: str, category: str = ""
    ) -> None:
        """The last word on a parameter, but for the proof."""
        row = self._row_of(step, status, actual, reason, category)
        self.rows[step.name] = row
        self._tell("writing", row)

    def _row_of(
        self, step: Step, status: ApplyStatus, actual: Value | None, reason: str = "", category: str = ""
    ) -> ApplyRow:
        wanted = self._wanted[step.name]
        return ApplyRow(wanted, status, self._before(step.name), actual, step.type, category, reason)

    def _before(self, name: str) -> Value | None:
        held = None if self._first is None else self._first.table.get(name)
        return None if held is None else held.value

    def _tell(self, phase: str, row: ApplyRow | None = None) -> None:
        if self._progress is not None:
            done = self.rows.keys() | self.written.keys()
            left = 0 if self._first is None else sum(step.name not in done for step in self.plan.steps)
            self._progress(ApplyProgress(phase, len(done), len(done) + left, row))

    def _row(self, planned: PlanRow) -> ApplyRow:
        """What became of a parameter in the end."""
        name, actual = planned.name, planned.before

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
            )

        if planned.status is PlanStatus.UNCHANGED:
            is_set = name in self.sent
            return row(ApplyStatus.SET, self._notes.get(name, "")) if is_set else row(ApplyStatus.UNCHANGED)
        if (settled := self.rows.get(name)) is not None:
            return replace(settled, actual=actual) if self._is_proven else settled
        answered = "acknowledged" if name in self.written else "sent, not acknowledged"
        if name in self.sent and actual is None:
            reason = f"{answered}, and the vehicle does not tell it any more"
            return replace(row(ApplyStatus.UNPROVEN, reason), nearest=())
        if planned.status in (PlanStatus.SKIPPED, PlanStatus.INVALID):
            return row(ApplyStatus.SKIPPED, planned.reason, planned.category)
        if planned.status is PlanStatus.LATER:
            return row(ApplyStatus.SKIPPED, "not on this vehicle", MISSING)
        if name not in self.sent:
            return row(ApplyStatus.FAILED, "not reached")
        if not self._is_proven:
            return row(ApplyStatus.UNPROVEN, f"{answered}, and not read back")
        if self._is_action(name):
            return row(ApplyStatus.SET, "done by the vehicle")
        return row(ApplyStatus.ADJUSTED, "the vehicle acknowledged it, and changed it afterwards")
