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
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import VehicleJson
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    info_of,
    known_of_session,
    parse_pairs,
    problems,
    resolved,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import print_json, print_table, printable, report, say
from paramclient.cli.param_names import learn_spelling, spelling
from paramclient.cli.read_commands import get_chosen
from paramclient.cli.session import (
    CommandSession,
    announce_write,
    check_link_argument,
    run_on_all,
    sessions,
    wait_for_firmware,
)
from paramclient.cli.write_outcomes import (
    OUTCOME_COLUMNS,
    counted_outcomes,
    outcome_cells,
    outcomes_code,
    report_outcomes,
    summary,
    write_all,
    writes_json,
)
from paramclient.client.component import SETTLE_MAX
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.model.ext_values import parse_ext_value
from paramclient.model.values import ParamType, WireValue, format_value
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
    wanted = parse_pairs(pairs, as_text=extended)
    if described is not None and not extended:
        wanted = [*resolved(wanted, described)]
    async with sessions(url, options, writes=True, extended=extended) as found:
        jobs = {each.address: await _prepare(each, wanted, described, metadata) for each in found}
        await _check_values([*jobs.values()], force=force)
        for each in found:
            await each.check_only()
        await announce_write(found)

        async def work(session: CommandSession) -> Sequence[SetOutcome]:
            job = jobs[session.address]
            return await write_all(
                session,
                job.writes,
                lambda so_far: _print([job], [so_far]),
                verb="setting",
                settle=settle,
                force=force,
                durable=durable,
            )

        began = anyio.current_time()
        done = [each.result or () for each in await run_on_all(found, work)]
        elapsed = anyio.current_time() - began
        is_all = found[0].choice.is_all
        lines = [
            printable(f"{counted_outcomes(outcomes)} on {session.receiver}")
            if is_all
            else summary(session, outcomes, elapsed)
            for session, outcomes in zip(found, done, strict=True)
        ]
    _print([*jobs.values()], done)
    if not options.json:
        for line in lines:
            say(line)
    code: int = ExitCode.DONE
    for job, outcomes in zip(jobs.values(), done, strict=True):
        report_outcomes(outcomes, job.described, vehicle=job.session.prefix)
        code = max(code, outcomes_code(outcomes))
    return code


@dataclass(frozen=True, slots=True)
class _Job:
    """The values for one vehicle, and its metadata."""

    session: CommandSession
    writes: Sequence[tuple[str, WireValue]]
    described: Metadata | None


async def _prepare(
    session: CommandSession,
    wanted: Sequence[tuple[str, WireValue]],
    described: Metadata | None,
    choice: MetadataChoice,
) -> _Job:
    """Return names and values as the vehicle and its metadata have them."""
    if session.component.is_extended:
        return _Job(session, await _extended_values(session, wanted), None)
    await learn_spelling(session.component, [name for name, _ in wanted])
    wanted = [(spelling(name, session.component), value) for name, value in wanted]
    if described is None:
        named = [f"{name}: {value!r} is not a number" for name, value in wanted if isinstance(value, str)]
        described = await known_of_session(session, choice, needed_for=named[0] if named else "")
    return _Job(session, resolved(wanted, described), described)


async def _extended_values(
    session: CommandSession, wanted: Sequence[tuple[str, WireValue]]
) -> list[tuple[str, WireValue]]:
    """Return the values that texts give in the types of extended parameters, which are read first.

    A name that the component does not have keeps its text; the write reports it.

    Raises:
        UsageError: a text is no value of the type.
        ParamClientError: a type could not be read.
    """
    found, errors = await get_chosen(session, [name for name, _ in wanted])
    for error in errors.values():
        if not isinstance(error, UnknownParameter):
            raise error
    types = {param.name: param.type_number for param in found}
    names = [(spelling(name, session.component), str(text)) for name, text in wanted]
    return [
        (name, parse_ext_value(name, text, types[name]) if name in types else text) for name, text in names
    ]


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


def _print(jobs: Sequence[_Job], done: Sequence[Sequence[SetOutcome]]) -> None:
    """Print the outcomes of the vehicles as a table or as JSON."""
    first = jobs[0].session
    pairs = list(zip(jobs, done, strict=True))
    if first.options.json:
        objects = [
            {
                "vehicle": VehicleJson.of(job.session.component),
                "results": writes_json(job.session, outcomes, job.described),
            }
            for job, outcomes in pairs
        ]
        vehicles = [
            {"system": job.session.component.system, "component": job.session.component.component, **each}
            for job, each in zip(jobs, objects, strict=True)
        ]
        print_json({"vehicles": vehicles} if first.choice.is_all else objects[0])
        return
    rows = (
        (
            *([job.session.address] if first.choice.is_all else []),
            *outcome_cells(job.session, outcome, job.described),
        )
        for job, outcomes in pairs
        for outcome in outcomes
    )
    columns = [*(["vehicle"] if first.choice.is_all else []), *OUTCOME_COLUMNS]
    print_table(columns, rows, right="requested actual")
