"""Extended parameters in the subcommands that work on a link: fetch, get, set, apply and restore."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Final, TypeAlias

import anyio

from paramclient.cache import CachedComponent, ParamCache
from paramclient.cli.confirmation import can_confirm, confirm
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import ExtParamJson, ext_value_json
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import print_json, print_table, printable, progress_bar, report, say
from paramclient.cli.param_names import with_suggestion
from paramclient.cli.session import ChosenVehicle, CommandSession, announce_write, connect
from paramclient.cli.sources import check_link, check_new, is_file, names_vehicle, tables_in
from paramclient.cli.write_outcomes import status_in_words
from paramclient.errors import NoReply, NotInCache, ParamClientError, UnknownParameter, UsageError
from paramclient.files.disk import is_extended_file, read_extended_file
from paramclient.model.ext_values import check_ext_value, encode_ext_value, ext_bytes
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.patterns import NameChoice, is_pattern
from paramclient.model.values import Param, ParamType, WireValue, format_value, type_name
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import FetchResult
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.provision import ExtApplyResult, ExtPlan
from paramclient.provision import apply_extended as write_extended_set
from paramclient.provision import verify_extended as verify_extended_set

__all__ = [
    "EXT_COLUMNS",
    "apply_extended",
    "cached_extended",
    "differences_json",
    "ext_cells",
    "ext_text",
    "ext_value_text",
    "extended_source",
    "fetch_extended",
    "get_extended",
    "in_order",
    "is_extended_source",
    "read_extended",
    "set_extended",
    "write_extended",
]

Side: TypeAlias = Param | WrittenParam | None
"""One side of a comparison: as a vehicle has it, as a file has it, or absent."""
NAMES_SHOWN_MAX: Final = 20
"""Names that a message lists; it gives the number of further ones."""
HEX: Final = "hex:"
"""The prefix of a value that is given as bytes in hexadecimal."""
EXT_COLUMNS: Final = ("name", "value", "type", "index")
"""Columns of a table of extended parameters."""


def is_extended_source(text: str) -> bool:
    """Return whether an argument names a file of extended parameters."""
    return is_file(text) and is_extended_file(text)


def ext_value_text(value: WireValue, number: int) -> str:
    """Return the text of an extended value, as subcommands print and take it."""
    return f"{HEX}{value.hex()}" if isinstance(value, bytes) else format_value(value, number)


def ext_text(param: Param | WrittenParam | None) -> str | None:
    """Return the text of the value of a parameter; None for None."""
    return None if param is None else ext_value_text(param.settable, param.type_number or 0)


def ext_cells(param: Param) -> tuple[object, ...]:
    """Return the cells of `EXT_COLUMNS`."""
    return param.name, ext_text(param), type_name(param.type_number), param.index


def in_order(params: Iterable[Param]) -> list[Param]:
    """Return parameters in the order of their indices."""
    return sorted(params, key=lambda param: (param.index is None, param.index or 0, param.name))


# fetch, get, set


async def fetch_extended(session: CommandSession, only: Sequence[str] = ()) -> ExitCode:
    """Fetch all extended parameters, and print them, or only those with these names or patterns.

    Raises:
        UsageError: a name or pattern fits no parameter.
    """
    result = await _fetch(session)
    for note in result.notes:
        report(note)
    params = in_order(result.params.values())
    if only:
        chosen, unmatched = NameChoice(only).choose(result.params)
        if unmatched:
            raise UsageError(f"no extended parameter of {session.label} is called {unmatched}")
        params = [param for param in params if param.name in chosen]
    if session.options.json:
        print_json(
            {
                "system": session.component.system,
                "component": session.component.component,
                "count": result.count,
                "source": result.source,
                "missing": list(result.missing),
                "elapsed_s": round(result.elapsed, 3),
                "extended": {each.name: ExtParamJson.of(each) for each in params},
            }
        )
    else:
        rows = ((*ext_cells(each), each.trust) for each in params)
        print_table([*EXT_COLUMNS, "trust"], rows, right="index")
        of = "" if result.count is None or not result.missing else f" of {result.count}"
        say(
            printable(
                f"{len(result.params)}{of} extended parameters of {session.label} from {result.source} in "
                f"{result.elapsed:.2f} s"
            )
        )
    if result.missing:
        indices = first_of(result.missing, NAMES_SHOWN_MAX)
        report(f"incomplete: indices {indices} of {session.label} were not received; run the command again")
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


async def _fetch(session: CommandSession) -> FetchResult:
    with progress_bar(f"fetching {session.label}") as progress:
        return await session.component.ext.fetch_all(timeout=session.deadline.left(), progress=progress)


async def get_extended(session: CommandSession, given: Sequence[str]) -> ExitCode:
    """Read and print extended parameters that names and patterns choose."""
    component, ext = session.component, session.component.ext
    if any(map(is_pattern, given)):
        await ext.fetch_all(timeout=session.deadline.left())
    names: dict[str, None] = {}
    errors: list[ParamClientError] = []
    for text in given:
        chosen, _ = NameChoice([text]).divide(ext.params)
        if not is_pattern(text):
            names[text if text in ext.params or not chosen else min(chosen)] = None
        elif chosen:
            names |= dict.fromkeys(sorted(chosen))
        else:
            what = f"{session.address} has no extended parameter that matches {text}"
            ids = (component.system, component.component)
            errors.append(UnknownParameter(what, system=ids[0], component=ids[1], name=text))
    found, failed = await read_extended(session, [*names])
    params = [found[name] for name in names if name in found]
    if session.options.json:
        print_json({"extended": {each.name: ExtParamJson.of(each) for each in params}})
    elif params:
        print_table(EXT_COLUMNS, map(ext_cells, params), right="index")
    errors += failed
    for error in errors:
        report(str(error))
    return max((code_of(error) for error in errors), default=ExitCode.DONE)


async def read_extended(
    session: CommandSession, names: Sequence[str]
) -> tuple[dict[str, Param], list[ParamClientError]]:
    """Read several extended parameters concurrently; return them by name, and the errors."""
    found: dict[str, Param] = {}
    errors: list[ParamClientError] = []

    async def read(name: str) -> None:
        try:
            found[name] = await session.component.ext.get(name, timeout=session.deadline.left())
        except UnknownParameter as error:
            errors.append(with_suggestion(error, session.component.ext.params))
        except NoReply as error:
            errors.append(error)

    async with anyio.create_task_group() as tasks:
        for name in names:
            tasks.start_soon(read, name)
    return found, errors


async def set_extended(
    session: CommandSession, pairs: Sequence[tuple[str, str]], *, durable: bool = False
) -> ExitCode:
    """Write extended parameters, and print the outcomes."""
    await session.check_only()
    await announce_write([session])
    found, errors = await read_extended(session, list(dict.fromkeys(name for name, _ in pairs)))
    for error in errors:
        if not isinstance(error, UnknownParameter):
            raise error
    unknown = {error.name: error for error in errors if isinstance(error, UnknownParameter)}
    values = [(name, value_of(name, text, found[name].type_number)) for name, text in pairs if name in found]
    written: Iterable[SetOutcome] = ()
    if values:
        result = await session.component.ext.set_many(
            values, timeout=session.deadline.left(), durable=durable
        )
        written = result.outcomes
    left = iter(written)
    outcomes = [
        next(left) if name in found else SetOutcome(name, text, SetStatus.REFUSED, error=unknown[name])
        for name, text in pairs
    ]
    _print_outcomes(session, outcomes)
    return _code_of_outcomes(outcomes)


def value_of(name: str, text: str, number: int) -> WireValue:
    """Return the value that a text gives in a type: a number, text, or bytes after `hex:`.

    Raises:
        UsageError: the text is no value of this type.
    """
    value: WireValue = text
    try:
        if text.startswith(HEX):
            value = bytes.fromhex(text.removeprefix(HEX))
        elif number in (ParamType.REAL32, ParamType.REAL64):
            value = float(text)
        elif ParamType.UINT8 <= number <= ParamType.INT64:
            value = int(text, 0)
    except ValueError:
        raise UsageError(f"{name}: {text!r} is not a value of type {type_name(number)}") from None
    try:
        encode_ext_value(check_ext_value(value), number)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None
    return value


# Sources, apply, restore


async def extended_source(text: str, options: LinkOptions) -> tuple[ParamSet, Mapping[str, Param]]:
    """Return the extended parameters of a file, a cached vehicle or a link; of vehicles also as received.

    Raises:
        NoReply: a table of a link is incomplete, or nothing was received.
        NotInCache: a cached table is incomplete, or there is none.
    """
    if is_file(text):
        return read_extended_file(text), {}
    if names_vehicle(text):
        if options.place is False:
            raise UsageError(f"{text!r} is a vehicle in the cache, which --no-cache excludes")
        table = cached_extended(text, options.cache, ChosenVehicle.parse(options.vehicle).component)
        if not table.complete:
            raise NotInCache(f"the table of {table.key}, component {table.component}, is incomplete")
        content = ParamSet.of(
            in_order(table.params.values()),
            component=table.component,
            at=max(table.heard_at.values(), default=None),
            source=f"cache {table.key}",
        )
        return content, table.params
    check_link(text)
    async with connect(text, options) as session:
        result = await _fetch(session)
        if not result.complete:
            missing = counted(len(result.missing), "extended parameter")
            raise NoReply(f"{missing} of {session.label}", attempts=0, waited=result.elapsed)
        content = ParamSet.of(
            in_order(result.params.values()),
            component=session.component.component,
            system=session.component.system,
            at=time.time(),
            source=f"link {session.client.link.name}",
        )
        return content, result.params


def cached_extended(vehicle: str | None, cache: str | None, component: int | None = None) -> CachedComponent:
    """Return the only cached table of extended parameters that fits.

    Raises:
        NotInCache: there is none.
        UsageError: there are several.
    """
    with ParamCache(cache) as opened:
        chosen = []
        if vehicle is not None and vehicle.isdecimal():  # a camera of the system has its own hardware id
            chosen = [
                each
                for each in opened.components()
                if each.system == int(vehicle) and component in (None, each.component)
            ]
        chosen = chosen or tables_in(opened, vehicle, component)
        found = [opened.load(each.key, each.component, extended=True) for each in chosen]
        tables = [table for table in found if table is not None and table.params]
    if not tables:
        raise NotInCache("there are no extended parameters of that vehicle in the cache")
    if len(tables) > 1:
        known = ", ".join(f"{table.key}, component {table.component}" for table in tables)
        raise UsageError(f"several tables fit: {known}; choose one as SYSTEM/COMPONENT")
    return tables[0]


async def apply_extended(
    url: str,
    file: str,
    options: LinkOptions,
    *,
    dry_run: bool,
    yes: bool,
    durable: bool,
    backup: str | None,
) -> ExitCode:
    """Write the differing values of a source of extended parameters, and verify them by another download."""
    content, _ = await extended_source(file, options)
    path = None if backup is None else check_new(backup)
    async with connect(url, options, writes=True) as session:
        write = partial(write_extended_set, session.component, content, durable=durable, backup=path)
        return await write_extended(session, content, write, dry_run=dry_run, yes=yes)


async def write_extended(
    session: CommandSession,
    content: ParamSet,
    write: Callable[..., Awaitable[ExtApplyResult]],
    *,
    dry_run: bool,
    yes: bool,
) -> ExitCode:
    """Write a set of extended parameters, after confirmation on a terminal, and print the result.

    Args:
        session: the component.
        content: the wanted parameters.
        write: writes them; it takes `timeout` and `before_writing`.
        dry_run: print only what would be written.
        yes: do not ask.
    """

    async def before() -> None:
        await session.check_only()
        await announce_write([session])

    if dry_run or (not yes and can_confirm(session.options)):
        plan = await verify_extended_set(session.component, content, timeout=session.deadline.left())
        _report_impossible(session, plan, content)
        if dry_run or not plan.changes:
            _print_plan(session, plan, is_dry=dry_run)
            return ExitCode.DONE if plan.is_met else ExitCode.INCOMPLETE
        _print_plan(session, plan, is_dry=True)
        if not await confirm("go on?"):
            return ExitCode.INCOMPLETE
    result = await write(timeout=session.deadline.left(), before_writing=before)
    _report_impossible(session, result.plan, content)
    if not result.plan.changes:
        _print_plan(session, result.plan, is_dry=False)
        return ExitCode.DONE if result.plan.is_met else ExitCode.INCOMPLETE
    _print_outcomes(session, result.outcomes)
    code = _code_of_outcomes(result.outcomes)
    if result.error is not None and not any(result.error is each.error for each in result.outcomes):
        report(str(result.error))
        code = max(code, code_of(result.error))
    now = {} if result.current is None else result.current
    for name in result.different if result.current is not None else ():
        actual = "not there" if name not in now else ext_text(now[name])
        in_file = ext_text(content.params[name])
        report(f"{name}: {session.label} has {actual}, and the file {in_file}")
    return code if result.complete else max(code, ExitCode.INCOMPLETE)


def _report_impossible(session: CommandSession, plan: ExtPlan, content: ParamSet) -> None:
    """Report the wanted parameters that the component lacks, or has in another type."""
    if plan.missing:
        report(f"{session.label} does not have {first_of(plan.missing, NAMES_SHOWN_MAX)}")
    for name in plan.mistyped:
        types = type_name(plan.current[name].type_number), type_name(content.params[name].type_number or 0)
        report(f"{name} is {types[0]} on {session.label}, and {types[1]} in {content.source}")


def differences_json(
    entries: Iterable[tuple[str, Side, Side, str]],
    *,
    is_same: bool,
) -> dict[str, object]:
    """Return the JSON of a comparison: name, left, right and comparison of each entry."""
    extended = [
        {
            "name": name,
            "left": None if left is None else _side_json(left),
            "right": None if right is None else _side_json(right),
            "is": comparison,
        }
        for name, left, right, comparison in entries
    ]
    return {"is_same": is_same, "extended": extended}


def _side_json(param: Param | WrittenParam) -> ExtParamJson:
    return ExtParamJson.of(param) if isinstance(param, Param) else ExtParamJson.written(param)


def _print_plan(session: CommandSession, plan: ExtPlan, *, is_dry: bool) -> None:
    if session.options.json:
        entries = ((name, plan.current[name], param, "different") for name, param in plan.changes.items())
        print_json(differences_json(entries, is_same=not plan.changes))
        return
    if plan.changes:
        rows = ((name, ext_text(plan.current[name]), ext_text(param)) for name, param in plan.changes.items())
        print_table(["name", "now", "wanted"], rows)
    verb = "would be set" if is_dry else "set"
    say(printable(f"{len(plan.changes)} of {session.label} {verb}"))


def _print_outcomes(session: CommandSession, outcomes: Sequence[SetOutcome]) -> None:
    if session.options.json:
        print_json({"results": [_outcome_json(each) for each in outcomes]})
    else:
        rows = (
            (
                each.name,
                ext_value_text(each.requested, ParamType.REAL64),
                None if each.result is None else ext_text(each.result.param),
                status_in_words(each.status, each.error),
            )
            for each in outcomes
        )
        print_table(["name", "requested", "actual", "status"], rows)
        say(printable(f"{sum(each.is_set for each in outcomes)} of {len(outcomes)} set on {session.label}"))
    for each in outcomes:
        if each.error is not None:
            report(f"{each.name}: {each.error}")


def _outcome_json(outcome: SetOutcome) -> dict[str, object]:
    """Return the JSON of an outcome; values that are no text are null, and `…_hex` has their bytes."""
    result, requested = outcome.result, outcome.requested
    written: dict[str, object] = {
        "name": outcome.name,
        "requested": ext_value_json(requested, ParamType.REAL64),
        "actual": None if result is None else ext_value_json(result.actual, result.param.type_number),
        "status": outcome.status.value,
    }
    if isinstance(requested, bytes):
        written["requested_hex"] = requested.hex()
    if result is not None:
        written["actual_hex"] = ext_bytes(result.param).hex()
    if outcome.error is not None:
        written["reason"] = str(outcome.error)
    return written


def _code_of_outcomes(outcomes: Iterable[SetOutcome]) -> ExitCode:
    errors = [each.error for each in outcomes if each.error is not None]
    return max((code_of(error) for error in errors), default=ExitCode.DONE)
