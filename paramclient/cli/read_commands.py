"""The subcommands fetch and get."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.default_sources import find_defaults, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import FetchJson, ParamJson
from paramclient.cli.metadata import (
    DESCRIBED_COLUMNS,
    MetadataChoice,
    described_cells,
    from_file,
    known_of_session,
)
from paramclient.cli.options import LinkOptions
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
    while_waiting,
)
from paramclient.cli.param_names import ChosenNames, check_given, learn_spelling, suggest
from paramclient.cli.session import (
    CommandSession,
    Done,
    failed_json,
    report_failures,
    report_others,
    run_on_all,
    sessions,
)
from paramclient.errors import ParamClientError, UsageError
from paramclient.metadata import Metadata
from paramclient.model.defaults import Default, add_default, default_of
from paramclient.model.names import NameChoice, is_pattern
from paramclient.model.notation import hash_text
from paramclient.model.values import Param, Trust, format_value, type_name
from paramclient.model.wording import first_of
from paramclient.protocol.fetch import FetchResult, Policy

__all__ = ["fetch", "fetch_table", "get", "get_chosen", "report_all"]

AWAITED_NAMES_MAX: Final = 3
"""Parameters that the line about awaited values names."""
INDICES_SHOWN_MAX: Final = 20
"""Missing indices that a message names, so that it stays readable; it gives the number of further ones."""

_DEFAULTS: Final = LinkOptions()


async def fetch(
    url: str,
    /,
    *names: Annotated[str, Parameter(show=False)],
    only: tuple[str, ...] = (),
    refresh: bool = False,
    changed: bool = False,
    policy: Policy = Policy.AUTO,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads.

    Args:
        url: The link: udpin:0.0.0.0:14550, tcp:HOST:PORT, serial:PATH, sim:px4.
        names: Not accepted; the error names the commands that take names.
        only: Print only this name or pattern, such as "MC_*"; repeatable.
        refresh: Download even if the cache is up to date.
        changed: Print only values that differ from the firmware's defaults.
        policy: What may be requested of the vehicle.
        metadata: A file with defaults; or vehicle, to download them from it.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    if names:
        given = shlex.quote(names[0])
        raise UsageError(
            f"fetch takes no names, as it fetches all: `paramclient get {url} {given}` reads only some, "
            f"`paramclient fetch {url} --only {given}` fetches all and prints some"
        )
    from_option = from_file(metadata)
    async with sessions(url, options, policy=policy, extended=extended) as found:

        async def work(session: CommandSession) -> _Fetched:
            fetched = _Fetched.of(session, await fetch_table(session, refresh=refresh), policy)
            if not (changed or options.json or metadata is not None):
                return fetched
            known = await find_defaults(session, metadata, from_option, fetched.params)
            return replace(fetched, described=known)

        done = await run_on_all(found, work)
        await report_others(found)
    return _show_fetched(done, only, options, changed=changed)


async def get(
    url: str,
    name: str,
    /,
    *names: str,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Read parameters from the vehicle.

    Args:
        url: The link.
        name: The parameter, in upper or lower case, or a pattern such as "MC_*": then the whole table is
            fetched, from the cache if the vehicle confirms it.
        names: Further parameters and patterns.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    given = check_given((name, *names))
    from_option = from_file(metadata)
    async with sessions(url, options, extended=extended) as found:

        async def work(session: CommandSession) -> _Read:
            params, errors = await get_chosen(session, given)
            return _Read(session, params, errors, from_option or await known_of_session(session, metadata))

        done = await run_on_all(found, work)
        await report_others(found)
    return _show_read(done, options)


# fetch


async def fetch_table(session: CommandSession, *, refresh: bool = False) -> FetchResult:
    """Fetch the table of a session."""
    is_one = not session.choice.is_all
    with progress_bar(f"fetching {session.label}") if is_one else nullcontext() as progress:
        return await session.component.fetch_all(
            refresh=refresh, timeout=session.deadline.left(), progress=progress
        )


@dataclass(frozen=True, slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session.

    A value that is only cached is left out. If the policy prevents its request, it is included and named in
    `cached` of the result. `described` has defaults of the metadata, by name.
    """

    session: CommandSession
    result: FetchResult
    params: list[Param]
    bytes_received: int
    bytes_sent: int
    described: Mapping[str, int | float] = field(default_factory=dict)

    @classmethod
    def of(cls, session: CommandSession, result: FetchResult, policy: Policy) -> _Fetched:
        """Select the parameters of a fetch under a policy."""
        left_out = set(result.cached) if policy is Policy.AUTO else set()
        return cls(
            session,
            replace(result, cached=()) if left_out else result,
            params=by_index(each for name, each in result.params.items() if name not in left_out),
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
    def changed(self) -> list[Param]:
        """The parameters that differ from their default."""
        pairs = zip(self.params, self.with_defaults, strict=True)
        return [param for param, known in pairs if known.is_changed]

    @property
    def incomplete(self) -> str:
        """The line about missing parameters."""
        missing = self.result.missing
        indices = f"{'index' if len(missing) == 1 else 'indices'} "
        indices += first_of(missing, INDICES_SHOWN_MAX)
        number = "was" if len(missing) == 1 else "were"
        return (
            f"incomplete: {indices} of {self.session.label} {number} not received; run the command again to "
            "request what is missing"
        )

    @property
    def summary(self) -> str:
        """The line about the fetch: parameters, source, seconds, losses, bytes, hash."""
        result = self.result
        of = f" of {result.count}" if result.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {milliseconds(result.round_trip)}, "
        transferred = f"{self.bytes_received:,} bytes received, {self.bytes_sent:,} sent"
        if len(self.session.client.components) > 1:  # the counters are those of the link
            transferred = f"{transferred} on the whole link"
        return (
            f"{result.received}{of} {self.session.noun}s of {self.session.label} from "
            f"{result.source} in {result.elapsed:.2f} s, {lost}{trip}{transferred}{crc}"
        )

    def as_json(self) -> FetchJson:
        """Return the JSON object."""
        return FetchJson.of(
            self.session.component,
            self.result,
            self.params,
            bytes_received=self.bytes_received,
            bytes_sent=self.bytes_sent,
            described=self.described,
        )


def _show_fetched(
    done: Sequence[Done[_Fetched]], only: Sequence[str], options: LinkOptions, *, changed: bool
) -> int:
    """Print the tables of the vehicles, and the failures; return the exit code."""
    is_all = done[0].session.choice.is_all
    found = [each.result for each in done if each.result is not None]
    has_defaults = any(default is not None for each in found for default in each.defaults)
    if only and found:
        chosen, unmatched = NameChoice(only).choose({param.name for each in found for param in each.params})
        if unmatched:
            whose = "any vehicle" if is_all else found[0].session.label
            raise UsageError(f"no parameter of {whose} is called {unmatched}")
        found = [replace(each, params=[p for p in each.params if p.name in chosen]) for each in found]
    if changed:
        found = [replace(each, params=each.changed) for each in found]
    for each in found:
        for note in each.result.notes:
            report(f"{each.session.prefix}{note}")
    if options.json:
        objects = [each.as_json() for each in found]
        print_json({"vehicles": objects, "errors": failed_json(done)} if is_all else objects[0])
    else:
        if has_defaults or not changed:
            more = ("trust", "default") if changed else ("trust",)
            rows = (
                (each.session, param, (param.trust, *([default_text(param)] * changed)))
                for each in found
                for param in each.with_defaults
            )
            _print_params(rows, more, is_all=is_all)
        for each in found:
            if changed and has_defaults:
                say_sources(each.session.label, each.defaults)
            say(printable(each.summary))
    code = report_failures(done)
    for each in found:
        if each.result.missing:
            report(each.incomplete)
            code = max(code, ExitCode.INCOMPLETE)
    if changed and not has_defaults:
        report_no_defaults()
        code = max(code, ExitCode.INCOMPLETE)
    return code


def _print_params(
    rows: Iterable[tuple[CommandSession, Param, Sequence[object]]], more: Sequence[str], *, is_all: bool
) -> None:
    """Print a table of parameters: session, parameter and the cells of the columns `more`."""
    cells = (
        (
            *([session.address] if is_all else []),
            param.name,
            format_value(param.settable, param.type_number),
            type_name(param.type_number),
            param.index,
            *others,
        )
        for session, param, others in rows
    )
    columns = [*(["vehicle"] if is_all else []), "name", "value", "type", "index", *more]
    print_table(columns, cells, right="value index default")


# get


@dataclass(frozen=True, slots=True)
class _Read:
    """The parameters that were read from a vehicle, the errors by name, and the metadata."""

    session: CommandSession
    params: Sequence[Param]
    errors: Mapping[str, ParamClientError]
    described: Metadata | None

    def as_json(self) -> dict[str, object]:
        """Return the JSON of the parameters with all their metadata, and of the errors."""
        known = self.described
        infos = {each.name: None if known is None else known.find(each.name) for each in self.params}
        read = {each.name: ParamJson.of(each, infos[each.name], whole=True) for each in self.params}
        failed = {name: str(error) for name, error in self.errors.items()}
        return {"params": read, **({"errors": failed} if failed else {})}


def _show_read(done: Sequence[Done[_Read]], options: LinkOptions) -> int:
    """Print the parameters of the vehicles, and the failures; return the exit code."""
    is_all = done[0].session.choice.is_all
    found = [each.result for each in done if each.result is not None]
    if options.json:
        objects = [each.as_json() for each in found]
        vehicles = [
            {"system": each.session.component.system, "component": each.session.component.component, **own}
            for each, own in zip(found, objects, strict=True)
        ]
        print_json({"vehicles": vehicles, "errors": failed_json(done)} if is_all else objects[0])
    elif is_all or any(each.params for each in found):
        is_described = any(each.described is not None for each in found)
        no_meaning = ("", "") if is_described else ()
        rows = (
            (
                each.session,
                param,
                no_meaning if each.described is None else described_cells(each.described, param),
            )
            for each in found
            for param in each.params
        )
        _print_params(rows, DESCRIBED_COLUMNS if is_described else (), is_all=is_all)
    code = report_failures(done)
    for each in found:
        if doubt := each.session.component.session.encoding_doubt:
            report(f"{each.session.prefix}{doubt}")
        code = max(code, report_all(each.errors.values(), each.session.prefix))
    return code


async def get_chosen(
    session: CommandSession, name_patterns: Sequence[str]
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched. Values that were received or confirmed by that are not read again.
    """
    component = session.component
    has_pattern = any(map(is_pattern, name_patterns))
    if has_pattern:
        await fetch_table(session)
    await learn_spelling(component, name_patterns)
    chosen = ChosenNames.of(component, name_patterns)
    known = {
        name: component.params[name] for name in chosen.names if has_pattern and name in component.params
    }
    found = {name: param for name, param in known.items() if param.trust is not Trust.CACHED}
    requested = [name for name in chosen.names if name not in found]
    errors: dict[str, ParamClientError] = {}

    async def read(name: str) -> None:
        try:
            found[name] = await component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            errors[name] = error

    async def read_all(_: object) -> None:
        async with anyio.create_task_group() as tasks:
            for name in requested:
                tasks.start_soon(read, name)

    await while_waiting(read_all, f"{first_of(requested, AWAITED_NAMES_MAX)} of {session.label}")
    in_order = {name: errors[name] for name in requested if name in errors}
    return (
        [found[name] for name in chosen.names if name in found],
        await suggest(session, {**in_order, **chosen.errors}),
    )


def report_all(errors: Iterable[ParamClientError], prefix: str = "") -> int:
    """Print every error; return the exit code for all of them."""
    worst = ExitCode.DONE
    for error in errors:
        report(f"{prefix}{error}")
        worst = max(worst, code_of(error))
    return worst
