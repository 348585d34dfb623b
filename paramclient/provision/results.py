"""Results of `apply`, `restore` and `verify`: one row for each wanted parameter, totals, progress."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from paramclient.errors import ParamClientError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, format_value
from paramclient.provision.apply_rules import CATEGORIES, OUT_OF_RANGE
from paramclient.provision.planning import Plan

__all__ = ["ApplyProgress", "ApplyResult", "ApplyRow", "ApplyStatus", "FleetApplied", "FleetVerified"]


class ApplyStatus(StrEnum):
    """The outcome for one wanted parameter."""

    SET = "set"
    """The value was written, and read back at the end."""
    UNCHANGED = "unchanged"
    """The vehicle had the value already."""
    ADJUSTED = "adjusted"
    """The value was written, and the vehicle changed it, immediately or within a second."""
    REFUSED = "refused"
    """The vehicle refused the value."""
    SKIPPED = "skipped"
    """The parameter was not written: left out, not on this vehicle, or invalid."""
    UNPROVEN = "unproven"
    """The value was sent, and could not be read back at the end."""
    FAILED = "failed"
    """The vehicle does not have the value or did not answer, or `apply` ended before the parameter."""


@dataclass(frozen=True, slots=True)
class ApplyRow:
    """The outcome for one wanted parameter, with its values before and after.

    Attributes:
        wanted: the parameter as the file has it.
        status: the outcome.
        before: the value before `apply`, or None if the vehicle did not have the parameter.
        actual: the value that the vehicle last reported, or None.
        type: the vehicle's type of the parameter; None if unknown.
        category: as in `PlanRow`, for skipped parameters.
        reason: the reason for the status as a sentence; may be "".
        nearest, renamed: as in `PlanRow`.
    """

    wanted: WrittenParam
    status: ApplyStatus
    before: WireValue | None = None
    actual: WireValue | None = None
    type: ParamType | int | None = None
    category: str = ""
    reason: str = ""
    nearest: tuple[str, ...] = ()
    renamed: WrittenParam | None = None

    @property
    def name(self) -> str:
        """The param_id in the file."""
        return self.wanted.name

    @property
    def target(self) -> WrittenParam:
        """The wanted parameter with the name and the value that the vehicle is to have."""
        return self.wanted if self.renamed is None else self.renamed

    @property
    def is_as_wanted(self) -> bool:
        """Whether the parameter has the wanted value, or was left out on purpose."""
        if self.status is ApplyStatus.SKIPPED:
            return self.category in _INTENDED_CATEGORIES
        return self.status in (ApplyStatus.SET, ApplyStatus.UNCHANGED)

    @property
    def so_far(self) -> ApplyRow:
        """This row with `SET` replaced by `UNPROVEN`, for a run that ended before the value was read back."""
        if self.status is not ApplyStatus.SET:
            return self
        return replace(self, status=ApplyStatus.UNPROVEN, reason="acknowledged, and not read back")

    def __str__(self) -> str:
        kind = ParamType.REAL32 if self.type is None else self.type
        value = self.target.settable if self.actual is None else self.actual
        name = self.name if self.renamed is None else f"{self.name} (here {self.renamed.name})"
        why = f": {self.reason}" if self.reason else ""
        like = f" (did you mean {', '.join(self.nearest)}?)" if self.nearest else ""
        return f"{name} = {format_value(value, kind)}, {self.status}{why}{like}"


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
class ApplyResult:
    """The result of `apply` or `restore` for one vehicle.

    Attributes:
        system: system id of the vehicle at the end; it differs from the first one if the system id was set.
        component: component id of the vehicle.
        rows: by name, one row for each wanted parameter, in the order of the file.
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
    rows: Mapping[str, ApplyRow]
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

    @property
    def counts(self) -> Mapping[ApplyStatus, int]:
        """The number of rows with each status."""
        return Counter(row.status for row in self.rows.values())

    def of(self, status: ApplyStatus) -> list[ApplyRow]:
        """Return the rows with this status, in order."""
        return [row for row in self.rows.values() if row.status is status]

    @property
    def shown_rows(self) -> list[ApplyRow]:
        """The rows to show: all except unchanged parameters and left-out ones that do not differ."""
        return [row for row in self.rows.values() if self._is_shown(row)]

    def _is_shown(self, row: ApplyRow) -> bool:
        if row.status is ApplyStatus.SKIPPED:
            return not row.is_as_wanted or self.plan.rows[row.name].differs
        return row.status is not ApplyStatus.UNCHANGED

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        end = f", ended by {self.error}" if self.error is not None else ""
        return (
            f"<ApplyResult {self.system}/{self.component} {counts or 'nothing'} in {self.elapsed:.2f} s{end}>"
        )


@dataclass(frozen=True, slots=True)
class FleetApplied:
    """The results of `apply_all` or `restore_all`.

    Attributes:
        results: by (system, component) at the start, the result for each vehicle.
        errors: by (system, component), the error of each vehicle to which nothing was written.
    """

    results: Mapping[tuple[int, int], ApplyResult]
    errors: Mapping[tuple[int, int], ParamClientError]

    @property
    def complete(self) -> bool:
        """Whether all vehicles have all wanted values."""
        return not self.errors and all(result.complete for result in self.results.values())


@dataclass(frozen=True, slots=True)
class FleetVerified:
    """The results of `verify_all`.

    Attributes:
        results: by (system, component), the comparison for each vehicle.
        errors: by (system, component), the error of each vehicle that could not be compared.
    """

    results: Mapping[tuple[int, int], Plan]
    errors: Mapping[tuple[int, int], ParamClientError]

    @property
    def is_met(self) -> bool:
        """Whether all vehicles have all wanted values."""
        return not self.errors and all(result.is_met for result in self.results.values())


_INTENDED_CATEGORIES = frozenset(CATEGORIES) - {OUT_OF_RANGE}
"""Categories of parameters that are left out on purpose: a skipped row of one is no failure."""
