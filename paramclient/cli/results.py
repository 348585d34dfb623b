"""How set-ups are shown: what is to be done, what became of it, and how a vehicle compares."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from paramclient.cli.outcome import ExitCode, code_of
from paramclient.cli.output import Coloured, print_table, printable, report, say
from paramclient.notation import value_json
from paramclient.provision import (
    MISSING,
    ApplyResult,
    ApplyRow,
    ApplyStatus,
    Plan,
    PlanRow,
    PlanStatus,
)
from paramclient.values import ParamType, Value, format_value, type_name

__all__ = [
    "Vehicle",
    "applied_code",
    "applied_json",
    "interrupted_json",
    "met_code",
    "planned_code",
    "planned_json",
    "show_applied",
    "show_interrupted",
    "show_planned",
    "show_verified",
    "verified_json",
]

MOST_NAMED: Final = 10
"""Parameters that are named in one line."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle as it is called in what is printed.

    Attributes:
        system, component: its address when the command began.
        who: in words, `1/1 px4`.
    """

    system: int
    component: int
    who: str


Cells: TypeAlias = list[object]


# what was done


def show_applied(results: Mapping[Vehicle, ApplyResult], *, full: bool) -> None:
    """Print one table of what became of each value, and a line for each vehicle on stderr."""
    _print(
        ["name", "before", "wanted", "now", "status", "reason"],
        {vehicle: map(_applied_cells, _shown(result, full=full)) for vehicle, result in results.items()},
    )
    for vehicle, result in results.items():
        say(printable(f"{vehicle.who}: {_counted(result.counts, ApplyStatus)} in {result.elapsed:.1f} s"))
        if (result.system, result.component) != (vehicle.system, vehicle.component):
            say(f"{vehicle.system}/{vehicle.component} is {result.system}/{result.component} now")
        if result.reboot_required:
            names = _listed(result.reboot_required)
            say(printable(f"{vehicle.who}: counts only from the next start of the vehicle on: {names}"))
        if result.error is not None:
            report(f"{vehicle.who}: {result.error}; run it again to go on from here")


def show_interrupted(rows: Mapping[Vehicle, Sequence[ApplyRow]]) -> None:
    """Print what became of each value before somebody ended it."""
    _print(
        ["name", "before", "wanted", "now", "status", "reason"],
        {vehicle: map(_applied_cells, each) for vehicle, each in rows.items()},
    )
    taken = sum(row.status is ApplyStatus.UNPROVEN for each in rows.values() for row in each)
    say(
        f"interrupted: {_number(taken, 'value')} acknowledged, not proven, and others may be on their way; "
        "run it again to go on from what the vehicle has"
    )


def applied_code(result: ApplyResult) -> ExitCode:
    """How a command ends with this result."""
    if result.complete:
        return ExitCode.DONE
    return ExitCode.INCOMPLETE if result.error is None else max(ExitCode.INCOMPLETE, code_of(result.error))


def applied_json(vehicle: Vehicle, result: ApplyResult, *, full: bool) -> dict[str, Any]:
    """The result for one vehicle; values that it had already only on demand."""
    return {
        **_address(vehicle),
        "now": {"system": result.system, "component": result.component},
        "complete": result.complete,
        "counts": {status.value: result.counts.get(status, 0) for status in ApplyStatus},
        "params": {row.name: _applied_row_json(row) for row in _shown(result, full=full)},
        "extra": len(result.extra),
        "reboots": result.reboots,
        "reboot_required": list(result.reboot_required),
        "error": None if result.error is None else str(result.error),
        "elapsed_s": round(result.elapsed, 3),
    }


def interrupted_json(vehicle: Vehicle, rows: Iterable[ApplyRow]) -> dict[str, Any]:
    """The same for what was ended by somebody."""
    return {
        **_address(vehicle),
        "complete": False,
        "params": {row.name: _applied_row_json(row) for row in rows},
        "error": "interrupted",
    }


def _shown(result: ApplyResult, *, full: bool) -> list[ApplyRow]:
    """All rows but those with nothing to see: what was so already, or is left out and no different."""
    return [row for row in result.rows.values() if full or _is_news(result, row)]


def _is_news(result: ApplyResult, row: ApplyRow) -> bool:
    if row.status is ApplyStatus.SKIPPED:
        return not row.is_as_wanted or result.plan.rows[row.name].differs
    return row.status is not ApplyStatus.UNCHANGED


def _applied_cells(row: ApplyRow) -> Cells:
    return [
        row.name,
        _text(row.before, row),
        _text(row.wanted.value, row),
        _text(row.actual, row),
        Coloured(row.status, _STYLES[row.status]),
        _why(row),
    ]


def _applied_row_json(row: ApplyRow) -> dict[str, Any]:
    return {"status": row.status, **_values_json(row), "actual": _json(row.actual, row), **_reasons_json(row)}


# what is to be done


def show_planned(plans: Mapping[Vehicle, Plan], *, reboot: bool, full: bool) -> None:
    """Print what would be sent, in its order, and what would not be and why."""
    _print(
        ["stage", "name", "before", "wanted", "status", "reason"],
        {vehicle: _planned_rows(plan, reboot=reboot, full=full) for vehicle, plan in plans.items()},
        right="stage",
    )
    for vehicle, plan in plans.items():
        say(printable(f"{vehicle.who}: {_counted(plan.counts, PlanStatus, _PLAN_WORDS)}; nothing was sent"))
        if plan.reboot_for and not reboot:
            names = _listed(plan.reboot_for)
            say(printable(f"{vehicle.who}: would count only from the next start of the vehicle on: {names}"))


def planned_code(plan: Plan, *, skip_invalid: bool) -> ExitCode:
    """How `apply` would end, as far as that can be known."""
    if plan.of(PlanStatus.INVALID):
        return ExitCode.INCOMPLETE if skip_invalid else ExitCode.USAGE
    is_missing = any(
        row.status is PlanStatus.SKIPPED and row.category == MISSING for row in plan.rows.values()
    )
    return ExitCode.INCOMPLETE if is_missing else ExitCode.DONE


def planned_json(vehicle: Vehicle, plan: Plan, *, full: bool) -> dict[str, Any]:
    """The plan for one vehicle."""
    return {
        **_address(vehicle),
        "dry_run": True,
        "counts": {status.value: plan.counts.get(status, 0) for status in PlanStatus},
        "stages": [
            {
                "purpose": stage.purpose,
                "reboot_first": stage.reboot_first,
                "steps": [
                    {
                        "name": step.name,
                        "value": value_json(step.value, step.type),
                        "type": type_name(step.type),
                        "before": value_json(step.before, step.type),
                        "needs_reboot": step.needs_reboot,
                    }
                    for step in stage.steps
                ],
            }
            for stage in plan.stages
        ],
        "params": {
            row.name: _planned_row_json(row)
            for row in plan.rows.values()
            if full or row.status is not PlanStatus.UNCHANGED
        },
        "extra": len(plan.extra),
        "reboot_for": list(plan.reboot_for),
    }


def _planned_rows(plan: Plan, *, reboot: bool, full: bool) -> Iterator[Cells]:
    has_started = False
    for number, stage in enumerate(plan.stages, start=1):
        for step in stage.steps:
            reason = stage.purpose + (", counts from the next start on" if step.needs_reboot else "")
            yield [number, *_planned_cells(plan.rows[step.name])[:-1], reason]
        if reboot and stage.reboot_first:
            has_started = True
            yield [number, None, None, None, Coloured("restart", "yellow"), "the vehicle starts again"]
    if reboot and not has_started and (plan.reboot_for or plan.unstarted):
        yield [None, None, None, None, Coloured("restart", "yellow"), "the vehicle starts again"]
    for row in plan.rows.values():
        if row.status is not PlanStatus.SET and (full or _is_worth_telling(row)):
            yield [None, *_planned_cells(row)]


def _planned_cells(row: PlanRow) -> Cells:
    return [
        row.name,
        _text(row.before, row),
        _text(row.wanted.value, row),
        Coloured(row.status, _PLAN_STYLES[row.status]),
        _why(row),
    ]


def _planned_row_json(row: PlanRow) -> dict[str, Any]:
    return {"status": row.status, **_values_json(row), **_reasons_json(row)}


def _is_worth_telling(row: PlanRow) -> bool:
    return row.status is not PlanStatus.UNCHANGED and row.differs


# how it compares


def show_verified(plans: Mapping[Vehicle, Plan], *, full: bool) -> None:
    """Print what is not as it should be."""
    _print(
        ["name", "wanted", "now", "is", "reason"],
        {
            vehicle: (_verified_cells(row) for row in plan.rows.values() if full or not _is_met(row))
            for vehicle, plan in plans.items()
        },
    )
    for vehicle, plan in plans.items():
        words: dict[str, int] = {}
        for row in plan.rows.values():
            words[_standing(row)] = words.get(_standing(row), 0) + 1
        counted = ", ".join(f"{number} {word}" for word, number in sorted(words.items(), key=_by_word))
        say(printable(f"{vehicle.who}: {counted or 'nothing to compare'}"))


def met_code(plan: Plan) -> ExitCode:
    """Whether the vehicle is as it should be."""
    return ExitCode.DONE if plan.is_met else ExitCode.DIFFERENT


def verified_json(vehicle: Vehicle, plan: Plan, *, full: bool) -> dict[str, Any]:
    """How one vehicle compares."""
    return {
        **_address(vehicle),
        "met": plan.is_met,
        "counts": {
            word: sum(_standing(row) == word for row in plan.rows.values()) for word in _STANDING_STYLES
        },
        "params": {
            row.name: {"is": _standing(row), **_values_json(row), **_reasons_json(row)}
            for row in plan.rows.values()
            if full or not _is_met(row)
        },
    }


def _verified_cells(row: PlanRow) -> Cells:
    standing = _standing(row)
    return [
        row.name,
        _text(row.wanted.value, row),
        _text(row.before, row),
        Coloured(standing, _STANDING_STYLES[standing]),
        _like(row) if standing == "missing" else _why(row),
    ]


def _standing(row: PlanRow) -> str:
    """How one parameter compares, in a word."""
    if row.category == MISSING:
        return "missing"
    if row.status is PlanStatus.SKIPPED:
        return "left out"
    return "same" if row.status is PlanStatus.UNCHANGED else "different"


def _is_met(row: PlanRow) -> bool:
    return _standing(row) in ("same", "left out")


def _by_word(counted: tuple[str, int]) -> int:
    return list(_STANDING_STYLES).index(counted[0])


# what these have in common

_STYLES: Final = {
    ApplyStatus.SET: "green",
    ApplyStatus.UNCHANGED: "",
    ApplyStatus.ADJUSTED: "yellow",
    ApplyStatus.REFUSED: "red",
    ApplyStatus.SKIPPED: "dim",
    ApplyStatus.UNPROVEN: "yellow",
    ApplyStatus.FAILED: "bold red",
}
_PLAN_STYLES: Final = {
    PlanStatus.SET: "green",
    PlanStatus.LATER: "yellow",
    PlanStatus.UNCHANGED: "",
    PlanStatus.SKIPPED: "dim",
    PlanStatus.INVALID: "bold red",
}
_PLAN_WORDS: Final = {PlanStatus.SET: "to set", PlanStatus.LATER: "that may come to light"}
_STANDING_STYLES: Final = {"same": "", "different": "yellow", "missing": "red", "left out": "dim"}


def _print(columns: Sequence[str], tables: Mapping[Vehicle, Iterable[Cells]], *, right: str = "") -> None:
    """One table for all; who it is stands in front where there are several."""
    is_one = len(tables) == 1
    rows = [
        [*([] if is_one else [f"{vehicle.system}/{vehicle.component}"]), *cells]
        for vehicle, each in tables.items()
        for cells in each
    ]
    if rows:
        print_table([*([] if is_one else ["vehicle"]), *columns], rows, right=f"before wanted now {right}")


def _address(vehicle: Vehicle) -> dict[str, Any]:
    return {"system": vehicle.system, "component": vehicle.component}


def _text(value: Value | None, row: ApplyRow | PlanRow) -> str | None:
    return None if value is None else format_value(_typed(value, row), _kind(row))


def _json(value: Value | None, row: ApplyRow | PlanRow) -> int | float | str | None:
    return None if value is None else value_json(_typed(value, row), _kind(row))


def _values_json(row: ApplyRow | PlanRow) -> dict[str, Any]:
    return {
        "type": None if row.type is None else type_name(row.type),
        "before": _json(row.before, row),
        "wanted": _json(row.wanted.value, row),
    }


def _reasons_json(row: ApplyRow | PlanRow) -> dict[str, Any]:
    return {"category": row.category, "reason": row.reason, "nearest": list(row.nearest)}


def _typed(value: Value, row: ApplyRow | PlanRow) -> Value:
    """A whole number that was written for a float as the float that it is."""
    is_float = row.type in (ParamType.REAL32, ParamType.REAL64)
    return float(value) if is_float and isinstance(value, int) else value


def _kind(row: ApplyRow | PlanRow) -> ParamType | int:
    return ParamType.REAL32 if row.type is None else row.type


def _why(row: ApplyRow | PlanRow) -> str:
    return f"{row.reason} {_like(row)}".strip()


def _like(row: ApplyRow | PlanRow) -> str:
    return f"(did you mean {', '.join(row.nearest)}?)" if row.nearest else ""


def _counted(counts: Mapping[Any, int], kinds: Iterable[Any], words: Mapping[Any, str] | None = None) -> str:
    told = [f"{counts[kind]} {(words or {}).get(kind, kind)}" for kind in kinds if counts.get(kind)]
    return ", ".join(told) or "nothing to set"


def _listed(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _number(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
