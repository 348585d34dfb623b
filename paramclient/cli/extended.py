"""Extended parameters in the subcommands that take them: fetch, get, set, watch, show, save, apply, …."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

import anyio
import anyio.to_thread

from paramclient.cache import CachedExtTable, ParamCache
from paramclient.cli.confirmation import can_confirm, confirm
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.metadata import check_no_option
from paramclient.cli.options import CacheOptions, LinkOptions
from paramclient.cli.output import (
    local_time,
    print_document,
    print_table,
    printable,
    progress_bar,
    report,
    say,
)
from paramclient.cli.restore_states import choices_error
from paramclient.cli.session import CommandSession, connect
from paramclient.cli.sources import check_link, is_file, names_vehicle, tables_in
from paramclient.cli.targets import check_new
from paramclient.cli.time_arguments import parse_when
from paramclient.cli.watch_lines import HEX, ext_value_text, print_changes_and_events
from paramclient.cli.write_outcomes import status_in_words
from paramclient.errors import (
    AlreadyRestored,
    CacheError,
    NoReply,
    NotInCache,
    UnknownParameter,
    UsageError,
)
from paramclient.files import FileFormat
from paramclient.files.disk import is_extended_file, read_extended_file, write_extended_file
from paramclient.model.ext_params import (
    ExtParam,
    ExtParamType,
    ExtValue,
    check_ext_value,
    encode_ext_value,
    ext_type_name,
)
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.patterns import NameChoice, is_pattern
from paramclient.model.similar_names import did_you_mean, nearest_names
from paramclient.model.values import check_name
from paramclient.model.wording import counted, first_of
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.protocol.vehicle.extended_kinds import expects_extended
from paramclient.provision import ExtApplyResult, ExtPlan, load_extended_state
from paramclient.provision import apply_extended as write_extended_set
from paramclient.provision import restore_extended as restore_extended_set
from paramclient.provision import verify_extended as verify_extended_set

__all__ = [
    "are_extended",
    "apply_extended",
    "check_choice",
    "diff_extended",
    "fetch_extended",
    "get_extended",
    "history_extended",
    "is_extended_link",
    "is_extended_session",
    "is_extended_source",
    "may_be_extended",
    "restore_extended",
    "save_extended",
    "set_extended",
    "show_extended",
    "text_pairs",
    "watch_extended",
]

PROBE_TIMEOUT: Final = 2.0
"""Seconds in which a component of a kind that usually has extended parameters must send one, before its plain
ones are used: four attempts, where nothing is known of the link."""
NAMES_SHOWN_MAX: Final = 20
"""Names that a message lists; it gives the number of further ones."""


def check_choice(*, extended: bool, plain: bool) -> None:
    """Check that not both protocols are chosen.

    Raises:
        UsageError: they are.
    """
    if extended and plain:
        raise UsageError("--extended and --plain exclude each other")


def may_be_extended(options: LinkOptions, *, extended: bool, plain: bool) -> bool:
    """Return whether the component that the options name may turn out to have extended parameters."""
    is_likely = options.component is not None and expects_extended(None, options.component)
    return extended or (is_likely and not plain)


async def is_extended_session(session: CommandSession, *, extended: bool, plain: bool) -> bool:
    """Return whether to use the extended parameters of the component.

    Without a choice of the user, the first one is requested from a component that usually has them.
    """
    if extended or plain or session.client.listens_only:
        return extended
    ext = session.component.ext
    if ext.is_spoken or not ext.is_expected:
        return ext.is_spoken
    try:
        await ext.get(0, timeout=session.deadline.left(PROBE_TIMEOUT))
    except (NoReply, UnknownParameter):
        return False
    return True


def is_extended_source(text: str) -> bool:
    """Return whether an argument names a file of extended parameters."""
    return is_file(text) and is_extended_file(text)


# fetch, get, set


async def fetch_extended(session: CommandSession, only: Sequence[str] = ()) -> ExitCode:
    """Fetch all extended parameters, and print them, or only those with these names or patterns.

    Raises:
        UsageError: a name or pattern fits no parameter.
    """
    options = session.options
    component = session.component
    with progress_bar(f"fetching {session.label}") as progress:
        result = await component.ext.fetch_all(timeout=session.deadline.left(), progress=progress)
    for note in result.notes:
        report(note)
    params = _by_index(result.params.values())
    if only:
        chosen, unmatched = NameChoice(only).choose(result.params)
        if unmatched:
            raise UsageError(f"no extended parameter of {session.label} is called {unmatched}")
        params = [param for param in params if param.name in chosen]
    if options.json:
        from paramclient.documents.extended_output import ExtFetchOutputDoc  # only here: loads pydantic

        print_document(ExtFetchOutputDoc.of(result, params))
    else:
        print_table([*_COLUMNS, "trust"], ((*_cells(each), each.trust) for each in params), right="index")
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


async def get_extended(session: CommandSession, names: Sequence[str]) -> ExitCode:
    """Read and print single extended parameters."""
    names, unmatched = await _chosen_names(session, names)
    found, errors = await _read_all(session, names)
    params = [found[name] for name in names if name in found]
    errors = [*unmatched, *errors]
    if session.options.json:
        from paramclient.documents.extended_output import ExtParamsOutputDoc  # only here: loads pydantic

        print_document(ExtParamsOutputDoc.of(params))
    elif params:
        print_table(_COLUMNS, map(_cells, params), right="index")
    for error in errors:
        report(str(error))
    return max((code_of(error) for error in errors), default=ExitCode.DONE)


async def _chosen_names(
    session: CommandSession, given: Sequence[str]
) -> tuple[list[str], list[NoReply | UnknownParameter]]:
    """Return the names that names and patterns choose, after a download if there is a pattern; and errors."""
    component = session.component
    ext = component.ext
    if any(map(is_pattern, given)):
        await ext.fetch_all(timeout=session.deadline.left())
    names: dict[str, None] = {}
    errors: list[NoReply | UnknownParameter] = []
    for text in given:
        chosen, _ = NameChoice([text]).divide(ext.params)
        if chosen or not is_pattern(text):
            exact = text in ext.params or not chosen
            names |= dict.fromkeys([text] if exact and not is_pattern(text) else sorted(chosen))
            continue
        label = f"{component.system}/{component.component}"
        what = f"{label} has no extended parameter that matches {text}"
        errors.append(
            UnknownParameter(what, system=component.system, component=component.component, name=text)
        )
    return list(names), errors


async def _read_all(
    session: CommandSession, names: Sequence[str]
) -> tuple[dict[str, ExtParam], list[NoReply | UnknownParameter]]:
    """Read several extended parameters concurrently; return them by name, and the errors."""
    found: dict[str, ExtParam] = {}
    errors: list[NoReply | UnknownParameter] = []

    async def read(name: str) -> None:
        try:
            found[name] = await session.component.ext.get(name, timeout=session.deadline.left())
        except UnknownParameter as error:
            errors.append(_with_nearest(error, session.component.ext.params))
        except NoReply as error:
            errors.append(error)

    async with anyio.create_task_group() as tasks:
        for name in names:
            tasks.start_soon(read, name)
    return found, errors


def _with_nearest(error: UnknownParameter, known: Iterable[str]) -> UnknownParameter:
    """Return the error with the most similar ones of these names, if it names none."""
    nearest = () if error.nearest or error.name is None else nearest_names(error.name, known)
    if not nearest:
        return error
    return UnknownParameter(
        f"{error}.{did_you_mean(nearest)}",
        system=error.system,
        component=error.component,
        name=error.name,
        nearest=nearest,
    )


def text_pairs(words: Sequence[str]) -> list[tuple[str, str]]:
    """Parse the arguments of `set`, as `NAME VALUE` or `NAME=VALUE`, without reading the values.

    Raises:
        UsageError: a name has no value, or is invalid.
    """
    pairs: list[tuple[str, str]] = []
    left = iter(words)
    for word in left:
        check_no_option(word)
        name, equals, text = word.partition("=")
        value = text if equals else next(left, None)
        if value is None:
            raise UsageError(f"{name}: there is no value")
        pairs.append((check_name(name), value))
    if not pairs:
        raise UsageError("set takes pairs of NAME and VALUE, or NAME=VALUE")
    return pairs


async def set_extended(
    session: CommandSession, pairs: Sequence[tuple[str, str]], *, durable: bool = False
) -> ExitCode:
    """Write extended parameters, and print the outcomes."""
    await session.check_only()
    await session.announce_write()
    found, errors = await _read_all(session, list(dict.fromkeys(name for name, _ in pairs)))
    for error in errors:
        if not isinstance(error, UnknownParameter):
            raise error
    unknown = {error.name: error for error in errors if isinstance(error, UnknownParameter)}
    values = [(name, value_of(name, text, found[name].type)) for name, text in pairs if name in found]
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


def value_of(name: str, text: str, number: int) -> ExtValue:
    """Return the value that a text gives in a type: a number, text, or bytes after `hex:`.

    Raises:
        UsageError: the text is no value of this type.
    """
    value: ExtValue = text
    try:
        if text.startswith(HEX):
            value = bytes.fromhex(text.removeprefix(HEX))
        elif number in (ExtParamType.REAL32, ExtParamType.REAL64):
            value = float(text)
        elif ExtParamType.UINT8 <= number <= ExtParamType.INT64:
            value = int(text, 0)
    except ValueError:
        raise UsageError(f"{name}: {text!r} is not a value of type {ext_type_name(number)}") from None
    try:
        encode_ext_value(check_ext_value(value), number)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None
    return value


async def watch_extended(session: CommandSession, name_patterns: Sequence[str]) -> ExitCode:
    """Print changes of extended parameters until the timeout of the options."""
    ext = session.component.ext
    changes, events = ext.changes(), session.client.events()
    known: set[str] | None = None
    if not session.client.listens_only:
        if not name_patterns or any(map(is_pattern, name_patterns)):
            with suppress(CacheError):  # with an empty cache, all received parameters are new
                await ext.fetch_all(timeout=session.deadline.left())
        _, errors = await _read_all(session, [name for name in name_patterns if not is_pattern(name)])
        if errors:
            for error in errors:
                report(str(error))
            return max(map(code_of, errors))
        known = set(ext.params)
    watched = ", ".join(name_patterns) if name_patterns else counted(len(ext.params), "extended parameter")
    say(printable(f"watching {watched} of {session.label}"))
    with anyio.move_on_after(session.deadline.left()):
        choice = NameChoice(name_patterns) if name_patterns else None
        await print_changes_and_events(session, changes, events, known, choice)
    return ExitCode.DONE


# show, save, diff


def show_extended(
    vehicle: str | None, names: Sequence[str], component: int | None, options: CacheOptions
) -> ExitCode:
    """Print extended parameters of a file, or cached ones."""
    if vehicle is not None and is_file(vehicle):
        file = read_extended_file(vehicle)
        params, description = (
            list(file.params.values()),
            f"{len(file.params)} extended parameters from {vehicle}",
        )
    else:
        table = _cached(vehicle, component, options)
        params = _by_index(table.params.values())
        description = f"{len(params)} extended parameters of {table.key}, component {table.component}"
    if names:
        chosen, unmatched = NameChoice(names).choose({each.name for each in params})
        if unmatched:
            raise NotInCache(f"not among the extended parameters: {unmatched}")
        params = [each for each in params if each.name in chosen]
    if options.json:
        from paramclient.documents.extended_output import ExtParamsOutputDoc  # only here: loads pydantic

        print_document(ExtParamsOutputDoc.of(params))
    else:
        print_table(_COLUMNS, map(_cells, params), right="index")
        say(printable(description))
    return ExitCode.DONE


async def save_extended(
    where: str, file: Path, file_format: FileFormat | None, options: LinkOptions
) -> ExitCode:
    """Write extended parameters to a file. An incomplete table is not written."""
    content = await _source(where, options)
    file_format = await anyio.to_thread.run_sync(
        lambda: write_extended_file(file, content, file_format=file_format)
    )
    if options.json:
        from paramclient.documents.extended_output import ExtSavedDoc  # only here: loads pydantic

        print_document(ExtSavedDoc.of(str(file), file_format, content))
    else:
        whose = f"{content.system}/{content.component}"
        say(
            printable(
                f"{len(content.params)} extended parameters of {whose} written to {file} ({file_format})"
            )
        )
    return ExitCode.DONE


async def diff_extended(
    left: str, right: str, options: LinkOptions, *, partial: bool, everything: bool
) -> ExitCode:
    """Compare the extended parameters of two sources."""
    first, second = await _source(left, options), await _source(right, options)
    names = list(dict.fromkeys((*first.params, *second.params)))
    if partial:
        names = list(second.params if is_file(right) and not is_file(left) else first.params)
    pairs = [(name, first.params.get(name), second.params.get(name)) for name in names]
    entries = [(name, one, two, _comparison(one, two)) for name, one, two in pairs]
    different = [entry for entry in entries if entry[3] != "same"]
    shown = entries if everything else different
    if options.json:
        from paramclient.documents.extended_output import ExtDiffDoc  # only here: loads pydantic

        print_document(ExtDiffDoc.of(shown, is_same=not different))
    else:
        if shown:
            rows = ((name, _text(one), _text(two), word) for name, one, two, word in shown)
            print_table(["name", "left", "right", "is"], rows)
        for side, content in (("left", first), ("right", second)):
            say(printable(f"{side}: {len(content.params)} extended parameters from {content.source}"))
        say(f"{len(entries) - len(different)} same, {len(different)} different")
    return ExitCode.DIFFERENT if different else ExitCode.DONE


# apply, restore


async def apply_extended(
    url: str,
    file: str,
    options: LinkOptions,
    *,
    dry_run: bool,
    yes: bool,
    durable: bool = False,
    backup: str | None = None,
) -> ExitCode:
    """Write the differing values of a file of extended parameters, and verify them by another download.

    The file may also be a vehicle in the cache, or a link.
    """
    content = await _source(file, options)
    path = None if backup is None else check_new(backup)
    async with connect(url, options, only=True) as session:
        write = partial(
            write_extended_set,
            session.component,
            content,
            durable=durable,
            backup=path,
            before_writing=partial(_before_writing, session),
        )
        return await _write_set(session, content, write, dry_run=dry_run, yes=yes)


async def restore_extended(
    url: str,
    when: str | None,
    options: LinkOptions,
    *,
    dry_run: bool,
    yes: bool,
    backup: str | None = None,
) -> ExitCode:
    """Restore an earlier state of the extended parameters of a component.

    `when` is a time, the number of a snapshot, or a backup file; None is the state before the last apply.
    """
    path = None if backup is None else check_new(backup)
    async with connect(url, options, only=True) as session:
        component = session.component
        if when is not None and is_file(when):
            state = read_extended_file(when)
        else:
            moment = None if when is None else parse_when(when, time.time())
            try:
                state = await load_extended_state(component, moment)
            except AlreadyRestored as error:
                raise choices_error(error, url, options, component, extended=True) from None
        at = "" if state.at is None else f", {local_time(state.at)}"
        say(printable(f"the state: {len(state.params)} extended parameters from {state.source}{at}"))
        before = partial(_before_writing, session)
        write = partial(restore_extended_set, component, state, backup=path, before_writing=before)
        return await _write_set(session, state, write, dry_run=dry_run, yes=yes)


async def _before_writing(session: CommandSession) -> None:
    await session.check_only()
    await session.announce_write()


async def _write_set(
    session: CommandSession,
    content: ExtParamSet,
    write: Callable[..., Awaitable[ExtApplyResult]],
    *,
    dry_run: bool,
    yes: bool,
) -> ExitCode:
    """Write a set of extended parameters, after confirmation on a terminal, and print the result."""
    if dry_run or (not yes and can_confirm(session.options)):
        plan = await verify_extended_set(session.component, content, timeout=session.deadline.left())
        _report_impossible(session, plan, content)
        if dry_run or not plan.changes:
            _print_plan(session, plan, is_dry=dry_run)
            return ExitCode.DONE if plan.is_met else ExitCode.INCOMPLETE
        _print_plan(session, plan, is_dry=True)
        if not await confirm("go on?"):
            return ExitCode.INCOMPLETE
    result = await write(timeout=session.deadline.left())
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
        actual = "not there" if name not in now else _text(now[name])
        in_file = _text(content.params[name])
        report(f"{name}: {session.label} has {actual}, and the file {in_file}")
    return code if result.complete else max(code, ExitCode.INCOMPLETE)


def history_extended(
    vehicle: str,
    names: Sequence[str],
    component: int | None,
    options: CacheOptions,
    *,
    limit: int | None,
    since: float | None,
) -> ExitCode:
    """Print the changes of a vehicle's extended parameters, the newest last."""
    with ParamCache(options.cache) as cache:
        key = tables_in(cache, vehicle, None)[0].key
        entries = cache.ext_history(key, component, None, None if names else limit, since)
    if names:
        choice = NameChoice(names)
        entries = [each for each in entries if choice.has(each.name)]
        entries = entries[-limit:] if limit else entries
    if options.json:
        from paramclient.documents.extended_output import ExtHistoryDoc  # only here: loads pydantic

        print_document(ExtHistoryDoc.of(entries))
        return ExitCode.DONE
    rows = (
        (local_time(each.at), each.component, each.name, _text(each.old), _text(each.new), each.by)
        for each in entries
    )
    print_table(["time", "component", "name", "old", "new", "by"], rows)
    return ExitCode.DONE


async def is_extended_link(text: str, options: LinkOptions) -> bool:
    """Return whether an argument names a link, and the component that the options name speaks the extended
    protocol."""
    is_link = not (is_file(text) or names_vehicle(text, options.cache))
    if not is_link or options.listen_only or not may_be_extended(options, extended=False, plain=False):
        return False
    check_link(text)
    async with connect(text, options) as session:
        return await is_extended_session(session, extended=False, plain=False)


async def are_extended(sources: Sequence[str], options: LinkOptions) -> bool:
    """Return whether none of these sources is a file, and at least one is a link to a component that speaks
    the extended protocol."""
    if any(map(is_file, sources)):
        return False
    for text in sources:
        if await is_extended_link(text, options):
            return True
    return False


# internal

_COLUMNS: Final = ("name", "value", "type", "index")
"""Columns of the table of extended parameters."""


def _cells(param: ExtParam) -> tuple[object, ...]:
    return param.name, _text(param), ext_type_name(param.type), param.index


def _text(param: ExtParam | None) -> str | None:
    return None if param is None else ext_value_text(param.value, param.type)


def _by_index(params: Iterable[ExtParam]) -> list[ExtParam]:
    return sorted(params, key=lambda param: (param.index is None, param.index or 0, param.name))


def _comparison(left: ExtParam | None, right: ExtParam | None) -> str:
    if left is None or right is None:
        return "only right" if left is None else "only left"
    return "same" if left.same_value(right) else "different"


def _cached(vehicle: str | None, component: int | None, options: CacheOptions) -> CachedExtTable:
    """Return the only cached table of extended parameters that fits.

    Raises:
        NotInCache: there is none.
        UsageError: there are several.
    """
    with ParamCache(options.cache) as cache:
        found = [cache.load_ext(each.key, each.component) for each in tables_in(cache, vehicle, component)]
        tables = [table for table in found if table is not None]
    if not tables:
        raise NotInCache("there are no extended parameters of that vehicle in the cache")
    if len(tables) > 1:
        known = ", ".join(f"{table.key}/{table.component}" for table in tables)
        raise UsageError(f"several tables fit: {known}; choose a vehicle, and a --component")
    return tables[0]


async def _source(text: str, options: LinkOptions) -> ExtParamSet:
    """Return the extended parameters of a file, a cached vehicle or a link.

    Raises:
        NoReply: a table of a link is incomplete, or nothing was received.
        NotInCache: a cached table is incomplete, or there is none.
    """
    if is_file(text):
        return read_extended_file(text)
    if names_vehicle(text, options.cache):
        if options.place is False:
            raise UsageError(f"{text!r} is a vehicle in the cache, which --no-cache excludes")
        table = _cached(text, options.component, CacheOptions(cache=options.cache))
        if not table.complete:
            raise NotInCache(f"the table of {table.key}, component {table.component}, is incomplete")
        params = {param.name: param for param in _by_index(table.params.values())}
        at = max(table.heard_at.values(), default=None)
        return ExtParamSet(params, None, table.component, at, f"cache {table.key}")
    check_link(text)
    async with connect(text, options) as session:
        with progress_bar(f"fetching {session.label}") as progress:
            result = await session.component.ext.fetch_all(timeout=session.deadline.left(), progress=progress)
        if not result.complete:
            missing = counted(len(result.missing), "extended parameter")
            raise NoReply(f"{missing} of {session.label}", attempts=0, waited=result.elapsed)
        params = {param.name: param for param in _by_index(result.params.values())}
        return ExtParamSet(
            params, result.system, result.component, time.time(), f"link {session.client.link.name}"
        )


def _report_impossible(session: CommandSession, plan: ExtPlan, content: ExtParamSet) -> None:
    """Report the wanted parameters that the component lacks, or has in another type."""
    if plan.missing:
        report(f"{session.label} does not have {first_of(plan.missing, NAMES_SHOWN_MAX)}")
    for name in plan.mistyped:
        types = ext_type_name(plan.current[name].type), ext_type_name(content.params[name].type)
        report(f"{name} is {types[0]} on {session.label}, and {types[1]} in {content.source}")


def _plan_entries(plan: ExtPlan) -> list[tuple[str, ExtParam | None, ExtParam | None, str]]:
    return [(name, plan.current[name], param, "different") for name, param in plan.changes.items()]


def _print_changes(plan: ExtPlan) -> None:
    if plan.changes:
        rows = ((name, _text(plan.current[name]), _text(param)) for name, param in plan.changes.items())
        print_table(["name", "now", "wanted"], rows)


def _print_plan(session: CommandSession, plan: ExtPlan, *, is_dry: bool) -> None:
    if session.options.json:
        from paramclient.documents.extended_output import ExtDiffDoc  # only here: loads pydantic

        print_document(ExtDiffDoc.of(_plan_entries(plan), is_same=not plan.changes))
        return
    _print_changes(plan)
    verb = "would be set" if is_dry else "set"
    say(printable(f"{len(plan.changes)} of {session.label} {verb}"))


def _print_outcomes(session: CommandSession, outcomes: Sequence[SetOutcome]) -> None:
    if session.options.json:
        from paramclient.documents.extended_output import ExtWritesOutputDoc  # only here: loads pydantic

        print_document(ExtWritesOutputDoc.of(outcomes))
    else:
        rows = (
            (
                each.name,
                ext_value_text(each.requested, ExtParamType.REAL64),
                None if each.result is None else _text(each.result.param),
                status_in_words(each.status, each.error),
            )
            for each in outcomes
        )
        print_table(["name", "requested", "actual", "status"], rows)
        say(printable(f"{sum(each.is_set for each in outcomes)} of {len(outcomes)} set on {session.label}"))
    for each in outcomes:
        if each.error is not None:
            report(f"{each.name}: {each.error}")


def _code_of_outcomes(outcomes: Iterable[SetOutcome]) -> ExitCode:
    errors = [each.error for each in outcomes if each.error is not None]
    return max((code_of(error) for error in errors), default=ExitCode.DONE)
