"""The subcommands apply, verify and restore over a service, with the output of those on a link.

A set-up runs at the service as a job.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import anyio

from paramclient.cli.confirmation import can_confirm, confirm
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.file_output import described
from paramclient.cli.metadata import VEHICLE, request_from_vehicle
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import print_document, printable, progress_bar, report, say
from paramclient.cli.restore_states import choices_error, named_state, restore_command, undone_by
from paramclient.cli.session import CommandSession, connect, receiver_in_words, wait_for_firmware
from paramclient.cli.setup_results import (
    NamedVehicle,
    applied_code,
    met_code,
    planned_code,
    show_applied,
    show_interrupted,
    show_planned,
    show_verified,
)
from paramclient.cli.targets import Source, describe
from paramclient.client.local import ServiceComponent
from paramclient.documents.setup import (
    AppliedRowDoc,
    ApplyResultDoc,
    InterruptedDoc,
    PlanDoc,
    PlanRowDoc,
    StepDoc,
    VerifiedDoc,
)
from paramclient.errors import AlreadyRestored, LinkError, NoReply, NotInCache, ParamClientError, UsageError
from paramclient.files import FileFormat, dumps
from paramclient.model.notation import parse_value
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, type_of_name
from paramclient.protocol.params.fetch_result import Progress
from paramclient.provision import MISSING, ApplyRow, ApplyStatus, Plan, PlanRow, PlanStatus
from paramclient.provision.planning import NOT_ON_VEHICLE, Stage, Step

__all__ = ["ServiceSetUp", "apply_over_service", "restore_over_service", "verify_over_service"]

JOB_POLL_INTERVAL: Final = 0.25
"""Seconds between two requests for the state of the job: the service updates its progress as often."""
JOB_CANCEL_TIMEOUT: Final = 3.0
"""Seconds in which Ctrl-C waits for the end of the job: the values in flight take one round trip."""


@dataclass(frozen=True, slots=True)
class ServiceSetUp:
    """The options of a subcommand that a service takes, as in the subcommand."""

    include: Sequence[str]
    reboot: bool = False
    allow_armed: bool = False
    skip_invalid: bool = False
    force: bool = False
    durable: bool = False
    renames: str | None = None
    full: bool = False

    @property
    def of_writing(self) -> dict[str, Any]:
        """The members of a request for any set-up, in addition to those for its plan."""
        return {"full": self.full, "reboot": self.reboot, "allow_armed": self.allow_armed}

    def body(self, wanted: ParamSet) -> dict[str, Any]:
        """Return the request for a comparison or a plan of apply. Values are sent as they are in the file.

        Raises:
            FileError: the file of --renames cannot be read.
        """
        content = dumps(wanted, file_format=FileFormat.JSON).decode()
        body: dict[str, Any] = {
            "wanted": {"file": {"name": Path(wanted.source).name, "text": content, "format": "json"}},
            "include": list(self.include),
            "force": self.force,
        }
        if self.renames is not None:
            text = Path(self.renames).read_text(encoding="utf-8")
            body["renames"] = {"name": Path(self.renames).name, "text": text}
        return body


async def apply_over_service(
    url: str,
    source: Source,
    choices: ServiceSetUp,
    options: LinkOptions,
    *,
    metadata: str | None,
    dry_run: bool,
    yes: bool,
) -> ExitCode:
    """Set up a vehicle of a service; see the subcommand apply.

    Ctrl-C cancels the job of the service. If it cannot be cancelled, its number is printed.

    Args:
        url: the service.
        source: the wanted parameters, which are read here.
        choices: the options for the service.
        options: they name the vehicle.
        metadata: None, or `vehicle` to let the service request the metadata first.
        dry_run: print the values that would be sent.
        yes: do not ask for confirmation.

    Raises:
        ParamClientError: as apply on a link; LinkError also if the service cannot be reached.
    """
    await source.open()
    async with connect(url, options, only=True) as session:
        component = _of_service(session)
        wanted = await _wanted(source, component)
        if metadata == VEHICLE:
            await request_from_vehicle(session)
        await wait_for_firmware([component], session.deadline)
        body = choices.body(wanted)
        more = choices.of_writing | {"skip_invalid": choices.skip_invalid, "durable": choices.durable}
        set_up = _SetUp(session, component, choices, wanted, "apply", body, body | more)
        return await set_up.ask_and_run(dry_run=dry_run, yes=yes)


async def restore_over_service(
    url: str,
    when: float | None,
    choices: ServiceSetUp,
    options: LinkOptions,
    *,
    dry_run: bool,
    yes: bool,
) -> ExitCode:
    """Restore an earlier state of a vehicle of a service, from its cache; see the subcommand restore.

    Ctrl-C as with `apply_over_service`. The state is named by its time, so that another apply cannot change
    what is restored.

    Args:
        url: the service.
        when: a float is a time in unix seconds, an int the number of a snapshot, None the state before the
            last apply.
        choices, options, dry_run, yes: as in `apply_over_service`.

    Raises:
        ParamClientError: as restore on a link; LinkError also if the service cannot be reached.
    """
    async with connect(url, options, only=True) as session:
        component = _of_service(session)
        await wait_for_firmware([component], session.deadline)
        try:
            if when is None:
                state = undone_by(await component.load_restore_point())
            else:
                state = named_state(await component.load_state(when), when)
        except NotInCache as error:
            if when is None:
                raise NotInCache(f"{error}, such as '2h ago'") from None
            raise
        except AlreadyRestored as error:
            raise choices_error(error, url, options, component) from None
        params = state.params
        say(printable(f"the state: {described(params)}"))
        if state.point:
            say(printable(f"the state is that {state.point}; {state.changes}"))
        body = {"include": list(choices.include), "force": choices.force}
        body |= {"snapshot": when} if isinstance(when, int) else {"at": params.at}
        more = choices.of_writing
        again = restore_command(url, state.name, options) if state.name else ""
        set_up = _SetUp(session, component, choices, params, "restore", body, body | more, state.point, again)
        return await set_up.ask_and_run(dry_run=dry_run, yes=yes)


async def verify_over_service(
    url: str, source: Source, choices: ServiceSetUp, options: LinkOptions, *, metadata: str | None
) -> ExitCode:
    """Compare a vehicle of a service with parameters; see the subcommand verify.

    Args:
        url, source, choices, options, metadata: as in `apply_over_service`.

    Raises:
        ParamClientError: as verify on a link; LinkError also if the service cannot be reached.
    """
    await source.open()
    async with connect(url, options) as session:
        component = _of_service(session)
        wanted = await _wanted(source, component)
        if metadata == VEHICLE:
            await request_from_vehicle(session)
        body = choices.body(wanted)
        if options.json:
            body["full"] = choices.full
            left = session.deadline.left()
            document = VerifiedDoc.model_validate(await component.compare(body, timeout=left))
            print_document(document)
            return ExitCode.DONE if document.met else ExitCode.DIFFERENT
        compared = _SetUp(session, component, choices, wanted, "apply", body, {})
        plan = await compared.plan()
        show_verified({compared.vehicle: plan}, full=choices.full)
        return met_code(plan)


def _of_service(session: CommandSession) -> ServiceComponent:
    component = session.component
    assert isinstance(component, ServiceComponent)
    return component


async def _wanted(source: Source, component: ServiceComponent) -> ParamSet:
    """Return the wanted parameters, meant for this component."""
    wanted = (await source.wanted([component]))[component.system, component.component]
    return replace(wanted, component=component.component, system=None)


@dataclass(frozen=True)
class _SetUp:
    """One set-up of a vehicle of a service.

    Attributes:
        wanted: the wanted parameters, or the state to restore.
        to_plan: the request for the plan.
        to_run: the request for the set-up.
        point: the restore point in words; "" for none.
        again: the command that continues after an interruption; "" for the given one.
    """

    session: CommandSession
    component: ServiceComponent
    choices: ServiceSetUp
    wanted: ParamSet
    kind: Literal["apply", "restore"]
    to_plan: Mapping[str, Any]
    to_run: Mapping[str, Any]
    point: str = ""
    again: str = ""

    @cached_property
    def vehicle(self) -> NamedVehicle:
        """The vehicle as the output names it."""
        each = self.component
        return NamedVehicle(
            each.system, each.component, describe(each), receiver_in_words(each), each.identity
        )

    @property
    def _commands(self) -> Mapping[NamedVehicle, str]:
        return {self.vehicle: self.again} if self.again else {}

    async def ask_and_run(self, *, dry_run: bool, yes: bool) -> ExitCode:
        """Print the plan, or ask for confirmation, run the set-up and print its result."""
        session, choices = self.session, self.choices
        if dry_run:
            return await self.show_plan()
        if not yes and can_confirm(session.options):
            plan = await self.plan()
            if plan.steps or choices.reboot:
                show_planned({self.vehicle: plan}, reboot=choices.reboot, full=choices.full)
                if not await confirm("go on?"):
                    return ExitCode.INCOMPLETE
        if not session.options.json:
            say(printable(f"writing to {receiver_in_words(self.component)} on {session.client.link.name}"))
        await session.check_only()
        return self.show_result(await self.run())

    async def plan(self) -> Plan:
        """Return the plan of the service, with every parameter."""
        return _plan_of(await self._planned(full=True), self.wanted, self.vehicle)

    async def show_plan(self) -> ExitCode:
        """Print the plan; return the exit code that the set-up is expected to have."""
        choices = self.choices
        plan = await self.plan()
        if self.session.options.json:
            print_document(await self._planned(full=choices.full))
        else:
            show_planned({self.vehicle: plan}, reboot=choices.reboot, full=choices.full)
        code = planned_code(plan, skip_invalid=choices.skip_invalid)
        if self.component.is_armed and not choices.allow_armed:
            report(f"{self.vehicle.label} is armed; nothing would be set now without --allow-armed")
            return max(code, ExitCode.INCOMPLETE)
        return code

    async def _planned(self, *, full: bool) -> PlanDoc:
        body = {**self.to_plan, "full": full}
        timeout = self.session.deadline.left()
        return PlanDoc.model_validate(await self.component.plan_set_up(self.kind, body, timeout=timeout))

    async def run(self) -> ApplyResultDoc:
        """Run the set-up as a job, and return its result; see `apply_over_service` for Ctrl-C."""
        began, timeout = anyio.current_time(), self.session.deadline.left()
        job = str((await self.component.begin_set_up(self.kind, self.to_run, timeout=timeout))["id"])
        title = "setting" if self.kind == "apply" else "restoring"
        try:
            with progress_bar(f"{title} {self.vehicle.label}") as draw:

                def report_progress(progress: Mapping[str, Any]) -> None:
                    if draw is not None:
                        draw(_progress_of(progress, anyio.current_time() - began))

                state = await self._ended(job, report_progress)
        except anyio.get_cancelled_exc_class():
            with anyio.CancelScope(shield=True):
                await self._cancel(job)
            raise
        except (LinkError, NoReply):
            report(self._continues(job))
            raise
        if state["state"] != "done":
            raise UsageError(f"the set-up of {self.vehicle.label} was cancelled at the service, job {job}")
        return ApplyResultDoc.model_validate(state["result"])

    async def _ended(
        self, job: str, report_progress: Callable[[Mapping[str, Any]], None] | None = None
    ) -> Mapping[str, Any]:
        """Wait for the end of a job, and return its last state."""
        while True:
            state = await self.component.read_job(job)
            if state["state"] != "running":
                return state
            if report_progress is not None and state["progress"] is not None:
                report_progress(state["progress"])
            await anyio.sleep(JOB_POLL_INTERVAL)

    async def _cancel(self, job: str) -> None:
        """Cancel a job and print the outcomes so far; or its number, if that is not possible.

        If the job has ended meanwhile, prints its result.
        """
        state: Mapping[str, Any] = {"state": "running"}
        try:
            with anyio.move_on_after(JOB_CANCEL_TIMEOUT):
                await self.component.cancel_job(job)
                state = await self._ended(job)
        except ParamClientError as error:
            report(str(error))
        if state["state"] == "running":
            report(self._continues(job))
            return
        if state["state"] == "done":
            self.show_result(ApplyResultDoc.model_validate(state["result"]))
            return
        if state["result"] is None:
            report(f"job {job} was cancelled before anything was written")
            return
        document = InterruptedDoc.model_validate(state["result"])
        if self.session.options.json:
            print_document(document)
            return
        rows = [_applied_row(name, row, self.wanted) for name, row in document.params.items()]
        show_interrupted({self.vehicle: rows}, self._commands)

    def _continues(self, job: str) -> str:
        """Return that a job may still run, and how to look at it and cancel it."""
        address = f"{self.session.client.link.name.partition('?')[0].rstrip('/')}/api/v1/jobs/{job}"
        return (
            f"the set-up of {self.vehicle.label} goes on at the service as job {job}: GET {address} shows "
            f"it, DELETE {address} cancels it"
        )

    def show_result(self, document: ApplyResultDoc) -> ExitCode:
        """Print the result; return the exit code."""
        error = None
        if document.error is not None:
            problem = document.problem
            error = ParamClientError(document.error)  # of an earlier version of the service
            if problem is not None:
                error = self.component.error_of_problem(problem.as_json())
        result = _Applied(document, self.wanted, error)
        if self.session.options.json:
            print_document(document.model_copy(update={"problem": None}))
        else:
            show_applied({self.vehicle: result}, full=self.choices.full, commands=self._commands)
        if self.point and error is None:
            say(printable(f"{self.vehicle.label}: restored the state {self.point}"))
        return applied_code(result)


class _Applied:
    """A result of the service, as `ApplyResult`. Its rows are only those to show."""

    def __init__(self, document: ApplyResultDoc, wanted: ParamSet, error: ParamClientError | None) -> None:
        self.system, self.component = document.now.system, document.now.component
        self.rows = {name: _applied_row(name, row, wanted) for name, row in document.params.items()}
        self.shown_rows = list(self.rows.values())
        self.counts: Mapping[ApplyStatus, int] = Counter(document.counts)
        self.complete = document.complete
        self.reboot_required = tuple(document.reboot_required)
        self.elapsed = document.elapsed_s
        self.error = error


def _plan_of(document: PlanDoc, wanted: ParamSet, vehicle: NamedVehicle) -> Plan:
    """Return the plan of a document with every parameter."""
    rows = {name: _plan_row(name, row, wanted) for name, row in document.params.items()}
    by_name = {row.target.name: row for row in rows.values()}
    stages = tuple(
        Stage(
            stage.purpose,
            tuple(_step(step, by_name[step.name].wanted) for step in stage.steps),
            reboot_first=stage.reboot_first,
        )
        for stage in document.stages
    )
    return Plan(wanted, rows, stages, identity=vehicle.identity)


def _step(document: StepDoc, wanted: WrittenParam) -> Step:
    kind = _type_of(document.type)
    assert kind is not None
    value, before = parse_value(document.value, kind), parse_value(document.before, kind)
    return Step(document.name, value, kind, before, document.needs_reboot, wanted)


def _plan_row(name: str, document: PlanRowDoc, wanted: ParamSet) -> PlanRow:
    note = ""
    if document.category == MISSING:
        note = document.reason.removeprefix(NOT_ON_VEHICLE).removeprefix("; ")
    return PlanRow(status=PlanStatus(document.status), rename_note=note, **_members(name, document, wanted))


def _applied_row(name: str, document: AppliedRowDoc, wanted: ParamSet) -> ApplyRow:
    actual = _value(document.actual, _type_of(document.type))
    return ApplyRow(status=ApplyStatus(document.status), actual=actual, **_members(name, document, wanted))


def _members(name: str, document: PlanRowDoc | AppliedRowDoc, wanted: ParamSet) -> dict[str, Any]:
    """Return the attributes that the rows of plans and results share."""
    kind = _type_of(document.type)
    target = parse_value(document.wanted, ParamType.REAL64 if kind is None else kind)
    given = wanted.get(name) or WrittenParam(name, target, kind)
    renamed = None
    if document.vehicle_name is not None:
        renamed = WrittenParam(document.vehicle_name, target, kind)
    return {
        "wanted": given,
        "before": _value(document.before, kind),
        "type": kind,
        "category": document.category,
        "reason": document.reason,
        "nearest": tuple(document.nearest),
        "renamed": renamed,
    }


def _value(given: object, kind: ParamType | int | None) -> WireValue | None:
    return None if given is None else parse_value(given, ParamType.REAL32 if kind is None else kind)


def _type_of(name: str | None) -> ParamType | int | None:
    return None if name is None else type_of_name(name)


def _progress_of(document: Mapping[str, Any], seconds: float) -> Progress:
    done, total = int(document["done"]), int(document["total"])
    rate = done / seconds if seconds else 0.0
    return Progress(done, total, rate, (total - done) / rate if rate else None)
