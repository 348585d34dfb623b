"""Tables and exit codes of plans, of results of apply and restore, and of comparisons."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import VehicleJson
from paramclient.cli.json_setup import ApplyJson, PlanJson, applied_rows
from paramclient.cli.output import Coloured, print_table, printable, report, say
from paramclient.errors import ParamClientError
from paramclient.model.identity import Identity
from paramclient.model.notation import typed
from paramclient.model.values import WireValue, format_value
from paramclient.model.wording import counted, first_of
from paramclient.provision import (
    MISSING,
    ApplyResult,
    ApplyRow,
    ApplyStatus,
    Plan,
    PlanRow,
    PlanStatus,
)

__all__ = [
    "Applied",
    "NamedVehicle",
    "applied_code",
    "applied_json",
    "interrupted_json",
    "planned_code",
    "planned_json",
    "show_applied",
    "show_interrupted",
    "show_planned",
]

RESULT_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""


@dataclass(frozen=True, slots=True)
class NamedVehicle:
    """A vehicle as the output names it.

    Attributes:
        system: its system id at the start of the command.
        component: its component id.
        label: its address and autopilot, `1/1 px4`.
        receiver: its address, kind and firmware, `1/1 PX4 quadrotor, firmware 1.16.0`.
        identity: its identity at the start of the command.
    """

    system: int
    component: int
    label: str
    receiver: str
    identity: Identity


class Applied(Protocol):
    """The part of `ApplyResult` that is printed."""

    @property
    def system(self) -> int:
        """As in `ApplyResult`, like all others."""

    @property
    def component(self) -> int: ...

    @property
    def rows(self) -> Mapping[str, ApplyRow]: ...

    @property
    def shown_rows(self) -> list[ApplyRow]: ...

    @property
    def counts(self) -> Mapping[ApplyStatus, int]: ...

    @property
    def complete(self) -> bool: ...

    @property
    def reboot_required(self) -> tuple[str, ...]: ...

    @property
    def error(self) -> ParamClientError | None: ...

    @property
    def elapsed(self) -> float: ...


Cells: TypeAlias = list[object]
"""The cells of a row."""


# Results


def show_applied(
    results: Mapping[NamedVehicle, Applied], *, full: bool, commands: Mapping[NamedVehicle, str] | None = None
) -> None:
    """Print one table of the outcome for each value, and a line for each vehicle on stderr.

    `commands` has the commands that continue after an error, if they are not the same command.
    """
    _print(
        ["name", "before", "wanted", "now", "status", "reason"],
        {
            vehicle: map(_applied_cells, result.rows.values() if full else result.shown_rows)
            for vehicle, result in results.items()
        },
    )
    for vehicle, result in results.items():
        say(
            printable(f"{vehicle.receiver}: {_counted(result.counts, ApplyStatus)} in {result.elapsed:.1f} s")
        )
        if (result.system, result.component) != (vehicle.system, vehicle.component):
            say(f"{vehicle.system}/{vehicle.component} is {result.system}/{result.component} now")
        if result.reboot_required:
            names = first_of(result.reboot_required, RESULT_NAMES_MAX)
            say(printable(f"{vehicle.label}: takes effect after a reboot: {names}"))
        if result.error is not None:
            again = _to_continue(vehicle, commands or {})
            report(f"{vehicle.label}: {result.error}; {again}")


def show_interrupted(
    rows: Mapping[NamedVehicle, Sequence[ApplyRow]], commands: Mapping[NamedVehicle, str] | None = None
) -> None:
    """Print the outcome for each value before Ctrl-C ended the command.

    `commands` has the commands that continue, if they are not the same command.
    """
    _print(
        ["name", "before", "wanted", "now", "status", "reason"],
        {vehicle: map(_applied_cells, each) for vehicle, each in rows.items()},
    )
    unproven = sum(row.status is ApplyStatus.UNPROVEN for each in rows.values() for row in each)
    vehicles = list(commands or rows)
    told = f"interrupted: {counted(unproven, 'value')} acknowledged, not proven, and others may be in flight"
    if not commands or len(vehicles) == 1:
        say(f"{told}; {_to_continue(vehicles[0] if vehicles else None, commands or {})}")
        return
    say(told)
    for vehicle in vehicles:
        say(f"{vehicle.label}: {_to_continue(vehicle, commands)}")


def _to_continue(vehicle: NamedVehicle | None, commands: Mapping[NamedVehicle, str]) -> str:
    command = None if vehicle is None else commands.get(vehicle)
    return "run it again to continue" if command is None else printable(f"to continue: `{command}`")


def applied_code(result: Applied) -> ExitCode:
    """Return the exit code for a result."""
    if result.complete:
        return ExitCode.DONE
    return ExitCode.INCOMPLETE if result.error is None else max(ExitCode.INCOMPLETE, code_of(result.error))


def applied_json(vehicle: NamedVehicle, result: ApplyResult, *, full: bool) -> ApplyJson:
    """Return the JSON of the result for one vehicle; unchanged values only if `full`."""
    system, component = vehicle.system, vehicle.component
    receiver = VehicleJson.at(system, component, vehicle.identity)
    return ApplyJson.of(result, system=system, component=component, full=full, vehicle=receiver)


def interrupted_json(vehicle: NamedVehicle, rows: Iterable[ApplyRow]) -> dict[str, object]:
    """Return the JSON of a set-up that Ctrl-C ended."""
    return {
        "system": vehicle.system,
        "component": vehicle.component,
        "complete": False,
        "params": applied_rows(rows),
        "error": "interrupted",
    }


def _applied_cells(row: ApplyRow) -> Cells:
    return [
        row.name,
        _text(row.before, row),
        _text(row.target.settable, row),
        _text(row.actual, row),
        Coloured(row.status, _STYLES[row.status]),
        _why(row),
    ]


# Plans


def show_planned(plans: Mapping[NamedVehicle, Plan], *, reboot: bool, full: bool) -> None:
    """Print the values that would be sent, in their order, and the reasons for all others."""
    _say_firmware(plans)
    _print(
        ["stage", "name", "before", "wanted", "status", "reason"],
        {vehicle: _planned_rows(plan, reboot=reboot, full=full) for vehicle, plan in plans.items()},
        right="stage",
    )
    for vehicle, plan in plans.items():
        say(
            printable(
                f"{vehicle.receiver}: {_counted(plan.counts, PlanStatus, _PLAN_WORDS)}; nothing was sent"
            )
        )
        if plan.reboot_for and not reboot:
            names = first_of(plan.reboot_for, RESULT_NAMES_MAX)
            say(printable(f"{vehicle.label}: would take effect after a reboot: {names}"))


def planned_code(plan: Plan, *, skip_invalid: bool) -> ExitCode:
    """Return the exit code of `apply` that is expected from the plan."""
    if plan.of(PlanStatus.INVALID):
        return ExitCode.INCOMPLETE if skip_invalid else ExitCode.USAGE
    is_missing = any(
        row.status is PlanStatus.SKIPPED and row.category == MISSING for row in plan.rows.values()
    )
    return ExitCode.INCOMPLETE if is_missing else ExitCode.DONE


def planned_json(vehicle: NamedVehicle, plan: Plan, *, full: bool) -> PlanJson:
    """Return the JSON of the plan for one vehicle."""
    return PlanJson.of(plan, system=vehicle.system, component=vehicle.component, full=full)


def _planned_rows(plan: Plan, *, reboot: bool, full: bool) -> Iterator[Cells]:
    has_started = False
    for number, stage in enumerate(plan.stages, start=1):
        for step in stage.steps:
            row = plan.rows[step.wanted.name]
            reason = stage.purpose + (", takes effect after a reboot" if step.needs_reboot else "")
            yield [number, *_planned_cells(row)[:-1], "; ".join(filter(None, (_vehicle_name(row), reason)))]
        if reboot and stage.reboot_first:
            has_started = True
            yield [number, None, None, None, Coloured("reboot", "yellow"), "the vehicle reboots"]
    if reboot and not has_started and (plan.reboot_for or plan.awaiting_reboot):
        yield [None, None, None, None, Coloured("reboot", "yellow"), "the vehicle reboots"]
    for row in plan.rows.values():
        if row.status is not PlanStatus.SET and (full or _is_notable(row)):
            yield [None, *_planned_cells(row)]


def _planned_cells(row: PlanRow) -> Cells:
    return [
        row.name,
        _text(row.before, row),
        _text(row.target.settable, row),
        Coloured(row.status, _PLAN_STYLES[row.status]),
        _why(row),
    ]


def _is_notable(row: PlanRow) -> bool:
    return row.status is not PlanStatus.UNCHANGED and row.differs


# Shared by all tables

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


def _print(
    columns: Sequence[str], tables: Mapping[NamedVehicle, Iterable[Cells]], *, right: str = ""
) -> None:
    """Print one table for all vehicles; with several, the first column names the vehicle."""
    is_one = len(tables) == 1
    rows = [
        [*([] if is_one else [f"{vehicle.system}/{vehicle.component}"]), *cells]
        for vehicle, each in tables.items()
        for cells in each
    ]
    if rows:
        print_table([*([] if is_one else ["vehicle"]), *columns], rows, right=f"before wanted now {right}")


def _say_firmware(plans: Mapping[NamedVehicle, Plan]) -> None:
    """Print a line for each vehicle that has another firmware version than the file."""
    for vehicle, plan in plans.items():
        if plan.firmware_note:
            say(printable(f"{vehicle.label}: {plan.firmware_note}"))


def _text(value: WireValue | None, row: ApplyRow | PlanRow) -> str | None:
    return None if value is None else format_value(*typed(value, row.type))


def _why(row: ApplyRow | PlanRow) -> str:
    return "; ".join(filter(None, (_vehicle_name(row), f"{row.reason} {_like(row)}".strip())))


def _vehicle_name(row: ApplyRow | PlanRow) -> str:
    return "" if row.renamed is None else f"{row.renamed.name} on this vehicle"


def _like(row: ApplyRow | PlanRow) -> str:
    return f"(did you mean {', '.join(row.nearest)}?)" if row.nearest else ""


def _counted(counts: Mapping[Any, int], kinds: Iterable[Any], words: Mapping[Any, str] | None = None) -> str:
    counted = [f"{counts[kind]} {(words or {}).get(kind, kind)}" for kind in kinds if counts.get(kind)]
    return ", ".join(counted) or "nothing to set"
