"""What came of a set-up: one row for each wanted parameter, and what else is to be said."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from paramclient.errors import ParamClientError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, format_value
from paramclient.provision.cautions import CATEGORIES, OUT_OF_RANGE
from paramclient.provision.planning import Plan

__all__ = ["ApplyProgress", "ApplyResult", "ApplyRow", "ApplyStatus", "FleetApplied", "FleetVerified"]


class ApplyStatus(StrEnum):
    """What became of a wanted parameter."""

    SET = "set"
    """It was written, and read back at the end."""
    UNCHANGED = "unchanged"
    """The vehicle had the value already."""
    ADJUSTED = "adjusted"
    """It was written, and the vehicle made another value of it, at once or within a second afterwards."""
    REFUSED = "refused"
    SKIPPED = "skipped"
    """It was not written: left out, not on this vehicle, or invalid."""
    UNPROVEN = "unproven"
    """It was sent, and could not be read back at the end."""
    FAILED = "failed"
    """The vehicle does not have the value, or did not answer, or it was not reached."""


@dataclass(frozen=True, slots=True)
class ApplyRow:
    """What became of one wanted parameter.

    Attributes:
        wanted: the parameter as it is written.
        status: what became of it.
        before: the value that the vehicle had, or None where it did not have the parameter.
        actual: the value that it was last seen to have, or None.
        type: the vehicle's type for it; None where that is not known.
        category: as in `PlanRow`, for what is skipped.
        reason: a sentence; "" where there is nothing to say.
        nearest: as in `PlanRow`.
    """

    wanted: WrittenParam
    status: ApplyStatus
    before: Value | None = None
    actual: Value | None = None
    type: ParamType | int | None = None
    category: str = ""
    reason: str = ""
    nearest: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.wanted.name

    @property
    def is_as_wanted(self) -> bool:
        """Whether there is nothing to be seen to: it has the value, or was left out on purpose."""
        if self.status is ApplyStatus.SKIPPED:
            return self.category in _ON_PURPOSE
        return self.status in (ApplyStatus.SET, ApplyStatus.UNCHANGED)

    @property
    def so_far(self) -> ApplyRow:
        """The same where nobody will read it back any more."""
        if self.status is not ApplyStatus.SET:
            return self
        return replace(self, status=ApplyStatus.UNPROVEN, reason="acknowledged, and not read back")

    def __str__(self) -> str:
        kind = ParamType.REAL32 if self.type is None else self.type
        value = self.wanted.value if self.actual is None else self.actual
        why = f": {self.reason}" if self.reason else ""
        like = f" (did you mean {', '.join(self.nearest)}?)" if self.nearest else ""
        return f"{self.name} = {format_value(value, kind)}, {self.status}{why}{like}"


@dataclass(frozen=True, slots=True)
class ApplyProgress:
    """How far a set-up is.

    Attributes:
        phase: "reading", "writing", "rebooting".
        done, total: values that were written in this run so far, and that are to be written as far as known.
        row: what has just become of one parameter; not its last word before the proof at the end.
    """

    phase: str
    done: int
    total: int
    row: ApplyRow | None = None


@dataclass(frozen=True, slots=True)
class ApplyResult:
    """What came of a set-up.

    Attributes:
        system, component: the vehicle's address at the end; another one than before where its system id was
            set.
        rows: by name, one for each wanted parameter, in the order in which they are written.
        plan: what was planned first.
        before: the state that was stored before anything was sent.
        extra: names that the vehicle had when its whole table was read last, and that are not wanted; they
            were left alone.
        reboots: how often the vehicle was started again.
        reboot_required: names that were written and count only from the next start of the vehicle on.
        error: what ended it before its time, or None. What is in the rows holds all the same.
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
        """Whether the vehicle has all that is wanted, proven, but for what is left out on purpose."""
        return self.error is None and all(row.is_as_wanted for row in self.rows.values())

    @property
    def counts(self) -> Mapping[ApplyStatus, int]:
        """How many rows have each status."""
        return Counter(row.status for row in self.rows.values())

    def of(self, status: ApplyStatus) -> list[ApplyRow]:
        """The rows with this status, in order."""
        return [row for row in self.rows.values() if row.status is status]

    @property
    def news(self) -> list[ApplyRow]:
        """The rows with something to see: not what was so already, or is left out and no different."""
        return [row for row in self.rows.values() if self._is_news(row)]

    def _is_news(self, row: ApplyRow) -> bool:
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
    """What came of a set-up of several vehicles.

    Attributes:
        results: by (system, component) as they were called at the start, what came of each.
        errors: those to which nothing was written, each with its error.
    """

    results: Mapping[tuple[int, int], ApplyResult]
    errors: Mapping[tuple[int, int], ParamClientError]

    @property
    def complete(self) -> bool:
        """Whether all of them have all that is wanted."""
        return not self.errors and all(result.complete for result in self.results.values())


@dataclass(frozen=True, slots=True)
class FleetVerified:
    """How several vehicles compare with what is wanted.

    Attributes:
        results: by (system, component), how each compares.
        errors: those that could not be compared, each with its error.
    """

    results: Mapping[tuple[int, int], Plan]
    errors: Mapping[tuple[int, int], ParamClientError]

    @property
    def is_met(self) -> bool:
        """Whether all of them have all that is wanted."""
        return not self.errors and all(result.is_met for result in self.results.values())


_ON_PURPOSE = frozenset(CATEGORIES) - {OUT_OF_RANGE}
