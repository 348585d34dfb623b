"""The subcommands fetch, get and watch."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.default_sources import find_defaults, report_no_defaults, say_sources
from paramclient.cli.every_vehicle import (
    Done,
    address_text,
    check_all,
    check_expected,
    every_vehicle,
    failed_json,
    report_failures,
    run_on_all,
)
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.extended import (
    check_choice,
    fetch_extended,
    get_extended,
    is_extended_session,
    watch_extended,
)
from paramclient.cli.json_output import FetchJson, ParamJson
from paramclient.cli.metadata import (
    DESCRIBED_COLUMNS,
    MetadataChoice,
    described_cells,
    from_file,
    known_of_session,
)
from paramclient.cli.options import Count, LinkOptions
from paramclient.cli.output import (
    by_index,
    default_text,
    milliseconds,
    print_json,
    print_table,
    printable,
    progress_bar,
    report,
    say,
)
from paramclient.cli.param_names import ChosenNames, check_given, may_appear, suggest
from paramclient.cli.session import CommandSession, connect
from paramclient.cli.waiting import while_waiting
from paramclient.cli.watch_lines import print_changes_and_events
from paramclient.errors import CacheError, NoReply, ParamClientError, UsageError
from paramclient.metadata import Metadata
from paramclient.model.defaults import Default, add_default, default_of
from paramclient.model.notation import hash_text
from paramclient.model.patterns import NameChoice, is_pattern
from paramclient.model.values import Param, Trust, format_value, type_name
from paramclient.model.wording import first_of
from paramclient.protocol.fetch import FetchResult, Policy, Progress

__all__ = ["fetch", "get", "watch"]

REFRESH_TIMEOUT: Final = 10.0
"""Seconds to wait for the values that the vehicle's hash does not cover, without --timeout."""
AWAITED_NAMES_MAX: Final = 3
"""Parameters that the line about awaited values names."""
INDICES_SHOWN_MAX: Final = 20
"""Missing indices that a message names, so that it stays readable; it gives the number of further ones."""

_DEFAULTS: Final = LinkOptions()


async def fetch(
    url: str,
    /,
    *names: Annotated[str, Parameter(show=False)],
    only: Annotated[tuple[str, ...], Parameter(show_default=False)] = (),
    refresh: bool = False,
    changed: bool = False,
    policy: Policy = Policy.AUTO,
    metadata: MetadataChoice = None,
    extended: bool = False,
    plain: bool = False,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    expect: Count = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle's hash matches, otherwise downloads.

    Exit code 1: some parameters are missing, or with --changed, the firmware's defaults are not known.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, tcp:HOST:PORT or sim:px4.
        names: Not accepted; the error names the commands that take names.
        only: Print only this name or pattern, such as "MC_*". May be given several times.
        refresh: Download all parameters even if the cache is up to date.
        changed: Print only parameters that differ from the firmware's defaults: those of the vehicle, else
            those of its metadata.
        policy: Requests that may be sent to the vehicle: all that are needed, only for its hash, or none.
        metadata: A file with the firmware's defaults; or vehicle, to download the vehicle's own metadata.
            Default: the stored metadata of the firmware; else, with --changed, that of the vehicle if it can
            be downloaded in 2 s.
        extended: Use the extended parameters (PARAM_EXT_*) of the component, such as a camera. Without this
            option, they are used if a camera or other payload answers a request for the first one.
        plain: Use the plain parameters, even if the component has extended ones.
        all_: Fetch from every vehicle heard within 3 s.
        expect: With --all: wait up to 10 s for this number of vehicles, and fail with fewer.
    """
    if names:
        given = shlex.quote(names[0])
        raise UsageError(
            f"fetch takes no names, as it fetches all: `paramclient get {url} {given}` reads only some, "
            f"`paramclient fetch {url} --only {given}` fetches all and prints some"
        )
    check_choice(extended=extended, plain=plain)
    from_option = from_file(metadata)
    fetching = _Fetching(refresh, policy)

    async def described(fetched: _Fetched) -> _Fetched:
        """Add the defaults of the metadata, if they are shown."""
        if not (changed or options.json or metadata is not None):
            return fetched
        found = await find_defaults(fetched.session, metadata, from_option, fetched.params)
        return replace(fetched, described=found)

    async def fetch_described(session: CommandSession) -> _Fetched:
        return await described(await fetching.fetch(session))

    check_expected(expect, all_=all_)
    if all_:
        check_all(options, extended=extended)
        async with every_vehicle(url, options, expect=expect, policy=policy) as sessions:
            fleet = await run_on_all(sessions, fetch_described)
        return _show_fleet(fleet, only, options, changed=changed)
    async with connect(url, options, policy=policy) as session:
        if await is_extended_session(session, extended=extended, plain=plain or changed):
            return await fetch_extended(session, only)
        with progress_bar(f"fetching {session.label}") as progress:
            fetched = await fetching.fetch(session, progress)
        fetched = await described(fetched)
        await session.report_others(has_all=True)
    has_defaults = fetched.has_defaults
    if only:
        chosen, unmatched = NameChoice(only).choose({param.name for param in fetched.params})
        if unmatched:
            raise UsageError(f"no parameter of {session.label} is called {unmatched}")
        fetched = replace(fetched, params=[param for param in fetched.params if param.name in chosen])
    if changed:
        fetched = replace(fetched, params=fetched.changed)
    for note in fetched.notes:
        report(note)
    if options.json:
        print_json(fetched.as_json())
    else:
        if not changed:
            rows = ((*_cells(param), param.trust) for param in fetched.params)
            print_table([*_COLUMNS, "trust"], rows, right="value index")
        elif has_defaults:
            rows = ((*_cells(param), param.trust, default_text(param)) for param in fetched.with_defaults)
            print_table([*_COLUMNS, "trust", "default"], rows, right="value index default")
            say_sources(session.label, fetched.defaults)
        say(printable(fetched.summary))
    if changed and not has_defaults:
        report_no_defaults()
        return ExitCode.INCOMPLETE
    if fetched.missing:
        report(fetched.incomplete)
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


async def get(
    url: str,
    name: str,
    /,
    *names: str,
    metadata: MetadataChoice = None,
    extended: bool = False,
    plain: bool = False,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    expect: Count = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Read parameters from the vehicle.

    Args:
        url: The link.
        name: The parameter, in upper or lower case, or a pattern such as "MC_*": then the whole table is
            fetched, from the cache if the vehicle's hash matches.
        names: Further parameters and patterns.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Use the extended parameters (PARAM_EXT_*) of the component, such as a camera. Without this
            option, they are used if a camera or other payload answers a request for the first one.
        plain: Use the plain parameters, even if the component has extended ones.
        all_: Read from every vehicle heard within 3 s.
        expect: With --all: wait up to 10 s for this number of vehicles, and fail with fewer.
    """
    check_choice(extended=extended, plain=plain)
    described = from_file(metadata)
    name_patterns = check_given((name, *names))
    check_expected(expect, all_=all_)
    if all_:
        check_all(options, extended=extended)
        async with every_vehicle(url, options, expect=expect) as sessions:
            read = await run_on_all(
                sessions, lambda each: _read(each, name_patterns, described, metadata, draws=False)
            )
        return _show_read(read, options)
    async with connect(url, options) as session:
        if await is_extended_session(session, extended=extended, plain=plain):
            return await get_extended(session, name_patterns)
        params, errors, described = await _read(session, name_patterns, described, metadata)
        await session.report_others(has_all=True)
    if options.json:
        print_json(_read_json(params, errors, described))
    elif params and described is None:
        print_table(_COLUMNS, map(_cells, params), right="value index")
    elif params and described is not None:
        rows = ((*_cells(param), *described_cells(described, param)) for param in params)
        print_table([*_COLUMNS, *DESCRIBED_COLUMNS], rows, right="value index")
    return _report_all(errors.values())


async def watch(
    url: str,
    /,
    *names: str,
    policy: Policy = Policy.AUTO,
    extended: bool = False,
    plain: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Print changes of values by any source, as they happen, until Ctrl-C or --timeout.

    Updates the table first, and also prints values that have changed since the cache was written. Also prints
    when the vehicle is lost, found or rebooted, and when its table is in sync again. Parameters that appear
    later, such as after a change of an *_ENABLE parameter, are watched too if a name or pattern matches.

    Args:
        url: The link.
        names: The parameters to watch, or patterns such as "MC_*". Default: all.
        policy: Requests that may be sent besides those for NAMES: all that are needed, only for the hash, or
            none.
        extended: Watch the extended parameters (PARAM_EXT_*) of the component, such as a camera. Without this
            option, they are used if a camera or other payload answers a request for the first one.
        plain: Watch the plain parameters, even if the component has extended ones.
    """
    check_choice(extended=extended, plain=plain)
    name_patterns = check_given(names)
    async with connect(url, options, policy=policy, is_live=True) as session:
        if await is_extended_session(session, extended=extended, plain=plain):
            return await watch_extended(session, name_patterns)
        changes, events = session.component.changes(), session.client.events()
        listens = session.client.listens_only
        has_pattern = any(map(is_pattern, name_patterns))
        if not listens and (has_pattern or not name_patterns):
            with suppress(CacheError):  # with an empty cache, all received parameters are new
                await _fetch_all(session)
        if name_patterns and not listens and (code := await _check_watched(session, name_patterns)):
            return code
        known = None if listens else set(session.component.params)
        watched = ", ".join(name_patterns) if name_patterns else f"{len(session.component.params)} parameters"
        say(printable(f"watching {watched} of {session.label}"))
        await session.report_others()
        failure: Exception | None = None
        async with anyio.create_task_group() as tasks:
            if name_patterns and not has_pattern and not listens:
                tasks.start_soon(_follow_groups, session)
            with anyio.move_on_after(session.deadline.left()):
                try:
                    choice = NameChoice(name_patterns) if name_patterns else None
                    await print_changes_and_events(session, changes, events, known, choice)
                except Exception as error:  # raised here, the task group would wrap it in a group
                    failure = error
            tasks.cancel_scope.cancel()
        if failure is not None:
            raise failure
    return ExitCode.DONE


# fetch


@dataclass(frozen=True, slots=True)
class _Fetching:
    """How parameters are fetched."""

    refresh: bool
    policy: Policy

    async def fetch(
        self, session: CommandSession, progress: Callable[[Progress], None] | None = None
    ) -> _Fetched:
        """Fetch the table of a vehicle, and the values that its hash does not cover."""
        result = await session.component.fetch_all(
            refresh=self.refresh,
            timeout=session.deadline.left(),
            progress=progress,
        )
        with suppress(NoReply):
            await session.component.refreshed(timeout=session.deadline.left(REFRESH_TIMEOUT))
        return _Fetched.of(session, result, self.policy)


@dataclass(frozen=True, slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session.

    A value that is only cached is left out, and its index counts as missing. If the policy prevents its
    request, it is included and named in `cached`. `described` has defaults of
    the metadata, by name.
    """

    session: CommandSession
    result: FetchResult
    params: list[Param]
    missing: list[int]
    cached: list[str]
    bytes_received: int
    bytes_sent: int
    described: Mapping[str, int | float] = field(default_factory=dict)

    @classmethod
    def of(cls, session: CommandSession, result: FetchResult, policy: Policy) -> _Fetched:
        """Select the parameters of a fetch under a policy."""
        params = by_index(session.component.params.values())
        cached = [param for param in params if param.trust is Trust.CACHED]
        missing = set(result.missing)
        if policy is Policy.AUTO:
            if result.source == "cache":
                missing = {param.index for param in cached if param.index is not None}
            params = [param for param in params if param.trust is not Trust.CACHED]
            cached = []
        return cls(
            session,
            result,
            params=params,
            missing=sorted(missing),
            cached=[param.name for param in cached],
            bytes_received=session.client.bytes_received,
            bytes_sent=session.client.bytes_sent,
        )

    @property
    def with_defaults(self) -> list[Param]:
        """The parameters with the defaults of the metadata, where the vehicle has given none."""
        return [add_default(param, self.described.get(param.name)) for param in self.params]

    @property
    def defaults(self) -> list[Default | None]:
        """The default of each parameter."""
        return [default_of(param, self.described.get(param.name)) for param in self.params]

    @property
    def has_defaults(self) -> bool:
        """Whether the default of a parameter is known."""
        return any(default is not None for default in self.defaults)

    @property
    def changed(self) -> list[Param]:
        """The parameters that differ from their default."""
        pairs = zip(self.params, self.with_defaults, strict=True)
        return [param for param, known in pairs if known.is_changed]

    @property
    def received(self) -> int:
        """The number of parameters that were received or confirmed."""
        return self.result.count - len(self.missing)

    @property
    def notes(self) -> list[str]:
        """Remarks for the user."""
        return [*self.result.notes]

    @property
    def incomplete(self) -> str:
        """The line about missing parameters."""
        number = "was" if len(self.missing) == 1 else "were"
        return (
            f"incomplete: {_index_text(self.missing)} of {self.session.label} {number} not received; run the "
            "command again to request what is missing"
        )

    @property
    def summary(self) -> str:
        """The line about the fetch: parameters, source, seconds, losses, bytes, hash."""
        result = self.result
        of = f" of {result.count}" if self.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {milliseconds(result.round_trip)}, "
        transferred = f"{self.bytes_received:,} bytes received, {self.bytes_sent:,} sent"
        if len(self.session.client.components) > 1:  # the counters are those of the link
            transferred = f"{transferred} on the whole link"
        return (
            f"{self.received}{of} parameters of {self.session.label} from {result.source} in "
            f"{result.elapsed:.2f} s, {lost}{trip}{transferred}{crc}"
        )

    def as_json(self) -> FetchJson:
        """Return the JSON object."""
        return FetchJson.of(
            self.session.component,
            self.result,
            self.params,
            missing=self.missing,
            cached=self.cached,
            bytes_received=self.bytes_received,
            bytes_sent=self.bytes_sent,
            described=self.described,
        )


def _show_fleet(
    fleet: Sequence[Done[CommandSession, _Fetched]],
    only: Sequence[str],
    options: LinkOptions,
    *,
    changed: bool,
) -> int:
    """Print the tables of several vehicles, and the failures; return the exit code."""
    found = [each.result for each in fleet if each.result is not None]
    has_defaults = any(each.has_defaults for each in found)
    if only:
        chosen, unmatched = NameChoice(only).choose({param.name for each in found for param in each.params})
        if unmatched and found:
            raise UsageError(f"no parameter of any vehicle is called {unmatched}")
        found = [replace(each, params=[p for p in each.params if p.name in chosen]) for each in found]
    if changed:
        found = [replace(each, params=each.changed) for each in found]
    for each in found:
        for note in each.notes:
            report(f"{each.session.label}: {note}")
    if options.json:
        print_json({"vehicles": [each.as_json() for each in found], "errors": failed_json(fleet)})
    else:
        rows = (
            (address_text(each.session), *_cells(param), param.trust, *([default_text(param)] * changed))
            for each in found
            for param in each.with_defaults
        )
        columns = ["vehicle", *_COLUMNS, "trust", *(["default"] * changed)]
        print_table(columns, rows, right="value index default")
        for each in found:
            if changed:
                say_sources(each.session.label, each.defaults)
            say(printable(each.summary))
    code = report_failures(fleet)
    for each in found:
        if each.missing:
            report(each.incomplete)
            code = max(code, ExitCode.INCOMPLETE)
    if changed and not has_defaults:
        report_no_defaults()
        code = max(code, ExitCode.INCOMPLETE)
    return code


async def _fetch_all(session: CommandSession, *, draws: bool = True) -> FetchResult:
    with progress_bar(f"fetching {session.label}") if draws else nullcontext() as progress:
        return await session.component.fetch_all(timeout=session.deadline.left(), progress=progress)


def _index_text(indices: Sequence[int]) -> str:
    return f"{'index' if len(indices) == 1 else 'indices'} {first_of(indices, INDICES_SHOWN_MAX)}"


# get

_COLUMNS: Final = ("name", "value", "type", "index")
"""Columns of the table of parameters."""


def _cells(param: Param) -> tuple[object, ...]:
    return (
        param.name,
        format_value(param.settable, param.type_number),
        type_name(param.type_number),
        param.index,
    )


async def _read(
    session: CommandSession,
    name_patterns: Sequence[str],
    described: Metadata | None,
    choice: MetadataChoice,
    *,
    draws: bool = True,
) -> tuple[list[Param], dict[str, ParamClientError], Metadata | None]:
    """Read the chosen parameters of a vehicle; return them, the errors by name, and the metadata."""
    params, errors = await _get_chosen(session, name_patterns, draws=draws)
    if described is None:
        described = await known_of_session(session, choice)
    return params, errors, described


def _read_json(
    params: Iterable[Param], errors: Mapping[str, ParamClientError], described: Metadata | None
) -> dict[str, object]:
    """Return the JSON of parameters with all their metadata, and of errors by name."""
    infos = {param.name: None if described is None else described.find(param.name) for param in params}
    read = {param.name: ParamJson.of(param, infos[param.name], whole=True) for param in params}
    failed = {name: str(error) for name, error in errors.items()}
    return {"params": read, **({"errors": failed} if failed else {})}


def _show_read(
    read: Sequence[Done[CommandSession, tuple[list[Param], dict[str, ParamClientError], Metadata | None]]],
    options: LinkOptions,
) -> int:
    """Print the parameters of several vehicles, and the failures; return the exit code."""
    found = [(each.vehicle, *each.result) for each in read if each.result is not None]
    if options.json:
        vehicles = [
            {
                "system": session.component.system,
                "component": session.component.component,
                **_read_json(params, errors, known),
            }
            for session, params, errors, known in found
        ]
        print_json({"vehicles": vehicles, "errors": failed_json(read)})
    else:
        is_described = any(described is not None for *_, described in found)
        no_meaning = ("", "") if is_described else ()
        rows = (
            (
                *(address_text(session), *_cells(param)),
                *(no_meaning if described is None else described_cells(described, param)),
            )
            for session, params, _, described in found
            for param in params
        )
        columns = ["vehicle", *_COLUMNS, *(DESCRIBED_COLUMNS if is_described else ())]
        print_table(columns, rows, right="value index")
    code = report_failures(read)
    for session, _, errors, _ in found:
        for error in errors.values():
            report(f"{session.label}: {error}")
            code = max(code, code_of(error))
    return code


async def _get_chosen(
    session: CommandSession, name_patterns: Sequence[str], *, draws: bool = True
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched. Values that were received or confirmed by that are not read again.
    """
    component = session.component
    has_pattern = any(map(is_pattern, name_patterns))
    if has_pattern:
        await _fetch_all(session, draws=draws)
        with suppress(NoReply):
            await component.refreshed(timeout=session.deadline.left(REFRESH_TIMEOUT))
    chosen = ChosenNames.of(component, name_patterns)
    known = {
        name: component.params[name] for name in chosen.names if has_pattern and name in component.params
    }
    fresh = {name: param for name, param in known.items() if param.trust is not Trust.CACHED}
    requested = [name for name in chosen.names if name not in fresh]
    read, errors = await while_waiting(
        lambda _: _get_all(session, requested), f"{first_of(requested, AWAITED_NAMES_MAX)} of {session.label}"
    )
    answered = [name for name in requested if name not in errors]
    found = fresh | dict(zip(answered, read, strict=True))
    return (
        [found[name] for name in chosen.names if name in found],
        await suggest(session, {**errors, **chosen.errors}),
    )


async def _get_all(
    session: CommandSession, names: Sequence[str]
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read several parameters concurrently; return parameters and errors in the order of the names."""
    found: dict[str, Param] = {}
    errors: dict[str, ParamClientError] = {}

    async def read(name: str) -> None:
        try:
            found[name] = await session.component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            errors[name] = error

    async with anyio.create_task_group() as tasks:
        for name in names:
            tasks.start_soon(read, name)
    return (
        [found[name] for name in names if name in found],
        {name: errors[name] for name in names if name in errors},
    )


def _report_all(errors: Iterable[ParamClientError]) -> int:
    """Print every error; return the exit code for all of them."""
    worst = ExitCode.DONE
    for error in errors:
        report(str(error))
        worst = max(worst, code_of(error))
    return worst


# watch


async def _check_watched(session: CommandSession, name_patterns: Sequence[str]) -> int:
    """Read the watched parameters, and report those that the vehicle does not have; return the exit code.

    A name or pattern of a group that the vehicle currently hides may appear later, and is no error.
    """
    _, errors = await _get_chosen(session, [text for text in name_patterns if not is_pattern(text)])
    patterns = [text for text in name_patterns if is_pattern(text)]
    errors |= ChosenNames.of(session.component, patterns).errors
    hidden = [name for name in errors if may_appear(name, session.component)]
    if hidden:
        say(printable(f"not there at present: {', '.join(hidden)}"))
    return _report_all(error for name, error in errors.items() if name not in hidden)


async def _follow_groups(session: CommandSession) -> None:
    """Fetch the table, so that added and removed parameters are noticed. Values were read already."""
    with suppress(ParamClientError):  # the events and the end of the changes report it
        await session.component.fetch_all()
