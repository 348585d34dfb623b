"""The subcommand set: values from the arguments, one outcome for each; and the writes, which reset shares."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Final, TypeVar

import anyio
from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import JsonObject, outcome_json, vehicle_json
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    info_of,
    known_of_session,
    meaning_of,
    needs_reboot,
)
from paramclient.cli.options import LinkOptions, Settle
from paramclient.cli.output import Coloured, Status, can_ask, confirm, report, say
from paramclient.cli.param_names import learn_spelling, spelling, suggest
from paramclient.cli.read_commands import get_chosen
from paramclient.cli.session import (
    CommandSession,
    Done,
    Sessions,
    check_link_argument,
    sessions,
    wait_for_firmware,
)
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.metadata.info import number_of
from paramclient.model.ext_values import parse_ext_value
from paramclient.model.values import ParamType, WireValue, check_name, format_value
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Progress
from paramclient.protocol.set_results import SetOutcome, SetStatus

__all__ = ["WriteJob", "set_", "write_all"]

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

_DEFAULTS: Final = LinkOptions()


async def set_(
    url: str,
    /,
    *pairs: Annotated[str, Parameter(name="NAME VALUE", allow_leading_hyphen=True)],
    settle: Settle = 0.0,
    force: bool = False,
    durable: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write parameters in the order given, and verify each by the value that the vehicle reports.

    A value is a decimal or hexadecimal number (0x1F), nan or inf; of an extended parameter also text, or
    bytes as hex:00FF. As NAME=VALUE, it may also be the name of a value, or names of bits separated by |, if
    metadata describes the parameter: it is downloaded from the vehicle unless --metadata names a file. A
    refused value does not stop the others. If several vehicles are heard, --vehicle must choose one, or all.
    A value outside the range in the metadata, or a fraction for an integer parameter, is written only after
    confirmation on a terminal, or with --force.

    Args:
        url: The link.
        pairs: A parameter, in upper or lower case, and its value, or NAME=VALUE. May be given several times.
        settle: Seconds to watch each value before it is read again. 1.2 detects values that PX4's modules
            clamp.
        force: Do not ask about values outside the range, and fractions for integers, which ArduPilot
            truncates. Send NaN and infinity also to PX4, which cannot save them and may stop, and to
            ArduPilot.
        durable: End only when all values and their history are on the disk and survive a power loss.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    check_link_argument(url)
    described = from_file(metadata)
    wanted = _parse_pairs(pairs, as_text=extended)
    if described is not None and not extended:
        wanted = _resolved(wanted, described)
    async with sessions(url, options, writes=True, extended=extended) as found:
        jobs = {each: await _prepare(each, wanted, described, metadata) for each in found}
        await _check_values([*jobs.values()], force=force)
        return await write_all(found, jobs, settle=settle, force=force, durable=durable)


async def _prepare(
    session: CommandSession,
    wanted: Sequence[tuple[str, WireValue]],
    described: Metadata | None,
    choice: MetadataChoice,
) -> WriteJob:
    """Return names and values as the vehicle and its metadata have them.

    Raises:
        UsageError: a text is no value of its parameter.
        ParamClientError: the type of an extended parameter could not be read.
    """
    component = session.component
    if component.is_extended:
        params, errors = await get_chosen(session, [name for name, _ in wanted])
        for error in errors.values():
            if not isinstance(error, UnknownParameter):  # the write reports that
                raise error
        types = {param.name: param.type_number for param in params}
        texts = [(spelling(name, component), str(text)) for name, text in wanted]
        values: list[tuple[str, WireValue]] = [
            (name, parse_ext_value(name, text, types[name]) if name in types else text)
            for name, text in texts
        ]
        return WriteJob(session, values, None)
    await learn_spelling(component, [name for name, _ in wanted])
    wanted = [(spelling(name, component), value) for name, value in wanted]
    if described is None:
        named = [f"{name}: {value!r} is not a number" for name, value in wanted if isinstance(value, str)]
        described = await known_of_session(session, choice, needed_for=named[0] if named else "")
    return WriteJob(session, _resolved(wanted, described), described)


async def _check_values(jobs: Sequence[WriteJob], *, force: bool) -> None:
    """Report values that are probably wrong; continue if the user confirms them, or with `force`.

    Raises:
        UsageError: the user does not confirm, or there is no terminal. Nothing was written.
    """
    doubts = dict.fromkeys([doubt for job in jobs async for doubt in _doubts(job)])
    for doubt in doubts:
        report(doubt)
    if not doubts or force:
        return
    if not can_ask():
        raise UsageError("nothing was written; --force writes these values all the same")
    await wait_for_firmware([job.session.component for job in jobs], jobs[0].session.deadline)
    receivers = ", ".join(job.session.receiver for job in jobs)
    if not await confirm(f"Write these values to {receivers} all the same?"):
        raise UsageError("nothing was written")


async def _doubts(job: WriteJob) -> AsyncIterator[str]:
    """Yield sentences on values outside the range, and on fractions for integers."""
    for name, value in job.writes:
        info = info_of(job.described, name)
        if info is not None and (problem := info.problem(value)) is not None:
            yield problem
        if not isinstance(value, float) or not math.isfinite(value) or value.is_integer():
            continue
        is_integer = info is not None and (
            bool(info.bits) or (info.type is not None and info.type.is_integer)
        )
        if not is_integer:
            component, timeout = job.session.component, job.session.deadline.left()
            try:
                known = component.params.get(name) or await component.get(name, timeout=timeout)
            except ParamClientError:
                continue  # the write will fail for the same reason, and say so
            is_integer = known.type.is_integer
        if is_integer:
            yield f"{name}: {format_value(value)} is not a whole number, and {name} is an integer"


# The arguments


def _parse_pairs(words: Sequence[str], *, as_text: bool = False) -> list[tuple[str, WireValue]]:
    """Parse parameters and values, as `NAME VALUE` or `NAME=VALUE`.

    A value after an equals sign may be the name of a value; it is returned as text. With `as_text`, every
    value is.

    Raises:
        UsageError: a name has no value, or a name or value is invalid.
    """
    pairs: list[tuple[str, WireValue]] = []
    left = iter(words)
    for word in left:
        if word.startswith("-"):  # values may be negative, so that an unknown option would be a name
            raise UsageError(f"Unknown option: {word.partition('=')[0]}. Nothing was written.")
        name, equals, text = word.partition("=")
        value = text if equals else next(left, None)
        if value is None:
            break
        if not as_text and equals and not value.strip():
            raise UsageError(f"{name}: there is no value after the equals sign")
        number = None if as_text else _number_or_none(name, value)
        if number is None and not (as_text or equals):
            if value.startswith("="):
                raise UsageError(f"write {name}=VALUE without spaces, or {name} VALUE without an equals sign")
            raise UsageError(
                f"{name}: {value!r} is not a number, such as 12, 0x1F, -1.5, 1e-3, nan or inf. "
                f"If it is the name of a value, write {shlex.quote(f'{name}={value}')}"
            )
        pairs.append((check_name(name), value if number is None else number))
    else:
        if pairs:
            return pairs
    end = f", and {words[-1]} has no value" if words else ""
    raise UsageError(f"set takes pairs of NAME and VALUE, or NAME=VALUE{end}")


def _number_or_none(name: str, text: str) -> int | float | None:
    """Parse a value exactly: an integer as an int, other numbers as a float; None if it is not a number."""
    try:
        return None if text != text.strip() else number_of(text)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None


def _resolved(
    pairs: Iterable[tuple[str, WireValue]], metadata: Metadata | None
) -> list[tuple[str, WireValue]]:
    """Return the pairs with every name of a value replaced by its number.

    Raises:
        UsageError: an unknown name of a value, or a parameter without metadata.
    """
    numbers: list[tuple[str, WireValue]] = []
    for name, value in pairs:
        if isinstance(value, str):
            info = info_of(metadata, name)
            if info is None:
                raise UsageError(f"{name}: {value!r} is not a number, and no metadata describes {name}")
            value = info.parse(value)
        numbers.append((name, value))
    return numbers


# Writes, also of reset


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
