"""The subcommand set: values from the arguments, one outcome for each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import anyio
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.confirmation import can_ask, confirm
from paramclient.cli.every_vehicle import (
    address_text,
    check_all,
    check_expected,
    every_vehicle,
    run_on_all,
)
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.extended import (
    check_choice,
    is_extended_session,
    may_be_extended,
    set_extended,
    text_pairs,
)
from paramclient.cli.json_output import VehicleJson, WriteJson
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    info_of,
    known_of_session,
    parse_pairs,
    problems,
    resolved,
)
from paramclient.cli.options import Count, LinkOptions
from paramclient.cli.output import print_json, print_table, printable, report, say
from paramclient.cli.param_names import spelling
from paramclient.cli.session import CommandSession, check_link_argument, connect, wait_for_firmware
from paramclient.cli.write_outcomes import (
    OUTCOME_COLUMNS,
    counted_outcomes,
    outcome_cells,
    outcomes_code,
    report_outcomes,
    summary,
    type_of,
    write_all,
)
from paramclient.client.arguments import SETTLE_MAX
from paramclient.errors import ParamClientError, UsageError
from paramclient.metadata import Metadata
from paramclient.model.values import ParamType, format_value
from paramclient.protocol.set_results import SetOutcome

__all__ = ["set_"]

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
    all_: Annotated[bool, Parameter(name="--all")] = False,
    expect: Count = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write parameters in the order given, and verify each by the value that the vehicle reports.

    A value is a decimal or hexadecimal number (0x1F), nan or inf; of an extended parameter also text, or
    bytes as hex:00FF. As NAME=VALUE, it may also be the name of a value, or names of bits separated by |, if
    metadata describes the parameter: it is downloaded from the vehicle unless --metadata names a file. Many
    writes are in flight at a time; values of one name, and switches such as *_ENABLE, are written one after
    the other. A refused value does not stop the others. If several vehicles are heard, --system must
    choose one, or --all must choose all. A value outside the range in the metadata, or a fraction for an
    integer parameter, is written only after confirmation on a terminal, or with --force.

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
        extended: Use the extended parameters (PARAM_EXT_*) of the component, such as a camera. Without this
            option, they are used if a camera or other payload answers a request for the first one.
        plain: Use the plain parameters, even if the component has extended ones.
        all_: Write to every vehicle heard within 3 s.
        expect: With --all: wait up to 10 s for this number of vehicles, and write to none if there are fewer.
    """
    check_link_argument(url)
    check_expected(expect, all_=all_)
    if all_:
        check_all(options, extended=extended)
        plain = True
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
    if all_:
        async with every_vehicle(url, options, expect=expect) as sessions:
            jobs = [await _prepare(each, wanted, described, metadata) for each in sessions]
            await _check_values(jobs, force=force)
            for each in sessions:
                await each.announce_write()
            done = await run_on_all(
                jobs, lambda job: _write(job, settle=settle, force=force, durable=durable, draws=False)
            )
        return _show_fleet(jobs, [each.result or () for each in done], options)
    async with connect(url, options, only=True) as session:
        if texts:
            if await is_extended_session(session, extended=extended, plain=plain):
                if settle or force or metadata is not None:
                    raise UsageError("--settle, --force and --metadata are for plain parameters")
                return await set_extended(session, texts, durable=durable)
            wanted = parse_pairs(pairs)
        job = await _prepare(session, wanted, described, metadata)
        described = job.described
        await _check_values([job], force=force)
        await session.check_only()
        await session.announce_write()
        await session.report_unheard()
        began = anyio.current_time()
        outcomes = await _write(job, settle=settle, force=force, durable=durable)
        line = summary(session, outcomes, anyio.current_time() - began)
    _print(session, outcomes, described)
    if not options.json:
        say(line)
    report_outcomes(outcomes, described)
    return outcomes_code(outcomes)


@dataclass(frozen=True, slots=True)
class _Job:
    """The values for one vehicle, and its metadata."""

    session: CommandSession
    writes: Sequence[tuple[str, int | float]]
    described: Metadata | None


async def _prepare(
    session: CommandSession,
    wanted: Sequence[tuple[str, int | float | str]],
    described: Metadata | None,
    choice: MetadataChoice,
) -> _Job:
    """Return names and values as the vehicle and its metadata have them."""
    wanted = [(spelling(name, session.component), value) for name, value in wanted]
    if described is None:
        named = [f"{name}: {value!r} is not a number" for name, value in wanted if isinstance(value, str)]
        described = await known_of_session(session, choice, needed_for=named[0] if named else "")
    return _Job(session, resolved(wanted, described), described)


async def _check_values(jobs: Sequence[_Job], *, force: bool) -> None:
    """Report values that are probably wrong; continue if the user confirms them, or with `force`.

    Raises:
        UsageError: the user does not confirm, or there is no terminal. Nothing was written.
    """
    found = [problem for job in jobs for problem in problems(job.writes, job.described)]
    for job in jobs:
        found += await _fractions(job)
    for problem in dict.fromkeys(found):
        report(problem)
    if not found or force:
        return
    if not can_ask():
        raise UsageError("nothing was written; --force writes these values all the same")
    await wait_for_firmware([job.session.component for job in jobs], jobs[0].session.deadline)
    receivers = ", ".join(job.session.receiver for job in jobs)
    if not await confirm(f"Write these values to {receivers} all the same?"):
        raise UsageError("nothing was written")


async def _fractions(job: _Job) -> list[str]:
    """Return sentences on fractions for parameters that are integers, by metadata or the vehicle's type."""
    found = []
    for name, value in job.writes:
        if not isinstance(value, float) or not math.isfinite(value) or value.is_integer():
            continue
        info, component = info_of(job.described, name), job.session.component
        kind = None if info is None else info.type
        if info is not None and info.bits:
            kind = ParamType.INT32
        if kind is None or not kind.is_integer:
            try:
                known = component.params.get(name) or await component.get(
                    name, timeout=job.session.deadline.left()
                )
            except ParamClientError:
                continue  # the write will fail for the same reason, and say so
            kind = known.type
        if kind.is_integer:
            found.append(f"{name}: {format_value(value)} is not a whole number, and {name} is an integer")
    return found


async def _write(
    job: _Job, *, settle: float, force: bool, durable: bool, draws: bool = True
) -> Sequence[SetOutcome]:
    """Write the values; return one outcome for each, also if nothing could be written."""
    return await write_all(
        job.session,
        job.writes,
        lambda so_far: _print(job.session, so_far, job.described),
        verb="setting",
        settle=settle,
        force=force,
        durable=durable,
        draws=draws,
    )


def _print(session: CommandSession, outcomes: Sequence[SetOutcome], described: Metadata | None) -> None:
    """Print the outcomes as a table or as JSON."""
    if session.options.json:
        print_json(_json(session, outcomes, described))
        return
    print_table(
        OUTCOME_COLUMNS,
        (outcome_cells(session, outcome, described) for outcome in outcomes),
        right="requested actual",
    )


def _json(
    session: CommandSession, outcomes: Sequence[SetOutcome], described: Metadata | None
) -> dict[str, object]:
    results = [WriteJson.of(each, type_of(session, each), info_of(described, each.name)) for each in outcomes]
    return {"vehicle": VehicleJson.of(session.component), "results": results}


def _show_fleet(jobs: Sequence[_Job], done: Sequence[Sequence[SetOutcome]], options: LinkOptions) -> int:
    """Print the outcomes of several vehicles; return the exit code."""
    pairs = list(zip(jobs, done, strict=True))
    if options.json:
        vehicles = [
            {
                "system": job.session.component.system,
                "component": job.session.component.component,
                **_json(job.session, outcomes, job.described),
            }
            for job, outcomes in pairs
        ]
        print_json({"vehicles": vehicles})
    else:
        rows = (
            (address_text(job.session), *outcome_cells(job.session, outcome, job.described))
            for job, outcomes in pairs
            for outcome in outcomes
        )
        print_table(["vehicle", *OUTCOME_COLUMNS], rows, right="requested actual")
        for job, outcomes in pairs:
            say(printable(f"{counted_outcomes(outcomes)} on {job.session.receiver}"))
    code: int = ExitCode.DONE
    for job, outcomes in pairs:
        report_outcomes(outcomes, job.described, vehicle=f"{job.session.label}: ")
        code = max(code, outcomes_code(outcomes))
    return code
