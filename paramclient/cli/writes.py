"""Writes of a subcommand: the values for each vehicle, their outcomes, and what is printed of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, TypeVar

import anyio

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import VehicleJson, WriteJson, as_json
from paramclient.cli.metadata import info_of, meaning_of, needs_reboot
from paramclient.cli.output import Coloured, Status, report, say
from paramclient.cli.param_names import suggest
from paramclient.cli.session import CommandSession, Done, Sessions
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.model.values import ParamType, WireValue, format_value
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Progress
from paramclient.protocol.set_results import SetOutcome, SetStatus

__all__ = ["WriteJob", "write_all"]

NOT_ON_VEHICLE: Final = "not on this vehicle"
"""The status, in a table, of a name that the vehicle does not have: it has refused nothing."""
INVALID: Final = "invalid"
"""The status, in a table, of a value that cannot be sent."""
WRITE_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""
_STYLES: Final = {
    SetStatus.ACCEPTED: "green",
    SetStatus.ADJUSTED: "yellow",
    SetStatus.REFUSED: "red",
    SetStatus.UNKNOWN: "bold red",
    SetStatus.NOT_TRIED: "dim",
}
"""Styles of the outcomes."""


@dataclass
class WriteJob:
    """The values for one vehicle in the order of the writes, its metadata, and the outcomes so far."""

    columns: ClassVar[Sequence[str]] = ("name", "requested", "actual", "status")
    right: ClassVar[str] = "requested actual"
    verb: ClassVar[str] = "setting"

    session: CommandSession
    writes: Sequence[tuple[str, WireValue]]
    described: Metadata | None
    arrived: list[SetOutcome] = field(default_factory=list)

    async def write(self, *, settle: float, force: bool, durable: bool) -> None:
        """Write the values as `Component.set_many` does; afterwards each has an outcome in any case."""
        session, began, total = self.session, anyio.current_time(), len(self.writes)
        is_announced = False

        def update(outcome: SetOutcome) -> None:
            nonlocal is_announced
            if not is_announced and _was_sent(outcome):
                is_announced = True
                session.announce_write()
            self.arrived.append(outcome)
            done = len(self.arrived)
            status.update(Progress.after(done, total, anyio.current_time() - began))

        label = session.label
        with Status(f"waiting for {label} to acknowledge PARAM_SET", f"{self.verb} {label}") as status:
            try:
                done = await session.component.set_many(
                    self.writes,
                    progress=update,
                    timeout=session.deadline.left(),
                    settle=settle,
                    force=force,
                    durable=durable,
                )
                outcomes: Sequence[SetOutcome] = done.outcomes
            except ParamClientError as error:  # raised only if nothing was written
                outcomes = [SetOutcome(*pair, SetStatus.NOT_TRIED, error=error) for pair in self.writes]
        unknown = {each.name: each.error for each in outcomes if isinstance(each.error, UnknownParameter)}
        better = await suggest(session, {**unknown})
        self.arrived = [replace(each, error=better.get(each.name, each.error)) for each in outcomes]

    @property
    def outcomes(self) -> list[SetOutcome]:
        """One outcome for each value, in order; *unknown* for those without one, after an interruption."""
        left = list(self.arrived)
        outcomes = []
        for name, value in self.writes:
            found = next((each for each in left if each.name == name), None)  # those of one name are in order
            if found is not None:
                left.remove(found)
            outcomes.append(found or SetOutcome(name, value, SetStatus.UNKNOWN))
        return outcomes

    def summary(self, more: str) -> str:
        """Return the numbers of outcomes in words: `2 of 4 set, 1 refused, 1 not tried on 1/1 PX4 …`."""
        outcomes = sorted(self.outcomes, key=lambda each: [*SetStatus].index(each.status))
        others = Counter(_status_in_words(each) for each in outcomes if not each.is_set)
        done = sum(each.is_set for each in outcomes)
        parts = [f"{done} of {len(outcomes)} set", *(f"{count} {words}" for words, count in others.items())]
        return f"{', '.join(parts)} on {self.session.receiver}{more}"

    @property
    def code(self) -> int:
        """The exit code for all outcomes."""
        return max((code_of(each.error) for each in self.arrived if each.error), default=ExitCode.DONE)

    def as_json(self) -> dict[str, object]:
        """Return the JSON of the vehicle and the outcomes."""
        results = [
            WriteJson.of(each, self._type_of(each), info_of(self.described, each.name))
            for each in self.outcomes
        ]
        return {"vehicle": as_json(VehicleJson.of(self.session.component)), "results": as_json(results)}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the rows; the reported value with its meaning, if that is known."""
        for each in self.outcomes:
            kind = self._type_of(each)
            number = kind if isinstance(each.requested, bytes) else ParamType.REAL64
            actual = None if each.reported is None else format_value(each.reported, kind)
            if each.reported is not None and (
                meaning := meaning_of(self.described, each.name, each.reported)
            ):
                actual = f"{actual} ({meaning})"
            status = Coloured(_status_in_words(each), _STYLES[each.status])
            yield each.name, format_value(each.requested, number), actual, status

    def report(self) -> None:
        """Print remarks, and errors: one line for all values without a response, and for one cause."""
        prefix = self.session.prefix
        late = {each.name for each in self.arrived if each.is_set and each.error is None}
        late = {name for name in late if needs_reboot(name, self.described)}
        if late:
            named = dict.fromkeys(name for name, _ in self.writes if name in late)
            say(f"{prefix}takes effect after a reboot: {', '.join(named)}")
        errors: dict[object, list[SetOutcome]] = {}
        for each in self.arrived:
            if each.result is not None and each.result.note:
                say(f"{prefix}{each.name}: {each.result.note}")
            if each.error is not None:
                is_open = each.status in (SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
                cause = (each.status, type(each.error)) if is_open else str(each.error)
                errors.setdefault(cause, []).append(each)
        for group in errors.values():
            names, text = list(dict.fromkeys(each.name for each in group)), str(group[0].error)
            is_named = len(names) == 1 and names[0] in re.split(r"[ ,:;]", text)
            report(f"{prefix}{'' if is_named else first_of(names, WRITE_NAMES_MAX) + ': '}{text}")

    def _type_of(self, outcome: SetOutcome) -> ParamType | int:
        """Return the vehicle's type of a parameter; REAL32 if it is not known."""
        if outcome.result is not None:
            return outcome.result.param.type_number
        known = self.session.component.params.get(outcome.name)
        return ParamType.REAL32 if known is None else known.type_number


Job = TypeVar("Job", bound=WriteJob)


async def write_all(
    found: Sessions,
    jobs: Mapping[CommandSession, Job],
    *,
    settle: float,
    force: bool,
    durable: bool,
) -> int:
    """Write the values of all vehicles, and print the outcomes, also those so far after an interruption.

    Returns:
        The exit code.

    Raises:
        AmbiguousVehicle, NoReply, LinkError: as from `CommandSession.check_only`; nothing was written.
    """
    first, writes = jobs[found[0]], any(job.writes for job in jobs.values())
    if writes:
        for each in found:
            await each.check_only()
        await found.report_unheard()
    began = anyio.current_time()
    done = [Done(session, job) for session, job in jobs.items()]
    try:
        if writes:
            await found.work(lambda each: jobs[each].write(settle=settle, force=force, durable=durable))
    except anyio.get_cancelled_exc_class():
        found.show(done, first.columns, first.right, errors=False)
        unknown = sum(each.status is SetStatus.UNKNOWN for job in jobs.values() for each in job.outcomes)
        say(
            f"interrupted: the outcome of {counted(unknown, 'value')} is not known, and the vehicle may "
            "have them; run it again to continue"
        )
        raise
    elapsed = anyio.current_time() - began
    found.show(done, first.columns, first.right, errors=False)
    for job in jobs.values():
        if not found[0].options.json:
            client = job.session.client
            traffic = f"{client.bytes_received:,} bytes received, {client.bytes_sent:,} sent"
            say(job.summary("" if found.is_all else f" in {elapsed:.2f} s, {traffic}"))
        job.report()
    return max(job.code for job in jobs.values())


def _was_sent(outcome: SetOutcome) -> bool:
    is_wrong = isinstance(outcome.error, UnknownParameter | UsageError)
    return outcome.status is not SetStatus.NOT_TRIED and not is_wrong


def _status_in_words(outcome: SetOutcome) -> str:
    """Return the status for a table; a value that was not sent has the words of `apply`, not *refused*."""
    if outcome.status is SetStatus.REFUSED and isinstance(outcome.error, UnknownParameter):
        return NOT_ON_VEHICLE
    if outcome.status is SetStatus.REFUSED and isinstance(outcome.error, UsageError):
        return INVALID
    return outcome.status
