"""Writes of a subcommand: outcomes of the values, and their output, also after an interruption."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Final

import anyio

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import WriteJson
from paramclient.cli.metadata import info_of, meaning_of, needs_reboot
from paramclient.cli.output import (
    Coloured,
    printable,
    progress_bar,
    report,
    say,
    while_waiting,
)
from paramclient.cli.param_names import suggest
from paramclient.cli.session import CommandSession
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.model.values import ParamType, WireValue, format_value
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Progress
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetStatus

__all__ = [
    "OUTCOME_COLUMNS",
    "counted_outcomes",
    "outcome_cells",
    "outcomes_code",
    "report_outcomes",
    "status_in_words",
    "summary",
    "write_all",
    "writes_json",
]

OUTCOME_COLUMNS: Final = ("name", "requested", "actual", "status")
"""Columns of a table of outcomes."""
NOT_ON_VEHICLE: Final = "not on this vehicle"
"""The status, in a table, of a name that the vehicle does not have: it has refused nothing."""
INVALID: Final = "invalid"
"""The status, in a table, of a value that cannot be sent."""
WRITE_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""


async def write_all(
    session: CommandSession,
    writes: Sequence[tuple[str, WireValue]],
    show: Callable[[Sequence[SetOutcome]], None],
    *,
    verb: str,
    settle: float,
    force: bool,
    durable: bool,
) -> Sequence[SetOutcome]:
    """Write values; return one outcome for each, also if nothing could be written.

    Args:
        session: the session.
        writes: pairs of name and value, in the order of the writes.
        show: prints outcomes as the subcommand does; called on cancellation with the outcomes so far.
        verb: the action for the progress bar, `setting`.
        settle, force, durable: as in `Component.set_many`.
    """
    drawn = None if session.choice.is_all else verb  # two bars at once are not possible
    with _progress_until_interrupted(session, writes, show, drawn) as progress:

        async def write(erase: Callable[[], None]) -> SetManyResult:
            def report(outcome: SetOutcome) -> None:
                erase()
                progress(outcome)

            return await session.component.set_many(
                writes,
                progress=report,
                timeout=session.deadline.left(),
                settle=settle,
                force=force,
                durable=durable,
            )

        try:
            done = await while_waiting(write, f"{session.label} to acknowledge PARAM_SET")
        except ParamClientError as error:  # raised only if nothing was written
            return [SetOutcome(name, value, SetStatus.NOT_TRIED, error=error) for name, value in writes]
    return await _with_suggestions(session, done.outcomes)


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
    session: CommandSession,
    writes: Sequence[tuple[str, WireValue]],
    show: Callable[[Sequence[SetOutcome]], None],
    verb: str | None,
) -> Iterator[Callable[[SetOutcome], None]]:
    """Yield a function that draws the progress; on cancellation, print the outcomes so far.

    Args:
        session, writes, show: as in `write_all`.
        verb: the action for the progress bar; None to draw none.
    """
    arrived: list[SetOutcome] = []
    began = anyio.current_time()
    try:
        with nullcontext() if verb is None else progress_bar(f"{verb} {session.label}") as draw:

            def update(outcome: SetOutcome) -> None:
                arrived.append(outcome)
                if draw is not None:
                    rate = len(arrived) / max(anyio.current_time() - began, 0.001)
                    draw(Progress(len(arrived), len(writes), rate, (len(writes) - len(arrived)) / rate))

            yield update
    except anyio.get_cancelled_exc_class():
        outcomes = _in_order(writes, arrived)
        show(outcomes)
        open_count = sum(each.status is SetStatus.UNKNOWN for each in outcomes)
        say(
            f"interrupted: the outcome of {counted(open_count, 'value')} is not known, and the vehicle may "
            "have them; run it again to continue"
        )
        raise


def _in_order(writes: Sequence[tuple[str, WireValue]], arrived: Sequence[SetOutcome]) -> list[SetOutcome]:
    """Return one outcome for each value in the order of the request; *unknown* for those without one."""
    left = [*arrived]
    outcomes = []
    for name, value in writes:
        found = next((each for each in left if each.name == name), None)  # those of one name are in order
        if found is not None:
            left.remove(found)
        outcomes.append(found or SetOutcome(name, value, SetStatus.UNKNOWN))
    return outcomes


def outcome_cells(
    session: CommandSession, outcome: SetOutcome, described: Metadata | None = None
) -> tuple[object, ...]:
    """Return the cells of `OUTCOME_COLUMNS` for an outcome; the reported value with its meaning, if known."""
    kind = type_of(session, outcome)
    actual = _text(outcome.reported, kind)
    if outcome.reported is not None and (meaning := meaning_of(described, outcome.name, outcome.reported)):
        actual = f"{actual} ({meaning})"
    return (
        outcome.name,
        _text(outcome.requested, kind if isinstance(outcome.requested, bytes) else ParamType.REAL64),
        actual,
        Coloured(status_in_words(outcome.status, outcome.error), _STYLES[outcome.status]),
    )


def status_in_words(status: SetStatus, error: Exception | None) -> str:
    """Return a status for a table; a value that was not sent has the words of `apply`, not *refused*."""
    if status is SetStatus.REFUSED and isinstance(error, UnknownParameter):
        return NOT_ON_VEHICLE
    if status is SetStatus.REFUSED and isinstance(error, UsageError):
        return INVALID
    return status


def _text(value: WireValue | None, kind: ParamType | int) -> str | None:
    return None if value is None else format_value(value, kind)


def writes_json(
    session: CommandSession, outcomes: Sequence[SetOutcome], described: Metadata | None
) -> list[WriteJson]:
    """Return the JSON of outcomes."""
    return [WriteJson.of(each, type_of(session, each), info_of(described, each.name)) for each in outcomes]


def type_of(session: CommandSession, outcome: SetOutcome) -> ParamType | int:
    """Return the vehicle's type of a parameter; REAL32 if it is not known."""
    if outcome.result is not None:
        return outcome.result.param.type_number
    known = session.component.params.get(outcome.name)
    return ParamType.REAL32 if known is None else known.type_number


def report_outcomes(outcomes: Sequence[SetOutcome], described: Metadata | None, *, vehicle: str = "") -> None:
    """Print remarks, and errors: one line for all values without a response, and for one cause.

    Args:
        outcomes: the outcomes of one vehicle.
        described: its metadata, or None.
        vehicle: beginning of each line, where several vehicles were written to.
    """
    late = {
        each.name: None
        for each in outcomes
        if each.is_set and each.error is None and needs_reboot(each.name, described)
    }
    if late:
        say(printable(f"{vehicle}takes effect after a reboot: {', '.join(late)}"))
    errors: dict[object, list[SetOutcome]] = {}
    for each in outcomes:
        if each.result is not None and each.result.note:
            say(printable(f"{vehicle}{each.name}: {each.result.note}"))
        if each.error is not None:
            is_open = each.status in (SetStatus.UNKNOWN, SetStatus.NOT_TRIED)
            cause = (each.status, type(each.error)) if is_open else str(each.error)
            errors.setdefault(cause, []).append(each)
    for group in errors.values():
        names = first_of(list(dict.fromkeys(each.name for each in group)), WRITE_NAMES_MAX)
        report(f"{vehicle}{names}: {group[0].error}")


def outcomes_code(outcomes: Sequence[SetOutcome]) -> int:
    """Return the exit code for all outcomes."""
    codes = [ExitCode.DONE if each.error is None else code_of(each.error) for each in outcomes]
    return max(codes, default=ExitCode.DONE)


def summary(session: CommandSession, outcomes: Sequence[SetOutcome], elapsed: float) -> str:
    """Return the line about all writes: numbers of outcomes, seconds, and bytes of the link."""
    client = session.client
    return (
        f"{counted_outcomes(outcomes)} on {session.receiver} in {elapsed:.2f} s, "
        f"{client.bytes_received:,} bytes received, {client.bytes_sent:,} sent"
    )


def counted_outcomes(outcomes: Sequence[SetOutcome]) -> str:
    """Return the numbers of outcomes in words: `2 of 4 set, 1 refused, 1 not tried`."""
    done = sum(each.is_set for each in outcomes)
    failed = sorted(
        (each for each in outcomes if each.status not in (SetStatus.ACCEPTED, SetStatus.ADJUSTED)),
        key=lambda each: [*SetStatus].index(each.status),
    )
    counts = Counter(status_in_words(each.status, each.error) for each in failed)
    others = [f"{count} {words}" for words, count in counts.items()]
    return ", ".join([f"{done} of {len(outcomes)} set", *others])


_STYLES: Final = {
    SetStatus.ACCEPTED: "green",
    SetStatus.ADJUSTED: "yellow",
    SetStatus.REFUSED: "red",
    SetStatus.UNKNOWN: "bold red",
    SetStatus.NOT_TRIED: "dim",
}
"""Styles of rich for each outcome."""
