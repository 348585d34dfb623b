"""Writes to vehicles, as of set and apply: one job for each, its outcomes, and those of set."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final, Protocol, Self

import anyio

from paramclient.cli.json_output import JsonObject, outcome_json, vehicle_json
from paramclient.cli.metadata import info_of
from paramclient.cli.output import LINE_NAMES_MAX, Coloured, ExitCode, Status, code_of, report, say
from paramclient.cli.session import CommandSession, Sessions, Shown
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.model.names import counted, first_of
from paramclient.model.values import ParamType, Value
from paramclient.protocol.set_results import SetOutcome, SetStatus

STYLES: Final = {
    **dict.fromkeys(("set", "accepted"), "green"),
    **dict.fromkeys(("later", "adjusted", "unproven"), "yellow"),
    **dict.fromkeys(("invalid", "unknown"), "bold red"),
    **dict.fromkeys(("skipped", "not tried"), "dim"),
    "refused": "red",
}
"""Styles of the outcomes of a value, and of the planned actions."""


class WriteJob(Shown, Protocol):
    """What is written to one vehicle."""

    async def write(self) -> Self:
        """Write the values, and return the job."""

    @property
    def open_count(self) -> int:
        """The number of values whose outcome is not proven, after an interruption."""

    @property
    def to_continue(self) -> str:
        """How to continue after an error, in words."""


async def write_all(found: Sessions, jobs: Mapping[CommandSession, WriteJob]) -> int:
    """Write to all vehicles; print the outcomes, also those so far after an interruption.

    Returns:
        The exit code.

    Raises:
        ParamClientError: nothing was written to the only vehicle.
    """
    try:
        return found.show(await found.work(lambda session: jobs[session].write()))
    except anyio.get_cancelled_exc_class():
        found.show(jobs)
        not_proven = counted(sum(job.open_count for job in jobs.values()), "value")
        to_continue = "; ".join(dict.fromkeys(job.to_continue for job in jobs.values()))
        say(f"interrupted: {not_proven} not proven, and others may be in flight; {to_continue}")
        raise


@dataclass(eq=False)
class SetJob:
    """The values of set for one vehicle in the order of the writes, and the outcomes so far.

    Attributes:
        session: the vehicle.
        writes: the values by name.
        described: the metadata of the vehicle, or None.
        settle, force: as in `Component.set_many`.
        arrived: the outcomes so far, by name.
        began: when the writes began, as a time of the event loop.
    """

    columns: ClassVar[Sequence[str]] = ("name", "requested", "actual", "status")
    to_continue: ClassVar[str] = "run it again to continue"

    session: CommandSession
    writes: Mapping[str, Value]
    described: Metadata | None
    settle: float = 0.0
    force: bool = False
    arrived: dict[str, SetOutcome] = field(default_factory=dict)
    began: float = 0.0

    async def write(self) -> Self:
        """Write the values; afterwards each has an outcome in any case.

        Raises:
            AmbiguousVehicle, NoReply, LinkError: as from `CommandSession.check_only`; nothing was written.
        """
        session, label = self.session, self.session.label
        if self.writes:
            await session.check_only()
        self.began, is_announced = anyio.current_time(), False

        def update(outcome: SetOutcome) -> None:
            nonlocal is_announced
            is_wrong = isinstance(outcome.error, UnknownParameter | UsageError)
            if not (is_announced or is_wrong or outcome.status is SetStatus.NOT_TRIED):
                is_announced = True
                session.announce_write()
            self.arrived[outcome.name] = outcome
            status.count(len(self.arrived), len(self.writes))

        with Status(f"waiting for {label} to acknowledge PARAM_SET", f"setting {label}") as status:
            try:
                done = await session.component.set_many(
                    self.writes,
                    progress=update,
                    timeout=session.deadline.left(),
                    settle=self.settle,
                    force=self.force,
                )
                outcomes = done.outcomes
            except ParamClientError as error:  # raised only if nothing was written
                pairs = self.writes.items()
                outcomes = tuple(SetOutcome(*pair, SetStatus.NOT_TRIED, error=error) for pair in pairs)
        self.arrived = {each.name: each for each in outcomes}
        return self

    @property
    def outcomes(self) -> list[SetOutcome]:
        """One outcome for each value; *unknown* for those without one, after an interruption."""
        return [
            self.arrived.get(name) or SetOutcome(name, value, SetStatus.UNKNOWN)
            for name, value in self.writes.items()
        ]

    @property
    def open_count(self) -> int:
        """The number of values that the vehicle may have."""
        return sum(each.status is SetStatus.UNKNOWN for each in self.outcomes)

    def as_json(self) -> JsonObject:
        """Return the JSON of the vehicle and the outcomes."""
        results = [
            outcome_json(each, self._type_of(each), info_of(self.described, each.name))
            for each in self.outcomes
        ]
        return {"vehicle": vehicle_json(self.session.component), "results": results}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the rows; the reported value with its meaning, if that is known."""
        for each in self.as_json()["results"]:
            actual = each["actual"] if "text" not in each else f"{each['actual']} ({each['text']})"
            yield each["name"], each["requested"], actual, Coloured(each["status"], STYLES[each["status"]])

    def report(self) -> int:
        """Print counts, remarks and errors: one line for all values without a response, and for one cause."""
        session, prefix = self.session, self.session.prefix
        if not session.options.json:
            counts = Counter(each.status for each in self.outcomes)
            done = counts.pop(SetStatus.ACCEPTED, 0) + counts.pop(SetStatus.ADJUSTED, 0)
            others = [f"{counts[status]} {status}" for status in SetStatus if status in counts]
            words = ", ".join([f"{done} of {len(self.writes)} set", *others])
            traffic = f"{session.client.bytes_received:,} bytes received, {session.client.bytes_sent:,} sent"
            end = "" if session.choice.is_all else f" in {anyio.current_time() - self.began:.2f} s, {traffic}"
            say(f"{words} on {session.receiver}{end}")
        errors = dict[object, list[SetOutcome]]()
        for each in self.arrived.values():
            info = info_of(self.described, each.name)
            if each.is_set and info is not None and info.reboot_required:
                say(f"{prefix}{each.name} takes effect after a reboot")
            if each.result is not None and each.result.note:
                say(f"{prefix}{each.name}: {each.result.note}")
            if each.error is not None:
                is_open = each.status in (SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
                cause = (each.status, type(each.error)) if is_open else str(each.error)
                errors.setdefault(cause, []).append(each)
        for group in errors.values():
            names, text = [each.name for each in group], str(group[0].error)
            is_named = len(names) == 1 and names[0] in re.split(r"[ ,:;]", text)
            report(f"{prefix}{'' if is_named else first_of(names, LINE_NAMES_MAX) + ': '}{text}")
        codes = [code_of(each.error) for each in self.arrived.values() if each.error is not None]
        return max(codes, default=ExitCode.DONE)

    def _type_of(self, outcome: SetOutcome) -> ParamType | int:
        """Return the vehicle's type of a parameter; REAL32 if it is not known."""
        if outcome.result is not None:
            return outcome.result.param.type
        known = self.session.component.params.get(outcome.name)
        return ParamType.REAL32 if known is None else known.type
