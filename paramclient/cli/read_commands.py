"""The subcommands fetch and get."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.default_sources import find_defaults, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import JsonObject, fetch_json
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    known_of_session,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import Status, by_index, milliseconds, report, say
from paramclient.cli.param_names import check_given, choose_names, learn_spelling, suggest
from paramclient.cli.param_table import RIGHT, ParamTable
from paramclient.cli.session import CommandSession, sessions
from paramclient.errors import ParamClientError, UsageError
from paramclient.model.names import NameChoice, is_pattern
from paramclient.model.notation import hash_text
from paramclient.model.values import Param, Trust
from paramclient.model.wording import first_of
from paramclient.protocol.fetch import FetchResult, Policy

__all__ = ["fetch", "get", "get_chosen", "report_all"]

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
        name = shlex.quote(names[0])
        raise UsageError(
            f"fetch takes no names, as it fetches all: `paramclient get {url} {name}` reads only some, "
            f"`paramclient fetch {url} --only {name}` fetches all and prints some"
        )
    given = from_file(metadata)
    async with sessions(url, options, policy=policy, extended=extended) as found:

        async def work(session: CommandSession) -> _Fetched:
            fetched = _Fetched.of(session, await session.fetch(refresh=refresh), policy)
            if changed or options.json or metadata is not None:
                table = fetched.table
                table.described = await find_defaults(session, metadata, given, table.params)
            return fetched

        done = await found.work(work)
        await found.report_others()
    fetched = [each.result for each in done if each.result is not None]
    if only and fetched:
        received = {param.name for each in fetched for param in each.table.params}
        chosen, unmatched = NameChoice(only).choose(received)
        if unmatched:
            whose = "any vehicle" if found.is_all else fetched[0].session.label
            raise UsageError(f"no parameter of {whose} is called {unmatched}")
        for each in fetched:
            each.table.keep(chosen)
    lacks_defaults = changed and not any(each.table.defaults for each in fetched)
    for each in fetched:
        for note in each.result.notes:
            report(f"{each.session.prefix}{note}")
        if changed:
            each.table.keep_changed()
    code = found.show(done, max([each.table.columns for each in fetched], key=len, default=[]), RIGHT)
    for each in [] if options.json or lacks_defaults else fetched:
        if changed:
            say_sources(each.session.label, each.table.defaults)
        say(each.summary)
    for each in fetched:
        if each.result.missing:
            report(each.incomplete)
            code = max(code, ExitCode.INCOMPLETE)
    if lacks_defaults:
        report_no_defaults()
        code = max(code, ExitCode.INCOMPLETE)
    return code


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
    chosen = check_given((name, *names))
    given = from_file(metadata)
    async with sessions(url, options, extended=extended) as found:

        async def work(session: CommandSession) -> _Read:
            params, errors = await get_chosen(session, chosen)
            known = given or await known_of_session(session, metadata)
            return _Read(ParamTable(params, metadata=known), errors)

        done = await found.work(work)
        await found.report_others()
    read = [(each.session, each.result) for each in done if each.result is not None]
    code = found.show(done, max([each.table.columns for _, each in read], key=len, default=[]), RIGHT)
    for session, each in read:
        if doubt := session.component.session.encoding_doubt:
            report(f"{session.prefix}{doubt}")
        code = max(code, report_all(each.errors.values(), session.prefix))
    return code


@dataclass(frozen=True, slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session.

    A value that is only cached is left out. If the policy prevents its request, it is included and named in
    `cached` of the result.
    """

    session: CommandSession
    result: FetchResult
    table: ParamTable
    traffic: dict[str, int]

    @classmethod
    def of(cls, session: CommandSession, result: FetchResult, policy: Policy) -> _Fetched:
        """Select the parameters of a fetch under a policy."""
        left_out = set(result.cached) if policy is Policy.AUTO else set()
        params = by_index(each for name, each in result.params.items() if name not in left_out)
        return cls(
            session,
            replace(result, cached=()) if left_out else result,
            ParamTable(params, more=("trust", lambda param: param.trust)),
            {"bytes_received": session.client.bytes_received, "bytes_sent": session.client.bytes_sent},
        )

    @property
    def incomplete(self) -> str:
        """The line about missing parameters."""
        missing = self.result.missing
        indices = "index" if len(missing) == 1 else "indices"
        return (
            f"incomplete: {indices} {first_of(missing, INDICES_SHOWN_MAX)} of {self.session.label} "
            f"{'was' if len(missing) == 1 else 'were'} not received; run the command again to request what "
            "is missing"
        )

    @property
    def summary(self) -> str:
        """The line about the fetch: parameters, source, seconds, losses, bytes, hash."""
        result = self.result
        of = f" of {result.count}" if result.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {milliseconds(result.round_trip)}, "
        is_shared = len(self.session.client.components) > 1  # the counters are those of the link
        link = " on the whole link" if is_shared else ""
        return (
            f"{result.received}{of} {self.session.noun}s of {self.session.label} from "
            f"{result.source} in {result.elapsed:.2f} s, {lost}{trip}{self.traffic['bytes_received']:,} "
            f"bytes received, {self.traffic['bytes_sent']:,} sent{link}{crc}"
        )

    def as_json(self) -> JsonObject:
        """Return the JSON object."""
        table = self.table
        return fetch_json(self.session.component, self.result, table.params, table.described)

    def rows(self) -> Iterable[Sequence[object]]:
        """Return the rows of the table."""
        return self.table.rows()


@dataclass(frozen=True, slots=True)
class _Read:
    """The parameters that were read from a vehicle, and the errors by name."""

    table: ParamTable
    errors: Mapping[str, ParamClientError]

    def as_json(self) -> JsonObject:
        """Return the JSON of the parameters with all their metadata, and of the errors."""
        failed = {name: str(error) for name, error in self.errors.items()}
        return {"params": self.table.as_json(whole=True)} | ({"errors": failed} if failed else {})

    def rows(self) -> Iterable[Sequence[object]]:
        """Return the rows of the table."""
        return self.table.rows()


async def get_chosen(
    session: CommandSession, name_patterns: Sequence[str], *, is_fetched: bool = False
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched, unless it is already. Values that were received or confirmed by that
    are not read again.
    """
    component = session.component
    if not is_fetched and (is_fetched := any(map(is_pattern, name_patterns))):
        await session.fetch()
    await learn_spelling(component, name_patterns)
    names, unmatched = choose_names(component, name_patterns)
    known = component.params if is_fetched else {}
    found = {name: known[name] for name in names if name in known}
    found = {name: param for name, param in found.items() if param.trust is not Trust.CACHED}
    requested = [name for name in names if name not in found]
    errors: dict[str, ParamClientError] = {}

    async def read(name: str) -> None:
        try:
            found[name] = await component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            errors[name] = error

    with Status(f"waiting for {first_of(requested, AWAITED_NAMES_MAX)} of {session.label}"):
        async with anyio.create_task_group() as tasks:
            for name in requested:
                tasks.start_soon(read, name)
    in_order = {name: errors[name] for name in requested if name in errors}
    return (
        [found[name] for name in names if name in found],
        await suggest(session, in_order | unmatched),
    )


def report_all(errors: Iterable[ParamClientError], prefix: str = "") -> int:
    """Print every error; return the exit code for all of them."""
    worst = ExitCode.DONE
    for error in errors:
        report(f"{prefix}{error}")
        worst = max(worst, code_of(error))
    return worst
