"""The subcommand set: values from the arguments, one outcome for each, and what an interruption leaves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final

import anyio
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.extended import (
    check_choice,
    is_extended_session,
    may_be_extended,
    set_extended,
    text_pairs,
)
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    info_of,
    known_of_session,
    needs_reboot,
    parse_pairs,
    problems,
    resolved,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import (
    Coloured,
    print_document,
    print_table,
    printable,
    progress_bar,
    report,
    say,
)
from paramclient.cli.param_names import suggest
from paramclient.cli.session import CommandSession, connect
from paramclient.client.arguments import SETTLE_MAX
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.model.values import ParamType, Value, format_value
from paramclient.model.wording import counted, first_of
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.params.write_batch import SetOutcome, SetStatus

if TYPE_CHECKING:
    from paramclient.documents.command_output import WritesOutputDoc

__all__ = ["set_"]

WRITE_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""

_DEFAULTS: Final = LinkOptions()


async def set_(
    url: str,
    /,
    *pairs: Annotated[str, Parameter(name="NAME VALUE", allow_leading_hyphen=True)],
    settle: Annotated[float, Parameter(validator=Number(gte=0, lte=SETTLE_MAX))] = 0.0,
    force: bool = False,
    durable: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    plain: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write parameters in the order given, and verify each by the value that the vehicle reports.

    A value is a decimal or hexadecimal number (0x1F), nan or inf; of an extended parameter also text, or
    bytes as hex:00FF. As NAME=VALUE, it may also be the name of a value, or names of bits separated by |, if
    metadata describes the parameter: it is downloaded from the vehicle unless --metadata names a file. Many
    writes are in flight at a time; values of one name, and switches such as *_ENABLE, are written one after
    the other. A refused value does not stop the others. If several vehicles are heard, --system must choose
    one.

    Args:
        url: The link.
        pairs: A parameter and its value, or NAME=VALUE. May be given several times.
        settle: Seconds for which each value is watched until it is read again. 1.2 shows values that PX4's
            modules clamp.
        force: Send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot.
        durable: End only when all values and their history are on the disk and survive a power loss.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Use the extended parameters (PARAM_EXT_*) of the component, as of a camera. Without it, a
            camera, gimbal or other payload is asked whether it has them.
        plain: Use the plain parameters, also of a component that has extended ones.
    """
    check_choice(extended=extended, plain=plain)
    described = from_file(metadata)
    wanted: list[tuple[str, int | float | str]] = []
    texts: list[tuple[str, str]] = []
    if may_be_extended(options, extended=extended, plain=plain):
        texts = text_pairs(pairs)
    else:
        wanted = parse_pairs(pairs)
        if described is not None:
            wanted = [*resolved(wanted, described)]
    async with connect(url, options, only=True) as session:
        if texts:
            if await is_extended_session(session, extended=extended, plain=plain):
                if settle or force or durable or metadata is not None:
                    raise UsageError("--settle, --force, --durable and --metadata are for plain parameters")
                return await set_extended(session, texts)
            wanted = parse_pairs(pairs)
        if described is None:
            has_names = any(isinstance(value, str) for _, value in wanted)
            described = await known_of_session(session, metadata, must=has_names)
        writes = resolved(wanted, described)
        for problem in problems(writes, described):
            report(problem)
        await session.check_only()
        began = anyio.current_time()
        outcomes = await _write(session, writes, described, settle=settle, force=force, durable=durable)
        outcomes = await _with_suggestions(session, outcomes)
        client = session.client
        summary = (
            f"{_counted(outcomes)} on {session.label} in {anyio.current_time() - began:.2f} s, "
            f"{client.bytes_received:,} bytes received, {client.bytes_sent:,} sent"
        )
    _print(session, outcomes, described)
    if not options.json:
        say(summary)
    late = {
        each.name: None
        for each in outcomes
        if each.is_set and each.error is None and needs_reboot(each.name, described)
    }
    if late:
        say(printable(f"takes effect after a reboot: {', '.join(late)}"))
    _report_all(outcomes)
    return max(ExitCode.DONE if each.error is None else code_of(each.error) for each in outcomes)


async def _write(
    session: CommandSession,
    writes: Sequence[tuple[str, int | float]],
    described: Metadata | None,
    *,
    settle: float,
    force: bool,
    durable: bool,
) -> Sequence[SetOutcome]:
    """Write the values; return one outcome for each, also if nothing could be written."""
    with _progress_until_interrupted(session, writes, described) as progress:
        try:
            done = await session.component.set_many(
                writes,
                progress=progress,
                timeout=session.deadline.left(),
                settle=settle,
                force=force,
                durable=durable,
            )
        except ParamClientError as error:  # raised only if nothing was written
            return [SetOutcome(name, value, SetStatus.NOT_TRIED, error=error) for name, value in writes]
    return done.outcomes


async def _with_suggestions(session: CommandSession, outcomes: Sequence[SetOutcome]) -> Sequence[SetOutcome]:
    """Return the outcomes with suggestions for names that the vehicle does not have."""
    errors = {each.name: each.error for each in outcomes if isinstance(each.error, UnknownParameter)}
    better = await suggest(session, {**errors})
    return [
        replace(each, error=better[each.name]) if isinstance(each.error, UnknownParameter) else each
        for each in outcomes
    ]


@contextmanager
def _progress_until_interrupted(
    session: CommandSession, writes: Sequence[tuple[str, int | float]], described: Metadata | None
) -> Iterator[Callable[[SetOutcome], None]]:
    """Yield a function that draws the progress; on cancellation, print the outcomes so far."""
    arrived: list[SetOutcome] = []
    began = anyio.current_time()
    try:
        with progress_bar(f"setting {session.label}") as draw:

            def update(outcome: SetOutcome) -> None:
                arrived.append(outcome)
                if draw is not None:
                    rate = len(arrived) / max(anyio.current_time() - began, 0.001)
                    draw(Progress(len(arrived), len(writes), rate, (len(writes) - len(arrived)) / rate))

            yield update
    except anyio.get_cancelled_exc_class():
        outcomes = _in_order(writes, arrived)
        _print(session, outcomes, described)
        open_count = sum(each.status is SetStatus.UNKNOWN for each in outcomes)
        say(
            f"interrupted: the outcome of {counted(open_count, 'value')} is not known, and the vehicle may "
            "have them; run it again to continue"
        )
        raise


def _in_order(writes: Sequence[tuple[str, int | float]], arrived: Sequence[SetOutcome]) -> list[SetOutcome]:
    """Return one outcome for each value in the order of the request; *unknown* for those without one."""
    left = [*arrived]
    outcomes = []
    for name, value in writes:
        found = next((each for each in left if each.name == name), None)  # those of one name are in order
        if found is not None:
            left.remove(found)
        outcomes.append(found or SetOutcome(name, value, SetStatus.UNKNOWN))
    return outcomes


def _print(session: CommandSession, outcomes: Sequence[SetOutcome], described: Metadata | None) -> None:
    """Print the outcomes as a table or as JSON."""
    if session.options.json:
        print_document(_document(session, outcomes, described))
        return
    print_table(
        ["name", "requested", "actual", "status"],
        (_cells(session, outcome) for outcome in outcomes),
        right="requested actual",
    )


def _document(
    session: CommandSession, outcomes: Sequence[SetOutcome], described: Metadata | None
) -> WritesOutputDoc:
    from paramclient.documents.command_output import (  # only here: loads pydantic
        WriteOutputDoc,
        WritesOutputDoc,
    )

    return WritesOutputDoc(
        results=[
            WriteOutputDoc.of(each, _type_of(session, each), info_of(described, each.name))
            for each in outcomes
        ]
    )


def _cells(session: CommandSession, outcome: SetOutcome) -> tuple[object, ...]:
    return (
        outcome.name,
        _text(outcome.requested, ParamType.REAL64),
        _text(outcome.actual, _type_of(session, outcome)),
        Coloured(outcome.status, _STYLES[outcome.status]),
    )


def _text(value: Value | None, kind: ParamType | int) -> str | None:
    return None if value is None else format_value(value, kind)


def _type_of(session: CommandSession, outcome: SetOutcome) -> ParamType | int:
    """Return the vehicle's type of a parameter; REAL32 if it is not known."""
    if outcome.result is not None:
        return outcome.result.param.type
    known = session.component.params.get(outcome.name)
    return ParamType.REAL32 if known is None else known.type


def _report_all(outcomes: Sequence[SetOutcome]) -> None:
    """Print the remarks and the errors: one line for all values without a response, and for one cause."""
    errors: dict[object, list[SetOutcome]] = {}
    for each in outcomes:
        if each.result is not None and each.result.note:
            say(printable(f"{each.name}: {each.result.note}"))
        if each.error is not None:
            is_open = each.status in (SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
            cause = (each.status, type(each.error)) if is_open else str(each.error)
            errors.setdefault(cause, []).append(each)
    for group in errors.values():
        names = first_of(list(dict.fromkeys(each.name for each in group)), WRITE_NAMES_MAX)
        report(f"{names}: {group[0].error}")


def _counted(outcomes: Sequence[SetOutcome]) -> str:
    """Return the numbers of outcomes in words: `2 of 4 set, 1 refused, 1 not tried`."""
    done = sum(each.is_set for each in outcomes)
    failed = {
        status: sum(each.status is status for each in outcomes)
        for status in SetStatus
        if status not in (SetStatus.ACCEPTED, SetStatus.ADJUSTED)
    }
    others = [f"{count} {status}" for status, count in failed.items() if count]
    return ", ".join([f"{done} of {len(outcomes)} set", *others])


_STYLES: Final = {
    SetStatus.ACCEPTED: "green",
    SetStatus.ADJUSTED: "yellow",
    SetStatus.REFUSED: "red",
    SetStatus.UNKNOWN: "bold red",
    SetStatus.NOT_TRIED: "dim",
}
"""Styles of rich for each outcome."""
