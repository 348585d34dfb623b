"""Tables, JSON and exit codes of plans, and of results of apply and restore."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, TypeAlias

import anyio

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import VehicleJson
from paramclient.cli.json_setup import ApplyJson, PlanJson, applied_rows
from paramclient.cli.output import Coloured, Status, print_json, print_table, printable, report, say
from paramclient.cli.session import CommandSession
from paramclient.client.component import Component
from paramclient.errors import ParamClientError
from paramclient.model.notation import typed
from paramclient.model.values import WireValue, format_value
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Progress
from paramclient.provision import (
    MISSING,
    ApplyProgress,
    ApplyResult,
    ApplyRow,
    ApplyStatus,
    FleetApplied,
    FleetVerified,
    Plan,
    PlanRow,
    PlanStatus,
)

__all__ = ["Address", "SetupOutput"]

Address: TypeAlias = tuple[int, int]
"""System id and component id."""
Cells: TypeAlias = list[object]
"""The cells of a row."""

RESULT_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""
RATE_DELAY: Final = 0.5
"""Seconds of writing after which the rate is precise enough to be shown."""
APPLIED_COLUMNS: Final = ("name", "before", "wanted", "now", "status", "reason")
"""Columns of a table of results."""


class SetupOutput:
    """Prints the plans and results of a set-up of one vehicle or of all, and returns exit codes.

    Args:
        sessions: the vehicles.
        full: whether unchanged and left-out parameters are printed.
        commands: the commands that continue after an error by address, if they are not the given command.
    """

    def __init__(
        self,
        sessions: Sequence[CommandSession],
        *,
        full: bool,
        commands: Mapping[Address, str] | None = None,
    ) -> None:
        self._sessions = {(each.component.system, each.component.component): each for each in sessions}
        self._is_all = sessions[0].choice.is_all
        self._as_json = sessions[0].options.json
        self._full = full
        self._commands = commands or {}

    def show_planned(self, fleet: FleetVerified, *, reboot: bool) -> None:
        """Print the values that would be sent, in their order, and the reasons for all others."""
        plans = fleet.results
        for address, plan in plans.items():
            if plan.firmware_note:
                say(printable(f"{self._sessions[address].label}: {plan.firmware_note}"))
        rows = {
            address: _planned_rows(plan, reboot=reboot, full=self._full) for address, plan in plans.items()
        }
        self._print_rows(["stage", "name", "before", "wanted", "status", "reason"], rows)
        for address, plan in plans.items():
            session, counts = self._sessions[address], _counted(plan.counts, PlanStatus, _PLAN_WORDS)
            say(printable(f"{session.receiver}: {counts}; nothing was sent"))
            if plan.reboot_for and not reboot:
                names = first_of(plan.reboot_for, RESULT_NAMES_MAX)
                say(printable(f"{session.label}: would take effect after a reboot: {names}"))

    def planned(self, fleet: FleetVerified, *, reboot: bool, skip_invalid: bool, allow_armed: bool) -> int:
        """Print plans; return the exit code that the set-up is expected to have."""
        self._raise_of_one(fleet.errors)
        if self._as_json:
            plans = [
                PlanJson.of(plan, system=system, component=component, full=self._full)
                for (system, component), plan in fleet.results.items()
            ]
            self._print_json(plans, fleet.errors)
        else:
            self.show_planned(fleet, reboot=reboot)
        code = self.report_errors(fleet.errors)
        for plan in fleet.results.values():
            code = max(code, _planned_code(plan, skip_invalid=skip_invalid))
        for session in [] if allow_armed else self._sessions.values():
            if session.component.is_armed:
                report(f"{session.label} is armed; nothing would be set now without --allow-armed")
                code = max(code, ExitCode.INCOMPLETE)
        return code

    def applied(self, fleet: FleetApplied) -> int:
        """Print the results of apply or restore; return the exit code."""
        self._raise_of_one(fleet.errors)
        if self._as_json:
            results = [self._applied_json(address, each) for address, each in fleet.results.items()]
            self._print_json(results, fleet.errors)
        else:
            self._show_applied(fleet.results)
        code = self.report_errors(fleet.errors)
        for result in fleet.results.values():
            if not result.complete:
                code = max(code, ExitCode.INCOMPLETE)
            if result.error is not None:
                code = max(code, code_of(result.error))
        return code

    def report_errors(self, errors: Mapping[Address, ParamClientError]) -> int:
        """Print the errors of vehicles; return the exit code for them."""
        for address, error in errors.items():
            report(f"{self._sessions[address].label}: {error}")
        return max(map(code_of, errors.values()), default=ExitCode.DONE)

    @contextmanager
    def progress_until_interrupted(self, title: str) -> Iterator[Callable[[Component, ApplyProgress], None]]:
        """Yield a function that draws the progress; on cancellation, print the outcomes so far."""
        rows: dict[Address, dict[str, ApplyRow]] = {}
        steps: dict[Address, tuple[int, int]] = {}
        began = 0.0
        try:
            with Status(f"{title}: waiting for the first response", title) as status:

                def update(component: Component, state: ApplyProgress) -> None:
                    nonlocal began
                    address = (component.system, component.component)
                    steps[address] = (state.done, state.total)
                    if state.row is not None:
                        rows.setdefault(address, {})[state.row.name] = state.row.so_far
                        began = began or anyio.current_time()
                    if began:
                        done, total = (sum(numbers) for numbers in zip(*steps.values(), strict=True))
                        seconds = anyio.current_time() - began
                        rate = done / seconds if seconds > RATE_DELAY else 0.0
                        status.update(Progress(done, total, rate, (total - done) / rate if rate else None))

                yield update
        except anyio.get_cancelled_exc_class():
            self._show_interrupted({address: list(each.values()) for address, each in rows.items()})
            raise

    def _show_applied(self, results: Mapping[Address, ApplyResult]) -> None:
        rows = {
            address: map(_applied_cells, result.rows.values() if self._full else result.shown_rows)
            for address, result in results.items()
        }
        self._print_rows(APPLIED_COLUMNS, rows)
        for address, result in results.items():
            session, counts = self._sessions[address], _counted(result.counts, ApplyStatus)
            say(printable(f"{session.receiver}: {counts} in {result.elapsed:.1f} s"))
            if (result.system, result.component) != address:
                say(f"{address[0]}/{address[1]} is {result.system}/{result.component} now")
            if result.reboot_required:
                names = first_of(result.reboot_required, RESULT_NAMES_MAX)
                say(printable(f"{session.label}: takes effect after a reboot: {names}"))
            if result.error is not None:
                report(f"{session.label}: {result.error}; {self._to_continue(address)}")

    def _show_interrupted(self, rows: Mapping[Address, Sequence[ApplyRow]]) -> None:
        """Print the outcome for each value before Ctrl-C ended the command."""
        if self._as_json:
            interrupted = [
                {
                    "system": system,
                    "component": component,
                    "complete": False,
                    "params": applied_rows(rows.get((system, component), ())),
                    "error": "interrupted",
                }
                for system, component in self._sessions
            ]
            self._print_json(interrupted, {})
            return
        cells = {address: map(_applied_cells, each) for address, each in rows.items()}
        self._print_rows(APPLIED_COLUMNS, cells)
        unproven = sum(row.status is ApplyStatus.UNPROVEN for each in rows.values() for row in each)
        commands = dict.fromkeys(map(self._to_continue, self._sessions))
        say(
            f"interrupted: {counted(unproven, 'value')} acknowledged, not proven, and others may be in "
            f"flight; {'; '.join(commands)}"
        )

    def _to_continue(self, address: Address) -> str:
        command = self._commands.get(address)
        return "run it again to continue" if command is None else printable(f"to continue: `{command}`")

    def _applied_json(self, address: Address, result: ApplyResult) -> ApplyJson:
        system, component = address
        vehicle = VehicleJson.at(system, component, self._sessions[address].component.identity)
        return ApplyJson.of(result, system=system, component=component, vehicle=vehicle, full=self._full)

    def _raise_of_one(self, errors: Mapping[Address, ParamClientError]) -> None:
        """Raise the error of the vehicle, if the command is for one."""
        if errors and not self._is_all:
            raise next(iter(errors.values()))

    def _print_json(self, objects: Sequence[object], errors: Mapping[Address, ParamClientError]) -> None:
        failed = [
            {"system": system, "component": component, "error": str(error)}
            for (system, component), error in errors.items()
        ]
        print_json({"vehicles": objects, "errors": failed} if self._is_all else objects[0])

    def _print_rows(self, columns: Sequence[str], tables: Mapping[Address, Iterable[Cells]]) -> None:
        """Print one table for all vehicles; with --vehicle all, the first column names the vehicle."""
        rows = [
            [*([self._sessions[address].address] if self._is_all else []), *cells]
            for address, each in tables.items()
            for cells in each
        ]
        if rows:
            vehicle = ["vehicle"] if self._is_all else []
            print_table([*vehicle, *columns], rows, right="before wanted now stage")


def _planned_code(plan: Plan, *, skip_invalid: bool) -> ExitCode:
    if plan.of(PlanStatus.INVALID):
        return ExitCode.INCOMPLETE if skip_invalid else ExitCode.USAGE
    is_missing = any(
        row.status is PlanStatus.SKIPPED and row.category == MISSING for row in plan.rows.values()
    )
    return ExitCode.INCOMPLETE if is_missing else ExitCode.DONE


def _planned_rows(plan: Plan, *, reboot: bool, full: bool) -> Iterator[Cells]:
    has_started = False
    restart: Cells = [None, None, None, Coloured("reboot", "yellow"), "the vehicle reboots"]
    for number, stage in enumerate(plan.stages, start=1):
        for step in stage.steps:
            row = plan.rows[step.wanted.name]
            reason = stage.purpose + (", takes effect after a reboot" if step.needs_reboot else "")
            yield [number, *_planned_cells(row)[:-1], "; ".join(filter(None, (_vehicle_name(row), reason)))]
        if reboot and stage.reboot_first:
            has_started = True
            yield [number, *restart]
    if reboot and not has_started and (plan.reboot_for or plan.awaiting_reboot):
        yield [None, *restart]
    for row in plan.rows.values():
        is_notable = row.status is not PlanStatus.UNCHANGED and row.differs
        if row.status is not PlanStatus.SET and (full or is_notable):
            yield [None, *_planned_cells(row)]


def _planned_cells(row: PlanRow) -> Cells:
    status = Coloured(row.status, _PLAN_STYLES[row.status])
    return [row.name, _text(row.before, row), _text(row.target.settable, row), status, _why(row)]


def _applied_cells(row: ApplyRow) -> Cells:
    return [
        row.name,
        _text(row.before, row),
        _text(row.target.settable, row),
        _text(row.actual, row),
        Coloured(row.status, _STYLES[row.status]),
        _why(row),
    ]


_STYLES: Final = {
    ApplyStatus.SET: "green",
    ApplyStatus.UNCHANGED: "",
    ApplyStatus.ADJUSTED: "yellow",
    ApplyStatus.REFUSED: "red",
    ApplyStatus.SKIPPED: "dim",
    ApplyStatus.UNPROVEN: "yellow",
    ApplyStatus.FAILED: "bold red",
}
"""Styles of rich for each outcome."""
_PLAN_STYLES: Final = {
    PlanStatus.SET: "green",
    PlanStatus.LATER: "yellow",
    PlanStatus.UNCHANGED: "",
    PlanStatus.SKIPPED: "dim",
    PlanStatus.INVALID: "bold red",
}
"""Styles of rich for each planned action."""
_PLAN_WORDS: Final = {PlanStatus.SET: "to set", PlanStatus.LATER: "that may be revealed"}
"""Words for planned actions in the summary, where they differ from the status."""


def _text(value: WireValue | None, row: ApplyRow | PlanRow) -> str | None:
    return None if value is None else format_value(*typed(value, row.type))


def _why(row: ApplyRow | PlanRow) -> str:
    like = f"(did you mean {', '.join(row.nearest)}?)" if row.nearest else ""
    return "; ".join(filter(None, (_vehicle_name(row), f"{row.reason} {like}".strip())))


def _vehicle_name(row: ApplyRow | PlanRow) -> str:
    return "" if row.renamed is None else f"{row.renamed.name} on this vehicle"


def _counted(counts: Mapping[Any, int], kinds: Iterable[Any], words: Mapping[Any, str] | None = None) -> str:
    found = [f"{counts[kind]} {(words or {}).get(kind, kind)}" for kind in kinds if counts.get(kind)]
    return ", ".join(found) or "nothing to set"
