"""Writes of set: the values for each vehicle, one outcome for each, and what is printed of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final

import anyio

from paramclient.cli.json_output import JsonObject, outcome_json, vehicle_json
from paramclient.cli.metadata import info_of, meaning_of
from paramclient.cli.output import LINE_NAMES_MAX, Coloured, ExitCode, Status, code_of, report, say
from paramclient.cli.param_names import suggest
from paramclient.cli.session import CommandSession, Done, Sessions
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.model.names import counted, first_of
from paramclient.model.values import ParamType, Value, format_value
from paramclient.protocol.fetch import Progress
from paramclient.protocol.set_results import SetOutcome, SetStatus

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
    """The values for one vehicle in the order of the writes, and the outcomes so far.

    Attributes:
        session: the vehicle.
        writes: the values by name.
        described: the metadata of the vehicle, or None.
        arrived: the outcomes so far, by name.
        began: the time of the event loop at which it was made.
    """

    columns: ClassVar[Sequence[str]] = ("name", "requested", "actual", "status")

    session: CommandSession
    writes: Mapping[str, Value]
    described: Metadata | None
    arrived: dict[str, SetOutcome] = field(default_factory=dict)
    began: float = field(default_factory=anyio.current_time)

    async def write(self, *, settle: float, force: bool) -> None:
        """Write the values as `Component.set_many` does; afterwards each has an outcome in any case."""
        session = self.session
        is_announced = False

        def update(outcome: SetOutcome) -> None:
            nonlocal is_announced
            is_wrong = isinstance(outcome.error, UnknownParameter | UsageError)
            if not (is_announced or is_wrong or outcome.status is SetStatus.NOT_TRIED):
                is_announced = True
                session.announce_write()
            self.arrived[outcome.name] = outcome
            elapsed = anyio.current_time() - self.began
            status.update(Progress.after(len(self.arrived), len(self.writes), elapsed))

        label = session.label
        with Status(f"waiting for {label} to acknowledge PARAM_SET", f"setting {label}") as status:
            try:
                done = await session.component.set_many(
                    self.writes, progress=update, timeout=session.deadline.left(), settle=settle, force=force
                )
                outcomes = done.outcomes
            except ParamClientError as error:  # raised only if nothing was written
                pairs = self.writes.items()
                outcomes = tuple(SetOutcome(*pair, SetStatus.NOT_TRIED, error=error) for pair in pairs)
        unknown = {each.name: each.error for each in outcomes if isinstance(each.error, UnknownParameter)}
        better = await suggest(session, {**unknown})
        self.arrived = {
            each.name: replace(each, error=better.get(each.name, each.error)) for each in outcomes
        }

    @property
    def outcomes(self) -> list[SetOutcome]:
        """One outcome for each value; *unknown* for those without one, after an interruption."""
        return [
            self.arrived.get(name) or SetOutcome(name, value, SetStatus.UNKNOWN)
            for name, value in self.writes.items()
        ]

    @property
    def summary(self) -> str:
        """The numbers of outcomes in words: `2 of 4 set, 1 refused, 1 not tried on 1/1 PX4 … in 0.2 s, …`."""
        counts = Counter(each.status for each in self.outcomes)
        done = counts.pop(SetStatus.ACCEPTED, 0) + counts.pop(SetStatus.ADJUSTED, 0)
        others = [f"{counts[status]} {status}" for status in SetStatus if status in counts]
        session, client = self.session, self.session.client
        what = f"{', '.join([f'{done} of {len(self.writes)} set', *others])} on {session.receiver}"
        if session.choice.is_all:
            return what
        traffic = f"{client.bytes_received:,} bytes received, {client.bytes_sent:,} sent"
        return f"{what} in {anyio.current_time() - self.began:.2f} s, {traffic}"

    def as_json(self) -> JsonObject:
        """Return the JSON of the vehicle and the outcomes."""
        results = [
            outcome_json(each, self._type_of(each), info_of(self.described, each.name))
            for each in self.outcomes
        ]
        return {"vehicle": vehicle_json(self.session.component), "results": results}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the rows; the reported value with its meaning, if that is known."""
        for each in self.outcomes:
            kind, name = self._type_of(each), each.name
            requested = kind if isinstance(each.requested, bytes) else ParamType.REAL64
            actual = None if each.reported is None else format_value(each.reported, kind)
            meaning = None if each.reported is None else meaning_of(self.described, name, each.reported)
            yield (
                name,
                format_value(each.requested, requested),
                f"{actual} ({meaning})" if meaning else actual,
                Coloured(each.status, _STYLES[each.status]),
            )

    def report(self) -> int:
        """Print a summary, remarks, and a line for the errors of each cause; return the exit code."""
        prefix, errors = self.session.prefix, dict[object, list[SetOutcome]]()
        code = ExitCode.DONE
        if not self.session.options.json:
            say(self.summary)
        for each in self.arrived.values():
            info = info_of(self.described, each.name)
            if each.is_set and info is not None and info.reboot_required:
                say(f"{prefix}{each.name} takes effect after a reboot")
            if each.result is not None and each.result.note:
                say(f"{prefix}{each.name}: {each.result.note}")
            if each.error is not None:
                code = max(code, code_of(each.error))
                is_open = each.status in (SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
                cause = (each.status, type(each.error)) if is_open else str(each.error)
                errors.setdefault(cause, []).append(each)
        for group in errors.values():
            names, text = [each.name for each in group], str(group[0].error)
            is_named = len(names) == 1 and names[0] in re.split(r"[ ,:;]", text)
            report(f"{prefix}{'' if is_named else first_of(names, LINE_NAMES_MAX) + ': '}{text}")
        return code

    def _type_of(self, outcome: SetOutcome) -> ParamType | int:
        """Return the vehicle's type of a parameter; REAL32 if it is not known."""
        if outcome.result is not None:
            return outcome.result.param.type
        known = self.session.component.params.get(outcome.name)
        return ParamType.REAL32 if known is None else known.type


async def write_all(found: Sessions, jobs: Sequence[WriteJob], *, settle: float, force: bool) -> int:
    """Write the values of all vehicles, and print the outcomes, also those so far after an interruption.

    Returns:
        The exit code.

    Raises:
        AmbiguousVehicle, NoReply, LinkError: as from `CommandSession.check_only`; nothing was written.
    """
    by_session, done = {job.session: job for job in jobs}, [Done(job.session, job) for job in jobs]
    if any(job.writes for job in jobs):
        for each in found:
            await each.check_only()
        try:
            await found.work(lambda each: by_session[each].write(settle=settle, force=force))
        except anyio.get_cancelled_exc_class():
            found.show(done, errors=False)
            unknown = sum(each.status is SetStatus.UNKNOWN for job in jobs for each in job.outcomes)
            say(
                f"interrupted: the outcome of {counted(unknown, 'value')} is not known, and the vehicle may "
                "have them; run it again to continue"
            )
            raise
    return found.show(done, errors=False)
