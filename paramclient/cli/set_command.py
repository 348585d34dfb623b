"""The subcommand set; and writes to vehicles, as of set and apply: one job for each, with its outcomes."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial as bind
from typing import Annotated, ClassVar, Protocol, Self

import anyio
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.json_output import JsonObject, info_of, results_json
from paramclient.cli.metadata import MetadataChoice, known_of_session
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import ExitCode, Status, can_ask, code_of, confirm, report, say
from paramclient.cli.session import CommandSession, Sessions, Shown, get_chosen, sessions, spelling
from paramclient.client.component import SETTLE_MAX
from paramclient.errors import ParamClientError, UsageError, VehicleError
from paramclient.metadata import Metadata
from paramclient.metadata.info import ParamInfo, number_of
from paramclient.model.names import is_pattern
from paramclient.model.values import ParamType, Value, bits_of, check_name, parse_ext_value
from paramclient.protocol.set_results import SetOutcome, SetStatus


async def set_(
    url: str,
    /,
    *pairs: Annotated[str, Parameter(name="NAME VALUE", allow_leading_hyphen=True)],
    settle: Annotated[float, Parameter(validator=Number(gte=0, lte=SETTLE_MAX))] = 0.0,
    force: bool = False,
    metadata: MetadataChoice = None,
    options: LinkOptions = LinkOptions(),
) -> int:
    """Write parameters in the order given, and verify each by the value that the vehicle reports.

    A value is a decimal or hexadecimal number (0x1F), nan or inf; of an extended parameter also text, or
    bytes as hex:00FF. It may also be the name of a value, or names of bits separated by |, if metadata
    describes the parameter: it is downloaded from the vehicle unless --metadata names a file. A value that
    the vehicle refuses does not stop the others. If several vehicles are heard, --vehicle must choose one, or
    all. If a value is outside the range in the metadata, or the type of its parameter cannot hold it, values
    are written only after confirmation on a terminal, or with --force.

    Args:
        url: The link.
        pairs: A parameter, in upper or lower case, and its value, or NAME=VALUE. May be given several times.
        settle: Seconds to watch each value before it is read again. 1.2 detects values that PX4's modules
            clamp.
        force: Do not ask about values outside the range, and fractions for integers, which ArduPilot
            truncates. Send NaN and infinity also to PX4, which cannot save them and may stop, and to
            ArduPilot.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
    """
    texts = _parse_pairs(pairs)
    async with sessions(url, options, writes=True) as found:
        jobs: dict[CommandSession, SetJob] = {}
        with interruptible(found, jobs):
            jobs |= await found.work(bind(_prepare, texts=texts, choice=metadata, settle=settle, force=force))
            doubts = dict.fromkeys(doubt for job in jobs.values() for doubt in job.doubts)
            for doubt in doubts:
                report(doubt)
            if doubts and not force:
                receivers = ", ".join(session.receiver for session in jobs)
                if not can_ask():
                    raise UsageError("nothing was sent; --force writes what can be written")
                if not await confirm(f"Write these values to {receivers} all the same?"):
                    return ExitCode.INCOMPLETE
            return found.show(await found.work(lambda session: jobs[session].write()))


def _parse_pairs(words: Sequence[str]) -> dict[str, str]:
    """Return the texts of values by parameter, from `NAME VALUE` or `NAME=VALUE`.

    Raises:
        UsageError: a name has no value, is invalid, or is given twice.
    """
    pairs, left = dict[str, str](), iter(words)
    for word in left:
        if word.startswith("-"):  # values may be negative, so that an unknown option would be a name
            raise UsageError(f"Unknown option: {word.partition('=')[0]}. Nothing was written.")
        name, equals, text = word.partition("=")
        if not equals and (text := next(left, "")) == "":
            raise UsageError(f"set takes pairs of NAME and VALUE, or NAME=VALUE, and {name} has no value")
        if check_name(name) in pairs or is_pattern(name):
            raise UsageError(f"{name}: set takes names, no patterns, and each once")
        pairs[name] = text
    if not pairs:
        raise UsageError("set takes pairs of NAME and VALUE, or NAME=VALUE")
    return pairs


async def _prepare(
    session: CommandSession, texts: Mapping[str, str], choice: MetadataChoice, *, settle: float, force: bool
) -> SetJob:
    """Return names and values as the vehicle and its metadata have them.

    The parameters are read first: texts of extended ones have values only with their types, and all values
    are checked before one is written.

    Raises:
        UsageError: a text is no value of its parameter.
    """
    component, job = session.component, SetJob(session, settle, force)
    if not component.is_extended:
        words = [pair for pair in texts.items() if number_of(pair[1]) is None]
        needed_for = "{}: {!r} is not a number".format(*words[0]) if words else ""
        job.described = await known_of_session(session, choice, needed_for=needed_for)
    pairs = {spelling(given, component): text for given, text in texts.items()}
    _, job.errors = await get_chosen(session, [*pairs])
    if len({spelling(each, component) for each in texts}) < len(texts):
        raise UsageError(f"{', '.join(texts)}: set takes each parameter once")
    for name, text in pairs.items():
        known = component.params.get(spelling(name, component))
        if component.is_extended:
            job.writes[name] = text if known is None else parse_ext_value(name, text, known.type)
            continue
        info = info_of(job.described, name) or ParamInfo(name)
        job.writes[name] = value = info.parse(text)
        if (problem := info.problem(value)) is not None:
            job.doubts.append(problem)
        try:
            bits_of(value, ParamType.REAL64 if known is None else known.type)
        except UsageError as error:
            job.doubts.append(f"{name}: {error}")
    return job


# Writes


class WriteJob(Shown, Protocol):
    """What is written to one vehicle; `report` and the rows give the outcomes so far."""

    has_begun: bool
    """Whether values may have been sent."""

    async def write(self) -> Self:
        """Write the values, and return the job."""


@contextmanager
def interruptible(found: Sessions, jobs: Mapping[CommandSession, WriteJob]) -> Iterator[None]:
    """After an interruption of the block, print the outcomes so far, or that nothing was sent."""
    try:
        yield
    except anyio.get_cancelled_exc_class():
        has_begun = any(job.has_begun for job in jobs.values())
        if has_begun or (jobs and found[0].options.json):
            found.show(jobs)
        say(f"interrupted: {'values without a proof may be in flight' if has_begun else 'nothing was sent'}")
        raise


@dataclass(eq=False)
class SetJob:
    """The values of set for one vehicle in the order of the writes, and the outcomes so far.

    Attributes:
        session: the vehicle.
        settle, force: as in `Component.set_many`.
        described: the metadata of the vehicle, or None.
        writes: the values by name.
        errors: by name, why a parameter could not be read; its value is not sent, and if the vehicle did not
            answer, none is.
        doubts: sentences on values outside the range, and on those that the type cannot hold.
        outcomes: one for each value by name; *unknown* for those without one so far.
        has_begun: whether values may have been sent.
    """

    columns: ClassVar[Sequence[str]] = ("name", "requested", "actual", "status", "reason")

    session: CommandSession
    settle: float
    force: bool
    described: Metadata | None = None
    writes: dict[str, Value] = field(default_factory=dict)
    errors: dict[str, ParamClientError] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    outcomes: dict[str, SetOutcome] = field(default_factory=dict)
    has_begun: bool = False

    async def write(self) -> Self:
        """Write the values, and return the job, in which each has an outcome.

        Raises:
            AmbiguousVehicle: as from `CommandSession.check_only`; nothing was written.
            NoReply, LinkError: nothing was written.
        """
        session, numbers = self.session, itertools.count(1)
        await session.check_only()
        self.has_begun = True
        silent = next((each for each in self.errors.values() if not isinstance(each, VehicleError)), None)
        for name, value in self.writes.items():
            error = self.errors.get(name, silent)
            failed = SetStatus.REFUSED if isinstance(error, VehicleError) else SetStatus.NOT_TRIED
            self.outcomes[name] = SetOutcome(name, value, failed if error else SetStatus.UNKNOWN, None, error)
        left = {each.name: each.requested for each in self.outcomes.values() if each.error is None}

        def update(outcome: SetOutcome) -> None:
            self.outcomes[outcome.name] = outcome
            status.count(next(numbers), len(left))

        label, timeout = session.label, session.deadline.left()
        with Status(f"waiting for {label} to acknowledge PARAM_SET", f"setting {label}") as status:
            done = await session.component.set_many(
                left, progress=update, timeout=timeout, settle=self.settle, force=self.force
            )
        self.outcomes |= {each.name: each for each in done.outcomes}
        return self

    def as_json(self) -> JsonObject:
        """Return the JSON of the vehicle and the outcomes."""
        return results_json(self.outcomes.values(), self.session.component, self.described)

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the rows; the reported value with its meaning, if that is known."""
        for each in self.as_json()["results"]:
            actual = each["actual"] if "text" not in each else f"{each['actual']} ({each['text']})"
            is_late = each["actual"] is not None and each.get("reboot_required")
            late = "takes effect after a reboot" if is_late else None
            reason = None if each["status"] == SetStatus.NOT_TRIED else each.get("reason")
            reasons = filter(None, (reason, each.get("note"), late))
            yield each["name"], each["requested"], actual, each["status"], "; ".join(reasons) or None

    def report(self) -> int:
        """Print the number of values with each outcome, and once why values were not tried."""
        counts = Counter(each.status for each in self.outcomes.values())
        if not self.session.options.json:
            words = ", ".join(f"{counts[status]} {status}" for status in SetStatus if status in counts)
            say(f"{self.session.receiver}: {words}")
        errors = [(each.status, each.error) for each in self.outcomes.values() if each.error is not None]
        if untried := [error for status, error in errors if status is SetStatus.NOT_TRIED]:
            report(f"{self.session.prefix}{untried[0]}")
        return max((code_of(error) for _, error in errors), default=0)
