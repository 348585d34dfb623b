"""Results of writes: of one `set`, and of each value of a `set_many`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from paramclient.errors import ParamClientError, ValueNotApplied
from paramclient.model.values import Param, Value, format_value


class SetStatus(StrEnum):
    """The outcome of one value of a `set_many`."""

    ACCEPTED = "accepted"
    """The vehicle holds the requested value, as far as the type can represent it."""
    ADJUSTED = "adjusted"
    """The vehicle stored another value."""
    REFUSED = "refused"
    """The vehicle does not have the value: it refused it, or the value cannot be sent to it."""
    UNKNOWN = "unknown"
    """The value was sent and not acknowledged: the vehicle may have it."""
    NOT_TRIED = "not tried"
    """The value was not sent."""


@dataclass(frozen=True, slots=True)
class SetResult:
    """The outcome of a `set`.

    Attributes:
        name: param_id.
        status: "accepted" (the vehicle holds the requested value, as far as the type can represent it), or
            "adjusted" (the vehicle changed the value: ArduPilot makes 1234 of 1234.7 for an integer; modules
            of PX4 change values up to 1.1 s later, which is seen while the value is watched).
        requested: the requested value.
        param: the parameter as it is now.
        attempts: sets that were sent.
        note: a further sentence, or empty.
    """

    name: str
    status: Literal["accepted", "adjusted"]
    requested: Value
    param: Param
    attempts: int
    note: str = ""

    @property
    def actual(self) -> Value:
        """The value that the vehicle reports: `param.value`."""
        return self.param.value

    @property
    def adjusted(self) -> bool:
        """Whether the vehicle stored another value."""
        return self.status == "adjusted"

    def __str__(self) -> str:
        number = self.param.type
        actual = format_value(self.param.settable, number)
        if self.adjusted:
            return f"{self.name} = {actual} (adjusted from {format_value(self.requested, number)})"
        return f"{self.name} = {actual}"


@dataclass(frozen=True, slots=True)
class SetOutcome:
    """The outcome of one value of a `set_many`.

    Attributes:
        name: param_id, as requested.
        requested: the requested value.
        status: what became of it.
        result: the result as of `set` for an accepted or adjusted value, else None.
        error: the error that `set` would have raised, or None. For a value that was not tried, the error that
            ended the call. An accepted or adjusted value has one (NotDurable) if it is not on the disk.
    """

    name: str
    requested: Value
    status: SetStatus
    result: SetResult | None = None
    error: ParamClientError | None = None

    @property
    def is_set(self) -> bool:
        """Whether the vehicle has acknowledged the value, also if it adjusted it."""
        return self.status in (SetStatus.ACCEPTED, SetStatus.ADJUSTED)

    @property
    def reported(self) -> Value | None:
        """The value that the vehicle has reported after the write, as `Param.settable`; None if none."""
        if self.result is not None:
            return self.result.param.settable
        return self.error.actual if isinstance(self.error, ValueNotApplied) else None

    def __str__(self) -> str:
        if self.result is not None and self.error is None:
            return str(self.result)
        return f"{self.name}: {self.status}" + ("" if self.error is None else f": {self.error}")


@dataclass(frozen=True, slots=True)
class SetManyResult:
    """The outcomes of a `set_many`.

    Attributes:
        system, component: MAVLink ids of the component.
        outcomes: one for each requested value, in the order of the request.
        error: why values were not tried, or why values are not on the disk; None otherwise.
        elapsed: seconds.
    """

    system: int
    component: int
    outcomes: tuple[SetOutcome, ...]
    error: ParamClientError | None
    elapsed: float

    def __getitem__(self, name: str) -> SetOutcome:
        """Return the outcome of a name; of the last value for it if it was requested several times."""
        return {outcome.name: outcome for outcome in self.outcomes}[name]

    @property
    def is_complete(self) -> bool:
        """Whether the vehicle has acknowledged every value, also if it adjusted some, without an error."""
        return self.error is None and all(outcome.is_set for outcome in self.outcomes)

    @property
    def counts(self) -> Mapping[SetStatus, int]:
        """The number of values with each status."""
        return Counter(outcome.status for outcome in self.outcomes)

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        whose = f"{self.system}/{self.component}"
        return f"<SetManyResult {whose} {counts or 'nothing'} in {self.elapsed:.2f} s>"
